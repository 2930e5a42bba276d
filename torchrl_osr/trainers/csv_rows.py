"""Rows of a TorchRL ``CSVLogger``, which appends to what is there."""

from __future__ import annotations

from pathlib import Path


def cut_back(folder: Path, step: int) -> None:
    """Cut off what was logged after a step, which a resumed run logs once more.

    A last line that a kill has left unfinished goes, too.

    Args:
        folder: of CSV files with rows ``step,value``, steps in ascending order.
        step: the last one that stays.
    """
    for path in folder.glob("*.csv"):
        with path.open("r+b") as file:
            kept = 0
            for line in file:
                number = line.split(b",")[0]
                if (
                    not (line.endswith(b"\n") and number.isdigit())
                    or int(number) > step
                ):
                    break
                kept += len(line)
            file.truncate(kept)
