"""One page about any number of runs: from their folders to ``report.html``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr._files import write_atomically
from torchrl_osr.evaluation import NUM_RESAMPLES
from torchrl_osr.report.checks import comparison_notes, data_of, methods_of
from torchrl_osr.report.figures import all_methods
from torchrl_osr.report.files import LeftOut
from torchrl_osr.report.html import page, paragraph, warning
from torchrl_osr.report.methods import name_methods
from torchrl_osr.report.notes import FEW_SEEDS
from torchrl_osr.report.robustness import name_suites
from torchrl_osr.report.runs import Run, find_runs
from torchrl_osr.report.sections import (
    clean_section,
    curves_section,
    profile_section,
    provenance_section,
)
from torchrl_osr.report.sections_paired import paired_section
from torchrl_osr.report.sections_robustness import (
    recovery_section,
    strength_section,
    table_section,
)

PAGE = "report.html"


def collect(folders: Sequence[Path]) -> tuple[list[Run], list[LeftOut]]:
    """Read and name all runs in or below the folders.

    Args:
        folders: of runs, or above them.

    Returns:
        Runs that may be averaged have one method's name, see
        :mod:`~torchrl_osr.report.methods`; and what was left out.

    Raises:
        FileNotFoundError: if a folder does not exist.
        ValueError: if there is no finished run, saying what was left out and why.
    """
    runs, unread = find_runs(folders)
    runs, unnamed = name_methods(runs)
    left_out = [*unread, *unnamed]
    if not runs:
        reasons = "".join(f"\n  {each.path}: {each.reason}" for each in left_out)
        where = ", ".join(map(str, folders))
        raise ValueError(f"no finished run in {where}.{reasons}")
    return name_suites(runs), left_out


def choose_reference(runs: Sequence[Run], wanted: str | None) -> str:
    """Return the method that the others are compared with.

    Args:
        runs: all of the report.
        wanted: its name; ``None`` is the first.

    Raises:
        ValueError: if there is no such method, naming those that there are.
    """
    methods = methods_of(runs)
    if wanted is None:
        return methods[0]
    if wanted not in methods:
        raise ValueError(f"no method {wanted!r}; there are: {'; '.join(methods)}")
    return wanted


def write_report(
    runs: Sequence[Run],
    left_out: Sequence[LeftOut],
    folder: Path,
    *,
    reference: str,
    command: str,
) -> Path:
    """Write the page and its figures.

    Args:
        runs: of :func:`collect`.
        left_out: of the same.
        folder: made if need be; files of a former report are replaced.

    Keyword Args:
        reference: the method that the others are compared with.
        command: how the report was asked for.

    Returns:
        The page's path.
    """
    folder.mkdir(parents=True, exist_ok=True)
    styles = all_methods(runs)
    sections = [
        ("Learning curves", curves_section(runs, styles, folder)),
        ("Undisturbed scores", clean_section(runs)),
        ("Out of sample", table_section(runs)),
        ("Over all data sets", profile_section(runs, styles, folder)),
        ("Strength of the disturbance", strength_section(runs, styles, folder)),
        ("Recovery", recovery_section(runs, styles, folder)),
        ("Differences", paired_section(runs, reference, styles, folder)),
        ("Where it comes from", provenance_section(runs, left_out, command)),
    ]
    methods, data = ", ".join(methods_of(runs)), ", ".join(data_of(runs))
    head = paragraph(
        f"{len(runs)} runs: {methods} on {data}.",
        "Brackets and bands are 95 % percentile-bootstrap intervals of "
        f"{NUM_RESAMPLES:,} resamples with fixed seeds: the same runs give the same "
        "page.",
        FEW_SEEDS,
    ) + warning("Before you compare", comparison_notes(runs))
    if left_out:
        head += warning(
            "Left out",
            [f"{len(left_out)} folders or files; the last section says why."],
        )
    path = folder / PAGE
    write_atomically(path, page("Report of runs", head, sections))
    return path
