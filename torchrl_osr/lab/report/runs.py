"""Runs of a report: found in folders or in a table, read within bounds, checked.

The small files of a run make one JSON object, its *record*. A table of runs
(``runs.jsonl.gz``) has a record on each line; :func:`pack_runs` writes one. Whatever is
in a record, it can only make its own run unreadable.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._files import MAX_JSON_BYTES, parse_json, read_json, write_atomically
from torchrl_osr.lab.data import ReferenceReturns, reference_returns
from torchrl_osr.lab.evaluation.recoverable import GROUPS, disturbances_of
from torchrl_osr.lab.run.run_config import flatten, read_yaml
from torchrl_osr.lab.run.run_folder import CONFIG, read_status
from torchrl_osr.lab.run.schema import method_name

SOURCE = "data.source"
"""Setting that names the source of the data set."""

ROBUSTNESS_FORMAT = 1
MAX_TABLE_BYTES = 4 * MAX_JSON_BYTES
"""Of a table of runs, unpacked. That of 83 runs with their disturbances has 10 MB."""

MAX_REASON = 300
"""Characters of the reason why a run is left out."""

MAX_STATES = 10_000
"""Of a task, from which a run was played."""

MAX_OFFSETS = 10_000
"""Entries of a distance curve; 2,000 resamples of so many have 160 MB."""

LARGEST = 1e12
"""Of returns and scores; beyond it sums of squares lose their digits."""

RECOVERY = {
    "disturbed_at": "disturbed_at",
    "survived_knock": "stood",
    "alive_after": "alive_after",
    "clean_alive_after": "undisturbed_alive",
    "recovery_steps": "recovery_steps",
}
"""Entries of a disturbance that ends, a number an episode, and their columns."""

EPISODE = (
    *("suite", "disturbance", "step", "episode", "score"),
    *RECOVERY.values(),
)
CURVE = ("suite", "disturbance", "step", "offset", "mean", "count")
SAVED = ("states", "group", "disturbance", "walk", "back")
"""Columns of the tables of episodes, of distance curves and of recoverable states."""


class LeftOut(NamedTuple):
    """A run, or a file of one, that is not in the report.

    Attributes:
        path: of the folder or file; for a table, with the number of the line.
        reason: in words.
    """

    path: str
    reason: str


class Run(NamedTuple):
    """One finished run.

    Attributes:
        facts: ``folder``, ``method``, ``data``, ``seed``, ``steps``, ``measure``,
            ``data_score``, ``overrides`` and ``versions``.
        settings: the configuration as texts, with dotted keys.
        protocols: how each suite was played; only like ones are compared.
        episodes: a row for each episode, see
            :class:`~torchrl_osr.lab.report.RunTables`.
        distances: a row for each step of a distance curve, see there.
        saved: a row for each recoverable state, see there.
        unusable: files of disturbances or states that could not be used.
    """

    facts: dict[str, Any]
    settings: dict[str, str]
    protocols: list[dict[str, str]]
    episodes: pd.DataFrame
    distances: pd.DataFrame
    saved: pd.DataFrame
    unusable: list[LeftOut]


def read_each(paths: Sequence[Path]) -> tuple[list[Run], list[LeftOut]]:
    """The finished runs in or below folders and in tables, and what was left out.

    Raises:
        FileNotFoundError: if a path does not exist.
    """
    runs: list[Run] = []
    left_out: list[LeftOut] = []

    def add(path: str, read: Callable[[], dict[str, Any]]) -> None:
        try:
            run = parse_run(read())
        # A foreign file may hold anything; no run but its own may suffer from it.
        except Exception as error:
            left_out.append(LeftOut(_encodable(path), _reason(error)))
        else:
            runs.append(run)
            left_out.extend(run.unusable)

    for folder in find_runs(path for path in paths if not path.is_file()):
        add(str(folder), partial(read_record, folder))
    for table in (path for path in paths if path.is_file()):
        try:
            for name, line in _lines(table):
                add(name, partial(parse_json, line, name))
        except (OSError, ValueError) as error:
            left_out.append(LeftOut(str(table), _reason(error)))
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
    found = find_runs(folders)
    if not found:
        raise ValueError("there is no run in the folders.")
    above = os.path.commonpath([folder.absolute().parent for folder in found])
    lines = []
    for folder in found:
        record = read_record(folder)
        for path, reason in parse_run(record).unusable:
            raise ValueError(f"{path}: {reason}")
        record["folder"] = folder.absolute().relative_to(above).as_posix()
        lines.append(json.dumps(record, separators=(",", ":")) + "\n")
    # Without the time: equal records, equal bytes.
    write_atomically(table, gzip.compress("".join(lines).encode(), mtime=0))
    return len(lines)


def read_records(table: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a table.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is damaged or too large, naming the line.
    """
    for name, line in _lines(table):
        yield parse_json(line, name)


