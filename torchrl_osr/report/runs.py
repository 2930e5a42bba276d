"""Runs of a report: found in folders or in a table, read within bounds, checked.

The small files of a run make one JSON object, its *record*. A table of runs
(``runs.jsonl.gz``) has a record on each line; :func:`pack_runs` writes one. Whatever is
in a record, it can only make its own run unreadable.
"""

from __future__ import annotations

import gzip
import json
import math
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import pandas as pd

from torchrl_osr._files import MAX_JSON_BYTES, parse_json, read_json, write_atomically
from torchrl_osr.data import REFERENCE_RETURNS, normalized_score
from torchrl_osr.experiment.run_config import MAX_CONFIG_DEPTH, read_yaml
from torchrl_osr.experiment.run_folder import CONFIG, STATUS, flatten

RETURNS = "returns.json"
ROBUSTNESS_FORMAT = 1
MAX_TABLE_BYTES = 4 * MAX_JSON_BYTES
"""Of a table of runs, unpacked. That of 83 runs with their disturbances has 10 MB."""

MAX_REASON = 300
"""Characters of the reason why a run is left out."""

MAX_OFFSET = 100_000
"""Steps from a disturbance to the end of its distance curve."""

SETTINGS = (
    *("env.name", "data.quality", "data.path", "data.random_share", "seed"),
    *("trainer.steps", "trainer.device", "trainer.num_threads"),
)
"""Settings that a report reads."""

LARGEST = 1e12
"""Of returns and scores; beyond it sums of squares lose their digits."""

DISTANCES = {
    "mean": "distance",
    "count": "count",
    "clean_mean": "undisturbed_distance",
    "clean_count": "undisturbed_count",
}
"""Entries of a robustness file's distance curves, and their columns."""


class LeftOut(NamedTuple):
    """A run, or a file of one, that is not in the report.

    Attributes:
        path: of the folder or file; for a table, with the number of the line.
        reason: in words.
    """

    path: str
    reason: str


@dataclass(frozen=True)
class Run:
    """One finished run.

    Attributes:
        folder: where it was found.
        method: its name in the report.
        config: the whole configuration, with dotted keys.
        overrides: of the command line; ``None`` if they were not recorded.
        data_score: mean normalised score of the data's episodes, if it is known.
        versions: of the packages, as far as recorded.
        episodes: a row for each episode, see :class:`RunTables`.
        distances: a row for each step of a distance curve, see :class:`RunTables`.
        protocols: by suite, what must be equal for results to be compared.
    """

    folder: str
    method: str
    config: Mapping[str, Any]
    overrides: tuple[str, ...] | None
    data_score: float | None
    versions: Mapping[str, str]
    episodes: pd.DataFrame
    distances: pd.DataFrame
    protocols: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def env(self) -> str:
        """Short name of the task."""
        return str(self.config["env.name"])

    @property
    def data(self) -> str:
        """Name of the data set."""
        share, path = self.config["data.random_share"], self.config["data.path"]
        mixed = f", {100 * share:g} % random" if share else ""
        recorded = f" {path}" if path else ""
        return f"{self.env} {self.config['data.quality']}{recorded}{mixed}"

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.config["seed"])

    @property
    def steps(self) -> int:
        """Gradient steps of the policy."""
        return int(self.config["trainer.steps"])

    @property
    def evaluated_at(self) -> list[int]:
        """Steps of the undisturbed evaluations."""
        undisturbed = self.episodes["suite"] == ""
        return [int(step) for step in self.episodes["step"][undisturbed].unique()]


@dataclass(frozen=True)
class RunTables:
    """All runs of a report.

    Attributes:
        runs: in the order in which they were found.
        episodes: a row for each episode: ``run`` (its number), ``data``, ``method``,
            ``seed``, ``suite`` (``""``: the training's own evaluations),
            ``disturbance`` (``""``: none), ``kind``, ``strength``, ``step`` of the
            checkpoint, ``episode`` (its seed), ``score``. For disturbances that end,
            ``transient``: whether the episode ``reached`` it and ``stood`` at its end,
            whether it was ``alive_after``, or without it ``undisturbed_alive``, 0, 1
            or NaN if that is not known, and ``recovery_steps``, infinite where it did
            not recover.
        distances: a row for each ``offset`` from such a disturbance, with the mean
            ``distance`` to the data of the ``count`` episodes that still last, and
            those of their undisturbed partners.
        left_out: what could not be used.
    """

    runs: Sequence[Run]
    episodes: pd.DataFrame
    distances: pd.DataFrame
    left_out: Sequence[LeftOut]

    @property
    def methods(self) -> list[str]:
        """The methods, in the order of their first runs."""
        return list(dict.fromkeys(run.method for run in self.runs))

    @property
    def data(self) -> list[str]:
        """The data sets, in the order of their first runs."""
        return list(dict.fromkeys(run.data for run in self.runs))

    @property
    def suites(self) -> list[str]:
        """The suites, in the order of their first runs."""
        return list(
            dict.fromkeys(suite for run in self.runs for suite in run.protocols)
        )

    def cells(self) -> dict[tuple[str, str], list[Run]]:
        """The runs of each data set and method: those that may be averaged."""
        found: dict[tuple[str, str], list[Run]] = {}
        for run in self.runs:
            found.setdefault((run.data, run.method), []).append(run)
        return found


