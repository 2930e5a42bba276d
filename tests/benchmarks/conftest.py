"""A source distribution has the tests, but not the benchmarks that these are of."""

from __future__ import annotations

from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
collect_ignore_glob = [] if BENCHMARKS.exists() else ["test_*.py"]
