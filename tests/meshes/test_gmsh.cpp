// Our side of gmsh from C++, so that the sanitizers see it too.
#include "meshes/gmsh.hpp"
#include "meshes/shapes.hpp"

#include <gtest/gtest.h>

#include <fstream>
#include <numbers>

using namespace quicksand::meshes;

namespace {

std::filesystem::path write(const char* name, const std::string& text) {
  const auto path = std::filesystem::path(testing::TempDir()) / name;
  std::ofstream(path) << text;
  return path;
}

const std::string square = R"(
Point(1) = {0, 0, 0, 0.2}; Point(2) = {1, 0, 0, 0.2}; Point(3) = {1, 1, 0, 0.2}; Point(4) = {0, 1, 0, 0.2};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Physical Curve("plates") = {1, 3};
Periodic Curve {2} = {4} Translate {1, 0, 0};
)";

}  // namespace

TEST(Meshes, a_script_is_read_from_cpp_with_the_dimension_it_has) {
  const auto path = write("quicksand_square.geo", square);
  for (int again = 0; again < 2; ++again) {
    const auto mesh = std::get<Mesh<2>>(read_mesh(path));
    EXPECT_NEAR(volume(mesh), 1.0, 1e-12);
    EXPECT_NEAR(boundary_area(mesh, "plates"), 2.0, 1e-12);
  }
  EXPECT_THROW(read_mesh<3>(path), std::invalid_argument);
  EXPECT_THROW(current_model(), std::invalid_argument);  // none is left alive
  std::filesystem::remove(path);
  EXPECT_THROW(read_mesh(path), std::filesystem::filesystem_error);
}

TEST(Meshes, gmsh_works_on_after_a_script_with_an_error) {
  const auto path = write("quicksand_error.geo", "Line(1) = {1, 2};\n");
  EXPECT_THROW(read_mesh(path), std::invalid_argument);
  std::filesystem::remove(path);
  EXPECT_NEAR(volume(pipe(1.0, 2.0, 0.5)), 2 * std::numbers::pi, 0.4);
  EXPECT_NEAR(volume(box<3>({.lengths = {1, 1, 1}, .periodic = {true, true, true}}, 0.4)), 1.0, 1e-12);
  EXPECT_NEAR(volume(cylinder_in_channel(0.02)), 2.2 * 0.41 - std::numbers::pi * 0.0025, 1e-3);
}
