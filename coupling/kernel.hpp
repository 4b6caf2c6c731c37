// What grains weigh at the nodes of a mesh: the one link between the two phases. W_ai >= 0, sum over nodes a of W_ai = 1 for each grain i.
//   volume      1 - eps_a = sum_i V_i W_ai/M_a,          M_a = int N_a, so that int (1 - eps) is the volume of the grains, to rounding
//   to a grain  f_i = sum_a W_ai f_a,                    f_a = int N_a f/M_a
//   to nodes    F_a = sum_i W_ai F_i/M_a  [N/m^3],       adjoint: int F . u = sum_i F_i . u_i, whatever u
// Two kernels. The hat: W_ai = N_a(x_i), of the element that holds the grain. The smooth one, of a radius r_0 that knows no mesh:
//   W_ai = int N_a(y) K(x_i, y) dy,   K(x, y) = sum_g B_g(x) B_g(y)/w_g,   w_g = int B_g over the domain,
// B_g the cubic B-splines of a grid of spacing D that stands still in space. They add up to 1, so int K(x, y) dy = 1 for all x, and K is symmetric:
// as heat that spreads between insulated walls. Grains near a wall lose nothing and take nothing from each other; a uniform field of grains reads
// uniform along flat walls, in corners and on curved ones, and no image of a grain has to be made. K is twice differentiable, and so is eps in
// time. Its variance along an axis is that of two splines, 2 D^2/3 = r_0^2, its mean is x. A grain meets 4^dim splines, whatever the mesh.
#pragma once

#include "walker.hpp"

namespace quicksand::coupling {

enum class Shape { hat, smooth };

template <int dim>
class Kernel {
 public:
  // `period` [m] along the axes of the grains' box, 0 where not periodic.
  Kernel(std::shared_ptr<const Mesh<dim>> mesh, Shape shape, double radius, const Vec<dim>& period);

  // The mesh has moved.
  void place(const std::vector<Vec<dim>>& nodes);
  // Grains in the elements that `places` tells, inside the periods of the mesh.
  void weigh(std::span<const Vec<dim>> x, const std::vector<Place<dim>>& places);
  const std::vector<double>& masses() const { return masses_; }  // M_a of each node, of an image that of its master [m^dim]

  double variance() const { return shape_ == Shape::hat ? 0.0 : 2.0 / 3 * spacing_.squaredNorm() / dim; }  // of the smooth kernel, along an axis [m^2]

  // From nodes (of which images count as their masters) to grains and back goes by way of carriers: splines, or for the hat the nodes themselves.
  template <class T>
  std::vector<T> to_carriers(const std::vector<T>& at_nodes, const T& zero) const;
  template <class T>
  T at_grain(int i, const std::vector<T>& at_carriers) const {
    const int from = i * per_grain_;
    T sum = weight_[from] * at_carriers[carrier_[from]];
    for (int k = from + 1; k < from + per_grain_; ++k) sum += weight_[k] * at_carriers[carrier_[k]];
    return sum;
  }
  template <class T>
  void give(int i, const T& value, std::vector<T>& to_carriers) const {
    for (int k = i * per_grain_; k < (i + 1) * per_grain_; ++k) to_carriers[carrier_[k]] += weight_[k] * value;
  }
  template <class T>
  std::vector<T> to_nodes(const std::vector<T>& of_carriers, const T& zero) const;  // sums, not yet over M_a
  std::size_t carriers() const { return shape_ == Shape::hat ? masses_.size() : spline_weight_.size(); }

 private:
  static constexpr int splines = dim == 2 ? 16 : 64;  // that are not 0 at a point
  struct Sample {  // a point of the integral over y
    std::array<int, dim + 1> node;
    Barycentric<dim> l;
    double volume;  // [m^dim]
    std::array<int, splines> spline;
    std::array<double, splines> b;
  };
  void splines_at(const Vec<dim>& x, int* spline, double* b) const;

  std::shared_ptr<const Mesh<dim>> mesh_;
  Shape shape_;
  Vec<dim> spacing_, origin_;
  std::array<int, dim> periodic_;        // splines along a period, or 0
  std::array<int, dim> first_, count_;   // of the grid that the mesh takes
  std::vector<fluid::QuadraturePoint<dim>> in_element_;  // the samples; empty: nodes
  std::vector<Sample> samples_;
  std::vector<double> masses_, spline_weight_;
  int per_grain_;
  std::vector<int> carrier_;
  std::vector<double> weight_;
};

// Defined here: of any T that can be added and scaled.
template <int dim>
template <class T>
std::vector<T> Kernel<dim>::to_carriers(const std::vector<T>& at_nodes, const T& zero) const {
  if (shape_ == Shape::hat) return at_nodes;
  std::vector<T> sum(spline_weight_.size(), zero);
  for (const Sample& s : samples_) {
    T here = zero;
    for (int a = 0; a <= dim; ++a) here += s.volume * s.l[a] * at_nodes[s.node[a]];
    for (int k = 0; k < splines; ++k) sum[s.spline[k]] += s.b[k] * here;
  }
  for (std::size_t g = 0; g < sum.size(); ++g)
    if (spline_weight_[g] > 0) sum[g] *= 1 / spline_weight_[g];
  return sum;
}

template <int dim>
template <class T>
std::vector<T> Kernel<dim>::to_nodes(const std::vector<T>& of_carriers, const T& zero) const {
  std::vector<T> sum(masses_.size(), zero);
  if (shape_ == Shape::hat) {
    for (std::size_t k = 0; k < sum.size(); ++k) sum[mesh_->master[k]] += of_carriers[k];
  } else {
    std::vector<T> density(of_carriers.size(), zero);
    for (std::size_t g = 0; g < density.size(); ++g)
      if (spline_weight_[g] > 0) density[g] = (1 / spline_weight_[g]) * of_carriers[g];
    for (const Sample& s : samples_) {
      T here = zero;
      for (int k = 0; k < splines; ++k) here += s.b[k] * density[s.spline[k]];
      for (int a = 0; a <= dim; ++a) sum[s.node[a]] += s.volume * s.l[a] * here;
    }
  }
  for (std::size_t k = 0; k < sum.size(); ++k) sum[k] = sum[mesh_->master[k]];
  return sum;
}

}  // namespace quicksand::coupling
