"""Studies made of cases: each a function of the flags whose rows become a table, and lists in results.json."""

from pathlib import Path

import numpy as np

from .arguments import CommandLine
from .results import write_results


def run_cases(doc, out, cases, plot):
    """The program of such a study: flags, then each case in turn; tables.md and results.json are written after each, so that a study that is stopped leaves
    what it has.

    Flags: --cases NAME ... (all), --out DIR, --quick.

    Parameters
    ----------
    doc : str
        The docstring of the study, which --help prints.
    out : pathlib.Path
        Default output directory.
    cases : list of functions
        case(flags) -> (rows, series): rows a list of dicts with the same keys, which results.json holds as lists CASE_KEY; series a dict of lists,
        CASE_NAME.
    plot : function
        plot(folder, results) draws the figures.
    """
    cases = {case.__name__: case for case in cases}
    parser = CommandLine(doc)
    parser.add_argument("--cases", nargs="+", choices=cases, default=list(cases))
    parser.add_argument("--out", type=Path, default=out)
    parser.add_argument("--quick", action="store_true")
    flags = parser.parse_args()
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
    results, tables = {}, []
    for name in flags.cases:
        rows, series = cases[name](flags)
        results |= {f"{name}_{key}": [row[key] for row in rows] for key in rows[0]} | {f"{name}_{key}": values for key, values in series.items()}
        tables.append(_table(name, rows))
        print(tables[-1], flush=True)
        (flags.out / "tables.md").write_text("\n".join(tables))
        write_results(flags.out / "results.json", results)
    plot(flags.out, results)


def _table(case, rows):
    """Markdown of a case's rows."""
    def text(value):
        if value is None or value != value:
            return "-"
        return f"{value:.3g}" if isinstance(value, (float, np.floating)) else str(value)

    names = list(rows[0])
    lines = [f"## {case}", "", "| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    return "\n".join(lines + ["| " + " | ".join(text(row[name]) for name in names) + " |" for row in rows]) + "\n"
