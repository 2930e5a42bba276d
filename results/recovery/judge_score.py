# ruff: noqa
"""Tables of every judge; imagined roll-outs are cached."""

import sys
import numpy as np, torch
from judge import *  # noqa: F403


def obs_of(clip=10):
    states, index = chosen_states()
    qpos, qvel = states.qpos[index], states.qvel[index]
    make = lambda p, v: np.concatenate([p[:, 1:], v.clip(-clip, clip)], 1).astype(
        np.float32
    )
    return (
        make(qpos, qvel),
        make(qpos[:, POS_MIRROR], qvel[:, POS_MIRROR]),
        states.walk[index],
        states.group[index],
    )


@torch.no_grad()
def rolled(arm, name, side=0):
    """fall step [E, S], disagreement [200, S], state at 20 and 40 [2, E, S, 18]"""
    file = HERE / "cache" / f"{arm}+{name.replace('/', '_')}+{side}.npz"
    file.parent.mkdir(exist_ok=True)
    if not file.exists():
        model, policy = ensemble(arm.strip("~^")), load_policy(RUNS / name)
        g = imagine(
            model,
            policy,
            obs_of(40 if arm.endswith("^") else 10)[side],
            steps=200,
            keep=(20, 40),
            spread=ensemble("norm") if arm.endswith("~") else None,
        )
        np.savez_compressed(
            file,
            lived=g[0].numpy().astype(np.uint8),
            apart=g[1].numpy().astype(np.float32),
            at=np.stack([k.numpy() for k in g[2]]),
        )
    return dict(np.load(file))


def ranks_auc(score, true):
    a, b = score[true], score[~true]
    if not len(a) or not len(b):
        return np.nan
    b = np.sort(b)
    return (
        (np.searchsorted(b, a, "left") + np.searchsorted(b, a, "right")) / 2 / len(b)
    ).mean()


def within(score, true):
    got = [ranks_auc(s, t) for s, t in zip(score, true)]
    return np.nanmean(got)


def chosen(score, true):
    order = np.argsort(-true.mean(0), kind="stable")
    c = order[np.argmax(score[:, order], 1)]
    return true[np.arange(len(true)), c], c


def boot(walk, number=500):
    draw, names = np.random.default_rng(0), np.unique(walk)
    of = {w: np.flatnonzero(walk == w) for w in names}
    return [
        np.concatenate([of[w] for w in draw.choice(names, len(names))])
        for _ in range(number)
    ]


def judges(arm, names, side=0):
    """scores [S, P] of all ways to use an arm"""
    got = [rolled(arm, n, side) for n in names]
    lived = np.stack([g["lived"] for g in got], -1).astype(float)  # E S P
    apart = np.stack([g["apart"] for g in got], -1)  # 200 S P
    out = {f"{arm} {h}": np.minimum(lived, h).mean(0) for h in (20, 40, 60, 100, 200)}
    out[f"{arm} stands at 100"] = (lived >= 100).mean(0)
    alive = np.stack([(lived > h).mean(0) for h in range(100)])
    d0 = np.median(apart[19])
    w = np.exp(-apart[:100] / d0)
    out[f"{arm} soft"] = (w * alive).sum(0) / w.sum(0)
    w = np.exp(-apart[:100].mean((1, 2)) / d0)[:, None, None]
    out[f"{arm} soft, same for all"] = (w * alive).sum(0) / w.sum(0)
    out[f"{arm} 100, calm"] = np.minimum(lived, 100).mean(0) - 20 * np.log(
        apart[:40].mean(0)
    )
    for h in (20, 40, 100):
        out[f"{arm} agreement {h}"] = -apart[:h].mean(0)
    return out, lived


def critic_scores(file, group, names, side, at=None):
    state = torch.load(HERE / file)
    net = Critics(state["weights.0"].shape[0])
    net.load_state_dict(state)
    acts = [load_policy(RUNS / n) for n in names]
    with torch.no_grad():
        if at is None:
            s = torch.as_tensor(obs_of()[side]).expand(len(names), -1, -1)
            return (
                net(s, torch.stack([p(x) for p, x in zip(acts, s)]))
                .sigmoid()
                .numpy()
                .T.astype(float)
            )
        s = torch.as_tensor(at[..., :17]).clone()
        s[..., 8:].clamp_(-10, 10)
        flat = s.flatten(1, 2)
        v = (
            net(flat, torch.stack([p(x) for p, x in zip(acts, flat)]))
            .sigmoid()
            .view(s.shape[:3])
        )
        return (v * torch.as_tensor(at[..., 17])).mean(1).numpy().T.astype(float)


ARMS_ = [
    a
    for a in [
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
        "wide8",
        "norm~",
        "steps8~",
        "unclip",
        "unclip^",
        "unclip8",
        "unclip8^",
    ]
    if (HERE / f"{a.strip(chr(126) + chr(94))}.pt").exists()
]


