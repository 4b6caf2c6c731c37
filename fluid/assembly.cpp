// The system of a step or a steady flow: assembled, put into the form that the solver takes, solved.
#include "facet.hpp"
#include "fluid.hpp"

#include "meshes/errors.hpp"

#include <algorithm>
#include <chrono>
#include <numeric>
#include <type_traits>

namespace quicksand::fluid {

using meshes::fail;

namespace {

double seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

}  // namespace

template <int dim>
template <int order, class T>
struct Fluid<dim>::Input : ElementInput<dim, order, T> {
  static constexpr int points = quadrature_count<dim, order>;
  std::array<Reaction<dim, T>, points> reactions;
  std::array<std::array<VecOf<dim, T>, points>, 2> subscales;
  std::array<VecOf<dim, T>, points> advances;
};

// One element to a lane; lanes that are left repeat the last.
template <int dim>
template <int order, class T>
void Fluid<dim>::gather(std::span<const int> elements, Input<order, T>& in) const {
  in.reaction = reaction_.empty() ? nullptr : in.reactions.data();
  in.advance = advance_.empty() ? nullptr : in.advances.data();
  if constexpr (order == 1) in.subscale = {in.subscales[0].data(), in.subscales[1].data()};
  in.reaction_on_change = reaction_on_change;
  in.advection = settings.advection != Advection::none;
  for (int lane = 0; lane < lanes_of<T>; ++lane) {
    const std::size_t element = elements[std::min<std::size_t>(lane, elements.size() - 1)];
    for (int a = 0; a <= dim; ++a) {
      const int k = mesh_->elements[element][a];
      put(in.x[a], lane, position_[k]), put(in.mesh_velocity[a], lane, mesh_velocity_[k]);
      put(in.pressure[a], lane, x_[0][space_.pressure_dof(space_.vertex[k])]);
    }
    for (int a = 0; a < in.n; ++a) {
      const int node = space_.node_of[element * in.n + a], dof = space_.first_dof[node];
      for (int t = 0; t < 3; ++t) put(in.eps[t][a], lane, eps_[t][node]);
      put(in.flux[0][a], lane, Eigen::Map<const Vec<dim>>(&guess_[dof]));
      for (int t = 0; t < 2; ++t) put(in.flux[t + 1][a], lane, Eigen::Map<const Vec<dim>>(&x_[t][dof]));
      if constexpr (order == 1) put(in.eps_slope[a], lane, eps_slope_[node]);
    }
    for (int q = 0; q < in.points; ++q) {
      const std::size_t point = element * in.points + q;
      if (in.reaction) {
        const Reaction<dim>& from = reaction_[point];
        Reaction<dim, T>& to = in.reactions[q];
        put(to.beta, lane, from.beta), put(to.yield, lane, from.yield), put(to.inertia, lane, from.inertia);
        put(to.beta_target, lane, from.beta_target), put(to.force, lane, from.force), put(to.follows, lane, from.follows);
      }
      if (in.advance) put(in.advances[q], lane, advance_[point]);
      if constexpr (order == 1)
        for (int t = 0; t < 2; ++t) put(in.subscales[t][q], lane, subscale_[t][point]);
    }
  }
}

// grad eps at the nodes, the mean over the elements around by volume: of second order inside where they are alike.
template <int dim>
std::vector<Vec<dim>> Fluid<dim>::eps_slopes() const {
  if (velocity_order() != 1) return {};
  std::vector<Vec<dim>> slope(space_.nodes(), Vec<dim>::Zero());
  std::vector<double> volume(space_.nodes(), 0.0);
  for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
    const int* node = &space_.node_of[e * (dim + 1)];
    const Geometry<dim> g = geometry<dim>(position_, mesh_->elements[e]);
    Vec<dim> here = Vec<dim>::Zero();
    for (int a = 0; a <= dim; ++a) here += eps_[0][node[a]] * g.grad_l[a];
    for (int a = 0; a <= dim; ++a) slope[node[a]] += g.volume * here, volume[node[a]] += g.volume;
  }
  for (int k = 0; k < space_.nodes(); ++k) slope[k] /= volume[k];
  return slope;
}

