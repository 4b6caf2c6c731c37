// Two bodies that meet, against the exact exchange of momentum.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Collisions : public ::testing::Test {};
TYPED_TEST_SUITE(Collisions, Dimensions, DimensionName);

constexpr double r = 0.01;  // [m]

// At u h = 30 r the ball is far beyond the floor at the end of a step without contact.
TYPED_TEST(Collisions, a_ball_rebounds_from_a_wall_with_its_restitution_at_any_step) {
  constexpr int dim = TypeParam::value;
  for (double dt : {1e-4, 1e-2, 0.3}) {
    for (double e : {0.0, 0.5, 1.0}) {
      auto sim = scene<dim>(0.0, in_plane<dim>(8 * r, 0));  // the smallest period there is
      sim.set_restitution("grain", "wall", e, 0.0);
      sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
      add<dim>(sim, in_plane<dim>(0, 1.5 * r), r, in_plane<dim>(0.3, -1));
      for (int k = 0; k < std::max(3.0, 0.02 / dt); ++k) sim.step(dt);
      EXPECT_NEAR(velocities(sim)[0][1], e, 1e-8) << dt;
      EXPECT_EQ(velocities(sim)[0][0], 0.3);
      EXPECT_GE(positions(sim)[0][1], r * (1 - 1e-8)) << dt;
    }
  }
}

TYPED_TEST(Collisions, a_ball_meets_a_wall_that_was_far_away_at_the_start_of_the_step) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  add<dim>(sim, in_plane<dim>(0, 10 * r), r, in_plane<dim>(0, -1));
  sim.step(0.2);  // 20 r in one step
  EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r);
}

TYPED_TEST(Collisions, a_grain_meets_another_that_was_far_away_at_the_start_of_the_step) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  add<dim>(sim, in_plane<dim>(-10 * r, 0), r, in_plane<dim>(1, 0));
  add<dim>(sim, in_plane<dim>(0, 0), r);
  sim.step(0.2);  // 20 r in one step
  EXPECT_NEAR(velocities(sim)[0][0], 0.5, 1e-8);  // e = 0: both go on with half the speed
  EXPECT_NEAR(velocities(sim)[1][0], 0.5, 1e-8);
}

TYPED_TEST(Collisions, unequal_grains_head_on_exchange_momentum_by_newtons_law) {
  constexpr int dim = TypeParam::value;
  const double e = 0.6, m1 = mass<dim>(r), m2 = mass<dim>(3 * r);
  for (double dt : {1e-4, 1e-3, 1e-2}) {
    auto sim = scene<dim>(0.5);
    sim.set_restitution("grain", "grain", e, 0.0);
    add<dim>(sim, in_plane<dim>(-1.1 * r, 0), r, in_plane<dim>(1, 0));
    add<dim>(sim, in_plane<dim>(3.1 * r, 0), 3 * r, in_plane<dim>(-1, 0));
    for (double t = 0; t < 0.01; t += dt) sim.step(dt);
    const double centre = (m1 - m2) / (m1 + m2);  // velocity of the centre of mass; relative velocity 2 becomes -2 e
    EXPECT_NEAR(velocities(sim)[0][0], centre - 2 * e * m2 / (m1 + m2), 1e-8) << dt;
    EXPECT_NEAR(velocities(sim)[1][0], centre + 2 * e * m1 / (m1 + m2), 1e-8) << dt;
  }
}

TYPED_TEST(Collisions, a_perfectly_elastic_ball_keeps_its_energy_over_hundreds_of_bounces) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  sim.set_restitution("grain", "wall", 1.0, 0.0);
  sim.add_plane(in_plane<dim>(0, -2 * r), in_plane<dim>(0, 1), "wall");
  sim.add_plane(in_plane<dim>(0, 2 * r), in_plane<dim>(0, -1), "wall");
  add<dim>(sim, Vec<dim>::Zero(), r, in_plane<dim>(0, 1));
  int bounces = 0;
  for (int k = 0; k < 10000; ++k) {
    const double before = velocities(sim)[0][1];
    sim.step(1e-3);
    bounces += before * velocities(sim)[0][1] < 0;
  }
  EXPECT_GE(bounces, 499);  // a way of 2 r is 20 steps long, less what it turns short of each wall: up to one step
  EXPECT_LE(bounces, 556);
  EXPECT_NEAR(std::abs(velocities(sim)[0][1]), 1.0, 500 * 1e-9);  // the solver's tolerance in each
}

