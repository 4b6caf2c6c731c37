// Void fraction, velocity and pressure in and out; steps in time, steady states; the state.
#include "fluid.hpp"

#include "meshes/errors.hpp"

#include <algorithm>

namespace quicksand::fluid {

using meshes::fail;
using meshes::place;

namespace {

// Linear systems within Newton's iteration: what they leave is taken up by the next one. Tighter ones cost more than they save; but the first of a
// steady flow, where a hydrostatic pressure may be all there is, must not leave velocities of a thousandth of it.
constexpr double newton_forcing = 1e-3;

}  // namespace

template <int dim>
Fluid<dim>::Fluid(std::shared_ptr<const Mesh<dim>> mesh, int order, Properties<dim> the_properties)
    : properties(the_properties), mesh_(mesh), space_(mesh, order, rank(), ranks()) {
  if (!(properties.density >= 0 && std::isfinite(properties.density)))
    fail("Fluid: density must be >= 0 kg/m^3 and finite, got {}", properties.density);
  if (!(properties.viscosity > 0 && std::isfinite(properties.viscosity)))
    fail("Fluid: viscosity must be > 0 Pa s and finite, got {}", properties.viscosity);
  conditions_.resize(mesh_->boundary_names.size());
  position_ = old_position_ = mesh_->nodes;
  mesh_velocity_.assign(mesh_->nodes.size(), Vec<dim>::Zero());
  eps_.fill(std::vector<double>(space_.nodes(), 1.0));
  x_.fill(std::vector<double>(space_.dofs(), 0.0));
  guess_ = x_[0];
  if (order == 1) subscale_.fill(std::vector<Vec<dim>>(mesh_->elements.size() * quadrature<dim, 1>().size(), Vec<dim>::Zero()));
  eps_change_.fill(std::vector<double>(space_.nodes(), 0.0));
  held_.resize(space_.nodes());
  has_frame_.assign(space_.nodes(), false);
  facets_of_.resize(conditions_.size());
  for (std::size_t f = 0; f < mesh_->facets.size(); ++f) facets_of_[mesh_->boundary[f]].push_back(static_cast<int>(f));
  motion_.resize(conditions_.size());
  swept_.fill(std::vector<double>(conditions_.size(), 0.0));
  pore_volume_.fill(pore_volume(eps_[0]));
  outer_pressure_.resize(conditions_.size());
  outer_velocity_.resize(conditions_.size());
}

// Void fraction, velocity, pressure: given at the nodes of the mesh, or with order 2 at all nodes.
template <int dim>
void Fluid<dim>::set_void_fraction(std::span<const double> eps) {
  const std::size_t vertices = mesh_->nodes.size(), all = nodes().size();
  if (eps.size() != vertices && eps.size() != all)
    fail("set_void_fraction: must have one value for each of {} nodes of the mesh{}, got {}", vertices,
         all == vertices ? "" : fmt::format(" or of all {} nodes", all), eps.size());
  for (std::size_t k = 0; k < eps.size(); ++k)
    if (!(eps[k] > 0 && eps[k] <= 1))
      fail("set_void_fraction: must be in (0, 1], got {} at {}", eps[k], place(k < vertices ? position_[k] : nodes()[k]));
  for (std::size_t k = 0; k < vertices; ++k)
    if (mesh_->master[k] == static_cast<int>(k)) eps_[0][space_.vertex[k]] = eps[k];
  std::size_t k = vertices;
  for (int node = 0; node < space_.nodes(); ++node) {
    if (space_.is_vertex(node)) continue;
    const auto [a, b] = space_.between[node];
    eps_[0][node] = eps.size() == all ? eps[k++] : 0.5 * (eps_[0][space_.vertex[a]] + eps_[0][space_.vertex[b]]);
  }
  if (!eps_started_) {  // the first to be set is that of the start as well, whose velocity stays
    for (int node = 0; node < space_.nodes(); ++node)
      for (auto& x : x_) Eigen::Map<Vec<dim>>(&x[space_.first_dof[node]]) *= eps_[0][node] / eps_[1][node];
    eps_[2] = eps_[1] = eps_[0], pore_volume_.fill(pore_volume(eps_[0]));
  }
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
  if (u.size() != number.size()) fail("set_velocity: must have one value for each of {} nodes, got {}", number.size(), u.size());
  for (std::size_t k = 0; k < u.size(); ++k) {
    if (!u[k].allFinite()) fail("set_velocity: must be finite, got {} m/s at node {}", place(u[k]), k);
    Eigen::Map<Vec<dim>> flux(&x_[0][space_.first_dof[number[k]]]);
    flux = eps_[1][number[k]] * u[k];
  }
  x_[1] = x_[0], steps_ = 0;
  for (auto& subscale : subscale_) std::fill(subscale.begin(), subscale.end(), Vec<dim>::Zero());
}

template <int dim>
void Fluid<dim>::set_pressure(std::span<const double> p) {
  if (p.size() != space_.vertex.size()) fail("set_pressure: must have one value for each of {} nodes of the mesh, got {}", space_.vertex.size(), p.size());
  for (std::size_t k = 0; k < p.size(); ++k) {
    if (!std::isfinite(p[k])) fail("set_pressure: must be finite, got {} Pa at node {}", p[k], k);
    x_[0][space_.pressure_dof(space_.vertex[k])] = p[k];
  }
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::quadrature_points() const {
  std::vector<Vec<dim>> x;
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) {
    for (const auto& element : mesh_->elements)
      for (const auto& point : quadrature<dim, order>()) {
        x.push_back(Vec<dim>::Zero());
        for (int a = 0; a <= dim; ++a) x.back() += point.l[a] * position_[element[a]];
      }
  });
  return x;
}

