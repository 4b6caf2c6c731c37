#include "fluid.hpp"

#include "locator.hpp"

#include <Eigen/Geometry>
#include <Eigen/Sparse>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <chrono>
#include <numeric>

namespace quicksand::fluid {

namespace {

// Linear systems within Newton's iteration: what they leave is taken up by the next one. Tighter ones cost more than they save.
constexpr double newton_forcing = 1e-3;

double seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

template <int dim>
std::string at(const Vec<dim>& x) {
  return fmt::format("({:.4g})", fmt::join(x.data(), x.data() + dim, ", "));
}

// A facet seen from its first element: which of the element's corners are its own, and its area times the normal out of the element.
template <int dim>
struct FacetView {
  int element;
  std::array<int, dim> corner;
  Vec<dim> area;  // [m^(dim-1)]
  FacetView(const Mesh<dim>& mesh, const std::vector<Vec<dim>>& position, int facet) : FacetView(mesh, facet, [&](int node) { return position[node]; }) {}
  template <class Place>
  FacetView(const Mesh<dim>& mesh, int facet, Place&& place) : element(mesh.facet_elements[facet][0]) {
    std::array<Vec<dim>, dim + 1> x;
    int opposite = 0, k = 0;
    for (int a = 0; a <= dim; ++a) {
      const int node = mesh.elements[element][a];
      x[a] = place(node);
      const auto& in = mesh.facets[facet];
      std::find(in.begin(), in.end(), node) == in.end() ? void(opposite = a) : void(corner[k++] = a);
    }
    const Geometry<dim> g = geometry<dim>(x);
    area = -dim * g.volume * g.grad_l[opposite];  // grad L points to the corner and is one over its height
  }
};

// Calls use(point in the element, weight) at the quadrature points of a facet.
template <int dim, class Use>
void along(const FacetView<dim>& facet, Use&& use) {
  for (const auto& point : quadrature<dim - 1, 2>()) {
    Barycentric<dim> l{};
    for (int k = 0; k < dim; ++k) l[facet.corner[k]] = point.l[k];
    use(l, point.weight);
  }
}

}  // namespace

template <int dim>
Fluid<dim>::Fluid(std::shared_ptr<const Mesh<dim>> mesh, int order, Properties<dim> the_properties)
    : properties(the_properties), mesh_(mesh), space_(mesh, order, rank(), ranks()) {
  if (!(properties.density >= 0 && std::isfinite(properties.density)))
    throw std::invalid_argument(fmt::format("Fluid: density must be >= 0 kg/m^3 and finite, got {}", properties.density));
  if (!(properties.viscosity > 0 && std::isfinite(properties.viscosity)))
    throw std::invalid_argument(fmt::format("Fluid: viscosity must be > 0 Pa s and finite, got {}", properties.viscosity));
  conditions_.resize(mesh_->boundary_names.size());
  position_ = old_position_ = mesh_->nodes;
  mesh_velocity_.assign(mesh_->nodes.size(), Vec<dim>::Zero());
  eps_.fill(std::vector<double>(space_.nodes(), 1.0));
  x_.fill(std::vector<double>(space_.dofs(), 0.0));
  guess_ = x_[0];
  eps_change_.assign(space_.nodes(), 0.0);
  old_eps_change_ = eps_change_;
  held_.resize(space_.nodes());
  has_frame_.assign(space_.nodes(), false);
  facets_of_.resize(conditions_.size());
  for (std::size_t f = 0; f < mesh_->facets.size(); ++f) facets_of_[mesh_->boundary[f]].push_back(static_cast<int>(f));
  motion_.resize(conditions_.size());
  swept_.assign(conditions_.size(), 0.0);
  old_swept_ = old_swept_used_ = swept_;
  pore_volume_.fill(pore_volume(eps_[0]));
  outer_pressure_.resize(conditions_.size());
  outer_velocity_.resize(conditions_.size());
}

template <int dim>
Fluid<dim>::~Fluid() = default;

template <int dim>
int Fluid<dim>::boundary_index(const char* function, const std::string& name) const {
  const auto& names = mesh_->boundary_names;
  const auto found = std::find(names.begin(), names.end(), name);
  if (found == names.end()) throw std::invalid_argument(fmt::format("{}: no boundary \"{}\"; the mesh has {}", function, name, names));
  return static_cast<int>(found - names.begin());
}

template <int dim>
auto Fluid<dim>::condition(const char* function, const std::string& name, Kind kind) -> Condition& {
  const int k = boundary_index(function, name);
  for (const int f : facets_of_[k])
    if (mesh_->facet_elements[f][1] >= 0)
      throw std::invalid_argument(fmt::format("{}: \"{}\" has facets inside the domain or on a periodic side: they can be measured, but hold nothing", function, name));
  if (mean_pressure_ && (kind == Kind::outflow || kind == Kind::permeable))
    throw std::invalid_argument(fmt::format("{}: the mean pressure is set already, \"{}\" would be a second reference", function, name));
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
void Fluid<dim>::move_boundary(const std::string& boundary, VectorField<dim> velocity) {
  const int k = boundary_index("move_boundary", boundary);
  for (const int f : facets_of_[k])
    if (mesh_->facet_elements[f][1] >= 0) throw std::invalid_argument(fmt::format("move_boundary: \"{}\" has facets inside the domain or on a periodic side", boundary));
  motion_[k] = std::move(velocity);
  harmonic_.reset();
}

template <int dim>
bool Fluid<dim>::has_pressure_reference() const {
  return std::any_of(conditions_.begin(), conditions_.end(), [](const Condition& c) { return c.kind == Kind::outflow || c.kind == Kind::permeable; });
}

template <int dim>
void Fluid<dim>::set_mean_pressure(double pressure) {
  if (!std::isfinite(pressure)) throw std::invalid_argument(fmt::format("set_mean_pressure: must be finite, got {} Pa", pressure));
  for (std::size_t k = 0; k < conditions_.size(); ++k)
    if (conditions_[k].kind == Kind::outflow || conditions_[k].kind == Kind::permeable)
      throw std::invalid_argument(fmt::format("set_mean_pressure: boundary \"{}\" sets the pressure already, there can be one reference only", mesh_->boundary_names[k]));
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
    throw std::invalid_argument(fmt::format("{}: no condition on {}; call set_wall, set_inflow, set_slip, set_outflow or set_permeable", function, missing));
}

// Void fraction, velocity, pressure: given at the nodes of the mesh, or with order 2 at all nodes.
template <int dim>
void Fluid<dim>::set_void_fraction(std::span<const double> eps) {
  const std::size_t vertices = mesh_->nodes.size(), all = nodes().size();
  if (eps.size() != vertices && eps.size() != all)
    throw std::invalid_argument(fmt::format("set_void_fraction: must have one value for each of {} nodes of the mesh{}, got {}", vertices,
                                            all == vertices ? "" : fmt::format(" or of all {} nodes", all), eps.size()));
  for (std::size_t k = 0; k < eps.size(); ++k)
    if (!(eps[k] > 0 && eps[k] <= 1))
      throw std::invalid_argument(fmt::format("set_void_fraction: must be in (0, 1], got {} at {}", eps[k], at<dim>(k < vertices ? position_[k] : nodes()[k])));
  for (std::size_t k = 0; k < vertices; ++k)
    if (mesh_->master[k] == static_cast<int>(k)) eps_[0][space_.vertex[k]] = eps[k];
  std::size_t k = vertices;
  for (int node = 0; node < space_.nodes(); ++node) {
    if (space_.is_vertex(node)) continue;
    const auto [a, b] = space_.between[node];
    eps_[0][node] = eps.size() == all ? eps[k++] : 0.5 * (eps_[0][space_.vertex[a]] + eps_[0][space_.vertex[b]]);
  }
  if (!eps_started_) eps_[2] = eps_[1] = eps_[0], pore_volume_.fill(pore_volume(eps_[0]));  // the first to be set is that of the start as well
  eps_started_ = true;
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::nodes() const {
  std::vector<Vec<dim>> x = position_;
  for (int node = 0; node < space_.nodes(); ++node)
    if (!space_.is_vertex(node)) x.push_back(0.5 * (position_[space_.between[node][0]] + position_[space_.between[node][1]]));
  return x;
}

template <int dim>
std::vector<int> Fluid<dim>::node_numbers() const {
  std::vector<int> number = space_.vertex;
  for (int node = 0; node < space_.nodes(); ++node)
    if (!space_.is_vertex(node)) number.push_back(node);
  return number;
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::velocity() const {
  std::vector<Vec<dim>> u;
  for (const int node : node_numbers()) u.push_back(Eigen::Map<const Vec<dim>>(&x_[0][space_.first_dof[node]]) / eps_[1][node]);
  return u;
}

template <int dim>
std::vector<double> Fluid<dim>::void_fraction() const {
  std::vector<double> eps;
  for (const int node : node_numbers()) eps.push_back(eps_[0][node]);
  return eps;
}

template <int dim>
std::vector<double> Fluid<dim>::pressure() const {
  std::vector<double> p;
  for (const int node : space_.vertex) p.push_back(x_[0][space_.pressure_dof(node)]);
  return p;
}

template <int dim>
void Fluid<dim>::set_velocity(std::span<const Vec<dim>> u) {
  const auto number = node_numbers();
  if (u.size() != number.size()) throw std::invalid_argument(fmt::format("set_velocity: must have one value for each of {} nodes, got {}", number.size(), u.size()));
  for (std::size_t k = 0; k < u.size(); ++k) {
    if (!u[k].allFinite()) throw std::invalid_argument(fmt::format("set_velocity: must be finite, got {} m/s at node {}", at<dim>(u[k]), k));
    Eigen::Map<Vec<dim>> flux(&x_[0][space_.first_dof[number[k]]]);
    flux = eps_[1][number[k]] * u[k];
  }
  x_[1] = x_[0], steps_ = 0;
}

template <int dim>
void Fluid<dim>::set_pressure(std::span<const double> p) {
  if (p.size() != space_.vertex.size()) throw std::invalid_argument(fmt::format("set_pressure: must have one value for each of {} nodes of the mesh, got {}", space_.vertex.size(), p.size()));
  for (std::size_t k = 0; k < p.size(); ++k) {
    if (!std::isfinite(p[k])) throw std::invalid_argument(fmt::format("set_pressure: must be finite, got {} Pa at node {}", p[k], k));
    x_[0][space_.pressure_dof(space_.vertex[k])] = p[k];
  }
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::quadrature_points() const {
  std::vector<Vec<dim>> x;
  auto add = [&](const auto& rule) {
    for (const auto& element : mesh_->elements)
      for (const auto& point : rule) {
        x.push_back(Vec<dim>::Zero());
        for (int a = 0; a <= dim; ++a) x.back() += point.l[a] * position_[element[a]];
      }
  };
  velocity_order() == 1 ? add(quadrature<dim, 1>()) : add(quadrature<dim, 2>());
  return x;
}

template <int dim>
void Fluid<dim>::set_reaction(std::vector<Reaction<dim>> reaction) {
  const std::size_t points = mesh_->elements.size() * (velocity_order() == 1 ? quadrature<dim, 1>().size() : quadrature<dim, 2>().size());
  if (!reaction.empty() && reaction.size() != points)
    throw std::invalid_argument(fmt::format("set_reaction: must have one value for each of {} quadrature points, got {}", points, reaction.size()));
  for (std::size_t k = 0; k < reaction.size(); ++k)
    if (!(reaction[k].beta >= 0 && std::isfinite(reaction[k].beta)) || !reaction[k].beta_target.allFinite() || !reaction[k].force.allFinite())
      throw std::invalid_argument(fmt::format("set_reaction: beta must be >= 0 kg/(m^3 s), target and force finite, got beta = {} at quadrature point {}", reaction[k].beta, k));
  reaction_ = std::move(reaction);
}

// What holds each velocity node at time t, on the mesh as it is now.
template <int dim>
void Fluid<dim>::hold(double t) {
  struct Held1 {  // one boundary's say on a node
    Kind kind;
    int turn;
    Vec<dim> value;
    std::vector<Vec<dim>> normals;
  };
  std::vector<std::vector<Held1>> says(space_.nodes());
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
        throw std::invalid_argument(fmt::format("step: the velocity on \"{}\" must be finite, got {} m/s at {}", mesh_->boundary_names[k], at<dim>(value[m]), at<dim>(x[m])));
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
    std::sort(says[node].begin(), says[node].end(), [](const Held1& a, const Held1& b) { return a.turn > b.turn; });
    const Held1* all = nullptr;
    for (const Held1& say : says[node])
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
    for (const Held1& say : says[node])
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
Vec<dim> Fluid<dim>::mesh_velocity_at(int node) const {
  return 0.5 * (mesh_velocity_[space_.between[node][0]] + mesh_velocity_[space_.between[node][1]]);
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
        throw std::invalid_argument(fmt::format("step: pressure and velocity on \"{}\" must be finite, got {} Pa and {} m/s at {}", mesh_->boundary_names[k],
                                                outer_pressure_[k][m], at<dim>(outer_velocity_[k][m]), at<dim>(x[m])));
  }
}

template <int dim>
template <int order>
ElementInput<dim, order> Fluid<dim>::input(int element) const {
  ElementInput<dim, order> in;
  for (int a = 0; a <= dim; ++a) {
    const int k = mesh_->elements[element][a];
    in.x[a] = position_[k], in.mesh_velocity[a] = mesh_velocity_[k];
  }
  for (int a = 0; a < in.n; ++a) {
    const int node = space_.node_of[element * in.n + a];
    for (int t = 0; t < 3; ++t) in.eps[t][a] = eps_[t][node];
    in.flux[0][a] = Eigen::Map<const Vec<dim>>(&guess_[space_.first_dof[node]]);
    for (int t = 0; t < 2; ++t) in.flux[t + 1][a] = Eigen::Map<const Vec<dim>>(&x_[t][space_.first_dof[node]]);
  }
  if (!reaction_.empty()) in.reaction = &reaction_[element * quadrature<dim, order>().size()];
  in.advection = settings.advection != Advection::none;
  return in;
}

template <int dim>
template <int order>
void Fluid<dim>::scatter(int local, const ElementSystem<dim, order>& system) {
  constexpr int n = shape_count<dim, order>;
  const int* node = &space_.node_of[space_.elements[local] * n];
  const int* place = &space_.place[static_cast<std::size_t>(local) * n * n];
  for (int a = 0; a < n; ++a) {
    if (!space_.mine(node[a])) continue;
    const int row = space_.first_dof[node[a]] - space_.begin, from = dof_of<dim>(a), rows = a <= dim ? dim + 1 : dim;
    for (int i = 0; i < rows; ++i) {
      b_[row + i] += system.b[from + i];
      double* in_row = &values_[space_.row_start[row + i]];
      for (int b = 0; b < n; ++b)
        for (int j = 0; j < (b <= dim ? dim + 1 : dim); ++j) in_row[place[a * n + b] + j] += system.a(from + i, dof_of<dim>(b) + j);
    }
  }
}

template <int dim>
template <int order>
void Fluid<dim>::assemble(const TimeWeights& time, bool newton) {
  values_.assign(space_.column.size(), 0.0);
  b_.assign(space_.end - space_.begin, 0.0);
  ElementSystem<dim, order> system;
  for (std::size_t local = 0; local < space_.elements.size(); ++local) {
    ElementInput<dim, order> in = input<order>(space_.elements[local]);
    in.newton = newton;
    element_system<dim, order>(in, properties, time, system);
    scatter<order>(static_cast<int>(local), system);
  }
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node) && space_.mine(node))
      b_[space_.pressure_dof(node) - space_.begin] -= time[0] * eps_change_[node] - time[2] * old_eps_change_[node];
  add_boundaries<order>();
}

// Where the pressure is given: eps (p_out - p) n . w, so that the traction is -p_out n; and where fluid enters there,
// -rho min((U - eps w) . n, 0) (u - u_out) . w: it has the velocity of what is outside, and brings no other energy in. At an outflow
// -p n + eta grad u n replaces the traction, so that a parallel flow leaves as it is: Heywood, Rannacher and Turek, IJNMF 22 (1996).
template <int dim>
template <int order>
void Fluid<dim>::add_boundaries() {
  constexpr int n = shape_count<dim, order>;
  std::vector<int> local_of(mesh_->elements.size(), -1);
  for (std::size_t local = 0; local < space_.elements.size(); ++local) local_of[space_.elements[local]] = static_cast<int>(local);
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    if (!conditions_[k].pressure) continue;
    std::size_t q = 0;
    for (const int f : facets_of_[k]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      const int local = local_of[facet.element];
      if (local < 0) {
        q += quadrature<dim - 1, 2>().size();
        continue;
      }
      const ElementInput<dim, order> in = input<order>(space_.elements[local]);
      const Geometry<dim> g = geometry<dim>(in.x);
      ElementSystem<dim, order> system;
      system.a.setZero(), system.b.setZero();
      along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
        const auto shape = shapes<dim, order>(l);
        const auto grad = shape_gradients<dim, order>(l, g.grad_l);
        const Vec<dim> area = weight * facet.area;
        double eps = 0.0;
        Vec<dim> flux = Vec<dim>::Zero(), grad_eps = Vec<dim>::Zero(), mesh_velocity = Vec<dim>::Zero();
        for (int a = 0; a < n; ++a) eps += shape[a] * in.eps[0][a], flux += shape[a] * in.flux[0][a], grad_eps += in.eps[0][a] * grad[a];
        for (int a = 0; a <= dim; ++a) mesh_velocity += l[a] * in.mesh_velocity[a];
        const double enters = in.advection ? properties.density * std::max(-(flux - eps * mesh_velocity).dot(area), 0.0) : 0.0;
        for (int a = 0; a < n; ++a)
          for (int i = 0; i < dim; ++i) {
            const int row = dof_of<dim>(a) + i;
            system.b[row] += shape[a] * (enters * outer_velocity_[k][q][i] - eps * outer_pressure_[k][q] * area[i]);
            for (int b = 0; b <= dim; ++b) system.a(row, dof_of<dim>(b) + dim) -= shape[a] * eps * l[b] * area[i];
            for (int b = 0; b < n; ++b) {
              system.a(row, dof_of<dim>(b) + i) += enters * shape[a] * shape[b] / eps;
              if (conditions_[k].kind != Kind::outflow) continue;
              const double slope = grad[b][i] - shape[b] / eps * grad_eps[i];  // of U/eps, times eps
              for (int j = 0; j < dim; ++j) system.a(row, dof_of<dim>(b) + j) -= properties.viscosity * shape[a] * slope * area[j];
            }
          }
        ++q;
      });
      scatter<order>(local, system);
    }
  }
}

