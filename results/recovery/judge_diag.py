# ruff: noqa
"""One-step error along the true ways of the policies from the recoverable states, against held-out rows."""

from judge import *  # noqa: F403

states, index = chosen_states()
sim = Simulator()
qpos, qvel = states.qpos[index][:166], states.qvel[index][:166]
arms = [
    a
    for a in (
        "plain-replay",
        "plain",
        "long",
        "norm",
        "mirror",
        "steps8",
        "steps8-plain",
        "falls",
        "all",
        "wide",
    )
    if (HERE / f"{a}.pt").exists()
]
r = rows()
scale = r.s.std(0)
X, A, N, K, G = [], [], [], [], []
for j, (name, p) in enumerate(policies("nine").items()):
    st = sim.full(qpos, qvel)
    going = np.arange(166)
    for k in range(60):
        o = sim.obs(st[going])
        a = act(p, o)
        st[going] = sim.step(st[going], a)
        n = sim.obs(st[going])
        X.append(o)
        A.append(a)
        N.append(n)
        K.append(np.full(len(o), k))
        going = going[healthy(n)]
        if not len(going):
            break
X, A, N = (torch.as_tensor(np.concatenate(v)).float() for v in (X, A, N))
K = np.concatenate(K)
h = r.held_rows[torch.randperm(len(r.held_rows))[:20000]]
with torch.no_grad():
    for arm in arms:
        m = ensemble(arm)
        e = (
            (
                ((m.next(X.expand(5, -1, -1), A.expand(5, -1, -1)).mean(0) - N) / scale)
                ** 2
            )
            .mean(-1)
            .sqrt()
            .numpy()
        )
        e0 = (
            (
                (
                    (
                        m.next(r.s[h].expand(5, -1, -1), r.a[h].expand(5, -1, -1)).mean(
                            0
                        )
                        - r.n[h]
                    )
                    / scale
                )
                ** 2
            )
            .mean(-1)
            .sqrt()
            .numpy()
        )
        print(
            arm,
            "held-out mean",
            e0.mean().round(3),
            "median",
            np.median(e0).round(3),
            "on the ways: steps 0-4, 5-19, 20-59 mean",
            *[
                e[(K >= a) & (K < b)].mean().round(3)
                for a, b in ((0, 5), (5, 20), (20, 60))
            ],
            flush=True,
        )
