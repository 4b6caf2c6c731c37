// The state of a scene: grains, walls, materials, and the box they live in. No behaviour beyond what keeps the arrays consistent.
#pragma once

#include "geometry.hpp"

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

namespace quicksand {

// Discs or spheres, kept sorted in space (the order changes when neighbours are found anew; `id` does not).
template <int dim>
struct Grains {
  std::vector<Vec<dim>> x;            // centre [m], wrapped into the box only when neighbours are found anew
  std::vector<Body<dim>> body;        // velocity, spin, inverse mass
  std::vector<double> r;              // radius [m]
  std::vector<std::int32_t> id;       // order of adding, >= 0; grains fixed to a wall: -1, -2, ...
  std::vector<std::int32_t> wall;     // wall that carries this grain; -1: free
  std::vector<std::uint8_t> material;
  std::vector<Vec<dim>> force;        // external force [N] (2D: N/m); empty when there is none
  double inertia = Rotation<dim>::inertia;  // I/(m r^2) of every grain [-]

  int size() const { return static_cast<int>(x.size()); }
};

// A rigid body that does not turn. Along each axis either its velocity is given (inv_m = 0) or its load (inv_m > 0).
template <int dim>
struct Wall {
  enum class Shape { plane, segment, triangle };  // segments in 2D, triangles in 3D: facets
  Shape shape = Shape::plane;
  Vec<dim> point = Vec<dim>::Zero();   // a point of the plane, or the facet's first corner [m]
  Vec<dim> normal = Vec<dim>::Zero();  // unit; of a plane towards the grains, of a facet either: it is met from both sides
  Vec<dim> span = Vec<dim>::Zero();    // from the facet's first corner to its second [m]
  Vec<dim> side = Vec<dim>::Zero();    // from the triangle's first corner to its third [m]
  Vec<dim> v = Vec<dim>::Zero();       // velocity [m/s]
  Vec<dim> inv_m = Vec<dim>::Zero();   // inverse mass per axis [1/kg] (2D: m/kg); 0: driven by velocity
  Vec<dim> load = Vec<dim>::Zero();    // external force on load-driven axes [N] (2D: N/m)
  std::array<bool, dim> loaded{};      // which axes are driven by load
  double mass = 0.0;                   // of the load-driven axes [kg] (2D: kg/m); 0: a tenth of the grains' mass, set at the first step
  std::uint8_t material = 0;
  Vec<dim> force = Vec<dim>::Zero();   // mean contact force on the wall over the last step [N] (2D: N/m)
  Vec<dim> moved = Vec<dim>::Zero();   // way since neighbours were last found [m]

  bool is_facet() const { return shape != Shape::plane; }
  Vec<dim> middle() const {
    if (shape == Shape::triangle) return point + (span + side) / 3;
    return point + 0.5 * span;
  }
};

// Friction and restitution for every pair of materials. Restitution: u_n+ = -normal u_n-, u_t+ = -tangential u_t-.
class Materials {
  template <int>
  friend class Simulation;  // state.cpp

 public:
  struct Pair {
    double friction = -1.0;  // [-]; negative: never set
    double normal = 0.0;
    double tangential = 0.0;
  };
  std::uint8_t find(const std::string& name, const char* where) const;  // throws std::invalid_argument: unknown
  std::uint8_t find_or_add(const std::string& name);
  const std::vector<std::string>& names() const { return names_; }
  Pair& pair(int a, int b) { return pairs_[index(a, b)]; }
  const Pair& pair(int a, int b) const { return pairs_[index(a, b)]; }

 private:
  static int index(int a, int b) { return a > b ? a * (a + 1) / 2 + b : b * (b + 1) / 2 + a; }
  std::vector<std::string> names_;
  std::vector<Pair> pairs_;
};

// [-L/2, L/2) along periodic axes, unbounded along the others.
template <int dim>
struct Box {
  Vec<dim> period = Vec<dim>::Zero();  // L [m]; 0: not periodic

  // From a to b, the shortest way.
  Vec<dim> nearest(Vec<dim> ab) const {
    for (int k = 0; k < dim; ++k)
      if (period[k] > 0) ab[k] -= period[k] * std::nearbyint(ab[k] / period[k]);
    return ab;
  }
  Vec<dim> wrap(Vec<dim> x) const {
    for (int k = 0; k < dim; ++k)
      if (period[k] > 0) {
        x[k] -= period[k] * std::floor(x[k] / period[k] + 0.5);
        if (x[k] >= 0.5 * period[k]) x[k] = -0.5 * period[k];  // rounding of the line above
      }
    return x;
  }
};

// Where a wall is nearest to a grain's centre: unit normal from wall to grain, distance from wall to centre [m].
template <int dim>
struct NearWall {
  Vec<dim> n;
  double distance;
};

// From a triangle's first corner to its point nearest to x, x seen from that corner; whether it is neither on an edge nor a corner.
// C. Ericson, Real-Time Collision Detection (2005), section 5.1.5.
inline std::pair<Vec<3>, bool> nearest_in_triangle(const Vec<3>& x, const Vec<3>& span, const Vec<3>& side) {
  const double a_1 = span.dot(x), a_2 = side.dot(x);
  if (a_1 <= 0 && a_2 <= 0) return {Vec<3>::Zero(), false};
  const double b_1 = a_1 - span.squaredNorm(), b_2 = a_2 - side.dot(span);
  if (b_1 >= 0 && b_2 <= b_1) return {span, false};
  const double c_1 = a_1 - span.dot(side), c_2 = a_2 - side.squaredNorm();
  if (c_2 >= 0 && c_1 <= c_2) return {side, false};
  const double on_side = c_1 * a_2 - a_1 * c_2, on_span = a_1 * b_2 - b_1 * a_2, opposite = b_1 * c_2 - c_1 * b_2;
  if (on_span <= 0 && a_1 >= 0 && b_1 <= 0) return {a_1 / (a_1 - b_1) * span, false};
  if (on_side <= 0 && a_2 >= 0 && c_2 <= 0) return {a_2 / (a_2 - c_2) * side, false};
  if (opposite <= 0 && b_2 >= b_1 && c_1 >= c_2) return {span + (b_2 - b_1) / ((b_2 - b_1) + (c_1 - c_2)) * (side - span), false};
  return {(on_side * span + on_span * side) / (on_side + on_span + opposite), true};
}

template <int dim>
NearWall<dim> nearest_point(const Wall<dim>& wall, const Vec<dim>& x, const Box<dim>& box) {
  if (wall.shape == Wall<dim>::Shape::plane) return {wall.normal, (x - wall.point).dot(wall.normal)};
  const Vec<dim> from_middle = box.nearest(x - wall.middle());
  if constexpr (dim == 3) {
    const Vec<3> from_corner = from_middle + (wall.span + wall.side) / 3;
    const auto [nearest, inside] = nearest_in_triangle(from_corner, wall.span, wall.side);
    const Vec<3> away = from_corner - nearest;
    const double across = from_corner.dot(wall.normal), distance = inside ? std::abs(across) : away.norm();
    if (inside || distance == 0) return {across < 0 ? Vec<3>(-wall.normal) : wall.normal, distance};
    return {away / distance, distance};
  }
  const double along = std::clamp(from_middle.dot(wall.span) / wall.span.squaredNorm(), -0.5, 0.5);
  const Vec<dim> away = from_middle - along * wall.span;
  const double distance = away.norm();
  if (distance > 0) return {away / distance, distance};
  return {wall.normal, 0.0};  // a centre exactly on the segment: either side will do
}

}  // namespace quicksand
