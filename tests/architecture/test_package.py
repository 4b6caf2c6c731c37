"""Quicksand installed: a C++ program that knows the prefix only, and one version number everywhere."""

import pathlib
import re
import subprocess

import pytest

import quicksand

ROOT = pathlib.Path(__file__).parents[2]
BUILD = pathlib.Path(quicksand.__file__).parents[2]


def run(*command):
    done = subprocess.run([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """Moved after the install: a package may not know where it was installed first."""
    folder = tmp_path_factory.mktemp("package")
    run("cmake", "--install", BUILD, "--prefix", folder / "first")
    return (folder / "first").rename(folder / "moved")


def test_the_package_names_no_folder_of_this_machine(prefix):
    files = list(prefix.rglob("*.cmake"))
    assert len(files) >= 4
    for file in files:
        assert not [place for place in (ROOT, BUILD, prefix.parent) if str(place) in file.read_text()], file


def test_the_floor_of_the_cpp_example_carries_the_weight(prefix, tmp_path):
    # The example is built without -march=native, unlike the library of the release preset: what both see has to lie in the
    # same places all the same.
    for file in (ROOT / "examples" / "cpp").iterdir():
        (tmp_path / file.name).write_text(file.read_text())
    run("cmake", "-G", "Ninja", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={prefix}",
        "-DCMAKE_CXX_FLAGS=-Wall -Wextra -Werror")
    run("cmake", "--build", tmp_path / "build")
    printed = run(tmp_path / "build" / "column")
    numbers = re.fullmatch(r"run-out (\S+) widths, coordination (\S+), largest overlap (\S+) d\n"
                           r"floor carries (\S+) of the weight, error of its impulse (\S+), (\d+) sub-steps unconverged\n", printed)
    assert numbers, printed
    run_out, coordination, overlap, carried, error, unconverged = map(float, numbers.groups())
    assert 0.5 < run_out < 4       # collapsed, and not run off the rough floor, five widths long
    assert 2 < coordination < 4    # of a heap at rest: some discs rattle, isostatic are 3 with friction and 4 without
    assert 0 < overlap < 0.01 and unconverged < 10  # of some 2000; 0 when this was written
    assert carried == pytest.approx(1, abs=0.01)  # at rest but for what half a second of settling leaves
    assert abs(error) < 1e-9                      # rounding, summed over 1200 steps


def test_a_program_may_use_the_meshes_and_one_that_does_not_needs_no_gmsh(prefix, tmp_path):
    (tmp_path / "area.cpp").write_text("""
        #include <quicksand/meshes/partition.hpp>
        #include <quicksand/meshes/shapes.hpp>
        #include <cstdio>
        int main() {
          const auto mesh = quicksand::meshes::annulus(1.0, 2.0, 0.1);
          std::printf("%.2f %zu\\n", volume(mesh), partition(mesh, 3).size() / mesh.elements.size());
        }""")
    (tmp_path / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.25)\nproject(area LANGUAGES CXX)\n"
                                             "find_package(quicksand REQUIRED COMPONENTS meshes)\n"
                                             "add_executable(area area.cpp)\ntarget_link_libraries(area quicksand::meshes)\n")
    configure = "cmake", "-G", "Ninja", "-S", tmp_path, f"-DCMAKE_PREFIX_PATH={prefix}"
    run(*configure, "-B", tmp_path / "build")
    run("cmake", "--build", tmp_path / "build")
    assert run(tmp_path / "build" / "area") == "9.42 1\n"  # 3 pi

    (tmp_path / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.25)\nproject(dry LANGUAGES CXX)\nfind_package(quicksand REQUIRED)\n"
                                             "if(TARGET quicksand::meshes OR NOT TARGET quicksand::grains)\n  message(FATAL_ERROR no)\nendif()\n")
    run(*configure, "-B", tmp_path / "dry", "-DCMAKE_DISABLE_FIND_PACKAGE_gmsh=ON")


def test_a_program_may_solve_a_flow_with_grains(prefix, tmp_path):
    (tmp_path / "flow.cpp").write_text("""
        #include <quicksand/coupling/coupling.hpp>
        #include <quicksand/meshes/shapes.hpp>
        #include <cstdio>
        using namespace quicksand::fluid;
        int main() {
          Fluid<2> flow(std::make_shared<Mesh<2>>(quicksand::meshes::channel(2.0, 1.0, 0.25, true)), 2, {1.0, 0.5, {12.0, 0.0}});
          flow.set_wall("walls", {});
          flow.solve_steady();
          std::printf("%.6f\\n", flow.probe(std::array{Vec<2>(1.0, 0.5)})[0].velocity[0]);
          quicksand::Simulation<2> grains(Vec<2>(2.0, 0.0));
          grains.set_friction("grain", "grain", 0.3);
          grains.add(std::array{Vec<2>(0.0, 0.5)}, std::array{0.01}, 2.0, {}, {}, "grain");
          quicksand::coupling::Settings settings;
          settings.kernel_radius = 0.1, settings.drag = quicksand::coupling::of_each(quicksand::coupling::di_felice);
          quicksand::coupling::Coupling<2> both(grains, flow, settings);
          for (int k = 0; k < 5; ++k) both.step(1.0);
          std::printf("%d\\n", both.drag_force()[0][0] != 0.0);
        }""")
    (tmp_path / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.25)\nproject(flow LANGUAGES CXX)\nset(CMAKE_CXX_STANDARD 20)\n"
                                             "find_package(quicksand REQUIRED COMPONENTS coupling)\n"
                                             "add_executable(flow flow.cpp)\ntarget_link_libraries(flow quicksand::coupling)\n")
    run("cmake", "-G", "Ninja", "-S", tmp_path, f"-DCMAKE_PREFIX_PATH={prefix}", "-B", tmp_path / "build")
    run("cmake", "--build", tmp_path / "build")
    assert run(tmp_path / "build" / "flow") == "3.000000\n1\n"  # rho g h^2 / (8 eta)


def test_one_version_everywhere():
    version, = re.findall(r"project\(quicksand VERSION (\S+)", (ROOT / "CMakeLists.txt").read_text())
    assert re.search(rf"^version: {re.escape(version)}$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert re.search(rf"^## \[{re.escape(version)}\]", (ROOT / "CHANGELOG.md").read_text(), re.M)
