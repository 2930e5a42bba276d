# ruff: noqa
"""Can a judge that is learned from a log tell falls from standing?

python judge.py truth              # the simulator, once
python judge.py train ARM          # a dynamics ensemble, see ARMS
python judge.py critic FILE GROUP  # survival critics; FILE: of an ensemble, or "none"
"""

import json
import math
import sys
import time
from functools import cache
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco import rollout
from torch import nn
from torch.nn.functional import huber_loss, layer_norm, silu, softplus

from torchrl_osr.lab.data import load_dataset
from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states
from torchrl_osr.policy import load_policy

torch.set_num_threads(1)
HERE, RUNS = Path("judge"), Path("outputs")
SKIP, HORIZON, NETWORKS = 4, 100, 5
OBS_MIRROR = [0, 1, 5, 6, 7, 2, 3, 4, 8, 9, 10, 14, 15, 16, 11, 12, 13]
ACT_MIRROR = [3, 4, 5, 0, 1, 2]
POS_MIRROR = [0, 1, 2, 6, 7, 8, 3, 4, 5]
GROUPS = {
    "nine": [
        *(f"six/walker2d-medium-expert/{m}/seed0" for m in ("td3_bc", "iql")),
        *(f"osrv/walker2d-medium-expert/osr_v/seed{s}" for s in range(3)),
        *(
            f"six/walker2d-medium-replay/{m}/seed0"
            for m in ("osr", "cql", "td3_bc", "iql")
        ),
    ],
    "rim": [f"rim/walker2d/ensemble-{s}" for s in range(5)],
}


def policies(group):
    """Load the policies of a group, by name."""
    return {
        name: load_policy(RUNS / name)
        for name in GROUPS[group]
        if finished(RUNS / name)
    }


def finished(run):
    status = run / "status.json"
    return (
        not status.exists()
        or '"finished"' in status.read_text()
        or '"done"' in status.read_text()
    )


# ---------------------------------------------------------------- simulator


class Simulator:
    """Walker2d-v5, many states at once."""

    def __init__(self):
        self.env = gymnasium.make("Walker2d-v5").unwrapped
        self.model, self.data = self.env.model, mujoco.MjData(self.env.model)
        self.nq, self.nv = self.model.nq, self.model.nv

    def full(self, qpos, qvel):
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.zeros((len(qpos), size))
        state[:, 1 : 1 + self.nq], state[:, 1 + self.nq : 1 + self.nq + self.nv] = (
            qpos,
            qvel,
        )
        return state

    def obs(self, state):
        velocity = state[..., 1 + self.nq : 1 + self.nq + self.nv]
        return np.concatenate([state[..., 2 : 1 + self.nq], velocity.clip(-10, 10)], -1)

    def step(self, state, action):
        control = np.repeat(action[:, None], SKIP, 1).astype(np.float64)
        states, _ = rollout.rollout(self.model, self.data, state, control)
        return states[:, -1]

    def survival(self, state, policy, steps):
        """Return the steps until a fall, of one policy from each state."""
        state, lived = state.copy(), np.zeros(len(state), int)
        going = np.arange(len(state))
        for _ in range(steps):
            state[going] = self.step(state[going], act(policy, self.obs(state[going])))
            lived[going] += 1
            going = going[healthy(self.obs(state[going]))]
            if not len(going):
                break
        return lived


def healthy(obs):
    return (obs[..., 0] > 0.8) & (obs[..., 0] < 2) & (abs(obs[..., 1]) < 1)


def act(policy, obs):
    return policy(torch.as_tensor(obs).float()).numpy()


def chosen_states():
    """All recoverable states of the public half, 80 easy and 80 contested ones."""
    states, draw = (
        load_recoverable_states("walker2d", "public"),
        np.random.default_rng(0),
    )
    index = np.flatnonzero(states.group == "recoverable")
    for group in ("easy", "contested"):
        index = np.append(
            index, draw.choice(np.flatnonzero(states.group == group), 80, replace=False)
        )
    return states, index


