// Sweeps over contacts. Sums are kept per block and added in the order of the blocks: the same for any number of threads.
#include "solvers.hpp"

#include "wide.hpp"

#include <limits>
#include <numeric>

namespace quicksand {

namespace {

enum class Law { frictionless, coulomb, coulomb_restitution };

struct Change {  // of one contact in one update
  double change = 0.0, size = 0.0;  // W_nn |dp|^2, W_nn |p|^2
  double speed2 = 0.0;              // (W_nn |dp|)^2 [m^2/s^2]
};

struct Sums {  // over contacts
  double change = 0.0;  // sum W_nn |dp|^2, or W_nn |e|^2
  double size = 0.0;    // sum W_nn |p|^2
  double worst = 0.0;   // largest (W_nn |dp|)^2, or (W_nn |e|)^2 [m^2/s^2]
  long updates = 0;
  void operator+=(const Change& one) {
    change += one.change, size += one.size, worst = std::max(worst, one.speed2);
  }
  void operator+=(const Sums& other) {
    change += other.change, size += other.size, updates += other.updates, worst = std::max(worst, other.worst);
  }
};

template <int dim>
Vec<dim> vector(const Vec<dim>& n, double p_n, const Tangent<dim>& p_t) {
  return p_n * n + tangent_vector(n, p_t);
}

template <Law law, int dim>
[[gnu::always_inline]] inline void push(Body<dim>& a, Body<dim>& b, const Vec<dim>& n, double p_n, const Tangent<dim>& p_t, double spin_ratio) {
  Vec<dim> p = p_n * n;
  if constexpr (law != Law::frictionless) p += tangent_vector(n, p_t);
  a.v -= a.inv_m * p;
  b.v += b.inv_m * p;
  if constexpr (law != Law::frictionless) {
    const Spin<dim> torque = spin_ratio * turn(n, p_t);
    a.s -= a.inv_m * torque;
    b.s -= b.inv_m * torque;
  }
}

template <Law law, int dim>
[[gnu::always_inline]] inline void push(Wall<dim>& wall, Body<dim>& b, const Vec<dim>& n, double p_n, const Tangent<dim>& p_t, double spin_ratio) {
  const Vec<dim> p = vector<dim>(n, p_n, p_t);
  wall.v -= wall.inv_m.cwiseProduct(p);
  b.v += b.inv_m * p;
  if constexpr (law != Law::frictionless) b.s -= (b.inv_m * spin_ratio) * turn(n, p_t);
}

// Relative velocity at the contact: normal part, then tangential part.
template <int dim>
struct Slip {
  double n;
  Tangent<dim> t;
};

template <Law law, int dim>
[[gnu::always_inline]] inline Slip<dim> slip(const Body<dim>& a, const Body<dim>& b, const Vec<dim>& n) {
  const Vec<dim> u = b.v - a.v;
  if constexpr (law == Law::frictionless) return {u.dot(n), zero<Tangent<dim>>()};
  return {u.dot(n), tangential(u, n) - cross(Spin<dim>(a.s + b.s), n)};
}

template <Law law, int dim>
[[gnu::always_inline]] inline Slip<dim> slip(const Wall<dim>& wall, const Body<dim>& b, const Vec<dim>& n) {
  const Vec<dim> u = b.v - wall.v;
  if constexpr (law == Law::frictionless) return {u.dot(n), zero<Tangent<dim>>()};
  return {u.dot(n), tangential(u, n) - cross(b.s, n)};
}

template <class C>
double inv_w_t(const C& c, double rolling) {
  if constexpr (requires { c.inv_w_t; })
    return c.inv_w_t;
  else
    return c.inv_w * rolling;
}

// One contact update; a is a Body or a Wall. Inlined by order: called, it costs three times as much.
template <Law law, int dim, class A, class C>
[[gnu::always_inline]] inline Change update(A& a, Body<dim>& b, C& c, const Tangent<dim>* bias_t, double spin_ratio,
                                          double omega) {
  Slip<dim> u = slip<law, dim>(a, b, c.n);
  u.n += c.bias;
  if (c.p.n == 0.0 && u.n >= 0.0) return {};  // open and stays open
  if constexpr (law == Law::coulomb_restitution) u.t += *bias_t;
  const double rolling = 1.0 / (1.0 + spin_ratio);
  Impulse<dim> next;
  if constexpr (law == Law::frictionless)
    next.n = std::max(c.p.n - omega * c.inv_w * u.n, 0.0);
  else
    next = obey_coulomb<dim>(c.p, u.n, u.t, omega * c.inv_w, omega * inv_w_t(c, rolling), c.friction);
  const double dn = next.n - c.p.n;
  const Tangent<dim> dt = next.t - c.p.t;
  push<law>(a, b, c.n, dn, dt, spin_ratio);
  c.p = next;
  const double w = 1.0 / c.inv_w, change = w * (dn * dn + squared(dt));
  return {change, w * (next.n * next.n + squared(next.t)), w * change};
}

template <Law law, int dim, class A, class C>
void residual(const A& a, const Body<dim>& b, const C& c, const Tangent<dim>* bias_t, Sums& sums) {
  Slip<dim> u = slip<law, dim>(a, b, c.n);
  u.n += c.bias;
  if (c.p.n == 0.0 && u.n >= 0.0) return;  // open: e = 0
  if constexpr (law == Law::coulomb_restitution) u.t += *bias_t;
  const double e2 = natural_map<dim>(c.p, u.n, u.t, c.inv_w, c.friction);
  sums.change += e2 / c.inv_w;
  sums.size += (c.p.n * c.p.n + squared(c.p.t)) / c.inv_w;
  sums.worst = std::max(sums.worst, e2 / (c.inv_w * c.inv_w));
}

// What a pass over the contacts does with each.
enum class Pass {
  all,        // update every contact; list those whose impulse has not settled
  unsettled,  // update the listed ones; drop those that have settled now
  residual,   // measure the error of every contact
};

template <Law law, int dim>
class Sweeper {
 public:
  explicit Sweeper(Problem<dim>& problem) : p_(problem), sums_(problem.blocks.size()) {}

