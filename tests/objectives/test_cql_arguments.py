"""What a script for CQLLoss passes, OSRLoss takes too, or says why not."""

from __future__ import annotations

import ast
import inspect
import math
import re
from pathlib import Path

import pytest
import torch
from torchrl.data import Bounded, Categorical, Composite
from torchrl.objectives import CQLLoss, SoftUpdate

from torchrl_osr import OSRLoss, OSRVLoss
from torchrl_osr.objectives import BaseLoss

PAGE = Path(__file__).parents[2] / "docs" / "torchrl.md"
ROW = re.compile(r"(?m)^\| `(\w+)` \| `(.+?)` \| (.+?) \| (.+?) \|")
BOTH = pytest.mark.parametrize("name", ["osr", "osrv"])
CQL = inspect.signature(CQLLoss).parameters


def defaults(loss_class: type) -> dict[str, object]:
    """Arguments of a loss by name, those of every loss included."""
    parameters = dict(inspect.signature(BaseLoss).parameters)
    parameters |= inspect.signature(loss_class).parameters
    return {name: each.default for name, each in parameters.items()}


def printed(cell: str) -> object:
    """What a cell of the page says the default is; ``refused`` is itself."""
    return ast.literal_eval(cell.strip("`")) if cell.startswith("`") else cell


def test_the_page_has_the_defaults_of_both_libraries() -> None:
    rows = {row[0]: row[1:] for row in ROW.findall(PAGE.read_text(encoding="utf-8"))}
    keywords = [name for name, each in CQL.items() if each.kind is each.KEYWORD_ONLY]
    assert sorted(rows) == sorted(keywords)
    for name, (theirs, osr, osrv) in rows.items():
        assert ast.literal_eval(theirs) == CQL[name].default, name
        for loss_class, cell in ((OSRLoss, osr), (OSRVLoss, osrv)):
            found = defaults(loss_class).get(name, "refused")
            expected = printed(cell)
            assert expected == found, (name, loss_class)


@pytest.mark.parametrize(
    "name", [name for name, each in CQL.items() if each.kind is each.KEYWORD_ONLY]
)
def test_every_argument_of_cql_is_taken_at_its_default(family, name) -> None:
    family("osr", **{name: CQL[name].default})


@BOTH
def test_gamma_is_refused_as_in_torchrl(family, name) -> None:
    with pytest.raises(TypeError, match=r"make_value_estimator\(gamma=0.95\)"):
        family(name, gamma=0.95)
    networks = family.networks(name)
    with pytest.raises(TypeError):
        CQLLoss(networks.actor, networks.critics, gamma=0.95)


@pytest.mark.parametrize(
    ("argument", "advice"),
    [
        ("min_q_weight", "recovery_weight"),
        ("with_lagrange", "recovery_weight"),
        ("lagrange_thresh", "recovery_weight"),
        ("max_q_backup", "OSRLoss has other targets"),
        ("deterministic_backup", "OSRLoss has other targets"),
    ],
)
def test_osr_v_says_what_stands_in_the_place(family, argument, advice) -> None:
    with pytest.raises(TypeError, match=f"OSRVLoss takes no {argument}: .*{advice}"):
        family("osrv", **{argument: 1.0})


@BOTH
def test_the_temperature_stays_within_its_bounds(family, family_batch, name) -> None:
    loss, batch = family(name, min_alpha=0.1, max_alpha=0.2), family_batch(name, 10)
    for start, expected in ((1.0, 0.2), (0.01, 0.1), (0.15, 0.15)):
        loss.log_alpha.data.fill_(math.log(start))
        assert loss(batch)["alpha"].item() == pytest.approx(expected, rel=1e-6)
        # Brought back itself, so that the next step starts from the bound.
        assert loss.log_alpha.exp().item() == pytest.approx(expected, rel=1e-6)


@BOTH
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"min_alpha": 0.0}, "min_alpha must be above 0"),
        ({"max_alpha": -1.0}, "max_alpha must be above 0"),
        ({"min_alpha": 0.5, "max_alpha": 0.1}, "max_alpha must be at least 0.5"),
    ],
)
def test_bounds_of_the_temperature_out_of_range(
    family, name, options, expected
) -> None:
    with pytest.raises(ValueError, match=expected):
        family(name, **options)


@BOTH
def test_the_environments_bounds_are_the_actors(family, name) -> None:
    spec = Bounded(-1.0, 1.0, shape=(2,))
    for fitting in (spec, Composite(action=spec), Composite(agent={"action": spec})):
        family(name, action_spec=fitting)
    narrow = Bounded(-0.4, 0.4, shape=(2,), dtype=torch.float64)
    networks = family.networks(name, low=-0.4, high=0.4)
    family(name, networks, action_spec=narrow)
    with pytest.raises(ValueError, match=r"actor's high is 1.0, .*\[2.0, 2.0\]"):
        family(name, action_spec=Bounded(-1.0, 2.0, shape=(2,)))
    with pytest.raises(ValueError, match="must be a Bounded spec"):
        family(name, action_spec=Categorical(3))
    with pytest.raises(ValueError, match="holds 2 entries"):
        family(name, action_spec=Composite(action=spec, other=spec))


@BOTH
def test_a_delayed_actor_chooses_the_action_of_the_td_target(
    family, family_batch, seeded, name
) -> None:
    batch = family_batch(name, 10)
    plain, delayed = family(name), family(name, delay_actor=True)
    updater = SoftUpdate(delayed, tau=0.5)
    names = ("target_value", "loss_actor")
    before, same = seeded(plain, batch), seeded(delayed, batch)
    assert all(torch.equal(before[key], same[key]) for key in names)
    for loss in (plain, delayed):
        for parameter in loss.actor_network_params.parameters():
            parameter.data.mul_(1.5)
    moved, held = seeded(plain, batch), seeded(delayed, batch)
    assert torch.equal(held["target_value"], before["target_value"])
    assert not torch.equal(moved["target_value"], before["target_value"])
    assert torch.equal(held["loss_actor"], moved["loss_actor"])
    updater.step()
    for target, source, old in zip(
        delayed.target_actor_network_params.values(True, True),
        delayed.actor_network_params.values(True, True),
        family(name).actor_network_params.values(True, True),
        strict=True,
    ):
        torch.testing.assert_close(target.data, (source.data + old.data) / 2)


# TorchRL 0.14.1 keeps a delayed actor that nobody reads.
def test_the_delayed_actor_of_cql_is_not_used(family, family_batch, seeded) -> None:
    networks, batch = family.networks("cql"), family_batch("cql", 10)
    loss = CQLLoss(
        networks.actor, networks.critics, target_entropy=-2.0, delay_actor=True
    ).double()
    SoftUpdate(loss, tau=0.5)
    before = seeded(loss, batch.clone())["loss_qvalue"]
    for parameter in loss.target_actor_network_params.values(True, True):
        parameter.data.mul_(1.5)
    assert torch.equal(seeded(loss, batch.clone())["loss_qvalue"], before)


def test_bounds_do_not_disturb_the_gradient(family, family_batch, seeded) -> None:
    batch = family_batch("osr", 10)
    free, bounded = family("osr"), family("osr", min_alpha=0.1, max_alpha=0.9)
    for loss in (free, bounded):
        seeded(loss, batch)["loss_alpha"].backward()
    assert torch.equal(free.log_alpha.grad, bounded.log_alpha.grad)
