// One body and columns of them, against rigid-body mechanics in closed form.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Bodies : public ::testing::Test {};
TYPED_TEST_SUITE(Bodies, Dimensions, DimensionName);

constexpr double r = 0.01;  // [m]

TYPED_TEST(Bodies, a_falling_ball_stops_at_the_floor_neither_above_nor_below_it) {
  constexpr int dim = TypeParam::value;
  for (double dt : {1e-4, 1e-3, 1e-2}) {
    auto sim = scene<dim>(0.3);
    sim.gravity = in_plane<dim>(0, -g);
    const int floor = sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0.0, 3 * r), r);  // falls 2 r in 64 ms
    for (double t = 0; t < 0.1; t += dt) {
      sim.step(dt);
      EXPECT_GE(positions(sim)[0][1] - r, -1e-8 * r) << dt;  // the gap closes by -gap/h: to the solver's tolerance
    }
    EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r) << dt;
    EXPECT_NEAR(velocities(sim)[0].norm(), 0.0, 1e-8 * g * dt) << dt;
    EXPECT_NEAR(sim.walls()[floor].force[1], -mass<dim>(r) * g, 1e-8 * mass<dim>(r) * g) << dt;
  }
}

// Forces are constant while the body slides, and what a body has left when it starts to roll is its angular momentum about the
// point of contact, which no friction changes: the scheme, first order in general, is exact in both.
TYPED_TEST(Bodies, sliding_turns_into_rolling_when_friction_has_spun_the_body_up) {
  constexpr int dim = TypeParam::value;
  const double mu = 0.2, u0 = 1.0, dt = 1e-3, inertia = Rotation<dim>::inertia;
  const double rolling = u0 / (1 + inertia);             // sphere: 5/7 u0, disc: 2/3 u0
  const double t_roll = (u0 - rolling) / (mu * g);       // sphere: 2 u0/(7 mu g), disc: u0/(3 mu g)
  auto sim = scene<dim>(mu);
  sim.gravity = in_plane<dim>(0, -g);
  sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  add<dim>(sim, in_plane<dim>(0, r), r, in_plane<dim>(u0, 0));
  double dissipated = 0.0;
  while (sim.time() < 1.5 * t_roll) {
    dissipated += sim.step(dt).dissipation;
    const double u = velocities(sim)[0][0], omega = in_plane(spins(sim)[0]);
    if (sim.time() < t_roll) {
      EXPECT_NEAR(u, u0 - mu * g * sim.time(), 1e-8);
      EXPECT_NEAR(omega * r, -mu * g * sim.time() / inertia, 1e-8);
    } else if (sim.time() > t_roll + dt) {
      EXPECT_NEAR(u, rolling, 1e-8);
      EXPECT_NEAR(omega * r, -rolling, 1e-8);
    }
  }
  EXPECT_NEAR(dissipated, 0.5 * mass<dim>(r) * (u0 * u0 - (1 + inertia) * rolling * rolling), 1e-8 * mass<dim>(r));
}

// A block cannot be built of grains that turn: above the limit of rolling the law of a grain is the block's, g (sin - mu cos).
TYPED_TEST(Bodies, on_a_slope_a_body_rolls_below_the_slip_limit_and_slides_like_a_block_above) {
  constexpr int dim = TypeParam::value;
  const double mu = 0.2, dt = 1e-3, inertia = Rotation<dim>::inertia;
  const double limit = mu * (1 + 1 / inertia);  // tan(alpha): disc 3 mu, sphere 7/2 mu
  for (double slope : {0.5 * limit, 0.99 * limit, 1.01 * limit, 2 * limit}) {
    const double alpha = std::atan(slope);
    auto sim = scene<dim>(mu);
    sim.gravity = in_plane<dim>(g * std::sin(alpha), -g * std::cos(alpha));
    sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0, r), r);
    for (int k = 0; k < 100; ++k) sim.step(dt);
    const double a = slope < limit ? g * std::sin(alpha) / (1 + inertia)  // disc 2/3, sphere 5/7 of g sin
                                   : g * (std::sin(alpha) - mu * std::cos(alpha));
    EXPECT_NEAR(velocities(sim)[0][0], a * 100 * dt, 1e-8) << slope;  // constant forces: exact
    EXPECT_NEAR(positions(sim)[0][1], r, 1e-8 * r);
  }
}

