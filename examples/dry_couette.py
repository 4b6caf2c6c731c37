"""Dry plane Couette flow of discs between two walls that shear and press: mu, phi and the profiles of one steady state.

    ./run examples/dry_couette.py --rate 10 --out out/dry_couette

The defaults are the reference case of a master's thesis on dense granular rheology with MigFlow (table 2.1): 5103 discs
of mean radius 1 mm and density 1000 kg/m3, no gravity, periodic in x, no restitution. In 2D all is per metre of depth.

Flags
    --out DIR           where results.json and the figures go (out/dry_couette)
    --rate G            nominal shear rate [1/s]: the walls move at +-G height/2, whatever the height becomes (10)
    --pressure P        load on each wall over its area [Pa]; both walls are free to move in y (5)
    --size-ratio L      r_max / r_min, radii uniform with mean 1 mm; the number of discs is that of L = 1 [-] (1)
    --height H          nominal height of the cell [m]; the lattice of L = 1 fills it (0.1)
    --width W           period in x [m] (0.2)
    --friction MU       between grains [-] (0.4)
    --wall-friction MU  between grains and walls [-] (1)
    --rough-walls       a row of touching grains of mean radius is fixed to each wall, its centres on the wall; they have the
                        friction of grains. Heights are then measured between the inner faces of the two rows
    --fixed-height      no load: the walls stay at --height. With L > 1 they close in on it during the first 10 % of the time
    --dt DT             time step, and interval of the samples [s] (0.001)
    --t-end T           end [s] (10)
    --tolerance E       residual at which a step is accepted [-] (the solver's default)
    --threads N         (all cores); results do not depend on it
    --seed N            of the radii, and of the small random velocities without which a lattice has no randomness:
                        uniform within 1 % of the wall speed, per component (0)
    --frame-every S     interval of frames for ParaView and numpy, see docs/output.md; 0: none [s] (0.1)
    --checkpoint-every S   interval of --out/checkpoint.h5 on the clock, one more at the end; 0: none [s] (60)
    --restart FILE      go on from a checkpoint, in its folder and with its flags: only --out, --t-end, --threads, --no-plots,
                        --frame-every, --checkpoint-every may be given anew. The results are those of a run without a break
    --quick             a run of some seconds: --height 0.03 --width 0.06 --t-end 2, where not given
    --no-plots          results.json only

results.json, SI, null where undefined. Means are over t >= t_converged, one sample per time step; X_std is the standard
deviation in time, X_err the standard error of the mean. Stresses are positive in compression and, without other mention,
of contacts between grains only.
    n_grains                    discs, those fixed to walls left out
    h                           height [m]
    phi phi_std phi_err         solid fraction [-]
    mu mu_std mu_err            |<tau>| / |<sigma_yy>| [-]; mu_std of the ratio at each time
    tau tau_std                 shear stress sigma_xy [Pa], negative: the upper wall goes to +x
    sigma_xx sigma_yy sigma_yy_std                 normal stresses [Pa]
    sigma_yy_wall_contacts sigma_yy_kinetic        the other parts of sigma_yy [Pa]: all three together balance the load
    wall_pressure               contact force on the walls over their area, mean of the two [Pa]
    branch_length               mean distance of the centres of grains in contact [m]
    shear_rate_bulk             slope of <v_x>(y) over the middle half of the height [1/s]
    inertial_number             rate x branch_length / sqrt(P / density) [-]; with --fixed-height, P is the measured sigma_yy,
                                all parts
    inertial_number_bulk        the same with shear_rate_bulk
    psi6                        hexagonal order at the end, mean of |psi_6| over grains 3 diameters away from walls [-]
    coordination                2 x contacts that bear an impulse in a sub-step / grains [-]; fewer in shorter sub-steps
    t_converged                 start of the steady state [s], thesis section 2.4; it looks at h only, so with --fixed-height
                                it is 10 % of the time
    state                       "jammed": over the last third of the time the bulk rate is below 5 % of nominal; else "flowing".
                                "interrupted": ended by Ctrl-C, the rest is of the time so far
    max_overlap                 largest of the run, in mean diameters [-]
    energy_error                |sum of the energy balance errors| / |work of the walls| [-]
    residual_max                largest of the run [-]
    unconverged_steps           sub-steps accepted above the tolerance
    steps                       sub-steps in all
    sweeps_per_step             solver sweeps per sub-step
    wall_time                   seconds of stepping, without output and plots
    threads
"""

