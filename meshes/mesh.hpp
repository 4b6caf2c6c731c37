// A simplex mesh with named regions and boundaries: data, and what can be said of it without a field. Where one comes from: gmsh.hpp,
// shapes.hpp; what is checked before there is one: assemble.hpp; how it is cut into parts: partition.hpp.
#pragma once

#include <Eigen/Core>

#include <array>
#include <string>
#include <string_view>
#include <type_traits>
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

template <int dim>
double volume(const Mesh<dim>& mesh);  // of all elements [m^dim]

// Area of a facet times its unit normal [m^(dim-1)].
template <int dim>
Vec<dim> area_normal(const Mesh<dim>& mesh, const std::type_identity_t<std::array<int, dim>>& facet);  // identity: dim comes from the mesh

// Index into boundary_names or region_names; std::invalid_argument that lists the names there are, and begins with `where`.
template <int dim>
int boundary_number(const Mesh<dim>& mesh, std::string_view name, std::string_view where);
template <int dim>
int region_number(const Mesh<dim>& mesh, std::string_view name, std::string_view where);

// Area of all facets of a boundary [m^(dim-1)].
template <int dim>
double boundary_area(const Mesh<dim>& mesh, std::string_view name);

// The facet of an element that has all its nodes but `corner`, its normal pointing out of the element.
template <int dim>
std::array<int, dim> outward_facet(const std::array<int, dim + 1>& element, int corner);

}  // namespace quicksand::meshes
