// Newton's method for contact problems, regularised by proximal points: see delassus.hpp.
#define EIGEN_DONT_PARALLELIZE  // results do not depend on the number of threads
#include "delassus_error.hpp"

#include <Eigen/LU>
#include <Eigen/Sparse>
#include <Eigen/SparseLU>

namespace quicksand {

namespace {

// Solves J x = b, J in blocks of the size of a contact. Dense where J is small or nearly full.
template <int dim>
class BlockLU {
 public:
  // rows[k], columns[k] of blocks[k]; false: J is singular
  bool factorise(int n, const std::vector<int>& rows, const std::vector<int>& columns, const std::vector<Mat<dim>>& blocks) {
    dense_ = n * dim <= 60 || static_cast<double>(blocks.size()) > 0.2 * n * static_cast<double>(n);
    if (dense_) {
      Eigen::MatrixXd j = Eigen::MatrixXd::Zero(n * dim, n * dim);
      for (std::size_t k = 0; k < blocks.size(); ++k) j.block<dim, dim>(dim * rows[k], dim * columns[k]) += blocks[k];
      full_.compute(j);
      return true;
    }
    entries_.clear();
    for (std::size_t k = 0; k < blocks.size(); ++k)
      for (int a = 0; a < dim; ++a)
        for (int b = 0; b < dim; ++b) entries_.emplace_back(dim * rows[k] + a, dim * columns[k] + b, blocks[k](a, b));
    Eigen::SparseMatrix<double> j(n * dim, n * dim);
    j.setFromTriplets(entries_.begin(), entries_.end());
    if (rows != rows_ || columns != columns_) sparse_.analyzePattern(j), rows_ = rows, columns_ = columns;
    sparse_.factorize(j);
    return sparse_.info() == Eigen::Success;
  }
  Eigen::VectorXd solve(const Eigen::VectorXd& b) {
    if (dense_) return full_.solve(b);
    return sparse_.solve(b);
  }

 private:
  bool dense_ = true;
  Eigen::PartialPivLU<Eigen::MatrixXd> full_;
  Eigen::SparseLU<Eigen::SparseMatrix<double>> sparse_;
  std::vector<Eigen::Triplet<double>> entries_;
  std::vector<int> rows_, columns_;
};

// One proximal problem: u = (W + alpha D) r + q - alpha D r_k, D = W_nn of each contact. Alart and Curnier's function, one contact:
//   f_n = r_n - (r_n - rho u_n)+ ,   f_t = r_t - P_disc(mu (r_n - rho u_n)+)(r_t - rho_t u_t) ,   rho = 1/W_nn
// rho_t = rho but where drag makes W_tt many times W_nn (of full discs and spheres 3 and 3.5): r_t - rho u_t would then overshoot the disc
// however small the slip, and one contact that sticks would take more than 500 iterations.
template <int dim>
class ProximalProblem {
 public:
  static constexpr int t = dim - 1;
  using VecT = Eigen::Matrix<double, t, 1>;

  ProximalProblem(const DelassusProblem<dim>& problem, const Eigen::VectorXd& centre, double alpha)
      : problem_(problem), centre_(centre), alpha_(alpha), f_(centre.size()), trial_(problem.contacts()) {}

  // |f| at r, in the energy norm: sqrt(sum W_nn |f|^2).
  double merit(const Eigen::VectorXd& r) {
    double f2 = 0.0;
    for (int c = 0; c < problem_.contacts(); ++c) {
      const Vec<dim> r_c = r.template segment<dim>(dim * c);
      const double w = w_nn(c);
      Vec<dim> way = row_velocity(problem_, r, c) / w + alpha_ * (r_c - centre_.template segment<dim>(dim * c));
      way.template tail<t>() *= share_t(c);
      trial_[c] = r_c - way;
      Vec<dim> f = r_c;
      if (const double n = trial_[c][0]; n > 0) {
        const VecT z = trial_[c].template tail<t>();
        const double bound = problem_.friction[c] * n, norm = z.norm();
        f[0] -= n;
        f.template tail<t>() -= norm > bound ? VecT(z * (bound / norm)) : z;
      }
      f_.template segment<dim>(dim * c) = f;
      f2 += w * f.squaredNorm();
    }
    return std::sqrt(f2);
  }

