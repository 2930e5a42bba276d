"""The perturbed state: its noise, what it leaves alone, and where it may be used."""

from __future__ import annotations

import copy
import itertools
import pickle

import numpy as np
import pytest
import torch
from objectives.losses import make_batch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_osr import StatePerturbation

PERTURBED = ("perturbed", "observation")


def observations(*size: int, value: float = 0.0) -> TensorDict:
    state = torch.full((*size, 11), value, dtype=torch.float64)
    return TensorDict({"observation": state}, size)


def noise(transform: StatePerturbation, *size: int) -> torch.Tensor:
    return transform(observations(*size))[PERTURBED]


def test_noise_has_the_standard_deviation_given_for_all_or_for_each_entry() -> None:
    for std in (np.float32(1e-3), [1e-3] * 10 + [3.0]):
        drawn = noise(StatePerturbation(std, seed=0), 100_000) / torch.tensor(std)
        # Var(x^2) is 2 for the Gaussian.
        assert (drawn.square().mean(0) - 1).abs().max() < 4 * (2 / 100_000) ** 0.5
        assert drawn.mean(0).abs().max() < 4 / 100_000**0.5
        assert drawn.abs().max().item() > 4
    message = r"std must be finite and at least 0, got -1\.0"
    with pytest.raises(ValueError, match=message):
        StatePerturbation(std=[0.1, -1.0])


def test_all_else_is_untouched_and_nothing_happens_in_place() -> None:
    batch = make_batch("osr", 10).exclude("perturbed")
    before, pointer = batch.clone(), batch["observation"].data_ptr()
    out = StatePerturbation(0.1)(batch)
    assert set(out.keys(True, True)) - set(before.keys(True, True)) == {PERTURBED}
    assert (out.select(*before.keys(True, True)) == before).all()
    assert out["observation"].data_ptr() == pointer != out[PERTURBED].data_ptr()
    assert not torch.equal(out[PERTURBED], out["observation"])


# -- streams --------------------------------------------------------------------------


def test_a_seed_decides_the_noise() -> None:
    drawn = [noise(StatePerturbation(1.0, seed=seed), 8) for seed in (5, 5, 6)]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    generator = torch.Generator().manual_seed(5)
    wanted = torch.randn(8, 11, generator=generator, dtype=torch.float64)
    assert torch.equal(drawn[0], wanted)


def of_serial_environments() -> list[torch.Tensor]:
    env = SerialEnv(
        3, lambda: TransformedEnv(GymEnv("Pendulum-v1"), StatePerturbation(1.0))
    )
    rows = env.reset()
    gaps = rows[PERTURBED] - rows["observation"]
    env.close()
    return list(gaps)


class Rows(torch.utils.data.Dataset):
    def __init__(self) -> None:
        self.transform = StatePerturbation(1.0, seed=3)

    def __len__(self) -> int:
        return 4

    def __getitem__(self, _: int) -> torch.Tensor:
        return noise(self.transform)


def of_workers() -> list[torch.Tensor]:
    rows = Rows()
    loader = torch.utils.data.DataLoader(
        rows, num_workers=2, multiprocessing_context="fork"
    )
    return [*[each[0] for each in loader], noise(rows.transform)]


def of_instances() -> list[torch.Tensor]:
    torch.manual_seed(12)
    drawn = [noise(StatePerturbation(1.0), 8) for _ in range(2)]
    return [*drawn, torch.randn(8, 11, dtype=torch.float64)]


def of_copies() -> list[torch.Tensor]:
    first = StatePerturbation(1.0, seed=3)
    noise(first, 2)
    second = copy.deepcopy(first)
    third, fourth = (pickle.loads(pickle.dumps(first)) for _ in range(2))
    every = first, second, first.clone(), copy.deepcopy(second), third, fourth
    return [noise(each, 8) for each in every]


@pytest.mark.parametrize(
    "draws", [of_instances, of_copies, of_serial_environments, of_workers]
)
def test_no_two_have_the_same_noise(draws) -> None:
    for one, other in itertools.combinations(draws(), 2):
        assert not (one == other).any()


def test_global_generator_is_neither_read_nor_moved() -> None:
    before = torch.get_rng_state()
    first = StatePerturbation(0.1)
    second = StatePerturbation(0.1, seed=first.seed)
    drawn = noise(first, 8)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(99)
    assert torch.equal(noise(second, 8), drawn)


@pytest.mark.parametrize("used", [True, False])
def test_a_restored_one_continues_the_noise_to_the_bit(used) -> None:
    transform, other = StatePerturbation(0.1, seed=4), StatePerturbation(0.5)
    if used:
        noise(transform, 5)
    other.load_state_dict(transform.state_dict())
    wanted = [noise(transform, 8) for _ in range(2)]
    assert all(torch.equal(noise(other, 8), each) for each in wanted)


# -- where it is used -----------------------------------------------------------------


def test_a_buffer_samples_perturbed_states_and_keeps_its_storage() -> None:
    transform, storage = StatePerturbation(0.1, seed=0), LazyTensorStorage(20)
    buffer = ReplayBuffer(storage=storage, batch_size=6, transform=transform)
    buffer.extend(observations(20, value=1.0).float())
    first, second = buffer.sample(), buffer.sample()
    assert first[PERTURBED].shape == (6, 11)
    assert (first["observation"] == 1).all()
    assert not torch.equal(first[PERTURBED], second[PERTURBED])
    stored = buffer.storage[:]
    assert (stored["observation"] == 1).all()
    assert "perturbed" not in stored.keys()  # noqa: SIM118


def test_nested_and_several_keys_draw_apart() -> None:
    pixels = torch.ones(4, 3).byte()  # integers become floats
    batch = TensorDict({"observation": torch.ones(4, 3), "agent": {"pixels": pixels}})
    batch.batch_size = [4]
    keys = ["observation", ("agent", "pixels")]
    transform = StatePerturbation(1.0, in_keys=keys, perturbed=("noisy", "states"))
    drawn = [transform(batch)["noisy", "states"][key] for key in keys]
    assert not any((each == 1).any() for each in drawn)
    assert torch.cat(drawn).unique().numel() == 24
    named = r"'agent' is a group.*\[\('agent', 'pixels'\)"
    with pytest.raises(ValueError, match=named):
        StatePerturbation(1.0, in_keys=("agent", "pixels"))(batch)


def test_environment_specs_hold_the_perturbed_state() -> None:
    env = TransformedEnv(GymEnv("Pendulum-v1"), StatePerturbation(0.1))
    env.set_seed(0)
    check_env_specs(env)
    rollout = env.rollout(3)
    for each in (rollout, rollout["next"]):
        gap = each[PERTURBED] - each["observation"]
        assert (gap != 0).all()
        assert gap.abs().max() < 1
    # Pendulum's observation is bounded; its perturbed state may leave the bounds.
    far = torch.full((3,), 100.0)
    env.base_env.guard = (each for each in ())  # cannot be copied
    assert env.transform.clone().parent is None
    assert not env.observation_spec["observation"].is_in(far)
    assert env.observation_spec[PERTURBED].is_in(far)


def test_compiled_transform_draws_the_same_noise() -> None:
    eager, traced = (StatePerturbation(0.1, seed=8) for _ in range(2))
    traced(observations(4))  # the generator is made in the first call
    noise(eager, 4)
    compiled = torch.compile(traced, backend="eager")
    assert torch.equal(compiled(observations(4))[PERTURBED], noise(eager, 4))
