"""examples/dry_couette.py, run as a user runs it, in cells of a few hundred discs."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import quicksand

EXAMPLE = Path(__file__).parents[2] / "examples" / "dry_couette.py"
FLAGS = ("--out --rate --pressure --size-ratio --height --width --friction --wall-friction --rough-walls --fixed-height --dt --t-end "
         "--tolerance --threads --seed --quick --no-plots --frame-every --checkpoint-every --restart").split()
KEYS = """n_grains h phi phi_std phi_err mu mu_std mu_err tau tau_std sigma_xx sigma_yy sigma_yy_std sigma_yy_wall_contacts
          sigma_yy_kinetic wall_pressure branch_length shear_rate_bulk inertial_number inertial_number_bulk psi6 coordination
          t_converged state max_overlap energy_error residual_max unconverged_steps steps sweeps_per_step wall_time threads""".split()


def run(*args, code=None):
    """Run the example, or Python code that does."""
    program = [str(EXAMPLE)] if code is None else ["-c", code]
    environment = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}
    return subprocess.run([sys.executable, *program, *map(str, args)], env=environment, capture_output=True, text=True, timeout=200)


def results_of(out, *args, threads=2):
    done = run("--quick", "--out", out, "--threads", threads, *args)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no progress bar where there is no terminal, no warning
    return json.loads((out / "results.json").read_text()), done.stdout


@pytest.fixture(scope="module")
def rough(tmp_path_factory):
    """Rough walls keep a small cell from crystallising: it flows, and is steady for most of the time."""
    out = tmp_path_factory.mktemp("rough")
    results, printed = results_of(out, "--rough-walls", "--size-ratio", 1.5)
    return out, results, printed


def test_results_hold_every_key_and_nothing_undefined(rough):
    _, results, _ = rough
    assert sorted(results) == sorted(KEYS)
    assert [key for key in KEYS if results[key] is None and not key.endswith("_err")] == []
    assert results["state"] == "flowing" and results["threads"] == 2


def test_the_parts_of_the_normal_stress_balance_the_load(rough):
    # Exact in a long mean; d/dt of sum(m y v_y) over about a second, and the walls' own acceleration, leave some 0.05 Pa.
    _, results, _ = rough
    parts = results["sigma_yy"] + results["sigma_yy_wall_contacts"] + results["sigma_yy_kinetic"]
    assert parts == pytest.approx(results["wall_pressure"], abs=0.15)
    assert results["wall_pressure"] == pytest.approx(5.0, abs=0.15)


def test_quantities_follow_from_each_other(rough):
    _, results, _ = rough
    assert results["mu"] == pytest.approx(abs(results["tau"]) / abs(results["sigma_yy"]), rel=1e-12)
    scale = results["branch_length"] / np.sqrt(5.0 / 1000.0)  # of the defaults
    assert results["inertial_number"] == pytest.approx(10.0 * scale, rel=1e-12)
    assert results["inertial_number_bulk"] == pytest.approx(results["shear_rate_bulk"] * scale, rel=1e-12)
    # phi = sum(pi r^2) / (width h), by the mean of r^2 for radii uniform in 0.8-1.2 mm: 1.0133 mm^2, known to 1 % from 448 discs.
    assert results["phi"] * 0.06 * results["h"] == pytest.approx(results["n_grains"] * np.pi * 1.0133e-6, rel=0.03)


def test_the_flow_is_that_of_grains(rough):
    # Wide bands, of what any dense inertial flow of such discs shows: signs, orders of magnitude.
    _, results, _ = rough
    assert results["n_grains"] == 448
    assert results["tau"] < 0 and 0.2 < results["mu"] < 0.7
    assert 0.65 < results["phi"] < 0.84
    assert 0.3 * 10 < results["shear_rate_bulk"] < 1.2 * 10
    assert 1.9e-3 < results["branch_length"] < 2.2e-3
    assert 0 < results["psi6"] < 0.8 and 0.5 < results["coordination"] < 4
    assert results["energy_error"] < 1e-6
    assert results["max_overlap"] < 0.005
    assert 0.2 - 1e-9 <= results["t_converged"] < 2.0  # not before a tenth of the time, a sum of time steps


def test_the_summary_names_no_reference_for_another_scene(rough):
    assert "thesis" not in rough[2] and "phi" in rough[2]


def test_figures_are_written(rough):
    out, _, _ = rough
    from matplotlib.image import imread

    for name in ("series.png", "profiles.png", "snapshot.png"):
        picture = imread(out / name)
        assert min(picture.shape[:2]) > 400 and picture[..., :3].std() > 0.02  # not blank


def test_flat_walls_and_no_plots(tmp_path):
    results, _ = results_of(tmp_path, "--no-plots", "--frame-every", 0, "--checkpoint-every", 0, "--t-end", 1)
    assert sorted(results) == sorted(KEYS) and os.listdir(tmp_path) == ["results.json"]
    assert results["branch_length"] is None or results["branch_length"] == pytest.approx(2e-3, rel=1e-3)  # one size, hardly overlapping


def test_a_fixed_height_is_reached_and_held(tmp_path):
    results, _ = results_of(tmp_path, "--no-plots", "--t-end", 1, "--fixed-height", "--size-ratio", 1.5, "--height", 0.02)
    assert results["h"] == pytest.approx(0.02, rel=1e-9) and results["phi_std"] < 1e-9
    assert results["t_converged"] == pytest.approx(0.1)
    total = results["sigma_yy"] + results["sigma_yy_wall_contacts"] + results["sigma_yy_kinetic"]
    assert results["inertial_number"] == pytest.approx(10.0 * results["branch_length"] / np.sqrt(total / 1000.0), rel=1e-12)


def test_results_depend_on_the_seed_and_not_on_the_threads(tmp_path):
    first, second, other = (
        results_of(tmp_path / name, "--no-plots", "--t-end", 0.3, "--size-ratio", 1.5, "--seed", seed, threads=threads)[0]
        for name, seed, threads in (("a", 1, 1), ("b", 1, 2), ("c", 2, 2)))
    for results in first, second, other:
        del results["threads"], results["wall_time"]
    assert first == second and first != other


def test_ctrl_c_writes_what_there_is(tmp_path):
    done = run("--quick", "--no-plots", "--threads", 2, "--out", tmp_path, code=f"""
