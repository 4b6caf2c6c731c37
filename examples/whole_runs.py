"""Whole runs of the rough-walled Couette cell for speed_accuracy_contacts.py: what tolerance, sub-steps, time step, and soft grains change.

measure(): 5103 discs, size ratio 1.5, rate 10 /s, rough walls on both sides (dry_couette.py). All runs go on from one developed state, ours and those of
LAMMPS (kn/P from 1e3 to 1e5; where `lmp` is installed). Friction is measured at the walls, over the load; the fraction from their distance; overlaps from
positions every 0.05 s; each by the same function for both codes, each on one core.
measure_spheres(): 10 000 spheres between rough walls.
"""

import json
import re
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import dry_couette
from quicksand import grains, study

RATE, PRESSURE, WIDTH, RADIUS = 10.0, 5.0, 0.2, 1e-3
SETTLE = 0.5  # s, after which a run has forgotten how the developed state was made


def cases(quick):
    """Settings of our runs by name; the first is the reference, the second the default."""
    default = {"tolerance": 1e-2, "sub_step_motion": 0.1, "dt": 1e-3}
    changes = {"reference": {"tolerance": 1e-3, "sub_step_motion": 0.05, "dt": 5e-4}, "default": {}}
    if not quick:
        changes |= {f"tolerance {x:g}": {"tolerance": x} for x in (0.3, 0.1, 0.03, 3e-3)}
        changes |= {f"motion {x:g}": {"sub_step_motion": x} for x in (0.05, 0.2, 0.5)}
        changes |= {f"dt {1e3 * x:g} ms": {"dt": x} for x in (5e-4, 2e-3, 4e-3)}
        changes |= {"coarse: tolerance 0.03, dt 2 ms": {"tolerance": 0.03, "dt": 2e-3},
                    "coarse: tolerance 0.03, motion 0.3, dt 2 ms": {"tolerance": 0.03, "sub_step_motion": 0.3, "dt": 2e-3}}
    return {name: default | change for name, change in changes.items()}


def make_scene(quick):
    size = {"height": 0.03, "width": 0.06} if quick else {"height": 0.1, "width": WIDTH}
    return dry_couette.scene(size_ratio=1.5, rough_walls=True, rate=RATE * 0.1 / size["height"], pressure=PRESSURE, threads=1, **size)


def overlaps(position, radius, period):
    """Mean of touching pairs and largest overlap, in mean diameters."""
    x = np.column_stack([position[:, 0] % period, position[:, 1] - position[:, 1].min()])
    tree = cKDTree(x, boxsize=(period, 1e3))
    i, j = tree.query_pairs(2 * radius.max(), output_type="ndarray").T
    d = x[i] - x[j]
    d[:, 0] -= period * np.round(d[:, 0] / period)
    depth = radius[i] + radius[j] - np.hypot(*d.T)
    depth = depth[depth > 0] / (2 * RADIUS)
    return (depth.mean(), depth.max()) if depth.size else (0.0, 0.0)


def averages(h, friction, solid, period, frames):
    mu, phi = grains.block_average(friction), grains.block_average(solid / (period * h))
    mean, largest = np.array([overlaps(*frame, period) for frame in frames]).T
    return {"mu": mu.mean, "mu_err": mu.error, "phi": phi.mean, "phi_err": phi.error, "overlap": mean.mean(), "overlap_max": largest.max()}


def run_ours(scene, state, settings, length):
    sim, dt = scene.sim, settings["dt"]
    sim.restore(state)
    for name in ("tolerance", "sub_step_motion"):
        setattr(sim, name, settings[name])
    lower, upper = scene.walls
    rows, frames, wall_time, unconverged, sub_steps = [], [], 0.0, 0, 0
    every = round(0.05 / dt)
    for k in range(round((SETTLE + length) / dt)):
        start = time.perf_counter()
        report = sim.step(dt)
        if k * dt < SETTLE - dt / 2:
            continue
        wall_time += time.perf_counter() - start
        unconverged += report.unconverged
        sub_steps += report.sub_steps
        low, high = scene.faces
        rows.append((high - low, 0.5 * (lower.force[0] - upper.force[0]) / (PRESSURE * scene.width)))
        if len(rows) % every == 0:
            frames.append((sim.position, sim.radius))
    h, friction = np.array(rows).T
    return averages(h, friction, scene.solid, scene.width, frames) | {
        "seconds": wall_time / length, "unconverged": unconverged, "sub_steps": sub_steps}


