# ruff: noqa
from judge import *  # noqa: F403

states, index = chosen_states()
sim = Simulator()
p = load_policy(RUNS / GROUPS["nine"][5])
state = sim.full(states.qpos[index], states.qvel[index])
S, N, V, V2, E = [], [], [], [], []
for k in range(40):
    old = state.copy()
    state = sim.step(state, act(p, sim.obs(state)))
    S.append(sim.obs(old))
    N.append(sim.obs(state))
    V.append(old[:, 11:19])
    V2.append(state[:, 11:19])
r = Rows.__new__(Rows)
f = lambda x: torch.as_tensor(np.stack(x, 1).reshape(-1, x[0].shape[1])).float()
r.s, r.n, V = f(S), f(N), f(V)
r.episode = torch.arange(len(index)).repeat_interleave(40)
c = r.s[:, 9:].abs() >= 9.999
before = (r.s[:, 9:] - V).abs()[c]
first = torch.zeros_like(c)
first[::40] = True
r.unclip()
e = (r.s[:, 9:] - V).abs()[c]
print(
    "clipcheck: clipped entries",
    int(c.sum()),
    "median error before",
    float(before.median()),
    "after",
    float(e.median()),
    "mean",
    float(before.mean()),
    float(e.mean()),
    "unclipped untouched",
    float((r.s[:, 9:] - V).abs()[~c].max()),
)
