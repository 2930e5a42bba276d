"""Write descriptions whose masses, gears, damping and friction are wrong by up to 30 %."""

import warnings

import gymnasium
import mujoco
import numpy as np

warnings.simplefilter("ignore")
for robot, env_id in (
    ("walker2d", "Walker2d-v5"),
    ("hopper", "Hopper-v5"),
    ("halfcheetah", "HalfCheetah-v5"),
):
    for draw in range(3 if robot != "halfcheetah" else 1):
        env = gymnasium.make(env_id).unwrapped
        true, rng = env.model, np.random.default_rng(draw)
        spec = mujoco.MjSpec.from_file(env.fullpath)
        names = [b.name for b in spec.bodies if b.name != "world"]
        f = 1 + 0.3 * rng.uniform(-1, 1, len(names) + true.nu + 2)
        masses, gears, (damping, friction) = f[: len(names)], f[len(names) : -2], f[-2:]
        for name, each in zip(names, masses):
            for g in spec.body(name).geoms:
                g.density *= each
        for a, each in zip(spec.actuators, gears):
            a.gear = np.array(a.gear) * each
        for j in spec.joints:
            j.damping = np.array(j.damping) * damping
        for g in spec.geoms:
            g.friction = [g.friction[0] * friction, *g.friction[1:]]
        m = spec.compile()
        open(f"{robot}-{draw}.xml", "w").write(spec.to_xml())
        m = mujoco.MjModel.from_xml_path(f"{robot}-{draw}.xml")
        ids = [
            (mujoco.mj_name2id(m, 1, n), mujoco.mj_name2id(true, 1, n)) for n in names
        ]
        if robot != "halfcheetah":
            assert np.allclose(
                [m.body_mass[i] / true.body_mass[j] for i, j in ids], masses, rtol=1e-4
            )
        assert np.allclose(
            m.actuator_gear[:, 0] / true.actuator_gear[:, 0], gears, rtol=1e-4
        )
        print(robot, draw, f.round(2), "mean", np.abs(f - 1).mean().round(3))
