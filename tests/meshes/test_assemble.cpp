// What is said of a mesh whoever made it: no gmsh in here, so that the sanitizers see our own code only.
#include "meshes/assemble.hpp"
#include "meshes/partition.hpp"
#include "meshes/shapes.hpp"

#include <Eigen/Geometry>
#include <gtest/gtest.h>

#include <functional>
#include <map>
#include <numeric>
#include <set>

using namespace quicksand::meshes;
using testing::IsSubstring;

namespace {

std::string error_of(const std::function<void()>& call) {
  try {
    call();
  } catch (const std::invalid_argument& e) {
    return e.what();
  }
  return "no error";
}

// The unit square as two triangles; sides 1 to 4 are bottom, right, top, left.
Parts<2> square() {
  Parts<2> parts;
  parts.nodes = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  parts.bodies = {{.tag = 7, .groups = {}, .simplices = {{0, 1, 2}, {0, 2, 3}}, .numbers = {11, 12}}};
  for (int k = 0; k < 4; ++k)
    parts.sides.push_back({.tag = k + 1, .groups = {k % 2 ? "side" : "plate"}, .simplices = {{k, (k + 1) % 4}}, .numbers = {std::size_t(k + 1)}});
  return parts;
}

std::string error_of(const Parts<2>& parts) {
  return error_of([&] { assemble(parts, "read it"); });
}

template <int dim>
Box<dim> unit_box(std::array<bool, dim> periodic) {
  return {.lengths = Vec<dim>::Ones(), .origin = Vec<dim>::Constant(-0.3), .periodic = periodic};
}

// Largest component of the sum of area normals over the boundary; for facets inside the domain they are the user's choice.
template <int dim>
double closure(const Mesh<dim>& mesh) {
  Vec<dim> sum = Vec<dim>::Zero();
  for (std::size_t k = 0; k < mesh.facets.size(); ++k)
    if (mesh.facet_elements[k][1] < 0) sum += area_normal(mesh, mesh.facets[k]);
  return sum.template lpNorm<Eigen::Infinity>();
}

// Facets between parts, across periods too. Only of meshes in which no two facets have the same masters.
int cut(const Mesh<2>& mesh, const std::vector<int>& part) {
  std::map<std::array<int, 2>, int> first;
  int between = 0;
  for (std::size_t e = 0; e < mesh.elements.size(); ++e)
    for (int corner = 0; corner < 3; ++corner) {
      auto key = outward_facet<2>(mesh.elements[e], corner);
      for (int& node : key) node = mesh.master[node];
      std::sort(key.begin(), key.end());
      const auto [known, is_new] = first.emplace(key, part[e]);
      between += !is_new && known->second != part[e];
    }
  return between;
}

}  // namespace

TEST(Meshes, a_named_square_keeps_its_names_and_its_normals_point_out) {
  const auto mesh = assemble(square(), "test");
  EXPECT_DOUBLE_EQ(volume(mesh), 1.0);
  EXPECT_EQ(mesh.boundary_names, (std::vector<std::string>{"plate", "side"}));
  EXPECT_EQ(mesh.region_names, std::vector<std::string>{"domain"});
  EXPECT_DOUBLE_EQ(boundary_area(mesh, "plate"), 2.0);
  EXPECT_EQ(closure(mesh), 0.0);
  for (std::size_t k = 0; k < mesh.facets.size(); ++k) {
    const Vec<2> x = (mesh.nodes[mesh.facets[k][0]] + mesh.nodes[mesh.facets[k][1]]) / 2 - Vec<2>(0.5, 0.5);
    EXPECT_GT(x.dot(area_normal(mesh, mesh.facets[k])), 0.0);
  }
}

TEST(Meshes, a_body_that_lies_upside_down_is_turned_and_one_that_is_folded_is_an_error) {
  auto parts = square();
  for (auto& triangle : parts.bodies[0].simplices) std::swap(triangle[0], triangle[1]);
  const auto mesh = assemble(parts, "test");
  for (const auto& element : mesh.elements) EXPECT_GT(volume(mesh, element), 0.0);
  EXPECT_EQ(closure(mesh), 0.0);
  std::swap(parts.bodies[0].simplices[1][0], parts.bodies[0].simplices[1][1]);
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: surface 7 is folded: 1 of its 2 elements are turned over against the others, the first is "
                                         "element 11 at (0.666667, 0.333333) m", error_of(parts));
}

