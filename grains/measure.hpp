// Measurements that a step does not take by itself: profiles across a scene, hexagonal order.
#pragma once

#include "simulation.hpp"

namespace quicksand {

// Sums over slices of a scene, each grain cut exactly by the slices it crosses. Fixed grains do not count.
template <int dim>
struct Profile {
  std::vector<double> solid;          // volume of grains in each slice [m^3] (2D: m^2)
  std::vector<Vec<dim>> momentum;     // sum of solid x velocity; / solid = mean velocity
  std::vector<Vec<dim>> second;       // sum of solid x velocity^2 per component; / solid - mean^2 = temperature
};

// `bins` slices of equal thickness between `low` and `high` [m] along `axis`.
template <int dim>
Profile<dim> profile(const Simulation<dim>& simulation, int axis, double low, double high, int bins);

// Mean over grains with low <= y <= high of |mean_j exp(6 i theta_ij)|, j nearer than 1.3 (r_i + r_j): 1 in a perfect crystal.
// Grains without neighbours count as 0. NaN when no grain lies there.
double psi6(const Simulation<2>& simulation, double low, double high);

}  // namespace quicksand
