"""Train a policy with OSR on offline data: a whole run on one page.

    python examples/offline_osr.py env=hopper
    python examples/offline_osr.py env=walker2d data=medium-expert loss=osr_v
    python examples/offline_osr.py -m env=hopper,walker2d seed=0,1,2
    python examples/offline_osr.py resume=<folder of a run> trainer.steps=40_000

Out-of-sample State Recovery keeps a policy close to the states of its data. An inverse
dynamics model learns which action leads from a state, clean or perturbed, to the next
state of the data. The policy learns to choose that action. In our runs this taught
little about pushes, see docs/results.md.

``torchrl-osr train`` makes the same run from the same parts, and has the other methods.
The configuration is in ``conf/``; ``--cfg job --resolve`` prints it.
"""

from __future__ import annotations

from functools import partial

import hydra
import torch
from omegaconf import DictConfig
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.cli.console import errors_as_sentences, single_job
from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.evaluation import inverse_dynamics_report
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.build import Learner
from torchrl_osr.lab.run.config import write_config
from torchrl_osr.lab.run.data import load_training_data
from torchrl_osr.lab.run.folder import Run, open_run
from torchrl_osr.lab.run.load import CHECKPOINTS, POLICY
from torchrl_osr.lab.run.schema import TrainConfig, register
from torchrl_osr.lab.run.train import (
    adam,
    averaged,
    evaluation,
    optimizer_of,
    prepare_machine,
    report,
    save_policies,
    saved,
    trainer_options,
)
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import Evaluation, OfflineTrainer, divergence_warning

LOSSES = {"torchrl_osr.OSRLoss": OSRLoss, "torchrl_osr.OSRVLoss": OSRVLoss}

register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="train")
@single_job
def main(cfg: DictConfig) -> float:
    """Check the configuration, hold the folder of the run, and train."""
    with open_run(cfg) as run:
        check_scope(run.config)
        return train(run)


def train(run: Run) -> float:
    """Train inverse dynamics model, critics and policy; return the last score."""
    config, folder = run.config, run.folder
    optim, sizes = config.optim, config.trainer
    device, autocast = prepare_machine(run)
    update = partial(FastUpdate, autocast_dtype=autocast, trace=sizes.record)

    # 1. Networks and loss: OSR (equations 2 and 11), or OSR-v (equation 8).
    torch.manual_seed(config.seed)
    spaces = config.env.observation_size, config.env.action_size
    cells, number = config.network.num_cells, config.loss["num_qvalue_nets"]
    actor = tanh_gaussian_actor(*spaces, num_cells=cells).to(device)
    critics = critic_ensemble(
        *spaces,
        num_qvalue_nets=number,
        num_cells=cells,
        layer_norm=config.network.layer_norm,
    )
    model = tanh_gaussian_inverse_dynamics(*spaces, num_cells=cells).to(device)
    loss_class = LOSSES[config.loss["_target_"]]
    loss = loss_class(actor, critics, model, **options_in(config.loss)).to(device)
    loss.make_value_estimator(gamma=optim.gamma)

    # 2. Data: transitions with standardised states, and a perturbed state for each
    # state. Both together are the paper's mixed data set D_tot.
    data = load_training_data(config, device)
    write_config(folder, config)  # with the checksum of the data
    perturbation = StatePerturbation(config.perturbation.std, seed=config.seed)
    data.buffer.append_transform(perturbation)

    # All trainers share these. A killed run continues from its last checkpoint.
    shared = trainer_options(run)
    kept = {"perturbation": perturbation, "observation_norm": saved(data.norm)}

    # 3. The inverse dynamics model, by maximum likelihood on D_tot.
    model_loss = InverseDynamicsLoss(model, **options_in(config.inverse_dynamics.loss))
    optimizer = adam(model_loss.parameters(), lr=optim.inverse_dynamics_lr)
    steps = sizes.inverse_dynamics_steps
    trainer = OfflineTrainer(
        update(model_loss, optimizer),
        data.buffer,
        steps,
        folder / "checkpoint" / "inverse_dynamics",
        seed=config.seed,
        components=kept,
        evaluation=Evaluation(
            lambda: inverse_dynamics_report(model, data.held_out), steps, "nll", "min"
        ),
        description="inverse_dynamics",
        **shared,
    )
    trainer.train()
    write_json(folder / "inverse_dynamics.json", trainer.history[-1])

    # 4. Critics and policy. One step: sample a batch, compute the losses, go backward
    # on their sum, step the optimizer, move the target networks and the average of the
    # policy's weights, which is evaluated and exported.
    values = list(loss.qvalue_network_params.parameters())
    known = set(values)
    policy = [each for each in loss.parameters() if each not in known]
    optimizer, schedule = optimizer_of(run, values, policy)
    targets = SoftUpdate(loss, tau=optim.tau)
    delay = {"policy_delay": optim.policy_delay, "policy_params": policy}
    average = averaged(actor, optim.policy_average)
    if optim.n_steps > 1:
        data.buffer.append_transform(take_multi_step)
    with evaluation(run, data.norm, average) as evaluate:
        trainer = OfflineTrainer(
            update(loss, optimizer, targets, **delay),
            data.buffer,
            sizes.steps,
            folder / CHECKPOINTS,
            seed=config.seed + 1,
            hooks=[
                # The policy of an earlier, shorter training.
                ("pre_optim_steps", partial((folder / POLICY).unlink, missing_ok=True)),
                divergence_warning(data.largest_reward, optim.gamma),
                ("post_optim", schedule.step),
                ("post_optim", partial(average.update_parameters, actor)),
            ],
            components=kept | {"schedule": schedule, "policy_average": average},
            evaluation=evaluate,
            description="policy",
            **shared,
        )
        trainer.train()

    # 5. Results: policy.safetensors, returns.json, curve.png and a table.
    save_policies(run, Learner(actor, model, loss=loss, objective=loss), data.norm)
    return report(run, data.data_mean, trainer)


def options_in(options: dict) -> dict:
    """Return the options of a class in the configuration."""
    return {name: value for name, value in options.items() if name != "_target_"}


def check_scope(config: TrainConfig) -> None:
    """Raise a ValueError for what this page leaves to ``torchrl-osr train``."""
    network, model = config.network, config.inverse_dynamics
    built = [network.actor, network.critic, model.network]
    ours = [tanh_gaussian_actor, critic_ensemble, tanh_gaussian_inverse_dynamics]
    if (
        config.loss["_target_"] not in LOSSES
        or built != [{"_target_": f"torchrl_osr.modules.{x.__name__}"} for x in ours]
        or config.recovery is not None
        or config.dynamics.use
        or config.trainer.compile
        or config.env.discrete
    ):
        raise ValueError(
            "this page trains loss=osr or osr_v with default networks and continuous "
            "actions, without recovery, dynamics or compile: use torchrl-osr train."
        )


if __name__ == "__main__":
    with errors_as_sentences():
        main()
