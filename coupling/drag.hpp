// Drag of a grain among others: the force on it is gamma (u - v), u and v the velocities of the phases ("model A": pressure gradient and
// viscous stress act on the grain besides). Pure functions of spheres, of eight side by side: logarithms and powers are most of the work.
// A disc stands for a column of spheres.
#pragma once

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <numbers>

namespace quicksand::coupling {

template <class T>
struct SuspensionOf {    // what a sphere sees
  T diameter;            // [m]
  T eps;                 // void fraction, in (0, 1]
  T slip;                // |u - v| of the phases [m/s]
  T density;             // of the fluid [kg/m^3]
  T viscosity;           // [Pa s]
  T reynolds() const { return density * eps * diameter * slip / viscosity; }  // of the superficial slip
};
using Suspension = SuspensionOf<double>;
using Eight = Eigen::Array<double, 8, 1, Eigen::DontAlign>;  // programs and libraries built for other processors agree
using Suspensions = SuspensionOf<Eight>;

// All return gamma [kg/s].

// R. Di Felice, Int. J. Multiphase Flow 20 (1994), with J. M. Dallavalle's sphere (1948), C_d = (0.63 + 4.8/sqrt(Re))^2:
//   F = pi/8 rho d^2 C_d |w| w eps^(2 - chi),   chi = 3.7 - 0.65 exp(-(1.5 - log10 Re)^2/2)
// The exponent 2 - chi is model A's, whose drag is eps times the weight less buoyancy of a settling grain.
inline Eight di_felice(const Suspensions& s) {
  const Eight re = s.reynolds(), seen = (re > 1e-10).select(re, 1e-10);  // nothing is left of the bell there
  const Eight off = 1.5 - log(seen) / std::numbers::ln10;
  const Eight chi = 3.7 - 0.65 * exp(-0.5 * off * off);
  const Eight sphere = 0.63 * sqrt(re) + 4.8;
  return std::numbers::pi / 8 * s.viscosity * s.diameter * sphere * sphere * exp((1 - chi) * log(s.eps));
}

// D. Gidaspow, Multiphase flow and fluidization (1994): S. Ergun, Chem. Eng. Prog. 48 (1952) below eps = 0.8,
// C. Y. Wen and Y. H. Yu, Chem. Eng. Prog. Symp. Ser. 62 (1966) above, with L. Schiller and A. Naumann's sphere (1935).
inline Eight schiller_naumann(const Eight& re) {  // C_d Re/24
  const Eight slow = 1 + 0.15 * pow(re, 0.687);
  return (re < 1000).select(slow, 0.44 / 24 * re);
}
inline Eight ergun(const Suspensions& s) {
  return std::numbers::pi * s.viscosity * s.diameter / s.eps * (25 * (1 - s.eps) + 1.75 / 6 * s.reynolds());
}
inline Eight wen_yu(const Suspensions& s) {
  return 3 * std::numbers::pi * s.viscosity * s.diameter * schiller_naumann(s.reynolds()) * pow(s.eps, -2.65);
}
inline Eight gidaspow(const Suspensions& s) { return (s.eps < 0.8).select(ergun(s), wen_yu(s)); }

// R. Beetstra, M. A. van der Hoef and J. A. M. Kuipers, AIChE J. 53 (2007), monodisperse.
inline Eight beetstra(const Suspensions& s) {
  const Eight re = s.reynolds() + 1e-10, phi = 1 - s.eps, e2 = s.eps * s.eps;
  const Eight inertial = 0.413 * re / (24 * e2) * (1 / s.eps + 3 * s.eps * phi + 8.4 * pow(re, -0.343)) /
                         (1 + exp(3 * std::numbers::ln10 * phi) * exp(-0.5 * (1 + 4 * phi) * log(re)));
  return 3 * std::numbers::pi * s.viscosity * s.diameter * s.eps * (10 * phi / e2 + e2 * (1 + 1.5 * sqrt(phi.abs())) + inertial);
}

// Discs, per metre of depth. As spheres: with the drag of spheres per volume of solids, at the void fraction that spheres have when they are packed
// as closely as the discs: 0.9069 by area is 0.7405 by volume. As cylinders: F = rho d/2 C_d |w| w per depth at the void fraction of the discs, as
// published 2D computations with MigFlow have it.
enum class Discs { spheres, cylinders };
inline double void_fraction_of_spheres(double eps_of_discs) {
  const double least = 2 / std::sqrt(std::numbers::pi * std::sqrt(3.0));
  const double phi = std::max(1 - eps_of_discs, 0.0);
  return 1 - least * phi * std::sqrt(phi);  // 1 as a sum of weights may be above it, by rounding
}
inline double per_depth(Discs discs, double diameter) { return discs == Discs::spheres ? 1.5 / diameter : 4 / (std::numbers::pi * diameter); }

}  // namespace quicksand::coupling
