// The volume-averaged equations on one element: Anderson and Jackson, Ind. Eng. Chem. Fund. 6 (1967), "model A", constant density,
//   d(eps)/dt + div U = 0,   U = eps u,
//   rho eps (du/dt + (u - w) . grad u) = -eps grad p + eps div(2 eta D(u)) + eps rho g - beta (u - v) + f - y grad p,
// u the velocity of the fluid, eps the void fraction, w the velocity of the mesh, beta (v - u) + f - y grad p the force of what else is there
// [N/m^3]; y stands for grains that the pressure sets in motion (coupling.hpp). Fluid that goes along with grains, their added mass rho_a [kg/m^3], makes it
// heavier over a step, by -rho_a/dt (u - u before).
// Unknowns are U and p: their divergence and gradient stand alone, whatever eps does. eps is continuous and as smooth as U.
// Momentum is tested with w as it stands, its viscous term integrated by parts: 2 eta D(u) : grad(eps w); the natural condition is that
// the viscous traction vanishes. A pure function of values; fluid.cpp loops.
#pragma once

#include "element.hpp"

#include <cmath>

namespace quicksand::fluid {

// T: double, or Lanes.
template <int dim, class T = double>
using Mat = Eigen::Matrix<T, dim, dim>;

template <int dim>
struct Properties {
  double density = 0.0;    // [kg/m^3]
  double viscosity = 0.0;  // [Pa s]
  Vec<dim> gravity = Vec<dim>::Zero();  // [m/s^2]
};

// df/dt = a[0] f(t) + a[1] f(t - dt) + a[2] f(t - 2 dt): backward Euler, BDF2; all 0 for a steady flow.
using TimeWeights = std::array<double, 3>;  // [1/s]

// The same from the changes of f over the last step and the one before: the weights add up to 0 but for rounding, so what does not change has no
// rate however short the step.
template <class T>
T rate(const TimeWeights& a, const T& change, const T& change_before) { return a[0] * change - a[2] * change_before; }

// Of the grains, at a quadrature point.
template <int dim, class T = double>
struct Reaction {
  using Vector = VecOf<dim, T>;
  T beta = 0.0;                          // [kg/(m^3 s)]
  Vector beta_target = Vector::Zero();   // [N/m^3]
  Vector force = Vector::Zero();         // [N/m^3]
  T yield = 0.0;                         // y [-]
  Vector follows = Vector::Zero();       // solid fraction that goes along with the fluid, along each axis: see Fluid::grains_follow
  T inertia = 0.0;                       // rho_a/dt [kg/(m^3 s)]
};

template <int dim, int order, class T = double>
struct ElementInput {
  using Vector = VecOf<dim, T>;
  static constexpr int n = shape_count<dim, order>;
  std::array<Vector, dim + 1> x;                   // vertices [m]
  std::array<std::array<T, n>, 3> eps;             // now, and one and two steps ago, on the same material points of the mesh
  std::array<std::array<Vector, n>, 3> flux;       // U: [0] the guess that advects, then the past [m/s]
  std::array<Vector, order == 1 ? n : 0> eps_slope;  // grad eps now, at the nodes: the mean of the elements around [1/m]
  std::array<Vector, dim + 1> mesh_velocity;       // [m/s]
  const Reaction<dim, T>* reaction = nullptr;      // at each quadrature point, or none
  std::array<T, dim + 1> pressure;                 // one step ago [Pa]
  std::array<const Vector*, 2> subscale{};         // order 1: one and two steps ago, at each quadrature point [m/s]; none: 0
  bool reaction_on_change = false;                 // see Fluid
  const Vector* advance = nullptr;                 // of the solid's flux before, at each quadrature point [m/s]: see Fluid::grains_follow
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

template <int dim, int order, class T = double>
struct ElementSystem {
  static constexpr int dofs = element_dofs<dim, order>;
  Eigen::Matrix<T, dofs, dofs, Eigen::RowMajor> a;
  Eigen::Matrix<T, dofs, 1> b;
};

// 4/h^2 for a regular simplex of edge h: 2 |u|/sqrt(u . m u) is the length of the element along u [1/m^2].
template <int dim, class T>
[[gnu::always_inline]] inline Mat<dim, T> metric(const Geometry<dim, T>& g) {
  Mat<dim, T> m = Mat<dim, T>::Zero();
  for (const auto& grad : g.grad_l) m += 2.0 * grad * grad.transpose();
  return m;
}

// The finer scales' own velocity U' [m/s], of which linear elements know nothing but this, at each quadrature point:
//   rho dU'/dt + U'/tau = -(residual of the momentum),   U + U' is what continuity holds for.
// It lives on from step to step, after R. Codina, J. Principe, O. Guasch and S. Badia, CMAME 196 (2007). Were it made anew in every step, with the
// time step in tau, another time step would be another divergence of U, and cost a pressure of rho tau/dt times the residual.
// 1/tau without time after Shakib, Hughes and Johan, CMAME 89 (1991), with the metric of the element, so that stretched elements are judged by the
// direction of the flow; `tau` below [m^3 s/kg] is 1/(rho a[0] + 1/tau). Added mass counts with rho, not with beta: a steady flow knows
// nothing of it.
// And the bulk viscosity [Pa s], that of LSIC (order 1) or grad-div (order 2): it knows neither the time step nor beta: with them, it would lock the
// flow as they grow. It acts as a pressure -bulk/eps (div U + d(eps)/dt) does, on div(eps w): so the pressure beyond a step of eps is right. Beside
// grains that move it acts on eps div w, so that what is in the fluid has no part of it and none of the momentum is lost.
// Where eps bends, viscous forces have the pressure jump by 2 eta [u'], where it curves, curve; what a continuous, linear pressure cannot follow is
// left to div U, and bulk holds against it. It grows with the square of eps_jump, the change of eps over the element relative to eps: that vanishes
// as h^2 where eps is resolved, so that orders stay. 200 with order 2, measured (docs/fluid.md): the flux through a plug is then right to 0.3 %; 100 misses
// that, 400 makes velocities of a smooth flow (V1) worse by a fifth. 0 in 3D: fieldsplit does not bear more. 40 with order 1, which has eps'' as well.
template <class T>
struct Stabilisation {
  T tau, bulk;
};
template <int dim, int order, class T>
[[gnu::always_inline]] inline Stabilisation<T> stabilisation(const Mat<dim, T>& m, const Properties<dim>& fluid, const VecOf<dim, T>& u, double rate, const T& inertia_over_eps, const T& beta_over_eps, const T& eps_jump) {
  using std::sqrt;
  constexpr double growth = order == 1 ? 40.0 : dim == 2 ? 200.0 : 0.0;
  const T advective = fluid.density * fluid.density * u.dot(m * u);
  const T viscous = 9.0 * fluid.viscosity * fluid.viscosity * m.squaredNorm();
  const T steady = advective + viscous;
  return {1.0 / (fluid.density * rate + (sqrt(steady + beta_over_eps * beta_over_eps) + inertia_over_eps)), (1.0 + growth * eps_jump * eps_jump) * sqrt(steady) / m.trace()};
}

// All that a quadrature point knows before U and p are found.
template <int dim, int order, class T>
struct AtPoint {
  static constexpr int n = shape_count<dim, order>;
  using Vector = VecOf<dim, T>;
  using Matrix = Mat<dim, T>;
  std::array<double, n> shape;
  std::array<Vector, n> grad, grad_u;   // of the shape functions, and of u = U/eps per unit of each unknown
  std::array<T, n> inertia;             // what acts along U itself per unit of each unknown: rho dU/dt, advection, reaction
  T eps, eps_rate;                      // d(eps)/dt at a fixed point
  T drives;                             // what stands before grad p [-]
  Vector past_velocity;                 // one step ago
  Vector follows;                       // of the reaction
  Vector grad_eps, relative;            // u - w of the guess, which advects; 0 for Stokes
  Matrix slope;                         // grad u of the guess, d u_i / d x_j
  Vector load;                          // the momentum's other side
  Matrix eps_curvature;                 // second derivatives of eps, of the slopes at nodes; order 1 only
  Vector beside;                        // what only the subscales' residual has, and no unknown [N/m^3]
  Stabilisation<T> stab;

