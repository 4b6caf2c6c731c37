// Walls: driven and loaded, flat and rough, segments and triangles, alone and side by side; and the stress between plates, which must add up to the load.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Walls : public ::testing::Test {};
TYPED_TEST_SUITE(Walls, Dimensions, DimensionName);

constexpr double r = 0.01;  // [m]

TYPED_TEST(Walls, a_wall_with_nothing_in_its_way_follows_its_load_and_its_drive_axis_by_axis) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  const int wall = sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  sim.drive(wall, 0, 0.2);
  sim.set_load(wall, 1, -3.0, 1.5);
  const int n = 100;
  const double dt = 1e-3;
  for (int k = 0; k < n; ++k) sim.step(dt);
  const Wall<dim>& w = sim.walls()[wall];
  EXPECT_NEAR((w.v - in_plane<dim>(0.2, -2.0 * n * dt)).norm(), 0.0, 1e-13);
  // The velocity at the end of each step carries the wall through it: dt^2 (1 + 2 + ... + n).
  EXPECT_NEAR((w.point - in_plane<dim>(0.2 * n * dt, -2.0 * dt * dt * n * (n + 1) / 2)).norm(), 0.0, 1e-14);

  sim.drive(wall, 1, 0.0);
  const auto report = sim.step(dt);
  EXPECT_EQ(w.v, in_plane<dim>(0.2, 0.0));
  EXPECT_EQ(report.work_walls, 0.0);
}

TYPED_TEST(Walls, a_loaded_wall_weighs_a_tenth_of_the_grains_unless_told) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  const int wall = sim.add_plane(in_plane<dim>(0, -10 * r), in_plane<dim>(0, 1), "wall");
  sim.set_load(wall, 1, -1.0, {});
  EXPECT_THROW(sim.step(1e-3), std::invalid_argument);  // a tenth of nothing
  add<dim>(sim, in_plane<dim>(0, 0), r);
  add<dim>(sim, in_plane<dim>(5 * r, 0), 2 * r);
  sim.step(1e-3);
  const double m = 0.1 * (mass<dim>(r) + mass<dim>(2 * r));
  EXPECT_NEAR(sim.walls()[wall].v[1], -1e-3 / m, 1e-12 / m);
}

// 36 grains in 2D, 64 in 3D, between two plates that slide apart at -+ `slide`, the upper one under load, no gravity.
constexpr double pressure = 100.0;  // [Pa] (2D: N/m)
template <int dim>
struct Cell {
  Simulation<dim> sim;
  double area, load;
  double height() const { return sim.walls()[1].point[1] - sim.walls()[0].point[1]; }

  explicit Cell(double slide) : sim(scene<dim>(0.4, in_period())), area(std::pow(sim.box().period[0], dim - 1)), load(pressure * area) {
    const double half = 1.5e-3 * cells()[1] + 1e-3;
    add_gas<dim>(sim, cells(), 0.1);
    sim.add_plane(in_plane<dim>(0, -half), in_plane<dim>(0, 1), "wall");
    sim.add_plane(in_plane<dim>(0, half), in_plane<dim>(0, -1), "wall");
    sim.drive(0, 0, -slide);
    sim.drive(1, 0, slide);
    sim.set_load(1, 1, -load, {});
    sim.settings.solve.tolerance = 1e-4;
  }

 private:
  static std::array<int, dim> cells() {
    std::array<int, dim> n;
    n.fill(dim == 2 ? 6 : 4);
    return n;
  }
  static Vec<dim> in_period() {
    Vec<dim> period = Vec<dim>::Constant(3e-3 * cells()[0]);
    period[1] = 0;
    return period;
  }
};

