// What boundaries say, and what that holds at each node.
#include "facet.hpp"
#include "fluid.hpp"

#include "meshes/errors.hpp"

#include <fmt/ranges.h>

#include <algorithm>

namespace quicksand::fluid {

using meshes::fail;
using meshes::place;

template <int dim>
int Fluid<dim>::boundary_index(const char* function, const std::string& name) const {
  return meshes::boundary_number(*mesh_, name, function);
}

template <int dim>
int Fluid<dim>::outer_boundary(const char* function, const std::string& name) const {
  const int k = boundary_index(function, name);
  for (const int f : facets_of_[k])
    if (mesh_->facet_elements[f][1] >= 0)
      fail("{}: \"{}\" has facets inside the domain or on a periodic side: they can be measured, but hold nothing", function, name);
  return k;
}

template <int dim>
auto Fluid<dim>::condition(const char* function, const std::string& name, Kind kind) -> Condition& {
  const int k = outer_boundary(function, name);
  if (mean_pressure_ && (kind == Kind::outflow || kind == Kind::permeable))
    fail("{}: the mean pressure is set already, \"{}\" would be a second reference", function, name);
  conditions_[k] = {};
  conditions_[k].kind = kind;
  conditions_[k].turn = ++turns_;
  return conditions_[k];
}

template <int dim>
void Fluid<dim>::set_wall(const std::string& boundary, VectorField<dim> velocity) {
  condition("set_wall", boundary, Kind::wall).velocity = std::move(velocity);
}
template <int dim>
void Fluid<dim>::set_inflow(const std::string& boundary, VectorField<dim> velocity) {
  condition("set_inflow", boundary, Kind::inflow).velocity = std::move(velocity);
}
template <int dim>
void Fluid<dim>::set_slip(const std::string& boundary) {
  condition("set_slip", boundary, Kind::slip);
}
template <int dim>
void Fluid<dim>::set_outflow(const std::string& boundary, ScalarField<dim> pressure) {
  condition("set_outflow", boundary, Kind::outflow).pressure = std::move(pressure);
}
template <int dim>
void Fluid<dim>::set_permeable(const std::string& boundary, VectorField<dim> velocity, ScalarField<dim> pressure) {
  Condition& c = condition("set_permeable", boundary, Kind::permeable);
  c.velocity = std::move(velocity), c.pressure = std::move(pressure);
}

template <int dim>
bool Fluid<dim>::has_pressure_reference() const {
  return std::any_of(conditions_.begin(), conditions_.end(), [](const Condition& c) { return static_cast<bool>(c.pressure); });
}

template <int dim>
void Fluid<dim>::set_mean_pressure(double pressure) {
  if (!std::isfinite(pressure)) fail("set_mean_pressure: must be finite, got {} Pa", pressure);
  for (std::size_t k = 0; k < conditions_.size(); ++k)
    if (conditions_[k].pressure)
      fail("set_mean_pressure: boundary \"{}\" sets the pressure already, there can be one reference only", mesh_->boundary_names[k]);
  mean_pressure_ = pressure;
}

template <int dim>
void Fluid<dim>::check_conditions(const char* function) const {
  std::vector<std::string> missing;
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    const auto& facets = facets_of_[k];
    const bool outer = std::any_of(facets.begin(), facets.end(), [&](int f) { return mesh_->facet_elements[f][1] < 0; });
    if (outer && conditions_[k].kind == Kind::none) missing.push_back(mesh_->boundary_names[k]);
  }
  if (!missing.empty())
    fail("{}: no condition on {}; call set_wall, set_inflow, set_slip, set_outflow or set_permeable", function, missing);
}