def read_record(folder: Path) -> dict[str, Any]:
    """The small files of a run's folder.

    Returns:
        ``folder``, ``method``, ``overrides``, and the contents of ``config``,
        ``status``, ``returns``, ``inverse_dynamics`` (``None`` without a model),
        ``robustness`` and ``recoverable``, the last two by name of the file; a damaged
        one is a text that says why.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if a file is damaged, or the run is not finished.
    """
    config = read_yaml(folder / CONFIG)
    status = read_status(folder)
    if status["status"] != "done":
        why = "".join(
            f": {status[key]}" for key in ("error", "reason") if key in status
        )
        raise ValueError(f"not finished, its status is {status['status']}{why}")
    hydra = read_yaml(folder / ".hydra" / "hydra.yaml")["hydra"]
    above, name = folder.resolve().parts[-2:]
    in_layout = name == f"seed{config['seed']}"
    model = folder / "inverse_dynamics.json"
    played: dict[str, dict[str, Any]] = {"robustness": {}, "recoverable": {}}
    for kind, files in played.items():
        for path in sorted(folder.glob(f"{kind}-*.json")):
            try:
                files[path.name] = read_json(path)
            except (OSError, ValueError) as error:
                files[path.name] = _reason(error)
    return {
        "folder": str(folder),
        "config": config,
        "overrides": hydra["overrides"]["task"],
        "status": status,
        "returns": read_json(folder / "returns.json"),
        "inverse_dynamics": read_json(model) if model.exists() else None,
        "method": above if in_layout else method_name(hydra["runtime"]["choices"]),
        **played,
    }


def parse_run(record: Mapping[str, Any]) -> Run:
    """The run of a record of :func:`read_record`.

    Raises:
        ValueError: if its numbers make no sense.
        KeyError: if an entry is missing.
    """
    record = _encodable(record)
    config, returns = flatten(record["config"]), record["returns"]
    env, steps = config["env.name"], config["trainer.steps"]
    path, share = config["data.path"], config["data.random_share"]
    references = reference_returns(
        env, config.get("env.random_return"), config.get("env.expert_return")
    )
    measure = "return" if references is None else "score"
    mean = returns[f"data_{measure}"]
    if mean is not None and not abs(mean) < LARGEST:
        raise ValueError(f"data_{measure} is {mean}, no finite {measure}")
    episodes = [_training_episodes(returns["evaluations"], references, steps)]
    distances = [_table([], CURVE)]
    versions = [returns["versions"]]
    protocols: list[dict[str, str]] = []
    unusable = []
    for name, content in record["robustness"].items():
        try:
            played, curves = _suite_episodes(content, f"{measure}s")
            suite = _protocol(content, steps)
            if suite["suite"] in [each["suite"] for each in protocols]:
                raise ValueError(f"a second file of suite {suite['suite']!r}")
        except Exception as error:  # as in read_each: the run itself is not to suffer
            unusable.append(LeftOut(f"{record['folder']}/{name}", _reason(error)))
        else:
            episodes.append(played)
            distances.append(curves)
            protocols.append(suite)
            versions.append(content["versions"])
    saved = [pd.DataFrame(columns=SAVED)]
    # Tables of runs that were written before there were such states have none.
    for name, content in record.get("recoverable", {}).items():
        try:
            saved.append(_saved_states(content))
        except Exception as error:
            unusable.append(LeftOut(f"{record['folder']}/{name}", _reason(error)))
        else:
            versions.append(content["versions"])
    facts = {
        "folder": str(record["folder"]),
        "method": str(record["method"]),
        "data": f"{env} {config[SOURCE]}{f' {path}' if path else ''}"
        + (f", {100 * share:g} % random" if share else ""),
        "seed": int(config["seed"]),
        "steps": int(steps),
        "measure": "score" if references else f"return of {env}",
        "data_score": None if mean is None else float(mean),
        "overrides": " ".join(map(str, record["overrides"] or ())),
        "versions": sorted(
            {f"{name} {each}" for of in versions for name, each in (of or {}).items()}
        ),
    }
    return Run(
        facts,
        {key: str(value) for key, value in config.items()},
        protocols,
        pd.concat(episodes, ignore_index=True),
        pd.concat(distances, ignore_index=True),
        pd.concat(saved, ignore_index=True),
        unusable,
    )