def truth():
    states, index = chosen_states()
    sim = Simulator()
    qpos, qvel = states.qpos[index], states.qvel[index]
    mirrored = sim.full(qpos[:, POS_MIRROR], qvel[:, POS_MIRROR])
    plain = sim.full(qpos, qvel)
    rng = np.random.default_rng(1)  # is it a symmetry?
    one, two, worst = plain.copy(), mirrored.copy(), 0.0
    for _ in range(20):
        a = rng.uniform(-1, 1, (len(index), 6))
        one, two = sim.step(one, a), sim.step(two, a[:, ACT_MIRROR])
        worst = max(worst, abs(sim.obs(one)[:, OBS_MIRROR] - sim.obs(two)).max())
    print(
        "largest difference to the mirrored simulation after 20 random actions", worst
    )
    out = HERE / "truth.npz"
    known = dict(np.load(out)) if out.exists() else {}
    for group in GROUPS:
        for name, policy in policies(group).items():
            if name not in known:
                known[name] = np.stack(
                    [sim.survival(s, policy, 300) for s in (plain, mirrored)]
                )
                print(
                    name,
                    "stands %",
                    (known[name][:, :166] == 300).mean(1).round(3),
                    flush=True,
                )
                np.savez(out, **known)


# ---------------------------------------------------------------- rows