import sys
import types

import numpy as np

from quicksand import grains, study

RADIUS, DENSITY = 1e-3, 1000.0  # mean [m], [kg/m^3]
PROFILE_EVERY = 10  # steps

REFERENCE_FLAGS = ("rate", "pressure", "size_ratio", "height", "width", "friction", "wall_friction", "rough_walls",
                   "fixed_height", "dt", "t_end", "quick")
THESIS = {  # table 3.1, mean (std); where these flags have their defaults
    "h": "0.104", "phi": "0.767 (0.003)", "mu": "0.392 (0.033)", "tau": "-1.89 (0.42)", "sigma_xx": "4.53 (0.92)",
    "sigma_yy": "4.81 (1.03)", "branch_length": "0.002", "inertial_number": "0.283", "t_converged": "3.6",
}


def command_line(doc=__doc__, out="out/dry_couette"):
    parser = study.Parser(doc, out=out, dt=1e-3, t_end=10.0, quick_t_end=2.0)
    parser.flag("--rate", type=study.number("1/s", above=0), default=10.0)
    parser.flag("--pressure", type=study.number("Pa", above=0), default=5.0)
    parser.flag("--size-ratio", type=study.number("", at_least=1), default=1.0)
    parser.flag("--height", type=study.number("m", above=0), default=0.1, quick=0.03)
    parser.flag("--width", type=study.number("m", above=0), default=0.2, quick=0.06)
    parser.flag("--friction", type=study.number("", at_least=0), default=0.4)
    parser.flag("--wall-friction", type=study.number("", at_least=0), default=1.0)
    parser.flag("--rough-walls", action="store_true")
    parser.flag("--fixed-height", action="store_true")
    return parser


def scene(**flags):
    """The cell for other studies: flags by name, the others at their defaults."""
    return Scene(types.SimpleNamespace(**command_line().defaults() | flags))


