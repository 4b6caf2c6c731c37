"""Bad input is an exception that names function, rule, value and unit, and changes nothing; and 200 random ones never crash.

`python test_bad_input.py 20000 7` runs the fuzz by itself, so many inputs from that seed.
"""

import faulthandler
import os
import pathlib
import random
import subprocess
import sys

import numpy as np
import pytest

import quicksand
from quicksand import grains, study

NAN, INF = float("nan"), float("inf")
R = 1e-3  # [m]


def vector(dim, x, y):
    return np.array([x, y, 0.0][:dim])


class Scene:
    """Three grains, two of them on a floor and under a lid, after a step: there are contacts and forces that could be lost."""

    def __init__(self, dim):
        self.dim = dim
        self.sim = sim = grains.Simulation(dim=dim, period=(0.1, None, 0.1)[:dim], gravity=vector(dim, 0, -9.81), threads=1)
        sim.set_friction("grain", "grain", 0.4)
        sim.set_friction("grain", "wall", 0.6)
        sim.add([vector(dim, 0, R), vector(dim, 0, 3 * R), vector(dim, 0.03, R)], R)
        self.floor = sim.add_plane(vector(dim, 0, 0), vector(dim, 0, 1))
        self.lid = sim.add_plane(vector(dim, 0, 4 * R), vector(dim, 0, -1), load=vector(dim, 0, -0.01), velocity=(None,) * dim)
        sim.attach(self.floor, [vector(dim, 0.02, 0)], R)
        sim.set_force(np.full((3, dim), 1e-4))
        sim.step(1e-3)


def overlapping(scene):
    scene.sim.position = [vector(scene.dim, x, R) for x in (0.0, 0.9 * R, 0.03)]


def behind_the_floor(scene):
    scene.sim.position = [vector(scene.dim, 0.01 * k, (1, 2, -0.1)[k] * R) for k in range(3)]


def on_a_fixed_grain(scene):
    scene.sim.position = [vector(scene.dim, x, 0.5 * R) for x in (0.0, 0.01, 0.02)]


def a_second_lid_below_the_floor(scene):
    scene.sim.add_plane(vector(scene.dim, 0, -2 * R), vector(scene.dim, 0, -1))


def a_grain_of_glass(scene):
    scene.sim.set_friction("glass", "glass", 0.1)
    scene.sim.add([vector(scene.dim, -0.03, R)], R, material="glass")


def at_rest(dim, n=3):
    return np.zeros((n, dim))


def spoiled(values, value):
    values = np.array(values, float)
    values.flat[-1] = value
    return values


def plane(scene, **more):
    return scene.sim.add_plane(vector(scene.dim, 0, 0), vector(scene.dim, 0, 1), **more)


def as_it_is(scene):
    pass


X = {dim: np.array([vector(dim, -0.03, R), vector(dim, -0.02, R)]) for dim in (2, 3)}

