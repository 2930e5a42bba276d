"""The page of settings: every key of ``torchrl-osr train``, from the schemas.

``conf.py`` writes it when the documentation is built. Names and types are those of the
schemas and of the losses' signatures, meanings those of their comments and
docstrings, values those of the two presets.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.run import schema

ROOT = Path(__file__).parents[1]
PRESETS = ("quick", "paper")
# Settings that users change first; the rest follows by group.
COMMON = (
    *("env.id", "data.source", "seed", "resume", "trainer.steps"),
    *("loss.recovery_weight", "perturbation.std", "optim.actor_lr", "optim.qvalue_lr"),
    "trainer.device",
)
HEAD = """# Settings

*Which settings are there, and what do they mean?*

```bash
torchrl-osr train trainer.steps=100_000 --cfg job
```

The tables have every key of `torchrl-osr train`, with its value in two presets. The
keys `loss.*` are the options of {py:class}`~torchrl_osr.OSRLoss`. To print those of
another loss, add `loss=osr_v --cfg job`.
"""


def described(documented: Any) -> dict[str, str]:
    """Read the meaning of each argument or attribute in a Google-style docstring."""
    text = inspect.getdoc(documented) or ""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in text.splitlines():
        item = re.match(r"    (\w+(?:, \w+)*): (.*)", line)
        if item:
            names = item[1].split(", ")
            found |= dict.fromkeys(names, item[2])
        elif names and line.startswith("        "):
            for name in names:
                found[name] += " " + line.strip()
        else:
            names = []
    return found


def commented(config: type) -> dict[str, str]:
    """Read the comment of each dataclass field, to its right or above it."""
    found, above = {}, []
    for line in inspect.getsource(config).splitlines():
        if comment := re.match(r"    # (.*)", line):
            above.append(comment[1])
            continue
        if field := re.match(r"    (\w+): [^#]*(?:# (.*))?$", line):
            found[field[1]] = field[2] or " ".join(above)
        above = []
    return found


def markdown(text: str) -> str:
    """Convert a docstring's markup to Markdown for a table's cell."""
    text = re.sub(r":math:`(.*?)`", r"$\1$", text)
    text = re.sub(r":(?:class|func|attr|meth):`~?(.*?)`", r"`\1`", text)
    text = text.replace("``", "`").replace("|", "\\|").replace("`None`", "`null`")
    # The two columns of values say it.
    text = re.sub(r" Default `?[\w.-]+?`?\.(?= |$)| Default: none\.", "", text)
    capital = text[1:2].islower() and not text.startswith("Gymnasium")
    text = text[:1].lower() + text[1:] if capital else text
    return text.rstrip(".")


def meanings(cfg: DictConfig) -> dict[str, str]:
    """Return the meaning of every key, dotted."""
    found = commented(schema.TrainConfig)
    found |= dict(meanings_of_groups(schema.TrainConfig))
    for name in ("loss", "inverse_dynamics.loss"):
        target = get_class(OmegaConf.select(cfg, f"{name}._target_"))
        for each in reversed(target.__mro__):
            if each.__module__.startswith("torchrl_osr"):
                options = described(each)
                found |= {f"{name}.{key}": text for key, text in options.items()}
    return found


def meanings_of_groups(config: type, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the meaning of every key, dotted, of the groups in a dataclass."""
    for name, field in config.__dataclass_fields__.items():
        if dataclasses.is_dataclass(field.default_factory):
            group = field.default_factory
            for key, text in commented(group).items():
                yield f"{prefix}{name}.{key}", text
            yield from meanings_of_groups(group, f"{prefix}{name}.")


def leaves(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every key, dotted, with its value; a ``_target_`` is no setting."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        elif key != "_target_":
            yield f"{prefix}{key}", value


def shown(value: Any) -> str:
    """Format a value as on the command line."""
    text = OmegaConf.to_yaml(OmegaConf.create({"_": value})).removeprefix("_:").strip()
    if isinstance(value, list):
        text = f"[{', '.join(map(str, value))}]"
    return f"`{text}`"


def page() -> str:
    """Return the whole page."""
    schema.register()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        composed = [compose("train", [f"preset={name}"]) for name in PRESETS]
    values = [
        dict(leaves(OmegaConf.to_container(cfg, resolve=True))) for cfg in composed
    ]
    values = [
        {key: each for key, each in of.items() if not key.startswith("settings.")}
        for of in values
    ]
    known = meanings(composed[0])
    groups: dict[str, list[str]] = {"The common ones": list(COMMON)}
    for key in values[0]:
        name = key.partition(".")[0] if "." in key else "run"
        groups.setdefault(f"`{name}`", []).append(key)
    lines = [HEAD]
    for title, keys in groups.items():
        lines += [
            f"## {title}\n",
            "| key | quick | paper | meaning |",
            "|---|---|---|---|",
        ]
        for key in keys:
            cells = [shown(each[key]) for each in values]
            meaning = markdown(known.get(key, ""))
            lines.append(f"| `{key}` | {' | '.join(cells)} | {meaning} |")
        lines.append("")
    return "\n".join(lines)
