"""Every ready shape: areas against closed form, normals that point out, names, and errors for sizes that make no sense."""

import numpy as np
import pytest

from quicksand import meshes

PI = np.pi


def area_normals(mesh):
    x = mesh.nodes[mesh.facets]
    if mesh.dim == 2:
        along = x[:, 1] - x[:, 0]
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    return np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 2


def volumes(mesh):
    x = mesh.nodes[mesh.elements]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / (2 if mesh.dim == 2 else 6)


SHAPES = {  # mesh, volume, area of each boundary; polygons inside circles come below
    "rectangle": (lambda: meshes.box((2, 3), (4, 5)), 6, {"left": 3, "right": 3, "bottom": 2, "top": 2}),
    "moved": (lambda: meshes.box((2, 3), (4, 5), origin=(-1, 7)), 6, {"left": 3, "right": 3, "bottom": 2, "top": 2}),
    "free": (lambda: meshes.box((2, 3), size=0.3), 6, {"left": 3, "right": 3, "bottom": 2, "top": 2}),
    "brick": (lambda: meshes.box((1, 2, 3), (2, 3, 4)), 6,
              {"left": 6, "right": 6, "bottom": 3, "top": 3, "back": 2, "front": 2}),
    "free brick": (lambda: meshes.box((1, 2, 3), size=0.5, origin=(1, 1, 1)), 6,
                   {"left": 6, "right": 6, "bottom": 3, "top": 3, "back": 2, "front": 2}),
    "tunnel": (lambda: meshes.box((1, 2, 3), (2, 3, 4), periodic=(True, False, True)), 6, {"bottom": 3, "top": 3}),
    "free tunnel": (lambda: meshes.box((1, 2, 3), size=0.5, periodic=(True, False, True)), 6, {"bottom": 3, "top": 3}),
    "channel": (lambda: meshes.channel(3, 1, 0.15), 3, {"inflow": 1, "outflow": 1, "walls": 6}),
    "periodic channel": (lambda: meshes.channel(3, 1, 0.15, periodic=True), 3, {"walls": 6}),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_has_its_volume_and_its_boundaries_their_areas(name):
    make, volume, areas = SHAPES[name]
    mesh = make()
    assert mesh.volume == pytest.approx(volume, rel=1e-12)
    assert mesh.boundary_names == list(areas)
    for boundary, area in areas.items():
        assert mesh.boundary_area(boundary) == pytest.approx(area, rel=1e-12)
    assert np.all(volumes(mesh) > 0)


ALL = {**{name: shape[0] for name, shape in SHAPES.items()},
       "cylinder": lambda: meshes.cylinder_in_channel(0.02), "annulus": lambda: meshes.annulus(1, 2, 0.2),
       "pipe": lambda: meshes.pipe(0.5, 2, 0.2), "periodic pipe": lambda: meshes.pipe(0.5, 2, 0.2, periodic=True)}


@pytest.mark.parametrize("name", ALL)
def test_the_normals_point_out_and_close_the_boundary(name):
    mesh = ALL[name]()
    normals, x = area_normals(mesh), mesh.nodes[mesh.facets].mean(axis=1)
    inside = mesh.nodes[mesh.elements[mesh.facet_elements[:, 0]]].mean(axis=1)
    assert np.all(np.einsum("ij,ij->i", normals, x - inside) > 0)
    assert np.all(mesh.facet_elements[:, 1] == -1)  # periodic sides have no names
    assert np.abs(normals.sum(axis=0)).max() < 1e-13
    images = mesh.master != np.arange(len(mesh.nodes))
    assert images.any() == ("tunnel" in name or "periodic" in name)
    if not images.any():  # the divergence theorem on x
        assert np.einsum("ij,ij->", normals, x) == pytest.approx(mesh.dim * mesh.volume, rel=1e-12)


def order(errors):
    return np.log2(errors[0] / errors[1])


def test_polygons_in_circles_converge_at_order_2():
    sizes = 0.1, 0.05
    rings = [meshes.annulus(0.5, 1, size) for size in sizes]
    assert order([2 * PI - mesh.boundary_area("outer") for mesh in rings]) == pytest.approx(2, abs=0.1)
    assert order([PI - mesh.boundary_area("inner") for mesh in rings]) == pytest.approx(2, abs=0.1)
    pipes = [meshes.pipe(0.5, 1, 2 * size) for size in sizes]
    assert order([PI / 4 - mesh.volume for mesh in pipes]) == pytest.approx(2, abs=0.1)
    assert order([PI - mesh.boundary_area("wall") for mesh in pipes]) == pytest.approx(2, abs=0.1)
    assert pipes[0].boundary_area("inflow") == pytest.approx(pipes[0].volume, rel=1e-12)  # length 1
    channels = [meshes.cylinder_in_channel(size / 5) for size in sizes]
    assert order([mesh.volume - (2.2 * 0.41 - PI * 0.05**2) for mesh in channels]) == pytest.approx(2, abs=0.1)
    assert order([PI * 0.1 - mesh.boundary_area("cylinder") for mesh in channels]) == pytest.approx(2, abs=0.1)


def test_an_annulus_is_the_difference_of_two_regular_polygons():
    mesh = meshes.annulus(0.5, 1, 0.13)
    outer, inner = (np.count_nonzero(mesh.boundary == k) for k in range(2))
    assert mesh.boundary_names == ["outer", "inner"]
    assert mesh.volume == pytest.approx(outer / 2 * np.sin(2 * PI / outer) - inner / 8 * np.sin(2 * PI / inner), rel=1e-12)


def test_the_cylinder_stands_where_schaefer_and_turek_put_it():
    mesh = meshes.cylinder_in_channel(0.01)
    assert {name: mesh.boundary_area(name) for name in ("inflow", "outflow", "walls")} == pytest.approx(
        {"inflow": 0.41, "outflow": 0.41, "walls": 4.4}, rel=1e-12)
    on = np.unique(mesh.facets[mesh.boundary == mesh.boundary_names.index("cylinder")])
    assert np.hypot(*(mesh.nodes[on] - [0.2, 0.2]).T) == pytest.approx(0.05, rel=1e-12)


def test_elements_grow_away_from_the_cylinder_up_to_the_ratio():
    for size, ratio in ((0.01, 1), (0.005, 4), (0.005, 8)):
        mesh = meshes.cylinder_in_channel(size, ratio=ratio)
        edge = 2 * np.sqrt(volumes(mesh) / np.sqrt(3))  # of the equilateral triangle
        far = mesh.nodes[mesh.elements].mean(axis=1)[:, 0] > 1
        assert np.median(edge[far]) == pytest.approx(ratio * size, rel=0.15)
        near = np.hypot(*(mesh.nodes[mesh.elements].mean(axis=1) - [0.2, 0.2]).T) < 0.05 + size
        assert np.median(edge[near]) == pytest.approx(size, rel=0.2)


def test_free_elements_are_as_long_as_asked():
    for mesh, size in ((meshes.box((1, 1), size=0.05), 0.05), (meshes.annulus(1, 2, 0.1), 0.1), (meshes.box((1, 1, 1), size=0.2), 0.2)):
        x = mesh.nodes[mesh.elements]
        longest = max(np.linalg.norm(x[:, a] - x[:, b], axis=1).max() for a in range(mesh.dim + 1) for b in range(a))
        assert 0.8 * size < longest < 2.0 * size


def test_the_same_call_gives_the_same_mesh():
    for make in ALL.values():
        one, two = make(), make()
        assert np.array_equal(one.nodes, two.nodes) and np.array_equal(one.elements, two.elements)


def test_arrays_outlive_their_mesh_and_writing_to_them_does_not_change_it():
    mesh = meshes.box((1, 1), (2, 2))
    nodes = mesh.nodes
    nodes[:] = 7
    assert mesh.volume == pytest.approx(1) and mesh.nodes.max() == 1
    del mesh
    assert nodes.min() == 7
    mesh = meshes.box((1, 1, 1), (2, 2, 2))
    arrays = {"nodes": (27, 3), "elements": (48, 4), "region": (48,), "facets": (48, 3), "facet_elements": (48, 2), "boundary": (48,), "master": (27,)}
    assert {name: getattr(mesh, name).shape for name in arrays} == arrays
    assert all(getattr(mesh, name).flags.owndata for name in arrays)
    assert meshes.box((1, 1), (2, 2), periodic=(1, 1)).facets.shape == (0, 2)


def test_a_mesh_describes_itself():
    mesh = meshes.channel(1, 0.5, 0.25, periodic=True)
    assert repr(mesh) == ("Mesh2D: 15 nodes (3 of them periodic images), 16 elements; regions 'domain'; boundaries 'walls' (8 facets)")
    assert mesh.dim == 2 and type(mesh).dim == 2


@pytest.mark.parametrize("call, message", [
    (lambda: meshes.box((1,), (1,)), "box: lengths must have 2 or 3 entries, got 1"),
    (lambda: meshes.box((1, 1)), r"box: give counts \(a grid\) or size \(unstructured\), one of them"),
    (lambda: meshes.box((1, 1), (2, 2), size=0.1), "box: give counts"),
    (lambda: meshes.box((1, 1), (2, 2, 2)), "box: counts must have an entry per axis, 2, got 3"),
    (lambda: meshes.box((1, 1), (2, 2), periodic=(True,)), "box: periodic must have an entry per axis, 2, got 1"),
    (lambda: meshes.box((1, 1), (2, 2), origin=(0, 0, 0)), "box: origin must have an entry per axis, 2, got 3"),
    (lambda: meshes.box((1, 1), (2, 2), origin=(0, np.nan)), r"box: origin must be finite, got \(0, nan\) m"),
    (lambda: meshes.box((1, -1), (2, 2)), "box: the length of axis 1 must be > 0 m, got -1 m"),
    (lambda: meshes.box((1, np.inf), size=1), "box: the length of axis 1 must be > 0 m, got inf m"),
    (lambda: meshes.box((1, 1), (2, 0)), "box: counts must be >= 1, got 0 along axis 1"),
    (lambda: meshes.box((1, 1), (2**30, 2**30)), r"box: counts of 1073741824 x 1073741824 would make 2.3e\+18 elements"),
    (lambda: meshes.box((1, 1), size=0), "box: size must be > 0 m, got 0 m"),
    (lambda: meshes.box((1, 1), size=1e-9), r"box: size 1e-09 m would make 2.0e\+18 elements, more than 1e\+08; choose a larger one"),
    (lambda: meshes.box((1, 3), size=0.6, periodic=(True, False)), r"box: size must be <= 0.5 m \(the shortest side, half of a periodic one\), got 0.6 m"),
    (lambda: meshes.box((1, 3), (1, 3), periodic=(True, False)), "box: the period of 1 m is too short"),
    (lambda: meshes.channel(1, 1, np.nan), "channel: size must be > 0 m, got nan m"),
    (lambda: meshes.channel(1, 0, 0.1), "channel: height must be > 0 m, got 0 m"),
    (lambda: meshes.channel(1, 1, 0.6, periodic=True), "channel: size must be <= 0.5 m"),
    (lambda: meshes.annulus(1, 1, 0.1), "annulus: inner must be < outer, got 1 m and 1 m"),
    (lambda: meshes.annulus(0, 1, 0.1), "annulus: inner must be > 0 m, got 0 m"),
    (lambda: meshes.annulus(1, 1.1, 0.2), "annulus: size must be <= 0.1 m"),
    (lambda: meshes.pipe(1, 1, 2), "pipe: size must be <= 1 m"),
    (lambda: meshes.pipe(-1, 1, 2), "pipe: radius must be > 0 m, got -1 m"),
    (lambda: meshes.cylinder_in_channel(0.03), r"cylinder_in_channel: size must be <= 0.025 m \(a quarter of the diameter\)"),
    (lambda: meshes.cylinder_in_channel(0.01, ratio=0.5), "cylinder_in_channel: ratio must be >= 1, got 0.5"),
    (lambda: meshes.cylinder_in_channel(0.01, centre=(0.2, 0.05)),
     r"cylinder_in_channel: between cylinder and walls must be >= 0.01 m, one element, got 0 m \(centre \(0.2, 0.05\) m, diameter 0.1 m\)"),
])
def test_nonsense_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
