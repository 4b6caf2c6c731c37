// Grains that leave a scene: the others keep their state, their contacts and what is known of their neighbours.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Remove : public ::testing::Test {};
TYPED_TEST_SUITE(Remove, Dimensions, DimensionName);

constexpr double r = 1e-3, h = 1e-4;  // [m], [s]

TYPED_TEST(Remove, the_others_close_up_in_their_order_and_keep_their_state) {
  constexpr int dim = TypeParam::value;
  std::array<int, dim> cells;
  cells.fill(4);
  auto sim = scene<dim>(0.4);
  const int wall = sim.add_plane(in_plane<dim>(0, -8 * r), in_plane<dim>(0, 1), "wall");
  sim.attach(wall, std::vector{in_plane<dim>(0, -7 * r)}, std::vector{0.5 * r}, "grain");
  add_gas<dim>(sim, cells, 1.0);
  const int n = sim.count();
  std::vector<Vec<dim>> force;
  for (int k = 0; k < n; ++k) force.push_back(in_plane<dim>(1e-4 * k, 0));
  sim.set_force(force);
  sim.set_drag(std::vector<double>(n, 1e-3), force);
  for (int k = 0; k < 20; ++k) sim.step(h);
  const auto x = positions(sim), v = velocities(sim), drag = sim.drag_impulse();
  const auto s = spins(sim);
  const long found = sim.neighbours().found;
  const std::vector<int> ids{n - 1, 0, 5, 6};
  sim.remove(ids);
  ASSERT_EQ(sim.count(), n - 4);
  const auto forces = sim.by_id([](const Grains<dim>& grains, int k) { return grains.force[k]; });
  for (int k = 0, old = 1; k < n - 4; ++k, ++old) {
    while (std::find(ids.begin(), ids.end(), old) != ids.end()) ++old;
    EXPECT_EQ(positions(sim)[k], x[old]);
    EXPECT_EQ(velocities(sim)[k], v[old]);
    EXPECT_EQ(spins(sim)[k], s[old]);
    EXPECT_EQ(forces[k], force[old]);
    EXPECT_EQ(sim.drag_impulse()[k], drag[old]);
  }
  for (const auto list = sim.contacts(); const auto j : list.j) EXPECT_LT(j, n - 4);

  // From here on as if the others had been alone: velocities agree to rounding of what they pass on in some collisions.
  auto alone = scene<dim>(0.4);
  alone.add_plane(in_plane<dim>(0, -8 * r), in_plane<dim>(0, 1), "wall");
  alone.attach(wall, std::vector{in_plane<dim>(0, -7 * r)}, std::vector{0.5 * r}, "grain");
  const auto radii = sim.by_id([](const Grains<dim>& grains, int k) { return grains.r[k]; });
  for (int k = 0; k < sim.count(); ++k) add<dim>(alone, positions(sim)[k], radii[k], velocities(sim)[k], spins(sim)[k]);
  alone.set_force(forces);
  alone.set_drag(std::vector<double>(n - 4, 1e-3), forces);
  sim.set_drag(std::vector<double>(n - 4, 1e-3), forces);
  sim.step(h / 4), alone.step(h / 4);
  EXPECT_EQ(sim.neighbours().found, found);  // the list is still good
  long contacts = 0;
  for (int k = 0; k < 120; ++k) {
    const auto report = sim.step(h / 4);
    ASSERT_EQ(report.sub_steps + alone.step(h / 4).sub_steps, 2);  // their number depends on what is listed
    contacts += report.contacts;
    for (int i = 0; i < sim.count(); ++i) ASSERT_LT((velocities(sim)[i] - velocities(alone)[i]).norm(), 1e-6) << k;
  }
  EXPECT_GT(contacts, 5);
}

// Two columns; one goes, the other stands, with the forces it had and from its solution. Then its upper half goes.
TYPED_TEST(Remove, what_is_left_of_a_pile_at_rest_stays_at_rest) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(10);
  for (int k = 0; k < 10; ++k) add<dim>(sim, in_plane<dim>(5 * r, (2 * k + 1) * r), r);
  sim.settings.solver = Solver::nlgs;
  for (int k = 0; k < 5; ++k) sim.step(h);
  sim.remove(std::vector{0, 1, 2, 3, 4, 5, 6, 7, 8, 9});
  const auto list = sim.contacts();
  ASSERT_EQ(list.i.size(), 10u);
  double weight = 0.0;
  for (const double f : list.force_normal) weight = std::max(weight, f);
  EXPECT_NEAR(weight, 10 * mass<dim>(r) * g, 1e-7 * weight);
  EXPECT_LE(sim.step(h).sweeps, 1);
  auto restored = scene<dim>(0.0);
  sim.remove(std::vector{5, 6, 7, 8, 9});
  restored.restore(sim.state());
  for (int k = 0; k < 5; ++k) sim.step(h), restored.step(h);
  EXPECT_EQ(velocities(sim), velocities(restored));
  EXPECT_NEAR(sim.walls()[0].force[1], -5 * mass<dim>(r) * g, 1e-7 * weight);
  for (const Vec<dim>& v : velocities(sim)) EXPECT_LT(v.norm(), 1e-9);
}

TYPED_TEST(Remove, ids_that_are_none_or_named_twice_are_refused_and_all_may_leave) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(3);
  sim.step(h);
  for (const auto& bad : {std::vector{3}, {-1}, {0, 2, 0}}) EXPECT_THROW(sim.remove(bad), std::invalid_argument);
  EXPECT_EQ(sim.count(), 3);
  sim.remove(std::vector{0, 1, 2});
  EXPECT_EQ(sim.count(), 0);
  EXPECT_EQ(sim.step(h).contacts, 0);
  add<dim>(sim, in_plane<dim>(0, r), r);
  sim.step(h);
  EXPECT_NEAR(sim.walls()[0].force[1], -mass<dim>(r) * g, 1e-7 * mass<dim>(r) * g);
}

}  // namespace
}  // namespace quicksand::test
