// In which element each grain is, found by walking from the one it was in.
#pragma once

#include "fluid/locator.hpp"

#include <memory>
#include <span>

namespace quicksand::coupling {

using fluid::Barycentric;
using fluid::Mesh;
using fluid::Vec;

template <int dim>
struct Place {
  int element = 0;
  Barycentric<dim> l{};  // barycentric coordinates in it
  int left_by = -1;      // boundary that the grain has left the mesh by; -1: it is inside
};

template <int dim>
class Walker {
 public:
  Walker(std::shared_ptr<const Mesh<dim>> mesh, const Vec<dim>& period);

  void place(const std::vector<Vec<dim>>& nodes);
  const std::vector<Vec<dim>>& nodes() const { return nodes_; }
  // The point moved by whole periods into those of the mesh.
  Vec<dim> wrap(Vec<dim> x) const;
  // From where it was, x wrapped.
  void find(const Vec<dim>& x, Place<dim>& now);

 private:
  std::shared_ptr<const Mesh<dim>> mesh_;
  std::vector<Vec<dim>> nodes_;
  std::vector<fluid::Geometry<dim>> geometry_;  // of each element
  Vec<dim> period_, low_;
  std::vector<std::array<int, dim + 1>> across_;  // of each element and corner, the element beyond the facet opposite, or -1 - its boundary
  std::optional<fluid::Locator<dim>> locator_;    // where a walk ends at the boundary: the domain need not be convex
};

}  // namespace quicksand::coupling
