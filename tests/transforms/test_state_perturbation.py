"""The perturbed state: its noise, what it leaves alone, and where it may be used."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_osr import StatePerturbation

PERTURBED = ("perturbed", "observation")


def observations(*size: int, value: float = 0.0) -> TensorDict:
    state = torch.full((*size, 11), value, dtype=torch.float64)
    return TensorDict({"observation": state}, size)


def noise(transform: StatePerturbation, *size: int) -> torch.Tensor:
    return transform(observations(*size))[PERTURBED]


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
def test_noise_has_the_given_standard_deviation(kind) -> None:
    size, std = 100_000, 1e-3
    drawn = noise(StatePerturbation(std, noise=kind, seed=0), size) / std
    # Var(x^2) is 2 for the Gaussian, 9/5 - 1 for the uniform of variance 1.
    error = ((2.0 if kind == "gaussian" else 0.8) / drawn.numel()) ** 0.5
    assert abs(drawn.square().mean().item() - 1) < 3 * error
    assert abs(drawn.mean().item()) < 3 / drawn.numel() ** 0.5
    bound = drawn.abs().max().item()
    # The half-width of that uniform is sqrt(3).
    assert bound > 4 if kind == "gaussian" else 1.73 < bound < 3**0.5


def test_all_else_is_untouched_and_nothing_happens_in_place(make_batch) -> None:
    batch = make_batch(10).exclude("perturbed")
    before, pointer = batch.clone(), batch["observation"].data_ptr()
    out = StatePerturbation(0.1)(batch)
    assert set(out.keys(True, True)) - set(before.keys(True, True)) == {PERTURBED}
    assert (out.select(*before.keys(True, True)) == before).all()
    assert out["observation"].data_ptr() == pointer != out[PERTURBED].data_ptr()
    assert not torch.equal(out[PERTURBED], out["observation"])


def test_zero_noise_gives_identical_values() -> None:
    batch = observations(7, value=0.1)
    perturbed = StatePerturbation(0.0)(batch)[PERTURBED]
    assert torch.equal(perturbed, batch["observation"])
    assert perturbed is not batch["observation"]


def test_seed_decides_the_noise() -> None:
    first, same, other = (StatePerturbation(0.1, seed=seed) for seed in (5, 5, 6))
    drawn = noise(first, 8)
    assert torch.equal(drawn, noise(same, 8))
    assert not torch.equal(drawn, noise(other, 8))
    assert not torch.equal(drawn, noise(first, 8))


def test_without_a_seed_torchs_initial_seed_decides() -> None:
    torch.manual_seed(12)
    first = StatePerturbation(0.1)
    torch.randn(3)
    second = StatePerturbation(0.1)
    torch.manual_seed(13)
    third = StatePerturbation(0.1)
    drawn = noise(first, 8)
    assert torch.equal(drawn, noise(second, 8))
    assert not torch.equal(drawn, noise(third, 8))


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
def test_global_generator_is_neither_read_nor_moved(kind) -> None:
    first, second = (StatePerturbation(0.1, seed=1, noise=kind) for _ in range(2))
    before = torch.get_rng_state()
    drawn = noise(first, 8)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(99)
    assert torch.equal(noise(second, 8), drawn)


def restored(transform: StatePerturbation) -> StatePerturbation:
    fresh = StatePerturbation(0.5, seed=77)
    fresh.load_state_dict(transform.state_dict())
    return fresh


@pytest.mark.parametrize("used", [True, False])
@pytest.mark.parametrize(
    "copied",
    [restored, copy.deepcopy, lambda transform: pickle.loads(pickle.dumps(transform))],
    ids=["state_dict", "deepcopy", "pickle"],
)
def test_copies_continue_the_noise_to_the_bit(copied, used) -> None:
    transform = StatePerturbation(0.1, seed=4)
    if used:
        noise(transform, 5)
    other = copied(transform)
    wanted = [noise(transform, 8) for _ in range(2)]
    assert all(torch.equal(noise(other, 8), each) for each in wanted)


@pytest.mark.parametrize("kind", [ReplayBuffer, TensorDictReplayBuffer])
def test_buffers_sample_perturbed_states_and_keep_their_storage(kind) -> None:
    transform = StatePerturbation(0.1, seed=0)
    buffer = kind(storage=LazyTensorStorage(20), batch_size=6, transform=transform)
    buffer.extend(observations(20, value=1.0).float())
    first, second = buffer.sample(), buffer.sample()
    assert first[PERTURBED].shape == (6, 11)
    assert (first["observation"] == 1).all()
    assert not torch.equal(first[PERTURBED], second[PERTURBED])
    head = buffer[:5]  # a view of the storage
    assert ((head[PERTURBED] - 1).abs() > 0).any()
    stored = buffer.storage[:]
    assert (stored["observation"] == 1).all()
    assert "perturbed" not in stored.keys()  # noqa: SIM118


def test_nested_and_several_keys_draw_apart() -> None:
    keys = ["observation", ("agent", "pixels")]
    batch = TensorDict(
        {"observation": torch.ones(4, 3), "agent": {"pixels": torch.ones(4, 3)}}, [4]
    )
    transform = StatePerturbation(1.0, in_keys=keys, perturbed=("noisy", "states"))
    out = transform(batch)
    assert transform.out_keys == [
        ("noisy", "states", "observation"),
        ("noisy", "states", "agent", "pixels"),
    ]
    one, other = (out[key] for key in transform.out_keys)
    assert not (one == 1).any()
    assert not (one == other).any()


def test_every_row_of_any_batch_shape_has_its_own_noise() -> None:
    drawn = noise(StatePerturbation(0.1), 2, 3)
    assert drawn.shape == (2, 3, 11)
    assert drawn.unique().numel() == drawn.numel()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype) -> None:
    batch = observations(4).to(dtype)
    assert StatePerturbation(0.1)(batch)[PERTURBED].dtype == dtype


def test_environment_specs_hold_the_perturbed_state() -> None:
    env = TransformedEnv(GymEnv("Pendulum-v1"), StatePerturbation(0.1))
    env.set_seed(0)
    check_env_specs(env)
    assert (
        env.observation_spec[PERTURBED].shape
        == env.observation_spec["observation"].shape
    )
    rollout = env.rollout(3)
    for entry in (rollout, rollout["next"]):
        gap = entry[PERTURBED] - entry["observation"]
        assert (gap != 0).all()
        assert gap.abs().max() < 1
    # Pendulum's observation is bounded; its perturbed state may leave the bounds.
    far = torch.full((3,), 100.0)
    assert not env.observation_spec["observation"].is_in(far)
    assert env.observation_spec[PERTURBED].is_in(far)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"std": -0.1}, "std must be at least 0, got -0.1"),
        ({"std": float("nan")}, "std must be at least 0, got nan"),
        ({"std": 0.1, "noise": "laplace"}, "got 'laplace'"),
        ({"std": float("inf")}, "std must be at least 0, got inf"),
    ],
)
def test_wrong_arguments_are_named(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        StatePerturbation(**arguments)


def test_missing_state_is_named_together_with_what_is_there() -> None:
    with pytest.raises(KeyError, match="'state'.*observation"):
        StatePerturbation(0.1, in_keys=["state"])(observations(4))


def test_integer_states_are_refused() -> None:
    batch = TensorDict({"observation": torch.zeros(4, 3, dtype=torch.uint8)}, [4])
    with pytest.raises(TypeError, match=r"'observation' must be floating point.*uint8"):
        StatePerturbation(0.1)(batch)


def test_compiled_transform_draws_the_same_noise() -> None:
    eager, traced = (StatePerturbation(0.1, seed=8) for _ in range(2))
    traced(observations(4))  # the generator is made in the first call
    noise(eager, 4)
    compiled = torch.compile(traced, backend="eager")
    assert torch.equal(compiled(observations(4))[PERTURBED], noise(eager, 4))
