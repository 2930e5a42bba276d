"""Train behaviour policies for a Gymnasium MuJoCo task with soft actor-critic.

Writes a medium actor, an expert actor, eight snapshots from the start of training to
the medium actor, and a card of their returns.
``torchrl_osr.lab.data.load_behavior_policy(name, policy, folder=...)`` reads them::

    python examples/train_behavior.py --env Hopper-v5 --steps 300000 --out policies

Ctrl-C ends the training early and keeps what has been learned.
"""

from __future__ import annotations

import argparse
from contextlib import closing, suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import DoubleToFloat, EnvBase, GymWrapper, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from tqdm.auto import tqdm

from torchrl_osr._files import whole_file, write_json
from torchrl_osr.lab.data import (
    collect_transitions,
    make_environment,
    reference_returns,
)
from torchrl_osr.lab.data.behavior import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    BehaviorPolicy,
    load_behavior_card,
)

WIDTH = 256
FRAMES = 32  # environment steps between equally many gradient steps


class Snapshot(NamedTuple):
    """The actor after ``step`` environment steps."""

    step: int
    actor: BehaviorPolicy
    mean_return: float


class Actor(nn.Module):
    """Two hidden layers and two heads, named as the arrays of the policy file."""

    def __init__(self, observation_size: int, action_size: int) -> None:
        super().__init__()
        self.hidden0 = nn.Linear(observation_size, WIDTH)
        self.hidden1 = nn.Linear(WIDTH, WIDTH)
        self.mean = nn.Linear(WIDTH, action_size)
        self.log_std = nn.Linear(WIDTH, action_size)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations ``[B, S]`` to loc and scale ``[B, A]`` before the tanh."""
        features = self.hidden1(self.hidden0(observation).relu()).relu()
        log_std = self.log_std(features).clamp(LOG_STD_MIN, LOG_STD_MAX)
        return self.mean(features), log_std.exp()

    def as_arrays(self) -> BehaviorPolicy:
        """Return a copy that needs NumPy only."""
        named = self.named_parameters()
        return BehaviorPolicy({name: p.detach().numpy().copy() for name, p in named})


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    formatter = argparse.ArgumentDefaultsHelpFormatter
    parser = argparse.ArgumentParser(formatter_class=formatter)
    add = parser.add_argument
    add("--env", default="Hopper-v5", help="Gymnasium MuJoCo task id")
    add("--name", help="name in the card; None: the id without its version")
    add("--out", type=Path, default=Path("behavior_policies"), help="output folder")
    add("--steps", type=int, default=300_000, help="environment steps")
    add("--random-steps", type=int, default=4_992, help="uniform steps at the start")
    add("--eval-every", type=int, default=10_000, help="steps between snapshots")
    add("--eval-steps", type=int, default=5_000, help="steps of one evaluation")
    add("--card-steps", type=int, default=20_000, help="steps behind a card entry")
    add("--medium-share", type=float, default=0.4, help="medium return / best return")
    add("--batch-size", type=int, default=128, help="rows per gradient step")
    add("--seed", type=int, default=0, help="seed of everything")
    add("--threads", type=int, default=1, help="torch threads; small nets like one")
    args = parser.parse_args(arguments)
    args.name = args.name or args.env.split("-v")[0].lower()
    return args


def make_agent(env: EnvBase) -> tuple[Actor, ProbabilisticActor, SACLoss]:
    """Return the actor network, the policy around it and the loss."""
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    network = Actor(*sizes)
    policy = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        spec=env.action_spec,
    )
    critic = MLP(sum(sizes), 1, num_cells=[WIDTH, WIDTH], activation_class=nn.ReLU)
    qvalue = ValueOperator(critic, ["observation", "action"])
    loss = SACLoss(policy, qvalue, loss_function="l2")
    loss.make_value_estimator(gamma=0.99)
    return network, policy, loss


def train(args: argparse.Namespace, eval_env: Any) -> list[Snapshot]:
    """Run soft actor-critic; return the actor at each evaluation."""
    env = TransformedEnv(GymWrapper(make_environment(args.env)), DoubleToFloat())
    env.set_seed(args.seed)
    network, policy, loss = make_agent(env)
    targets = SoftUpdate(loss, tau=0.005)
    # Each loss sends gradients into its own networks only: one optimizer will do.
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(args.steps + FRAMES), batch_size=args.batch_size
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=FRAMES,
        total_frames=-(-args.steps // FRAMES) * FRAMES,
        init_random_frames=args.random_steps // FRAMES * FRAMES,
        auto_register_policy_transforms=False,
    )
    snapshots: list[Snapshot] = []
    bar = tqdm(total=args.steps, unit="step", disable=None)
    with closing(bar), suppress(KeyboardInterrupt):
        for step, batch in zip(count(FRAMES, FRAMES), collector):
            buffer.extend(batch)
            for _ in range(FRAMES if step > args.random_steps else 0):
                losses = loss(buffer.sample())
                total = losses["loss_actor"] + losses["loss_qvalue"]
                (total + losses["loss_alpha"]).backward()
                optimizer.step()
                optimizer.zero_grad()
                targets.step()
            bar.update(FRAMES)
            if step >= min(args.steps, args.eval_every * (len(snapshots) + 1)):
                actor = network.as_arrays()
                entry = measure(eval_env, actor, args.eval_steps, args.seed)
                snapshots.append(Snapshot(step, actor, entry["stochastic_return"][0]))
                bar.set_postfix(mean_return=f"{snapshots[-1].mean_return:.0f}")
    collector.shutdown()
    return snapshots


def measure(
    env: gymnasium.Env[Any, Any], policy: BehaviorPolicy, steps: int, seed: int
) -> dict[str, Any]:
    """Mean and deviation of a policy's returns, as its card has them."""

    def mean_action(observation: NDArray[Any], _: object) -> NDArray[np.float32]:
        return policy.deterministic(observation)

    entry: dict[str, Any] = {}
    for name, sampler in (
        ("deterministic", mean_action),
        ("stochastic", policy.sample),
    ):
        _, returns, lengths = collect_transitions(
            env, [sampler], steps, seed=seed, progress=False
        )
        if not len(returns):
            raise SystemExit(f"no {name} episode ended in {steps} steps: take more.")
        entry[f"{name}_return"] = [float(returns.mean()), float(returns.std())]
    entry["episode_length"] = float(lengths.mean())
    entry["episodes"] = len(returns)
    return entry


