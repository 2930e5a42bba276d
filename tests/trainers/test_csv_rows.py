"""Rows that a killed run has logged after its checkpoint."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from torchrl.record.loggers import CSVLogger

from torchrl_osr.trainers.csv_rows import cut_back

rows = st.dictionaries(st.integers(0, 50), st.floats(allow_nan=False))


@given(rows, st.integers(-1, 50), st.sampled_from(["", "6", "60,", "60,0.1"]))
def test_what_stays_is_what_was_logged_until_the_step(
    tmp_path_factory, rows, step, end
):
    folder = tmp_path_factory.mktemp("rows")
    lines = [f"{number},{value}\n" for number, value in sorted(rows.items())]
    (folder / "loss.csv").write_text("".join(lines) + end)  # killed within a line
    cut_back(folder, step)
    kept = sum(number <= step for number in rows)
    assert (folder / "loss.csv").read_text() == "".join(lines[:kept])


@pytest.mark.parametrize("interval", [4, 5, 100])
def test_killed_run_logs_no_step_twice(tmp_path, runs, interval):
    """Killed in its last step, some time after its last checkpoint or before any."""

    def make(folder):
        return runs.make(
            tmp_path / folder,
            checkpoint_interval=interval,
            log_interval=1,
            evaluate=lambda: {"score": 1.0},
            loggers=[CSVLogger("csv", log_dir=str(tmp_path / folder))],
        )

    def read(folder):
        files = (tmp_path / folder / "csv" / "scalars" / "train").glob("*.csv")
        return {path.name: path.read_text() for path in files}

    make("undisturbed").train()
    killed = make("killed")

    def kill(batch):
        if killed.step == 12:
            raise MemoryError
        return batch

    killed.register_op("process_optim_batch", kill)
    with pytest.raises(MemoryError):
        killed.train()
    before = read("killed")
    make("killed").train()
    assert read("killed") == read("undisturbed") != before
    assert read("killed")["score.csv"] == "0,1.0\n6,1.0\n12,1.0\n"
