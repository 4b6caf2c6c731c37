"""What tolerance and time step cost and change: the reference flow at size ratio 1.5, which does not crystallise, several seeds each.

    ./run tests/benchmarks/tolerance.py --out out/tolerance --seeds 8 --jobs 2

Runs examples/dry_couette.py, skips runs that are there already, prints the table of docs/dry_couette.md. Errors are standard
errors of the mean over seeds; `bias` is against the tightest tolerance (same time step).
"""

import argparse
import json
import pathlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

EXAMPLE = pathlib.Path(__file__).parents[2] / "examples" / "dry_couette.py"
TOLERANCES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
STEPS = (5e-4,)  # [s], at the default tolerance; beside the default 1e-3


def cases():
    return [(tolerance, 1e-3) for tolerance in TOLERANCES] + [(1e-2, dt) for dt in STEPS]


def folder(out, case, seed):
    return out / f"tolerance_{case[0]:g}" / f"dt_{case[1]:g}" / f"seed_{seed}"


def run(out, case, seed):
    where = folder(out, case, seed)
    if not (where / "results.json").exists():
        subprocess.run([sys.executable, EXAMPLE, "--out", where, "--tolerance", str(case[0]), "--dt", str(case[1]),
                        "--seed", str(seed), "--size-ratio", "1.5", "--threads", "1", "--no-plots"], check=True, stdout=subprocess.DEVNULL)


def table(out, seeds):
    rows = {}
    for case in cases():
        runs = [json.loads(path.read_text()) for seed in range(seeds)
                if (path := folder(out, case, seed) / "results.json").exists()]
        runs = [r for r in runs if r["mu"] is not None]
        if runs:
            rows[case] = (runs, {name: np.array([r[name] for r in runs], float) for name in
                                 ("mu", "phi", "max_overlap", "sweeps_per_step", "wall_time", "psi6", "unconverged_steps")})
    tightest = rows.get((TOLERANCES[-1], 1e-3))
    lines = ["| tolerance | dt [s] | seeds | mu | bias | phi | bias | max overlap [d] | sweeps | wall time [s] | psi6 |",
             "|---|---|---|---|---|---|---|---|---|---|---|"]
    for (tolerance, dt), (runs, values) in rows.items():
        n = len(runs)
        error = lambda name: values[name].std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
        bias = lambda name: values[name].mean() - tightest[1][name].mean() if tightest else np.nan
        lines.append(f"| {tolerance:g} | {dt:g} | {n} | {values['mu'].mean():.4f} +- {error('mu'):.4f} | {bias('mu'):+.4f} "
                     f"| {values['phi'].mean():.4f} +- {error('phi'):.4f} | {bias('phi'):+.4f} | {values['max_overlap'].max():.2%} "
                     f"| {values['sweeps_per_step'].mean():.0f} | {np.median(values['wall_time']):.0f} | {values['psi6'].mean():.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default="out/tolerance")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--jobs", type=int, default=2)
    flags = parser.parse_args()
    with ThreadPoolExecutor(flags.jobs) as pool:
        list(pool.map(lambda job: run(flags.out, *job), [(case, seed) for seed in range(flags.seeds) for case in cases()]))
    print(table(flags.out, flags.seeds))
