// Problems with W written out: their error, sweeps over them, and the choice between sweeps and Newton's method (newton.cpp).
#include "contact.hpp"
#include "delassus_error.hpp"
#include "errors.hpp"

#include <Eigen/LU>
#include <numeric>

namespace quicksand {

template <int dim>
DelassusProblem<dim> delassus_problem(std::span<const int> row_start, std::span<const int> column, std::span<const double> value,
                                      std::span<const double> q, std::span<const double> friction) {
  const int n = static_cast<int>(friction.size());
  const std::size_t rows = static_cast<std::size_t>(n) * dim;
  constexpr const char* where = "solve_contact_problem";
  if (q.size() != rows) fail("{}: q must have {} entries, {} per contact, got {}", where, rows, dim, q.size());
  if (row_start.size() != rows + 1 || row_start[0] != 0 || !std::is_sorted(row_start.begin(), row_start.end()) ||
      row_start.back() != static_cast<int>(column.size()) || column.size() != value.size())
    fail("{}: W must be a CSR matrix of {} x {}", where, rows, rows);
  for (int c : column)
    if (c < 0 || c >= static_cast<int>(rows)) fail("{}: W must be a CSR matrix of {} x {}, got column {}", where, rows, rows, c);
  for (const auto& values : {value, q, friction})
    for (double x : values)
      if (!is_finite(x)) fail("{}: W, q and friction must be finite, got {}", where, x);

  DelassusProblem<dim> problem;
  problem.q = Eigen::Map<const Eigen::VectorXd>(q.data(), rows);
  problem.friction.assign(friction.begin(), friction.end());
  std::vector<int> place(n, -1), columns;  // block of each column in the row at hand
  for (int c = 0; c < n; ++c) {
    if (friction[c] < 0) fail("{}: friction must be >= 0, got {} (contact {})", where, friction[c], c);
    columns.assign(1, c);
    for (int k = row_start[dim * c]; k < row_start[dim * (c + 1)]; ++k) columns.push_back(column[k] / dim);
    std::sort(columns.begin(), columns.end());
    columns.erase(std::unique(columns.begin(), columns.end()), columns.end());
    for (int d : columns) {
      if (d == c) problem.diagonal.push_back(static_cast<int>(problem.column.size()));
      place[d] = static_cast<int>(problem.column.size());
      problem.column.push_back(d);
      problem.blocks.push_back(Mat<dim>::Zero());
    }
    for (int a = 0; a < dim; ++a)
      for (int k = row_start[dim * c + a]; k < row_start[dim * c + a + 1]; ++k)
        problem.blocks[place[column[k] / dim]](a, column[k] % dim) += value[k];
    problem.row_start.push_back(static_cast<int>(problem.column.size()));
    const double w = problem.blocks[problem.diagonal[c]](0, 0);
    if (w <= 0) fail("{}: W_nn of every contact must be > 0, got {} (contact {})", where, w, c);
  }
  return problem;
}

template <int dim>
Eigen::VectorXd contact_velocity(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r) {
  Eigen::VectorXd u(r.size());
  for (int c = 0; c < problem.contacts(); ++c) u.segment<dim>(dim * c) = row_velocity(problem, r, c);
  return u;
}

namespace {

// W_cc without the parts that are rounding only: a contact of two bodies that cannot turn about each other has a singular block.
template <int dim>
Mat<dim> local_inverse(const Mat<dim>& block) {
  Mat<dim> regular = block;
  regular.diagonal().array() += 1e-14 * block.trace();
  return regular.inverse();
}

// The contact problem of one contact, w = W r + q, solved exactly: open, sticking, or sliding in direction -r_t.
Vec<2> solve_contact(const Mat<2>& w, const Mat<2>& inverse, const Vec<2>& q, double friction, const Vec<2>&) {
  if (q[0] >= 0) return Vec<2>::Zero();
  Vec<2> r = -inverse * q;
  if (r[0] >= 0 && std::abs(r[1]) <= friction * r[0]) return r;
  for (const double way : {1.0, -1.0}) {  // sign of the sliding velocity
    const double w_n = w(0, 0) - way * friction * w(0, 1);
    if (w_n <= 0) continue;
    r = Vec<2>{1.0, -way * friction} * (-q[0] / w_n);
    if (way * (w.row(1).dot(r) + q[1]) >= 0) break;
  }
  return r;
}

// Sliding in 3D: u_n = 0, r_t = -mu r_n d, and d is the direction of u_t. The angle of d by Newton's method from the last one.
Vec<3> solve_contact(const Mat<3>& w, const Mat<3>& inverse, const Vec<3>& q, double friction, const Vec<3>& last) {
  if (q[0] >= 0) return Vec<3>::Zero();
  const Vec<3> stick = -inverse * q;
  if (stick[0] >= 0 && stick.tail<2>().norm() <= friction * stick[0]) return stick;
  using Vec2 = Eigen::Vector2d;
  const Vec2 w_nt = w.block<1, 2>(0, 1).transpose(), w_tn = w.block<2, 1>(1, 0);
  const Eigen::Matrix2d w_tt = w.block<2, 2>(1, 1);
  Vec2 d = -last.tail<2>();
  if (d.squaredNorm() == 0) d = q.tail<2>();
  if (d.squaredNorm() == 0) d = -stick.tail<2>();
  if (d.squaredNorm() == 0) d = Vec2::UnitX();
  d.normalize();
  double r_n = 0.0;
  for (int iteration = 0; iteration < 15; ++iteration) {
    double w_n = w(0, 0) - friction * w_nt.dot(d);
    if (w_n <= 1e-12 * w(0, 0)) w_n = w(0, 0);  // sliding that way would jam: no solution there
    r_n = -q[0] / w_n;
    const Vec2 across{-d[1], d[0]}, a = w_tn - friction * w_tt * d, u_t = q.tail<2>() + a * r_n;
    const double off = u_t.dot(across);
    if (std::abs(off) <= 1e-12 * u_t.norm() && u_t.dot(d) >= 0) break;
    const double dr_n = r_n / w_n * friction * w_nt.dot(across);
    const double slope = (a * dr_n - friction * r_n * w_tt * across).dot(across) - u_t.dot(d);
    const double turn = slope < 0 ? std::clamp(-off / slope, -0.7, 0.7) : (off > 0 ? 0.5 : -0.5);
    d = (d + std::tan(turn) * across).normalized();
  }
  Vec<3> r;
  r << r_n, -friction * r_n * d;
  return r;
}

template <int dim>
class Sweeps {
 public:
  explicit Sweeps(const DelassusProblem<dim>& problem) : problem_(problem), inverse_(problem.contacts()) {
    for (int c = 0; c < problem.contacts(); ++c) inverse_[c] = local_inverse<dim>(problem.blocks[problem.diagonal[c]]);
  }