// What holds each velocity node at time t, on the mesh as it is now.
template <int dim>
void Fluid<dim>::hold(double t) {
  struct Say {  // of one boundary on a node
    Kind kind;
    int turn;
    Vec<dim> value;
    std::vector<Vec<dim>> normals;
  };
  std::vector<std::vector<Say>> says(space_.nodes());
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    const Condition& c = conditions_[k];
    if (c.kind == Kind::none || c.kind == Kind::outflow) continue;
    std::vector<int> of_boundary;  // velocity nodes
    std::vector<Vec<dim>> x;
    std::vector<std::vector<Vec<dim>>> normals;
    std::vector<int> index(space_.nodes(), -1);
    for (const int f : facets_of_[k]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      for (const auto& [node, where] : facet_nodes(f)) {
        if (index[node] < 0) {
          index[node] = static_cast<int>(of_boundary.size());
          of_boundary.push_back(node), x.push_back(where), normals.emplace_back();
        }
        // Facets that meet at an edge of the domain have a say each; those of a smooth surface have one together.
        auto& known = normals[index[node]];
        auto same = std::find_if(known.begin(), known.end(), [&](const Vec<dim>& n) { return n.dot(facet.area) > 0.7 * n.norm() * facet.area.norm(); });
        same == known.end() ? known.push_back(facet.area) : void(*same += facet.area);
      }
    }
    std::vector<Vec<dim>> value;
    if (c.velocity) value = c.velocity(x, t);
    else for (const int node : of_boundary) value.push_back(mesh_velocity_at(node));
    for (std::size_t m = 0; m < x.size(); ++m) {
      if (!value[m].allFinite())
        fail("step: the velocity on \"{}\" must be finite, got {} m/s at {}", mesh_->boundary_names[k], place(value[m]), place(x[m]));
      says[of_boundary[m]].push_back({c.kind, c.turn, value[m], normals[m]});
    }
  }
  for (int node = 0; node < space_.nodes(); ++node) {
    Held& held = held_[node];
    held = {};
    has_frame_[node] = false;
    const double eps = eps_[0][node];
    auto add = [&](const Vec<dim>& direction, const Vec<dim>& velocity) {
      Vec<dim> rest = direction.normalized();
      for (int k = 0; k < held.last; ++k) rest -= rest.dot(held.frame.col(k)) * held.frame.col(k);
      if (held.last == dim || rest.norm() < 0.3) return;  // held already
      rest.normalize();
      held.frame.col(held.last) = rest;
      held.value[held.last++] = eps * velocity.dot(rest);
    };
    // Walls and inflows hold everything. Where several meet, each says what crosses it, so that none leaks, and the last one set the rest.
    std::sort(says[node].begin(), says[node].end(), [](const Say& a, const Say& b) { return a.turn > b.turn; });
    const Say* all = nullptr;
    for (const Say& say : says[node])
      if (say.kind == Kind::wall || say.kind == Kind::inflow) {
        for (const Vec<dim>& normal : say.normals) add(normal, say.value);
        if (!all) all = &say;
      }
    if (all) {
      for (int axis = 0; axis < dim; ++axis) add(Vec<dim>::Unit(axis), all->value);
      held.value = held.frame * held.value;
      held.frame.setIdentity();
      continue;
    }
    const Vec<dim> with_mesh = mesh_velocity_at(node);
    for (const Say& say : says[node])
      for (const Vec<dim>& normal : say.normals) {
        if (say.kind == Kind::slip) {
          add(normal, with_mesh);
        } else {
          const Vec<dim> n = normal.normalized();
          for (int axis = 0; axis < dim; ++axis) {
            const Vec<dim> tangent = Vec<dim>::Unit(axis) - n[axis] * n;
            if (tangent.norm() > 0.5) add(tangent, say.value);
          }
        }
      }
    if (held.last == 0) continue;
    // The rest of the frame: what is left of the axes.
    int columns = held.last;
    for (int axis = 0; axis < dim && columns < dim; ++axis) {
      Vec<dim> rest = Vec<dim>::Unit(axis);
      for (int k = 0; k < columns; ++k) rest -= rest.dot(held.frame.col(k)) * held.frame.col(k);
      if (rest.norm() > 0.5) held.frame.col(columns++) = rest.normalized();
    }
    has_frame_[node] = true;
  }
}

template <int dim>
std::vector<std::pair<int, Vec<dim>>> Fluid<dim>::facet_nodes(int facet) const {
  std::vector<std::pair<int, Vec<dim>>> nodes;
  for (const int k : mesh_->facets[facet]) nodes.emplace_back(space_.vertex[k], position_[k]);
  if (velocity_order() == 1) return nodes;
  const int element = mesh_->facet_elements[facet][0];
  const auto& corners = mesh_->elements[element];
  const auto& in = mesh_->facets[facet];
  auto on_facet = [&](int k) { return std::find(in.begin(), in.end(), k) != in.end(); };
  for (int k = 0; k < edges_of_simplex<dim>; ++k) {
    const auto [a, b] = simplex_edges<dim>[k];
    if (on_facet(corners[a]) && on_facet(corners[b]))
      nodes.emplace_back(space_.node_of[element * space_.per_element + dim + 1 + k], 0.5 * (position_[corners[a]] + position_[corners[b]]));
  }
  return nodes;
}

// Pressures and the velocity of what enters, at the quadrature points of open boundaries.
template <int dim>
void Fluid<dim>::evaluate_outside(double t) {
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    const Condition& c = conditions_[k];
    if (!c.pressure) continue;
    std::vector<Vec<dim>> x, with_mesh;
    for (const int f : facets_of_[k]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      along<dim>(facet, [&](const Barycentric<dim>& l, double) {
        x.push_back(Vec<dim>::Zero()), with_mesh.push_back(Vec<dim>::Zero());
        for (int a = 0; a <= dim; ++a) {
          const int corner = mesh_->elements[facet.element][a];
          x.back() += l[a] * position_[corner], with_mesh.back() += l[a] * mesh_velocity_[corner];
        }
      });
    }
    outer_pressure_[k] = c.pressure(x, t);
    outer_velocity_[k] = c.velocity ? c.velocity(x, t) : with_mesh;
    for (std::size_t m = 0; m < x.size(); ++m)
      if (!std::isfinite(outer_pressure_[k][m]) || !outer_velocity_[k][m].allFinite())
        fail("step: pressure and velocity on \"{}\" must be finite, got {} Pa and {} m/s at {}", mesh_->boundary_names[k],
             outer_pressure_[k][m], place(outer_velocity_[k][m]), place(x[m]));
  }
}

template class Fluid<2>;  // of the members defined here
template class Fluid<3>;

}  // namespace quicksand::fluid
