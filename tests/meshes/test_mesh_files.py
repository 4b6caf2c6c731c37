"""Meshes from .msh files, .geo scripts and models of a gmsh that is alive in the same process."""

import os
import pathlib
import subprocess
import sys
import textwrap

import numpy as np
import pytest

import quicksand
from quicksand import meshes

SQUARE = """lc = 0.2;
Point(1) = {0, 0, 0, lc}; Point(2) = {1, 0, 0, lc}; Point(3) = {1, 1, 0, lc}; Point(4) = {0, 1, 0, lc};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Physical Surface("water") = {1};
Physical Curve("plates") = {1, 3};
"""
SIDES = 'Physical Curve("sides") = {2, 4};\n'
PERIODIC = "Periodic Curve {2} = {4} Translate {1, 0, 0};\n"
CUBE = """SetFactory("OpenCASCADE");
Box(1) = {0, 0, 0, 1, 1, 1};
Physical Surface("x") = {1, 2}; Physical Surface("y") = {3, 4}; Physical Surface("z") = {5, 6};
Mesh.MeshSizeMax = 0.4;
"""


@pytest.fixture
def read(tmp_path):
    """Reads a .geo script given as text."""
    def read(text, **kwargs):
        path = tmp_path / "script.geo"
        path.write_text(text)
        return meshes.read(path, **kwargs)
    return read


def python(code, folder):
    """Runs a script in a process of its own: a gmsh that is alive stays there. Returns what it prints, on both channels."""
    package = str(pathlib.Path(quicksand.__file__).parents[1])  # PYTHONPATH may be relative to another folder
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], cwd=folder, env={**os.environ, "PYTHONPATH": package}, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    return done.stdout