// The first ball strikes the second, which touches the third while that moves off: the third must not be struck by more than there is.
TYPED_TEST(Collisions, a_ball_struck_while_its_neighbour_moves_off_makes_no_energy) {
  constexpr int dim = TypeParam::value;
  for (double e : {0.3, 0.8, 1.0})
    for (double leaving : {0.0, 0.1, 0.5, 0.9}) {
      auto sim = scene<dim>(0.0);
      sim.set_restitution("grain", "grain", e, 0.0);
      for (int k = 0; k < 3; ++k) add<dim>(sim, in_plane<dim>(2 * k * r, 0), r, in_plane<dim>(k == 0 ? 1 : k == 1 ? 0 : leaving, 0));
      const double before = 0.5 * mass<dim>(r) * (1 + squared(leaving));
      const auto report = sim.step(1e-5);
      EXPECT_LE(report.kinetic_energy, before * (1 + 1e-8)) << e << " " << leaving;
      if (e == 1) { EXPECT_NEAR(report.kinetic_energy, before, 1e-8 * before) << leaving; }
      if (e == 1 && leaving == 0.5) {  // one after the other: 1 and 2 exchange velocities, then 2 and 3 do
        EXPECT_NEAR(velocities(sim)[0][0], 0.0, 1e-8);
        EXPECT_NEAR(velocities(sim)[1][0], 1.0, 1e-8);
        EXPECT_NEAR(velocities(sim)[2][0], 0.5, 1e-8);
      }
    }
}

// As if all were at e = 0 the second ball would not reach the third in this step, but it rebounds twice as fast.
TYPED_TEST(Collisions, a_ball_that_rebounds_towards_a_third_hands_on_all_its_energy) {
  constexpr int dim = TypeParam::value;
  const double h = 1e-4;
  auto sim = scene<dim>(0.0);
  sim.set_restitution("grain", "grain", 1.0, 0.0);
  for (int k = 0; k < 3; ++k) add<dim>(sim, in_plane<dim>(2 * k * r + (k == 2 ? 0.7 * h : 0), 0), r, in_plane<dim>(k == 0 ? 1 : 0, 0));
  sim.step(h);
  EXPECT_LE(sim.step(h).max_overlap, 0.3 * h * (1 + 1e-6));  // it goes h where there was room for 0.7 h
  for (int k = 0; k < 3; ++k) EXPECT_NEAR(velocities(sim)[k][0], k == 2 ? 1.0 : 0.0, 1e-8);
}

TYPED_TEST(Collisions, approaches_below_the_rest_speed_do_not_rebound) {
  constexpr int dim = TypeParam::value;
  for (double speed : {0.009, 0.011}) {
    auto sim = scene<dim>(0.0);
    sim.settings.rest_speed = 0.01;
    sim.set_restitution("grain", "wall", 0.5, 0.0);
    sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0, 1.001 * r), r, in_plane<dim>(0, -speed));
    for (int k = 0; k < 5; ++k) sim.step(1e-3);
    EXPECT_NEAR(velocities(sim)[0][1], speed < 0.01 ? 0.0 : 0.5 * speed, 1e-10);
  }
}

// Foerster, Louge, Chang and Allia, Phys. Fluids 6 (1994). u = relative velocity of the points in contact; psi1 = -u_t^-/u_n^-,
// psi2 = -u_t^+/u_n^-, along the direction of u_t^-. With k = 1 + m r^2/I, 7/2 for spheres and 3 for discs:
//   sliding psi2 = psi1 - k (1+e) mu,   sticking psi2 = -beta0 psi1,   whichever changes psi less.
struct Material {
  double r, rho, e, mu, beta0;
  bool wall;
};
const Material measured[] = {
    {1.59e-3, 2500, 0.97, 0.092, 0.44, false},  // soda-lime glass
    {1.59e-3, 2500, 0.831, 0.125, 0.31, true},  // the same on a wall
    {2.995e-3, 1319, 0.87, 0.25, 0.43, false},  // cellulose acetate
};

