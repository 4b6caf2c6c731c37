// Walls: driven and loaded, flat and rough, segments; and the stress between plates, which must add up to the load.
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

}  // namespace
}  // namespace quicksand::test
