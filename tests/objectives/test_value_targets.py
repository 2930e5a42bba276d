"""The critics' target: its kinds, its discount, and returns of several steps."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torchrl.data.postprocs import MultiStep
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator
from torchrl_osr.objectives.step import Step


def target_value(family, seeded, name: str, batch, *args, **kwargs) -> torch.Tensor:
    loss = family(name)
    loss.make_value_estimator(*args, **kwargs)
    return seeded(loss, batch)["target_value"]


def test_td_target_is_the_reward_and_the_discounted_value(family, make_batch) -> None:
    loss, batch = family("cql"), make_batch(5)
    loss.make_value_estimator(gamma=0.5)
    batch["next", "reward"] = torch.arange(1.0, 6.0).double().unsqueeze(-1)
    step = Step(loss, batch, perturbed=False)
    target = step.td_target(10 * torch.arange(1.0, 6.0).double())
    # By hand: 1 + 5, 2 (terminated), 3 + 15 (cut by a time limit), 4 + 20, 5 + 25.
    assert target.tolist() == [6, 2, 18, 24, 30]


def test_a_policy_that_is_first_asked_without_gradient_has_one(
    family, make_batch
) -> None:
    loss = family("cql")
    step = Step(loss, make_batch(5), perturbed=False)
    with torch.no_grad():
        step.policy("clean").sample()
    log_prob = step.policy("clean").log_prob(step.data_action.unsqueeze(0))
    log_prob.sum().backward()
    actor = loss.actor_network_params.parameters()
    assert all(each.grad is not None for each in actor)


@pytest.mark.losses(having="critics")
def test_the_kinds_of_target_agree_where_they_must(
    family, family_batch, seeded, name
) -> None:
    batch = family_batch(name, 2, 5)
    target = partial(target_value, family, seeded, name, batch)
    td0 = target()
    assert td0 == target("td0", gamma=0.99)
    assert td0 == target(ValueEstimators.TD0)
    assert td0 == target(TD0Estimator(gamma=0.99, value_network=None))
    td1 = target(ValueEstimators.TD1)
    assert td0 != td1
    # TD(lambda) is TD(0) at lambda = 0 and TD(1) at lambda = 1.
    for lmbda, wanted in {0.0: td0, 1.0: td1}.items():
        # The vectorised estimator of TorchRL 0.14.1 fails at lambda = 0.
        found = target(ValueEstimators.TDLambda, lmbda=lmbda, vectorized=False)
        torch.testing.assert_close(found, wanted)


@pytest.mark.losses(having="critics")
@pytest.mark.parametrize("kind", ["gae", ValueEstimators.GAE, ValueEstimators.VTrace])
def test_estimators_without_an_action_value_are_refused(family, name, kind) -> None:
    with pytest.raises(NotImplementedError):
        family(name).make_value_estimator(kind)


@pytest.mark.losses(having="critics")
def test_gamma_scales_the_bootstrap(family, family_batch, seeded, name) -> None:
    batch = family_batch(name, 10)
    target = partial(target_value, family, seeded, name, batch)
    zero, half, one = (target(gamma=gamma) for gamma in (0.0, 0.5, 1.0))
    torch.testing.assert_close(zero, batch["next", "reward"].mean())
    assert one != zero
    torch.testing.assert_close(half, (zero + one) / 2)


GAMMA, STEPS = 0.875, 3


def state_only(networks, discrete: bool):
    """Critics that ignore the action: the target's draws do not matter."""
    for critic in networks.critics:
        if not discrete:
            critic.module[0].weight.data[:, 3:] = 0.0
    return networks


def next_values(networks, discrete: bool, state: torch.Tensor) -> torch.Tensor:
    """What the policy is worth at a state, by the lowest critic."""
    if discrete:
        lowest = torch.stack([critic.module(state) for critic in networks.critics])
        return (networks.actor[0].module(state).softmax(-1) * lowest.amin(0)).sum(-1)
    action = torch.zeros(*state.shape[:-1], 2, dtype=state.dtype)
    values = [critic.module(state, action) for critic in networks.critics]
    return torch.cat(values, -1).amin(-1)


def pred_values(networks, batch) -> list[torch.Tensor]:
    state, action = batch["observation"], batch["action"]
    if action.is_floating_point():
        return [c.module(state, action).squeeze(-1) for c in networks.critics]
    index = action if action.ndim == 2 else action.argmax(-1)
    index = index.unsqueeze(-1)
    return [c.module(state).gather(-1, index).squeeze(-1) for c in networks.critics]


