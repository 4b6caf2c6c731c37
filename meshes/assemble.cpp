#include "assemble.hpp"

#include "errors.hpp"

#include <algorithm>
#include <set>
#include <unordered_map>

namespace quicksand::meshes {

namespace {

constexpr double flat = 1e-12;           // volume / (longest edge)^dim: below it the rounding of the coordinates decides the sign
constexpr double periodic_error = 1e-8;  // distance of an image from its place / period: files written with 9 digits pass

template <int dim>
constexpr const char* body_name = dim == 2 ? "surface" : "volume";
template <int dim>
constexpr const char* side_name = dim == 2 ? "curve" : "surface";

template <int dim, std::size_t n>
Vec<dim> centre(const std::vector<Vec<dim>>& nodes, const std::array<int, n>& simplex) {
  Vec<dim> sum = Vec<dim>::Zero();
  for (int node : simplex) sum += nodes[node];
  return sum / n;
}

template <std::size_t n>
std::array<int, n> sorted(std::array<int, n> simplex) {
  std::sort(simplex.begin(), simplex.end());
  return simplex;
}

// Do two orders of the same nodes point to the same side?
template <std::size_t n>
bool same_direction(const std::array<int, n>& a, const std::array<int, n>& b) {
  if constexpr (n == 2) return a == b;
  else {
    const auto start = std::find(b.begin(), b.end(), a[0]) - b.begin();
    return b[(start + 1) % n] == a[1];
  }
}

// The name of the one group of an entity, or "" when it is in none.
template <std::size_t n>
std::string only_group(const Entity<n>& entity, std::string_view where, const char* what, const char* why) {
  const std::set<std::string> names(entity.groups.begin(), entity.groups.end());
  if (names.size() > 1)
    fail("{}: {} {} is in {} physical groups, '{}': {}", where, what, entity.tag, names.size(), fmt::join(names, "', '"), why);
  return names.empty() ? "" : *names.begin();
}

int number_in(std::vector<std::string>& names, const std::string& name) {
  const auto found = std::find(names.begin(), names.end(), name);
  if (found == names.end()) return names.push_back(name), static_cast<int>(names.size()) - 1;
  return static_cast<int>(found - names.begin());
}

// Turns a body over that is wholly upside down.
template <int dim>
void orient(const Mesh<dim>& mesh, const Entity<dim + 1>& body, std::vector<std::array<int, dim + 1>>& elements, std::string_view where) {
  std::size_t negative = 0, first[2] = {elements.size(), elements.size()};  // first of each sign: positive, negative
  for (std::size_t e = 0; e < elements.size(); ++e) {
    double edge = 0.0;
    for (int a : elements[e])
      for (int b : elements[e]) edge = std::max(edge, (mesh.nodes[a] - mesh.nodes[b]).norm());
    const double v = volume(mesh, elements[e]);
    if (!(std::abs(v) >= flat * std::pow(edge, dim)))  // so that NaN fails too
      fail("{}: element {} of {} {} at {} m is flat: its volume is {:.3g} m^{}, its longest edge {:.3g} m; mesh that place anew", where,
           body.numbers[e], body_name<dim>, body.tag, place(centre(mesh.nodes, elements[e])), v, dim, edge);
    first[v < 0] = std::min(first[v < 0], e);
    negative += v < 0;
  }
  if (negative == 0) return;
  if (negative < elements.size()) {
    const bool fewer = 2 * negative <= elements.size();
    const std::size_t e = first[fewer];
    fail("{}: {} {} is folded: {} of its {} elements are turned over against the others, the first is element {} at {} m; mesh it anew, or "
         "untangle it (gmsh: Mesh.Optimize)",
         where, body_name<dim>, body.tag, fewer ? negative : elements.size() - negative, elements.size(), body.numbers[e],
         place(centre(mesh.nodes, elements[e])));
  }
  for (auto& element : elements) std::swap(element[dim - 1], element[dim]);
}

// Elements of the bodies that count, still in the generator's numbering of nodes.
template <int dim>
void take_elements(const Parts<dim>& parts, Mesh<dim>& mesh, std::string_view where) {
  const bool grouped = std::any_of(parts.bodies.begin(), parts.bodies.end(), [](const auto& body) { return !body.groups.empty(); });
  for (const auto& body : parts.bodies) {
    if (body.simplices.empty() || (grouped && body.groups.empty())) continue;
    const std::string name = grouped ? only_group(body, where, body_name<dim>, "an element has one region; keep one of them") : "domain";
    auto elements = body.simplices;
    orient(mesh, body, elements, where);
    mesh.region.insert(mesh.region.end(), elements.size(), number_in(mesh.region_names, name));
    mesh.elements.insert(mesh.elements.end(), elements.begin(), elements.end());
  }
  if (mesh.elements.empty())
    fail("{}: no elements: {}", where,
         grouped ? fmt::format("the {}s in physical groups are not meshed", body_name<dim>)
                 : fmt::format("there is no {} in this mesh", dim == 2 ? "triangle" : "tetrahedron"));
}

// Drops the nodes that no element uses; returns the new number of each, or -1.
template <int dim>
std::vector<int> renumber_nodes(Mesh<dim>& mesh) {
  std::vector<int> number(mesh.nodes.size(), -1);
  for (const auto& element : mesh.elements)
    for (int node : element) number[node] = 0;
  int kept = 0;
  for (std::size_t k = 0; k < number.size(); ++k)
    if (number[k] == 0) mesh.nodes[kept] = mesh.nodes[k], number[k] = kept++;
  mesh.nodes.resize(kept);
  for (auto& element : mesh.elements)
    for (int& node : element) node = number[node];
  return number;
}

template <int dim>
std::array<int, dim> renumbered(std::array<int, dim> simplex, const std::vector<int>& number) {
  for (int& node : simplex) node = number[node];
  return simplex;
}

template <int dim>
struct Facet {
  std::array<int, dim> key, nodes;     // sorted; in the order that points out of the first element
  std::array<int, 2> element{-1, -1};  // the second is that inside the mesh, not across a period
  int across = -1;                     // facet on the other side of a period
  int group = -1;
  int side = -1;                       // in parts.sides; -1: the generator does not know it
};

template <int dim>
class Facets {
 public:
  Facets(const Mesh<dim>& mesh, std::string_view where) : mesh_(mesh), where_(where) {
    std::vector<Facet<dim>> all;
    all.reserve((dim + 1) * mesh.elements.size());
    for (std::size_t e = 0; e < mesh.elements.size(); ++e)
      for (int corner = 0; corner <= dim; ++corner) {
        const auto nodes = outward_facet<dim>(mesh.elements[e], corner);
        all.push_back({.key = sorted(nodes), .nodes = nodes, .element = {static_cast<int>(e), -1}});
      }
    std::stable_sort(all.begin(), all.end(), [](const auto& a, const auto& b) { return a.key < b.key; });
    for (const auto& facet : all) {
      if (list.empty() || list.back().key != facet.key) {
        list.push_back(facet);
        continue;
      }
      auto& before = list.back();
      if (before.element[1] >= 0 || same_direction(before.nodes, facet.nodes))
        fail("{}: elements overlap at the facet at {} m: {}; look for elements that are there twice, or in two groups", where,
             place(at(facet)), before.element[1] >= 0 ? "it belongs to three" : "two lie on the same side of it");
      before.element[1] = facet.element[0];
    }
  }