# (the call that must fail, words of the message); `s` is a Scene
RULES = [
    # radius, density, NaN, shapes
    (lambda s: s.sim.add(X[s.dim], 0.0), "add: radius must be > 0 m, got 0 (grain 0)"),
    (lambda s: s.sim.add(X[s.dim], [R, -R]), "add: radius must be > 0 m, got -0.001 (grain 1)"),
    (lambda s: s.sim.add(X[s.dim], NAN), "add: radius must be > 0 m, got nan"),
    (lambda s: s.sim.add(X[s.dim], INF), "add: radius must be between 1e-30 and 1e30 m, got inf"),
    (lambda s: s.sim.add(X[s.dim], [R]), "add: one radius per grain, got 1 for 2 grains"),
    (lambda s: s.sim.add(X[s.dim], R, density=0), "add: density must be > 0 kg/m^3, got 0"),
    (lambda s: s.sim.add(spoiled(X[s.dim], NAN), R), "add: position [m] must be finite, got nan (grain 1)"),
    (lambda s: s.sim.add(X[s.dim][:, :1], R), "add: position must be an array of shape (n, "),
    (lambda s: s.sim.add(X[s.dim], R, velocity=spoiled(X[s.dim], INF)), "add: velocity [m/s] must be finite, got inf (grain 1)"),
    (lambda s: s.sim.add(X[s.dim], R, velocity=at_rest(s.dim, 0)), "add: one velocity per grain, got 0 for 2 grains"),
    (lambda s: s.sim.add(X[s.dim], R, spin=[NAN] * 2 if s.dim == 2 else at_rest(3, 2) * NAN),
     "add: spin [rad/s] must be finite, got nan (grain 0)"),
    (lambda s: s.sim.add(X[s.dim], R, material="marble"), "add: unknown material 'marble'"),
    (lambda s: s.sim.add(X[s.dim], 0.013), "add: a period must be at least four diameters, got 0.1 m for radius 0.013 m (grain 0)"),
    (lambda s: s.sim.attach(s.floor, X[s.dim], -R), "attach: radius must be > 0 m, got -0.001 (grain 0)"),
    (lambda s: s.sim.attach(s.floor, X[s.dim], 0.013), "attach: a period must be at least four diameters, got 0.1 m"),
    (lambda s: s.sim.attach(s.floor, spoiled(X[s.dim], NAN), R), "attach: position [m] must be finite, got nan (grain 1)"),
    (lambda s: s.sim.attach(s.floor, X[s.dim], R, material="marble"), "attach: unknown material 'marble'"),
    (lambda s: s.sim.attach(Scene(s.dim).floor, X[s.dim], R), "attach: wall 0 belongs to another simulation"),
    # walls
    (lambda s: s.sim.add_plane(vector(s.dim, 0, NAN), vector(s.dim, 0, 1)), "add_plane: point [m] must be finite, got (0, nan"),
    (lambda s: s.sim.add_plane(vector(s.dim, 0, 0), vector(s.dim, 0, 0)), "add_plane: normal must be finite and not zero, got (0, 0"),
    (lambda s: s.sim.add_plane(vector(s.dim, 0, 0), vector(s.dim, 1, 1)), "add_plane: normal must be 0 along a periodic axis"),
    (lambda s: plane(s, material="x"), "add_plane: unknown material 'x'"),
    (lambda s: plane(s, velocity=vector(s.dim, 1, 2), load=vector(s.dim, 3, 4)),
     "add_plane: axis 0 is driven by velocity (1 m/s) and by load (3 N)"),
    (lambda s: plane(s, velocity=(1.0,)), "add_plane: velocity needs one entry per axis"),
    (lambda s: plane(s, velocity=vector(s.dim, 1, NAN)),
     "add_plane: velocity must be finite, got nan m/s (axis 1)"),
    (lambda s: plane(s, load=vector(s.dim, INF, 1)), "add_plane: load must be finite, got inf N (axis 0)"),
    (lambda s: plane(s, load=vector(s.dim, 0, 1), mass=-1.0), "add_plane: mass must be > 0 kg, got -1"),
    (lambda s: plane(s, mass=2.0), "add_plane: mass is that of load-driven axes, and no axis has a load, got 2 kg"),
    (lambda s: s.floor.drive(0, NAN), "drive: velocity must be finite, got nan m/s (wall 0, axis 0)"),
    (lambda s: s.floor.drive(3, 1.0), "drive: axis must be 0 to "),
    (lambda s: s.floor.set_load(1, INF), "set_load: load must be finite, got inf N (wall 0, axis 1)"),
    (lambda s: s.floor.set_load(-1, 1.0), "set_load: axis must be 0 to "),
    # materials
    (lambda s: s.sim.set_friction("grain", "wall", -0.1), "set_friction: friction must be >= 0 and finite, got -0.1 ('grain' on 'wall')"),
    (lambda s: s.sim.set_friction("grain", "new", NAN), "set_friction: friction must be >= 0 and finite, got nan"),
    (lambda s: s.sim.set_friction("new", "", 0.1), "set_friction: a material needs a name"),
    (lambda s: s.sim.set_restitution("grain", "wall", 1.1), "set_restitution: normal restitution must be in [0, 1], got 1.1"),
    (lambda s: s.sim.set_restitution("grain", "wall", 1, NAN), "set_restitution: tangential restitution must be in [0, 1], got nan"),
    (lambda s: s.sim.set_restitution("grain", "marble", 1), "set_restitution: unknown material 'marble'"),
    (lambda s: s.sim.set_inertia(0), "set_inertia: I/(m r^2) must be in (0, 1], got 0"),
    # state and settings
    (lambda s: setattr(s.sim, "position", spoiled(at_rest(s.dim), NAN)), "set_position: position [m] must be finite, got nan (grain 2)"),
    (lambda s: setattr(s.sim, "position", at_rest(s.dim, 2)), "set_position: one position per grain, got 2 for 3 grains"),
    (lambda s: setattr(s.sim, "velocity", spoiled(at_rest(s.dim), NAN)),
     "set_velocity: velocity [m/s] must be finite, got nan (grain 2)"),
    (lambda s: setattr(s.sim, "spin", spoiled(s.sim.spin, INF)), "set_spin: spin [rad/s] must be finite, got inf (grain 2)"),
    (lambda s: s.sim.set_force(spoiled(at_rest(s.dim), NAN)), "set_force: force [N] must be finite, got nan (grain 2)"),
    (lambda s: s.sim.set_force(at_rest(s.dim, 0)), "set_force: one force per grain, got 0 for 3 grains"),
    (lambda s: s.sim.set_drag([1.0, -1.0, 0.0], at_rest(s.dim)), "set_drag: coefficient must be >= 0 kg/s and finite, got -1 (grain 1)"),
    (lambda s: s.sim.set_drag(np.ones(3), spoiled(at_rest(s.dim), INF)), "set_drag: velocity [m/s] must be finite, got inf (grain 2)"),
    (lambda s: s.sim.set_drag(np.ones(3)), "set_drag: one velocity per grain, got 0 for 3 grains"),
    (lambda s: s.sim.remove([3]), "remove: no grain 3, the scene has 3"),
    (lambda s: s.sim.remove([0, 2, 0]), "remove: grain 0 is named twice"),
    (lambda s: s.sim.remove(np.array([True, False, False])), "remove: ids must be integers of shape (n,), got bool of 1 dimensions"),
    (lambda s: s.sim.contact_impulse, "contact_impulse: kept only while there is drag; call set_drag"),
    (lambda s: setattr(s.sim, "gravity", vector(s.dim, 0, NAN)), "Simulation: gravity must be finite, got (0, nan"),
    (lambda s: setattr(s.sim, "gravity", [0.0]), "Simulation: gravity must have shape ("),
    (lambda s: setattr(s.sim, "threads", 0), "Simulation: threads must be 1 to 1024, got 0"),
    (lambda s: setattr(s.sim, "tolerance", 0.0), "Simulation: tolerance must be in (0, 1], got 0"),
    (lambda s: setattr(s.sim, "max_sweeps", 0), "Simulation: max_sweeps must be >= 1, got 0"),
    (lambda s: setattr(s.sim, "active_sweeps", -1), "Simulation: active_sweeps must be >= 1, got -1"),
    (lambda s: setattr(s.sim, "omega", 2.0), "Simulation: omega must be in [1, 2), got 2"),
    (lambda s: setattr(s.sim, "sub_step_motion", NAN), "Simulation: sub_step_motion must be in (0, 0.5], got nan"),
    (lambda s: setattr(s.sim, "rest_speed", INF), "Simulation: rest_speed must be >= 0 m/s and finite, got inf"),
    (lambda s: setattr(s.sim, "solver", "lu"), "Simulation: solver must be one of 'auto', 'nlgs', 'active_set', 'accelerated', 'newton', got 'lu'"),
    (lambda s: setattr(s.sim, "sub_step_rule", ""), "Simulation: sub_step_rule must be 'relative' or 'absolute', got ''"),
    (lambda s: grains.Simulation(dim=4), "Simulation: dim must be 2 or 3, got 4"),
    (lambda s: grains.Simulation(s.dim, period=(0.1,)), "Simulation: period needs one entry per axis"),
    (lambda s: grains.Simulation(s.dim, period=vector(s.dim, 0.1, -1)),
     "Simulation: period must be > 0 m, or 0 along axes that are not periodic, got -1 (axis 1)"),
    (lambda s: grains.Simulation(s.dim, gravity=vector(s.dim, INF, 0)), "Simulation: gravity must be finite, got (inf, 0"),
    (lambda s: grains.Simulation(s.dim, treads=2), "Simulation: unknown setting 'treads', known: threads"),
    # measurements
    (lambda s: s.sim.profile(3, 0, 1, 10), "profile: axis must be 0 to "),
    (lambda s: s.sim.profile(1, 0, INF, 10), "profile: low < high must be finite, got 0 and inf m"),
    (lambda s: s.sim.profile(1, 0, 1, 0), "profile: bins must be 1 to 1000000, got 0"),
    # the start, and the step
    (lambda s: s.sim.step(0), "step: dt must be > 0 s, got 0"),
    (lambda s: s.sim.step(-1e-3), "step: dt must be > 0 s, got -0.001"),
    (lambda s: s.sim.step(NAN), "step: dt must be > 0 s, got nan"),
    (lambda s: s.sim.check(INF), "step: dt must be between 1e-30 and 1e30 s, got inf"),
    (lambda s: s.sim.step(1e15), "step: dt = 1000000000000000 s takes more than 1e9 sub-steps at speeds up to"),
]

