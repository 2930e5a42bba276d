"""Commands of the package in processes forked from one that has imported everything.

Imports take seconds, the rest of a tiny run one: so hundreds of runs can be killed. As
a script it starts what its input says, for those who cannot fork themselves, see
:class:`Server`.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

COMMANDS = ("train", "evaluate")
LATER = (
    "pandas", "matplotlib.backends.backend_agg", "matplotlib.figure",
    "matplotlib.layout_engine", "gymnasium.envs.mujoco.hopper_v5",
)  # fmt: skip
"""What the commands import when they need it."""

TINY = (
    "data=random", "data.num_transitions=600", "data.held_out=0.1",
    "network.num_cells=[8]", "trainer.batch_size=8",
    "trainer.inverse_dynamics_steps=40", "trainer.steps=60", "trainer.log_interval=10",
    "trainer.eval_interval=30", "trainer.eval_episodes=1",
    "trainer.checkpoint_interval=10", "trainer.checkpoints_kept=2",
)  # fmt: skip
"""Overrides of a run of a second."""


class Rename(NamedTuple):
    """A file put in its place.

    Attributes:
        name: of the file, below the folder that is watched.
        nth: of the renames to this name in the life of the process, from 1.
    """

    name: str
    nth: int


def warm_up() -> None:
    """Import what the commands need; torch is left with one thread, for forks."""
    import torch

    # A shell without job control has its background processes ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    for name in (*(f"torchrl_osr.lab.cli.{each}" for each in COMMANDS), *LATER):
        import_module(name)


def start(
    command: str,
    *arguments: str,
    output: Path,
    folder: Path | None = None,
    environment: dict[str, str] | None = None,
    watched: Path | None = None,
    seen: Callable[[Rename, bool], None] = lambda rename, done: None,
) -> int:
    """Start a command in a process of its own and return the process's id.

    Args:
        command: name of the command, or the path of a script.
        *arguments: of its command line.

    Keyword Args:
        output: file to which both its streams are appended.
        folder: in which it is called. Default: this process's.
        environment: in the place of this process's, for what is read after imports.
        watched: folder below which renames are seen.
        seen: called in the new process before and after each of them.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        stream = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        if folder is not None:
            os.chdir(folder)
            sys.path[0] = str(folder)  # as python -m has it
        if environment is not None:
            os.environ.clear()
            os.environ.update(environment)
        if watched is not None:
            _watch(watched, seen)
        if command.endswith(".py"):
            sys.argv, sys.path[0] = [command, *arguments], str(Path(command).parent)
            runpy.run_path(command, run_name="__main__")
        else:
            import_module("torchrl_osr.lab.__main__").main([command, *arguments])
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:  # also interrupted here: the child must not go on as its parent
            os._exit(code)


def ended(process: int, *, wait: bool = True) -> int | None:
    """Exit code of a process, as a shell has it; ``None`` if it lives, without waiting.

    Args:
        process: id of a child.

    Keyword Args:
        wait: for its end. Default ``True``.
    """
    there, state = os.waitpid(process, 0 if wait else os.WNOHANG)
    if not there:
        return None
    code = os.waitstatus_to_exitcode(state)
    return code if code >= 0 else 128 - code


def killed_at(wanted: Rename, *, after: bool) -> Callable[[Rename, bool], None]:
    """For ``seen`` of :func:`start`: kill the process just before or after a rename."""

    def seen(rename: Rename, done: bool) -> None:
        if rename == wanted and done == after:
            os.kill(os.getpid(), signal.SIGKILL)

    return seen


def noted_in(path: Path) -> Callable[[Rename, bool], None]:
    """For ``seen`` of :func:`start`: write every rename into a file, a line each."""

    def seen(rename: Rename, done: bool) -> None:
        if done:
            with path.open("a") as file:
                file.write(f"{rename.nth} {rename.name}\n")

    return seen


def read_renames(path: Path) -> list[Rename]:
    """Renames that :func:`noted_in` has noted, in their order."""
    lines = [line.split(" ", 1) for line in path.read_text().splitlines()]
    return [Rename(name, int(nth)) for nth, name in lines]


def met_in_turn(renames: Sequence[Rename]) -> list[Rename]:
    """The same renames, as a run meets them that is killed at each in turn.

    It goes on behind its last checkpoint, so that it writes ``best.torchrl`` for the
    first time in that life where the undisturbed run did for the second.
    """
    met: list[Rename] = []
    since: dict[str, list[str]] = {}  # by folder: names since it goes on there
    for name in (each.name for each in renames):
        folder, _, file = name.rpartition("/")
        names = since.setdefault(folder, [])
        names.append(name)
        met.append(Rename(name, names.count(name)))
        if re.fullmatch(r"checkpoint-\d+\.torchrl|\..*\.partial\.json", file):
            names.clear()
    return met


def _watch(folder: Path, seen: Callable[[Rename, bool], None]) -> None:
    """Call ``seen`` around all renames to places below a folder."""
    times: Counter[str] = Counter()

    def watching(original: Callable[..., None]) -> Callable[..., None]:
        def rename(source: Any, target: Any, **options: Any) -> None:
            path = Path(os.fsdecode(target)).absolute()
            if not path.is_relative_to(folder.absolute()):
                return original(source, target, **options)
            name = path.relative_to(folder.absolute()).as_posix()
            times[name] += 1
            seen(Rename(name, times[name]), False)
            original(source, target, **options)
            seen(Rename(name, times[name]), True)
            return None

        return rename

    os.replace, os.rename = watching(os.replace), watching(os.rename)


class Server:
    """A warm process that starts commands, for a parent that has threads.

    Args:
        environment: of the processes.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def start(self, *command: str, output: Path, **request: Any) -> int:
        """Start a command and return the process's id.

        Args:
            *command: its name and arguments.

        Keyword Args:
            output: file to which both its streams are appended.
            **request: ``folder`` and ``environment``, see :func:`start`; ``watched``,
                the folder whose renames are seen; ``noted_in``, the file that gets
                them; ``killed_before``, a :class:`Rename`.
        """
        assert self._process.stdin is not None
        line = json.dumps({"command": command, "output": str(output)} | request)
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return self._answer()

    def ended(self) -> int:
        """Wait for the process that was started last; its exit code."""
        return self._answer()

    def _answer(self) -> int:
        assert self._process.stdout is not None
        return int(self._process.stdout.readline())

    def close(self) -> None:
        """End the server."""
        self._process.communicate()


def serve() -> None:
    """Start what each line of the input asks for; print its id, then its exit code."""
    warm_up()
    for line in sys.stdin:
        request = json.loads(line)
        watching: dict[str, Any] = {"environment": request.get("environment")}
        if "folder" in request:
            watching["folder"] = Path(request["folder"])
        if "watched" in request:
            watching["watched"] = Path(request["watched"])
        if "noted_in" in request:
            watching["seen"] = noted_in(Path(request["noted_in"]))
        elif "killed_before" in request:
            wanted = Rename(*request["killed_before"])
            watching["seen"] = killed_at(wanted, after=False)
        process = start(*request["command"], output=Path(request["output"]), **watching)
        print(process, flush=True)
        print(ended(process), flush=True)


if __name__ == "__main__":
    serve()
