"""A run with a dynamics model: trained once, kept with what it fits, resumed."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import SMALL, composed
from tensordict import TensorDict

from torchrl_osr.lab.cli import train
from torchrl_osr.lab.data.store.cache import cache_root
from torchrl_osr.lab.dynamics import ImaginedReplayBuffer, turned
from torchrl_osr.lab.dynamics.training import (
    FILE,
    Phase,
    dynamics_model,
    imagined_replay_buffer,
    load_dynamics,
)
from torchrl_osr.lab.run import run_folder
from torchrl_osr.lab.run.build import check_parts, dynamics_options, make_learner
from torchrl_osr.lab.run.published import check_published
from torchrl_osr.lab.run.trained_run import load_trained
from torchrl_osr.lab.run.training_data import load_training_data, model_data
from torchrl_osr.policy.tensor_file import read_tensors, write_tensors
from torchrl_osr.trainers import OfflineTrainer

CPU = torch.device("cpu")
TINY = [
    *SMALL,
    "loss=mopo",
    "dynamics.num_networks=3",
    "dynamics.num_elites=2",
    "dynamics.num_cells=[8]",
    "dynamics.batch_size=8",
    "dynamics.steps=20",
    "dynamics.vae_num_cells=[8]",
    "dynamics.vae_steps=10",
    "dynamics.rollout_starts=20",
    "dynamics.rollout_interval=4",
    "dynamics.generations=2",
    "dynamics.real_ratio=0.25",
    "trainer.steps=14",
    "trainer.eval_interval=100",
    "trainer.checkpoint_interval=7",
]

pytestmark = pytest.mark.usefixtures("own_cache")


def small(*overrides: str):
    return composed("train", *TINY, *overrides)


def buffer_of(cfg, data, model, actor) -> ImaginedReplayBuffer:
    return imagined_replay_buffer(
        dynamics_options(cfg), model_data(cfg, data), model, actor, lambda batch: batch,
        batch_size=cfg.trainer.batch_size, gamma=cfg.optim.gamma,
        n_steps=cfg.optim.n_steps, seed=cfg.seed,
    )  # fmt: skip


def trained_model(folder: Path) -> dict[str, torch.Tensor]:
    """The dynamics model in a run's newest checkpoint."""
    path = max((folder / "checkpoint" / "policy").glob("checkpoint-*.torchrl"))
    with zipfile.ZipFile(path) as archive:
        (name,) = (
            each for each in archive.namelist()
            if "adversary" in each and each.endswith(".pt")
        )  # fmt: skip
        content = io.BytesIO(archive.read(name))
    model: dict[str, torch.Tensor] = torch.load(content, weights_only=True)["model"]
    return model


def ran(folder: Path, *overrides: str) -> Path:
    folder.mkdir(exist_ok=True)
    cfg = small(*overrides)
    with run_folder.claimed(folder, cfg, {}), run_folder.status(folder):
        train.run(cfg, folder)
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, own_cache) -> Path:
    return ran(tmp_path_factory.mktemp("finished") / "run")


def scalars(folder: Path, phase: str = "policy") -> dict[str, list[list[str]]]:
    found = {}
    for path in sorted((folder / "csv" / "scalars" / phase).glob("*.csv")):
        with path.open() as file:
            found[path.stem] = list(csv.reader(file))
    return found


def test_run_leaves_model_report_and_numbers(finished) -> None:
    report = json.loads((finished / "dynamics.json").read_text())
    assert [each["steps"] for each in report["rollout"]] == [1, 2, 5, 10, 20]
    model = load_dynamics(finished / "dynamics.safetensors")
    assert (model.observation_dim, model.action_dim, model.num_networks) == (11, 3, 3)
    assert len(model.elites) == 2
    rows = load_training_data(small(), CPU).held_out
    mean, _ = model.predict(rows["observation"], rows["action"])
    assert model.disagreement(mean).max().item() == pytest.approx(
        report["largest_disagreement"]
    )
    assert {"imagined_refused", "imagined_reward"} <= scalars(finished).keys()
    assert not (finished / "inverse_dynamics.json").exists()
    # What evaluates a run needs no model.
    assert load_trained(finished).config.dynamics.use


RAMBO = ["loss=rambo", "dynamics.adversarial_steps=7", "dynamics.adversarial_weight=1"]
RECOVERY = ["recovery=osr", "trainer.inverse_dynamics_steps=3"]