// Grains that the network does not hold go on drifting and hit it now and then: they are stopped by hand. 1e-3: ten times the
// solver's tolerance, whose errors add up over the layers.
TYPED_TEST(Walls, grains_pressed_by_a_load_come_to_rest_with_that_force_on_both_walls_and_that_stress_inside) {
  constexpr int dim = TypeParam::value;
  Cell<dim> cell(0.0);
  StepReport<dim> report;
  for (int k = 0; k < 2000; ++k) cell.sim.step(1e-4);
  cell.sim.set_velocity(std::vector<Vec<dim>>(cell.sim.count(), Vec<dim>::Zero()));
  cell.sim.set_spin(std::vector<Spin<dim>>(cell.sim.count(), zero<Spin<dim>>()));
  for (int k = 0; k < 20; ++k) report = cell.sim.step(1e-4);
  EXPECT_LT(std::abs(cell.sim.walls()[1].v[1]), 1e-6);
  EXPECT_NEAR(cell.sim.walls()[1].force[1], cell.load, 1e-3 * cell.load);
  EXPECT_NEAR(cell.sim.walls()[0].force[1], -cell.load, 1e-3 * cell.load);
  const Mat<dim> stress = (report.virial_contacts + report.virial_wall_contacts) / (cell.area * cell.height());
  EXPECT_NEAR(stress(1, 1), pressure, 1e-3 * pressure);
  EXPECT_NEAR(stress(0, 1), stress(1, 0), 1e-3 * pressure);  // no torque is left
}

// sum m y v_y of the grains grows at the rate virial + kinetic - (force on the lid) x height, and does not grow for ever.
// The force on the lid fluctuates by as much as its mean: 5000 steps leave about 1 % (measured with both tolerances 1e-2 and 1e-4).
TYPED_TEST(Walls, in_a_sheared_cell_contact_wall_and_kinetic_stress_add_up_to_the_load_on_average) {
  constexpr int dim = TypeParam::value;
  Cell<dim> cell(0.5);
  for (int k = 0; k < 1000; ++k) cell.sim.step(1e-4);
  Mat<dim> contacts = Mat<dim>::Zero(), kinetic = contacts;
  double volume = 0.0;
  for (int k = 0; k < 5000; ++k) {
    const auto report = cell.sim.step(1e-4);
    volume += cell.area * cell.height();
    contacts += report.virial_contacts + report.virial_wall_contacts;
    kinetic += report.virial_kinetic;
  }
  EXPECT_GT(kinetic(1, 1) / volume, 0.02 * pressure);  // else it would not be tested
  EXPECT_NEAR((contacts + kinetic)(1, 1) / volume, pressure, 0.03 * pressure);
}

// ------------------------------------------------------------------------------------------------------------ rough walls

TYPED_TEST(Walls, grains_fixed_to_a_wall_move_with_it_and_carry_its_load) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.5);
  const int wall = sim.add_plane(in_plane<dim>(0, -5 * r), in_plane<dim>(0, 1), "wall");
  // A cradle for a ball: two grains under it along the first axis, and in 3D two more along the third.
  std::vector<Vec<dim>> cradle;
  for (int axis = 0; axis < dim; axis += 2)
    for (int side : {-1, 1}) cradle.push_back(side * 1.2 * r * Vec<dim>::Unit(axis));
  sim.attach(wall, cradle, std::vector<double>(cradle.size(), r), "grain");
  sim.gravity = in_plane<dim>(0, -g);
  sim.drive(wall, 0, 0.1);
  const double m = 2 * mass<dim>(r), h = 1e-4;
  sim.set_load(wall, 1, (m + mass<dim>(r)) * g, m);  // gravity does not act on walls: the load bears the ball and lifts the wall
  add<dim>(sim, in_plane<dim>(0, 1.6 * r), r, in_plane<dim>(0.1, 0));  // sqrt(2^2 - 1.2^2) = 1.6: touching
  for (int k = 0; k < 500; ++k) sim.step(h);
  const double a = m * g / (m + mass<dim>(r));  // of wall and ball together: load - weight = m g
  const Wall<dim>& w = sim.walls()[wall];
  EXPECT_NEAR(w.v[1], a * 0.05, 1e-8);
  EXPECT_NEAR(velocities(sim)[0][1], a * 0.05, 1e-8);
  EXPECT_NEAR(w.force[1], -mass<dim>(r) * (g + a), 1e-7 * mass<dim>(r) * g);
  const Vec<dim> moved = w.point - in_plane<dim>(0, -5 * r);
  EXPECT_NEAR(moved[0], 0.1 * 0.05, 1e-12);
  for (int k = 0; k < sim.grains().size(); ++k)
    if (const int id = sim.grains().id[k]; id < 0) {
      EXPECT_NEAR((sim.grains().x[k] - cradle[-1 - id] - moved).norm(), 0.0, 1e-13);
    }
}

