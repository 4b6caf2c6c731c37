#include "petsc.hpp"

#include <fmt/format.h>
#include <petscksp.h>

#include <algorithm>
#include <cstdlib>
#include <stdexcept>

namespace quicksand::fluid {

namespace {

void check(PetscErrorCode error, const char* what) {
  if (error == 0) return;
  const char* text = nullptr;
  char* detail = nullptr;
  PetscErrorMessage(error, &text, &detail);
  throw std::runtime_error(fmt::format("PETSc failed in {}: {} ({})", what, text ? text : "unknown error", detail ? detail : ""));
}
#define PETSC(call) check(call, #call)

}  // namespace

void start_petsc() {
  PetscBool there = PETSC_FALSE;
  PetscInitialized(&there);
  if (there) return;
  if (PetscInitializeNoArguments() != 0) throw std::runtime_error("PETSc could not be started");
  PetscPushErrorHandler(PetscReturnErrorHandler, nullptr);  // errors become exceptions, without a page on standard error
  PetscPopSignalHandler();                                  // Ctrl-C belongs to the script
  std::atexit([] {
    PetscBool over = PETSC_FALSE;
    PetscFinalized(&over);
    if (!over) PetscFinalize();
  });
}

void set_petsc_options(const std::string& options) {
  start_petsc();
  if (PetscOptionsInsertString(nullptr, options.c_str()) != 0)
    throw std::invalid_argument(fmt::format("petsc_options: must be pairs \"-name value\" as on PETSc's command line, got \"{}\"", options));
}

int rank() {
  start_petsc();
  int r;
  MPI_Comm_rank(PETSC_COMM_WORLD, &r);
  return r;
}

int ranks() {
  start_petsc();
  int n;
  MPI_Comm_size(PETSC_COMM_WORLD, &n);
  return n;
}

void sum_over_ranks(std::span<double> values) {
  start_petsc();
  MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<int>(values.size()), MPI_DOUBLE, MPI_SUM, PETSC_COMM_WORLD);
}

void share(std::vector<double>& x, const std::vector<int>& first) {
  if (ranks() == 1) return;
  std::vector<int> counts(ranks());
  for (int r = 0; r < ranks(); ++r) counts[r] = first[r + 1] - first[r];
  MPI_Allgatherv(MPI_IN_PLACE, 0, MPI_DATATYPE_NULL, x.data(), counts.data(), first.data(), MPI_DOUBLE, PETSC_COMM_WORLD);
}

struct LinearSolver::State {
  LinearSettings settings;
  Mat matrix = nullptr;
  Vec x = nullptr, b = nullptr;
  KSP ksp = nullptr;
  std::vector<int> row_start, block_column;
  int begin = 0, block = 1;
  bool keep_factors = false;
  double scale = 0.0;  // first residual of recent systems
  std::vector<double> history = std::vector<double>(1);
  ~State() {
    PetscBool over = PETSC_FALSE;
    PetscFinalized(&over);
    if (over) return;
    KSPDestroy(&ksp), VecDestroy(&x), VecDestroy(&b), MatDestroy(&matrix);
  }
};

