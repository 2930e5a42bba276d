"""Several runs in one update: each ends with the numbers of its single run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers import CSVLogger

from torchrl_osr import StatePerturbation
from torchrl_osr.evaluation import read_scalars
from torchrl_osr.trainers import OfflineTrainer, train_together
from torchrl_osr.trainers.member_noise import MemberNoise

STEPS, TOLERANCE = 20, 1e-9
# What members may have for themselves, all of it at once.
WEIGHTS, RATES = (0.5, 1.0, 0.1), (1e-2, 3e-3, 1e-2)
STDS, TAUS, GAMMAS = (0.1, 0.01, 0.3), (0.1, 0.2, 0.1), (0.9, 0.9, 0.99)


@pytest.fixture(autouse=True)
def _in_float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def make(runs):
    """Return a factory of trainers: those of one index are the same run."""

    def make(folder: Path, index: int, name: str = "OSR", **options) -> OfflineTrainer:
        loss_options = dict(options.pop("loss_options", {}))
        if name in ("OSR", "OSR-v", "OSR-10"):
            loss_options = {"recovery_weight": WEIGHTS[index]} | loss_options
        loss = runs.make_loss(name, **loss_options)
        torch.manual_seed(index)
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        updater = None
        if name != "inverse dynamics":
            loss.make_value_estimator(gamma=GAMMAS[index])
            updater = SoftUpdate(loss, tau=TAUS[index])
        perturbation = StatePerturbation(STDS[index], seed=index)
        data = runs.make_data("cpu")
        data = data.apply(lambda x: x.double() if x.is_floating_point() else x)
        storage = options.pop("storage", None) or TensorStorage(data)
        buffer = ReplayBuffer(storage=storage, batch_size=8, transform=perturbation)
        options = {
            "total_steps": STEPS,
            "seed": index,
            "target_net_updater": updater,
            # An evaluation that draws from the global generator.
            "evaluate": lambda: {"score": torch.rand(()).item()},
            "components": {"perturbation": perturbation},
            "loggers": [CSVLogger("csv", log_dir=str(folder))],
            "log_interval": 4,
            "eval_interval": 6,
            "checkpoint_interval": 5,
            "progress": False,
        } | options
        adam = torch.optim.Adam(loss.parameters(), lr=RATES[index], fused=True)
        return OfflineTrainer(loss, adam, buffer, folder=folder / "ckpt", **options)

    return make


def run(make, folder, index, *arguments, then=lambda trainer: None, **options):
    """Yield the trainer of a member, as a script would; return it."""
    torch.manual_seed(100 + index)
    torch.rand(index)  # a state that no other member has
    trainer = make(folder / str(index), index, *arguments, **options)
    then(trainer)
    yield trainer
    return trainer


def train_alone(make, folder, index, *arguments, **options) -> OfflineTrainer:
    (trainer,) = train_together([run(make, folder, index, *arguments, **options)])
    return trainer


def train_all(make, folder, *arguments, indices=range(3), **options):
    members = [run(make, folder, each, *arguments, **options) for each in indices]
    return train_together(members)


def logged(trainer: OfflineTrainer) -> dict:
    folder = trainer.rotation.directory.parent / "csv" / "scalars"
    return read_scalars(folder / trainer.description)


def assert_same(runs, check, together, alone) -> None:
    """Compare networks, targets, Adam's state, generators, logs and history."""
    *mine, _ = runs.state(together)
    *theirs, _ = runs.state(alone)
    *mine, sampler, perturbation = mine
    *theirs, there, noise = theirs
    assert torch.equal(sampler, there)
    assert torch.equal(perturbation, noise)
    check("state", mine, theirs, tolerance=TOLERANCE)
    assert together.history == alone.history
    here, there = logged(together), logged(alone)
    assert here.keys() == there.keys()
    for name, rows in there.items():
        # float32 in the logs
        wanted = [pytest.approx(value, rel=1e-5, abs=1e-6) for _, value in rows]
        assert [value for _, value in here[name]] == wanted, name
        assert [step for step, _ in here[name]] == [step for step, _ in rows]


CASES = {
    "OSR": ("OSR", {"chunk_size": 64}),
    "OSR, layer norm": ("OSR", {"chunk_size": 64, "layer_norm": True}),
    "OSR-v": ("OSR-v", {}),
    "OSR-10": ("OSR-10", {}),
    "CQL": ("CQL", {}),
    "EDAC": ("EDAC", {}),
    "adversarial": ("adversarial", {}),
    "mse": ("inverse dynamics", {"loss_function": "mse"}),
    "nll": ("inverse dynamics", {}),
}