// --------------------------------------------------------------------------------------------------------------- segments

TEST(Segments, a_ball_rests_on_either_side_of_a_segment) {
  for (double side : {1.0, -1.0}) {
    auto sim = scene<2>(0.3);
    sim.gravity = Vec<2>(0, -side * g);
    const int wall = sim.add_segment(Vec<2>(-0.1, 0), Vec<2>(0.1, 0), "wall");
    add<2>(sim, Vec<2>(0.03, side * 2 * r), r);
    for (int k = 0; k < 100; ++k) sim.step(1e-3);
    EXPECT_NEAR(positions(sim)[0][1], side * r, 1e-8 * r);
    EXPECT_NEAR(sim.walls()[wall].force[1], -side * mass<2>(r) * g, 1e-8 * mass<2>(r) * g);
  }
}

TEST(Segments, across_a_periodic_boundary_a_segment_is_met_at_its_image) {
  auto sim = scene<2>(0.3, Vec<2>(0.2, 0));
  sim.gravity = Vec<2>(0, -g);
  sim.add_segment(Vec<2>(0.05, 0), Vec<2>(0.12, 0), "wall");  // 0.02 of it beyond the boundary at 0.1
  add<2>(sim, Vec<2>(-0.09, 1.5 * r), r);
  for (int k = 0; k < 100; ++k) sim.step(1e-3);
  EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r);
}

// A point on a smooth sphere leaves it at cos(theta) = 2/3 + u0^2/(3 g r), theta from the top; the centre of a disc that slides
// round the end of a segment does the same on a circle of its radius. First order in dt: 1 % at 2000 steps to the moment.
TEST(Segments, a_smooth_disc_slides_round_the_end_of_a_segment_and_leaves_where_a_point_leaves_a_sphere) {
  const double u0 = 0.05;
  auto sim = scene<2>(0.0);
  sim.gravity = Vec<2>(0, -g);
  const int wall = sim.add_segment(Vec<2>(-0.1, 0), Vec<2>(0, 0), "wall");
  add<2>(sim, Vec<2>(0, r), r, Vec<2>(u0, 0));
  double leaves_at = 0.0;
  for (int k = 0; k < 10000; ++k) {
    sim.step(2e-5);
    const Vec<2> x = positions(sim)[0];
    EXPECT_GE(nearest_point(sim.walls()[wall], x, sim.box()).distance, r * (1 - 1e-8));  // never through it
    if (sim.walls()[wall].force.norm() > 0) leaves_at = x.y() / x.norm();
  }
  EXPECT_NEAR(leaves_at, 2.0 / 3 + u0 * u0 / (3 * g * r), 0.01);
  EXPECT_LT(positions(sim)[0].y(), -r);  // past it
}

// --------------------------------------------------------------------------------------------------------------- facets

