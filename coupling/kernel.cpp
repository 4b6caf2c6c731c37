#include "kernel.hpp"

#include "meshes/errors.hpp"

#include <algorithm>
#include <numeric>

namespace quicksand::coupling {

namespace {

// Samples of an element, spaced 1/parts of its edges: the middles of the parts it is cut into, corners of the same shape first, then what is
// between them; all of the same volume. In 3D the four corners and four parts of the octahedron between them, again and again.
template <int dim>
std::vector<Barycentric<dim>> middles(int halvings) {
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
  std::vector<Barycentric<dim>> middles;
  for (const Corners& c : parts) {
    Barycentric<dim> m{};
    for (const auto& corner : c)
      for (int k = 0; k <= dim; ++k) m[k] += corner[k] / (dim + 1);
    middles.push_back(m);
  }
  return middles;
}

constexpr double spacing = 0.7;  // of samples at most, in radii
constexpr int cells_in_reach = 2;
constexpr double balanced = 1e-4;  // how uniform a uniform field of grains reads, at the start

}  // namespace

template <int dim>
Kernel<dim>::Kernel(std::shared_ptr<const Mesh<dim>> mesh, Shape shape, double radius, const Vec<dim>& period)
    : mesh_(std::move(mesh)), shape_(shape), reach_(radius * std::sqrt(dim + 8.0)), period_(period), sum_(mesh_->nodes.size(), 0.0) {
  if (shape_ == Shape::smooth) {
    if (!(radius > 0 && std::isfinite(radius))) meshes::fail("Coupling: kernel_radius must be > 0 m and finite, got {}", radius);
    double largest = 0.0;
    for (const auto& element : mesh_->elements) largest = std::max(largest, fluid::geometry<dim>(mesh_->nodes, element).volume);
    const int elements_at_node = dim == 2 ? 6 : 24;
    // Samples about as far apart as the radius, or nearer: nodes, or parts of elements.
    if (std::pow(largest * elements_at_node / (dim + 1), 1.0 / dim) > 0.5 * radius) {
      int halvings = 0;
      for (double apart = std::pow(largest, 1.0 / dim); apart > spacing * radius && halvings < 8; apart *= 0.5) ++halvings;
      if (halvings > 5) meshes::fail("Coupling: kernel_radius = {} m is too small for elements of {} m^{}: take kernel=\"hat\", a finer mesh or a larger radius", radius, largest, dim);
      in_element_ = middles<dim>(halvings);
    }
  }
  place(mesh_->nodes);
  if (shape_ == Shape::hat) return;
  b_.assign(samples_.size(), 1.0);
  sort();
  for (int k = 0; k < 100; ++k) {
    const std::vector<double> before = b_;
    balance_once();
    double change = 0.0;
    for (std::size_t s = 0; s < b_.size(); ++s) change = std::max(change, std::abs(b_[s] / before[s] - 1));
    if (change < 0.5 * balanced) break;
  }
}

template <int dim>
void Kernel<dim>::place(const std::vector<Vec<dim>>& nodes) {
  masses_.assign(nodes.size(), 0.0);
  samples_.clear();
  for (const auto& element : mesh_->elements) {
    const double volume = fluid::geometry<dim>(nodes, element).volume;
    for (const int k : element) masses_[mesh_->master[k]] += volume / (dim + 1);
    for (const auto& l : in_element_) {
      Sample sample{.x = Vec<dim>::Zero(), .volume = volume / in_element_.size(), .node = {}, .l = l};
      for (int a = 0; a <= dim; ++a) sample.x += l[a] * nodes[element[a]], sample.node[a] = mesh_->master[element[a]];
      samples_.push_back(sample);
    }
  }
  for (std::size_t k = 0; k < nodes.size(); ++k) masses_[k] = masses_[mesh_->master[k]];
  if (shape_ == Shape::hat) return;
  if (in_element_.empty())
    for (std::size_t k = 0; k < nodes.size(); ++k)
      if (mesh_->master[k] == static_cast<int>(k)) {
        Sample sample{.x = nodes[k], .volume = masses_[k], .node = {}, .l = {1.0}};
        sample.node.fill(static_cast<int>(k));
        samples_.push_back(sample);
      }
  if (b_.empty()) return;
  sort();
  balance_once();
}

// Samples and their images into cells of R/cells_in_reach, those of a row of cells one after the other.
template <int dim>
void Kernel<dim>::sort() {
  std::vector<Near> all;
  low_ = samples_[0].x;
  Vec<dim> high = low_;
  for (const Sample& s : samples_) low_ = low_.cwiseMin(s.x), high = high.cwiseMax(s.x);
  const Vec<dim> from = low_.array() - 2 * reach_, to = high.array() + 2 * reach_;  // grains may be beyond the last sample, by its distance
  std::array<int, dim> images;
  int combinations = 1;
  for (int k = 0; k < dim; ++k) images[k] = period_[k] > 0 ? static_cast<int>(std::ceil(reach_ / period_[k])) : 0, combinations *= 2 * images[k] + 1;
  for (std::size_t s = 0; s < samples_.size(); ++s)
    for (int c = 0; c < combinations; ++c) {
      Vec<dim> x = samples_[s].x;
      for (int k = 0, rest = c; k < dim; ++k) {
        x[k] += (rest % (2 * images[k] + 1) - images[k]) * period_[k];
        rest /= 2 * images[k] + 1;
      }
      if ((x.array() >= from.array()).all() && (x.array() <= to.array()).all()) all.push_back({x, samples_[s].volume * b_[s], static_cast<int>(s)});
    }
  low_ = all[0].x, high = low_;
  for (const Near& n : all) low_ = low_.cwiseMin(n.x), high = high.cwiseMax(n.x);
  const double cell = reach_ / cells_in_reach;
  int total = 1;
  for (int k = 0; k < dim; ++k) total *= cells_[k] = static_cast<int>((high[k] - low_[k]) / cell) + 1;
  auto flat = [&](const Vec<dim>& x) {
    int f = 0;
    for (int k = dim - 1; k >= 0; --k) f = f * cells_[k] + std::clamp(static_cast<int>((x[k] - low_[k]) / cell), 0, cells_[k] - 1);
    return f;
  };
  cell_start_.assign(total + 1, 0);
  for (const Near& n : all) ++cell_start_[flat(n.x) + 1];
  std::partial_sum(cell_start_.begin(), cell_start_.end(), cell_start_.begin());
  near_.resize(all.size());
  std::vector<int> at(cell_start_.begin(), cell_start_.end() - 1);
  for (const Near& n : all) near_[at[flat(n.x)]++] = n;
}

// Calls use(sample, volume b K) for those within reach of x.
template <int dim>
template <class Use>
void Kernel<dim>::within(const Vec<dim>& x, Use&& use) const {
  const double cell = reach_ / cells_in_reach, scale = 1 / (reach_ * reach_);
  std::array<int, dim> first, last, c;
  for (int k = 0; k < dim; ++k) {
    first[k] = std::max(static_cast<int>(std::floor((x[k] - reach_ - low_[k]) / cell)), 0);
    last[k] = std::min(static_cast<int>(std::floor((x[k] + reach_ - low_[k]) / cell)), cells_[k] - 1);
    if (first[k] > last[k]) return;
  }
  c = first;
  for (bool more = true; more;) {
    int row = 0;
    for (int k = dim - 1; k > 0; --k) row = (row + c[k]) * cells_[k - 1];
    for (int n = cell_start_[row + first[0]]; n < cell_start_[row + last[0] + 1]; ++n) {
      const double inside = 1 - (near_[n].x - x).squaredNorm() * scale;
      if (inside > 0) use(near_[n].sample, near_[n].weight * inside * inside * inside);
    }
    more = false;
    for (int k = 1; k < dim && !more; ++k) more = ++c[k] <= last[k] || (c[k] = first[k], false);
  }
}

// b <- sqrt(b/int b K): converges where b <- 1/int b K would swing about the answer.
template <int dim>
void Kernel<dim>::balance_once() {
  std::vector<double> next(b_.size());
  for (std::size_t s = 0; s < b_.size(); ++s) {
    double sum = 0.0;
    within(samples_[s].x, [&](int, double weight) { sum += weight; });
    next[s] = std::sqrt(b_[s] / sum);
  }
  for (Near& n : near_) n.weight *= next[n.sample] / b_[n.sample];
  b_.swap(next);
}

template <int dim>
const Weights<dim>& Kernel<dim>::weigh(std::span<const Vec<dim>> x, const std::vector<Place<dim>>& places) {
  weights_.start.assign(1, 0), weights_.node.clear(), weights_.weight.clear();
  for (std::size_t i = 0; i < x.size(); ++i) {
    auto push = [&](int node, double weight) { weights_.node.push_back(node), weights_.weight.push_back(weight); };
    const auto& corners = mesh_->elements[places[i].element];
    if (shape_ == Shape::hat) {
      for (int a = 0; a <= dim; ++a) push(mesh_->master[corners[a]], std::max(places[i].l[a], 0.0));  // on a face it may be below, by rounding
    } else {
      double total = 0.0;
      auto add = [&](int node, double weight) {
        if (sum_[node] == 0.0) touched_.push_back(node);
        sum_[node] += weight;
      };
      within(x[i], [&](int s, double weight) {
        total += weight;
        const Sample& sample = samples_[s];
        if (in_element_.empty()) add(sample.node[0], weight);
        else for (int a = 0; a <= dim; ++a) add(sample.node[a], weight * sample.l[a]);
      });
      for (const int node : touched_) push(node, sum_[node] / total), sum_[node] = 0.0;
      touched_.clear();
    }
    weights_.start.push_back(static_cast<int>(weights_.node.size()));
  }
  return weights_;
}

template class Kernel<2>;
template class Kernel<3>;

}  // namespace quicksand::coupling
