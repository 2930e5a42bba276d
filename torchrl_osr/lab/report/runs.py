"""Finished runs as data frames."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._files import read_json
from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation.robustness import RECOVERY
from torchrl_osr.lab.run.config import CONFIG, flatten, read_config, read_yaml
from torchrl_osr.lab.run.evaluate_offline import OFFLINE
from torchrl_osr.lab.run.folder import HYDRA, RESUMABLE, read_status
from torchrl_osr.lab.run.schema import method_name

IGNORED = (
    *sorted({*RESUMABLE} - {"trainer.steps", "trainer.eval_interval"}),
    *("resume", "seed", "data.checksum", "logger."),
    *("trainer.compile", "trainer.checkpoint_interval", "loss.deactivate_vmap"),
)
"""The seed, and settings that change how a number is computed, but not the number."""

METHOD = (
    *("loss.", "recovery", "network.actor.", "optim.policy_delay", "perturbation."),
    *("inverse_dynamics.", "dynamics.", "optim.actor_schedule"),
)
"""Settings in which methods differ by intent; all others should be equal."""

NUM_NAMED, NAMED_WIDTH = 3, 40
"""At most so many differences are in a name, with so many characters of each value."""

ESTIMATED = "estimated return"
"""Measure of runs that were never played; a first state stands for an episode."""

SAVED = ["states", "group", "disturbance", "walk", "back"]


@dataclass(frozen=True)
class RunTables:
    """All runs of a report.

    Attributes:
        runs: a row for each run; ``data_score`` is the mean of the data's episodes.
        settings: its configuration as texts, a column for each dotted key.
        episodes: a row for each episode. ``suite`` is ``""`` for the training's own
            evaluations, ``disturbance`` for undisturbed episodes.
        saved: a row for each run and recoverable state; ``back`` is the share of the
            checkpoints that recovered.
        left_out: folder of each run that is not in the tables, and the reason.
    """

    runs: pd.DataFrame
    settings: pd.DataFrame
    episodes: pd.DataFrame
    saved: pd.DataFrame
    left_out: Sequence[tuple[str, str]]

    @property
    def methods(self) -> list[str]:
        """Methods, in the order of their first runs."""
        return list(self.runs["method"].unique())

    @property
    def data(self) -> list[str]:
        """Data sets, in the order of their first runs."""
        return list(self.runs["data"].unique())

    @property
    def measure(self) -> str:
        """Normalised score, or return of an environment."""
        return str(self.runs["measure"].iloc[0])

    @property
    def suites(self) -> list[str]:
        """Suites, in the order of their first runs."""
        return [name for name in self.episodes["suite"].unique() if name]


def find_runs(tops: Iterable[Path]) -> list[Path]:
    """Find the folders of runs in or below the folders, each once, sorted by path."""
    found: dict[Path, Path] = {}
    for top in tops:
        if not top.exists():
            raise FileNotFoundError(f"{top} does not exist.")
        hits = []
        for folder, below, files in os.walk(top):  # folders may vanish meanwhile
            # Hydra keeps a second config.yaml in a hidden folder, W&B in a run's.
            run = CONFIG in files
            below[:] = [x for x in below if x[0] != "." and not (run and x == "wandb")]
            hits += [Path(folder)] * run
        for path in sorted(hits):
            found.setdefault(path.resolve(), path)
    return list(found.values())


def read_runs(folders: Sequence[Path]) -> RunTables:
    """Read all finished runs in or below the folders, and name their methods.

    Runs of one method differ only in the seed, and in settings that depend on the data
    set. Other differences become part of the method's name. Of two runs of one method,
    data set and seed the one counts that is last in the order of folders and paths.
    """
    found: list[_Run] = []
    left_out: list[tuple[str, str]] = []
    for folder in find_runs(folders):
        try:
            run = _read(folder)
            # Scores and returns, or returns of two environments, have no mean.
            measure = (found or [run])[0].facts["measure"]
            if run.facts["measure"] != measure:
                raise ValueError(
                    f"measured in {run.facts['measure']}, not in {measure}"
                )
            found.append(run)
        # Another program's file may hold anything, and concerns its own run alone.
        except Exception as error:
            known = isinstance(error, (OSError, ValueError))
            text = str(error) if known else repr(error)
            left_out.append((str(folder), text.split("\n")[0]))
    if not found:
        reasons = "".join(f"\n  {name}: {reason}" for name, reason in left_out)
        raise ValueError(f"no finished run in {', '.join(map(str, folders))}.{reasons}")
    runs = pd.DataFrame([run.facts for run in found])
    settings = pd.DataFrame([run.settings for run in found]).fillna("none")
    # One name, other contents: a log that was corrected, for instance.
    contents = pd.DataFrame([run.contents for run in found])
    runs["data"] = tell_apart(runs["data"], contents)
    runs["method"] = tell_apart(runs["method"], comparable(settings), runs["data"])
    cell = ["method", "data", "seed"]
    last = runs.groupby(cell)["folder"].transform("last")
    again = runs.duplicated(cell, "last")
    left_out += [
        (folder, f"{later} has the same method, data and seed, and comes later")
        for folder, later in zip(runs["folder"][again], last[again], strict=True)
    ]
    runs = runs[~again]
    # Suites of one name that were played differently are different suites.
    played = [
        {"run": run} | each for run in runs.index for each in found[run].protocols
    ]
    protocols = pd.DataFrame(played or [{"run": -1, "suite": ""}])
    protocols = protocols.set_index(["run", "suite"])
    suites = protocols.index.get_level_values("suite").to_series(protocols.index)
    suites = tell_apart(suites, protocols).rename("named")

    def joined(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
        rows = pd.concat(dict(enumerate(parts)), names=["run", None]).reset_index("run")
        rows = rows.join(runs[["data", "method", "seed"]], on="run", how="inner")
        return rows.reset_index(drop=True)

    episodes = joined([run.episodes for run in found]).join(suites, on=["run", "suite"])
    episodes["suite"] = episodes.pop("named").fillna("")
    saved = joined([run.saved for run in found])
    return RunTables(runs, settings.loc[runs.index], episodes, saved, left_out)


class _Run(NamedTuple):
    """One run; ``contents`` identifies the data, ``protocols`` the suites."""

    facts: dict[str, Any]
    settings: dict[str, str]
    contents: dict[str, str]
    protocols: list[dict[str, str]]
    episodes: pd.DataFrame
    saved: pd.DataFrame


def _read(folder: Path) -> _Run:
    """Read a run; raise if it is not finished, or its numbers make no sense."""
    status = read_status(folder)
    if status["status"] != "done":
        why = [f": {status[key]}" for key in ("error", "reason") if key in status]
        raise ValueError(
            f"not finished, its status is {status['status']}{''.join(why)}"
        )
    config = flatten(read_config(folder))
    hydra = read_yaml(folder / HYDRA)["hydra"]
    choices = hydra["runtime"]["choices"]
    method = method_name(choices["loss"], choices.get("recovery"))
    returns = read_json(folder / "returns.json")
    env, steps, path = config["env.name"], config["trainer.steps"], config["data.path"]
    references = reference_returns(
        env, config.get("env.random_return"), config.get("env.expert_return")
    )
    measure = "return" if references is None else "score"
    measured = "normalised score" if references else f"return of {env}"
    evaluations = returns["evaluations"]
    judged = [f for f in (folder / f"body-{OFFLINE}", folder / OFFLINE) if f.exists()]
    if judged and not evaluations:  # judged by the data alone
        offline = read_json(judged[0])
        values = offline["values"]
        seeds = [*range(len(values))]
        each = {"step": offline["step"], "seeds": seeds, "returns": values}
        evaluations, references, measure = [each], None, "return"
        returns["data_return"] = offline["data_value"]
        kind = "in a body" if "xml" in offline else "by FQE"
        measured = f"{ESTIMATED} {kind} (discount {offline['discount']:g}) of {env}"
        for key in ("steps", "xml", "frame_skip"):
            config[f"offline.{key}"] = offline.get(key)
    if not evaluations or evaluations[-1]["step"] != steps:
        at = evaluations[-1]["step"] if evaluations else "none"
        raise ValueError(
            f"not finished, or never played: last evaluation at step {at}; "
            "'evaluate-offline' estimates a run that was never played"
        )
    rows, protocols, versions = [], [], [returns["versions"]]
    for each in evaluations:
        values = np.array(each["returns"], dtype=float)
        values = values if references is None else references.score(values)
        rows.append(_episodes("", each["step"], each["seeds"], values, {"name": ""}))
    for file in sorted(folder.glob("robustness-*.json")):
        # Named by the file: a renamed one holds other episodes.
        content = read_json(file) | {"suite": file.stem.removeprefix("robustness-")}
        if (at := content["evaluations"][-1]["step"]) != steps:
            content["suite"] += f"-at-{at}"
        rows.append(suite_episodes(content))
        protocols.append(_protocol(content))
        versions.append(content["versions"])
    episodes = pd.concat(rows)
    if not np.isfinite(episodes["score"]).all():
        raise ValueError("not all of its returns are finite numbers")
    saved = [pd.DataFrame(columns=SAVED)]
    for file in sorted(folder.glob("recoverable-*.json")):
        content = read_json(file) | {"half": file.stem.removeprefix("recoverable-")}
        if (at := content["evaluations"][-1]["step"]) != steps:
            content["half"] += f"-at-{at}"
        saved.append(saved_states(content))
        versions.append(content["versions"])
    above, name = folder.resolve().parts[-2:]
    in_layout = name == f"seed{config['seed']}"
    mean, share = returns[f"data_{measure}"], config["data.random_share"]
    data = f"{env} {config['data.source']}{f' {path}' if path else ''}"
    packages = {f"{name} {v}" for of in versions for name, v in (of or {}).items()}
    facts = {
        "folder": str(folder),
        "method": above if in_layout else method,
        "data": data + (f", {100 * share:g} % random" if share else ""),
        "seed": int(config["seed"]),
        "steps": int(steps),
        "measure": measured,
        "data_score": np.nan if mean is None else float(mean),
        "overrides": " ".join(map(str, hydra["overrides"]["task"] or ())),
        "versions": sorted(packages),
    }
    contents = {"mean": f"{facts['data_score']:.2f}"}
    contents["checksum"] = str(config.get("data.checksum") or "")[:8]
    settings = {key: str(value) for key, value in config.items()}
    states = pd.concat(saved, ignore_index=True)
    return _Run(facts, settings, contents, protocols, episodes, states)


def suite_episodes(content: Mapping[str, Any]) -> pd.DataFrame:
    """Return the episodes of a file of results under a suite, disturbed or not."""
    rows = []
    for each in content["evaluations"]:
        clean = {"name": "", **each["clean"]}
        measure = "scores" if "scores" in clean else "returns"
        for level in (clean, *each["levels"]):
            place = content["suite"], each["step"], clean["seeds"]
            rows.append(_episodes(*place, level[measure], level))
    return pd.concat(rows)


def _episodes(
    suite: str, step: int, seeds: list[int], scores: Any, level: Mapping[str, Any]
) -> pd.DataFrame:
    """Return the rows of one evaluation under a disturbance."""
    entries = {key: level.get(key) for key in ("disturbed_at", *RECOVERY)}
    numbers = {"step": step, "episode": seeds, "score": scores} | entries
    frame = pd.DataFrame(numbers, dtype=float)
    return frame.assign(suite=suite, disturbance=level["name"])


def _protocol(content: Mapping[str, Any]) -> dict[str, str]:
    """Return the facts that must be equal in comparable results of a suite."""
    evaluations = content["evaluations"]
    facts = {
        "suite": content["suite"],
        "checkpoints": f"last {len(evaluations)}",
        "seeds": [each["clean"]["seeds"] for each in evaluations],
        "levels": content["levels"],
    }
    return {name: str(value) for name, value in facts.items()}


def saved_states(content: Mapping[str, Any]) -> pd.DataFrame:
    """Return the states of a file, and the share of checkpoints that recover."""
    columns = {key: content[key] for key in SAVED[1:-1]}
    back = np.mean([each["back"] for each in content["evaluations"]], axis=0)
    # The same number of the same groups may be other states.
    digest = hashlib.sha256(json.dumps(list(columns.values())).encode()).hexdigest()
    name = f"{content['half']} {digest[:6]}"
    return pd.DataFrame({"states": name} | columns | {"back": back})


def comparable(settings: pd.DataFrame) -> pd.DataFrame:
    """Select the settings that must be equal for two runs to be averaged."""
    return settings[[key for key in settings if not key.startswith(IGNORED)]]


def tell_apart(
    names: pd.Series, facts: pd.DataFrame, data: pd.Series | None = None
) -> pd.Series:
    """Add to equal names the facts in which they differ on one data set."""
    found = names.copy()
    data = pd.Series("", names.index) if data is None else data
    for name, group in facts.groupby(names, sort=False):
        differing = group.loc[:, group.groupby(data).nunique().max() > 1]
        if differing.empty:
            continue
        short = differing.iloc[:, :NUM_NAMED]
        texts = short.apply(
            lambda row: ", ".join(f"{k}={v[:NAMED_WIDTH]}" for k, v in row.items()),
            axis=1,
        )
        kinds = differing.groupby(list(differing), sort=False).ngroup() + 1
        if texts.nunique() < kinds.max():  # the names are too short for all of it
            texts += ", kind " + kinds.astype(str)
        found[group.index] = f"{name} (" + texts + ")"
    return found


def comparison_notes(tables: RunTables) -> list[str]:
    """Write a sentence for each thing that makes a comparison unfair."""
    runs, notes = tables.runs, []
    if tables.measure.startswith(ESTIMATED):
        notes.append(
            "No run was played. The returns are estimates from the data alone, which "
            "did not rank trained policies of walking robots in our tests."
        )
    versions = pd.Series(runs["versions"].explode().dropna().unique()).sort_values()
    for _, each in versions.groupby(versions.str.rpartition(" ")[0]):
        if len(each) > 1:
            notes.append(f"Mixed versions: {', '.join(each)}.")
    settings = comparable(tables.settings)
    for data, group in runs.groupby("data", sort=False):
        kinds = settings.loc[group.index].nunique()
        keys = [key for key in kinds.index[kinds > 1] if not key.startswith(METHOD)]
        if keys:
            notes.append(f"{data}: its runs differ in {', '.join(keys)}.")
    return notes
