// A user's mistake is an exception that names the function, the rule and the value.
#include "scenes.hpp"

#include <limits>

namespace quicksand::test {
namespace {

template <class D>
class Errors : public ::testing::Test {};
TYPED_TEST_SUITE(Errors, Dimensions, DimensionName);

template <class Act>
std::string mistake(Act&& act) {
  try {
    act();
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "no error";
}

const double nan = std::numeric_limits<double>::quiet_NaN(), infinity = std::numeric_limits<double>::infinity();

TYPED_TEST(Errors, a_mistake_is_told_with_function_rule_and_value) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3, in_plane<dim>(0.1, 0));
  const Vec<dim> zero = Vec<dim>::Zero(), up = in_plane<dim>(0, 1);
  const int wall = sim.add_plane(zero, up, "wall");
  auto add_one = [&](const Vec<dim>& x, double r, double rho = density, const char* material = "grain") {
    return mistake([&] { sim.add({&x, 1}, {&r, 1}, rho, {}, {}, material); });
  };
  const std::pair<std::string, std::string> expected[] = {
      {add_one(zero, -0.001), "add: radius must be > 0 m, got -0.001 (grain 0)"},
      {add_one(zero, 0.0), "add: radius must be > 0 m, got 0"},
      {add_one(zero, nan), "add: radius"},
      {add_one(in_plane<dim>(0, nan), 0.001), "add: position [m] must be finite"},
      {add_one(zero, 0.001, 0.0), "add: density must be > 0 kg/m^3, got 0"},
      {add_one(zero, 0.001, infinity), "add: density"},
      {add_one(zero, 0.001, density, "marble"), "add: unknown material 'marble'"},
      {add_one(zero, 0.013), "add: a period must be at least four diameters, got 0.1 m"},
      {mistake([&] { sim.add({}, std::vector{1.0}, density, {}, {}, "grain"); }), "add: one radius per grain"},
      {mistake([&] { sim.set_friction("grain", "wall", -0.1); }), "set_friction: friction must be >= 0, got -0.1"},
      {mistake([&] { sim.set_friction("grain", "wall", nan); }), "set_friction: friction"},
      {mistake([&] { sim.set_restitution("grain", "wall", 1.1, 0); }), "set_restitution: normal restitution must be in [0, 1]"},
      {mistake([&] { sim.set_restitution("grain", "marble", 1, 0); }), "set_restitution: unknown material 'marble'"},
      {mistake([&] { sim.set_inertia(0); }), "set_inertia: I/(m r^2) must be in (0, 1], got 0"},
      {mistake([&] { sim.add_plane(zero, zero, "wall"); }), "add_plane: normal"},
      {mistake([&] { sim.add_segment(zero, zero, "wall"); }), "add_segment: "},
      {mistake([&] { sim.drive(wall + 1, 0, 0); }), "drive: no wall 1, the scene has 1"},
      {mistake([&] { sim.drive(wall, 0, nan); }), "drive: velocity must be finite"},
      {mistake([&] { sim.load(wall, 1, infinity, {}); }), "load: load must be finite"},
      {mistake([&] { sim.load(wall, 1, 1.0, 0.0); }), "load: mass must be > 0 kg, got 0"},
      {mistake([&] { sim.attach(wall, {&zero, 1}, std::vector{-1.0}, "grain"); }), "attach: radius must be > 0 m, got -1"},
      {mistake([&] { sim.set_force({&zero, 1}); }), "set_force: one force per grain, got 1 for 0 grains"},
      {mistake([&] { sim.set_velocity({&zero, 1}); }), "set_velocity: one velocity per grain"},
      {mistake([&] { sim.step(0.0); }), "step: dt must be > 0 s, got 0"},
      {mistake([&] { sim.step(nan); }), "step: dt"},
      {mistake([&] { Simulation<dim>{-up}; }), "Simulation: period must be > 0 m"},
  };
  for (const auto& [told, start] : expected) EXPECT_TRUE(told.starts_with(start)) << told << "\n instead of: " << start;
  EXPECT_EQ(sim.count(), 0);  // nothing of what failed was added
}

TYPED_TEST(Errors, an_axis_that_the_scene_does_not_have_is_refused) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  const int wall = sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  for (int axis : {-1, dim}) {
    EXPECT_TRUE(mistake([&] { sim.drive(wall, axis, 0.0); }).starts_with("drive: ")) << axis;
    EXPECT_TRUE(mistake([&] { sim.load(wall, axis, 0.0, {}); }).starts_with("load: ")) << axis;
  }
}

// Only pairs that can meet: friction between walls means nothing.
TYPED_TEST(Errors, a_pair_of_materials_without_friction_is_refused_when_it_can_meet) {
  constexpr int dim = TypeParam::value;
  Simulation<dim> sim(Vec<dim>::Zero());
  sim.set_friction("steel", "steel", 0.1);
  sim.set_friction("glass", "glass", 0.1);
  const Vec<dim> x = Vec<dim>::Zero();
  const double r = 1e-3;
  sim.add({&x, 1}, {&r, 1}, density, {}, {}, "glass");
  sim.step(1e-3);
  sim.add_plane(in_plane<dim>(0, -1), in_plane<dim>(0, 1), "steel");
  const std::string told = mistake([&] { sim.step(1e-3); });
  EXPECT_TRUE(told.starts_with("step: no friction set between 'glass' and 'steel'")) << told;
}

}  // namespace
}  // namespace quicksand::test