  // Contacts whose impulse changed by less than this are left out until the next sweep over all:
  // W_nn |dp|^2 <= energy, and W_nn |dp| <= speed.
  void settle(double energy, double speed) { settled_energy_ = energy, settled_speed2_ = speed * speed; }

  // To be called by all threads of a team; ends with a barrier after which the sums hold.
  void pass(Pass what, double omega) {
    for (std::size_t colour = 0; colour + 1 < p_.colours.size(); ++colour) {
#pragma omp for schedule(static)
      for (int b = p_.colours[colour]; b < p_.colours[colour + 1]; ++b) sums_[b] = block(what, b, omega);
    }
#pragma omp single
    finish(what, omega);
  }

  // The same, by one thread: blocks are sorted by colour, so the result is the same.
  void pass_alone(Pass what, double omega) {
    for (int b = 0; b < static_cast<int>(p_.blocks.size()); ++b) sums_[b] = block(what, b, omega);
    finish(what, omega);
  }

  // Relative change, or relative residual, of the last pass.
  double relative() const {
    if (total_.change == 0.0) return 0.0;
    return total_.size > 0.0 ? std::sqrt(total_.change / total_.size) : std::numeric_limits<double>::infinity();
  }
  double worst() const { return std::sqrt(total_.worst); }
  double size() const { return total_.size; }
  long unsettled() const { return unsettled_; }
  int sweeps() const { return sweeps_; }
  long updates() const { return updates_; }

 private:
  // What one thread does at the end of a pass: contacts with walls, which share them, and the sums.
  void finish(Pass what, double omega) {
    total_ = {};
    for (std::size_t k = 0; k < p_.wall_contacts.size(); ++k) {
      WallContact<dim>& c = p_.wall_contacts[k];
      const Tangent<dim>* bias_t = p_.wall_bias_t.empty() ? nullptr : &p_.wall_bias_t[k];
      if (what == Pass::residual)
        residual<law, dim>(p_.walls[c.wall], p_.bodies[c.j], c, bias_t, total_);
      else
        total_ += update<law, dim>(p_.walls[c.wall], p_.bodies[c.j], c, bias_t, p_.spin_ratio, omega);
    }
    for (const Sums& s : sums_) total_ += s;
    if (what != Pass::residual) {
      ++sweeps_;
      updates_ += total_.updates + static_cast<long>(p_.wall_contacts.size());
      unsettled_ = std::accumulate(p_.unsettled_count.begin(), p_.unsettled_count.end(), 0L);
    }
  }

  bool unsettled(double change, double speed2) const {
    return (change > settled_energy_) | (speed2 > settled_speed2_);
  }

