// The step of a scene; reads as its own table of contents from step() on.
#include "errors.hpp"
#include "simulation.hpp"

#include <chrono>

namespace quicksand {

namespace {

// Relative velocity of j seen from i, at the contact.
template <int dim, class A>
Vec<dim> relative_velocity(const A& a, const Body<dim>& b, const Vec<dim>& n) {
  if constexpr (std::is_same_v<A, Body<dim>>)
    return b.v - a.v - tangent_vector(n, Tangent<dim>(cross(Spin<dim>(a.s + b.s), n)));
  else
    return b.v - a - tangent_vector(n, Tangent<dim>(cross(b.s, n)));
}

// Pairs are listed up to this gap, in mean radii. Of 0.5 to 1.6 the fastest in the reference flow: fewer detections, more pairs to look at.
constexpr double skin = 1.3;

// A sub-step has converged when its residual is below the tolerance and no single contact's error, as an overlap h W_nn |e|, is above
// this share of the tolerance in mean diameters: the overlaps of a flow stay at about twice this bound, and a global norm hides them.
constexpr double overlap_share = 0.06;

// Overlaps above this share of the tolerance, in mean diameters, are taken back: the errors of a contact that lasts add up.
constexpr double repair_above = 0.03;
constexpr double repaired = 0.5;  // of the excess, in a sub-step

}  // namespace

template <int dim>
StepReport<dim> Simulation<dim>::step(double dt) {
  check(dt);
  free_walls();
  threads_ = choose_threads();
  const auto start = std::chrono::steady_clock::now();
  StepReport<dim> report;
  report.dt = dt;
  for (Wall<dim>& wall : walls_) wall.force.setZero();
  if (dragged()) {
    for (auto* of_step : {&drag_.impulse, &drag_.contact_impulse}) std::fill(of_step->begin(), of_step->end(), Vec<dim>::Zero());
    std::fill(drag_.in_contact.begin(), drag_.in_contact.end(), 0);
  }

  for (double left = dt; left > 0;) {
    Motion motion = measure_pairs();
    double h, gain;
    auto choose = [&] {
      gain = speed_gain(left), h = sub_step_length(left, dt, motion, gain);
      if (h != left) gain = speed_gain(h);
    };
    choose();
    // How near a pair must be to touch in this sub-step: half as much again as the fastest of all neighbours moves relative to another,
    // for a grain may be pushed faster than any moved before. Pairs that are no neighbours yet must not come that near, by
    // their own motion and half of that.
    auto alert = [&](double speed) { return 1.5 * h * (speed + gain) + 0.01 * mean_radius_; };
    if (!neighbours_.valid(grains_, walls_, alert(motion.speed) / 3, h, threads_)) {
      neighbours_.find(grains_, walls_, box_, std::clamp(3 * alert(motion.speed), skin * mean_radius_, max_radius_ * 2), threads_);
      motion = measure_pairs();
      choose();
      while (!neighbours_.valid(grains_, walls_, alert(motion.speed) / 3, h, threads_)) h *= 0.5, gain = speed_gain(h);
    }
    const double overlap = motion.overlap, allowed = repair_above * settings.solve.tolerance * 2 * mean_radius_;
    if (overlap > allowed) {
      repair_overlaps(allowed);
      measure_pairs();
    }
    body_before_ = grains_.body;
    for (std::size_t w = 0; w < walls_.size(); ++w) wall_before_[w] = walls_[w].v;

    SolveReport solved;
    for (int attempt = 0;; ++attempt) {
      accelerate(h);
      find_contacts(h, alert(motion.speed), alert(motion.wall_speed));
      const auto solving = std::chrono::steady_clock::now();
      const SolveReport last = solve_contacts(h);
      report.solve_time += std::chrono::duration<double>(std::chrono::steady_clock::now() - solving).count();
      solved = {solved.sweeps + last.sweeps, solved.updates + last.updates, last.residual, last.worst, last.converged};
      // A light grain squeezed out by a heavy one is faster than any was before: what it would run into becomes a contact, too.
      const double missed = speed_of_missed(h, motion.speed, alert(motion.speed), alert(motion.wall_speed));
      if (missed == 0 || attempt == 5) break;
      motion.speed = std::max(motion.speed, missed), motion.wall_speed = std::max(motion.wall_speed, missed);
      grains_.body = body_before_;
      for (std::size_t w = 0; w < walls_.size(); ++w) walls_[w].v = wall_before_[w];
    }
    contacts_current_ = true;
    account(h, report);
    if (dragged()) {
      note_contacts();
      unweigh();
    }
    move(h);

    left = h < left ? left - h : 0.0;
    time_ += h;
    ++report.sub_steps;
    report.sweeps += solved.sweeps;
    report.updates += solved.updates;
    report.residual = std::max(report.residual, solved.residual);
    report.worst_contact = std::max(report.worst_contact, h * solved.worst);
    report.max_overlap = std::max(report.max_overlap, overlap);
    report.unconverged += !solved.converged;
    if (!solved.converged && !settings.accept_unconverged)
      throw NotConverged(fmt::format(
          "step: residual {:.2e} (tolerance {:.2e}) and error of one contact {:.2e} mean diameters (at most {:.2e}) after {} sweeps at "
          "t = {:.6g} s; raise max_sweeps or the tolerance, or accept such steps with accept_unconverged (they are counted)",
          solved.residual, settings.solve.tolerance, h * solved.worst / (2 * mean_radius_), overlap_share * settings.solve.tolerance,
          solved.sweeps, time_));
  }

  report.time = time_;
  report.candidates /= report.sub_steps;
  if (report.contacts > 0) report.branch_length /= static_cast<double>(report.contacts);
  report.coordination = n_free_ > 0 ? 2.0 * report.contacts / (double(report.sub_steps) * n_free_) : 0.0;
  report.contacts /= report.sub_steps;
  report.virial_contacts /= dt;
  report.virial_wall_contacts /= dt;
  for (Wall<dim>& wall : walls_) wall.force /= dt;
  for (const Body<dim>& b : grains_.body) {
    if (b.inv_m == 0) continue;
    report.virial_kinetic += b.v * b.v.transpose() / b.inv_m;
  }
  const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
  const int shared = threads_ > 1;
  pace_.seconds[shared] += taken.count() / static_cast<double>(report.updates + grains_.size());
  ++pace_.samples[shared];
  return report;
}

// Threads that other work keeps waiting are slower than one alone, by a factor of hundreds on a busy machine. Results do not depend on
// their number, so now and then a few steps are made the other way, and the faster way makes the rest. A trial that goes badly ends
// at once, and the longer nothing changes, the rarer trials are.
template <int dim>
int Simulation<dim>::choose_threads() {
  const int most = std::clamp(grains_.size() / 1000, 1, settings.threads);  // fewer grains are not worth a second thread
  if (most == 1) return 1;
  if (pace_.left-- <= 0) {
    pace_.seconds[0] = pace_.seconds[1] = 0.0, pace_.samples[0] = pace_.samples[1] = 0;
    pace_.left = pace_.wait;
    pace_.wait = std::min(2 * pace_.wait, 5000);
  }
  const auto pace = [&](int way) { return pace_.seconds[way] / pace_.samples[way]; };
  const int other = !pace_.shared;
  if (pace_.samples[pace_.shared] < 3) return pace_.shared ? most : 1;
  const bool bad = pace_.samples[other] > 0 && pace(other) > 3 * pace(pace_.shared);
  if (pace_.samples[other] < 3 && !bad) return other ? most : 1;
  if (pace(other) < pace(pace_.shared)) pace_.shared = other, pace_.wait = 200;
  return pace_.shared ? most : 1;
}

// Checks of the scene that adding things one by one cannot make, and what depends on the scene but not on the sub-step.
template <int dim>
void Simulation<dim>::check(double dt) {
  check_positive(dt, "step: dt", "s");
  quicksand::check(settings, "step");
  if (!is_finite(gravity.norm())) fail("step: gravity must be finite, got ({}) m/s^2", fmt::join(gravity, ", "));
  const int n = grains_.size();
  double mass = 0.0, r_sum = 0.0, r_min = std::numeric_limits<double>::infinity(), v2_max = 0.0;
  std::vector<char> used(materials_.names().size(), 0), grain(used.size(), 0);
  acceleration_ = max_radius_ = 0.0;
  for (int k = 0; k < n; ++k) {
    r_sum += grains_.r[k];
    r_min = std::min(r_min, grains_.r[k]);
    max_radius_ = std::max(max_radius_, grains_.r[k]);
    v2_max = std::max(v2_max, grains_.body[k].v.squaredNorm());
    if (grains_.body[k].inv_m > 0) mass += 1.0 / grains_.body[k].inv_m;
    if (!grains_.force.empty()) acceleration_ = std::max(acceleration_, grains_.force[k].norm() * grains_.body[k].inv_m);
    used[grains_.material[k]] = 1;
    if (grains_.id[k] >= 0) grain[grains_.material[k]] = 1;
  }
  acceleration_ += gravity.norm();
  mean_radius_ = n > 0 ? r_sum / n : 0.0;
  wall_acceleration_ = 0.0;
  wall_mass_ = 0.1 * mass;
  for (const Wall<dim>& wall : walls_) {
    used[wall.material] = 1;
    v2_max = std::max(v2_max, wall.v.squaredNorm());
    for (int k = 0; k < dim; ++k) {
      if (!wall.loaded[k]) continue;
      const double m = wall.mass > 0 ? wall.mass : wall_mass_;
      if (m == 0.0) fail("step: load-driven wall {} needs a mass [kg] where there are no grains", &wall - walls_.data());
      wall_acceleration_ = std::max(wall_acceleration_, std::abs(wall.load[k]) / m);
    }
  }
  acceleration_ += wall_acceleration_;
  friction_ = restitution_ = tangential_restitution_ = false;
  for (std::size_t a = 0; a < used.size(); ++a)
    for (std::size_t b = 0; b < used.size(); ++b) {
      if (!grain[a] || !used[b]) continue;
      const Materials::Pair& pair = materials_.pair(a, b);
      if (pair.friction < 0)
        fail("step: no friction set between '{}' and '{}'; call set_friction", materials_.names()[a], materials_.names()[b]);
      friction_ |= pair.friction > 0;
      restitution_ |= pair.normal > 0 || pair.tangential > 0;
      tangential_restitution_ |= pair.tangential > 0;
    }
  // No two come closer faster than this; a billion sub-steps is no simulation, but a slip of the pen.
  const double speed = std::sqrt(v2_max) + speed_gain(dt);
  if (n > 0 && dt * speed > 1e9 * settings.sub_step_motion * r_min)
    fail("step: dt = {} s takes more than 1e9 sub-steps at speeds up to {:.4g} m/s with a smallest radius of {:.4g} m", dt, speed, r_min);
  if (!places_checked_) check_places();
  places_checked_ = true;
}

// Where grains and walls may not be at the start; later the solver sees to it. Only when they were put somewhere from outside.
template <int dim>
void Simulation<dim>::check_places() const {
  constexpr auto plane = Wall<dim>::Shape::plane;
  const int n = grains_.size(), n_walls = static_cast<int>(walls_.size());
  for (int b = 0; b < n_walls; ++b)
    for (int a = 0; a < b; ++a) {
      const bool facing = walls_[a].shape == plane && walls_[b].shape == plane && walls_[a].normal.dot(walls_[b].normal) < -1 + 1e-12;
      const double between = (walls_[b].point - walls_[a].point).dot(walls_[a].normal);
      if (facing && between < 0) fail("step: walls {} and {} cross: they face each other over {:.4g} m", a, b, between);
    }
  for (int w = 0; w < n_walls; ++w)
    for (int k = 0; k < n && walls_[w].shape == plane; ++k) {
      const double distance = nearest_point(walls_[w], grains_.x[k], box_).distance;
      if (grains_.wall[k] < 0 && distance < 0)
        fail("step: grain {} is {:.4g} m behind wall {}, whose normal points to the side of the grains", grains_.id[k], -distance, w);
    }
  std::vector<Vec<dim>> x(grains_.x);
  for (Vec<dim>& p : x) p = box_.wrap(p);
  const CloseGrains<dim> close(x, grains_.r, box_, 1.0, 0.0);
  auto name = [&](int k) {
    return grains_.wall[k] < 0 ? fmt::format("grain {}", grains_.id[k]) : fmt::format("a grain fixed to wall {}", grains_.wall[k]);
  };
  for (int k = 0; k < n; ++k)
    close.visit(k, [&](int i, int j, int code) {
      if (grains_.wall[i] >= 0 && grains_.wall[j] >= 0) return;
      const double distance = (x[j] - x[i] + periodic_shift(box_, code)).norm();
      const double overlap = grains_.r[i] + grains_.r[j] - distance, smaller = std::min(grains_.r[i], grains_.r[j]);
      if (grains_.id[i] > grains_.id[j]) std::swap(i, j);
      if (overlap > smaller)
        fail("step: {} and {} overlap by {:.4g} m, more than the smaller radius, {:.4g} m", name(i), name(j), overlap, smaller);
    });
}

template <int dim>
void Simulation<dim>::free_walls() {
  wall_before_.resize(walls_.size());
  for (Wall<dim>& wall : walls_)
    for (int k = 0; k < dim; ++k) {
      if (!wall.loaded[k]) continue;
      if (wall.mass == 0.0) wall.mass = wall_mass_;
      wall.inv_m[k] = 1.0 / wall.mass;
    }
}

// From a wall, or the grain fixed to it, to the grain of the pair: the direction, and the distance of the surfaces.
template <int dim>
NearWall<dim> Simulation<dim>::near_wall(const WallPair<dim>& pair) const {
  if (pair.fixed < 0) {
    NearWall<dim> near = nearest_point(walls_[pair.wall], grains_.x[pair.j], box_);
    near.distance -= grains_.r[pair.j];
    return near;
  }
  const Vec<dim> branch = grains_.x[pair.j] - grains_.x[pair.fixed] + neighbours_.shifts[pair.shift];
  const double length = branch.norm();
  return {branch / length, length - (grains_.r[pair.j] + grains_.r[pair.fixed])};
}

template <int dim>
const Materials::Pair& Simulation<dim>::law_of(const WallPair<dim>& pair) const {
  return materials_.pair(pair.fixed >= 0 ? grains_.material[pair.fixed] : walls_[pair.wall].material, grains_.material[pair.j]);
}

// Gaps of all listed pairs, and how fast they move relative to each other.
template <int dim>
typename Simulation<dim>::Motion Simulation<dim>::measure_pairs() {
  const auto& pairs = neighbours_.pairs;
  const auto& wall_pairs = neighbours_.wall_pairs;
  const int n = static_cast<int>(pairs.size()), n_walls = static_cast<int>(wall_pairs.size());
  gap_.resize(n + n_walls);
  wall_normal_.resize(n_walls);
  double speed2 = 0.0, rate2 = 0.0, least = 0.0;
#pragma omp parallel for num_threads(threads_) schedule(static) reduction(max : speed2, rate2) reduction(min : least)
  for (int k = 0; k < n; ++k) {
    const Pair<dim>& pair = pairs[k];
    const Vec<dim> branch = grains_.x[pair.j] - grains_.x[pair.i] + neighbours_.shifts[pair.shift];
    const double reach = grains_.r[pair.i] + grains_.r[pair.j];
    gap_[k] = branch.norm() - reach;
    const double u2 = (grains_.body[pair.j].v - grains_.body[pair.i].v).squaredNorm();
    least = std::min(least, gap_[k]);
    speed2 = std::max(speed2, u2);
    rate2 = std::max(rate2, u2 / (reach * reach));
  }
  Motion motion{std::sqrt(speed2), 0.0, std::sqrt(rate2), -least};
  for (int k = 0; k < n_walls; ++k) {
    const WallPair<dim>& pair = wall_pairs[k];
    const Wall<dim>& wall = walls_[pair.wall];
    const Vec<dim> u = grains_.body[pair.j].v - wall.v;
    const double r = grains_.r[pair.j];
    const NearWall<dim> near = near_wall(pair);
    double speed = u.norm();
    if (pair.fixed >= 0) motion.rate = std::max(motion.rate, speed / (r + grains_.r[pair.fixed]));
    else if (wall.shape == Wall<dim>::Shape::plane) speed = std::abs(u.dot(near.n));  // the gap to a plane is linear: any step
    else motion.rate = std::max(motion.rate, 0.5 * speed / r);
    gap_[n + k] = near.distance;
    wall_normal_[k] = near.n;
    motion.wall_speed = std::max(motion.wall_speed, speed);
    motion.overlap = std::max(motion.overlap, -near.distance);
  }
  return motion;
}

// Moves grains that overlap too much apart, lighter ones more. Velocities stay: no kinetic energy comes of it.
template <int dim>
void Simulation<dim>::repair_overlaps(double allowed) {
  const int n = static_cast<int>(neighbours_.pairs.size());
  for (int k = 0; k < n; ++k) {
    if (gap_[k] >= -allowed) continue;
    const auto [i, j, shift, p] = neighbours_.pairs[k];
    const Vec<dim> branch = grains_.x[j] - grains_.x[i] + neighbours_.shifts[shift];
    const double m_i = grains_.body[i].inv_m, m_j = grains_.body[j].inv_m, length = branch.norm();
    const Vec<dim> apart = repaired * std::max(grains_.r[i] + grains_.r[j] - length - allowed, 0.0) / ((m_i + m_j) * length) * branch;
    grains_.x[i] -= m_i * apart;
    grains_.x[j] += m_j * apart;
  }
  for (std::size_t k = 0; k < neighbours_.wall_pairs.size(); ++k) {
    if (gap_[n + k] >= -allowed) continue;
    const WallPair<dim>& pair = neighbours_.wall_pairs[k];
    grains_.x[pair.j] += repaired * (-gap_[n + k] - allowed) * near_wall(pair).n;
  }
}

// The largest speed among listed pairs that are no contacts, being further apart than the alert distances, and yet would overlap at the end
// of the sub-step; 0: there are none. `speed`: that of the fastest pair before it [m/s].
template <int dim>
double Simulation<dim>::speed_of_missed(double h, double speed, double alert, double wall_alert) const {
  const int n = static_cast<int>(neighbours_.pairs.size()), n_grains = grains_.size();
  const double allowed = 0.01 * mean_radius_;
  double speed2 = 0.0, kick2 = 0.0;
#pragma omp parallel for num_threads(threads_) schedule(static) reduction(max : kick2)
  for (int k = 0; k < n_grains; ++k) kick2 = std::max(kick2, (grains_.body[k].v - body_before_[k].v).squaredNorm());
  // Two kicks may add up. Overlaps of a tenth of a diameter and less are left to repair: a look at all pairs costs 6 % of a flow's time.
  if (2 * h * std::sqrt(kick2) < 0.2 * mean_radius_) return 0.0;
  const double farthest = h * (speed + 2 * std::sqrt(kick2)) - allowed;  // no pair can meet from here
#pragma omp parallel for num_threads(threads_) schedule(static) reduction(max : speed2)
  for (int k = 0; k < n; ++k) {
    if (gap_[k] < alert || gap_[k] > farthest) continue;
    const Pair<dim>& pair = neighbours_.pairs[k];
    const Vec<dim> u = grains_.body[pair.j].v - grains_.body[pair.i].v;
    const Vec<dim> branch = grains_.x[pair.j] - grains_.x[pair.i] + neighbours_.shifts[pair.shift] + h * u;
    if (branch.norm() < grains_.r[pair.i] + grains_.r[pair.j] - allowed) speed2 = std::max(speed2, u.squaredNorm());
  }
  for (std::size_t k = 0; k < neighbours_.wall_pairs.size(); ++k) {
    const WallPair<dim>& pair = neighbours_.wall_pairs[k];
    if (gap_[n + k] < wall_alert) continue;
    const Vec<dim> u = grains_.body[pair.j].v - walls_[pair.wall].v;
    if (gap_[n + k] + h * u.dot(near_wall(pair).n) < -allowed) speed2 = std::max(speed2, u.squaredNorm());
  }
  return std::sqrt(speed2);
}

// The linearised gap underestimates the gap of convex bodies that slide past each other, by (u_t h)^2/(2 d): a sub-step that
// lets a pair move by a fraction f of its centres' distance opens gaps of f^2/2 of it, and never makes an overlap.
template <int dim>
double Simulation<dim>::sub_step_length(double left, double dt, const Motion& motion, double gain) const {
  if (grains_.size() == 0) return left;
  double parts = 1.0;
  if (settings.sub_steps == SubSteps::relative) {
    const double rate = motion.rate + gain / (2 * mean_radius_);
    parts = std::ceil(left * rate / settings.sub_step_motion);
  } else {
    double v2_max = 0.0, r_min = std::numeric_limits<double>::infinity();
    for (int k = 0; k < grains_.size(); ++k)
      v2_max = std::max(v2_max, grains_.body[k].v.squaredNorm()), r_min = std::min(r_min, grains_.r[k]);
    parts = std::round(left / dt * std::max(1.0, std::ceil(8 * std::sqrt(v2_max) * dt / r_min)));
  }
  return left / std::max(parts, 1.0);
}

template <int dim>
void Simulation<dim>::accelerate(double h) {
  const int n = grains_.size();
  if (!gravity.isZero(0.0) || !grains_.force.empty()) {
    const bool forced = !grains_.force.empty();
#pragma omp parallel for num_threads(threads_) schedule(static)
    for (int k = 0; k < n; ++k) {
      Body<dim>& b = grains_.body[k];
      if (b.inv_m == 0) continue;
      const double share = drag_.added_mass.empty() ? h : h / (1.0 + drag_.added_mass[grains_.id[k]] * b.inv_m);  // h m/(m + m_a)
      b.v += share * gravity;
      if (forced) b.v += share * b.inv_m * grains_.force[k];
    }
  }
  if (dragged()) {
    weigh(h);
#pragma omp parallel for num_threads(threads_) schedule(static)
    for (int k = 0; k < n; ++k) {
      Body<dim>& b = grains_.body[k];
      if (b.inv_m == 0) continue;
      const int id = grains_.id[k];
      b.v += h * drag_.coefficient[id] * b.inv_m * (drag_.velocity[id] - b.v);  // (v + k u)/(1 + k), k = h gamma/(m + m_a)
    }
  }
  for (Wall<dim>& wall : walls_) wall.v += h * wall.inv_m.cwiseProduct(wall.load);
}

// Pairs nearer than `alert` [m], of grains and walls `wall_alert`, become contacts, with the impulse of the last sub-step, scaled to the length of this one.
template <int dim>
void Simulation<dim>::find_contacts(double h, double alert, double wall_alert) {
  const int n = static_cast<int>(neighbours_.pairs.size()), n_blocks = static_cast<int>(neighbours_.blocks.size());
  resize_tight(contacts_, n);
  resize_tight(pair_of_, n);
  count_.resize(n_blocks);
  const double scale = last_h_ > 0 ? h / last_h_ : 0.0;
  last_h_ = h;
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int b = 0; b < n_blocks; ++b) {
    // Contacts that bore load come first: whether a sweep may skip a contact is then easy to predict.
    const auto [begin, end] = neighbours_.blocks[b];
    int at_loaded = begin, at = begin;
    for (int k = begin; k < end; ++k) at += gap_[k] < alert && neighbours_.pairs[k].p.n > 0;
    for (int k = begin; k < end; ++k) {
      Pair<dim>& pair = neighbours_.pairs[k];
      if (gap_[k] >= alert) {
        pair.p = {};
        continue;
      }
      const int slot = pair.p.n > 0 ? at_loaded++ : at++;
      pair_of_[slot] = k;
      Contact<dim>& c = contacts_[slot];
      const Vec<dim> branch = grains_.x[pair.j] - grains_.x[pair.i] + neighbours_.shifts[pair.shift];
      c.n = branch / branch.norm();
      c.bias = std::max(gap_[k], 0.0) / h;
      c.inv_w = 1.0 / (grains_.body[pair.i].inv_m + grains_.body[pair.j].inv_m);
      c.friction = materials_.pair(grains_.material[pair.i], grains_.material[pair.j]).friction;
      c.p = {scale * pair.p.n, scale * onto_plane(pair.p.t, c.n)};
      c.i = pair.i;
      c.j = pair.j;
    }
    count_[b] = at - neighbours_.blocks[b].begin;
  }
  wall_contacts_.clear();
  join_facets(wall_alert);
  for (std::size_t k = 0; k < neighbours_.wall_pairs.size(); ++k) {
    WallPair<dim>& pair = neighbours_.wall_pairs[k];
    if (gap_[n + k] >= wall_alert) {
      pair.p = {};
      continue;
    }
    const Wall<dim>& wall = walls_[pair.wall];
    const Body<dim>& body = grains_.body[pair.j];
    WallContact<dim> c{};
    c.n = wall_normal_[k];
    c.bias = std::max(gap_[n + k], 0.0) / h;
    c.inv_w = 1.0 / (body.inv_m + c.n.cwiseProduct(wall.inv_m).dot(c.n));
    const double spin_ratio = spin_ratios_.empty() ? 1 / grains_.inertia : spin_ratios_[pair.j];
    c.inv_w_t = 1.0 / (body.inv_m * (1 + spin_ratio) + wall.inv_m.maxCoeff());
    if constexpr (dim == 2)
      c.inv_w_t = 1.0 / (body.inv_m * (1 + spin_ratio) + c.n.y() * c.n.y() * wall.inv_m.x() + c.n.x() * c.n.x() * wall.inv_m.y());
    c.friction = law_of(pair).friction;
    c.p = {scale * pair.p.n, scale * onto_plane(pair.p.t, c.n)};
    c.wall = pair.wall;
    c.j = pair.j;
    c.pair = static_cast<int>(k);
    wall_contacts_.push_back(c);
  }
}