// Of the flow x, at the quadrature points of all elements.
template <int dim>
std::vector<Vec<dim>> Fluid<dim>::subscales(const std::vector<double>& x, const TimeWeights& time) const {
  if (velocity_order() != 1) return {};
  std::vector<Vec<dim>> all(subscale_[0].size());
  constexpr int points = quadrature_count<dim, 1>;
  Input<1, Lanes> in;
  std::vector<int> elements(mesh_->elements.size());
  std::iota(elements.begin(), elements.end(), 0);
  for (std::size_t first = 0; first < elements.size(); first += Lanes::count) {
    const auto here = std::span(elements).subspan(first, std::min<std::size_t>(Lanes::count, elements.size() - first));
    std::array<VecOf<dim, Lanes>, dim + 1> flux;
    std::array<Lanes, dim + 1> p;
    for (std::size_t lane = 0; lane < Lanes::count; ++lane)
      for (int a = 0; a <= dim; ++a) {
        const int node = space_.node_of[here[std::min(lane, here.size() - 1)] * (dim + 1) + a];
        put(flux[a], lane, Eigen::Map<const Vec<dim>>(&x[space_.first_dof[node]])), put(p[a], lane, x[space_.pressure_dof(node)]);
      }
    std::array<VecOf<dim, Lanes>, points> found;
    if (residual_.empty()) gather(here, in), element_subscale<dim, Lanes>(in, properties, time, flux, p, found.data());
    else
      for (int q = 0; q < points; ++q) found[q] = residual_[first / Lanes::count * points + q].subscale(flux, p);
    for (std::size_t lane = 0; lane < here.size(); ++lane)
      for (int q = 0; q < points; ++q)
        for (int i = 0; i < dim; ++i) all[(first + lane) * points + q][i] = get(found[q][i], lane);
  }
  return all;
}

template <int dim>
template <int order, class T>
void Fluid<dim>::scatter(int local, int lane, const ElementSystem<dim, order, T>& system) {
  constexpr int n = shape_count<dim, order>;
  const int* node = &space_.node_of[space_.elements[local] * n];
  const int* place = &space_.place[static_cast<std::size_t>(local) * n * n];
  for (int a = 0; a < n; ++a) {
    if (!space_.mine(node[a])) continue;
    const int row = space_.first_dof[node[a]] - space_.begin, from = dof_of<dim>(a), rows = a <= dim ? dim + 1 : dim;
    for (int i = 0; i < rows; ++i) {
      b_[row + i] += get(system.b[from + i], lane);
      double* in_row = &values_[space_.row_start[row + i]];
      for (int b = 0; b < n; ++b)
        for (int j = 0; j < (b <= dim ? dim + 1 : dim); ++j) in_row[place[a * n + b] + j] += get(system.a(from + i, dof_of<dim>(b) + j), lane);
    }
  }
}

template <int dim>
template <int order>
void Fluid<dim>::assemble(const TimeWeights& time, bool newton) {
  values_.assign(space_.column.size(), 0.0);
  b_.assign(space_.end - space_.begin, 0.0);
  using T = std::conditional_t<order == 1, Lanes, double>;
  ElementSystem<dim, order, T> system;
  Input<order, T> in;
  // Not where ranks assemble their own elements: all know all subscales, of the same code, to the last bit.
  const bool keep = order == 1 && !newton && ranks() == 1;
  const std::span elements(space_.elements);
  residual_.resize(keep ? (elements.size() + Lanes::count - 1) / Lanes::count * in.points : 0);
  for (std::size_t first = 0; first < elements.size(); first += lanes_of<T>) {
    const auto here = elements.subspan(first, std::min<std::size_t>(lanes_of<T>, elements.size() - first));
    gather(here, in);
    in.newton = newton;
    Residual<dim, T>* residual = nullptr;
    if constexpr (order == 1) residual = keep ? &residual_[first / Lanes::count * in.points] : nullptr;
    element_system<dim, order, T>(in, properties, time, system, residual);
    for (std::size_t lane = 0; lane < here.size(); ++lane) scatter(static_cast<int>(first + lane), static_cast<int>(lane), system);
  }
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node) && space_.mine(node))
      b_[space_.pressure_dof(node) - space_.begin] -= rate(time, eps_change_[0][node], eps_change_[1][node]);
  add_boundaries<order>();
}

