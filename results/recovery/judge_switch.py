# ruff: noqa
"""Choice every ten steps: switch.py FILE GROUP HORIZON DELTA MIRROR [HOLD]   FILE: arm, simulator, critic:NAME, random"""

from judge import *  # noqa: F403
from judge_score import boot, obs_of

file, group, H, delta, mirror = (
    sys.argv[1],
    sys.argv[2],
    int(sys.argv[3]),
    float(sys.argv[4]),
    int(sys.argv[5]),
)
hold = int(sys.argv[6]) if len(sys.argv) > 6 else 10
early = int(sys.argv[7]) if len(sys.argv) > 7 else 0
known = dict(np.load(HERE / "truth.npz"))
names = [
    n
    for g in (["nine", "rim"] if group == "all" else [group])
    for n in GROUPS[g]
    if n in known
]
order = np.argsort([-(known[n][0][:166] == 300).mean() for n in names], kind="stable")
acts = [load_policy(RUNS / names[k]) for k in order]
sides = 2 if mirror else 1
cands = [(p, s) for s in range(sides) for p in range(len(acts))]
sim = Simulator()
states, index = chosen_states()
index = index[:166]
walk = states.walk[index]
qpos, qvel = states.qpos[index], states.qvel[index]
PM = np.array(POS_MIRROR)


def turned(state):
    s = state.copy()
    s[:, 1 : 1 + 9] = state[:, 1 + PM]
    s[:, 10:19] = state[:, 10 + PM]
    return s


model = (
    ensemble(file)
    if file not in ("simulator", "random", "clipped") and not file.startswith("critic")
    else None
)
net = None
if file.startswith("critic"):
    w = torch.load(HERE / f"{file}.pt")
    net = Critics(w["weights.0"].shape[0])
    net.load_state_dict(w)
rng = np.random.default_rng(0)


def score(state, c):
    p, s = cands[c]
    if file.startswith("unclip"):  # the velocities as they are known from positions
        state = state.copy()
        state[:, 10:19] = estimate[asked]
    st = turned(state) if s else state
    if file == "random":
        return rng.random(len(st))
    if file == "clipped":
        st = st.copy()
        st[:, 10:19] = st[:, 10:19].clip(-10, 10)
    if file in ("simulator", "clipped"):
        return sim.survival(st, acts[p], H).astype(float)
    o = torch.as_tensor(sim.obs(st)).float()
    if file.startswith("unclip"):
        o = torch.as_tensor(np.concatenate([st[:, 2:10], st[:, 10:19]], 1)).float()
    with torch.no_grad():
        if net is not None:
            k = order[p]
            ob = o
            h = (torch.cat([ob, acts[p](ob)], -1) - net.loc) / net.scale
            for q in range(2):
                h = silu(layer_norm(h @ net.weights[q][k] + net.biases[q][k], [128]))
            return 100 * (h @ net.weights[2][k] + net.biases[2][k]).sigmoid()[
                :, 0
            ].numpy().astype(float)
        return (
            imagine(model, acts[p], o, steps=H, keep=())[0]
            .mean(0)
            .numpy()
            .astype(float)
        )


state = sim.full(qpos, qvel)
going = np.arange(len(state))
present = np.zeros(len(state), int)
t = time.process_time()
changes = 0
estimate, asked = state[:, 10:19].clip(-10, 10), None
for step in range(300):
    if step % hold == 0 if not early else (step == 0 or step % hold == early):
        now = (
            np.full(len(going), -1.0)
            if step == 0 or file == "random"
            else np.zeros(len(going))
        )
        if step and file != "random":
            for c in np.unique(present[going]):
                r = np.flatnonzero(present[going] == c)
                asked = going[r]
                now[r] = score(state[asked], c)
        full = 100.0 if net is not None else float(H)
        ask = (
            np.flatnonzero(now + delta < full)
            if file != "random"
            else np.arange(len(going))
        )
        if len(ask):
            asked = going[ask]
            table = np.stack(
                [score(state[going[ask]], c) for c in range(len(cands))], 1
            )
            best = table.argmax(1)
            move = table.max(1) > now[ask] + (delta if step else -1)
            old = present[going[ask]].copy()
            present[going[ask[move]]] = best[move]
            changes += (present[going[ask]] != old).sum() if step else 0
    a = np.zeros((len(going), 6))
    for c in np.unique(present[going]):
        p, s = cands[c]
        r = np.flatnonzero(present[going] == c)
        o = sim.obs(turned(state[going[r]]) if s else state[going[r]])
        u = act(acts[p], o)
        a[r] = u[:, ACT_MIRROR] if s else u
    old = state[going].copy()
    state[going] = sim.step(state[going], a)
    new = state[going]
    seen = new[:, 10:19].clip(-10, 10)
    total = 2 * (new[:, 1:10] - old[:, 1:10]) / 0.008
    guess = np.where(abs(old[:, 10:19]) < 10, total - old[:, 10:19], total / 2)
    estimate[going] = np.where(
        abs(seen) < 10, seen, np.sign(seen) * (guess * np.sign(seen)).clip(10, 40)
    )
    going = going[healthy(sim.obs(state[going]))]
    if not len(going):
        break
saved = np.isin(np.arange(len(state)), going)
b = [saved[i].mean() for i in boot(walk)]
print(
    f"switch {file} {group} ({len(cands)} candidates) horizon {H} delta {delta} every {hold}, first again after {early or hold}: {100 * saved.mean():.1f} [{100 * np.quantile(b, 0.025):.0f}, {100 * np.quantile(b, 0.975):.0f}], changes a state {changes / len(state):.1f}, {time.process_time() - t:.0f} s",
    flush=True,
)