  Vec<dim> at(const Facet<dim>& facet) const { return centre(mesh_.nodes, facet.key); }

  Facet<dim>* find(const std::array<int, dim>& nodes) {
    const auto key = sorted(nodes);
    const auto found = std::lower_bound(list.begin(), list.end(), key, [](const auto& facet, const auto& k) { return facet.key < k; });
    return found != list.end() && found->key == key ? &*found : nullptr;
  }

  // Physical groups; an interior facet takes the direction the generator gives it.
  void name(const Parts<dim>& parts, const std::vector<int>& number, std::vector<std::string>& names) {
    for (std::size_t s = 0; s < parts.sides.size(); ++s) {
      const auto& side = parts.sides[s];
      const std::string name = only_group(side, where_, side_name<dim>, "a facet has one boundary condition; keep one of them");
      for (const auto& simplex : side.simplices) {
        const auto nodes = renumbered<dim>(simplex, number);
        auto* facet = find(nodes);
        if (!facet) continue;  // of a part of the geometry that is not in the mesh
        facet->side = static_cast<int>(s);
        if (name.empty()) continue;
        const int group = number_in(names, name);
        if (facet->group >= 0 && facet->group != group)
          fail("{}: the facet at {} m is in two physical groups, '{}' and '{}': a facet has one boundary condition; keep one of them", where_,
               place(at(*facet)), names[facet->group], name);
        facet->group = group;
        if (facet->element[1] >= 0 && !same_direction(facet->nodes, nodes)) {
          facet->nodes = nodes;
          std::swap(facet->element[0], facet->element[1]);
        }
      }
    }
  }

