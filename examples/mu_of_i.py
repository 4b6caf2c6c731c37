"""The rheology of dry plane Couette flow: mu(I) and phi(I) over shear rates and size ratios, fitted, beside the thesis.

    ./run examples/mu_of_i.py --out out/mu_of_i --jobs 2

Each run is examples/dry_couette.py with its own defaults. Runs that are done are skipped and one that was stopped goes on from its
checkpoint, so the study can be killed and started again at any time.

Flags
    --size-ratios L ...  r_max / r_min [-] (1 1.22 1.5 2.33 9)
    --rates G ...        nominal shear rates [1/s] (0.1 0.2 0.5 1 2 5 10 15 20)
    --seeds N            runs of each, with seeds 0 ... N - 1 (1)
    --jobs N             runs at the same time, one thread each (all cores)
    --out DIR            (out/mu_of_i; with --quick out/mu_of_i_quick)
    --quick              small cells and short runs, size ratios 1 1.5 2.33 and rates 2 5 10 20 where not given: a look at the
                         tables and figures, not at the physics

DIR/lambda_1.5/rate_10/results.json, and seed_1/results.json there for the second seed, are those of the runs. DIR/results.json has,
one entry per size ratio, null where fewer than four runs flow:
    size_ratio
    mu_s mu_2 I0                    of mu = mu_s + (mu_2 - mu_s) / (1 + I0 / I), by least squares over the runs that flow, all seeds,
                                    with I from the nominal shear rate as in the thesis [-]
    mu_s_error mu_2_error I0_error  standard errors, from the scatter about the fit
    mu_s_bulk ... I0_bulk_error     the same with I from the shear rate measured in the bulk
Beside it: tables.md (tables 3.1 to 3.3 of the thesis, ours beside) and the figures 3.4, 3.7, 3.9 as figure_3_4.png ..., each once more
with the bulk shear rate as figure_3_9_bulk.png.
"""

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from quicksand import study

EXAMPLE = Path(__file__).with_name("dry_couette.py")
THESIS_FITS = {1.22: (0.198, 0.862, 0.493), 1.5: (0.213, 0.790, 0.324), 2.33: (0.255, 0.836, 0.289), 9.0: (0.272, 0.790, 0.163)}
THESIS_STATES = {  # tables 3.1 and 3.2: rate 10, by size ratio
    1.0: {"h": "0.1043", "phi": "0.767 +- 0.003", "mu": "0.392 +- 0.033", "tau": "-1.89 +- 0.42", "sigma_xx": "4.53 +- 0.92",
          "sigma_yy": "4.81 +- 1.03", "branch_length": "0.00200", "inertial_number": "0.28"},
    1.5: {"h": "0.1100", "phi": "0.736 +- 0.002", "mu": "0.469 +- 0.043", "tau": "-2.22 +- 0.43", "sigma_xx": "4.78 +- 1.10",
          "sigma_yy": "4.74 +- 0.92", "branch_length": "0.00203", "inertial_number": "0.29"},
}
COLOURS = {1.0: "#1f5fa8", 1.22: "#2e7d4f", 1.5: "#c2452d", 2.33: "#8a5a00", 9.0: "#6b3fa0"}


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--size-ratios", type=study.number("", at_least=1), nargs="+")
    parser.add_argument("--rates", type=study.number("1/s", above=0), nargs="+")
    parser.add_argument("--seeds", type=study.whole(at_least=1), default=1)
    parser.add_argument("--jobs", type=study.whole(at_least=1), default=os.cpu_count())
    parser.add_argument("--out", type=Path)
    parser.add_argument("--quick", action="store_true")
    flags = parser.parse_args()
    flags.size_ratios = flags.size_ratios or ([1.0, 1.5, 2.33] if flags.quick else [1.0, 1.22, 1.5, 2.33, 9.0])
    flags.rates = flags.rates or ([2.0, 5.0, 10.0, 20.0] if flags.quick else [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0])
    flags.out = flags.out or Path("out/mu_of_i_quick" if flags.quick else "out/mu_of_i")
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
    return flags


def folder(out, size_ratio, rate, seed):
    place = out / f"lambda_{size_ratio:g}" / f"rate_{rate:g}"
    return place / f"seed_{seed}" if seed else place


def result(place):
    """results.json of a run that is done, else None."""
    path = place / "results.json"
    results = json.loads(path.read_text()) if path.exists() else None
    return None if results is None or results["state"] == "interrupted" else results


