"""Estimate how good trained policies are, from their data alone.

    torchrl-osr evaluate-offline outputs/log-pump-file/*
    torchrl-osr evaluate-offline <run's folder> --discount 0.995 --steps 20000
    torchrl-osr evaluate-offline <run's folder> --xml robot.xml --frame-skip 4

The discounted return, averaged over first states of the data. By fitted Q evaluation:
critics learn the values of each policy. With --xml by rollouts in the robot's body,
whose masses, gears, damping and friction are identified from the data. Results are in
a run's folder. See docs/no_simulator.md for how far to trust the order.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_osr.lab.evaluation.tables import aligned_columns
from torchrl_osr.lab.run.evaluate_offline import OfflineEvaluator
from torchrl_osr.lab.run.load import checkpoints_of


def main() -> None:
    """Evaluate the runs; print a table for each data set, best first."""
    parser = argparse.ArgumentParser(prog=sys.argv[0], description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("runs", nargs="+", type=Path, help="folders of runs, or checkpoints in them")
    add("--checkpoints", action="store_true", help="evaluate all that each run kept")
    add("--discount", type=float, help="default: the run's; with --xml 0.997")
    add("--steps", type=int, help="updates; default: by the discount, with --xml 3000")
    add("--xml", help="description of the robot's body, MJCF")
    add("--frame-skip", type=int, default=1, help="physics steps of an action in it")
    add("--seed", type=int, default=0, help="of the training")
    add("--data", metavar="PATH", help="place of the log, if it was moved")
    add("--trust", action="append", default=[], help="module that the run may import")
    options = vars(parser.parse_args())
    runs, tables = options.pop("runs"), defaultdict[Any, dict[str, Any]](dict)
    for name in ("steps", "frame_skip"):
        if (found := options[name]) is not None and found < 1:
            parser.error(f"--{name.replace('_', '-')} {found}; expected at least 1.")
    for run in runs:
        if "=" in str(run) and not run.exists():
            parser.error(f"{run} is no run; options have the form --data PATH.")
        checkpoints_of(run)  # before time is spent
    if options.pop("checkpoints"):
        runs = [each for run in runs for each in checkpoints_of(run)]
    evaluate = OfflineEvaluator(**options)
    for number, run in enumerate(runs, 1):
        print(f"{number} of {len(runs)}: {run}", flush=True)
        found = evaluate(run)
        same = (found[key] for key in ("env", "data", "discount", "data_value"))
        tables[tuple(same)][run.as_posix()] = found
    for table in tables.values():
        print("\n" + ranking(table))


def ranking(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a text table of policies on one data set, the best estimate first."""
    best, *others = order = sorted(results, key=lambda run: -results[run]["value"])
    first = results[best]
    rows = [("policy", "value", "[95 %]")]
    for run in order:
        interval = "[{value_low:.4g}, {value_high:.4g}]".format(**results[run])
        interval = interval if results[run]["episodes"] > 1 else "one episode"
        rows.append((run, f"{results[run]['value']:.4g}", interval))
    rows.append(("the data, until its episodes end", f"{first['data_value']:.4g}", ""))
    lines = [
        "{env} {source}: estimated discounted return, discount {discount:g}, from the "
        "first states of {episodes:,} episodes".format(**first),
        *aligned_columns(rows),
    ]
    if others:
        lines.append(
            f"  To use the first: torchrl-osr export {shlex.quote(best)} policy.onnx"
        )
    if "xml" not in first:
        lines += [
            "  This does not see a policy leave its data: it is no permission",
            "  to switch a robot on. In our tests with walking robots, the order",
            "  of policies was not better than chance: docs/no_simulator.md.",
        ]
    return "\n".join(lines)
