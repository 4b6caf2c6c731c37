"""Immersed plane Couette flow of discs: the dry cell with a fluid in its pores, the pressure imposed on the grains alone.

    ./run examples/immersed_couette.py --viscosity 0.15 --out out/immersed_couette

Cell, grains, walls and loads are those of examples/dry_couette.py. The walls are permeable plates: the fluid sticks to them, and crosses them
freely to where the pressure is 0. They feel the grains only, and move as these let them; the mesh follows (ALE). No gravity. In 2D all is per
metre of depth, and a disc has the drag of spheres, per volume of solids.

Flags: those of examples/dry_couette.py (--help of it), out/immersed_couette, and
    --viscosity ETA       of the fluid [Pa s] (0.15: a viscous number of 0.3)
    --fluid-density RHO   [kg/m^3] (1000)
    --kernel-radius R0    standard deviation of the kernel that averages grains [m] (three mean radii: 1.5 diameters)
    --mesh-size H         element length [m] (0.008: four diameters)
    --element NAME        p1p1 or p2p1 (p1p1)
    --start-phi PHI       solid fraction at the start [-] (0.83/(1 + 0.29 K), at most that of the dry lattice; K is the visco-inertial number at the
                          nominal rate: near what such cells come to. Pores fill and drain through the plates as (height)^2 viscosity/pressure: a
                          dense lattice would need ten times as long as the dry cell to find its height)

results.json, SI, null where undefined: all keys of the dry example, and, means over t >= t_converged where nothing else is said,
    viscous_number          viscosity x shear_rate_bulk/P [-]
    visco_inertial_number   I sqrt(1 + 2/St), I the bulk inertial number [-]
    stokes_number           St = grain density x branch_length^2 x shear_rate_bulk/viscosity [-]
    fluid_shear_stress      mean of -eta (du_x/dy + du_y/dx) over the cell [Pa], negative as tau is
    mean_drag               |drag| of a grain, mean over grains [N/m]
    plate_shear_traction    force of grains and fluid on the plates along x over their area, the mean of both [Pa]
    shear_stress            of contacts, grains' motion and fluid, mean over the same slabs as below [Pa]
    shear_stress_variation  largest of |its mean over time in a slab - the mean|, relative, in slabs beyond the kernel's reach, 3.2 R0, from the plates: nearer
                            to them drag moves momentum from grains to fluid over distances that neither's stress knows [-]
    drained_volume_error    |volume that the plates let out - what the cell lost| over the largest change of its volume, whole run [-]
    momentum_error volume_error   largest of all steps, see quicksand.coupling [-]
    carried_impulse         mean; what the fluid gives back a step late, over what was exchanged [-]
    fluid_share exchange_share grains_share   of wall_time [-]
    fluid_step_time         fluid and exchange per step, mean [s]
    dofs                    unknowns of the fluid
"""

import sys

import numpy as np

from dry_couette import DENSITY, PROFILE_EVERY, RADIUS, UNITS, Scene, command_line, measure, profiles_of, record
from quicksand import coupling, fluid, meshes, study

BALANCES = ("momentum_error", "volume_error", "carried_impulse")
SHARES = ("fluid", "exchange", "grains")


def parse_flags():
    parser = command_line(__doc__, out="out/immersed_couette")
    parser.flag("--viscosity", type=study.number("Pa s", above=0), default=0.15)
    parser.flag("--fluid-density", type=study.number("kg/m^3", at_least=0), default=1000.0)
    parser.flag("--kernel-radius", type=study.number("m", above=0), default=3 * RADIUS)
    parser.flag("--mesh-size", type=study.number("m", above=0), default=8 * RADIUS)
    parser.flag("--element", choices=("p1p1", "p2p1"), default="p1p1")
    parser.flag("--start-phi", type=study.number("", above=0))
    return parser, parser.parse_args()


def start_phi(flags):
    inertial = flags.rate * 2 * RADIUS * np.sqrt(DENSITY / flags.pressure)
    stokes = DENSITY * (2 * RADIUS) ** 2 * flags.rate / flags.viscosity
    return min(0.83 / (1 + 0.29 * inertial * np.sqrt(1 + 2 / stokes)), 0.8)


class Immersed(Scene):
    """The dry cell in a fluid."""

    def __init__(self, flags):
        super().__init__(flags, None if flags.fixed_height else flags.start_phi or start_phi(flags))
        low, high = (wall.position[1] for wall in self.walls)
        counts = [max(2, round(length / flags.mesh_size)) for length in (flags.width, high - low)]
        mesh = meshes.box([flags.width, high - low], counts, periodic=[True, False], origin=[-flags.width / 2, low])
        self.flow = fluid.Fluid(mesh, density=flags.fluid_density, viscosity=flags.viscosity, element=flags.element)
        # The fluid starts as the grains do, in simple shear.
        speed = self.walls[1].velocity[0]
        self.flow.set_velocity(np.column_stack([speed * self.flow.nodes[:, 1] / high, 0 * self.flow.nodes[:, 1]]))
        self.both = coupling.Coupling(self.sim, self.flow, kernel_radius=flags.kernel_radius)
        for name, wall in zip(("bottom", "top"), self.walls):
            self.flow.permeable(name, velocity=(wall.velocity[0], 0.0), pressure=0.0)
            self.both.follow(name, wall)

    @property
    def cell_height(self):
        """Of the mesh [m]: that of the cell before the last step of the grains."""
        return np.ptp(self.flow.nodes[:, 1])