// int q (change of eps at a fixed point) over a step, for each q of a vertex: int q (eps - eps before) on the mesh before, less what the
// moving mesh has swept. Summed over q it is the change of int eps less the flux of eps through the moving boundary, exactly.
template <int dim>
std::vector<double> Fluid<dim>::eps_change(double dt) const {
  std::vector<double> change(space_.nodes(), 0.0);
  const bool moves = std::any_of(mesh_velocity_.begin(), mesh_velocity_.end(), [](const Vec<dim>& w) { return !w.isZero(0.0); });
  auto sum = [&]<int order>(std::integral_constant<int, order>) {
    constexpr int n = shape_count<dim, order>;
    for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
      const auto& corners = mesh_->elements[e];
      const int* node = &space_.node_of[e * n];
      auto integrate = [&](double share, auto&& rate) {  // on the mesh at old + share (new - old)
        std::array<Vec<dim>, dim + 1> x;
        for (int a = 0; a <= dim; ++a) x[a] = (1 - share) * old_position_[corners[a]] + share * position_[corners[a]];
        const Geometry<dim> g = geometry<dim>(x);
        for (const auto& point : quadrature<dim, order>()) {
          const double value = rate(point, g) * point.weight * g.volume;
          for (int a = 0; a <= dim; ++a) change[node[a]] += point.l[a] * value;
        }
      };
      integrate(0.0, [&](const auto& point, const auto&) {
        const auto shape = shapes<dim, order>(point.l);
        double d = 0.0;
        for (int a = 0; a < n; ++a) d += shape[a] * (eps_[0][node[a]] - eps_[1][node[a]]);
        return d;
      });
      if (moves)
        for (const double side : {-1.0, 1.0})  // Gauss: exact for the cubic polynomial in time
          integrate(0.5 + side * 0.5 / std::sqrt(3.0), [&](const auto& point, const Geometry<dim>& g) {
            const auto grad = shape_gradients<dim, order>(point.l, g.grad_l);
            Vec<dim> slope = Vec<dim>::Zero(), w = Vec<dim>::Zero();
            for (int a = 0; a < n; ++a) slope += eps_[0][node[a]] * grad[a];
            for (int a = 0; a <= dim; ++a) w += point.l[a] * mesh_velocity_[corners[a]];
            return -0.5 * dt * w.dot(slope);
          });
    }
  };
  velocity_order() == 1 ? sum(std::integral_constant<int, 1>{}) : sum(std::integral_constant<int, 2>{});
  return change;
}

