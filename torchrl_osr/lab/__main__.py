"""The command line: ``torchrl-osr <command> ...``, or ``python -m torchrl_osr.lab``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

from torchrl_osr.lab.cli.console import errors_as_sentences

# Threads that wait shall not spin; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

COMMANDS = {
    "data": "look at a log before anything is trained on it",
    "train": "train a policy on offline data, or continue a run",
    "collect": "roll out a policy in any environment and keep the log",
    "evaluate": "disturb a trained policy: score lost, survival, way back",
    "report": "compare any number of runs on one page",
    "export": "write a trained policy to one file, for use elsewhere",
}

CONFIGURED = ("data", "train", "collect", "evaluate")
"""Those that Hydra configures."""

HELP = """\
Offline reinforcement learning that recovers when knocked off its data (OSR).

  torchrl-osr <command> ...

{commands}

A first run, its evaluation and a page about both:

  torchrl-osr train env=hopper
  torchrl-osr evaluate sweep=outputs
  torchrl-osr report outputs

For every command:

  --help     what it takes
  --debug    the traceback of an error, which is otherwise one sentence

  torchrl-osr --version                        versions, for a bug report
  eval "$(torchrl-osr -sc install=bash)"       completion in this shell
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Give the rest of the command line to the command that it begins with.

    Args:
        arguments: the command and what it takes. Default: those of the process.
    """
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"  {command:10}{does}" for command, does in COMMANDS.items()]
        print(HELP.format(commands="\n".join(lines)), end="")
    elif name == "--version":
        print(_versions())
    elif name in ("-sc", "--shell-completion"):
        _complete(list(rest))
    elif name in COMMANDS:
        _start(name, [f"torchrl-osr {name}", *rest])
    else:
        known = ", ".join(COMMANDS)
        sys.exit(f"torchrl-osr has no command {name!r}; it has {known}.")


def _start(name: str, arguments: list[str]) -> None:
    sys.argv = arguments
    with errors_as_sentences():
        import_module(f"torchrl_osr.lab.cli.{name}").main()


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


def _complete(arguments: list[str]) -> None:
    """Give Hydra's completion, which knows no commands, the line without its command.

    Where it has nothing to offer, the shell completes names of files.
    """
    if arguments[:1] != ["query=bash"]:  # to install it, any command will do
        _start("train", ["torchrl-osr", "-sc", *arguments])
        return
    line = os.environ["COMP_LINE"]
    program, name, rest = (*line.split(maxsplit=2), "", "")[:3]
    if not name or (not rest and not line.endswith(" ")):
        print(*COMMANDS)
    elif name in CONFIGURED:
        os.environ["COMP_LINE"] = f"{program} {rest}"
        _start(name, [program, "-sc", *arguments])


if __name__ == "__main__":
    main()
