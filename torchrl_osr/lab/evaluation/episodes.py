"""Complete episodes of a policy, many at once, and the raw return of each.

Shapes: ``E`` episodes, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import ObservationNorm

from torchrl_osr._checks import check_at_least
from torchrl_osr.lab.data import ReferenceReturns
from torchrl_osr.lab.data.environment import make_environment
from torchrl_osr.lab.evaluation.statistics import mean_interval
from torchrl_osr.objectives.networks import ONE_HOT

UnitPolicy = Callable[[Tensor], Tensor]
"""Maps raw observations ``[E, S]`` to actions ``[E, A]`` within -1 and 1.

Discrete actions are their numbers, ``[E]``.
"""

Wrap: TypeAlias = Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]
"""Puts wrappers around an environment."""

Watch = Callable[[int, NDArray[Any], bool, dict[str, Any]], None]
"""Gets episode, observation ``[S]``, terminated and info of each reset and step."""


@dataclass(frozen=True)
class EpisodeResults:
    """Undiscounted returns, lengths, reset seeds and successes of episodes, ``[E]``.

    A success is ``info["success"]`` of the last step, if the task has such an entry.
    """

    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]
    seeds: NDArray[np.int64]
    successes: NDArray[np.bool_] | None = None


def deterministic_policy(
    actor_network: ProbabilisticTensorDictSequential,
    observation_norm: ObservationNorm | None = None,
) -> UnitPolicy:
    """Return the actor's deterministic action as a function of raw observations.

    Of one-hot actions that is the number of the likeliest. Pass the
    ``observation_norm`` of the training data if the actor needs standardised states.
    """

    @torch.no_grad()
    def policy(observation: Tensor) -> Tensor:
        if observation_norm is not None:
            observation = observation_norm._apply_transform(observation)
        batch = TensorDict({"observation": observation}, [len(observation)])
        distribution = actor_network.get_dist(batch)
        action: Tensor = distribution.deterministic_sample
        return action.argmax(-1) if isinstance(distribution, ONE_HOT) else action

    return policy


class EpisodeEvaluator:
    """Play one episode for each of a fixed list of seeds, to its end.

    The policy is called once a step, with all unfinished episodes.

    Keyword Args:
        num_episodes: ``E``. Default 10.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.
        device: of the policy. Default CPU.
        wrap: put around each environment. Default: nothing.
        fixed_batch: call the policy with all ``E`` rows to the end. torch's rounding
            depends on the number of rows; with a fixed number, an episode does not
            depend on when others end. Default ``False``.

    Examples:
        >>> evaluator = EpisodeEvaluator("Hopper-v5", num_episodes=2)
        >>> results = evaluator(lambda observation: torch.zeros(len(observation), 3))
        >>> results.lengths.shape
        (2,)
    """

    def __init__(
        self,
        env_id: str,
        *,
        num_episodes: int = 10,
        seed: int = 0,
        device: torch.device | str = "cpu",
        wrap: Wrap | None = None,
        fixed_batch: bool = False,
    ) -> None:
        check_at_least(1, "num_episodes", num_episodes)
        made = (make_environment(env_id) for _ in range(num_episodes))
        self.environments = [each if wrap is None else wrap(each) for each in made]
        self.seeds = seed + np.arange(num_episodes)
        self.device, self.fixed_batch = device, fixed_batch

    def __call__(
        self, policy: UnitPolicy, watch: Watch = lambda *_: None
    ) -> EpisodeResults:
        """Play an episode for each seed; call the policy's ``reset`` first, if any."""
        getattr(policy, "reset", lambda: None)()
        episodes = len(self.environments)
        returns, lengths = np.zeros(episodes), np.zeros(episodes, dtype=np.int64)
        infos: list[dict[str, Any]] = []
        starts = []
        for episode, environment in enumerate(self.environments):
            start, info = environment.reset(seed=int(self.seeds[episode]))
            watch(episode, start, False, info)
            starts.append(start)
            infos.append(info)
        observations = np.stack(starts).astype(np.float32)
        everyone = running = list(range(episodes))
        while running:
            rows = everyone if self.fixed_batch else running
            batch = torch.from_numpy(observations[rows]).to(self.device)
            actions = dict(zip(rows, policy(batch).detach().cpu().numpy(), strict=True))
            unfinished = []
            for episode in running:
                step = self.environments[episode].step(actions[episode])
                observation, reward, terminated, truncated, infos[episode] = step
                watch(episode, observation, terminated, infos[episode])
                observations[episode] = observation
                returns[episode] += float(reward)
                lengths[episode] += 1
                if not (terminated or truncated):
                    unfinished.append(episode)
            running = unfinished
        successes = None
        if all("success" in info for info in infos):
            successes = np.array([bool(info["success"]) for info in infos])
        return EpisodeResults(returns, lengths, self.seeds, successes)

    def close(self) -> None:
        """Close the environments."""
        for environment in self.environments:
            environment.close()


def measure_of(row: Mapping[str, Any]) -> str:
    """Return ``"score"`` if a summary has scores, else ``"return"``."""
    return "score" if "score" in row else "return"


def summarize(
    results: EpisodeResults, references: ReferenceReturns | None
) -> dict[str, Any]:
    """Summarise episodes, JSON-compatible.

    Returns:
        Means ``"return"``, ``"length"`` and, with references, ``"score"``. The 95 %
        bootstrap interval: ``"score_low"`` and ``"score_high"``, or ``"return_low"``
        and ``"return_high"``. The lists ``"returns"``, ``"lengths"``, ``"seeds"``.
    """
    measure, values = "return", results.returns
    if references is not None:
        measure, values = "score", references.score(results.returns)
    mean, low, high = mean_interval(values)
    return {
        measure: mean,
        f"{measure}_low": low,
        f"{measure}_high": high,
        "return": float(results.returns.mean()),
        "length": float(results.lengths.mean()),
        "returns": results.returns.tolist(),
        "lengths": results.lengths.tolist(),
        "seeds": results.seeds.tolist(),
    }