class Scene:
    """The cell, its grains and its two walls."""

    def __init__(self, flags, start_phi=None):
        """start_phi: the lattice is stretched across to this solid fraction [-]."""
        self.rng = rng = np.random.default_rng(flags.seed)
        count = len(grains.hexagonal_lattice(flags.width, flags.height, 2.1 * RADIUS, RADIUS))
        radius = grains.uniform_radii(count, RADIUS, flags.size_ratio, rng)
        self.width, self.solid = flags.width, np.pi * (radius**2).sum()
        filled = self.solid / (flags.width * flags.height)
        if flags.fixed_height and filled > 0.84:  # random close packing of discs
            raise ValueError(f"--fixed-height: the discs would fill {filled:.2f} of the cell, more than fits (0.84)")
        self.rough = RADIUS if flags.rough_walls else 0.0  # how far the fixed grains stand out of a wall

        # The largest grain needs room at every site: with L > 1 the cell is taller, and some sites stay empty.
        largest = 2 * RADIUS * flags.size_ratio / (1 + flags.size_ratio)
        height = flags.height
        while len(site := grains.hexagonal_lattice(flags.width, height, 2.1 * largest, largest)) < count:
            height += np.sqrt(0.75) * 2.1 * largest
        position = site[np.sort(rng.choice(len(site), count, replace=False))]

        if start_phi is not None:
            stretch = self.solid / (flags.width * start_phi) / height
            height *= stretch
            position[:, 1] *= stretch

        speed = flags.rate * flags.height / 2
        velocity = 0.01 * speed * rng.uniform(-1, 1, position.shape)
        velocity[:, 0] += speed * position[:, 1] / (height / 2)

        self.sim = grains.Simulation(dim=2, period=(flags.width, None), threads=flags.threads, tolerance=flags.tolerance,
                                     accept_unconverged=True)
        self.sim.set_friction("grain", "grain", flags.friction)
        self.sim.set_friction("grain", "wall", flags.wall_friction)
        self.sim.add(position, radius, density=DENSITY, velocity=velocity, material="grain")

        self.closing_until = max(1, round(0.1 * flags.t_end / flags.dt)) * flags.dt
        closing_speed = (height - flags.height) / 2 / self.closing_until  # 0 with L = 1
        self.walls = []
        for side in (-1, 1):
            across = {"velocity": (side * speed, None), "load": (None, -side * flags.pressure * flags.width)}
            if flags.fixed_height:
                across = {"velocity": (side * speed, -side * closing_speed)}
            y = side * (height / 2 + self.rough)
            self.walls.append(self.sim.add_plane(point=(0.0, y), normal=(0.0, -side), material="wall", **across))
        self.fixed = self.attach_rows() if flags.rough_walls else None
        self.sim.check(flags.dt)

    def attach_rows(self):
        columns = int(self.width / (2 * RADIUS) + 1e-9)
        x = (np.arange(columns) + 0.5) / columns * self.width - self.width / 2
        rows = [np.column_stack([x, np.full(columns, wall.position[1])]) for wall in self.walls]
        for wall, row in zip(self.walls, rows):
            self.sim.attach(wall, row, np.full(columns, RADIUS), material="grain")
        return rows

    def hold_height(self):
        for wall in self.walls:
            wall.drive(axis=1, velocity=0.0)

    @property
    def faces(self):
        """Heights of the lower and upper inner face [m]."""
        return self.walls[0].position[1] + self.rough, self.walls[1].position[1] - self.rough

    def fixed_grains(self):
        """Where the grains fixed to the walls are now: positions (n, 2), radii (n,) [m]."""
        if self.fixed is None:
            return None
        moved = [row + (wall.position - (0.0, row[0, 1])) for wall, row in zip(self.walls, self.fixed)]
        return np.concatenate(moved), np.full(sum(map(len, moved)), RADIUS)


def profiles_of(flags):
    return grains.Profiles(axis=1, bins=max(20, round(flags.height / (2 * RADIUS))), cross_section=flags.width)


def record(run, scene, report, flags):
    """The grains' part of the sample of a step."""
    lower, upper = scene.walls
    low, high = scene.faces
    area = flags.width * (high - low)
    stress = report.virial_contacts / area
    run.record(h=high - low, phi=scene.solid / area, tau=stress[0, 1], sigma_xx=stress[0, 0], sigma_yy=stress[1, 1],
               mu=abs(stress[0, 1] / stress[1, 1]) if stress[1, 1] else np.nan,
               sigma_yy_wall_contacts=report.virial_wall_contacts[1, 1] / area,
               sigma_yy_kinetic=report.virial_kinetic[1, 1] / area,
               wall_pressure=(upper.force[1] - lower.force[1]) / (2 * flags.width),
               branch_length=report.branch_length or np.nan, coordination=report.coordination)


def simulate(scene, flags):
    """Step to the end; every time step leaves a sample in the run, every tenth a profile."""
    run, profiles = study.Run(scene.sim, flags.dt, flags.t_end), profiles_of(flags)
    run.keep(flags, profiles=profiles, rng=scene.rng)
    for report in run:
        record(run, scene, report, flags)
        if run.samples % PROFILE_EVERY == 0:
            low, high = scene.faces
            profiles.sample(scene.sim, low, high)
        if flags.fixed_height and scene.sim.time > scene.closing_until - flags.dt / 2:
            scene.hold_height()
    return run, profiles