template <int dim>
std::vector<double> Fluid<dim>::quadrature_weights() const {
  std::vector<double> weights;
  each_point([&](const auto&, const int*, double weight) { weights.push_back(weight); });
  return weights;
}

template <int dim>
void Fluid<dim>::set_reaction(std::vector<Reaction<dim>> reaction) {
  const std::size_t points = mesh_->elements.size() * with_order(velocity_order(), []<int order>(std::integral_constant<int, order>) { return quadrature<dim, order>().size(); });
  if (!reaction.empty() && reaction.size() != points && reaction.size() != mesh_->nodes.size())
    fail("set_reaction: must have one value for each of {} quadrature points, or of {} nodes of the mesh, got {}", points, mesh_->nodes.size(), reaction.size());
  for (std::size_t k = 0; k < reaction.size(); ++k)
    if (!(reaction[k].beta >= 0 && std::isfinite(reaction[k].beta)) || !reaction[k].beta_target.allFinite() || !reaction[k].force.allFinite() || !(reaction[k].yield >= 0) || !(reaction[k].inertia >= 0))
      fail("set_reaction: beta must be >= 0 kg/(m^3 s), target and force finite, yield and inertia >= 0, got beta = {}, yield = {}, inertia = {} at point {}", reaction[k].beta, reaction[k].yield, reaction[k].inertia, k);
  yield_.clear();
  if (reaction.size() != mesh_->nodes.size()) {
    reaction_ = std::move(reaction);
    return;
  }
  for (const Reaction<dim>& at_node : reaction) yield_.push_back(at_node.yield);
  reaction_.clear();
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) {
    for (const auto& element : mesh_->elements)
      for (const auto& point : quadrature<dim, order>()) {
        Reaction<dim>& sum = reaction_.emplace_back();
        for (int a = 0; a <= dim; ++a) {
          const Reaction<dim>& at_node = reaction[element[a]];
          sum.beta += point.l[a] * at_node.beta, sum.yield += point.l[a] * at_node.yield;
          sum.beta_target += point.l[a] * at_node.beta_target, sum.force += point.l[a] * at_node.force;
          sum.follows += point.l[a] * at_node.follows, sum.inertia += point.l[a] * at_node.inertia;
        }
      }
  });
}

// Calls use(shapes, velocity nodes, weight) at the quadrature points of all elements.
template <int dim>
template <class Use>
void Fluid<dim>::each_point(Use&& use) const {
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) {
    for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
      const double volume = geometry<dim>(position_, mesh_->elements[e]).volume;
      for (const auto& point : quadrature<dim, order>()) use(shapes<dim, order>(point.l), &space_.node_of[e * space_.per_element], point.weight * volume);
    }
  });
}

template <int dim>
Vec<dim> Fluid<dim>::mesh_velocity_at(int node) const {
  return 0.5 * (mesh_velocity_[space_.between[node][0]] + mesh_velocity_[space_.between[node][1]]);
}

// Changes of flux and pressure relative to their sizes, the larger of the two. What is as small as rounding makes it beside the other, velocities
// of a fluid at rest or the pressure of a uniform flow, counts for nothing: 1e-4 of it is rounding times 1e3 at a tolerance of 1e-9.
template <int dim>
double Fluid<dim>::relative_change(const std::vector<double>& x, const std::vector<double>& before) const {
  std::array<double, 2> change{}, size{};
  for (int node = 0; node < space_.nodes(); ++node)
    for (int i = 0; i < space_.dofs_at(node); ++i) {
      const double scale = i == dim ? 1.0 / pressure_scale_ : 1.0, now = scale * x[space_.first_dof[node] + i], was = scale * before[space_.first_dof[node] + i];
      change[i == dim] += (now - was) * (now - was), size[i == dim] += now * now;
    }
  double worst = 0.0;
  for (int k = 0; k < 2; ++k)
    if (size[k] > 0) worst = std::max(worst, std::sqrt(change[k] / std::max(size[k], 1e-8 * size[1 - k])));
  return worst;
}

