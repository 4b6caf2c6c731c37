// What tells 2D from 3D: vectors, spins, the tangential part of a contact, volumes of discs and spheres and of their slices.
// In 2D every mass, force and volume is per metre of depth. Everything else in this folder is written once for both.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <numbers>

namespace quicksand {

template <int dim>
using Vec = Eigen::Matrix<double, dim, 1>;
template <int dim>  // DontAlign: Eigen would align Mat<2> by what the processor has, a program without AVX then misread a library with it
using Mat = Eigen::Matrix<double, dim, dim, Eigen::ColMajor | Eigen::DontAlign>;
static_assert(alignof(Vec<2>) == 16 && alignof(Vec<3>) == 8 && alignof(Mat<2>) == 8,
              "quicksand: layouts differ from the library's; Eigen's alignment must not be turned off");

// A grain turns with angular velocity omega; the solver stores s = r omega [m/s], so that no radius enters a sweep.
// Tangent: the part of a vector in the contact plane. 2D: its component on t = (-n_y, n_x). 3D: a vector normal to n.
template <int dim>
struct Rotation;

template <>
struct Rotation<2> {
  using Spin = double;
  using Tangent = double;
  static constexpr int components = 1;
  static constexpr double inertia = 0.5;  // I/(m r^2) of a full disc [-]
};

template <>
struct Rotation<3> {
  using Spin = Vec<3>;
  using Tangent = Vec<3>;
  static constexpr int components = 3;
  static constexpr double inertia = 0.4;  // I/(m r^2) of a full sphere [-]
};

template <int dim>
using Spin = typename Rotation<dim>::Spin;
template <int dim>
using Tangent = typename Rotation<dim>::Tangent;

template <class T>
T zero() {
  if constexpr (std::is_same_v<T, Vec<3>>)
    return T::Zero();
  else
    return T{};
}

template <class Real>  // double, or lanes of them (wide.hpp)
Real squared(const Real& t) {
  return t * t;
}
inline double squared(const Vec<3>& t) { return t.squaredNorm(); }
template <class Real>
Real product(const Real& a, const Real& b) {
  return a * b;
}
inline double product(const Vec<3>& a, const Vec<3>& b) { return a.dot(b); }

template <class Real>
Real length(const Real& t) {
  return t > 0.0 ? t : -t;
}
inline double length(const Vec<3>& t) { return t.norm(); }

inline double inner(double a, double b) { return a * b; }
inline double inner(const Vec<3>& a, const Vec<3>& b) { return a.dot(b); }

inline double tangential(const Vec<2>& u, const Vec<2>& n) { return n.x() * u.y() - n.y() * u.x(); }
inline Vec<3> tangential(const Vec<3>& u, const Vec<3>& n) { return u - u.dot(n) * n; }

// s x n: velocity of a surface point in direction n from the centre, for spin s = r omega
inline double cross(double s, const Vec<2>&) { return s; }
inline Vec<3> cross(const Vec<3>& s, const Vec<3>& n) {
  return {s.y() * n.z() - s.z() * n.y(), s.z() * n.x() - s.x() * n.z(), s.x() * n.y() - s.y() * n.x()};
}

// n x p_t, the torque direction of a tangential impulse
inline double turn(const Vec<2>&, double t) { return t; }
inline Vec<3> turn(const Vec<3>& n, const Vec<3>& t) { return cross(n, t); }

inline Vec<2> tangent_vector(const Vec<2>& n, double t) { return {-t * n.y(), t * n.x()}; }
inline Vec<3> tangent_vector(const Vec<3>&, const Vec<3>& t) { return t; }

// Carries a stored tangential impulse over to the contact plane of a normal that has turned a little.
inline double onto_plane(double t, const Vec<2>&) { return t; }
inline Vec<3> onto_plane(const Vec<3>& t, const Vec<3>& n) { return t - t.dot(n) * n; }

template <int dim>
double solid_volume(double r) {
  if constexpr (dim == 2)
    return std::numbers::pi * r * r;
  else
    return 4.0 / 3.0 * std::numbers::pi * r * r * r;
}

// Volume of the part of a disc or sphere of radius r at 0 that lies below the plane y = z.
template <int dim>
double solid_below(double r, double z) {
  z = std::clamp(z, -r, r);
  if constexpr (dim == 2)
    return r * r * (0.5 * std::numbers::pi + std::asin(z / r)) + z * std::sqrt(std::max(r * r - z * z, 0.0));
  else
    return std::numbers::pi * (r * r * (z + r) - (z * z * z + r * r * r) / 3.0);
}

// What a sweep reads and writes of one grain: 32 bytes in 2D, 64 in 3D, one cache line never split.
template <int dim>
struct Body;

template <>
struct alignas(32) Body<2> {
  Vec<2> v;      // velocity [m/s]
  double s;      // r omega [m/s]
  double inv_m;  // inverse mass [m/kg]; 0: moved by its wall
};

template <>
struct alignas(64) Body<3> {
  Vec<3> v;      // velocity [m/s]
  double inv_m;  // inverse mass [1/kg]; 0: moved by its wall
  Vec<3> s;      // r omega [m/s]
};

}  // namespace quicksand