template <int dim>
std::vector<double> Fluid<dim>::times_matrix(const std::vector<double>& x) const {
  std::vector<double> y(space_.end - space_.begin, 0.0);
  for (std::size_t r = 0; r < y.size(); ++r)
    for (int k = space_.row_start[r]; k < space_.row_start[r + 1]; ++k) y[r] += values_[k] * x[space_.column[k]];
  return y;
}

// The unknowns at the end of a step, or of a steady flow. Solved for what is missing to a start that satisfies the conditions, in the
// frames of the held nodes, and scaled so that pressure and flux weigh the same.
template <int dim>
std::vector<double> Fluid<dim>::solve(const char* function, const std::vector<double>& start, const TimeWeights& time, bool newton, double tolerance, Report& report) {
  const double begun = seconds();
  velocity_order() == 1 ? assemble<1>(time, newton) : assemble<2>(time, newton);
  const double assembled = seconds();
  report.assembly_time += assembled - begun;
  const int own = space_.end - space_.begin;
  std::vector<double> x = start;
  for (int node = 0; node < space_.nodes(); ++node) {
    const Held& held = held_[node];
    if (held.last == 0) continue;
    Eigen::Map<Vec<dim>> flux(&x[space_.first_dof[node]]);
    Vec<dim> along = held.frame.transpose() * flux;
    along.head(held.last) = held.value.head(held.last);
    flux = held.frame * along;
  }
  const int pinned = has_pressure_reference() ? -1 : space_.pressure_dof(space_.vertex[mesh_->elements[0][0]]);
  std::vector<double> missing = times_matrix(x), values = values_;
  for (int r = 0; r < own; ++r) missing[r] = b_[r] - missing[r];
  if (pinned >= 0) spread_surplus(function, x, time, missing);

  std::vector<int> node_at(space_.dofs(), -1);  // velocity node whose components begin there
  for (int node = 0; node < space_.nodes(); ++node) node_at[space_.first_dof[node]] = node;
  std::array<double, 3> size{};  // of the momentum's diagonal, of what pressures do to it, rows
  std::vector<char> is_pressure(space_.dofs(), false);
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node)) is_pressure[space_.pressure_dof(node)] = true;
  for (int r = 0; r < own; ++r) {
    if (is_pressure[space_.begin + r]) continue;
    for (int k = space_.row_start[r]; k < space_.row_start[r + 1]; ++k)
      if (space_.column[k] == space_.begin + r) size[0] += std::abs(values[k]);
      else if (is_pressure[space_.column[k]]) size[1] += std::abs(values[k]);
  }
  sum_over_ranks(size);
  const double pressure_scale = pressure_scale_ = size[0] / size[1];
  for (int node = 0; node < space_.nodes(); ++node) {
    if (!space_.mine(node)) continue;
    const int first = space_.first_dof[node] - space_.begin, length = space_.row_start[first + 1] - space_.row_start[first];
    double* rows = &values[space_.row_start[first]];
    const int* columns = &space_.column[space_.row_start[first]];
    if (has_frame_[node]) {
      Eigen::Map<Eigen::Matrix<double, dim, Eigen::Dynamic, Eigen::RowMajor>> block(rows, dim, length);
      block = (held_[node].frame.transpose() * block).eval();
      Eigen::Map<Vec<dim>> m(&missing[first]);
      m = (held_[node].frame.transpose() * m).eval();
    }
    for (int i = 0; i < space_.dofs_at(node); ++i, rows += length) {
      const int row = space_.begin + first + i;
      if (i < dim ? i < held_[node].last : row == pinned) {
        for (int k = 0; k < length; ++k) rows[k] = columns[k] == row ? 1.0 : 0.0;
        missing[first + i] = 0.0;
        continue;
      }
      for (int k = 0; k < length; ++k) {
        const int other = node_at[columns[k]];
        if (other >= 0 && has_frame_[other]) {
          Eigen::Map<Eigen::Matrix<double, 1, dim>> block(&rows[k]);
          block = (block * held_[other].frame).eval();
        }
        if (is_pressure[columns[k]]) rows[k] *= pressure_scale;
        if (i == dim) rows[k] *= pressure_scale;
      }
      if (i == dim) missing[first + i] *= pressure_scale;
    }
  }
  if (!solver_) {
    LinearSettings linear = settings.linear.value_or(LinearSettings{.method = dim == 2 ? Method::direct : velocity_order() == 1 ? Method::ilu : Method::fieldsplit});
    std::vector<int> pressures;
    for (int k = space_.begin; k < space_.end; ++k)
      if (is_pressure[k]) pressures.push_back(k);
    solver_ = std::make_unique<LinearSolver>(space_.begin, space_.end, space_.dofs(), space_.row_start, space_.column, linear, velocity_order() == 1 ? dim + 1 : 1, pressures);
  }
  std::vector<double> change(space_.dofs(), 0.0);
  const LinearReport linear = solver_->solve(values, missing, std::span(change).subspan(space_.begin, own), tolerance);
  report.linear_iterations += linear.iterations;
  report.factorisations += linear.factorised;
  share(change, space_.first_of_rank);
  const bool finite = std::all_of(change.begin(), change.end(), [](double v) { return std::isfinite(v); });
  if (!linear.converged || !finite)
    throw NotConverged(fmt::format("{}: velocity and pressure not found in step {}, t = {:.6g} s: {} after {} iterations, residual {:.1e}. Likely causes: {}", function,
                                   steps_ + 1, time_, finite ? linear.reason : "values not finite", linear.iterations, linear.residual,
                                   "velocities that have blown up (a smaller time step), elements of extreme aspect, parts of the domain without a condition on the pressure"));
  for (int node = 0; node < space_.nodes(); ++node) {
    if (has_frame_[node]) {
      Eigen::Map<Vec<dim>> u(&change[space_.first_dof[node]]);
      u = (held_[node].frame * u).eval();
    }
    if (space_.is_vertex(node)) change[space_.pressure_dof(node)] *= pressure_scale;
  }
  for (int k = 0; k < space_.dofs(); ++k) x[k] += change[k];
  if (pinned >= 0) {
    const double shift = mean_pressure_.value_or(0.0) - mean_pressure(x);
    for (int node = 0; node < space_.nodes(); ++node)
      if (space_.is_vertex(node)) x[space_.pressure_dof(node)] += shift;
  }
  const std::vector<double> there = times_matrix(x);
  reaction_at_nodes_.assign(space_.dofs(), 0.0);
  for (int r = 0; r < own; ++r) reaction_at_nodes_[space_.begin + r] = there[r] - b_[r];
  share(reaction_at_nodes_, space_.first_of_rank);
  report.solve_time += seconds() - assembled;
  return x;
}

