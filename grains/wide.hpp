// Four contacts between discs side by side, one lane each. One contact alone keeps the processor waiting for its own results;
// four cost little more than one. The law is that of contact.hpp, on lanes.
#pragma once

#include "contact.hpp"

#ifdef __AVX2__
#include <immintrin.h>
#endif

#pragma GCC diagnostic ignored "-Wignored-attributes"  // templates on Lanes: values, never memory that may alias

namespace quicksand {

// Their own alignment is 16 without AVX and 32 with it. What is kept in memory says 32, so that programs and libraries built for
// other processors agree; lanes by themselves are passed differently too, and only within the solver.
using Lanes = double __attribute__((vector_size(32), may_alias));

// Whether a comparison holds in any lane.
template <class Mask>
bool any(const Mask& mask) {
#ifdef __AVX2__
  return _mm256_movemask_pd(reinterpret_cast<const __m256d&>(mask)) != 0;
#else
  return (mask[0] | mask[1] | mask[2] | mask[3]) != 0;
#endif
}
inline bool any(int one) { return one != 0; }

// Up to four contacts that share no grain: updating them at once is updating one after the other. They fill the lanes from the
// last; an empty lane names the grains of the last and has 1/W = 0, so that what it stores changes nothing and is stored first.
struct alignas(32) Pack {
  Lanes n_x, n_y;
  Lanes bias;
  Lanes inv_w;
  Lanes friction;
  Impulse<2, Lanes> p;
  int i[4], j[4];
};
static_assert(sizeof(Pack) == 256);

struct alignas(32) PackGeneral {  // General of each lane
  Lanes bias_t, ratio_i, ratio_j, rolling;
};

inline void put(PackGeneral& pack, int lane, const General<2>& g) {
  pack.bias_t[lane] = g.bias_t, pack.ratio_i[lane] = g.ratio_i, pack.ratio_j[lane] = g.ratio_j, pack.rolling[lane] = g.rolling;
}

inline void put(Pack& pack, int lane, const Contact<2>& c) {
  pack.n_x[lane] = c.n.x(), pack.n_y[lane] = c.n.y();
  pack.bias[lane] = c.bias, pack.inv_w[lane] = c.inv_w, pack.friction[lane] = c.friction;
  pack.p.n[lane] = c.p.n, pack.p.t[lane] = c.p.t;
  pack.i[lane] = c.i, pack.j[lane] = c.j;
}

struct Quad {
  Lanes a, b, c, d;
};

inline Quad transpose(const Quad& q) {
  const Lanes ab_even = __builtin_shufflevector(q.a, q.b, 0, 4, 2, 6), ab_odd = __builtin_shufflevector(q.a, q.b, 1, 5, 3, 7);
  const Lanes cd_even = __builtin_shufflevector(q.c, q.d, 0, 4, 2, 6), cd_odd = __builtin_shufflevector(q.c, q.d, 1, 5, 3, 7);
  return {__builtin_shufflevector(ab_even, cd_even, 0, 1, 4, 5), __builtin_shufflevector(ab_odd, cd_odd, 0, 1, 4, 5),
          __builtin_shufflevector(ab_even, cd_even, 2, 3, 6, 7), __builtin_shufflevector(ab_odd, cd_odd, 2, 3, 6, 7)};
}

inline Lanes& row(Body<2>& b) { return reinterpret_cast<Lanes&>(b); }

inline Quad load(Body<2>* bodies, const int* at) {  // v_x, v_y, s, 1/m
  return transpose({row(bodies[at[0]]), row(bodies[at[1]]), row(bodies[at[2]]), row(bodies[at[3]])});
}

inline void store(Body<2>* bodies, const int* at, const Quad& q) {
  const Quad by_body = transpose(q);
  row(bodies[at[0]]) = by_body.a;
  row(bodies[at[1]]) = by_body.b;
  row(bodies[at[2]]) = by_body.c;
  row(bodies[at[3]]) = by_body.d;
}

// Whether a flag is set for any of the grains.
inline bool any_of(const int* flags, const Contact<3>& c) { return flags[c.i] | flags[c.j]; }
inline bool any_of(const int* flags, const Pack& pack) {
#ifdef __AVX2__
  const __m256i found = _mm256_i32gather_epi32(flags, *reinterpret_cast<const __m256i*>(pack.i), 4);
  return !_mm256_testz_si256(found, found);
#else
  int found = 0;
  for (int lane = 0; lane < 4; ++lane) found |= flags[pack.i[lane]] | flags[pack.j[lane]];
  return found != 0;
#endif
}

template <Law law>
struct WideSlip {
  Lanes n, t{};
  [[gnu::always_inline]] WideSlip(const Quad& a, const Quad& b, const Pack& c, const PackGeneral* general) {
    const Lanes u_x = b.a - a.a, u_y = b.b - a.b;
    n = u_x * c.n_x + u_y * c.n_y + c.bias;
    if constexpr (law != Law::frictionless) t = c.n_x * u_y - c.n_y * u_x - (a.c + b.c);
    if constexpr (law == Law::general) t += general->bias_t;
  }
  bool open(const Pack& c) const { return !any((c.p.n != 0.0) | (n < 0.0)); }  // and stays open
};

// general: of the pack where that is the law, else not read.
template <Law law>
[[gnu::always_inline]] inline Change<Lanes> update(Pack& c, Body<2>* bodies, const PackGeneral* general, double spin_ratio, double omega) {
  Quad a = load(bodies, c.i), b = load(bodies, c.j);  // .a = v_x, .b = v_y, .c = s, .d = 1/m
  const WideSlip<law> u(a, b, c, general);
  if (u.open(c)) return {};
  Impulse<2, Lanes> next;
  const Lanes step = omega * c.inv_w;
  if constexpr (law == Law::frictionless)
    next.n = positive<Lanes>(c.p.n - step * u.n);
  else if constexpr (law == Law::general)
    next = obey_coulomb<2, Lanes>(c.p, u.n, u.t, step, step * general->rolling, c.friction);
  else
    next = obey_coulomb<2, Lanes>(c.p, u.n, u.t, step, step * (1.0 / (1.0 + spin_ratio)), c.friction);
  const Lanes d_n = next.n - c.p.n, d_t = next.t - c.p.t;
  const Lanes p_x = d_n * c.n_x - d_t * c.n_y, p_y = d_n * c.n_y + d_t * c.n_x;
  a.a -= a.d * p_x, a.b -= a.d * p_y;
  b.a += b.d * p_x, b.b += b.d * p_y;
  if constexpr (law == Law::coulomb) a.c -= a.d * (spin_ratio * d_t), b.c -= b.d * (spin_ratio * d_t);
  if constexpr (law == Law::general) a.c -= a.d * (general->ratio_i * d_t), b.c -= b.d * (general->ratio_j * d_t);
  store(bodies, c.i, a);
  store(bodies, c.j, b);
  c.p = next;
  const Lanes w = a.d + b.d, change = w * (d_n * d_n + d_t * d_t);
  return {change, w * (next.n * next.n + next.t * next.t), w * change};
}

template <Law law>
inline Change<Lanes> error(const Pack& c, Body<2>* bodies, const PackGeneral* general) {
  const Quad a = load(bodies, c.i), b = load(bodies, c.j);
  const WideSlip<law> u(a, b, c, general);
  if (u.open(c)) return {};
  const Lanes w = a.d + b.d, change = w * natural_map<2, Lanes>(c.p, u.n, u.t, c.inv_w, c.friction);
  return {change, w * (c.p.n * c.p.n + c.p.t * c.p.t), w * change};
}

}  // namespace quicksand
