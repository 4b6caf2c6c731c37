// What no step may change, or only by what the report says: momentum, angular momentum, energy; and what a scene must not
// depend on: where the box begins, how many threads there are.
#include "scenes.hpp"

#include <cstring>

namespace quicksand::test {
namespace {

template <class D>
class Balances : public ::testing::Test {};
TYPED_TEST_SUITE(Balances, Dimensions, DimensionName);

// 64 grains with friction and restitution that collide in a box periodic along every axis.
template <int dim>
Simulation<dim> gas(double normal, double tangential) {
  auto sim = scene<dim>(0.4, Vec<dim>::Constant(3e-3 * cells<dim>()[0]));
  sim.set_restitution("grain", "grain", normal, tangential);
  add_gas<dim>(sim, cells<dim>(), 1.0);
  return sim;
}

TYPED_TEST(Balances, collisions_keep_the_total_momentum_in_every_step) {
  constexpr int dim = TypeParam::value;
  auto sim = gas<dim>(0.7, 0.2);
  sim.settings.solve.tolerance = 1e-3;  // the balance does not wait for convergence: impulses come in opposite pairs
  auto momentum = [&] {
    Vec<dim> sum = Vec<dim>::Zero();
    for (const Body<dim>& b : sim.grains().body) sum += b.v / b.inv_m;
    return sum;
  };
  const Vec<dim> before = momentum();
  const double rounding = 1e-14 * 64 * mass<dim>(1e-3);  // 64 terms of about m x 1 m/s
  long contacts = 0;
  for (int k = 0; k < 200; ++k) {
    contacts += sim.step(2e-4).contacts;
    ASSERT_LT((momentum() - before).norm(), rounding) << k;
  }
  EXPECT_GT(contacts, 200);
}

// Impulses act on the two surfaces: closed by a gap, their torques differ by gap x p_t. Grains that touch keep it exactly.
TYPED_TEST(Balances, two_grains_that_touch_keep_their_angular_momentum_spin_included) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  sim.set_restitution("grain", "grain", 0.8, 0.3);
  std::mt19937 random(2);
  const double r = 1e-3;
  const Vec<dim> n = in_plane<dim>(0.6, 0.8);
  add<dim>(sim, Vec<dim>::Zero(), r, n + random_vector<dim>(random, 0.3), turning<dim>(400.0));
  add<dim>(sim, 3 * r * n, 2 * r, -n + random_vector<dim>(random, 0.3), turning<dim>(-100.0));
  auto angular_momentum = [&] {
    Spin<dim> sum = zero<Spin<dim>>();
    for (int k = 0; k < 2; ++k) {
      const double m = mass<dim>((k + 1) * r);
      const Vec<dim> x = positions(sim)[k], v = velocities(sim)[k];
      sum += m * Rotation<dim>::inertia * squared((k + 1) * r) * spins(sim)[k];
      if constexpr (dim == 2)
        sum += m * (x[0] * v[1] - x[1] * v[0]);
      else
        sum += m * cross(x, v);
    }
    return sum;
  };
  const Spin<dim> before = angular_momentum();
  sim.step(1e-4);
  ASSERT_GT(sim.contacts().force_tangential.at(0).norm(), 0.0);
  EXPECT_LT(std::sqrt(squared(Spin<dim>(angular_momentum() - before))), 1e-14 * mass<dim>(2 * r) * 3 * r);
}

// Everything that does work at once: a floor that shears, a lid under load, gravity, friction, restitution.
TYPED_TEST(Balances, kinetic_energy_changes_by_work_less_dissipation) {
  constexpr int dim = TypeParam::value;
  Vec<dim> period = Vec<dim>::Constant(3e-3 * cells<dim>()[0]);
  period[1] = 0;
  auto sim = scene<dim>(0.5, period);
  sim.settings.solve.tolerance = 1e-3;  // an identity of the impulses, whatever they are
  sim.set_restitution("grain", "grain", 0.5, 0.1);
  add_gas<dim>(sim, cells<dim>(), 0.3);
  const double half = 1.5e-3 * cells<dim>()[1] + 1e-3;
  const int floor = sim.add_plane(in_plane<dim>(0, -half), in_plane<dim>(0, 1), "wall");
  const int lid = sim.add_plane(in_plane<dim>(0, half), in_plane<dim>(0, -1), "wall");
  sim.gravity = in_plane<dim>(1, -g);
  sim.drive(floor, 0, 0.5);
  const double load = -20 * 64 * mass<dim>(1e-3) * g;
  sim.set_load(lid, 1, load, {});
  auto kinetic = [&] {
    double sum = 0.5 * sim.walls()[lid].mass * squared(sim.walls()[lid].v[1]);
    for (const Body<dim>& b : sim.grains().body)
      sum += 0.5 / b.inv_m * (b.v.squaredNorm() + Rotation<dim>::inertia * squared(b.s));
    return sum;
  };
  const std::vector<double> masses = sim.by_id([](const Grains<dim>& grains, int k) { return mass<dim>(grains.r[k]); });
  const double dt = 1e-4;
  double before = kinetic(), sheared = 0.0;
  for (int k = 0; k < 300; ++k) {
    const double lid_was = sim.walls()[lid].v[1];
    const std::vector<Vec<dim>> v = velocities(sim);
    const auto report = sim.step(dt);
    const double scale = std::abs(report.work_walls) + std::abs(report.work_forces) + report.dissipation + before;
    ASSERT_LT(std::abs(report.energy_balance_error), 1e-12 * scale) << k;
    ASSERT_NEAR(report.kinetic_energy, kinetic(), 1e-12 * scale);
    ASSERT_NEAR(kinetic() - before, report.work_walls + report.work_forces - report.dissipation, 1e-12 * scale);
    before = kinetic();
    if (report.sub_steps > 1) continue;
    // The work once more, from what is known in a step without sub-steps: mean force x way, load x mean speed, weight x way.
    const double lid_v = sim.walls()[lid].v[1], drag = -sim.walls()[floor].force[0];
    ASSERT_NEAR(report.work_walls, drag * 0.5 * dt + load * 0.5 * (lid_was + lid_v) * dt, 1e-12 * scale) << k;
    sheared += std::abs(drag);
    double weight = 0.0;
    for (std::size_t i = 0; i < v.size(); ++i)
      weight += masses[i] * 0.5 * dt * sim.gravity.dot(v[i] + velocities(sim)[i]);
    ASSERT_NEAR(report.work_forces, weight, 1e-12 * scale);
  }
  EXPECT_GT(sheared, 0.0);
}

// The loss is p.W p/2 - p.u^+ >= p.W p/2 when no force acts from outside (weight that closes a contact again adds to it at first
// order in h). The solver's tolerance spoils p.u^+ <= 0 by its own fraction of p.W p: only rounding is left to allow for.
TYPED_TEST(Balances, a_gas_without_restitution_loses_energy_in_every_step) {
  constexpr int dim = TypeParam::value;
  auto sim = gas<dim>(0.0, 0.0);
  sim.settings.solve.tolerance = 1e-6;
  double before = 0.0, lost = 0.0;
  for (int k = 0; k < 200; ++k) {
    const auto report = sim.step(2e-4);
    const double allowed = 1e-14 * report.kinetic_energy;
    EXPECT_GE(report.dissipation, -allowed) << k;
    if (k > 0) {
      EXPECT_LE(report.kinetic_energy, before + allowed) << k;
    }
    before = report.kinetic_energy;
    lost += report.dissipation;
  }
  EXPECT_GT(lost, 0.1 * before);
}

// Another origin gives another order of the grains, hence other rounding, which collisions amplify (see Bodies2D3D). Without
// sub-steps: how many there are depends on which pairs happen to be listed, and that on where the cells of detection lie.
TYPED_TEST(Balances, the_box_may_begin_anywhere) {
  constexpr int dim = TypeParam::value;
  std::mt19937 random(3);
  auto run = [](Simulation<dim>& sim) {
    for (int k = 0; k < 200; ++k) ASSERT_EQ(sim.step(5e-5).sub_steps, 1);
  };
  auto here = gas<dim>(0.7, 0.2);
  const std::vector<Vec<dim>> start = positions(here);
  run(here);
  for (int trial = 0; trial < 3; ++trial) {
    auto there = gas<dim>(0.7, 0.2);
    const Vec<dim> shift = random_vector<dim>(random, 0.1);
    std::vector<Vec<dim>> moved = start;
    for (Vec<dim>& x : moved) x += shift;
    there.set_position(moved);
    run(there);
    double apart = 0.0;
    for (std::size_t k = 0; k < start.size(); ++k)
      apart = std::max(apart, here.box().nearest(positions(there)[k] - positions(here)[k] - shift).norm());
    EXPECT_LT(apart, 1e-8 * 1e-3);
  }
}

TYPED_TEST(Balances, a_ball_flies_straight_through_periodic_boundaries) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.5, Vec<dim>::Constant(0.1));
  std::mt19937 random(4);
  const Vec<dim> x = random_vector<dim>(random, 0.05), v = random_vector<dim>(random, 1.0);
  add<dim>(sim, x, 0.01, v);
  for (int k = 0; k < 1000; ++k) sim.step(1e-3);
  EXPECT_LT(sim.box().nearest(positions(sim)[0] - x - v).norm(), 1e-13);
  EXPECT_EQ(velocities(sim)[0], v);
}