def test_a_model_in_training_is_continued_with_the_same_bits(tmp_path) -> None:
    """Stopped in the middle of a generation, with OSR's recovery term added."""
    whole, folder = tmp_path / "whole", tmp_path / "run"
    ran(whole, *RAMBO, *RECOVERY)
    ran(folder, *RAMBO, *RECOVERY, "trainer.steps=6")
    ran(folder, *RAMBO, *RECOVERY)
    names = ("loss_qvalue", "loss_recovery", "imagined_reward", "adversary_objective")
    for name in names:
        assert scalars(folder)[name] == scalars(whole)[name], name
    models = [trained_model(each) for each in (whole, folder)]
    assert all(map(torch.equal, *(each.values() for each in models)))
    before = load_dynamics(whole / FILE).state_dict()
    assert not torch.equal(models[0]["layers.0.weight"], before["layers.0.weight"])
    here, there = (load_trained(each).loss.state_dict() for each in (whole, folder))
    for key, value in here.items():
        assert not torch.is_tensor(value) or torch.equal(value, there[key]), key


def test_a_weight_of_0_is_no_adversary_and_rows_may_be_on_disk(tmp_path) -> None:
    settings = ["dynamics.adversarial_weight=0", "data.storage=disk", "trainer.steps=2"]
    found = scalars(ran(tmp_path, *RAMBO, *RECOVERY, *settings))
    assert len(found["imagined_reward"]) == 2
    assert {"loss_recovery", "recovery_kl"} <= found.keys()
    assert "adversary_objective" not in found


@pytest.mark.parametrize("steps", [0, 3])
def test_rollouts_begin_in_states_of_the_data_or_beside_them(finished, steps) -> None:
    cfg = small(f"dynamics.disturbed_steps={steps}", "dynamics.unknown=refuse")
    data, model = load_training_data(cfg, CPU), load_dynamics(finished / FILE)
    actor = make_learner(cfg, 11, 3).actor
    buffer = buffer_of(cfg, data, model, actor)
    buffer.sample()
    starts = buffer.imagined["observation"][:15]
    known = data.buffer.storage.get(torch.arange(540))["observation"]
    there = (starts.unsqueeze(1) == known).all(-1).any(1)
    assert not there.any() if steps else there.all()


@pytest.mark.parametrize("noise", [0, 0.3])
def test_the_policys_own_actions_are_marked_and_may_have_noise(finished, noise) -> None:
    cfg = small("loss=td3_bc", "dynamics.use=true", f"dynamics.action_noise={noise}")
    data, model = load_training_data(cfg, CPU), load_dynamics(finished / FILE)
    actor = make_learner(cfg, 11, 3).actor
    buffer = buffer_of(cfg, data, model, actor)
    batch = buffer.sample()
    rows = batch[batch["imagined"].squeeze(-1)]
    assert len(rows) == round((1 - cfg.dynamics.real_ratio) * len(batch))
    apart = (rows["action"] - actor(rows.select("observation"))["action"]).abs()
    assert (0.01 < apart.max() < 2) if noise else (apart.max() < 1e-6)


def test_recovery_by_imagination_is_one_line(tmp_path) -> None:
    rim = ["loss=rim", "dynamics.real_ratio=0.5", "trainer.steps=2"]
    found = scalars(ran(tmp_path, *rim))
    assert {"cloning_error", "imagined_reward", "imagined_refused"} <= found.keys()


@pytest.mark.parametrize("shift", [0, -100])
def test_the_task_ends_where_the_model_knows_less_than_it_should(shift) -> None:
    # A freshly drawn model, and a share that leaves about half of the first rows.
    cfg = small(
        *("dynamics.unknown=halt", "dynamics.known_share=0.5"),
        *("dynamics.rollout_starts=400", f"data.reward_shift={shift}"),
        *("dynamics.penalty=0", "dynamics.terminations=never"),
    )
    data = load_training_data(cfg, CPU)
    torch.manual_seed(0)
    model, actor = dynamics_options(cfg).ensemble(11, 3), make_learner(cfg, 11, 3).actor
    buffer = buffer_of(cfg, data, model, actor)
    buffer.sample()
    first = buffer.imagined[: cfg.dynamics.rollout_starts]["next"]
    ended = first["terminated"].squeeze(-1)
    assert 0.3 < ended.float().mean() < 0.7
    worst = min(np.quantile(data.held_out["next", "reward"], 0.01), 0)
    assert (worst < -90) == (shift < 0)
    wanted = torch.full([int(ended.sum()), 1], worst / (1 - cfg.optim.gamma))
    torch.testing.assert_close(first["reward"][ended], wanted.float())


