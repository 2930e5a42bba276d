# ruff: noqa
from judge_score import *

known = dict(np.load(HERE / "truth.npz"))
names = GROUPS["nine"]
states, index = chosen_states()
q = states.qvel[index][:166]
clear = (abs(q) <= 10).all(1)
kinds = states.kind[index][:166]
true = np.stack([known[n][0][:166] for n in names], 1) == 300
print(
    "recoverable states without a clipped velocity",
    clear.sum(),
    "kinds",
    {
        k: (int((kinds == k).sum()), int((clear & (kinds == k)).sum()))
        for k in np.unique(kinds)
    },
)
for m, w in (("clear", clear), ("clipped", ~clear)):
    print(
        m, "truth %", true[w].mean().round(3), "union", true[w].any(1).mean().round(3)
    )
    for arm in ARMS_:
        sc, lived = judges(arm, names)
        for h in ("40", "100", "200"):
            v = sc[f"{arm} {h}"][:166][w]
            print(
                "  ",
                arm,
                h,
                "AUC %.3f within %.3f saved %.1f; belief %.2f"
                % (
                    ranks_auc(v.ravel(), true[w].ravel()),
                    within(v, true[w]),
                    100 * chosen(v, true[w])[0].mean(),
                    (lived[:, :166][:, w] >= 100).mean(),
                ),
            )
