"""examples/stability_fluid.py: its cases, keys and figures, and what a short run of it must show."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quicksand

EXAMPLE = Path(__file__).parents[2] / "examples" / "stability_fluid.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
CASES = "steps rest peclet courant small_steps darcy aspect backflow reynolds".split()


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    out = tmp_path_factory.mktemp("stability_fluid")
    done = subprocess.run([sys.executable, EXAMPLE, "--quick", "--out", out], env=ENVIRONMENT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return json.loads((out / "results.json").read_text()), out, done.stdout


def rows(results, case):
    lists = {name.removeprefix(f"{case}_"): values for name, values in results.items() if name.startswith(f"{case}_")}
    return [dict(zip(lists, row)) for row in zip(*lists.values(), strict=True)]


def test_every_case_has_its_rows_and_keys_and_the_docstring_names_them(quick):
    results, out, printed = quick
    text = EXAMPLE.read_text().split('"""')[1]
    for case in CASES:
        assert len(rows(results, case)) >= 2 and f"## {case}" in printed
        for key in rows(results, case)[0]:
            assert re.search(rf"\b(?:{case}_)?{key}\b", text), f"{case}_{key} is not in the docstring"
    for name in ("peclet.png", "small_steps.png", "darcy.png", "courant.png", "tables.md"):
        assert (out / name).stat().st_size > 4000


def test_what_must_hold_in_a_short_run_too(quick):
    results, _, _ = quick
    assert all(row["fastest"] < 1e-7 for row in rows(results, "rest") if row["fastest"] is not None and row["scene"] != "step sinks")
    assert all(row["overshoot"] < 0.2 for row in rows(results, "peclet") if row["element"] == "p1p1")
    assert all(row["growth"] < 1.1 for case in ("courant", "backflow") for row in rows(results, case))
    small = [row for row in rows(results, "small_steps") if row["scene"] in ("channel", "impulse")]
    assert all(row["first"] < 0.05 for row in small if row["dt"] >= 1e-6 or row["scene"] == "channel")
    assert all(row["overshoot"] < 1e-6 for row in rows(results, "darcy") if row["scene"] == "interface" and row["overshoot"] is not None)


def test_one_case_alone_and_a_wrong_name(tmp_path):
    go = lambda *args: subprocess.run([sys.executable, EXAMPLE, "--quick", "--out", tmp_path, *args], env=ENVIRONMENT, capture_output=True, text=True, timeout=100)
    assert go("--cases", "peclet").returncode == 0
    assert {name.split("_")[0] for name in json.loads((tmp_path / "results.json").read_text())} == {"peclet"}
    wrong = go("--cases", "hourglass")
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1 and "hourglass" in wrong.stderr
