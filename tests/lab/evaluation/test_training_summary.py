"""The table and the figure of a training run."""

from __future__ import annotations

from torchrl.record.loggers import CSVLogger

from torchrl_osr.lab.evaluation import (
    read_scalars,
    score_table,
)


def evaluations(*scores: float) -> list[dict]:
    return [
        {"step": 10 * i, "score": s, "score_low": s - 1, "score_high": s + 1}
        for i, s in enumerate(scores)
    ]


def test_scalars_are_read_as_logged_and_the_later_row_counts(tmp_path):
    for values in ({1: 5.0, 2: 6.0, 3: 7.0}, {2: 6.5, 3: 7.5}):  # killed, then resumed
        logger = CSVLogger("csv", log_dir=str(tmp_path))
        for step, value in values.items():
            logger.log_scalar("policy/loss_x", value, step=step)
    scalars = read_scalars(tmp_path / "csv" / "scalars" / "policy")
    assert scalars == {"loss_x": [(1, 5.0), (2, 6.5), (3, 7.5)]}


def test_table_has_last_recent_and_best(tmp_path):
    history = evaluations(0, 90, 10, 20, 30, 40)
    table = score_table("hopper", history, history[1], 15.6, tmp_path)
    lines = dict(line.split("  ", 1) for line in map(str.strip, table.split("\n")[1:]))
    assert lines["data, mean episode"].split() == ["15.6"]
    assert lines["policy, last"].split() == ["40.0", "[39.0,", "41.0]"]
    assert lines["policy, mean of last 5"].split() == ["38.0"]
    assert lines["policy, best evaluation"].split()[0] == "90.0"
    assert lines["files"].strip() == str(tmp_path)
