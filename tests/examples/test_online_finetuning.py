"""The example that goes on with a trained run in its environment, as a user runs it."""

from __future__ import annotations

import json


def test_a_trained_run_goes_on_in_its_environment(tmp_path, run, tiny) -> None:
    offline, online = tmp_path / "offline", tmp_path / "online"
    run(tmp_path, "train", *tiny(), f"hydra.run.dir={offline}")
    options = ["--frames=200", "--interval=100", "--episodes=1", "--min-q-weight=1"]
    given = [str(offline), str(online), *options]
    assert "never trained" not in run(tmp_path, "online_finetuning.py", *given)
    record = json.loads((online / "online.json").read_text(encoding="utf-8"))
    assert (record["loss"], record["step"]) == ("OSRLoss", 10)
    assert record["min_q_weight"] == 1.0
    assert [point["frames"] for point in record["curve"]] == [0, 100, 200]
    first, *_, last = record["curve"]
    assert first["seeds"] == last["seeds"]
    assert first["returns"] != last["returns"], "the same policy"
    assert (online / "online.png").read_bytes().startswith(b"\x89PNG")
