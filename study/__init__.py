"""What every study repeats, once: flags, the stepping loop, results.json, the summary and the figures."""

from .arguments import CommandLine, Parser, number, whole
from .cases import run_cases
from .figures import BLUE, FAINT, RED, plot_along, plot_errors, plot_flow, plot_flow_curves, plot_lines, plot_profile, plot_series, plot_snapshot
from .results import print_summary, write_results
from .run import Run
