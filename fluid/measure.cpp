// What can be said of a flow: fluxes and forces on boundaries, values at points, errors against a known flow, the balance of volume.
#include "facet.hpp"
#include "fluid.hpp"
#include "locator.hpp"

#include "meshes/errors.hpp"

#include <Eigen/Geometry>

namespace quicksand::fluid {

using meshes::fail;
using meshes::place;

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
  with_order(velocity_order(), add);
  return sum;
}

template <int dim>
double Fluid<dim>::flux(const std::string& boundary) const {
  const int k = boundary_index("flux", boundary);
  return flux_of(x_[0], k) - rate(time_weights_, swept_[1][k], swept_[2][k]);
}

template <int dim>
void Fluid<dim>::account(Report& report, const std::vector<double>& x, const TimeWeights& time) const {
  double area = 0.0, fastest = 0.0, pores = 0.0;
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    if (conditions_[k].kind == Kind::none) continue;  // inside, or on a periodic side
    report.net_inflow -= flux_of(x, static_cast<int>(k)) - rate(time, swept_[0][k], swept_[1][k]);
    for (const int f : facets_of_[k]) area += FacetView<dim>(*mesh_, position_, f).area.norm();
  }
  for (int node = 0; node < space_.nodes(); ++node) {
    fastest = std::max(fastest, Eigen::Map<const Vec<dim>>(&x[space_.first_dof[node]]).norm());
    if (space_.is_vertex(node)) pores += std::abs(rate(time, eps_change_[0][node], eps_change_[1][node]));
  }
  report.pore_volume_rate = rate(time, pore_volume_[0] - pore_volume_[1], pore_volume_[1] - pore_volume_[2]);
  // The pores' volume is known to rounding of sums only, 1e-14: of a fluid at rest, or nearly so, that is all there is, and no error.
  const double size = fastest * area + pores, error = std::abs(report.pore_volume_rate - report.net_inflow) - 1e-14 * std::abs(time[0] * pore_volume_[0]);
  report.volume_error = error > 0 ? error / size : 0.0;
}

template <int dim>
void Fluid<dim>::judge_elements(Report& report, const std::vector<double>& x, double dt) const {
  double courant = 0.0, peclet = 0.0;  // squares
  for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
    Vec<dim> u = Vec<dim>::Zero();
    double least = 1.0, most = 0.0;
    for (int a = 0; a < space_.per_element; ++a) {
      const int node = space_.node_of[e * space_.per_element + a];
      least = std::min(least, eps_[0][node]), most = std::max(most, eps_[0][node]);
      if (a <= dim) u += (Eigen::Map<const Vec<dim>>(&x[space_.first_dof[node]]) / eps_[0][node] - mesh_velocity_[mesh_->elements[e][a]]) / (dim + 1);
    }
    report.eps_jump = std::max(report.eps_jump, (most - least) / least);
    double per_time = 0.0;  // (|u|/h)^2 = u . m u/4, m the element's metric
    for (const Vec<dim>& grad : geometry<dim>(position_, mesh_->elements[e]).grad_l) per_time += 0.5 * grad.dot(u) * grad.dot(u);
    courant = std::max(courant, per_time);
    if (per_time > 0) peclet = std::max(peclet, u.squaredNorm() * u.squaredNorm() / per_time);
  }
  report.courant = std::sqrt(courant) * dt;
  report.peclet = properties.density * std::sqrt(peclet) / properties.viscosity;
}

