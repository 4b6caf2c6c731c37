// Drag, implicit in the contact problem: what it does to one grain, to grains that touch, and to the balances.
// k = h gamma/m, a = m_a/m throughout [-].
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Drag : public ::testing::Test {};
TYPED_TEST_SUITE(Drag, Dimensions, DimensionName);

constexpr double r = 1e-3, h = 1e-4;  // [m], [s]

template <int dim>
void set_drag(Simulation<dim>& sim, const std::vector<double>& k, const Vec<dim>& u, const std::vector<double>& a = {}) {
  const std::vector<double> masses = sim.by_id([](const Grains<dim>& grains, int i) { return 1.0 / grains.body[i].inv_m; });
  std::vector<double> gamma, added;
  for (std::size_t i = 0; i < masses.size(); ++i) gamma.push_back(k[i] * masses[i] / h);
  for (std::size_t i = 0; i < a.size(); ++i) added.push_back(a[i] * masses[i]);
  sim.set_drag(gamma, std::vector<Vec<dim>>(masses.size(), u), added);
}

constexpr std::array ks{1e-3, 1.0, 1e3, 1e6};

// (m + m_a)(v+ - v) = h (m g + F) + h gamma (u - v+)
TYPED_TEST(Drag, a_free_grain_follows_implicit_euler_however_stiff_and_keeps_its_spin) {
  constexpr int dim = TypeParam::value;
  for (const auto& [k, a] : {std::pair{1e-3, 0.0}, {1.0, 0.0}, {1e3, 0.0}, {1e6, 0.0}, {0.0, 0.5}, {1.0, 5.0}, {1e3, 0.2}, {1e-3, 500.0}}) {
    auto sim = scene<dim>(0.3);
    sim.gravity = in_plane<dim>(0, -g);
    Vec<dim> v = in_plane<dim>(0.03, -0.02);
    const Vec<dim> u = in_plane<dim>(-0.05, 0.1);
    add<dim>(sim, Vec<dim>::Zero(), r, v, turning<dim>(3.0));
    if (a > 0)
      set_drag<dim>(sim, {k}, u, {a});
    else
      set_drag<dim>(sim, {k}, u);
    const Vec<dim> force = mass<dim>(r) * in_plane<dim>(3.0, 1.0);
    sim.set_force({&force, 1});
    const Vec<dim> pull = sim.gravity + in_plane<dim>(3.0, 1.0);
    for (int n = 0; n < 20; ++n) {
      const Vec<dim> before = v;
      ASSERT_EQ(sim.step(h).sub_steps, 1);
      v = ((1 + a) * v + h * pull + k * u) / (1 + a + k);
      ASSERT_LT((velocities(sim)[0] - v).norm(), 1e-15) << k << " " << a;
      // To rounding of h gamma u and m_a v:
      ASSERT_LT((sim.drag_impulse()[0] - mass<dim>(r) * (v - before - h * pull)).norm(), 1e-16 * (1 + k + a) * mass<dim>(r)) << k << " " << a;
      ASSERT_EQ(sim.contact_impulse()[0], Vec<dim>(Vec<dim>::Zero()));
      ASSERT_EQ(sim.in_contact()[0], 0);
    }
    EXPECT_EQ(in_plane(spins(sim)[0]), 3.0);
  }
}

