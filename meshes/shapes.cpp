#include "shapes.hpp"

#include "assemble.hpp"
#include "errors.hpp"
#include "gmsh.hpp"

#include <Eigen/LU>
#include <gmsh.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <numeric>
#include <set>

namespace quicksand::meshes {

namespace {

constexpr double most_elements = 1e8;  // beyond it a mistake is likelier than a mesh

void check_length(double length, std::string_view where, std::string_view what) {
  if (!(length > 1e-30 && length < 1e30)) fail("{}: {} must be > 0 m, got {} m", where, what, length);
}

// Elements along a length so that none is longer than `size`; a length that is a multiple but for rounding gives that multiple.
int count(double length, double size) { return std::max(1, static_cast<int>(std::ceil(length / size * (1 - 1e-12)))); }

void check_size(double size, double largest, std::string_view where, std::string_view why, double elements) {
  check_length(size, where, "size");
  if (size > largest * (1 + 1e-12)) fail("{}: size must be <= {:.6g} m ({}), got {} m", where, largest, why, size);
  if (elements > most_elements) fail("{}: size {} m would make {:.1e} elements, more than {:.0e}; choose a larger one", where, size, elements, most_elements);
}

template <int dim>
void check(const Box<dim>& box) {
  for (int a = 0; a < dim; ++a) {
    check_length(box.lengths[a], "box", fmt::format("the length of axis {}", a));
    if (!(std::abs(box.origin[a]) < 1e30)) fail("box: origin must be finite, got {} m", place(box.origin));
  }
}

template <int dim>
void turn_upright(std::array<int, dim + 1>& element, const std::vector<Vec<dim>>& nodes) {
  Eigen::Matrix<double, dim, dim> edges;
  for (int k = 0; k < dim; ++k) edges.col(k) = nodes[element[k + 1]] - nodes[element[0]];
  if (edges.determinant() < 0) std::swap(element[dim - 1], element[dim]);
}

// Adds the facets of an element that are on a side.
template <int dim, class OnSide>
void add_facets(Entity<dim>& side, const std::array<int, dim + 1>& element, OnSide&& on_side) {
  for (int corner = 0; corner <= dim; ++corner) {
    const auto facet = outward_facet<dim>(element, corner);
    if (on_side(facet)) side.simplices.push_back(facet);
  }
}

// Of a facet: do all its nodes fulfil a condition?
template <class Condition>
auto all(Condition condition) {
  return [condition](const auto& facet) { return std::all_of(facet.begin(), facet.end(), condition); };
}

template <int dim>
void number_simplices(Parts<dim>& parts) {
  for (auto& body : parts.bodies) body.numbers.resize(body.simplices.size()), std::iota(body.numbers.begin(), body.numbers.end(), 1);
}

// A box as a grid, with a name for each side: first and last of each axis.
template <int dim>
Mesh<dim> grid(const Box<dim>& box, const std::array<int, dim>& counts, const std::array<const char*, 2 * dim>& names, std::string_view where) {
  std::array<int, dim + 1> stride{1};  // node numbers; the last is how many nodes there are
  for (int a = 0; a < dim; ++a) stride[a + 1] = stride[a] * (counts[a] + 1);
  auto position = [&](int node, int axis) { return node % stride[axis + 1] / stride[axis]; };

  Parts<dim> parts;
  parts.nodes.resize(stride[dim]);
  for (int node = 0; node < stride[dim]; ++node)
    for (int a = 0; a < dim; ++a)
      parts.nodes[node][a] = box.origin[a] + box.lengths[a] * (static_cast<double>(position(node, a)) / counts[a]);

  parts.bodies.push_back({.tag = 1, .groups = {}, .simplices = {}, .numbers = {}});
  for (int s = 0; s < 2 * dim; ++s) {
    parts.sides.push_back({.tag = s + 1, .groups = {}, .simplices = {}, .numbers = {}});
    if (!box.periodic[s / 2]) parts.sides.back().groups.push_back(names[s]);
  }
  for (int cell = 0; cell < stride[dim]; ++cell) {  // by its lowest node
    bool inside = true;
    for (int a = 0; a < dim; ++a) inside = inside && position(cell, a) < counts[a];
    if (!inside) continue;
    std::array<int, dim> axes;
    std::iota(axes.begin(), axes.end(), 0);
    do {  // H. W. Kuhn: each order of the axes is a way from corner to corner of the cell, its nodes are a simplex
      std::array<int, dim + 1> element{cell};
      for (int a = 0; a < dim; ++a) element[0] += position(cell, a) % 2 * stride[a];  // odd cells are mirrored
      for (int k = 0; k < dim; ++k) element[k + 1] = element[k] + (position(cell, axes[k]) % 2 ? -1 : 1) * stride[axes[k]];
      turn_upright<dim>(element, parts.nodes);
      parts.bodies[0].simplices.push_back(element);
      for (int s = 0; s < 2 * dim; ++s) {
        const int at = s % 2 ? counts[s / 2] : 0;
        add_facets<dim>(parts.sides[s], element, all([&](int node) { return position(node, s / 2) == at; }));
      }
    } while (std::next_permutation(axes.begin(), axes.end()));
  }
  for (int a = 0; a < dim; ++a) {
    if (!box.periodic[a]) continue;
    Period<dim> period{.translation = Vec<dim>::Zero(), .pairs = {}, .images = {2 * a + 2}, .masters = {2 * a + 1}};
    period.translation[a] = box.lengths[a];
    for (int node = 0; node < stride[dim]; ++node)
      if (position(node, a) == 0) period.pairs.push_back({node + counts[a] * stride[a], node});
    parts.periods.push_back(std::move(period));
  }
  number_simplices(parts);
  return assemble(parts, where);
}

template <int dim>
constexpr std::array<const char*, 2 * dim> side_names() {
  if constexpr (dim == 2) return {"left", "right", "bottom", "top"};
  else return {"left", "right", "bottom", "top", "back", "front"};
}

void name(int dim, const std::vector<int>& tags, const char* group) {
  gmsh::model::setPhysicalName(dim, gmsh::model::addPhysicalGroup(dim, tags), group);
}

// Four points and four lines of a rectangle: bottom, right, top, left.
std::array<int, 4> add_rectangle(const Vec<2>& low, const Vec<2>& high) {
  namespace geo = gmsh::model::geo;
  const int a = geo::addPoint(low.x(), low.y(), 0), b = geo::addPoint(high.x(), low.y(), 0);
  const int c = geo::addPoint(high.x(), high.y(), 0), d = geo::addPoint(low.x(), high.y(), 0);
  return {geo::addLine(a, b), geo::addLine(b, c), geo::addLine(c, d), geo::addLine(d, a)};
}

// A circle as four arcs.
std::vector<int> add_circle(const Vec<2>& centre, double radius) {
  namespace geo = gmsh::model::geo;
  const int middle = geo::addPoint(centre.x(), centre.y(), 0);
  std::array<int, 4> points;
  for (int k = 0; k < 4; ++k) points[k] = geo::addPoint(centre.x() + radius * (k == 0) - radius * (k == 2), centre.y() + radius * (k == 1) - radius * (k == 3), 0);
  std::vector<int> arcs;
  for (int k = 0; k < 4; ++k) arcs.push_back(geo::addCircleArc(points[k], middle, points[(k + 1) % 4]));
  return arcs;
}

void divide(const std::vector<int>& arcs, double radius, double size) {
  for (int arc : arcs) gmsh::model::mesh::setTransfiniteCurve(arc, count(std::numbers::pi / 2 * radius, size) + 1);
}

std::vector<double> shift(int axis, double length) {
  std::vector<double> affine{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  affine[4 * axis + 3] = length;
  return affine;
}

}  // namespace

template <int dim>
Mesh<dim> box(const Box<dim>& box, const std::type_identity_t<std::array<int, dim>>& counts) {
  check(box);
  double elements = dim == 2 ? 2 : 6;
  for (int a = 0; a < dim; ++a) {
    if (counts[a] < 1) fail("box: counts must be >= 1, got {} along axis {}", counts[a], a);
    elements *= counts[a];
  }
  if (elements > most_elements) fail("box: counts of {} would make {:.1e} elements, more than {:.0e}", fmt::join(counts, " x "), elements, most_elements);
  return grid<dim>(box, counts, side_names<dim>(), "box");
}

template <int dim>
Mesh<dim> box(const Box<dim>& box, double size) {
  check(box);
  double elements = 1, shortest = box.lengths.minCoeff();
  for (int a = 0; a < dim; ++a) {
    elements *= box.lengths[a] / size;
    if (box.periodic[a]) shortest = std::min(shortest, box.lengths[a] / 2);
  }
  check_size(size, shortest, "box", "the shortest side, half of a periodic one", 2 * (dim == 3 ? 3 : 1) * elements);
  return mesh_by_gmsh<dim>("box", size, [&] {
    const Vec<dim> high = box.origin + box.lengths;
    std::array<int, 2 * dim> sides;  // in the order of their names
    if constexpr (dim == 2) {
      const auto [bottom, right, top, left] = add_rectangle(box.origin, high);
      gmsh::model::geo::addPlaneSurface({gmsh::model::geo::addCurveLoop({bottom, right, top, left})});
      gmsh::model::geo::synchronize();
      sides = {left, right, bottom, top};
    } else {
      gmsh::model::occ::addBox(box.origin.x(), box.origin.y(), box.origin.z(), box.lengths.x(), box.lengths.y(), box.lengths.z());
      gmsh::model::occ::synchronize();
      sides = {1, 2, 3, 4, 5, 6};  // the order in which addBox makes them
    }
    for (int a = 0; a < dim; ++a) {
      if (box.periodic[a]) gmsh::model::mesh::setPeriodic(dim - 1, {sides[2 * a + 1]}, {sides[2 * a]}, shift(a, box.lengths[a]));
      else
        for (int s : {2 * a, 2 * a + 1}) name(dim - 1, {sides[s]}, side_names<dim>()[s]);
    }
  });
}

Mesh<2> channel(double length, double height, double size, bool periodic) {
  check_length(length, "channel", "length");
  check_length(height, "channel", "height");
  check_size(size, std::min(height, periodic ? length / 2 : length), "channel", "the height and the length, half of a periodic one",
             2 * length * height / (size * size));
  return grid<2>({.lengths = {length, height}, .periodic = {periodic, false}}, {count(length, size), count(height, size)},
                 {"inflow", "outflow", "walls", "walls"}, "channel");
}

Mesh<2> cylinder_in_channel(double size, const CylinderInChannel& shape) {
  constexpr const char* where = "cylinder_in_channel";
  const double radius = shape.diameter / 2;
  check_length(shape.length, where, "length");
  check_length(shape.height, where, "height");
  check_length(shape.diameter, where, "diameter");
  if (!(shape.ratio >= 1 && shape.ratio < 1e30)) fail("{}: ratio must be >= 1, got {}", where, shape.ratio);
  const double largest = shape.ratio * size;
  check_size(size, radius / 2, where, "a quarter of the diameter",
             2 * shape.length * shape.height / (largest * largest) + 10 * 2 * std::numbers::pi * radius / size);
  const double room = std::min({shape.centre.x(), shape.centre.y(), shape.length - shape.centre.x(), shape.height - shape.centre.y()}) - radius;
  if (!(room >= size))
    fail("{}: between cylinder and walls must be >= {} m, one element, got {:.6g} m (centre {} m, diameter {} m)", where, size, room,
         place(shape.centre), shape.diameter);
  return mesh_by_gmsh<2>(where, largest, [&] {
    namespace geo = gmsh::model::geo;
    const auto [bottom, right, top, left] = add_rectangle(Vec<2>::Zero(), {shape.length, shape.height});
    const auto circle = add_circle(shape.centre, radius);
    geo::addPlaneSurface({geo::addCurveLoop({bottom, right, top, left}), geo::addCurveLoop(circle)});
    geo::synchronize();
    name(1, {left}, "inflow");
    name(1, {right}, "outflow");
    name(1, {bottom, top}, "walls");
    name(1, circle, "cylinder");
    divide(circle, radius, size);
    const int field = gmsh::model::mesh::field::add("MathEval");
    gmsh::model::mesh::field::setString(field, "F", fmt::format("{} + 0.2*(Sqrt((x-({}))^2 + (y-({}))^2) - {})", size, shape.centre.x(), shape.centre.y(), radius));
    gmsh::model::mesh::field::setAsBackgroundMesh(field);
  });
}

namespace {

// The disc or annulus of radius < outer; inner 0: no hole.
Mesh<2> ring(std::string_view where, double inner, double outer, double size) {
  return mesh_by_gmsh<2>(where, size, [&] {
    namespace geo = gmsh::model::geo;
    std::vector<std::vector<int>> circles{add_circle(Vec<2>::Zero(), outer)};
    std::vector<int> loops{geo::addCurveLoop(circles[0])};
    if (inner > 0) {
      circles.push_back(add_circle(Vec<2>::Zero(), inner));
      loops.push_back(geo::addCurveLoop(circles[1]));
    }
    geo::addPlaneSurface(loops);
    geo::synchronize();
    for (std::size_t k = 0; k < circles.size(); ++k) {
      name(1, circles[k], k == 0 ? "outer" : "inner");
      divide(circles[k], k == 0 ? outer : inner, size);
    }
  });
}

}  // namespace

Mesh<2> annulus(double inner, double outer, double size) {
  check_length(inner, "annulus", "inner");
  check_length(outer, "annulus", "outer");
  if (!(inner < outer)) fail("annulus: inner must be < outer, got {} m and {} m", inner, outer);
  check_size(size, std::min(inner, outer - inner), "annulus", "the inner radius and the gap", 7 * (outer * outer - inner * inner) / (size * size));
  return ring("annulus", inner, outer, size);
}

Mesh<3> pipe(double radius, double length, double size, bool periodic) {
  check_length(radius, "pipe", "radius");
  check_length(length, "pipe", "length");
  check_size(size, std::min(radius, periodic ? length / 2 : length), "pipe", "the radius and the length, half of a periodic one",
             22 * radius * radius * length / (size * size * size));
  const Mesh<2> disc = ring("pipe", 0, radius, size);
  const int layers = count(length, size), n = static_cast<int>(disc.nodes.size());
  Parts<3> parts;
  for (int layer = 0; layer <= layers; ++layer)
    for (const auto& node : disc.nodes) parts.nodes.push_back({length * (static_cast<double>(layer) / layers), node.x(), node.y()});
  std::set<std::array<int, 2>> rim;
  for (const auto& [a, b] : disc.facets) rim.insert({std::min(a, b), std::max(a, b)});
  auto on_wall = [&](const std::array<int, 3>& facet) {  // over an edge of the rim
    std::set<int> below;
    for (int node : facet) below.insert(node % n);
    return below.size() == 2 && rim.contains({*below.begin(), *below.rbegin()});
  };

  parts.bodies.push_back({.tag = 1, .groups = {}, .simplices = {}, .numbers = {}});
  for (int s = 0; s < 3; ++s) parts.sides.push_back({.tag = s + 1, .groups = {}, .simplices = {}, .numbers = {}});
  if (!periodic) parts.sides[0].groups = {"inflow"}, parts.sides[1].groups = {"outflow"};
  parts.sides[2].groups = {"wall"};
  for (int layer = 0; layer < layers; ++layer)
    for (auto triangle : disc.elements) {
      // A prism as three tetrahedra: one node after the other goes up, in the order of their numbers, so that neighbours agree on diagonals.
      std::sort(triangle.begin(), triangle.end());
      std::array<int, 3> front;
      for (int k = 0; k < 3; ++k) front[k] = layer * n + triangle[k];
      for (int k = 2; k >= 0; --k) {
        std::array<int, 4> element{front[0], front[1], front[2], front[k] + n};
        turn_upright<3>(element, parts.nodes);
        parts.bodies[0].simplices.push_back(element);
        add_facets<3>(parts.sides[0], element, all([&](int node) { return node < n; }));
        add_facets<3>(parts.sides[1], element, all([&](int node) { return node >= layers * n; }));
        add_facets<3>(parts.sides[2], element, on_wall);
        front[k] += n;
      }
    }
  if (periodic) {
    Period<3> period{.translation = {length, 0, 0}, .pairs = {}, .images = {2}, .masters = {1}};
    for (int node = 0; node < n; ++node) period.pairs.push_back({layers * n + node, node});
    parts.periods.push_back(std::move(period));
  }
  number_simplices(parts);
  return assemble(parts, "pipe");
}

template Mesh<2> box(const Box<2>&, const std::array<int, 2>&);
template Mesh<3> box(const Box<3>&, const std::array<int, 3>&);
template Mesh<2> box(const Box<2>&, double);
template Mesh<3> box(const Box<3>&, double);

}  // namespace quicksand::meshes