class Stresses:
    """Shear stress across planes of constant y, means over slabs of three diameters: contacts, motion of grains, fluid [Pa]."""

    def __init__(self, flags):
        self.flags = flags
        self.slabs = max(6, round(flags.height / (6 * RADIUS)))  # averages over as many slabs of planes
        self.planes = (np.arange(8 * self.slabs) + 0.5) / (8 * self.slabs)
        self.samples = []  # (time, stress at planes, 3 parts)

    def sample(self, scene):
        sim, flow, width = scene.sim, scene.flow, self.flags.width
        low, high = (wall.position[1] for wall in scene.walls)
        y = low + (high - low) * self.planes
        contacts, x = sim.contacts(), sim.position
        i, j = contacts["grain_i"], contacts["grain_j"]
        # A contact acts across the planes between the centres; at a wall, from there on.
        start = np.where(i >= 0, x[np.maximum(i, 0), 1], contacts["point"][:, 1])
        force = contacts["force_normal"][:, None] * contacts["normal"] + contacts["force_tangential"]  # on j
        up = x[j, 1] > start
        ends = np.where(up[:, None], np.column_stack([start, x[j, 1]]), np.column_stack([x[j, 1], start]))
        on_upper = np.where(up, force[:, 0], -force[:, 0])
        stress = np.zeros((3, len(y)))  # contacts, motion, fluid
        first, last = np.searchsorted(y, ends[:, 0], "left"), np.searchsorted(y, ends[:, 1], "left")
        crossing = np.bincount(first, on_upper, len(y) + 1) - np.bincount(last, on_upper, len(y) + 1)
        stress[0] = np.cumsum(crossing)[:-1] / width
        # Motion about the mean of a slice as thick as the planes are apart.
        slices = np.clip(np.digitize(x[:, 1], (y[1:] + y[:-1]) / 2), 0, len(y) - 1)
        mass, v = sim.mass, sim.velocity
        sums = [np.bincount(slices, weight, len(y)) for weight in (mass, mass * v[:, 0], mass * v[:, 1], mass * v[:, 0] * v[:, 1])]
        thickness = y[1] - y[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            stress[1] = np.nan_to_num(sums[3] - sums[1] * sums[2] / sums[0]) / (width * thickness)
        # The fluid's, of the elements on both sides of a plane: mean slope of u_x along x.
        at = flow.mesh.nodes[:, 1]
        rows, index = np.unique(np.round(at / np.ptp(at), 9), return_inverse=True)
        vertices = len(at)
        mean = np.bincount(index, flow.velocity[:vertices, 0]) / np.bincount(index)
        height = np.bincount(index, flow.nodes[:vertices, 1]) / np.bincount(index)
        slope = np.diff(mean) / np.diff(height)
        middles = (height[1:] + height[:-1]) / 2
        stress[2] = -self.flags.viscosity * np.interp(y, middles, slope)
        self.samples.append((sim.time, stress.reshape(3, self.slabs, -1).mean(axis=2)))

    def state(self):
        return {"time": np.array([t for t, _ in self.samples]), "stress": np.array([s for _, s in self.samples])} if self.samples else {}

    def restore(self, state):
        self.samples = list(zip(state.get("time", []), state.get("stress", [])))

    def mean(self, start):
        """Over time >= start: (3, slabs); None without samples."""
        chosen = [stress for time, stress in self.samples if start is not None and time >= start]
        return np.mean(chosen, axis=0) if chosen else None


def simulate(scene, flags):
    run, profiles, stresses = study.Run(scene.sim, flags.dt, flags.t_end, scene.both), profiles_of(flags), Stresses(flags)
    run.keep(flags, fluid=scene.flow, coupling=scene.both, profiles=profiles, stresses=stresses, rng=scene.rng)
    for report in run:
        record(run, scene, report.grains, flags)
        lower, upper = scene.walls
        plates = [scene.flow.force(name)[0] for name in ("bottom", "top")]
        run.record(**{name: getattr(report, name) for name in BALANCES}, **{f"{name}_time": getattr(report, f"{name}_time") for name in SHARES},
                   mean_drag=np.hypot(*scene.both.drag_force.T).mean(), cell_height=scene.cell_height,
                   drained=flags.dt * (scene.flow.flux("bottom") + scene.flow.flux("top")),
                   plate_shear_traction=(lower.force[0] + plates[0] - upper.force[0] - plates[1]) / (2 * flags.width))
        if run.samples % PROFILE_EVERY == 0:
            profiles.sample(scene.sim, *scene.faces)
            stresses.sample(scene)
        if flags.fixed_height and scene.sim.time > scene.closing_until - flags.dt / 2:
            scene.hold_height()
    return run, profiles, stresses


def immersed_results(results, scene, run, stresses, flags):
    steady, t_converged = run.since(results["t_converged"]), results["t_converged"]
    rate, inertial, branch = results["shear_rate_bulk"], results["inertial_number_bulk"], results["branch_length"]
    pressure = results["sigma_yy_wall_contacts"] if flags.fixed_height else flags.pressure
    known = None not in (rate, inertial, branch) and rate > 0
    stokes = DENSITY * branch**2 * rate / flags.viscosity if known else None
    parts = stresses.mean(t_converged)
    height = run["cell_height"]
    volume = flags.width * height
    stress = variation = None
    if parts is not None:
        ends = np.arange(stresses.slabs + 1) / stresses.slabs * results["h"]
        reach = 3.2 * flags.kernel_radius
        total = parts.sum(axis=0)[(ends[:-1] >= reach) & (ends[1:] <= results["h"] - reach)]
        if total.size:
            stress, variation = total.mean(), np.abs(total / total.mean() - 1).max()
    spent = {name: run[f"{name}_time"].sum() for name in SHARES}
    return results | {
        "viscous_number": flags.viscosity * rate / pressure if known and pressure > 0 else None,
        "visco_inertial_number": inertial * np.sqrt(1 + 2 / stokes) if known else None,
        "stokes_number": stokes,
        "fluid_shear_stress": -flags.viscosity * 2 * scene.walls[1].velocity[0] / steady.mean("cell_height") if steady["cell_height"].size else None,
        "mean_drag": steady.mean("mean_drag"),
        "plate_shear_traction": steady.mean("plate_shear_traction"),
        "shear_stress": stress,
        "shear_stress_variation": variation,
        "drained_volume_error": abs(run["drained"][1:].sum() + volume[-1] - volume[0]) / np.ptp(volume) if len(height) > 1 and np.ptp(volume) > 0 else None,
        "momentum_error": run["momentum_error"].max(initial=0.0),
        "volume_error": run["volume_error"].max(initial=0.0),
        "carried_impulse": steady.mean("carried_impulse"),
    } | {f"{name}_share": spent[name] / run.wall_time for name in SHARES} | {
        "fluid_step_time": (spent["fluid"] + spent["exchange"]) / max(run.samples, 1),
        "dofs": scene.flow.dofs,
    }


MORE_UNITS = {
    "viscous_number": "-", "visco_inertial_number": "-", "stokes_number": "-", "fluid_shear_stress": "Pa", "shear_stress": "Pa", "plate_shear_traction": "Pa",
    "shear_stress_variation": "-", "mean_drag": "N/m", "drained_volume_error": "-", "momentum_error": "-", "volume_error": "-", "carried_impulse": "-",
    "fluid_share": "-", "exchange_share": "-", "grains_share": "-", "fluid_step_time": "s", "dofs": "",
}


def plot(results, scene, run, profile, stresses, flags):
    study.plot_series(flags.out / "series.png", run["time"], [
        (label, run[name], results[name]) for name, label in (
            ("h", "$h$ [m]"), ("phi", r"$\phi$ [-]"), ("tau", r"$\tau$ of contacts [Pa]"), ("plate_shear_traction", "traction of the plates [Pa]"))
    ], results["t_converged"])
    if profile:
        study.plot_profile(flags.out / "profiles.png", profile, flags.rate * flags.height / profile.height)
    parts = stresses.mean(results["t_converged"])
    if parts is not None:
        names = ("contacts", "motion of grains", "fluid", "all")
        colours = (study.BLUE, study.FAINT, "tab:green", study.RED)
        lines = [(name, colour, (np.arange(stresses.slabs) + 0.5) / stresses.slabs * results["h"], -values) for name, colour, values in zip(names, colours, [*parts, parts.sum(axis=0)])]
        study.plot_lines(flags.out / "shear_stress.png", "y [m]", r"$-\tau$ [Pa]", [("", lines)], scales=("linear", "linear"))
    study.plot_snapshot(flags.out / "snapshot.png", scene.sim, *scene.faces, scene.fixed_grains(), title=f"$t$ = {scene.sim.time:.3g} s")


def main():
    parser, flags = parse_flags()
    with parser.user_errors():
        scene = Immersed(flags)
    with parser.user_errors(OSError):
        run, profiles, stresses = simulate(scene, flags)
    results, profile = measure(scene, run, profiles, flags)
    results = immersed_results(results, scene, run, stresses, flags)
    study.write_results(flags.out / "results.json", results)
    study.print_summary(f"immersed plane Couette flow, {results['n_grains']} discs, {results['state']}", results, UNITS | MORE_UNITS)
    if run.samples and not flags.no_plots:
        plot(results, scene, run, profile, stresses, flags)
    return 130 if run.interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
