"""Every defect of a file or a script is a ValueError that says what, where, and what to do. (Those of a mesh in itself: test_assemble.cpp.)"""

import re

import pytest

from quicksand import meshes

SQUARE = """lc = 0.3;
Point(1) = {0, 0, 0, lc}; Point(2) = {1, 0, 0, lc}; Point(3) = {1, 1, 0, lc}; Point(4) = {0, 1, 0, lc};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Physical Surface("water") = {1};
Physical Curve("plates") = {1, 3};
"""
SIDES = 'Physical Curve("sides") = {2, 4};\n'
BOX = 'SetFactory("OpenCASCADE");\nBox(1) = {0, 0, 0, 1, 1, 1};\nMesh.MeshSizeMax = 0.5;\n'

SCRIPTS = [
    (SQUARE, r"8 of 16 boundary facets are in no physical group, the first at \(0, 0.125\) m: name every part of the boundary; .* \(gmsh: Physical Curve"),
    (BOX, r".* boundary facets are in no physical group, the first at .*Physical Surface\("),
    (SQUARE + SIDES + 'Physical Curve("lid") = {3};\n', "curve 3 is in 2 physical groups, 'lid', 'plates': a facet has one boundary condition"),
    (SQUARE + SIDES + 'Physical Surface("oil") = {1};\n', "surface 1 is in 2 physical groups, 'oil', 'water': an element has one region"),
    (SQUARE + SIDES + "Mesh.ElementOrder = 2;\n", r"elements of order 2 \('Triangle 6', \d+ of them, the first is \d+\); only straight ones are known: set Mesh.ElementOrder = 1"),
    (SQUARE + SIDES + "Recombine Surface {1};\n", r"surface 1 is meshed with 'Quadrilateral 4' elements \(\d+, the first is \d+\); only simplices"),
    ((SQUARE + SIDES).replace("0, lc", "0.5, lc"), r"a mesh in 2D lies in the plane z = 0 m, the node at \(.*, 0.5\) m does not"),
    (SQUARE + "Periodic Curve {2} = {4} Rotate {{0, 0, 1}, {0.5, 0.5, 0}, Pi};\n", "curve 2 is a turned or mirrored image of curve 4; a period must be a translation"),
    (SQUARE + "Periodic Curve {2} = {4};\n", r"periodic sides do not match: the image of the node at .* m away \(period 1 m\); in a script, sides that run against each other need a minus"),
    ("Point(1) = {0, 0, 0};\n", "there is no triangle in this mesh"),
    ("Point(1) = {0, 0, 0;\n", "gmsh says: .*syntax error"),
    ("Line(1) = {1, 2};\n", "gmsh says: Unknown control point 1"),
    ('Merge "nothing.msh";\n', "gmsh says: Unable to open file"),
    ((SQUARE + SIDES)[:-1], "the last line has no newline at its end, and gmsh would leave it out: add one"),
]


@pytest.mark.parametrize("script, message", SCRIPTS)
def test_a_script_with_a_defect_is_an_error_and_the_next_one_is_read(script, message, tmp_path):
    path = tmp_path / "script.geo"
    path.write_text(script)
    with pytest.raises(ValueError, match="^" + re.escape(f"read {path}: ") + message):
        meshes.read(path)
    path.write_text(SQUARE + SIDES)
    assert meshes.read(path).volume == pytest.approx(1)


def msh(nodes, elements, names="", more=""):
    """A .msh 2.2 file; elements are (type, group, entity, nodes...)."""
    node_lines = "\n".join(f"{k + 1} {x} {y} {z}" for k, (x, y, z) in enumerate(nodes))
    element_lines = "\n".join(f"{k + 1} {kind} 2 {group} {entity} {' '.join(map(str, corners))}" for k, (kind, group, entity, *corners) in enumerate(elements))
    names = "\n".join(names)
    return (f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n{len(names.splitlines())}\n{names}\n$EndPhysicalNames\n"
            f"$Nodes\n{len(nodes)}\n{node_lines}\n$EndNodes\n$Elements\n{len(elements)}\n{element_lines}\n$EndElements\n{more}")


CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
LINES = [(1, 2, k, k, k % 4 + 1) for k in (1, 2, 3, 4)]
NAMES = ['1 2 "wall"', '2 1 "water"']
UP, DOWN = [(2, 1, 1, 1, 2, 3), (2, 1, 1, 1, 3, 4)], [(2, 1, 1, 2, 1, 3), (2, 1, 1, 3, 1, 4)]


def test_elements_upside_down_are_turned(tmp_path):
    path = tmp_path / "mesh.msh"
    path.write_text(msh(CORNERS, LINES + DOWN, NAMES))
    mesh = meshes.read(path)
    assert mesh.boundary_names == ["wall"] and mesh.boundary_area("wall") == pytest.approx(4)
    assert mesh.volume == pytest.approx(1)


