// Eight numbers side by side: what is written for one element in terms of T is done for eight elements at once where T is Lanes. A number of
// Eigen's, for small matrices of them.
#pragma once

#include <Eigen/Core>

#include <cmath>

namespace quicksand::fluid {

struct alignas(64) Lanes {
  static constexpr int count = 8;
  using Numbers = double __attribute__((vector_size(64)));
  using Mask = long __attribute__((vector_size(64)));
  Numbers of;
  Lanes() = default;
  Lanes(double same) : of(same - Numbers{}) {}
  explicit Lanes(const Numbers& numbers) : of(numbers) {}
  Lanes& operator+=(const Lanes& o) { return of += o.of, *this; }
  Lanes& operator-=(const Lanes& o) { return of -= o.of, *this; }
  Lanes& operator*=(const Lanes& o) { return of *= o.of, *this; }
  Lanes& operator/=(const Lanes& o) { return of /= o.of, *this; }
  friend Lanes operator+(Lanes a, const Lanes& b) { return a += b; }
  friend Lanes operator-(Lanes a, const Lanes& b) { return a -= b; }
  friend Lanes operator*(Lanes a, const Lanes& b) { return a *= b; }
  friend Lanes operator/(Lanes a, const Lanes& b) { return a /= b; }
  friend Lanes operator-(const Lanes& a) { return Lanes(-a.of); }
  friend Mask operator>(const Lanes& a, const Lanes& b) { return a.of > b.of; }
  friend Lanes sqrt(Lanes a) {
    for (int k = 0; k < count; ++k) a.of[k] = std::sqrt(a.of[k]);
    return a;
  }
};

// a where it holds, else b.
inline Lanes select(const Lanes::Mask& mask, const Lanes& a, const Lanes& b) { return Lanes(mask ? a.of : b.of); }
inline double select(bool mask, double a, double b) { return mask ? a : b; }

template <class T>
constexpr int lanes_of = 1;
template <>
inline constexpr int lanes_of<Lanes> = Lanes::count;
inline void put(double& to, int, double value) { to = value; }
inline void put(Lanes& to, int lane, double value) { to.of[lane] = value; }
inline double get(const double& from, int) { return from; }
inline double get(const Lanes& from, int lane) { return from.of[lane]; }
template <class To, class From>
void put(Eigen::MatrixBase<To>& to, int lane, const Eigen::MatrixBase<From>& values) {
  for (int i = 0; i < values.size(); ++i) put(to.derived()(i), lane, values(i));
}

}  // namespace quicksand::fluid

template <>
struct Eigen::NumTraits<quicksand::fluid::Lanes> : Eigen::NumTraits<double> {
  using Real = quicksand::fluid::Lanes;
  using NonInteger = Real;
  using Nested = Real;
};
template <class Operation>
struct Eigen::ScalarBinaryOpTraits<double, quicksand::fluid::Lanes, Operation> {
  using ReturnType = quicksand::fluid::Lanes;
};
template <class Operation>
struct Eigen::ScalarBinaryOpTraits<quicksand::fluid::Lanes, double, Operation> {
  using ReturnType = quicksand::fluid::Lanes;
};
