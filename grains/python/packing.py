"""Where grains stand at the start: lattices and sizes. Discs only; nothing here settles or compacts."""

import numpy as np


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
        When the cell is too small for one site.
    """
    row_height = np.sqrt(0.75) * spacing
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
    """
    smallest = 2 * mean / (1 + size_ratio)
    return rng.uniform(smallest, size_ratio * smallest, count)
