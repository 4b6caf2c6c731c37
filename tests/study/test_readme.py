"""The script in the README runs as it stands there and ends in the weight of the grains."""

import pathlib
import re
import subprocess
import sys

README = pathlib.Path(__file__).parents[2] / "README.md"


def test_the_floor_of_the_readme_script_carries_the_weight():
    block = README.read_text().split("## A script")[1].split("\nSI units")[0]
    script = "\n".join(line[4:] for line in block.splitlines() if line.startswith("    ") or not line)
    printed = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    carried, weight = map(float, re.search(r"carries ([\d.]+) N/m of ([\d.]+) N/m", printed).groups())
    assert abs(carried / weight - 1) < 0.02  # at rest but for what half a second of settling leaves