TEST(Meshes, a_flat_element_is_named) {
  auto parts = square();
  parts.nodes[3] = {0.5, 0.5};
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: element 12 of surface 7 at (0.5, 0.5) m is flat: its volume is 0 m^2, its longest edge 1.41 m", error_of(parts));
  parts.nodes[3].x() = std::nan("");
  EXPECT_PRED_FORMAT2(IsSubstring, "is flat", error_of(parts));
}

TEST(Meshes, elements_that_overlap_are_named) {
  auto parts = square();
  parts.bodies[0].simplices.push_back({0, 1, 2});
  parts.bodies[0].numbers.push_back(13);
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: elements overlap at the facet at (0.5, 0) m: two lie on the same side of it", error_of(parts));
  parts.nodes.push_back({-1, 2});
  parts.bodies[0].simplices.back() = {0, 2, 4};
  EXPECT_PRED_FORMAT2(IsSubstring, "elements overlap at the facet at (0.5, 0.5) m: it belongs to three", error_of(parts));
}

TEST(Meshes, boundary_facets_without_a_group_are_counted_and_the_first_is_placed) {
  auto parts = square();
  parts.sides[1].groups.clear();
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: 1 of 4 boundary facets are in no physical group, the first at (1, 0.5) m: name every part", error_of(parts));
}

TEST(Meshes, a_facet_or_a_body_in_two_groups_is_an_error_unless_both_have_the_same_name) {
  auto parts = square();
  parts.sides[0].groups = {"plate", "plate"};
  EXPECT_DOUBLE_EQ(boundary_area(assemble(parts, "test"), "plate"), 2.0);
  parts.sides[0].groups = {"plate", "floor"};
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: curve 1 is in 2 physical groups, 'floor', 'plate': a facet has one boundary condition", error_of(parts));
  parts.sides[0].groups = {"plate"};
  parts.sides[1].simplices.push_back({1, 0});  // two curves of different groups that hold the same facet
  EXPECT_PRED_FORMAT2(IsSubstring, "the facet at (0.5, 0) m is in two physical groups, 'plate' and 'side'", error_of(parts));
  parts = square();
  parts.bodies[0].groups = {"water", "oil"};
  EXPECT_PRED_FORMAT2(IsSubstring, "surface 7 is in 2 physical groups, 'oil', 'water': an element has one region", error_of(parts));
}

TEST(Meshes, an_interior_side_keeps_the_direction_it_was_given) {
  for (const bool turned : {false, true}) {
    auto parts = square();
    parts.sides.push_back({.tag = 5, .groups = {"sieve"}, .simplices = {{0, 2}}, .numbers = {5}});
    if (turned) parts.sides.back().simplices = {{2, 0}};
    const auto mesh = assemble(parts, "test");
    ASSERT_EQ(mesh.boundary_names.back(), "sieve");
    const auto& elements = mesh.facet_elements.back();
    EXPECT_EQ(elements, (turned ? std::array{0, 1} : std::array{1, 0}));  // the normal is to the right of the way: from (0, 0) to (1, 1) it is
                                                                          // towards element 0, below
    const Vec<2> n = area_normal(mesh, mesh.facets.back());
    auto centre = [&](int e) {
      Vec<2> sum = Vec<2>::Zero();
      for (int node : mesh.elements[e]) sum += mesh.nodes[node] / 3;
      return sum;
    };
    EXPECT_GT(n.dot(centre(elements[1]) - centre(elements[0])), 0.0);
  }
}

