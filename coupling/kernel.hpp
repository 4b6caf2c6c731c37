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
    T sum = 0.0 * at_carriers[0];
    each_weight(grains_, i, [&](int carrier, double weight) { sum += weight * at_carriers[carrier]; });
    return sum;
  }
  template <class T>
  void give(int i, const T& value, std::vector<T>& to_carriers) const {
    each_weight(grains_, i, [&](int carrier, double weight) { to_carriers[carrier] += weight * value; });
  }
  template <class T>
  std::vector<T> to_nodes(const std::vector<T>& of_carriers, const T& zero) const;  // sums, not yet over M_a
  std::size_t carriers() const { return shape_ == Shape::hat ? masses_.size() : inv_spline_weight_.size(); }

  // Whether there can be flow on the mesh that the smooth kernel does not see; what follows is for these, of carriers with their images.
  bool is_resolved() const { return resolved_; }
  // sum_i f_i B_g(x_i)/w_g of grains: at_nodes of it is their density [1/m^dim].
  template <class T>
  std::vector<T> density(const std::vector<T>& of_grains) const;
  // sum_a M_a B_g(x_a) f_a/sum_a M_a B_g(x_a)
  template <class T>
  std::vector<T> mean(const std::vector<T>& at_nodes) const;
  // sum_g B_g(x_a) c_g
  template <class T>
  std::vector<T> at_nodes(const std::vector<T>& of_carriers) const;

 private:
  static constexpr int splines = dim == 2 ? 16 : 64;  // that are not 0 at a point
  struct Splines {  // at a point: the first of four along each axis, on a grid without end, and their values
    std::array<int, dim> first;
    std::array<std::array<double, 4>, dim> along;
  };
  struct Seen {    // from a node
    const Splines* sample;
    std::array<int, dim> first;
    double weight;  // N_a times its volume
  };
  Splines splines_at(const Vec<dim>& x) const;
  int on_grid(int number, int axis) const { return on_grid_[axis][number - before_[axis]]; }
  struct Points {  // grains, or nodes: of each the first carrier, and what it gives to all that it meets; the hat: all carriers
    std::vector<int> carrier;
    std::vector<double> weight;
  };
  template <class Use>
  void each_weight(const Points& points, int i, Use&& use) const {
    if (shape_ == Shape::hat) {
      for (int k = i * (dim + 1); k < (i + 1) * (dim + 1); ++k) use(points.carrier[k], points.weight[k]);
      return;
    }
    const double* weight = &points.weight[i * splines];
    for (int last = 0; last < 4; ++last)
      for (int middle = 0; middle < (dim == 3 ? 4 : 1); ++middle, weight += 4) {
        const int from = points.carrier[i] + (dim == 3 ? last * count_[1] + middle : last) * count_[0];
        for (int m = 0; m < 4; ++m) use(from + m, weight[m]);
      }
  }
  void add_row(int node, const std::vector<Vec<dim>>& nodes);
  void weigh_points(std::span<const Vec<dim>> x, Points& points) const;
  // Sums over points: what images got is their splines' too, all is divided by a weight.
  template <class T>
  void finish(std::vector<T>& sums, const std::vector<double>& inv_weight) const {
    for (const auto& [image, spline] : images_) sums[spline] += sums[image];
    for (const auto& [image, spline] : images_) sums[image] = sums[spline];
    for (std::size_t g = 0; g < sums.size(); ++g) sums[g] *= inv_weight[g];
  }

  std::shared_ptr<const Mesh<dim>> mesh_;
  Shape shape_;
  Vec<dim> spacing_, origin_;
  std::array<int, dim> periodic_;        // splines along a period, or 0
  // The grid that a grain in the mesh may meet, and beyond it by rounding: across a period splines are there twice, the second is an image.
  std::array<int, dim> first_, count_;
  std::vector<std::array<int, 2>> images_;     // and of what
  std::array<std::vector<int>, dim> on_grid_;  // of numbers from before_ on, the place of what is no image
  std::array<int, dim> before_;
  std::vector<fluid::QuadraturePoint<dim>> in_element_;  // the samples; empty: nodes
  std::vector<std::vector<std::array<int, 2>>> around_;  // of each node, the elements there and which of their corners it is
  std::vector<Splines> samples_;                         // of each element, or of each node
  std::vector<double> volumes_, masses_;
  std::vector<double> inv_spline_weight_;                // 1/w_g; 0 where no sample meets the spline
  std::vector<Seen> seen_;
  std::vector<double> window_;
  // int N_a B_g, of each node a the splines g that it meets; nothing of images.
  std::vector<int> row_start_, spline_;
  std::vector<double> value_;
  Points grains_, nodes_;
  std::vector<double> inv_node_weight_;  // 1/sum_a M_a B_g(x_a)
  bool resolved_ = false;
};

