"""examples/immersed_couette.py: its balances, its limit without a fluid, a run that goes on."""

import json
import sys
import types

import numpy as np
import pytest

from run_examples import EXAMPLES, go
from test_dry_couette import KEYS as OF_THE_DRY

KEYS = """viscous_number visco_inertial_number stokes_number fluid_shear_stress mean_drag momentum_error volume_error carried_impulse fluid_share exchange_share
          grains_share plate_shear_traction shear_stress shear_stress_variation drained_volume_error fluid_step_time dofs""".split()


def results_of(out, *args):
    done = go("immersed_couette", out, *args)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "results.json").read_text()), done.stdout


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    out = tmp_path_factory.mktemp("short")
    return out, *results_of(out, "--quick", "--threads", 2, "--t-end", 0.6)


def test_results_hold_the_keys_of_the_issue_and_those_of_the_dry_example(short):
    out, results, printed = short
    assert sorted(results) == sorted(OF_THE_DRY + KEYS)
    for name in ("series", "profiles", "shear_stress", "snapshot"):
        assert (out / f"{name}.png").stat().st_size > 5000
    assert "viscous_number" in printed


def test_balances_close(short):
    _, results, _ = short
    assert results["drained_volume_error"] < 1e-10
    assert results["momentum_error"] < 1e-9 and results["volume_error"] < 1e-10
    assert results["fluid_share"] + results["exchange_share"] + results["grains_share"] == pytest.approx(1, abs=0.02)
    assert results["wall_pressure"] == pytest.approx(5.0, abs=0.1)  # whatever the pore pressure: the plates feel grains only
    assert results["carried_impulse"] < 0.03


def test_a_run_that_is_stopped_goes_on_as_if_it_had_not_been(short, tmp_path):
    out, results, _ = short
    results_of(tmp_path, "--quick", "--threads", 2, "--t-end", 0.3, "--no-plots")
    again, _ = results_of(tmp_path, "--restart", tmp_path / "checkpoint.h5", "--t-end", 0.6, "--no-plots")
    timed = ("wall_time", "fluid_step_time", "fluid_share", "exchange_share", "grains_share")
    assert {key: value for key, value in again.items() if key not in timed} == {key: value for key, value in results.items() if key not in timed}


def test_a_fluid_of_no_density_and_viscosity_is_none(tmp_path):
    sys.path.insert(0, str(EXAMPLES))
    import dry_couette
    import immersed_couette

    flags = types.SimpleNamespace(**dry_couette.command_line().defaults() | {
        "height": 0.03, "width": 0.06, "threads": 2, "viscosity": 1e-10, "fluid_density": 1e-8, "kernel_radius": 3e-3, "mesh_size": 8e-3, "element": "p1p1", "start_phi": 0.75})
    wet, dry = immersed_couette.Immersed(flags), dry_couette.Scene(flags, start_phi=0.75)
    for _ in range(20):
        wet.both.step(1e-3)
        dry.sim.step(1e-3)
    assert np.allclose(wet.sim.velocity, dry.sim.velocity, atol=1e-6 * 0.15)