// Where facets meet, one of them alone is wrong about the surface. A grain on a facet A is nearest to a point of A's rim on its neighbour B:
// held off that point at the end of the step, with the gap linear in the motion, it would be braked before it gets there. It is on A,
// which contains that point: where the surface is flat or a ridge, B is left out until the grain has passed the rim; where it is a
// valley, B is met with its plane. Of facets met at one point of both, one stays. Dropped pairs get an infinite gap.
template <int dim>
void Simulation<dim>::join_facets(double wall_alert) {
  const auto& pairs = neighbours_.wall_pairs;
  const std::size_t n = neighbours_.pairs.size();
  const double same = 1e-6 * mean_radius_;
  struct Met {
    std::size_t k;
    double gap;
    Vec<dim> n;
  };
  std::vector<Met> met;  // facets that one grain may touch, the nearest first
  for (std::size_t begin = 0, end; begin < pairs.size(); begin = end) {
    const int j = pairs[begin].j;
    met.clear();
    for (end = begin; end < pairs.size() && pairs[end].j == j; ++end)
      if (pairs[end].fixed < 0 && walls_[pairs[end].wall].is_facet() && gap_[n + end] < wall_alert)
        met.push_back({end, gap_[n + end], wall_normal_[end]});
    if (met.size() < 2) continue;
    std::stable_sort(met.begin(), met.end(), [](const Met& a, const Met& b) { return a.gap < b.gap; });
    const double r = grains_.r[j];
    for (std::size_t b = 1; b < met.size(); ++b) {
      const Wall<dim>& other = walls_[pairs[met[b].k].wall];
      const Vec<dim> to_foot = -(met[b].gap + r) * met[b].n, foot = grains_.x[j] + to_foot;
      const auto a = std::find_if(met.begin(), met.begin() + b, [&](const Met& nearer) {
        return nearest_point(walls_[pairs[nearer.k].wall], foot, box_).distance < same;
      });
      if (a == met.begin() + b) continue;
      const Vec<dim> along = box_.nearest(other.middle() - foot);
      const double across = -to_foot.dot(other.normal), gap = std::abs(across) - r;
      if (a->n.dot(along) < 1e-9 * along.norm())
        gap_[n + met[b].k] = std::numeric_limits<double>::infinity();
      else if (gap > std::min(a->gap, 0.0) - 0.01 * r)  // else the grain is not in the valley, but at its end
        gap_[n + met[b].k] = gap, wall_normal_[met[b].k] = across < 0 ? Vec<dim>(-other.normal) : other.normal;
    }
  }
}

