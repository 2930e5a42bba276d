"""One page about any number of runs: verdict, tables, figures, differences."""

from torchrl_osr.lab.report.comparisons import compare, quantities
from torchrl_osr.lab.report.page import write_report
from torchrl_osr.lab.report.runs import (
    RunTables,
    comparison_notes,
    pack_runs,
    read_records,
    read_runs,
)

__all__ = [
    "RunTables",
    "compare",
    "comparison_notes",
    "pack_runs",
    "quantities",
    "read_records",
    "read_runs",
    "write_report",
]