  // The Newton step at the r of the last merit(); false: the system is singular. Open contacts (f = r) leave it at once. `first`: a
  // contact that touches without a force counts as closed. f is the same, and the first step through a pile at rest then reaches its
  // top instead of climbing one layer; later steps would cycle between the two.
  bool step(BlockLU<dim>& lu, Eigen::VectorXd& dr, bool first) {
    const int n = problem_.contacts();
    number_.assign(n, -1);
    closed_.clear();
    nothing_ = 0.0;
    for (int c = 0; c < n && first; ++c) nothing_ = std::max(nothing_, 1e-12 * w_nn(c) * std::abs(trial_[c][0]));
    for (int c = 0; c < n; ++c)
      if (trial_[c][0] > 0 || (first && w_nn(c) * trial_[c][0] >= -nothing_)) number_[c] = static_cast<int>(closed_.size()), closed_.push_back(c);
    dr = -f_;
    if (closed_.empty()) return true;
    rows_.clear(), columns_.clear(), blocks_.clear();
    Eigen::VectorXd b(dim * closed_.size());
    for (std::size_t k = 0; k < closed_.size(); ++k) {
      const int c = closed_[k];
      const auto [own, by_velocity] = derivative(c);  // df = own dr_c + by_velocity rho du_c
      const double w = w_nn(c);
      Vec<dim> right = -f_.template segment<dim>(dim * c);
      for (int m = problem_.row_start[c]; m < problem_.row_start[c + 1]; ++m) {
        const int d = problem_.column[m];
        Mat<dim> block = by_velocity * problem_.blocks[m] / w;
        if (d == c) block += own + alpha_ * by_velocity;
        if (number_[d] < 0) {
          right -= block * dr.template segment<dim>(dim * d);
        } else {
          rows_.push_back(static_cast<int>(k)), columns_.push_back(number_[d]), blocks_.push_back(block);
        }
      }
      b.template segment<dim>(dim * k) = right;
    }
    if (!lu.factorise(static_cast<int>(closed_.size()), rows_, columns_, blocks_)) return false;
    const Eigen::VectorXd x = lu.solve(b);
    for (std::size_t k = 0; k < closed_.size(); ++k) dr.template segment<dim>(dim * closed_[k]) = x.template segment<dim>(dim * k);
    return x.allFinite();
  }

 private:
  double w_nn(int c) const { return problem_.blocks[problem_.diagonal[c]](0, 0); }
  double share_t(int c) const {  // rho_t/rho
    const double w_tt = problem_.blocks[problem_.diagonal[c]].diagonal().template tail<t>().mean();
    return w_tt > 4 * w_nn(c) ? 4 * w_nn(c) / w_tt : 1.0;
  }

  std::pair<Mat<dim>, Mat<dim>> derivative(int c) const {  // of a closed contact
    Mat<dim> own = Mat<dim>::Zero(), by_velocity = Mat<dim>::Zero();
    by_velocity(0, 0) = 1.0;
    const VecT z = trial_[c].template tail<t>();
    const double friction = problem_.friction[c], bound = friction * std::max(trial_[c][0], 0.0), norm = z.norm();
    using MatT = Eigen::Matrix<double, t, t>;
    const MatT one = MatT::Identity();
    if (norm <= bound + nothing_ / w_nn(c)) {
      by_velocity.template block<t, t>(1, 1) = one;
    } else {
      const VecT way = z / norm;
      const MatT turning = bound / norm * (one - way * way.transpose());
      own.template block<t, t>(1, 1) = one - turning;
      own.template block<t, 1>(1, 0) = -friction * way;
      by_velocity.template block<t, t>(1, 1) = turning;
      by_velocity.template block<t, 1>(1, 0) = friction * way;
    }
    by_velocity.template rightCols<t>() *= share_t(c);
    return {own, by_velocity};
  }

