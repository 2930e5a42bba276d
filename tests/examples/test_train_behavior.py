"""The example that trains behaviour policies, as a user runs it."""

from __future__ import annotations

from contextlib import closing

from torchrl_osr.lab.data import (
    collect_transitions,
    load_behavior_policy,
    make_environment,
)
from torchrl_osr.lab.data.behavior import load_behavior_card


def test_policies_are_written_that_load_and_play(tmp_path, run):
    # A process of its own: torchrl's collectors warn on import.
    options = (
        "--env=InvertedPendulum-v5", f"--out={tmp_path}", "--steps=192",
        "--random-steps=96", "--eval-every=96", "--eval-steps=200",
        "--card-steps=400", "--batch-size=16",
    )  # fmt: skip
    run(tmp_path, "train_behavior.py", *options)
    card = load_behavior_card(tmp_path)["invertedpendulum"]
    files = {path.stem for path in (tmp_path / "invertedpendulum").glob("*.npz")}
    assert card["env"] == "InvertedPendulum-v5"
    assert set(card["policies"]) == files
    assert files == {"medium", "expert", *(f"replay_{n}" for n in range(1, 9))}
    for entry in card["policies"].values():
        assert entry["steps"] in (96, 192)
        assert entry["stochastic_return"][0] > 0
    policy = load_behavior_policy("invertedpendulum", "replay_1", folder=tmp_path)
    with closing(make_environment("InvertedPendulum-v5")) as env:
        _, returns, _ = collect_transitions(env, [policy.sample], 100)
    assert returns.min() >= 0