// Where no fluid can leave, what boundaries and a changing void fraction let in must add up to nothing. Profiles on a mesh do so up to its
// error, which every vertex takes its share of.
template <int dim>
void Fluid<dim>::spread_surplus(const char* function, const std::vector<double>& x, const TimeWeights& time, std::vector<double>& missing) const {
  Report balance;
  account(balance, x, time);
  const double surplus = balance.net_inflow - balance.pore_volume_rate;
  if (balance.volume_error > 0.01)
    throw std::invalid_argument(fmt::format("{}: no boundary lets fluid leave, but {:.6g} flow in and the pores grow by {:.6g} (2D: m^2/s, 3D: m^3/s); set an outflow, or velocities that add up", function,
                                            balance.net_inflow, balance.pore_volume_rate));
  double volume = 0.0;
  std::vector<double> share(space_.nodes(), 0.0);
  for (const auto& element : mesh_->elements) {
    std::array<Vec<dim>, dim + 1> corner;
    for (int a = 0; a <= dim; ++a) corner[a] = position_[element[a]];
    const double v = geometry<dim>(corner).volume;
    volume += v;
    for (const int k : element) share[space_.vertex[k]] += v / (dim + 1);
  }
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node) && space_.mine(node)) missing[space_.pressure_dof(node) - space_.begin] -= surplus * share[node] / volume;
}

