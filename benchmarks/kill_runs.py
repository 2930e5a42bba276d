"""Kill and interrupt tiny runs, hundreds of times: is anything lost, or different?

    nice python benchmarks/kill_runs.py --folder /tmp/kills

A run is ``torchrl-osr train`` and then ``torchrl-osr evaluate``, with data of its own.
One is left alone. Others are started again with the same command whenever they were

* killed with SIGKILL just before and just after each rename that the undisturbed one
  made, from the first roll-out of the data to the last figure,
* killed with SIGKILL at random moments, or
* stopped by SIGINT, SIGTERM or SIGHUP at random moments of the training,

until they end, and are compared with the undisturbed one. Writes ``kills.json`` and
``interrupts.json`` into ``results/reliability``.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import random
import re
import shutil
import signal
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import torch
import warm_runs
from same_run import differences, file_names

from torchrl_osr.lab.run.run_folder import package_versions

OUTPUT = Path(__file__).resolve().parents[1] / "results" / "reliability"
EVALUATE = ("suite=torque", "last=2", "episodes=2", "progress=false")
MOST_KILLS = 20
"""Of one run at random: on a busy machine it might never end otherwise."""

KILLED = 128 + signal.SIGKILL
EXIT_CODES = {signal.SIGINT: 130, signal.SIGTERM: 75, signal.SIGHUP: 75}


class Run:
    """One run: how far it is, and the command that it needs.

    Args:
        top: folder of its data and of its results.
    """

    def __init__(self, top: Path) -> None:
        self.top, self.folder, self.output = top, top / "run", top / "output.txt"
        shutil.rmtree(top, ignore_errors=True)
        top.mkdir(parents=True)

    @property
    def status(self) -> dict[str, Any]:
        """What ``status.json`` says."""
        path = self.folder / "status.json"
        return json.loads(path.read_text()) if path.exists() else {"status": "none"}

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return (self.folder / "robustness-torque.png").exists()

    def start(self, **watching: Any) -> int:
        """Start the command that comes next; return the process's id."""
        os.environ["TORCHRL_OSR_CACHE"] = str(self.top / "cache")
        train = ("train", *warm_runs.TINY, f"hydra.run.dir={self.folder}")
        evaluate = ("evaluate", *EVALUATE, f"checkpoint={self.folder}")
        command = evaluate if self.status["status"] == "done" else train
        return warm_runs.start(*command, output=self.output, **watching)

    def newest(self) -> dict[str, int]:
        """Return the step of the newest checkpoint of each phase."""
        found = sorted(self.folder.glob("checkpoint/*/checkpoint-*.torchrl"))
        return {each.parent.name: int(each.stem.split("-")[1]) for each in found}

    def said(self) -> str:
        """Return all that the run's processes have printed."""
        return self.output.read_text() if self.output.exists() else ""

    def went_on(self) -> list[tuple[str, int]]:
        """Return phase and step of every checkpoint that was gone on from."""
        pattern = r"goes on from \S+/(\w+)/checkpoint-(\d+)"
        found = re.findall(pattern, self.said())
        return [(phase, int(step)) for phase, step in found]


def live(
    run: Run, signalled: signal.Signals | None, seconds: float, **watching: Any
) -> tuple[int, bool]:
    """Let a run live once; return its exit code, and whether the signal was sent.

    The signal comes so many seconds after the process has got to work: SIGKILL after
    its start, others after it has begun with updates.
    """
    before, times = run.newest(), len(run.went_on())
    said = len(run.said())
    process, sent, code = run.start(**watching), False, None
    begin = None if signalled in EXIT_CODES else time.monotonic()
    while signalled is not None and code is None and not sent:
        time.sleep(0.002)
        code = warm_runs.ended(process, wait=False)
        if begin is None and re.search("goes on from|step 0 of", run.said()[said:]):
            begin = time.monotonic()
        if code is None and begin is not None and time.monotonic() > begin + seconds:
            os.kill(process, signalled)
            sent = True
    if code is None:
        code = warm_runs.ended(process)
    lost = [each for each in run.went_on()[times:] if each[1] != before[each[0]]]
    if lost:
        raise SystemExit(f"{lost} is not the last checkpoint of {before}: {run.top}")
    return code, sent


def was_killed(run: Run, code: int) -> bool:
    """Whether a run died by the kill; it must else have come to its end."""
    if code not in (0, KILLED):
        raise SystemExit(f"a run ended with code {code}: {run.output}")
    return code == KILLED


def kills_at_renames(top: Path, events: list[tuple[warm_runs.Rename, bool]]) -> dict:
    """Let one run die at each of these places in turn; say at which it did."""
    run, killed = Run(top), []
    for rename, after in events:
        if run.finished:
            break
        seen = warm_runs.killed_at(rename, after=after)
        if was_killed(run, live(run, None, 0, watched=top, seen=seen)[0]):
            killed.append(f"{'after' if after else 'before'} {rename.name}")
    return end(run) | {"killed": killed}


def kills_at_random(top: Path, longest: float) -> dict:
    """Kill one run at random moments, a number of times at most, until it ends."""
    run, killed, rng = Run(top), [], random.Random(top.name)
    while not run.finished and len(killed) < MOST_KILLS:
        if was_killed(run, live(run, signal.SIGKILL, rng.uniform(0, longest))[0]):
            killed.append(f"after {max(run.newest().items(), default='nothing')}")
    return end(run) | {"killed": killed}


