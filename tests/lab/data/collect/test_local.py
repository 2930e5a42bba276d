"""Local sets: collected once for a request, and what their manifests say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_osr.lab.data import (
    check_dataset,
    is_memory_mapped,
    load_local_dataset,
)
from torchrl_osr.lab.data.collect import local

ROWS = 300


def load(cache_dir: Path | None, **changes):
    request = {"num_transitions": ROWS, "cache_dir": cache_dir, "progress": False}
    return load_local_dataset("hopper", "random", **(request | changes))


@pytest.fixture
def collections(monkeypatch) -> list[str]:
    """Record each real collection."""
    calls: list[str] = []
    original = local.collect_quality

    def recorded(env_name, quality, *args, **kwargs):
        calls.append(quality)
        return original(env_name, quality, *args, **kwargs)

    monkeypatch.setattr(local, "collect_quality", recorded)
    return calls


def test_second_load_reads_the_same_data(tmp_path, collections):
    first, manifest = load(tmp_path)
    second, again = load(tmp_path)
    mapped, also = load(tmp_path, on_disk=True)
    assert collections == ["random"]
    assert (first == second).all()
    assert (first == mapped).all()
    assert manifest == again == also
    check_dataset(second)
    assert is_memory_mapped(mapped)
    assert not is_memory_mapped(second)


def test_manifest_describes_the_set(tmp_path):
    data, manifest = load(tmp_path, seed=3)
    folder = tmp_path / "rolled-out" / f"hopper-random-{ROWS}-seed3"
    assert manifest == json.loads((folder / "manifest.json").read_text())
    returns = np.array(manifest["episode_returns"])
    assert manifest["env_id"] == "Hopper-v5"
    assert (manifest["quality"], manifest["seed"]) == ("random", 3)
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


def test_other_versions_make_the_set_anew(tmp_path, collections, monkeypatch):
    first, _ = load(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(local, "version", lambda package: "1.0")
        second, manifest = load(tmp_path)
    assert manifest["versions"]["numpy"] == "1.0"
    assert len(collections) == 2
    assert (first == second).all()
    load(tmp_path)
    assert len(collections) == 3


CHILD = """
import sys
import torch
from torchrl_osr.lab.data.collect import local

torch.set_num_threads(1)
original = local.collect_quality

def announced(*args, **kwargs):
    print("collected", flush=True)
    return original(*args, **kwargs)

local.collect_quality = announced
print("ready", flush=True)
sys.stdin.readline()
data, manifest = local.load_local_dataset(
    "hopper", "medium", num_transitions=5000, cache_dir=sys.argv[1], progress=False
)
print(manifest["sha256"], data["observation"].double().sum().item(), flush=True)
"""


def test_two_processes_at_once_collect_once(tmp_path):
    children = [
        subprocess.Popen(
            [sys.executable, "-c", CHILD, str(tmp_path)],
            cwd=Path(__file__).parents[4],
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


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_mixture_says_what_it_is_made_of(tmp_path, on_disk):
    request = {"num_transitions": 2000, "seed": 3, "cache_dir": tmp_path}
    valuable, _ = load_local_dataset("hopper", "medium", **request)
    random, _ = load_local_dataset("hopper", "random", **request)
    data, manifest = load_local_dataset(
        "hopper", "medium", random_share=0.9, on_disk=on_disk, **request
    )
    assert is_memory_mapped(data) == on_disk
    assert manifest["rows"] == {"medium": 200, "random": 1800}
    for rows, source in ((data[:200], valuable), (data[200:], random)):
        known = {tuple(row.tolist()) for row in source["observation"]}
        assert all(tuple(row.tolist()) in known for row in rows["observation"])
    scores = {
        name: source["normalized_score"] for name, source in manifest["sources"].items()
    }
    expected = 0.1 * scores["medium"] + 0.9 * scores["random"]
    assert manifest["normalized_score"] == pytest.approx(expected)


def test_random_data_are_not_mixed_with_random_data(tmp_path):
    request = {"num_transitions": 100, "cache_dir": tmp_path, "random_share": 0.5}
    with pytest.raises(ValueError, match="quality is random already"):
        load_local_dataset("hopper", "random", **request)
    assert not [*tmp_path.iterdir()]
