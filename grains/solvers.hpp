// The contact problem of one sub-step and the solvers for it. A solver is a function from a Problem to a SolveReport; it changes
// velocities and impulses together, so that v = v_free + M^-1 H p holds at every moment. A new solver is one more such function.
#pragma once

#include "contact.hpp"
#include "delassus.hpp"
#include "neighbours.hpp"
#include "wide.hpp"

#include <limits>
#include <span>

namespace quicksand {

// Doubling, as vectors do when they grow, would cost some hundred bytes per grain.
template <class Vector>
void resize_tight(Vector& values, std::size_t n) {
  if (n > values.capacity()) values.reserve(n + n / 8);
  values.resize(n);
}

// What solvers keep in memory from one problem to the next.
struct Scratch {
  std::vector<Pack> packs;                // 2D: the contacts, block by block
  std::vector<PackGeneral> general;       // of each pack, for the general law
  std::vector<std::array<int, 4>> slots;  // of the contacts of each pack, from the first slot of a block on; -1: empty lane
  std::vector<int> first, units;          // per block: first pack; packs, or in 3D contacts
  std::vector<int> list, listed;          // per slot, per block: what has not settled
  std::vector<int> touched;               // per grain
};

template <int dim>
struct Problem {
  std::span<Body<dim>> bodies;
  std::span<Wall<dim>> walls;
  std::span<const Block> blocks;                  // slots of `contacts` that belong to each block
  std::span<const int> colours;                   // see Neighbours
  std::span<const int> count;                     // contacts in use, from the first slot of each block
  std::span<Contact<dim>> contacts;
  std::span<WallContact<dim>> wall_contacts;
  std::span<const Tangent<dim>> bias_t;           // tangential restitution e_t u_t^- per slot [m/s]; empty: none
  std::span<const Tangent<dim>> wall_bias_t;
  Scratch& scratch;
  double spin_ratio;                              // m r^2/I [-]
  // With drag a body's inverse mass is 1/(m + m_a + h gamma), but its spin is as light as ever: (m + m_a + h gamma) r^2/I per body [-]; empty: no drag.
  std::span<const double> spin_ratios;
  bool friction;                                  // false: no contact has any, and nothing turns
  int threads;

  double spin_ratio_of(int body) const { return spin_ratios.empty() ? spin_ratio : spin_ratios[body]; }
};

struct SolverSettings {
  double tolerance = 1e-2;   // on the residual [-]
  double worst = std::numeric_limits<double>::infinity();  // on W_nn |e| of every contact [m/s]
  double rounding = 0.0;     // W_nn |e| that velocities in double precision cannot tell from 0 [m/s]
  int max_sweeps = 5000;     // over the contacts
  int max_newton = 500;      // Newton iterations, each a factorisation; a fifth of them where they are the fallback
  int active_sweeps = 6;     // over contacts that have not settled, before each over all that these have touched
  double omega = 1.5;        // over-relaxation to start from [-]
};

struct SolveReport {
  int sweeps = 0;            // over all contacts or over some
  long updates = 0;          // contacts visited in these sweeps, in 2D four at a time
  double residual = 0.0;     // |D e|/|D r|, e the natural map, D = sqrt(W_nn) [-]
  double worst = 0.0;        // largest W_nn |e| of one contact: a velocity [m/s]
  bool converged = true;
};

// Nonlinear Gauss-Seidel, M. Jean, CMAME 177 (1999): the reference.
template <int dim>
SolveReport solve_nlgs(Problem<dim>& problem, const SolverSettings& settings);

// Over-relaxed Gauss-Seidel. A sweep over all contacts, then rounds: several sweeps over those whose impulse has not settled yet,
// one over those with a grain that these have moved. What is left elsewhere is found when the residual of all is measured. The
// relaxation falls back towards 1 when progress stalls.
template <int dim>
SolveReport solve_active_set(Problem<dim>& problem, const SolverSettings& settings);

// Symmetric Gauss-Seidel (a sweep to and fro: X. Li, D. Sun, K.-C. Toh, Math. Program. 155 (2016)) with Nesterov's extrapolation and
// restarts (restart.hpp): sweeps grow as the height of the scene, not as its square.
template <int dim>
SolveReport solve_accelerated(Problem<dim>& problem, const SolverSettings& settings);

// Newton's method on the Delassus operator written out (delassus.hpp): few iterations however tall the scene, each a factorisation.
template <int dim>
SolveReport solve_newton(Problem<dim>& problem, const SolverSettings& settings);

// solve_active_set, but where there are few contacts; what takes more than some hundred of its sweeps by solve_accelerated; should that run out of sweeps, solve_newton,
// then solve_nlgs.
template <int dim>
SolveReport solve_auto(Problem<dim>& problem, const SolverSettings& settings);

// The same problem as u = W r + q, r its impulses: contacts block by block, then those with walls. q holds the biases.
template <int dim>
std::pair<DelassusProblem<dim>, Eigen::VectorXd> delassus(const Problem<dim>& problem);

// Adds H p of the stored impulses to the velocities.
template <int dim>
void warm_start(Problem<dim>& problem);

}  // namespace quicksand