def same(a, b, rel=0.0):
    assert a.boundary_names == b.boundary_names and a.region_names == b.region_names
    for name in ("elements", "region", "facets", "facet_elements", "boundary", "master"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert a.nodes == pytest.approx(b.nodes, abs=rel)


def test_a_script_is_meshed_and_its_physical_groups_are_regions_and_boundaries(read):
    mesh = read(SQUARE + SIDES)
    assert mesh.dim == 2 and mesh.volume == pytest.approx(1)
    assert mesh.region_names == ["water"] and mesh.boundary_names == ["plates", "sides"]
    assert mesh.boundary_area("plates") == pytest.approx(2) == mesh.boundary_area("sides")
    cube = read(CUBE)
    assert cube.dim == 3 and cube.volume == pytest.approx(1)
    assert cube.region_names == ["domain"] and cube.boundary_names == ["x", "y", "z"]
    assert cube.boundary_area("z") == pytest.approx(2)


def test_a_script_that_meshes_itself_is_left_as_it_is(read):
    same(read(SQUARE + SIDES + "Mesh 2;\n"), read(SQUARE + SIDES))
    finer = read(SQUARE + SIDES + "Mesh 2;\nRefineMesh;\n")
    assert len(finer.elements) == 4 * len(read(SQUARE + SIDES).elements)


def test_a_group_without_a_name_goes_by_its_number(read):
    assert read(SQUARE + "Physical Curve(7) = {2, 4};\n").boundary_names == ["plates", "7"]


WRITE = """
    import gmsh
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.open("script.geo")
    gmsh.model.mesh.generate({dim})
    for version, name in ((2.2, "old.msh"), (4.1, "new.msh")):
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(name)
    gmsh.option.setNumber("Mesh.Binary", 1)
    gmsh.write("binary.msh")
"""


@pytest.mark.parametrize("script, dim", [(SQUARE + SIDES, 2), (SQUARE + SIDES + PERIODIC, 2), (CUBE, 3),
                                         (CUBE + "Periodic Surface {6} = {5} Translate {0, 0, 1};\nPeriodic Surface {2} = {1} Translate {1, 0, 0};\n", 3)])
def test_both_versions_of_a_file_the_script_and_the_live_model_give_the_same_mesh(script, dim, tmp_path):
    if dim == 3:
        script += 'Physical Volume("water") = {1};\n'  # or files would hold the named surfaces only
    (tmp_path / "script.geo").write_text(script)
    printed = python(WRITE.format(dim=dim) + """
    from quicksand import meshes
    mesh = meshes.current_model()
    print(mesh, len(mesh.facets), round(mesh.volume, 12))
    """, tmp_path)
    mesh = meshes.read(tmp_path / "new.msh")
    assert mesh.dim == dim and mesh.volume == pytest.approx(1)
    assert (mesh.master != np.arange(len(mesh.nodes))).any() == ("Periodic" in script)
    for name in ("old.msh", "binary.msh", "script.geo"):
        same(meshes.read(tmp_path / name), mesh, 1e-15)
    assert printed == f"{mesh} {len(mesh.facets)} {round(mesh.volume, 12)}\n"


def test_periodic_sides_without_a_name_are_in_a_file_of_version_4_and_missed_in_one_of_version_2(tmp_path):
    (tmp_path / "script.geo").write_text(SQUARE + PERIODIC)
    python(WRITE.format(dim=2), tmp_path)
    same(meshes.read(tmp_path / "new.msh"), meshes.read(tmp_path / "script.geo"), 1e-15)
    with pytest.raises(ValueError, match="10 of 20 boundary facets .*; gmsh writes periodic sides to a .msh 2.2 file with a group only, to 4.1 always"):
        meshes.read(tmp_path / "old.msh")


def test_periodic_sides_need_no_name_and_named_ones_know_the_element_across(read):
    mesh = read(SQUARE + PERIODIC)
    assert mesh.boundary_names == ["plates"]
    moved = mesh.nodes - mesh.nodes[mesh.master]
    image = mesh.master != np.arange(len(mesh.nodes))
    assert moved[image] == pytest.approx(np.tile([1.0, 0.0], (image.sum(), 1)), abs=1e-9) and np.all(mesh.nodes[image, 0] == 1)

    mesh = read(SQUARE + SIDES + PERIODIC)
    side = mesh.boundary == mesh.boundary_names.index("sides")
    own, across = mesh.nodes[mesh.elements].mean(axis=1)[mesh.facet_elements[side]].transpose(1, 0, 2)
    x = mesh.nodes[mesh.facets[side]].mean(axis=1)
    assert np.all(np.abs(own[:, 0] - x[:, 0]) < 0.2) and np.all(np.abs(across[:, 0] - (1 - x[:, 0])) < 0.2)
    assert np.all(np.abs(own[:, 1] - across[:, 1]) < 0.2)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_a_cube_is_periodic_in_one_two_and_three_axes_and_corners_have_one_master(read, axes):
    text = CUBE
    for a in range(axes):
        text += f"Periodic Surface {{{2 * a + 2}}} = {{{2 * a + 1}}} Translate {{{a == 0:d}, {a == 1:d}, {a == 2:d}}};\n"
    mesh = read(text)
    masters, counts = np.unique(mesh.master, return_counts=True)
    assert np.array_equal(mesh.master[masters], masters)
    assert np.all(mesh.nodes[masters, :axes] < 1 - 1e-9)
    assert counts.max() == 2**axes  # edges of the cube, and its corner, in one piece
    moved = mesh.nodes - mesh.nodes[mesh.master]
    assert moved == pytest.approx(np.round(moved), abs=1e-9) and not moved[:, axes:].any()


def test_a_named_line_inside_the_mesh_is_kept_with_the_direction_of_the_script(read):
    halves = """lc = 0.2;
        Point(1) = {0, 0, 0, lc}; Point(2) = {1, 0, 0, lc}; Point(3) = {2, 0, 0, lc}; Point(4) = {2, 1, 0, lc}; Point(5) = {1, 1, 0, lc}; Point(6) = {0, 1, 0, lc};
        Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 5}; Line(5) = {5, 6}; Line(6) = {6, 1}; Line(7) = {FROM, TO};
        Curve Loop(1) = {1, SIGN7, 5, 6}; Plane Surface(1) = {1};
        Curve Loop(2) = {2, 3, 4, -SIGN7}; Plane Surface(2) = {2};
        Physical Surface("water") = {1}; Physical Surface("oil") = {2};
        Physical Curve("walls") = {1:6}; Physical Curve("sieve") = {7};
        """.replace("    ", "")
    for start, end, sign, normal in ((2, 5, "", 1), (5, 2, "-", -1)):
        text = halves.replace("FROM", str(start)).replace("TO", str(end)).replace("-SIGN7", "7" if sign else "-7").replace("SIGN7", sign + "7")
        mesh = read(text)
        sieve = mesh.boundary == mesh.boundary_names.index("sieve")
        assert mesh.boundary_area("sieve") == pytest.approx(1) and sieve.sum() == 5
        first, second = mesh.facet_elements[sieve].T
        region = np.array(mesh.region_names)[mesh.region]
        assert set(region[first]) == {"water" if normal > 0 else "oil"} and set(region[second]) == {"oil" if normal > 0 else "water"}
        x = mesh.nodes[mesh.facets[sieve]]
        assert np.all(np.sign((x[:, 1] - x[:, 0])[:, 1]) == normal)  # n_x
        assert not (mesh.facet_elements[~sieve, 1] >= 0).any()
    only = read(text.replace('Physical Surface("oil") = {2};', "").replace('"walls") = {1:6}', '"walls") = {1, 5, 6}'))
    assert only.volume == pytest.approx(1) and only.region_names == ["water"] and only.nodes[:, 0].max() == 1


def test_a_live_session_keeps_its_models_its_options_and_its_log(tmp_path):
    (tmp_path / "script.geo").write_text("NewModel;\n" + SQUARE + SIDES)
    assert python("""
        import gmsh, numpy as np
        from quicksand import meshes
        gmsh.initialize()
        gmsh.option.setNumber("General.Verbosity", 5)
        gmsh.logger.start()
        options = {"General.Terminal": 1, "General.AbortOnError": 2, "Mesh.ElementOrder": 2, "Mesh.MeshSizeMax": 0.01, "Mesh.Algorithm": 5, "Mesh.RecombineAll": 1}
        for name, value in options.items():
            gmsh.option.setNumber(name, value)
        gmsh.model.add("mine")
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.add("other")
        gmsh.model.setCurrent("mine")
        before = gmsh.model.list(), gmsh.model.getEntities()
        free = meshes.box((1, 1), size=0.2)
        script = meshes.read("script.geo")
        for path in "script.geo", "nothing.geo":
            try:
                meshes.read(path, dim=3)
            except (ValueError, FileNotFoundError) as error:
                print(error)
        assert (gmsh.model.list(), gmsh.model.getEntities()) == before and gmsh.model.getCurrent() == "mine"
        assert {name: gmsh.option.getNumber(name) for name in options} == options
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.logger.write("still here")
        assert gmsh.logger.get()[-1].endswith("still here")
        gmsh.finalize()
        again = meshes.box((1, 1), size=0.2)
        assert np.array_equal(free.nodes, again.nodes) and np.array_equal(free.elements, again.elements)
        assert np.array_equal(script.nodes, meshes.read("script.geo").nodes)
        """, tmp_path).replace("Error   : Gmsh has not been initialized\n", "") == (
            "read script.geo: this is a mesh in 2D, not in 3D\n[Errno 2] No such file or directory: 'nothing.geo'\n")


def test_gmsh_is_not_left_alive_and_prints_nothing(tmp_path):
    (tmp_path / "script.geo").write_text(SQUARE + SIDES)
    assert python("""
        import gmsh
        from quicksand import meshes
        for _ in range(3):
            meshes.read("script.geo")
            meshes.box((1, 1), size=0.2)
        try:
            meshes.current_model()
        except ValueError as error:
            print(error)
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        print(gmsh.model.list(), gmsh.option.getNumber("General.Verbosity"))
        try:
            meshes.current_model()
        except ValueError as error:
            print(error)
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(1, [1, 2, 3, 4])
        gmsh.model.mesh.generate(2)
        print(meshes.current_model(dim=2).volume)
        try:
            meshes.current_model(dim=3)
        except ValueError as error:
            print(error)
        """, tmp_path).splitlines() == [
            "current_model: no gmsh is alive in this process: call gmsh.initialize() and make a model first. In Python that must be the `gmsh` that "
            "loads the system's libgmsh (Debian: python3-gmsh), not one that brings its own",
            "[''] 5.0", "current_model: the model '' has no elements: call gmsh.model.mesh.generate first", "1.0",
            "current_model: this is a mesh in 2D, not in 3D"]


def test_importing_meshes_loads_neither_petsc_nor_mpi(tmp_path):
    maps = python("from quicksand import meshes; print(open('/proc/self/maps').read())", tmp_path).lower()
    assert "libgmsh" in maps and "libmpi" not in maps and "petsc" not in maps


def test_paths_may_be_strings_and_a_missing_file_is_named(tmp_path):
    (tmp_path / "a.geo").write_text(SQUARE + SIDES)
    same(meshes.read(str(tmp_path / "a.geo")), meshes.read(tmp_path / "a.geo"))
    with pytest.raises(FileNotFoundError) as caught:
        meshes.read(tmp_path / "nothing.msh")
    assert pathlib.Path(caught.value.filename) == tmp_path / "nothing.msh"
    (tmp_path / "folder.msh").mkdir()
    with pytest.raises(IsADirectoryError):
        meshes.read(tmp_path / "folder.msh")
