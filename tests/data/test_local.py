from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data import check_dataset, load_local_dataset, local
from torchrl_osr.data.local import FORMAT_VERSION

ROWS = 300
FOLDER = f"hopper-random-{ROWS}-seed0"


def load(cache_dir: Path | None, **changes):
    request = {"num_transitions": ROWS, "cache_dir": cache_dir, "progress": False}
    return load_local_dataset("hopper", "random", **(request | changes))


@pytest.fixture
def collections(monkeypatch) -> list[str]:
    """Record each real collection."""
    calls: list[str] = []
    original = local.collect_level

    def recorded(env_name, level, *args, **kwargs):
        calls.append(level)
        return original(env_name, level, *args, **kwargs)

    monkeypatch.setattr(local, "collect_level", recorded)
    return calls


@pytest.fixture
def warnings_logged(monkeypatch) -> list[str]:
    messages: list[str] = []
    monkeypatch.setattr(local.torchrl_logger, "warning", messages.append)
    return messages


def test_second_load_reads_the_same_data(tmp_path, collections, warnings_logged):
    first, manifest = load(tmp_path)
    second, again = load(tmp_path)
    assert collections == ["random"]
    assert warnings_logged == []
    assert (first == second).all()
    assert manifest == again
    check_dataset(second)
    assert second.shape == (ROWS,)


def test_manifest_describes_the_set(tmp_path):
    data, manifest = load(tmp_path, seed=3)
    assert manifest == json.loads(
        (
            tmp_path / "local" / f"hopper-random-{ROWS}-seed3" / "manifest.json"
        ).read_text()
    )
    returns = np.array(manifest["episode_returns"])
    assert manifest["format_version"] == FORMAT_VERSION
    assert manifest["env_id"] == "Hopper-v5"
    assert (manifest["level"], manifest["seed"]) == ("random", 3)
    assert manifest["num_complete_episodes"] == len(returns) > 3
    assert manifest["return"]["mean"] == pytest.approx(returns.mean())
    assert manifest["return"]["max"] == returns.max()
    assert manifest["episode_length"]["min"] == min(manifest["episode_lengths"])
    # (mean - random) / (expert - random), the constants of D4RL.
    expected = 100 * (returns.mean() + 20.272305) / (3234.3 + 20.272305)
    assert manifest["normalized_score"] == pytest.approx(expected)
    assert set(manifest["versions"]) == {"numpy", "gymnasium", "mujoco"}
    cut = not data["next", "terminated"][-1].item()
    complete = int(data["next", "done"].sum()) - cut
    assert complete == len(returns)


def test_behaviour_files_are_recorded_by_checksum(tmp_path):
    _, manifest = load_local_dataset(
        "hopper", "medium-expert", num_transitions=20, cache_dir=tmp_path
    )
    assert set(manifest["behavior_sha256"]) == {"medium", "expert"}
    assert all(len(digest) == 64 for digest in manifest["behavior_sha256"].values())
    # Ten rows a policy complete no episode.
    assert manifest["return"] is None
    assert manifest["normalized_score"] is None


def test_environment_variable_moves_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path / "elsewhere"))
    load(None)
    assert (tmp_path / "elsewhere" / "local" / FOLDER / "data.npz").is_file()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format_version": 0}, "its format_version is 0, wanted"),
        ({"versions": {"numpy": "1.0"}}, "its versions is"),
        ({"seed": 9}, "its seed is 9, wanted 0"),
        ({"normalized_score": 99.0}, "the seal of its manifest.json is wrong"),
    ],
)
def test_a_manifest_that_does_not_fit_is_remade(
    tmp_path, collections, warnings_logged, change, reason
):
    first, _ = load(tmp_path)
    path = tmp_path / "local" / FOLDER / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    second, manifest = load(tmp_path)
    assert len(collections) == 2
    assert len(warnings_logged) == 1
    assert reason in warnings_logged[0]
    assert (first == second).all()
    assert manifest["seed"] == 0
    load(tmp_path)
    assert len(collections) == 2


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("data.npz", lambda content: content[:1000] + b"?" + content[1001:]),
        ("data.npz", lambda content: content[:1000]),
        ("manifest.json", lambda content: content[:50]),
        ("manifest.json", lambda content: b"[]"),
    ],
)
def test_a_damaged_file_is_remade(tmp_path, collections, warnings_logged, name, damage):
    first, _ = load(tmp_path)
    path = tmp_path / "local" / FOLDER / name
    path.write_bytes(damage(path.read_bytes()))
    second, _ = load(tmp_path)
    assert len(collections) == 2
    assert len(warnings_logged) == 1
    assert (first == second).all()


def test_a_missing_file_is_remade(tmp_path, collections, warnings_logged):
    load(tmp_path)
    (tmp_path / "local" / FOLDER / "data.npz").unlink()
    load(tmp_path)
    assert len(collections) == 2
    assert (
        "cannot be read" in warnings_logged[0] or "No such file" in warnings_logged[0]
    )


def test_a_folder_below_a_file_names_path_and_cure(tmp_path, collections):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OSError, match=r"TORCHRL_OSR_CACHE=.*cache_dir=.*file"
    ) as raised:
        load(tmp_path / "file" / "cache")
    assert isinstance(raised.value, NotADirectoryError)
    assert collections == []


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def full_disk(file, **_):
        file.write(b"half a file")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(local.np, "savez", full_disk)
        with pytest.raises(OSError, match=r"No space left.*free space.*cache_dir="):
            load(tmp_path)
    names = [path.name for path in (tmp_path / "local").iterdir()]
    assert names in ([], [f"{FOLDER}.lock"])
    data, _ = load(tmp_path)
    check_dataset(data)


