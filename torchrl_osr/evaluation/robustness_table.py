"""The table of an evaluation under disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_osr.evaluation.recovery import STEPS_AFTER

HEADER = (
    "level", "clean", "score", "loss %", "[95 %]", "met it",
    f"alive +{STEPS_AFTER}", "(clean)", "back", "steps back",
)  # fmt: skip


def robustness_table(title: str, summary: Sequence[Mapping[str, Any]]) -> str:
    """Return the table for the screen.

    Args:
        title: what was evaluated.
        summary: see :func:`summarize_levels`.
    """

    def number(value: float | None, digits: int = 1) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    def percent(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f} %"

    rows = [
        (
            row["name"],
            number(row["clean_score"]),
            number(row["score"]),
            number(row["decrease"]),
            f"[{number(row['decrease_low'])}, {number(row['decrease_high'])}]",
            percent(row["disturbed_share"]),
            percent(row["survival"]),
            percent(row["clean_survival"]),
            percent(row["recovered_share"]),
            number(row["recovery_median"]),
        )
        for row in summary
    ]
    widths = [max(map(len, column)) for column in zip(HEADER, *rows, strict=True)]
    lines = [title]
    for row in (HEADER, *rows):
        cells = [
            # Names to the left, numbers to the right.
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  " + "  ".join(cells))
    return "\n".join(lines)