// Of fewer than 3000 grains three threads would not be used, nor in more than a few long steps if they turn out slower than one.
// Few sweeps suffice: what is not converged must agree as well.
TYPED_TEST(Balances, results_are_the_same_bit_for_bit_for_any_number_of_threads) {
  constexpr int dim = TypeParam::value;
  auto run = [](int threads) {
    std::array<int, dim> cells;
    cells.fill(15);
    if constexpr (dim == 2) cells = {80, 40};
    Vec<dim> period = Vec<dim>::Constant(3e-3 * cells[0]);
    period[1] = 0;
    auto sim = scene<dim>(0.5, period);
    sim.settings.solve.max_sweeps = 5;
    sim.settings.accept_unconverged = true;
    sim.settings.threads = threads;
    add_gas<dim>(sim, cells, 1.0);
    const double half = 1.5e-3 * cells[1] + 1e-3;
    sim.drive(sim.add_plane(in_plane<dim>(0, -half), in_plane<dim>(0, 1), "wall"), 1, 5.0);
    sim.drive(sim.add_plane(in_plane<dim>(0, half), in_plane<dim>(0, -1), "wall"), 0, 1.0);
    std::vector<Vec<dim>> dense = positions(sim);
    for (Vec<dim>& x : dense) x *= 0.75;  // contacts from the first step on
    sim.set_position(dense);
    for (int k = 0; k < 8; ++k) EXPECT_GT(sim.step(2e-4).contacts, 400);
    return sim;
  };
  const auto one = run(1);
  for (int threads : {2, 3}) {
    const auto many = run(threads);
    EXPECT_EQ(0, std::memcmp(positions(one).data(), positions(many).data(), one.count() * sizeof(Vec<dim>))) << threads;
    EXPECT_EQ(0, std::memcmp(velocities(one).data(), velocities(many).data(), one.count() * sizeof(Vec<dim>))) << threads;
    EXPECT_EQ(0, std::memcmp(spins(one).data(), spins(many).data(), one.count() * sizeof(Spin<dim>))) << threads;
  }
}

}  // namespace
}  // namespace quicksand::test