def measure(scene, run, profiles, flags):
    """The results, and the mean profile of the steady state (None without one)."""
    sim = scene.sim
    t_converged = grains.detect_steady_state(run["time"], run["h"]).time
    steady = run.since(t_converged)
    profile = profiles.mean(t_converged)
    shear_rate_bulk = profile and profile.shear_rate()
    last_third = profiles.mean(2 / 3 * sim.time)
    rate_at_end = last_third and last_third.shear_rate()

    results = {"n_grains": sim.count}
    for name in ("h", "phi", "tau", "sigma_xx", "sigma_yy", "sigma_yy_wall_contacts", "sigma_yy_kinetic", "wall_pressure",
                 "branch_length", "coordination"):
        results[name] = steady.mean(name)
    for name in ("phi", "mu", "tau", "sigma_yy"):
        results[f"{name}_std"] = steady.std(name)
    phi = grains.block_average(steady["phi"])
    results["phi_err"] = phi and phi.error
    results["mu"] = abs(results["tau"] / results["sigma_yy"]) if results["sigma_yy"] else None
    results["mu_err"] = grains.ratio_error(steady["tau"], steady["sigma_yy"])

    pressure = flags.pressure
    if flags.fixed_height and t_converged is not None:
        pressure = results["sigma_yy"] + results["sigma_yy_wall_contacts"] + results["sigma_yy_kinetic"]

    def inertial_number(rate):
        known = None not in (rate, results["branch_length"]) and pressure > 0
        return rate * results["branch_length"] / np.sqrt(pressure / DENSITY) if known else None

    low, high = scene.faces
    return results | {
        "shear_rate_bulk": shear_rate_bulk,
        "inertial_number": inertial_number(flags.rate),
        "inertial_number_bulk": inertial_number(shear_rate_bulk),
        "psi6": sim.psi6(low + 6 * RADIUS, high - 6 * RADIUS),
        "t_converged": t_converged,
        "state": "interrupted" if run.interrupted
                 else "jammed" if rate_at_end is not None and rate_at_end < 0.05 * flags.rate else "flowing",
    } | run.solver_results(2 * RADIUS), profile


UNITS = {
    "t_converged": "s", "h": "m", "phi": "-", "mu": "-", "tau": "Pa", "sigma_xx": "Pa", "sigma_yy": "Pa",
    "sigma_yy_wall_contacts": "Pa", "sigma_yy_kinetic": "Pa", "wall_pressure": "Pa", "branch_length": "m",
    "shear_rate_bulk": "1/s", "inertial_number": "-", "inertial_number_bulk": "-", "psi6": "-", "coordination": "-",
    "max_overlap": "d", "energy_error": "-", "residual_max": "-", "unconverged_steps": "", "steps": "",
    "sweeps_per_step": "", "wall_time": "s", "threads": "",
}


def plot(results, scene, run, profile, flags):
    study.plot_series(flags.out / "series.png", run["time"], [
        (label, run[name], results[name]) for name, label in (
            ("h", "$h$ [m]"), ("phi", r"$\phi$ [-]"), ("tau", r"$\tau$ [Pa]"), ("mu", r"$|\tau|/|\sigma_{yy}|$ [-]"))
    ], results["t_converged"])
    if profile:
        study.plot_profile(flags.out / "profiles.png", profile, flags.rate * flags.height / profile.height)
    study.plot_snapshot(flags.out / "snapshot.png", scene.sim, *scene.faces, scene.fixed_grains(),
                        title=f"$t$ = {scene.sim.time:.3g} s")


def main():
    parser = command_line()
    flags = parser.parse_args()
    with parser.user_errors():
        scene = Scene(flags)
    with parser.user_errors(OSError):  # of its files
        run, profiles = simulate(scene, flags)
    results, profile = measure(scene, run, profiles, flags)
    study.write_results(flags.out / "results.json", results)
    reference = all(getattr(flags, name) == parser.get_default(name) for name in REFERENCE_FLAGS)
    study.print_summary(f"dry plane Couette flow, {results['n_grains']} discs, {results['state']}", results, UNITS,
                        THESIS if reference else None)
    if run.samples and not flags.no_plots:
        plot(results, scene, run, profile, flags)
    return 130 if run.interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
