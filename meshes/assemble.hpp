// From what a mesh generator hands over to a Mesh: every defect of a mesh is found and named here, whoever made it.
#pragma once

#include "mesh.hpp"

namespace quicksand::meshes {

// A piece of the generator's geometry: its simplices and the physical groups that hold it.
template <std::size_t corners>
struct Entity {
  int tag;                          // the generator's number of it
  std::vector<std::string> groups;  // names; the same name twice is one group
  std::vector<std::array<int, corners>> simplices;
  std::vector<std::size_t> numbers;  // the generator's numbers of the simplices
};

// Sides that are images of others: node first of a pair is node second moved by the translation.
template <int dim>
struct Period {
  Vec<dim> translation;                   // [m]
  std::vector<std::array<int, 2>> pairs;  // nodes, the rims of the sides included
  std::vector<int> images, masters;       // tags of sides
};

template <int dim>
struct Parts {
  std::vector<Vec<dim>> nodes;  // [m]; those that no element uses are dropped
  std::vector<Entity<dim + 1>> bodies;
  std::vector<Entity<dim>> sides;  // an interior side keeps the direction its simplices have here
  std::vector<Period<dim>> periods;
};

// Elements are those of bodies in physical groups, or all ("domain") when no body is in one. A body that is wholly turned over is turned
// back. Boundary facets need a group, periodic ones do not. Errors begin with `where`:
//   no elements; a body or a facet in two groups; flat elements; a body partly turned over; elements that overlap; boundary facets without
//   a group; periodic sides that do not match; elements that touch their own image across a period.
template <int dim>
Mesh<dim> assemble(const Parts<dim>& parts, std::string_view where);

}  // namespace quicksand::meshes