template <int dim>
Problem<dim> Simulation<dim>::problem() {
  return {
      .bodies = grains_.body,
      .walls = walls_,
      .blocks = neighbours_.blocks,
      .colours = neighbours_.colours,
      .count = count_,
      .contacts = contacts_,
      .wall_contacts = wall_contacts_,
      .bias_t = {},
      .wall_bias_t = {},
      .scratch = scratch_,
      .spin_ratio = 1.0 / grains_.inertia,
      .spin_ratios = spin_ratios_,
      .friction = friction_,
      .threads = threads_,
  };
}

template <int dim>
std::pair<DelassusProblem<dim>, Eigen::VectorXd> Simulation<dim>::contact_problem() {
  if (!contacts_current_)
    fail("contact_problem: there is none before the first step, nor after the scene was changed from outside or restored; make a step first");
  Problem<dim> last = problem();
  if (tangential_restitution_) last.bias_t = bias_t_, last.wall_bias_t = wall_bias_t_;
  if (!dragged()) return delassus(last);
  weigh(last_h_);
  last.spin_ratios = spin_ratios_;
  auto problem_and_impulses = delassus(last);
  unweigh();
  return problem_and_impulses;
}

template <int dim>
SolveReport Simulation<dim>::solve_contacts(double h) {
  Problem<dim> problem = this->problem();
  auto solve = [&](Problem<dim>& p, const SolverSettings& limits) {
    if (settings.solver == Solver::nlgs) return solve_nlgs(p, limits);
    if (settings.solver == Solver::newton) return solve_newton(p, limits);
    if (settings.solver == Solver::active_set) return solve_active_set(p, limits);
    if (settings.solver == Solver::accelerated) return solve_accelerated(p, limits);
    return solve_auto(p, limits);
  };
  warm_start(problem);
  SolverSettings limits = settings.solve;
  double fastest2 = 0.0;
  for (const Body<dim>& b : grains_.body) fastest2 = std::max(fastest2, b.v.squaredNorm() + squared(b.s));
  limits.rounding = 8 * std::numeric_limits<double>::epsilon() * std::sqrt(fastest2);
  limits.worst = overlap_share * settings.solve.tolerance * 2 * mean_radius_ / h;
  SolveReport report = solve(problem, limits);
  if (restitution_ && rebound(h)) {
    if (tangential_restitution_) problem.bias_t = bias_t_, problem.wall_bias_t = wall_bias_t_;
    const SolveReport second = solve(problem, limits);
    report = {report.sweeps + second.sweeps, report.updates + second.updates, second.residual, second.worst, second.converged};
  }
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int b = 0; b < static_cast<int>(count_.size()); ++b)
    for (int k = neighbours_.blocks[b].begin; k < neighbours_.blocks[b].begin + count_[b]; ++k)
      neighbours_.pairs[pair_of_[k]].p = contacts_[k].p;
  for (const WallContact<dim>& c : wall_contacts_) neighbours_.wall_pairs[c.pair].p = c.p;
  return report;
}