// Defined here: of any T that can be added and scaled.
template <int dim>
template <class T>
std::vector<T> Kernel<dim>::to_carriers(const std::vector<T>& at_nodes, const T& zero) const {
  if (shape_ == Shape::hat) return at_nodes;
  std::vector<T> sum(carriers(), zero);
  for (std::size_t a = 0; a < at_nodes.size(); ++a) {
    const T here = at_nodes[a];
    for (int k = row_start_[a]; k < row_start_[a + 1]; ++k) sum[spline_[k]] += value_[k] * here;
  }
  for (std::size_t g = 0; g < sum.size(); ++g) sum[g] *= inv_spline_weight_[g];
  for (const auto& [image, spline] : images_) sum[image] = sum[spline];
  return sum;
}

template <int dim>
template <class T>
std::vector<T> Kernel<dim>::to_nodes(const std::vector<T>& of_carriers, const T& zero) const {
  std::vector<T> sum(masses_.size(), zero);
  if (shape_ == Shape::hat) {
    for (std::size_t k = 0; k < sum.size(); ++k) sum[mesh_->master[k]] += of_carriers[k];
  } else {
    std::vector<T> density(of_carriers);
    finish(density, inv_spline_weight_);
    for (std::size_t a = 0; a < sum.size(); ++a) {
      T here = zero;
      for (int k = row_start_[a]; k < row_start_[a + 1]; ++k) here += value_[k] * density[spline_[k]];
      sum[a] = here;
    }
  }
  for (std::size_t k = 0; k < sum.size(); ++k) sum[k] = sum[mesh_->master[k]];
  return sum;
}

template <int dim>
template <class T>
std::vector<T> Kernel<dim>::density(const std::vector<T>& of_grains) const {
  std::vector<T> sum(carriers(), 0.0 * of_grains[0]);
  for (std::size_t i = 0; i < of_grains.size(); ++i) give(static_cast<int>(i), of_grains[i], sum);
  finish(sum, inv_spline_weight_);
  return sum;
}

template <int dim>
template <class T>
std::vector<T> Kernel<dim>::mean(const std::vector<T>& at_nodes) const {
  std::vector<T> sum(carriers(), 0.0 * at_nodes[0]);
  for (std::size_t a = 0; a < at_nodes.size(); ++a)
    if (mesh_->master[a] == static_cast<int>(a))
      each_weight(nodes_, static_cast<int>(a), [&](int carrier, double weight) { sum[carrier] += weight * masses_[a] * at_nodes[a]; });
  finish(sum, inv_node_weight_);
  return sum;
}

template <int dim>
template <class T>
std::vector<T> Kernel<dim>::at_nodes(const std::vector<T>& of_carriers) const {
  std::vector<T> sum(masses_.size(), 0.0 * of_carriers[0]);
  for (std::size_t a = 0; a < sum.size(); ++a)
    each_weight(nodes_, static_cast<int>(a), [&](int carrier, double weight) { sum[a] += weight * of_carriers[carrier]; });
  return sum;
}

}  // namespace quicksand::coupling