def run(flags, size_ratio, rate, seed):
    """Make a run, or go on with it; returns what it says on failure."""
    place = folder(flags.out, size_ratio, rate, seed)
    if result(place):
        return ""
    checkpoint = place / "checkpoint.h5"
    if checkpoint.exists():
        arguments = ["--restart", checkpoint]
    else:
        arguments = ["--out", place, "--size-ratio", str(size_ratio), "--rate", str(rate), "--seed", str(seed), "--threads", "1",
                     "--frame-every", "0", "--no-plots"] + ["--quick"] * flags.quick
    done = subprocess.run([sys.executable, EXAMPLE, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        return f"lambda {size_ratio:g}, rate {rate:g} 1/s, seed {seed}: {done.stderr.strip() or f'exit status {done.returncode}'}"
    checkpoint.unlink(missing_ok=True)
    return ""


def run_all(flags):
    """All runs, `jobs` at a time; returns the messages of those that failed."""
    from tqdm import tqdm

    jobs = [(size_ratio, rate, seed) for seed in range(flags.seeds) for size_ratio in flags.size_ratios for rate in flags.rates]
    with ThreadPoolExecutor(flags.jobs) as pool:
        running = [pool.submit(run, flags, *job) for job in jobs]
        try:
            done = tqdm(as_completed(running), total=len(jobs), unit="run", leave=False, disable=not sys.stderr.isatty())
            return [message for message in (future.result() for future in done) if message]
        except KeyboardInterrupt:  # the runs in progress have got it, too: they write their checkpoints and end
            pool.shutdown(cancel_futures=True)
            raise


def collect(flags):
    """Results of the runs that are done, by size ratio; {rate: list over seeds} each."""
    runs = {}
    for size_ratio in flags.size_ratios:
        for rate in flags.rates:
            found = [results for seed in range(flags.seeds) if (results := result(folder(flags.out, size_ratio, rate, seed)))]
            if found:
                runs.setdefault(size_ratio, {})[rate] = found
    return runs


def mu_of_i(inertial_number, mu_s, mu_2, i_0):
    """P. Jop, Y. Forterre, O. Pouliquen, Nature 441 (2006)."""
    return mu_s + (mu_2 - mu_s) / (1 + i_0 / inertial_number)


def fit(runs, which):
    """((mu_s, mu_2, I0), their standard errors) of the runs that flow; (None, None) with fewer than four."""
    from scipy.optimize import curve_fit

    flowing = [r for r in runs if r["state"] == "flowing" and r["mu"] is not None and (r[which] or 0) > 0]
    if len(flowing) < 4:
        return None, None
    values, covariance = curve_fit(mu_of_i, [r[which] for r in flowing], [r["mu"] for r in flowing], p0=(0.2, 0.8, 0.3),
                                   bounds=(0, [2, 5, 50]))
    return values, np.sqrt(np.diag(covariance))


def fit_all(runs, size_ratios):
    """The lists of results.json."""
    results = {"size_ratio": list(size_ratios)}
    for suffix, which in (("", "inertial_number"), ("_bulk", "inertial_number_bulk")):
        fits = [fit([r for seeds in runs.get(ratio, {}).values() for r in seeds], which) for ratio in size_ratios]
        for k, name in enumerate(("mu_s", "mu_2", "I0")):
            results[f"{name}{suffix}"] = [values[k] if values is not None else None for values, _ in fits]
            results[f"{name}{suffix}_error"] = [errors[k] if errors is not None else None for _, errors in fits]
    return results


def tables(runs, results):
    """Tables 3.1 to 3.3 and one of all runs, as Markdown."""
    lines = ["Rate 10 /s (tables 3.1 and 3.2). Ours: mean over seeds +- standard error in time; thesis: +- standard deviation in time.", "",
             "| quantity | " + " | ".join(f"lambda {ratio:g} | thesis" for ratio in THESIS_STATES) + " |",
             "|---|" + "---|---|" * len(THESIS_STATES)]
    for name, unit in (("h", "m"), ("phi", "-"), ("mu", "-"), ("tau", "Pa"), ("sigma_xx", "Pa"), ("sigma_yy", "Pa"),
                       ("branch_length", "m"), ("inertial_number", "-"), ("inertial_number_bulk", "-")):
        row = [f"{name} [{unit}]"]
        for ratio, thesis in THESIS_STATES.items():
            seeds = [r for r in runs.get(ratio, {}).get(10.0, []) if r[name] is not None]
            error = np.mean([r[f"{name}_err"] for r in seeds]) if seeds and seeds[0].get(f"{name}_err") else None
            row += [f"{np.mean([r[name] for r in seeds]):.4g}" + (f" +- {error:.2g}" if error else "") if seeds else "-", thesis.get(name, "-")]
        lines.append("| " + " | ".join(row) + " |")

    def mean(seeds, name):
        known = [r[name] for r in seeds if r[name] is not None]
        return f"{np.mean(known):.3g}" if known else "-"

    def value(name, k):
        return "-" if results[name][k] is None else f"{results[name][k]:.3f} +- {results[name + '_error'][k]:.3f}"

    lines += ["", "Fits (table 3.3).", "", "| lambda | mu_s | thesis | mu_2 | thesis | I0 | thesis | mu_s, bulk rate | mu_2 | I0 |",
              "|---" * 10 + "|"]
    for k, ratio in enumerate(results["size_ratio"]):
        thesis = THESIS_FITS.get(ratio, ("-",) * 3)
        cells = [cell for name, t in zip(("mu_s", "mu_2", "I0"), thesis) for cell in (value(name, k), str(t))]
        lines.append(f"| {ratio:g} | " + " | ".join(cells + [value(f"{name}_bulk", k) for name in ("mu_s", "mu_2", "I0")]) + " |")

    lines += ["", "All runs, means over seeds.", "", "| lambda | rate [1/s] | I | state | mu | phi | bulk rate [1/s] | I, bulk | psi6 |", "|---" * 9 + "|"]
    for ratio, by_rate in runs.items():
        for rate, seeds in by_rate.items():
            state = ", ".join(sorted({r["state"] for r in seeds}))
            cells = [mean(seeds, name) for name in ("mu", "phi", "shear_rate_bulk", "inertial_number_bulk", "psi6")]
            lines.append(" | ".join([f"| {ratio:g}", f"{rate:g}", mean(seeds, "inertial_number"), state, *cells]) + " |")
    return "\n".join(lines) + "\n"


def plot(out, runs, results):
    ratios = list(results["size_ratio"])
    figures = (("figure_3_4", [1.0]), ("figure_3_7", [1.0, 1.5]), ("figure_3_9", [r for r in ratios if r > 1]))
    for suffix, which in (("", "inertial_number"), ("_bulk", "inertial_number_bulk")):
        for name, shown in figures:
            curves = []
            for ratio in shown:
                points = [r for seeds in runs.get(ratio, {}).values() for r in seeds if r["mu"] is not None and (r[which] or 0) > 0]
                k = ratios.index(ratio) if ratio in ratios else None
                fitted = None if k is None else [results[f"{n}{suffix}"][k] for n in ("mu_s", "mu_2", "I0")]
                curves.append({
                    "label": rf"$\lambda$ = {ratio:g}", "colour": COLOURS.get(ratio, "#222222"),
                    **{key: np.array([r[field] for r in points], float) for key, field in
                       (("i", which), ("mu", "mu"), ("mu_err", "mu_err"), ("phi", "phi"), ("phi_err", "phi_err"))},
                    "flowing": np.array([r["state"] == "flowing" for r in points], bool),
                    "fit": None if not fitted or None in fitted else lambda i, f=fitted: mu_of_i(i, *f),
                    "thesis": None if suffix or ratio not in THESIS_FITS else lambda i, f=THESIS_FITS[ratio]: mu_of_i(i, *f),
                })
            label = "bulk" if suffix else "nominal"
            curves = [curve for curve in curves if curve["i"].size]
            if curves:
                study.plot_flow_curves(out / f"{name}{suffix}.png", curves, f"inertial number $I$, {label} shear rate [-]")


def main():
    flags = parse_flags()
    try:
        failed = run_all(flags)
        runs = collect(flags)
        results = fit_all(runs, flags.size_ratios)
        study.write_results(flags.out / "results.json", results)
        text = tables(runs, results)
        (flags.out / "tables.md").write_text(text)
        print(text)
        plot(flags.out, runs, results)
    except KeyboardInterrupt:
        print("mu_of_i.py: stopped; the same command goes on", file=sys.stderr)
        return 130
    for message in failed:
        print(f"mu_of_i.py: {message}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