template <int dim>
Vec<dim> velocity_of_surface(const Vec<dim>& v, const Spin<dim>& omega, const Vec<dim>& n, double radius) {
  return v + tangent_vector(n, Tangent<dim>(cross(Spin<dim>(radius * omega), n)));
}

TYPED_TEST(Collisions, oblique_impacts_slide_or_stick_as_in_the_experiments_of_foerster) {
  constexpr int dim = TypeParam::value;
  const double k = 1 + 1 / Rotation<dim>::inertia;
  const Vec<dim> n = in_plane<dim>(0.6, 0.8);  // from the first body to the second
  Tangent<dim> t;
  if constexpr (dim == 2)
    t = 1.0;
  else
    t = Vec<3>(0.48, -0.36, 0.8);  // out of the plane
  for (const Material& m : measured) {
    for (double psi1 = 0.1; psi1 < 6; psi1 += 0.3) {
      auto sim = scene<dim>(m.mu);
      sim.set_restitution("grain", "grain", m.e, m.beta0);
      sim.set_restitution("grain", "wall", m.e, m.beta0);
      // One half of the slip comes from the spins, the other from the centres.
      const Vec<dim> v = 0.7 * (-n + 0.5 * psi1 * tangent_vector(n, t));
      const Spin<dim> omega = -0.7 * 0.5 * psi1 / m.r * turn(n, t);
      if (m.wall)
        sim.add_plane(Vec<dim>::Zero(), n, "wall");
      else
        add<dim>(sim, -m.r * n, m.r, Vec<dim>::Zero(), zero<Spin<dim>>(), m.rho);
      const int j = add<dim>(sim, (1 + 1e-9) * m.r * n, m.r, v, omega, m.rho);
      sim.step(1e-5);
      const Vec<dim> first = m.wall ? Vec<dim>(Vec<dim>::Zero()) : velocity_of_surface<dim>(velocities(sim)[0], spins(sim)[0], n, m.r);
      const Vec<dim> u = velocity_of_surface<dim>(velocities(sim)[j], spins(sim)[j], n, -m.r) - first;
      const double psi2 = std::max(psi1 - k * (1 + m.e) * m.mu, -m.beta0 * psi1);
      EXPECT_NEAR(u.dot(n), 0.7 * m.e, 1e-8) << psi1;
      EXPECT_NEAR(std::sqrt(squared(Tangent<dim>(tangential(u, n) - 0.7 * psi2 * t))), 0.0, 1e-8) << psi1;
    }
  }
}

TYPED_TEST(Collisions, grains_collide_across_every_periodic_boundary) {
  constexpr int dim = TypeParam::value;
  for (int axis = 0; axis < dim; ++axis) {
    auto sim = scene<dim>(0.0, Vec<dim>::Constant(0.1));
    sim.set_restitution("grain", "grain", 1.0, 0.0);
    Vec<dim> x = Vec<dim>::Constant(0.017), y = x;
    x[axis] = 0.05 - 1.2 * r, y[axis] = -0.05 + 1.2 * r;
    add<dim>(sim, x, r, Vec<dim>::Unit(axis));
    add<dim>(sim, y, r, -Vec<dim>::Unit(axis));
    for (int k = 0; k < 5; ++k) sim.step(1e-3);
    EXPECT_NEAR((velocities(sim)[0] + Vec<dim>::Unit(axis)).norm(), 0.0, 1e-8) << axis;
    EXPECT_NEAR((velocities(sim)[1] - Vec<dim>::Unit(axis)).norm(), 0.0, 1e-8) << axis;
  }
}

}  // namespace
}  // namespace quicksand::test
