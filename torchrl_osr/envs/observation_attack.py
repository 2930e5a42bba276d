r"""Observations that an adversary falsifies, within a box around the true ones.

The evaluation of "RORL: Robust Offline Reinforcement Learning via Conservative
Smoothing" (Yang et al., NeurIPS 2022), https://arxiv.org/abs/2206.02829. An adversary
needs the networks, so it sits between environment and policy, not in a wrapper.

Shapes: ``E`` episodes, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ObservationNorm
from torchrl.modules import TanhNormal

from torchrl_osr._checks import check_choice
from torchrl_osr.objectives.adversary import Adversary
from torchrl_osr.objectives.tanh_gaussian import TanhGaussianActorCritic

Distribution = Callable[[TensorDictBase], TanhNormal]
"""Maps states of any batch size to the policy's distribution there."""

Values = Callable[[TensorDictBase, Tensor], Tensor]
"""Maps states ``[M, E]`` and actions ``[M, E, A]`` to all critics' ``[N, M, E]``."""


def networks_of(loss: TanhGaussianActorCritic) -> tuple[Distribution, Values]:
    """Return the policy and the critics of a loss, as they are at each call.

    Args:
        loss: :class:`~torchrl_osr.OSRLoss` or :class:`~torchrl_osr.OSRVLoss`, trained.

    Returns:
        The policy's distribution as a function of states, and the values of all critics
        (not of the target critics) as a function of states and actions: the first two
        arguments of :func:`attacked_policy`.

    Raises:
        TypeError: if the loss has no tanh-Gaussian policy.

    Examples:
        >>> import torch
        >>> from torchrl_osr import OSRLoss
        >>> from torchrl_osr.envs import attacked_policy, networks_of
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> loss = OSRLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...                recovery_weight=0)
        >>> policy = attacked_policy(*networks_of(loss), kind="min_Q", epsilon=0.1)
        >>> policy(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """
    if not isinstance(loss, TanhGaussianActorCritic):
        raise TypeError(
            f"Expected an OSRLoss or OSRVLoss, got {type(loss).__name__}; pass "
            "attacked_policy its actor's get_dist and a function of its critics."
        )

    def distribution(states: TensorDictBase) -> TanhNormal:
        return loss._distribution(loss._policy(states))

    def qvalue(states: TensorDictBase, action: Tensor) -> Tensor:
        return loss._qvalue(states, action, loss.qvalue_network_params.detach())

    return distribution, qvalue


def attacked_policy(
    policy_distribution: Distribution,
    qvalue: Values | None = None,
    observation_norm: ObservationNorm | None = None,
    *,
    kind: Literal["random", "action_diff", "min_Q"],
    epsilon: float,
    method: Literal["sample", "gradient"] = "sample",
    num_samples: int = 50,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Callable[[Tensor], Tensor]:
    r"""Return a deterministic policy that is shown falsified observations.

    Each number of an observation is off by at most :math:`\epsilon` standard deviations
    of the data. Where in that box:

    * ``"random"``: anywhere, uniformly;
    * ``"action_diff"``: where the policy's distribution differs most from the one at
      the true state, by the Jeffreys divergence;
    * ``"min_Q"``: where the policy's action has the lowest value, averaged over the
      critics, at the true state.

    The last two look as :class:`~torchrl_osr.Adversary` does: among 50 draws by
    default; ``method="gradient"`` with ``num_samples=1`` is RORL's first order, with 20
    its mixed order. ``epsilon=0`` is the bare policy.

    Args:
        policy_distribution: the actor's ``get_dist``, for instance, or what
            :func:`networks_of` returns.
        qvalue: the critics; only ``"min_Q"`` asks.
        observation_norm: how the training data were standardised
            (``standard_normal=True``). Default: not at all, and ``epsilon`` is in the
            observation's own units.

    Keyword Args:
        kind: ``"random"``, ``"action_diff"`` or ``"min_Q"``.
        epsilon: half-width of the box, in standard deviations; RORL's go from 0 to 0.3.
        method: ``"sample"`` (default) or ``"gradient"``.
        num_samples: draws, or starts of the gradient steps. Default 50.
        seed: of the draws' own generator, which goes on from call to call and draws
            for the whole batch: the same numbers again take a new policy, and the same
            episodes. Default 0.
        device: where the policy is. Default CPU.

    Returns:
        A function from observations ``[E, S]``, as the environment gives them, to
        actions ``[E, A]``.

    Raises:
        ValueError: if ``kind`` or ``method`` is unknown, ``epsilon`` negative,
            ``num_samples`` below 1, or ``qvalue`` missing for ``"min_Q"``.

    Examples:
        >>> import torch
        >>> from torchrl_osr.envs import attacked_policy
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> actor = tanh_gaussian_actor(11, 3)
        >>> policy = attacked_policy(actor.get_dist, kind="action_diff", epsilon=0.1)
        >>> policy(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """
    check_choice("kind", kind, ("random", "action_diff", "min_Q"))
    if kind == "min_Q" and qvalue is None:
        raise ValueError(
            "kind='min_Q' needs qvalue, the critics whose value it lowers; got None. "
            "networks_of(loss) returns a trained loss's."
        )
    objective: Literal["action_diff", "min_Q"] = (
        "min_Q" if kind == "min_Q" else "action_diff"
    )
    adversary = Adversary(objective, method, epsilon, num_samples)
    critics = cast(Values, qvalue)  # asked for "min_Q" alone
    generator = torch.Generator(device).manual_seed(seed)

    def falsify(states: TensorDictBase) -> TensorDictBase:
        if kind != "random":
            return adversary.perturb(
                states, ["observation"], policy_distribution, critics, generator
            )
        clean = states["observation"]
        uniform = torch.rand(
            clean.shape, generator=generator, dtype=clean.dtype, device=clean.device
        )
        return states.copy().set("observation", clean + epsilon * (2 * uniform - 1))

    @torch.no_grad()
    def policy(observation: Tensor) -> Tensor:
        if observation_norm is not None:
            observation = (observation - observation_norm.loc) / observation_norm.scale
        states = TensorDict({"observation": observation}, [len(observation)])
        if epsilon > 0:
            states = falsify(states)
        action: Tensor = policy_distribution(states).deterministic_sample
        return action

    return policy
