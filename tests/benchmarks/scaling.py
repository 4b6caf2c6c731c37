"""Cost per grain against the number of grains (height fixed, width grown) and against the size ratio.

    ./run tests/benchmarks/scaling.py --copies 1 10 100 --threads 2

Develops the reference flow (5103 discs) for --develop seconds, sets copies of it side by side, and times some steps: all sizes are
in the same state. Then the same flow with size ratio 9 at equal N, each after --develop seconds.
"""

import argparse
import pathlib
import sys
import time

import numpy as np

from quicksand import grains

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "examples"))
import dry_couette  # noqa: E402

WIDTH, SPEED, PRESSURE, DT = 0.2, 0.5, 5.0, 1e-3


def reference_scene(size_ratio, threads):
    return dry_couette.scene(pressure=PRESSURE, size_ratio=size_ratio, width=WIDTH, threads=threads)


def copies(scene, n, threads):
    """n copies of a scene side by side."""
    sim = grains.Simulation(dim=2, period=(n * WIDTH, None), threads=threads, accept_unconverged=True)
    sim.set_friction("grain", "grain", 0.4)
    sim.set_friction("grain", "wall", 1.0)
    shift = (np.arange(n) - (n - 1) / 2) * WIDTH
    old = scene.sim
    position = np.tile(old.position, (n, 1))
    position[:, 0] += np.repeat(shift, old.count)
    sim.add(position, np.tile(old.radius, n), velocity=np.tile(old.velocity, (n, 1)), spin=np.tile(old.spin, n))
    for side, wall in zip((-1, 1), scene.walls):
        sim.add_plane(wall.position, (0, -side), velocity=(side * SPEED, None), load=(None, -side * PRESSURE * n * WIDTH))
    return sim


def measure(sim, steps, warm_up=20):
    for _ in range(warm_up):  # impulses are not copied: the warm start needs a few steps
        sim.step(DT)
    start, reports = time.perf_counter(), [sim.step(DT) for _ in range(steps)]
    wall = time.perf_counter() - start
    sub_steps, sweeps = sum(r.sub_steps for r in reports), sum(r.sweeps for r in reports)
    return {"N": sim.count, "ms/step": 1e3 * wall / steps, "sub-steps": sub_steps / steps, "sweeps": sweeps / sub_steps,
            "us/(grain step)": 1e6 * wall / steps / sim.count, "ns/(grain sub-step sweep)": 1e9 * wall / sweeps / sim.count,
            "updates/(grain sub-step)": sum(r.updates for r in reports) / sub_steps / sim.count,
            "bytes/grain": sim.memory / sim.count}


def show(rows):
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(v if isinstance(v, str) else f"{v:.4g}" for v in row.values()) + " |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 10, 100])
    parser.add_argument("--develop", type=float, default=3.0)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--threads", type=int, default=2)
    flags = parser.parse_args()
    developed = {}
    for size_ratio in (1.0, 9.0):
        developed[size_ratio] = reference_scene(size_ratio, flags.threads)
        for _ in range(round(flags.develop / DT)):
            developed[size_ratio].sim.step(DT)
    show([{"scene": "size ratio 1"} | measure(copies(developed[1.0], n, flags.threads), flags.steps) for n in flags.copies])
    print()
    show([{"scene": f"size ratio {ratio:g}"} | measure(developed[ratio].sim, 5 * flags.steps) for ratio in (1.0, 9.0)])
