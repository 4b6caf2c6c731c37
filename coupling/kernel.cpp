#include "kernel.hpp"

#include "meshes/errors.hpp"

#include <algorithm>
#include <limits>

namespace quicksand::coupling {

namespace {

// Samples of an element: those of a rule of degree 4 on each of the parts that it is cut into, its corners and what is between them, again and again;
// in 3D that is an octahedron, cut into four. All parts are of the same volume.
template <int dim>
std::vector<fluid::QuadraturePoint<dim>> samples_of_parts(int halvings) {
  using Corners = std::array<Barycentric<dim>, dim + 1>;
  Corners whole{};
  for (int a = 0; a <= dim; ++a) whole[a][a] = 1.0;
  std::vector<Corners> parts{whole};
  auto half = [](const Barycentric<dim>& p, const Barycentric<dim>& q) {
    Barycentric<dim> m;
    for (int k = 0; k <= dim; ++k) m[k] = 0.5 * (p[k] + q[k]);
    return m;
  };
  for (int h = 0; h < halvings; ++h) {
    std::vector<Corners> next;
    for (const Corners& c : parts) {
      for (int a = 0; a <= dim; ++a) {
        Corners corner;
        for (int b = 0; b <= dim; ++b) corner[b] = half(c[a], c[b]);
        next.push_back(corner);
      }
      if constexpr (dim == 2) {
        next.push_back({half(c[0], c[1]), half(c[1], c[2]), half(c[2], c[0])});
      } else {
        const auto a = half(c[0], c[1]), b = half(c[2], c[3]);  // opposite: the axis of the octahedron
        const std::array ring{half(c[0], c[2]), half(c[1], c[2]), half(c[1], c[3]), half(c[0], c[3])};
        for (int k = 0; k < 4; ++k) next.push_back({a, b, ring[k], ring[(k + 1) % 4]});
      }
    }
    parts.swap(next);
  }
  std::vector<fluid::QuadraturePoint<dim>> samples;
  for (const Corners& c : parts)
    for (const auto& point : fluid::quadrature<dim, 2>()) {
      auto& sample = samples.emplace_back(fluid::QuadraturePoint<dim>{{}, point.weight / parts.size()});
      for (int a = 0; a <= dim; ++a)
        for (int k = 0; k <= dim; ++k) sample.l[k] += point.l[a] * c[a][k];
    }
  return samples;
}

constexpr double apart_at_most = 0.8;  // of samples, in spacings of the splines

}  // namespace

template <int dim>
Kernel<dim>::Kernel(std::shared_ptr<const Mesh<dim>> mesh, Shape shape, double radius, const Vec<dim>& period) : mesh_(std::move(mesh)), shape_(shape) {
  if (shape_ == Shape::smooth) {
    if (!(radius > 0 && std::isfinite(radius))) meshes::fail("Coupling: kernel_radius must be > 0 m and finite, got {}", radius);
    origin_ = mesh_->nodes[0];
    for (const Vec<dim>& x : mesh_->nodes) origin_ = origin_.cwiseMin(x);
    const double wanted = std::sqrt(1.5) * radius;
    for (int k = 0; k < dim; ++k) {
      periodic_[k] = period[k] > 0 ? std::max(1, static_cast<int>(std::lround(period[k] / wanted))) : 0;
      spacing_[k] = periodic_[k] > 0 ? period[k] / periodic_[k] : wanted;
    }
    double largest = 0.0, smallest = std::numeric_limits<double>::infinity();
    for (const auto& element : mesh_->elements) {
      const double volume = fluid::geometry<dim>(mesh_->nodes, element).volume;
      largest = std::max(largest, volume), smallest = std::min(smallest, volume);
    }
    // K lets half of a wave of length 2 h pass at h = 2.67 radii.
    resolved_ = std::pow(smallest * (dim == 2 ? 2 : 6), 1.0 / dim) < 2.5 * radius;
    const int elements_at_node = dim == 2 ? 6 : 24;
    if (std::pow(largest * elements_at_node / (dim + 1), 1.0 / dim) > 0.4 * wanted) {
      int halvings = 0;
      const std::size_t in_part = fluid::quadrature<dim, 2>().size();
      for (double apart = std::pow(largest / in_part, 1.0 / dim); apart > apart_at_most * wanted && halvings < 8; apart *= 0.5) ++halvings;
      if (halvings > 5) meshes::fail("Coupling: kernel_radius = {} m is too small for elements of {} m^{}: take kernel=\"hat\", a finer mesh or a larger radius", radius, largest, dim);
      in_element_ = samples_of_parts<dim>(halvings);
      around_.resize(mesh_->nodes.size());
      for (std::size_t e = 0; e < mesh_->elements.size(); ++e)
        for (int a = 0; a <= dim; ++a) around_[mesh_->master[mesh_->elements[e][a]]].push_back({static_cast<int>(e), a});
    }
  }
  place(mesh_->nodes);
}

template <int dim>
[[gnu::always_inline]] inline auto Kernel<dim>::splines_at(const Vec<dim>& x) const -> Splines {
  Splines at;
  for (int k = 0; k < dim; ++k) {
    const double t = (x[k] - origin_[k]) * (1 / spacing_[k]), cell = std::floor(t), f = t - cell, g = 1 - f;
    at.first[k] = static_cast<int>(cell) - 1;
    at.along[k] = {1.0 / 6 * g * g * g, 2.0 / 3 - f * f * (1 - 0.5 * f), 2.0 / 3 - g * g * (1 - 0.5 * g), 1.0 / 6 * f * f * f};
  }
  return at;
}

template <int dim>
void Kernel<dim>::place(const std::vector<Vec<dim>>& nodes) {
  masses_.assign(nodes.size(), 0.0);
  volumes_.clear();
  for (const auto& element : mesh_->elements) {
    volumes_.push_back(fluid::geometry<dim>(nodes, element).volume);
    for (const int k : element) masses_[mesh_->master[k]] += volumes_.back() / (dim + 1);
  }
  for (std::size_t k = 0; k < nodes.size(); ++k) masses_[k] = masses_[mesh_->master[k]];
  if (shape_ == Shape::hat) return;
  Vec<dim> low = nodes[0], high = low;
  for (const Vec<dim>& x : nodes) low = low.cwiseMin(x), high = high.cwiseMax(x);
  for (int k = 0; k < dim; ++k) {
    first_[k] = static_cast<int>(std::floor((low[k] - origin_[k]) / spacing_[k])) - 2;
    count_[k] = static_cast<int>(std::floor((high[k] - origin_[k]) / spacing_[k])) + 4 - first_[k];
    // Splines of an element, as seen from one of its nodes on the other side of the mesh.
    before_[k] = first_[k] - count_[k];
    on_grid_[k].resize(3 * count_[k]);
    for (int n = 0; n < 3 * count_[k]; ++n)
      on_grid_[k][n] = periodic_[k] > 0 ? (n + (periodic_[k] - 1) * count_[k]) % periodic_[k] : std::clamp(n - count_[k], 0, count_[k] - 1);
  }
  images_.clear();
  const int rows = dim == 2 ? count_[1] : count_[1] * count_[dim - 1];
  for (int row = 0, g = 0; row < rows; ++row) {
    int of = on_grid(first_[dim - 1] + (dim == 3 ? row / count_[1] : row), dim - 1);
    if constexpr (dim == 3) of = of * count_[1] + on_grid(first_[1] + row % count_[1], 1);
    for (int m = 0; m < count_[0]; ++m, ++g)
      if (const int spline = of * count_[0] + on_grid(first_[0] + m, 0); spline != g) images_.push_back({g, spline});
  }
  samples_.clear();
  if (in_element_.empty())
    for (const Vec<dim>& x : nodes) samples_.push_back(splines_at(x));
  else
    for (const auto& element : mesh_->elements)
      for (const auto& sample : in_element_) {
        Vec<dim> x = Vec<dim>::Zero();
        for (int a = 0; a <= dim; ++a) x += sample.l[a] * nodes[element[a]];
        samples_.push_back(splines_at(x));
      }
  row_start_.assign(1, 0), spline_.clear(), value_.clear();
  for (std::size_t k = 0; k < nodes.size(); ++k) {
    if (mesh_->master[k] == static_cast<int>(k)) add_row(static_cast<int>(k), nodes);
    row_start_.push_back(static_cast<int>(spline_.size()));
  }
  inv_spline_weight_.assign(rows * count_[0], 0.0);
  for (std::size_t k = 0; k < spline_.size(); ++k) inv_spline_weight_[spline_[k]] += value_[k];
  for (double& w : inv_spline_weight_) w = w > 0 ? 1 / w : 0.0;
  for (const auto& [image, spline] : images_) inv_spline_weight_[image] = inv_spline_weight_[spline];
  if (!resolved_) return;
  weigh_points(nodes, nodes_);
  inv_node_weight_.assign(carriers(), 1.0);
  inv_node_weight_ = mean(std::vector<double>(nodes.size(), 1.0));
  for (double& w : inv_node_weight_) w = w > 0 ? 1 / w : 0.0;
}

// The splines that a node meets, gathered on the part of the grid that they lie in.
template <int dim>
void Kernel<dim>::add_row(int node, const std::vector<Vec<dim>>& nodes) {
  if (!in_element_.empty() && around_[node].empty()) return;
  std::array<int, dim> low, size{};
  low.fill(std::numeric_limits<int>::max());
  seen_.clear();
  if (in_element_.empty()) seen_.push_back({&samples_[node], samples_[node].first, masses_[node]});
  else
    for (const auto& [element, corner] : around_[node]) {
      std::array<int, dim> shift{};  // of an image
      const Vec<dim> way = nodes[mesh_->elements[element][corner]] - nodes[node];
      for (int axis = 0; axis < dim; ++axis)
        if (periodic_[axis] > 0) shift[axis] = static_cast<int>(std::lround(way[axis] / spacing_[axis]));
      for (std::size_t s = 0; s < in_element_.size(); ++s) {
        const Splines& sample = samples_[element * in_element_.size() + s];
        Seen& seen = seen_.emplace_back(Seen{&sample, sample.first, in_element_[s].weight * in_element_[s].l[corner] * volumes_[element]});
        for (int axis = 0; axis < dim; ++axis) seen.first[axis] -= shift[axis];
      }
    }
  for (const Seen& seen : seen_)
    for (int axis = 0; axis < dim; ++axis) low[axis] = std::min(low[axis], seen.first[axis]);
  for (const Seen& seen : seen_)
    for (int axis = 0; axis < dim; ++axis) size[axis] = std::max(size[axis], seen.first[axis] - low[axis] + 4);
  const int rows = dim == 2 ? size[1] : size[1] * size[dim - 1];
  window_.assign(rows * size[0], 0.0);
  for (const Seen& seen : seen_) {
    int row = seen.first[dim - 1] - low[dim - 1];
    if constexpr (dim == 3) row = row * size[1] + seen.first[1] - low[1];
    double* to = &window_[row * size[0] + seen.first[0] - low[0]];
    const Eigen::Array4d along = seen.weight * Eigen::Map<const Eigen::Array4d>(seen.sample->along[0].data());
    for (int last = 0; last < 4; ++last) {
      const double outer = seen.sample->along[dim - 1][last];
      if constexpr (dim == 2) Eigen::Map<Eigen::Array4d>(to + last * size[0]) += outer * along;
      else
        for (int middle = 0; middle < 4; ++middle) Eigen::Map<Eigen::Array4d>(to + (last * size[1] + middle) * size[0]) += outer * seen.sample->along[1][middle] * along;
    }
  }
  std::size_t k = spline_.size();
  spline_.resize(k + rows * size[0]), value_.resize(k + rows * size[0]);
  for (int row = 0; row < rows; ++row) {
    int from = on_grid(low[dim - 1] + (dim == 3 ? row / size[1] : row), dim - 1);
    if constexpr (dim == 3) from = from * count_[1] + on_grid(low[1] + row % size[1], 1);
    const double* value = &window_[row * size[0]];
    const int* column = &on_grid_[0][low[0] - before_[0]];
    for (int m = 0; m < size[0]; ++m) {
      spline_[k] = from * count_[0] + column[m], value_[k] = value[m];
      k += value[m] > 0;
    }
  }
  spline_.resize(k), value_.resize(k);
}

template <int dim>
void Kernel<dim>::weigh(std::span<const Vec<dim>> x, const std::vector<Place<dim>>& places) {
  if (shape_ == Shape::smooth) {
    weigh_points(x, grains_);
    return;
  }
  grains_.carrier.clear(), grains_.weight.clear();
  for (const Place<dim>& place : places)
    for (int a = 0; a <= dim; ++a) grains_.carrier.push_back(mesh_->master[mesh_->elements[place.element][a]]), grains_.weight.push_back(std::max(place.l[a], 0.0));  // below 0 by rounding, on a face
}

template <int dim>
void Kernel<dim>::weigh_points(std::span<const Vec<dim>> x, Points& points) const {
  points.carrier.resize(x.size()), points.weight.resize(x.size() * splines);
  for (std::size_t i = 0; i < x.size(); ++i) {
    const Splines at = splines_at(x[i]);
    int first = at.first[dim - 1] - first_[dim - 1];
    for (int axis = dim - 2; axis >= 0; --axis) first = first * count_[axis] + at.first[axis] - first_[axis];
    points.carrier[i] = first;
    const auto along = Eigen::Map<const Eigen::Array4d>(at.along[0].data());
    double* b = &points.weight[i * splines];
    Eigen::Array4d met = Eigen::Array4d::Zero();  // in all less than 1 where the mesh ends within a spline that no sample meets
    for (int last = 0, k = 0; last < 4; ++last)
      for (int middle = 0; middle < (dim == 3 ? 4 : 1); ++middle, k += 4) {
        const double* inv_w = &inv_spline_weight_[first + (dim == 3 ? last * count_[1] + middle : last) * count_[0]];
        double product = at.along[dim - 1][last];
        if constexpr (dim == 3) product *= at.along[1][middle];
        const Eigen::Array4d here = (Eigen::Map<const Eigen::Array4d>(inv_w) > 0).select(product * along, 0.0);
        Eigen::Map<Eigen::Array4d>(b + k) = here;
        met += here;
      }
    const double all = 1 / met.sum();
    for (int k = 0; k < splines; k += 4) Eigen::Map<Eigen::Array4d>(b + k) *= all;  // as they were stored: longer ones would wait for memory
  }
}

template class Kernel<2>;
template class Kernel<3>;

}  // namespace quicksand::coupling