  [[gnu::always_inline]] AtPoint(const ElementInput<dim, order, T>& in, const Geometry<dim, T>& g, const Matrix& m, const Properties<dim>& fluid, const TimeWeights& time, int q) {
    const auto& point = quadrature<dim, order>()[q];
    const double rho = fluid.density;
    shape = shapes<dim, order>(point.l);
    grad = shape_gradients<dim, order, T>(point.l, g.grad_l);
    std::array<T, 3> eps_at;
    std::array<Vector, 3> flux;
    Vector mesh_velocity = Vector::Zero();
    for (int t = 0; t < 3; ++t) {
      eps_at[t] = 0.0, flux[t].setZero();
      for (int a = 0; a < n; ++a) eps_at[t] += shape[a] * in.eps[t][a], flux[t] += shape[a] * in.flux[t][a];
    }
    grad_eps.setZero();
    for (int a = 0; a < n; ++a) grad_eps += in.eps[0][a] * grad[a];
    for (int a = 0; a <= dim; ++a) mesh_velocity += point.l[a] * in.mesh_velocity[a];
    Reaction<dim, T> reaction = in.reaction ? in.reaction[q] : Reaction<dim, T>{};
    eps = eps_at[0];
    drives = eps + reaction.yield, follows = reaction.follows;
    past_velocity = flux[1] / eps_at[1];
    if (in.reaction_on_change) {
      reaction.beta_target += reaction.beta * past_velocity;
      for (int a = 0; a <= dim; ++a) reaction.force += reaction.yield * in.pressure[a] * g.grad_l[a];
    }
    eps_rate = rate(time, eps_at[0] - eps_at[1], eps_at[1] - eps_at[2]) - mesh_velocity.dot(grad_eps);
    const T inv_eps = 1.0 / eps;
    relative = in.advection ? Vector(flux[0] * inv_eps - mesh_velocity) : Vector::Zero();
    slope.setZero();
    for (int a = 0; a < n; ++a) {
      grad_u[a] = (grad[a] - shape[a] * inv_eps * grad_eps) * inv_eps;
      slope += in.flux[0][a] * grad_u[a].transpose();
      inertia[a] = rho * (time[0] * shape[a] + eps * relative.dot(grad_u[a])) + (reaction.beta + reaction.inertia) * inv_eps * shape[a];
    }
    const Vector past = time[1] * past_velocity + time[2] / eps_at[2] * flux[2];  // of du/dt
    load = eps * rho * (fluid.gravity.template cast<T>() - past) + reaction.beta_target + reaction.force;
    load += reaction.inertia * past_velocity;
    if (in.newton) load += rho * slope * flux[0];
    beside.setZero();
    for (int t = 0; t < 2; ++t)
      if (in.subscale[t]) beside += rho * time[t + 1] * in.subscale[t][q];
    if (in.subscale[0]) beside -= reaction.inertia * inv_eps * in.subscale[0][q];
    eps_curvature.setZero();
    if constexpr (order == 1) {
      for (int a = 0; a < n; ++a) eps_curvature += 0.5 * (in.eps_slope[a] * grad[a].transpose() + grad[a] * in.eps_slope[a].transpose());
      // Where eps is not resolved, h^2 eps''/eps well above 1, it says little, and the subscales of it, some 1/17 of that times u, must not rule U.
      const T steep = 2.0 * dim / m.trace() * eps_curvature.norm() * inv_eps;
      eps_curvature /= 1.0 + steep * steep;
      // U bends where eps does and grains move: what they carry and U add up to a flux without divergence, U = Q - (1 - eps) v, and Q and v are taken to
      // be as smooth as they look: U'' = v eps''. Grains that nobody tells of go with the mesh.
      Vector grains;
      for (int i = 0; i < dim; ++i) grains[i] = select(reaction.beta > 0.0, reaction.beta_target[i] / reaction.beta, mesh_velocity[i]);
      beside -= fluid.viscosity * (eps_curvature * grains + eps_curvature.trace() * grains);
    }
    T least = in.eps[0][0], most = least;
    for (const T& at_node : in.eps[0]) least = select(least > at_node, at_node, least), most = select(at_node > most, at_node, most);
    stab = stabilisation<dim, order, T>(m, fluid, relative, time[0], reaction.inertia * inv_eps, reaction.beta * inv_eps, (most - least) * inv_eps);
  }

