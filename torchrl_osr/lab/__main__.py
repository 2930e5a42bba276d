"""The command line: ``torchrl-osr <command> ...``, or ``python -m torchrl_osr.lab``."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from torchrl_osr.lab.cli.console import errors_as_sentences, guess
from torchrl_osr.lab.run import CONF

# Waiting threads do not spin; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

COMMANDS = (
    "data", "train", "collect", "evaluate", "evaluate-offline", "report", "export",
)  # fmt: skip
"""``conf/help.txt`` describes them."""

CONFIGS = {
    "data": "check_data", "train": "train", "collect": "collect",
    "evaluate": "evaluation/evaluate",
}  # fmt: skip
"""Configurations of Hydra's commands; they have the commands' help."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Dispatch to the subcommand; ``arguments`` are by default the process's."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(Path(CONF, "help.txt").read_text(), end="")
    elif name == "--version":
        found = [f"torchrl-osr {version('torchrl-osr')}"]
        found.append(f"python {sys.version.split()[0]}")
        for package in ("torch", "torchrl", "tensordict", "gymnasium", "mujoco"):
            with suppress(PackageNotFoundError):
                found.append(f"{package} {version(package)}")
        print(", ".join(found))
    elif name in CONFIGS and {"-h", "--help"} & {*rest}:
        from yaml import safe_load  # quick, unlike Hydra and torch

        content = safe_load(Path(CONF, f"{CONFIGS[name]}.yaml").read_text())
        print(content["hydra"]["help"]["template"], end="")
    elif name in COMMANDS:
        # Hydra takes no flag behind the first key=value.
        rest.sort(key=lambda each: name in CONFIGS and "=" in each and each[0] != "-")
        home = str(Path.home())  # a shell leaves the ~ of data.path=~/log.csv
        rest = [re.sub(r"(?<=[=\[,\"'])~(?=/)", lambda _: home, each) for each in rest]
        sys.argv = [f"torchrl-osr {name}", *rest]
        # For modules of the user's; last, where they replace no installed package.
        sys.path.append(os.getcwd())
        with errors_as_sentences():
            if {each[:13] for each in rest} >= {"data.columns=", "data.columns."}:
                raise ValueError(
                    "data.columns=<file> replaces all data.columns.<part>=...: write "
                    "these into the file."
                )
            import_module(f"torchrl_osr.lab.cli.{name.replace('-', '_')}").main()
    else:
        known = ", ".join(COMMANDS)
        similar = guess(name, COMMANDS)
        sys.exit(f"torchrl-osr has no command {name!r}{similar}; it has {known}.")


if __name__ == "__main__":
    main()
