"""One page about any number of runs: tables, figures and paired comparisons."""

from torchrl_osr.report.page import write_report

__all__ = ["write_report"]
