"""examples/stability.py and stability_fluid.py: their cases, keys and figures, and what a short run of them must show."""

import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quicksand

FOLDER = Path(__file__).parents[2] / "examples"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}
CASES = {"stability": "stack column sizes overlaps tunnel big_steps friction elastic crystal wedge haff".split(),
         "stability_fluid": "steps rest peclet courant small_steps darcy aspect backflow reynolds".split()}
FIGURES = {"stability": ("column.png", "elastic.png", "haff.png"), "stability_fluid": ("peclet.png", "small_steps.png", "darcy.png", "courant.png")}
SMALLEST = {"stability": 5000, "stability_fluid": 4000}  # file [B]
LIMIT = {"stability": 120, "stability_fluid": 200}  # of all cases [s]


def go(example, out, *args, limit):
    environment = ENVIRONMENT | ({"OMP_NUM_THREADS": "1"} if example == "stability_fluid" else {})
    return subprocess.run([sys.executable, FOLDER / f"{example}.py", "--quick", "--out", out, *args], env=environment, capture_output=True, text=True, timeout=limit)


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """A quick run of an example, once: its results, folder and standard output."""
    @functools.cache
    def run(example):
        out = tmp_path_factory.mktemp(example)
        done = go(example, out, limit=LIMIT[example])
        assert done.returncode == 0 and done.stderr == "", done.stderr
        return json.loads((out / "results.json").read_text()), out, done.stdout
    return run


def rows(results, case):
    lists = {name.removeprefix(f"{case}_"): values for name, values in results.items()
             if name.startswith(f"{case}_") and not name.startswith(f"{case}_series")}
    return [dict(zip(lists, row)) for row in zip(*lists.values(), strict=True)]


@pytest.mark.parametrize("example", CASES)
def test_every_case_has_its_rows_and_keys_and_the_docstring_names_them(quick, example):
    results, out, printed = quick(example)
    text = (FOLDER / f"{example}.py").read_text().split('"""')[1]
    for case in CASES[example]:
        assert len(rows(results, case)) >= 2 and f"## {case}" in printed
        for key in rows(results, case)[0]:
            assert re.search(rf"\b(?:{case}_)?{key}\b", text), f"{case}_{key} is not in the docstring"
    for name in (*FIGURES[example], "tables.md"):
        assert (out / name).stat().st_size > SMALLEST[example]


def test_what_must_hold_of_dry_grains_in_a_short_run_too(quick):
    results, _, _ = quick("stability")
    assert all(row["force_error"] < 1e-4 for row in rows(results, "stack") if row["solver"] in ("auto", "newton") and row["tolerance"] == 1e-6)
    assert any(row["unconverged"] for row in rows(results, "stack") if row["solver"] == "nlgs")  # else the case would be an easy one
    assert all(row["made"] == 0 for row in rows(results, "overlaps") if row["scene"] != "pile")
    assert all("more than the smaller radius" in row["beyond_message"] for row in rows(results, "overlaps")[::3])
    assert all(row["through"] == 0 for row in rows(results, "tunnel"))
    assert all(abs(row["pressure"] - 1) < 0.03 for row in rows(results, "crystal"))
    assert all(row["growth"] < 1e-8 for row in rows(results, "elastic") if row["scene"] == "gas" and row["tolerance"] == 1e-8)
    elastic, inelastic = rows(results, "haff")
    assert elastic["collision_rate"] == pytest.approx(1, abs=0.1) and inelastic["rate"] == pytest.approx(1, abs=0.15)


def test_what_must_hold_of_the_fluid_in_a_short_run_too(quick):
    results, _, _ = quick("stability_fluid")
    assert all(row["fastest"] < 1e-7 for row in rows(results, "rest") if row["fastest"] is not None and row["scene"] != "step sinks")
    assert all(row["overshoot"] < 0.2 for row in rows(results, "peclet") if row["element"] == "p1p1")
    assert all(row["growth"] < 1.1 for case in ("courant", "backflow") for row in rows(results, case))
    small = [row for row in rows(results, "small_steps") if row["scene"] in ("channel", "impulse")]
    assert all(row["first"] < 0.05 for row in small if row["dt"] >= 1e-6 or row["scene"] == "channel")
    assert all(row["overshoot"] < 1e-6 for row in rows(results, "darcy") if row["scene"] == "interface" and row["overshoot"] is not None)


@pytest.mark.parametrize("example, case", [("stability", "overlaps"), ("stability_fluid", "peclet")])
def test_one_case_alone_and_a_wrong_name(tmp_path, example, case):
    assert go(example, tmp_path, "--cases", case, limit=LIMIT[example] / 2).returncode == 0
    assert {name.split("_")[0] for name in json.loads((tmp_path / "results.json").read_text())} == {case}
    wrong = go(example, tmp_path, "--cases", "hourglass", limit=LIMIT[example] / 2)
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1 and "hourglass" in wrong.stderr
