"""Finished runs as data frames, read from their folders or from packed tables.

The small files of a run make one JSON object, its *record*. A packed table
(``.jsonl.gz``) has a record on each line.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._files import parse_json, read_json, write_atomically
from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.run.run_config import flatten, read_yaml
from torchrl_osr.lab.run.run_folder import CONFIG, MAY_DIFFER, read_status
from torchrl_osr.lab.run.schema import method_name

IGNORED = (
    *sorted({*MAY_DIFFER} - {"trainer.steps", "trainer.eval_interval"}),
    *("resume", "seed", "data.storage", "logger.", "trainer.compile"),
    *("trainer.cudagraph", "trainer.checkpoint_interval", "loss.deactivate_vmap"),
)
"""Settings that change how a number is computed, not which, and the seed."""

IDENTITY = ("env.", "data.source", "data.quality", "data.random_share", "data.path")
"""Settings that name the data set."""

METHOD = (
    *("loss.", "recovery", "network.actor.", "optim.policy_delay", "perturbation."),
    *("inverse_dynamics.", "dynamics.", "num_random", "min_q_weight"),
)
"""Settings in which methods differ by intent; all others should be equal."""

NUM_NAMED, NAMED_WIDTH = 3, 40
"""At most so many differences are in a name, with so many characters of each value."""

RECOVERY = {
    "disturbed_at": "disturbed_at",
    "survived_knock": "stood",
    "alive_after": "alive_after",
    "clean_alive_after": "undisturbed_alive",
    "recovery_steps": "recovery_steps",
}
"""Entries of a disturbance, a number an episode, and their columns."""

SAVED = ["states", "group", "disturbance", "walk", "back"]
EPISODE = ("suite", "disturbance", "step", "episode", "score", *RECOVERY.values())


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
            none), ``step`` of the checkpoint, ``episode`` (its seed), ``score``, and
            the step at which it was ``disturbed_at`` (NaN: never). For disturbances
            that end whether it ``stood`` at its end, whether it was ``alive_after``, or
            without it ``undisturbed_alive``, and its ``recovery_steps`` (NaN: never).
        saved: a row for each run and recoverable state, in the order of the states:
            ``run``, ``data``, ``method``, ``seed``; ``states``, the half and a digest
            of the states; ``group``, ``disturbance``, ``walk``; and ``back``, the share
            of the checkpoints that came back from it.
        left_out: folder, or line of a table, and reason of each run that is not in the
            tables.
    """

    runs: pd.DataFrame
    settings: pd.DataFrame
    episodes: pd.DataFrame
    saved: pd.DataFrame
    left_out: Sequence[tuple[str, str]]

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
        """Normalised score, or return of an environment."""
        measure = str(self.runs["measure"].iloc[0])
        return "normalised score" if measure == "score" else measure

    @property
    def suites(self) -> list[str]:
        """The suites, in the order of their first runs."""
        return [name for name in self.episodes["suite"].unique() if name]


class _Run(NamedTuple):
    """A parsed record.

    ``contents`` identifies the data, ``protocols`` has how each suite was played.
    """

    facts: dict[str, Any]
    settings: dict[str, str]
    contents: dict[str, str]
    protocols: list[dict[str, str]]
    episodes: pd.DataFrame
    saved: pd.DataFrame
    left_out: list[tuple[str, str]]


def find_runs(tops: Iterable[Path]) -> list[Path]:
    """Folders of runs in or below the folders, each once, in the order of paths.

    Raises:
        FileNotFoundError: if one of the folders does not exist.
    """
    found: dict[Path, Path] = {}
    for top in tops:
        if not top.exists():
            raise FileNotFoundError(f"{top} does not exist.")
        for path in sorted(top.rglob(CONFIG)):
            # Hydra keeps a second config.yaml in a hidden folder.
            if not any(part[0] == "." for part in path.relative_to(top).parts):
                found.setdefault(path.parent.resolve(), path.parent)
    return list(found.values())