// Two grains that touch, stick and are dragged by unlike coefficients: one contact, its W_nn and W_tt by hand.
TYPED_TEST(Drag, a_sticking_contact_moves_heavy_centres_and_light_spins) {
  constexpr int dim = TypeParam::value;
  const double none = 0.0;
  for (const auto& [k_1, k_2, e_1, e_2] : {std::array{0.0, 3.0, none, none}, {40.0, 0.1, none, none}, {1e6, 2.0, none, none}, {1e4, 1e6, none, none}, {0.0, 0.0, 2.0, 0.3}, {3.0, 0.1, 0.0, 50.0}}) {
    for (const Solver solver : {Solver::nlgs, Solver::active_set, Solver::accelerated, Solver::newton, Solver::automatic}) {
      auto sim = scene<dim>(100.0);
      sim.settings.solver = solver;
      SCOPED_TRACE(testing::Message() << "k " << k_1 << " " << k_2 << ", a " << e_1 << " " << e_2 << ", solver " << static_cast<int>(solver));
      const Vec<dim> v_1 = in_plane<dim>(0.02, 0.0), v_2 = in_plane<dim>(-0.01, 0.013);
      add<dim>(sim, in_plane<dim>(0, 0), r, v_1, turning<dim>(2.0));
      add<dim>(sim, in_plane<dim>(2.5 * r, 0), 1.5 * r, v_2, turning<dim>(-1.0));
      set_drag<dim>(sim, {k_1, k_2}, Vec<dim>::Zero(), {e_1, e_2});
      ASSERT_EQ(sim.step(h).sub_steps, 1);

      const double m_1 = mass<dim>(r), m_2 = mass<dim>(1.5 * r), a_1 = 1 / (m_1 * (1 + e_1 + k_1)), a_2 = 1 / (m_2 * (1 + e_2 + k_2));
      const double b_1 = 1 / (Rotation<dim>::inertia * m_1), b_2 = 1 / (Rotation<dim>::inertia * m_2);
      const double left_1 = (1 + e_1) / (1 + e_1 + k_1), left_2 = (1 + e_2) / (1 + e_2 + k_2);
      const Vec<dim> u = left_2 * v_2 - left_1 * v_1;
      const double s_1 = 2.0 * r, s_2 = -1.5 * r, p_n = -u[0] / (a_1 + a_2), p_t = -(u[1] - s_1 - s_2) / (a_1 + a_2 + b_1 + b_2);
      ASSERT_GT(p_n, 0.0);
      ASSERT_LT(std::abs(p_t), 100 * p_n);
      const Vec<dim> p = in_plane<dim>(p_n, p_t);
      EXPECT_LT((velocities(sim)[0] - left_1 * v_1 + a_1 * p).norm(), 1e-10 * 0.02);
      EXPECT_LT((velocities(sim)[1] - left_2 * v_2 - a_2 * p).norm(), 1e-10 * 0.02);
      EXPECT_NEAR(in_plane(spins(sim)[0]) * r, s_1 - b_1 * p_t, 1e-10 * 0.02);
      EXPECT_NEAR(in_plane(spins(sim)[1]) * 1.5 * r, s_2 - b_2 * p_t, 1e-10 * 0.02);
      EXPECT_LT((sim.contact_impulse()[1] - p).norm(), 1e-8 * p.norm());
      EXPECT_LT((sim.contact_impulse()[0] + p).norm(), 1e-8 * p.norm());
      EXPECT_EQ(sim.in_contact(), (std::vector<std::uint8_t>{1, 1}));
    }
  }
}

TYPED_TEST(Drag, a_collision_keeps_the_momentum_of_grains_and_of_the_fluid_that_goes_along) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  sim.settings.solve.tolerance = 1e-12;
  sim.set_restitution("grain", "grain", 0.8, 0.0);
  add<dim>(sim, in_plane<dim>(0, 0), r, in_plane<dim>(0.05, 0.01));
  add<dim>(sim, in_plane<dim>(2.5 * r, 0), 1.5 * r, in_plane<dim>(-0.02, 0));
  set_drag<dim>(sim, {0, 0}, Vec<dim>::Zero(), {4.0, 0.25});
  const double m_1 = 5.0 * mass<dim>(r), m_2 = 1.25 * mass<dim>(1.5 * r);
  const Vec<dim> before = m_1 * velocities(sim)[0] + m_2 * velocities(sim)[1];
  const auto report = sim.step(h);
  const Vec<dim> v_1 = velocities(sim)[0], v_2 = velocities(sim)[1];
  EXPECT_NEAR(v_2[0] - v_1[0], 0.8 * 0.07, 1e-12);
  EXPECT_LT((m_1 * v_1 + m_2 * v_2 - before).norm(), 1e-14 * before.norm());
  EXPECT_LT(std::abs(report.energy_balance_error), 1e-12 * report.kinetic_energy);
  const Vec<dim> grains = mass<dim>(r) * (v_1 - in_plane<dim>(0.05, 0.01)) + mass<dim>(1.5 * r) * (v_2 - in_plane<dim>(-0.02, 0));
  EXPECT_LT((grains - sim.drag_impulse()[0] - sim.drag_impulse()[1]).norm(), 1e-14 * before.norm());  // theirs alone is not kept
  EXPECT_GT(grains.norm(), 0.1 * before.norm());
}