// A line through `corners` in the plane of the first two axes, as segments; in 3D a strip of triangles on both sides of that plane.
template <int dim>
void add_line(Simulation<dim>& sim, const std::vector<Vec<2>>& corners) {
  std::vector<std::array<Vec<dim>, dim>> facets;
  for (std::size_t k = 0; k + 1 < corners.size(); ++k) {
    const Vec<dim> a = in_plane<dim>(corners[k][0], corners[k][1]), b = in_plane<dim>(corners[k + 1][0], corners[k + 1][1]);
    if constexpr (dim == 2) {
      facets.push_back({a, b});
    } else {
      const Vec<3> side(0, 0, (corners[1] - corners[0]).norm());
      for (int row = -4; row < 4; ++row) {
        facets.push_back({a + row * side, b + row * side, b + (row + 1) * side});
        facets.push_back({a + row * side, a + (row + 1) * side, b + (row + 1) * side});
      }
    }
  }
  sim.add_facets(facets, "wall");
}

std::vector<Vec<2>> flat(double from, double to, double size) {
  std::vector<Vec<2>> corners;
  for (int k = 0; k <= std::lround((to - from) / size); ++k) corners.emplace_back(from + k * size, 0.0);
  return corners;
}

TEST(Triangles, are_nearest_at_a_face_an_edge_or_a_corner) {
  auto sim = scene<3>(0.3);
  sim.add_triangle(Vec<3>(0, 0, 0), Vec<3>(2, 0, 0), Vec<3>(0, 1, 0), "wall");
  const Wall<3>& wall = sim.walls()[0];
  auto expect = [&](const Vec<3>& x, const Vec<3>& nearest) {
    const NearWall<3> near = nearest_point(wall, x, sim.box());
    EXPECT_NEAR(near.distance, (x - nearest).norm(), 1e-15);
    EXPECT_LT((x - near.distance * near.n - nearest).norm(), 1e-15);
  };
  for (const double z : {0.5, -0.5, 1e-9}) {
    expect({0.5, 0.25, z}, {0.5, 0.25, 0});   // face
    expect({1.0, -0.3, z}, {1.0, 0, 0});      // edges
    expect({-0.3, 0.4, z}, {0, 0.4, 0});
    expect({1.2, 0.9, z}, {1, 0.5, 0});
    expect({-1, -2, z}, {0, 0, 0});           // corners
    expect({3, 0.5, z}, {2, 0, 0});
    expect({-0.1, 1.5, z}, {0, 1, 0});
  }
  EXPECT_EQ(std::abs(nearest_point(wall, Vec<3>(0.5, 0.25, 0), sim.box()).n.z()), 1.0);
  EXPECT_THROW(sim.add_triangle(Vec<3>(0, 0, 0), Vec<3>(1, 1, 1), Vec<3>(2, 2, 2), "wall"), std::invalid_argument);
}

TEST(Triangles, a_ball_rests_on_either_side) {
  for (double side : {1.0, -1.0}) {
    auto sim = scene<3>(0.3);
    sim.gravity = Vec<3>(0, -side * g, 0);
    const int wall = sim.add_triangle(Vec<3>(-0.1, 0, -0.1), Vec<3>(0.1, 0, -0.1), Vec<3>(0, 0, 0.2), "wall");
    add<3>(sim, Vec<3>(0.01, side * 2 * r, 0), r);
    for (int k = 0; k < 100; ++k) sim.step(1e-3);
    EXPECT_NEAR(positions(sim)[0][1], side * r, 1e-8 * r);
    EXPECT_NEAR(sim.walls()[wall].force[1], -side * mass<3>(r) * g, 1e-8 * mass<3>(r) * g);
  }
}

// Facets smaller and larger than the grain; through the periodic boundary, too.
TYPED_TEST(Walls, over_the_rims_of_a_flat_floor_of_facets_a_smooth_grain_slides_without_noticing) {
  constexpr int dim = TypeParam::value;
  for (const double size : {0.3 * r, 3.7 * r}) {
    Vec<dim> period = Vec<dim>::Zero();
    period[0] = 20 * size;
    if (period[0] < 8 * r) period[0] = 0;
    auto sim = scene<dim>(0.0, period);
    sim.gravity = in_plane<dim>(0, -g);
    add_line<dim>(sim, flat(-10 * size, 10 * size, size));
    Vec<dim> v = in_plane<dim>(0.31, 0);
    if (dim == 3) v[2] = 0.02;
    add<dim>(sim, in_plane<dim>(-3 * r * (period[0] == 0), r), r, v);
    const int steps = period[0] == 0 ? 150 : 3000;
    for (int k = 0; k < steps; ++k) {
      sim.step(1e-3);
      ASSERT_LT((velocities(sim)[0] - v).norm(), 1e-10) << size << ' ' << k;
    }
    EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r);
    Vec<dim> force = Vec<dim>::Zero();
    for (const Wall<dim>& wall : sim.walls()) force += wall.force;
    EXPECT_NEAR(force[1], -mass<dim>(r) * g, 1e-8 * mass<dim>(r) * g);
  }
}

