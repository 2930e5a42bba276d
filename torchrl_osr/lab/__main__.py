"""The command line: ``torchrl-osr <command> ...``, or ``python -m torchrl_osr.lab``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

from torchrl_osr.lab.cli.console import errors_as_sentences

# Waiting threads do not spin; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

COMMANDS = {
    "data": "check a log before training on it",
    "train": "train a policy on offline data, or continue a run",
    "settings": "print the settings of every method on a data set",
    "collect": "roll out a policy in any environment and keep the log",
    "evaluate": "disturb a trained policy: score lost, survival, recovery",
    "report": "compare any number of runs on one page",
    "export": "write a trained policy to one file, for use elsewhere",
}

HELP = """\
Offline reinforcement learning that recovers from out-of-distribution states (OSR).

  torchrl-osr <command> ...

{commands}

A first run, its evaluation and a page about both:

  torchrl-osr train env=hopper
  torchrl-osr evaluate sweep=outputs
  torchrl-osr report outputs

For every command:

  --help     its options
  --debug    the traceback of an error, which is otherwise one sentence

  torchrl-osr --version    versions, for a bug report
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Dispatch to the subcommand.

    Args:
        arguments: the command and its arguments. Default: those of the process.
    """
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"  {command:10}{does}" for command, does in COMMANDS.items()]
        print(HELP.format(commands="\n".join(lines)), end="")
    elif name == "--version":
        print(_versions())
    elif name in COMMANDS:
        # Hydra takes no flag behind the first key=value.
        rest.sort(key=lambda each: each not in ("-m", "--multirun"))
        sys.argv = [f"torchrl-osr {name}", *rest]
        # For modules of the user's; last, where they replace no installed package.
        sys.path.append(os.getcwd())
        with errors_as_sentences():
            import_module(f"torchrl_osr.lab.cli.{name}").main()
    else:
        known = ", ".join(COMMANDS)
        sys.exit(f"torchrl-osr has no command {name!r}; it has {known}.")


def _versions() -> str:
    """The package's version, Python's and those that decide its numbers."""
    found = [
        f"torchrl-osr {version('torchrl-osr')}",
        f"python {sys.version.split()[0]}",
    ]
    for package in ("torch", "torchrl", "tensordict", "gymnasium", "mujoco"):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} not installed")
    return ", ".join(found)


if __name__ == "__main__":
    main()