  // Joins the facets across a period, by the nodes of this period only: with two elements across a period, facets on different sides may
  // have the same masters.
  void join(const Parts<dim>& parts, const Period<dim>& period, const std::unordered_map<int, int>& master) {
    for (auto& facet : list) {
      if (facet.element[1] >= 0) continue;
      auto image = facet.key;
      bool all = true;
      for (int& node : image) {
        const auto found = master.find(node);
        if (!(all = found != master.end())) break;
        node = found->second;
      }
      if (!all) continue;
      auto* partner = find(image);
      if (!partner || partner->element[1] >= 0) continue;
      if (facet.across >= 0 || partner->across >= 0)
        fail("{}: the facet at {} m is joined with two others by periods; a side has one partner", where_, place(at(facet)));
      facet.across = static_cast<int>(partner - list.data());
      partner->across = static_cast<int>(&facet - list.data());
    }
    auto holds = [](const std::vector<int>& tags, int tag) { return std::find(tags.begin(), tags.end(), tag) != tags.end(); };
    for (const auto& facet : list) {
      if (facet.element[1] >= 0 || facet.across >= 0 || facet.side < 0) continue;
      const int tag = parts.sides[facet.side].tag;
      const bool image = holds(period.images, tag), is_master = holds(period.masters, tag);
      if (!image && !is_master) continue;
      const Vec<dim> shift = image ? Vec<dim>(-period.translation) : period.translation;
      fail("{}: periodic sides do not match: the facet at {} m on {} {} has no partner at {} m; mesh one side as a copy of the other (gmsh: "
           "Periodic {}, setPeriodic)",
           where_, place(at(facet)), side_name<dim>, tag, place(Vec<dim>(at(facet) + shift)), dim == 2 ? "Curve" : "Surface");
    }
  }

  void check_boundary_is_named(const std::vector<bool>& on_period) const {
    int boundary = 0, unnamed = 0;
    const Facet<dim>* first = nullptr;
    for (const auto& facet : list) {
      if (facet.element[1] >= 0 || facet.across >= 0) continue;
      ++boundary;
      if (facet.group < 0 && unnamed++ == 0) first = &facet;
    }
    if (unnamed == 0) return;
    const bool periodic = std::all_of(first->key.begin(), first->key.end(), [&](int node) { return on_period[node]; });
    const char* hint =
        periodic ? "it lies between nodes of periodic sides, which do not match there: mesh one side as a copy of the other"
                 : "name every part of the boundary; inside the domain it is a gap between parts that are not joined; gmsh writes periodic "
                   "sides to a .msh 2.2 file with a group only, to 4.1 always";
    fail("{}: {} of {} boundary facets are in no physical group, the first at {} m: {} (gmsh: Physical {}(\"wall\") = {{...}})", where_, unnamed,
         boundary, place(at(*first)), hint, dim == 2 ? "Curve" : "Surface");
  }

  std::vector<Facet<dim>> list;  // sorted by key

