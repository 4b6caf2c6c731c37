// The wake of a grain against closed forms.
#include "coupling/wake.hpp"

#include <gtest/gtest.h>

namespace quicksand::coupling {
namespace {

constexpr double s = 2e-3, viscosity = 1e-3, density = 1000.0;
const double alone = 1 / (6 * std::pow(std::numbers::pi, 1.5) * viscosity * s);  // of a Gaussian force in slow flow, where its middle is

TEST(Wake, InSlowFlowIsThatOfAGaussianForce) { EXPECT_NEAR(own_wake(s, viscosity, density, 0.0, 0.0) / alone, 1.0, 1e-4); }

// int t^2/(t^2 + x^2) exp(-t^2) dt = sqrt(pi)/2 (1 - sqrt(pi) x exp(x^2) erfc(x))
TEST(Wake, IsScreenedByTheDragOfOthers) {
  for (const double x : {0.01, 0.1, 1.0, 3.0})
    EXPECT_NEAR(own_wake(s, viscosity, density, x * x / (s * s), 0.0) / alone, 1 - std::sqrt(std::numbers::pi) * x * std::exp(x * x) * std::erfc(x), 1e-4) << x;
}

// int t^2 (1 - mu^2)/(t^2 + r^2 mu^2) exp(-t^2) dt dmu over 2 sqrt(pi)/3, r = rho W s/eta, by scipy.integrate.quad
TEST(Wake, IsLeftBehindInFastFlow) {
  for (const auto& [r, expected] : {std::pair{0.1, 0.9373223}, {1.0, 0.5902767}, {10.0, 0.1191887}, {1000.0, 0.001327790}})
    EXPECT_NEAR(own_wake(s, viscosity, density, 0.0, r * viscosity / (density * s)) / alone / expected, 1.0, 1e-4) << r;
}

}  // namespace
}  // namespace quicksand::coupling