# (what is wrong about the start, the call that must tell, words of the message)
STARTS = [
    (overlapping, lambda s: s.sim.step(1e-3), "step: grain 0 and grain 1 overlap by 0.0011 m, more than the smaller radius, 0.001 m"),
    (overlapping, lambda s: s.sim.check(1e-3), "step: grain 0 and grain 1 overlap by 0.0011 m"),
    (on_a_fixed_grain, lambda s: s.sim.step(1e-3), "step: a grain fixed to wall 0 and grain 2 overlap by 0.0015 m"),
    (behind_the_floor, lambda s: s.sim.step(1e-3), "step: grain 2 is 0.0001 m behind wall 0"),
    (a_second_lid_below_the_floor, lambda s: s.sim.step(1e-3), "step: walls 0 and 2 cross: they face each other over -0.002 m"),
    (a_grain_of_glass, lambda s: s.sim.step(1e-3), "step: no friction set between 'grain' and 'glass'"),
]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("prepare, call, words", [(as_it_is, *rule) for rule in RULES] + STARTS)
def test_a_broken_rule_is_told_with_function_value_and_unit_and_changes_nothing(dim, prepare, call, words):
    scene = Scene(dim)
    prepare(scene)
    before = scene.sim.state().tobytes()
    with pytest.raises(ValueError) as told:
        call(scene)
    assert words in str(told.value)
    assert scene.sim.state().tobytes() == before
    with pytest.raises(ValueError, match="known: (grain, wall|grain, wall, glass)$"):  # no material came in
        scene.sim.add(X[dim], R, material="none of them")
    assert scene.sim.add_plane(vector(dim, 0, -0.01), vector(dim, 0, 1)).number == 2 + (prepare is a_second_lid_below_the_floor)


