"""Training on a GPU; left out where there is none."""

from __future__ import annotations

import json

import pytest
import torch
from fast.test_traced_update import LOSSES, assert_follows, make, pair
from objectives.losses import A, S, make_batch, make_loss, make_networks
from torchrl.objectives import SoftUpdate

from torchrl_osr import CQLLoss, load_policy
from torchrl_osr.fast import FastUpdate, NonfiniteError
from torchrl_osr.fast.update import hold_bounds
from torchrl_osr.lab.__main__ import main
from torchrl_osr.modules import tanh_gaussian_actor

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("name", [*LOSSES, "uneven bounds"])
def test_a_cuda_graph_has_the_bits_of_the_loss(name):
    if name == "uneven bounds":
        networks = make_networks("osr")
        low, high = torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0])
        networks.actor = tanh_gaussian_actor(S, A, low=low, high=high).double()
        loss, batch = make_loss("cql", networks), make_batch("cql", 6)
    else:
        loss, batch = make(name), make_batch(name, 6)
    loss, batch = loss.to("cuda"), batch.to("cuda")
    hold_bounds(loss)
    eager, graphed = pair(loss, batch)
    assert graphed.trace
    assert_follows(graphed, eager, loss, batch)


@pytest.mark.parametrize("name", ["bc", "iql", "rebrac", "td3-bc"])
def test_a_gpu_has_the_numbers_of_a_cpu(name):
    """Of losses without random numbers, which differ."""
    found = []
    for device in ("cpu", "cuda"):
        loss = make(name).to(device)
        if hasattr(loss, "policy_noise"):
            loss.policy_noise = 0.0
        losses = loss(make_batch(name, 6).to(device))
        found.append(losses.detach().cpu())
    torch.testing.assert_close(*found, rtol=1e-10, atol=1e-10)


def test_networks_on_a_gpu_are_enough():
    networks, batch = make_networks("osr"), make_batch("osr", 6).to("cuda")
    for each in (networks.actor, *networks.critics, networks.model):
        each.to("cuda")
    assert make_loss("osr", networks)(batch)["loss_cql"].is_cuda


def test_infinity_is_found_within_a_hundred_updates():
    loss, batch = make_loss("osr").to("cuda"), make_batch("osr", 5).to("cuda")
    optimizer = torch.optim.Adam(loss.parameters(), fused=True)
    update = FastUpdate(loss, optimizer, SoftUpdate(loss, tau=0.1), warm_up=5)
    losses = [update(batch.clone())["loss_qvalue"] for _ in range(20)]
    assert len({float(each) for each in losses}) == 20  # they are not overwritten
    batch["next", "reward"] *= torch.inf
    for _ in range(79):
        update(batch.clone())
    with pytest.raises(NonfiniteError, match="loss_qvalue"):
        update(batch.clone())


@pytest.mark.parametrize("loss", ["osr", "iql", "td3_bc"])
def test_a_run_trains_resumes_and_loads_on_a_cpu(tmp_path, loss):
    steps = ["trainer.steps=300", "trainer.inverse_dynamics_steps=200"]
    sizes = ["data.num_transitions=3000", "trainer.eval_episodes=1"]
    often = ["trainer.checkpoint_interval=150", "trainer.eval_interval=150"]
    given = ["env=hopper", "data=random", f"loss={loss}", "trainer.device=cuda"]
    command = ["train", *given, *steps, *sizes, *often, f"hydra.run.dir={tmp_path}/run"]
    main(command)
    history = json.loads((tmp_path / "run" / "returns.json").read_text())
    assert history
    main(["train", f"resume={tmp_path}/run", "trainer.steps=450"])
    assert "without a trace" not in (tmp_path / "run" / "train.log").read_text()
    assert load_policy(tmp_path / "run").act(torch.zeros(11)).shape == (3,)


def test_a_loss_that_waits_for_the_gpu_trains_untraced(caplog):
    class Waits(CQLLoss):
        def losses(self, batch):
            losses, metrics = super().losses(batch)
            return losses, metrics | {"pred_value": torch.tensor(float(batch.a.sum()))}

    networks = make_networks("cql")
    loss = Waits(networks.actor, networks.critics).to("cuda")
    update = FastUpdate(loss, torch.optim.Adam(loss.parameters()), warm_up=1)
    for _ in range(5):
        losses = update(make_batch("cql", 6).to("cuda"))
    assert losses.isfinite().all()
    assert "Waits runs without a trace" in caplog.text
