"""Tables and figure of what ``update_speed.py`` measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from contenders import EAGER, OURS, PLAIN, PRODUCTS, SAMPLING, TORCHRL
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

MARKERS = ("<!-- tables -->\n", "<!-- end of tables -->\n")
TITLES = {
    "float32": "float32, PyTorch's default",
    "medium": 'float32 with torch.set_float32_matmul_precision("medium"), all alike',
    "bfloat16": "bfloat16 autocast of the losses; the plain reference is in float32",
}
LABELS = {
    TORCHRL: "TorchRL's CQLLoss",
    PLAIN: "plain reference (OSR)",
    PRODUCTS: "matrix products of OSR alone",
}
# Okabe and Ito's palette, which colour-blind readers can tell apart.
COLORS = {
    "OSR": "#0072B2",
    "CQL(H)": "#56B4E9",
    "OSR-v": "#009E73",
    "OSR-10": "#E69F00",
    EAGER: "#F0E442",
    TORCHRL: "#D55E00",
    PLAIN: "#CC79A7",
    PRODUCTS: "#BBBBBB",
}
PARTS = ("forward", "backward", "forward and backward", "optimizer", "targets")


def markdown(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Markdown table."""
    lines = [list(header), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def label(name: str, precision: str) -> str:
    """Name of a contender in tables and figure."""
    autocast = name == PLAIN and precision == "bfloat16"
    return LABELS.get(name, name) + ", autocast" * autocast


def speed_table(sizes: Mapping[str, Any], precision: str, *, on_gpu: bool) -> str:
    """Updates a second, and how they compare with the plain reference."""
    unit = "second" if on_gpu else "cpu_second"

    def cell(name: str, size: str) -> str:
        row = sizes[size][precision][name]
        if row["failure"]:
            return "failed"
        ratio = "" if row["ratio"] is None else f" ({row['ratio']:.2f}x)"
        return f"{row[f'updates_per_{unit}']:.1f}{ratio}"

    names = [n for n in next(iter(sizes.values()))[precision] if n != SAMPLING]
    rows = [
        [label(name, precision), *(cell(name, size) for size in sizes)]
        for name in names
    ]
    shares = [results[precision]["OSR"]["products_share"] for results in sizes.values()]
    rows.append(
        [
            "matrix products' share of OSR",
            *("failed" if share is None else f"{share:.0%}" for share in shares),
        ]
    )
    name = "updates a second" if on_gpu else "updates a CPU second"
    return markdown([f"{name} (x plain reference)", *sizes], rows)


def parts_table(results: Mapping[str, Any], precision: str) -> str:
    """CPU milliseconds of the parts of an update of one size."""
    rows = []
    for name, row in results.items():
        if row["failure"]:
            cells = [row["failure"].partition("\n")[0]]
        else:
            parts = row["cpu_seconds_by_part"]
            cells = [f"{1000 * parts[p]:.1f}" if p in parts else "" for p in PARTS]
        if row["failure"] or any(cells):
            rows.append([label(name, precision), *cells])
    return markdown(["implementation", *(f"{part} ms" for part in PARTS)], rows)


def tables(results: Mapping[str, Any]) -> str:
    """All tables as Markdown; the parts of an update are those of the first size."""
    sizes, machine = results["sizes"], results["machine"]
    first = next(iter(sizes))
    text = (
        f"`{results['command']}`: {machine.get('gpu', machine['cpu'])} "
        f"({machine['cpus']} cores, {machine['capability']}, "
        f"{' and '.join(machine['bfloat16_units']) or 'no units for bfloat16'}), "
        f"{machine['threads']} thread(s), medians of {machine['rounds']} rounds, load "
        f"average {machine['load_average'][0]:.1f} at the start, commit "
        f"`{machine['commit']}`, torch {machine['torch']}, TorchRL "
        f"{machine['torchrl']}, tensordict {machine['tensordict']}, {machine['date']}."
        "\n"
    )
    for precision in sizes[first]:
        table = speed_table(sizes, precision, on_gpu="gpu" in machine)
        text += f"\n### {TITLES[precision]}\n\n{table}"
        text += f"\nOne update of `{first}`:\n\n"
        text += parts_table(sizes[first][precision], precision)
    sampling = sizes[first]["float32"][SAMPLING]["updates_per_cpu_second"]
    return text + (
        f"\nSampling a batch of `{first}` with perturbed states, which no number above "
        f"includes, took {1000 / sampling:.2f} ms.\n"
    )


def write_tables(text: str, readme: Path) -> None:
    """Put the tables between the markers of a README, where there is one."""
    if readme.exists():
        before, _, rest = readme.read_text(encoding="utf-8").partition(MARKERS[0])
        _, _, after = rest.partition(MARKERS[1])
        whole = before + MARKERS[0] + text + MARKERS[1] + after
        readme.write_text(whole, encoding="utf-8")


def draw_precision(axes: Axes, sizes: Mapping[str, Any], precision: str) -> None:
    """Draw a bar for each contender and size: its speed over the plain reference's."""
    # The plain reference is the line at 1, except under autocast.
    drawn = [*OURS, EAGER, TORCHRL, PRODUCTS] + [PLAIN] * (precision == "bfloat16")
    names = [name for name in drawn if name in next(iter(sizes.values()))[precision]]
    width = 0.85 / len(names)
    for i, name in enumerate(names):
        for position, results in enumerate(sizes.values()):
            row = results[precision][name]
            if row["ratio"] is None:
                continue
            x = position + (i - (len(names) - 1) / 2) * width
            spread = [
                [row["ratio"] - row["ratio_lowest"]],
                [row["ratio_highest"] - row["ratio"]],
            ]
            axes.bar(
                x, row["ratio"], width * 0.92, color=COLORS[name], yerr=spread,
                label=label(name, precision) if position == 0 else None,
                error_kw={"elinewidth": 0.8, "ecolor": "#444444"},
            )  # fmt: skip
            axes.annotate(
                f"{row['ratio']:.2f}", (x, row["ratio_highest"]), (0, 2),
                textcoords="offset points", ha="center", fontsize=7,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
            )  # fmt: skip
    axes.axhline(
        1, color="black", linewidth=1, linestyle="--",
        label="plain reference (OSR)" + ", float32" * (precision == "bfloat16"),
    )  # fmt: skip
    axes.set_xticks(range(len(sizes)), list(sizes))
    axes.set_title(TITLES[precision], fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(y=0.12)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))


def draw(results: Mapping[str, Any], path: Path) -> None:
    """Draw a panel for each precision."""
    precisions = list(next(iter(results["sizes"].values())))
    figure = Figure(figsize=(11, 3 * len(precisions)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(precisions), 1, squeeze=False)[:, 0]
    for axes, precision in zip(panels, precisions, strict=True):
        draw_precision(axes, results["sizes"], precision)
    figure.supylabel("times the plain reference's speed", fontsize=10)
    figure.savefig(path, dpi=130)