template <int dim>
double Fluid<dim>::mean_pressure(const std::vector<double>& x) const {
  double sum = 0.0, volume = 0.0;
  for (const auto& element : mesh_->elements) {
    std::array<Vec<dim>, dim + 1> corner;
    double mean = 0.0;
    for (int a = 0; a <= dim; ++a) corner[a] = position_[element[a]], mean += x[space_.pressure_dof(space_.vertex[element[a]])] / (dim + 1);
    const double v = geometry<dim>(corner).volume;
    sum += v * mean, volume += v;
  }
  return sum / volume;
}

// Changes of flux and pressure relative to their sizes, the larger of the two. One that should vanish is what rounding of the other's forces
// leaves of it (a fluid at rest under gravity, a body force that needs no pressure): changes within 1e-14 of those are none.
template <int dim>
double Fluid<dim>::relative_change(const std::vector<double>& x, const std::vector<double>& before) const {
  std::array<double, 2> change{}, size{};
  for (int node = 0; node < space_.nodes(); ++node)
    for (int i = 0; i < space_.dofs_at(node); ++i) {
      const double now = x[space_.first_dof[node] + i], was = before[space_.first_dof[node] + i];
      change[i == dim] += (now - was) * (now - was), size[i == dim] += now * now;
    }
  const double rounding = std::pow(1e-14 / settings.newton_tolerance, 2), scale = pressure_scale_ * pressure_scale_;
  size = {size[0] + rounding * size[1] / scale, size[1] + rounding * size[0] * scale};
  double worst = 0.0;
  for (int k = 0; k < 2; ++k)
    if (size[k] > 0) worst = std::max(worst, std::sqrt(change[k] / size[k]));
  return worst;
}

template <int dim>
Report Fluid<dim>::step(double dt) {
  if (!(dt > 0 && std::isfinite(dt))) throw std::invalid_argument(fmt::format("step: dt must be > 0 s and finite, got {}", dt));
  check_conditions("step");
  Report report;
  const bool second = settings.scheme == Scheme::bdf2 && steps_ > 0;
  const double r = second ? dt / dt_ : 0.0;
  const TimeWeights time = second ? TimeWeights{(1 + 2 * r) / (1 + r) / dt, -(1 + r) / dt, r * r / (1 + r) / dt} : TimeWeights{1 / dt, -1 / dt, 0.0};
  for (int k = 0; k < space_.dofs(); ++k) guess_[k] = x_[0][k] + (second ? r * (x_[0][k] - x_[1][k]) : 0.0);
  const std::vector<Vec<dim>> mesh_velocity = mesh_velocity_;
  old_position_ = position_;
  std::vector<double> x;
  try {
    move_mesh(time_ + dt, dt);
    pore_volume_[0] = pore_volume(eps_[0]);
    for (std::size_t k = 0; k < swept_.size(); ++k) swept_[k] = swept(static_cast<int>(k), dt);
    eps_change_ = eps_change(dt);
    x = solve_step(time_ + dt, time, report);
    account(report, x, time);
  } catch (...) {
    position_ = old_position_, mesh_velocity_ = mesh_velocity;
    throw;
  }
  x_[1].swap(x_[0]), x_[0].swap(x);
  eps_[2] = eps_[1], eps_[1] = eps_[0];
  pore_volume_[2] = pore_volume_[1], pore_volume_[1] = pore_volume_[0];
  old_eps_change_ = eps_change_, old_swept_used_ = old_swept_, old_swept_ = swept_;
  time_weights_ = time, time_ += dt, dt_ = dt;
  ++steps_;
  return report;
}

template <int dim>
std::vector<double> Fluid<dim>::solve_step(double t, const TimeWeights& time, Report& report) {
  hold(t);
  evaluate_outside(t);
  std::vector<double> x = guess_;
  const bool newton = settings.advection == Advection::newton;
  for (int k = 0;; ++k) {
    std::vector<double> next = solve("step", x, time, newton && k > 0, newton ? newton_forcing : 0.0, report);
    ++report.newton_iterations;
    report.change = relative_change(next, x);
    x.swap(next);
    if (!newton || report.change < settings.newton_tolerance) return x;
    if (k == settings.max_newton) throw_newton("step", report);
    guess_ = x;
  }
}

// Calls visit(doubles) for every part of the state.
template <int dim>
template <class Visit>
void Fluid<dim>::each_part(Visit&& visit) {
  double steps = steps_, started = eps_started_;
  for (double* one : {&time_, &dt_, &steps, &started}) visit(std::span(one, 1));
  steps_ = static_cast<int>(steps), eps_started_ = started != 0.0;
  for (auto* many : {&x_[0], &x_[1], &eps_[0], &eps_[1], &eps_[2], &eps_change_, &old_eps_change_, &swept_, &old_swept_, &old_swept_used_}) visit(std::span(*many));
  visit(std::span(pore_volume_));
  visit(std::span(time_weights_));
  for (auto* points : {&position_, &mesh_velocity_}) visit(std::span(points->data()->data(), dim * points->size()));
}

