"""Many recorded episodes through every reader: right, or refused by name?

    python benchmarks/data_properties.py --examples 2000

Runs the tests of ``tests/data/read/test_data_properties.py`` with more examples than
the suite has time for, counts what came of them and writes
``results/reliability/data_properties.json``. An example that gives a wrong number ends
the run with that example.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
import warnings
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "results" / "reliability" / "data_properties.json"
TESTS = ("test_episodes", "test_rows_and_files", "test_minari", "test_export_and_back")


def property_tests(examples: int) -> ModuleType:
    """Import the tests, which read the number of examples when they are imported."""
    os.environ["TORCHRL_OSR_PROPERTY_EXAMPLES"] = str(examples)
    sys.path.insert(0, str(ROOT / "tests"))  # what the tests share
    path = ROOT / "tests" / "data" / "read" / "test_data_properties.py"
    spec = importlib.util.spec_from_file_location("data_properties_tests", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Run each property, print and write the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=2000, help="of each property")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    # Minari asks for an author's address, and more, whenever a set is made.
    warnings.filterwarnings("ignore", category=UserWarning, module="minari")
    module = property_tests(arguments.examples)
    seconds = {}
    for name in TESTS:
        start = time.perf_counter()
        getattr(module, name)()
        seconds[name] = round(time.perf_counter() - start, 1)
        print(f"{name}: {arguments.examples} examples, {seconds[name]} s, all right")
    result = {
        "examples_of_each_property": arguments.examples,
        "wrong": 0,  # else the run has ended above
        "outcomes": dict(sorted(module.OUTCOMES.items())),
        "seconds": seconds,
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