TYPED_TEST(Drag, a_grain_pressed_on_a_wall_bears_the_drag_there_and_rests) {
  constexpr int dim = TypeParam::value;
  for (const double k : ks) {
    auto sim = scene<dim>(0.3);
    sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0, r), r);
    const Vec<dim> u = in_plane<dim>(0, -0.1);
    set_drag<dim>(sim, {k}, u);
    for (int n = 0; n < 5; ++n) sim.step(h);
    const double force = k * mass<dim>(r) / h * 0.1;
    EXPECT_LT(velocities(sim)[0].norm(), 1e-12 * 0.1);
    EXPECT_NEAR(sim.walls()[0].force[1], -force, 1e-9 * force) << k;
    EXPECT_NEAR(sim.contact_impulse()[0][1], h * force, 1e-9 * h * force) << k;
    EXPECT_NEAR(sim.drag_impulse()[0][1], -h * force, 1e-9 * h * force) << k;
    EXPECT_EQ(sim.in_contact()[0], 1);
  }
}

// Rolling without slip, the spin keeps its own inertia I while the centre is as heavy as m + h gamma:
//   (m + I/r^2 + h gamma) v+ = (m + I/r^2) v + h m g sin(theta),  with the terminal speed m g sin(theta)/gamma.
TYPED_TEST(Drag, down_an_incline_a_grain_rolls_at_the_speed_that_its_torque_balance_gives) {
  constexpr int dim = TypeParam::value;
  const double theta = std::numbers::pi / 6, rolls = 1 + Rotation<dim>::inertia;
  for (const double k : ks) {
    auto sim = scene<dim>(0.5);
    sim.gravity = in_plane<dim>(g * std::sin(theta), -g * std::cos(theta));
    sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0, r), r);
    set_drag<dim>(sim, {k}, Vec<dim>::Zero());
    double v = 0.0;
    for (int n = 0; n < 30; ++n) {
      ASSERT_EQ(sim.step(h).sub_steps, 1);
      v = (rolls * v + h * g * std::sin(theta)) / (rolls + k);
      ASSERT_NEAR(velocities(sim)[0][0], v, 1e-8 * v) << k;  // ten times the tolerance
      ASSERT_NEAR(in_plane(spins(sim)[0]), -v / r, 1e-8 * v / r) << k;
    }
    if (k >= 1) {
      EXPECT_NEAR(v, h * g * std::sin(theta) / k, 1e-5 * v);
    }
  }
}

TYPED_TEST(Drag, a_rising_fluid_holds_a_stack_under_a_ceiling) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  sim.gravity = in_plane<dim>(0, -g);
  sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, -1), "wall");
  std::vector<double> k;
  double force = 0.0;  // drag less weight
  for (int n = 0; n < 6; ++n) {
    add<dim>(sim, in_plane<dim>(0, -(2 * n + 1) * r), r);
    k.push_back(std::pow(10.0, n - 2));
    force += mass<dim>(r) * (k.back() / h * 0.5 - g);
  }
  set_drag<dim>(sim, k, in_plane<dim>(0, 0.5));
  for (int n = 0; n < 20; ++n) sim.step(h);
  EXPECT_NEAR(sim.walls()[0].force[1], force, 1e-7 * force);
  for (const Vec<dim>& v : velocities(sim)) EXPECT_LT(v.norm(), 1e-8);
}

// Everything at once: a periodic gas on a floor, with friction, both restitutions, drag from none to stiff, and added mass from none to much.
template <int dim>
Simulation<dim> dragged_gas(double speed) {
  Vec<dim> period = Vec<dim>::Constant(3e-3 * cells<dim>()[0]);
  period[1] = 0;
  auto sim = scene<dim>(0.4, period);
  sim.set_restitution("grain", "grain", 0.6, 0.2);
  sim.set_restitution("grain", "wall", 0.3, 0.1);
  sim.gravity = in_plane<dim>(0, -g);
  sim.add_plane(in_plane<dim>(0, -1.5e-3 * cells<dim>()[1] - 1e-3), in_plane<dim>(0, 1), "wall");
  add_gas<dim>(sim, cells<dim>(), speed);
  std::vector<double> k, a;
  for (int n = 0; n < sim.count(); ++n) k.push_back(n % 4 == 0 ? 0.0 : std::pow(10.0, n % 4 - 3)), a.push_back(n % 3 == 0 ? 0.0 : std::pow(10.0, n % 3 - 1.5));
  set_drag<dim>(sim, k, in_plane<dim>(0.3, -1.0), a);
  return sim;
}

