"""The speed benchmark: its matrix products, and a run from end to end."""

from __future__ import annotations

import copy
import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace

import contenders
import pytest
import torch
import update_speed
from contenders import (
    EAGER,
    GRAPH,
    ON_GPU,
    OURS,
    PLAIN,
    PRODUCTS,
    SAMPLING,
    Size,
    make_contender,
    osr_products,
)
from matmul_bound import Products, count_flops, osr_passes, total_flops
from speed_report import tables
from update_speed import PRECISIONS, summarize

NUMBERS = [
    "updates_per_cpu_second", "updates_per_second", "ratio", "ratio_lowest",
    "ratio_highest", "products_share",
]  # fmt: skip


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("name", ["hopper-2x64", "halfcheetah-3x32", "hopper-quick"])
def test_products_are_those_of_our_update(name, autocast) -> None:
    cpu = torch.device("cpu")
    passes, counted = osr_products(Size.parse(name), cpu, autocast=autocast)
    assert total_flops(passes) == pytest.approx(counted, rel=0.03)


@pytest.mark.parametrize("chunk", [None, 5])
def test_products_run_as_many_operations_as_their_shapes_tell(chunk) -> None:
    passes = osr_passes(3, 2, (8, 4), batch=12, num_random=2, critics=3, chunk=chunk)
    products = Products(passes, torch.float32, "cpu")
    assert count_flops(products.update) == total_flops(passes)


NAMES = ("OSR", EAGER, PLAIN, PRODUCTS, SAMPLING)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[str, dict, Path]:
    folder = tmp_path_factory.mktemp("speed")
    text = "Before.\n<!-- tables -->\nold\n<!-- end of tables -->\nAfter.\n"
    (folder / "README.md").write_text(text)
    sizes = ["--sizes=hopper-1x8", "--precisions=float32"]
    sizes += ["--rounds=2", "--seconds=0.001", f"--output={folder}"]
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        # The others do the same with other losses: left out to save time.
        patch.setitem(PRECISIONS, "float32", NAMES)
        update_speed.main(sizes)
    return printed.getvalue(), json.loads((folder / "speed.json").read_text()), folder


def test_file_has_every_contender_and_round(run) -> None:
    _, results, _ = run
    assert set(results) == {"command", "machine", "sizes"}
    assert {"cpu", "torch", "threads", "rounds", "commit"} <= set(results["machine"])
    (by_precision,) = results["sizes"].values()
    assert list(by_precision) == ["float32"]
    for precision in by_precision:
        assert list(by_precision[precision]) == list(NAMES)
        for row in by_precision[precision].values():
            assert row["failure"] is None
            assert all(row[number] >= 0 for number in NUMBERS)
            assert len(row["rounds"]) == 2
            # Round by round, and their medians, which of two rounds are their means:
            # the mean of seconds is not one over the mean of rates.
            cpu = [each["cpu_seconds"] for each in row["rounds"]]
            parts = [each["cpu_seconds_by_part"].values() for each in row["rounds"]]
            assert [sum(each) for each in parts] == pytest.approx(cpu, rel=0.5)
            seconds = sum(row["cpu_seconds_by_part"].values())
            assert seconds == pytest.approx(sum(cpu) / 2, rel=0.5)
            rates = [1 / each for each in cpu]
            assert row["updates_per_cpu_second"] == pytest.approx(sum(rates) / 2)


def test_a_failure_is_told_and_ends_nothing_else(run) -> None:
    _, results, _ = run
    sizes = copy.deepcopy(results["sizes"])
    rows = sizes["hopper-1x8"]["float32"]
    failed = SimpleNamespace(rounds=[], failure="RuntimeError: dtypes")
    rows["OSR"] = summarize(failed, failed, failed, "cpu_seconds")
    assert rows["OSR"]["ratio"] is rows["OSR"]["updates_per_second"] is None
    text = tables({**results, "sizes": sizes})
    assert "| OSR | failed |" in text
    assert "| OSR | RuntimeError: dtypes |" in text


def test_tables_are_printed_and_put_into_the_readme(run) -> None:
    printed, results, folder = run
    readme = (folder / "README.md").read_text()
    assert readme.startswith("Before.\n<!-- tables -->\n")
    assert readme.endswith("<!-- end of tables -->\nAfter.\n")
    assert "old" not in readme
    assert printed.strip() in readme
    osr = results["sizes"]["hopper-1x8"]["float32"]["OSR"]
    cell = f"| OSR | {osr['updates_per_cpu_second']:.1f} ({osr['ratio']:.2f}x) |"
    assert cell in printed
    assert (folder / "speed.png").stat().st_size > 10_000


# Without a GPU, CudaGraphModule runs the update as it is.
@pytest.mark.filterwarnings("ignore:This module is instantiated on a machine without")
@pytest.mark.filterwarnings("ignore:Tensordict is registered in PyTree")
def test_graph_reads_the_batch_and_moves_the_same_weights(monkeypatch) -> None:
    size, device = Size.parse("hopper-1x8"), torch.device("cpu")
    made, original = [], contenders.our_loss

    def our_loss(*arguments):
        made.append(original(*arguments))
        return made[-1]

    monkeypatch.setattr(contenders, "our_loss", our_loss)
    for name in ("OSR", GRAPH):
        torch.manual_seed(0)
        update, batches = make_contender(name, size, device, autocast=False)
        for batch in batches[:3]:
            list(update(batch))
    plain, graph = (loss.state_dict().values() for loss in made)
    assert all(torch.equal(a, b) for a, b in zip(plain, graph, strict=True))


@pytest.mark.parametrize(("device", "number"), [("cpu", 0), ("cuda", len(ON_GPU))])
def test_graphs_and_compilation_take_part_on_a_gpu(monkeypatch, device, number) -> None:
    asked = []

    def contender(name, *_):
        asked.append(name)
        return SimpleNamespace(rounds=[], failure="", close=list)

    monkeypatch.setattr(update_speed, "Contender", contender)
    update_speed.measure("hopper-1x8", precisions=["float32"], rounds=0, device=device)
    assert len([name for name in asked if name in ON_GPU]) == number
    assert set(OURS) < set(asked)
