#include "walker.hpp"

#include <map>

namespace quicksand::coupling {

template <int dim>
Walker<dim>::Walker(std::shared_ptr<const Mesh<dim>> mesh, const Vec<dim>& period) : mesh_(std::move(mesh)), period_(period), low_(mesh_->nodes[0]) {
  place(mesh_->nodes);
  for (const Vec<dim>& x : nodes_) low_ = low_.cwiseMin(x);
  auto key = [](auto facet) {
    std::sort(facet.begin(), facet.end());
    return facet;
  };
  std::map<std::array<int, dim>, std::array<int, 2>> sides;  // element and corner that met the facet first
  across_.resize(mesh_->elements.size());
  for (std::size_t e = 0; e < across_.size(); ++e)
    for (int corner = 0; corner <= dim; ++corner) {
      across_[e][corner] = -1;
      const auto [other, is_first] = sides.try_emplace(key(meshes::outward_facet<dim>(mesh_->elements[e], corner)), std::array{static_cast<int>(e), corner});
      if (is_first) continue;
      across_[e][corner] = other->second[0];
      across_[other->second[0]][other->second[1]] = static_cast<int>(e);
    }
  for (std::size_t f = 0; f < mesh_->facets.size(); ++f) {
    if (mesh_->facet_elements[f][1] >= 0) continue;
    const auto [e, corner] = sides.at(key(mesh_->facets[f]));
    across_[e][corner] = -1 - mesh_->boundary[f];
  }
}

template <int dim>
void Walker<dim>::place(const std::vector<Vec<dim>>& nodes) {
  nodes_ = nodes, locator_.reset();
  geometry_.clear();
  for (const auto& element : mesh_->elements) geometry_.push_back(fluid::geometry<dim>(nodes_, element));
}

template <int dim>
Vec<dim> Walker<dim>::wrap(Vec<dim> x) const {
  for (int k = 0; k < dim; ++k)
    if (period_[k] > 0) x[k] -= period_[k] * std::floor((x[k] - low_[k]) / period_[k]);
  return x;
}

template <int dim>
void Walker<dim>::find(const Vec<dim>& x, Place<dim>& now) {
  now.left_by = -1;
  int boundary = -1;
  for (int steps = 0; steps < 200; ++steps) {  // a walk may go round in circles on slender elements: then the grid decides
    const auto& corners = mesh_->elements[now.element];
    const auto& g = geometry_[now.element];
    int lowest = 0;
    for (int a = 0; a <= dim; ++a) {
      now.l[a] = 1.0 + g.grad_l[a].dot(x - nodes_[corners[a]]);
      if (now.l[a] < now.l[lowest]) lowest = a;
    }
    if (now.l[lowest] >= 0) return;
    const int next = across_[now.element][lowest];
    if (next < 0) {
      boundary = -1 - next;
      break;
    }
    now.element = next;
  }
  if (!locator_) locator_.emplace(*mesh_, nodes_);
  if (const auto found = locator_->find(x)) now.element = found->first, now.l = found->second;
  else now.left_by = std::max(boundary, 0);
}

template class Walker<2>;
template class Walker<3>;

}  // namespace quicksand::coupling