def test_segments_obey_the_rules_of_planes():
    sim = Scene(2).sim
    for arguments, words in [
        ({"start": (0, 0), "end": (0, 0)}, "add_segment: start and end [m] must be finite and apart, got (0, 0) and (0, 0)"),
        ({"start": (0, NAN), "end": (0, 0)}, "add_segment: start and end [m] must be finite and apart, got (0, nan)"),
        ({"start": (0, 0), "end": (1, 0), "velocity": (1, None), "load": (1, None)}, "add_segment: axis 0 is driven by velocity (1 m/s)"),
        ({"start": (0, 0), "end": (1, 0), "velocity": (None, INF)}, "add_segment: velocity must be finite, got inf m/s (axis 1)"),
    ]:
        with pytest.raises(ValueError) as told:
            sim.add_segment(**arguments)
        assert words in str(told.value)
    assert sim.add_segment((0, -1), (1, -1)).number == 2
    with pytest.raises(ValueError, match="psi6: low and high must be numbers, got nan and 1 m"):
        sim.psi6(NAN, 1.0)


RNG = np.random.default_rng(1)
HELPER_RULES = [
    (lambda: grains.hexagonal_lattice(NAN, 0.1, 2e-3, R), "hexagonal_lattice: width must be > 0 m and finite, got nan m"),
    (lambda: grains.hexagonal_lattice(0.1, 0.1, 0, R), "hexagonal_lattice: spacing must be > 0 m and finite, got 0 m"),
    (lambda: grains.hexagonal_lattice(0.1, 0.1, 2e-3, -R), "hexagonal_lattice: margin must be >= 0 m and finite, got -0.001 m"),
    (lambda: grains.hexagonal_lattice(1e6, 1e6, 2e-3, R),
     "hexagonal_lattice: spacing 0.002 m gives a cell of 1e+06 m x 1e+06 m more than 1e+08 sites"),
    (lambda: grains.uniform_radii(-1, R, 1.5, RNG), "uniform_radii: count must be 0 to 100000000, got -1"),
    (lambda: grains.uniform_radii(10, 0.0, 1.5, RNG), "uniform_radii: mean must be > 0 m and finite, got 0 m"),
    (lambda: grains.uniform_radii(10, R, 0.9, RNG), "uniform_radii: size_ratio must be >= 1 (r_max / r_min) and finite, got 0.9"),
    (lambda: grains.Profiles(axis=3, bins=10, cross_section=1.0), "Profiles: axis must be 0 to 2, got 3"),
    (lambda: grains.Profiles(axis=1, bins=0, cross_section=1.0), "Profiles: bins must be 1 to 1000000, got 0"),
    (lambda: grains.Profiles(axis=1, bins=10, cross_section=-1.0), "Profiles: cross_section must be > 0 m (3D: m^2) and finite, got -1"),
    (lambda: grains.Profiles(axis=1, bins=10, cross_section=1.0).mean(NAN),
     "Profiles.mean: start must be a number and finite, got nan s"),
    (lambda: grains.detect_steady_state([0, 1], [1]),
     "detect_steady_state: time and height must both have shape (n,), got (2,) and (1,)"),
    (lambda: grains.detect_steady_state([0, 1], [1, INF]), "detect_steady_state: height must be finite, got inf m (sample 1)"),
    (lambda: grains.detect_steady_state([0, 1, 1], [1, 1, 1]), "detect_steady_state: time must increase from >= 0 s, got 1 s (sample 2)"),
    (lambda: grains.detect_steady_state([-1, 1], [1, 1]), "detect_steady_state: time must increase from >= 0 s, got -1 s (sample 0)"),
    (lambda: grains.block_average([1, NAN]), "block_average: samples must be finite, got nan"),
    (lambda: grains.block_average([[1, 2]]), "block_average: samples must have shape (n,), got (1, 2)"),
    (lambda: grains.ratio_error([1, 2], [1]), "ratio_error: numerator and denominator must have one shape, got (2,) and (1,)"),
    (lambda: study.Run(None, 0.0, 1.0), "Run: dt must be > 0 s and t_end at least dt, got dt = 0 s and t_end = 1 s"),
    (lambda: study.Run(None, 1.0, NAN), "Run: dt must be > 0 s and t_end at least dt, got dt = 1 s and t_end = nan s"),
]


