"""Methods: which runs may be averaged, what they are called, how fair comparisons are.

Runs are averaged only if their configurations differ in nothing but the seed (and, over
data sets, in the data set and in what is chosen by it). Of runs with one name that
differ in more, each kind becomes a method of its own, with the difference in its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from torchrl_osr.lab.report.runs import SOURCE, LeftOut, read_each
from torchrl_osr.lab.report.scores import counted
from torchrl_osr.lab.run.run_folder import MAY_DIFFER

IGNORED = (
    *sorted({*MAY_DIFFER} - {"trainer.steps", "trainer.eval_interval"}),
    "resume",
    "data.storage",
    "logger.",
    "trainer.compile",
    "trainer.cudagraph",
    "trainer.checkpoint_interval",
    "loss.chunk_size",
    "loss.deactivate_vmap",
)
"""Settings that decide how a number is computed, not which."""

IDENTITY = ("seed", "env.", SOURCE, "data.random_share", "data.path")
"""Settings that the report sorts runs by."""

METHOD = (
    "loss.",
    "recovery",
    "network.actor.",
    "optim.policy_delay",
    "perturbation.",
    "inverse_dynamics.",
    "dynamics.",
    "num_random",
    "min_q_weight",
)
"""Settings in which methods differ by intent; all others should be equal."""

NUM_NAMED, NAMED_WIDTH = 3, 40
"""At most so many differences are in a name, with so many characters of each value."""


@dataclass(frozen=True)
class RunTables:
    """All runs of a report.

    Attributes:
        runs: a row for each run: ``folder``, ``method``, ``data``, ``seed``, ``steps``,
            ``measure`` (score, or return of an environment without references),
            ``data_score`` (mean score, or return, of the data's episodes),
            ``overrides`` of the command line and ``versions`` of the packages.
        settings: its configuration as texts, a column for each dotted key.
        episodes: a row for each episode: ``run``, ``data``, ``method``, ``seed``,
            ``suite`` (``""``: the training's own evaluations), ``disturbance`` (``""``:
            none), ``step`` of the checkpoint, ``episode`` (its seed), ``score``. For
            disturbances that end the step at which it was ``disturbed_at``, whether it
            ``stood`` at its end, whether it was ``alive_after``, or without it
            ``undisturbed_alive``, and its ``recovery_steps``; NaN where it was not
            disturbed or did not recover.
        distances: a row for each ``offset`` from such a disturbance, with the ``mean``
            distance to the data of the ``count`` episodes that still last.
        saved: a row for each run and recoverable state, in the order of the states:
            ``run``, ``data``, ``method``, ``seed``; ``states``, the half and a mark
            that other states do not have; ``group``, ``disturbance``, ``walk``; and
            ``back``, the share of the checkpoints that came back from it.
        left_out: what could not be used.
    """

    runs: pd.DataFrame
    settings: pd.DataFrame
    episodes: pd.DataFrame
    distances: pd.DataFrame
    saved: pd.DataFrame
    left_out: Sequence[LeftOut]

    @property
    def methods(self) -> list[str]:
        """The methods, in the order of their first runs."""
        return list(self.runs["method"].unique())

    @property
    def data(self) -> list[str]:
        """The data sets, in the order of their first runs."""
        return list(self.runs["data"].unique())

    @property
    def measure(self) -> str:
        """What episodes are measured in: normalised score, or return of what."""
        measure = str(self.runs["measure"].iloc[0])
        return "normalised score" if measure == "score" else measure

    @property
    def suites(self) -> list[str]:
        """The suites, in the order of their first runs."""
        return [name for name in self.episodes["suite"].unique() if name]


def read_runs(paths: Sequence[Path]) -> RunTables:
    """Read all runs in or below the folders and in the tables, and name their methods.

    Args:
        paths: folders of runs, or above them, and tables of runs (``.jsonl.gz``). A
            run that is below two of the folders counts once.

    Returns:
        Runs of one method's name may be averaged. What cannot be read, is not finished
        or is there twice is listed as left out.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if there is no finished run, saying what was left out and why.
    """
    found, left_out = read_each(paths)
    if not found:
        reasons = "".join(f"\n  {each.path}: {each.reason}" for each in left_out)
        raise ValueError(
            f"no finished run in {', '.join(map(str, paths))}.{reasons}\n"
            "Give folders of torchrl-osr train, or a table of such runs."
        )
    # Returns of one environment and scores, or returns of another, have no mean.
    measure = found[0].facts["measure"]
    left_out += [
        LeftOut(
            run.facts["folder"],
            f"it is measured in {run.facts['measure']}, and the page in {measure}: "
            "report it alone, or train with env.random_return and env.expert_return",
        )
        for run in found
        if run.facts["measure"] != measure
    ]
    found = [run for run in found if run.facts["measure"] == measure]
    # Runs of one name together: what it is told apart into is then below each other.
    names = [run.facts["method"] for run in found]
    found.sort(key=lambda run: names.index(run.facts["method"]))
    runs = pd.DataFrame([run.facts for run in found])
    settings = pd.DataFrame([run.settings for run in found]).fillna("none")
    runs["method"] = tell_apart(runs["method"], comparable(settings), runs["data"])
    cell = ["method", "data", "seed"]
    first = runs.groupby(cell)["folder"].transform("first")
    again = runs.duplicated(cell)
    left_out += [
        LeftOut(folder, f"the same run as {other}, which is in the report")
        for folder, other in zip(runs["folder"][again], first[again], strict=True)
    ]
    runs = runs[~again]
    played_suites = [
        {"run": number, **each}
        for number in runs.index
        for each in found[number].protocols
    ]
    protocols = pd.DataFrame(played_suites or [{"run": 0, "suite": ""}])
    protocols = protocols.set_index(["run", "suite"])
    played = protocols.index.get_level_values("suite").to_series(protocols.index)
    everywhere = pd.Series("", protocols.index)
    suites = tell_apart(played, protocols, everywhere).rename("named")

    def joined(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
        rows = pd.concat(dict(enumerate(parts)), names=["run", None]).reset_index("run")
        rows = rows.join(runs[["data", "method", "seed"]], on="run", how="inner")
        return rows.reset_index(drop=True)

    def named(rows: pd.DataFrame) -> pd.DataFrame:
        rows = rows.join(suites, on=["run", "suite"])
        rows["suite"] = rows.pop("named").fillna("")
        return rows

    return RunTables(
        runs,
        settings.loc[runs.index],
        named(joined([run.episodes for run in found])),
        named(joined([run.distances for run in found])),
        joined([run.saved for run in found]),
        left_out,
    )


def comparable(settings: pd.DataFrame) -> pd.DataFrame:
    """The settings that must be equal for two runs to be averaged."""
    return settings[
        [key for key in settings if not key.startswith((*IGNORED, *IDENTITY))]
    ]


def tell_apart(names: pd.Series, facts: pd.DataFrame, data: pd.Series) -> pd.Series:
    """Names with, behind each, in what it differs from others of the same name.

    Args:
        names: of the rows.
        facts: of each, a column for each kind.
        data: of which data set each is. What is alike in every one of them tells
            nothing apart: it has been chosen by the data.
    """
    found = names.copy()
    for name, group in facts.groupby(names, sort=False):
        differing = group.loc[:, group.groupby(data).nunique().max() > 1]
        if differing.empty:
            continue
        kinds = differing.groupby(list(differing), sort=False).ngroup() + 1
        texts = [
            ", ".join(f"{key}={value[:NAMED_WIDTH]}" for key, value in row.items())
            for row in differing.iloc[:, :NUM_NAMED].to_dict("records")
        ]
        if len(set(texts)) < kinds.max():  # what differs did not fit in
            texts = [
                f"{text}, kind {kind}" for text, kind in zip(texts, kinds, strict=True)
            ]
        found[group.index] = [f"{name} ({text})" for text in texts]
    return found


def comparison_notes(tables: RunTables) -> list[str]:
    """A sentence for everything that makes a comparison less than fair."""
    runs, notes = tables.runs, []
    versions = pd.Series(sorted(set().union(*runs["versions"])), dtype=str)
    for _, found in versions.groupby(versions.str.rpartition(" ")[0]):
        if len(found) > 1:
            notes.append(f"Mixed versions: {', '.join(found)}.")
    silent = runs["versions"].str.len() == 0
    if silent.any():
        notes.append(f"No versions are recorded of {counted(silent.sum(), 'run')}.")
    settings = comparable(tables.settings)
    for method, group in runs.groupby("method", sort=False):
        kinds = settings.loc[group.index].nunique()
        if keys := list(kinds.index[kinds > 1]):
            notes.append(f"{method} differs between data sets: {', '.join(keys)}.")
    settings = settings.assign(data_score=runs["data_score"])
    for data, group in runs.groupby("data", sort=False):
        facts = settings.loc[group.index]
        keys = [
            key for key in facts.columns[facts.nunique(dropna=False) > 1]
            if not key.startswith(METHOD)
        ]  # fmt: skip
        if keys:
            notes.append(f"{data}: its runs differ in {', '.join(keys)}.")
        seeds = group.groupby("method", sort=False)["seed"].agg(
            lambda each: ", ".join(map(str, sorted(each)))
        )
        if seeds.nunique() > 1:
            alike = seeds.index.to_series().groupby(seeds, sort=False).agg(", ".join)
            each = "; ".join(f"{of} ({names})" for of, names in alike.items())
            notes.append(f"{data}: methods have different seeds: {each}.")
    if not runs.duplicated(["data", "method"]).any():
        notes.append(
            "Every method has one seed a data set: intervals are over the episodes of "
            "that one training and say nothing about another."
        )
    return notes