TYPED_TEST(Drag, impulses_of_drag_and_contacts_are_all_that_changes_momentum_and_energy_balances) {
  constexpr int dim = TypeParam::value;
  auto sim = dragged_gas<dim>(0.5);
  sim.settings.solve.tolerance = 1e-3;  // identities of the impulses, whatever they are
  const std::vector<double> m = sim.by_id([](const Grains<dim>& grains, int k) { return 1.0 / grains.body[k].inv_m; });
  const double rounding = 1e-12 * mass<dim>(r);  // of a thousand terms of about m x 1 m/s
  long contacts = 0;
  double power = 0.0;
  for (int n = 0; n < 400; ++n) {
    const std::vector<Vec<dim>> before = velocities(sim);
    const auto report = sim.step(h);
    const std::vector<Vec<dim>> after = velocities(sim);
    Vec<dim> internal = h * sim.walls()[0].force;
    double work = 0.0;
    for (int k = 0; k < sim.count(); ++k) {
      const Vec<dim> p = sim.drag_impulse()[k] + sim.contact_impulse()[k] + m[k] * h * sim.gravity;
      ASSERT_LT((m[k] * (after[k] - before[k]) - p).norm(), rounding) << n;
      if (sim.in_contact()[k] == 0) {
        ASSERT_EQ(sim.contact_impulse()[k].norm(), 0.0);
      }
      internal += sim.contact_impulse()[k];
      work += 0.5 * (sim.drag_impulse()[k] + m[k] * h * sim.gravity).dot(before[k] + after[k]);
    }
    ASSERT_LT(internal.norm(), rounding) << n;
    const double scale = std::abs(report.work_forces) + report.dissipation + report.kinetic_energy;
    ASSERT_LT(std::abs(report.energy_balance_error), 1e-12 * scale) << n;
    if (report.sub_steps == 1) {
      ASSERT_NEAR(report.work_forces, work, 1e-12 * scale) << n;
      power += report.work_forces;
    }
    contacts += report.contacts;
    EXPECT_EQ(sim.by_id([](const Grains<dim>& grains, int k) { return 1.0 / grains.body[k].inv_m; }), m);
  }
  auto restored = scene<dim>(0.0, sim.box().period);
  restored.restore(sim.state());
  sim.step(h), restored.step(h);
  EXPECT_EQ(velocities(sim), velocities(restored));
  EXPECT_GT(contacts, 200);
  EXPECT_NE(power, 0.0);
}

// Tangential restitution: u_t+ = -e_t u_t-, with drag that of before the sub-step, at a contact that sticks.
TYPED_TEST(Drag, a_dragged_grain_rebounds_from_a_wall_with_both_restitutions) {
  constexpr int dim = TypeParam::value;
  for (const double k : ks) {
    auto sim = scene<dim>(1e4);
    sim.settings.solve.tolerance = 1e-12;
    sim.set_restitution("grain", "wall", 0.8, 0.4);
    sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
    add<dim>(sim, in_plane<dim>(0, r), r, in_plane<dim>(0.03, -0.05), turning<dim>(5.0));
    set_drag<dim>(sim, {k}, Vec<dim>::Zero());
    const double u_t = 0.03 + 5.0 * r;
    sim.step(h);
    const Vec<dim> v = velocities(sim)[0];
    EXPECT_NEAR(v[1], 0.8 * 0.05, 1e-12) << k;
    EXPECT_NEAR(v[0] + r * in_plane(spins(sim)[0]), -0.4 * u_t, 1e-11) << k;
    // Of the tangential impulse the spin takes r p_t/I, the centre p_t/(m (1 + k)).
    const double p_t = (v[0] - 0.03 / (1 + k)) * (1 + k);
    EXPECT_NEAR((in_plane(spins(sim)[0]) - 5.0) * r, p_t / Rotation<dim>::inertia, 1e-15 * (1 + k) + 1e-12) << k;
  }
}