def tables_of(runs: Sequence[Run], left_out: Sequence[LeftOut] = ()) -> RunTables:
    """Put the runs' episodes into one table, and their distances into another."""
    keys = [
        {"run": number, "data": run.data, "method": run.method, "seed": run.seed}
        for number, run in enumerate(runs)
    ]
    episodes, distances = (
        pd.concat([getattr(run, name).assign(**key) for run, key in
                   zip(runs, keys, strict=True)], ignore_index=True)
        for name in ("episodes", "distances")
    )  # fmt: skip
    return RunTables(runs, episodes, distances, left_out)


def read_each(paths: Iterable[Path]) -> tuple[list[Run], list[LeftOut]]:
    """Read every run in or below the folders and in the tables.

    Args:
        paths: folders of runs, or above them, and tables (``.jsonl.gz``). A run that is
            below two of the folders counts once.

    Returns:
        The finished runs, and what was left out.

    Raises:
        FileNotFoundError: if a path does not exist.
    """
    runs: list[Run] = []
    left_out: list[LeftOut] = []
    for path, load in _sources(paths):
        try:
            run, unusable = parse_run(load())
        # A foreign file may hold anything; no run but its own may suffer from it.
        except Exception as error:
            left_out.append(LeftOut(*_encodable([path, _reason(error)])))
        else:
            runs.append(run)
            left_out += [
                LeftOut(*_encodable([f"{path}/{name}", why])) for name, why in unusable
            ]
    return runs, left_out


def pack_runs(folders: Iterable[Path], table: Path) -> int:
    """Write the runs in or below the folders into one table.

    Args:
        folders: of finished runs, or above them.
        table: the ``.jsonl.gz`` file, replaced when all is read.

    Returns:
        The number of runs.

    Raises:
        OSError: if a file cannot be read or written.
        ValueError: if there is no run, or one that is not finished or makes no sense,
            naming it.
    """
    found = [folder for top in folders for folder in _folders(top)]
    if not found:
        raise ValueError("there is no run in the folders.")
    above = os.path.commonpath([folder.absolute().parent for folder in found])
    records = []
    for folder in found:
        record = read_record(folder)
        _, unusable = parse_run(record)
        if unusable:
            raise ValueError(f"{folder}: {'; '.join(map(': '.join, unusable))}")
        name = folder.absolute().relative_to(above).as_posix()
        records.append(record | {"folder": name})
    write_records(records, table)
    return len(records)


def write_records(records: Iterable[Mapping[str, Any]], table: Path) -> None:
    """Write records into a table, all or nothing; equal records, equal bytes."""
    lines = [json.dumps(each, separators=(",", ":")) + "\n" for each in records]
    write_atomically(table, gzip.compress("".join(lines).encode(), mtime=0))