def multi_step_loss(networks, batch, discrete: bool) -> torch.Tensor:
    """``loss_qvalue`` of n-step returns, row by row."""
    total = 0.0
    pred, next_rows = pred_values(networks, batch), batch["next"]
    for trajectory in range(2):
        for first in range(5):
            target, discount = 0.0, 1.0
            for step in range(first, min(first + STEPS, 5)):
                row = next_rows[trajectory, step]
                target = target + discount * row["reward"].squeeze()
                discount *= GAMMA
                if row["done"]:
                    break
            # The flag of the first step, which is the one that MultiStep leaves.
            if not next_rows["terminated"][trajectory, first]:
                value = next_values(networks, discrete, row["observation"])
                target = target + discount * value
            for values in pred:
                total = total + (values[trajectory, first] - target).square() / 10
    return total


# Those without an inverse dynamics model, to which several steps mean nothing.
MODEL_FREE = ["cql", "cql-perturbed", "cql-options", "cloning", "noisy-cloning"]
MODEL_FREE += ["edac", "td3bc", "discrete-cql"]


@pytest.mark.losses(*MODEL_FREE)
def test_multi_step_returns_are_discounted_by_their_steps(
    family, family_batch, name
) -> None:
    discrete = family[name].discrete
    networks = state_only(family.networks(name), discrete)
    batch = family_batch(name, 2, 5)
    with torch.no_grad():
        expected = multi_step_loss(networks, batch, discrete)
    # The temperature is next to nothing for those with the entropy in the target.
    tiny = {"alpha_init": 1e-15} if "loss_alpha" in family[name].groups else {}
    loss = family(name, networks, **tiny)
    loss.make_value_estimator(gamma=GAMMA)
    batch = MultiStep(GAMMA, STEPS)(batch)
    out = loss(batch.copy())["loss_qvalue"].detach()
    torch.testing.assert_close(out, expected, rtol=1e-9, atol=1e-9)
    # As in TorchRL's own losses, the number of steps is not among the in_keys: a batch
    # without it is discounted as if every return were of one step.
    assert "steps_to_next_obs" not in loss.in_keys
    one_step = loss(batch.select(*loss.in_keys))["loss_qvalue"].detach()
    assert (one_step - expected).abs() > 1e-3


@pytest.mark.losses(having="model")
def test_with_its_first_step_kept_a_model_sees_that_one(
    family, family_batch, name
) -> None:
    """The recovery term is that of the single steps, the target that of several."""
    single = family_batch(name, 30)
    several = single.clone().set("next", single["next"].roll(1, 0))
    batch = several.clone().set("one_step", single["next"])
    batch["steps_to_next_obs"] = torch.full((30, 1), 2)
    found = {}
    for kind, rows, gamma in (
        ("both", batch, 0.5),
        ("single", single, 0.5),
        ("several", several, 0.25),
    ):
        loss = family(name)
        if "loss_qvalue" in loss.out_keys:
            loss.make_value_estimator(gamma=gamma)
        torch.manual_seed(0)
        found[kind] = loss(rows)
    recovery = [key for key in map(str, found["both"].keys()) if "recovery" in key]
    for key in recovery:
        torch.testing.assert_close(found["both"][key], found["single"][key])
        assert (found["both"][key] - found["several"][key]).abs() > 1e-6
    if "target_value" in found["both"]:
        both, several = (found[kind]["target_value"] for kind in ("both", "several"))
        torch.testing.assert_close(both, several)


@pytest.mark.losses(having="critics")
def test_multi_step_of_one_step_changes_nothing(
    family, family_batch, record, assert_same, name
) -> None:
    loss, batch = family(name), family_batch(name, 2, 5)
    shifted = MultiStep(GAMMA, 1)(batch.clone())
    assert_same(record(loss, shifted), record(loss, batch))


@pytest.mark.parametrize("kind", ["td1", ValueEstimators.TDLambda])
def test_rows_are_no_trajectory(family, family_batch, kind) -> None:
    loss = family("td3bc")
    loss.make_value_estimator(kind)
    with pytest.raises(
        ValueError, match=r"a batch \[B, T\] of trajectories, got \[10\]"
    ):
        loss(family_batch("td3bc", 10))
    assert loss(family_batch("td3bc", 2, 5))["loss_qvalue"].isfinite()
