"""What the tests of commands and examples share: their processes, tiny sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from warm import Server

EXAMPLES = Path(__file__).parents[1] / "examples"


def files_of(folder: Path, *more: str) -> dict[str, bytes]:
    """Results, networks, log entries and more of a run: files that have no time."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for pattern in ("*.json", "**/*.safetensors", "**/*.csv", *more)
        for path in folder.glob(pattern)
    }


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """One cache for the tests of a file, and one thread; processes inherit both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHRL_OSR_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.delenv("HYDRA_FULL_ERROR", raising=False)  # it means --debug
        yield


@pytest.fixture(scope="session")
def tiny() -> Callable[..., list[str]]:
    """Return a maker of a command's overrides, for a run of seconds."""

    def overrides(data: str = "random", **trainer: object) -> list[str]:
        from composed import SMALL  # imports the laboratory

        given = {f"trainer.{key}": str(value) for key, value in trainer.items()}
        sizes = dict(each.split("=") for each in SMALL)
        sizes |= {"data": data, "trainer.progress": "true"} | given
        return [f"{key}={value}" for key, value in sizes.items()]

    return overrides


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A process that has imported everything and forks commands."""
    server = Server()
    yield server
    server.close()


@pytest.fixture(scope="session")
def run(tmp_path_factory, server) -> Callable[..., str]:
    """Return a function that runs a command, or an example's file.

    It expects an exit code, by default 0, and returns what was printed.
    """
    outputs = tmp_path_factory.mktemp("outputs")

    def run(cwd: Path, name: str, *arguments: str, code: int = 0) -> str:
        name = str(EXAMPLES / name) if name.endswith(".py") else name
        output = outputs / f"{len(list(outputs.iterdir()))}.txt"
        server.start(name, *arguments, output=output, folder=cwd)
        assert server.ended() == code, output.read_text(encoding="utf-8")
        return output.read_text(encoding="utf-8")

    return run
