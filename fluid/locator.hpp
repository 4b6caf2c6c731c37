// Which element holds a point: elements in the cells of a regular grid over the mesh.
#pragma once

#include "element.hpp"

#include <algorithm>
#include <optional>
#include <utility>

namespace quicksand::fluid {

template <int dim>
class Locator {
 public:
  Locator(const Mesh<dim>& mesh, const std::vector<Vec<dim>>& position) : mesh_(mesh), position_(position) {
    low_ = position[0];
    Vec<dim> high = low_;
    for (const Vec<dim>& x : position) low_ = low_.cwiseMin(x), high = high.cwiseMax(x);
    const Vec<dim> length = (high - low_).cwiseMax(1e-300);
    const double edge = std::pow(length.prod() / static_cast<double>(mesh.elements.size()), 1.0 / dim);
    int cells = 1;
    for (int k = 0; k < dim; ++k) cells *= count_[k] = std::max(1, static_cast<int>(length[k] / edge));
    size_ = length;
    for (int k = 0; k < dim; ++k) size_[k] /= count_[k];
    in_cell_.resize(cells);
    for (std::size_t e = 0; e < mesh.elements.size(); ++e) {
      Vec<dim> from = position[mesh.elements[e][0]], to = from;
      for (const int k : mesh.elements[e]) from = from.cwiseMin(position[k]), to = to.cwiseMax(position[k]);
      const auto a = cell(from), b = cell(to);
      std::array<int, dim> c = a;
      for (bool more = true; more;) {
        in_cell_[flat(c)].push_back(static_cast<int>(e));
        more = false;
        for (int k = 0; k < dim && !more; ++k) more = ++c[k] <= b[k] || (c[k] = a[k], false);
      }
    }
  }

  // The element, and where in it; on a boundary up to rounding also from outside.
  std::optional<std::pair<int, Barycentric<dim>>> find(const Vec<dim>& x) const {
    std::optional<std::pair<int, Barycentric<dim>>> best;
    double deepest = -1e-9;
    for (const int e : in_cell_[flat(cell(x))]) {
      const Geometry<dim> g = geometry<dim>(position_, mesh_.elements[e]);
      Barycentric<dim> l;
      for (int a = 0; a <= dim; ++a) l[a] = 1.0 + g.grad_l[a].dot(x - position_[mesh_.elements[e][a]]);
      const double least = *std::min_element(l.begin(), l.end());
      if (least > deepest) deepest = least, best = {e, l};
    }
    return best;
  }

 private:
  std::array<int, dim> cell(const Vec<dim>& x) const {
    std::array<int, dim> c;
    for (int k = 0; k < dim; ++k) c[k] = std::clamp(static_cast<int>(std::clamp((x[k] - low_[k]) / size_[k], -1.0, 1e9)), 0, count_[k] - 1);
    return c;
  }
  int flat(const std::array<int, dim>& c) const {
    int f = c[dim - 1];
    for (int k = dim - 2; k >= 0; --k) f = f * count_[k] + c[k];
    return f;
  }

  const Mesh<dim>& mesh_;
  const std::vector<Vec<dim>>& position_;
  Vec<dim> low_, size_;
  std::array<int, dim> count_;
  std::vector<std::vector<int>> in_cell_;
};

}  // namespace quicksand::fluid
