// Frictional contact problems with their Delassus operator written out: u = W r + q, as other codes exchange them (FCLIB) and as a scene
// poses them (solvers.hpp). The local blocks of W may be full: not only discs and spheres.
#pragma once

#include "geometry.hpp"

#include <limits>
#include <span>
#include <string>
#include <vector>

namespace quicksand {

// Per contact (n, t) in 2D, (n, t1, t2) in 3D; r_n >= 0 pushes apart. The law, De Saxce and Feng, Math. Comput. Modelling 28 (1998):
//   K* contains u + mu |u_t| n  perp  r in K = {|r_t| <= mu r_n}
template <int dim>
struct DelassusProblem {
  using Block = Mat<dim>;
  std::vector<int> row_start{0};  // blocks of contact c: row_start[c] ... row_start[c + 1] - 1
  std::vector<int> column;        // of each block, ascending in a row
  std::vector<Block> blocks;      // of W
  std::vector<int> diagonal;      // W_cc of each contact, as an index into `blocks`
  Eigen::VectorXd q;
  std::vector<double> friction;   // [-]

  int contacts() const { return static_cast<int>(friction.size()); }
};

// What an error is measured by; both are 0 exactly at a solution. e = r - P_K(r - rho (u + mu |u_t| n)), the natural map:
enum class Norm {
  fclib,   // |e| / max(|q|, |u|, |r|) with rho = 1: that of the FCLIB community, for problems without units
  energy,  // |D e| / |D r|, D = sqrt(W_nn), with rho = 1/W_nn: free of units, that of scenes
};

struct DelassusSettings {
  Norm norm = Norm::fclib;
  double tolerance = 1e-8;
  double worst = std::numeric_limits<double>::infinity();  // on W_nn |e| of every contact, rho = 1/W_nn
  double rounding = 0.0;                                   // W_nn |e| that is as good as 0
  int max_iterations = 100000;
};

struct DelassusReport {
  std::string solver;                  // that made the last iterations: "nlgs", "accelerated" or "newton"
  int iterations = 0;                  // sweeps and Newton iterations
  double error = 0.0, worst = 0.0;     // at the end
  bool converged = false;
  std::vector<double> error_history;   // every time it was measured
  std::vector<int> iteration_history;  // iterations made by then
};

// A problem from its scalar CSR matrix. Throws std::invalid_argument: sizes that do not match, a contact with W_nn <= 0, values that are
// not finite.
template <int dim>
DelassusProblem<dim> delassus_problem(std::span<const int> row_start, std::span<const int> column, std::span<const double> value,
                                      std::span<const double> q, std::span<const double> friction);

// u = W r + q
template <int dim>
Eigen::VectorXd contact_velocity(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r);

// All start from `r` and leave the best found there; its error is in the report.
// Nonlinear Gauss-Seidel, every contact solved exactly in its turn: M. Jean, CMAME 177 (1999).
template <int dim>
DelassusReport solve_nlgs(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings);

// Symmetric Gauss-Seidel with Nesterov's extrapolation, as that of solvers.hpp.
template <int dim>
DelassusReport solve_accelerated(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings);

// Semismooth Newton (Alart and Curnier, CMAME 92 (1991)) inside a proximal point iteration (Rockafellar, SIAM J. Control Optim. 14
// (1976)), which makes systems with more contacts than freedoms regular and takes nothing from the solution.
template <int dim>
DelassusReport solve_newton(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings);

// solve_accelerated while its progress promises to be cheaper than Newton's factorisations, then Newton; sweeps again should it fail.
template <int dim>
DelassusReport solve_auto(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings);

// How far r is from the solution: sqrt(dr . W dr / r* . W r*), the energy of what is still missing of the velocities that contacts
// have to make, relative to all they make. A small natural map is no such thing: it is local, and in a pile of L layers hides errors
// L^2 times larger. The solution r* is estimated by one Newton step, contacts that touch without a force taken as closed, with a
// proximal term of 1e-8, which errors over up to 1e4 layers do not feel. Where that does not bring the natural map down tenfold, many
// contacts still have to open or slide: then by solve_auto to a thousandth of the natural map of r, and such a step from there, which
// shows what sweeps have left. Infinity: no step could be made. Costs a factorisation, or a solve and two.
template <int dim>
double global_error(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r);

}  // namespace quicksand
