"""What the documentation says is true: its code runs, its names and values exist."""

from __future__ import annotations

import re
import runpy
from importlib import import_module
from pathlib import Path

import pytest
from mktestdocs import check_md_file, grab_code_blocks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [
    ROOT / "README.md",
    ROOT / "torchrl_osr" / "data" / "collect" / "behavior_policies" / "MODEL_CARD.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PACKAGES = [
    f"torchrl_osr{name}"
    for name in (
        "",
        ".data",
        ".envs",
        ".evaluation",
        ".film",
        ".imagination",
        ".modules",
        ".objectives",
        ".policy",
        ".report",
        ".trainers",
        ".transforms",
    )
]
DESCRIBE_ALL = re.compile(r"\.\. automodule:: ([\w.]+)\n((?:   :.*\n?)*)")
DESCRIBE_ONE = re.compile(r"\.\. (?:autoclass|autofunction|py:data):: ([\w.]+)")


def shell_lines(text: str) -> list[str]:
    blocks = grab_code_blocks(text, lang="bash")
    return [line for block in blocks for line in block.splitlines()]


def described() -> tuple[set[str], set[int]]:
    """Names that the reference describes one by one, and ids of all it describes."""
    text = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    names = set(DESCRIBE_ONE.findall(text))
    ids = set()
    for module, options in DESCRIBE_ALL.findall(text):
        if ":members:" in options:
            ids |= {
                id(value)
                for name, value in vars(import_module(module)).items()
                if not name.startswith("_")
                and (
                    ":imported-members:" in options
                    or getattr(value, "__module__", None) == module
                )
            }
    for name in names:
        module, _, attribute = name.rpartition(".")
        if module:
            ids.add(id(getattr(import_module(module), attribute)))
    return names, ids


def leaves(tree: dict, prefix: str = "") -> list[str]:
    """Dotted names of all values of a nested dictionary."""
    names = []
    for key, value in tree.items():
        name = f"{prefix}{key}"
        names += leaves(value, f"{name}.") if isinstance(value, dict) else [name]
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    check_md_file(page, memory=True)


def test_readmes_diff_is_of_the_drop_in_example():
    (block,) = grab_code_blocks(README, lang="diff")
    example = (ROOT / "examples" / "drop_in_loss.py").read_text(encoding="utf-8")
    for line in block.splitlines():
        if line.startswith("+"):
            assert line[1:] in example


def test_readme_has_one_test_line_and_one_main_job_line():
    fresh = [line for line in shell_lines(README) if line.startswith("python3 -m venv")]
    assert len([line for line in fresh if line.endswith("&& pytest")]) == 1
    job = "&& python examples/offline_osr.py env=hopper"
    assert len([line for line in fresh if line.endswith(job)]) == 1
    assert len(fresh) == 2
    assert len(re.findall(r"(?m)(?:^|[ &])pytest$", README)) == 1


def test_ci_runs_the_readmes_test_line():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "README.md" in script
    assert 'bash -euo pipefail -c "$line"' in script
    assert ".[test]" not in script, "a second copy"


def test_readme_is_short_and_its_links_exist():
    assert len(README.splitlines()) <= 120
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    assert "docs/method.md" in targets
    assert all((ROOT / target).exists() for target in targets)


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_in_the_reference(package):
    names, ids = described()
    module = import_module(package)
    missing = [
        name
        for name in module.__all__
        if f"{package}.{name}" not in names
        and name not in names
        and id(getattr(module, name)) not in ids
    ]
    assert not missing


def test_public_functions_and_configuration_are_in_the_reference():
    text = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    with_members = [
        name for name, rest in DESCRIBE_ALL.findall(text) if "members" in rest
    ]
    assert {"torchrl_osr.functional", "torchrl_osr.lab.run.schema"} <= set(with_members)


def test_settings_page_is_up_to_date():
    """``python docs/settings.py`` writes it."""
    script = runpy.run_path(str(ROOT / "docs" / "settings.py"))
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == script["page"]()


def test_options_of_every_group_are_documented():
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    for group in (
        "env",
        "data",
        "inverse_dynamics",
        "dynamics",
        "loss",
        "perturbation",
        "recovery",
        "logger",
        "preset",
        "hydra/launcher",
    ):
        (row,) = re.findall(rf"(?m)^\| `{group}` \|.*$", page)
        for path in (ROOT / "conf" / group).glob("*.yaml"):
            assert f"`{path.stem}`" in row


def test_family_page_has_every_loss_of_the_configuration():
    page = (ROOT / "docs" / "family.md").read_text(encoding="utf-8")
    for path in (ROOT / "conf" / "loss").glob("*.yaml"):
        assert f"`loss={path.stem}" in page
    deviations = re.findall(r"(?m)\| (\de[-+]\d+) \|$", page)
    assert len(deviations) == page.count("\n| ") - 1
    assert max(map(float, deviations)) < 1e-8
