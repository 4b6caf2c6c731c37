#include "space.hpp"

#include "meshes/partition.hpp"

#include <algorithm>
#include <map>

namespace quicksand::fluid {

namespace {

// Vertices first, as met in the elements, then the middles of edges. An edge and its image across a period are one: the same masters at
// the ends and the same way between them (with two cells to a period, two edges join the same masters).
template <int dim>
void number_nodes(Space<dim>& s) {
  const Mesh<dim>& mesh = *s.mesh;
  s.vertex.assign(mesh.nodes.size(), -1);
  s.node_of.assign(mesh.elements.size() * s.per_element, -1);
  for (std::size_t e = 0; e < mesh.elements.size(); ++e)
    for (int a = 0; a <= dim; ++a) {
      const int master = mesh.master[mesh.elements[e][a]];
      if (s.vertex[master] < 0) s.vertex[master] = s.nodes(), s.between.push_back({master, master});
      s.node_of[e * s.per_element + a] = s.vertex[master];
    }
  for (std::size_t k = 0; k < mesh.nodes.size(); ++k) s.vertex[k] = s.vertex[mesh.master[k]];
  if (s.order == 1) return;
  struct Edge {
    Vec<dim> way;
    int node;
  };
  std::map<std::array<int, 2>, std::vector<Edge>> edges;
  for (std::size_t e = 0; e < mesh.elements.size(); ++e)
    for (int k = 0; k < edges_of_simplex<dim>; ++k) {
      int a = mesh.elements[e][simplex_edges<dim>[k][0]], b = mesh.elements[e][simplex_edges<dim>[k][1]];
      if (s.vertex[a] > s.vertex[b]) std::swap(a, b);
      const Vec<dim> way = mesh.nodes[b] - mesh.nodes[a];
      auto& same_ends = edges[{s.vertex[a], s.vertex[b]}];
      auto known = std::find_if(same_ends.begin(), same_ends.end(), [&](const Edge& edge) { return (edge.way - way).norm() < 1e-6 * way.norm(); });
      if (known == same_ends.end()) {
        known = same_ends.insert(known, {way, s.nodes()});
        s.between.push_back({a, b});
      }
      s.node_of[e * s.per_element + dim + 1 + k] = known->node;
    }
}

}  // namespace

template <int dim>
Space<dim>::Space(std::shared_ptr<const Mesh<dim>> the_mesh, int order, int rank, int ranks)
    : mesh(std::move(the_mesh)), order(order), per_element(order == 1 ? shape_count<dim, 1> : shape_count<dim, 2>) {
  number_nodes(*this);
  const int count = static_cast<int>(mesh->elements.size());
  const std::vector<int> part = ranks == 1 ? std::vector<int>(count, 0) : meshes::partition(*mesh, ranks);
  std::vector<int> owner(nodes(), ranks);
  for (int k = 0; k < count * per_element; ++k) owner[node_of[k]] = std::min(owner[node_of[k]], part[k / per_element]);
  // In the order of the elements, so that neighbours in the mesh stay near each other in the matrix.
  first_dof.assign(nodes(), -1);
  int dof = 0;
  for (int r = 0; r < ranks; ++r) {
    first_of_rank.push_back(dof);
    for (const int node : node_of)
      if (owner[node] == r && first_dof[node] < 0) first_dof[node] = dof, dof += dofs_at(node);
  }
  first_of_rank.push_back(dof);
  begin = first_of_rank[rank], end = first_of_rank[rank + 1];
  node_at.assign(dofs(), -1), is_pressure.assign(dofs(), false);
  for (int node = 0; node < nodes(); ++node) {
    node_at[first_dof[node]] = node;
    if (is_vertex(node)) is_pressure[pressure_dof(node)] = true;
  }

  std::vector<std::vector<int>> near(nodes());  // nodes that share an element, by number of dof
  local_of.assign(count, -1);
  for (int e = 0; e < count; ++e) {
    const int* node = &node_of[e * per_element];
    if (std::none_of(node, node + per_element, [&](int k) { return mine(k); })) continue;
    local_of[e] = static_cast<int>(elements.size());
    elements.push_back(e);
    for (int a = 0; a < per_element; ++a)
      if (mine(node[a])) near[node[a]].insert(near[node[a]].end(), node, node + per_element);
  }
  std::vector<int> owned;
  for (int k = 0; k < nodes(); ++k)
    if (mine(k)) owned.push_back(k);
  auto by_dof = [&](int a, int b) { return first_dof[a] < first_dof[b]; };
  std::sort(owned.begin(), owned.end(), by_dof);
  row_start.push_back(0);
  for (const int node : owned) {
    auto& list = near[node];
    std::sort(list.begin(), list.end(), by_dof);
    list.erase(std::unique(list.begin(), list.end()), list.end());
    for (int row = 0; row < dofs_at(node); ++row) {
      for (const int other : list)
        for (int k = 0; k < dofs_at(other); ++k) column.push_back(first_dof[other] + k);
      row_start.push_back(static_cast<int>(column.size()));
    }
  }
  place.reserve(elements.size() * per_element * per_element);
  for (const int e : elements)
    for (int a = 0; a < per_element; ++a)
      for (int b = 0; b < per_element; ++b) {
        const int row = node_of[e * per_element + a], other = node_of[e * per_element + b];
        if (!mine(row)) {
          place.push_back(-1);
          continue;
        }
        const auto first = column.begin() + row_start[first_dof[row] - begin], last = column.begin() + row_start[first_dof[row] - begin + 1];
        place.push_back(static_cast<int>(std::lower_bound(first, last, first_dof[other]) - first));
      }
}

template struct Space<2>;
template struct Space<3>;

}  // namespace quicksand::fluid