@pytest.mark.parametrize("call, words", HELPER_RULES)
def test_helpers_tell_function_rule_value_and_unit(call, words):
    with pytest.raises(ValueError) as told:
        call()
    assert words in str(told.value)


def test_a_failed_sample_leaves_the_profiles_as_they_were():
    profiles = grains.Profiles(axis=1, bins=10, cross_section=0.1)
    for low, high in [(0.0, NAN), (1.0, 0.0)]:
        with pytest.raises(ValueError, match="profile: low < high must be finite"):
            profiles.sample(Scene(2).sim, low, high)
    assert profiles.samples == []


# ---------------------------------------------------------------------------------------------------------------- fuzz

TOLD = (ValueError, TypeError)  # a broken rule, a wrong type; nothing else is let through
HUGE = 1e300


class Kind:
    """A kind of argument: numbers that break its rule, and things that are no such argument at all."""

    def __init__(self, *numbers, others=("text",), shapes=None, optional=False):
        self.numbers, self.others, self.shapes = numbers, (*others, *(() if optional else (None,))), shapes

    def poison(self, good, rng):
        if rng.random() < 0.4:
            return rng.choice([*self.others, 1j, object(), [[]], {}, np.array([1j]), np.array(["a"]), lambda: 0])
        if self.shapes is None:
            return rng.choice(self.numbers)
        good = np.array(good, float)
        if rng.random() < 0.4:
            return self.shapes(good, rng)
        good.flat[rng.randrange(good.size)] = rng.choice(self.numbers)
        return good


