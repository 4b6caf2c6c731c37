// A simplex mesh with named regions and boundaries: data, and what can be said of it without a field. Where one comes from: gmsh.hpp,
// shapes.hpp; how it is cut into parts: partition.hpp.
#pragma once

#include <Eigen/Core>

#include <array>
#include <string>
#include <vector>

namespace quicksand::meshes {

template <int dim>
using Vec = Eigen::Matrix<double, dim, 1>;

template <int dim>
struct Mesh {
  std::vector<Vec<dim>> nodes;                     // [m]
  std::vector<std::array<int, dim + 1>> elements;  // nodes; the volume is positive
  std::vector<int> region;                         // of each element: index into region_names
  std::vector<std::string> region_names;           // gmsh's physical groups of dimension dim

  // Every facet on the boundary of the domain, and those inside it (or on periodic sides) that belong to a physical group.
  std::vector<std::array<int, dim>> facets;          // nodes; the normal points from the first of its elements to the second
  std::vector<std::array<int, 2>> facet_elements;    // the second is -1 on the boundary, the one across the period on a periodic side
  std::vector<int> boundary;                         // of each facet: index into boundary_names
  std::vector<std::string> boundary_names;           // physical groups of dimension dim - 1

  // Periodic sides: node k is the image of node master[k], which is its own master; elsewhere master[k] = k.
  std::vector<int> master;
};

// Volume of a simplex [m^dim]; negative when its nodes are in the wrong order.
template <int dim>
double volume(const Mesh<dim>& mesh, const std::array<int, dim + 1>& element);

// Area of a facet times its unit normal [m^(dim-1)].
template <int dim>
Vec<dim> area_normal(const Mesh<dim>& mesh, const std::array<int, dim>& facet);

}  // namespace quicksand::meshes
