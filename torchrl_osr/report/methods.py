"""What a run is called, and which runs may stand together.

Runs are averaged only if their configurations differ in nothing but the seed (and, over
data sets, the data set). Of runs with one name that differ in more, each kind becomes a
method of its own, with the difference in its name.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from torchrl_osr.data import REFERENCE_RETURNS
from torchrl_osr.report.files import LeftOut
from torchrl_osr.report.runs import Run

IGNORED = (
    "resume",
    "logger.",
    "trainer.progress",
    "trainer.num_threads",
    "trainer.nonfinite",
    "trainer.cudagraph",
    "trainer.log_interval",
    "trainer.checkpoint_interval",
    "trainer.checkpoints_kept",
    "loss.chunk_size",
    "loss.deactivate_vmap",
)
"""Keys of the configuration that decide how a number is computed, not which."""

LATER = {
    "data.path": None,
    "data.download": False,
    "data.storage": "memory",
    "data.reward_scale": 1.0,
    "data.reward_shift": 0.0,
    "trainer.compile": False,
    "population": None,
}
"""Keys that the configurations of older runs lack, and what those runs did."""

IDENTITY = ("seed", "env.", "data.level", "data.random_share")
"""Keys that the report sorts runs by."""

METHOD = ("loss.", "perturbation.", "inverse_dynamics.", "num_random")
"""Keys in which methods differ by intent; all others should be those of the rivals."""

NUM_NAMED = 3
"""At most so many differences stand in a name."""


def loss_name(config: Mapping[str, Any]) -> str:
    """Return which option of ``loss=`` a configuration is, as its values tell.

    Args:
        config: with dotted keys.
    """
    loss = {
        key.removeprefix("loss."): value
        for key, value in config.items()
        if key.startswith("loss.")
    }
    target = str(loss.get("_target_", "unknown")).rpartition(".")[2]
    if target != "OSRLoss":
        return {"OSRVLoss": "osr_v"}.get(target, target)
    weight = loss.get("recovery_weight")
    if loss.get("min_q_weight") == 0:
        family = "sac" if weight == 0 else "osr"
        family = "edac" if loss.get("diversity_weight") else family
        return f"{family}_{loss.get('num_qvalue_nets')}"
    if weight == 0:
        return "cql"
    if loss.get("recovery_target") == "data":
        return "cql_bc" if loss.get("recovery_states") == "clean" else "cql_noisy_bc"
    if loss.get("recovery_direction") == "reverse":
        return "osr_official"
    return "osr_adversarial" if "adversary.objective" in loss else "osr"


def method_name(run: Run) -> str:
    """Return a run's method: of its folder's name, command line or configuration.

    Folders that are laid out as ``<env>-<level>/<method>/seed<k>`` say it themselves.
    Else it is what stood behind ``loss=``, or what the configuration's values tell.

    Raises:
        ValueError: if such a folder contradicts the run's configuration.
    """
    data, method, seed = ("", "", *run.folder.resolve().parts)[-3:]
    if re.fullmatch(r"seed\d+", seed) and data.split("-")[0] in REFERENCE_RETURNS:
        start = f"{run.env}-{run.config['data.level']}"
        if not data.startswith(start) or seed != f"seed{run.seed}":
            raise ValueError(
                f"the folder says {data} and {seed}, its configuration {start} and "
                f"seed{run.seed}"
            )
        return method
    for override in run.overrides or ():
        if override.startswith("loss="):
            return override.removeprefix("loss=")
    return loss_name(run.config)


def name_methods(runs: Iterable[Run]) -> tuple[list[Run], list[LeftOut]]:
    """Give every run its method's name; keep one run of each method, data and seed.

    Returns:
        The runs in their order, and what was left out.
    """
    left_out = []
    named: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        try:
            named[method_name(run)].append(run)
        except ValueError as error:
            left_out.append(LeftOut(run.folder, str(error)))
    kept: dict[tuple[str, str, int], Run] = {}
    for method, group in named.items():
        for run, more in zip(group, kinds_of(group), strict=True):
            run = replace(run, method=f"{method} ({more})" if more else method)
            first = kept.setdefault((run.method, run.data, run.seed), run)
            if first is not run:
                reason = f"the same run as {first.folder}, which is in the report"
                left_out.append(LeftOut(run.folder, reason))
    return list(kept.values()), left_out


def comparable(run: Run) -> dict[str, Any]:
    """Return what must be equal for two runs to be averaged."""
    facts = {
        key: value
        for key, value in (LATER | dict(run.config)).items()
        if not key.startswith((*IGNORED, *IDENTITY))
    }
    return facts | {"evaluated at": [row["step"] for row in run.evaluations]}


def kinds_of(runs: Sequence[Run]) -> list[str]:
    """Return in few words what is special about each run; "" where all are alike."""
    facts = [comparable(run) for run in runs]
    texts = distinctions(facts)
    presets = [preset(run) for run in runs]
    # A preset says it all if it goes with the differences one to one.
    pairs = set(zip(presets, texts, strict=True))
    one_to_one = len(set(presets)) == len(set(texts)) == len(pairs) > 1
    if not one_to_one or any(run.overrides is None for run in runs):
        return texts
    by_steps = len({run.steps for run in runs}) > 1
    return [
        f"preset {name}, {run.steps:,} steps" if by_steps else f"preset {name}"
        for name, run in zip(presets, runs, strict=True)
    ]


def distinctions(facts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return in few words in which entries each differs from the others.

    Args:
        facts: entries by name.

    Returns:
        A text for each; equal for equal entries, else different. All "" if all are
        equal.
    """
    keys = list(dict.fromkeys(key for each in facts for key in each))
    differing = [
        key for key in keys if any(each.get(key) != facts[0].get(key) for each in facts)
    ]
    kinds = [repr([each.get(key) for key in differing]) for each in facts]
    shown = sorted(differing, key=lambda key: (key != "trainer.steps", keys.index(key)))
    if "trainer.steps" in shown and "evaluated at" in shown:
        shown.remove("evaluated at")  # the one brings the other with it
    rest = len(shown) - NUM_NAMED
    texts = [
        ", ".join(describe(key, each) for key in shown[:NUM_NAMED])
        + (f" and {rest} more" if rest > 0 else "")
        for each in facts
    ]
    if len(set(texts)) < len(set(kinds)):  # what differs did not fit in
        order = list(dict.fromkeys(kinds))
        texts = [
            f"{text}, kind {order.index(kind) + 1}"
            for text, kind in zip(texts, kinds, strict=True)
        ]
    return texts


def preset(run: Run) -> str:
    """Return the preset that stood on the command line."""
    for override in run.overrides or ():
        if override.startswith("preset="):
            return override.removeprefix("preset=")
    return "of the defaults"


def describe(key: str, facts: Mapping[str, Any]) -> str:
    """Return an entry in words."""
    if key not in facts:
        return f"no {key}"
    if key == "trainer.steps":
        return f"{facts[key]:,} steps"
    if key == "evaluated at":
        return f"evaluated {len(facts[key])} times"
    if key in ("levels", "episode seeds"):
        return f"other {key}"
    return f"{key}={facts[key]}"
