"""Reading the JSON files of a run, and refusing those that say nonsense."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_osr._files import read_json

ROBUSTNESS_FORMAT = 1


class LeftOut(NamedTuple):
    """What is not in the report.

    Attributes:
        path: a run's folder, or a file in it.
        reason: in words.
    """

    path: Path
    reason: str


def check_evaluations(evaluations: Sequence[Mapping[str, Any]], steps: int) -> None:
    """Raise unless a run's evaluations go to its end and every return is a number.

    Raises:
        ValueError: saying which evaluation is wrong.
    """
    last = evaluations[-1]["step"] if evaluations else 0
    if last != steps:
        raise ValueError(f"not finished, evaluated last at step {last} of {steps}")
    for row in evaluations:
        if len(row["returns"]) != len(row["seeds"]) or not row["returns"]:
            raise ValueError(f"returns and seeds of step {row['step']} do not match")
        if not all(math.isfinite(value) for value in row["returns"]):
            raise ValueError(f"a return of step {row['step']} is not finite")
        if row["seeds"] != evaluations[0]["seeds"]:
            raise ValueError(f"episodes of step {row['step']} have other seeds")


def read_suites(folder: Path) -> tuple[dict[str, dict[str, Any]], list[LeftOut]]:
    """Read a run's ``robustness-<suite>.json`` files.

    Returns:
        Their contents by suite, and the files that cannot be used.
    """
    suites: dict[str, dict[str, Any]] = {}
    left_out = []
    for path in sorted(folder.glob("robustness-*.json")):
        try:
            content = read_json(path)
            check_suite(content)
            name = str(content["suite"])
            if name in suites:
                raise ValueError(f"a second file of suite {name!r}")
        except KeyError as error:
            left_out.append(LeftOut(path, f"there is no entry {error}"))
        except (OSError, TypeError, ValueError) as error:
            left_out.append(LeftOut(path, str(error)))
        else:
            suites[name] = content
    return suites, left_out


def check_suite(content: Mapping[str, Any]) -> None:
    """Raise unless all evaluations have the same levels, in pairs with clean episodes.

    Raises:
        ValueError: saying what is wrong.
        KeyError: if an entry is missing.
    """
    if content.get("format") != ROBUSTNESS_FORMAT:
        raise ValueError(
            f"its format is {content.get('format')!r}, known is {ROBUSTNESS_FORMAT}"
        )
    if not content["evaluations"]:
        raise ValueError("it has no evaluations")
    first = content["evaluations"][0]
    for row in content["evaluations"]:
        where = f"step {row['step']}"
        if levels_of(row) != levels_of(first) or not row["levels"]:
            raise ValueError(f"{where} has other levels than step {first['step']}")
        for part in (row["clean"], *row["levels"]):
            name = part.get("name", "clean")
            if len(part["scores"]) != len(row["clean"]["seeds"]) or not part["scores"]:
                raise ValueError(f"{where}, {name}: scores and seeds do not match")
            if not all(math.isfinite(value) for value in part["scores"]):
                raise ValueError(f"{where}, {name}: a score is not finite")


def levels_of(evaluation: Mapping[str, Any]) -> list[tuple[str, str, float]]:
    """Return name, kind and strength of each level."""
    return [
        (str(level["name"]), str(level["kind"]), float(level["strength"]))
        for level in evaluation["levels"]
    ]
