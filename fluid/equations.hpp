// The volume-averaged equations on one element: Anderson and Jackson, Ind. Eng. Chem. Fund. 6 (1967), "model A", constant density,
//   d(eps)/dt + div U = 0,   U = eps u,
//   rho eps (du/dt + (u - w) . grad u) = -eps grad p + eps div(2 eta D(u)) + eps rho g - beta (u - v) + f,
// u the velocity of the fluid, eps the void fraction, w the velocity of the mesh, beta (v - u) + f the force of what else is there [N/m^3].
// Unknowns are U and p: their divergence and gradient stand alone, whatever eps does. eps is continuous and as smooth as U.
// Momentum is tested with w as it stands, its viscous term integrated by parts: 2 eta D(u) : grad(eps w); the natural condition is that
// the viscous traction vanishes. A pure function of values; fluid.cpp loops.
#pragma once

#include "element.hpp"

namespace quicksand::fluid {

template <int dim>
using Mat = Eigen::Matrix<double, dim, dim>;

template <int dim>
struct Properties {
  double density = 0.0;    // [kg/m^3]
  double viscosity = 0.0;  // [Pa s]
  Vec<dim> gravity = Vec<dim>::Zero();  // [m/s^2]
};

// df/dt = a[0] f(t) + a[1] f(t - dt) + a[2] f(t - 2 dt): backward Euler, BDF2; all 0 for a steady flow.
using TimeWeights = std::array<double, 3>;  // [1/s]

// Of the grains, at a quadrature point.
template <int dim>
struct Reaction {
  double beta = 0.0;                       // [kg/(m^3 s)]
  Vec<dim> beta_target = Vec<dim>::Zero(); // [N/m^3]
  Vec<dim> force = Vec<dim>::Zero();       // [N/m^3]
};

template <int dim, int order>
struct ElementInput {
  static constexpr int n = shape_count<dim, order>;
  std::array<Vec<dim>, dim + 1> x;                 // vertices [m]
  std::array<std::array<double, n>, 3> eps;        // now, and one and two steps ago, on the same material points of the mesh
  std::array<std::array<Vec<dim>, n>, 3> flux;     // U: [0] the guess that advects, then the past [m/s]
  std::array<Vec<dim>, dim + 1> mesh_velocity;     // [m/s]
  const Reaction<dim>* reaction = nullptr;         // at each quadrature point, or none
  std::array<const Vec<dim>*, 2> subscale{};       // order 1: one and two steps ago, at each quadrature point [m/s]; none: 0
  bool advection = true;
  bool newton = false;                             // derivative of the advection as well; otherwise by the guess alone
};

// Unknown i of velocity node a: dof_of(a) + i, for vertices followed by p.
template <int dim>
constexpr int dof_of(int a) {
  return a <= dim ? a * (dim + 1) : (dim + 1) * (dim + 1) + (a - dim - 1) * dim;
}
template <int dim, int order>
constexpr int element_dofs = shape_count<dim, order> * dim + dim + 1;

template <int dim, int order>
struct ElementSystem {
  static constexpr int dofs = element_dofs<dim, order>;
  Eigen::Matrix<double, dofs, dofs, Eigen::RowMajor> a;
  Eigen::Matrix<double, dofs, 1> b;
};

// The finer scales' own velocity U' [m/s], of which linear elements know nothing but this, at each quadrature point:
//   rho dU'/dt + U'/tau = -(residual of the momentum),   U + U' is what continuity holds for.
// It lives on from step to step, after R. Codina, J. Principe, O. Guasch and S. Badia, CMAME 196 (2007). Were it made anew in every step, with the
// time step in tau, another time step would be another divergence of U, and cost a pressure of rho tau/dt times the residual.
// 1/tau without time after Shakib, Hughes and Johan, CMAME 89 (1991), with the metric of the element, so that stretched elements are judged by the
// direction of the flow; `tau` below [m^3 s/kg] is 1/(rho a[0] + 1/tau). And the bulk viscosity [Pa s] that goes with it: it knows neither the time
// step nor beta: with them, it would lock the flow as they grow.
template <int dim>
struct Stabilisation {
  double tau, bulk;
};
template <int dim>
Stabilisation<dim> stabilisation(const Geometry<dim>& g, const Properties<dim>& fluid, const Vec<dim>& u, double rate, double beta_over_eps) {
  Mat<dim> metric = Mat<dim>::Zero();  // 4/h^2 for a regular simplex of edge h
  for (const Vec<dim>& grad : g.grad_l) metric += 2.0 * grad * grad.transpose();
  const double advective = fluid.density * fluid.density * u.dot(metric * u);
  const double viscous = 9.0 * fluid.viscosity * fluid.viscosity * metric.squaredNorm();
  const double steady = advective + viscous;
  return {1.0 / (fluid.density * rate + std::sqrt(steady + beta_over_eps * beta_over_eps)), std::sqrt(steady) / metric.trace()};
}

// rho (a[1] U' + a[2] U'') of past subscales at quadrature point q [N/m^3].
template <int dim, int order>
Vec<dim> memory(const ElementInput<dim, order>& in, const Properties<dim>& fluid, const TimeWeights& time, int q) {
  Vec<dim> sum = Vec<dim>::Zero();
  for (int t = 0; t < 2; ++t)
    if (in.subscale[t]) sum += fluid.density * time[t + 1] * in.subscale[t][q];
  return sum;
}

template <int dim, int order>
void element_system(const ElementInput<dim, order>& in, const Properties<dim>& fluid, const TimeWeights& time, ElementSystem<dim, order>& out) {
  constexpr int n = shape_count<dim, order>;
  const Geometry<dim> g = geometry<dim>(in.x);
  const double rho = fluid.density, eta = fluid.viscosity;
  out.a.setZero(), out.b.setZero();
  int q = 0;
  for (const auto& point : quadrature<dim, order>()) {
    const double weight = point.weight * g.volume;
    const auto shape = shapes<dim, order>(point.l);
    const auto grad = shape_gradients<dim, order>(point.l, g.grad_l);
    std::array<double, 3> eps{};
    std::array<Vec<dim>, 3> flux;
    Vec<dim> grad_eps = Vec<dim>::Zero(), mesh_velocity = Vec<dim>::Zero();
    for (int t = 0; t < 3; ++t) {
      flux[t].setZero();
      for (int a = 0; a < n; ++a) eps[t] += shape[a] * in.eps[t][a], flux[t] += shape[a] * in.flux[t][a];
    }
    for (int a = 0; a < n; ++a) grad_eps += in.eps[0][a] * grad[a];
    for (int a = 0; a <= dim; ++a) mesh_velocity += point.l[a] * in.mesh_velocity[a];
    const Reaction<dim> reaction = in.reaction ? in.reaction[q] : Reaction<dim>{};
    const Vec<dim> past_subscale = memory<dim, order>(in, fluid, time, q);
    ++q;
    const double inv_eps = 1.0 / eps[0];
    const Vec<dim> u = flux[0] * inv_eps, relative = in.advection ? Vec<dim>(u - mesh_velocity) : Vec<dim>::Zero();
    std::array<Vec<dim>, n> grad_u, grad_test;  // of u = U/eps, and of eps w, per unit of each unknown
    std::array<double, n> carried;              // eps (u - w) . grad u
    Mat<dim> slope = Mat<dim>::Zero();          // grad u of the guess, d u_i / d x_j
    for (int a = 0; a < n; ++a) {
      grad_u[a] = (grad[a] - shape[a] * inv_eps * grad_eps) * inv_eps;
      grad_test[a] = eps[0] * grad[a] + shape[a] * grad_eps;
      carried[a] = eps[0] * relative.dot(grad_u[a]);
      slope += in.flux[0][a] * grad_u[a].transpose();
    }
    const Vec<dim> past = time[1] / eps[1] * flux[1] + time[2] / eps[2] * flux[2];  // of du/dt
    const Vec<dim> load = eps[0] * rho * (fluid.gravity - past) + reaction.beta_target + reaction.force +
                          (in.newton ? Vec<dim>(rho * slope * flux[0]) : Vec<dim>::Zero());
    const double eps_rate = time[0] * (eps[0] - eps[1]) - time[2] * (eps[1] - eps[2]) - mesh_velocity.dot(grad_eps);  // at a fixed point
    const Stabilisation<dim> stab = stabilisation<dim>(g, fluid, relative, time[0], reaction.beta * inv_eps);
    std::array<double, n> inertia;  // what acts along U itself: rho dU/dt, advection, reaction
    for (int b = 0; b < n; ++b) inertia[b] = rho * (time[0] * shape[b] + carried[b]) + reaction.beta * inv_eps * shape[b];

    for (int a = 0; a < n; ++a) {
      // SUPG: the residual tested with tau rho (u - w) . grad w, beside w. Order 2 does without.
      const double test = shape[a] + (order == 1 ? stab.tau * rho * relative.dot(grad[a]) : 0.0);
      const int row = dof_of<dim>(a);
      for (int b = 0; b < n; ++b) {
        const int column = dof_of<dim>(b);
        const double diagonal = weight * (test * inertia[b] + eta * grad_u[b].dot(grad_test[a]));
        for (int i = 0; i < dim; ++i) {
          out.a(row + i, column + i) += diagonal;
          for (int j = 0; j < dim; ++j) {
            double value = eta * grad_u[b][i] * grad_test[a][j] + stab.bulk * grad[a][i] * grad[b][j];
            if (in.newton) value += test * rho * shape[b] * slope(i, j);
            out.a(row + i, column + j) += weight * value;
          }
        }
      }
      for (int b = 0; b <= dim; ++b)
        for (int i = 0; i < dim; ++i) out.a(row + i, dof_of<dim>(b) + dim) += weight * test * eps[0] * g.grad_l[b][i];
      for (int i = 0; i < dim; ++i) out.b[row + i] += weight * (test * load[i] - stab.bulk * grad[a][i] * eps_rate);
    }
    for (int a = 0; a <= dim; ++a) {
      const int row = dof_of<dim>(a) + dim;
      for (int b = 0; b < n; ++b)
        for (int j = 0; j < dim; ++j) out.a(row, dof_of<dim>(b) + j) += weight * point.l[a] * grad[b][j];
    }
    if constexpr (order == 1) {
      // The viscous force -eps div(2 eta D(u)) does not vanish where eps varies: second derivatives of U/eps, U and eps linear.
      std::array<Mat<dim>, n> viscous, strong;  // of the momentum, column j by U_j
      for (int b = 0; b < n; ++b) {
        const Mat<dim> cross = grad[b] * grad_eps.transpose();
        const Mat<dim> hessian = (2.0 * shape[b] * inv_eps * grad_eps * grad_eps.transpose() - cross - cross.transpose()) * (inv_eps * inv_eps);
        viscous[b] = -eps[0] * eta * (hessian + hessian.trace() * Mat<dim>::Identity());
        strong[b] = viscous[b] + inertia[b] * Mat<dim>::Identity();
        if (in.newton) strong[b] += rho * shape[b] * slope;
      }
      for (int a = 0; a < n; ++a) {
        const double along = weight * stab.tau * rho * relative.dot(grad[a]);
        const Vec<dim> test = weight * stab.tau * grad[a];  // PSPG: continuity holds for U less tau times the residual
        const int row = dof_of<dim>(a);
        for (int b = 0; b < n; ++b) {
          const int column = dof_of<dim>(b);
          out.a.template block<dim, dim>(row, column) += along * viscous[b];
          out.a.template block<1, dim>(row + dim, column) += test.transpose() * strong[b];
          out.a(row + dim, column + dim) += eps[0] * test.dot(grad[b]);
        }
        for (int i = 0; i < dim; ++i) out.b[row + i] -= along * past_subscale[i];
        out.b[row + dim] += test.dot(load - past_subscale);
      }
    }
  }
}

// The subscale U' at each quadrature point, where U and p are found: rho dU'/dt + U'/tau = -(residual of the momentum).
// R. Codina, J. Principe, O. Guasch and S. Badia, CMAME 196 (2007).
template <int dim>
void element_subscale(const ElementInput<dim, 1>& in, const Properties<dim>& fluid, const TimeWeights& time, const std::array<Vec<dim>, dim + 1>& found, const std::array<double, dim + 1>& p, Vec<dim>* out) {
  constexpr int n = dim + 1;
  const Geometry<dim> g = geometry<dim>(in.x);
  const double rho = fluid.density, eta = fluid.viscosity;
  const auto& grad = g.grad_l;
  int q = 0;
  for (const auto& point : quadrature<dim, 1>()) {
    std::array<double, 3> eps{};
    std::array<Vec<dim>, 3> flux;
    Vec<dim> grad_eps = Vec<dim>::Zero(), mesh_velocity = Vec<dim>::Zero(), now = Vec<dim>::Zero(), grad_p = Vec<dim>::Zero();
    for (int t = 0; t < 3; ++t) {
      flux[t].setZero();
      for (int a = 0; a < n; ++a) eps[t] += point.l[a] * in.eps[t][a], flux[t] += point.l[a] * in.flux[t][a];
    }
    for (int a = 0; a < n; ++a) grad_eps += in.eps[0][a] * grad[a], mesh_velocity += point.l[a] * in.mesh_velocity[a], now += point.l[a] * found[a], grad_p += p[a] * grad[a];
    const double inv_eps = 1.0 / eps[0];
    const Reaction<dim> reaction = in.reaction ? in.reaction[q] : Reaction<dim>{};
    const Vec<dim> relative = in.advection ? Vec<dim>(flux[0] * inv_eps - mesh_velocity) : Vec<dim>::Zero();
    Vec<dim> residual = eps[0] * grad_p + rho * time[0] * now + reaction.beta * inv_eps * now - reaction.beta_target - reaction.force -
                        eps[0] * rho * (fluid.gravity - time[1] / eps[1] * flux[1] - time[2] / eps[2] * flux[2]);
    for (int b = 0; b < n; ++b) {
      const Vec<dim> grad_u = (grad[b] - point.l[b] * inv_eps * grad_eps) * inv_eps;
      const Mat<dim> cross = grad[b] * grad_eps.transpose();
      const Mat<dim> hessian = (2.0 * point.l[b] * inv_eps * grad_eps * grad_eps.transpose() - cross - cross.transpose()) * (inv_eps * inv_eps);
      residual += rho * eps[0] * relative.dot(grad_u) * found[b] - eps[0] * eta * (hessian * found[b] + hessian.trace() * found[b]);
    }
    const double tau = stabilisation<dim>(g, fluid, relative, time[0], reaction.beta * inv_eps).tau;
    out[q] = -tau * (residual + memory<dim, 1>(in, fluid, time, q));
    ++q;
  }
}

}  // namespace quicksand::fluid
