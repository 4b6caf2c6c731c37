// A facet of the mesh seen from the element that it bounds, and quadrature on it.
#pragma once

#include "element.hpp"

#include <algorithm>

namespace quicksand::fluid {

// Which corners of its first element are the facet's own, and its area times the normal out of that element.
template <int dim>
struct FacetView {
  int element;
  std::array<int, dim> corner;
  Geometry<dim> geometry;  // of the element
  Vec<dim> area;           // [m^(dim-1)]
  FacetView(const Mesh<dim>& mesh, const std::vector<Vec<dim>>& position, int facet) : FacetView(mesh, facet, [&](int node) { return position[node]; }) {}
  template <class Where>
  FacetView(const Mesh<dim>& mesh, int facet, Where&& where) : element(mesh.facet_elements[facet][0]) {
    std::array<Vec<dim>, dim + 1> x;
    int opposite = 0, k = 0;
    for (int a = 0; a <= dim; ++a) {
      const int node = mesh.elements[element][a];
      x[a] = where(node);
      const auto& in = mesh.facets[facet];
      std::find(in.begin(), in.end(), node) == in.end() ? void(opposite = a) : void(corner[k++] = a);
    }
    geometry = fluid::geometry<dim>(x);
    area = -dim * geometry.volume * geometry.grad_l[opposite];  // grad L points to the corner and is one over its height
  }
};

// Calls use(point in the element, weight) at the quadrature points of a facet.
template <int dim, class Use>
void along(const FacetView<dim>& facet, Use&& use) {
  for (const auto& point : quadrature<dim - 1, 2>()) {
    Barycentric<dim> l{};
    for (int k = 0; k < dim; ++k) l[facet.corner[k]] = point.l[k];
    use(l, point.weight);
  }
}

}  // namespace quicksand::fluid