template <int dim>
Report Fluid<dim>::step(double dt) {
  if (!(dt > 0 && std::isfinite(dt))) fail("step: dt must be > 0 s and finite, got {}", dt);
  check_conditions("step");
  Report report;
  const bool second = settings.scheme == Scheme::bdf2 && steps_ > 0;
  const double r = second ? dt / dt_ : 0.0;
  const TimeWeights time = second ? TimeWeights{(1 + 2 * r) / (1 + r) / dt, -(1 + r) / dt, r * r / (1 + r) / dt} : TimeWeights{1 / dt, -1 / dt, 0.0};
  for (int k = 0; k < space_.dofs(); ++k) guess_[k] = x_[0][k] + (second ? r * (x_[0][k] - x_[1][k]) : 0.0);
  if (moved_for_ == 0) move(dt);
  if (moved_for_ != dt) fail("step: the mesh was moved for a step of {} s, got {}", moved_for_, dt);
  std::vector<double> x;
  try {
    keep_advance();
    for (Vec<dim>& a : advance_) a /= dt;
    pore_volume_[0] = pore_volume(eps_[0]);
    for (std::size_t k = 0; k < conditions_.size(); ++k) swept_[0][k] = swept(static_cast<int>(k), dt);
    eps_change_[0] = eps_change(dt);
    eps_slope_ = eps_slopes();
    x = solve_step(time_ + dt, time, report);
    account(report, x, time);
    judge_elements(report, x, dt);
  } catch (...) {
    for (Vec<dim>& a : advance_) a *= dt;
    undo_move();
    throw;
  }
  moved_for_ = 0.0;
  if (!advance_.empty()) advance_ = advances(x, dt);
  std::vector<Vec<dim>> subscale = subscales(x, time);
  subscale_[1].swap(subscale_[0]), subscale_[0].swap(subscale);
  x_[1].swap(x_[0]), x_[0].swap(x);
  eps_[2] = eps_[1], eps_[1] = eps_[0];
  pore_volume_[2] = pore_volume_[1], pore_volume_[1] = pore_volume_[0];
  eps_change_[1] = eps_change_[0];
  swept_[2] = swept_[1], swept_[1] = swept_[0];
  time_weights_ = time, time_ += dt, dt_ = dt;
  ++steps_;
  return report;
}

template <int dim>
void Fluid<dim>::move(double dt) {
  if (moved_for_ != 0) undo_move();
  old_position_ = position_, old_mesh_velocity_ = mesh_velocity_;
  moved_for_ = dt;
  try {
    move_mesh(time_ + dt, dt);
  } catch (...) {
    undo_move();
    throw;
  }
}

template <int dim>
void Fluid<dim>::undo_move() {
  position_ = old_position_, mesh_velocity_ = old_mesh_velocity_;
  moved_for_ = 0.0;
}

template <int dim>
void Fluid<dim>::keep_advance() {
  if (!grains_follow) advance_.clear();
  else if (advance_.empty()) advance_.assign(quadrature_weights().size(), Vec<dim>::Zero());
}

// dt f (u - u before) of the flow x at quadrature points.
template <int dim>
std::vector<Vec<dim>> Fluid<dim>::advances(const std::vector<double>& x, double dt) const {
  std::vector<Vec<dim>> all;
  each_point([&](const auto& shape, const int* node, double) {
    std::array<double, 2> eps{};
    std::array<Vec<dim>, 2> flux{Vec<dim>::Zero(), Vec<dim>::Zero()};
    for (std::size_t a = 0; a < shape.size(); ++a)
      for (int t = 0; t < 2; ++t) {
        eps[t] += shape[a] * eps_[t][node[a]];
        flux[t] += shape[a] * Eigen::Map<const Vec<dim>>(&(t == 0 ? x : x_[0])[space_.first_dof[node[a]]]);
      }
    const Vec<dim> follows = reaction_.empty() ? Vec<dim>(Vec<dim>::Zero()) : reaction_[all.size()].follows;
    all.push_back(dt * follows.cwiseProduct(flux[0] / eps[0] - flux[1] / eps[1]));
  });
  return all;
}

