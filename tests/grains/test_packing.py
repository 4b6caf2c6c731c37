"""Lattices and sizes to start from."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from quicksand.grains import hexagonal_lattice, uniform_radii


def test_the_lattice_of_the_thesis_has_5103_discs():
    sites = hexagonal_lattice(0.2, 0.1, spacing=2.1e-3, margin=1e-3)
    assert len(sites) == 5103  # table 2.1: 27 rows of 95 and 27 of 94
    assert np.unique(sites[:, 1].round(9)).size == 54
    assert np.abs(sites[:, 0]).max() <= 0.099 and np.abs(sites[:, 1]).max() <= 0.049
    assert sites[:, 1].mean() == pytest.approx(0.0, abs=1e-5)  # 95 and 94: the centre of mass is not quite that of the rows


def test_neighbours_are_one_spacing_apart():
    sites = hexagonal_lattice(0.02, 0.02, spacing=2e-3, margin=1e-3)
    distances = pdist(sites)
    assert distances.min() == pytest.approx(2e-3, rel=1e-12)
    inner = sites[np.abs(sites).max(axis=1) < 6e-3]
    near = np.linalg.norm(inner[:, None] - sites[None], axis=2) < 2.001e-3
    assert (near.sum(axis=1) - 1 == 6).all()


def test_a_cell_too_small_for_a_grain_is_refused():
    with pytest.raises(ValueError, match="0.001 m fits in a cell of 0.001 m x 0.1 m"):
        hexagonal_lattice(0.001, 0.1, spacing=2.1e-3, margin=1e-3)


def test_radii_are_uniform_with_the_mean_and_ratio_asked_for():
    radii = uniform_radii(100_000, 1e-3, 1.5, np.random.default_rng(1))
    assert 0.8e-3 <= radii.min() < 0.8001e-3 and 1.1999e-3 < radii.max() <= 1.2e-3
    assert radii.mean() == pytest.approx(1e-3, rel=2e-3)  # five standard errors: 0.4e-3 / sqrt(12) / sqrt(1e5)
    assert radii.var() == pytest.approx(0.4e-3**2 / 12, rel=0.02)
    assert (uniform_radii(10, 1e-3, 1.0, np.random.default_rng(1)) == 1e-3).all()
