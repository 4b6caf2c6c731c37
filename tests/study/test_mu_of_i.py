"""examples/mu_of_i.py: runs, resumes, fits."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import quicksand

EXAMPLE = Path(__file__).parents[2] / "examples" / "mu_of_i.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}
KEYS = [f"{name}{suffix}{error}" for suffix in ("", "_bulk") for name in ("mu_s", "mu_2", "I0") for error in ("", "_error")]

spec = importlib.util.spec_from_file_location("mu_of_i", EXAMPLE)
study = importlib.util.module_from_spec(spec)
spec.loader.exec_module(study)


def go(*args):
    return subprocess.run([sys.executable, EXAMPLE, *map(str, args)], env=ENVIRONMENT, capture_output=True, text=True, timeout=300)


def synthetic(mu_s, mu_2, i_0, noise=0.0):
    rng = np.random.default_rng(0)
    runs = [{"state": "flowing", "mu": study.mu_of_i(i, mu_s, mu_2, i_0) + noise * rng.standard_normal(), "inertial_number": i}
            for i in np.geomspace(0.01, 0.6, 9)]
    return runs + [{"state": "jammed", "mu": 9.0, "inertial_number": 0.003}, {"state": "flowing", "mu": None, "inertial_number": 0.3}]


def test_the_fit_finds_the_law_and_leaves_out_what_does_not_flow():
    values, errors = study.fit(synthetic(0.21, 0.79, 0.32), "inertial_number")
    np.testing.assert_allclose(values, (0.21, 0.79, 0.32), rtol=1e-6)
    assert (errors < 1e-6).all()
    values, errors = study.fit(synthetic(0.21, 0.79, 0.32, noise=0.003), "inertial_number")
    assert (np.abs(values - (0.21, 0.79, 0.32)) < 4 * errors).all() and (errors > 1e-4).all()
    assert study.fit(synthetic(0.21, 0.79, 0.32)[6:], "inertial_number") == (None, None)


def test_runs_are_made_once_fitted_and_shown(tmp_path):
    args = ("--quick", "--out", tmp_path, "--size-ratios", 1.5, "--rates", 5, 10, 15, 20, "--jobs", 2)
    done = go(*args)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    results = json.loads((tmp_path / "results.json").read_text())
    assert sorted(results) == sorted(["size_ratio"] + KEYS) and results["size_ratio"] == [1.5]
    assert all(len(results[key]) == 1 for key in KEYS) and 0 <= results["mu_s"][0] < results["mu_2"][0]
    assert "| 1.5 | " in (tmp_path / "tables.md").read_text() == done.stdout[:-1]
    for figure in ("figure_3_7", "figure_3_9"):
        assert (tmp_path / f"{figure}.png").stat().st_size > 5000 and (tmp_path / f"{figure}_bulk.png").exists()
    made = {path: path.stat().st_mtime_ns for path in tmp_path.glob("lambda_1.5/rate_*/results.json")}
    assert len(made) == 4
    assert go(*args, "--seeds", 2).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert len(list(tmp_path.glob("lambda_1.5/rate_*/seed_1/results.json"))) == 4


def test_a_study_that_is_stopped_goes_on(tmp_path):
    rates = (20, 10, 5, 2)  # a quick run takes from half a second on: the signal finds one of them at work
    args = ("--out", tmp_path, "--size-ratios", 1.5, "--rates", *rates, "--jobs", 1, "--quick")
    process = subprocess.Popen([sys.executable, EXAMPLE, *map(str, args)], env=ENVIRONMENT, stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True, start_new_session=True)
    places = [tmp_path / "lambda_1.5" / f"rate_{rate}" for rate in rates]
    while not places[0].exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C on a terminal does
    message = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and message.count("\n") == 1 and "the same command goes on" in message
    assert not (places[-1] / "results.json").exists()
    for place in places:
        if (place / "checkpoint.h5").exists():  # the run had begun to step
            assert json.loads((place / "results.json").read_text())["state"] == "interrupted"
    assert go(*args).returncode == 0
    for place in places:
        results = json.loads((place / "results.json").read_text())
        assert results["state"] in ("flowing", "jammed") and results["steps"] >= 2000 and not (place / "checkpoint.h5").exists()


@pytest.mark.parametrize("args, rule", [
    (["--size-ratios", "0.5"], "--size-ratios: must be >= 1, got 0.5"), (["--rates", "0"], "--rates: must be > 0 1/s, got 0"),
    (["--jobs", "0"], "--jobs: must be >= 1"), (["--rates"], "expected at least one argument"), (["--out", "/proc/nowhere"], "/proc/nowhere"),
])
def test_a_wrong_flag_ends_with_one_line_and_status_2(args, rule):
    done = go(*args)
    assert done.returncode == 2 and rule in done.stderr and done.stderr.count("\n") == 1 and done.stdout == ""