def table(group):
    known = dict(np.load(HERE / "truth.npz"))
    names = [
        n
        for g in (["nine", "rim"] if group == "all" else [group])
        for n in GROUPS[g]
        if n in known
    ]
    _, _, walk, kind = obs_of()
    hard = kind == "recoverable"
    steps = np.stack([known[n][0] for n in names], 1)
    other = np.stack([known[n][1] for n in names], 1)
    T, M = steps == 300, other == 300
    true = T[hard]
    samples = boot(walk[hard])
    print(
        f"\n== {group}: {len(names)} policies; stands % {(100 * true.mean(0)).round(1)} best {100 * true.mean(0).max():.1f} union {100 * true.any(1).mean():.1f} with mirrors {100 * (true | M[hard]).any(1).mean():.1f}; true steps 100: {(steps[hard] >= 100).mean():.3f}, 300: {true.mean():.3f}; all states {T.mean():.3f}"
    )
    b = [s_ for s_ in [true[i].mean(0).max() for i in samples]]
    fell = steps[hard][~true]
    print(
        "steps until fall, quantiles", np.quantile(fell, [0.05, 0.25, 0.5, 0.75, 0.95])
    )
    print(
        "with mirrors: mean agreement of a policy and its mirror",
        (T[hard] == M[hard]).mean().round(3),
    )
    print(
        "a choice by the simulator for 20, 40, 60, 100, 300 steps:",
        [
            round(
                100 * chosen(np.minimum(steps[hard], h).astype(float), true)[0].mean(),
                1,
            )
            for h in (20, 40, 60, 100, 300)
        ],
        "AUC",
        [
            round(ranks_auc(np.minimum(steps[hard], h).ravel(), true.ravel()), 3)
            for h in (20, 40, 60, 100)
        ],
    )
    prior = np.broadcast_to(true.mean(0), true.shape)
    print(f"policy's average alone: AUC {ranks_auc(prior.ravel(), true.ravel()):.3f}")
    every, stand = {}, {}
    for arm in ARMS_:
        sc, lived = judges(arm, names)
        every |= {k: v[hard] for k, v in sc.items()}
        stand[arm] = (lived >= 100).mean(), (lived[:, hard] >= 100).mean()
        for g in [group] if group != "all" else []:
            for c in sorted(HERE.glob(f"critic-*-{g}.pt")):
                for k, h in enumerate((20, 40)):
                    at = np.stack([rolled(arm, n)["at"][k] for n in names])
                    every[f"{arm} {h} + {c.stem}"] = critic_scores(
                        c.name, g, names, 0, at
                    )[hard]
    if group != "all":
        for c in sorted(HERE.glob(f"critic-*-{group}.pt")):
            every[c.stem] = critic_scores(c.name, group, names, 0)[hard]
    base = every.get("plain 100")
    for k, v in every.items():
        got, who = chosen(v, true)
        a = ranks_auc(v.ravel(), true.ravel())
        bs = [ranks_auc(v[i].ravel(), true[i].ravel()) for i in samples]
        gain = (
            np.array(bs)
            - [ranks_auc(base[i].ravel(), true[i].ravel()) for i in samples]
            if base is not None
            else np.zeros(1)
        )
        sv = [got[i].mean() for i in samples]
        q = lambda x, m=1: (
            "[%.*f, %.*f]"
            % (
                2 if m == 1 else 0,
                m * np.quantile(x, 0.025),
                2 if m == 1 else 0,
                m * np.quantile(x, 0.975),
            )
        )
        print(
            f"{k:34s} AUC {a:.3f} {q(bs)} gain {a - (ranks_auc(base.ravel(), true.ravel()) if base is not None else 0):+.3f} {q(gain)} within {within(v, true):.3f} saved {100 * got.mean():.1f} {q(sv, 100)}"
        )
    print(
        "belief stands 100 (all states, recoverable):",
        {k: tuple(round(float(x), 3) for x in v) for k, v in stand.items()},
        "true",
        (steps >= 100).mean().round(3),
        (steps[hard] >= 100).mean().round(3),
    )
    # all states
    print(
        "AUC, all 326 states:",
        {
            a: round(
                ranks_auc(judges(a, names, 0)[0][f"{a} 100"].ravel(), T.ravel()), 3
            )
            for a in ARMS_
        },
    )


def doubled(arms):
    """The choice among the nine and their mirrors."""
    known = dict(np.load(HERE / "truth.npz"))
    names = GROUPS["nine"]
    _, _, walk, kind = obs_of()
    hard = kind == "recoverable"
    steps = np.concatenate(
        [np.stack([known[n][k] for n in names], 1) for k in (0, 1)], 1
    )[hard]
    true = steps == 300
    samples = boot(walk[hard])
    print(
        f"\n== nine and mirrors: best {100 * true.mean(0).max():.1f} union {100 * true.any(1).mean():.1f}; the simulator with 20, 40, 60, 100, 200, 300 steps",
        [
            round(100 * chosen(np.minimum(steps, h).astype(float), true)[0].mean(), 1)
            for h in (20, 40, 60, 100, 200, 300)
        ],
    )
    for arm in arms:
        sides = [judges(arm, names, k)[0] for k in (0, 1)]
        every = {
            k: np.concatenate([x[k] for x in sides], 1)[hard]
            for k in sides[0]
            if k.split()[-1] in ("100", "200", "40") and "calm" not in k
        }
        for c in sorted(HERE.glob("critic-*-nine.pt")):
            every[f"{arm} 40 + {c.stem}"] = np.concatenate(
                [
                    critic_scores(
                        c.name,
                        "nine",
                        names,
                        k,
                        np.stack([rolled(arm, n, k)["at"][1] for n in names]),
                    )
                    for k in (0, 1)
                ],
                1,
            )[hard]
        for k, v in every.items():
            got, _ = chosen(v, true)
            sv = [got[i].mean() for i in samples]
            print(
                f"{k:34s} AUC {ranks_auc(v.ravel(), true.ravel()):.3f} within {within(v, true):.3f} saved {100 * got.mean():.1f} [{100 * np.quantile(sv, 0.025):.0f}, {100 * np.quantile(sv, 0.975):.0f}]"
            )


if __name__ == "__main__":
    for g in sys.argv[1:] or ("nine", "rim", "all"):
        if g == "doubled":
            doubled(
                [
                    a
                    for a in ("plain", "norm", "steps8", "unclip8", "unclip8^")
                    if a in ARMS_
                ]
            )
            continue
        if g == "nine" or any(n in np.load(HERE / "truth.npz") for n in GROUPS["rim"]):
            table(g)
