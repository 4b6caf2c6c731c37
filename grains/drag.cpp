// What drag adds to a step, and what it is told of contacts in return. Its work is in account(), in step.cpp.
#include "impulse.hpp"
#include "simulation.hpp"

#include <algorithm>
#include <numeric>

namespace quicksand {

// The most by which gravity, forces, drag and loads change a velocity in time h.
template <int dim>
double Simulation<dim>::speed_gain(double h) const {
  if (!dragged()) return h * acceleration_;
  const int n = grains_.size();
  double most = 0.0;
#pragma omp parallel for num_threads(threads_) schedule(static) reduction(max : most)
  for (int k = 0; k < n; ++k) {
    const Body<dim>& b = grains_.body[k];
    if (b.inv_m == 0) continue;
    const int id = grains_.id[k];
    const double rate = drag_.coefficient[id] * b.inv_m;
    Vec<dim> a = gravity + rate * (drag_.velocity[id] - b.v);
    if (!grains_.force.empty()) a += b.inv_m * grains_.force[k];
    most = std::max(most, a.norm() / (1.0 + h * rate + drag_.added_mass_of(id) * b.inv_m));
  }
  return h * (most + wall_acceleration_);
}

// m (v - v_before) = h gamma (u - v) - m_a (v - v_before) + other impulses: to these a grain is as heavy as m + m_a + h gamma, for its translation only.
// The true masses stay in body_before_.
template <int dim>
void Simulation<dim>::weigh(double h) {
  const int n = grains_.size();
  spin_ratios_.assign(n, 1.0 / grains_.inertia);
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int k = 0; k < n; ++k) {
    Body<dim>& b = grains_.body[k];
    if (b.inv_m == 0) continue;
    const double heavier = 1.0 + (drag_.added_mass_of(grains_.id[k]) + h * drag_.coefficient[grains_.id[k]]) * b.inv_m;
    b.inv_m /= heavier;
    spin_ratios_[k] *= heavier;
  }
}

template <int dim>
void Simulation<dim>::unweigh() {
  for (int k = 0; k < grains_.size(); ++k) grains_.body[k].inv_m = body_before_[k].inv_m;
}

// Who touches, and the impulses that come of it, by id.
template <int dim>
void Simulation<dim>::note_contacts() {
  auto note = [&](int k, const Vec<dim>& p) {
    if (grains_.id[k] < 0) return;
    drag_.contact_impulse[grains_.id[k]] += p;
    drag_.in_contact[grains_.id[k]] = 1;
  };
  each_loaded_contact([&](const Contact<dim>& c) {
    const Vec<dim> p = impulse_vector<dim>(c.n, c.p.n, c.p.t);
    note(c.i, -p), note(c.j, p);
  });
  for (const WallContact<dim>& c : wall_contacts_)
    if (c.p.n > 0) note(c.j, impulse_vector<dim>(c.n, c.p.n, c.p.t));
}

template <int dim>
std::vector<std::uint8_t> Simulation<dim>::held() const {
  const int n = grains_.size();
  std::vector<int> root(n + walls_.size());  // union-find: grains, then walls
  std::vector<std::uint8_t> axes(root.size(), 0);
  std::iota(root.begin(), root.end(), 0);
  auto find = [&](int k) {
    while (root[k] != k) k = root[k] = root[root[k]];
    return k;
  };
  auto join = [&](int a, int b) {
    const auto [first, last] = std::minmax({find(a), find(b)});
    root[last] = first;
  };
  for (int k = 0; k < n; ++k)
    if (grains_.wall[k] >= 0) join(k, n + grains_.wall[k]);
  std::vector<std::uint8_t> stiff(walls_.size(), 0), leans(n, 0);
  for (std::size_t w = 0; w < walls_.size(); ++w)
    for (int k = 0; k < dim; ++k) stiff[w] |= (walls_[w].inv_m[k] == 0) << k;
  // An impulse mostly across an axis does not hold along it.
  auto lean = [&](int grain, int wall, const Vec<dim>& p) {
    for (int k = 0; k < dim; ++k)
      if (std::abs(p[k]) > 0.05 * p.norm()) leans[grain] |= stiff[wall] & (1 << k);
  };
  each_loaded_contact([&](const Contact<dim>& c) {
    join(c.i, c.j);
    for (const auto [grain, other] : {std::pair{c.i, c.j}, std::pair{c.j, c.i}})
      if (grains_.wall[other] >= 0) lean(grain, grains_.wall[other], impulse_vector<dim>(c.n, c.p.n, c.p.t));
  });
  for (const WallContact<dim>& c : wall_contacts_)
    if (c.p.n > 0) join(c.j, n + c.wall), lean(c.j, c.wall, impulse_vector<dim>(c.n, c.p.n, c.p.t));
  for (int k = 0; k < n; ++k) axes[find(k)] |= leans[k];
  return by_id([&](const Grains<dim>&, int k) { return axes[find(k)]; });
}

template class Simulation<2>;  // of the members defined here
template class Simulation<3>;

}  // namespace quicksand