// The residual is local; over a column of n grains it bounds the error only up to a factor n^2, the condition number.
TYPED_TEST(Bodies, in_a_column_each_contact_bears_the_weight_above_whichever_the_solver) {
  constexpr int dim = TypeParam::value;
  for (Solver solver : {Solver::nlgs, Solver::active_set}) {
    auto sim = scene<dim>(0.3);
    sim.settings.solver = solver;
    sim.settings.solve.tolerance = 1e-10;
    sim.gravity = in_plane<dim>(0, -g);
    const int floor = sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    const int n = 20;
    std::vector<double> weight_from(n + 1, 0.0);
    double top = 0.0;
    for (int k = 0; k < n; ++k) {
      const double radius = r * (1 + 0.5 * std::sin(k));
      add<dim>(sim, in_plane<dim>(0.0, top + radius), radius);
      weight_from[k] = mass<dim>(radius) * g;
      top += 2 * radius;
    }
    for (int k = n - 1; k >= 0; --k) weight_from[k] += weight_from[k + 1];
    for (int k = 0; k < 5; ++k) sim.step(1e-3);

    const double error = n * n * 1e-10 * weight_from[0];
    const ContactList<dim> contacts = sim.contacts();
    ASSERT_EQ(contacts.i.size(), n);
    for (std::size_t c = 0; c < contacts.i.size(); ++c)
      EXPECT_NEAR(contacts.force_normal[c], weight_from[contacts.j[c]], error) << contacts.i[c] << " under " << contacts.j[c];
    EXPECT_NEAR(sim.walls()[floor].force[1], -weight_from[0], error);
    for (const Vec<dim>& v : velocities(sim)) EXPECT_LT(v.norm(), n * n * 1e-8 * g * 1e-3);
  }
}

TYPED_TEST(Bodies, a_force_reaches_the_grain_of_its_number_wherever_that_is_sorted) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  for (int k = 0; k < 20; ++k) add<dim>(sim, in_plane<dim>((k * 7 % 20) * 10 * r, 0), r);
  std::vector<Vec<dim>> force;
  for (int k = 0; k < 20; ++k) force.push_back(in_plane<dim>(0, k * mass<dim>(r)));
  sim.set_force(force);  // the first step sorts
  for (int k = 0; k < 10; ++k) sim.step(1e-3);
  for (int k = 0; k < 20; ++k) EXPECT_NEAR(velocities(sim)[k][1], k * 10e-3, 1e-14) << k;
  for (Vec<dim>& f : force) f = -f;
  sim.set_force(force);  // now that they are sorted
  for (int k = 0; k < 10; ++k) sim.step(1e-3);
  for (int k = 0; k < 20; ++k) EXPECT_NEAR(velocities(sim)[k][1], 0.0, 1e-14) << k;
  sim.set_force({});
  sim.gravity = in_plane<dim>(-1, 0);
  sim.step(1e-3);
  for (int k = 0; k < 20; ++k) EXPECT_NEAR(velocities(sim)[k][0], -1e-3, 1e-15) << k;
}

// The same arithmetic in the same order up to rounding, which collisions amplify: each multiplies a difference by about the free
// way over the radius, some hundredfold over this run.
TEST(Bodies2D3D, spheres_with_the_mass_and_inertia_of_discs_move_like_them_in_a_plane) {
  auto disc = scene<2>(0.4);
  auto sphere = scene<3>(0.4);
  sphere.set_inertia(0.5);
  add_gas<2>(disc, {6, 6}, 1.0);
  auto build = [](auto& sim, auto dim) {
    sim.settings.solver = Solver::nlgs;  // active_set leaves out contacts by fours in 2D and one by one in 3D
    sim.settings.solve.tolerance = 1e-5;  // what is left is the same in both
    sim.gravity = in_plane<dim>(0, -g);
    sim.set_restitution("grain", "grain", 0.7, 0.2);
    sim.add_plane(in_plane<dim>(0, -0.01), in_plane<dim>(0, 1), "wall");
    sim.add_plane(in_plane<dim>(-0.01, 0), in_plane<dim>(1, 0), "wall");
    sim.add_plane(in_plane<dim>(0.01, 0), in_plane<dim>(-1, 0), "wall");
  };
  build(disc, std::integral_constant<int, 2>{});
  build(sphere, std::integral_constant<int, 3>{});
  const auto radius = disc.by_id([](const Grains<2>& grains, int k) { return grains.r[k]; });
  for (std::size_t k = 0; k < radius.size(); ++k) {
    const Vec<2> x = positions(disc)[k], v = velocities(disc)[k];
    add<3>(sphere, in_plane<3>(x[0], x[1]), radius[k], in_plane<3>(v[0], v[1]), turning<3>(spins(disc)[k]),
           density * 3 / (4 * radius[k]));
  }
  long contacts = 0;
  for (int k = 0; k < 200; ++k) {
    const auto in_2d = disc.step(2e-4);
    const auto in_3d = sphere.step(2e-4);
    contacts += in_2d.contacts;
    EXPECT_EQ(in_2d.sub_steps, in_3d.sub_steps);
  }
  EXPECT_GT(contacts, 100);  // it is no free flight
  for (std::size_t k = 0; k < radius.size(); ++k) {
    const Vec<3> x = positions(sphere)[k];
    EXPECT_NEAR((x.head<2>() - positions(disc)[k]).norm(), 0.0, 1e-9 * radius[k]) << k;
    EXPECT_NEAR(spins(sphere)[k].z(), spins(disc)[k], 1e-9 / radius[k]) << k;
    EXPECT_EQ(x.z(), 0.0);
  }
}

}  // namespace
}  // namespace quicksand::test
