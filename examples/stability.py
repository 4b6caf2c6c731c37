"""Where dry grains stay right, and where they stop: eleven hard cases, each against what is known exactly.

    ./run examples/stability.py --out out/stability

Flags
    --cases NAME ...    of the names below (all)
    --out DIR           results.json, tables.md and figures (out/stability)
    --quick             fewer grains and steps: half a minute in all

stack     ten discs, densities 1 : ratio, from zero impulses: every contact force against the weight above it
column    single column of 200 discs at rest for 1e5 steps: force on the floor, drift, overlaps
sizes     a big disc or sphere on a bed of small ones in a box: the force on it, cost per grain
overlaps  grains that overlap at the start: energy made, steps until repaired
tunnel    a grain faster than its diameter per step against thin targets
big_steps a bed that falls, and a cell that shears, with steps up to 100 times too large
friction  friction 0 to 1e6: a disc on an incline, a column of discs that collapses
elastic   restitution 1: gases of several densities, Newton's cradle, a column that bounces
crystal   a hexagonal crystal, all contacts touching, sheared between plates
wedge     a disc in a V-shaped groove whose forces are not unique
haff      a gas of inelastic discs that cools: Haff's law, with the rate of kinetic theory

results.json, flat: lists CASE_KEY over the rows of each case, in the order of tables.md. Keys of every case, of the worst step unless said:
    residual worst_contact max_overlap      of the step's report [-], [d], [d]: in mean diameters
    unconverged sub_steps sweeps            sums over all steps; of stack: of the first step
    energy_error                            sum of |energy_balance_error| over all energy that was turned over [-]
    steps wall_time                         steps made, seconds they took
Keys of one case:
    stack_ratio stack_layout stack_solver stack_tolerance; stack_force_error, largest |force - weight above| / weight above, after one step,
        stack_force_error_200 after 200 more; stack_global_error of the first step; stack_unconverged_200 stack_max_overlap_200
    column_tolerance column_solver; column_floor_error, largest |floor force / weight - 1|, after 100 steps column_floor_error_100, over the
        last half column_floor_error_late; column_drift_half column_drift, of the top disc at half time and at the end [d];
        column_overlap_half column_overlap_end [d]
    sizes_dim sizes_ratio sizes_grains; sizes_force_error, |mean force on the big one / its weight - 1| over the last tenth;
        sizes_wall_error of what floor and sides bear together; sizes_time_per_grain, per step and grain [s]; sizes_time_per_grain_without the big one
        sizes_sink, depth of its lowest point below the surface of the bed [small d]
    overlaps_scene overlaps_share, of the smaller radius; overlaps_kinetic, largest kinetic energy over m g d of all grains;
        overlaps_made, largest rise of kinetic and potential energy over the same; overlaps_steps_to_repair, until no overlap is above 0.01 d;
        overlaps_beyond_message, what a step says to 1.01
    tunnel_target tunnel_rule tunnel_cfl, speed dt / d; tunnel_trials, of restitution 0 and 1 in turn; tunnel_through; tunnel_sub_steps_per_step, at most
    big_steps_scene big_steps_dt [s] big_steps_motion, the limit for sub-steps; big_steps_sub_steps_per_step; big_steps_pressure, force on the
        walls at the end over load or weight; big_steps_mu big_steps_mu_err big_steps_phi of the sheared cell; big_steps_height of the fallen bed's top [m]
    friction_scene friction_mu friction_solver; friction_error, |velocity / exact - 1| on the incline; friction_height and friction_width
        of the heap [d]
    elastic_scene elastic_phi elastic_dt [s] elastic_solver elastic_tolerance; elastic_energy, at the end over the start; elastic_growth, largest
        in a step over the start; elastic_collisions, of a grain; elastic_last, velocity of the cradle's last ball over the first's
    crystal_solver crystal_friction; crystal_mu, shear over normal stress of the plates; crystal_pressure over the load; crystal_slip, share of
        the plates' speed that is not shear of the crystal; crystal_largest_force over the load on a disc
    wedge_friction wedge_solver wedge_loaded, 100 weights pressed it first; wedge_force normal force over the weight after 10 steps,
        wedge_force_end at the end; wedge_speed, largest late speed over g dt; wedge_creep, way in all steps [d]
    haff_restitution haff_phi haff_dt [s] haff_collision_rate over that of Enskog's theory (e = 1 only); haff_rate_early haff_rate haff_rate_err,
        measured 1/tau over the theory's, over tau/2 and over 2 tau, with its standard error over three seeds; haff_energy, end over start
    Series of the figures: column_series_step column_series_error_SOLVER_TOLERANCE; elastic_series_time [s] and elastic_series_energy [E0], each
        _PHI_SOLVER_TOLERANCE_DT; haff_series_time [tau] and haff_series_temperature [T0], each _RESTITUTION_PHI
"""