def developed_once(folder, sim, develop):
    """The state from which all runs in the folder start; develop() leads there."""
    path = folder / "state.npy"
    if not path.exists():
        develop()
        np.save(path, sim.state())
    return np.load(path)


def made_once(folder, runs, per):
    """Results of runs by name; those that the folder holds are not made again. A run that returns None is left out."""
    rows = {}
    for name, run in runs.items():
        path = folder / f"{name}.json"
        if not path.exists():
            if (found := run()) is None:
                continue
            study.write_results(path, found)
            print(f"{name}: {found['seconds']:.2f} s {per}", flush=True)
        rows[name] = json.loads(path.read_text())
    return rows


def write_data(path, sim, walls, period, wall_grains):
    """The present state for LAMMPS: types 1 grains, 2 and 3 the grains of the lower and of the upper wall; heights from the lower wall."""
    dim, half = sim.dim, len(wall_grains[1]) // 2
    r = np.concatenate([sim.radius, wall_grains[1]])
    x = np.zeros((len(r), 3))
    x[:, :dim] = np.concatenate([sim.position, wall_grains[0]])
    x[:, 0] %= period
    x[:, 1] -= walls[0].position[1]
    if dim == 3:
        x[:, 2] %= period
    v, spin = np.zeros((len(r), 3)), np.zeros((len(r), 3))
    v[:sim.count, :dim] = sim.velocity
    v[sim.count:, 0] = np.repeat([wall.velocity[0] for wall in walls], half)
    spin[:sim.count, 2 if dim == 2 else slice(None)] = sim.spin
    kind, ids = np.repeat([1, 2, 3], [sim.count, half, half]), np.arange(1, len(r) + 1)
    depth = (0, period) if dim == 3 else (-0.002, 0.002)
    with open(path, "w") as file:
        file.write(f"plane Couette flow\n\n{len(r)} atoms\n3 atom types\n\n0 {period} xlo xhi\n-0.01 0.5 ylo yhi\n{depth[0]} {depth[1]} zlo zhi\n\nAtoms # sphere\n\n")
        np.savetxt(file, np.column_stack([ids, kind, 2 * r, np.full(len(r), DENSITY[dim]), x]), "%d %d %.12g %g %.12g %.12g %.12g")
        file.write("\nVelocities\n\n")
        np.savetxt(file, np.column_stack([ids, v, spin]), "%d" + 6 * " %.9g")


def run_lammps(sim, walls, period, wall_grains, folder, kappa, r_min, settle, timed, average):
    """LAMMPS from the present state, with springs of kn = kappa P (3D: kappa P d): `settle` s, `timed` s, and `average` s that leave `series` and
    `frames` in the folder. Returns seconds per simulated second over `timed`, and its time step [s]; None where it is not installed."""
    if shutil.which("lmp") is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    write_data(folder / "start.data", sim, walls, period, wall_grains)
    dim, d = sim.dim, 2 * wall_grains[1][0]
    area, pressure = (period, PRESSURE) if dim == 2 else (period**2, SPHERE_PRESSURE)
    kn = kappa * pressure * (1.0 if dim == 2 else d)
    mass = {r: DENSITY[dim] * (np.pi * r**2 if dim == 2 else 4 / 3 * np.pi * r**3) for r in (d / 2, r_min)}
    damping = -np.log(0.1) / np.hypot(np.pi, np.log(0.1))  # of its critical value: restitution 0.1, the least that gran/hooke is used with
    variables = {"dim": dim, "kn": kn, "gn": 2 * damping * np.sqrt(kn / (mass[d / 2] / 2)), "dt": np.pi * np.sqrt(mass[r_min] / 2 / kn) / 20,
                 "force": 2 * pressure * area / len(wall_grains[1]), "load": area * pressure, "settle": settle, "time": timed, "average": average,
                 "skin": d * (0.6 if kappa < 1e3 else 0.4 if kappa < 1e5 else 0.3)}
    done = subprocess.run(["lmp", "-in", Path(__file__).parent / "peers" / "couette.lammps",
                           *(word for name, value in variables.items() for word in ("-var", name, f"{value:.12g}"))], cwd=folder, capture_output=True, text=True,
                          env={"OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"})
    if done.returncode != 0:
        raise RuntimeError(f"lmp failed: {done.stdout[-500:]}{done.stderr[-500:]}")
    seconds = float(re.findall(r"Loop time of (\S+) on", done.stdout)[1])
    steps, dt = map(float, re.search(r"^TIMED (\S+) (\S+)$", done.stdout, re.M).groups())
    return seconds / (steps * dt), dt