// What a state must agree with: 53 bits of FNV-1a over the element, the mesh's nodes and how they are connected.
template <int dim>
static double fingerprint(const Space<dim>& space) {
  std::uint64_t hash = 14695981039346656037ull;
  auto add = [&](const void* data, std::size_t bytes) {
    for (std::size_t k = 0; k < bytes; ++k) hash = (hash ^ static_cast<const unsigned char*>(data)[k]) * 1099511628211ull;
  };
  const Mesh<dim>& mesh = *space.mesh;
  add(&space.order, sizeof space.order);
  add(mesh.nodes.data(), mesh.nodes.size() * sizeof mesh.nodes[0]);
  add(mesh.elements.data(), mesh.elements.size() * sizeof mesh.elements[0]);
  add(mesh.master.data(), mesh.master.size() * sizeof mesh.master[0]);
  return static_cast<double>(hash >> 11);
}

template <int dim>
std::vector<double> Fluid<dim>::state() {
  std::vector<double> all{fingerprint(space_)};
  each_part([&](std::span<double> part) { all.insert(all.end(), part.begin(), part.end()); });
  if (solver_) solver_->forget();
  return all;
}

template <int dim>
void Fluid<dim>::restore(std::span<const double> state) {
  std::size_t size = 1;
  each_part([&](std::span<double> part) { size += part.size(); });
  if (state.empty() || state[0] != fingerprint(space_) || state.size() != size)
    throw std::invalid_argument(fmt::format("restore: the state is of another mesh or element ({} numbers where this one has {}); make the fluid on the mesh it was saved with", state.size(), size));
  std::size_t at = 1;
  each_part([&](std::span<double> part) {
    std::copy_n(state.begin() + at, part.size(), part.begin());
    at += part.size();
  });
  old_position_ = position_;
  if (solver_) solver_->forget();
}

template <int dim>
void Fluid<dim>::throw_newton(const char* function, const Report& report) const {
  throw NotConverged(fmt::format("{}: Newton's iteration for the advection in step {}, t = {:.6g} s, still changes by {:.1e} after {} iterations. Likely causes: a flow that has no "
                                 "steady state or is far from it (lower the Reynolds number in stages, or step in time), a time step too large", function, steps_ + 1, time_, report.change,
                                 report.newton_iterations));
}

// Stokes' flow to start from where there is nothing, two iterations with the advection lagged, then Newton's.
template <int dim>
Report Fluid<dim>::solve_steady() {
  check_conditions("solve_steady");
  Report report;
  const TimeWeights time{};
  for (auto* none : {&eps_change_, &swept_, &old_swept_}) std::fill(none->begin(), none->end(), 0.0);
  std::fill(mesh_velocity_.begin(), mesh_velocity_.end(), Vec<dim>::Zero());
  eps_[2] = eps_[1] = eps_[0];
  pore_volume_.fill(pore_volume(eps_[0]));
  hold(time_);
  evaluate_outside(time_);
  std::vector<double> x = x_[0];
  const bool linear = settings.advection == Advection::none || properties.density == 0;
  for (int k = 0;; ++k) {
    guess_ = x;
    std::vector<double> next = solve("solve_steady", x, time, !linear && k > 2, linear ? 0.0 : newton_forcing, report);
    ++report.newton_iterations;
    report.change = relative_change(next, x);
    x.swap(next);
    if (linear || report.change < settings.newton_tolerance) break;
    if (k == settings.max_newton) throw_newton("solve_steady", report);
  }
  account(report, x, time);
  x_[1] = x_[0] = x;
  time_weights_ = time;
  steps_ = 0;
  return report;
}

template <int dim>
double Fluid<dim>::flux_of(const std::vector<double>& x, int boundary) const {
  double sum = 0.0;
  auto add = [&]<int order>(std::integral_constant<int, order>) {
    for (const int f : facets_of_[boundary]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
        const auto shape = shapes<dim, order>(l);
        for (int a = 0; a < shape_count<dim, order>; ++a)
          sum += weight * shape[a] * facet.area.dot(Eigen::Map<const Vec<dim>>(&x[space_.first_dof[space_.node_of[facet.element * space_.per_element + a]]]));
      });
    }
  };
  velocity_order() == 1 ? add(std::integral_constant<int, 1>{}) : add(std::integral_constant<int, 2>{});
  return sum;
}

template <int dim>
double Fluid<dim>::flux(const std::string& boundary) const {
  const int k = boundary_index("flux", boundary);
  return flux_of(x_[0], k) - (time_weights_[0] * old_swept_[k] - time_weights_[2] * old_swept_used_[k]);
}

template <int dim>
void Fluid<dim>::account(Report& report, const std::vector<double>& x, const TimeWeights& time) const {
  double area = 0.0, fastest = 0.0, pores = 0.0;
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    if (conditions_[k].kind == Kind::none) continue;  // inside, or on a periodic side
    report.net_inflow -= flux_of(x, static_cast<int>(k)) - (time[0] * swept_[k] - time[2] * old_swept_[k]);
    for (const int f : facets_of_[k]) area += FacetView<dim>(*mesh_, position_, f).area.norm();
  }
  for (int node = 0; node < space_.nodes(); ++node) {
    fastest = std::max(fastest, Eigen::Map<const Vec<dim>>(&x[space_.first_dof[node]]).norm());
    if (space_.is_vertex(node)) pores += std::abs(time[0] * eps_change_[node] - time[2] * old_eps_change_[node]);
  }
  report.pore_volume_rate = time[0] * pore_volume_[0] + time[1] * pore_volume_[1] + time[2] * pore_volume_[2];
  double size = fastest * area + pores;
  for (int k = 0; k < 3; ++k) size += 1e-12 * std::abs(time[k] * pore_volume_[k]);  // what rounding leaves of a fluid at rest is no error
  report.volume_error = size > 0 ? std::abs(report.pore_volume_rate - report.net_inflow) / size : 0.0;
}

// Calls use(point, force): what the fluid does to a boundary, the pressure at the facets' quadrature points, the viscous traction at nodes.
// Where boundaries meet, each has its share of a node, by area.
template <int dim>
template <class Use>
void Fluid<dim>::loads(const char* function, const std::string& boundary, Use&& use) const {
  const int k = boundary_index(function, boundary);
  if (reaction_at_nodes_.empty()) throw std::logic_error(fmt::format("{}: nothing is known before the first step", function));
  std::vector<double> area(space_.nodes(), 0.0);  // of facets at each node
  for (std::size_t f = 0; f < mesh_->facets.size(); ++f) {
    if (mesh_->facet_elements[f][1] >= 0) continue;
    const double own = FacetView<dim>(*mesh_, position_, static_cast<int>(f)).area.norm();
    for (const auto& [node, x] : facet_nodes(static_cast<int>(f))) area[node] += own;
  }
  for (const int f : facets_of_[k]) {
    const FacetView<dim> facet(*mesh_, position_, f);
    if (mesh_->facet_elements[f][1] < 0)
      for (const auto& [node, x] : facet_nodes(f))
        use(x, Vec<dim>(-facet.area.norm() / area[node] / eps_[1][node] * Eigen::Map<const Vec<dim>>(&reaction_at_nodes_[space_.first_dof[node]])));
    const auto& corners = mesh_->elements[facet.element];
    along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
      Vec<dim> x = Vec<dim>::Zero();
      double p = 0.0;
      for (int a = 0; a <= dim; ++a) x += l[a] * position_[corners[a]], p += l[a] * x_[0][space_.pressure_dof(space_.vertex[corners[a]])];
      use(x, Vec<dim>(weight * p * facet.area));
    });
  }
}

