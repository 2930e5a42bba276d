"""Targets that move in one call, against TorchRL's."""

from __future__ import annotations

import torch
from torchrl import objectives

from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.modules import critic_ensemble, deterministic_actor
from torchrl_osr.trainers import SoftUpdate


def test_targets_have_the_bits_of_torchrls(make_batch):
    moved = []
    for kind in (objectives.SoftUpdate, SoftUpdate):
        torch.manual_seed(0)
        sizes = {"num_cells": [8]}
        critics = critic_ensemble(3, 2, **sizes)
        loss = TD3BCLoss(deterministic_actor(3, 2, **sizes), critics).double()
        updater = kind(loss, tau=0.1)
        optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
        for _ in range(3):
            loss(make_batch(4))["loss_qvalue"].backward()
            optimizer.step()
            updater.step()
        moved.append(loss.target_qvalue_network_params.flatten_keys())
    ours, theirs = moved
    assert (ours == theirs).all()
    assert not (ours == loss.qvalue_network_params.flatten_keys()).all()
