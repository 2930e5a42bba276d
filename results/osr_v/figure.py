"""Draw what the constraint of OSR-v does by itself, and what the runs with it score.

    python results/osr_v/figure.py

Reads ``bound.json``, ``runs.jsonl.gz`` and the ablation's runs in ``results/oos``;
writes ``osr_v.png`` and prints the scores.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Any

from torchrl_osr.evaluation.drawing import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    new_figure,
    save_figure,
)
from torchrl_osr.report import read_records

from torchrl_osr._files import read_json

HERE = Path(__file__).parent
COLORS = {"osr": GREEN, "cql": GREY, "osr_v": ORANGE}
LABELS = {"osr": "OSR", "cql": "CQL(H)", "osr_v": "OSR-v as printed"}
TRIED = (BLUE, "black", "#A0457E", "#E69F00", "#56B4E9")
DATA = ("hopper-medium-expert", "walker2d-medium-expert")


def curve(record: dict[str, Any]) -> tuple[list[int], list[float]]:
    """Steps and scores of a run's evaluations."""
    rows = record["returns"]["evaluations"]
    return [row["step"] for row in rows], [row["score"] for row in rows]


def tried() -> Iterator[tuple[str, str, tuple[list[int], list[float]]]]:
    """Data, name and curve of the runs of this folder."""
    for record in read_records(HERE / "runs.jsonl.gz"):
        config = record["config"]
        data = f"{config['env']['name']}-{config['data']['quality']}"
        yield data, record["folder"], curve(record)


def ablation() -> dict[tuple[str, str], list[tuple[list[int], list[float]]]]:
    """Curves of the ablation's seeds, by data and method."""
    curves = defaultdict(list)
    for record in read_records(HERE.parent / "oos" / "runs.jsonl.gz"):
        data, method, _ = record["folder"].split("/")
        if method in COLORS:
            curves[data, method].append(curve(record))
    return curves


def main() -> None:
    """Draw a panel for the constraint and one for each data set."""
    known = ablation()
    print("ablation, means over seeds: best evaluation, last five")
    for (data, method), seeds in known.items():
        best = mean(max(scores) for _, scores in seeds)
        last = mean(mean(scores[-5:]) for _, scores in seeds)
        print(f"  {data:22} {method:6} {best:5.0f} {last:5.0f}")
    figure = new_figure(12, 4.6, layout="constrained")
    alone, *panels = figure.subplots(1, 1 + len(DATA))
    bound = read_json(HERE / "bound.json")
    steps = [bound["every"] * number for number in range(len(bound["curves"]["mean"]))]
    alone.plot(steps, bound["curves"]["mean"], color=ORANGE, label="as printed: a mean")
    alone.plot(steps, bound["curves"]["logsumexp"], color=BLUE, label="log-sum-exp")
    alone.axhline(
        bound["entropy_of_the_model"], color="black", ls=":", lw=1,
        label="entropy of the model",
    )  # fmt: skip
    alone.set(title="the constraint alone", xlabel="gradient steps", ylabel="gap")
    alone.set_yscale("symlog", linthresh=2)
    alone.legend(frameon=False, fontsize=8, loc="upper right")

    for axes, data in zip(panels, DATA, strict=True):
        for method, color in COLORS.items():
            for number, points in enumerate(known[data, method]):
                label = LABELS[method] if number == 0 else None
                axes.plot(*points, color=color, alpha=0.5, label=label)
        here = [(name, points) for quality, name, points in tried() if quality == data]
        for (name, points), color in zip(here, TRIED[: len(here)], strict=True):
            print(f"  {data:22} {name}:", *(f"{score:.1f}" for score in points[1]))
            axes.plot(*points, "o-", color=color, label=name)
        axes.set(title=data, xlabel="updates", ylabel="normalised score")
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.15)}
        axes.legend(frameon=False, fontsize=8, ncols=2, **place)
    save_figure(figure, HERE / "osr_v.png", dpi=110)


if __name__ == "__main__":
    main()