// Calls use(point, force): what the fluid and what is in it do to a boundary by pressure and viscous stress. The fluid's share of the viscous
// traction, eps, is that of its momentum balance at nodes, with the drag there; where boundaries meet, each has its share of a node, by area. Pressure, and
// the rest of the traction, which acts on what is in the fluid, at the facets' quadrature points.
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
        use(x, Vec<dim>(-facet.area.norm() / area[node] * Eigen::Map<const Vec<dim>>(&reaction_at_nodes_[space_.first_dof[node]])));
    const auto& corners = mesh_->elements[facet.element];
    along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
      Vec<dim> x = Vec<dim>::Zero();
      for (int a = 0; a <= dim; ++a) x += l[a] * position_[corners[a]];
      const InElement<> there = flow_in(facet.element, l, facet.geometry);
      use(x, Vec<dim>(weight * (pressure_in(facet.element, l) * facet.area - (1 - there.eps) * (there.stress * facet.area))));
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
    const double volume = geometry<dim>(position_, corners).volume;
    for (const auto& point : quadrature<dim, 2>()) {
      Vec<dim> where = Vec<dim>::Zero();
      for (int a = 0; a <= dim; ++a) where += point.l[a] * position_[corners[a]];
      x.push_back(where), p.push_back(pressure_in(static_cast<int>(e), point.l)), weight.push_back(point.weight * volume);
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
template <int order>
[[gnu::always_inline]] inline Vec<dim> Fluid<dim>::velocity_at(int element, const Barycentric<dim>& l, int steps_ago) const {
  double eps = 0.0;
  Vec<dim> flux = Vec<dim>::Zero();
  const auto shape = shapes<dim, order>(l);
  const int* node = &space_.node_of[element * shape_count<dim, order>];
  for (int a = 0; a < shape_count<dim, order>; ++a) {
    eps += shape[a] * eps_[1 + steps_ago][node[a]];
    flux += shape[a] * Eigen::Map<const Vec<dim>>(&x_[steps_ago][space_.first_dof[node[a]]]);
  }
  return flux / eps;
}

template <int dim>
Vec<dim> Fluid<dim>::velocity_in(int element, const Barycentric<dim>& l, int steps_ago) const {
  return velocity_order() == 1 ? velocity_at<1>(element, l, steps_ago) : velocity_at<2>(element, l, steps_ago);
}

template <int dim>
double Fluid<dim>::pressure_in(int element, const Barycentric<dim>& l, int steps_ago) const {
  double p = 0.0;
  for (int a = 0; a <= dim; ++a) p += l[a] * x_[steps_ago][space_.pressure_dof(space_.vertex[mesh_->elements[element][a]])];
  return p;
}

template <int dim>
Vec<dim> Fluid<dim>::pressure_slope(int element, const Geometry<dim>& g, int steps_ago) const {
  Vec<dim> slope = Vec<dim>::Zero();
  for (int a = 0; a <= dim; ++a) slope += x_[steps_ago][space_.pressure_dof(space_.vertex[mesh_->elements[element][a]])] * g.grad_l[a];
  return slope;
}

template <int dim>
auto Fluid<dim>::probe(std::span<const Vec<dim>> x) const -> std::vector<Probe> {
  const Locator<dim> locator(*mesh_, position_);
  std::vector<Probe> found;
  for (const Vec<dim>& point : x) {
    const auto where = point.allFinite() ? locator.find(point) : std::nullopt;
    if (!where) fail("probe: {} m (point {}) is not inside the mesh", place(point), found.size());
    const auto& [element, l] = *where;
    const Geometry<dim> g = geometry<dim>(position_, mesh_->elements[element]);
    found.push_back({velocity_in(element, l), pressure_in(element, l), pressure_slope(element, g)});
  }
  return found;
}

// Calls use(facet, point in its element, area times normal, p_out - p) where the pressure outside is given.
template <int dim>
template <class Use>
void Fluid<dim>::each_open_point(Use&& use, int steps_ago) const {
  const auto& outside = steps_ago == 0 ? outer_pressure_ : outer_before_;
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    if (!conditions_[k].pressure || outside[k].empty()) continue;  // before the first step nothing is known
    std::size_t q = 0;
    for (const int f : facets_of_[k]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
        use(facet, l, Vec<dim>(weight * facet.area), outside[k][q++] - pressure_in(facet.element, l, steps_ago));
      });
    }
  }
}

template <int dim>
double Fluid<dim>::yield_at(const std::array<int, dim + 1>& corners, const Barycentric<dim>& l) const {
  double yield = 0.0;
  for (int a = 0; a <= dim && !yield_.empty(); ++a) yield += l[a] * yield_[corners[a]];
  return yield;
}

