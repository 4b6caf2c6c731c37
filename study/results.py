"""What a study leaves behind: results.json and a table on the terminal."""

import json
import math

import numpy as np

from quicksand.grains.frames import write_whole


def write_results(path, results):
    """Write a flat dict as JSON; None and NaN become null. A reader sees the old file or the whole new one.

    Parameters
    ----------
    path : pathlib.Path
    results : dict
        Numbers in SI, strings, None, or lists of these.
    """
    text = json.dumps({key: _plain(value) for key, value in results.items()}, indent=2, allow_nan=False) + "\n"
    write_whole(path, text.encode(), sync=True)


def _plain(value):
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_summary(title, results, units, references=None, source="thesis", digits=4):
    """Print results as a table, with NAME_err and NAME_std beside NAME.

    Parameters
    ----------
    title : str
    results : dict
    units : dict
        The quantities to print, in this order, and their units.
    references : dict, optional
        Published values as text, by quantity; adds a column.
    source : str
        Its heading.
    digits : int
        Of values.
    """
    table = [["quantity", "unit", "value", "+- error", "(std)"]]
    for name, unit in units.items():
        value = results[name]
        table.append([name, unit, str(value) if isinstance(value, int) else _text(value, f"{{:.{digits}g}}") or "-",
                      _text(results.get(f"{name}_err"), "+- {:.2g}"), _text(results.get(f"{name}_std"), "({:.2g})")])
    if references:
        for row in table:
            row.append(references.get(row[0], ""))
        table[0][-1] = source
    widths = [max(map(len, column)) for column in zip(*table)]
    print(title)
    for row in table:
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


def _text(value, form):
    return "" if value is None else form.format(value)
