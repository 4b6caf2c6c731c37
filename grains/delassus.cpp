// Problems with W written out: their error, sweeps over them, and the choice between sweeps and Newton's method (newton.cpp).
#include "contact.hpp"
#include "delassus_error.hpp"
#include "restart.hpp"
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

  void sweep(Eigen::VectorXd& r, bool back = false) const {
    const int n = problem_.contacts();
    for (int k = 0; k < n; ++k) {
      const int c = back ? n - 1 - k : k;
      auto r_c = r.template segment<dim>(dim * c);
      const Vec<dim> before = r_c;
      const Mat<dim>& w = problem_.blocks[problem_.diagonal[c]];
      r_c = solve_contact(w, inverse_[c], Vec<dim>(row_velocity(problem_, r, c) - w * before), problem_.friction[c], before);
    }
  }

 private:
  const DelassusProblem<dim>& problem_;
  std::vector<Mat<dim>> inverse_;
};

// Sweeps to and fro, each followed by a step further the way the two have taken.
template <int dim>
class Accelerated {
 public:
  static constexpr const char* name = "accelerated";
  static constexpr int sweeps = 2;

  Accelerated(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r) : sweeps_(problem), w_(r.size()), last_(r), start_(r) {
    for (int c = 0; c < problem.contacts(); ++c)
      w_.template segment<dim>(dim * c).setConstant(problem.blocks[problem.diagonal[c]](0, 0));
  }

  void step(Eigen::VectorXd& r) {
    r = start_;
    sweeps_.sweep(r);
    half_way_ = r;
    sweeps_.sweep(r, true);
    half_way_ = (r - half_way_).cwiseAbs2();
    const double beta = restart_.weigh(std::sqrt(half_way_.dot(w_)));
    restart_.resisted((start_ - r).cwiseProduct(w_).dot(r - last_) > 0);
    start_ = r + beta * (r - last_);
    last_ = r;
  }

 private:
  Sweeps<dim> sweeps_;
  Restart restart_;
  Eigen::VectorXd w_, last_, start_, half_way_;
};

template <int dim>
class GaussSeidel {
 public:
  static constexpr const char* name = "nlgs";
  static constexpr int sweeps = 1;
  GaussSeidel(const DelassusProblem<dim>& problem, const Eigen::VectorXd&) : sweeps_(problem) {}
  void step(Eigen::VectorXd& r) { sweeps_.sweep(r); }

 private:
  Sweeps<dim> sweeps_;
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

// Sweeps until the error is below the tolerance, `more` sweeps are made, or what is left to do promises to take longer than `seconds`.
template <class Method, int dim>
void sweep(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings, int more, double seconds,
           DelassusReport& report, Best<dim>& best) {
  Method method(problem, r);
  report.solver = Method::name;
  const double one = seconds_of_sweep(problem);
  std::vector<std::pair<int, double>> seen;  // sweeps, least error by then
  double least = std::numeric_limits<double>::infinity();
  for (int made = 0; made < more && !report.converged;) {
    for (int k = 0, n = std::max(5, made / 10); k < n && made < more; k += Method::sweeps, made += Method::sweeps) method.step(r);
    report.iterations += made - (seen.empty() ? 0 : seen.back().first);
    best.look(r, report);
    least = std::min(least, report.error);
    seen.emplace_back(made, least);
    if (made < 40 || !std::isfinite(seconds)) continue;
    // What the second half of the sweeps has gained, the error will go on losing.
    const auto half = *std::find_if(seen.begin(), seen.end(), [&](const auto& s) { return s.first >= made / 2; });
    const double rate = std::log(least / half.second) / (made - half.first);
    if (rate >= 0 || std::log(settings.tolerance / least) / rate * one > seconds) return;
  }
}

constexpr double endless = std::numeric_limits<double>::infinity();

template <class Method, int dim>
DelassusReport with_sweeps(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  DelassusReport report;
  Best<dim> best(problem, settings);
  if (!best.look(r, report)) sweep<Method>(problem, r, settings, settings.max_iterations, endless, report, best);
  best.take(r, report);
  return report;
}

}  // namespace

template <int dim>
DelassusReport solve_nlgs(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  return with_sweeps<GaussSeidel<dim>>(problem, r, settings);
}

template <int dim>
DelassusReport solve_accelerated(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  return with_sweeps<Accelerated<dim>>(problem, r, settings);
}

template <int dim>
DelassusReport solve_auto(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings) {
  DelassusReport report;
  Best<dim> best(problem, settings);
  if (best.look(r, report)) return report;
  sweep<Accelerated<dim>>(problem, r, settings, settings.max_iterations, seconds_of_newton(problem), report, best);
  if (!report.converged && report.iterations < settings.max_iterations) {
    best.take(r, report);
    iterate_newton(problem, r, settings, report, best);
  }
  if (!report.converged && report.iterations < settings.max_iterations) {
    best.take(r, report);
    sweep<Accelerated<dim>>(problem, r, settings, settings.max_iterations - report.iterations, endless, report, best);
  }
  best.take(r, report);
  return report;
}

#define INSTANTIATE(dim)                                                                                                          \
  template DelassusProblem<dim> delassus_problem(std::span<const int>, std::span<const int>, std::span<const double>,            \
                                                 std::span<const double>, std::span<const double>);                              \
  template Eigen::VectorXd contact_velocity(const DelassusProblem<dim>&, const Eigen::VectorXd&);                                \
  template DelassusReport solve_nlgs(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);                    \
  template DelassusReport solve_accelerated(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);             \
  template DelassusReport solve_auto(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);
INSTANTIATE(2)
INSTANTIATE(3)
#undef INSTANTIATE

}  // namespace quicksand
