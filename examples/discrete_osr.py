"""OSR for discrete actions on CartPole, from the data to a table, in about a minute.

    python examples/discrete_osr.py --seed 1 --output cartpole.json

The data are rolled out here: a rule that balances the pole, mixed with random actions.
Two policies are then learnt from them alone, by CQL and by OSR. Both play from the
task's own starts, and from starts three times as far out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl import torchrl_logger
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_osr import DiscreteOSRLoss, InverseDynamicsLoss, StatePerturbation
from torchrl_osr.data import (
    check_dataset,
    make_replay_buffer,
    observation_statistics,
    split_held_out,
)
from torchrl_osr.evaluation import mean_interval
from torchrl_osr.modules import (
    categorical_actor,
    categorical_inverse_dynamics,
    discrete_critic_ensemble,
)

TASK, SIZES = "CartPole-v1", (4, 2)  # of the observation, and number of actions
EPSILONS = (0.4, 0.6, 0.8, 1.0)  # shares of random actions in the data, by episode
STARTS = {"own": 0.05, "wide": 0.15}  # the four numbers of a first state lie within +-
EVALUATION_SEED = 10_000_000  # above the seeds of the data's episodes
PERTURBATION = 0.05  # standard deviation, in units of the data's own
WEIGHTS = {"cql": 0.0, "osr": 0.5}  # the two losses differ in recovery_weight alone
CELLS = [64, 64]
PACKAGES = ("torchrl-osr", "torchrl", "tensordict", "torch", "gymnasium", "numpy")

Policy = Callable[[NDArray[Any]], NDArray[Any]]


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    formatter = argparse.ArgumentDefaultsHelpFormatter
    parser = argparse.ArgumentParser(formatter_class=formatter)
    add = parser.add_argument
    add("--seed", type=int, default=0, help="of the data and of the training")
    add("--loss", nargs="+", choices=list(WEIGHTS), default=list(WEIGHTS))
    add("--steps", type=int, default=3_000, help="updates of a policy")
    add("--model-steps", type=int, default=1_000, help="updates of the model")
    add("--data-episodes", type=int, default=220, help="about 20,000 transitions")
    add("--episodes", type=int, default=50, help="played by each policy at the end")
    add("--output", type=Path, help="write the returns of every episode here, as JSON")
    return parser.parse_args(arguments)


def play(policy: Policy, seeds: NDArray[np.int64], start: float = STARTS["own"]) -> Any:
    """Play one whole episode a seed; return all transitions and the episodes' returns.

    A time-out is truncated, not terminated, and every next observation is the true one.
    """
    envs = gymnasium.make_vec(TASK, num_envs=len(seeds), vectorization_mode="sync")
    starts = {"low": -start, "high": start}
    observation, _ = envs.reset(seed=seeds.tolist(), options=starts)
    episode, running = np.arange(len(seeds)), np.ones(len(seeds), dtype=bool)
    steps = []
    while running.any():
        action = policy(observation)
        next_observation, reward, terminated, truncated, _ = envs.step(action)
        row = episode, observation, action, next_observation, reward, terminated
        steps.append([column[running] for column in (*row, truncated)])
        # The environments start anew on their own; a seed's first episode counts.
        running &= ~(terminated | truncated)
        observation = next_observation
    envs.close()
    joined = [np.concatenate(column) for column in zip(*steps, strict=True)]
    observation, action, next_observation, *rest = map(torch.from_numpy, joined[1:])
    reward, terminated, truncated = (column.unsqueeze(-1) for column in rest)
    data = TensorDict({"observation": observation}, [len(action)])
    data["action"] = torch.nn.functional.one_hot(action, SIZES[1])
    data["next"] = {"observation": next_observation, "reward": reward.float()}
    data["next"].update({"terminated": terminated, "truncated": truncated})
    data["next", "done"] = terminated | truncated
    return data, np.bincount(joined[0], weights=joined[4])


def noisy_rule(num_episodes: int, rng: np.random.Generator) -> Policy:
    """Push the cart to where the pole falls, but at random with probability epsilon."""
    epsilon = np.resize(EPSILONS, num_episodes)

    def policy(observation: NDArray[Any]) -> NDArray[Any]:
        rule = observation[:, 2] + 0.5 * observation[:, 3] > 0  # angle and its velocity
        chance = rng.random(num_episodes) < epsilon
        return np.where(chance, rng.integers(SIZES[1], size=num_episodes), rule)

    return policy


def greedy(actor: ProbabilisticTensorDictSequential, loc: Any, scale: Any) -> Policy:
    """Return the likeliest action of an actor as a function of raw observations."""

    @torch.no_grad()
    def policy(observation: NDArray[Any]) -> NDArray[Any]:
        batch = {"observation": (torch.from_numpy(observation) - loc) / scale}
        logits = actor.get_dist(TensorDict(batch, [len(observation)])).logits
        return logits.argmax(-1).numpy()

    return policy


def train(loss: LossModule, buffer: ReplayBuffer, steps: int, updater: Any) -> None:
    """Minimise the sum of a loss module's ``loss_*`` entries."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    for _ in range(steps):
        losses = loss(buffer.sample())
        sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Data, inverse dynamics model, policies; return everything that was measured."""
    rng = np.random.default_rng(args.seed)
    seeds = rng.integers(EVALUATION_SEED, size=args.data_episodes)
    data, returns = play(noisy_rule(args.data_episodes, rng), seeds)
    check_dataset(data)
    results: dict[str, Any] = {"rows": len(data), "data_returns": returns.tolist()}
    loc, scale = observation_statistics(data)
    for key in ("observation", ("next", "observation")):
        data[key] = (data[key] - loc) / scale
    data, held_out = split_held_out(data, 0.1, seed=args.seed)

    def buffer() -> ReplayBuffer:
        noise = StatePerturbation(std=PERTURBATION, seed=args.seed)
        return make_replay_buffer(data, batch_size=128, seed=args.seed, transform=noise)

    torch.manual_seed(args.seed)
    network = categorical_inverse_dynamics(*SIZES, num_cells=CELLS)
    train(InverseDynamicsLoss(network), buffer(), args.model_steps, None)
    (nll,) = InverseDynamicsLoss(network, states="clean")(held_out).values()
    seeds = EVALUATION_SEED + np.arange(args.episodes)
    results |= {"model_nll": nll.item(), "episode_seeds": seeds.tolist(), "returns": {}}
    for name in args.loss:
        torch.manual_seed(args.seed)  # the same networks to begin with
        actor = categorical_actor(*SIZES, num_cells=CELLS)
        critics = discrete_critic_ensemble(*SIZES, num_cells=CELLS)
        loss = DiscreteOSRLoss(actor, critics, network, recovery_weight=WEIGHTS[name])
        train(loss, buffer(), args.steps, SoftUpdate(loss, tau=5e-3))
        for starts, bound in STARTS.items():
            _, returns = play(greedy(actor, loc, scale), seeds, bound)
            results["returns"][f"{name}, {starts} starts"] = returns.tolist()
    return results


def table(results: dict[str, Any]) -> str:
    """Return mean returns with their 95 % intervals over the episodes."""
    rows = {"data": results["data_returns"]} | results["returns"]
    lines = [f"{'':16}{'return':>8}   95 % interval     episodes"]
    for name, returns in rows.items():
        mean, low, high = mean_interval(returns)
        span = f"{low:.1f} to {high:.1f}"
        lines.append(f"{name:16}{mean:8.1f}   {span:16}{len(returns):10}")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Run all of it, print the table, write the file."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    args = parse_arguments(arguments)
    results = run(args)
    print(f"{TASK}, {results['rows']} transitions, seed {args.seed}")
    print(f"inverse dynamics, held out: {results['model_nll']:.4f} nats")
    print(table(results))
    if args.output is not None:
        results["command"] = f"python examples/discrete_osr.py {' '.join(arguments)}"
        results["versions"] = {name: version(name) for name in PACKAGES}
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
