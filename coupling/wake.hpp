// What a sphere's own wake adds to the flow that is seen where it is. A law of drag asks for the flow without the grain; the averaged flow has the
// grain's force F in it, spread as by a Gaussian of variance 2 s^2, and so stands still with the grain in part. In 3D, steady, about a grain that the
// fluid passes at speed W, and among others that drag the fluid too (H. C. Brinkman, Appl. Sci. Res. A1 (1947); C. W. Oseen (1910)):
//   u_own = -G F,   G = 1/(8 pi^3) int exp(-k^2 s^2) (1 - mu^2) Re 1/(eta (k^2 + kappa^2) + i rho W k mu) d^3k,   mu = cos(k, W),
// 1/(6 pi^1.5 eta s) in slow flow around one grain; kappa^2 = n gamma/eta of n grains per volume: beds as dense as 0.1 see next to nothing of it.
// In 2D it grows with the logarithm of the domain: there is no such correction.
#pragma once

#include <cmath>
#include <numbers>

namespace quicksand::coupling {

// G [s/kg]. s [m]; screening: kappa^2 [1/m^2]; W [m/s].
inline double own_wake(double s, double viscosity, double density, double screening, double speed) {
  // Over ln(k s), as scales of k may lie far from each other; what is left out is 2e-5.
  constexpr double step = 0.3;
  const double inverse = density * speed * s / viscosity, screened = screening * s * s;
  double sum = 0.0;
  for (int n = -36; n <= 5; ++n) {
    const double t = std::exp(step * n), resisted = t * t + screened, a = inverse * t / resisted, a2 = a * a;
    // int (1 - mu^2)/(1 + a^2 mu^2) dmu from -1 to 1
    const double over_mu = a < 0.03 ? 4.0 / 3 - 4.0 / 15 * a2 + 4.0 / 35 * a2 * a2 : 2 * ((1 + a2) * std::atan(a) / a - 1) / a2;
    sum += t * t * t * std::exp(-t * t) / resisted * over_mu;
  }
  return step * sum / (4 * std::numbers::pi * std::numbers::pi * viscosity * s);
}

}  // namespace quicksand::coupling
