"""Examples run as a user runs them, with what every one of them must leave behind."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import quicksand

EXAMPLES = Path(__file__).parents[2] / "examples"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": "1"}


def run(name, *args):
    return subprocess.run([sys.executable, EXAMPLES / f"{name}.py", *map(str, args)], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)


def go(name, out, *args):
    return run(name, *args, "--out", out)


def results(name, out, *args, pictures=(), picture_bytes=10000):
    """results.json: every key is a flag or in the docstring, pictures are of some size."""
    done = go(name, out, *args)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    found = json.loads((out / "results.json").read_text())
    text = (EXAMPLES / f"{name}.py").read_text().split('"""')[1]
    flags = set(re.findall(r"--([a-z-]+)", text))
    for key in found:
        assert key.replace("_", "-") in flags or re.search(rf"\b{key}\b", text.split("results.json")[-1]), f"{key} is not in the docstring"
    assert found["dofs"] > 0 and found["wall_time"] > 0
    for picture in pictures:
        assert (out / picture).stat().st_size > picture_bytes
    return found
