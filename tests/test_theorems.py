"""What the paper proves, on random tabular problems: how far each statement holds.

States and actions are few and every expectation is exact, so that a sentence of
docs/method.md about a theorem can be counted: true in all problems, in some, or in
none. The test of theorem 1 checks the documentation alone.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor

from torchrl_osr.functional import value_constraint

PROBLEMS, STATES, ACTIONS = 2000, 5, 3


def simplex(*shape: int) -> Tensor:
    """Uniform draws from the probability simplex of the last dimension."""
    draw = -torch.rand(*shape, dtype=torch.float64).log()
    return draw / draw.sum(-1, keepdim=True)


def next_states(policy: Tensor, dynamics: Tensor) -> Tensor:
    """``P(s' | s, pi)``: ``[n, A]`` and ``[n, A, S]`` to ``[n, S]``."""
    return torch.einsum("na,nas->ns", policy, dynamics)


def averaged_model(next_state: Tensor, policy: Tensor, dynamics: Tensor) -> Tensor:
    """Mean over ``s'`` of the inverse dynamics model, equation (6), ``[n, A]``."""
    joint = policy.unsqueeze(-1) * dynamics
    model = joint / next_states(policy, dynamics).unsqueeze(1)
    return torch.einsum("ns,nas->na", next_state, model)


def divergence(p: Tensor, q: Tensor) -> Tensor:
    return torch.special.xlogy(p, p / q).sum(-1)


def constraint(qvalue: Tensor, policy: Tensor, target: Tensor) -> Tensor:
    """Equation (8) by the package, exactly: every action once, weighted."""
    count = qvalue.shape[-1]
    return value_constraint(count * policy * qvalue, count * target * qvalue)


def problems(shift: float = 0.3) -> SimpleNamespace:
    """Random ``s`` with behaviour and dynamics, and an ``s^`` with its own.

    The dynamics at ``s^`` are those at ``s`` with ``shift`` of other dynamics.
    """
    shape = (PROBLEMS, ACTIONS)
    behaviour, off_behaviour, policy = (simplex(*shape) for _ in range(3))
    dynamics = simplex(*shape, STATES)
    off_dynamics = (1 - shift) * dynamics + shift * simplex(*shape, STATES)
    next_state = next_states(behaviour, dynamics)
    return SimpleNamespace(
        behaviour=behaviour, off_behaviour=off_behaviour, policy=policy,
        dynamics=dynamics, off_dynamics=off_dynamics, next_state=next_state,
        target=averaged_model(next_state, off_behaviour, off_dynamics),
        qvalue=torch.randn(*shape, dtype=torch.float64),
    )  # fmt: skip


def test_proposition_2_at_the_data_the_model_is_the_behaviour_policy() -> None:
    # So on D the constraint is E_pi Q - E_D Q: CQL with a plain mean.
    mdp = problems()
    target = averaged_model(mdp.next_state, mdp.behaviour, mdp.dynamics)
    torch.testing.assert_close(target, mdp.behaviour, rtol=0, atol=1e-12)
    gap = constraint(mdp.qvalue, mdp.policy, target)
    plain = ((mdp.policy - mdp.behaviour) * mdp.qvalue).sum(-1)
    torch.testing.assert_close(gap, plain, rtol=0, atol=1e-12)


def test_theorem_1_is_one_step_towards_the_minimiser_and_not_the_minimiser() -> None:
    """Left side: argmin is the model's mean. Right side: fit of the next states.

    The mean is one expectation-maximisation step of that fit from the behaviour policy
    at ``s^``. It improves the fit in 2000 of 2000 problems, and is its minimiser, where
    a further step would leave it, in 0 of 2000.
    """
    mdp = problems()
    dynamics, target = mdp.off_dynamics, mdp.target
    again = averaged_model(mdp.next_state, target, dynamics)
    start, once, twice = (
        divergence(mdp.next_state, next_states(policy, dynamics))
        for policy in (mdp.off_behaviour, target, again)
    )
    assert (once <= start).sum() == PROBLEMS
    assert (twice < once).sum() == PROBLEMS
    assert ((again - target).abs().sum(-1) < 1e-6).sum() == 0
    for _ in range(300):
        again = averaged_model(mdp.next_state, again, dynamics)
    best = divergence(mdp.next_state, next_states(again, dynamics))
    # Far from it, too: most of the way is left, and the policies are not alike.
    assert ((once - best) / (start - best)).median() > 0.5
    assert (again - target).abs().sum(-1).median() > 0.5


def test_theorem_2_bounds_the_gap_to_the_behaviour_policy_for_positive_values() -> None:
    """The half of the bound that can be stated for a table, with and without signs.

    With ``delta`` the largest relative difference of the next states' probabilities,
    the model's and the behaviour policy's values at ``s^`` differ by at most
    ``delta E_{pi_beta} Q``: in 2000 of 2000 problems for Q >= 0, which the paper does
    not say it needs. For values of either sign it is false in many problems, and true
    in all with ``|Q|`` on the right.
    """
    mdp = problems()
    off_next = next_states(mdp.off_behaviour, mdp.off_dynamics)
    delta = (mdp.next_state / off_next - 1).abs().amax(-1)

    def gap(qvalue: Tensor) -> Tensor:
        return constraint(qvalue, mdp.off_behaviour, mdp.target).abs()

    def bound(qvalue: Tensor) -> Tensor:
        return delta * (mdp.off_behaviour * qvalue).sum(-1)

    positive = mdp.qvalue.abs()
    assert (gap(positive) <= bound(positive)).sum() == PROBLEMS
    assert (gap(positive) / bound(positive)).max() < 0.9
    # Also where the bound itself is given the benefit of its absolute value.
    signed = (gap(mdp.qvalue) > bound(mdp.qvalue).abs()).sum().item()
    assert 0.02 < signed / PROBLEMS < 0.2
    assert (gap(mdp.qvalue) <= bound(positive)).sum() == PROBLEMS
