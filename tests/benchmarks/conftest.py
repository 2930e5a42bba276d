"""The benchmarks are scripts: their folder is on the path when one of them runs."""

from __future__ import annotations

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
# A source distribution has the tests, but not what is measured with.
collect_ignore_glob = [] if BENCHMARKS.exists() else ["test_*.py"]
