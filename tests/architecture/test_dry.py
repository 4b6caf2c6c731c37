"""-DFLUID=OFF: what a dry build looks for, compiles, loads and installs has nothing of PETSc, MPI, gmsh and METIS."""

import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
HEAVY = re.compile(r"petsc|openmpi|libmpi|-lmpi|\bmpi|gmsh|metis", re.IGNORECASE)  # not "compiler", not "OpenMP"


def run(*command, env=None, code=0):
    done = subprocess.run([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, env=env)
    assert done.returncode == code, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dry")
    # Without optimisation and tests, which change nothing of what is looked for here.
    run("cmake", "-S", ROOT, "--preset", "dry", "-B", folder, f"-DPython_EXECUTABLE={sys.executable}", f"-DPYTHON_EXECUTABLE={sys.executable}",
        "-DCMAKE_CXX_FLAGS_RELEASE=-O0", "-DQUICKSAND_NATIVE=OFF", "-DQUICKSAND_TESTS=OFF")
    return folder


def heavy_lines(text):
    """Comments of a CMake cache left out."""
    return [line for line in text.replace(str(ROOT), "").splitlines() if HEAVY.search(line) and not line.startswith("//")]


def test_the_check_notices_what_the_full_build_uses():
    import quicksand
    assert heavy_lines((pathlib.Path(quicksand.__file__).parents[2] / "CMakeCache.txt").read_text())
    assert heavy_lines("-L/usr/lib/x86_64-linux-gnu/openmpi") and heavy_lines("-lmpi") and not heavy_lines("COMPILER OpenMP")


def test_a_dry_build_looks_for_and_compiles_nothing_heavy(build):
    assert not heavy_lines((build / "CMakeCache.txt").read_text().replace(str(build), ""))
    commands = run("ninja", "-C", build, "-t", "commands").replace(str(build), "")
    assert "grains/python.cpp" in commands
    assert not heavy_lines(commands) and "meshes/" not in commands.replace(str(ROOT), "")


def test_a_dry_build_runs_without_anything_heavy_and_installs_the_grains_only(build, tmp_path):
    run("cmake", "--build", build)
    maps = run(sys.executable, "-c", f"""
import sys
sys.path.insert(0, {str(build / "python")!r})
from quicksand import grains
assert grains.__file__.startswith({str(build)!r})
sim = grains.Simulation(dim=2)
print(open("/proc/self/maps").read())
try:
    from quicksand import meshes
except ImportError:
    print("no meshes")
""", env={})
    assert "no meshes" in maps and not heavy_lines(maps)
    run("cmake", "--install", build, "--prefix", tmp_path / "prefix")
    assert not [file for file in (tmp_path / "prefix").rglob("*") if "meshes" in file.name.lower()]

    (tmp_path / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.25)\nproject(a LANGUAGES CXX)\n"
                                             "find_package(quicksand REQUIRED COMPONENTS ${part})\n")
    configure = "cmake", "-G", "Ninja", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={tmp_path / 'prefix'}"
    run(*configure, "-Dpart=grains")
    assert "quicksand::meshes was not built" in " ".join(run(*configure, "-Dpart=meshes", code=1).split())