// Newton's law for contacts that would close in this sub-step and approach faster than the rest speed:
//   0 <= u_n + e u_n^-  perp  p_n >= 0,  without the gap term;  u_t + e_t u_t^- in the place of u_t.
// Once any contact rebounds, one that was opening is held no firmer than by that law, u_n >= -e u_n^-: held at its gap it would turn what
// others rebound with into kinetic energy (three balls in a row, e = 1: by 14 %). With every bias b >= e u_n^-, one e and no friction,
//   (1+e) sum p u_n^- <= -p.W p <= 0  and so  change of energy = sum p (u_n^- - b)/2 <= (1-e)/2 sum p u_n^- <= 0.
// J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988). Friction or unequal e may still break it.
// A gap that the first solve left open can only be closed by what others rebound with. Held there, its grains would be braked before they
// touch, with no rebound to follow: it is left to the next sub-step, to which they come overlapping by at most sub_step_motion radii.
// Returns whether any contact rebounds; without one nothing is changed.
template <int dim>
bool Simulation<dim>::rebound(double h) {
  auto for_contacts = [&](auto&& visit) {
    for (std::size_t b = 0; b < count_.size(); ++b)
      for (int k = neighbours_.blocks[b].begin; k < neighbours_.blocks[b].begin + count_[b]; ++k) {
        Contact<dim>& c = contacts_[k];
        visit(c, materials_.pair(grains_.material[c.i], grains_.material[c.j]),
              relative_velocity(body_before_[c.i], body_before_[c.j], c.n), bias_t_, k);
      }
    for (std::size_t k = 0; k < wall_contacts_.size(); ++k) {
      WallContact<dim>& c = wall_contacts_[k];
      visit(c, law_of(neighbours_.wall_pairs[c.pair]),
            relative_velocity(wall_before_[c.wall], body_before_[c.j], c.n), wall_bias_t_, k);
    }
  };
  auto rebounds = [&](const auto& c, const Materials::Pair& law, const Vec<dim>& u) {
    return c.p.n > 0 && u.dot(c.n) < -settings.rest_speed && (law.normal > 0 || law.tangential > 0);
  };
  bool any = false;
  for_contacts([&](const auto& c, const Materials::Pair& law, const Vec<dim>& u, auto&, std::size_t) { any = any || rebounds(c, law, u); });
  if (!any) return false;
  if (tangential_restitution_) {
    bias_t_.assign(contacts_.size(), zero<Tangent<dim>>());
    wall_bias_t_.assign(wall_contacts_.size(), zero<Tangent<dim>>());
  }
  for_contacts([&](auto& c, const Materials::Pair& law, const Vec<dim>& u, std::vector<Tangent<dim>>& bias_t, std::size_t k) {
    const double u_n = u.dot(c.n);
    if (rebounds(c, law, u)) {
      c.bias = law.normal * u_n;
      if (tangential_restitution_) bias_t[k] = law.tangential * tangential(u, c.n);
    } else {
      if (c.p.n <= 0 && c.bias > 0 && law.normal > 0) c.bias += settings.sub_step_motion * grains_.r[c.j] / h;
      c.bias = std::max(c.bias, law.normal * u_n);
    }
  });
  return true;
}