  // contact(0) ... contact(n - 1), four at a time as long as these share no grain.
  template <class Get, class List>
  void visit_by_four(int n, Get&& contact, double omega, List&& list, Sums& sums) {
    Contact<2> idle[4];
    Body<2> idle_a[4], idle_b[4];
    for (int lane = 0; lane < 4; ++lane)
      idle[lane] = {Vec<2>(1, 0), 0.0, 1.0, 0.0, {}, 0, 0}, idle_a[lane] = idle_b[lane] = {Vec<2>(0, 0), 0.0, 1.0};
    Body<2>* const bodies = p_.bodies.data();
    Contact<2>* const contacts = p_.contacts.data();
    FourChanges total;
    auto update = [&](const Four& four, const int* k, int width) {
      const FourChanges one = update_four<law != Law::frictionless>(four, p_.spin_ratio, omega);
      total.change += one.change;
      total.size += one.size;
      total.speed2 = total.speed2 > one.speed2 ? total.speed2 : one.speed2;
      const int moved = bits((one.change > settled_energy_) | (one.speed2 > settled_speed2_));
      for (int lane = 0; lane < width; ++lane) list(k[lane], moved >> lane & 1);
    };
    auto put = [&](Four& four, int lane, int k) {
      Contact<2>& c = contacts[k];
      four.contact[lane] = &c, four.a[lane] = bodies + c.i, four.b[lane] = bodies + c.j;
    };
    for (int at = 0; at < n;) {
      Four four;
      int k[4], width = std::min(4, n - at);
      for (int lane = 0; lane < width; ++lane) k[lane] = contact(at + lane);
      if (width == 4 && independent(contacts[k[0]], contacts[k[1]], contacts[k[2]], contacts[k[3]])) {
        for (int lane = 0; lane < 4; ++lane) put(four, lane, k[lane]);
        update(four, k, 4);
      } else {  // where one colour ends and the next begins
        auto shared = [&](int a, int b) {
          const Contact<2>&c = contacts[k[a]], &d = contacts[k[b]];
          return c.i == d.i || c.i == d.j || c.j == d.i || c.j == d.j;
        };
        for (int lane = 1; lane < width; ++lane)
          for (int before = 0; before < lane && before < width; ++before)
            if (lane < width && shared(lane, before)) width = lane;
        for (int lane = 0; lane < 4; ++lane) {
          if (lane < width)
            put(four, lane, k[lane]);
          else
            four.contact[lane] = &idle[lane], four.a[lane] = &idle_a[lane], four.b[lane] = &idle_b[lane];
        }
        update(four, k, width);
      }
      at += width;
    }
    for (int lane = 0; lane < 4; ++lane) sums += Change{total.change[lane], total.size[lane], total.speed2[lane]};
  }

  Sums block(Pass what, int b, double omega) {
    Sums sums;
    const int first = p_.blocks[b].begin, end = first + p_.count[b];
    Body<dim>* const bodies = p_.bodies.data();
    Contact<dim>* const contacts = p_.contacts.data();
    auto bias_t = [&](int k) { return law == Law::coulomb_restitution ? &p_.bias_t[k] : nullptr; };
    int n_unsettled = 0;
    auto list = [&](int k, bool moved) {
      p_.unsettled[first + n_unsettled] = k;
      n_unsettled += moved;
    };
    auto visit = [&](int n, auto&& contact) {
      sums.updates = n;
      if constexpr (dim == 2 && law != Law::coulomb_restitution) {
        visit_by_four(n, contact, omega, list, sums);
      } else {
        for (int a = 0; a < n; ++a) {
          const int k = contact(a);
          Contact<dim>& c = contacts[k];
          const Change change = update<law, dim>(bodies[c.i], bodies[c.j], c, bias_t(k), p_.spin_ratio, omega);
          sums += change;
          list(k, unsettled(change.change, change.speed2));
        }
      }
      p_.unsettled_count[b] = n_unsettled;
    };
    if (what == Pass::all) {
      visit(p_.count[b], [&](int a) { return first + a; });
    } else if (what == Pass::unsettled) {
      visit(p_.unsettled_count[b], [&](int a) { return p_.unsettled[first + a]; });
    } else {
      for (int k = first; k < end; ++k) {
        const Contact<dim>& c = contacts[k];
        residual<law, dim>(bodies[c.i], bodies[c.j], c, bias_t(k), sums);
      }
    }
    return sums;
  }

