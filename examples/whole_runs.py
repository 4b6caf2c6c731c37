"""Whole runs of the rough-walled Couette cell for speed_accuracy_contacts.py: what tolerance, sub-steps, time step, and soft grains change.

5103 discs, size ratio 1.5, rate 10 /s, rough walls on both sides (dry_couette.py). All runs go on from one developed state, ours and those of
LAMMPS (kn/P from 1e3 to 1e5; where `lmp` is installed). Friction is measured at the walls, over the load; the fraction from their distance; overlaps from
positions every 0.05 s; each by the same function for both codes, each on one core.
"""

import json
import re
import shutil
import subprocess
import time
import types
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
        changes |= {"tolerance 0.03, motion 0.3, dt 2 ms": {"tolerance": 0.03, "sub_step_motion": 0.3, "dt": 2e-3}}
    return {name: default | change for name, change in changes.items()}


def make_scene(quick):
    size = {"height": 0.03, "width": 0.06} if quick else {"height": 0.1, "width": WIDTH}
    return dry_couette.Scene(types.SimpleNamespace(
        seed=0, size_ratio=1.5, fixed_height=False, rough_walls=True, rate=RATE * 0.1 / size["height"], pressure=PRESSURE, threads=1,
        tolerance=None, friction=0.4, wall_friction=1.0, t_end=10.0, dt=1e-3, **size))


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


def write_data(path, scene):
    """The present state for LAMMPS: types 1 grains, 2 and 3 the lower and the upper wall. Heights from the lower wall's centres."""
    position, radius = scene.fixed_grains()
    sim, half = scene.sim, len(radius) // 2
    x = np.concatenate([sim.position, position])
    x = np.column_stack([x[:, 0] % scene.width, x[:, 1] - scene.walls[0].position[1]])
    speed = RATE * 0.05
    v = np.concatenate([sim.velocity, np.repeat([(-speed, 0.0), (speed, 0.0)], half, axis=0)])
    kind = np.repeat([1, 2, 3], [sim.count, half, half])
    r = np.concatenate([sim.radius, radius])
    spin = np.concatenate([sim.spin, np.zeros(2 * half)])
    ids = np.arange(1, len(x) + 1)
    with open(path, "w") as file:
        file.write(f"plane Couette flow\n\n{len(x)} atoms\n3 atom types\n\n0 {scene.width} xlo xhi\n-0.01 0.5 ylo yhi\n-0.002 0.002 zlo zhi\n\nAtoms # sphere\n\n")
        np.savetxt(file, np.column_stack([ids, kind, 2 * r, np.full(len(x), 1000.0), x, 0 * r]), "%d %d %.12g %g %.12g %.12g %g")
        file.write("\nVelocities\n\n")
        np.savetxt(file, np.column_stack([ids, v, 0 * r, 0 * r, 0 * r, spin]), "%d %.9g %.9g %g %g %g %.9g")


def run_lammps(scene, folder, kappa, length):
    """None where LAMMPS is not installed."""
    if shutil.which("lmp") is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    write_data(folder / "start.data", scene)
    variables = {"kappa": kappa, "skin": 1.2e-3 if kappa < 1e3 else 0.8e-3 if kappa < 1e5 else 0.6e-3, "rmin": 0.8e-3, "P": PRESSURE, "w": scene.width,
                 "settle": SETTLE, "time": length}
    done = subprocess.run(["lmp", "-in", Path(__file__).parent / "peers" / "couette.lammps", *(word for name, value in variables.items() for word in ("-var", name, f"{value:g}"))],
                          cwd=folder, env={"OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"},
                          capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"lmp failed: {done.stdout[-500:]}{done.stderr[-500:]}")
    loops = [float(seconds) for seconds in re.findall(r"Loop time of (\S+) on", done.stdout)]
    steps, dt = re.search(r"^TIMED (\S+) (\S+)$", done.stdout, re.M).groups()
    series = np.loadtxt(folder / "series")
    h, friction = series[:, 1], 0.5 * np.abs(series[:, 2:4]).sum(axis=1)
    frames, lines = [], (folder / "frames").read_text().split("ITEM: TIMESTEP")[1:]
    for frame in lines:
        rows = np.array([row.split() for row in frame.split("ITEM: ATOMS")[1].split("\n")[1:] if row], float)
        rows = rows[rows[:, 1] == 1]
        frames.append((rows[:, 2:4], rows[:, 4]))
    return averages(h, friction, scene.solid, scene.width, frames) | {
        "seconds": loops[1] / (float(steps) * float(dt)), "unconverged": 0, "sub_steps": int(length / float(dt))}


def measure(flags):
    """Results of all runs; those that --out/runs holds already are not made again."""
    length = 1.0 if flags.quick else 10.0
    folder = flags.out / "runs"
    folder.mkdir(parents=True, exist_ok=True)
    scene = make_scene(flags.quick)
    kept = folder / "state.npy"
    if not kept.exists():
        for _ in range(500 if flags.quick else 4000):
            scene.sim.step(1e-3)
        np.save(kept, scene.sim.state())
    state = np.load(kept)
    runs = {name: (lambda s=settings, n=name: run_ours(scene, state, s, (2 if n == "reference" else 1) * length))
            for name, settings in cases(flags.quick).items()}
    if not flags.quick:
        for kappa in (1e3, 1e4, 1e5):
            def soft(kappa=kappa):
                scene.sim.restore(state)
                return run_lammps(scene, folder / f"lammps_{kappa:g}", kappa, length)
            runs[f"LAMMPS {kappa:g}"] = soft
    rows = {}
    for name, run in runs.items():
        path = folder / f"{name}.json"
        if not path.exists():
            if (found := run()) is None:
                continue
            study.write_results(path, found)
            print(f"{name}: {found['seconds']:.2f} s per simulated second, mu {found['mu']:.4f} +- {found['mu_err'] or np.nan:.4f}", flush=True)
        rows[name] = json.loads(path.read_text())
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


def plot(path, results):
    seconds, names = np.array(results["run_seconds"]), results["run_names"]
    kinds = [("LAMMPS", "#8a5a00", [n.startswith("LAMMPS") for n in names]), ("tolerance", "#1f5fa8", [n.startswith("tolerance") for n in names]),
             ("sub-steps", "#2e7d4f", [n.startswith("motion") for n in names]), ("dt", "#c2452d", [n.startswith("dt") for n in names]),
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
