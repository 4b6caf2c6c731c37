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
      {add_one(zero, 1e300), "add: radius must be between 1e-30 and 1e30 m, got 1e+300"},
      {add_one(zero, 0.013), "add: a period must be at least four diameters, got 0.1 m"},
      {mistake([&] { sim.add({}, std::vector{1.0}, density, {}, {}, "grain"); }), "add: one radius per grain"},
      {mistake([&] { sim.set_friction("grain", "wall", -0.1); }), "set_friction: friction must be >= 0 and finite, got -0.1"},
      {mistake([&] { sim.set_friction("grain", "wall", nan); }), "set_friction: friction"},
      {mistake([&] { sim.set_restitution("grain", "wall", 1.1, 0); }), "set_restitution: normal restitution must be in [0, 1]"},
      {mistake([&] { sim.set_restitution("grain", "marble", 1, 0); }), "set_restitution: unknown material 'marble'"},
      {mistake([&] { sim.set_inertia(0); }), "set_inertia: I/(m r^2) must be in (0, 1], got 0"},
      {mistake([&] { sim.add_plane(zero, zero, "wall"); }), "add_plane: normal"},
      {mistake([&] { sim.add_segment(zero, zero, "wall"); }), "add_segment: "},
      {mistake([&] { sim.drive(wall + 1, 0, 0); }), "drive: no wall 1, the scene has 1"},
      {mistake([&] { sim.drive(wall, 0, nan); }), "drive: velocity must be finite"},
      {mistake([&] { sim.set_load(wall, 1, infinity, {}); }), "set_load: load must be finite"},
      {mistake([&] { sim.set_load(wall, 1, 1.0, 0.0); }), "set_load: mass must be > 0 kg, got 0"},
      {mistake([&] { sim.attach(wall, {&zero, 1}, std::vector{-1.0}, "grain"); }), "attach: radius must be > 0 m, got -1"},
      {mistake([&] { sim.attach(wall, {&zero, 1}, std::vector{0.013}, "grain"); }), "attach: a period must be at least four diameters"},
      {mistake([&] { sim.add_plane(zero, in_plane<dim>(1, 1), "wall"); }), "add_plane: normal must be 0 along a periodic axis"},
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
    EXPECT_TRUE(mistake([&] { sim.set_load(wall, axis, 0.0, {}); }).starts_with("set_load: ")) << axis;
  }
}

// Each mistake of a start, put right again by what follows it: nothing has moved in between.
TYPED_TEST(Errors, a_step_from_an_impossible_start_is_refused_and_moves_nothing) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3, in_plane<dim>(0.1, 0));
  sim.gravity = in_plane<dim>(0, -g);
  const double r = 1e-3;
  const Vec<dim> left = in_plane<dim>(-0.0497, 2 * r), right = in_plane<dim>(0.0497, 2 * r), apart = in_plane<dim>(0, 2 * r);
  add<dim>(sim, left, r);
  add<dim>(sim, right, 2 * r);
  auto start = [&](std::vector<Vec<dim>> x) {
    sim.set_position(x);
    const std::string told = mistake([&] { sim.step(1e-3); });
    EXPECT_EQ(sim.time(), 0.0);
    for (int k = 0; k < 2; ++k) EXPECT_EQ((velocities(sim)[k].norm() + (positions(sim)[k] - x[k]).norm()), 0.0);
    return told;
  };
  EXPECT_TRUE(start({left, right}).starts_with("step: grain 0 and grain 1 overlap by 0.0024")) << start({left, right});  // across the boundary
  const int floor = sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  EXPECT_TRUE(start({apart, in_plane<dim>(0.02, -r)}).starts_with("step: grain 1 is 0.001 m behind wall 0"));
  sim.attach(floor, {&apart, 1}, {&r, 1}, "grain");
  EXPECT_TRUE(start({apart, in_plane<dim>(0.02, r)}).starts_with("step: a grain fixed to wall 0 and grain 0 overlap by 0.002 m"));
  sim.set_position(std::vector{in_plane<dim>(0.04, r), in_plane<dim>(0.02, 2 * r)});
  sim.gravity[1] = nan;
  EXPECT_TRUE(mistake([&] { sim.step(1e-3); }).starts_with("step: gravity must be finite"));
  sim.gravity[1] = -g;
  sim.settings.threads = 0;
  EXPECT_EQ(mistake([&] { sim.step(1e-3); }), "step: threads must be 1 to 1024, got 0");
  sim.settings.threads = 1;
  EXPECT_TRUE(mistake([&] { sim.step(1e20); }).starts_with("step: dt = 1e+20 s takes more than 1e9 sub-steps"));
  sim.check(1e-3);
  sim.step(1e-3);
  EXPECT_EQ(sim.time(), 1e-3);
  sim.add_plane(in_plane<dim>(0, -r), in_plane<dim>(0, -1), "wall");
  EXPECT_EQ(mistake([&] { sim.step(1e-3); }), "step: walls 0 and 1 cross: they face each other over -0.001 m");
  EXPECT_EQ(sim.time(), 1e-3);
}

// A grain that drops in later must not have its default mass fixed by a first step that failed.
TYPED_TEST(Errors, a_refused_step_does_not_fix_the_mass_of_a_loaded_wall) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.3);
  const int wall = sim.add_plane(in_plane<dim>(0, -0.1), in_plane<dim>(0, 1), "wall");
  sim.set_load(wall, 1, 0.0, {});
  add<dim>(sim, Vec<dim>::Zero(), 1e-3);
  EXPECT_NE(mistake([&] { sim.step(0.0); }), "no error");
  sim.gravity[0] = nan;
  EXPECT_NE(mistake([&] { sim.step(1e-3); }), "no error");
  sim.gravity[0] = 0;
  add<dim>(sim, in_plane<dim>(0.1, 0), 1e-3);
  sim.step(1e-3);
  EXPECT_DOUBLE_EQ(sim.walls()[wall].mass, 0.2 * mass<dim>(1e-3));
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