def of_grains(good, rng):
    return rng.choice([good[:-1], good[:0], np.concatenate([good, good]), good[..., None], good[None], good + 1j, good.astype(str),
                       good.astype(object)])


def of_axes(good, rng):
    return rng.choice([good[:-1], good[:0], np.tile(good, 3), good[None], good + 1j, good.astype(str)])


POSITIVE, LENGTH = Kind(0.0, -1.0, NAN, INF, -INF, HUGE, 1e-300, 10**400), Kind(0.0, -1.0, NAN, INF, -INF)
FINITE, NOT_NEGATIVE, FRACTION = Kind(NAN, INF, -INF, HUGE), Kind(-1e-9, NAN, INF, HUGE), Kind(-0.1, 1.1, NAN, INF)
NEW_MATERIAL = Kind("", 3, others=[])
AXIS, COUNT = Kind(-1, 3, 1.5, NAN, 10**30), Kind(0, -1, 1.5, NAN, INF, 10**30)
MATERIAL = Kind("marble", "", 3)
VECTORS = Kind(NAN, INF, -INF, HUGE, shapes=of_grains)
MAYBE_VECTORS = Kind(NAN, INF, -INF, HUGE, shapes=of_grains, optional=True)
RADII = Kind(0.0, -R, NAN, INF, HUGE, 0.02, shapes=of_grains)
VECTOR = Kind(NAN, INF, -INF, HUGE, shapes=of_axes)
NORMAL = Kind(NAN, INF, HUGE, shapes=of_axes, others=[np.zeros(2), np.zeros(3)])
PER_AXIS = Kind(NAN, INF, -INF, HUGE, shapes=lambda good, rng: rng.choice([good[:-1], good[:0], np.tile(good, 3), good[None], good + 1j]),
                others=["ab", ["a", "b"]], optional=True)
PERIOD = Kind(NAN, INF, -1.0, HUGE, shapes=PER_AXIS.shapes, others=["ab", ["a", "b"], 0.1], optional=True)
SERIES = Kind(NAN, INF, -INF, shapes=lambda good, rng: rng.choice([good[:-1], good[None], good + 1j, good.astype(str)]))
SAMPLES = Kind(NAN, INF, shapes=lambda good, rng: rng.choice([good[None], good + 1j]))
LOW, HIGH = Kind(NAN, INF, 2.0), Kind(NAN, INF, -INF, HUGE, 0.0)