TEST(Meshes, nodes_that_no_element_uses_and_bodies_outside_of_the_groups_are_dropped) {
  auto parts = square();
  parts.nodes.insert(parts.nodes.begin(), {5, 5});
  auto shift = [](auto& entities) {
    for (auto& entity : entities)
      for (auto& simplex : entity.simplices)
        for (int& node : simplex) ++node;
  };
  shift(parts.bodies), shift(parts.sides);
  parts.bodies[0].groups = {"water"};
  parts.nodes.push_back({2, 2});
  parts.bodies.push_back({.tag = 8, .groups = {}, .simplices = {{2, 5, 3}}, .numbers = {13}});
  const auto mesh = assemble(parts, "test");
  EXPECT_EQ(mesh.nodes.size(), 4u);
  EXPECT_EQ(mesh.elements.size(), 2u);
  EXPECT_EQ(mesh.region_names, std::vector<std::string>{"water"});
  EXPECT_DOUBLE_EQ(volume(mesh), 1.0);
}

TEST(Meshes, a_mesh_without_elements_is_an_error) {
  auto parts = square();
  parts.bodies.clear();
  EXPECT_EQ(error_of(parts), "read it: no elements: there is no triangle in this mesh");
}

TEST(Meshes, no_such_boundary_or_region_lists_those_there_are) {
  const auto mesh = assemble(square(), "test");
  EXPECT_EQ(error_of([&] { boundary_number(mesh, "lid", "set_wall"); }), "set_wall: no boundary is named 'lid': this mesh has 'plate', 'side'");
  EXPECT_EQ(error_of([&] { region_number(mesh, "oil", "fill"); }), "fill: no region is named 'oil': this mesh has 'domain'");
  EXPECT_EQ(error_of([&] { boundary_area(box(unit_box<2>({true, true}), {2, 2}), "lid"); }),
            "boundary_area: no boundary is named 'lid': this mesh has none");
}

template <int dim>
void check_grid(const std::array<int, dim>& counts, const std::array<bool, dim>& periodic) {
  const auto mesh = box(unit_box<dim>(periodic), counts);
  int cells = 1, masters = 1, named = 0;
  for (int a = 0; a < dim; ++a) {
    cells *= counts[a], masters *= counts[a] + !periodic[a];
    named += periodic[a] ? 0 : 2;
  }
  EXPECT_NEAR(volume(mesh), 1.0, 1e-13);
  EXPECT_EQ(mesh.elements.size(), std::size_t(cells * (dim == 2 ? 2 : 6)));
  EXPECT_EQ(mesh.boundary_names.size(), std::size_t(named));
  for (const auto& name : mesh.boundary_names) EXPECT_NEAR(boundary_area(mesh, name), 1.0, 1e-13) << name;
  EXPECT_NEAR(closure(mesh), 0.0, 1e-15);
  std::set<int> distinct;
  for (std::size_t k = 0; k < mesh.nodes.size(); ++k) {
    const int m = mesh.master[k];
    distinct.insert(m);
    EXPECT_EQ(mesh.master[m], m);
    const Vec<dim> d = mesh.nodes[k] - mesh.nodes[m];
    for (int a = 0; a < dim; ++a) {  // a corner is the image of the lowest corner, not of another image
      EXPECT_NEAR(d[a], std::round(d[a]), 1e-15);
      if (periodic[a]) EXPECT_LT(mesh.nodes[m][a], 0.7 - 1e-9);
      else EXPECT_EQ(d[a], 0.0);
    }
  }
  EXPECT_EQ(distinct.size(), std::size_t(masters));
}

TEST(Meshes, a_grid_fills_its_box_with_any_axes_periodic_and_two_cells_across_a_period) {
  for (int mask = 0; mask < 8; ++mask) {
    const std::array<bool, 3> periodic{(mask & 1) != 0, (mask & 2) != 0, (mask & 4) != 0};
    check_grid<3>({2, 3, 2}, periodic);
    if (mask < 4) check_grid<2>({2, 3}, {periodic[0], periodic[1]});
  }
}