def run_soft_discs(scene, state, folder, kappa, length):
    scene.sim.restore(state)
    found = run_lammps(scene.sim, scene.walls, scene.width, scene.fixed_grains(), folder, kappa, 0.8 * RADIUS, SETTLE, 0.5, length)
    if found is None:
        return None
    series = np.loadtxt(folder / "series")
    h, friction = series[:, 1] - 2 * RADIUS, 0.5 * np.abs(series[:, 2:4]).sum(axis=1)
    frames = []
    for frame in (folder / "frames").read_text().split("ITEM: TIMESTEP")[1:]:
        rows = np.array([row.split() for row in frame.split("ITEM: ATOMS")[1].split("\n")[1:] if row], float)
        rows = rows[rows[:, 1] == 1]
        frames.append((rows[:, 2:4], rows[:, 4]))
    return averages(h, friction, scene.solid, scene.width, frames) | {
        "seconds": found[0], "unconverged": 0, "sub_steps": int(length / found[1])}


# Spheres: periodic along x and z, between walls of touching spheres on a square lattice, I = 0.01.
SPHERE_PRESSURE, INERTIAL_NUMBER = 1000.0, 0.01  # [Pa], [-]
DENSITY = {2: 1000.0, 3: 2500.0}  # [kg/m^3]


