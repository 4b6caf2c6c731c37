#include "coupling.hpp"

#include "meshes/errors.hpp"

#include <chrono>

namespace quicksand::coupling {

using meshes::fail;
using meshes::place;

namespace {

// Vectors as long as registers are, or a multiple of it: sums over splines are of whole ones.
template <int n>
using Padded = Eigen::Matrix<double, (n + 3) / 4 * 4, 1>;

double seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

}  // namespace

DragLaw of_each(Eight (*law)(const Suspensions&)) {
  return [law](std::span<const Suspension> s, std::span<double> gamma) {
    for (std::size_t from = 0; from < s.size(); from += 8) {
      const std::size_t count = std::min<std::size_t>(8, s.size() - from);
      std::array<Suspension, 8> last;
      const Suspension* at = &s[from];
      if (count < 8) {
        last.fill(s.back()), std::copy_n(at, count, last.begin());
        at = last.data();
      }
      Suspensions eight;
      for (int k = 0; k < 8; ++k) eight.diameter[k] = at[k].diameter;
      for (int k = 0; k < 8; ++k) eight.eps[k] = at[k].eps;
      for (int k = 0; k < 8; ++k) eight.slip[k] = at[k].slip;
      for (int k = 0; k < 8; ++k) eight.density[k] = at[k].density;
      for (int k = 0; k < 8; ++k) eight.viscosity[k] = at[k].viscosity;
      const Eight here = law(eight);
      std::copy_n(here.data(), count, gamma.begin() + from);
    }
  };
}

template <int dim>
Coupling<dim>::Coupling(Simulation<dim>& grains, fluid::Fluid<dim>& fluid, Settings the_settings)
    : settings(std::move(the_settings)), grains_(grains), fluid_(fluid), mesh_(fluid.space().mesh), walker_(mesh_, grains.box().period),
      kernel_(mesh_, settings.kernel, settings.kernel_radius, grains.box().period), outlet_(mesh_->boundary_names.size(), false) {
  if (!(settings.added_mass >= 0 && std::isfinite(settings.added_mass))) fail("Coupling: added_mass must be >= 0 and finite, got {}", settings.added_mass);
  const Vec<dim>& period = grains.box().period;
  Vec<dim> low = mesh_->nodes[0], high = low, shift = Vec<dim>::Zero();
  for (const Vec<dim>& x : mesh_->nodes) low = low.cwiseMin(x), high = high.cwiseMax(x);
  for (std::size_t k = 0; k < mesh_->nodes.size(); ++k) shift = shift.cwiseMax((mesh_->nodes[k] - mesh_->nodes[mesh_->master[k]]).cwiseAbs());
  for (int k = 0; k < dim; ++k) {
    if ((period[k] > 0) != (shift[k] > 1e-9 * (high[k] - low[k])) || std::abs(period[k] - shift[k]) > 1e-9 * period[k])
      fail("Coupling: the grains' period along axis {} is {} m, that of the mesh {} m (0: not periodic); they must be the same", k, period[k], shift[k]);
    if (period[k] > 0 && std::abs(high[k] - low[k] - period[k]) > 1e-9 * period[k])
      fail("Coupling: the mesh must extend over one period along axis {}, {} m, but does over {}", k, period[k], high[k] - low[k]);
  }
  settings.undisturbed &= settings.fluid_moves;  // of a fluid that feels no grain the flow is undisturbed
  if (settings.undisturbed && dim == 2) fail("Coupling: undisturbed is of spheres: the wake of a disc in slow flow is as wide as the domain");
  if (settings.fluid_moves) {
    fluid_.settings.scheme = fluid::Scheme::backward_euler;
    fluid_.reaction_on_change = true;
    // Drag makes the equations easy, elements of several grains make few of them: of 1200 in 2D, ILU takes a third of the time of MUMPS, whose factors
    // have to be new in most steps. What it leaves open is momentum lost.
    if (!fluid_.settings.linear) {
      const bool ilu = fluid_.velocity_order() == 1 && (dim == 3 || fluid_.space().dofs() < 20000);
      fluid_.settings.linear = fluid::LinearSettings{.method = ilu ? fluid::Method::ilu : dim == 2 ? fluid::Method::direct : fluid::Method::fieldsplit, .fill_levels = dim == 2};
    }
    fluid_.settings.linear->tolerance = 1e-13;
    fluid_.grains_follow = settings.grains_move;
  }
}

template <int dim>
void Coupling<dim>::follow(const std::string& boundary, int wall) {
  if (wall < 0 || wall >= static_cast<int>(grains_.walls().size())) fail("follow: there is no wall {}, but {}", wall, grains_.walls().size());
  auto follow = std::make_shared<Follow>(Follow{wall, grains_.walls()[wall].point, Vec<dim>::Zero()});
  fluid_.move_boundary(boundary, [follow](std::span<const Vec<dim>> x, double) { return std::vector<Vec<dim>>(x.size(), follow->velocity); });
  follows_[boundary] = std::move(follow);
}

template <int dim>
void Coupling<dim>::set_outlet(const std::string& boundary) {
  outlet_[meshes::boundary_number(*mesh_, boundary, "set_outlet")] = true;
}

template <int dim>
void Coupling<dim>::take_grains() {
  const std::size_t n = grains_.count();
  x_.resize(n), v_.resize(n), r_.resize(n), m_.resize(n);
  grains_.each([&](int id, const Grains<dim>& g, int k) {
    x_[id] = walker_.wrap(g.x[k]), v_[id] = g.body[k].v;
    r_[id] = g.r[k], m_[id] = 1.0 / g.body[k].inv_m;
  });
  carry_.resize(n, Vec<dim>::Zero()), free_.resize(n, false), follows_fluid_.resize(n, Vec<dim>::Zero()), place_.resize(n), drag_.resize(n), answer_.resize(n);  // new grains
}

// Where grains are; those that have left through an outlet are taken out.
template <int dim>
void Coupling<dim>::locate() {
  std::vector<int> gone;
  for (std::size_t i = 0; i < x_.size(); ++i) {
    walker_.find(x_[i], place_[i]);
    if (place_[i].left_by < 0) continue;
    if (!outlet_[place_[i].left_by])
      fail("Coupling: grain {} at {} m is outside the mesh, beyond boundary \"{}\". Grains need a wall there, or call outlet(\"{}\") to let them go", i, place(x_[i]),
           mesh_->boundary_names[place_[i].left_by], mesh_->boundary_names[place_[i].left_by]);
    gone.push_back(static_cast<int>(i));
  }
  if (gone.empty()) return;
  grains_.remove(gone);
  removed_ += static_cast<int>(gone.size());
  auto keep = [&](auto& values) {
    std::size_t to = 0, next = 0;
    for (std::size_t i = 0; i < values.size(); ++i)
      if (next < gone.size() && gone[next] == static_cast<int>(i)) ++next;
      else values[to++] = values[i];
    values.resize(to);
  };
  keep(x_), keep(v_), keep(r_), keep(m_), keep(carry_), keep(free_), keep(follows_fluid_), keep(place_), keep(drag_), keep(answer_);
}

// What the flow is and does where each grain is.
template <int dim>
void Coupling<dim>::tell_grains() {
  using Values = Padded<3 * dim>;
  std::vector<Values> at_nodes(mesh_->nodes.size(), Values::Zero());
  for (std::size_t k = 0; k < at_nodes.size(); ++k) at_nodes[k].template head<3 * dim>() << flow_.velocity[k], flow_.pressure_gradient[k], flow_.viscous_force[k];
  const std::vector<Values> at_carriers = kernel_.to_carriers(at_nodes, Values(Values::Zero()));
  const std::size_t n = x_.size();
  u_.resize(n), u_mean_.resize(n), grad_p_.resize(n), stress_force_.resize(n), eps_at_.resize(n);
  for (std::size_t i = 0; i < n; ++i) {
    const Values here = kernel_.at_grain(static_cast<int>(i), at_carriers);
    u_mean_[i] = here.template head<dim>(), grad_p_[i] = here.template segment<dim>(dim);
    stress_force_[i] = solid_volume_of(static_cast<int>(i)) * (here.template segment<dim>(2 * dim) - grad_p_[i]);
    u_[i] = fluid_.velocity_in(place_[i].element, place_[i].l);
    eps_at_[i] = 0.0;
    for (int a = 0; a <= dim; ++a) eps_at_[i] += place_[i].l[a] * eps_[mesh_->elements[place_[i].element][a]];
  }
}

// (1 + k/n)^-n
template <int dim>
double Coupling<dim>::left_of(double k) const {
  return sub_steps_ == 1 ? 1 / (1 + k) : std::exp(-sub_steps_ * std::log1p(k / sub_steps_));
}

// c of the text above.
template <int dim>
double Coupling<dim>::share_of(double k) const {
  if (sub_steps_ == 1) return k / (1 + k);
  if (k < 1e-4) return 0.5 * k * (1 + 1.0 / sub_steps_);  // to rounding, where the formula loses digits
  return 1 + std::expm1(-sub_steps_ * std::log1p(k / sub_steps_)) / k;
}

// s of wake.hpp. The hat gives the force to the nodes a of the element, l_a to each, and the flow is read at nodes b (or where the grain is, of elements
// of order 2); in between lie the linear field of the force and linear test functions. The first is a hat, of variance h^2/6 along an axis (of cubes in
// tetrahedra; others by their volume). The second is one too, but for what the matrix of the same elements undoes: in the mean over directions of
// k, sum k_i^4 = 3/5 k^4, it leaves 2/5 of it. Flow at a distance r from a force that is so spread, by directions' mean, is erf(r/(2 s))/(6 pi eta r).
// The smooth kernel's variance adds to it.
template <int dim>
typename Coupling<dim>::Own Coupling<dim>::own(int i) const {
  const auto& l = place_[i].l;
  const auto& corners = mesh_->elements[place_[i].element];
  const bool linear = fluid_.velocity_order() == 1;
  double volume = 0.0, peak = 0.0;  // h^3, and what the hat makes of 1 where the grain is
  for (int a = 0; a <= dim; ++a) volume += l[a] * kernel_.masses()[corners[a]], peak += l[a] * l[a] / kernel_.masses()[corners[a]];
  const double s = std::cbrt(volume) * std::sqrt((linear ? 1.4 : 1.0) / 12);
  auto at = [&](const Vec<dim>& apart) {
    const double r = apart.norm();
    return r < 1e-6 * s ? 1 / s : std::sqrt(std::numbers::pi) * std::erf(r / (2 * s)) / r;
  };
  double sum = 0.0;
  for (int a = 0; a <= dim; ++a) {
    const Vec<dim>& x = walker_.nodes()[corners[a]];
    if (!linear) sum += l[a] * at(x - x_[i]);
    else for (int b = 0; b <= dim; ++b) sum += l[a] * l[b] * at(x - walker_.nodes()[corners[b]]);
  }
  const double variance = std::pow(peak, -2.0 / 3) / (2 * std::numbers::pi) + kernel_.variance();
  return {std::sqrt(1 / (sum * sum) + kernel_.variance() / 2), solid_volume_of(i) * std::pow(2 * std::numbers::pi * variance, -1.5)};
}

// Drag of the chosen grains about these slips, F(|w|) w/|w|. growth: d ln gamma/d ln |w|, that of a single sphere by Dallavalle's law, whatever the law: it
// makes steps from one linearisation to the next good ones, the answer does not depend on it.
template <int dim>
void Coupling<dim>::linearise(const std::vector<int>& which, const std::vector<Vec<dim>>& slip, std::vector<double>& growth) {
  std::vector<Suspension> seen;
  seen.reserve(which.size());
  for (const int i : which) {
    double eps = eps_at_[i];
    if (dim == 2 && settings.discs == Discs::spheres) eps = void_fraction_of_spheres(eps);
    seen.push_back({2 * r_[i], eps, slip[i].norm(), fluid_.properties.density, fluid_.properties.viscosity});
  }
  std::vector<double> gamma(seen.size()), gain(seen.size(), 1.0);  // gain: the slip without the grain's wake over that with it
  for (double change = 1.0; change > 1e-9;) {
    settings.drag(seen, gamma);
    change = 0.0;
    for (std::size_t k = 0; k < which.size(); ++k) {
      const int i = which[k];
      if (!(gamma[k] >= 0 && std::isfinite(gamma[k])))
        fail("Coupling: the drag law gives {} kg/s for grain {}: slip {} m/s, void fraction {}, diameter {} m", gamma[k], i, seen[k].slip, seen[k].eps, seen[k].diameter);
      if (!settings.undisturbed) continue;
      // Others' solids, beyond what the estimate of its own may leave.
      const double volume = solid_volume_of(i), others = std::max(0.0, 1 - eps_at_[i] - 1.5 * own_[i].solids);
      const double wake = gamma[k] * own_wake(own_[i].spread, fluid_.properties.viscosity, fluid_.properties.density, others * gamma[k] / (volume * fluid_.properties.viscosity), seen[k].slip);
      if (wake > 0.5)
        fail("Coupling: undisturbed: grain {} of diameter {} m takes {} of the flow where it is along with it, more than half: take a larger kernel_radius or larger elements", i, 2 * r_[i], wake);
      const double next = 1 / (1 - wake);
      change = std::max(change, std::abs(next - gain[k]));
      gain[k] = next, seen[k].slip = next * slip[i].norm();
    }
  }
  for (std::size_t k = 0; k < which.size(); ++k) {
    const int i = which[k];
    gamma[k] *= gain[k];
    const double inertial = 0.63 * std::sqrt(seen[k].reynolds());
    growth[i] = inertial / (inertial + 4.8);
    const double scale = dim == 2 ? per_depth(settings.discs, 2 * r_[i]) : 1.0;
    drag_[i] = {scale * gamma[k] * (1 + growth[i]), slip[i] * (growth[i] / (1 + growth[i]))};
  }
}

// Drag of every grain, linear about the slip that it will have: of free grains in the flow as it is, of others their slip now.
template <int dim>
void Coupling<dim>::expect_drag(double dt) {
  const int n = static_cast<int>(x_.size());
  std::vector<Vec<dim>> slip(n);
  std::vector<double> growth(n);
  std::vector<int> which(n);
  for (int i = 0; i < n; ++i) slip[i] = u_[i] - v_[i], which[i] = i;
  if (settings.undisturbed) {
    own_.resize(n);
    for (int i = 0; i < n; ++i) own_[i] = own(i);
  }
  for (int rounds = 0; !which.empty() && rounds < 30; ++rounds) {
    linearise(which, slip, growth);
    std::vector<int> again;
    for (const int i : which) {
      if (!free_[i] || !settings.grains_move) continue;
      const double mass = m_[i] + added_mass_of(i), k = dt * drag_[i].gamma / mass, left = left_of(k);
      const Vec<dim> rest = m_[i] * grains_.gravity + stress_force_[i] + added_mass_of(i) * convection_[i];
      // Without drag it would fall freely; with it, it tends to u - shift + rest/gamma.
      const Vec<dim> end = k > 1e-8 ? Vec<dim>(u_[i] - drag_[i].shift + rest / drag_[i].gamma) : Vec<dim>(v_[i] + dt / mass * rest);
      const Vec<dim> next = u_[i] - (k > 1e-8 ? Vec<dim>(end + left * (v_[i] - end)) : end);
      const double before = slip[i].norm(), after = next.norm();
      if (after > 2 * before || growth[i] * std::abs(after - before) > 0.03 * before) again.push_back(i);
      slip[i] = next;
    }
    which.swap(again);
  }
}

template <int dim>
void Coupling<dim>::answer_as_expected(double dt) {
  for (std::size_t i = 0; i < x_.size(); ++i) {
    const double gamma = drag_[i].gamma, added = added_mass_of(static_cast<int>(i)), mass = m_[i] + added;
    double c = settings.grains_move ? share_of(dt * gamma / mass) : 0.0;
    if (settings.grains_move) c += added / mass * (1 - c);
    answer_[i] = {gamma, started_ ? c * solid_volume_of(static_cast<int>(i)) : 0.0, settings.grains_move ? v_[i] : Vec<dim>(Vec<dim>::Zero()), -added * convection_[i], grad_p_[i], added / dt};
    if (!free_[i] || !settings.grains_move) continue;
    answer_[i].beta = (1 - c) * gamma, answer_[i].inertia *= 1 - c;
    answer_[i].given = c * (m_[i] * grains_.gravity + stress_force_[i]) + (1 - c) * answer_[i].given;
  }
}

// About what the last pass did: in the same flow the fluid would give what grains got.
template <int dim>
void Coupling<dim>::answer_as_last(double dt) {
  for (std::size_t i = 0; i < x_.size(); ++i) {
    Answer& answer = answer_[i];
    if (!free_[i]) answer.beta = drag_[i].gamma, answer.inertia = added_mass_of(static_cast<int>(i)) / dt;
    const Vec<dim> change = u_mean_[i] - u_mean_before_[i];
    answer.given = answer.beta * (u_before_[i] + change - drag_[i].shift - answer.v) + answer.inertia * change - drag_force_[i] / dt;
    answer.grad_p = grad_p_[i];
  }
}

template <int dim>
void Coupling<dim>::set_reaction(double dt) {
  using Values = Padded<3 * dim + 2>;  // beta, yield, beta target, force, follows
  const Values zero = Values::Zero();
  std::vector<Values> to_carriers(kernel_.carriers(), zero);
  for (std::size_t i = 0; i < x_.size(); ++i) {
    const Answer& answer = answer_[i];
    Values values = zero;
    values.template head<3 * dim + 2>() << answer.beta, answer.yield, answer.beta * (answer.v + drag_[i].shift - u_before_[i]), answer.given + answer.yield * (answer.grad_p - grad_p_before_[i]) + carry_[i] / dt,
        solid_volume_of(static_cast<int>(i)) * follows_fluid_[i];
    kernel_.give(static_cast<int>(i), values, to_carriers);
  }
  const std::vector<Values> sums = kernel_.to_nodes(to_carriers, zero);
  std::vector<fluid::Reaction<dim>> at_nodes(sums.size());
  for (std::size_t k = 0; k < sums.size(); ++k) {
    const Values density = sums[k] / kernel_.masses()[k];
    at_nodes[k].beta = density[0], at_nodes[k].yield = density[1];
    at_nodes[k].beta_target = density.template segment<dim>(2), at_nodes[k].force = density.template segment<dim>(2 + dim);
    at_nodes[k].follows = density.template segment<dim>(2 + 2 * dim);
  }
  if (settings.added_mass > 0) {  // by itself: the sums above are of whole registers
    std::vector<double> inertia(kernel_.carriers(), 0.0);
    for (std::size_t i = 0; i < x_.size(); ++i) kernel_.give(static_cast<int>(i), answer_[i].inertia, inertia);
    inertia = kernel_.to_nodes(inertia, 0.0);
    for (std::size_t k = 0; k < inertia.size(); ++k) at_nodes[k].inertia = inertia[k] / kernel_.masses()[k];
  }
  if (kernel_.is_resolved() && !x_.empty()) {
    const std::vector<Vec<dim>> force = short_wave_drag();
    for (std::size_t k = 0; k < force.size(); ++k) at_nodes[k].force += force[k];
  }
  fluid_.set_reaction(std::move(at_nodes));
}

// -beta (1 - P)^3 w of the text above.
template <int dim>
std::vector<Vec<dim>> Coupling<dim>::short_wave_drag() const {
  using Mat = fluid::Mat<dim>;
  std::vector<double> gamma(x_.size());
  for (std::size_t i = 0; i < gamma.size(); ++i) gamma[i] = answer_[i].beta;
  const std::vector<double> by_carriers = kernel_.density(gamma), beta = kernel_.at_nodes(by_carriers);
  const auto at_nodes_over_beta = [&]<class T>(const std::vector<T>& of_carriers) {
    std::vector<T> f = kernel_.at_nodes(of_carriers);
    for (std::size_t k = 0; k < f.size(); ++k) f[k] *= beta[k] > 0 ? 1 / beta[k] : 0.0;
    return f;
  };
  const auto pass = [&]<class T>(const std::vector<T>& f) {
    std::vector<T> c = kernel_.mean(f);
    for (std::size_t g = 0; g < c.size(); ++g) c[g] *= by_carriers[g];
    return at_nodes_over_beta(c);
  };
  const auto less_passed = [&](std::vector<Vec<dim>>& f) {
    const std::vector<Vec<dim>> passed = pass(f);
    for (std::size_t k = 0; k < f.size(); ++k) f[k] -= passed[k];
  };
  const auto& x = walker_.nodes();
  std::vector<Vec<dim>> wave = fluid_.velocity(), shift = x;
  wave.resize(x.size());
  std::vector<Mat> slope(x.size(), Mat::Zero());
  for (const auto& corners : mesh_->elements) {
    const auto g = fluid::geometry<dim>(x, corners);
    Mat here = Mat::Zero();
    for (int a = 0; a <= dim; ++a) here += wave[corners[a]] * g.grad_l[a].transpose();
    for (const int a : corners) slope[mesh_->master[a]] += g.volume / (dim + 1) * here;
  }
  for (std::size_t k = 0; k < x.size(); ++k)
    if (mesh_->master[k] == static_cast<int>(k)) slope[k] /= kernel_.masses()[k];
  for (Vec<dim>& s : shift)
    for (int axis = 0; axis < dim; ++axis)
      if (grains_.box().period[axis] > 0) s[axis] = 0.0;  // no field is linear along it
  less_passed(wave), less_passed(shift);
  slope = pass(slope);
  for (std::size_t k = 0; k < x.size(); ++k) wave[k] -= slope[k] * shift[k];
  for (int power = 1; power < 3; ++power) less_passed(wave);
  std::vector<double> beta_at(x_.size());  // grains
  std::vector<Vec<dim>> slip(x_.size()), drag(x_.size());
  for (std::size_t i = 0; i < x_.size(); ++i) beta_at[i] = kernel_.at_grain(static_cast<int>(i), by_carriers), slip[i] = u_before_[i] - v_[i];
  for (int round = 0; round < 3; ++round) {
    for (std::size_t i = 0; i < x_.size(); ++i) drag[i] = gamma[i] * slip[i];
    const std::vector<Vec<dim>> c = kernel_.density(drag), there = at_nodes_over_beta(c);
    for (std::size_t k = 0; k < x.size(); ++k) wave[k] += there[k];
    for (std::size_t i = 0; i < x_.size(); ++i)
      if (beta_at[i] > 0) slip[i] -= kernel_.at_grain(static_cast<int>(i), c) / beta_at[i];
  }
  for (int power = 0; power < 3; ++power) less_passed(wave);
  for (std::size_t k = 0; k < x.size(); ++k) wave[k] *= -beta[k];
  return wave;
}

template <int dim>
Report<dim> Coupling<dim>::step(double dt) {
  if (!(dt > 0 && std::isfinite(dt))) fail("step: dt must be > 0 s and finite, got {}", dt);
  if (settings.grains_move) grains_.check(dt);
  if (settings.fluid_moves && fluid_.settings.scheme != fluid::Scheme::backward_euler)
    fail("step: the fluid's scheme must be backward_euler when it is coupled: grains are of first order, and volumes add up only then");
  Report<dim> report;
  report.dt = dt;
  const double begun = seconds();
  if (!follows_.empty()) {
    for (auto& [boundary, follow] : follows_) {
      follow->velocity = (grains_.walls()[follow->wall].point - follow->from) / dt;
      for (int k = 0; k < dim; ++k)
        if (grains_.box().period[k] > 0) follow->velocity[k] = 0.0;
    }
    fluid_.move(dt);
    auto nodes = fluid_.nodes();
    nodes.resize(mesh_->nodes.size());
    walker_.place(nodes);
    kernel_.place(nodes);
  }
  take_grains();
  const int before = removed_;
  locate();
  report.removed = removed_ - before;
  const int n = static_cast<int>(x_.size());
  kernel_.weigh(x_, place_);
  if (settings.fluid_moves) {
    std::vector<double> to_carriers(kernel_.carriers(), 0.0);
    for (int i = 0; i < n; ++i) kernel_.give(i, solid_volume_of(i), to_carriers);
    eps_ = kernel_.to_nodes(to_carriers, 0.0);
    for (std::size_t k = 0; k < eps_.size(); ++k) eps_[k] = 1 - eps_[k] / kernel_.masses()[k];
    fluid_.set_void_fraction(eps_);
  } else {
    eps_ = fluid_.void_fraction();
    eps_.resize(mesh_->nodes.size());
  }
  flow_ = fluid_.projected(settings.added_mass > 0);  // on the mesh as it is now
  tell_grains();
  convection_.assign(n, Vec<dim>::Zero());
  if (settings.added_mass > 0) {
    const auto at_carriers = kernel_.to_carriers(flow_.convection, Vec<dim>(Vec<dim>::Zero()));
    for (int i = 0; i < n; ++i) convection_[i] = kernel_.at_grain(i, at_carriers);
  }
  expect_drag(dt);
  answer_as_expected(dt);
  u_before_ = u_, u_mean_before_ = u_mean_, grad_p_before_ = grad_p_;
  const bool again = settings.fluid_moves && settings.grains_move && std::isfinite(settings.tolerance);
  if (again) fluid_.mark();
  const std::vector<char> grains_before = again ? grains_.state() : std::vector<char>{};
  Vec<dim> handed = Vec<dim>::Zero();
  for (int i = 0; i < n; ++i) handed += carry_[i];
  std::vector<Vec<dim>> next_carry(n, Vec<dim>::Zero());
  for (;;) {
    if (settings.fluid_moves) {
      set_reaction(dt);
      const double stepping = seconds();
      report.fluid = fluid_.step(dt);
      report.fluid_time += seconds() - stepping;
      flow_ = fluid_.projected();
      tell_grains();
    }
    move_grains(dt, report);
    ++report.passes;
    // What the fluid gave, as its own answer has it, less what the grains got.
    Vec<dim> given = Vec<dim>::Zero(), carried = Vec<dim>::Zero();
    double apart = 0.0;
    report.exchanged_impulse = 0.0;
    for (int i = 0; i < n; ++i) {
      report.exchanged_impulse += drag_force_[i].norm();
      if (!settings.fluid_moves) continue;
      const Answer& answer = answer_[i];
      const Vec<dim> u = u_before_[i] + u_mean_[i] - u_mean_before_[i];  // as its equations have it
      const Vec<dim> gave = dt * (answer.beta * (u - drag_[i].shift - answer.v) - answer.given + answer.yield * (grad_p_[i] - answer.grad_p) + answer.inertia * (u_mean_[i] - u_mean_before_[i]));
      next_carry[i] = gave - drag_force_[i];
      given += gave, carried += next_carry[i], apart += next_carry[i].norm();
    }
    if (report.exchanged_impulse > 0) {
      report.carried_impulse = carried.norm() / report.exchanged_impulse, report.disagreement = apart / report.exchanged_impulse;
      if (settings.fluid_moves)
        report.momentum_error = (dt * fluid_.momentum_residual() + (dt * fluid_.reaction_force() + given - handed) + grains_error_).norm() / report.exchanged_impulse;
    }
    if (!again || report.disagreement <= settings.tolerance || report.passes >= settings.max_passes) break;
    answer_as_last(dt);
    fluid_.back(), grains_.restore(grains_before);
  }
  carry_ = next_carry;
  if (settings.grains_move) {
    const std::vector<std::uint8_t> held = grains_.held();
    for (int i = 0; i < n; ++i)
      for (int axis = 0; axis < dim; ++axis) follows_fluid_[i][axis] = held[i] >> axis & 1 ? 0.8 * follows_fluid_[i][axis] : 1.0;
  }
  for (int i = 0; i < n; ++i) {
    drag_force_[i] /= dt;
    report.drag += drag_force_[i];
  }
  started_ = true;
  report.time = grains_.time();
  report.exchange_time = seconds() - begun - report.fluid_time - report.grains_time;
  return report;
}

// The grains' step in the flow as it is; drag_force_ is then the impulse of drag and added mass.
template <int dim>
void Coupling<dim>::move_grains(double dt, Report<dim>& report) {
  const int n = static_cast<int>(x_.size());
  std::vector<double> gamma(n);
  std::vector<Vec<dim>> target(n);
  drag_force_.resize(n);
  for (int i = 0; i < n; ++i) gamma[i] = drag_[i].gamma, target[i] = u_[i] - drag_[i].shift;
  grains_error_.setZero();
  std::vector<double> added;               // masses, and impulses of theirs on grains at rest; empty: none
  std::vector<Vec<dim>> added_impulse;
  if (settings.added_mass > 0)
    for (int i = 0; i < n; ++i) {
      added.push_back(added_mass_of(i));
      added_impulse.push_back(added[i] * (u_mean_[i] - u_mean_before_[i] + dt * convection_[i]));
    }
  if (!settings.grains_move) {
    for (int i = 0; i < n; ++i) drag_force_[i] = dt * gamma[i] * target[i];
    for (std::size_t i = 0; i < added.size(); ++i) drag_force_[i] += added_impulse[i];
    return;
  }
  const double stepping = seconds();
  std::vector<Vec<dim>> force = stress_force_;
  for (std::size_t i = 0; i < added.size(); ++i) force[i] += added_impulse[i] / dt;
  grains_.set_force(force);
  grains_.set_drag(gamma, target, added);
  for (auto& [boundary, follow] : follows_) follow->from = grains_.walls()[follow->wall].point;
  report.grains = grains_.step(dt);
  report.grains_time += seconds() - stepping;
  sub_steps_ = report.grains.sub_steps;
  drag_force_ = grains_.drag_impulse();
  const auto& in_contact = grains_.in_contact();
  const auto& contact_impulse = grains_.contact_impulse();
  const auto after = grains_.by_id([](const Grains<dim>& g, int k) { return Vec<dim>(g.body[k].v); });
  for (std::size_t i = 0; i < added.size(); ++i) drag_force_[i] += added_impulse[i];
  for (int i = 0; i < n; ++i) {
    free_[i] = !in_contact[i];
    grains_error_ += m_[i] * (after[i] - v_[i]) - dt * (m_[i] * grains_.gravity + stress_force_[i]) - drag_force_[i] - contact_impulse[i];
  }
}

template <int dim>
std::vector<double> Coupling<dim>::state() const {
  std::vector<double> all{static_cast<double>(place_.size()), static_cast<double>(sub_steps_), static_cast<double>(started_), static_cast<double>(removed_)};
  for (std::size_t i = 0; i < place_.size(); ++i) {
    all.push_back(free_[i]), all.push_back(place_[i].element);
    for (const Vec<dim>& vector : {carry_[i], follows_fluid_[i]}) all.insert(all.end(), vector.data(), vector.data() + dim);
  }
  for (const auto& [boundary, follow] : follows_) all.insert(all.end(), follow->from.data(), follow->from.data() + dim);
  return all;
}

template <int dim>
void Coupling<dim>::restore(std::span<const double> state) {
  const std::size_t n = grains_.count(), size = 4 + n * (2 + 2 * dim) + follows_.size() * dim;
  if (state.size() != size || state[0] != static_cast<double>(n))
    fail("restore: the state has {} numbers where {} grains and {} boundaries that follow walls have {}; restore grains and fluid first, and call follow as "
         "before", state.size(), n, follows_.size(), size);
  const double* at = state.data() + 1;
  sub_steps_ = static_cast<int>(*at++), started_ = *at++ != 0.0, removed_ = static_cast<int>(*at++);
  free_.resize(n), place_.resize(n), carry_.resize(n), follows_fluid_.resize(n);
  for (std::size_t i = 0; i < n; ++i) {
    free_[i] = *at++ != 0.0, place_[i].element = static_cast<int>(*at++);
    for (Vec<dim>* vector : {&carry_[i], &follows_fluid_[i]}) *vector = Eigen::Map<const Vec<dim>>(at), at += dim;
  }
  for (auto& [boundary, follow] : follows_) follow->from = Eigen::Map<const Vec<dim>>(at), at += dim;
}

template class Coupling<2>;
template class Coupling<3>;

}  // namespace quicksand::coupling
