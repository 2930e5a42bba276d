"""A process that has imported everything and forks commands: imports take seconds.

As a script it reads a request a line: ``command``, ``output``, ``folder`` and
``environment``. It prints the id of the new process, and its exit code at its end.
"""

from __future__ import annotations

import atexit
import json
import os
import runpy
import signal
import subprocess
import sys
import traceback
from importlib import import_module
from pathlib import Path


class Server:
    """A warm process that starts commands, for a parent that has threads."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__], env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def start(self, *command: str, output: Path, folder: Path) -> int:
        """Start a command or a script; return its id. It prints into ``output``."""
        request = {
            "command": command, "output": str(output), "folder": str(folder),
            "environment": dict(os.environ),
        }  # fmt: skip
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self.ended()

    def ended(self) -> int:
        """Wait for the process that was started last; its exit code, as in a shell."""
        return int(self._process.stdout.readline())

    def close(self) -> None:
        """End the server."""
        self._process.communicate()


def run(command: list[str], output: str, folder: str, environment: dict) -> int:
    """Run a command in this new process; its exit code."""
    stream = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    os.chdir(folder)
    sys.path[0] = folder  # as python -m has it
    os.environ.clear()
    os.environ.update(environment)
    try:
        if command[0].endswith(".py"):
            sys.argv, sys.path[0] = command, str(Path(command[0]).parent)
            runpy.run_path(command[0], run_name="__main__")
        else:
            import_module("torchrl_osr.lab.__main__").main(command)
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
        return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def serve() -> None:
    """Fork a process for each request."""
    import torch

    # A shell without job control has its background processes ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    for name in (
        *("torchrl_osr.lab.cli.train", "torchrl_osr.lab.cli.evaluate", "pandas"),
        *("matplotlib.figure", "gymnasium.envs.mujoco.hopper_v5"),
    ):
        import_module(name)
    for line in sys.stdin:
        process = os.fork()
        if not process:
            code = 1
            try:
                code = run(**json.loads(line))
                atexit._run_exitfuncs()
                sys.stdout.flush()
                sys.stderr.flush()
            finally:  # also interrupted here: the child must not go on as its parent
                os._exit(code)
        print(process, flush=True)
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        print(code if code >= 0 else 128 - code, flush=True)


if __name__ == "__main__":
    serve()