def choose(snapshots: list[Snapshot], medium_share: float) -> dict[str, Snapshot]:
    """Name the snapshots to keep."""
    returns = np.array([snapshot.mean_return for snapshot in snapshots])
    best = int(returns.argmax())
    # The share is counted from the first snapshot, since returns may be negative.
    threshold = returns[0] + medium_share * (returns[best] - returns[0])
    medium = int(np.argmax(returns >= threshold))
    chosen = {"medium": snapshots[medium], "expert": snapshots[best]}
    for number, index in enumerate(np.linspace(0, medium, 8).round(), start=1):
        chosen[f"replay_{number}"] = snapshots[int(index)]
    return chosen


def save(path: Path, policy: BehaviorPolicy, *, half: bool) -> None:
    """Write a policy as plain arrays, in float16 or float32; whole or not at all."""
    dtype = np.float16 if half else np.float32
    arrays = {name: array.astype(dtype) for name, array in policy.arrays.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        np.savez_compressed(file, **arrays)


def main(arguments: list[str] | None = None) -> None:
    """Train, choose, measure again and write."""
    args = parse_arguments(arguments)
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    entries = {}
    env = make_environment(args.env)
    snapshots = train(args, env)
    if not snapshots:
        raise SystemExit("stopped before the first evaluation: nothing to keep.")
    for name, kept in choose(snapshots, args.medium_share).items():
        # Half precision is enough for the eight that only add variety.
        half = name.startswith("replay")
        file = args.out / args.name / f"{name}.npz"
        save(file, kept.actor, half=half)
        # Fresh episodes: those that a snapshot was chosen by flatter it.
        entry = measure(env, kept.actor, args.card_steps, args.seed + 1)
        if references := reference_returns(args.name):
            score = references.score(entry["stochastic_return"][0])
            entry["normalized"] = score
        entry |= {"steps": kept.step, "dtype": "float16" if half else "float32"}
        entries[name] = entry
        torchrl_logger.info(f"{args.name} {name}: {entry}")
    path = args.out / "card.json"
    card = load_behavior_card(args.out) if path.exists() else {}
    write_json(path, card | {args.name: {"env": args.env, "policies": entries}})


if __name__ == "__main__":
    main()
