#include "partition.hpp"

#include "errors.hpp"

#include <metis.h>

#include <algorithm>
#include <numeric>

namespace quicksand::meshes {

namespace {

struct Graph {
  std::vector<idx_t> start, neighbour;  // those of element e: start[e] to start[e + 1]
};

// Elements that share a facet. Facets are known by their masters, which joins those across a period; with two elements across a period
// this joins a few too many, which harms no partition.
template <int dim>
Graph dual_graph(const Mesh<dim>& mesh) {
  struct Facet {
    std::array<int, dim> key;
    int element;
  };
  std::vector<Facet> facets;
  facets.reserve((dim + 1) * mesh.elements.size());
  for (std::size_t e = 0; e < mesh.elements.size(); ++e)
    for (int corner = 0; corner <= dim; ++corner) {
      auto key = outward_facet<dim>(mesh.elements[e], corner);
      for (int& node : key) node = mesh.master[node];
      std::sort(key.begin(), key.end());
      facets.push_back({key, static_cast<int>(e)});
    }
  std::sort(facets.begin(), facets.end(), [](const auto& a, const auto& b) { return std::tie(a.key, a.element) < std::tie(b.key, b.element); });

  std::vector<std::pair<int, int>> edges;
  for (std::size_t k = 0; k < facets.size(); ++k)
    for (std::size_t j = k + 1; j < facets.size() && facets[j].key == facets[k].key; ++j)
      edges.insert(edges.end(), {{facets[k].element, facets[j].element}, {facets[j].element, facets[k].element}});
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());

  Graph graph{.start = std::vector<idx_t>(mesh.elements.size() + 1, 0), .neighbour = {}};
  for (const auto& [a, b] : edges) {
    if (a == b) continue;
    ++graph.start[a + 1];
    graph.neighbour.push_back(b);
  }
  std::partial_sum(graph.start.begin(), graph.start.end(), graph.start.begin());
  return graph;
}

}  // namespace

template <int dim>
std::vector<int> partition(const Mesh<dim>& mesh, int parts) {
  const auto n = static_cast<idx_t>(mesh.elements.size());
  if (parts < 1 || parts > n) fail("partition: parts must be between 1 and the number of elements, {}, got {}", n, parts);
  std::vector<int> part(n, 0);
  if (parts == 1) return part;
  Graph graph = dual_graph(mesh);
  idx_t options[METIS_NOPTIONS];
  METIS_SetDefaultOptions(options);
  options[METIS_OPTION_SEED] = 1;
  idx_t vertices = n, constraints = 1, count = parts, cut = 0;
  std::vector<idx_t> found(n, 0);
  const int status = METIS_PartGraphKway(&vertices, &constraints, graph.start.data(), graph.neighbour.data(), nullptr, nullptr, nullptr, &count,
                                         nullptr, nullptr, options, &cut, found.data());
  if (status != METIS_OK) throw std::runtime_error(fmt::format("partition: METIS gave up on {} elements and {} parts (code {})", n, parts, status));
  std::copy(found.begin(), found.end(), part.begin());

  // METIS may leave parts of a few elements empty: those take from the largest.
  std::vector<int> size(parts, 0);
  for (int p : part) ++size[p];
  for (int p = 0; p < parts; ++p) {
    if (size[p] > 0) continue;
    const auto largest = static_cast<int>(std::max_element(size.begin(), size.end()) - size.begin());
    *std::find(part.begin(), part.end(), largest) = p;
    --size[largest], ++size[p];
  }
  return part;
}

template std::vector<int> partition(const Mesh<2>&, int);
template std::vector<int> partition(const Mesh<3>&, int);

}  // namespace quicksand::meshes
