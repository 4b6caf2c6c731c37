// PETSc and MPI, which stay behind this door: a linear system distributed by rows, and what ranks tell each other.
#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

namespace quicksand::fluid {

// Starts MPI and PETSc when nobody has yet; they end with the process. Every function below does so by itself.
void start_petsc();
// Options as on PETSc's command line, "-ksp_monitor -log_view"; those of the environment variable PETSC_OPTIONS hold as well. A solver
// reads them when it is made. Throws std::invalid_argument.
void set_petsc_options(const std::string& options);

int rank();
int ranks();
void sum_over_ranks(std::span<double> values);
// Each rank's own part of x, first[r] ... first[r + 1] - 1, to all ranks.
void share(std::vector<double>& x, const std::vector<int>& first);

enum class Method {
  direct,    // MUMPS; its factors serve on as a preconditioner of GMRES while few iterations are enough
  ilu,       // GMRES with ILU(0) of each rank's blocks of a node's unknowns
  fieldsplit,  // flexible GMRES; velocity by ILU(0), pressure by multigrid on A_pu diag(A_uu)^-1 A_up (SELFP)
};

struct LinearSettings {
  Method method = Method::direct;
  double tolerance = 1e-11;     // on the residual, preconditioned, relative to the first one of this system or of recent ones [-]
  int max_iterations = 1000;
  int fill_levels = 0;          // of ILU, on one process
  int most_with_old_factors = 16;  // iterations: more, and the next matrix is factorised anew
};

struct LinearReport {
  int iterations = 0;
  bool factorised = false;      // anew in this solve
  bool converged = false;
  double residual = 0.0;        // relative, at the end
  std::string reason;           // in PETSc's words
};

class LinearSolver {
 public:
  // Rows begin ... end - 1 of `size` are this rank's; columns ascend in each row. With ilu, rows come in blocks of `block` that have the same
  // columns; fieldsplit needs to know which of this rank's rows are pressures.
  LinearSolver(int begin, int end, int size, const std::vector<int>& row_start, const std::vector<int>& column, LinearSettings settings,
               int block = 1, const std::vector<int>& pressures = {}, const std::string& prefix = "");
  ~LinearSolver();
  // x of this rank's rows from 0; `values` along row_start and column. A looser tolerance than that of the settings is relative to this system.
  LinearReport solve(std::span<const double> values, std::span<const double> b, std::span<double> x, double tolerance = 0.0);
  void forget();  // factors and scales of earlier systems

 private:
  struct State;
  std::unique_ptr<State> s_;
};

}  // namespace quicksand::fluid