def functions(scene):
    """name: (function, {argument: (a good value, its kind)})"""
    sim, dim, x = scene.sim, scene.dim, X[scene.dim]
    spin = np.zeros(2) if dim == 2 else np.zeros((2, 3))

    def setter(name):
        return lambda value: setattr(sim, name, value)

    place = {"point": (vector(dim, 0, -0.01), VECTOR), "normal": (vector(dim, 0, 1), NORMAL)}
    wall = {"material": ("wall", MATERIAL), "load": (vector(dim, 0, -1), PER_AXIS),
            "mass": (1.0, Kind(0.0, -1.0, NAN, INF, HUGE, optional=True))}
    profiles = grains.Profiles(1, 10, 0.1)
    table = {
        "Simulation": (grains.Simulation, {
            "dim": (dim, Kind(0, 4, 2.5, NAN, 10**30)), "period": (np.full(dim, 0.1), PERIOD),
            "gravity": (np.zeros(dim), Kind(*VECTOR.numbers, shapes=of_axes, optional=True)),
            "threads": (1, Kind(0, -1, 1.5, 10**9, optional=True)),
            "tolerance": (0.01, Kind(0.0, -1.0, NAN, INF, 2.0, optional=True)), "solver": ("nlgs", Kind("", "lu", 3, optional=True))}),
        "add": (sim.add, {"position": (x, VECTORS), "radius": (np.full(2, R), RADII), "density": (1000.0, POSITIVE),
                          "velocity": (0 * x, MAYBE_VECTORS), "spin": (spin, MAYBE_VECTORS), "material": ("grain", MATERIAL)}),
        "attach": (sim.attach, {"wall": (scene.floor, Kind(0, 1.0, others=[Scene(5 - dim).floor, Scene(dim).floor])),
                                "position": (x, VECTORS), "radius": (np.full(2, R), RADII), "material": ("grain", MATERIAL)}),
        "add_plane": (sim.add_plane, place | wall),
        "add_plane, velocity": (sim.add_plane, place | {"velocity": (vector(dim, 1, 0), PER_AXIS)}),
        "drive": (scene.lid.drive, {"axis": (0, AXIS), "velocity": (0.0, FINITE)}),
        "set_load": (scene.lid.set_load, {"axis": (1, AXIS), "load": (-0.01, FINITE)}),
        "set_friction": (sim.set_friction, {"a": ("grain", NEW_MATERIAL), "b": ("wall", NEW_MATERIAL), "friction": (0.6, NOT_NEGATIVE)}),
        "set_restitution": (sim.set_restitution, {"a": ("grain", MATERIAL), "b": ("wall", MATERIAL), "normal": (0.0, FRACTION),
                                                  "tangential": (0.0, FRACTION)}),
        "set_inertia": (sim.set_inertia, {"ratio": (0.5, Kind(0.0, -1.0, 1.1, NAN, INF))}),
        "set_force": (sim.set_force, {"force": (np.full((3, dim), 1e-4), MAYBE_VECTORS)}),
        "set_drag": (sim.set_drag, {"coefficient": (np.full(3, 1e-3), Kind(-1e-9, NAN, INF, HUGE, shapes=of_grains)),
                                    "velocity": (np.full((3, dim), 0.1), VECTORS)}),
        "remove": (sim.remove, {"ids": (np.array([0, 1]), Kind(-1, 3, 1.5, NAN, INF, 10**30, others=[[-1], [0, 0], [[0]]]))}),
        "step": (sim.step, {"dt": (1e-4, POSITIVE)}),
        "check": (sim.check, {"dt": (1e-4, POSITIVE)}),
        "profile": (sim.profile, {"axis": (1, AXIS), "low": (0.0, LOW), "high": (1.0, HIGH),
                                  "bins": (10, Kind(*COUNT.numbers, 2**31 - 1))}),
        "hexagonal_lattice": (grains.hexagonal_lattice, {"width": (0.1, LENGTH), "height": (0.1, LENGTH), "spacing": (0.01, LENGTH),
                                                         "margin": (R, Kind(-1e-9, NAN, INF, 1.0))}),
        "uniform_radii": (grains.uniform_radii, {"count": (10, Kind(-1, 1.5, NAN, 10**12, 10**30)), "mean": (R, LENGTH),
                                                 "size_ratio": (1.5, Kind(0.9, -1.0, NAN, INF)), "rng": (RNG, Kind(0, 1.5))}),
        "Profiles": (grains.Profiles, {"axis": (1, AXIS), "bins": (10, COUNT), "cross_section": (1.0, LENGTH)}),
        "Profiles.sample": (lambda low, high: profiles.sample(sim, low, high), {"low": (0.0, LOW), "high": (1.0, HIGH)}),
        "Profiles.mean": (profiles.mean, {"start": (0.0, Kind(NAN, INF, optional=True))}),
        "detect_steady_state": (grains.detect_steady_state, {"time": (np.arange(200.0), SERIES), "height": (np.ones(200), SERIES)}),
        "block_average": (grains.block_average, {"samples": (np.ones(50), SAMPLES)}),
        "ratio_error": (grains.ratio_error, {"numerator": (np.ones(50), SERIES), "denominator": (np.ones(50), SERIES)}),
        "Run": (lambda dt, t_end: study.Run(sim, dt, t_end), {"dt": (0.1, LENGTH), "t_end": (1.0, LENGTH)}),
    }
    for name, good, kind in [
        ("position", sim.position, VECTORS), ("velocity", sim.velocity, VECTORS), ("spin", sim.spin, VECTORS),
        ("gravity", sim.gravity, VECTOR), ("tolerance", 0.01, Kind(0.0, -1.0, NAN, INF, 2.0)), ("max_sweeps", 1000, COUNT),
        ("active_sweeps", 6, COUNT), ("threads", 1, COUNT), ("omega", 1.5, Kind(0.9, 2.0, NAN, INF)),
        ("sub_step_motion", 0.1, Kind(0.0, -1.0, 0.6, NAN)), ("rest_speed", 0.0, NOT_NEGATIVE),
        ("solver", "active_set", Kind("", "lu", 3)), ("sub_step_rule", "relative", Kind("", "all", 3)),
    ]:
        table[name] = setter(name), {"value": (good, kind)}
    if dim == 2:
        table["add_segment"] = sim.add_segment, {"start": ((0, -0.02), VECTOR), "end": ((0.01, -0.02), VECTOR)} | wall
        table["psi6"] = sim.psi6, {"low": (0.0, Kind(NAN)), "high": (1.0, Kind(NAN))}
    else:
        table["add_triangle"] = sim.add_triangle, {"a": ((0, -0.02, 0), VECTOR), "b": ((0.01, -0.02, 0), VECTOR), "c": ((0, -0.02, 0.01), VECTOR)} | wall
    return table