def test_the_task_ends_forward_alone_and_with_a_discount() -> None:
    with pytest.raises(ValueError, match="unknown=halt needs a forward"):
        check_parts(small("loss=romi", "dynamics.unknown=halt"), 11, 3)
    with pytest.raises(ValueError, match="gamma below 1"):
        check_parts(small("dynamics.unknown=halt", "optim.gamma=1"), 11, 3)


def test_disturbed_steps_are_forward() -> None:
    cfg = small("loss=romi", "dynamics.disturbed_steps=3")
    with pytest.raises(ValueError, match="disturbed_steps=3 needs a forward"):
        check_parts(cfg, 11, 3)


def test_rows_that_lead_into_the_data_are_imagined_backwards(tmp_path) -> None:
    romi = ["loss=romi", "dynamics.reverse_policy=cvae", "trainer.steps=2"]
    folder = ran(tmp_path, *romi)
    assert "imagined_reward" in scalars(folder)
    assert len(scalars(folder, "vae")["loss_vae"]) == 10
    # A model of one direction of time is none of the other.
    given = f"dynamics.path={folder / FILE}"
    with pytest.raises(ValueError, match="direction of time: backward there, forward"):
        modelled(tmp_path / "forward", given)
    cfg = small("loss=romi")
    data, model = load_training_data(cfg, CPU), load_dynamics(folder / FILE)
    actor = make_learner(cfg, 11, 3).actor
    buffer = buffer_of(cfg, data, model, actor)
    buffer.sample()
    rows = buffer.imagined
    # The first generation's first rows, with any action, end in states of the data.
    ends, known = (
        rows["next", "observation"][:20],
        data.buffer.storage.get(torch.arange(540)),
    )
    same = (ends.unsqueeze(1) == known["observation"]).all(-1)
    assert same.any(1).all()
    assert rows["action"].abs().max() <= 1
    assert not rows["next", "terminated"].any()


def test_states_are_corrected_by_a_trained_autoencoder(tmp_path) -> None:
    folder = ran(tmp_path, "loss=sdc", "dynamics.real_ratio=1", "trainer.steps=2")
    assert {"deviation", "multiplier"} <= scalars(folder).keys()
    held = load_trained(folder).loss.transition_network_params
    assert held["target_scale"].ne(1).all()


def modelled(folder: Path, *overrides: str) -> list[OfflineTrainer]:
    """The phase of the model alone; returns its trainer, if one was needed."""
    folder.mkdir(exist_ok=True)
    cfg, trainers = small(*overrides), []

    def new_trainer(*arguments, **options) -> OfflineTrainer:
        trainers.append(OfflineTrainer(*arguments, progress=False, **options))
        return trainers[0]

    data = model_data(cfg, load_training_data(cfg, CPU))
    phase = Phase(folder, new_trainer, torch.optim.Adam, cfg.seed)
    names = "device", "precision", "matmul_precision", "compile"
    arithmetic = {name: cfg.trainer[name] for name in names}
    dynamics_model(
        dynamics_options(cfg), data, phase, name="hopper-random", arithmetic=arithmetic
    )
    return trainers


def test_a_model_is_trained_once(finished, tmp_path) -> None:
    assert not modelled(tmp_path / "again", "loss.alpha_init=0.5")
    trained, taken = (
        (each / FILE).read_bytes() for each in (finished, tmp_path / "again")
    )
    assert trained == taken
    assert modelled(tmp_path / "other", "seed=1")
    assert (tmp_path / "other" / FILE).read_bytes() != trained


def test_a_damaged_model_in_the_cache_is_trained_anew(tmp_path) -> None:
    before = {*(cache_root() / "dynamics").glob("*.safetensors")}
    assert modelled(tmp_path / "first", "seed=2")
    (cached,) = {*(cache_root() / "dynamics").glob("*.safetensors")} - before
    whole = cached.read_bytes()
    cached.write_bytes(whole[:-3])
    assert modelled(tmp_path / "second", "seed=2")
    assert cached.read_bytes() == whole