// Columns side by side, thrown together and pressed on a floor: packs of four in 2D, both restitutions, slip and stick. In a column no
// impulse can be traded for another, so velocities are unique (in a heap, dry or not, they need not be, and tight tolerances cycle).
TYPED_TEST(Drag, every_solver_finds_the_same_velocities_under_mixed_drag) {
  constexpr int dim = TypeParam::value;
  auto start = scene<dim>(0.3);
  start.set_restitution("grain", "grain", 0.5, 0.2);
  start.gravity = in_plane<dim>(0, -g);
  start.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  std::mt19937 random(3);
  std::vector<double> k;
  for (int column = 0; column < 12; ++column)
    for (int layer = 0; layer < 6; ++layer) {
      add<dim>(start, in_plane<dim>(3 * r * column, (2 * layer + 1) * r), r, random_vector<dim>(random, 0.05), turning<dim>(20.0 * column));
      k.push_back(std::pow(10.0, (5 * layer + column) % 7 - 3));
    }
  set_drag<dim>(start, k, in_plane<dim>(0.02, -0.03));
  std::vector<std::vector<Vec<dim>>> found;
  for (const Solver solver : {Solver::nlgs, Solver::active_set, Solver::accelerated, Solver::newton, Solver::automatic}) {
    auto sim = start;
    sim.settings.solver = solver;
    sim.settings.solve.max_sweeps = 100000;
    long contacts = 0;
    for (int n = 0; n < 5; ++n) contacts += sim.step(h).contacts;
    EXPECT_GT(contacts, 5 * 20);
    found.push_back(velocities(sim));
    const auto [problem, impulses] = sim.contact_problem();  // W of effective masses: its error is that of the step
    EXPECT_LT(global_error(problem, impulses), 1e-6);
  }
  for (const auto& v : found)
    for (std::size_t i = 0; i < v.size(); ++i) EXPECT_LT((v[i] - found[0][i]).norm(), 1e-7) << i;  // residuals are local: tolerance x layers^2 x steps
}

TYPED_TEST(Drag, none_is_as_if_there_had_never_been_any_and_zero_drag_differs_by_rounding) {
  constexpr int dim = TypeParam::value;
  auto never = dragged_gas<dim>(0.5), none = never, zero_drag = never;
  never.set_drag({}, {});
  none.step(1e-9);
  none.restore(never.state());
  set_drag<dim>(zero_drag, std::vector<double>(zero_drag.count(), 0.0), Vec<dim>::Zero());
  for (int n = 0; n < 20; ++n) never.step(h), none.step(h), zero_drag.step(h);
  EXPECT_EQ(velocities(never), velocities(none));
  for (int k = 0; k < never.count(); ++k) EXPECT_LT((velocities(never)[k] - velocities(zero_drag)[k]).norm(), 1e-6);
}

TYPED_TEST(Drag, bad_input_is_refused_and_grains_added_later_have_none) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  add<dim>(sim, Vec<dim>::Zero(), r);
  EXPECT_THROW(sim.drag_impulse(), std::invalid_argument);
  const std::vector<Vec<dim>> u{in_plane<dim>(1, 0)};
  for (const double bad : {-1.0, std::nan(""), 1e300}) EXPECT_THROW(sim.set_drag(std::vector{bad}, u), std::invalid_argument);
  EXPECT_THROW(sim.set_drag(std::vector{1.0, 1.0}, u), std::invalid_argument);
  EXPECT_THROW(sim.set_drag(std::vector{1.0}, {}), std::invalid_argument);
  EXPECT_THROW(sim.set_drag({}, u), std::invalid_argument);
  EXPECT_THROW(sim.set_drag(std::vector{1.0}, std::vector<Vec<dim>>{Vec<dim>::Constant(std::nan(""))}), std::invalid_argument);
  EXPECT_THROW(sim.drag_impulse(), std::invalid_argument);
  sim.set_drag(std::vector{1.0}, u);
  add<dim>(sim, in_plane<dim>(1, 0), r);
  sim.step(h);
  EXPECT_GT(velocities(sim)[0][0], 0.0);
  EXPECT_EQ(velocities(sim)[1].norm(), 0.0);
  EXPECT_EQ(sim.drag_impulse().size(), 2u);
  const std::vector<double> none{0.0, 0.0};
  const std::vector<Vec<dim>> still(2, Vec<dim>::Zero());
  for (const double bad : {-1.0, std::nan(""), 1e300}) EXPECT_THROW(sim.set_drag(none, still, std::vector{1.0, bad}), std::invalid_argument);
  EXPECT_THROW(sim.set_drag(none, still, std::vector{1.0}), std::invalid_argument);
  EXPECT_THROW(sim.set_drag({}, {}, std::vector{1.0, 1.0}), std::invalid_argument);
  // Added mass keeps to its grain when another is removed.
  sim.set_velocity(still);
  set_drag<dim>(sim, none, Vec<dim>::Zero(), {7.0, 3.0});
  sim.remove(std::vector{0});
  add<dim>(sim, in_plane<dim>(2, 0), r);
  sim.gravity = in_plane<dim>(0, -g);
  sim.step(h);
  EXPECT_NEAR(velocities(sim)[0][1], -h * g / 4, 1e-15);
  EXPECT_NEAR(velocities(sim)[1][1], -h * g, 1e-15);
}

}  // namespace
}  // namespace quicksand::test