TYPED_TEST(Walls, a_grain_that_rolls_over_a_flat_floor_of_facets_keeps_rolling) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.5);
  sim.gravity = in_plane<dim>(0, -g);
  add_line<dim>(sim, flat(-15 * r, 15 * r, 1.5 * r));
  add<dim>(sim, in_plane<dim>(-14 * r, r), r, in_plane<dim>(0.2, 0), turning<dim>(-0.2 / r));
  for (int k = 0; k < 1200; ++k) sim.step(1e-3);
  EXPECT_GT(positions(sim)[0][0], 9 * r);
  EXPECT_NEAR(velocities(sim)[0][0], 0.2, 1e-8);
  EXPECT_NEAR(in_plane(spins(sim)[0]), -0.2 / r, 1e-8 / r);
  EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r);
}

// Inside a polygon each side takes the part of the velocity that is normal to it: cos(angle) is left at every corner, nothing else.
TYPED_TEST(Walls, along_the_inside_of_a_polygon_a_smooth_grain_loses_at_each_corner_what_points_into_the_next_side) {
  constexpr int dim = TypeParam::value;
  constexpr int n = 128;  // at flatter corners the rim of the next side is nearer than its face
  const double angle = 2 * std::numbers::pi / n, inner = 20 * r;
  std::vector<Vec<2>> corners;
  for (int k = 0; k <= n; ++k)
    corners.push_back(inner / std::cos(angle / 2) * Vec<2>(std::sin((k - 0.5) * angle), -std::cos((k - 0.5) * angle)));
  auto sim = scene<dim>(0.0);
  add_line<dim>(sim, corners);
  add<dim>(sim, in_plane<dim>(0.1 * r, -inner + r), r, in_plane<dim>(0.5, 0));
  for (int k = 0; k < 1500; ++k) {
    sim.step(1e-3);
    const Vec<dim> v = velocities(sim)[0], x = positions(sim)[0];
    const double turned = std::atan2(v[1], v[0]) / angle;
    ASSERT_LT(std::hypot(x[0], x[1]), (inner - r) / std::cos(angle / 2) * (1 + 1e-8)) << k;
    if (turned < -0.5 || turned > n / 4) break;
    const double sides = std::round(turned);
    if (std::abs(turned - sides) < 1e-9) {
      ASSERT_NEAR(v.norm(), 0.5 * std::pow(std::cos(angle), sides), 1e-8) << k;
    }
  }
  EXPECT_GT(velocities(sim)[0][1], 0.1);  // up the other side
}

// Over a ridge a grain flies straight on; the side behind must not pull or brake it before.
TYPED_TEST(Walls, over_a_ridge_of_facets_a_smooth_grain_flies_straight_on) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  add_line<dim>(sim, {Vec<2>(-5 * r, 0), Vec<2>(0, 0), Vec<2>(4 * r, -3 * r)});
  add<dim>(sim, in_plane<dim>(-4.03 * r, r), r, in_plane<dim>(0.5, 0));
  for (int k = 0; k < 200; ++k) {
    sim.step(1e-3);
    ASSERT_LT((velocities(sim)[0] - in_plane<dim>(0.5, 0)).norm(), 1e-12) << k;
  }
}

}  // namespace
}  // namespace quicksand::test