template <int dim>
template <int order, class T>
[[gnu::always_inline]] inline auto Fluid<dim>::flow_at(const AtNodes<order, T>& nodes, const Barycentric<dim>& l, const Geometry<dim, T>& g) const -> InElement<T> {
  using Vector = VecOf<dim, T>;
  using Matrix = Mat<dim, T>;
  T eps = 0.0;
  Vector flux = Vector::Zero(), grad_eps = Vector::Zero();
  Matrix slope = Matrix::Zero();
  const auto shape = shapes<dim, order>(l);
  const auto grad = shape_gradients<dim, order, T>(l, g.grad_l);
  for (int a = 0; a < shape_count<dim, order>; ++a) {
    eps += shape[a] * nodes.eps[a], grad_eps += nodes.eps[a] * grad[a];
    flux += shape[a] * nodes.flux[a], slope += nodes.flux[a] * grad[a].transpose();
  }
  const T inv_eps = 1.0 / eps;
  const Vector u = inv_eps * flux;
  slope = (inv_eps * (slope - u * grad_eps.transpose())).eval();
  return {u, properties.viscosity * (slope + slope.transpose()), eps, slope};
}

// One element to a lane, from `first` on; lanes beyond `count` repeat the last.
template <int dim>
template <int order, class T>
[[gnu::always_inline]] inline auto Fluid<dim>::at_nodes(int first, int count) const -> AtNodes<order, T> {
  constexpr int n = shape_count<dim, order>;
  AtNodes<order, T> at;
  for (int lane = 0; lane < lanes_of<T>; ++lane) {
    const std::size_t element = first + std::min(lane, count - 1);
    for (int a = 0; a < n; ++a) {
      const int node = space_.node_of[element * n + a];
      put(at.eps[a], lane, eps_[1][node]), put(at.flux[a], lane, Eigen::Map<const Vec<dim>>(&x_[0][space_.first_dof[node]]));
    }
    for (int a = 0; a <= dim; ++a) {
      const int k = mesh_->elements[element][a];
      put(at.x[a], lane, position_[k]), put(at.mesh_velocity[a], lane, mesh_velocity_[k]);
      put(at.pressure[a], lane, x_[0][space_.pressure_dof(space_.vertex[k])]);
    }
  }
  return at;
}

template <int dim>
auto Fluid<dim>::flow_in(int element, const Barycentric<dim>& l, const Geometry<dim>& g) const -> InElement<> {
  return velocity_order() == 1 ? flow_at<1>(at_nodes<1, double>(element, 1), l, g) : flow_at<2>(at_nodes<2, double>(element, 1), l, g);
}