TEST(Meshes, named_periodic_sides_know_the_element_across_even_with_two_cells_in_each_period) {
  // Here facets of different sides have the same masters: only the nodes of the period itself tell them apart.
  Parts<2> parts;
  for (int j = 0; j < 3; ++j)
    for (int i = 0; i < 3; ++i) parts.nodes.push_back({i, j});
  parts.bodies = {{.tag = 1, .groups = {}, .simplices = {}, .numbers = {}}};
  parts.sides = {{.tag = 1, .groups = {"left"}, .simplices = {{3, 0}, {6, 3}}, .numbers = {1, 2}},
                 {.tag = 2, .groups = {"right"}, .simplices = {{2, 5}, {5, 8}}, .numbers = {3, 4}}};
  for (int j = 0; j < 2; ++j)
    for (int i = 0; i < 2; ++i) {
      const int a = 3 * j + i;
      for (const auto& t : {std::array{a, a + 1, a + 4}, std::array{a, a + 4, a + 3}}) parts.bodies[0].simplices.push_back(t);
    }
  parts.bodies[0].numbers.resize(8);
  parts.periods = {{.translation = {2, 0}, .pairs = {{2, 0}, {5, 3}, {8, 6}}, .images = {2}, .masters = {1}},
                   {.translation = {0, 2}, .pairs = {{6, 0}, {7, 1}, {8, 2}}, .images = {}, .masters = {}}};
  const auto mesh = assemble(parts, "test");
  EXPECT_EQ(mesh.master, (std::vector<int>{0, 1, 0, 3, 4, 3, 0, 1, 0}));
  ASSERT_EQ(mesh.facets.size(), 4u);
  std::map<std::array<int, 2>, std::string> found;
  for (int k = 0; k < 4; ++k) found[mesh.facet_elements[k]] = mesh.boundary_names[mesh.boundary[k]];
  // elements by cell: (0, 0): 0 right and 1 left of its diagonal, (1, 0): 2, 3, (0, 1): 4, 5, (1, 1): 6, 7
  EXPECT_EQ(found, (std::map<std::array<int, 2>, std::string>{{{1, 2}, "left"}, {{5, 6}, "left"}, {{2, 1}, "right"}, {{6, 5}, "right"}}));

  parts.nodes[5].x() += 1e-6;
  EXPECT_PRED_FORMAT2(IsSubstring, "periodic sides do not match: the image of the node at (0, 1) m should lie at (2, 1) m, and lies at (2, 1) "
                                         "m, 1e-06 m away (period 2 m)", error_of(parts));
  parts.nodes[5].x() = 2 + 1e-9;  // the last digits of a file are no defect
  EXPECT_EQ(error_of(parts), "no error");
  parts.periods[0].pairs.erase(parts.periods[0].pairs.begin() + 1);
  EXPECT_PRED_FORMAT2(IsSubstring, "periodic sides do not match: the facet at (0, 0.5) m on curve 1 has no partner at (2, 0.5) m", error_of(parts));
}

TEST(Meshes, periodic_sides_with_the_same_nodes_and_other_triangles_do_not_match) {
  Parts<3> parts;  // a cube of five tetrahedra: the diagonals of opposite faces cross
  for (int k = 0; k < 8; ++k) parts.nodes.push_back({double(k & 1), double(k >> 1 & 1), double(k >> 2)});
  parts.bodies = {{.tag = 1, .groups = {}, .simplices = {{0, 1, 2, 4}, {3, 2, 1, 7}, {5, 1, 7, 4}, {6, 2, 4, 7}, {1, 2, 4, 7}}, .numbers = {1, 2, 3, 4, 5}}};
  for (auto& t : parts.bodies[0].simplices) {
    const Vec<3> a = parts.nodes[t[1]] - parts.nodes[t[0]], b = parts.nodes[t[2]] - parts.nodes[t[0]], c = parts.nodes[t[3]] - parts.nodes[t[0]];
    if (a.cross(b).dot(c) < 0) std::swap(t[0], t[1]);
  }
  parts.sides = {{.tag = 1, .groups = {"wall"}, .simplices = {{0, 1, 4}, {5, 1, 4}, {2, 3, 7}, {6, 2, 7}, {0, 1, 2}, {3, 2, 1}, {5, 7, 4}, {6, 4, 7}}, .numbers = {}}};
  parts.periods = {{.translation = {1, 0, 0}, .pairs = {{1, 0}, {3, 2}, {5, 4}, {7, 6}}, .images = {}, .masters = {}}};
  EXPECT_PRED_FORMAT2(IsSubstring, "read it: 4 of 12 boundary facets are in no physical group, the first at (0, 0.333333, 0.333333) m: it lies between nodes "
                                   "of periodic sides, which do not match there", error_of([&] { assemble(parts, "read it"); }));
}