def interrupts(top: Path, longest: float) -> dict:
    """Interrupt one run at random moments of its training until that ends."""
    run, ends, rng = Run(top), [], random.Random(top.name)
    while run.status["status"] != "done":
        number = rng.choice(list(EXIT_CODES))
        code, sent = live(run, number, rng.uniform(0, longest / 3))
        if sent:
            said = run.status
            phase = re.match(r"(\w+): stopped|stopped", said.get("reason", ""))
            where = (phase[1] or "elsewhere") if phase else said["status"]
            right = (EXIT_CODES[number], "preempted")
            if (code, said["status"]) == (0, "done"):
                right = (0, "done")  # it was writing that already
            ends.append(
                {
                    "signal": number.name,
                    "code": code,
                    "status": said["status"],
                    "in": where,
                    "right": (code, said["status"]) == right,
                }
            )
    return compared(run, same_means=False) | {"ends": ends}


def end(run: Run) -> dict[str, Any]:
    """Let a run end by itself, and compare it with the undisturbed one."""
    while not run.finished:
        code, _ = live(run, None, 0)
        if code:
            raise SystemExit(f"a run ended with code {code}: {run.output}")
    return compared(run, same_means=True)


def compared(run: Run, *, same_means: bool) -> dict[str, Any]:
    """Compare a run with the undisturbed one, as far as it has come."""
    undisturbed = run.top.parent / "undisturbed" / "run"
    found = differences(undisturbed, run.folder, same_means=same_means)
    if not run.finished:  # it was not evaluated
        found = [each for each in found if not each.startswith("robustness")]
    return {"different": found}


def different(runs: list[dict[str, Any]]) -> list[str]:
    """Return what is different in any of the runs."""
    return [each for one in runs for each in one["different"]]


def machine() -> dict[str, Any]:
    """Return where this was measured, and with which versions."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return {
        "processor": f"{names[0]}, {os.cpu_count()} cores",
        "system": f"{platform.system()}, Python {platform.python_version()}",
        "versions": package_versions(),
        "date": time.strftime("%Y-%m-%d"),
    }


def main() -> None:
    """Do all of it, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--interrupts", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--folder", type=Path, required=True)
    options = parser.parse_args()
    begin = time.perf_counter()
    warm_runs.warm_up()
    undisturbed, noted, longest = Run(options.folder / "undisturbed"), [], 0.0
    while not undisturbed.finished:
        path = undisturbed.top / f"renames{len(noted)}"
        watching = {"watched": undisturbed.top, "seen": warm_runs.noted_in(path)}
        began = time.monotonic()
        code, _ = live(undisturbed, None, 0, **watching)
        longest = longest or (time.monotonic() - began) / 2  # of the training
        if code:
            raise SystemExit(f"the run ended with {code}: {undisturbed.output}")
        noted += warm_runs.read_renames(path)
    places = warm_runs.met_in_turn(noted)
    events = [(each, after) for each in places for after in (False, True)]
    print(f"{len(noted)} renames in an undisturbed run", flush=True)

    def repeat(kind, name: str, wanted: int, count: str) -> list[dict]:
        """Do runs of a kind until that many kills or interrupts are together."""
        results: list[dict] = []
        while (there := sum(len(each[count]) for each in results)) < wanted:
            tops = [
                options.folder / f"{name}{len(results) + number}"
                for number in range(options.jobs)
            ]
            results += pool.map(kind, tops, chunksize=1)
            print(f"{name}: {there} of {wanted} {count}", flush=True)
        return results

    with multiprocessing.get_context("fork").Pool(options.jobs) as pool:
        named = repeat(
            partial(kills_at_renames, events=events),
            "named",
            options.kills // 2,
            "killed",
        )
        left = options.kills - sum(len(each["killed"]) for each in named)
        at_random = partial(kills_at_random, longest=longest)
        random_kills = repeat(at_random, "random", left, "killed")
        stop = partial(interrupts, longest=longest)
        interrupted = repeat(stop, "interrupted", options.interrupts, "ends")
    killed = [place for each in named for place in each["killed"]]
    ends = [each for one in interrupted for each in one["ends"]]
    common = machine() | {
        "train": warm_runs.TINY,
        "evaluate": EVALUATE,
        "compared": file_names(undisturbed.folder),
        "steps_lost_beyond_the_last_checkpoint": 0,  # else it has ended above
    }
    kills = {
        "kills": len(killed) + sum(len(each["killed"]) for each in random_kills),
        "at_renames": len(killed),
        "runs": len(named) + len(random_kills),
        "different": [
            each for one in named + random_kills for each in one["different"]
        ],
        "renames": dict(sorted(Counter(killed).items())),
        "at_random": [each["killed"] for each in random_kills],
    }
    codes = Counter(
        f"{e['signal']} in {e['in']}: {e['code']}, {e['status']}" for e in ends
    )
    stopped = {
        "interrupts": len(ends),
        "runs": len(interrupted),
        "wrong_ends": [each for each in ends if not each["right"]],
        "different": different(interrupted),
        "ends": dict(sorted(codes.items())),
    }
    print(f"{time.perf_counter() - begin:.0f} s")
    for name, result in (("kills", kills), ("interrupts", stopped)):
        if not result[name]:
            continue
        text = json.dumps(result | common, indent=1)
        (OUTPUT / f"{name}.json").write_text(f"{text}\n", encoding="utf-8")
        print({key: result[key] for key in list(result)[:4]})


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
