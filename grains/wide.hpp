// Four contacts between discs at a time: one lane each. A single update waits about seventy cycles for its own results, and the
// processor sees no more than two ahead; four side by side cost little more than one. The law is that of contact.hpp, on lanes.
// Only for contacts that share no grain: the result is then that of one after the other.
#pragma once

#include "contact.hpp"

#ifdef __AVX__
#include <immintrin.h>
#endif

#pragma GCC diagnostic ignored "-Wignored-attributes"  // templates on Lanes: values, never memory that may alias

namespace quicksand {

using Lanes = double __attribute__((vector_size(32), may_alias));

// Bit k is set where lane k of a comparison holds.
template <class Mask>
int bits(const Mask& mask) {
#ifdef __AVX__
  return _mm256_movemask_pd(reinterpret_cast<const __m256d&>(mask));
#else
  return -static_cast<int>(mask[0] + 2 * mask[1] + 4 * mask[2] + 8 * mask[3]);
#endif
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

// Up to four contacts that share no grain, and the bodies they act on. Unused lanes point to contacts and bodies of their own.
struct Four {
  Contact<2>* contact[4];
  Body<2>*a[4], *b[4];
};

// Whether four contacts share no grain.
inline bool independent(const Contact<2>& c0, const Contact<2>& c1, const Contact<2>& c2, const Contact<2>& c3) {
  using Ints = int __attribute__((vector_size(32)));
  const Ints v{c0.i, c0.j, c1.i, c1.j, c2.i, c2.j, c3.i, c3.j};
  const Ints equal = (v == __builtin_shufflevector(v, v, 2, 3, 4, 5, 6, 7, 0, 1)) |
                     (v == __builtin_shufflevector(v, v, 3, 2, 5, 4, 7, 6, 1, 0)) |
                     (v == __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3)) |
                     (v == __builtin_shufflevector(v, v, 5, 4, 7, 6, 1, 0, 3, 2));
#ifdef __AVX__
  return _mm256_testz_si256(reinterpret_cast<const __m256i&>(equal), reinterpret_cast<const __m256i&>(equal));
#else
  int any = 0;
  for (int lane = 0; lane < 8; ++lane) any |= equal[lane];
  return any == 0;
#endif
}

struct FourChanges {
  Lanes change{}, size{}, speed2{};  // see Change in solvers.cpp
};

template <class T>
const Lanes& lanes(const T* p) {
  return *reinterpret_cast<const Lanes*>(p);
}

inline Quad load(Body<2>* const* body) {  // v_x, v_y, s, 1/m
  return transpose({lanes(body[0]), lanes(body[1]), lanes(body[2]), lanes(body[3])});
}

inline void store(Body<2>* const* body, const Quad& q) {
  const Quad by_body = transpose(q);
  *reinterpret_cast<Lanes*>(body[0]) = by_body.a;
  *reinterpret_cast<Lanes*>(body[1]) = by_body.b;
  *reinterpret_cast<Lanes*>(body[2]) = by_body.c;
  *reinterpret_cast<Lanes*>(body[3]) = by_body.d;
}

template <bool friction>
[[gnu::always_inline]] inline FourChanges update_four(const Four& four, double spin_ratio, double omega) {
  auto half = [&](int k) {  // of each contact: n_x, n_y, bias, 1/W, then friction, p_n, p_t, bodies
    auto part = [&](int lane) { return lanes(reinterpret_cast<const double*>(four.contact[lane]) + 4 * k); };
    return transpose({part(0), part(1), part(2), part(3)});
  };
  const auto [n_x, n_y, bias, inv_w] = half(0);
  const auto [mu, p_n, p_t, unused] = half(1);
  Quad a = load(four.a), b = load(four.b);  // .a = v_x, .b = v_y, .c = s, .d = 1/m
  const Lanes u_x = b.a - a.a, u_y = b.b - a.b;
  const Lanes u_n = u_x * n_x + u_y * n_y + bias;
  if (bits((p_n > 0.0) | (u_n < 0.0)) == 0) return {};  // all open, and stay open
  Impulse<2, Lanes> next;
  if constexpr (friction) {
    const Lanes u_t = n_x * u_y - n_y * u_x - (a.c + b.c);
    const Lanes step = omega * inv_w;
    next = obey_coulomb<2, Lanes>({p_n, p_t}, u_n, u_t, step, step / (1.0 + spin_ratio), mu);
  } else {
    next.n = positive(p_n - omega * inv_w * u_n);
  }
  const Lanes d_n = next.n - p_n, d_t = next.t - p_t;
  const Lanes p_x = d_n * n_x - d_t * n_y, p_y = d_n * n_y + d_t * n_x;
  a.a -= a.d * p_x, a.b -= a.d * p_y;
  b.a += b.d * p_x, b.b += b.d * p_y;
  if constexpr (friction) a.c -= a.d * (spin_ratio * d_t), b.c -= b.d * (spin_ratio * d_t);
  store(four.a, a);
  store(four.b, b);
  for (int lane = 0; lane < 4; ++lane) four.contact[lane]->p = {next.n[lane], next.t[lane]};
  const Lanes w = 1.0 / inv_w, change = w * (d_n * d_n + d_t * d_t);
  return {change, w * (next.n * next.n + next.t * next.t), w * change};
}

}  // namespace quicksand