def find_runs(tops: Iterable[Path]) -> list[Path]:
    """Folders of runs in or below the folders, each once, in the order of paths.

    Raises:
        FileNotFoundError: if one of the folders does not exist.
    """
    found: dict[Path, Path] = {}
    for top in tops:
        if not top.exists():
            raise FileNotFoundError(f"{top} does not exist.")
        found |= {
            path.parent.resolve(): path.parent
            for path in sorted(top.rglob(CONFIG))
            # Hydra keeps a second config.yaml in a hidden folder.
            if not any(part[0] == "." for part in path.relative_to(top).parts)
        }
    return list(found.values())


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


def _training_episodes(
    evaluations: Sequence[Mapping[str, Any]],
    references: ReferenceReturns | None,
    steps: int,
) -> pd.DataFrame:
    """Undisturbed episodes of the training's own evaluations."""
    at = [row["step"] for row in evaluations]
    if not at:
        raise ValueError("its policy was never played: there was no simulator")
    if at[-1] != steps:
        raise ValueError(f"not finished, evaluated last at step {at[-1]} of {steps}")
    rows = [
        {
            "suite": "",
            "disturbance": "",
            "step": row["step"],
            "episode": row["seeds"],
            "score": row["returns"],
        }
        for row in evaluations
    ]
    episodes = _table(rows, EPISODE)
    if references is None:
        return episodes
    return episodes.assign(score=references.score(episodes["score"].to_numpy()))


