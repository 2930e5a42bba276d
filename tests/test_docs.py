"""Code blocks of the documentation run, its links resolve, and the README's commands
exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mktestdocs import check_md_file, grab_code_blocks

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
PAGES += ROOT.glob("torchrl_osr/**/MODEL_CARD.md")
LINKED = [*PAGES, *ROOT.glob("results/**/*.md"), *ROOT.glob("CONTRIBUTING.md")]

# The commands of these pages run with their blocks: tests/lab/cli/test_*_page.py.
WITH_COMMANDS = {ROOT / "docs" / f"{name}.md" for name in ("no_simulator", "your_data")}


@pytest.mark.parametrize("page", sorted({*PAGES} - WITH_COMMANDS), ids=lambda p: p.name)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    check_md_file(page, memory=True)


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page):
    text = re.sub(r"(?s)```.*?```", "", page.read_text(encoding="utf-8"))
    targets = re.findall(r"\]\((?!\w+:)([^)#\s]+)", text)
    written_at_build = ROOT / "docs" / "generated"
    missing = [
        target
        for target in targets
        if not (file := (page.parent / target).resolve()).exists()
        and written_at_build not in file.parents
    ]
    assert not missing


def test_readme_has_one_command_to_train_and_one_to_test():
    text = README.read_text(encoding="utf-8")
    # .ci/run looks for the second line.
    for command in ("python examples/offline_osr.py env=hopper", "pytest"):
        assert re.search(rf"(?m)^python3 -m venv .* && {command}$", text)


def test_named_versions_are_those_of_the_constraints():
    """A new TorchRL lists the places that name the old one."""
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pins = {"0.11", *re.findall(r"(?m)^(?:torchrl|tensordict)==(\S+)", pins)}
    for file in [
        *PAGES,
        *ROOT.glob("torchrl_osr/**/*.py"),
        *ROOT.glob("tests/**/*.py"),
    ]:
        text = file.read_text(encoding="utf-8")
        named = re.findall(r"(?:TorchRL|tensordict) (\d+(?:\.\d+)+)", text)
        assert {*named} <= pins, file


def test_readmes_diff_is_of_the_drop_in_example():
    (block,) = grab_code_blocks(README.read_text(encoding="utf-8"), lang="diff")
    example = (ROOT / "examples" / "drop_in_loss.py").read_text(encoding="utf-8")
    added = [line[1:] for line in block.splitlines() if line.startswith("+")]
    assert all(line in example for line in added)