def test_weights_are_those_of_the_best_evaluation(tmp_path) -> None:
    (trainer,) = modelled(tmp_path, "dynamics.lr=0.3")
    errors = [row["mse"] for row in trainer.history]
    report = json.loads((tmp_path / "dynamics.json").read_text())
    assert min(errors) < errors[-1]
    assert report["mse"] == pytest.approx(min(errors))


def test_a_given_model_is_taken_if_it_fits_the_data(finished, tmp_path) -> None:
    given = [f"dynamics.path={finished / FILE}", "dynamics.num_cells=[5]"]
    assert not modelled(tmp_path / "same", *given)
    model = load_dynamics(tmp_path / "same" / FILE)
    assert model.layers[0].weight.shape[-1] == 8
    for override, named in {
        "data.num_transitions=500": "rows: 540 there, 450 here",
        "data.standardize=false": "observation scale: .*held-out rows: ",
    }.items():
        with pytest.raises(ValueError, match=f"was trained on other data.*{named}"):
            modelled(tmp_path / override, *given, override)


@pytest.mark.parametrize("content", [b"", b"no tensors at all", None])
def test_another_file_is_refused(finished, tmp_path, content) -> None:
    path = tmp_path / "model.safetensors"
    if content is None:
        write_tensors(path, {"weight": torch.zeros(2)}, {"kind": "policy"})
    else:
        path.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"model\.safetensors: .*dynamics\.safetensors"
    ):
        load_dynamics(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("elites", torch.tensor([1, 3]), "elites are none of its networks"),
        ("input_loc", torch.zeros(10**5), "layers do not fit together"),
        ("layers.0.weight", torch.zeros(10**5, 1), "layers do not fit together"),
        ("target_loc", torch.zeros(3), "size mismatch"),
    ],
)
def test_a_file_that_makes_no_model_is_refused(
    finished, tmp_path, name, value, message
) -> None:
    tensors, record = read_tensors(finished / FILE)
    tensors[name] = value
    stamps = ("checksum", "tensors_sha256", "format")
    record = {key: value for key, value in record.items() if key not in stamps}
    write_tensors(tmp_path / "model.safetensors", tensors, record)
    with pytest.raises(ValueError, match=message):
        load_dynamics(tmp_path / "model.safetensors")


def test_from_disk_the_same_model_is_trained(finished) -> None:
    here, there = (
        model_data(cfg, load_training_data(cfg, CPU))
        for cfg in (small(f"data.storage={each}") for each in ("memory", "disk"))
    )
    torch.testing.assert_close(here.pieces, there.pieces)
    around = here.reverse(), there.reverse()
    samples = []
    for data in (here, there, *around):
        rows = data.buffer(8)
        rows.set_rng(
            torch.Generator().manual_seed(0)
        )  # of the storage, which is shared
        samples.append(rows.sample())
    first, second, *turned_rows = samples
    torch.testing.assert_close(first, second)
    for each in turned_rows:
        torch.testing.assert_close(turned(each), first)
    # A piece of a trajectory, from its last state on.
    for key in (("next", "observation"), "observation"):
        step, other = around[0].pieces[0, 0], here.pieces[0, -1]
        torch.testing.assert_close(turned(step)[key], other[key])
    numbers = torch.tensor([3, 500, 7])
    torch.testing.assert_close(here.storage.get(numbers), there.storage.get(numbers))
    assert here.facts()["rows"] == there.facts()["rows"] == 540