@pytest.mark.parametrize("case", CASES)
def test_each_member_ends_as_its_single_run(tmp_path, make, runs, check, case):
    name, loss_options = CASES[case]
    options = {"loss_options": loss_options, "checkpoint_interval": STEPS}
    before = torch.get_rng_state()
    members = train_all(make, tmp_path / "all", name, **options)
    assert torch.equal(torch.get_rng_state(), before)
    for index in (2, 1):
        alone = train_alone(make, tmp_path / "alone", index, name, **options)
        assert_same(runs, check, members[index], alone)
    ends = [next(each.loss_module.parameters()) for each in members]
    assert not torch.allclose(ends[0], ends[1])


def break_off(step: int):
    """Return what makes a trainer fail in the middle of an update."""

    def then(trainer: OfflineTrainer) -> None:
        def fail(batch):
            if trainer.step > step:
                raise KeyboardInterrupt
            return batch

        trainer.register_op("process_optim_batch", fail)

    return then


@pytest.fixture
def killed(tmp_path, make) -> Path:
    """Return the folder of a population that was killed in its 13th update."""
    with pytest.raises(KeyboardInterrupt):
        train_all(make, tmp_path / "all", then=break_off(12))
    return tmp_path / "all"


def newest(folder: Path, index: int) -> str:
    return max(path.name for path in (folder / str(index) / "ckpt").glob("check*"))


def test_killed_members_continue_together_from_where_each_is(
    tmp_path, make, runs, check, killed
):
    # The kill came while checkpoints were written: one member has not got its own.
    assert newest(killed, 0) == "checkpoint-000000000010.torchrl"
    (killed / "0" / "ckpt" / newest(killed, 0)).unlink()
    members = train_all(make, killed)
    for index, member in enumerate(members):
        alone = train_alone(make, tmp_path / "alone", index)
        *mine, _ = runs.state(member)
        *theirs, _ = runs.state(alone)
        floating = [
            (a, b) for a, b in zip(mine, theirs, strict=True) if a.is_floating_point()
        ]
        check("state", *zip(*floating, strict=True), tolerance=TOLERANCE)
        assert member.history == alone.history
    # And once more, when all is done.
    assert train_all(make, killed)[2].history == members[2].history


def test_member_continues_alone_and_joins_again(tmp_path, make, runs, check, killed):
    """A member's checkpoint is a single run's: no other file is needed."""
    continued = train_alone(make, killed, 1)
    alone = train_alone(make, tmp_path / "alone", 1)
    *mine, _, _, _ = runs.state(continued)
    *theirs, _, _, _ = runs.state(alone)
    check("state", mine, theirs, tolerance=TOLERANCE)
    assert continued.history == alone.history
    joined = train_all(make, killed)
    assert [each.step for each in joined] == [STEPS] * 3
    assert joined[1].history == alone.history


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"total_steps": 21}, "total_steps: 20 and 21"),
        ({"eval_interval": 7}, "eval"),
        ({"loss_options": {"num_random": 3}}, "num_random: 2 and 3"),
        ({"loss_options": {"recovery_weight": 0.0}}, "recovers: True and False"),
        ({"loss_options": {"temperature": 2.0}}, "temperature: 1.0 and 2.0"),
        ({"loss_options": {"layer_norm": True}}, "qvalue_network_params"),
        ({"name": "OSR-v"}, "class: OSRLoss and OSRVLoss"),
        ({"autocast_dtype": torch.bfloat16}, "autocast_dtype"),
        ({"nonfinite": "skip"}, "nonfinite=skip: False and True"),
    ],
)
def test_members_that_differ_are_refused_by_name(tmp_path, make, options, named):
    members = [run(make, tmp_path, 0), run(make, tmp_path, 1, **options)]
    with pytest.raises(ValueError, match=f"members 0 and 1 .*{named}"):
        train_together(members)


def log_each(trainer: OfflineTrainer) -> None:
    trainer.register_op("post_optim_log", lambda _: {})


def draw_from_default(trainer: OfflineTrainer) -> None:
    def draw(batch):
        torch.rand(3)
        return batch

    trainer.register_op("process_optim_batch", draw)


@pytest.mark.parametrize(
    ("then", "error", "named"),
    [
        (
            lambda trainer: trainer.loss_module.compile(backend="eager"),
            ValueError,
            "compiled",
        ),
        (log_each, ValueError, "post_optim_log"),
        (draw_from_default, RuntimeError, "default generator"),
    ],
)
def test_what_a_population_cannot_do_is_named(tmp_path, make, then, error, named):
    with pytest.raises(error, match=named):
        train_all(make, tmp_path, then=then)


def test_buffers_with_one_storage_are_refused(tmp_path, make, runs):
    data = runs.make_data("cpu")
    data = data.apply(lambda x: x.double() if x.is_floating_point() else x)
    with pytest.raises(RuntimeError, match="storage of its own"):
        train_all(make, tmp_path, storage=TensorStorage(data))


