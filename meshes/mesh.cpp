#include "mesh.hpp"

#include "errors.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>

namespace quicksand::meshes {

namespace {

int number_of(const std::vector<std::string>& names, std::string_view name, std::string_view where, const char* what) {
  const auto found = std::find(names.begin(), names.end(), name);
  if (found != names.end()) return static_cast<int>(found - names.begin());
  if (names.empty()) fail("{}: no {} is named '{}': this mesh has none", where, what, name);
  fail("{}: no {} is named '{}': this mesh has '{}'", where, what, name, fmt::join(names, "', '"));
}

}  // namespace

template <int dim>
double volume(const Mesh<dim>& mesh, const std::array<int, dim + 1>& element) {
  Eigen::Matrix<double, dim, dim> edges;
  for (int k = 0; k < dim; ++k) edges.col(k) = mesh.nodes[element[k + 1]] - mesh.nodes[element[0]];
  return edges.determinant() / (dim == 2 ? 2 : 6);
}

template <int dim>
double volume(const Mesh<dim>& mesh) {
  double sum = 0.0;
  for (const auto& element : mesh.elements) sum += volume(mesh, element);
  return sum;
}

template <int dim>
Vec<dim> area_normal(const Mesh<dim>& mesh, const std::type_identity_t<std::array<int, dim>>& facet) {
  const Vec<dim> a = mesh.nodes[facet[1]] - mesh.nodes[facet[0]];
  if constexpr (dim == 2) {
    return {a.y(), -a.x()};
  } else {
    const Vec<dim> b = mesh.nodes[facet[2]] - mesh.nodes[facet[0]];
    return 0.5 * a.cross(b);
  }
}

template <int dim>
int boundary_number(const Mesh<dim>& mesh, std::string_view name, std::string_view where) {
  return number_of(mesh.boundary_names, name, where, "boundary");
}

template <int dim>
int region_number(const Mesh<dim>& mesh, std::string_view name, std::string_view where) {
  return number_of(mesh.region_names, name, where, "region");
}

template <int dim>
double boundary_area(const Mesh<dim>& mesh, std::string_view name) {
  const int number = boundary_number(mesh, name, "boundary_area");
  double sum = 0.0;
  for (std::size_t k = 0; k < mesh.facets.size(); ++k)
    if (mesh.boundary[k] == number) sum += area_normal(mesh, mesh.facets[k]).norm();
  return sum;
}

template <int dim>
std::array<int, dim> outward_facet(const std::array<int, dim + 1>& element, int corner) {
  std::array<int, dim> facet;
  for (int k = 0; k < dim; ++k) facet[k] = element[k < corner ? k : k + 1];
  // Leaving out node 0 of (0, 1, 2) or (0, 1, 2, 3) gives the outward order, each step of `corner` swaps two nodes.
  if (corner % 2 == 1) std::swap(facet[dim - 2], facet[dim - 1]);
  return facet;
}

#define INSTANTIATE(dim)                                                                  \
  template double volume(const Mesh<dim>&, const std::array<int, dim + 1>&);                 \
  template double volume(const Mesh<dim>&);                                                  \
  template Vec<dim> area_normal(const Mesh<dim>&, const std::array<int, dim>&);              \
  template int boundary_number(const Mesh<dim>&, std::string_view, std::string_view);        \
  template int region_number(const Mesh<dim>&, std::string_view, std::string_view);          \
  template double boundary_area(const Mesh<dim>&, std::string_view);                         \
  template std::array<int, dim> outward_facet<dim>(const std::array<int, dim + 1>&, int);
INSTANTIATE(2)
INSTANTIATE(3)
#undef INSTANTIATE

}  // namespace quicksand::meshes
