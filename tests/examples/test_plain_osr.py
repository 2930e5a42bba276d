"""The plain page computes what OSRLoss and InverseDynamicsLoss compute."""

from __future__ import annotations

import runpy
from types import SimpleNamespace

import pytest
import torch
from objectives.losses import make_batch
from processes import EXAMPLES
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, modules

page = SimpleNamespace(**runpy.run_path(str(EXAMPLES / "plain_osr.py")))

# Observation, action, hidden layers and batch; the first two are make_batch's.
S, A, CELLS, B, K = 3, 2, [8, 8], 10, 4
LOSSES = ["loss_actor", "loss_alpha", "loss_qvalue", "loss_cql"]


@pytest.fixture(params=[False, True], ids=["plain", "layer norm"])
def both(request):
    """Both with the same weights, target critics and temperatures off the start."""
    # Numbers as bounds would be float32, and the actions equal to 1e-8 only.
    bounds = {"low": -torch.ones(A).double(), "high": torch.ones(A).double()}
    actor = modules.tanh_gaussian_actor(S, A, num_cells=CELLS, **bounds)
    norm = {"layer_norm": request.param}
    critics = modules.critic_ensemble(S, A, num_cells=CELLS, **norm)
    model = modules.tanh_gaussian_inverse_dynamics(S, A, num_cells=CELLS, **bounds)
    plain = page.PlainOSR(S, A, CELLS, num_random=K, **norm)
    pairs = [(actor, plain.actor), (model, plain.inverse_dynamics)]
    pairs += [*zip(critics, plain.critics, strict=True)]
    pairs += [*zip(critics, plain.targets, strict=True)]
    for source, copied in pairs:
        theirs = zip(copied.double().parameters(), source.parameters(), strict=True)
        for parameter, value in theirs:
            parameter.data.copy_(value.data)
    loss = OSRLoss(actor, critics, model, num_random=K, alpha_init=0.3).double()
    loss.make_value_estimator(gamma=plain.gamma)
    plain.gamma = loss.value_estimator.gamma.item()  # TorchRL keeps it in float32
    updater = SoftUpdate(loss, tau=plain.tau)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(0.8))
    for target in plain.targets:
        for parameter in target.parameters():
            parameter.data.mul_(0.8)
    plain.log_alpha.data = loss.log_alpha.data.clone()
    return loss, updater, plain, model


def draw_as_ours(*_):
    """Torch's draws in the order in which OSRLoss makes them, K before B there."""

    def swap(noise: torch.Tensor) -> torch.Tensor:
        return noise.transpose(0, 1).reshape(-1, A)

    like = {"dtype": torch.float64}
    actor = torch.randn(2 * B, A, **like)
    uniform = 2 * torch.rand(K, B, A, **like) - 1
    proposals = torch.randn(K, 2, B, A, **like)
    target = torch.randn(B, A, **like)
    return page.Noise(
        actor, target, swap(uniform), swap(proposals[:, 0]), swap(proposals[:, 1])
    )


def test_losses_and_updates_equal_ours(both, check):
    loss, updater, plain, _ = both
    optimizer = torch.optim.Adam(loss.parameters(), lr=plain.rate)
    plain.draw = draw_as_ours
    for seed in range(3):
        torch.manual_seed(seed)
        batch = make_batch("osr", B)
        losses = loss(batch)
        torch.manual_seed(seed)
        reference = plain.losses(page.unpack(batch), draw_as_ours())
        assert set(reference) == set(LOSSES)
        values = [[found[key] for key in LOSSES] for found in (losses, reference)]
        check("plain OSR", *values, tolerance=1e-6 if seed else 1e-12)
        sum(losses[key] for key in LOSSES).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        torch.manual_seed(seed)
        plain.update(page.unpack(batch))
    got = list(loss.actor_network_params.values(True, True))
    wanted = list(plain.actor.parameters())
    for params, critics in (
        (loss.qvalue_network_params, plain.critics),
        (loss.target_qvalue_network_params, plain.targets),
    ):
        got += params.values(True, True)
        pairs = zip(*(critic.parameters() for critic in critics), strict=True)
        wanted += [torch.stack(pair) for pair in pairs]
    check("plain OSR, after three updates", got, wanted, tolerance=1e-6)


def test_inverse_dynamics_loss_equals_ours(both, check):
    *_, plain, model = both
    batch = make_batch("osr", B)
    ours = InverseDynamicsLoss(model.double())(batch)["loss_inverse_dynamics"]
    reference = plain.inverse_dynamics_loss(page.unpack(batch))
    check("plain inverse dynamics", [ours], [reference], tolerance=1e-12)


def test_toy_runs(capsys):
    page.main()
    assert "loss_qvalue" in capsys.readouterr().out