def read_records(table: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a table.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is damaged or too large, naming the line.
    """
    for name, line in _lines(table):
        yield parse_json(line, name)


def read_record(folder: Path) -> dict[str, Any]:
    """Gather the small files of a run's folder.

    Args:
        folder: of the run.

    Returns:
        ``folder``, ``method``, ``overrides``, and the contents of ``config``,
        ``status``, ``returns``, ``inverse_dynamics`` (``None`` without a model) and
        ``robustness``, the last by name of the file; a damaged one is a text that says
        why.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if a file is damaged, or the run is not finished.
    """
    config = read_yaml(folder / CONFIG)
    status = read_json(folder / STATUS)
    check_status(status)
    overrides = folder / ".hydra" / "overrides.yaml"
    model = folder / "inverse_dynamics.json"
    robustness: dict[str, Any] = {}
    for path in sorted(folder.glob("robustness-*.json")):
        try:
            robustness[path.name] = read_json(path)
        except (OSError, ValueError) as error:
            robustness[path.name] = _reason(error)
    record = {
        "folder": str(folder),
        "config": config,
        "overrides": read_yaml(overrides) if overrides.exists() else None,
        "status": status,
        "returns": read_json(folder / RETURNS),
        "inverse_dynamics": read_json(model) if model.exists() else None,
        "robustness": robustness,
    }
    return record | {"method": _method(folder, record)}


def check_status(status: Mapping[str, Any]) -> None:
    """Raise unless a run is done.

    Raises:
        ValueError: saying how it stands.
    """
    if status["status"] != "done":
        why = "".join(
            f": {status[key]}" for key in ("error", "reason") if key in status
        )
        raise ValueError(f"not finished, its status is {status['status']}{why}")


def parse_run(record: Mapping[str, Any]) -> tuple[Run, list[tuple[str, str]]]:
    """Check a record and make it a run.

    Args:
        record: see :func:`read_record`.

    Returns:
        The run; names of the robustness files that could not be used, and why.

    Raises:
        ValueError: if the run is not finished, or its numbers make no sense.
        KeyError: if an entry is missing.
    """
    check_status(record["status"])
    if _depth(record["config"]) > MAX_CONFIG_DEPTH:
        raise ValueError(
            f"the configuration is nested more than {MAX_CONFIG_DEPTH} deep"
        )
    names = ("folder", "method", "config", "overrides")
    folder, method, config, overrides = _encodable([record[name] for name in names])
    config = flatten(config)
    for key in SETTINGS:  # a configuration of another program has none of them
        config[key]
    returns, steps = record["returns"], config["trainer.steps"]
    if not isinstance(steps, int):
        raise ValueError(f"trainer.steps is {steps!r}, no number of steps")
    parts = [_training_episodes(returns["evaluations"], config["env.name"], steps)]
    distances = [_stack([NO_CURVE])]
    versions = [returns["versions"]]
    protocols: dict[str, dict[str, Any]] = {}
    unusable = []
    for name, content in record["robustness"].items():
        try:
            suite, episodes, curves = _parse_suite(content)
            if suite in protocols:
                raise ValueError(f"a second file of suite {suite!r}")
            protocols[suite] = _protocol(episodes, steps)
        except Exception as error:  # as in read_each: the run itself is not to suffer
            unusable.append((name, _reason(error)))
        else:
            parts.append(episodes)
            distances.append(curves)
            versions.append(content["versions"])
    score = returns["data_score"]
    run = Run(
        folder=str(folder),
        method=str(method),
        config=config,
        overrides=None if overrides is None else tuple(map(str, overrides)),
        data_score=None if score is None else float(_finite([score], "data_score")[0]),
        versions=_merge_versions(versions),
        episodes=pd.concat(parts, ignore_index=True),
        distances=pd.concat(distances, ignore_index=True),
        protocols=protocols,
    )
    # What the report asks of a run later is asked here, where it can be refused.
    if not run.data or not 0 <= run.seed < 2**63:
        raise ValueError(f"seed {run.seed} of {run.data!r} is none")
    return run, unusable


def _folders(top: Path) -> list[Path]:
    """Folders of runs in or below a folder, in the order of their paths."""
    if not top.exists():
        raise FileNotFoundError(f"{top} does not exist.")
    return [
        path.parent
        for path in sorted(top.rglob(CONFIG))
        # Hydra keeps a second config.yaml in a hidden folder.
        if not any(part[0] == "." for part in path.relative_to(top).parts)
    ]


def _sources(
    paths: Iterable[Path],
) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Yield where each record is, and what reads it."""
    seen = set()
    for top in paths:
        if top.is_file():
            try:
                for name, line in _lines(top):
                    yield name, partial(parse_json, line, name)
            except (OSError, ValueError) as error:
                yield str(top), partial(_refuse, error)
            continue
        for folder in _folders(top):
            if folder.resolve() not in seen:
                seen.add(folder.resolve())
                yield str(folder), partial(read_record, folder)


def _refuse(error: Exception) -> NoReturn:
    raise error


def _lines(table: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines of a packed table with their names, within bounds."""
    left, number = MAX_TABLE_BYTES, 0
    try:
        with gzip.open(table, "rb") as file:
            while line := file.readline(min(left, MAX_JSON_BYTES) + 1):
                left, number = left - len(line), number + 1
                if left < 0 or len(line) > MAX_JSON_BYTES:
                    raise ValueError(
                        f"it unpacks to more than {MAX_TABLE_BYTES:,} bytes, or to "
                        f"{MAX_JSON_BYTES:,} in one line"
                    )
                yield f"{table}, line {number}", line.decode("utf-8", "replace")
    except (EOFError, zlib.error) as error:
        raise ValueError(f"it is damaged behind line {number}: {error}") from error


def _method(folder: Path, record: Mapping[str, Any]) -> str:
    """Name of a run's method: that of its folder, or of its loss.

    Folders that are laid out as ``<env>-<quality>/<method>/seed<k>`` say it themselves.

    Raises:
        ValueError: if such a folder contradicts the run's configuration.
    """
    config = flatten(record["config"])
    data, method, seed = ("", "", *folder.resolve().parts)[-3:]
    if re.fullmatch(r"seed\d+", seed) and data.split("-")[0] in REFERENCE_RETURNS:
        here = f"{config['env.name']}-{config['data.quality']}"
        if not data.startswith(here) or seed != f"seed{config['seed']}":
            raise ValueError(
                f"the folder says {data} and {seed}, its configuration {here} and "
                f"seed{config['seed']}"
            )
        return method
    choices = folder / ".hydra" / "hydra.yaml"
    if choices.exists():
        return str(read_yaml(choices)["hydra"]["runtime"]["choices"]["loss"])
    for override in record["overrides"] or ():
        if str(override).startswith("loss="):
            return str(override).removeprefix("loss=")
    target = str(config["loss._target_"]).rpartition(".")[2]
    return target.removesuffix("Loss").lower()


def _training_episodes(
    evaluations: Sequence[Mapping[str, Any]], env: str, steps: int
) -> pd.DataFrame:
    """Return the undisturbed episodes of the training's own evaluations."""
    at = [row["step"] for row in evaluations]
    if not at or at[-1] != steps:
        last = at[-1] if at else 0
        raise ValueError(f"not finished, evaluated last at step {last} of {steps}")
    if at[0] < 0 or not all(low < high for low, high in pairwise(at)):
        raise ValueError("evaluations are not in the order of their steps")
    parts = []
    for row in evaluations:
        where = f"step {row['step']}"
        if row["seeds"] != evaluations[0]["seeds"]:
            raise ValueError(f"episodes of {where} have other seeds")
        returns = _numbers(row["returns"], row["seeds"], where)
        parts.append(
            _rows("", row["step"], row["seeds"], normalized_score(env, returns))
        )
    return _stack(parts)


def _parse_suite(content: Any) -> tuple[str, pd.DataFrame, pd.DataFrame]:
    """Return a robustness file's suite, episodes and distances."""
    if not isinstance(content, dict):
        raise ValueError(str(content))  # why it could not be read
    if content["format"] != ROBUSTNESS_FORMAT:
        raise ValueError(
            f"its format is {content['format']!r}, known is {ROBUSTNESS_FORMAT}"
        )
    if not content["evaluations"]:
        raise ValueError("it has no evaluations")
    suite = _encodable(str(content["suite"]))
    first = [_level(each) for each in content["evaluations"][0]["levels"]]
    names = {name for name, *_ in first}
    if not suite or not first or "" in names or len(names) < len(first):
        raise ValueError("suite and levels need one name each")
    episodes, curves = [], [NO_CURVE]
    for row in content["evaluations"]:
        step, seeds = row["step"], row["clean"]["seeds"]
        if [_level(each) for each in row["levels"]] != first:
            raise ValueError(f"step {step} has other levels than the first step")
        clean = _numbers(row["clean"]["scores"], seeds, f"step {step}, clean")
        episodes.append(_rows(suite, step, seeds, clean))
        for level, (name, kind, strength) in zip(row["levels"], first, strict=True):
            scores = _numbers(level["scores"], seeds, f"step {step}, {name}")
            ends = level["recovery_steps"] is not None
            way_back = level if ends else None
            episodes.append(
                _rows(suite, step, seeds, scores, name, kind, strength, way_back)
            )
            if ends:
                if max(level["distance"]["offset"], default=-1) < 0:
                    raise ValueError(f"{name}: no distance after the disturbance")
                where = {"suite": suite, "disturbance": name, "step": int(step)}
                curves.append(_curve(level["distance"], where))
    return suite, _stack(episodes), _stack(curves)


def _rows(
    suite: str,
    step: int,
    seeds: Sequence[int],
    scores: Any,
    disturbance: str = "",
    kind: str = "",
    strength: float = math.nan,
    level: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the columns of one checkpoint's episodes; ``level`` is one that ends."""
    columns = {
        "suite": suite,
        "disturbance": disturbance,
        "kind": kind,
        "strength": strength,
        "step": int(step),
        "episode": np.array(seeds, dtype=np.int64),
        "score": scores,
        "transient": level is not None,
        "reached": False,
        "stood": math.nan,
        "alive_after": math.nan,
        "undisturbed_alive": math.nan,
        "recovery_steps": math.inf,
    }
    if level is not None:
        steps = [math.inf if each is None else each for each in level["recovery_steps"]]
        columns |= {
            "reached": np.array([at is not None for at in level["disturbed_at"]]),
            "stood": np.array(level["survived_knock"], dtype=np.float64),
            "alive_after": np.array(level["alive_after"], dtype=np.float64),
            "undisturbed_alive": np.array(level["clean_alive_after"], dtype=np.float64),
            "recovery_steps": np.array(steps, dtype=np.float64),
        }
    return _broadcast(columns, len(seeds))


def _broadcast(columns: Mapping[str, Any], rows: int) -> dict[str, Any]:
    """Return every column with a value for each row."""
    for name, column in columns.items():
        if np.ndim(column) and np.shape(column) != (rows,):
            raise ValueError(f"{name} has not {rows} entries")
    return {name: np.broadcast_to(each, rows) for name, each in columns.items()}


def _stack(parts: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return columns below each other as one table."""
    return pd.DataFrame(
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    )


def _curve(distance: Mapping[str, Any], where: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a distance curve; NaN where there is no number."""
    offsets = np.array(distance["offset"], dtype=np.int64)
    columns = {"offset": offsets} | {
        name: np.array(distance[key], dtype=np.float64)
        for key, name in DISTANCES.items()
    }
    if any((np.abs(column) > MAX_OFFSET).any() for column in columns.values()):
        raise ValueError(f"a distance, or an offset, is beyond {MAX_OFFSET:,}")
    return _broadcast({**where, **columns}, len(offsets))


def _level(level: Mapping[str, Any]) -> tuple[str, str, float]:
    """Return name, kind and strength of a disturbance."""
    (strength,) = _finite([level["strength"]], "strength")
    name, kind = _encodable([str(level["name"]), str(level["kind"])])
    return name, kind, float(strength)


def _protocol(episodes: pd.DataFrame, steps: int) -> dict[str, Any]:
    """Return what must be equal for two results of a suite to be compared."""
    clean = episodes[episodes["disturbance"] == ""]
    at = clean["step"].unique().tolist()
    return {
        "checkpoints": f"last {len(at)}" if at[-1] == steps else at,
        "episodes": len(clean),
        "episode seeds": clean["episode"].tolist(),
        "levels": episodes[["disturbance", "kind", "strength"]]
        .drop_duplicates()
        .dropna()
        .to_numpy()
        .tolist(),
    }


def _numbers(values: Any, seeds: Sequence[Any], where: str) -> Any:
    """Return an episode's numbers, one for each seed and all of them finite."""
    if len(values) != len(seeds) or not values or len(set(seeds)) < len(seeds):
        raise ValueError(f"numbers and seeds of {where} do not match")
    return _finite(values, where)


def _finite(values: Any, where: str) -> Any:
    """Return numbers as an array, all of them finite."""
    numbers = np.array(values, dtype=np.float64)
    if numbers.ndim != 1 or not (np.abs(numbers) < LARGEST).all():
        raise ValueError(f"a number of {where} is not finite, or beyond {LARGEST:g}")
    return numbers


def _merge_versions(sources: Iterable[Mapping[str, str] | None]) -> dict[str, str]:
    """Return each package's version; several of one run stay visible as such."""
    found: dict[str, list[str]] = {}
    for source in sources:
        for package, version in (source or {}).items():
            package, version = _encodable([str(package), str(version)])
            versions = found.setdefault(package, [])
            if version not in versions:
                versions.append(version)
    return {package: " and ".join(each) for package, each in found.items()}


def _depth(value: Any, most: int = MAX_CONFIG_DEPTH) -> int:
    """Levels of nesting; one more than ``most`` if there are more."""
    inner = value.values() if isinstance(value, dict) else value
    if not isinstance(value, (dict, list)) or most < 0:
        return 0
    return 1 + max((_depth(each, most - 1) for each in inner), default=0)


def _encodable(value: Any) -> Any:
    """Return texts that can be written as UTF-8, whatever a file escaped."""
    return json.loads(json.dumps(value, ensure_ascii=False).encode("utf-8", "replace"))


def _reason(error: Exception) -> str:
    """Return why something could not be used, on one line."""
    if isinstance(error, KeyError):
        return f"there is no entry {error}"[:MAX_REASON]
    named = isinstance(error, (OSError, ValueError))
    text = str(error) if named else f"{type(error).__name__}: {error}"
    return text.split("\n")[0][:MAX_REASON] or type(error).__name__


NO_CURVE = _curve(
    {"offset": [], **{key: [] for key in DISTANCES}},
    {"suite": "", "disturbance": "", "step": 0},
)