// Where the pressure is given: eps (p_out - p) n . w, so that the traction is -p_out n; and where fluid enters there,
// -rho min((U - eps w) . n, 0) (u - u_out) . w: it has the velocity of what is outside, and brings no other energy in. At an outflow
// -p n + eta grad u n replaces the traction, so that a parallel flow leaves as it is: Heywood, Rannacher and Turek, IJNMF 22 (1996).
template <int dim>
template <int order>
void Fluid<dim>::add_boundaries() {
  constexpr int n = shape_count<dim, order>;
  for (std::size_t k = 0; k < conditions_.size(); ++k) {
    if (!conditions_[k].pressure) continue;
    std::size_t q = 0;
    for (const int f : facets_of_[k]) {
      const FacetView<dim> facet(*mesh_, position_, f);
      const int local = space_.local_of[facet.element];
      if (local < 0) {
        q += quadrature<dim - 1, 2>().size();
        continue;
      }
      Input<order, double> in;
      gather(std::span(&facet.element, 1), in);
      ElementSystem<dim, order> system;
      system.a.setZero(), system.b.setZero();
      along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
        const auto shape = shapes<dim, order>(l);
        const auto grad = shape_gradients<dim, order>(l, facet.geometry.grad_l);
        const Vec<dim> area = weight * facet.area;
        double eps = 0.0;
        const double yield = yield_at(mesh_->elements[facet.element], l);
        Vec<dim> flux = Vec<dim>::Zero(), grad_eps = Vec<dim>::Zero(), mesh_velocity = Vec<dim>::Zero();
        for (int a = 0; a < n; ++a) eps += shape[a] * in.eps[0][a], flux += shape[a] * in.flux[0][a], grad_eps += in.eps[0][a] * grad[a];
        for (int a = 0; a <= dim; ++a) mesh_velocity += l[a] * in.mesh_velocity[a];
        // Of a reaction on change, what was given before.
        double before = 0.0;
        if (reaction_on_change) before = yield * (outer_before_[k][q] - pressure_in(facet.element, l));
        const double enters = in.advection ? properties.density * std::max(-(flux - eps * mesh_velocity).dot(area), 0.0) : 0.0;
        for (int a = 0; a < n; ++a)
          for (int i = 0; i < dim; ++i) {
            const int row = dof_of<dim>(a) + i;
            system.b[row] += shape[a] * (enters * outer_velocity_[k][q][i] - ((eps + yield) * outer_pressure_[k][q] - before) * area[i]);
            for (int b = 0; b <= dim; ++b) system.a(row, dof_of<dim>(b) + dim) -= shape[a] * (eps + yield) * l[b] * area[i];
            for (int b = 0; b < n; ++b) {
              system.a(row, dof_of<dim>(b) + i) += enters * shape[a] * shape[b] / eps;
              if (conditions_[k].kind != Kind::outflow) continue;
              const double slope = grad[b][i] - shape[b] / eps * grad_eps[i];  // of U/eps, times eps
              for (int j = 0; j < dim; ++j) system.a(row, dof_of<dim>(b) + j) -= properties.viscosity * shape[a] * slope * area[j];
            }
          }
        ++q;
      });
      scatter(local, 0, system);
    }
  }
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
  with_order(velocity_order(), [&]<int order>(std::integral_constant<int, order>) { assemble<order>(time, newton); });
  const double assembled = seconds();
  report.assembly_time += assembled - begun;
  const int own = space_.end - space_.begin;
  std::vector<double> x = start;
  for (int node = 0; node < space_.nodes(); ++node) {
    const Held& held = held_[node];
    if (held.last == 0) continue;
    Eigen::Map<Vec<dim>> flux(&x[space_.first_dof[node]]);
    Vec<dim> along = held.frame.transpose() * flux;
    for (int axis = 0; axis < held.last; ++axis) along[axis] = held.value[axis];
    flux = held.frame * along;
  }
  const int pinned = has_pressure_reference() ? -1 : space_.pressure_dof(space_.vertex[mesh_->elements[0][0]]);
  std::vector<double> missing = times_matrix(x), values = values_;
  for (int r = 0; r < own; ++r) missing[r] = b_[r] - missing[r];
  if (pinned >= 0) spread_surplus(function, x, time, missing);

  const auto& is_pressure = space_.is_pressure;
  std::array<double, 2> size{};  // of the momentum's diagonal, and of what pressures do to it
  for (int r = 0; r < own; ++r) {
    if (is_pressure[space_.begin + r]) continue;
    double of_row = 0.0;
    for (int k = space_.row_start[r]; k < space_.row_start[r + 1]; ++k)
      if (space_.column[k] == space_.begin + r) size[0] += std::abs(values[k]);
      else if (is_pressure[space_.column[k]]) of_row += std::abs(values[k]);
    size[1] += of_row;
  }
  sum_over_ranks(size);
  const double pressure_scale = pressure_scale_ = size[0] / size[1];
  std::vector<double> scale(space_.dofs());
  for (int k = 0; k < space_.dofs(); ++k) scale[k] = is_pressure[k] ? pressure_scale : 1.0;
  const bool any_frame = std::find(has_frame_.begin(), has_frame_.end(), true) != has_frame_.end();
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
      for (int k = 0; k < length && any_frame; ++k) {
        const int other = space_.node_at[columns[k]];
        if (other < 0 || !has_frame_[other]) continue;
        Eigen::Map<Eigen::Matrix<double, 1, dim>> block(&rows[k]);
        block = (block * held_[other].frame).eval();
      }
      for (int k = 0; k < length; ++k) rows[k] *= scale[row] * scale[columns[k]];
      missing[first + i] *= scale[row];
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
                                   steps_ + 1, time_, finite || !linear.converged ? linear.reason : "values not finite", linear.iterations, linear.residual,
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
    fail("{}: no boundary lets fluid leave, but {:.6g} flow in and the pores grow by {:.6g} (2D: m^2/s, 3D: m^3/s); set an outflow, or velocities that add up", function,
         balance.net_inflow, balance.pore_volume_rate);
  const std::vector<double> share = vertex_volumes();
  const double volume = std::accumulate(share.begin(), share.end(), 0.0);
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node) && space_.mine(node)) missing[space_.pressure_dof(node) - space_.begin] -= surplus * share[node] / volume;
}

// int q over the mesh for each q of a vertex [m^dim].
template <int dim>
std::vector<double> Fluid<dim>::vertex_volumes() const {
  std::vector<double> volumes(space_.nodes(), 0.0);
  for (const auto& element : mesh_->elements) {
    const double share = geometry<dim>(position_, element).volume / (dim + 1);
    for (const int k : element) volumes[space_.vertex[k]] += share;
  }
  return volumes;
}

template <int dim>
double Fluid<dim>::mean_pressure(const std::vector<double>& x) const {
  const std::vector<double> volumes = vertex_volumes();
  double sum = 0.0;
  for (int node = 0; node < space_.nodes(); ++node)
    if (space_.is_vertex(node)) sum += volumes[node] * x[space_.pressure_dof(node)];
  return sum / std::accumulate(volumes.begin(), volumes.end(), 0.0);
}

template class Fluid<2>;  // of the members defined here
template class Fluid<3>;

}  // namespace quicksand::fluid