class Rows:
    """Rows of data sets in order of time, some episodes held out."""

    def __init__(self, names, unclip=False):
        parts, offset = [], 0
        for name in names:
            data, _ = load_dataset("walker2d", name, num_transitions=200_000)
            episode = episode_of(data) + offset
            offset = int(episode.max()) + 1
            keys = (
                "observation",
                "action",
                ("next", "observation"),
                ("next", "terminated"),
            )
            parts.append([*(data[k].float() for k in keys), episode])
        self.s, self.a, self.n, self.ended, self.episode = (
            torch.cat(p) for p in zip(*parts, strict=True)
        )
        held = np.random.default_rng(0).permutation(offset)[: offset // 20]
        if unclip:
            self.unclip()
        self.held = torch.isin(self.episode, torch.as_tensor(held))
        self.train_rows, self.held_rows = (
            (~self.held).nonzero()[:, 0],
            self.held.nonzero()[:, 0],
        )

    def unclip(self, dt=0.008):
        """Estimate velocities beyond the clip at 10 from the positions around them."""
        s, n, v = self.s, self.n, self.s[:, 9:].clone()
        follows = (self.episode[1:] == self.episode[:-1])[:, None] & (
            n[:-1] == s[1:]
        ).all(1, True)
        total = 2 * (n[:, :8] - s[:, :8]) / dt  # of this velocity and the next
        before = torch.cat([total[:1], total[:-1]])
        known = torch.cat([torch.zeros(1, 1, dtype=torch.bool), follows])
        last = torch.cat([v[:1], v[:-1]])
        middle = torch.where(known, (before + total) / 4, total / 2)
        backward = torch.where(known & (last.abs() < 9.999), before - last, middle)
        best = torch.where(n[:, 9:].abs() < 9.999, total - n[:, 9:], backward)

        def beyond(old, new):
            return torch.where(
                old.abs() < 9.999, old, old.sign() * (new * old.sign()).clamp(10, 40)
            )

        s[:, 9:] = beyond(v, best)
        after = torch.cat([s[1:, 9:], s[:1, 9:]])
        goes = torch.cat([follows, torch.zeros(1, 1, dtype=torch.bool)])
        n[:, 9:] = torch.where(goes, after, beyond(n[:, 9:], total - s[:, 9:]))

    def starts(self, length, held):
        """First rows of windows inside one episode."""
        same = self.episode[: -length + 1] == self.episode[length - 1 :]
        return (same & (self.held if held else ~self.held)[: -length + 1]).nonzero()[
            :, 0
        ]


@cache
def rows(which="both"):
    names = (
        ["medium-replay"] if which == "replay" else ["medium-expert", "medium-replay"]
    )
    return Rows(names, which == "unclip")


# ---------------------------------------------------------------- dynamics


class Ensemble(nn.Module):
    """Gaussian changes of the state; with layer normalisation if ``norm``."""

    def __init__(self, norm=False, width=128, number=NETWORKS):
        super().__init__()
        sizes = [23, width, width, width, 34]
        self.norm, self.number = norm, number
        self.weights, self.biases, self.gains, self.shifts = (
            nn.ParameterList() for _ in range(4)
        )
        for i, o in zip(sizes, sizes[1:], strict=False):
            weight, std = torch.empty(number, i, o), 1 / (2 * i**0.5)
            self.weights.append(
                nn.init.trunc_normal_(weight, std=std, a=-2 * std, b=2 * std)
            )
            self.biases.append(torch.zeros(number, 1, o))
            if norm and o == width:
                self.gains.append(torch.ones(number, 1, o))
                self.shifts.append(torch.zeros(number, 1, o))
        self.lowest, self.highest = (
            nn.Parameter(torch.full([17], v)) for v in (-10.0, 0.5)
        )
        for name, size in (
            ("in_loc", 23),
            ("in_scale", 23),
            ("out_loc", 17),
            ("out_scale", 17),
        ):
            self.register_buffer(name, torch.ones(size))

    def standardize(self, r):
        x = torch.cat([r.s, r.a], -1)[r.train_rows].double()
        y = (r.n - r.s)[r.train_rows].double()
        for name, value in (("in", x), ("out", y)):
            getattr(self, name + "_loc").copy_(value.mean(0))
            getattr(self, name + "_scale").copy_(value.std(0))

    def forward(self, s, a):
        """Return mean and log-variance ``[E, B, 17]`` of standardised changes."""
        h = (torch.cat([s, a], -1) - self.in_loc) / self.in_scale
        for k in range(3):
            h = torch.baddbmm(self.biases[k], h, self.weights[k])
            if self.norm:
                h = layer_norm(h, h.shape[-1:]) * self.gains[k] + self.shifts[k]
            h = silu(h)
        mean, free = torch.baddbmm(self.biases[3], h, self.weights[3]).chunk(2, -1)
        below = self.highest - softplus(self.highest - free)
        return mean, self.lowest + softplus(below - self.lowest)

    def next(self, s, a):
        return s + self(s, a)[0] * self.out_scale + self.out_loc


@torch.no_grad()
def held_out_error(model, r, steps=20, number=600):
    """Return the median error over held-out windows after each step, in deviations."""
    scale = r.s.std(0)
    start = r.starts(steps, True)
    start = start[
        torch.randperm(len(start), generator=torch.Generator().manual_seed(0))[:number]
    ]
    s, found = r.s[start].expand(model.number, -1, -1), []
    for k in range(steps):
        s = model.next(s, r.a[start + k].expand(model.number, -1, -1))
        found.append((((s.mean(0) - r.n[start + k]) / scale) ** 2).mean(-1).sqrt())
    return torch.stack(found).nan_to_num(9)


ARMS = {
    "plain-replay": dict(which="replay"),
    "plain": dict(),
    "long": dict(seconds=360),
    "norm": dict(norm=True),
    "mirror": dict(mirror=True),
    "steps8": dict(norm=True, seconds=360, first="norm", unroll=8),
    "steps8-plain": dict(seconds=120, first="plain", unroll=8),
    "all": dict(norm=True, mirror=True, seconds=360, unroll=8, first="norm"),
    "falls": dict(falls=True, norm=True),
    "unclip": dict(norm=True, which="unclip"),
    "unclip8": dict(norm=True, which="unclip", seconds=240, first="unclip", unroll=8),
    "wide": dict(norm=True, width=256, seconds=180),
    "wide8": dict(norm=True, width=256, seconds=300, first="wide", unroll=8),
}


def train(arm):
    o = (
        dict(
            norm=False,
            mirror=False,
            unroll=1,
            seconds=None,
            first=None,
            which="both",
            falls=False,
            width=128,
        )
        | ARMS[arm]
    )
    torch.manual_seed(0)
    r, model = rows(o["which"]), Ensemble(o["norm"], o["width"])
    model.standardize(r)
    if o["first"]:
        model.load_state_dict(torch.load(HERE / f"{o['first']}.pt"))
    lr = 3e-4 if o["first"] else 1e-3
    optimizer = torch.optim.Adam(
        model.parameters(),
        lr=lr,
        weight_decay=3e-5 if not o["first"] else 0,
        fused=True,
    )
    scale, unroll = r.s.std(0), o["unroll"]
    size = 64 if unroll > 1 else 128
    index = r.starts(unroll, False) if unroll > 1 else r.train_rows
    if o["falls"]:  # half of the rows within 50 steps of a fall
        end = r.ended.squeeze(-1).nonzero()[:, 0]
        near = torch.zeros(len(r.s), dtype=torch.bool)
        for e in end:
            near[max(0, e - 49) : e + 1] |= (
                r.episode[max(0, e - 49) : e + 1] == r.episode[e]
            )
        near = (near & ~r.held).nonzero()[:, 0]
        print("rows near falls", len(near), "falls", len(end))
    best, kept, t, step = math.inf, None, time.process_time(), 0
    while True:
        used = time.process_time() - t
        done = used / o["seconds"] if o["seconds"] else step / 10_000
        if step % 1000 == 0 or done >= 1:
            e = held_out_error(model, r)
            score = float(e[7].median()) if unroll > 1 else float(e[0].mean())
            print(
                arm,
                step,
                round(used),
                "s; error after 1, 8, 20",
                *(round(float(e[k].median()), 4) for k in (0, 7, 19)),
                "mean",
                *(round(float(e[k].mean()), 3) for k in (0, 7, 19)),
                flush=True,
            )
            if (o["seconds"] and score < best) or not o["seconds"]:
                best, kept = (
                    score,
                    {k: v.clone() for k, v in model.state_dict().items()},
                )
        if done >= 1:
            break
        if o["seconds"]:
            optimizer.param_groups[0]["lr"] = lr * max(
                0.02, (1 - done) if o["first"] else min(1, 1.5 - 1.5 * done)
            )
        drawn = index[torch.randint(len(index), [NETWORKS, size])]
        if o["falls"]:
            drawn[:, : size // 2] = near[
                torch.randint(len(near), [NETWORKS, size // 2])
            ]
        s, loss = r.s[drawn], 0.0
        flip = torch.rand(NETWORKS, size, 1) < 0.5 if o["mirror"] else None

        def turn(x, order, flip=flip):
            return x if flip is None else torch.where(flip, x[..., order], x)

        s = turn(s, OBS_MIRROR)
        for h in range(unroll):
            a, n = turn(r.a[drawn + h], ACT_MIRROR), turn(r.n[drawn + h], OBS_MIRROR)
            mean, log_variance = model(s, a)
            if unroll == 1:
                error = (mean - (n - s - model.out_loc) / model.out_scale).square()
                loss = NETWORKS * (error * (-log_variance).exp() + log_variance).mean()
                loss = loss + 0.01 * (model.highest - model.lowest).sum()
            else:
                s = s + mean * model.out_scale + model.out_loc
                loss = loss + NETWORKS * 0.9 ** (h + 1) * huber_loss(
                    s / scale, n / scale
                )
        optimizer.zero_grad()
        loss.backward()
        if unroll > 1:
            nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        step += 1
    torch.save(kept, HERE / f"{arm}.pt")


def ensemble(arm):
    state = torch.load(HERE / f"{arm}.pt")
    model = Ensemble(any("gains" in k for k in state), state["weights.0"].shape[-1])
    model.load_state_dict(state)
    model.most = 40.0 if arm.startswith("unclip") else 10.0
    return model.requires_grad_(False)


@torch.no_grad()
def imagine(model, policy, obs, steps=HORIZON, keep=(20,), spread=None):
    """Roll a policy out in each network from ``[B, 17]``.

    Returns steps until the fall ``[E, B]``, disagreement ``[steps, B]`` and the states
    after ``keep`` steps.
    """
    s = torch.as_tensor(obs).float().expand(model.number, -1, -1)
    going, lived = torch.ones(s.shape[:2]), torch.zeros(s.shape[:2])
    apart, states = [], []
    for h in range(1, steps + 1):
        seen = torch.cat([s[..., :8], s[..., 8:].clamp(-10, 10)], -1)
        a = policy(seen.flatten(0, 1)).view(*s.shape[:2], 6)
        following = model.next(s, a)
        if spread is not None:
            following = (
                following
                + torch.randn_like(s) * (spread(s, a)[1] / 2).exp() * spread.out_scale
            )
        s = following.nan_to_num(0)
        s = torch.cat([s[..., :8], s[..., 8:].clamp(-model.most, model.most)], -1)
        lived += going
        going = going * healthy(s)
        apart.append((s.std(0) / model.in_scale[:17]).square().mean(-1).sqrt())
        if h in keep:
            states.append(torch.cat([s, going[..., None]], -1))
    return lived, torch.stack(apart), states


# ---------------------------------------------------------------- survival critics


class Critics(nn.Module):
    """Probability of no fall, one network for each policy, ``[P, B]``."""

    def __init__(self, number, width=128):
        super().__init__()
        sizes = [23, width, width, 1]
        self.weights = nn.ParameterList(
            torch.empty(number, i, o).uniform_(-1, 1) / i**0.5
            for i, o in zip(sizes, sizes[1:], strict=False)
        )
        self.biases = nn.ParameterList(torch.zeros(number, 1, o) for o in sizes[1:])
        self.register_buffer("loc", torch.zeros(23))
        self.register_buffer("scale", torch.ones(23))

    def forward(self, s, a):
        h = (torch.cat([s, a], -1) - self.loc) / self.scale
        for k in range(2):
            h = torch.baddbmm(self.biases[k], h, self.weights[k])
            h = silu(layer_norm(h, h.shape[-1:]))
        return torch.baddbmm(self.biases[2], h, self.weights[2]).squeeze(-1)  # log-odds


def critic(arm, group, seconds=150, gamma=0.99, size=256):
    """Fitted evaluation of survival, ``y = (1 - fall) (1 - gamma + gamma V(s', pi(s')))``."""
    torch.manual_seed(0)
    r, chosen = rows(), policies(group)
    number, t = len(chosen), time.process_time()
    s, a, n, ended = r.s, r.a, r.n, r.ended.squeeze(-1)
    if (
        arm != "none"
    ):  # rows of each policy in the model, from rows and after random torques
        model, parts = ensemble(arm), []
        for policy in chosen.values():
            x = r.s[r.train_rows[torch.randint(len(r.train_rows), [4000])]]
            kept = [[], [], [], []]
            net = torch.randint(NETWORKS, [len(x)])
            for h in range(30):
                with torch.no_grad():
                    u = policy(x)
                    if h < 10:  # half of the starts are disturbed for up to ten steps
                        wild = torch.arange(len(x)) % 20 > 10 + h
                        u = torch.where(wild[:, None], 2 * torch.rand_like(u) - 1, u)
                    y = model.next(
                        x.expand(NETWORKS, -1, -1), u.expand(NETWORKS, -1, -1)
                    )[net, torch.arange(len(x))]
                y = torch.cat([y[:, :8], y[:, 8:].clamp(-10, 10)], -1).nan_to_num(0)
                fell = ~healthy(y)
                for store, value in zip(kept, (x, u, y, fell.float()), strict=True):
                    store.append(value)
                x, net = y[~fell], net[~fell]
            parts.append([torch.cat(k) for k in kept])
        print(
            "imagined rows",
            [len(p[0]) for p in parts],
            "falls",
            [round(float(p[3].mean()), 4) for p in parts],
            round(time.process_time() - t),
            "s",
            flush=True,
        )
    net, target = Critics(number), Critics(number)
    x = torch.cat([s, a], -1)[r.train_rows]
    net.loc.copy_(x.mean(0)), net.scale.copy_(x.std(0))
    target.load_state_dict(net.state_dict())
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-4, fused=True)
    falls = (ended.bool() & ~r.held).nonzero()[:, 0]
    following = torch.stack(
        [
            torch.cat([policy(n[i : i + 20_000]) for i in range(0, len(n), 20_000)])
            for policy in chosen.values()
        ]
    )
    print("actions", round(time.process_time() - t), "s; falls", len(falls), flush=True)
    if arm != "none":
        ahead = [
            torch.cat(
                [policy(p[2][i : i + 20_000]) for i in range(0, len(p[2]), 20_000)]
            )
            for p, policy in zip(parts, chosen.values(), strict=True)
        ]
    real = size if arm == "none" else size // 2
    step, which = 0, torch.arange(number)[:, None]
    while time.process_time() - t < seconds:
        for group_ in optimizer.param_groups:
            group_["lr"] = 5e-4 * max(0.05, 1 - (time.process_time() - t) / seconds)
        i = r.train_rows[torch.randint(len(r.train_rows), [number, real])]
        batch = [s[i], a[i], n[i], ended[i], following[which, i]]
        if arm != "none":
            drawn = [torch.randint(len(p[0]), [size - real]) for p in parts]
            extra = [
                torch.stack([p[k][j] for p, j in zip(parts, drawn, strict=True)])
                for k in range(4)
            ]
            extra.append(torch.stack([u[j] for u, j in zip(ahead, drawn, strict=True)]))
            batch = [torch.cat(pair, 1) for pair in zip(batch, extra, strict=True)]
        bs, ba, bn, bf, bu = batch
        with torch.no_grad():
            wanted = (1 - bf) * (1 - gamma + gamma * target(bn, bu).sigmoid())
        loss = number * nn.functional.binary_cross_entropy_with_logits(
            net(bs, ba), wanted
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            for p, q in zip(target.parameters(), net.parameters(), strict=True):
                p.lerp_(q, 0.05)
        step += 1
        if step % 1000 == 0:
            print(
                step,
                round(time.process_time() - t),
                "s",
                float(loss) / number,
                "mean value",
                [round(v, 2) for v in wanted.mean(1).tolist()],
                flush=True,
            )
    torch.save(net.state_dict(), HERE / f"critic-{arm}-{group}.pt")


if __name__ == "__main__":
    command, *rest = sys.argv[1:]
    {"truth": truth, "train": train, "critic": critic}[command](*rest)