  // What the viscous force -eps div(2 eta D(u)) is per unit of unknown b, column j by U_j: second derivatives of U/eps, U linear. Those of eps count as much
  // as its slope squared; elements do not have them, but their neighbours' slopes do, as K. Jansen, S. Collis, C. Whiting and F. Shakib have it for
  // velocities, CMAME 174 (1999). Order 1 only.
  [[gnu::always_inline]] Matrix viscous(int b, double eta) const {
    static_assert(order == 1);
    const T inv_eps = 1.0 / eps;
    const Matrix cross = grad[b] * grad_eps.transpose();
    const Matrix hessian = (shape[b] * (2.0 * inv_eps * grad_eps * grad_eps.transpose() - eps_curvature) - cross - cross.transpose()) * (inv_eps * inv_eps);
    return -eps * eta * (hessian + hessian.trace() * Matrix::Identity());
  }
};

// The residual of the momentum at a quadrature point as what is found makes it, and what that makes of the subscale; order 1.
template <int dim, class T>
struct Residual {
  using Vector = VecOf<dim, T>;
  T tau, drives;
  Vector rest;
  std::array<Vector, dim + 1> grad;
  std::array<Mat<dim, T>, dim + 1> by_flux;
  Vector subscale(const std::array<Vector, dim + 1>& flux, const std::array<T, dim + 1>& p) const {
    Vector residual = rest;
    for (int b = 0; b <= dim; ++b) residual += drives * p[b] * grad[b] + by_flux[b] * flux[b];
    return -tau * residual;
  }
};

// residual: at each quadrature point, or none is kept; order 1, without Newton's derivative.
template <int dim, int order, class T>
void element_system(const ElementInput<dim, order, T>& in, const Properties<dim>& fluid, const TimeWeights& time, ElementSystem<dim, order, T>& out, Residual<dim, T>* residual = nullptr) {
  using Vector = VecOf<dim, T>;
  using Matrix = Mat<dim, T>;
  constexpr int n = shape_count<dim, order>;
  const Geometry<dim, T> g = geometry<dim, T>(in.x);
  const Mat<dim, T> m = metric(g);
  const double rho = fluid.density, eta = fluid.viscosity;
  out.a.setZero(), out.b.setZero();
  const auto& rule = quadrature<dim, order>();
  for (std::size_t q = 0; q < rule.size(); ++q) {
    const T weight = rule[q].weight * g.volume;
    const AtPoint<dim, order, T> at(in, g, m, fluid, time, static_cast<int>(q));
    const auto& shape = at.shape;
    const auto& grad = at.grad;
    const Stabilisation<T>& stab = at.stab;
    const T bulk = stab.bulk / at.eps;
    std::array<Vector, n> grad_test;  // of eps w
    std::array<Vector, n> bulk_test;  // among grains that feel pressure as it is, eps div w: on div(eps w) it would hold the fluid back where eps moves through the mesh
    for (int a = 0; a < n; ++a) {
      grad_test[a] = at.eps * grad[a] + shape[a] * at.grad_eps;
      bulk_test[a] = in.reaction_on_change ? Vector(at.eps * grad[a]) : grad_test[a];
    }

    for (int a = 0; a < n; ++a) {
      // SUPG: the residual tested with tau rho (u - w) . grad w, beside w. Order 2 does without.
      const T test = shape[a] + (order == 1 ? T(stab.tau * rho * at.relative.dot(grad[a])) : T(0.0));
      const int row = dof_of<dim>(a);
      for (int b = 0; b < n; ++b) {
        const int column = dof_of<dim>(b);
        const T diagonal = weight * (test * at.inertia[b] + eta * at.grad_u[b].dot(grad_test[a]));
        for (int i = 0; i < dim; ++i) {
          out.a(row + i, column + i) += diagonal;
          for (int j = 0; j < dim; ++j) {
            T value = eta * at.grad_u[b][i] * grad_test[a][j] + bulk * bulk_test[a][i] * grad[b][j];
            if (in.newton) value += test * rho * shape[b] * at.slope(i, j);
            out.a(row + i, column + j) += weight * value;
          }
        }
      }
      for (int b = 0; b <= dim; ++b)
        for (int i = 0; i < dim; ++i) out.a(row + i, dof_of<dim>(b) + dim) += weight * test * at.drives * g.grad_l[b][i];
      for (int i = 0; i < dim; ++i) out.b[row + i] += weight * (test * at.load[i] - bulk * bulk_test[a][i] * at.eps_rate);
    }
    for (int a = 0; a <= dim; ++a) {
      const int row = dof_of<dim>(a) + dim;
      for (int b = 0; b < n; ++b)
        for (int j = 0; j < dim; ++j) out.a(row, dof_of<dim>(b) + j) += weight * rule[q].l[a] * grad[b][j];
      if (!in.advance) continue;
      // Of a - a before, by parts: see Fluid::grains_follow.
      const Vector with_fluid = weight * at.follows.cwiseProduct(g.grad_l[a]);
      for (int b = 0; b < n; ++b)
        for (int j = 0; j < dim; ++j) out.a(row, dof_of<dim>(b) + j) -= shape[b] / at.eps * with_fluid[j];
      out.b[row] -= with_fluid.dot(at.past_velocity) + weight * g.grad_l[a].dot(in.advance[q]);
    }
    if constexpr (order == 1) {
      std::array<Matrix, n> viscous, strong;  // of the momentum, column j by U_j
      for (int b = 0; b < n; ++b) {
        viscous[b] = at.viscous(b, eta);
        strong[b] = viscous[b] + at.inertia[b] * Matrix::Identity();
        if (in.newton) strong[b] += rho * shape[b] * at.slope;
      }
      if (residual) residual[q] = {stab.tau, at.drives, at.beside - at.load, grad, strong};
      for (int a = 0; a < n; ++a) {
        const T along = weight * stab.tau * rho * at.relative.dot(grad[a]);
        const Vector test = weight * stab.tau * grad[a];  // PSPG: continuity holds for U less tau times the residual
        const int row = dof_of<dim>(a);
        for (int b = 0; b < n; ++b) {
          const int column = dof_of<dim>(b);
          out.a.template block<dim, dim>(row, column) += along * viscous[b];
          out.a.template block<1, dim>(row + dim, column) += test.transpose() * strong[b];
          out.a(row + dim, column + dim) += at.drives * test.dot(grad[b]);
        }
        for (int i = 0; i < dim; ++i) out.b[row + i] -= along * at.beside[i];
        out.b[row + dim] += test.dot(at.load - at.beside);
      }
    }
  }
}

// The subscale U' at each quadrature point, where U and p are found.
template <int dim, class T>
void element_subscale(const ElementInput<dim, 1, T>& in, const Properties<dim>& fluid, const TimeWeights& time, const std::array<VecOf<dim, T>, dim + 1>& found, const std::array<T, dim + 1>& p, VecOf<dim, T>* out) {
  const Geometry<dim, T> g = geometry<dim, T>(in.x);
  const Mat<dim, T> m = metric(g);
  for (std::size_t q = 0; q < quadrature<dim, 1>().size(); ++q) {
    const AtPoint<dim, 1, T> at(in, g, m, fluid, time, static_cast<int>(q));
    Residual<dim, T> residual{at.stab.tau, at.drives, at.beside - at.load, at.grad, {}};
    for (int b = 0; b <= dim; ++b) residual.by_flux[b] = at.viscous(b, fluid.viscosity) + at.inertia[b] * Mat<dim, T>::Identity();
    out[q] = residual.subscale(found, p);
  }
}

}  // namespace quicksand::fluid