def test_a_failed_member_ends_every_run_with_the_reason(tmp_path, make):
    reasons = []

    def noted(index):
        try:
            yield from run(make, tmp_path, index)
        except FloatingPointError as error:
            reasons.append(str(error))
            raise

    def spoiled(index):
        trainer = make(tmp_path / str(index), index)
        trainer.loss_module.min_q_weight = float("nan")
        yield trainer

    with pytest.raises(FloatingPointError, match="member 1: .* losses loss_cql"):
        train_together([noted(0), spoiled(1), noted(2)])
    assert len(reasons) == 2
    assert "loss_cql" in reasons[0]
    assert not list(tmp_path.glob("1/ckpt/checkpoint-*"))


@pytest.mark.parametrize("captured", [False, True])
def test_a_member_skips_its_own_updates(tmp_path, make, runs, graphs, check, captured):
    def poison(trainer: OfflineTrainer) -> None:
        count = torch.zeros(())

        def spoil(batch):
            count.add_(1)
            reward = batch["next", "reward"].masked_fill(count == 7, torch.nan)
            return batch.set(("next", "reward"), reward)

        trainer.register_op("process_optim_batch", spoil)

    members = [
        run(make, tmp_path, 0, nonfinite="skip", cudagraph=captured),
        run(make, tmp_path, 1, nonfinite="skip", cudagraph=captured, then=poison),
    ]
    first, second = train_together(members)
    assert (first.guard.skipped, second.guard.skipped) == (0, 1)
    (alone,) = train_together(
        [run(make, tmp_path / "alone", 1, nonfinite="skip", then=poison)]
    )
    assert_same(runs, check, second, alone)


def test_runs_of_different_lengths_are_refused(tmp_path, make):
    def longer(index):
        yield from run(make, tmp_path / "first", index, total_steps=1)
        yield from run(make, tmp_path / "second", index)

    with pytest.raises(ValueError, match="different phases"):
        train_together([run(make, tmp_path, 0, total_steps=1), longer(1)])
    with pytest.raises(ValueError, match="at least one"):
        train_together([])


@pytest.mark.parametrize("shape", [(3,), (16,), (2, 5, 7)])
def test_members_draw_what_the_default_generator_would(shape):
    """For each function that losses call, in vmap, shape by shape."""

    def draws(like):
        return [
            torch.rand(shape),
            torch.randn(*shape, dtype=torch.float32),
            torch.rand_like(like),
            torch.randn_like(like, dtype=torch.float32),
            torch.empty(shape).normal_(),
            torch.normal(torch.zeros(shape), torch.full(shape, 2.0)),
        ]

    like = torch.zeros(3, *shape)
    generators = [torch.Generator().manual_seed(seed) for seed in range(3)]

    def one(member, like):
        with MemberNoise(member, generators):
            return draws(like)

    together = torch.vmap(one, randomness="error")(torch.arange(3), like)
    for seed in range(3):
        torch.manual_seed(seed)
        for mine, theirs in zip(together, draws(like[0]), strict=True):
            assert mine.dtype == theirs.dtype
            assert torch.equal(mine[seed], theirs)
        assert torch.equal(torch.get_rng_state(), generators[seed].get_state())


@pytest.mark.parametrize(
    "draw",
    [
        lambda: torch.randint(3, (2,)),
        lambda: torch.empty(3).uniform_(),
        lambda: torch.rand(3, generator=torch.Generator()),
        lambda: torch.bernoulli(torch.ones(2)),
    ],
)
def test_other_random_functions_are_refused(draw):
    generators = [torch.Generator() for _ in range(2)]

    def one(member):
        with MemberNoise(member, generators):
            return draw()

    with pytest.raises(RuntimeError, match="random operation"):
        torch.vmap(one, randomness="error")(torch.arange(2))


def test_what_is_filled_in_place_is_not_mistaken_for_noise():
    def one(member):
        with MemberNoise(member, [torch.Generator()]):
            filled = torch.zeros(3)
            filled.normal_()
            return filled

    out = torch.vmap(one, randomness="error")(torch.arange(1))
    assert out.isnan().all()


def test_population_is_captured_in_one_graph(tmp_path, make, runs, graphs, check):
    """On a stand-in for CUDA graphs: what is replayed is what would be done."""
    plain = train_all(make, tmp_path / "plain")
    captured = train_all(make, tmp_path / "captured", cudagraph=True)
    (graph,) = graphs
    assert graph.replays == STEPS - 3
    for mine, theirs in zip(captured, plain, strict=True):
        assert_same(runs, check, mine, theirs)
