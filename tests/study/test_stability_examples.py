"""examples/stability.py: its cases, keys and figures, and what a short run of it must show."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quicksand

EXAMPLE = Path(__file__).parents[2] / "examples" / "stability.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}
CASES = "stack column sizes overlaps tunnel big_steps friction elastic crystal wedge haff".split()


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    out = tmp_path_factory.mktemp("stability")
    done = subprocess.run([sys.executable, EXAMPLE, "--quick", "--out", out], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return json.loads((out / "results.json").read_text()), out, done.stdout


def rows(results, case):
    lists = {name.removeprefix(f"{case}_"): values for name, values in results.items()
             if name.startswith(f"{case}_") and not name.startswith(f"{case}_series")}
    return [dict(zip(lists, row)) for row in zip(*lists.values(), strict=True)]


def test_every_case_has_its_rows_and_keys_and_the_docstring_names_them(quick):
    results, out, printed = quick
    text = EXAMPLE.read_text().split('"""')[1]
    for case in CASES:
        assert len(rows(results, case)) >= 2 and f"## {case}" in printed
        for key in rows(results, case)[0]:
            assert re.search(rf"\b(?:{case}_)?{key}\b", text), f"{case}_{key} is not in the docstring"
    for name in ("column.png", "elastic.png", "haff.png", "tables.md"):
        assert (out / name).stat().st_size > 5000


def test_what_must_hold_in_a_short_run_too(quick):
    results, _, _ = quick
    assert all(row["force_error"] < 1e-4 for row in rows(results, "stack") if row["solver"] in ("auto", "newton") and row["tolerance"] == 1e-6)
    assert any(row["unconverged"] for row in rows(results, "stack") if row["solver"] == "nlgs")  # else the case would be an easy one
    assert all(row["made"] == 0 for row in rows(results, "overlaps") if row["scene"] != "pile")
    assert all("more than the smaller radius" in row["beyond_message"] for row in rows(results, "overlaps")[::3])
    assert all(row["through"] == 0 for row in rows(results, "tunnel"))
    assert all(abs(row["pressure"] - 1) < 0.03 for row in rows(results, "crystal"))
    assert all(row["growth"] < 1e-8 for row in rows(results, "elastic") if row["scene"] == "gas" and row["tolerance"] == 1e-8)
    elastic, inelastic = rows(results, "haff")
    assert elastic["collision_rate"] == pytest.approx(1, abs=0.1) and inelastic["rate"] == pytest.approx(1, abs=0.15)


def test_one_case_alone_and_a_wrong_name(tmp_path):
    go = lambda *args: subprocess.run([sys.executable, EXAMPLE, "--quick", "--out", tmp_path, *args], env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert go("--cases", "overlaps").returncode == 0
    assert {name.split("_")[0] for name in json.loads((tmp_path / "results.json").read_text())} == {"overlaps"}
    wrong = go("--cases", "hourglass")
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1 and "hourglass" in wrong.stderr