import os, runpy, signal
from quicksand import study
record = study.Run.record
def record_and_interrupt(run, **values):
    record(run, **values)
    if run.samples == 150 and "h" in values:
        os.kill(os.getpid(), signal.SIGINT)
study.Run.record = record_and_interrupt
runpy.run_path({str(EXAMPLE)!r}, run_name="__main__")
""")
    assert done.returncode == 130 and done.stderr == ""
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["state"] == "interrupted" and results["steps"] >= 150 and sorted(results) == sorted(KEYS)


@pytest.mark.parametrize("args, rule", [
    (["--rate", "0"], "--rate: must be > 0 1/s, got 0"),
    (["--width", "0.006"], "four diameters"),
    (["--angle", "3"], "unrecognized arguments"),
])
def test_a_wrong_flag_ends_with_one_line_and_status_2(tmp_path, args, rule):
    done = run("--quick", "--out", tmp_path, *args)
    assert done.returncode == 2 and rule in done.stderr
    assert done.stderr.count("\n") == 1 and done.stdout == ""


@pytest.fixture
def message(tmp_path, monkeypatch, capfd):
    """main() in this process, with flags that it must refuse before the first step: what it writes to stderr."""
    spec = importlib.util.spec_from_file_location("dry_couette", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    monkeypatch.setattr(example, "simulate", lambda *_: pytest.fail("it runs"))

    def main(*args):
        monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--quick", "--out", str(tmp_path), *args])
        with pytest.raises(SystemExit) as end:
            example.main()
        out, err = capfd.readouterr()
        assert end.value.code == 2 and out == "" and err.count("\n") == 1 and err.startswith("dry_couette.py: "), (args, err)
        return err

    return main


@pytest.mark.parametrize("args, rule", [
    (["--pressure", "-5"], "--pressure: must be > 0 Pa, got -5"),
    (["--size-ratio", "0.9"], "--size-ratio: must be >= 1, got 0.9"),
    (["--friction", "-0.1"], "--friction: must be >= 0"),
    (["--friction", "1e40"], "set_friction: friction must be >= 0 and finite, got 1e+40"),
    (["--threads", "none"], "--threads: must be a whole number, got 'none'"),
    (["--threads", "0"], "--threads: must be >= 1, got 0"),
    (["--threads", "5000"], "Simulation: threads must be 1 to 1024, got 5000"),
    (["--tolerance", "2"], "Simulation: tolerance must be in (0, 1], got 2"),
    (["--width", "0.001"], "no grain of radius 0.001 m fits"),
    (["--width", "1e9"], "hexagonal_lattice: spacing 0.0021 m gives a cell of 1e+09 m x 0.03 m more than 1e+08 sites"),
    (["--height", "1e300"], "more than 1e+08 sites"),
    (["--fixed-height", "--size-ratio", "9"], "more than fits"),
    (["--rate", "1e20"], "step: dt = 0.001 s takes more than 1e9 sub-steps"),
    (["--rate", "1e300"], "add: velocity [m/s] must be finite"),
    (["--pressure", "1e25"], "step: dt = 0.001 s takes more than 1e9 sub-steps"),
    (["--pressure", "1e300"], "add_plane: load must be finite"),
    (["--dt", "1e-300", "--t-end", "1e-299"], "step: dt must be between 1e-30 and 1e30 s, got 1e-300"),
    (["--dt", "1e40", "--t-end", "1e40"], "step: dt must be between 1e-30 and 1e30 s, got 1e+40"),
    (["--t-end", "1e300"], "--t-end: must be at most 1e9 time steps"),
    (["--t-end", "0.0005"], "--t-end: must be at least one time step"),
])
def test_what_is_wrong_is_said_with_the_value(message, args, rule):
    assert rule in message(*args)


def test_no_nonsense_after_a_flag_is_taken_for_a_value(message):
    numbers = ("--rate --pressure --size-ratio --height --width --friction --wall-friction --dt --t-end --tolerance --threads "
               "--seed --frame-every --checkpoint-every").split()
    for flag in numbers:
        for nonsense in ("nan", "-nan", "inf", "-inf", "-1", "1e400", "abc", "", " ", "0x10", "1,5", "--", "1 2", "\x00", "１．５ｍ"):
            assert flag in message(flag, nonsense) or nonsense == "--"
        message(flag)  # nothing at all
    for flag in FLAGS:
        if flag not in numbers and flag != "--out":
            message(flag + "=1")


def test_help_explains_every_flag_and_every_result():
    words = run("--help").stdout.split()
    assert [name for name in FLAGS + KEYS if name not in words] == []
