# ruff: noqa
"""How exact must a judge be? The simulator with errors of the state, at the start or in every step."""

from judge import *  # noqa: F403
from judge_score import ranks_auc, within, chosen

states, index = chosen_states()
index = index[:166]
sim = Simulator()
qpos, qvel = states.qpos[index], states.qvel[index]
known = dict(np.load(HERE / "truth.npz"))
names = GROUPS["nine"]
true = np.stack([known[n][0][:166] for n in names], 1) == 300
acts = [load_policy(RUNS / n) for n in names]
scale = rows("replay").s.std(0).numpy()
rng = np.random.default_rng(0)


def lived(start, every, copies, clip=False):
    out = np.zeros((166, 9))
    for j, p in enumerate(acts):
        state = np.repeat(sim.full(qpos, qvel), copies, 0)
        n = len(state)
        if clip:
            state[:, 10:19] = state[:, 10:19].clip(-10, 10)
        state[:, 2:19] += start * scale * rng.standard_normal((n, 17))
        steps, going = np.zeros(n), np.arange(n)
        for _ in range(200):
            s = sim.step(state[going], act(p, sim.obs(state[going])))
            if every:
                s[:, 2:19] += every * scale * rng.standard_normal((len(going), 17))
            state[going] = s
            steps[going] += 1
            going = going[healthy(sim.obs(s))]
            if not len(going):
                break
        out[:, j] = steps.reshape(166, copies).mean(1)
    return out


for start, every, copies, clip in (
    (0, 0, 1, True),
    (0.01, 0, 1, False),
    (0.1, 0, 1, False),
    (0.1, 0, 5, False),
    (0, 0.01, 1, False),
    (0, 0.03, 5, False),
    (0, 0.1, 5, False),
):
    v = lived(start, every, copies, clip)
    print(
        "bound: clipped" if clip else "bound:",
        "error at start",
        start,
        "every step",
        every,
        "copies",
        copies,
        "AUC %.3f within %.3f saved %.1f"
        % (
            ranks_auc(v.ravel(), true.ravel()),
            within(v, true),
            100 * chosen(v, true)[0].mean(),
        ),
        flush=True,
    )
