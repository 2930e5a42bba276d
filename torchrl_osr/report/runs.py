"""Reading runs: what is in their folders, and what is not fit to be reported.

Everything comes from files that a run leaves: ``config.yaml``, ``status.json``,
``returns.json``, ``.hydra/overrides.yaml`` and ``robustness-<suite>.json``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from yaml import YAMLError

from torchrl_osr._files import read_json
from torchrl_osr.data import normalized_score
from torchrl_osr.experiment.run_config import read_config, read_yaml
from torchrl_osr.experiment.run_folder import CONFIG, STATUS
from torchrl_osr.report.files import LeftOut, check_evaluations, read_suites

RETURNS = "returns.json"
NOT_RECORDED = "not recorded"


@dataclass(frozen=True)
class Run:
    """One finished run.

    Attributes:
        folder: as it was found.
        config: the whole configuration, with dotted keys.
        overrides: what stood on the command line; ``None`` if nobody wrote it down.
        data_score: mean normalised score of the data's episodes, if it is known.
        evaluations: in the order of their steps, with the raw ``"returns"``.
        suites: content of each ``robustness-<suite>.json``, by suite.
        versions: of the packages, as far as recorded.
        hardware: in words, if recorded.
        method: its name in the report.
    """

    folder: Path
    config: Mapping[str, Any]
    overrides: tuple[str, ...] | None
    data_score: float | None
    evaluations: Sequence[Mapping[str, Any]]
    suites: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    hardware: str | None = None
    method: str = ""

    @property
    def env(self) -> str:
        """Short name of the task."""
        return str(self.config["env.name"])

    @property
    def known_data_score(self) -> str:
        """The data's own score, or that it is unknown."""
        return "unknown" if self.data_score is None else f"{self.data_score:.1f}"

    @property
    def data(self) -> str:
        """Name of the data set."""
        share = self.config.get("data.random_share") or 0
        mixed = f", {100 * share:g} % random" if share else ""
        path = self.config.get("data.path")
        recorded = f" {path}" if path else ""
        return f"{self.env} {self.config['data.level']}{recorded}{mixed}"

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.config["seed"])

    @property
    def steps(self) -> int:
        """Gradient steps of the policy."""
        return int(self.config["trainer.steps"])


def find_runs(folders: Iterable[Path]) -> tuple[list[Run], list[LeftOut]]:
    """Read every run in or below the folders, in the order of their paths.

    Args:
        folders: of runs, or above them. A run that is below two of them counts once.

    Returns:
        The finished runs, and what was left out.

    Raises:
        FileNotFoundError: if a folder does not exist.
    """
    runs: list[Run] = []
    left_out: list[LeftOut] = []
    seen = set()
    for top in folders:
        if not top.is_dir():
            raise FileNotFoundError(f"{top} is no folder.")
        for path in sorted(top.rglob(CONFIG)):
            folder = path.parent
            # Hydra keeps a second config.yaml in a hidden folder.
            hidden = any(part[0] == "." for part in path.relative_to(top).parts)
            if hidden or folder.resolve() in seen:
                continue
            seen.add(folder.resolve())
            try:
                run, without = read_run(folder)
            except (OSError, ValueError, TypeError, YAMLError) as error:
                left_out.append(LeftOut(folder, str(error).split("\n")[0]))
            except KeyError as error:
                left_out.append(LeftOut(folder, f"there is no entry {error}"))
            else:
                runs.append(run)
                left_out += without
    return runs, left_out


def read_run(folder: Path) -> tuple[Run, list[LeftOut]]:
    """Read one run.

    Args:
        folder: holds its files.

    Returns:
        The run, and the robustness files in its folder that could not be used.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if the run is not finished, or its files say nonsense.
        KeyError: if an entry is missing.
    """
    config = flatten(OmegaConf.to_container(read_config(folder / CONFIG)))
    for key in ("env.name", "data.level", "seed", "trainer.steps"):
        config[key]  # a configuration of another program has none of them
    # An archive of results need not have kept the status.
    if (folder / STATUS).exists():
        status = read_json(folder / STATUS)
        if status.get("status") != "done":
            error = f": {status['error']}" if "error" in status else ""
            raise ValueError(f"not finished, its status is {status['status']}{error}")
    if not (folder / RETURNS).exists():
        raise ValueError(f"not finished, there is no {RETURNS}")
    returns = read_json(folder / RETURNS)
    evaluations = returns["evaluations"]
    check_evaluations(evaluations, int(config["trainer.steps"]))
    suites, left_out = read_suites(folder)
    sources = [returns, *suites.values()]
    hardware = [str(each["hardware"]) for each in sources if each.get("hardware")]
    overrides = folder / ".hydra" / "overrides.yaml"
    run = Run(
        folder,
        config,
        tuple(map(str, read_yaml(overrides))) if overrides.exists() else None,
        None if returns["data_score"] is None else float(returns["data_score"]),
        evaluations,
        suites,
        _merge_versions([each.get("versions", {}) for each in sources]),
        "; ".join(dict.fromkeys(hardware)) or None,
    )
    normalized_score(run.env, 0.0)  # without reference returns there is no score
    return run, left_out


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
    return flat


def _merge_versions(sources: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Return each package's version; several of one run stay visible as such."""
    found: dict[str, list[str]] = {}
    for source in sources:
        for package, version in source.items():
            versions = found.setdefault(str(package), [])
            if str(version) not in versions:
                versions.append(str(version))
    return {package: " and ".join(each) for package, each in found.items()}