FILES = [
    ("hello\n", "gmsh says: .*syntax error"),
    ("", "gmsh says: Could not merge file"),
    (msh(CORNERS, LINES + UP, NAMES)[:-40], "gmsh says: Error loading"),
    (msh(CORNERS, LINES + [(2, 1, 1, 1, 2, 9)], NAMES), "gmsh says: Wrong node index 9"),
    (msh(CORNERS, LINES + [UP[0], DOWN[1]], NAMES), r"surface 1 is folded: 1 of its 2 elements are turned over against the others, the first is element 6 "
                                                    r"at \(0.333333, 0.666667\) m"),
    (msh(CORNERS[:3] + [(0.5, 0.5 + 1e-14, 0)], LINES + UP, NAMES), r"element 6 of surface 1 at \(0.5, 0.5\) m is flat: its volume is \S+ m\^2, its longest edge 1.41 m"),
    (msh(CORNERS, LINES, NAMES), "there is no triangle in this mesh"),
    (msh(CORNERS, LINES + UP, NAMES, "$Periodic\n1\n1 2 4\n2\n2 1\n"), r"its \$Periodic section ends in the middle, at entry 1 of 1"),
    (msh(CORNERS, LINES + UP, NAMES, "$Periodic\n1\n1 2 4\n2\n2 1\n3 7\n$EndPeriodic\n"), "node 7 is used and not defined"),
    (msh(CORNERS, LINES + [(2, 1, 1, 1, 2, 3), (2, 3, 1, 1, 3, 4)], NAMES + ['2 3 "oil"']), "surface 1 is in 2 physical groups, 'oil', 'water'"),
    (msh(CORNERS, LINES + [(3, 1, 1, 1, 2, 3, 4)], NAMES), "surface 1 is meshed with 'Quadrilateral 4' elements"),
    (msh(CORNERS + [(0, 0, 1)], [(2, 2, 1, 1, 2, 3), (6, 1, 1, 1, 2, 3, 4, 5, 1)], NAMES[:0]), "volume 1 is meshed with 'Prism 6' elements"),
]


@pytest.mark.parametrize("text, message", FILES)
def test_a_file_with_a_defect_is_an_error(text, message, tmp_path):
    path = tmp_path / "mesh.msh"
    path.write_text(text)
    with pytest.raises(ValueError, match="^" + re.escape(f"read {path}: ") + message):
        meshes.read(path)


def periodic_square(shift=0.0, affine=True):
    """Four triangles; the right side is an image of the left one, its middle node moved by `shift`."""
    nodes = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0.5, 0), (1, 0.5 + shift, 0), (0.5, 0, 0), (0.5, 1, 0), (0.5, 0.5, 0)]
    lines = [(1, 2, 1, 1, 7), (1, 2, 1, 7, 2), (1, 2, 3, 3, 8), (1, 2, 3, 8, 4), (1, 3, 2, 2, 6), (1, 3, 2, 6, 3), (1, 3, 4, 4, 5), (1, 3, 4, 5, 1)]
    ring = [1, 7, 2, 6, 3, 8, 4, 5]
    triangles = [(2, 1, 1, 9, ring[k], ring[(k + 1) % 8]) for k in range(8)]
    matrix = "Affine 1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1\n" if affine else ""
    return msh(nodes, lines + triangles, NAMES + ['1 3 "side"'], f"$Periodic\n1\n1 2 4\n{matrix}3\n2 1\n3 4\n6 5\n$EndPeriodic\n")


@pytest.mark.parametrize("affine", [True, False])
def test_two_cells_across_a_period_join_and_a_node_out_of_its_place_is_an_error(affine, tmp_path):
    path = tmp_path / "mesh.msh"
    path.write_text(periodic_square(affine=affine))
    mesh = meshes.read(path)
    assert list(mesh.master) == [0, 0, 3, 3, 4, 4, 6, 7, 8]
    side = mesh.boundary == mesh.boundary_names.index("side")
    assert side.sum() == 4 and (mesh.facet_elements[side] >= 0).all()
    path.write_text(periodic_square(1e-4, affine))
    with pytest.raises(ValueError, match="periodic sides do not match: the image of the node at .* m away"):
        meshes.read(path)


def test_a_period_of_one_cell_is_too_short(tmp_path):
    path = tmp_path / "script.geo"
    path.write_text(SQUARE.replace("0.3", "3") + "Periodic Curve {2} = {4} Translate {1, 0, 0};\n")
    with pytest.raises(ValueError, match="the period of 1 m is too short: the element at .* m, 1 m long, touches its own image"):
        meshes.read(path)


def test_a_name_without_a_group_lists_the_names_there_are():
    with pytest.raises(ValueError, match="boundary_area: no boundary is named 'lid': this mesh has 'left', 'right', 'bottom', 'top'"):
        meshes.box((1, 1), (2, 2)).boundary_area("lid")


def test_the_name_of_a_file_must_say_what_it_is(tmp_path):
    with pytest.raises(ValueError, match=r"the name must end in .msh \(a mesh\) or .geo \(a script that gmsh meshes\), got '.step'"):
        meshes.read("part.step")
    with pytest.raises(ValueError, match="read: dim must be 2, 3 or None"):
        meshes.read("part.msh", dim=1)