TEST(Meshes, a_period_of_one_cell_is_too_short) {
  EXPECT_EQ(error_of([] { box(unit_box<2>({false, true}), {4, 1}); }),
            "box: the period of 1 m is too short: the element at (-0.133333, 0.0333333) m, 1 m long, touches its own image; a period needs two layers "
            "of elements, so make them smaller than 0.5 m");
  EXPECT_PRED_FORMAT2(IsSubstring, "the period of 1 m is too short", error_of([] { box(unit_box<3>({true, true, true}), {2, 2, 1}); }));
}

TEST(Meshes, a_grid_has_the_mirror_symmetry_of_its_box) {
  const auto mesh = box(Box<2>{.lengths = {1, 2}}, {4, 6});
  std::set<std::array<long, 2>> centres;
  auto key = [](double x, double y) { return std::array{std::lround(x * 1e6), std::lround(y * 1e6)}; };
  for (const auto& e : mesh.elements) {
    const Vec<2> c = (mesh.nodes[e[0]] + mesh.nodes[e[1]] + mesh.nodes[e[2]]) / 3;
    centres.insert(key(c.x(), c.y()));
  }
  for (const auto& e : mesh.elements) {
    const Vec<2> c = (mesh.nodes[e[0]] + mesh.nodes[e[1]] + mesh.nodes[e[2]]) / 3;
    EXPECT_TRUE(centres.contains(key(1 - c.x(), c.y())) && centres.contains(key(c.x(), 2 - c.y())));
  }
}

TEST(Meshes, no_triangle_of_a_grid_with_even_counts_has_all_its_nodes_on_the_boundary) {
  const auto mesh = box(Box<2>{.lengths = {1, 1}}, {4, 4});
  std::set<int> boundary;
  for (const auto& facet : mesh.facets) boundary.insert(facet.begin(), facet.end());
  for (const auto& element : mesh.elements)
    EXPECT_FALSE(std::all_of(element.begin(), element.end(), [&](int node) { return boundary.contains(node); }));
}

TEST(Meshes, parts_cover_the_mesh_evenly_and_touch_less_than_stripes_of_the_numbering) {
  const auto mesh = box(Box<2>{.lengths = {1, 1}}, {40, 40});
  for (int parts : {2, 7, 16}) {
    const auto part = partition(mesh, parts);
    std::vector<int> size(parts, 0), stripes(part.size());
    for (int p : part) ++size.at(p);
    for (int n : size) EXPECT_NEAR(n, 3200.0 / parts, 0.05 * 3200 / parts);
    for (std::size_t e = 0; e < part.size(); ++e) stripes[e] = static_cast<int>(e * parts / part.size());
    EXPECT_LT(cut(mesh, part), (parts > 2 ? 0.8 : 1.1) * cut(mesh, stripes));  // of two parts stripes are the best there are
    EXPECT_EQ(part, partition(mesh, parts));
  }
}

TEST(Meshes, parts_know_the_neighbours_across_a_period) {
  // Halves of 30 x 20 cells: a cut along x costs 30 facets. One along y costs 20, but with x periodic it takes two of them.
  for (const bool periodic : {false, true}) {
    const auto mesh = box(Box<2>{.lengths = {3, 2}, .periodic = {periodic, false}}, {30, 20});
    EXPECT_LE(cut(mesh, partition(mesh, 2)), periodic ? 33 : 22);
  }
}

TEST(Meshes, no_part_is_empty_up_to_one_element_each) {
  const auto mesh = box(Box<3>{.lengths = {1, 1, 1}}, {2, 1, 1});
  for (int parts = 1; parts <= 12; ++parts) {
    const auto part = partition(mesh, parts);
    EXPECT_EQ(std::set<int>(part.begin(), part.end()).size(), std::size_t(parts));
  }
  EXPECT_EQ(error_of([&] { partition(mesh, 13); }), "partition: parts must be between 1 and the number of elements, 12, got 13");
  EXPECT_EQ(error_of([&] { partition(mesh, 0); }), "partition: parts must be between 1 and the number of elements, 12, got 0");
}
