"""One page about any number of runs: verdict, tables, figures, differences."""

from torchrl_osr.lab.report.page import write_report
from torchrl_osr.lab.report.runs import RunTables, comparison_notes, read_runs

__all__ = ["RunTables", "comparison_notes", "read_runs", "write_report"]
