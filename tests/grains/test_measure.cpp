// Slices of grains, profiles and hexagonal order, against geometry.
#include "grains/measure.hpp"
#include "scenes.hpp"

#include <numeric>

namespace quicksand::test {
namespace {

template <class D>
class Measure : public ::testing::Test {};
TYPED_TEST_SUITE(Measure, Dimensions, DimensionName);

TYPED_TEST(Measure, slices_of_a_grain_add_up_to_the_grain) {
  constexpr int dim = TypeParam::value;
  const double r = 0.3, all = solid_volume<dim>(r);
  EXPECT_EQ(solid_below<dim>(r, -r), 0.0);
  EXPECT_EQ(solid_below<dim>(r, -5.0), 0.0);
  EXPECT_NEAR(solid_below<dim>(r, 0.0), 0.5 * all, 1e-16);
  EXPECT_NEAR(solid_below<dim>(r, r), all, 1e-16);
  EXPECT_NEAR(solid_below<dim>(r, 5.0), all, 1e-16);
  // dV/dz is the cut: 2 sqrt(r^2 - z^2) of a disc, pi (r^2 - z^2) of a sphere. Central differences: h^2/6 times the third
  // derivative, at most 2e-7 here.
  for (double z : {-0.2, 0.05, 0.25}) {
    const double half = std::sqrt(r * r - z * z), cut = dim == 2 ? 2 * half : std::numbers::pi * half * half, h = 1e-5;
    EXPECT_NEAR((solid_below<dim>(r, z + h) - solid_below<dim>(r, z - h)) / (2 * h), cut, 1e-7);
    EXPECT_NEAR(solid_below<dim>(r, z) + solid_below<dim>(r, -z), all, 1e-15);
  }
}

TYPED_TEST(Measure, a_profile_holds_every_grain_once_and_returns_a_uniform_velocity) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  std::array<int, dim> cells;
  cells.fill(5);
  add_gas<dim>(sim, cells, 1.0);
  const Vec<dim> v = in_plane<dim>(0.3, -0.7);
  sim.set_velocity(std::vector<Vec<dim>>(sim.count(), v));
  double solid = 0.0;
  for (double r : sim.grains().r) solid += solid_volume<dim>(r);
  for (int axis = 0; axis < dim; ++axis) {
    const Profile<dim> p = profile(sim, axis, -8e-3, 8e-3, 37);
    EXPECT_NEAR(std::accumulate(p.solid.begin(), p.solid.end(), 0.0), solid, 1e-13 * solid);
    for (int b = 0; b < 37; ++b) {
      EXPECT_NEAR((p.momentum[b] - p.solid[b] * v).norm(), 0.0, 1e-14 * solid);
      EXPECT_NEAR((p.second[b] - p.solid[b] * v.cwiseAbs2()).norm(), 0.0, 1e-14 * solid);
    }
  }
}

TYPED_TEST(Measure, a_wall_and_the_grains_fixed_to_it_are_no_part_of_a_profile) {
  constexpr int dim = TypeParam::value;
  auto sim = scene<dim>(0.0);
  sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  const Vec<dim> x = in_plane<dim>(0, 1e-3);
  const double r = 1e-3;
  sim.attach(0, {&x, 1}, {&r, 1}, "grain");
  EXPECT_EQ(profile(sim, 1, 0.0, 2e-3, 1).solid[0], 0.0);
}

// Rows 2 d apart from each other by d sin 60: each grain has six neighbours at 60 degrees, also through the period.
TEST(Psi6, is_one_in_a_hexagonal_crystal_wherever_it_is_turned_and_zero_on_a_square_lattice) {
  const double d = 2e-3;
  auto crystal = scene<2>(0.0, Vec<2>(10 * d, 10 * d * std::sqrt(3)));
  for (int row = 0; row < 20; ++row)
    for (int k = 0; k < 10; ++k)
      add<2>(crystal, Vec<2>((k + 0.5 * (row % 2)) * d, row * d * std::sqrt(0.75)), 0.5 * d);
  EXPECT_NEAR(psi6(crystal, -1, 1), 1.0, 1e-12);

  auto turned = scene<2>(0.0);
  auto square = scene<2>(0.0, Vec<2>(10 * d, 10 * d));
  for (int row = 0; row < 10; ++row)
    for (int k = 0; k < 10; ++k) {
      const Vec<2> x((k + 0.5 * (row % 2)) * d, row * d * std::sqrt(0.75));
      add<2>(turned, Vec<2>(0.8 * x[0] - 0.6 * x[1], 0.6 * x[0] + 0.8 * x[1]), 0.5 * d);
      add<2>(square, Vec<2>(k * d, row * d), 0.5 * d);
    }
  EXPECT_NEAR(psi6(turned, -1, 1), 1.0, 1e-12);
  EXPECT_NEAR(psi6(square, -1, 1), 0.0, 1e-12);  // 6 x 90 degrees: two bonds cancel two
  EXPECT_TRUE(std::isnan(psi6(square, 1, 2)));
}

TEST(Psi6, counts_a_grain_without_neighbours_as_zero) {
  auto sim = scene<2>(0.0);
  add<2>(sim, Vec<2>(0, 0), 1e-3);
  add<2>(sim, Vec<2>(2e-3, 0), 1e-3);
  add<2>(sim, Vec<2>(9e-3, 0), 1e-3);
  EXPECT_NEAR(psi6(sim, -1, 1), 2.0 / 3, 1e-12);
}

}  // namespace
}  // namespace quicksand::test
