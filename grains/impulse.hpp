// What an impulse at a contact does to the two bodies, and how these move relative to each other there. Inlined by order: a sweep calls
// them for every contact.
#pragma once

#include "contact.hpp"
#include "grains.hpp"

namespace quicksand {

template <int dim>
Vec<dim> impulse_vector(const Vec<dim>& n, double p_n, const Tangent<dim>& p_t) {
  return p_n * n + tangent_vector(n, p_t);
}

// Spin ratios of the bodies: see Problem::spin_ratios.
template <Law law, int dim>
[[gnu::always_inline]] inline void push(Body<dim>& a, Body<dim>& b, const Vec<dim>& n, double p_n, const Tangent<dim>& p_t, double ratio_a, double ratio_b) {
  Vec<dim> p = p_n * n;
  if constexpr (law != Law::frictionless) p += tangent_vector(n, p_t);
  a.v -= a.inv_m * p;
  b.v += b.inv_m * p;
  if constexpr (law != Law::frictionless) {
    const Spin<dim> torque = turn(n, p_t);
    a.s -= a.inv_m * Spin<dim>(ratio_a * torque);
    b.s -= b.inv_m * Spin<dim>(ratio_b * torque);
  }
}

template <Law law, int dim>
[[gnu::always_inline]] inline void push(Wall<dim>& wall, Body<dim>& b, const Vec<dim>& n, double p_n, const Tangent<dim>& p_t, double, double ratio_b) {
  const Vec<dim> p = impulse_vector<dim>(n, p_n, p_t);
  wall.v -= wall.inv_m.cwiseProduct(p);
  b.v += b.inv_m * p;
  if constexpr (law != Law::frictionless) b.s -= (b.inv_m * ratio_b) * turn(n, p_t);
}

// Relative velocity at the contact: normal part, then tangential part.
template <int dim>
struct Slip {
  double n;
  Tangent<dim> t;
};

template <Law law, int dim>
[[gnu::always_inline]] inline Slip<dim> slip(const Body<dim>& a, const Body<dim>& b, const Vec<dim>& n) {
  const Vec<dim> u = b.v - a.v;
  if constexpr (law == Law::frictionless) return {u.dot(n), zero<Tangent<dim>>()};
  return {u.dot(n), tangential(u, n) - cross(Spin<dim>(a.s + b.s), n)};
}

template <Law law, int dim>
[[gnu::always_inline]] inline Slip<dim> slip(const Wall<dim>& wall, const Body<dim>& b, const Vec<dim>& n) {
  const Vec<dim> u = b.v - wall.v;
  if constexpr (law == Law::frictionless) return {u.dot(n), zero<Tangent<dim>>()};
  return {u.dot(n), tangential(u, n) - cross(b.s, n)};
}

}  // namespace quicksand
