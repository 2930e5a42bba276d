"""The body against Gymnasium's simulator, and its identification."""

from __future__ import annotations

import json
import os

import gymnasium
import numpy as np
import pytest
import torch
from composed import trained
from tensordict import TensorDict

from torchrl_osr.lab.dynamics import Body
from torchrl_osr.lab.dynamics.body import fitted_body
from torchrl_osr.lab.dynamics.training import MODEL, REPORT, load_dynamics

HOPPER = gymnasium.make("Hopper-v5").unwrapped


def played(env, rows: int, seed: int = 0) -> TensorDict:
    """Return transitions of random actions from random standing states."""
    rng, found = np.random.default_rng(seed), []
    env.reset(seed=seed)
    size = env.model.nq, env.model.nv
    for _ in range(rows):
        qpos = env.init_qpos + 0.1 * rng.standard_normal(size[0])
        env.set_state(qpos, rng.standard_normal(size[1]))
        before = env._get_obs()
        action = rng.uniform(-1, 1, env.model.nu)
        found.append([before, action, env.step(action)[0]])
    state, action, following = (
        torch.tensor(np.array(column), dtype=torch.float32)
        for column in zip(*found, strict=True)
    )
    after = {"observation": following}
    return TensorDict({"observation": state, "action": action, "next": after}, [rows])


def test_the_body_moves_as_gymnasiums_does() -> None:
    env = gymnasium.make("HalfCheetah-v5").unwrapped
    rows = played(env, 50)
    state, following = rows["observation"], rows["next", "observation"]
    loc, scale = state.mean(0), state.std(0)
    units = {"loc": loc.tolist(), "scale": scale.tolist(), "low": -2.0, "high": 1.0}
    body = Body(env.fullpath, env.frame_skip, **units)
    action = 2 * (rows["action"] + 2) / 3 - 1
    found = body((state - loc) / scale, action) * scale + loc
    close = {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(found, following, **close)
    control = -2 + 3 * (action + 1) / 2
    found = body.in_own_units()(state, control)
    torch.testing.assert_close(found, following, **close)
    exploding = body.in_own_units()(state + 1e3, control)
    assert not (exploding.abs() < 100).any(1).all(), "MuJoCo would reset it"


def test_a_description_that_has_changed_is_read_anew(tmp_path) -> None:
    xml = tmp_path / "robot.xml"
    for number, mass in enumerate(("1", "2")):
        geom = f'<geom size="1" mass="{mass}"/>'
        xml.write_text(f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>")
        os.utime(xml, (number, number))
        assert Body(str(xml), 1).model.body_mass[1] == float(mass)


def test_limits_of_sensors_are_numbers_that_many_rows_share() -> None:
    state = torch.randn(1000, 11)
    state[:, 10].clamp_(max=0.5)
    after = {"observation": state.roll(1, 0), "terminated": torch.zeros(1000, 1)}
    rows = TensorDict({"observation": state, "next": after}, [1000])
    body = Body(HOPPER.fullpath, 4).limited(rows)
    assert body.most[10] == 0.5
    assert np.isfinite(body.least + body.most).sum() == 1
    assert body.observed(torch.ones(1, 11))[0, 10] == 0.5
    shown = (state[:, 10] < 0.5) & (state.roll(1, 0)[:, 10] < 0.5)
    assert torch.equal(body.shows(rows), shown)
    state[:, 10] = 0.0
    with pytest.raises(ValueError, match="an observed number is at its limit or never"):
        fitted_body(body, rows, seed=0)


def test_rows_without_a_next_state_identify_no_body(capsys) -> None:
    rows = played(HOPPER, 60)
    rows["next", "terminated"] = torch.zeros(60, 1, dtype=torch.bool)
    ends = rows[:20].clone()
    ends["next", "observation"] = ends["observation"]
    ends["next", "terminated"] = ~ends["next", "terminated"]
    body = Body(HOPPER.fullpath, HOPPER.frame_skip)
    wanted, _ = fitted_body(body, rows, seed=0)
    found, left = fitted_body(body, torch.cat([rows, ends]), seed=0)
    assert found == wanted
    assert len(left) <= 60


GREY = [
    "loss=rim", "dynamics=grey_box", f"dynamics.xml={HOPPER.fullpath}",
    "dynamics.frame_skip=4", "dynamics.num_networks=2", "dynamics.num_elites=1",
    "dynamics.num_cells=[8]", "dynamics.batch_size=8", "dynamics.steps=20",
    "dynamics.rollout_starts=20",
]  # fmt: skip


def test_a_run_identifies_the_body_and_keeps_it(tmp_path, capsys) -> None:
    trained(tmp_path / "run", *GREY, "trainer.steps=2")
    errors = [line.split()[4] for line in capsys.readouterr().out.splitlines()
              if line.startswith("body as")]  # fmt: skip
    assert float(errors[1]) <= float(errors[0]) < 1e-3
    model = load_dynamics(tmp_path / "run" / MODEL)
    assert model.body is not None
    np.testing.assert_allclose(model.body.factors, 1, atol=0.05)
    report = json.loads((tmp_path / "run" / REPORT).read_text())
    assert min(report["r2"][:-1]) > 0.99
    state, action = torch.zeros(5, 11), torch.zeros(5, 3)
    left_over = model.predict(state, action)[0][..., :-1] + state
    left_over -= model.body(state, action)
    model.body = None
    wanted = model.predict(state, action)[0][..., :-1]
    torch.testing.assert_close(left_over, wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["env=walker2d"], "6 positions, 6 velocities .* 17 observed .* 6 actions"),
        (["loss=sdc"], "needs gradients of the model"),
        (["dynamics.adversarial_steps=5"], "needs gradients of the model"),
        (["dynamics.xml=none.xml"], "none.xml"),
        (["dynamics.xml="], "xml is not given: a grey box needs"),
    ],
)
def test_a_body_that_cannot_be_used_is_refused(tmp_path, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        trained(tmp_path / "run", *GREY, *options)