import time
from pathlib import Path

import numpy as np

from quicksand import grains, study

GRAVITY, RADIUS, DENSITY, DT = 9.81, 1e-3, 2500.0, 1e-3
D = 2 * RADIUS
SOLVERS = ("nlgs", "active_set", "accelerated", "newton", "auto")
COLOURS = ("#1f5fa8", "#c2452d", "#2e7d4f", "#8a5a00", "#222222")


def scene(friction=0.3, restitution=0.0, gravity=GRAVITY, dim=2, **settings):
    """An empty scene; gravity [m/s^2] along -y. Sub-steps that miss their tolerance are counted."""
    sim = grains.Simulation(dim=dim, gravity=np.eye(dim)[1] * -gravity, accept_unconverged=True, threads=1, **settings)
    for other in ("grain", "wall"):
        sim.set_friction("grain", other, friction)
        sim.set_restitution("grain", other, restitution)
    return sim


def add_box(sim, low, high):
    """Planes along every side of the box; a bound that is infinite has none."""
    axes = np.eye(len(low))
    return [sim.add_plane(bound * axis, sign * axis) for axis, *bounds in zip(axes, low, high) for bound, sign in zip(bounds, (1, -1)) if np.isfinite(bound)]


def borne(walls):
    """Weight that the walls carry, those at the sides by friction [N] (2D: N/m)."""
    return -sum(wall.force[1] for wall in walls)


class Run:
    """Steps a scene and keeps the worst of what its reports say."""

    def __init__(self, sim, dt):
        self.sim, self.dt, self.diameter = sim, dt, 2 * sim.radius.mean()
        self.residual = self.worst_contact = self.max_overlap = self.most_sub_steps = 0
        self.unconverged = self.sub_steps = self.sweeps = self.steps = 0
        self.wrong = self.turned_over = self.wall_time = 0.0

    def go(self, steps, look=None):
        for _ in range(steps):
            start = time.perf_counter()
            report = self.sim.step(self.dt)
            self.wall_time += time.perf_counter() - start
            self.steps += 1
            for name in ("residual", "worst_contact", "max_overlap"):
                setattr(self, name, max(getattr(self, name), getattr(report, name)))
            for name in ("unconverged", "sub_steps", "sweeps"):
                setattr(self, name, getattr(self, name) + getattr(report, name))
            self.most_sub_steps = max(self.most_sub_steps, report.sub_steps)
            self.wrong += abs(report.energy_balance_error)
            self.turned_over += abs(report.work_forces) + abs(report.work_walls) + abs(report.dissipation)
            if look:
                look(report)
        self.turned_over += kinetic_energy(self.sim)
        return self

    def said(self):
        return {"residual": self.residual, "worst_contact": self.worst_contact / self.diameter, "max_overlap": self.max_overlap / self.diameter,
                "unconverged": self.unconverged, "sub_steps": self.sub_steps, "sweeps": self.sweeps,
                "energy_error": self.wrong / self.turned_over if self.turned_over else 0.0, "steps": self.steps, "wall_time": self.wall_time}


def kinetic_energy(sim):
    """Of translation [J/m]."""
    return 0.5 * (sim.mass[:, None] * sim.velocity**2).sum()


def column_of(density, **settings):
    """Discs on top of each other on a floor, touching, and the weight that each one's lower contact bears [N/m]."""
    sim = scene(**settings)
    for k, rho in enumerate(density):
        sim.add([[0.0, (2 * k + 1) * RADIUS]], RADIUS, density=rho)
    floor = sim.add_plane((0, 0), (0, 1))
    return sim, floor, GRAVITY * np.cumsum(sim.mass[::-1])[::-1]


def force_error(sim, weight):
    contacts, force = sim.contacts(), np.zeros(sim.count)
    force[contacts["grain_j"]] = contacts["force_normal"]
    return float((np.abs(force - weight) / weight).max())


def stack(flags):
    rows = []
    for ratio in (1e3, 1e6):
        layouts = {"heavy on light": [1] * 9 + [ratio], "light on heavy": [ratio] + [1] * 9, "alternating": [1, ratio] * 5}
        for layout, density in layouts.items():
            for solver in SOLVERS:
                for tolerance in (1e-2, 1e-6):
                    sim, _, weight = column_of(DENSITY * np.array(density), solver=solver, tolerance=tolerance)
                    first = Run(sim, DT).go(1)
                    row = {"ratio": ratio, "layout": layout, "solver": solver, "tolerance": tolerance,
                           "force_error": force_error(sim, weight), "global_error": sim.global_error()} | first.said()
                    rest = Run(sim, DT).go(20 if flags.quick else 200)
                    rows.append(row | {"force_error_200": force_error(sim, weight), "unconverged_200": rest.unconverged,
                                       "max_overlap_200": rest.max_overlap / D})
    return rows, {}


