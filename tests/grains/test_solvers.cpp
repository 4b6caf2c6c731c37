// The contact law and its error measure, what happens when the tolerance is missed, and how a step is divided.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Solvers : public ::testing::Test {};
TYPED_TEST_SUITE(Solvers, Dimensions, DimensionName);

template <int dim>
Tangent<dim> tangent(double t) {  // in the plane of contact of n = the first axis
  if constexpr (dim == 2)
    return t;
  else
    return {0.0, 0.6 * t, 0.8 * t};
}

TYPED_TEST(Solvers, the_natural_map_vanishes_exactly_where_the_contact_obeys_its_law) {
  constexpr int dim = TypeParam::value;
  const double mu = 0.4, rho = 0.7;  // rounding: |e| of some 1e-16, squared
  const auto e2 = [&](double p_n, double p_t, double w_n, double w_t) {
    return natural_map<dim>({p_n, tangent<dim>(p_t)}, w_n, tangent<dim>(w_t), rho, mu);
  };
  EXPECT_EQ(e2(0, 0, 0.5, 0.3), 0);             // open
  EXPECT_EQ(e2(0, 0, 0, 0), 0);                 // touching without force
  EXPECT_EQ(natural_map<dim>({0, tangent<dim>(0)}, 0.5, tangent<dim>(0), rho, 0.0), 0);  // open, without friction
  EXPECT_LT(e2(2, 0.5, 0, 0), 1e-30);           // sticking
  EXPECT_LT(e2(2, -mu * 2, 0, 0), 1e-30);       // about to slide
  EXPECT_LT(e2(2, -mu * 2, 0, 0.9), 1e-30);     // sliding, friction against it
  EXPECT_GT(e2(2, mu * 2, 0, 0.9), 0.1);        // sliding, friction with it
  EXPECT_GT(e2(2, -mu * 1.9, 0, 0.9), 1e-4);    // sliding with less friction than there is
  EXPECT_GT(e2(0, 0, -1e-3, 0), 1e-8);          // penetrating
}

TYPED_TEST(Solvers, the_natural_map_of_simple_violations_is_known_in_closed_form) {
  constexpr int dim = TypeParam::value;
  const double mu = 0.4, rho = 0.7;
  const auto e = [&](double p_n, double p_t, double w_n, double w_t) {
    return std::sqrt(natural_map<dim>({p_n, tangent<dim>(p_t)}, w_n, tangent<dim>(w_t), rho, mu));
  };
  EXPECT_NEAR(e(0, 0, -0.3, 0), rho * 0.3, 1e-15);                              // the impulse that would stop it
  EXPECT_NEAR(e(2, 0, 0.3, 0), rho * 0.3, 1e-15);                               // pushing while it opens,
  EXPECT_NEAR(e(0.1, 0, 0.3, 0), 0.1, 1e-15);                                   // by no more than there is to take away
  EXPECT_NEAR(e(2, 0, 0, 0.1), rho * 0.1 * std::sqrt(1 + mu * mu), 1e-15);      // slipping within the cone: (mu w_t, w_t)
  EXPECT_NEAR(e(2, 2, 0, 0), (2 - mu * 2) / std::sqrt(1 + mu * mu), 1e-15);     // distance from the cone
}

// One contact at a time is solved exactly by obey_coulomb with both steps 1/W: whatever the state, the result has no error.
TYPED_TEST(Solvers, one_update_of_a_contact_obeys_the_law) {
  constexpr int dim = TypeParam::value;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> any(-1, 1);
  const double w_nn = 1.3, w_tt = 4.1, mu = 0.4;
  for (int trial = 0; trial < 100; ++trial) {
    const Impulse<dim> p{std::abs(any(random)), tangent<dim>(any(random))};
    const double u_n = any(random);
    const Tangent<dim> u_t = tangent<dim>(any(random));
    const Impulse<dim> next = obey_coulomb<dim>(p, u_n, u_t, 1 / w_nn, 1 / w_tt, mu);
    const Tangent<dim> after = u_t + w_tt * (next.t - p.t);
    EXPECT_LT(natural_map<dim>(next, u_n + w_nn * (next.n - p.n), after, 1 / w_nn, mu), 1e-28);
  }
}

// From zero impulses a sweep carries weight by one contact: one sweep cannot bring 30 to balance.
TYPED_TEST(Solvers, a_step_that_misses_its_tolerance_throws_unless_accepted_and_then_counts_it) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(30);
  sim.settings.solver = Solver::active_set;
  sim.settings.solve.max_sweeps = 1;
  try {
    sim.step(1e-3);
    FAIL() << "did not throw";
  } catch (const NotConverged& error) {
    EXPECT_TRUE(std::string(error.what()).starts_with("step: residual")) << error.what();
  }
  sim.settings.accept_unconverged = true;
  auto report = sim.step(1e-3);
  EXPECT_EQ(report.unconverged, 1);
  EXPECT_GT(report.residual, sim.settings.solve.tolerance);
  EXPECT_LE(report.sweeps, 1);
  sim.settings.solve.max_sweeps = 10000;
  report = sim.step(1e-3);
  EXPECT_EQ(report.unconverged, 0);
  EXPECT_LE(report.residual, sim.settings.solve.tolerance);
}

