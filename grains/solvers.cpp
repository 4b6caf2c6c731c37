// Sweeps over contacts. Sums are kept per block and added in the order of the blocks: the same for any number of threads.
#include "impulse.hpp"
#include "restart.hpp"
#include "solvers.hpp"

#include <limits>
#include <numeric>

namespace quicksand {

namespace {

struct Sums {  // over contacts
  double change = 0.0;  // sum W_nn |dp|^2, or W_nn |e|^2
  double size = 0.0;    // sum W_nn |p|^2
  double worst = 0.0;   // largest (W_nn |dp|)^2, or (W_nn |e|)^2 [m^2/s^2]
  long updates = 0;
  void operator+=(const Change<>& one) {
    change += one.change, size += one.size, worst = std::max(worst, one.speed2);
  }
  void operator+=(const Change<Lanes>& four) {
    for (int lane = 0; lane < 4; ++lane) *this += Change<>{four.change[lane], four.size[lane], four.speed2[lane]};
  }
  void operator+=(const Sums& other) {
    change += other.change, size += other.size, updates += other.updates, worst = std::max(worst, other.worst);
  }
};

inline double sum(double x) { return x; }
inline double sum(const Lanes& x) { return (x[0] + x[1]) + (x[2] + x[3]); }

template <class Real>
Real positive_or_one(Real x) {
  return x > 0.0 ? x : Real{} + 1.0;
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
[[gnu::always_inline]] inline Change<> update(A& a, Body<dim>& b, C& c, const General<dim>& general, double omega) {
  Slip<dim> u = slip<law, dim>(a, b, c.n);
  u.n += c.bias;
  if (c.p.n == 0.0 && u.n >= 0.0) return {};  // open and stays open; an extrapolated impulse may be negative
  if constexpr (law == Law::general) u.t += general.bias_t;
  Impulse<dim> next;
  if constexpr (law == Law::frictionless)
    next.n = std::max(c.p.n - omega * c.inv_w * u.n, 0.0);
  else
    next = obey_coulomb<dim>(c.p, u.n, u.t, omega * c.inv_w, omega * inv_w_t(c, general.rolling), c.friction);
  const double dn = next.n - c.p.n;
  const Tangent<dim> dt = next.t - c.p.t;
  push<law>(a, b, c.n, dn, dt, general.ratio_i, general.ratio_j);
  c.p = next;
  const double w = 1.0 / c.inv_w, change = w * (dn * dn + squared(dt));
  return {change, w * (next.n * next.n + squared(next.t)), w * change};
}

template <Law law, int dim, class A, class C>
Change<> error(const A& a, const Body<dim>& b, const C& c, const General<dim>& general) {
  Slip<dim> u = slip<law, dim>(a, b, c.n);
  u.n += c.bias;
  if (c.p.n == 0.0 && u.n >= 0.0) return {};  // open: e = 0
  if constexpr (law == Law::general) u.t += general.bias_t;
  const double w = 1.0 / c.inv_w, change = w * natural_map<dim>(c.p, u.n, u.t, c.inv_w, c.friction);
  return {change, w * (c.p.n * c.p.n + squared(c.p.t)), w * change};
}

// visit(block) for every block, by the threads of a team: those of one colour at the same time.
template <int dim, class Visit>
void each_block(const Problem<dim>& problem, Visit&& visit, bool backwards = false) {
  const int n_colours = static_cast<int>(problem.colours.size()) - 1;
  for (int k = 0; k < n_colours; ++k) {
    const int colour = backwards ? n_colours - 1 - k : k;
#pragma omp for schedule(static)
    for (int b = problem.colours[colour]; b < problem.colours[colour + 1]; ++b) visit(b);
  }
}

// What a pass over the contacts does. Each lists the contacts that have not settled for the next.
enum class Pass {
  all,        // update every contact
  back,       // the same in the opposite order
  touched,    // those with a grain that listed contacts have moved; the others still solve what they solved before
  unsettled,  // those listed
  residual,   // measure the error of every contact
};

// The contacts of a block in the order they are visited, in units: packs of four in 2D, one by one in 3D.
template <Law law, int dim>
class Sweeper {
 public:
  static constexpr bool wide = dim == 2;
  static constexpr int unit = wide ? 4 : 1;  // contacts

  explicit Sweeper(Problem<dim>& problem) : p_(problem), s_(problem.scratch), sums_(problem.blocks.size()) {
    const std::size_t n_blocks = problem.blocks.size();
    resize_tight(s_.list, problem.contacts.size());
    s_.listed.assign(n_blocks, 0);
    s_.units.assign(problem.count.begin(), problem.count.end());
    s_.touched.assign(problem.bodies.size(), -1);
    wall_list_.resize(problem.wall_contacts.size());
    if constexpr (wide) pack();
  }

  // Writes the impulses back to where they came from.
  ~Sweeper() {
    if constexpr (wide) {
#pragma omp parallel num_threads(p_.threads)
      each_block(p_, [&](int b) {
        for (int k = 0; k < s_.units[b]; ++k)
          for (int lane = 0; lane < 4; ++lane)
            if (const int slot = s_.slots[p_.blocks[b].begin + k][lane]; slot >= 0) {
              const Pack& pack = s_.packs[s_.first[b] + k];
              p_.contacts[slot].p = {pack.p.n[lane], pack.p.t[lane]};
            }
      });
    }
  }

  // Contacts whose impulse changed by less than this are left out until a grain of theirs is touched:
  // W_nn |dp|^2 <= energy, and W_nn |dp| <= speed.
  void settle(double energy, double speed) { settled_energy_ = energy, settled_speed2_ = speed * speed; }

  // To be called by all threads of a team; ends with a barrier after which the sums hold.
  void pass(Pass what, double omega) {
    if (what == Pass::back) {
#pragma omp single
      wall_sums_ = walls(what, omega);
    }
    each_block(p_, [&](int b) { sums_[b] = block(what, b, omega); }, what == Pass::back);
#pragma omp single
    {
      if (what != Pass::back) wall_sums_ = walls(what, omega);
      add_up(what);
    }
  }

  // The same, by one thread: blocks are sorted by colour, so the result is the same. Not for Pass::back.
  void pass_alone(Pass what, double omega) {
    for (int b = 0; b < static_cast<int>(p_.blocks.size()); ++b) sums_[b] = block(what, b, omega);
    wall_sums_ = walls(what, omega);
    add_up(what);
  }

  // Impulses and velocities go on by beta times the way p - p_0 they have come since the last call, p_0. To be called by all threads
  // of a team. Afterwards resists(): whether sweeps have been pulling p back against that way from where they started, y,
  //   (y - p) . W_nn (p - p_0) > 0.
  void extrapolate(double beta) {
    each_block(p_, [&](int b) {
      Real against{};
      for (int k = 0; k < s_.units[b]; ++k) against += go_on(contact(b, k), last_[unit_at(b, k)], start_[unit_at(b, k)], beta);
      sums_[b].change = sum(against);
    });
#pragma omp for schedule(static)
    for (int k = 0; k < static_cast<int>(p_.bodies.size()); ++k) go_on(p_.bodies[k], last_body_[k], beta);
#pragma omp single
    {
      against_ = 0.0;
      for (const Sums& s : sums_) against_ += s.change;
      for (std::size_t k = 0; k < p_.wall_contacts.size(); ++k)
        against_ += go_on(p_.wall_contacts[k], last_wall_contact_[k], start_wall_contact_[k], beta);
      for (std::size_t w = 0; w < p_.walls.size(); ++w) {
        const Vec<dim> v = p_.walls[w].v;
        p_.walls[w].v += beta * (v - last_wall_[w]);
        last_wall_[w] = v;
      }
    }
  }
  bool resists() const { return against_ > 0.0; }

  // Where the first way starts: to be called by one thread before the first sweep.
  void begin_extrapolation() {
    const std::size_t n_units = wide ? s_.packs.size() : p_.contacts.size();
    last_.resize(n_units), start_.resize(n_units);
    for (std::size_t b = 0; b < p_.blocks.size(); ++b)
      for (int k = 0; k < s_.units[b]; ++k) last_[unit_at(b, k)] = start_[unit_at(b, k)] = contact(b, k).p;
    last_wall_contact_.resize(p_.wall_contacts.size());
    for (std::size_t k = 0; k < p_.wall_contacts.size(); ++k) last_wall_contact_[k] = p_.wall_contacts[k].p;
    start_wall_contact_ = last_wall_contact_;
    last_body_.assign(p_.bodies.begin(), p_.bodies.end());
    last_wall_.clear();
    for (const Wall<dim>& wall : p_.walls) last_wall_.push_back(wall.v);
  }

  // Marks the grains that the listed contacts, or walls, will move until the next pass over those touched. One thread.
  void touch() {
    std::fill(s_.touched.begin(), s_.touched.end(), 0);
    for (int b = 0; b < static_cast<int>(p_.blocks.size()); ++b)
      for (int a = p_.blocks[b].begin; a < p_.blocks[b].begin + s_.listed[b]; ++a) {
        const auto& c = contact(b, s_.list[a]);
        if constexpr (wide)
          for (int lane = 0; lane < 4; ++lane) s_.touched[c.i[lane]] = s_.touched[c.j[lane]] = 1;
        else
          s_.touched[c.i] = s_.touched[c.j] = 1;
      }
    for (const WallContact<dim>& c : p_.wall_contacts) s_.touched[c.j] = 1;
  }

  // Relative change, or relative residual, of the last pass.
  double relative() const {
    if (total_.change == 0.0) return 0.0;
    return size_ > 0.0 ? std::sqrt(total_.change / size_) : std::numeric_limits<double>::infinity();
  }
  double worst() const { return std::sqrt(total_.worst); }
  double size() const { return size_; }
  long unsettled() const { return unsettled_; }
  int sweeps() const { return sweeps_; }
  long updates() const { return updates_; }

 private:
  void pack() {
    const std::size_t n_blocks = p_.blocks.size();
    resize_tight(s_.slots, p_.contacts.size());
    s_.first.resize(n_blocks);
#pragma omp parallel num_threads(p_.threads)
    each_block(p_, [&](int b) { fill_slots(b); });
    int total = 0;
    for (std::size_t b = 0; b < n_blocks; ++b) s_.first[b] = total, total += s_.units[b];
    resize_tight(s_.packs, total);
    if (law == Law::general) resize_tight(s_.general, total);
#pragma omp parallel num_threads(p_.threads)
    each_block(p_, [&](int b) { fill_packs(b); });
  }

  // Consecutive contacts that share no grain make a pack.
  void fill_slots(int b) {
    const int begin = p_.blocks[b].begin;
    int pack = begin - 1, lane = 0;  // the pack being filled, by its slot
    for (int k = begin; k < begin + p_.count[b]; ++k) {
      int &at_i = s_.touched[p_.contacts[k].i], &at_j = s_.touched[p_.contacts[k].j];  // pack they are in
      if (lane == 0 || at_i == pack || at_j == pack) s_.slots[++pack] = {-1, -1, -1, -1}, lane = 4;
      s_.slots[pack][--lane] = k;
      at_i = at_j = pack;
    }
    s_.units[b] = pack + 1 - begin;
  }

  void fill_packs(int b) {
    for (int k = 0; k < s_.units[b]; ++k) {
      const std::array<int, 4>& slots = s_.slots[p_.blocks[b].begin + k];
      Pack& pack = s_.packs[s_.first[b] + k];
      Contact<2> empty = p_.contacts[slots[3]];
      empty.inv_w = 0.0, empty.p = {};
      for (int lane = 0; lane < 4; ++lane) {
        put(pack, lane, slots[lane] < 0 ? empty : p_.contacts[slots[lane]]);
        if constexpr (law == Law::general) put(s_.general[s_.first[b] + k], lane, general(slots[slots[lane] < 0 ? 3 : lane]));
      }
    }
  }

  auto& contact(int b, int k) {
    if constexpr (wide)
      return s_.packs[s_.first[b] + k];
    else
      return p_.contacts[p_.blocks[b].begin + k];
  }

  General<dim> general(int slot) const {
    General<dim> g{zero<Tangent<dim>>(), p_.spin_ratio, p_.spin_ratio, rolling_};
    if constexpr (law == Law::general) {
      if (!p_.bias_t.empty()) g.bias_t = p_.bias_t[slot];
      if (!p_.spin_ratios.empty()) {
        const Contact<dim>& c = p_.contacts[slot];
        g.ratio_i = p_.spin_ratios[c.i], g.ratio_j = p_.spin_ratios[c.j];
        const double w_i = p_.bodies[c.i].inv_m, w_j = p_.bodies[c.j].inv_m;
        g.rolling = (w_i + w_j) / (w_i * (1.0 + g.ratio_i) + w_j * (1.0 + g.ratio_j));
      }
    }
    return g;
  }
  General<dim> wall_general(int k) const {
    General<dim> g{zero<Tangent<dim>>(), p_.spin_ratio, p_.spin_ratio, 0.0};  // W_tt: that of the contact
    if constexpr (law == Law::general) {
      if (!p_.wall_bias_t.empty()) g.bias_t = p_.wall_bias_t[k];
      g.ratio_j = p_.spin_ratio_of(p_.wall_contacts[k].j);
    }
    return g;
  }

  std::size_t unit_at(std::size_t b, int k) const { return wide ? s_.first[b] + k : p_.blocks[b].begin + k; }

  // Contacts with walls, which share them: one thread.
  Sums walls(Pass what, double omega) {
    Sums sums;
    const bool listed = what == Pass::unsettled;
    const int n = listed ? n_wall_listed_ : static_cast<int>(p_.wall_contacts.size());
    n_wall_listed_ = 0;
    for (int a = 0; a < n; ++a) {
      const int k = what == Pass::back ? n - 1 - a : listed ? wall_list_[a] : a;
      WallContact<dim>& c = p_.wall_contacts[k];
      const Change<> change = what == Pass::residual
                                  ? error<law, dim>(p_.walls[c.wall], p_.bodies[c.j], c, wall_general(k))
                                  : update<law, dim>(p_.walls[c.wall], p_.bodies[c.j], c, wall_general(k), omega);
      sums += change;
      wall_list_[n_wall_listed_] = k;
      n_wall_listed_ += change.change > settled_energy_ || change.speed2 > settled_speed2_;
    }
    sums.updates = n;
    return sums;
  }

  void add_up(Pass what) {
    total_ = wall_sums_;
    for (const Sums& s : sums_) total_ += s;
    if (what == Pass::all || what == Pass::back || what == Pass::residual) size_ = total_.size;
    unsettled_ = unit * std::accumulate(s_.listed.begin(), s_.listed.end(), 0L) + n_wall_listed_;
    if (what == Pass::residual) return;
    ++sweeps_;
    updates_ += unit * (total_.updates - wall_sums_.updates) + wall_sums_.updates;
  }

  Sums block(Pass what, int b, double omega) {
    int* const list = s_.list.data() + p_.blocks[b].begin;
    int* end = list;
    if (what == Pass::touched) {
      for (int k = 0; k < s_.units[b]; ++k) *end = k, end += any_of(s_.touched.data(), contact(b, k));
      s_.listed[b] = static_cast<int>(end - list);
      end = list;
    }
    const bool all = what == Pass::all || what == Pass::back || what == Pass::residual, back = what == Pass::back;
    const int n = all ? s_.units[b] : s_.listed[b];
    Change<Real> total;
    auto visit = [&](auto&& one) {
      for (int a = 0; a < n; ++a) {
        const int k = back ? n - 1 - a : all ? a : list[a];
        const Change<Real> change = one(contact(b, k), k);
        total.change += change.change;
        total.size += change.size;
        total.speed2 = total.speed2 > change.speed2 ? total.speed2 : change.speed2;
        *end = k;
        end += any((change.change > settled_energy_) | (change.speed2 > settled_speed2_));
      }
    };
    Body<dim>* const bodies = p_.bodies.data();
    if constexpr (wide) {
      auto of_pack = [&](int k) { return law == Law::general ? &s_.general[s_.first[b] + k] : nullptr; };
      if (what == Pass::residual)
        visit([&](Pack& c, int k) { return error<law>(c, bodies, of_pack(k)); });
      else
        visit([&](Pack& c, int k) { return update<law>(c, bodies, of_pack(k), p_.spin_ratio, omega); });
    } else {
      const int first = p_.blocks[b].begin;
      if (what == Pass::residual)
        visit([&](auto& c, int k) { return error<law, dim>(bodies[c.i], bodies[c.j], c, general(first + k)); });
      else
        visit([&](auto& c, int k) { return update<law, dim>(bodies[c.i], bodies[c.j], c, general(first + k), omega); });
    }
    s_.listed[b] = static_cast<int>(end - list);
    Sums sums;
    sums += total;
    sums.updates = n;
    return sums;
  }

  // Returns (y - p) . W_nn (p - p_0); then p_0 becomes p, and both p and y the point further on.
  template <class C, class I>
  static auto go_on(C& c, I& last, I& start, double beta) {
    const I p = c.p;
    const auto way_n = p.n - last.n, to_start_n = start.n - p.n;
    const typename I::T way_t = p.t - last.t, to_start_t = start.t - p.t;
    const auto back = to_start_n * way_n + product(to_start_t, way_t);
    last = p;
    c.p.n += beta * way_n, c.p.t += beta * way_t;
    start = c.p;
    return back / positive_or_one(c.inv_w);  // empty lanes: 1/W = 0
  }
  static void go_on(Body<dim>& b, Body<dim>& last, double beta) {
    const Body<dim> now = b;
    b.v += beta * (now.v - last.v);
    b.s += beta * (now.s - last.s);
    last = now;
  }

  Problem<dim>& p_;
  Scratch& s_;
  const double rolling_ = 1.0 / (1.0 + p_.spin_ratio);
  std::vector<Sums> sums_;
  Sums total_, wall_sums_;
  std::vector<int> wall_list_;  // wall contacts that have not settled
  int n_wall_listed_ = 0;
  using Real = std::conditional_t<wide, Lanes, double>;
  using UnitImpulse = std::conditional_t<wide, Impulse<2, Lanes>, Impulse<dim>>;
  std::vector<UnitImpulse> last_, start_;  // of extrapolate(): p_0 and y
  std::vector<Impulse<dim>> last_wall_contact_, start_wall_contact_;
  std::vector<Body<dim>> last_body_;
  std::vector<Vec<dim>> last_wall_;
  double against_ = 0.0;
  double size_ = 0.0;  // of the last pass over all
  double settled_energy_ = 0.0, settled_speed2_ = 0.0;
  int sweeps_ = 0;
  long updates_ = 0, unsettled_ = 0;
};

constexpr double strongest_omega = 1.8;

// Fewer contacts than that are swept sooner by one thread than several can meet at the ends of the colours.
constexpr long worth_sharing = 2000;

// When the residual is worth its pass: the change of the impulses in a sweep over all contacts tells.
class Watch {
 public:
  explicit Watch(const SolverSettings& settings) : settings_(settings), trial_(settings.tolerance), trial_worst_(2 * settings.worst) {}

  bool worth_a_look(double change, double worst) {
    change_ = change, change_worst_ = worst;
    const bool promising = change <= trial_ && worst <= trial_worst_;
    return promising || (change <= settings_.tolerance && worst <= 2 * settings_.worst && ++unchecked_ >= 5);
  }

  // Notes what the residual was found to be; returns whether that is good enough.
  bool look(double residual, double worst, SolveReport& report) {
    report.residual = residual, report.worst = worst;
    report.converged = (residual <= settings_.tolerance && worst <= settings_.worst) ||
                       worst <= settings_.rounding;  // contacts that only just touch: impulses of the size of their errors
    auto lower = [](double trial, double seen, double wanted, double error) {
      return error > wanted ? std::min(trial, seen) * std::clamp(0.7 * wanted / error, 0.1, 0.7) : trial;
    };
    trial_ = lower(trial_, change_, settings_.tolerance, residual);
    trial_worst_ = lower(trial_worst_, change_worst_, settings_.worst, worst);
    unchecked_ = 0;
    return report.converged;
  }

 private:
  const SolverSettings& settings_;
  double trial_, trial_worst_;  // changes below which the residual is looked at
  double change_ = 0.0, change_worst_ = 0.0;
  int unchecked_ = 0;           // passes since the last look that may have been enough
};

// Sweeps until the residual is below the tolerance.
template <Law law, int dim>
SolveReport relax(Problem<dim>& problem, const SolverSettings& settings, bool active_set) {
  Sweeper<law, dim> sweeper(problem);
  Watch watch(settings);
  SolveReport report;
  enum class Next { sweep, active, check, done } next = Next::sweep;
  const Next sweep = active_set ? Next::active : Next::sweep;  // all but the first
  double omega = active_set ? settings.omega : 1.0;
  double before = std::numeric_limits<double>::infinity();
  int slow = 0;
  const long contacts = std::accumulate(problem.count.begin(), problem.count.end(), 1L);
#pragma omp parallel num_threads(problem.threads)
  while (next != Next::done) {
    if (next == Next::active) {
#pragma omp single
      sweeper.touch();
      int k = 0;
      for (; k < settings.active_sweeps && sweeper.unsettled() > worth_sharing; ++k) sweeper.pass(Pass::unsettled, omega);
#pragma omp single
      for (; k < settings.active_sweeps && sweeper.unsettled() > 0; ++k) sweeper.pass_alone(Pass::unsettled, omega);
    }
    sweeper.pass(next == Next::check ? Pass::residual : next == Next::active ? Pass::touched : Pass::all, omega);
#pragma omp single
    {
      if (next == Next::check) {
        const bool done = watch.look(sweeper.relative(), sweeper.worst(), report) || sweeper.sweeps() >= settings.max_sweeps;
        next = done ? Next::done : sweep;
      } else {
        const double change = sweeper.relative();
        // Over-relaxation can cycle in dense states: three sweeps in a row that gain less than a fifth halve omega - 1.
        slow = change > 0.8 * before ? slow + 1 : 0;
        // Where that does not help it was no cycle, but impulses that balance each other, as of a wedged grain, and fade slowly.
        if (active_set && slow >= (omega > 1.0 ? 3 : 10))
          omega = omega == 1.0 ? strongest_omega : (omega < 1.1 ? 1.0 : 1.0 + 0.5 * (omega - 1.0)), slow = 0;
        before = change;
        // Settled: an equal share of the tolerance in the energy norm, and well below the error allowed to one contact.
        sweeper.settle(settings.tolerance * settings.tolerance * sweeper.size() / static_cast<double>(contacts), 0.3 * settings.worst);
        next = watch.worth_a_look(change, sweeper.worst()) || sweeper.sweeps() >= settings.max_sweeps ? Next::check : sweep;
      }
    }
  }
  report.sweeps = sweeper.sweeps();
  report.updates = sweeper.updates();
  return report;
}

// A sweep and one in the opposite order, then a step further the way the two have taken.
template <Law law, int dim>
SolveReport accelerate(Problem<dim>& problem, const SolverSettings& settings) {
  Sweeper<law, dim> sweeper(problem);
  sweeper.begin_extrapolation();
  Watch watch(settings);
  SolveReport report;
  Restart restart;
  double beta = 0.0;
  bool look = false, done = false;
#pragma omp parallel num_threads(problem.threads)
  while (true) {
    sweeper.pass(Pass::all, 1.0);
    sweeper.pass(Pass::back, 1.0);
#pragma omp single
    {
      const bool last = sweeper.sweeps() >= settings.max_sweeps;
      beta = restart.weigh(sweeper.relative());
      look = watch.worth_a_look(sweeper.relative(), sweeper.worst()) || last;
      done = last;
    }
    if (look) {
      sweeper.pass(Pass::residual, 1.0);
#pragma omp single
      done |= watch.look(sweeper.relative(), sweeper.worst(), report);
    }
    if (done) break;
    sweeper.extrapolate(beta);
#pragma omp single
    restart.resisted(sweeper.resists());
  }
  report.sweeps = sweeper.sweeps();
  report.updates = sweeper.updates();
  return report;
}

// solve(law) with the simplest law that the problem needs.
template <int dim, class Solve>
SolveReport by_law(const Problem<dim>& problem, Solve&& solve) {
  using enum Law;
  if (!problem.friction) return solve(std::integral_constant<Law, frictionless>());
  if (problem.bias_t.empty() && problem.wall_bias_t.empty() && problem.spin_ratios.empty()) return solve(std::integral_constant<Law, coulomb>());
  return solve(std::integral_constant<Law, general>());
}

}  // namespace

template <int dim>
SolveReport solve_nlgs(Problem<dim>& problem, const SolverSettings& settings) {
  return by_law(problem, [&](auto law) { return relax<law>(problem, settings, false); });
}

template <int dim>
SolveReport solve_active_set(Problem<dim>& problem, const SolverSettings& settings) {
  return by_law(problem, [&](auto law) { return relax<law>(problem, settings, true); });
}

template <int dim>
SolveReport solve_accelerated(Problem<dim>& problem, const SolverSettings& settings) {
  return by_law(problem, [&](auto law) { return accelerate<law>(problem, settings); });
}

template <int dim>
void warm_start(Problem<dim>& problem) {
  auto start = [&](auto& a, Body<dim>& b, const auto& c, double ratio_a) {
    if (c.p.n > 0.0) push<Law::coulomb>(a, b, c.n, c.p.n, c.p.t, ratio_a, problem.spin_ratio_of(c.j));
  };
#pragma omp parallel num_threads(problem.threads)
  each_block(problem, [&](int b) {
    for (int k = problem.blocks[b].begin; k < problem.blocks[b].begin + problem.count[b]; ++k) {
      const Contact<dim>& c = problem.contacts[k];
      start(problem.bodies[c.i], problem.bodies[c.j], c, problem.spin_ratio_of(c.i));
    }
  });
  for (const WallContact<dim>& c : problem.wall_contacts) start(problem.walls[c.wall], problem.bodies[c.j], c, 0.0);
}

template SolveReport solve_nlgs(Problem<2>&, const SolverSettings&);
template SolveReport solve_nlgs(Problem<3>&, const SolverSettings&);
template SolveReport solve_active_set(Problem<2>&, const SolverSettings&);
template SolveReport solve_active_set(Problem<3>&, const SolverSettings&);
template SolveReport solve_accelerated(Problem<2>&, const SolverSettings&);
template SolveReport solve_accelerated(Problem<3>&, const SolverSettings&);
template void warm_start(Problem<2>&);
template void warm_start(Problem<3>&);

}  // namespace quicksand
