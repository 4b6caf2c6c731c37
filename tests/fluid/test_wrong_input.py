"""What a user can get wrong is a ValueError that says what and where; what does not converge is NotConverged, with the state as before."""

import numpy as np
import pytest
from quicksand import fluid, meshes


def cavity(element="p1p1", cells=4, viscosity=0.1, **settings):
    flow = fluid.Fluid(meshes.box([1.0, 1.0], counts=[cells, cells]), **({"density": 1.0, "viscosity": viscosity, "element": element} | settings))
    for name in ("left", "right", "bottom"):
        flow.wall(name)
    flow.wall("top", (1.0, 0.0))
    return flow


def test_a_boundary_without_a_condition_is_named():
    flow = fluid.Fluid(meshes.channel(1.0, 1.0, 0.5), density=1.0, viscosity=1.0)
    flow.wall("walls")
    for go in (lambda: flow.step(0.1), flow.solve_steady):
        with pytest.raises(ValueError, match=r"no condition on \[\"inflow\", \"outflow\"\]"):
            go()


@pytest.mark.parametrize("call", [lambda f: f.wall("lid"), lambda f: f.slip("lid"), lambda f: f.inflow("lid", (1.0, 0.0)), lambda f: f.outflow("lid"), lambda f: f.permeable("lid"),
                                  lambda f: f.flux("lid"), lambda f: f.force("lid"), lambda f: f.torque("lid")])
def test_an_unknown_boundary_comes_with_those_that_are_known(call):
    with pytest.raises(ValueError, match="lid.*left.*right.*bottom.*top"):
        call(cavity())


@pytest.mark.parametrize("eps, says", [(0.0, r"in \(0, 1\], got 0"), (-0.1, "got -0.1"), (1.0001, "got 1.0001"), (np.nan, "got nan"), (np.full(25, 1.5), "got 1.5 at"),
                                       (lambda x, t: x[:, 0], "got 0 at"), (np.ones(24), "25 nodes"), (lambda x, t: np.ones(3), r"shape \(25,\), got \(3\)")])
def test_a_void_fraction_is_above_0_and_at_most_1(eps, says):
    with pytest.raises(ValueError, match=says):
        cavity().void_fraction = eps


@pytest.mark.parametrize("settings, says", [({"viscosity": 0.0}, "viscosity must be > 0 Pa s"), ({"viscosity": -1.0}, "got -1"), ({"viscosity": np.nan}, "viscosity"), ({"density": -1.0}, "density must be >= 0"),
                                            ({"density": np.inf}, "density"), ({"gravity": (np.nan, 0.0)}, "gravity must be finite"), ({"gravity": (0.0, 0.0, -9.81)}, r"gravity must have shape \(2,\)"),
                                            ({"element": "q1q1"}, "p1p1.*p2p1.*q1q1")])
def test_properties_that_no_fluid_has(settings, says):
    with pytest.raises(ValueError, match=says):
        cavity(**settings)


def test_there_is_one_reference_of_pressure():
    flow = fluid.Fluid(meshes.channel(1.0, 1.0, 0.5), density=1.0, viscosity=1.0)
    flow.outflow("outflow")
    with pytest.raises(ValueError, match="one reference"):
        flow.mean_pressure(0.0)
    for set_pressure in (lambda f: f.outflow("outflow"), lambda f: f.permeable("outflow")):
        flow = fluid.Fluid(meshes.channel(1.0, 1.0, 0.5), density=1.0, viscosity=1.0)
        flow.mean_pressure(0.0)
        with pytest.raises(ValueError, match="second reference"):
            set_pressure(flow)


@pytest.mark.parametrize("velocity, says", [(lambda x, t: np.ones(len(x)), r"velocity must have shape \(2,\) or \(5, 2\), got \(5\)"), (lambda x, t: np.ones((len(x), 3)), r"got \(5, 3\)"),
                                            (lambda x, t: np.full(x.shape, np.nan), "velocity on \"top\" must be finite"), (lambda x, t: x / 0 * (1, 0), "must be finite")])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_functions_return_is_checked(velocity, says):
    flow = cavity()
    flow.wall("top", velocity)
    with pytest.raises(ValueError, match=says):
        flow.step(0.1)
    assert flow.time == 0