  const DelassusProblem<dim>& problem_;
  const Eigen::VectorXd& centre_;
  double alpha_;
  double nothing_ = 0.0;  // W_nn |r - rho u| that rounding cannot tell from 0 [m/s]
  Eigen::VectorXd f_;
  std::vector<Vec<dim>> trial_;  // r - rho u
  std::vector<int> number_, closed_, rows_, columns_;
  std::vector<Mat<dim>> blocks_;
};

// Of 1e-2 to 1e-6 and factors 0.2 and 0.05: the eight third-party problems are solved with any of them; a small alpha reaches across more
// layers of a pile in one step (about 1/sqrt(alpha)), a large one needs fewer steps in systems with more contacts than freedoms.
constexpr double first_alpha = 1e-3, least_alpha = 1e-12, falls_by = 0.05;
constexpr int most_inner = 30, most_outer = 60;

// Iterates may leave the cones by their error; an answer pulls nothing together and holds no more than friction can.
template <int dim>
Eigen::VectorXd in_cones(const DelassusProblem<dim>& problem, Eigen::VectorXd r) {
  for (int c = 0; c < problem.contacts(); ++c) {
    auto p = r.template segment<dim>(dim * c);
    p[0] = std::max(p[0], 0.0);
    const double bound = problem.friction[c] * p[0], norm = p.template tail<dim - 1>().norm();
    if (norm > bound) p.template tail<dim - 1>() *= bound / norm;
  }
  return r;
}

}  // namespace

template <int dim>
void iterate_newton(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings, DelassusReport& report,
                    Best<dim>& best) {
  report.solver = "newton";
  BlockLU<dim> lu;
  Eigen::VectorXd centre = r, dr, next;
  double alpha = first_alpha;
  for (int outer = 0; outer < most_outer && !report.converged; ++outer) {
    ProximalProblem<dim> proximal(problem, centre, alpha);
    double f = proximal.merit(r);
    const double start = f;
    bool solved = true;
    for (int k = 0; k < most_inner && f > 1e-2 * start && report.iterations < settings.max_iterations; ++k) {
      if (!proximal.step(lu, dr, outer == 0 && k == 0)) { solved = false; break; }
      ++report.iterations;
      double length = 1.0, f_next = 0.0;
      for (;; length *= 0.5) {
        // No descent on any part of the way: the whole step, for f is not smooth and may have to rise first.
        if (length < 1e-3) { f_next = proximal.merit(next = r + dr); break; }
        f_next = proximal.merit(next = r + length * dr);
        if (f_next < (1 - 1e-4 * length) * f) break;
      }
      r.swap(next);
      f = f_next;
    }
    if (!solved || !(f <= 0.5 * start)) {
      r = centre;
      alpha *= 10;
    } else {
      centre = r;
      alpha = std::max(falls_by * alpha, least_alpha);
    }
    best.look(in_cones(problem, r), report);
    if (report.iterations >= settings.max_iterations) break;
  }
}

template <int dim>
DelassusReport solve_newton(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  DelassusReport report;
  Best<dim> best(problem, settings);
  if (!best.look(r, report)) iterate_newton(problem, r, settings, report, best);
  best.take(r, report);
  return report;
}

template <int dim>
double global_error(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r) {
  constexpr double unknown = std::numeric_limits<double>::infinity();
  DelassusReport report;
  DelassusSettings settings{.norm = Norm::energy, .max_iterations = 20000};
  Best<dim> best(problem, settings);
  best.look(r, report);
  if (report.error == 0.0) return 0.0;
  const double before = report.error;
  const auto size = [&](const Eigen::VectorXd& p) { return std::sqrt(std::max(p.dot(contact_velocity(problem, p) - problem.q), 0.0)); };
  const auto step_from = [&](const Eigen::VectorXd& from) -> Eigen::VectorXd {
    BlockLU<dim> lu;
    ProximalProblem<dim> proximal(problem, from, 1e-8);
    Eigen::VectorXd dr;
    if (proximal.merit(from) == 0.0) return from;
    if (!proximal.step(lu, dr, true)) return Eigen::VectorXd::Constant(r.size(), unknown);
    return from + dr;
  };
  Eigen::VectorXd solution = step_from(r);
  best.look(solution, report);
  if (!(report.error <= 0.1 * before)) {  // contacts still have to open or slide
    settings.tolerance = std::max(1e-3 * std::min(before, 1.0), 1e-13);
    solution = r;
    solve_auto(problem, solution, settings);
    solution = step_from(solution);
  }
  const double of_all = solution.allFinite() ? size(solution) : 0.0;
  return of_all > 0 ? size(solution - r) / of_all : unknown;
}

#define INSTANTIATE(dim)                                                                                                             \
  template void iterate_newton(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&, DelassusReport&, Best<dim>&); \
  template double global_error(const DelassusProblem<dim>&, const Eigen::VectorXd&);                                                 \
  template DelassusReport solve_newton(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);
INSTANTIATE(2)
INSTANTIATE(3)
#undef INSTANTIATE

}  // namespace quicksand