  void sweep(Eigen::VectorXd& r, double omega) const {
    for (int c = 0; c < problem_.contacts(); ++c) {
      auto r_c = r.template segment<dim>(dim * c);
      const Vec<dim> before = r_c;
      const Mat<dim>& w = problem_.blocks[problem_.diagonal[c]];
      const double friction = problem_.friction[c];
      Vec<dim> next = solve_contact(w, inverse_[c], Vec<dim>(row_velocity(problem_, r, c) - w * before), friction, before);
      if (omega != 1.0) {
        next = before + omega * (next - before);
        const double most = friction * std::max(next[0], 0.0), t = next.template tail<dim - 1>().norm();
        next[0] = std::max(next[0], 0.0);
        if (t > most) next.template tail<dim - 1>() *= most / t;
      }
      r_c = next;
    }
  }

 private:
  const DelassusProblem<dim>& problem_;
  std::vector<Mat<dim>> inverse_;
};

// Seconds, to an order of magnitude: what decides between sweeps and factorisations must not be a clock, or results would not repeat.
template <int dim>
double seconds_of_sweep(const DelassusProblem<dim>& problem) {
  return 1e-9 * (0.25 * dim * dim * static_cast<double>(problem.blocks.size()) + 30.0 * problem.contacts());
}
template <int dim>
double seconds_of_newton(const DelassusProblem<dim>& problem) {  // some 15 factorisations
  const double n = dim * static_cast<double>(problem.contacts()), entries = dim * dim * static_cast<double>(problem.blocks.size());
  return 15 * std::min(1e-10 * n * n * n, 1e-8 * entries * std::sqrt(n));
}

// Sweeps until the error is below the tolerance, `more` sweeps are made, or what is left to do would take longer than `seconds`.
template <int dim>
void sweep(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings, int more, double seconds,
           DelassusReport& report, Best<dim>& best) {
  const Sweeps<dim> sweeps(problem);
  report.solver = "nlgs";
  const double one = seconds_of_sweep(problem);
  double omega = settings.omega, before = std::numeric_limits<double>::infinity();
  int wait = 5;
  for (int made = 0; made < more && !report.converged;) {
    wait = std::min(wait, more - made);
    for (int k = 0; k < wait; ++k) sweeps.sweep(r, omega);
    made += wait, report.iterations += wait;
    best.look(r, report);
    // The error falls like a geometric series where the set of contacts that slide or open has settled.
    const double rate = std::log(report.error / before) / wait, left = std::log(settings.tolerance / report.error) / rate;
    const bool falls = report.error < 0.99 * before;
    if (std::isfinite(before) && made >= 20 && !(falls && left * one < seconds)) {
      if (omega > 1.0) omega = 1.0;  // over-relaxation may cycle
      else if (std::isfinite(seconds)) return;
    }
    before = report.error;
    wait = falls && left > 0 ? std::clamp(static_cast<int>(0.7 * left), 5, std::max(made / 2, 5)) : 10;
  }
}

}  // namespace

template <int dim>
DelassusReport solve_nlgs(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  DelassusReport report;
  Best<dim> best(problem, settings);
  if (!best.look(r, report)) sweep(problem, r, settings, settings.max_iterations, std::numeric_limits<double>::infinity(), report, best);
  best.take(r, report);
  return report;
}

template <int dim>
DelassusReport solve_auto(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  DelassusReport report;
  Best<dim> best(problem, settings);
  if (best.look(r, report)) return report;
  // In 2D 1.3 takes about 0.6 times the sweeps of 1 (FrictionContactProblem00237: 180 instead of 320; 1.5 cycles there), on the 3D
  // problems of tests/data 1.3 to 1.7 take as many or more.
  DelassusSettings sweeping = settings;
  if (dim == 2) sweeping.omega = 1.3;
  sweep(problem, r, sweeping, settings.max_iterations, seconds_of_newton(problem), report, best);
  if (!report.converged && report.iterations < settings.max_iterations) {
    best.take(r, report);
    iterate_newton(problem, r, settings, report, best);
  }
  if (!report.converged && report.iterations < settings.max_iterations) {
    best.take(r, report);
    sweeping.omega = 1.0;
    sweep(problem, r, sweeping, settings.max_iterations - report.iterations, std::numeric_limits<double>::infinity(), report, best);
  }
  best.take(r, report);
  return report;
}

#define INSTANTIATE(dim)                                                                                                          \
  template DelassusProblem<dim> delassus_problem(std::span<const int>, std::span<const int>, std::span<const double>,            \
                                                 std::span<const double>, std::span<const double>);                              \
  template Eigen::VectorXd contact_velocity(const DelassusProblem<dim>&, const Eigen::VectorXd&);                                \
  template DelassusReport solve_nlgs(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);                    \
  template DelassusReport solve_auto(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);
INSTANTIATE(2)
INSTANTIATE(3)
#undef INSTANTIATE

}  // namespace quicksand