// Work, dissipation and stress of the sub-step. With p the impulse of a contact and u its relative velocity, the change of kinetic
// energy is exactly the sum of p.(u before + u after)/2 plus the work of what acts from outside.
template <int dim>
void Simulation<dim>::account(double h, StepReport<dim>& report) {
  const int n_blocks = static_cast<int>(neighbours_.blocks.size());
  sums_.resize(n_blocks);
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int b = 0; b < n_blocks; ++b) {
    Sums sums;
    const int begin = neighbours_.blocks[b].begin;
    for (int k = begin; k < begin + count_[b]; ++k) {
      const Contact<dim>& c = contacts_[k];
      if (c.p.n <= 0) continue;
      const Vec<dim> p = c.p.n * c.n + tangent_vector(c.n, c.p.t);
      const Vec<dim> u = relative_velocity(body_before_[c.i], body_before_[c.j], c.n) +
                         relative_velocity(grains_.body[c.i], grains_.body[c.j], c.n);
      const double branch = grains_.r[c.i] + grains_.r[c.j] + gap_[pair_of_[k]];
      sums.power += 0.5 * p.dot(u);
      sums.branch += branch;
      sums.virial += p * (branch * c.n).transpose();
      ++sums.contacts;
    }
    sums.candidates = count_[b];
    sums_[b] = sums;
  }
  double power = 0.0;
  for (const Sums& s : sums_) {
    power += s.power;
    report.branch_length += s.branch;
    report.contacts += s.contacts;
    report.candidates += s.candidates;
    report.virial_contacts += s.virial;
  }
  report.candidates += static_cast<long>(wall_contacts_.size());
  double work_walls = 0.0, work_forces = 0.0, kinetic = 0.0, kinetic_before = 0.0;
  for (const WallContact<dim>& c : wall_contacts_) {
    if (c.p.n <= 0) continue;
    const Vec<dim> p = c.p.n * c.n + tangent_vector(c.n, c.p.t);
    Wall<dim>& wall = walls_[c.wall];
    const Vec<dim> u = relative_velocity(wall_before_[c.wall], body_before_[c.j], c.n) +
                       relative_velocity(wall.v, grains_.body[c.j], c.n);
    power += 0.5 * p.dot(u);
    wall.force -= p;
    for (int k = 0; k < dim; ++k)
      if (wall.inv_m[k] == 0) work_walls += p[k] * wall.v[k];
    report.virial_wall_contacts += p * (grains_.r[c.j] * c.n).transpose();
  }
  for (std::size_t w = 0; w < walls_.size(); ++w)
    for (int k = 0; k < dim; ++k) {
      if (walls_[w].inv_m[k] == 0) continue;
      const double before = wall_before_[w][k], after = walls_[w].v[k];
      work_walls += h * walls_[w].load[k] * 0.5 * (before + after);
      kinetic += 0.5 * after * after / walls_[w].inv_m[k];
      kinetic_before += 0.5 * before * before / walls_[w].inv_m[k];
    }
  const bool pulled = !gravity.isZero(0.0), forced = !grains_.force.empty(), dragged = this->dragged();
  for (int k = 0; k < grains_.size(); ++k) {
    const Body<dim>&before = body_before_[k], &after = grains_.body[k];
    if (before.inv_m == 0) continue;
    const double m = 1.0 / before.inv_m;  // after: with drag, see weigh()
    kinetic += 0.5 * m * (after.v.squaredNorm() + grains_.inertia * squared(after.s));
    kinetic_before += 0.5 * m * (before.v.squaredNorm() + grains_.inertia * squared(before.s));
    if (!pulled && !forced && !dragged) continue;
    Vec<dim> f = m * gravity;
    if (forced) f += grains_.force[k];
    if (dragged) {
      const int id = grains_.id[k];
      Vec<dim> drag = drag_.coefficient[id] * (drag_.velocity[id] - after.v);
      if (!drag_.added_mass.empty()) drag -= drag_.added_mass[id] / h * (after.v - before.v);
      drag_.impulse[id] += h * drag;
      f += drag;
    }
    work_forces += 0.5 * h * f.dot(before.v + after.v);
  }
  report.kinetic_energy = kinetic;
  report.work_walls += work_walls;
  report.work_forces += work_forces;
  report.dissipation -= power;
  report.energy_balance_error += kinetic - kinetic_before - work_walls - work_forces - power;
}

