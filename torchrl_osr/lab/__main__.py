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

COMMANDS = {
    "data": "check a log before training on it",
    "train": "train a policy on offline data, or continue a run",
    "collect": "roll out a policy in any environment and keep the log",
    "evaluate": "disturb a trained policy: score lost, survival, recovery",
    "evaluate-offline": "estimate how good policies are from their data alone",
    "report": "compare any number of runs on one page",
    "export": "write a trained policy to one file, for use elsewhere",
}

CONFIGS = {
    "data": "check_data", "train": "train", "collect": "collect",
    "evaluate": "evaluation/evaluate",
}  # fmt: skip
"""Configurations of Hydra's commands; they have the commands' help."""

HELP = """\
Offline reinforcement learning that recovers from out-of-distribution states (OSR).

  torchrl-osr <command> ...

{commands}

A first run, its evaluation and a page about both:

  torchrl-osr train env=hopper
  torchrl-osr evaluate sweep=outputs
  torchrl-osr report outputs

Every command takes --help for its options, and --debug for the traceback of an error.
"torchrl-osr --version" prints versions, for a bug report.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Dispatch to the subcommand; ``arguments`` are by default the process's."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"  {command:18}{does}" for command, does in COMMANDS.items()]
        print(HELP.format(commands="\n".join(lines)), end="")
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
        rest.sort(key=lambda each: each not in ("-m", "--multirun"))
        home = str(Path.home())  # a shell leaves the ~ of data.path=~/log.csv
        rest = [re.sub(r"(?<=[=\[,\"'])~(?=/)", lambda _: home, each) for each in rest]
        sys.argv = [f"torchrl-osr {name}", *rest]
        # For modules of the user's; last, where they replace no installed package.
        sys.path.append(os.getcwd())
        with errors_as_sentences():
            import_module(f"torchrl_osr.lab.cli.{name.replace('-', '_')}").main()
    else:
        known = ", ".join(COMMANDS)
        similar = guess(name, COMMANDS)
        sys.exit(f"torchrl-osr has no command {name!r}{similar}; it has {known}.")


if __name__ == "__main__":
    main()