def column(flags):
    layers, steps = (50, 2000) if flags.quick else (200, 100_000)
    rows, series = [], {"series_step": list(np.unique(np.geomspace(1, steps, 200).astype(int)))}
    for solver, tolerance in (("auto", 1e-2), ("auto", 1e-3), ("auto", 1e-4), ("auto", 1e-6), ("newton", 1e-6)):
        sim, floor, weight = column_of([DENSITY] * layers, solver=solver, tolerance=tolerance)
        run, error, overlap, start = Run(sim, DT), [], [], sim.position[-1, 1]

        def look(report):
            error.append(abs(-floor.force[1] / weight[0] - 1))
            overlap.append(report.max_overlap / D)

        run.go(steps // 2, look)
        half = (start - sim.position[-1, 1]) / D
        run.go(steps - steps // 2, look)
        error, overlap = np.array(error), np.array(overlap)
        rows.append({"solver": solver, "tolerance": tolerance, "floor_error": error.max(), "floor_error_100": error[100:].max(),
                     "floor_error_late": error[steps // 2:].max(), "drift_half": half, "drift": (start - sim.position[-1, 1]) / D,
                     "overlap_half": overlap[:steps // 2].max(), "overlap_end": overlap[-steps // 10:].max()} | run.said())
        # the largest error up to the next point of the series
        series[f"series_error_{solver}_{tolerance:g}"] = list(np.maximum.reduceat(error, np.array(series["series_step"]) - 1))
    return rows, series


def bed_in_box(dim, width, height, rng):
    """Small grains, radii 0.8 to 1 mm, loosely in a box with its floor at y = 0; in 3D of a square base. The scene and its walls."""
    sim, pitch = scene(dim=dim), 2.05 * RADIUS
    axes = [np.arange(int(w / pitch)) * pitch - (int(w / pitch) - 1) * pitch / 2 for w in [width] * dim]
    axes[1] = (np.arange(int(height / pitch)) + 0.5) * pitch
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)
    sim.add(x, rng.uniform(0.8 * RADIUS, RADIUS, len(x)), density=DENSITY, velocity=rng.uniform(-0.05, 0.05, x.shape))
    bounds = np.full(dim, width / 2)
    return sim, add_box(sim, [*-bounds[:1], 0.0, *-bounds[2:]], [*bounds[:1], np.inf, *bounds[2:]])


def force_on(sim, grain):
    """Of all contacts [N] (2D: N/m)."""
    contacts = sim.contacts()
    force = contacts["force_normal"][:, None] * contacts["normal"] + contacts["force_tangential"]
    return force[contacts["grain_j"] == grain].sum(axis=0) - force[contacts["grain_i"] == grain].sum(axis=0)


def sizes(flags):
    rows = []
    for dim, ratio in ((2, 10), (3, 5)) if flags.quick else ((2, 10), (2, 30), (2, 100), (3, 10), (3, 30)):
        rng, width = np.random.default_rng(0), (3 if dim == 2 else 2.2) * ratio * RADIUS
        settle, steps = (200, 200) if flags.quick else (500, 300 if (dim, ratio) == (3, 30) else 1000)
        sim, walls = bed_in_box(dim, width, 10 * D if dim == 2 else 4 * D, rng)
        Run(sim, DT).go(settle)
        without = Run(sim, DT).go(settle // 2)
        top, big = (sim.position[:, 1] + sim.radius).max(), ratio * RADIUS
        sim.add(top * np.eye(dim)[[1]] + (big + 0.1 * RADIUS) * np.eye(dim)[[1]], big, density=DENSITY)
        run = Run(sim, DT).go(steps - steps // 10)
        late = []
        run.go(steps // 10, lambda report: late.append((force_on(sim, sim.count - 1)[1], borne(walls))))
        on_big, on_walls = np.mean(late, axis=0)
        run.diameter = D  # the mean is no scale of small grains' overlaps
        rows.append({"dim": dim, "ratio": ratio, "grains": sim.count, "force_error": abs(on_big / (GRAVITY * sim.mass[-1]) - 1),
                     "wall_error": abs(on_walls / (GRAVITY * sim.mass.sum()) - 1), "time_per_grain": run.wall_time / run.steps / sim.count,
                     "time_per_grain_without": without.wall_time / without.steps / (sim.count - 1),
                     "sink": (top - (sim.position[-1, 1] - big)) / D} | run.said())
    return rows, {}


def overlaps(flags):
    def pair(share, radius=RADIUS):
        sim = scene(gravity=0)
        sim.add([[0, 0], [RADIUS + radius - share * min(radius, RADIUS), 0]], [RADIUS, radius], density=DENSITY)
        return sim

    def lattice(share, gravity=0.0):
        sim, n = scene(gravity=gravity), 10
        at = (np.arange(n) - (n - 1) / 2) * (2 - share) * RADIUS
        sim.add(np.stack(np.meshgrid(at, at - at[0] + RADIUS), -1).reshape(-1, 2), RADIUS, density=DENSITY)
        if gravity:
            add_box(sim, [-1.5 * n * RADIUS, 0], [1.5 * n * RADIUS, np.inf])
        return sim

    rows = []
    scenes = {"pair": pair, "1 to 10": lambda share: pair(share, 10 * RADIUS), "lattice": lattice, "pile": lambda share: lattice(share, GRAVITY)}
    for name, make in scenes.items():
        for share in (0.1, 0.5, 0.99):
            sim, kinetic, made, left = make(share), [], [], []
            run, scale, potential = Run(sim, DT), GRAVITY * D * sim.mass.sum(), lambda: -sim.mass @ sim.position @ sim.gravity
            start = potential()

            def look(report):
                kinetic.append(report.kinetic_energy / scale)
                made.append((report.kinetic_energy + potential() - start) / scale)
                left.append(report.max_overlap / run.diameter)

            run.go(100 if flags.quick else 500, look)
            deep = np.flatnonzero(np.array(left) > 0.01)
            rows.append({"scene": name, "share": share, "kinetic": max(kinetic), "made": max(made),
                         "steps_to_repair": int(deep[-1]) + 1 if deep.size else 0, "beyond_message": ""} | run.said())
    for row, (name, make) in zip(rows[::3], scenes.items()):
        try:
            make(1.01).step(DT)
            row["beyond_message"] = "accepted"
        except ValueError as error:
            row["beyond_message"] = str(error)
    return rows, {}


def tunnel(flags):
    def shoot(target, rule, restitution, speed, distance):
        """Whether a disc thrown down at a target `distance` below it came through, and the run."""
        sim = scene(gravity=0, restitution=restitution, sub_step_rule=rule)
        sim.add([[0.013 * RADIUS, distance + RADIUS]], RADIUS, density=DENSITY, velocity=[[0, -speed]])
        face = lambda: 0.0
        if target == "plane":
            sim.add_plane((0, 0), (0, 1))
        elif target == "segment":
            sim.add_segment((-20 * RADIUS, 0), (20 * RADIUS, 0))
        elif target == "row of 1/10":
            x = np.arange(-100, 101) * 0.2 * RADIUS
            sim.attach(sim.add_plane((0, -1.0), (0, 1)), np.column_stack([x, np.full_like(x, -0.1 * RADIUS)]), 0.1 * RADIUS)
        elif target == "loose wall":
            wall = sim.add_plane((0, 0), (0, 1), load=(None, 0.0), mass=sim.mass[0])
            face = lambda: wall.position[1]
        elif target == "disc of 1/10 on a floor":
            sim.add([[0, -0.1 * RADIUS]], 0.1 * RADIUS, density=DENSITY)
            sim.add_plane((0, -0.2 * RADIUS), (0, 1))
            face = lambda: max(0.0, -10 * (sim.position[1, 1] + 0.1 * RADIUS))  # raised where the small one went through
        elif target == "moving segment":  # comes up at a disc at rest
            sim.velocity = [[0, 0]]
            wall = sim.add_segment((-20 * RADIUS, 0), (20 * RADIUS, 0), velocity=(None, speed))
            face = lambda: wall.position[1]
        else:  # another disc, at rest, coming, small
            radius = 0.1 * RADIUS if target == "disc of 1/10" else RADIUS
            sim.add([[0, -radius]], radius, density=DENSITY, velocity=[[0, speed if target == "head-on" else 0]])
            face = lambda: sim.position[1, 1] + radius
        steps = int(np.ceil((distance + 4 * RADIUS) / (speed * DT))) + 2
        run = Run(sim, DT).go(steps)
        return sim.position[0, 1] - RADIUS < face() - 0.2 * RADIUS, run

    rows, rng = [], np.random.default_rng(0)
    trials = 2 if flags.quick else 6
    for target in ("plane", "segment", "row of 1/10", "loose wall", "moving segment", "disc", "disc of 1/10", "disc of 1/10 on a floor", "head-on"):
        for rule in ("relative", "absolute"):
            for cfl in (1.0, 10.0) if flags.quick else (1.0, 10.0, 100.0):
                shots = [shoot(target, rule, k % 2, cfl * D / DT, D * (1 + cfl * rng.uniform(0, 1))) for k in range(trials)]
                said = [run.said() for _, run in shots]
                rows.append({"target": target, "rule": rule, "cfl": cfl, "trials": trials, "through": sum(bool(through) for through, _ in shots),
                             "sub_steps_per_step": max(run.most_sub_steps for _, run in shots)}
                            | {name: (max if name in ("residual", "worst_contact", "max_overlap", "energy_error") else sum)(
                                one[name] for one in said) for name in said[0]})
    return rows, {}


def big_steps(flags):
    rows = []
    for dt in (1e-4, 1e-2) if flags.quick else (1e-4, 1e-3, 1e-2):
        sim, walls = bed_in_box(2, 40 * RADIUS, (10 if flags.quick else 40) * RADIUS, np.random.default_rng(0))
        sim.position = sim.position + (0, 10 * D)
        run, pressure = Run(sim, dt), []
        steps = round(1.0 / dt)
        run.go(steps - steps // 10).go(steps // 10, lambda report: pressure.append(borne(walls) / (GRAVITY * sim.mass.sum())))
        rows.append({"scene": "fall", "dt": dt, "motion": sim.sub_step_motion, "sub_steps_per_step": run.sub_steps / run.steps, "pressure": np.mean(pressure),
                     "mu": None, "mu_err": None, "phi": None,
                     "height": (sim.position[:, 1] + sim.radius).max()} | run.said())
    for dt, motion in ((1e-4, 0.1), (1e-2, 0.1)) if flags.quick else ((1e-4, 0.1), (1e-3, 0.1), (1e-2, 0.1), (1e-2, 0.5)):
        width, height, load, rate, rng = 60 * RADIUS, 30 * RADIUS, 5.0, 10.0, np.random.default_rng(0)
        sim = scene(friction=0.4, gravity=0, period=(width, None), sub_step_motion=motion)
        x = grains.hexagonal_lattice(width, height, 2.3 * RADIUS, 1.2 * RADIUS)
        radius = grains.uniform_radii(len(x), RADIUS, 1.3, rng)
        sim.add(x, radius, density=1000.0, velocity=np.column_stack([rate * x[:, 1], 0 * x[:, 0]]) + rng.uniform(-1e-3, 1e-3, x.shape))
        walls = [sim.add_plane((0, side * (height / 2 + 0.2 * RADIUS)), (0, -side), velocity=(side * rate * height / 2, None),
                               load=(None, -side * load * width)) for side in (-1, 1)]
        run, late = Run(sim, dt), []
        steps = round((0.5 if flags.quick else 10.0) / dt)

        def look(report):
            h = walls[1].position[1] - walls[0].position[1]
            stress = report.virial_contacts / (width * h)
            late.append(((walls[1].force[1] - walls[0].force[1]) / (2 * load * width), stress[0, 1], stress[1, 1], np.pi * (radius**2).sum() / (width * h)))

        run.go(steps // 2).go(steps - steps // 2, look)
        pressure, tau, normal, phi = np.array(late).T
        rows.append({"scene": "shear", "dt": dt, "motion": motion, "sub_steps_per_step": run.sub_steps / run.steps, "pressure": pressure.mean(),
                     "mu": abs(tau.mean() / normal.mean()), "mu_err": grains.ratio_error(tau, normal), "phi": phi.mean(), "height": None} | run.said())
    return rows, {}


def friction(flags):
    rows, tilt = [], np.radians(30)
    for mu in (0.0, 0.1, 10.0, 1e6):
        sim = scene(friction=mu)
        sim.gravity = GRAVITY * np.array([np.sin(tilt), -np.cos(tilt)])
        sim.add([[0, RADIUS]], RADIUS, density=DENSITY)
        sim.add_plane((0, 0), (0, 1))
        run = Run(sim, DT).go(200)
        # A disc slides under mu g cos, or rolls: then its acceleration is 2/3 of that without friction.
        exact = max(GRAVITY * (np.sin(tilt) - mu * np.cos(tilt)), 2 / 3 * GRAVITY * np.sin(tilt)) * sim.time
        rows.append({"scene": "incline", "mu": mu, "solver": sim.solver, "error": abs(sim.velocity[0, 0] / exact - 1), "height": None, "width": None}
                    | run.said())
    for mu in (0.0, 0.5, 10.0, 1e6):
        for solver in ("nlgs", "auto", "newton"):
            sim, n = scene(friction=mu, solver=solver), 5 if flags.quick else 8
            x = np.stack(np.meshgrid((np.arange(n) - (n - 1) / 2) * 2.02 * RADIUS, (2.02 * np.arange(2 * n) + 1.01) * RADIUS), -1).reshape(-1, 2)
            x[:, 0] += np.random.default_rng(0).uniform(-0.01, 0.01, len(x)) * RADIUS
            sim.add(x, RADIUS, density=DENSITY)
            add_box(sim, [-100 * RADIUS, 0], [100 * RADIUS, np.inf])
            run = Run(sim, DT).go(50 if flags.quick else 100 if solver == "newton" else 500)  # Newton: up to 0.1 s per step
            at = sim.position[:, 0]
            rows.append({"scene": "heap", "mu": mu, "solver": solver, "error": None, "height": (sim.position[:, 1].max() + RADIUS) / D,
                         "width": (at.max() - at.min()) / D} | run.said())
    return rows, {}


def gas(phi, restitution, n, seed=0, **settings):
    """n x n discs of temperature 0.01 m^2/s^2 (per component) in a box periodic along both axes, of solid fraction phi."""
    rng, pitch = np.random.default_rng(seed), np.sqrt(np.pi / phi) * RADIUS
    sim = scene(friction=0, restitution=restitution, gravity=0, period=(n * pitch, n * pitch), **settings)
    at = (np.arange(n) + 0.5 - n / 2) * pitch
    velocity = rng.normal(0, 0.1, (n * n, 2))
    velocity -= velocity.mean(axis=0)
    velocity *= 0.1 / np.sqrt((velocity**2).mean())
    sim.add(np.stack(np.meshgrid(at, at), -1).reshape(-1, 2), RADIUS, density=DENSITY, velocity=velocity)
    return sim


class Energies:
    """Of every step: to look at."""

    def __init__(self, sim):
        self.of, self.collisions = [kinetic_energy(sim)], 0.0  # collisions of a disc

    def __call__(self, report):
        self.of.append(report.kinetic_energy)
        self.collisions += report.coordination * report.sub_steps

    @property
    def kept(self):
        return self.of[-1] / self.of[0]

    @property
    def growth(self):
        return max(np.diff(self.of).max() / self.of[0], 0.0)


def elastic(flags):
    rows, series = [], {}
    exact = {"solver": "nlgs", "tolerance": 1e-8}
    settings = [(1e-3, exact), (1e-4, exact), (1e-4, {"solver": "auto", "tolerance": 1e-2}), (1e-4, {"solver": "nlgs", "tolerance": 1e-2})]
    for phi in (0.05, 0.5, 0.75):
        for dt, how in settings:
            sim = gas(phi, 1.0, 10 if flags.quick else 20, **how)
            energies = Energies(sim)
            run = Run(sim, dt).go(round((0.05 if flags.quick else 1.0) / dt), energies)
            thin = np.linspace(0, run.steps, 51).astype(int)
            label = f"{phi:g}_{how['solver']}_{how['tolerance']:g}_{dt:g}"
            series |= {f"series_time_{label}": list(thin * dt), f"series_energy_{label}": list(np.array(energies.of)[thin] / energies.of[0])}
            rows.append({"scene": "gas", "phi": phi, "dt": dt} | how | {"energy": energies.kept, "growth": energies.growth,
                        "collisions": energies.collisions, "last": None} | run.said())
    for gap in (0.0, 1e-2):  # [d] between the balls of a cradle
        for dt in (1e-3, 1e-5):
            sim = scene(restitution=1.0, gravity=0, **exact)
            sim.add([[(k + (k > 0)) * D * (1 + gap), 0] for k in range(5)], RADIUS, density=DENSITY, velocity=[[0.1, 0]] + [[0, 0]] * 4)
            energies = Energies(sim)
            run = Run(sim, dt).go(round(0.03 / dt), energies)
            rows.append({"scene": f"cradle, gaps {gap:g} d", "phi": None, "dt": dt} | exact | {"energy": energies.kept, "growth": energies.growth,
                        "collisions": energies.collisions, "last": sim.velocity[-1, 0] / 0.1} | run.said())
    for dt in (1e-3, 1e-4):  # ten discs fall together by their diameter
        sim, _, _ = column_of([DENSITY] * 10, restitution=1.0, **exact)
        sim.position = sim.position + (0, D)
        run, total = Run(sim, dt), []
        energy = lambda: kinetic_energy(sim) + GRAVITY * sim.mass @ (sim.position[:, 1] - RADIUS * (2 * np.arange(10) + 1))
        start = energy()
        run.go(round((0.1 if flags.quick else 1.0) / dt), lambda report: total.append(energy() / start))
        rows.append({"scene": "column", "phi": None, "dt": dt} | exact | {"energy": total[-1], "growth": max(np.diff([1.0] + total).max(), 0.0),
                    "collisions": None, "last": None} | run.said())
    return rows, series


def crystal(flags):
    rows, (columns, layers) = [], (8, 3) if flags.quick else (12, 7)
    load, speed = 100.0, 0.05
    for solver in ("nlgs", "auto", "newton"):
        for mu in (0.0, 0.5):
            sim = scene(friction=mu, gravity=0, solver=solver, period=(columns * D, None))
            row = np.sqrt(3) * RADIUS
            sim.add([[(column + 0.5 * (layer % 2)) * D, (layer - (layers - 1) / 2) * row] for layer in range(layers) for column in range(columns)],
                    RADIUS, density=DENSITY)
            edge = (layers - 1) / 2 * row + RADIUS
            walls = []
            for side in (-1, 1):  # rough: half grains that lock into the outer layers
                walls.append(sim.add_plane((0, side * (edge + row)), (0, -side), velocity=(side * speed, None), load=(None, -side * load * columns * D)))
                x = (np.arange(columns) + 0.5 * ((layers if side > 0 else 1) % 2)) * D
                sim.attach(walls[-1], np.column_stack([x, np.full(columns, side * (edge + row - RADIUS))]), RADIUS)
            run, late, largest = Run(sim, DT), [], []

            def look(report):
                late.append((walls[1].force, walls[0].force))
                forces = sim.contacts()["force_normal"]
                largest.append(forces.max(initial=0.0) / (load * D))

            run.go(100 if flags.quick else 200 if solver == "newton" else 2000, look)
            upper, lower = np.mean(late[len(late) // 2:], axis=0)
            shear = np.polyfit(sim.position[:, 1], sim.velocity[:, 0], 1)[0] * (edge + row) / speed
            rows.append({"solver": solver, "friction": mu, "mu": abs(upper[0] - lower[0]) / abs(upper[1] - lower[1]),
                         "pressure": (upper[1] - lower[1]) / (2 * load * columns * D), "slip": 1 - shear, "largest_force": max(largest)} | run.said())
    return rows, {}


def wedge(flags):
    rows, half = [], np.radians(30)
    for mu in (0.0, 0.3, 1.0, 1e6):
        for solver in ("nlgs", "auto", "newton"):
            for loaded in (False, True):
                sim = scene(friction=mu, solver=solver)
                sim.add([[0, RADIUS / np.sin(half)]], RADIUS, density=DENSITY)
                for side in (-1, 1):
                    sim.add_plane((0, 0), (-side * np.cos(half), np.sin(half)))
                weight = GRAVITY * sim.mass[0]
                if loaded:
                    sim.set_force([[0, -100 * weight]])
                    Run(sim, DT).go(10)
                    sim.set_force(None)
                run, speed, start = Run(sim, DT).go(10), [], sim.position
                force = sim.contacts()["force_normal"].max(initial=0.0) / weight
                run.go(100 if flags.quick else 5000, lambda report: speed.append(np.linalg.norm(sim.velocity[0]) / (GRAVITY * DT)))
                rows.append({"friction": mu, "solver": solver, "loaded": loaded, "force": force,
                             "force_end": sim.contacts()["force_normal"].max(initial=0.0) / weight, "speed": max(speed[len(speed) // 2:]),
                             "creep": np.linalg.norm(sim.position - start) / D} | run.said())
    return rows, {}


# Kinetic theory of smooth hard discs, temperature T = <v_x^2> [m^2/s^2], number density n. The relative velocity g of a pair has variance
# 2 T per component, <|g|> = sqrt(pi T); a disc sweeps 2 d <|g|> n chi: omega = 2 sqrt(pi) n d chi sqrt(T) collisions of a disc per second.
# A collision takes m (1-e^2) g_n^2 / 4. Weighted by how often they are met, g_n exp(-g_n^2 / 4T), normal velocities have <g_n^2> = 4 T.
# N m T of energy thus loses N omega/2 x m (1-e^2) T per second: dT/dt = -(1-e^2)/2 omega T, omega ~ sqrt(T). Haff's law solves it:
# T = T0 / (1 + t/tau)^2 with 1/tau = (1-e^2) omega_0 / 4.
def collision_rate(phi, temperature):
    """Enskog's, chi of D. Henderson, Mol. Phys. 30 (1975) [1/s]."""
    n, chi = phi / (np.pi * RADIUS**2), (1 - 7 * phi / 16) / (1 - phi) ** 2
    return 2 * np.sqrt(np.pi) * n * D * chi * np.sqrt(temperature)


def haff(flags):
    rows, series, n = [], {}, 16 if flags.quick else 40
    cases = [(1.0, 0.1, 1e-4), (0.95, 0.1, 1e-4)] if flags.quick else [
        (1.0, 0.1, 1e-4), (1.0, 0.1, 1e-3), (1.0, 0.3, 1e-4), (1.0, 0.3, 2e-5), (0.95, 0.1, 1e-4), (0.95, 0.1, 1e-3), (0.95, 0.1, 1e-2),
        (0.95, 0.3, 1e-4), (0.95, 0.3, 2e-5), (0.9, 0.1, 1e-4)]
    for restitution, phi, dt in cases:
        found, run = [], None
        for seed in range(1 if flags.quick else 3):
            sim = gas(phi, restitution, n, seed, solver="nlgs", tolerance=1e-6)
            run = run or Run(sim, dt)
            run.sim = sim
            run.go(round(5 / collision_rate(phi, 0.01) / dt))  # five collisions: the lattice is forgotten
            omega = collision_rate(phi, kinetic_energy(sim) / sim.mass.sum())
            theory, energies = (1 - restitution**2) * omega / 4, Energies(sim)
            steps = round((2 / theory if theory else 20 / omega) / dt)
            run.go(steps, energies)
            t, T = np.arange(steps + 1) * dt, np.array(energies.of) / energies.of[0]
            early = steps // 4 + 1  # half of tau
            slope = lambda last: np.polyfit(t[:last], np.sqrt(1 / T[:last]), 1)[0] / theory if theory else np.nan  # sqrt(T0/T) = 1 + t/tau
            found.append((energies.collisions / (steps * dt) / omega, slope(early), slope(None), energies.kept))
        collisions, rate_early, rate, kept = np.mean(found, axis=0)
        rows.append({"restitution": restitution, "phi": phi, "dt": dt, "collision_rate": collisions if restitution == 1 else None,
                     "rate_early": rate_early, "rate": rate, "rate_err": np.std([one[2] for one in found], ddof=1) / np.sqrt(len(found)) if len(found) > 1 else None,
                     "energy": kept} | run.said())
        if theory and dt == 1e-4:
            thin = np.linspace(0, steps, 100).astype(int)
            series |= {f"series_time_{restitution:g}_{phi:g}": list(t[thin] * theory), f"series_temperature_{restitution:g}_{phi:g}": list(T[thin])}
    return rows, series


def plot(out, results):
    def curves(prefix, x, y):
        """Of the series whose names begin so: (label, x, y)."""
        names = [name.removeprefix(f"{prefix}_{y}_") for name in results if name.startswith(f"{prefix}_{y}_")]
        return [(name, np.array(results.get(f"{prefix}_{x}_{name}", results.get(f"{prefix}_{x}")), float),
                 np.array(results[f"{prefix}_{y}_{name}"], float)) for name in names]

    if "column_series_step" in results:
        study.plot_lines(out / "column.png", "step", "|floor force / weight - 1| [-]", [("largest until the next point", [
            (name.replace("_", ", "), colour, x, np.maximum(y, 1e-10)) for (name, x, y), colour in zip(curves("column_series", "step", "error"), COLOURS)])])
    if "elastic_scene" in results:
        panels = {}
        for name, x, y in curves("elastic_series", "time", "energy"):
            phi, solver, tolerance, dt = name.split("_")
            panels.setdefault(phi, []).append((f"{solver}, {tolerance}, {1e3 * float(dt):g} ms", x, y))
        study.plot_lines(out / "elastic.png", "$t$ [s]", "$E/E_0$ [-]", [(f"$e$ = 1, solid fraction {phi}", [
            (name, colour, x, y) for (name, x, y), colour in zip(lines, COLOURS)]) for phi, lines in panels.items()], scales=("linear", "linear"))
    if "haff_phi" in results:
        t = np.linspace(0, 2, 50)
        study.plot_lines(out / "haff.png", "$t$ [tau of the theory]", "$T/T_0$ [-]", [("", [
            (f"e {name.replace('_', ', solid fraction ')}", colour, x, y) for (name, x, y), colour in zip(curves("haff_series", "time", "temperature"), COLOURS)]
            + [("Haff's law", COLOURS[-1], t, (1 + t) ** -2)])], scales=("linear", "log"))


CASES = (stack, column, sizes, overlaps, tunnel, big_steps, friction, elastic, crystal, wedge, haff)

if __name__ == "__main__":
    study.run_cases(__doc__, Path("out/stability"), CASES, plot)