LinearSolver::LinearSolver(int begin, int end, int size, const std::vector<int>& row_start, const std::vector<int>& column,
                           LinearSettings settings, int block, const std::vector<int>& pressures, const std::string& prefix)
    : s_(std::make_unique<State>()) {
  start_petsc();
  s_->settings = settings, s_->row_start = row_start, s_->begin = begin;
  s_->block = settings.method == Method::ilu ? block : 1;
  const int own = end - begin, bs = s_->block;
  PETSC(MatCreate(PETSC_COMM_WORLD, &s_->matrix));
  PETSC(MatSetSizes(s_->matrix, own, own, size, size));
  PETSC(MatSetOptionsPrefix(s_->matrix, prefix.c_str()));
  if (bs > 1) {
    std::vector<PetscInt> diagonal(own / bs, 0), other(own / bs, 0);
    for (int r = 0; r < own / bs; ++r)
      for (int k = row_start[r * bs]; k < row_start[r * bs + 1]; k += bs) {
        s_->block_column.push_back(column[k] / bs);
        ++(begin <= column[k] && column[k] < end ? diagonal : other)[r];
      }
    PETSC(MatSetType(s_->matrix, MATBAIJ));
    PETSC(MatSetBlockSize(s_->matrix, bs));
    PETSC(MatXAIJSetPreallocation(s_->matrix, bs, diagonal.data(), other.data(), nullptr, nullptr));
  } else {
    std::vector<PetscInt> rows(column.size()), columns(column.begin(), column.end());
    for (int r = 0; r < own; ++r) std::fill(rows.begin() + row_start[r], rows.begin() + row_start[r + 1], begin + r);
    PETSC(MatSetType(s_->matrix, MATAIJ));
    PETSC(MatSetFromOptions(s_->matrix));
    PETSC(MatSetPreallocationCOO(s_->matrix, static_cast<PetscCount>(rows.size()), rows.data(), columns.data()));
  }
  PETSC(MatCreateVecs(s_->matrix, &s_->x, &s_->b));
  PETSC(KSPCreate(PETSC_COMM_WORLD, &s_->ksp));
  PETSC(KSPSetOptionsPrefix(s_->ksp, prefix.c_str()));
  PETSC(KSPSetType(s_->ksp, KSPGMRES));
  PETSC(KSPGMRESSetRestart(s_->ksp, 100));
  PETSC(KSPSetTolerances(s_->ksp, settings.tolerance, 1e-300, PETSC_DEFAULT, settings.max_iterations));
  PC pc;
  PETSC(KSPGetPC(s_->ksp, &pc));
  if (settings.method == Method::direct) {
    PETSC(PCSetType(pc, PCLU));
    PETSC(PCFactorSetMatSolverType(pc, MATSOLVERMUMPS));
    // Room for pivots put off, in per cent of what the analysis expects: MUMPS's own 20 are too few where a reaction begins at once.
    PETSC(KSPSetOperators(s_->ksp, s_->matrix, s_->matrix));
    PETSC(PCFactorSetUpMatSolverType(pc));
    Mat factors;
    PETSC(PCFactorGetMatrix(pc, &factors));
    PETSC(MatMumpsSetIcntl(factors, 14, 200));
  } else if (settings.method == Method::ilu) {
    PETSC(PCSetType(pc, ranks() == 1 ? PCILU : PCBJACOBI));
    PETSC(PCFactorSetLevels(pc, settings.fill_levels));  // nothing where pc is none that factorises
  } else {
    PETSC(KSPSetType(s_->ksp, KSPFGMRES));
    PETSC(PCSetType(pc, PCFIELDSPLIT));
    IS p, u;
    PETSC(ISCreateGeneral(PETSC_COMM_WORLD, static_cast<PetscInt>(pressures.size()), pressures.data(), PETSC_COPY_VALUES, &p));
    PETSC(ISComplement(p, begin, end, &u));
    PETSC(PCFieldSplitSetIS(pc, "u", u));
    PETSC(PCFieldSplitSetIS(pc, "p", p));
    PETSC(ISDestroy(&p));
    PETSC(ISDestroy(&u));
    PETSC(PCFieldSplitSetType(pc, PC_COMPOSITE_SCHUR));
    PETSC(PCFieldSplitSetSchurFactType(pc, PC_FIELDSPLIT_SCHUR_FACT_UPPER));
    PETSC(PCFieldSplitSetSchurPre(pc, PC_FIELDSPLIT_SCHUR_PRE_SELFP, nullptr));
    // Options that the user has set stay.
    for (const auto& [name, value] : {std::pair{"fieldsplit_u_ksp_type", "preonly"}, {"fieldsplit_u_pc_type", ranks() == 1 ? "ilu" : "bjacobi"}, {"fieldsplit_p_ksp_type", "preonly"}, {"fieldsplit_p_pc_type", "hypre"}}) {
      PetscBool set = PETSC_FALSE;
      const std::string option = "-" + prefix + name;
      PETSC(PetscOptionsHasName(nullptr, nullptr, option.c_str(), &set));
      if (!set) PETSC(PetscOptionsSetValue(nullptr, option.c_str(), value));
    }
  }
  PETSC(KSPSetResidualHistory(s_->ksp, s_->history.data(), 1, PETSC_TRUE));
  PETSC(KSPSetFromOptions(s_->ksp));
  PetscInt most = 0;
  PETSC(KSPGetTolerances(s_->ksp, &s_->settings.tolerance, nullptr, nullptr, &most));  // -ksp_rtol, -ksp_max_it
  s_->settings.max_iterations = static_cast<int>(most);
}

