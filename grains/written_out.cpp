// The contact problem of a scene with its Delassus operator written out, and its solution by Newton's method on that.
#include "impulse.hpp"
#include "solvers.hpp"

namespace quicksand {

namespace {

// Calls visit(contact, bias_t) for every contact, in the order of delassus().
template <int dim, class P, class Visit>
void each_contact(P& problem, Visit&& visit) {
  static const Tangent<dim> none = zero<Tangent<dim>>();
  for (std::size_t b = 0; b < problem.blocks.size(); ++b)
    for (int k = problem.blocks[b].begin; k < problem.blocks[b].begin + problem.count[b]; ++k)
      visit(problem.contacts[k], problem.bias_t.empty() ? none : problem.bias_t[k]);
  for (std::size_t k = 0; k < problem.wall_contacts.size(); ++k)
    visit(problem.wall_contacts[k], problem.wall_bias_t.empty() ? none : problem.wall_bias_t[k]);
}

// The axes of a contact: n, then tangents t with n x t1 = t2.
template <int dim>
Mat<dim> axes(const Vec<dim>& n) {
  Mat<dim> r;
  r.col(0) = n;
  if constexpr (dim == 2) {
    r.col(1) = tangent_vector(n, 1.0);
  } else {
    int least;
    n.cwiseAbs().minCoeff(&least);
    r.col(1) = cross(n, Vec<3>(Vec<3>::Unit(least))).normalized();
    r.col(2) = cross(n, Vec<3>(r.col(1)));
  }
  return r;
}

template <int dim>
Vec<dim> components(const Mat<dim>& axes, double along_n, const Tangent<dim>& t) {
  if constexpr (dim == 2)
    return {along_n, t};
  else
    return {along_n, t.dot(axes.col(1)), t.dot(axes.col(2))};
}

// W of two contacts by a body they share: its translation, and its spin, on whose direction n x t the tangents act.
template <int dim>
Mat<dim> coupling(const Mat<dim>& a, const Mat<dim>& b, double sign, double inv_m, double spin_ratio) {
  Mat<dim> w = (sign * inv_m) * a.transpose() * b;
  if constexpr (dim == 2) {
    w(1, 1) += inv_m * spin_ratio;
  } else {
    Eigen::Matrix<double, 3, 2> turn_a, turn_b;
    turn_a << a.col(2), -a.col(1);
    turn_b << b.col(2), -b.col(1);
    w.template block<2, 2>(1, 1) += inv_m * spin_ratio * turn_a.transpose() * turn_b;
  }
  return w;
}

}  // namespace

template <int dim>
std::pair<DelassusProblem<dim>, Eigen::VectorXd> delassus(const Problem<dim>& problem) {
  struct End {
    int contact;
    double sign;  // +1: body j of the contact
  };
  std::vector<std::vector<End>> of_body(problem.bodies.size()), of_wall(problem.walls.size());
  std::vector<Mat<dim>> frame;
  std::vector<std::array<int, 2>> ends;  // bodies; a wall: -1 - its number
  DelassusProblem<dim> out;
  std::vector<Vec<dim>> r, u;
  each_contact<dim>(problem, [&](const auto& c, const Tangent<dim>& bias_t) {
    const int k = static_cast<int>(frame.size());
    frame.push_back(axes<dim>(c.n));
    out.friction.push_back(c.friction);
    r.push_back(components<dim>(frame.back(), c.p.n, c.p.t));
    Slip<dim> slip;
    of_body[c.j].push_back({k, 1.0});
    if constexpr (requires { c.wall; }) {
      slip = quicksand::slip<Law::coulomb, dim>(problem.walls[c.wall], problem.bodies[c.j], c.n);
      if (!problem.walls[c.wall].inv_m.isZero(0.0)) of_wall[c.wall].push_back({k, -1.0});
      ends.push_back({-1 - c.wall, c.j});
    } else {
      slip = quicksand::slip<Law::coulomb, dim>(problem.bodies[c.i], problem.bodies[c.j], c.n);
      of_body[c.i].push_back({k, -1.0});
      ends.push_back({c.i, c.j});
    }
    u.push_back(components<dim>(frame.back(), slip.n + c.bias, Tangent<dim>(slip.t + bias_t)));
  });
  const int n = static_cast<int>(frame.size());
  out.q.resize(dim * n);
  Eigen::VectorXd impulses(dim * n);
  std::vector<Mat<dim>> row(n);
  std::vector<int> in_row(n, -1), columns;
  for (int c = 0; c < n; ++c) {
    columns.clear();
    auto add = [&](int d, const Mat<dim>& w) {
      if (in_row[d] != c) in_row[d] = c, columns.push_back(d), row[d].setZero();
      row[d] += w;
    };
    for (int end = 0; end < 2; ++end) {
      const int body = ends[c][end];
      const double sign = end == 0 ? -1.0 : 1.0;
      if (body >= 0) {
        for (const End& other : of_body[body])
          add(other.contact, coupling<dim>(frame[c], frame[other.contact], sign * other.sign, problem.bodies[body].inv_m, problem.spin_ratio_of(body)));
      } else {
        for (const End& other : of_wall[-1 - body])
          add(other.contact, frame[c].transpose() * problem.walls[-1 - body].inv_m.asDiagonal() * frame[other.contact]);
      }
    }
    std::sort(columns.begin(), columns.end());
    Vec<dim> q = u[c];
    for (int d : columns) {
      if (d == c) out.diagonal.push_back(static_cast<int>(out.column.size()));
      out.column.push_back(d);
      out.blocks.push_back(row[d]);
      q -= row[d] * r[d];
    }
    out.row_start.push_back(static_cast<int>(out.column.size()));
    out.q.template segment<dim>(dim * c) = q;
    impulses.template segment<dim>(dim * c) = r[c];
  }
  return {std::move(out), std::move(impulses)};
}

template <int dim>
SolveReport solve_newton(Problem<dim>& problem, const SolverSettings& settings) {
  auto [system, r] = delassus(problem);
  const DelassusReport solved = solve_newton(
      system, r,
      DelassusSettings{.norm = Norm::energy, .tolerance = settings.tolerance, .worst = settings.worst, .rounding = settings.rounding,
                       .max_iterations = settings.max_newton});
  int k = 0;
  each_contact<dim>(problem, [&](auto& c, const Tangent<dim>&) {
    const Vec<dim> r_c = r.template segment<dim>(dim * k++);
    const Mat<dim> frame = axes<dim>(c.n);
    Impulse<dim> next{r_c[0], zero<Tangent<dim>>()};
    if constexpr (dim == 2) next.t = r_c[1];
    else next.t = r_c[1] * frame.col(1) + r_c[2] * frame.col(2);
    const Impulse<dim> change{next.n - c.p.n, next.t - c.p.t};
    if constexpr (requires { c.wall; })
      push<Law::coulomb>(problem.walls[c.wall], problem.bodies[c.j], c.n, change.n, change.t, 0.0, problem.spin_ratio_of(c.j));
    else
      push<Law::coulomb>(problem.bodies[c.i], problem.bodies[c.j], c.n, change.n, change.t, problem.spin_ratio_of(c.i), problem.spin_ratio_of(c.j));
    c.p = next;
  });
  SolveReport report;
  report.sweeps = solved.iterations;
  report.updates = static_cast<long>(solved.iterations) * k;
  report.residual = solved.error, report.worst = solved.worst, report.converged = solved.converged;
  return report;
}

template SolveReport solve_newton(Problem<2>&, const SolverSettings&);
template SolveReport solve_newton(Problem<3>&, const SolverSettings&);
template std::pair<DelassusProblem<2>, Eigen::VectorXd> delassus(const Problem<2>&);
template std::pair<DelassusProblem<3>, Eigen::VectorXd> delassus(const Problem<3>&);

}  // namespace quicksand