def _suite_episodes(content: Any, values: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Episodes of a robustness file, and the distance curves of its disturbances."""
    if not isinstance(content, dict):
        raise ValueError(str(content))  # why it could not be read
    if content["format"] != ROBUSTNESS_FORMAT:
        raise ValueError(
            f"its format is {content['format']!r}, known is {ROBUSTNESS_FORMAT}"
        )
    episodes, curves = [], []
    for row in content["evaluations"]:
        clean = {"name": "", "recovery_steps": None, **row["clean"]}
        for level in (clean, *row["levels"]):
            where = {
                "suite": str(content["suite"]),
                "disturbance": str(level["name"]),
                "step": row["step"],
            }
            numbers = {"episode": row["clean"]["seeds"], "score": level[values]}
            if level["recovery_steps"] is not None:  # it ends
                numbers |= {name: level[key] for key, name in RECOVERY.items()}
                curve = {
                    key: level["distance"][key] for key in ("offset", "mean", "count")
                }
                if max(curve["offset"]) < 0 or len(curve["offset"]) > MAX_OFFSETS:
                    raise ValueError(
                        "there is no distance after the disturbance, or there are "
                        f"more than {MAX_OFFSETS:,}"
                    )
                curves.append(where | curve)
            episodes.append(where | numbers)
    return _table(episodes, EPISODE), _table(curves, CURVE)


def _saved_states(content: Any) -> pd.DataFrame:
    """The states of a file, and the share of its checkpoints that each was saved by."""
    if not isinstance(content, dict):
        raise ValueError(str(content))  # why it could not be read
    if content["format"] != ROBUSTNESS_FORMAT:
        raise ValueError(
            f"its format is {content['format']!r}, known is {ROBUSTNESS_FORMAT}"
        )
    half, group, walk = str(content["half"]), content["group"], content["walk"]
    back = np.array([each["back"] for each in content["evaluations"]])
    if not 0 < len(group) <= MAX_STATES or back.shape[1:] != (len(group),):
        raise ValueError(
            f"it has {len(group)} states, and answers of the shape {back.shape}"
        )
    if not np.isin(back, (0, 1)).all() or not {*group} <= {*GROUPS}:
        raise ValueError(f"answers are not 0 or 1, or groups are none of {GROUPS}")
    disturbance = content["disturbance"]
    disturbances_of(disturbance)
    # The same number of the same groups may be other states.
    of_each = json.dumps([group, disturbance, walk])
    digest = hashlib.sha256(of_each.encode()).hexdigest()
    columns = {"states": f"{half} {digest[:6]}", "group": group, "back": back.mean(0)}
    columns |= {"disturbance": disturbance, "walk": np.array(walk, dtype=np.int64)}
    return pd.DataFrame(columns)


def _protocol(content: Mapping[str, Any], steps: int) -> dict[str, str]:
    """What must be equal for two results of a suite to be compared, as texts."""
    evaluations = content["evaluations"]
    at = [row["step"] for row in evaluations]
    seeds = [row["clean"]["seeds"] for row in evaluations]
    levels = [
        [(each["name"], each["kind"], each["strength"]) for each in row["levels"]]
        for row in evaluations
    ]
    if not levels or not levels[0] or levels.count(levels[0]) < len(levels):
        raise ValueError("it needs evaluations, all of the same levels")
    if not content["suite"] or "" in [name for name, *_ in levels[0]]:
        raise ValueError("a suite and its levels need names")
    protocol = {
        "suite": content["suite"],
        "checkpoints": f"last {len(at)}" if at[-1] == steps else at,
        "episodes": sum(map(len, seeds)),
        "seeds": seeds,
        "levels": levels[0],
    }
    return {name: str(value) for name, value in protocol.items()}


def _table(parts: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """The parts below each other; numbers that are not plausible are refused.

    Args:
        parts: of each its columns: one value for all rows, or a list.
        columns: of the table; what a part lacks is NaN.

    Raises:
        ValueError: if a part has no rows or lists of different lengths, or a number is
            huge, or missing where it has to be there.
    """
    frames = [pd.DataFrame(part) for part in parts]
    if any(frame.empty for frame in frames):
        raise ValueError("there are no episodes")
    frame = pd.concat([pd.DataFrame(columns=columns), *frames])
    numbers = frame.drop(columns=["suite", "disturbance"]).astype(float)
    if not (numbers.isna() | (numbers.abs() < LARGEST)).all(axis=None):
        raise ValueError(f"a number is beyond {LARGEST:g}")
    known = numbers.columns.intersection(
        ["step", "episode", "score", "offset", "count"]
    )
    if numbers[known].isna().any(axis=None):
        raise ValueError("a number is missing or not finite")
    integers = known.difference(["score", "count"])
    return frame.assign(**numbers).astype(dict.fromkeys(integers, "int64"))


def _encodable(value: Any) -> Any:
    """JSON-compatible value whose texts can be written as UTF-8."""
    return json.loads(json.dumps(value, ensure_ascii=False).encode("utf-8", "replace"))


def _reason(error: Exception) -> str:
    """Why something could not be used, on one line."""
    if isinstance(error, KeyError):
        return f"there is no entry {error}"[:MAX_REASON]
    named = isinstance(error, (OSError, ValueError))
    text = str(error) if named else f"{type(error).__name__}: {error}"
    return str(_encodable(text.split("\n")[0][:MAX_REASON] or type(error).__name__))