def read_record(folder: Path) -> dict[str, Any]:
    """Read the small files of a run's folder.

    Raises:
        ValueError: if a file is damaged, or the run is not finished.
    """
    status = read_status(folder)
    if status["status"] != "done":
        why = "".join(
            f": {status[key]}" for key in ("error", "reason") if key in status
        )
        raise ValueError(f"not finished, its status is {status['status']}{why}")
    config = read_yaml(folder / CONFIG)
    hydra = read_yaml(folder / ".hydra" / "hydra.yaml")["hydra"]
    above, name = folder.resolve().parts[-2:]
    in_layout = name == f"seed{config['seed']}"
    return {
        "folder": str(folder),
        "config": config,
        "overrides": hydra["overrides"]["task"],
        "returns": read_json(folder / "returns.json"),
        "method": above if in_layout else method_name(hydra["runtime"]["choices"]),
    } | {
        kind: {
            path.name: read_json(path) for path in sorted(folder.glob(f"{kind}-*.json"))
        }
        for kind in ("robustness", "recoverable")
    }


def read_records(table: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a packed table."""
    with gzip.open(table, "rt", encoding="utf-8") as file:
        for number, line in enumerate(file, start=1):
            yield parse_json(line, f"{table}, line {number}")


def pack_runs(folders: Iterable[Path], table: Path) -> int:
    """Write the finished runs in or below the folders into one table.

    Returns:
        The number of runs.

    Raises:
        ValueError: if a run is not finished, or damaged.
    """
    found = [folder.absolute() for folder in find_runs(folders)]
    above = os.path.commonpath([folder.parent for folder in found]) if found else ""
    records = [
        read_record(folder) | {"folder": folder.relative_to(above).as_posix()}
        for folder in found
    ]
    text = "".join(json.dumps(each, separators=(",", ":")) + "\n" for each in records)
    # Without the time: equal records, equal bytes.
    write_atomically(table, gzip.compress(text.encode(), mtime=0))
    return len(records)


def read_runs(paths: Sequence[Path]) -> RunTables:
    """Read all runs in or below the folders and in the tables, and name their methods.

    Runs of one method differ in nothing but the seed, and what is chosen by the data
    set. If other settings differ, the name of the method says in which. Of two runs of
    one method, data set and seed the later one counts.

    Args:
        paths: folders of runs, or above them, and packed tables.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if there is no finished run, with the reasons.
    """
    found, left_out = [], []
    folders = find_runs(path for path in paths if not path.is_file())
    records: list[Any] = [*folders]
    for table in (path for path in paths if path.is_file()):
        records += read_records(table)
    for record in records:
        name = record["folder"] if isinstance(record, dict) else str(record)
        try:
            found.append(
                _parse(record if isinstance(record, dict) else read_record(record))
            )
        # Another program's file may hold anything, and concerns its own run alone.
        except Exception as error:
            left_out.append((name, _reason(error)))
    if found:
        # Returns of one environment and scores, or returns of another, have no mean.
        measure = found[0].facts["measure"]
        left_out += [
            (
                run.facts["folder"],
                f"measured in {run.facts['measure']}, not in {measure}",
            )
            for run in found
            if run.facts["measure"] != measure
        ]
        found = [run for run in found if run.facts["measure"] == measure]
        left_out += [each for run in found for each in run.left_out]
    else:
        reasons = "".join(f"\n  {name}: {reason}" for name, reason in left_out)
        raise ValueError(f"no finished run in {', '.join(map(str, paths))}.{reasons}")
    names = [run.facts["method"] for run in found]
    found.sort(key=lambda run: names.index(run.facts["method"]))
    runs = pd.DataFrame([run.facts for run in found])
    settings = pd.DataFrame([run.settings for run in found]).fillna("none")
    # One name, other contents: a log that was corrected, for instance.
    contents = pd.DataFrame([run.contents for run in found])
    runs["data"] = tell_apart(runs["data"], contents)
    runs["method"] = tell_apart(runs["method"], comparable(settings), runs["data"])
    cell = ["method", "data", "seed"]
    last, again = (
        runs.groupby(cell)["folder"].transform("last"),
        runs.duplicated(cell, "last"),
    )
    left_out += [
        (folder, f"{later} is a later run of the same method, data and seed")
        for folder, later in zip(runs["folder"][again], last[again], strict=True)
    ]
    runs = runs[~again]
    # Suites of one name that were played differently are different suites.
    played = pd.DataFrame(
        [{"run": run} | each for run in runs.index for each in found[run].protocols]
        or [{"run": -1, "suite": ""}]
    ).set_index(["run", "suite"])
    suites = played.index.get_level_values("suite").to_series(played.index)
    suites = tell_apart(suites, played).rename("named")

    def joined(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
        rows = pd.concat(dict(enumerate(parts)), names=["run", None]).reset_index("run")
        return rows.join(runs[["data", "method", "seed"]], on="run", how="inner")

    episodes = joined([run.episodes for run in found]).join(suites, on=["run", "suite"])
    episodes["suite"] = episodes.pop("named").fillna("")
    return RunTables(
        runs,
        settings.loc[runs.index],
        episodes.reset_index(drop=True),
        joined([run.saved for run in found]).reset_index(drop=True),
        left_out,
    )


def _reason(error: Exception) -> str:
    """Why a run is left out, on one line."""
    if isinstance(error, KeyError):
        return f"there is no entry {error}"
    text = str(error) if isinstance(error, (OSError, ValueError)) else repr(error)
    return text.split("\n")[0]


def _parse(record: Mapping[str, Any]) -> _Run:
    """Frames of a record; raises if its numbers make no sense."""
    config, returns = flatten(record["config"]), record["returns"]
    env, steps, path = config["env.name"], config["trainer.steps"], config["data.path"]
    share, mixed = config["data.random_share"], ""
    if share:
        mixed = f", {100 * share:g} % random"
    # Older tables call the source of the data its quality.
    source = config.get("data.source", config.get("data.quality"))
    references = reference_returns(
        env, config.get("env.random_return"), config.get("env.expert_return")
    )
    measure = "return" if references is None else "score"
    evaluations = returns["evaluations"]
    if not evaluations or evaluations[-1]["step"] != steps:
        at = evaluations[-1]["step"] if evaluations else "none"
        raise ValueError(f"not finished, or never played: last evaluation at step {at}")
    rows, left_out, protocols, versions = [], [], [], [returns["versions"]]
    for each in evaluations:
        values = np.array(each["returns"], dtype=float)
        values = values if references is None else references.score(values)
        rows += _episodes("", "", each["step"], each["seeds"], values, {})
    episodes, saved = [_table(rows)], [pd.DataFrame(columns=SAVED)]
    for name, content in (record["robustness"] | record.get("recoverable", {})).items():
        try:
            if "half" in content:
                saved.append(_saved_states(content))
            else:
                episodes.append(_suite(content, f"{measure}s"))
                protocols.append(_protocol(content, steps))
            versions.append(content["versions"])
        except Exception as error:  # as in read_runs: the run itself can be used
            left_out.append((f"{record['folder']}/{name}", _reason(error)))
    mean = returns[f"data_{measure}"]
    facts = {
        "folder": str(record["folder"]),
        "method": str(record["method"]),
        "data": f"{env} {source}{f' {path}' if path else ''}{mixed}",
        "seed": int(config["seed"]),
        "steps": int(steps),
        "measure": "score" if references else f"return of {env}",
        "data_score": np.nan if mean is None else float(mean),
        "overrides": " ".join(map(str, record["overrides"] or ())),
        "versions": sorted(
            {f"{name} {each}" for of in versions for name, each in (of or {}).items()}
        ),
    }
    settings = {key: str(value) for key, value in config.items()}
    contents = {"mean": f"{facts['data_score']:.2f}"}
    contents["checksum"] = str(returns.get("data_checksum", ""))[:8]
    tables = pd.concat(episodes, ignore_index=True), pd.concat(saved, ignore_index=True)
    return _Run(facts, settings, contents, protocols, *tables, left_out)


def _table(rows: Sequence[tuple[Any, ...]]) -> pd.DataFrame:
    """Episodes as a frame; raises unless all scores are finite."""
    frame = pd.DataFrame(rows, columns=EPISODE)
    numbers = list(EPISODE[2:])
    frame[numbers] = frame[numbers].astype(float)
    if not np.isfinite(frame["score"]).all():
        raise ValueError("not all of its returns are finite numbers")
    return frame.astype({"step": int, "episode": int})


def _suite(content: Mapping[str, Any], measure: str) -> pd.DataFrame:
    """Episodes of a robustness file."""
    rows = []
    for each in content["evaluations"]:
        seeds = each["clean"]["seeds"]
        for level in ({"name": "", **each["clean"]}, *each["levels"]):
            place = content["suite"], level["name"], each["step"]
            rows += _episodes(*place, seeds, level[measure], level)
    return _table(rows)


def _episodes(
    suite: str,
    disturbance: str,
    step: int,
    seeds: Sequence[int],
    scores: Iterable[float],
    level: Mapping[str, Any],
) -> list[tuple[Any, ...]]:
    """Rows of the episodes of one evaluation."""
    unknown = [None] * len(seeds)
    columns = [level.get(key) or unknown for key in RECOVERY]
    of_each = zip(seeds, scores, *columns, strict=True)
    return [(suite, disturbance, step, *each) for each in of_each]


def _protocol(content: Mapping[str, Any], steps: int) -> dict[str, str]:
    """What must be equal for two results of a suite to be compared, as texts."""
    evaluations = content["evaluations"]
    at = [each["step"] for each in evaluations]
    keys = ("name", "kind", "strength")
    facts = {
        "suite": content["suite"],
        "checkpoints": f"last {len(at)}" if at[-1] == steps else at,
        "seeds": [each["clean"]["seeds"] for each in evaluations],
        "levels": [[level[key] for key in keys] for level in evaluations[0]["levels"]],
    }
    return {name: str(value) for name, value in facts.items()}


def _saved_states(content: Mapping[str, Any]) -> pd.DataFrame:
    """The states of a file, and the share of its checkpoints that each was saved by."""
    columns = {key: content[key] for key in ("group", "disturbance", "walk")}
    back = np.mean([each["back"] for each in content["evaluations"]], axis=0)
    # The same number of the same groups may be other states.
    digest = hashlib.sha256(json.dumps(list(columns.values())).encode()).hexdigest()
    columns = {"states": f"{content['half']} {digest[:6]}"} | columns | {"back": back}
    return pd.DataFrame(columns)


def comparable(settings: pd.DataFrame) -> pd.DataFrame:
    """The settings that must be equal for two runs to be averaged."""
    return settings[[key for key in settings if not key.startswith(IGNORED)]]


def tell_apart(
    names: pd.Series, facts: pd.DataFrame, data: pd.Series | None = None
) -> pd.Series:
    """Add to equal names the facts in which they differ.

    Args:
        names: of the rows.
        facts: of each, a column for each kind.
        data: the data set of each, if facts may differ between data sets.
    """
    found = names.copy()
    data = pd.Series("", names.index) if data is None else data
    for name, group in facts.groupby(names, sort=False):
        differing = group.loc[:, group.groupby(data).nunique().max() > 1]
        if differing.empty:
            continue
        kinds = differing.groupby(list(differing), sort=False).ngroup() + 1
        texts = [
            ", ".join(f"{key}={value[:NAMED_WIDTH]}" for key, value in row.items())
            for row in differing.iloc[:, :NUM_NAMED].to_dict("records")
        ]
        if len(set(texts)) < kinds.max():  # the names are too short for all of it
            texts = [
                f"{text}, kind {kind}" for text, kind in zip(texts, kinds, strict=True)
            ]
        found[group.index] = [f"{name} ({text})" for text in texts]
    return found


def comparison_notes(tables: RunTables) -> list[str]:
    """A sentence for everything that makes a comparison less than fair."""
    runs, notes = tables.runs, []
    versions: dict[str, set[str]] = {}
    for each in {each for row in runs["versions"] for each in row}:
        versions.setdefault(each.rpartition(" ")[0], set()).add(each)
    mixed = sorted(
        ", ".join(sorted(each)) for each in versions.values() if len(each) > 1
    )
    notes += [f"Mixed versions: {each}." for each in mixed]
    settings = comparable(tables.settings)
    for method, group in runs.groupby("method", sort=False):
        kinds = settings.loc[group.index].nunique()
        names = [key for key in kinds.index[kinds > 1] if not key.startswith(IDENTITY)]
        if names:
            notes.append(f"{method} differs between data sets: {', '.join(names)}.")
    for data, group in runs.groupby("data", sort=False):
        kinds = settings.loc[group.index].nunique()
        names = [key for key in kinds.index[kinds > 1] if not key.startswith(METHOD)]
        if names:
            notes.append(f"{data}: its runs differ in {', '.join(names)}.")
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
            "one training and say nothing about another."
        )
    return notes
