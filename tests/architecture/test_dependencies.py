"""Who may know whom, and what a dry script loads."""

import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
ALLOWED = {"meshes": {"meshes"}, "grains": {"grains"}, "fluid": {"fluid", "meshes"},
           "coupling": {"coupling", "fluid", "meshes", "grains"}}  # of our own folders
HEAVY = re.compile(r"petsc|mpi|gmsh", re.IGNORECASE)

LIST_LIBRARIES = """
{extra}
import numpy as np
from quicksand import grains
sim = grains.Simulation(dim=2)
sim.set_friction("grain", "grain", 0.4)
sim.add(np.array([[0.0, 0.0]]), 1e-3)
sim.step(1e-3)
print(open("/proc/self/maps").read())
"""


def libraries(extra=""):
    """Names of the libraries that the process of a dry script has mapped."""
    maps = subprocess.run([sys.executable, "-c", LIST_LIBRARIES.format(extra=extra)], check=True, capture_output=True,
                          text=True).stdout
    return {pathlib.Path(path).name for path in re.findall(r"(/\S+\.so\S*)", maps)}


@pytest.mark.parametrize("folder", [f for f in ALLOWED if (ROOT / f).is_dir()])
def test_a_folder_includes_only_what_it_may_know(folder):
    sources = [*(ROOT / folder).rglob("*.hpp"), *(ROOT / folder).rglob("*.cpp")]
    assert sources
    for source in sources:
        for included in re.findall(r'#include\s*[<"]([^">]+)[">]', source.read_text()):
            path = pathlib.PurePosixPath(included)
            if len(path.parts) > 1 and path.parts[0] in ALLOWED:
                assert path.parts[0] in ALLOWED[folder], f"{source} includes {included}"
            assert ".." not in path.parts, f"{source} includes {included}"


def test_a_dry_script_maps_no_petsc_mpi_or_gmsh():
    loaded = libraries()
    assert any("_grains" in name for name in loaded)
    assert not [name for name in loaded if HEAVY.search(name)]


def test_the_list_of_libraries_notices_mpi():
    assert [name for name in libraries("import mpi4py; mpi4py.rc.initialize = False; from mpi4py import MPI") if HEAVY.search(name)]