template <int dim>
void Simulation<dim>::move(double h) {
  const int n = grains_.size();
  for (Wall<dim>& wall : walls_) wall.point += h * wall.v, wall.moved += h * wall.v;
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int k = 0; k < n; ++k) {
    if (grains_.wall[k] >= 0) grains_.body[k].v = walls_[grains_.wall[k]].v;
    grains_.x[k] += h * grains_.body[k].v;
  }
}

template <int dim>
ContactList<dim> Simulation<dim>::contacts() const {
  ContactList<dim> list;
  auto push = [&](std::int64_t i, int j, const auto& c) {
    list.i.push_back(i);
    list.j.push_back(grains_.id[j]);
    list.normal.push_back(c.n);
    list.point.push_back(box_.wrap(grains_.x[j] - grains_.r[j] * c.n));
    list.force_normal.push_back(c.p.n / last_h_);
    list.force_tangential.push_back(tangent_vector(c.n, c.p.t) / last_h_);
  };
  each_loaded_contact([&](const Contact<dim>& c) { push(grains_.id[c.i], c.j, c); });
  for (const WallContact<dim>& c : wall_contacts_)
    if (c.p.n > 0) push(-1 - c.wall, c.j, c);
  return list;
}

template <int dim>
std::size_t Simulation<dim>::memory() const {
  auto bytes = [](const auto& v) { return v.capacity() * sizeof(v[0]); };
  return bytes(grains_.x) + bytes(grains_.body) + bytes(grains_.r) + bytes(grains_.id) + bytes(grains_.wall) +
         bytes(grains_.material) + bytes(grains_.force) + bytes(neighbours_.pairs) + bytes(neighbours_.wall_pairs) +
         bytes(gap_) + bytes(contacts_) + bytes(pair_of_) + bytes(wall_contacts_) + bytes(scratch_.packs) + bytes(scratch_.slots) +
         bytes(scratch_.list) + bytes(scratch_.touched) + bytes(body_before_) + bytes(bias_t_);
}

template class Simulation<2>;  // of the members defined here
template class Simulation<3>;

}  // namespace quicksand