@pytest.mark.parametrize("pressure, says", [(lambda x, t: np.full(len(x), np.inf), "pressure and velocity on \"right\" must be finite"), (lambda x, t: np.ones((len(x), 2)), "pressure must be a number or have shape")])
def test_pressures_are_checked_too(pressure, says):
    flow = cavity()
    flow.outflow("right", pressure)
    with pytest.raises(ValueError, match=says):
        flow.step(0.1)


@pytest.mark.parametrize("values, says", [({"beta": -1.0}, "beta must be >= 0"), ({"beta": np.nan}, "finite"), ({"force": (np.inf, 0.0)}, "finite"), ({"beta": np.ones(7)}, "beta must be a number or have shape"),
                                          ({"beta": 1.0, "target": (np.nan, 0.0)}, "target and force finite")])
def test_reactions_are_checked(values, says):
    with pytest.raises(ValueError, match=says):
        cavity().reaction(**values)


class Broken(Exception):
    pass


def broken(x, t):
    if t > 0.15:
        raise Broken("at a point")
    return np.ones(len(x))


@pytest.mark.parametrize("place", ("wall", "outflow", "void_fraction", "beta"))
def test_an_exception_inside_a_function_comes_through_and_nothing_has_happened(place):
    flow = cavity()
    if place == "wall":
        flow.wall("top", lambda x, t: np.column_stack([broken(x, t), np.zeros(len(x))]))
    elif place == "outflow":
        flow.outflow("right", broken)
    elif place == "void_fraction":
        flow.void_fraction = broken
    else:
        flow.reaction(beta=broken)
    flow.step(0.1)
    before = flow.velocity
    with pytest.raises(Broken, match="at a point"):
        flow.step(0.1)
    assert flow.time == 0.1 and np.array_equal(flow.velocity, before)


def test_a_steady_flow_that_is_not_found_is_said_so_and_the_state_is_kept():
    flow = cavity(cells=8, viscosity=1e-5)
    flow.set_velocity((0.1, 0.0))
    flow.set_pressure(2.0)
    flow.max_newton = 3
    before = flow.velocity
    with pytest.raises(fluid.NotConverged, match="after 4 iterations.*Likely causes"):
        flow.solve_steady()
    assert np.array_equal(flow.velocity, before) and np.all(flow.pressure == 2.0) and flow.time == 0
    assert issubclass(fluid.NotConverged, RuntimeError)


@pytest.mark.parametrize("dt", (0.0, -1.0, np.nan, np.inf))
def test_a_time_step_is_above_zero(dt):
    with pytest.raises(ValueError, match="dt must be > 0 s"):
        cavity().step(dt)


def test_what_flows_into_a_closed_box_must_flow_out():
    flow = cavity()
    flow.inflow("left", (1.0, 0.0))
    with pytest.raises(ValueError, match="no boundary lets fluid leave, but 1"):
        flow.step(0.1)


@pytest.mark.parametrize("x", ((1.2, 0.5), (np.nan, 0.5)))
def test_a_probe_outside_is_an_error(x):
    with pytest.raises(ValueError, match="point 1.*not inside the mesh"):
        cavity().probe([[0.5, 0.5], x])


def test_starting_values_have_the_shape_of_the_nodes_and_are_finite():
    flow = cavity("p2p1")
    for call, says in ((lambda: flow.set_velocity(np.ones((25, 2))), r"\(2,\) or \(81, 2\), got \(25, 2\)"), (lambda: flow.set_pressure(np.ones(81)), r"shape \(25,\)"),
                       (lambda: flow.set_velocity((np.nan, 0.0)), "finite"), (lambda: flow.set_pressure(np.inf), "finite")):
        with pytest.raises(ValueError, match=says):
            call()


def test_forces_are_not_known_before_the_first_step():
    for measure in (cavity().force, cavity().torque):
        with pytest.raises(Exception, match="nothing is known before the first step"):
            measure("top")
