"""A switching policy of runs: what their files hold, in the environment's units."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from untrained_run import make_run

from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.dynamics.training import FILE, load_dynamics, write_dynamics
from torchrl_osr.lab.run.policy_of_run import load_run_policy
from torchrl_osr.lab.run.switching import load_switching_policy

LOSS = "loss=td3_bc"


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    """Two untrained runs with models, one of a task's own bounds."""
    top, found = tmp_path_factory.mktemp("runs"), []
    for seed in range(2):
        torch.manual_seed(seed)
        folder = top / f"seed{seed}"
        bounds = "env.action_low=[-1,-2,0]", "env.action_high=[1,2,4]"
        make_run(folder, LOSS, *bounds)
        model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=1, num_cells=[4])
        write_dynamics(folder / FILE, model, {"direction of time": "forward"})
        found.append(folder)
    return found


def test_it_is_the_runs_policies_models_and_critics(folders) -> None:
    switching = load_switching_policy(folders, steps=1, hold=2)
    policies = [load_run_policy(folder) for folder in folders]
    state = torch.randn(6, 11)
    state[:, 0], state[:, 1] = 1.2 + 0.1 * state[:, 0].abs(), 0.0
    wanted = []
    for policy in policies:
        action, each = policy(state), []
        for folder, own in zip(folders, policies, strict=True):
            # Restated: the run's networks see standardised states and actions in 1.
            seen, half = (state - own.loc) / own.scale, (own.high - own.low) / 2
            unit = (action - (own.low + own.high) / 2) / half
            plain = load_dynamics(folder / FILE)
            mean = plain.predict(seen, unit)[0][plain.elites[0]]
            after = state + mean[:, :-1] * own.scale
            values = [
                critic.smallest_value(after, policy(after)) for critic in policies
            ]
            alive = ~switching.terminated(after)
            each.append(mean[:, -1] + 0.99 * alive * sum(values) / 2)
        wanted.append(sum(each) / 2)
    wanted = torch.stack(wanted, 1)
    torch.testing.assert_close(switching.returns(state), wanted)
    chosen = wanted.argmax(1)
    actions = torch.stack([policy(state) for policy in policies], 1)
    assert torch.equal(switching(state), actions[torch.arange(6), chosen])


def test_others_may_judge_and_critics_may_judge_alone(folders, tmp_path) -> None:
    make_run(tmp_path / "bc", "loss=bc", "env.action_low=[-1,-1,-1]")
    state = torch.zeros(1, 11)
    judged = load_switching_policy([tmp_path / "bc"], judges=folders[:1])
    assert (len(judged.policies), len(judged.networks.weights[0])) == (1, 1)
    assert torch.equal(judged(state), load_run_policy(tmp_path / "bc")(state))
    alone = load_switching_policy(folders, critics_only=True)
    policies = [load_run_policy(folder) for folder in folders]
    for column, policy in zip(alone.returns(state).T, policies, strict=True):
        values = [each.smallest_value(state, policy(state)) for each in policies]
        torch.testing.assert_close(column, sum(values) / 2)


def test_judges_of_another_unit_of_reward_are_refused(folders, tmp_path) -> None:
    bounds = "env.action_low=[-1,-2,0]", "env.action_high=[1,2,4]"
    make_run(tmp_path / "other", LOSS, *bounds, "data.reward_scale=100")
    with pytest.raises(ValueError, match=r"reward_scale: \[1.0, 100.0\]"):
        load_switching_policy([*folders, tmp_path / "other"], critics_only=True)
    load_switching_policy([*folders, tmp_path / "other"], judges=folders)


def test_what_cannot_be_switched_is_named(folders, tmp_path) -> None:
    def refused(message: str, *runs: Path, kind: type[Exception] = ValueError) -> None:
        with pytest.raises(kind, match=message):
            load_switching_policy(runs)

    bounds = "env.action_low=[-1,-1,-1]", "env.action_high=[1,1,1]"
    for name, options in {
        "bare": [LOSS],
        "clone": ["loss=bc", *bounds],
        "hasty": [LOSS, "optim.gamma=0.9"],
        "reverse": [LOSS],
    }.items():
        make_run(tmp_path / name, *options)
    facts = {"direction of time": "backward"}
    write_dynamics(tmp_path / "reverse" / FILE, DynamicsEnsemble(11, 3), facts)
    bare = tmp_path / "bare"
    refused("train with loss=rim or dynamics=ensemble", bare, kind=FileNotFoundError)
    refused("clone has discrete actions or no critics", tmp_path / "clone")
    refused(r"optim.gamma: \[0.9, 0.99\]", folders[0], tmp_path / "hasty")
    refused("these differ: direction of time", tmp_path / "reverse")
