// One contact: its data, the law it obeys, and how far it is from obeying it. Pure functions on values; loops live in solvers.cpp.
#pragma once

#include "geometry.hpp"

namespace quicksand {

// Real: double, or in 2D four contacts side by side (wide.hpp).
template <int dim, class Real = double>
struct Impulse {
  using T = std::conditional_t<dim == 2, Real, Tangent<dim>>;
  Real n{};           // >= 0, pushes apart [N s] (2D: N s/m)
  T t = zero<T>();    // friction [N s]
};

// A contact that the solver sees: n points from body i to body j, u = velocity of j relative to i at the contact.
// Exact for discs and spheres: the local Delassus block is diagonal, W_tt = W_nn (1 + m r^2/I) without drag. Not so for clumps.
// 64 bytes in 2D, one cache line: what a sweep does not read (which pair it is) is kept apart.
template <int dim>
struct alignas(dim == 2 ? 64 : 32) Contact {
  Vec<dim> n;
  double bias;      // b_n in 0 <= u_n + b_n  perp  p_n >= 0 [m/s]
  double inv_w;     // 1/W_nn [kg]
  double friction;  // [-]
  Impulse<dim> p;
  int i, j;         // bodies
};
static_assert(sizeof(Contact<2>) == 64);

// The same with a wall in the place of body i. W_tt is stored: a wall may be light along one axis and held along another.
template <int dim>
struct WallContact {
  Vec<dim> n;
  double bias;
  double inv_w;
  double inv_w_t;  // 1/W_tt [kg]; for a wall free along some axes only: a bound, exact once the sweeps have converged
  double friction;
  Impulse<dim> p;
  int wall, j;
  int pair;
};

template <class Real>
Real positive(Real x) {
  return x > 0.0 ? x : Real{};
}

template <class Real>
Real clip(Real t, Real bound) {
  t = t < bound ? t : bound;
  return t > -bound ? t : -bound;
}
inline Vec<3> clip(const Vec<3>& t, double bound) {
  const double norm2 = t.squaredNorm();
  return norm2 <= bound * bound ? t : Vec<3>(t * (bound / std::sqrt(norm2)));
}

// Signorini-Coulomb at one contact, the others held: M. Jean, CMAME 177 (1999), eqs. for a diagonal local block.
//   0 <= u_n + b_n  perp  p_n >= 0,   |p_t| <= mu p_n,  p_t opposite to u_t when sliding
// u_n holds b_n already; step_n = omega/W_nn, step_t = omega/W_tt; omega = 1 solves the contact exactly.
template <int dim, class Real = double>
Impulse<dim, Real> obey_coulomb(const Impulse<dim, Real>& p, Real u_n, const typename Impulse<dim, Real>::T& u_t, Real step_n,
                                Real step_t, Real friction) {
  using T = typename Impulse<dim, Real>::T;
  Impulse<dim, Real> next;
  next.n = positive(p.n - step_n * u_n);
  next.t = clip(T(p.t - step_t * u_t), friction * next.n);
  return next;
}

// e = r - P_K(r - rho (w + mu |w_t| n)), K = {|r_t| <= mu r_n}, rho = 1/W_nn: zero exactly when the contact obeys its law.
// De Saxce and Feng, Math. Comput. Modelling 28 (1998). Returns |e|^2.
template <int dim, class Real = double>
Real natural_map(const Impulse<dim, Real>& p, Real w_n, const typename Impulse<dim, Real>::T& w_t, Real rho, Real friction) {
  using T = typename Impulse<dim, Real>::T;
  const Real z_n = p.n - rho * (w_n + friction * length(w_t));
  const T z_t = p.t - rho * w_t;
  const Real norm_t = length(z_t);
  const Real on_cone = positive<Real>((z_n + friction * norm_t) / (1.0 + friction * friction));
  const auto inside = norm_t <= friction * z_n;  // of K; r_n = 0 where z is in its polar cone
  const Real r_n = inside ? positive<Real>(z_n) : on_cone;  // without friction K is a half-line: norm_t = 0 does not say z_n >= 0
  const Real shrunk = inside ? Real{} + 1.0 : (norm_t > 0.0 ? friction * on_cone / norm_t : Real{});
  return (p.n - r_n) * (p.n - r_n) + squared(T(p.t - shrunk * z_t));
}

// What a visit changed at one contact, or how far it is from its law: with dp the change, or e, the natural map.
template <class Real = double>
struct Change {
  Real change{}, size{};  // W_nn |dp|^2, W_nn |p|^2
  Real speed2{};          // (W_nn |dp|)^2 [m^2/s^2]
};

// general: Coulomb with tangential restitution, or with drag, under which a grain is heavier to push than to turn.
enum class Law { frictionless, coulomb, general };

// What the general law needs of a contact beside its data. Without drag the spin ratios are m r^2/I and W_nn/W_tt = 1/(1 + m r^2/I).
template <int dim>
struct General {
  Tangent<dim> bias_t;     // see Problem::bias_t
  double ratio_i, ratio_j; // see Problem::spin_ratios
  double rolling;          // W_nn/W_tt [-]
};

}  // namespace quicksand
