"""The table of a training run."""

from __future__ import annotations

from torchrl.record.loggers import CSVLogger

from torchrl_osr.lab.evaluation.training_summary import read_scalars, score_table


def evaluations(*scores: float, **more) -> list[dict]:
    return [
        {"step": 10 * i, "score": s, "score_low": s - 1, "score_high": s + 1} | more
        for i, s in enumerate(scores)
    ]


def cells(table: str) -> dict[str, list[str]]:
    pairs = (line.strip().split("  ", 1) for line in table.split("\n")[1:])
    return {name: rest.split() for name, rest in pairs}


def test_scalars_are_read_as_logged_and_the_later_row_counts(tmp_path):
    for values in ({1: 5.0, 2: 6.0, 3: 7.0}, {2: 6.5, 3: 7.5}):  # killed, then resumed
        logger = CSVLogger("csv", log_dir=str(tmp_path))
        for step, value in values.items():
            logger.log_scalar("policy/loss_x", value, step=step)
    scalars = read_scalars(tmp_path / "csv" / "scalars" / "policy")
    assert scalars == {"loss_x": [(1, 5.0), (2, 6.5), (3, 7.5)]}


def test_table_has_last_recent_and_best(tmp_path):
    history = evaluations(0, 90, 10, 20, 30, 40)
    rows = cells(score_table("hopper", history, history[1], 15.6, tmp_path))
    assert rows["data, mean episode"] == ["15.6"]
    assert rows["policy, last"] == ["40.0", "[39.0,", "41.0]"]
    assert rows["policy, mean of last 5"] == ["38.0"]
    assert rows["policy, best evaluation"][0] == "90.0"


def test_the_untrained_policy_is_in_no_mean(tmp_path):
    history = evaluations(100, 20, 40)
    rows = cells(score_table("hopper", history, history[2], None, tmp_path))
    assert rows["policy, mean of last 2"] == ["30.0"]