template <int dim>
auto Fluid<dim>::projected(bool convection) const -> Projected {
  const std::vector<Vec<dim>> none(space_.nodes(), Vec<dim>::Zero());
  Projected sum{none, none, none, convection ? none : std::vector<Vec<dim>>{}};
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) {
    using T = std::conditional_t<order == 1, Lanes, double>;
    using Vector = VecOf<dim, T>;
    const int elements = static_cast<int>(mesh_->elements.size());
    for (int first = 0; first < elements; first += lanes_of<T>) {
      const int count = std::min(lanes_of<T>, elements - first);
      const auto nodes = at_nodes<order, T>(first, count);
      const Geometry<dim, T> g = geometry<dim, T>(nodes.x);
      std::array<Vector, dim + 1> velocity, convected;
      velocity.fill(Vector::Zero()), convected.fill(Vector::Zero());
      Mat<dim, T> stress = Mat<dim, T>::Zero();
      for (const auto& point : quadrature<dim, order>()) {
        const InElement<T> there = flow_at<order, T>(nodes, point.l, g);
        const T weight = point.weight * g.volume;
        for (int a = 0; a <= dim; ++a) velocity[a] += weight * point.l[a] * there.u;
        stress += weight * there.stress;
        if (!convection) continue;
        Vector relative = there.u;
        for (int a = 0; a <= dim; ++a) relative -= point.l[a] * nodes.mesh_velocity[a];
        for (int a = 0; a <= dim; ++a) convected[a] += weight * point.l[a] * there.slope * relative;
      }
      Vector grad_p = Vector::Zero();
      for (int a = 0; a <= dim; ++a) grad_p += nodes.pressure[a] * g.grad_l[a];
      grad_p *= g.volume / (dim + 1.0);
      for (int a = 0; a <= dim; ++a) {
        const Vector viscous = -stress * g.grad_l[a];
        for (int lane = 0; lane < count; ++lane) {
          const int node = space_.vertex[mesh_->elements[first + lane][a]];
          for (int i = 0; i < dim; ++i) {
            sum.velocity[node][i] += get(velocity[a][i], lane), sum.pressure_gradient[node][i] += get(grad_p[i], lane), sum.viscous_force[node][i] += get(viscous[i], lane);
            if (convection) sum.convection[node][i] += get(convected[a][i], lane);
          }
        }
      }
    }
    for (std::size_t f = 0; f < mesh_->facets.size(); ++f) {
      if (mesh_->facet_elements[f][1] >= 0) continue;
      const FacetView<dim> facet(*mesh_, position_, static_cast<int>(f));
      along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
        const Vec<dim> traction = weight * flow_in(facet.element, l, facet.geometry).stress * facet.area;
        for (int a = 0; a <= dim; ++a) sum.viscous_force[space_.vertex[mesh_->elements[facet.element][a]]] += l[a] * traction;
      });
    }
  });
  each_open_point([&](const FacetView<dim>& facet, const Barycentric<dim>& l, const Vec<dim>& area, double step) {
    for (int a = 0; a <= dim; ++a) sum.pressure_gradient[space_.vertex[mesh_->elements[facet.element][a]]] += l[a] * step * area;
  });
  const std::vector<double> volumes = vertex_volumes();
  Projected at_nodes;
  for (const int node : space_.vertex) {
    at_nodes.velocity.push_back(sum.velocity[node] / volumes[node]);
    at_nodes.pressure_gradient.push_back(sum.pressure_gradient[node] / volumes[node]);
    at_nodes.viscous_force.push_back(sum.viscous_force[node] / volumes[node]);
    if (convection) at_nodes.convection.push_back(sum.convection[node] / volumes[node]);
  }
  return at_nodes;
}

template <int dim>
Vec<dim> Fluid<dim>::momentum_residual() const {
  Vec<dim> sum = Vec<dim>::Zero();
  for (int node = 0; node < space_.nodes(); ++node) {
    const Held& held = held_[node];
    Vec<dim> left = held.frame.transpose() * Eigen::Map<const Vec<dim>>(&reaction_at_nodes_[space_.first_dof[node]]);
    for (int axis = 0; axis < held.last; ++axis) left[axis] = 0.0;
    sum += held.frame * left;
  }
  return sum;
}

template <int dim>
Vec<dim> Fluid<dim>::reaction_force() const {
  Vec<dim> sum = Vec<dim>::Zero();
  if (reaction_.empty()) return sum;
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) {
    const auto& rule = quadrature<dim, order>();
    for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
      const Geometry<dim> g = geometry<dim>(position_, mesh_->elements[e]);
      Vec<dim> grad_p = pressure_slope(static_cast<int>(e), g);
      if (reaction_on_change) grad_p -= pressure_slope(static_cast<int>(e), g, 1);
      for (std::size_t q = 0; q < rule.size(); ++q) {
        const Reaction<dim>& r = reaction_[e * rule.size() + q];
        const Vec<dim> u = velocity_at<order>(static_cast<int>(e), rule[q].l, 0), change = u - velocity_at<order>(static_cast<int>(e), rule[q].l, 1);
        sum += rule[q].weight * g.volume * (r.beta_target + r.force - r.beta * (reaction_on_change ? change : u) - r.yield * grad_p - r.inertia * change);
      }
    }
  });
  for (int ago = 0; ago <= reaction_on_change; ++ago)
    each_open_point([&](const FacetView<dim>& facet, const Barycentric<dim>& l, const Vec<dim>& area, double step) {
      sum += (ago == 0 ? -1 : 1) * yield_at(mesh_->elements[facet.element], l) * step * area;
    }, ago);
  return sum;
}

template class Fluid<2>;  // of the members defined here
template class Fluid<3>;

}  // namespace quicksand::fluid