template <int dim>
std::vector<double> Fluid<dim>::solve_step(double t, const TimeWeights& time, Report& report) {
  hold(t);
  outer_before_ = outer_pressure_;
  evaluate_outside(t);
  for (std::size_t k = 0; k < conditions_.size(); ++k)
    if (outer_before_[k].empty()) outer_before_[k] = outer_pressure_[k];
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
  keep_advance();
  double steps = steps_, started = eps_started_;
  for (double* one : {&time_, &dt_, &steps, &started}) visit(std::span(one, 1));
  steps_ = static_cast<int>(steps), eps_started_ = started != 0.0;
  for (auto* many : {&x_[0], &x_[1], &eps_[0], &eps_[1], &eps_[2], &eps_change_[0], &eps_change_[1], &swept_[0], &swept_[1], &swept_[2]}) visit(std::span(*many));
  visit(std::span(pore_volume_));
  visit(std::span(time_weights_));
  for (auto* points : {&position_, &mesh_velocity_, &subscale_[0], &subscale_[1], &advance_})
    if (!points->empty()) visit(std::span(points->data()->data(), dim * points->size()));
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
std::vector<double> Fluid<dim>::parts() {
  std::vector<double> all;
  each_part([&](std::span<double> part) { all.insert(all.end(), part.begin(), part.end()); });
  return all;
}

template <int dim>
void Fluid<dim>::set_parts(std::span<const double> parts) {
  std::size_t at = 0;
  each_part([&](std::span<double> part) {
    std::copy_n(parts.begin() + at, part.size(), part.begin());
    at += part.size();
  });
}

template <int dim>
void Fluid<dim>::mark() {
  marked_ = parts(), marked_move_ = moved_for_, marked_outside_ = outer_pressure_;
}

template <int dim>
void Fluid<dim>::back() {
  set_parts(marked_), moved_for_ = marked_move_, outer_pressure_ = marked_outside_;
}

template <int dim>
std::vector<double> Fluid<dim>::state() {
  std::vector<double> all = parts();
  all.insert(all.begin(), fingerprint(space_));
  if (solver_) solver_->forget();
  return all;
}

template <int dim>
void Fluid<dim>::restore(std::span<const double> state) {
  std::size_t size = 1;
  each_part([&](std::span<double> part) { size += part.size(); });
  if (state.empty() || state[0] != fingerprint(space_) || state.size() != size)
    fail("restore: the state is of another mesh or element ({} numbers where this one has {}); make the fluid on the mesh it was saved with", state.size(), size);
  set_parts(state.subspan(1));
  old_position_ = position_, moved_for_ = 0.0;
  evaluate_outside(time_);  // for projected()
  if (solver_) solver_->forget();
}

template <int dim>
void Fluid<dim>::throw_newton(const char* function, const Report& report) const {
  throw NotConverged(fmt::format("{}: Newton's iteration for the advection in step {}, t = {:.6g} s, still changes by {:.1e} after {} iterations. Likely causes: a flow that has no "
                                 "steady state or is far from it (lower the Reynolds number in stages, or step in time), a time step too large{}", function, steps_ + 1, time_, report.change,
                                 report.newton_iterations,
                                 report.change < 1e-5 ? ", or rounding: pressures or reactions so large that newton_tolerance cannot be met" : ""));
}

// Stokes' flow to start from where there is nothing, two iterations with the advection lagged, then Newton's.
template <int dim>
Report Fluid<dim>::solve_steady() {
  check_conditions("solve_steady");
  Report report;
  const TimeWeights time{};
  for (auto* none : {&eps_change_[0], &swept_[0], &swept_[1]}) std::fill(none->begin(), none->end(), 0.0);
  std::fill(mesh_velocity_.begin(), mesh_velocity_.end(), Vec<dim>::Zero());
  eps_[2] = eps_[1] = eps_[0];
  pore_volume_.fill(pore_volume(eps_[0]));
  eps_slope_ = eps_slopes();
  hold(time_);
  evaluate_outside(time_);
  std::vector<double> x = x_[0];
  const bool linear = settings.advection == Advection::none || properties.density == 0;
  for (int k = 0;; ++k) {
    guess_ = x;
    std::vector<double> next = solve("solve_steady", x, time, !linear && k > 2, linear || k == 0 ? 0.0 : newton_forcing, report);
    ++report.newton_iterations;
    report.change = relative_change(next, x);
    x.swap(next);
    if (linear || report.change < settings.newton_tolerance) break;
    if (k == settings.max_newton) throw_newton("solve_steady", report);
  }
  account(report, x, time);
  judge_elements(report, x, 0.0);
  subscale_[1] = subscale_[0] = subscales(x, time);
  x_[1] = x_[0] = x;
  time_weights_ = time;
  steps_ = 0;
  return report;
}

template class Fluid<2>;  // of the members defined here
template class Fluid<3>;

}  // namespace quicksand::fluid
