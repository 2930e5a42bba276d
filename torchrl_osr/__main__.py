"""The command line: ``torchrl-osr <command> ...``, or ``python -m torchrl_osr``."""

from __future__ import annotations

import os
import sys
from importlib import import_module

# Threads that wait shall not spin; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

COMMANDS = {
    "train": "train a policy on offline data, or continue a run",
    "evaluate": "disturb a trained policy: score lost, survival, way back",
    "film": "film a push and what follows",
    "report": "compare any number of runs on one page",
    "export": "write a trained policy to one file, for use elsewhere",
}


def main() -> None:
    """Give the rest of the command line to the command that it begins with."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"  {command:10}{does}" for command, does in COMMANDS.items()]
        print("torchrl-osr <command> ...\n", *lines, sep="\n")
        print("\ntorchrl-osr <command> --help says what it takes.")
        return
    if name not in COMMANDS:
        known = ", ".join(COMMANDS)
        sys.exit(f"torchrl-osr has no command {name!r}; it has {known}.")
    sys.argv = [f"torchrl-osr {name}", *rest]
    import_module(f"torchrl_osr.commands.{name}").main()


if __name__ == "__main__":
    main()