class Spheres:
    def __init__(self, count, columns):
        rng, d = np.random.default_rng(0), 1e-3
        self.period = columns * d
        per_row = int(self.period / (1.12 * d))
        spacing = self.period / per_row
        k = np.arange(count)
        site = (np.column_stack([k % per_row, k // per_row**2, k // per_row % per_row]) + 0.5) * spacing
        site -= [self.period / 2, 0.5 * (site[-1, 1] + spacing / 2), self.period / 2]
        height = 2 * site[-1, 1] + spacing
        self.inertial_time = d * np.sqrt(DENSITY[3] / SPHERE_PRESSURE)
        self.rate = INERTIAL_NUMBER / self.inertial_time
        radius = d / 2 * rng.uniform(0.9, 1.1, count)
        self.solid = 4 / 3 * np.pi * (radius**3).sum()
        speed = 0.5 * self.rate * self.solid / (0.59 * self.period**2)  # at the height of a dense flow
        velocity = 0.05 * speed * rng.uniform(-1, 1, site.shape)
        velocity[:, 0] += speed * site[:, 1] / (height / 2)
        self.sim = grains.Simulation(dim=3, period=(self.period, None, self.period), threads=1, accept_unconverged=True)
        for other in ("grain", "wall"):
            self.sim.set_friction("grain", other, 0.4)
        self.sim.add(site, radius, density=DENSITY[3], velocity=velocity, material="grain")
        x, z = (axis.ravel() for axis in np.meshgrid(*2 * [(np.arange(columns) + 0.5) * d - self.period / 2]))
        self.walls, rows = [], []
        for side in (-1, 1):
            y = side * (height / 2 + d / 2)
            wall = self.sim.add_plane((0, y, 0), (0, -side, 0), material="wall", velocity=(side * speed, None, 0.0),
                                      load=(None, -side * SPHERE_PRESSURE * self.period**2, None))
            rows.append(np.column_stack([x, np.full(x.size, y), z]))
            self.sim.attach(wall, rows[-1], np.full(x.size, d / 2), material="grain")
            self.walls.append(wall)
        self.rows, self.d = rows, d

    def wall_grains(self):
        moved = [row + (wall.position - (0.0, row[0, 1], 0.0)) for wall, row in zip(self.walls, self.rows)]
        return np.concatenate(moved), np.full(sum(map(len, moved)), self.d / 2)

    def shear(self, strain, settings):
        """Means over a strain, and seconds per unit strain."""
        sim, area, dt = self.sim, self.period**2, settings["dt"] * self.inertial_time
        sim.tolerance = settings["tolerance"]
        rows, unconverged, overlap, start = [], 0, 0.0, time.perf_counter()
        for _ in range(round(strain / (self.rate * dt))):
            report = sim.step(dt)
            unconverged += report.unconverged
            overlap = max(overlap, report.max_overlap / self.d)
            lower, upper = self.walls
            rows.append((self.solid / (area * (upper.position[1] - lower.position[1] - self.d)), 0.5 * (lower.force[0] - upper.force[0]) / (SPHERE_PRESSURE * area)))
        seconds = time.perf_counter() - start
        phi, mu = (grains.block_average(x) for x in np.array(rows).T)
        return {"mu": mu.mean, "mu_err": mu.error, "phi": phi.mean, "phi_err": phi.error, "overlap_max": overlap, "unconverged": unconverged,
                "seconds": seconds / (len(rows) * self.rate * dt)}


# dt in inertial times. Larger steps cost more per strain: impulses grow with h^2, and with them the sweeps to the same overlap.
SPHERE_CASES = {"reference": {"tolerance": 3e-3, "dt": 0.05}, "default": {"tolerance": 1e-2, "dt": 0.1}, "tolerance 0.03": {"tolerance": 3e-2, "dt": 0.1},
                "tolerance 0.1": {"tolerance": 0.1, "dt": 0.1}}


def measure_spheres(flags):
    """As measure(), for spheres; LAMMPS is timed over a strain of 0.02 only."""
    folder = flags.out / "spheres"
    folder.mkdir(parents=True, exist_ok=True)
    cell = Spheres(600, 8) if flags.quick else Spheres(10000, 20)
    strain = 0.1 if flags.quick else 3.0
    state = developed_once(folder, cell.sim, lambda: cell.shear(0.3 if flags.quick else 2.0, {"tolerance": 0.03, "dt": 0.1}))

    def ours(settings):
        cell.sim.restore(state)
        cell.shear(strain / 10, settings)
        return cell.shear(strain, settings)

    def soft():
        cell.sim.restore(state)
        unit = 1 / cell.rate
        found = run_lammps(cell.sim, cell.walls, cell.period, cell.wall_grains(), folder / "lammps", 1e4, 0.9 * cell.d / 2, 0.005 * unit, 0.02 * unit, 0)
        return found and dict.fromkeys(("mu", "mu_err", "phi", "phi_err", "overlap_max", "unconverged")) | {"seconds": found[0] * unit}

    runs = {name: (lambda s=settings: ours(s)) for name, settings in SPHERE_CASES.items() if not flags.quick or name == "default"}
    if not flags.quick:
        runs["LAMMPS 1e4"] = soft
    rows = made_once(folder, runs, "per unit strain")
    names = ("mu", "mu_err", "phi", "phi_err", "overlap_max", "unconverged", "seconds")
    return {"sphere_names": list(rows)} | {f"sphere_{name}": [row[name] for row in rows.values()] for name in names}


def measure(flags):
    """Results of all runs; those that --out/runs holds already are not made again."""
    length = 1.0 if flags.quick else 10.0
    folder = flags.out / "runs"
    folder.mkdir(parents=True, exist_ok=True)
    scene = make_scene(flags.quick)
    state = developed_once(folder, scene.sim, lambda: [scene.sim.step(1e-3) for _ in range(500 if flags.quick else 4000)])
    runs = {name: (lambda s=settings, n=name: run_ours(scene, state, s, (2 if n == "reference" else 1) * length))
            for name, settings in cases(flags.quick).items()}
    if not flags.quick:
        for kappa in (1e3, 1e4, 1e5):
            def soft(kappa=kappa):
                return run_soft_discs(scene, state, folder / f"lammps_{kappa:g}", kappa, length)
            runs[f"LAMMPS {kappa:g}"] = soft
    rows = made_once(folder, runs, "per simulated second")
    names = ("mu", "mu_err", "phi", "phi_err", "overlap", "overlap_max", "seconds", "unconverged", "sub_steps")
    return {"run_names": list(rows)} | {f"run_{name}": [row[name] for row in rows.values()] for name in names}


def table(results):
    reference = {name: results[f"run_{name}"][0] for name in ("mu", "phi")}
    lines = ["", "Whole runs, one core: rough walls, size ratio 1.5, rate 10 /s; errors relative to the reference", "",
             "| run | s per simulated s | mu | error of mu | phi | error of phi | mean overlap / d | largest |", "|---" * 8 + "|"]
    for k, name in enumerate(results["run_names"]):
        mu, mu_err, phi, phi_err, mean, largest, seconds = (results[f"run_{x}"][k] for x in ("mu", "mu_err", "phi", "phi_err", "overlap", "overlap_max", "seconds"))
        lines.append(f"| {name} | {seconds:.2f} | {mu:.4f} +- {mu_err or np.nan:.4f} | {100 * (mu / reference['mu'] - 1):+.2f} % | {phi:.4f} +- {phi_err or np.nan:.4f} "
                     f"| {100 * (phi / reference['phi'] - 1):+.2f} % | {mean:.1e} | {largest:.1e} |")
    return lines


def sphere_table(results):
    lines = ["", "10 000 spheres between rough walls, I = 0.01, one core", "",
             "| run | s per unit strain | mu | phi | largest overlap / d | unconverged |", "|---" * 6 + "|"]

    def with_error(value, error):
        return "-" if value is None else f"{value:.4f} +- {error or np.nan:.4f}"

    for name, mu, mu_err, phi, phi_err, overlap, unconverged, seconds in zip(*(results[f"sphere_{x}"] for x in (
            "names", "mu", "mu_err", "phi", "phi_err", "overlap_max", "unconverged", "seconds"))):
        lines.append(f"| {name} | {seconds:.1f} | {with_error(mu, mu_err)} | {with_error(phi, phi_err)} | {'-' if overlap is None else f'{overlap:.1e}'} | {unconverged if unconverged is not None else '-'} |")
    return lines


def plot(path, results):
    seconds, names = np.array(results["run_seconds"]), results["run_names"]
    kinds = [("LAMMPS", "#8a5a00", [n.startswith("LAMMPS") for n in names]), ("tolerance", "#1f5fa8", [n.startswith("tolerance") for n in names]),
             ("sub-steps", "#2e7d4f", [n.startswith("motion") for n in names]), ("dt", "#c2452d", [n.startswith("dt") for n in names]),
             ("several", "#7b3fa0", [n.startswith("coarse") for n in names]),
             ("default", "#222222", [n == "default" for n in names])]
    panels = []
    for name in ("mu", "phi"):
        value, error = (np.array(results[f"run_{name}{x}"], float) for x in ("", "_err"))
        away = np.abs(value / value[0] - 1)
        resolved = np.hypot(error, error[0]) / value[0]
        panels.append((f"error of {name} [-] (at least its standard error)", np.maximum(away, resolved)))
    panels += [("mean overlap [d]", np.array(results["run_overlap"])), ("largest overlap [d]", np.array(results["run_overlap_max"]))]
    study.plot_lines(path, "wall time per simulated second [s]", "error", [
        (title, [(kind, colour, seconds[chosen], value[chosen]) for kind, colour, chosen in kinds if any(chosen)]) for title, value in panels],
        points=True)
