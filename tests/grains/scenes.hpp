// What the tests of this folder share: scenes of one material, grains added one at a time, state read by id.
// Scenes lie in the plane of the first two axes unless a test says otherwise; in 3D the rest is zero.
#pragma once

#include "grains/simulation.hpp"

#include <gtest/gtest.h>

#include <random>

namespace quicksand::test {

using Dimensions = ::testing::Types<std::integral_constant<int, 2>, std::integral_constant<int, 3>>;
struct DimensionName {
  template <class T>
  static std::string GetName(int) {
    return std::to_string(T::value) + "D";
  }
};

constexpr double density = 2500.0;  // [kg/m^3]
constexpr double g = 9.81;          // [m/s^2]

template <int dim>
double mass(double r) {
  return density * solid_volume<dim>(r);
}

template <int dim>
Vec<dim> in_plane(double x, double y) {
  Vec<dim> v = Vec<dim>::Zero();
  v[0] = x, v[1] = y;
  return v;
}

// Turning from the first axis towards the second.
template <int dim>
Spin<dim> turning(double omega) {
  if constexpr (dim == 2)
    return omega;
  else
    return {0.0, 0.0, omega};
}
inline double in_plane(double spin) { return spin; }
inline double in_plane(const Vec<3>& spin) { return spin.z(); }

// An empty scene of grains and walls, with one friction. Its tolerance is ten times what rounding lets a scene in which grains
// rest on several others reach: gaps are known to 1e-18 m, hence speeds to 1e-14 m/s of the 1e-3 m/s that weight adds in a step.
// Tests of single contacts allow ten times the tolerance.
template <int dim>
Simulation<dim> scene(double friction, const Vec<dim>& period = Vec<dim>::Zero()) {
  Simulation<dim> sim(period);
  sim.set_friction("grain", "grain", friction);
  sim.set_friction("grain", "wall", friction);
  sim.settings.solve.tolerance = 1e-9;
  sim.settings.solve.max_sweeps = 10000;
  return sim;
}

template <int dim>
int add(Simulation<dim>& sim, const Vec<dim>& x, double r, const Vec<dim>& v = Vec<dim>::Zero(),
        const Spin<dim>& omega = zero<Spin<dim>>(), double rho = density) {
  return sim.add({&x, 1}, {&r, 1}, rho, {&v, 1}, {&omega, 1}, "grain");
}

template <int dim>
std::vector<Vec<dim>> positions(const Simulation<dim>& sim) {
  return sim.by_id([](const Grains<dim>& grains, int k) { return grains.x[k]; });
}
template <int dim>
std::vector<Vec<dim>> velocities(const Simulation<dim>& sim) {
  return sim.by_id([](const Grains<dim>& grains, int k) { return grains.body[k].v; });
}
template <int dim>
std::vector<Spin<dim>> spins(const Simulation<dim>& sim) {  // omega [rad/s]
  return sim.by_id([](const Grains<dim>& grains, int k) { return Spin<dim>(grains.body[k].s / grains.r[k]); });
}

template <int dim>
Vec<dim> random_vector(std::mt19937& random, double most) {
  std::uniform_real_distribution<double> component(-most, most);
  Vec<dim> v;
  for (int k = 0; k < dim; ++k) v[k] = component(random);
  return v;
}

// Grains of radius 1 mm on top of each other on a floor, touching, at rest.
template <int dim>
Simulation<dim> column(int layers) {
  auto sim = scene<dim>(0.3);
  sim.gravity = in_plane<dim>(0, -g);
  sim.add_plane(Vec<dim>::Zero(), in_plane<dim>(0, 1), "wall");
  for (int k = 0; k < layers; ++k) add<dim>(sim, in_plane<dim>(0, (2 * k + 1) * 1e-3), 1e-3);
  return sim;
}

// Of a gas of 64 grains.
template <int dim>
constexpr std::array<int, dim> cells() {
  if constexpr (dim == 2)
    return {8, 8};
  else
    return {4, 4, 4};
}

// Grains of radii 0.8 to 1.2 mm near the points of a square or cubic lattice of spacing 3 mm around 0, with random velocities up
// to `speed` along each axis. Adds cells[0] x cells[1] (x cells[2]) of them.
template <int dim>
void add_gas(Simulation<dim>& sim, const std::array<int, dim>& cells, double speed) {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> radius(0.8e-3, 1.2e-3);
  int total = 1;
  for (int n : cells) total *= n;
  for (int c = 0; c < total; ++c) {
    Vec<dim> x;
    for (int k = 0, rest = c; k < dim; rest /= cells[k], ++k) x[k] = 3e-3 * (rest % cells[k] - 0.5 * (cells[k] - 1));
    add<dim>(sim, x + random_vector<dim>(random, 0.2e-3), radius(random), random_vector<dim>(random, speed),
             Spin<dim>(turning<dim>(1.0) * random_vector<1>(random, speed / 1e-3)[0]));
  }
}

}  // namespace quicksand::test
