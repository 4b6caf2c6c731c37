#include "kernel.hpp"

#include "meshes/errors.hpp"

#include <algorithm>

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
Kernel<dim>::Kernel(std::shared_ptr<const Mesh<dim>> mesh, Shape shape, double radius, const Vec<dim>& period) : mesh_(std::move(mesh)), shape_(shape), per_grain_(shape == Shape::hat ? dim + 1 : splines) {
  if (shape_ == Shape::smooth) {
    if (!(radius > 0 && std::isfinite(radius))) meshes::fail("Coupling: kernel_radius must be > 0 m and finite, got {}", radius);
    origin_ = mesh_->nodes[0];
    for (const Vec<dim>& x : mesh_->nodes) origin_ = origin_.cwiseMin(x);
    const double wanted = std::sqrt(1.5) * radius;
    for (int k = 0; k < dim; ++k) {
      periodic_[k] = period[k] > 0 ? std::max(1, static_cast<int>(std::lround(period[k] / wanted))) : 0;
      spacing_[k] = periodic_[k] > 0 ? period[k] / periodic_[k] : wanted;
    }
    double largest = 0.0;
    for (const auto& element : mesh_->elements) largest = std::max(largest, fluid::geometry<dim>(mesh_->nodes, element).volume);
    const int elements_at_node = dim == 2 ? 6 : 24;
    if (std::pow(largest * elements_at_node / (dim + 1), 1.0 / dim) > 0.4 * wanted) {
      int halvings = 0;
      const std::size_t in_part = fluid::quadrature<dim, 2>().size();
      for (double apart = std::pow(largest / in_part, 1.0 / dim); apart > apart_at_most * wanted && halvings < 8; apart *= 0.5) ++halvings;
      if (halvings > 5) meshes::fail("Coupling: kernel_radius = {} m is too small for elements of {} m^{}: take kernel=\"hat\", a finer mesh or a larger radius", radius, largest, dim);
      in_element_ = samples_of_parts<dim>(halvings);
    }
  }
  place(mesh_->nodes);
}

template <int dim>
void Kernel<dim>::place(const std::vector<Vec<dim>>& nodes) {
  masses_.assign(nodes.size(), 0.0);
  for (const auto& element : mesh_->elements) {
    const double share = fluid::geometry<dim>(nodes, element).volume / (dim + 1);
    for (const int k : element) masses_[mesh_->master[k]] += share;
  }
  for (std::size_t k = 0; k < nodes.size(); ++k) masses_[k] = masses_[mesh_->master[k]];
  if (shape_ == Shape::hat) return;
  Vec<dim> low = nodes[0], high = low;
  for (const Vec<dim>& x : nodes) low = low.cwiseMin(x), high = high.cwiseMax(x);
  std::size_t total = 1;
  for (int k = 0; k < dim; ++k) {
    first_[k] = periodic_[k] > 0 ? 0 : static_cast<int>(std::floor((low[k] - origin_[k]) / spacing_[k])) - 1;
    count_[k] = periodic_[k] > 0 ? periodic_[k] : static_cast<int>(std::floor((high[k] - origin_[k]) / spacing_[k])) + 3 - first_[k];
    total *= count_[k];
  }
  samples_.clear();
  auto add = [&](const Vec<dim>& x, double volume, const std::array<int, dim + 1>& node, const Barycentric<dim>& l) {
    Sample& sample = samples_.emplace_back();
    sample.node = node, sample.l = l, sample.volume = volume;
    splines_at(x, sample.spline.data(), sample.b.data());
  };
  if (in_element_.empty()) {
    for (std::size_t k = 0; k < nodes.size(); ++k) {
      if (mesh_->master[k] != static_cast<int>(k)) continue;
      std::array<int, dim + 1> node;
      node.fill(static_cast<int>(k));
      add(nodes[k], masses_[k], node, {1.0});
    }
  } else {
    for (const auto& element : mesh_->elements) {
      const double volume = fluid::geometry<dim>(nodes, element).volume;
      std::array<int, dim + 1> node;
      for (int a = 0; a <= dim; ++a) node[a] = mesh_->master[element[a]];
      for (const auto& [l, share] : in_element_) {
        Vec<dim> x = Vec<dim>::Zero();
        for (int a = 0; a <= dim; ++a) x += l[a] * nodes[element[a]];
        add(x, share * volume, node, l);
      }
    }
  }
  spline_weight_.assign(total, 0.0);
  for (const Sample& s : samples_)
    for (int k = 0; k < splines; ++k) spline_weight_[s.spline[k]] += s.volume * s.b[k];
}

// The cubic B-splines at x and their numbers.
template <int dim>
void Kernel<dim>::splines_at(const Vec<dim>& x, int* spline, double* b) const {
  std::array<std::array<double, 4>, dim> along;
  std::array<std::array<int, 4>, dim> number;
  for (int k = 0; k < dim; ++k) {
    const double t = (x[k] - origin_[k]) / spacing_[k], cell = std::floor(t), f = t - cell, g = 1 - f;
    along[k] = {g * g * g / 6, 2.0 / 3 - f * f * (1 - 0.5 * f), 2.0 / 3 - g * g * (1 - 0.5 * g), f * f * f / 6};
    for (int m = 0; m < 4; ++m) {
      int n = static_cast<int>(cell) - 1 + m - first_[k];
      while (periodic_[k] > 0 && n < 0) n += periodic_[k];
      while (periodic_[k] > 0 && n >= periodic_[k]) n -= periodic_[k];
      number[k][m] = std::clamp(n, 0, count_[k] - 1);  // of a grain that rounding puts beyond the mesh
    }
  }
  int at = 0;
  for (int last = 0; last < 4; ++last)
    for (int middle = 0; middle < (dim == 3 ? 4 : 1); ++middle) {
      int row = number[dim - 1][last];
      double product = along[dim - 1][last];
      if constexpr (dim == 3) row = row * count_[1] + number[1][middle], product *= along[1][middle];
      for (int m = 0; m < 4; ++m, ++at) spline[at] = row * count_[0] + number[0][m], b[at] = product * along[0][m];
    }
}

template <int dim>
void Kernel<dim>::weigh(std::span<const Vec<dim>> x, const std::vector<Place<dim>>& places) {
  carrier_.resize(x.size() * per_grain_), weight_.resize(carrier_.size());
  for (std::size_t i = 0; i < x.size(); ++i) {
    if (shape_ == Shape::smooth) {
      splines_at(x[i], &carrier_[i * splines], &weight_[i * splines]);
      double met = 0.0;  // less than 1 where the mesh ends within a spline that no sample meets
      for (int k = 0; k < splines; ++k) {
        double& b = weight_[i * splines + k];
        if (spline_weight_[carrier_[i * splines + k]] == 0.0) b = 0.0;
        met += b;
      }
      for (int k = 0; k < splines; ++k) weight_[i * splines + k] /= met;
      continue;
    }
    const auto& corners = mesh_->elements[places[i].element];
    for (int a = 0; a <= dim; ++a) carrier_[i * per_grain_ + a] = mesh_->master[corners[a]], weight_[i * per_grain_ + a] = std::max(places[i].l[a], 0.0);  // below 0 by rounding, on a face
  }
}

template class Kernel<2>;
template class Kernel<3>;

}  // namespace quicksand::coupling
