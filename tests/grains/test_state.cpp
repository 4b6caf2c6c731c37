// A restored scene goes on bit for bit; what is no state of it is refused and changes nothing.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class T>
class State : public testing::Test {};
TYPED_TEST_SUITE(State, Dimensions, DimensionName);

// A pile of rebounding grains between walls driven by velocity and by load, under forces of their own.
template <int dim>
Simulation<dim> busy_scene() {
  auto sim = scene<dim>(0.4);
  std::mt19937 random(1);
  constexpr double r = 1e-3;
  for (int k = 0; k < 36; ++k) add<dim>(sim, in_plane<dim>(2.02 * r * (k % 6), 2.02 * r * (k / 6) + r), r,
                                      in_plane<dim>(random_vector<2>(random, 0.1)[0], random_vector<2>(random, 0.1)[1]));
  sim.gravity = in_plane<dim>(0, -g);
  sim.set_restitution("grain", "grain", 0.7, 0.2);
  sim.add_plane(in_plane<dim>(0, 0), in_plane<dim>(0, 1), "wall");
  const int lid = sim.add_plane(in_plane<dim>(0, 0.0125), in_plane<dim>(0, -1), "wall");
  sim.set_load(lid, 1, -0.01, 1.0);
  sim.drive(lid, 0, 0.1);
  std::vector<Vec<dim>> force(sim.count(), in_plane<dim>(1e-3, 0));
  sim.set_force(force);
  return sim;
}

template <int dim>
void expect_same(const Simulation<dim>& a, const Simulation<dim>& b) {
  EXPECT_EQ(positions(a), positions(b));
  EXPECT_EQ(velocities(a), velocities(b));
  EXPECT_EQ(spins(a), spins(b));
  for (std::size_t w = 0; w < a.walls().size(); ++w) EXPECT_EQ(a.walls()[w].point, b.walls()[w].point);
  EXPECT_EQ(a.time(), b.time());
}

TYPED_TEST(State, a_restored_scene_goes_on_bit_for_bit) {
  constexpr int dim = TypeParam::value;
  auto sim = busy_scene<dim>();
  for (int when : {0, 1, 7, 40}) {
    for (int k = 0; k < when; ++k) sim.step(5e-4);
    auto restored = scene<dim>(0.0);
    restored.restore(sim.state());
    expect_same(sim, restored);
    EXPECT_EQ(sim.contacts().force_normal, restored.contacts().force_normal);
    long contacts = 0;
    for (int k = 0; k < 60; ++k) {
      const auto one = sim.step(5e-4), other = restored.step(5e-4);
      EXPECT_EQ(one.updates, other.updates);
      EXPECT_EQ(one.work_walls, other.work_walls);
      contacts += one.contacts;
    }
    EXPECT_GT(contacts, 5);
    expect_same(sim, restored);
    EXPECT_EQ(sim.neighbours().found, restored.neighbours().found);
  }
}

TYPED_TEST(State, what_is_no_state_is_refused_and_changes_nothing) {
  constexpr int dim = TypeParam::value;
  auto sim = busy_scene<dim>();
  sim.step(5e-4);
  const std::vector<char> good = sim.state();
  auto other = busy_scene<dim>();
  const auto before = positions(other);
  auto refused = [&](const std::vector<char>& bytes, const std::string& why) {
    try {
      other.restore(bytes);
      ADD_FAILURE() << "accepted: " << why;
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find(why), std::string::npos) << error.what();
    }
  };
  for (std::size_t keep = 0; keep < good.size(); keep += std::max<std::size_t>(good.size() / 97, 1))
    refused({good.begin(), good.begin() + static_cast<long>(keep)}, "restore: ");
  auto longer = good;
  longer.push_back(0);
  refused(longer, "too long");
  auto version = good;
  version[8 + 16 + 16 + 16] = '9';  // count, header and text of the name, header of the version
  refused(version, "version 9");
  refused(std::vector<char>(1000, 1), "restore: ");
  constexpr int other_dim = 5 - dim;
  refused(busy_scene<other_dim>().state(), "dimensions");
  EXPECT_EQ(positions(other), before);
  EXPECT_EQ(other.time(), 0.0);
}

}  // namespace
}  // namespace quicksand::test