  Problem<dim>& p_;
  std::vector<Sums> sums_;
  Sums total_;
  double settled_energy_ = 0.0, settled_speed2_ = 0.0;
  int sweeps_ = 0;
  long updates_ = 0, unsettled_ = 0;
};

// Fewer contacts than that are swept sooner by one thread than several can meet at the ends of the colours.
constexpr long worth_sharing = 2000;

// Sweeps until the residual is below the tolerance. The change of the impulses in a sweep over all contacts tells when the
// residual is worth its pass.
template <Law law, int dim>
SolveReport relax(Problem<dim>& problem, const SolverSettings& settings, bool active_set) {
  Sweeper<law, dim> sweeper(problem);
  SolveReport report;
  enum class Next { sweep, active, check, done } next = Next::sweep;
  double omega = active_set ? settings.omega : 1.0;
  double trial = settings.tolerance;  // change below which the residual is looked at
  double before = std::numeric_limits<double>::infinity();
  int slow = 0, limit = settings.max_sweeps;
  bool fallen_back = !active_set;
  const long contacts = std::accumulate(problem.count.begin(), problem.count.end(), 1L);
#pragma omp parallel num_threads(problem.threads)
  while (next != Next::done) {
    if (next == Next::active) {
      int k = 0;
      for (; k < settings.active_sweeps && sweeper.unsettled() > worth_sharing; ++k) sweeper.pass(Pass::unsettled, omega);
#pragma omp single
      for (; k < settings.active_sweeps && sweeper.unsettled() > 0; ++k) sweeper.pass_alone(Pass::unsettled, omega);
    }
    sweeper.pass(next == Next::check ? Pass::residual : Pass::all, omega);
#pragma omp single
    {
      if (next == Next::check) {
        report.residual = sweeper.relative();
        report.worst = sweeper.worst();
        report.converged = (report.residual <= settings.tolerance && report.worst <= settings.worst) ||
                           report.worst <= settings.rounding;  // contacts that only just touch: impulses of the size of their errors
        const bool out_of_sweeps = sweeper.sweeps() >= limit;
        if (report.converged || (out_of_sweeps && fallen_back)) {
          next = Next::done;
        } else {
          if (report.residual > settings.tolerance)
            trial = std::min(trial, before) * std::clamp(0.7 * settings.tolerance / report.residual, 0.1, 0.7);
          next = fallen_back ? Next::sweep : Next::active;
          if (out_of_sweeps) fallen_back = true, omega = 1.0, limit += settings.max_sweeps, next = Next::sweep;
        }
      } else {
        const double change = sweeper.relative();
        // Over-relaxation can cycle in dense states: three sweeps in a row that gain less than a fifth halve omega - 1.
        slow = change > 0.8 * before ? slow + 1 : 0;
        if (slow >= 3) omega = omega < 1.1 ? 1.0 : 1.0 + 0.5 * (omega - 1.0), slow = 0;
        before = change;
        // Settled: an equal share of the tolerance in the energy norm, and well below the error allowed to one contact.
        sweeper.settle(settings.tolerance * settings.tolerance * sweeper.size() / static_cast<double>(contacts), 0.3 * settings.worst);
        next = (change <= trial && sweeper.worst() <= 2 * settings.worst) || sweeper.sweeps() >= limit ? Next::check : (fallen_back ? Next::sweep : Next::active);
      }
    }
  }
  report.sweeps = sweeper.sweeps();
  report.updates = sweeper.updates();
  return report;
}

template <int dim>
SolveReport relax_by_law(Problem<dim>& problem, const SolverSettings& settings, bool active_set) {
  if (!problem.friction) return relax<Law::frictionless>(problem, settings, active_set);
  if (problem.bias_t.empty() && problem.wall_bias_t.empty())
    return relax<Law::coulomb>(problem, settings, active_set);
  return relax<Law::coulomb_restitution>(problem, settings, active_set);
}

}  // namespace

template <int dim>
SolveReport solve_nlgs(Problem<dim>& problem, const SolverSettings& settings) {
  return relax_by_law(problem, settings, false);
}

template <int dim>
SolveReport solve_active_set(Problem<dim>& problem, const SolverSettings& settings) {
  return relax_by_law(problem, settings, true);
}

template <int dim>
void warm_start(Problem<dim>& problem) {
  auto start = [&](auto& a, Body<dim>& b, const auto& c) {
    if (c.p.n > 0.0) push<Law::coulomb>(a, b, c.n, c.p.n, c.p.t, problem.spin_ratio);
  };
#pragma omp parallel num_threads(problem.threads)
  for (std::size_t colour = 0; colour + 1 < problem.colours.size(); ++colour) {
#pragma omp for schedule(static)
    for (int b = problem.colours[colour]; b < problem.colours[colour + 1]; ++b)
      for (int k = problem.blocks[b].begin; k < problem.blocks[b].begin + problem.count[b]; ++k) {
        const Contact<dim>& c = problem.contacts[k];
        start(problem.bodies[c.i], problem.bodies[c.j], c);
      }
  }
  for (const WallContact<dim>& c : problem.wall_contacts) start(problem.walls[c.wall], problem.bodies[c.j], c);
}

template SolveReport solve_nlgs(Problem<2>&, const SolverSettings&);
template SolveReport solve_nlgs(Problem<3>&, const SolverSettings&);
template SolveReport solve_active_set(Problem<2>&, const SolverSettings&);
template SolveReport solve_active_set(Problem<3>&, const SolverSettings&);
template void warm_start(Problem<2>&);
template void warm_start(Problem<3>&);

}  // namespace quicksand