def fuzz(count, seed):
    """Calls with one argument spoiled. Prints those that were accepted, failed with another error, or changed something."""
    faulthandler.enable()
    rng = random.Random(seed)
    scenes = [Scene(2), Scene(3)]
    for scene in scenes:  # the calls are good but for what is spoiled
        for name in functions(scene):
            call, arguments = functions(Scene(scene.dim))[name]
            call(**{argument: good for argument, (good, _) in arguments.items()})
    refused = 0
    for case in range(count):
        scene = rng.choice(scenes)
        table = functions(scene)
        name = rng.choice(sorted(table))
        call, arguments = table[name]
        spoiled_one = rng.choice(sorted(arguments))
        values = {argument: good for argument, (good, _) in arguments.items()}
        values[spoiled_one] = arguments[spoiled_one][1].poison(values[spoiled_one], rng)
        shown = f"case {case}: {scene.dim}D {name}({spoiled_one}={values[spoiled_one]!r})"
        print(shown, file=sys.stderr, flush=True)  # the last one is what crashed
        before = scene.sim.state().tobytes()
        try:
            call(**values)
            wrong = "accepted"
        except TOLD:
            refused += 1
            wrong = "" if scene.sim.state().tobytes() == before else "changed the scene"
        except Exception as error:
            wrong = f"{type(error).__name__}: {error}"
        if wrong:
            print(shown, wrong, sep=": ")
        scene.sim.step(1e-4)
    print(f"{refused} of {count} refused")


def test_200_random_bad_inputs_neither_crash_nor_pass_in_silence():
    environment = os.environ | {"PYTHONPATH": str(pathlib.Path(quicksand.__file__).parents[1]), "PYTHONWARNINGS": "error"}
    done = subprocess.run([sys.executable, __file__, "200", "1"], env=environment, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout == "200 of 200 refused\n"


if __name__ == "__main__":
    fuzz(int(sys.argv[1]), int(sys.argv[2]))