template <int dim>
Vec<dim> Fluid<dim>::force(const std::string& boundary) const {
  Vec<dim> sum = Vec<dim>::Zero();
  loads("force", boundary, [&](const Vec<dim>&, const Vec<dim>& force) { sum += force; });
  return sum;
}

template <int dim>
auto Fluid<dim>::torque(const std::string& boundary, const Vec<dim>& centre) const -> Moment {
  Moment sum = Moment::Zero();
  loads("torque", boundary, [&](const Vec<dim>& x, const Vec<dim>& force) {
    const Vec<dim> arm = x - centre;
    if constexpr (dim == 2) sum[0] += arm[0] * force[1] - arm[1] * force[0];
    else sum += arm.cross(force);
  });
  return sum;
}

template <int dim>
auto Fluid<dim>::error(const VectorField<dim>& velocity, const ScalarField<dim>& pressure) const -> Error {
  std::vector<Vec<dim>> x, u;
  std::vector<double> p, weight;
  for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
    const auto& corners = mesh_->elements[e];
    std::array<Vec<dim>, dim + 1> corner;
    for (int a = 0; a <= dim; ++a) corner[a] = position_[corners[a]];
    const double volume = geometry<dim>(corner).volume;
    for (const auto& point : quadrature<dim, 2>()) {
      Vec<dim> where = Vec<dim>::Zero();
      double value = 0.0;
      for (int a = 0; a <= dim; ++a) where += point.l[a] * corner[a], value += point.l[a] * x_[0][space_.pressure_dof(space_.vertex[corners[a]])];
      x.push_back(where), p.push_back(value), weight.push_back(point.weight * volume);
      u.push_back(velocity_in(static_cast<int>(e), point.l));
    }
  }
  const auto exact_u = velocity(x, time_);
  const auto exact_p = pressure(x, time_);
  std::array<double, 2> off{}, size{};
  for (std::size_t k = 0; k < x.size(); ++k) {
    off[0] += weight[k] * (u[k] - exact_u[k]).squaredNorm(), size[0] += weight[k] * exact_u[k].squaredNorm();
    off[1] += weight[k] * (p[k] - exact_p[k]) * (p[k] - exact_p[k]), size[1] += weight[k] * exact_p[k] * exact_p[k];
  }
  return {std::sqrt(off[0] / size[0]), std::sqrt(off[1] / size[1])};
}

template <int dim>
Vec<dim> Fluid<dim>::velocity_in(int element, const Barycentric<dim>& l) const {
  double eps = 0.0;
  Vec<dim> flux = Vec<dim>::Zero();
  auto add = [&](const auto& shape) {
    for (int a = 0; a < space_.per_element; ++a) {
      const int node = space_.node_of[element * space_.per_element + a];
      eps += shape[a] * eps_[1][node];
      flux += shape[a] * Eigen::Map<const Vec<dim>>(&x_[0][space_.first_dof[node]]);
    }
  };
  velocity_order() == 1 ? add(shapes<dim, 1>(l)) : add(shapes<dim, 2>(l));
  return flux / eps;
}

template <int dim>
auto Fluid<dim>::probe(std::span<const Vec<dim>> x) const -> std::vector<Probe> {
  const Locator<dim> locator(*mesh_, position_);
  std::vector<Probe> found;
  for (const Vec<dim>& point : x) {
    const auto where = point.allFinite() ? locator.find(point) : std::nullopt;
    if (!where) throw std::invalid_argument(fmt::format("probe: {} m (point {}) is not inside the mesh", at<dim>(point), found.size()));
    const auto& [element, l] = *where;
    const auto& corners = mesh_->elements[element];
    Probe probe{Vec<dim>::Zero(), 0.0, Vec<dim>::Zero()};
    std::array<Vec<dim>, dim + 1> corner;
    for (int a = 0; a <= dim; ++a) corner[a] = position_[corners[a]];
    const Geometry<dim> g = geometry<dim>(corner);
    for (int a = 0; a <= dim; ++a) {
      const double p = x_[0][space_.pressure_dof(space_.vertex[corners[a]])];
      probe.pressure += l[a] * p, probe.pressure_gradient += p * g.grad_l[a];
    }
    probe.velocity = velocity_in(element, l);
    found.push_back(probe);
  }
  return found;
}

template <int dim>
double Fluid<dim>::pore_volume(const std::vector<double>& eps) const {
  double sum = 0.0;
  auto add = [&]<int order>(std::integral_constant<int, order>) {
    for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
      std::array<Vec<dim>, dim + 1> corner;
      for (int a = 0; a <= dim; ++a) corner[a] = position_[mesh_->elements[e][a]];
      double mean = 0.0;
      for (const auto& point : quadrature<dim, order>()) {
        const auto shape = shapes<dim, order>(point.l);
        for (int a = 0; a < shape_count<dim, order>; ++a) mean += point.weight * shape[a] * eps[space_.node_of[e * space_.per_element + a]];
      }
      sum += geometry<dim>(corner).volume * mean;
    }
  };
  velocity_order() == 1 ? add(std::integral_constant<int, 1>{}) : add(std::integral_constant<int, 2>{});
  return sum;
}

// int int eps w . n dA dt over a step, with eps of its end carried along: exact, as in eps_change().
template <int dim>
double Fluid<dim>::swept(int boundary, double dt) const {
  double sum = 0.0;
  auto add = [&]<int order>(std::integral_constant<int, order>) {
    for (const double side : {-1.0, 1.0}) {
      const double share = 0.5 + side * 0.5 / std::sqrt(3.0);
      for (const int f : facets_of_[boundary]) {
        const FacetView<dim> facet(*mesh_, f, [&](int k) { return Vec<dim>((1 - share) * old_position_[k] + share * position_[k]); });
        along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
          const auto shape = shapes<dim, order>(l);
          double eps = 0.0;
          Vec<dim> w = Vec<dim>::Zero();
          for (int a = 0; a < shape_count<dim, order>; ++a) eps += shape[a] * eps_[0][space_.node_of[facet.element * space_.per_element + a]];
          for (int a = 0; a <= dim; ++a) w += l[a] * mesh_velocity_[mesh_->elements[facet.element][a]];
          sum += 0.5 * dt * weight * eps * w.dot(facet.area);
        });
      }
    }
  };
  velocity_order() == 1 ? add(std::integral_constant<int, 1>{}) : add(std::integral_constant<int, 2>{});
  return sum;
}

