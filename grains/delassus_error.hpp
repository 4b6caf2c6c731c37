// What sweeps and Newton's method share: a row of W r + q, the error of a problem, and the best iterate seen.
#pragma once

#include "contact.hpp"
#include "delassus.hpp"

namespace quicksand {

template <int dim>
[[gnu::always_inline]] inline Vec<dim> row_velocity(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r, int c) {
  Vec<dim> u = problem.q.template segment<dim>(dim * c);
  for (int k = problem.row_start[c]; k < problem.row_start[c + 1]; ++k)
    u.noalias() += problem.blocks[k] * r.template segment<dim>(dim * problem.column[k]);
  return u;
}

// The tangential components of one contact in the form that contact.hpp takes.
inline double tangent_of(const Vec<2>& v) { return v[1]; }
inline Vec<3> tangent_of(const Vec<3>& v) { return {0.0, v[1], v[2]}; }

template <int dim>
class Best {
 public:
  Best(const DelassusProblem<dim>& problem, const DelassusSettings& settings) : problem_(problem), settings_(settings) {}

  // Measures r, keeps it if it is the best so far, and notes its error in the report. Returns whether it is good enough.
  bool look(const Eigen::VectorXd& r, DelassusReport& report) {
    double e2 = 0.0, size2 = 0.0, u2 = 0.0, worst = 0.0;
    for (int c = 0; c < problem_.contacts(); ++c) {
      const Vec<dim> u = row_velocity(problem_, r, c), p = r.template segment<dim>(dim * c);
      const double w = problem_.blocks[problem_.diagonal[c]](0, 0), rho = settings_.norm == Norm::fclib ? 1.0 : 1.0 / w;
      const double one = natural_map<dim>({p[0], tangent_of(p)}, u[0], tangent_of(u), rho, problem_.friction[c]);
      const double weight = settings_.norm == Norm::fclib ? 1.0 : w;
      e2 += weight * one, size2 += weight * p.squaredNorm(), u2 += u.squaredNorm();
      worst = std::max(worst, w * w * one);
    }
    report.worst = std::sqrt(worst);
    const double size = settings_.norm == Norm::fclib ? std::sqrt(std::max({size2, u2, problem_.q.squaredNorm()})) : std::sqrt(size2);
    report.error = e2 == 0.0 ? 0.0 : (size > 0 ? std::sqrt(e2) / size : std::numeric_limits<double>::infinity());
    if (!std::isfinite(report.error)) report.error = std::numeric_limits<double>::infinity();
    report.error_history.push_back(report.error);
    report.iteration_history.push_back(report.iterations);
    report.converged = (report.error <= settings_.tolerance && report.worst <= settings_.worst) || report.worst <= settings_.rounding;
    if (r_.size() == 0 || report.converged || report.error < error_)
      r_ = r, error_ = report.error, worst_ = report.worst;
    return report.converged;
  }

  void take(Eigen::VectorXd& r, DelassusReport& report) const { r = r_, report.error = error_, report.worst = worst_; }

 private:
  const DelassusProblem<dim>& problem_;
  const DelassusSettings& settings_;
  Eigen::VectorXd r_;
  double error_ = std::numeric_limits<double>::infinity(), worst_ = 0.0;
};

// newton.cpp
template <int dim>
void iterate_newton(const DelassusProblem<dim>& problem, Eigen::VectorXd& r, const DelassusSettings& settings, DelassusReport& report,
                    Best<dim>& best);

}  // namespace quicksand