// The residual is local: a column needs some steps until what it hides, errors that vary smoothly over the height, has gone too.
TYPED_TEST(Solvers, a_column_at_rest_starts_from_its_solution_and_needs_few_rounds_of_sweeps) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(30);
  sim.settings.solver = Solver::active_set;
  const int cold = sim.step(1e-3).sweeps;
  for (int k = 0; k < 50; ++k) sim.step(1e-3);
  for (double dt : {1e-3, 0.3e-3}) {  // impulses are scaled with the step
    int sweeps = 0;
    for (int k = 0; k < 20; ++k) sweeps += sim.step(dt).sweeps;
    EXPECT_LE(30 * sweeps, 20 * cold) << dt;
  }
}

// A sub-step adds at most the error allowed to one contact, a share of the tolerance in diameters; repair keeps that from adding up.
// Sweeps carry a force one layer at a time: thousands for 320 layers. Newton needs a handful, and W of a column factorises in O(n).
TYPED_TEST(Solvers, a_tall_narrow_column_costs_some_newton_steps_and_no_thousands_of_sweeps) {
  constexpr int dim = TypeParam::value;
  for (const bool in_a_shaft : {false, true}) {
    auto sim = column<dim>(320);
    if (in_a_shaft)  // contacts with walls at all heights
      for (const double side : {-1.0, 1.0}) sim.add_plane(in_plane<dim>(1e-3 * side, 0), in_plane<dim>(-side, 0), "wall");
    const auto report = sim.step(1e-3);
    EXPECT_EQ(report.unconverged, 0);
    EXPECT_LT(report.sweeps, 400);
    double weight = 0.0;
    for (const Body<dim>& b : sim.grains().body) weight += g / b.inv_m;
    EXPECT_NEAR(-sim.walls()[0].force[1], weight, 0.01 * weight);
  }
}

TYPED_TEST(Solvers, overlaps_do_not_add_up_beyond_the_tolerance_in_diameters_however_loose_it_is) {
  constexpr int dim = TypeParam::value;
  for (Solver solver : {Solver::nlgs, Solver::active_set})
    for (double tolerance : {1e-3, 1e-2, 1e-1}) {
      auto sim = column<dim>(30);
      sim.settings.solver = solver;
      sim.settings.solve.tolerance = tolerance;
      double first = 0.0, last = 0.0;
      for (int k = 0; k < 100; ++k) first = std::max(first, sim.step(1e-3).max_overlap);
      for (int k = 0; k < 400; ++k) sim.step(1e-3);
      for (int k = 0; k < 100; ++k) last = std::max(last, sim.step(1e-3).max_overlap);
      EXPECT_LT(first, 1.5 * tolerance * 2e-3) << tolerance;
      EXPECT_LT(last, 1.5 * tolerance * 2e-3) << tolerance;
    }
}

// -------------------------------------------------------------------------------------------------------------- sub-steps

template <int dim>
Simulation<dim> passing(double speed, double drift) {  // two grains side by side; one passes the other
  const double r = 1e-3;
  auto sim = scene<dim>(0.0);
  add<dim>(sim, in_plane<dim>(0, 0), r, in_plane<dim>(drift, 0));
  add<dim>(sim, in_plane<dim>(0, 2.01 * r), r, in_plane<dim>(drift + speed, 0));
  return sim;
}

TYPED_TEST(Solvers, a_step_is_cut_so_that_no_pair_moves_by_more_than_a_tenth_of_its_distance) {
  constexpr int dim = TypeParam::value;
  for (double way : {0.05, 0.35, 0.79})  // of the distance 2 r in 1 ms
    for (double drift : {0.0, 50.0}) {
      auto sim = passing<dim>(2.0 * way, drift);  // [m/s]
      EXPECT_EQ(sim.step(1e-3).sub_steps, std::ceil(way / 0.1)) << way << ", " << drift;
      sim.settings.sub_step_motion = 0.02;
      EXPECT_EQ(sim.step(0.1e-3).sub_steps, std::ceil(0.1 * way / 0.02)) << way << ", " << drift;
    }
}

TYPED_TEST(Solvers, the_absolute_rule_cuts_by_the_largest_speed_and_the_smallest_radius) {
  constexpr int dim = TypeParam::value;
  for (double drift : {0.1, 5.0}) {
    auto sim = passing<dim>(0.0, drift);
    sim.settings.sub_steps = SubSteps::absolute;
    EXPECT_EQ(sim.step(1e-3).sub_steps, std::ceil(8 * drift * 1e-3 / 1e-3));
  }
}

}  // namespace
}  // namespace quicksand::test
