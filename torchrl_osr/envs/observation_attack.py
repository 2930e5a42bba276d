r"""Observations that an adversary perturbs, within a box around the true ones.

The evaluation of "RORL: Robust Offline Reinforcement Learning via Conservative
Smoothing" (Yang et al., NeurIPS 2022), https://arxiv.org/abs/2206.02829. An adversary
needs the networks, so it acts between environment and policy, not in a wrapper.

Shapes: ``E`` episodes, ``S`` observation, ``A`` action, ``N`` critics, ``M`` candidate
perturbations of one state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ObservationNorm
from torchrl.modules import TanhNormal
from torchrl.objectives import LossModule

from torchrl_osr import Adversary
from torchrl_osr._checks import check_choice

PolicyDistribution: TypeAlias = Callable[[TensorDictBase], TanhNormal]
"""Maps states of any batch size to the policy's distribution there."""

CriticValues: TypeAlias = Callable[[TensorDictBase, Tensor], Tensor]
"""Maps states ``[M, E]`` and actions ``[M, E, A]`` to all critics' ``[N, M, E]``."""


def critics_of(loss: LossModule) -> CriticValues:
    """Values of all critics of a loss, as a function of states and actions.

    The critics themselves, not their target networks, with the parameters that the loss
    has at each call.

    Args:
        loss: a loss module with a ``qvalue_network``: :class:`~torchrl_osr.OSRLoss`,
            :class:`~torchrl_osr.OSRVLoss`, TorchRL's SAC or CQL loss.

    Raises:
        TypeError: if the loss has no ``qvalue_network``.
    """
    if not hasattr(loss, "qvalue_network"):
        raise TypeError(
            f"{type(loss).__name__} has no qvalue_network; pass attacked_policy a "
            "function from states and actions [M, E] to values [N, M, E] instead."
        )

    def values(states: TensorDictBase, action: Tensor) -> Tensor:
        keys, each = loss.tensor_keys, []
        for params in loss.qvalue_network_params.detach().unbind(0):
            batch = states.copy().set(keys.action, action)
            with params.to_module(loss.qvalue_network, preserve_module_state=False):
                batch = loss.qvalue_network(batch)
            each.append(batch.get(keys.state_action_value).squeeze(-1))
        return torch.stack(each)

    return values


def attacked_policy(
    policy_distribution: PolicyDistribution,
    qvalue: CriticValues | None = None,
    observation_norm: ObservationNorm | None = None,
    *,
    kind: Literal["random", "action_diff", "min_Q"],
    epsilon: float,
    method: Literal["sample", "gradient"] = "sample",
    num_samples: int = 50,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Callable[[Tensor], Tensor]:
    r"""Deterministic policy that sees perturbed observations.

    Each entry of an observation is off by at most :math:`\epsilon` standard deviations
    of the data. The perturbation is

    * ``"random"``: uniform in that box;
    * ``"action_diff"``: the one that changes the policy's distribution most, by the
      Jeffreys divergence;
    * ``"min_Q"``: the one that leads the policy to the action of lowest value at the
      true state, averaged over the critics.

    The last two are searched by :class:`~torchrl_osr.Adversary`: the best of 50 draws
    by default; ``method="gradient"`` with ``num_samples=1`` is RORL's first order, with
    20 its mixed order. ``epsilon=0`` is the unperturbed policy.

    Args:
        policy_distribution: the actor's ``get_dist``, for instance.
        qvalue: values of the critics, see :func:`critics_of`; only ``"min_Q"`` needs
            them.
        observation_norm: how the training data were standardised
            (``standard_normal=True``). Default: not at all, and ``epsilon`` is in the
            observation's own units.

    Keyword Args:
        kind: ``"random"``, ``"action_diff"`` or ``"min_Q"``.
        epsilon: half-width of the box, in standard deviations; RORL's go from 0 to 0.3.
        method: ``"sample"`` (default) or ``"gradient"``.
        num_samples: draws, or starts of the gradient steps. Default 50.
        seed: of the draws' own generator, which continues from call to call and draws
            for the whole batch: only a new policy and the same episodes give the same
            numbers again. Default 0.
        device: where the policy is. Default CPU.

    Returns:
        A function from observations ``[E, S]``, as the environment gives them, to
        actions ``[E, A]``.

    Raises:
        ValueError: if ``kind`` or ``method`` is unknown, ``epsilon`` negative,
            ``num_samples`` below 1, or ``qvalue`` missing for ``"min_Q"``.

    Examples:
        >>> import torch
        >>> from torchrl_osr import OSRLoss
        >>> from torchrl_osr.envs import attacked_policy, critics_of
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> actor = tanh_gaussian_actor(11, 3)
        >>> loss = OSRLoss(actor, critic_ensemble(11, 3), recovery_weight=0)
        >>> policy = attacked_policy(
        ...     actor.get_dist, critics_of(loss), kind="min_Q", epsilon=0.1
        ... )
        >>> policy(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """
    check_choice("kind", kind, ("random", "action_diff", "min_Q"))
    if kind == "min_Q" and qvalue is None:
        raise ValueError(
            "kind='min_Q' needs qvalue, the critics whose value it lowers; got None. "
            "critics_of(loss) returns those of a trained loss."
        )
    objective: Literal["action_diff", "min_Q"] = (
        "min_Q" if kind == "min_Q" else "action_diff"
    )
    # Checks the other arguments, also for "random".
    adversary = Adversary(objective, method, epsilon, num_samples)
    critics = cast(CriticValues, qvalue)  # only "min_Q" calls it
    generator = torch.Generator(device).manual_seed(seed)

    @torch.no_grad()
    def policy(observation: Tensor) -> Tensor:
        if observation_norm is not None:
            observation = (observation - observation_norm.loc) / observation_norm.scale
        states = TensorDict({"observation": observation}, [len(observation)])
        if epsilon > 0 and kind == "random":
            states["observation"] = _uniform_in_box(observation, epsilon, generator)
        elif epsilon > 0:
            states = adversary.perturb(
                states, ["observation"], policy_distribution, critics, generator
            )
        action: Tensor = policy_distribution(states).deterministic_sample
        return action

    return policy


def _uniform_in_box(
    centre: Tensor, half_width: float, generator: torch.Generator
) -> Tensor:
    uniform = torch.rand(
        centre.shape, generator=generator, dtype=centre.dtype, device=centre.device
    )
    return centre + half_width * (2 * uniform - 1)