// Factors of the mesh's Laplacian, for each component with its own held nodes.
template <int dim>
struct Fluid<dim>::Harmonic {
  std::array<std::vector<int>, dim> row;  // of each velocity node among the free ones, or -1
  std::array<Eigen::SparseMatrix<double>, dim> held;  // what held nodes do to free rows
  std::array<Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>, dim> factors;
};

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::harmonic(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity) {
  std::vector<Vec<dim>> at_node(space_.nodes(), Vec<dim>::Zero());
  for (std::size_t k = 0; k < moved.size(); ++k)
    for (std::size_t m = 0; m < moved[k].size(); ++m) at_node[space_.vertex[moved[k][m]]] = velocity[k][m];
  if (!harmonic_) {
    harmonic_ = std::make_unique<Harmonic>();
    std::array<std::vector<char>, dim> is_held;
    for (auto& held : is_held) held.assign(space_.nodes(), false);
    for (std::size_t f = 0; f < mesh_->facets.size(); ++f) {
      if (mesh_->facet_elements[f][1] >= 0) continue;
      const Vec<dim> normal = FacetView<dim>(*mesh_, mesh_->nodes, static_cast<int>(f)).area.normalized();
      for (const int k : mesh_->facets[f])
        for (int axis = 0; axis < dim; ++axis) is_held[axis][space_.vertex[k]] |= motion_[mesh_->boundary[f]] || std::abs(normal[axis]) > 1e-6;
    }
    for (int axis = 0; axis < dim; ++axis) {
      auto& row = harmonic_->row[axis];
      row.assign(space_.nodes(), -1);
      int free = 0;
      for (int node = 0; node < space_.nodes(); ++node)
        if (space_.is_vertex(node) && !is_held[axis][node]) row[node] = free++;
      std::vector<Eigen::Triplet<double>> inner, outer;
      for (const auto& element : mesh_->elements) {
        std::array<Vec<dim>, dim + 1> corner;
        for (int a = 0; a <= dim; ++a) corner[a] = mesh_->nodes[element[a]];
        const Geometry<dim> g = geometry<dim>(corner);
        for (int a = 0; a <= dim; ++a)
          for (int b = 0; b <= dim; ++b) {
            const int i = space_.vertex[element[a]], j = space_.vertex[element[b]];
            if (row[i] < 0) continue;
            const double value = g.volume * g.grad_l[a].dot(g.grad_l[b]);
            row[j] < 0 ? outer.emplace_back(row[i], j, value) : inner.emplace_back(row[i], row[j], value);
          }
      }
      Eigen::SparseMatrix<double> laplacian(free, free);
      laplacian.setFromTriplets(inner.begin(), inner.end());
      harmonic_->held[axis].resize(free, space_.nodes());
      harmonic_->held[axis].setFromTriplets(outer.begin(), outer.end());
      if (free > 0) harmonic_->factors[axis].compute(laplacian);
      if (free > 0 && harmonic_->factors[axis].info() != Eigen::Success)
        throw std::invalid_argument(fmt::format("step: nothing holds the nodes of the mesh along axis {}; move a boundary with move_boundary", axis));
    }
  }
  for (int axis = 0; axis < dim; ++axis) {
    if (harmonic_->held[axis].rows() == 0) continue;
    Eigen::VectorXd known(space_.nodes());
    for (int node = 0; node < space_.nodes(); ++node) known[node] = at_node[node][axis];
    const Eigen::VectorXd found = harmonic_->factors[axis].solve(-(harmonic_->held[axis] * known));
    for (int node = 0; node < space_.nodes(); ++node)
      if (harmonic_->row[axis][node] >= 0) at_node[node][axis] = found[harmonic_->row[axis][node]];
  }
  std::vector<Vec<dim>> w;
  for (const int node : space_.vertex) w.push_back(at_node[node]);
  return w;
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::stretch(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity) const {
  std::vector<Vec<dim>> place, w;
  for (std::size_t k = 0; k < moved.size(); ++k) {
    if (moved[k].empty()) continue;
    place.push_back(Vec<dim>::Zero()), w.push_back(velocity[k][0]);
    for (std::size_t m = 0; m < moved[k].size(); ++m) {
      place.back() += position_[moved[k][m]] / moved[k].size();
      if ((velocity[k][m] - w.back()).norm() > 1e-12 * w.back().norm())
        throw std::invalid_argument(fmt::format("step: mesh_motion \"stretch\" needs boundaries that move as a whole, but \"{}\" does not; use \"harmonic\"", mesh_->boundary_names[k]));
    }
  }
  if (place.size() != 2) throw std::invalid_argument(fmt::format("step: mesh_motion \"stretch\" is between two boundaries that move, got {}; move the other one with velocity 0, or use \"harmonic\"", place.size()));
  // The axis that tells them apart: their centres may be shifted along the others.
  int axis;
  (place[1] - place[0]).cwiseAbs().maxCoeff(&axis);
  std::vector<Vec<dim>> at_nodes;
  for (const Vec<dim>& x : position_) {
    const double share = (x[axis] - place[0][axis]) / (place[1][axis] - place[0][axis]);
    at_nodes.push_back((1 - share) * w[0] + share * w[1]);
  }
  return at_nodes;
}

// Moves the mesh over a step. Throws, with the mesh where it was, when an element would fold.
template <int dim>
void Fluid<dim>::move_mesh(double t, double dt) {
  if (std::none_of(motion_.begin(), motion_.end(), [](const auto& m) { return static_cast<bool>(m); })) return;
  std::vector<std::vector<int>> moved(motion_.size());  // mesh nodes of each boundary that moves
  std::vector<std::vector<Vec<dim>>> velocity(motion_.size());
  for (std::size_t k = 0; k < motion_.size(); ++k) {
    if (!motion_[k]) continue;
    std::vector<char> seen(position_.size(), false);
    std::vector<Vec<dim>> x;
    for (const int f : facets_of_[k])
      for (const int node : mesh_->facets[f])
        if (!seen[node]) seen[node] = true, moved[k].push_back(node), x.push_back(position_[node]);
    velocity[k] = motion_[k](x, t);
    for (std::size_t m = 0; m < x.size(); ++m)
      if (!velocity[k][m].allFinite()) throw std::invalid_argument(fmt::format("step: the velocity of boundary \"{}\" must be finite, got {} m/s at {}", mesh_->boundary_names[k], at<dim>(velocity[k][m]), at<dim>(x[m])));
  }
  mesh_velocity_ = mesh_motion == MeshMotion::harmonic ? harmonic(moved, velocity) : stretch(moved, velocity);
  for (std::size_t k = 0; k < position_.size(); ++k) position_[k] = old_position_[k] + dt * mesh_velocity_[k];
  for (const auto& element : mesh_->elements) {
    std::array<Vec<dim>, dim + 1> corner;
    for (int a = 0; a <= dim; ++a) corner[a] = position_[element[a]];
    if (!(geometry<dim>(corner).volume > 0))
      throw std::invalid_argument(fmt::format("step: moving the boundaries over {:.4g} s folds the mesh at {} m; take smaller steps, or make a new mesh", dt, at<dim>(corner[0])));
  }
}

template class Fluid<2>;
template class Fluid<3>;

}  // namespace quicksand::fluid