def test_penalty_and_units_are_those_of_the_task(finished, tmp_path) -> None:
    """Imagined rewards lose the penalty in the task's units, whatever the data's."""
    found = {}
    for penalty in (0.0, 1.5):
        cfg = small(f"dynamics.penalty={penalty}", "dynamics.rollout_steps=1")
        data = load_training_data(cfg, CPU)
        torch.manual_seed(0)
        actor = make_learner(cfg, 11, 3).actor
        model = load_dynamics(finished / "dynamics.safetensors")
        buffer = buffer_of(cfg, data, model, actor)
        buffer.set_rng(torch.Generator().manual_seed(0))
        buffer.sample()
        found[penalty] = buffer.imagined
    free, lowered = found.values()
    assert torch.equal(free["next", "observation"], lowered["next", "observation"])
    _, scale = model.predict(free["observation"], free["action"])
    scale[..., :-1] *= data.norm.scale
    wanted = scale.square().sum(-1).sqrt().max(0).values
    lost = (free["next", "reward"] - lowered["next", "reward"]).squeeze(-1)
    torch.testing.assert_close(lost, 1.5 * wanted, rtol=1e-4, atol=1e-5)
    state = free["next", "observation"] * data.norm.scale + data.norm.loc
    fallen = (state[:, 0] <= 0.7) | (state[:, 1].abs() >= 0.2)
    assert torch.equal(free["next", "terminated"].squeeze(-1), fallen)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env=pointmaze-umaze", "data=diverse"], "no rule is known by which Point"),
        (["dynamics.num_elites=9"], "num_elites must be between 1 and num_networks=3"),
        (["dynamics.real_ratio=0.01"], "real_ratio=0.01 of 8 rows are 0"),
        (["loss=scas", "dynamics=reverse"], "asks where actions lead, and a model"),
        (["loss=romi", "dynamics.adversarial_steps=9"], "here none is: set it to 0"),
        ([*RAMBO, "dynamics.real_ratio=1"], "adversarial_steps=7 trains the model"),
        (
            ["loss=bc", "dynamics=ensemble", RAMBO[1]],
            "asks for the values of critics, and BCLoss has none",
        ),
    ],
)
def test_what_cannot_be_had_is_refused_before_the_data(overrides, message) -> None:
    with pytest.raises(ValueError, match=message):
        check_parts(small(*overrides), 11, 3)


def test_a_loss_has_the_trained_model_and_nothing_is_imagined(tmp_path) -> None:
    folder = ran(tmp_path, "loss=scas", "dynamics.real_ratio=1", "trainer.steps=2")
    assert "imagined_reward" not in scalars(folder)
    model = load_dynamics(folder / FILE)
    held = load_trained(folder).loss.dynamics_network_params
    for key, value in TensorDict.from_module(model).items(True, True):
        assert torch.equal(held[key], value), key
    # No task needs a rule for its end, where nothing is imagined.
    cfg = small("loss=scas", "dynamics.real_ratio=1", "env=pointmaze-umaze")
    check_parts(cfg, 11, 3)
    with pytest.raises(ValueError, match="needs a model of the dynamics: take dyn"):
        check_parts(small("loss=scas", "dynamics=none"), 11, 3)


def test_a_time_limit_alone_may_end_a_task() -> None:
    check_parts(
        small("env=pointmaze-umaze", "data=diverse", "dynamics.terminations=never"),
        11, 3,
    )  # fmt: skip


def test_roll_outs_are_as_published_for_a_data_set() -> None:
    found = {
        name: (cfg.dynamics.rollout_steps, cfg.dynamics.penalty)
        for name, cfg in {
            "replay": small("data=medium-replay", "env=walker2d"),
            "by id": small("data=medium", "env.id=HalfCheetah-v5"),
            "another": small("env.id=my:Arm-v0.1"),
            "given": small("dynamics.penalty=3", "dynamics.rollout_steps=2"),
        }.items()
    }
    assert found == {
        "replay": (1, 2.5),
        "by id": (5, 0.5),
        "another": (5, 2.5),
        "given": (2, 3.0),
    }
    assert not small("dynamics=none").dynamics.use
    plain = small("loss=rambo", "data=medium", "env=walker2d").dynamics
    assert (plain.rollout_steps, plain.adversarial_weight) == (5, 0.0)
    reverse = small("loss=romi", "env=halfcheetah").dynamics
    assert (reverse.rollout_steps, reverse.reverse_policy) == (1, "cvae")


def test_defaults_are_said(caplog) -> None:
    choices = {"loss": "mopo", "env": "hopper", "data": "random", "preset": "quick"}
    check_published(small(), choices)
    assert not caplog.records
    check_published(small("env.id=Pendulum-v1"), choices)
    assert "rollout_steps=5 and dynamics.penalty=2.5 are taken" in caplog.text


def test_settings_of_other_data_or_of_another_task_are_refused() -> None:
    choices = {"loss": "osr", "env": "hopper", "data": "random", "preset": "quick"}
    with pytest.raises(ValueError, match="data.source=expert .* give data=expert"):
        check_published(small("data.source=expert"), choices)
    choices["data"], cheetah = "medium-expert", "env.id=HalfCheetah-v5"
    with pytest.raises(ValueError, match="for hopper medium-expert.*env=halfcheetah"):
        check_published(small("data=medium-expert", cheetah), choices)
