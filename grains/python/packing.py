"""Where grains stand at the start: lattices and sizes. Discs only; nothing here settles or compacts."""

import math

import numpy as np

from .errors import check_number, check_whole

MOST = 100_000_000  # grains: more are a slip of the pen, and would not fit into memory


def hexagonal_lattice(width, height, spacing, margin):
    """Sites of a triangular lattice with rows along x, in a cell centred on the origin.

    Rows fill the width from the left, every second one shifted by half a spacing; the stack of rows is centred in
    the height.

    Parameters
    ----------
    width, height : float
        Cell [m].
    spacing : float
        Distance of neighbours [m].
    margin : float
        Least distance of a site from the edges of the cell [m], the radius of the grains to put there.

    Returns
    -------
    (n, 2) array
        Positions [m], row by row from below.

    Raises
    ------
    ValueError
        When a length is not finite or not > 0 (margin: >= 0), the cell is too small for one site or has more than 1e8.
    """
    for name, value in (("width", width), ("height", height), ("spacing", spacing)):
        check_number(f"hexagonal_lattice: {name}", value, "m", above=0)
    check_number("hexagonal_lattice: margin", margin, "m", at_least=0)
    row_height = math.sqrt(0.75) * spacing
    if (width / spacing + 1) * (height / row_height + 1) > MOST:
        raise ValueError(f"hexagonal_lattice: spacing {spacing:g} m gives a cell of {width:g} m x {height:g} m more than {MOST:g} sites")
    rows = int((height - 2 * margin) / row_height + 1e-9) + 1
    if height < 2 * margin or width < 2 * margin:
        raise ValueError(f"hexagonal_lattice: no grain of radius {margin:g} m fits in a cell of {width:g} m x {height:g} m")
    sites = []
    for row in range(rows):
        first = margin + (row % 2) * spacing / 2
        columns = int((width - margin - first) / spacing + 1e-9) + 1 if first <= width - margin else 0
        x = first + spacing * np.arange(columns) - width / 2
        sites.append(np.column_stack([x, np.full(columns, (row - (rows - 1) / 2) * row_height)]))
    return np.concatenate(sites)


def uniform_radii(count, mean, size_ratio, rng):
    """Radii uniform between r_min and size_ratio r_min.

    Parameters
    ----------
    count : int
    mean : float
        Mean of the distribution [m].
    size_ratio : float
        r_max / r_min [-], at least 1.
    rng : numpy.random.Generator

    Returns
    -------
    (count,) array
        Radii [m].

    Raises
    ------
    ValueError
        When count is not in 0 to 1e8, mean is not > 0, or size_ratio < 1.
    """
    check_whole("uniform_radii: count", count, 0, MOST)
    check_number("uniform_radii: mean", mean, "m", above=0)
    check_number("uniform_radii: size_ratio", size_ratio, "(r_max / r_min)", at_least=1)
    if not isinstance(rng, np.random.Generator):
        raise TypeError(f"uniform_radii: rng must be a numpy.random.Generator, got {rng!r}")
    smallest = 2 * mean / (1 + size_ratio)
    return rng.uniform(smallest, size_ratio * smallest, count)