 private:
  const Mesh<dim>& mesh_;
  std::string_view where_;
};

// Image -> master in the numbering of the mesh, each checked to lie where the period says.
template <int dim>
std::unordered_map<int, int> check_pairs(const Mesh<dim>& mesh, const Period<dim>& period, const std::vector<int>& number,
                                         std::string_view where) {
  std::unordered_map<int, int> master;
  const double length = period.translation.norm();
  if (!(length > 0)) fail("{}: a period must be > 0 m, got {} m", where, length);
  for (const auto& [image, original] : period.pairs) {
    const int i = number[image], m = number[original];
    if (i < 0 || m < 0) continue;
    const Vec<dim> expected = mesh.nodes[m] + period.translation;
    const double error = (mesh.nodes[i] - expected).norm();
    if (!(error <= periodic_error * length))
      fail("{}: periodic sides do not match: the image of the node at {} m should lie at {} m, and lies at {} m, {:.3g} m away (period {:.6g} m); "
           "in a script, sides that run against each other need a minus: Periodic Curve {{2}} = {{-4}}",
           where, place(mesh.nodes[m]), place(expected), place(mesh.nodes[i]), error, length);
    const auto [known, is_new] = master.emplace(i, m);
    if (!is_new && known->second != m)
      fail("{}: periodic sides do not match: the node at {} m is the image of two nodes, at {} m and {} m", where, place(mesh.nodes[i]),
           place(mesh.nodes[known->second]), place(mesh.nodes[m]));
  }
  return master;
}

// One master for all nodes that periods join: a corner may be an image of an image.
template <int dim>
void set_masters(Mesh<dim>& mesh, const std::vector<std::unordered_map<int, int>>& periods, const std::vector<bool>& is_image) {
  auto& master = mesh.master;
  auto root = [&](int node) {
    while (master[node] != node) node = master[node] = master[master[node]];
    return node;
  };
  for (const auto& period : periods)
    for (const auto& [image, original] : period) {
      const int a = root(image), b = root(original);
      // Whichever way they are joined, the root is the first of the nodes that are no image; the order of the pairs does not matter.
      const bool keep_a = std::pair(bool(is_image[a]), a) < std::pair(bool(is_image[b]), b);
      master[keep_a ? b : a] = keep_a ? a : b;
    }
  for (std::size_t k = 0; k < master.size(); ++k) master[k] = root(static_cast<int>(k));
}

template <int dim>
void check_periods_are_long_enough(const Mesh<dim>& mesh, std::string_view where) {
  for (const auto& element : mesh.elements)
    for (int a = 0; a <= dim; ++a)
      for (int b = 0; b < a; ++b)
        if (mesh.master[element[a]] == mesh.master[element[b]]) {
          const double length = (mesh.nodes[element[a]] - mesh.nodes[element[b]]).norm();
          fail("{}: the period of {:.6g} m is too short: the element at {} m, {:.6g} m long, touches its own image; a period needs two layers of "
               "elements, so make them smaller than {:.6g} m",
               where, length, place(centre(mesh.nodes, element)), length, length / 2);
        }
}

}  // namespace

template <int dim>
Mesh<dim> assemble(const Parts<dim>& parts, std::string_view where) {
  Mesh<dim> mesh;
  mesh.nodes = parts.nodes;
  take_elements(parts, mesh, where);
  const std::vector<int> number = renumber_nodes(mesh);

  Facets<dim> facets(mesh, where);
  std::vector<std::string> names;
  facets.name(parts, number, names);

  mesh.master.resize(mesh.nodes.size());
  for (std::size_t k = 0; k < mesh.master.size(); ++k) mesh.master[k] = static_cast<int>(k);
  std::vector<std::unordered_map<int, int>> periods;
  std::vector<bool> is_image(mesh.nodes.size(), false), on_period(mesh.nodes.size(), false);
  for (const auto& period : parts.periods) {
    periods.push_back(check_pairs(mesh, period, number, where));
    for (const auto& [image, original] : periods.back()) is_image[image] = on_period[image] = on_period[original] = true;
    facets.join(parts, period, periods.back());
  }
  facets.check_boundary_is_named(on_period);
  set_masters(mesh, periods, is_image);
  check_periods_are_long_enough(mesh, where);

  std::vector<const Facet<dim>*> kept;
  for (const auto& facet : facets.list)
    if (facet.group >= 0) kept.push_back(&facet);
  std::stable_sort(kept.begin(), kept.end(), [](auto* a, auto* b) { return std::pair(a->group, a->element[0]) < std::pair(b->group, b->element[0]); });
  for (const auto* facet : kept) {
    mesh.facets.push_back(facet->nodes);
    mesh.facet_elements.push_back({facet->element[0], facet->across >= 0 ? facets.list[facet->across].element[0] : facet->element[1]});
    mesh.boundary.push_back(facet->group);
  }
  mesh.boundary_names = std::move(names);
  return mesh;
}

template Mesh<2> assemble(const Parts<2>&, std::string_view);
template Mesh<3> assemble(const Parts<3>&, std::string_view);

}  // namespace quicksand::meshes
