"""Examples of grains in a fluid: their keys, their pictures, and how near they come to the drag law."""

import json

import pytest

from run_examples import go, results


# Re 0.7, 134, 2e4; the last a light grain, which rises.
@pytest.mark.parametrize("args", [("--diameter", 1e-4, "--dt-over-tau", 100), ("--dt-over-tau", 0.05), ("--diameter", 2e-2, "--dim", 2, "--dt-over-tau", 100), ("--density", 100)])
def test_a_grain_in_a_fluid_at_rest_falls_as_the_law_says(tmp_path, args):
    found = results("terminal_velocity", tmp_path, *args, pictures=("velocity.png",))
    assert abs(found["error"]) < 1e-6
    assert found["steps"] * found["dt"] > 19.999 * found["tau"] and found["fluid_share"] is None


def test_a_grain_falls_too_fast_in_its_own_wake_the_more_so_the_narrower_that_is(tmp_path):
    errors = []
    for mesh_over_d in (2, 6):
        found = results("terminal_velocity", tmp_path, "--two-way", "--diameter", 1e-4, "--mesh-over-d", mesh_over_d)
        errors.append(found["error"])
        assert found["momentum_error"] < 1e-9 and found["volume_error"] < 1e-11 and found["carried_impulse"] < 1e-6
        assert 0.5 < found["fluid_share"] + found["exchange_share"] + found["grains_share"] <= 1
    assert 0.2 > errors[0] > errors[1] > 0.02


# Measured: -0.5, +0.6, +0.5 %; the goal is 3 %.
@pytest.mark.parametrize("diameter, mesh_over_d", [(2.4e-5, 2), (1e-4, 6), (2.9e-4, 10)])
def test_with_drag_by_the_undisturbed_flow_it_falls_as_the_law_says(tmp_path, diameter, mesh_over_d):
    found = results("terminal_velocity", tmp_path, "--two-way", "--undisturbed", "--diameter", diameter, "--mesh-over-d", mesh_over_d)
    assert abs(found["error"]) < 0.015 and found["wake_over_slip"] > 0.005


# Random beds. Measured, seed 0: -0.24, 0.26, -0.02, -0.08 and 0.93 % (means of five seeds: -0.37, 0.58, -0.07, -0.05, 1.5); of the same law in each point of the void fraction, which
# tells what the packing does: 0.11, 0.28, 0.03, 0.00 %. Without drag on waves shorter than the kernel -0.45, -1.3 at 3 and 0.5.
@pytest.mark.parametrize("args, most", [((), 0.005), (("--mesh-over-d", 0.5), 0.005), (("--mesh-over-d", 6), 0.005), (("--dim", 3), 0.005), (("--open",), 0.02)])
def test_a_held_bed_has_the_pressure_gradient_of_the_law(tmp_path, args, most):
    found = results("packed_bed", tmp_path, *args)
    assert abs(found["error"]) < most
    assert found["momentum_error"] < 1e-11 and found["volume_error"] < 1e-10
    if found["error_local"] is None:
        assert args == ("--open",)
    else:
        assert abs(found["error"] - found["error_local"]) < 0.004
        assert found["steps"] <= 40  # to the steady flow, at k = 1e4


# Jammed discs have channels, and are off the law; let go, they keep the flow that they had when they were held. Measured: 0.06 %, up to 0.32 over five seeds. While elements
# yielded to the pressure itself, and not to its change, the bed slid away: -1.1 %, with another seed -10.
def test_a_jammed_bed_that_is_let_go_stays_and_keeps_its_flow(tmp_path):
    found = results("packed_bed", tmp_path, "--free")
    assert abs(found["error"] - found["error_held"]) < 2.5e-3
    assert found["grain_speed"] < 0.05 and found["momentum_error"] < 1e-11


def test_the_hat_breaks_on_elements_of_a_diameter_and_says_so(tmp_path):
    done = go("packed_bed", tmp_path, "--kernel", "hat", "--mesh-over-d", 0.7)
    assert done.returncode == 2 and "set_void_fraction: must be in (0, 1]" in done.stderr


# Measured: +0.02, +0.16, -0.06. The goal is 0.25.
@pytest.mark.parametrize("diameter, reynolds", [(2.4e-5, 0.0115), (3e-4, 11.1), (1e-3, 134)])
def test_homogeneous_settling_is_that_of_richardson_and_zaki(tmp_path, diameter, reynolds):
    found = results("sedimentation", tmp_path, "--homogeneous", "--viscosity", 1e-3, "--diameter", diameter, pictures=("sedimentation.png",))
    assert found["reynolds"] == pytest.approx(reynolds, rel=0.01)
    assert abs(found["exponent_error"]) < 0.25
    assert found["momentum_error"] < 1e-9 and found["volume_error"] < 1e-6  # of slow flow, what the linear solver leaves


@pytest.mark.parametrize("dim", [2, 3])
def test_a_block_settles_in_a_closed_box_and_none_of_it_gets_out(tmp_path, dim):
    found = results("sedimentation", tmp_path, "--quick", "--dim", dim, pictures=("sedimentation.png",))
    height = found["height"]
    assert len(found["time"]) == len(height) == found["steps"]
    assert height[-1] < 0.6 * height[0] and min(height) > 0
    assert found["front_speed"] > found["front_speed_law"]  # a block falls as one, faster than its grains do through it
    assert found["momentum_error"] < 1e-8 and found["volume_error"] < 1e-7 and found["void_fraction_min"] > 0.1


def test_errors_of_the_coupling_are_charted(tmp_path):
    done = go("accuracy_coupling", tmp_path, "--quick")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "results.json").read_text())
    wake = list(zip(found["wake_undisturbed"], found["wake_error"]))
    assert all(abs(error) < 0.03 if undisturbed else error > 0.04 for undisturbed, error in wake) and len(wake) == 8
    hat, smooth = ([abs(e) for e, kernel in zip(found["beds_error"], found["beds_kernel_over_d"]) if (kernel == 0) == is_hat] for is_hat in (True, False))
    assert max(smooth) < 1e-3 < max(hat)
    slow, fast = zip(*zip(found["crossing_jump"][::2], found["crossing_jump"][1::2]))  # dt and half of it, of the hat and the smooth kernel
    assert fast[0] > slow[0] and fast[1] == pytest.approx(slow[1] / 2, rel=0.02)
    assert all((tmp_path / f"{picture}.png").stat().st_size > 10000 for picture in ("wake", "beds", "crossing"))


@pytest.mark.parametrize("name, args, says", [("packed_bed", ("--mesh-over-d", 0), "must be > 0"), ("sedimentation", ("--phi", 0.9), "at most 0.75"), ("terminal_velocity", ("--density", 1000), "does not fall"),
                                              ("terminal_velocity", ("--undisturbed",), "needs --two-way"),
                                              ("terminal_velocity", ("--diameter", 0), "must be > 0 m")])
def test_a_wrong_flag_is_one_line_and_status_2(tmp_path, name, args, says):
    done = go(name, tmp_path, *args)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and says in done.stderr, done.stderr
