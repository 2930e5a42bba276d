"""Episodes, statistics, the inverse dynamics model's report and figures."""

from torchrl_osr.evaluation.inverse_dynamics import inverse_dynamics_report
from torchrl_osr.evaluation.statistics import mean_interval

__all__ = ["inverse_dynamics_report", "mean_interval"]