LinearSolver::~LinearSolver() = default;

void LinearSolver::forget() { s_->keep_factors = false, s_->scale = 0.0; }

LinearReport LinearSolver::solve(std::span<const double> values, std::span<const double> b, std::span<double> x, double tolerance) {
  LinearReport report;
  if (const int bs = s_->block; bs > 1) {
    const int* columns = s_->block_column.data();
    for (int r = 0; r + 1 < static_cast<int>(s_->row_start.size()); r += bs) {
      const PetscInt row = (s_->begin + r) / bs, count = (s_->row_start[r + 1] - s_->row_start[r]) / bs;
      PETSC(MatSetValuesBlocked(s_->matrix, 1, &row, count, columns, &values[s_->row_start[r]], INSERT_VALUES));
      columns += count;
    }
    PETSC(MatAssemblyBegin(s_->matrix, MAT_FINAL_ASSEMBLY));
    PETSC(MatAssemblyEnd(s_->matrix, MAT_FINAL_ASSEMBLY));
  } else {
    PETSC(MatSetValuesCOO(s_->matrix, values.data(), INSERT_VALUES));
  }
  PetscScalar* to;
  PETSC(VecGetArray(s_->b, &to));
  std::copy(b.begin(), b.end(), to);
  PETSC(VecRestoreArray(s_->b, &to));
  PETSC(KSPSetOperators(s_->ksp, s_->matrix, s_->matrix));
  // Newton's matrices change more from one to the next; and what it goes on to correct may be far below what it began with.
  const bool newton = tolerance > s_->settings.tolerance;
  const int most = newton ? s_->settings.most_with_old_factors / 2 : s_->settings.most_with_old_factors;
  for (bool old = s_->keep_factors;; old = false) {
    PETSC(KSPSetReusePreconditioner(s_->ksp, old ? PETSC_TRUE : PETSC_FALSE));
    // With old factors no more than it costs to make new ones is tried.
    PETSC(KSPSetTolerances(s_->ksp, std::max(tolerance, s_->settings.tolerance), std::max((newton ? 1e-3 : 1.0) * s_->settings.tolerance * s_->scale, 1e-300), PETSC_DEFAULT, old ? 2 * most : s_->settings.max_iterations));
    const PetscErrorCode error = KSPSolve(s_->ksp, s_->b, s_->x);
    KSPConvergedReason reason = KSP_DIVERGED_PC_FAILED;
    PetscInt iterations = 0;
    PetscReal residual = 0.0;
    if (error == 0) {
      PETSC(KSPGetConvergedReason(s_->ksp, &reason));
      PETSC(KSPGetIterationNumber(s_->ksp, &iterations));
      PETSC(KSPGetResidualNorm(s_->ksp, &residual));
      s_->scale = std::max(0.5 * s_->scale, s_->history[0]);
      residual = s_->scale > 0 ? residual / s_->scale : 0.0;
    }
    report.iterations += iterations;
    report.factorised = !old;
    report.converged = reason > 0;
    report.residual = residual;
    report.reason = KSPConvergedReasons[reason];
    s_->keep_factors = report.converged && s_->settings.method == Method::direct && iterations <= most;
    if (report.converged || !old) break;
  }
  const PetscScalar* from;
  PETSC(VecGetArrayRead(s_->x, &from));
  std::copy(from, from + x.size(), x.begin());
  PETSC(VecRestoreArrayRead(s_->x, &from));
  return report;
}

}  // namespace quicksand::fluid
