"""The CartPole example, from its command line to its table and its file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROWS = ["cql, own starts", "cql, wide starts", "osr, own starts", "osr, wide starts"]


@pytest.fixture(scope="module")
def train(run):
    """Return a function that runs it: what was printed, and its file."""
    sizes = ["--steps=5", "--model-steps=5", "--data-episodes=8", "--episodes=3"]

    def train(folder: Path, *options: str) -> tuple[str, dict]:
        output = "--output=new/returns.json"
        code, printed = run(folder, "discrete_osr.py", *sizes, output, *options)
        assert code == 0, printed
        text = (folder / "new" / "returns.json").read_text(encoding="utf-8")
        return printed, json.loads(text)

    return train


@pytest.fixture(scope="module")
def both(tmp_path_factory, train) -> tuple[str, dict]:
    return train(tmp_path_factory.mktemp("both"))


def test_table_has_a_row_for_the_data_and_each_policy(both) -> None:
    printed, results = both
    rows = re.findall(r"(?m)^(.+?) +([\d.]+)   [\d.]+ to [\d.]+ +(\d+)$", printed)
    assert [name for name, _, _ in rows] == ["data", *ROWS]
    returns = [results["data_returns"], *results["returns"].values()]
    for (_, mean, episodes), each in zip(rows, returns, strict=True):
        assert int(episodes) == len(each)
        assert float(mean) == pytest.approx(sum(each) / len(each), abs=0.06)


def test_file_has_every_episode_and_how_it_was_made(both) -> None:
    _, results = both
    assert list(results["returns"]) == ROWS
    # A reward of 1 a step: the data's returns are its length.
    assert sum(results["data_returns"]) == results["rows"]
    seeds = results["episode_seeds"]
    assert len(set(seeds)) == 3
    for returns in results["returns"].values():
        assert len(returns) == 3
        assert all(1 <= value <= 500 for value in returns)
    assert results["command"].startswith("python examples/discrete_osr.py --steps=5 ")
    assert {"torch", "torchrl", "gymnasium"} <= set(results["versions"])


def test_the_same_seed_gives_the_same_numbers_and_a_loss_can_be_chosen(
    both, train, tmp_path
) -> None:
    _, results = both
    printed, again = train(tmp_path, "--loss", "osr")
    assert again["data_returns"] == results["data_returns"]
    assert list(again["returns"]) == ROWS[2:]
    for name, returns in again["returns"].items():
        assert returns == results["returns"][name]
    assert "cql" not in printed
