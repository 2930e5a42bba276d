"""A run that is killed, interrupted or tampered with, started again: the same bits.

Its processes are forked from one that has imported everything.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from contextlib import suppress
from itertools import count
from pathlib import Path

import pytest
from same_run import differences
from warm_runs import Rename, Server, met_in_turn, read_renames

KILLED = 128 + signal.SIGKILL
APPENDED = {"train.log", ".lock"}
CODES = {signal.SIGINT: 130, signal.SIGTERM: 75, signal.SIGHUP: 75}


class Runs:
    """Starts commands; ``output`` is what the last one printed."""

    def __init__(self, server: Server, folder: Path, sizes: list[str]) -> None:
        self.server, self.sizes = server, sizes
        self.outputs = (folder / f"output{number}.txt" for number in count())

    def start(self, *command: str, **request) -> int:
        self.path = next(self.outputs)
        request["environment"] = dict(os.environ)
        return self.server.start(*command, output=self.path, **request)

    @property
    def output(self) -> str:
        return self.path.read_text()

    def run(self, *command: str, **request) -> int:
        self.start(*command, **request)
        return self.server.ended()

    def train(self, folder: Path, *more: str, **request) -> int:
        return self.run(
            "train", *self.sizes, f"hydra.run.dir={folder}", *more, **request
        )

    def resume(self, folder: Path, *more: str) -> int:
        return self.run("train", f"resume={folder}", *more)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, server, tiny) -> Runs:
    sizes = tiny(steps=20, eval_interval=20, checkpoints_kept=1)
    sizes += ["optim.policy_average=0.1"]  # has a state of its own
    return Runs(server, tmp_path_factory.mktemp("outputs"), sizes)


@pytest.fixture(scope="module")
def undisturbed(runs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    noted = str(folder / "renames")
    request = {"watched": str(folder / "run"), "noted_in": noted}
    assert runs.train(folder / "run", **request) == 0, runs.output
    return folder / "run"


@pytest.fixture(scope="module")
def renames(undisturbed) -> list[Rename]:
    return read_renames(undisturbed.with_name("renames"))


@pytest.fixture
def finished(undisturbed, tmp_path) -> Path:
    """A finished run that may be spoiled."""
    return shutil.copytree(undisturbed, tmp_path / "finished")


def status(folder: Path) -> dict:
    return json.loads((folder / "status.json").read_text())


def test_every_file_is_renamed_into_its_place_or_appended_to(undisturbed, renames):
    files = {
        path.relative_to(undisturbed).as_posix()
        for path in undisturbed.rglob("*")
        if path.is_file() and path.suffix != ".csv"
    }
    assert {"status.json", "curve.png", "returns.json"} <= files
    assert files - {each.name for each in renames} == APPENDED


def test_killed_before_each_rename_it_ends_with_the_same_bits(
    runs, undisturbed, renames, tmp_path
):
    """One run, killed anew at each place, also when it reports after the last step."""
    folder = tmp_path / "run"
    for place in met_in_turn(renames):
        # TorchRL's own renames, to a name from which we rename: benchmarks/kill_runs.py
        if place.name.endswith(".new"):
            continue
        request = {"watched": str(folder), "killed_before": place}
        assert runs.train(folder, **request) == KILLED, (place, runs.output)
    assert runs.train(folder) == 0, runs.output
    assert differences(undisturbed, folder, same_means=True) == []
    assert status(folder) == {"status": "done"}
    files, wanted = (
        {path.relative_to(top) for path in top.rglob("*")}
        for top in (folder, undisturbed)
    )
    assert files == wanted, "something was left behind"


def test_interrupted_at_any_moment_it_ends_in_order_and_goes_on(
    runs, undisturbed, tmp_path
):
    folder, seed = tmp_path / "run", random.randrange(10**6)
    rng, ends = random.Random(seed), []
    sizes = [*runs.sizes, f"hydra.run.dir={folder}"]
    while len(ends) < 6:
        process = runs.start("train", *sizes)
        while (
            not (folder / "status.json").exists()
            or status(folder).get("pid") != process
        ):
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.4))
        number = rng.choice(list(CODES))
        with suppress(ProcessLookupError):  # it has come to its end
            os.kill(process, number)
        code, said = runs.server.ended(), status(folder)["status"]
        if said == "done":  # after that, the signal meets a process without a run
            assert code in (0, 128 + number), (seed, runs.output)
            break
        ends.append((code, said))
        assert ends[-1] == (CODES[number], "preempted"), (seed, runs.output)
        assert f"resume={folder}" in runs.output
    assert runs.train(folder) == 0, runs.output
    assert differences(undisturbed, folder) == [], seed


def test_longer_run_is_one_that_was_that_long_from_the_start(runs, finished, tmp_path):
    assert runs.resume(finished, "trainer.steps=40") == 0, runs.output
    assert runs.train(tmp_path / "long", "trainer.steps=40") == 0, runs.output
    found = differences(tmp_path / "long", finished, same_means=True)
    # The model's training was over; its checkpoints are of then.
    model = "checkpoint/inverse_dynamics/"
    assert [each for each in found if not each.startswith(model)] == []
    assert all(each.endswith("/trainer.steps") for each in found)
    config = (finished / "config.yaml").read_text()
    assert "  steps: 40\n" in config
    assert "resume: null" in config


def test_other_settings_are_refused_by_name_unless_forced(runs, finished):
    path, before = finished / "config.yaml", status(finished)
    path.write_text(path.read_text().replace("gamma: 0.99", "gamma: 0.9"))
    assert runs.resume(finished, "trainer.steps=40") == 1
    assert "optim.gamma: 0.99 there, 0.9 now" in runs.output
    assert "trainer.steps:" not in runs.output
    assert status(finished) == before, "the run is what it was"
    # On the command line it is refused before anything is touched.
    path.write_text(path.read_text().replace("gamma: 0.9\n", "gamma: 0.99\n"))
    files = {each: each.read_bytes() for each in (path, finished / "status.json")}
    assert runs.resume(finished, "optim.gamma=0.9") == 1
    assert "optim.gamma: 0.99 there, 0.9 now" in runs.output
    for options in (["trainer.steps=10"], ["trainer.steps=10", "force=true"]):
        assert runs.resume(finished, *options) == 1
        assert "trainer.steps=20, and 10 are fewer" in runs.output
    assert files == {each: each.read_bytes() for each in files}
    assert runs.resume(finished, "optim.gamma=0.9", "force=true") == 0
    assert "by force=true: optim.gamma: 0.99 there, 0.9 now" in runs.output
    assert "force: false" in path.read_text()


def test_resumed_run_keeps_its_name_in_the_report(runs, tmp_path):
    folder = tmp_path / "run"
    assert runs.train(folder, "loss=cql") == 0, runs.output
    hydra = (folder / ".hydra" / "hydra.yaml").read_bytes()
    assert b"loss: cql" in hydra
    assert runs.resume(folder) == 0, runs.output
    assert runs.train(folder, "loss=osr") == 1
    assert "loss.recovery_weight" in runs.output
    assert (folder / ".hydra" / "hydra.yaml").read_bytes() == hydra


def test_folder_that_is_removed_ends_the_run(runs, tmp_path):
    folder, more = tmp_path / "run", "trainer.steps=2000"
    runs.start("train", *runs.sizes, f"hydra.run.dir={folder}", more)
    # The second phase has just begun, and may have logged nothing yet.
    while not (folder / "inverse_dynamics.json").exists():
        time.sleep(0.001)
    folder.rename(tmp_path / "elsewhere")
    assert runs.server.ended() == 1, runs.output
    assert "was removed or renamed while the run was going on" in runs.output
    assert not (folder / "status.json").exists()


def test_second_sweep_continues_what_is_not_done(runs, tiny, tmp_path):
    sizes = tiny(steps=100, eval_interval=100, checkpoint_interval=25, record="false")
    sweep = ["-m", *sizes, "loss=cql", "seed=0,1", "hydra.sweep.dir=sweep"]
    command, request = ["train", *sweep], {"folder": str(tmp_path)}
    process = runs.start(*command, **request)
    pattern = "sweep/*/checkpoint/policy/checkpoint-*"
    while not list(tmp_path.glob(f"{pattern}25.torchrl")):
        os.kill(process, 0)  # it lives
        time.sleep(0.001)
    os.kill(process, signal.SIGTERM)
    assert runs.server.ended() == 75, runs.output
    (folder,) = (path.parent for path in tmp_path.glob("sweep/*/status.json"))
    assert status(folder)["status"] == "preempted"
    assert runs.run(*command, **request) == 0, runs.output
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob(pattern)}
    assert len(list(tmp_path.glob("sweep/*/returns.json"))) == 2
    # And once more, when all is done: nothing is trained.
    assert runs.run(*command, **request) == 0, runs.output
    again = {path: path.stat().st_mtime_ns for path in tmp_path.glob(pattern)}
    assert again == written
    for path in tmp_path.glob("sweep/*/status.json"):
        assert status(path.parent) == {"status": "done"}
