// Simplices with shape functions of order 1 or 2, and quadrature on them. Barycentric coordinates L_0 ... L_dim throughout.
#pragma once

#include "lanes.hpp"

#include "meshes/mesh.hpp"

#include <Eigen/Geometry>

#include <cmath>
#include <type_traits>
#include <utility>

namespace quicksand::fluid {

using meshes::Mesh;
using meshes::Vec;
template <int dim, class T>
using VecOf = Eigen::Matrix<T, dim, 1>;

template <int dim>
constexpr int edges_of_simplex = dim * (dim + 1) / 2;

// Ends of edge k: the order in which the edge nodes of a simplex of order 2 follow its vertices.
template <int dim>
constexpr auto simplex_edges = [] {
  std::array<std::array<int, 2>, edges_of_simplex<dim>> ends{};
  int k = 0;
  for (int a = 0; a <= dim; ++a)
    for (int b = a + 1; b <= dim; ++b) ends[k++] = {a, b};
  return ends;
}();

template <int dim, int order>
constexpr int shape_count = order == 1 ? dim + 1 : dim + 1 + edges_of_simplex<dim>;

template <int dim>
using Barycentric = std::array<double, dim + 1>;

template <int dim, int order>
std::array<double, shape_count<dim, order>> shapes(const Barycentric<dim>& l) {
  std::array<double, shape_count<dim, order>> n;
  for (int a = 0; a <= dim; ++a) n[a] = order == 1 ? l[a] : l[a] * (2 * l[a] - 1);
  if constexpr (order == 2)
    for (int k = 0; k < edges_of_simplex<dim>; ++k) n[dim + 1 + k] = 4 * l[simplex_edges<dim>[k][0]] * l[simplex_edges<dim>[k][1]];
  return n;
}

// Gradients of the shape functions where grad_l are those of the barycentric coordinates.
template <int dim, int order, class T>
std::array<VecOf<dim, T>, shape_count<dim, order>> shape_gradients(const Barycentric<dim>& l, const std::array<VecOf<dim, T>, dim + 1>& grad_l) {
  std::array<VecOf<dim, T>, shape_count<dim, order>> g;
  for (int a = 0; a <= dim; ++a) g[a] = order == 1 ? grad_l[a] : VecOf<dim, T>((4 * l[a] - 1) * grad_l[a]);
  if constexpr (order == 2)
    for (int k = 0; k < edges_of_simplex<dim>; ++k) {
      const auto [a, b] = simplex_edges<dim>[k];
      g[dim + 1 + k] = 4 * (l[a] * grad_l[b] + l[b] * grad_l[a]);
    }
  return g;
}

template <int dim, class T = double>
struct Geometry {
  T volume;                               // [m^dim]
  std::array<VecOf<dim, T>, dim + 1> grad_l;   // of the barycentric coordinates [1/m]
};

template <int dim, class T = double>
[[gnu::always_inline]] inline Geometry<dim, T> geometry(const std::array<VecOf<dim, T>, dim + 1>& x) {
  using Vector = VecOf<dim, T>;
  std::array<Vector, dim> across;  // what is normal to the other edges from x[0], times their area
  T six_volumes;                // 2D: two
  if constexpr (dim == 2) {
    const Vector a = x[1] - x[0], b = x[2] - x[0];
    across = {Vector(b.y(), -b.x()), Vector(-a.y(), a.x())};
    six_volumes = a.dot(across[0]);
  } else {
    const Vector a = x[1] - x[0], b = x[2] - x[0], c = x[3] - x[0];
    across = {b.cross(c), c.cross(a), a.cross(b)};
    six_volumes = a.dot(across[0]);
  }
  Geometry<dim, T> g;
  g.volume = six_volumes / (dim == 2 ? 2 : 6);
  const T inverse = 1.0 / six_volumes;
  g.grad_l[0].setZero();
  for (int k = 0; k < dim; ++k) g.grad_l[k + 1] = inverse * across[k], g.grad_l[0] -= g.grad_l[k + 1];
  return g;
}

template <int dim>
[[gnu::always_inline]] inline Geometry<dim> geometry(const std::vector<Vec<dim>>& position, const std::array<int, dim + 1>& nodes) {
  std::array<Vec<dim>, dim + 1> x;
  for (int a = 0; a <= dim; ++a) x[a] = position[nodes[a]];
  return geometry<dim>(x);
}

// call(order) with the order as a constant.
template <class Call>
auto with_order(int order, Call&& call) {
  return order == 1 ? call(std::integral_constant<int, 1>{}) : call(std::integral_constant<int, 2>{});
}

template <int dim>
struct QuadraturePoint {
  Barycentric<dim> l;
  double weight;  // of the volume
};

// Exact for polynomials of degree 2 (order 1) and 4 (order 2): products of two shape functions. The rules of degree 2 are those of
// Hammer and Stroud (1956); in 2D degree 4, six points, is Dunavant, IJNME 21 (1985); in 3D degree 4 uses the eleven points of Keast,
// CMAME 55 (1986), which has one negative weight; the fourteen points of degree 5 of Walkington (2000) do not, and are taken instead.
template <int dim, int order>
const auto& quadrature() {
  static const auto points = [] {
    if constexpr (dim == 1) {  // facets in 2D: Gauss
      if constexpr (order == 1) {
        const double a = 0.5 - 0.5 / std::sqrt(3.0);
        return std::array<QuadraturePoint<1>, 2>{{{{a, 1 - a}, 0.5}, {{1 - a, a}, 0.5}}};
      } else {
        const double a = 0.5 - 0.5 * std::sqrt(0.6);
        return std::array<QuadraturePoint<1>, 3>{{{{a, 1 - a}, 5.0 / 18}, {{0.5, 0.5}, 8.0 / 18}, {{1 - a, a}, 5.0 / 18}}};
      }
    } else if constexpr (dim == 2 && order == 1) {
      const double a = 2.0 / 3, b = 1.0 / 6, w = 1.0 / 3;
      return std::array<QuadraturePoint<2>, 3>{{{{a, b, b}, w}, {{b, a, b}, w}, {{b, b, a}, w}}};
    } else if constexpr (dim == 3 && order == 1) {
      const double b = (5 - std::sqrt(5.0)) / 20, a = 1 - 3 * b, w = 0.25;
      return std::array<QuadraturePoint<3>, 4>{{{{a, b, b, b}, w}, {{b, a, b, b}, w}, {{b, b, a, b}, w}, {{b, b, b, a}, w}}};
    } else if constexpr (dim == 2) {
      std::array<QuadraturePoint<2>, 6> p;
      int k = 0;
      for (const auto& [b, w] : {std::pair{0.445948490915965, 0.223381589678011}, {0.091576213509771, 0.109951743655322}})
        for (int m = 0; m < 3; ++m, ++k) {
          p[k] = {{b, b, b}, w};
          p[k].l[m] = 1 - 2 * b;
        }
      return p;
    } else {
      std::array<QuadraturePoint<3>, 14> p;
      int k = 0;
      for (const auto& [b, w] : {std::pair{0.310885919263301, 0.112687925718016}, {0.092735250310891, 0.073493043116362}})
        for (int m = 0; m < 4; ++m, ++k) {
          p[k] = {{b, b, b, b}, w};
          p[k].l[m] = 1 - 3 * b;
        }
      const double c = 0.045503704125650, d = 0.5 - c, w = 0.042546020777081;
      for (int m = 0; m < 4; ++m)
        for (int n = m + 1; n < 4; ++n, ++k) {
          p[k] = {{c, c, c, c}, w};
          p[k].l[m] = p[k].l[n] = d;
        }
      return p;
    }
  }();
  return points;
}

template <int dim, int order>
constexpr int quadrature_count = std::tuple_size_v<std::remove_cvref_t<decltype(quadrature<dim, order>())>>;

}  // namespace quicksand::fluid
