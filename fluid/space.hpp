// The unknowns on a mesh: a flux U at every velocity node (vertices; with order 2 the middles of edges too), a pressure at every vertex;
// shared across periods. Who owns which, and the pattern of the matrix. Every rank knows the whole mesh and all numbers, and assembles the
// rows it owns from all elements that touch them: nothing is sent but the solution.
#pragma once

#include "equations.hpp"

#include <memory>

namespace quicksand::fluid {

template <int dim>
struct Space {
  Space(std::shared_ptr<const Mesh<dim>> mesh, int order, int rank, int ranks);

  std::shared_ptr<const Mesh<dim>> mesh;
  int order, per_element;         // velocity nodes of an element
  std::vector<int> vertex;        // velocity node of each mesh node
  std::vector<int> node_of;       // velocity nodes of each element, per_element in a row
  std::vector<std::array<int, 2>> between;  // of each velocity node, two mesh nodes: it is in the middle, or on the one given twice
  std::vector<int> first_dof;     // of each velocity node: its components of U, then p at a vertex. Consecutive for a node, and per rank
  std::vector<int> first_of_rank; // dofs: those of rank k are first_of_rank[k] ... first_of_rank[k + 1] - 1
  int nodes() const { return static_cast<int>(between.size()); }
  int dofs() const { return first_of_rank.back(); }
  bool is_vertex(int node) const { return between[node][0] == between[node][1]; }
  int pressure_dof(int node) const { return first_dof[node] + dim; }
  int dofs_at(int node) const { return is_vertex(node) ? dim + 1 : dim; }
  std::vector<int> node_at;       // of each dof, the velocity node whose dofs begin there, or -1
  std::vector<char> is_pressure;  // of each dof

  // This rank's rows, in compressed form.
  int begin, end;                 // dofs
  std::vector<int> elements;      // that touch one of its nodes
  std::vector<int> local_of;      // of each element of the mesh, its index in `elements`, or -1
  std::vector<int> row_start, column;
  std::vector<int> place;         // per element of `elements` and pair of its nodes: where in each row of the first the columns of the
                                  // second begin; -1: the row is another rank's
  bool mine(int node) const { return begin <= first_dof[node] && first_dof[node] < end; }
};

}  // namespace quicksand::fluid
