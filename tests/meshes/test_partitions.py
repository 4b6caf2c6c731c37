"""Partitions cover the mesh, are balanced, and touch little."""

import numpy as np
import pytest

from quicksand import meshes


def neighbours(mesh):
    """(pairs, 2) elements that share a facet, across periods too."""
    corners = mesh.master[mesh.elements]
    facets = np.concatenate([np.sort(np.delete(corners, k, axis=1), axis=1) for k in range(mesh.dim + 1)])
    element = np.tile(np.arange(len(corners)), mesh.dim + 1)
    order = np.lexsort(facets.T)
    same = np.all(facets[order][1:] == facets[order][:-1], axis=1)
    return np.stack([element[order][:-1][same], element[order][1:][same]], axis=1)


@pytest.mark.parametrize("make", [lambda: meshes.cylinder_in_channel(0.005), lambda: meshes.box((1, 1, 1), (8, 8, 8), periodic=(True, True, False)),
                                  lambda: meshes.pipe(0.5, 2, 0.12, periodic=True)])
@pytest.mark.parametrize("parts", [2, 8])
def test_parts_are_within_5_percent_of_equal_and_touch_less_than_stripes(make, parts):
    mesh = make()
    part = mesh.partition(parts)
    sizes = np.bincount(part)
    assert len(part) == len(mesh.elements) and len(sizes) == parts
    assert np.all(np.abs(sizes - sizes.mean()) < 0.05 * sizes.mean())
    pairs = neighbours(mesh)
    stripes = np.arange(len(part)) * parts // len(part)
    cut, cut_of_stripes = (np.count_nonzero(p[pairs[:, 0]] != p[pairs[:, 1]]) for p in (part, stripes))
    assert 0 < cut < (0.8 if parts > 2 else 1.1) * cut_of_stripes
    assert np.array_equal(part, mesh.partition(parts))


def test_one_part_is_the_whole_mesh_and_too_many_are_an_error():
    mesh = meshes.box((1, 1), (2, 2))
    assert not mesh.partition(1).any()
    assert sorted(mesh.partition(8)) == list(range(8))
    for parts in (0, -1, 9):
        with pytest.raises(ValueError, match=f"partition: parts must be between 1 and the number of elements, 8, got {parts}"):
            mesh.partition(parts)