def test_leftovers_of_a_killed_process_are_cleared(tmp_path, collections):
    leftover = tmp_path / "local" / f".{FOLDER}.new"
    leftover.mkdir(parents=True)
    (leftover / "data.npz").write_bytes(b"half a file")
    load(tmp_path)
    assert not leftover.exists()


def test_a_whole_set_is_read_without_writing(tmp_path, monkeypatch):
    load(tmp_path)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(local, "FileLock", refuse)
    data, _ = load(tmp_path)
    check_dataset(data)


CHILD = """
import sys
import torch
from torchrl_osr.data import local

torch.set_num_threads(1)
original = local.collect_level

def announced(*args, **kwargs):
    print("collected", flush=True)
    return original(*args, **kwargs)

local.collect_level = announced
print("ready", flush=True)
sys.stdin.readline()
data, manifest = local.load_local_dataset(
    "hopper", "medium", num_transitions=5000, cache_dir=sys.argv[1], progress=False
)
print(manifest["data_sha256"], data["observation"].double().sum().item(), flush=True)
"""


def test_two_processes_at_once_collect_once(tmp_path):
    children = [
        subprocess.Popen(
            [sys.executable, "-c", CHILD, str(tmp_path)],
            cwd=Path(__file__).parents[2],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for child in children:
        assert child.stdout.readline() == "ready\n"
    for child in children:
        child.stdin.write("go\n")
        child.stdin.flush()
    outputs = [child.communicate(timeout=60)[0].splitlines() for child in children]
    assert [child.returncode for child in children] == [0, 0]
    assert sum(lines.count("collected") for lines in outputs) == 1
    assert outputs[0][-1] == outputs[1][-1]


def test_unknown_names_list_what_exists(tmp_path):
    with pytest.raises(ValueError, match=r"'ant'.*halfcheetah, hopper, walker2d"):
        load_local_dataset("ant", "random", num_transitions=5, cache_dir=tmp_path)
    with pytest.raises(ValueError, match=r"'simple'.*random, medium, medium-replay"):
        load_local_dataset("hopper", "simple", num_transitions=5, cache_dir=tmp_path)


def sound_data(rows: int = 6) -> TensorDict:
    flags = {
        name: torch.zeros(rows, 1, dtype=torch.bool)
        for name in ("done", "terminated", "truncated")
    }
    following = {"observation": torch.ones(rows, 3), "reward": torch.zeros(rows, 1)}
    return TensorDict(
        {
            "observation": torch.ones(rows, 3),
            "action": torch.ones(rows, 2),
            "next": TensorDict(following | flags, [rows]),
        },
        [rows],
    )


def test_sound_data_pass_the_guard():
    check_dataset(sound_data())


OBSERVATION, NEXT = "observation", ("next", "observation")


@pytest.mark.parametrize("key", [OBSERVATION, NEXT, "action"])
def test_all_zero_fields_are_named_with_the_usual_culprit(key):
    data = sound_data()
    data.get(key).zero_()
    with pytest.raises(ValueError, match=r"zero in all 6 rows.*Minari") as raised:
        check_dataset(data)
    assert repr(key) in str(raised.value)


@pytest.mark.parametrize("key", [OBSERVATION, NEXT, "action", ("next", "reward")])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_counted(key, value):
    data = sound_data()
    data.get(key)[1:3] = value
    with pytest.raises(ValueError, match=r"NaN or infinity in 2 of 6 rows") as raised:
        check_dataset(data)
    assert repr(key) in str(raised.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (NEXT, torch.ones(6, 4), r"\[6, 4\]; expected \[6, 3\]"),
        ("action", torch.ones(6), r"'action' has shape \[6\]; expected \[6, D\]"),
        (("next", "reward"), torch.ones(6), r"'reward'\) has shape \[6\]; .*\[6, 1\]"),
        (("next", "done"), torch.zeros(6, 1), r"'done'\) has type torch.float32"),
        (("next", "done"), torch.ones(6, 1) > 0, r"terminated \| truncated in 6 rows"),
    ],
)
def test_wrong_shapes_and_types_say_what_was_expected(key, value, message):
    data = sound_data()
    data.set(key, value)
    with pytest.raises(ValueError, match=message):
        check_dataset(data)


def test_missing_keys_are_named():
    data = sound_data()
    del data["next", "reward"]
    with pytest.raises(ValueError, match=r"lacks \('next', 'reward'\); it has"):
        check_dataset(data)


def test_unflat_data_are_refused():
    with pytest.raises(ValueError, match=r"batch size \[2, 3\]; expected a flat"):
        check_dataset(sound_data().reshape(2, 3))


WITHOUT_EXTRAS = """
import sys
for name in ("gymnasium", "mujoco", "tqdm", "platformdirs"):
    sys.modules[name] = None
from torchrl_osr.data import load_behavior_policy, normalized_score
from torchrl_osr.data import make_replay_buffer, check_dataset
for name in ("load_local_dataset", "collect_level", "make_environment"):
    try:
        exec(f"from torchrl_osr.data import {name}")
    except ImportError as error:
        assert "pip install torchrl-osr[examples]" in str(error), error
    else:
        raise AssertionError(name)
"""


def test_the_rest_works_without_the_examples_extra():
    completed = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert completed.returncode == 0, completed.stderr


def test_public_names_exist():
    import torchrl_osr.data

    assert all(hasattr(torchrl_osr.data, name) for name in torchrl_osr.data.__all__)
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        torchrl_osr.data.missing  # noqa: B018
