// Shape functions, quadrature, and the element's system of equations: what must hold on any simplex.
#include "fluid/equations.hpp"

#include <gtest/gtest.h>

#include <random>

namespace quicksand::fluid {
namespace {

template <class T>
class Element : public ::testing::Test {};
template <int d, int o>
struct Case {
  static constexpr int dim = d, order = o;
};
using Cases = ::testing::Types<Case<2, 1>, Case<2, 2>, Case<3, 1>, Case<3, 2>>;
TYPED_TEST_SUITE(Element, Cases);

double factorial(int n) { return n <= 1 ? 1.0 : n * factorial(n - 1); }

template <int dim>
std::array<Vec<dim>, dim + 1> corners() {
  std::array<Vec<dim>, dim + 1> x;
  for (int a = 0; a <= dim; ++a)
    for (int i = 0; i < dim; ++i) x[a][i] = (a == i + 1 ? 0.7 : 0.0) + 0.1 * std::sin(3.0 * a + 5.0 * i);
  return x;
}

// int of L_0^a L_1^b L_2^c over a simplex, over its volume: dim! a! b! c! / (dim + a + b + c)!
TYPED_TEST(Element, quadrature_is_exact_for_products_of_two_shape_functions) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order;
  for (int a = 0; a <= 2 * order; ++a)
    for (int b = 0; a + b <= 2 * order; ++b)
      for (int c = 0; a + b + c <= 2 * order; ++c) {
        double sum = 0.0;
        for (const auto& point : quadrature<dim, order>()) sum += point.weight * std::pow(point.l[0], a) * std::pow(point.l[1], b) * std::pow(point.l[2], c);
        EXPECT_NEAR(sum, factorial(dim) * factorial(a) * factorial(b) * factorial(c) / factorial(dim + a + b + c), 1e-14) << a << b << c;
      }
}

TYPED_TEST(Element, shape_functions_sum_to_one_and_their_gradients_are_their_slopes) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order;
  const Geometry<dim> g = geometry<dim>(corners<dim>());
  Barycentric<dim> l{};
  for (int a = 0; a <= dim; ++a) l[a] = (a + 1.0) / ((dim + 1) * (dim + 2) / 2);
  const auto n = shapes<dim, order>(l);
  const auto slope = shape_gradients<dim, order>(l, g.grad_l);
  double sum = 0.0;
  for (const double value : n) sum += value;
  EXPECT_NEAR(sum, 1.0, 1e-15);
  const double h = 1e-5;
  for (int axis = 0; axis < dim; ++axis) {
    auto at = [&](double way) {
      Barycentric<dim> there = l;
      for (int a = 0; a <= dim; ++a) there[a] += way * g.grad_l[a][axis];
      return shapes<dim, order>(there);
    };
    for (std::size_t a = 0; a < n.size(); ++a) EXPECT_NEAR((at(h)[a] - at(-h)[a]) / (2 * h), slope[a][axis], 1e-9);
  }
}

template <int dim, int order>
struct Setup {
  ElementInput<dim, order> in;
  Properties<dim> fluid;
  std::vector<Reaction<dim>> reaction;
  Eigen::Matrix<double, element_dofs<dim, order>, 1> x;

  explicit Setup(int seed = 3) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> any(-1, 1);
    auto vector = [&] { return Vec<dim>(Vec<dim>::NullaryExpr([&] { return any(random); })); };
    in.x = corners<dim>();
    for (int t = 0; t < 3; ++t)
      for (int a = 0; a < in.n; ++a) in.eps[t][a] = 0.6 + 0.3 * any(random), in.flux[t][a] = vector();
    for (auto& slope : in.eps_slope) slope = vector();
    for (auto& w : in.mesh_velocity) w = vector();
    for (std::size_t q = 0; q < quadrature<dim, order>().size(); ++q) reaction.push_back({3.0 + any(random), vector(), vector()});
    in.reaction = reaction.data();
    fluid.density = 1.3, fluid.viscosity = 0.2, fluid.gravity = vector();
    for (int a = 0; a < in.n; ++a) x.template segment<dim>(dof_of<dim>(a)) = in.flux[0][a];
    for (int a = 0; a <= dim; ++a) x[dof_of<dim>(a) + dim] = any(random);
  }
};

// With the guess for the solution, Newton's system and that of the lagged advection leave the same residual.
TYPED_TEST(Element, newtons_system_and_the_lagged_one_agree_where_the_guess_is_the_solution) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order;
  Setup<dim, order> setup;
  const TimeWeights bdf2{15.0, -20.0, 5.0};
  ElementSystem<dim, order> lagged, newton;
  element_system<dim, order>(setup.in, setup.fluid, bdf2, lagged);
  setup.in.newton = true;
  element_system<dim, order>(setup.in, setup.fluid, bdf2, newton);
  EXPECT_GT((newton.a - lagged.a).norm(), 1e-3 * lagged.a.norm());
  const Eigen::VectorXd one = lagged.a * setup.x - lagged.b, other = newton.a * setup.x - newton.b;
  EXPECT_LT((one - other).norm(), 1e-12 * lagged.a.norm() * setup.x.norm());
}

// At rest, grad p = rho g balances whatever eps and beta are: every row of the residual is zero.
TYPED_TEST(Element, hydrostatic_pressure_at_rest_leaves_no_residual_in_any_void_fraction) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order;
  Setup<dim, order> setup;
  for (auto& flux : setup.in.flux) flux.fill(Vec<dim>::Zero());
  for (auto& w : setup.in.mesh_velocity) w.setZero();
  setup.in.eps[1] = setup.in.eps[2] = setup.in.eps[0];
  for (auto& reaction : setup.reaction) reaction.beta_target.setZero(), reaction.force.setZero();
  setup.x.setZero();
  for (int a = 0; a <= dim; ++a) setup.x[dof_of<dim>(a) + dim] = setup.fluid.density * setup.fluid.gravity.dot(setup.in.x[a]) + 4.0;
  ElementSystem<dim, order> system;
  element_system<dim, order>(setup.in, setup.fluid, {15.0, -20.0, 5.0}, system);
  EXPECT_LT((system.a * setup.x - system.b).cwiseAbs().maxCoeff(), 1e-13);
  setup.x[dof_of<dim>(1) + dim] += 0.1;
  EXPECT_GT((system.a * setup.x - system.b).cwiseAbs().maxCoeff(), 1e-4);
}

// A fluid that moves as a whole, and grains and the mesh with it, through an eps that moves along: no inertia, no viscous force, no divergence.
TYPED_TEST(Element, a_fluid_that_moves_with_grains_and_mesh_as_a_whole_feels_no_force) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order;
  Setup<dim, order> setup;
  setup.fluid.gravity.setZero();
  const Vec<dim> u = Vec<dim>::LinSpaced(0.4, 1.1);
  for (auto& reaction : setup.reaction) reaction.beta_target = reaction.beta * u, reaction.force.setZero();
  setup.in.mesh_velocity.fill(u);
  for (int a = dim + 1; a < setup.in.n; ++a) {  // eps linear: eps u is in the space then
    const auto [i, j] = simplex_edges<dim>[a - dim - 1];
    setup.in.eps[0][a] = 0.5 * (setup.in.eps[0][i] + setup.in.eps[0][j]);
  }
  setup.in.eps[1] = setup.in.eps[2] = setup.in.eps[0];
  setup.x.setZero();
  for (int a = 0; a < setup.in.n; ++a) {
    for (auto& flux : setup.in.flux) flux[a] = setup.in.eps[0][a] * u;
    setup.x.template segment<dim>(dof_of<dim>(a)) = setup.in.flux[0][a];
  }
  ElementSystem<dim, order> system;
  element_system<dim, order>(setup.in, setup.fluid, {15.0, -20.0, 5.0}, system);
  const Eigen::VectorXd residual = system.a * setup.x - system.b;
  for (int a = 0; a < setup.in.n; ++a) EXPECT_LT(residual.segment(dof_of<dim>(a), dim).norm(), 1e-13);
  if constexpr (order == 1) {  // neither do the subscales, which add nothing to div U, whether grains are known or go with the mesh
    const Geometry<dim> g = geometry<dim>(setup.in.x);
    Vec<dim> grad_eps = Vec<dim>::Zero();
    for (int a = 0; a <= dim; ++a) grad_eps += setup.in.eps[0][a] * g.grad_l[a];
    for (const auto* reaction : {setup.reaction.data(), static_cast<Reaction<dim>*>(nullptr)}) {
      setup.in.reaction = reaction;
      element_system<dim, order>(setup.in, setup.fluid, {15.0, -20.0, 5.0}, system);
      for (int a = 0; a <= dim; ++a) {
        const int row = dof_of<dim>(a) + dim;
        EXPECT_NEAR(system.a.row(row).dot(setup.x) - system.b[row], g.volume / (dim + 1) * u.dot(grad_eps), 1e-13);
      }
    }
  }
  setup.in.mesh_velocity[0] += Vec<dim>::Constant(0.1);  // eps slides along: the divergence shows
  element_system<dim, order>(setup.in, setup.fluid, {15.0, -20.0, 5.0}, system);
  EXPECT_GT((system.a * setup.x - system.b).head(dim).norm(), 1e-5);
}

// Eight elements at once are eight elements, whether grains are told of in them or not: same formulas, sums that differ by rounding.
TYPED_TEST(Element, lanes_are_elements_by_themselves) {
  constexpr int dim = TypeParam::dim, order = TypeParam::order, points = quadrature_count<dim, order>;
  if constexpr (order == 1) {
    using Eight = VecOf<dim, Lanes>;
    ElementInput<dim, order, Lanes> in;
    std::array<Reaction<dim, Lanes>, points> reaction;
    std::array<Eight, points> subscale, advance;
    std::vector<Setup<dim, order>> setups;
    std::vector<std::vector<Vec<dim>>> beside(2 * Lanes::count);  // subscales and advances
    for (int lane = 0; lane < Lanes::count; ++lane) {
      Setup<dim, order>& one = setups.emplace_back(lane);
      one.in.x[1][0] += 0.1 * lane;
      for (int a = 0; a <= dim; ++a) one.in.pressure[a] = lane + 0.1 * a;
      for (int a = 0; a <= dim; ++a) {
        put(in.x[a], lane, one.in.x[a]), put(in.mesh_velocity[a], lane, one.in.mesh_velocity[a]), put(in.eps_slope[a], lane, one.in.eps_slope[a]), put(in.pressure[a], lane, one.in.pressure[a]);
        for (int t = 0; t < 3; ++t) put(in.eps[t][a], lane, one.in.eps[t][a]), put(in.flux[t][a], lane, one.in.flux[t][a]);
      }
      for (int q = 0; q < points; ++q) {
        Reaction<dim>& from = one.reaction[q];
        from.yield = 0.1 * q, from.inertia = 0.2 * lane, from.follows.setConstant(0.3 - 0.1 * q);
        if (lane == 2) from.beta = 0.0;
        put(reaction[q].beta, lane, from.beta), put(reaction[q].beta_target, lane, from.beta_target), put(reaction[q].force, lane, from.force);
        put(reaction[q].yield, lane, from.yield), put(reaction[q].inertia, lane, from.inertia), put(reaction[q].follows, lane, from.follows);
        for (int k = 0; k < 2; ++k) beside[2 * lane + k].push_back(one.in.flux[k][q]);
        put(subscale[q], lane, one.in.flux[0][q]), put(advance[q], lane, one.in.flux[1][q]);
      }
    }
    in.reaction = reaction.data(), in.subscale[0] = subscale.data(), in.advance = advance.data(), in.reaction_on_change = true;
    ElementSystem<dim, order, Lanes> eight;
    std::array<Residual<dim, Lanes>, points> residuals;
    element_system<dim, order, Lanes>(in, setups[0].fluid, {15.0, -20.0, 5.0}, eight, residuals.data());
    for (int lane = 0; lane < Lanes::count; ++lane) {
      auto& alone = setups[lane].in;
      alone.reaction = setups[lane].reaction.data(), alone.subscale[0] = beside[2 * lane].data(), alone.advance = beside[2 * lane + 1].data(), alone.reaction_on_change = true;
      ElementSystem<dim, order> one;
      std::array<Residual<dim, double>, points> residual;
      element_system<dim, order, double>(alone, setups[0].fluid, {15.0, -20.0, 5.0}, one, residual.data());
      for (int i = 0; i < one.dofs; ++i) {
        EXPECT_NEAR(get(eight.b[i], lane), one.b[i], 1e-14 * one.b.norm());
        for (int j = 0; j < one.dofs; ++j) EXPECT_NEAR(get(eight.a(i, j), lane), one.a(i, j), 1e-14 * one.a.norm());
      }
      for (int q = 0; q < points; ++q) {
        const auto found = residual[q].subscale(alone.flux[0], alone.pressure);
        const auto with_others = residuals[q].subscale(in.flux[0], in.pressure);
        for (int i = 0; i < dim; ++i) EXPECT_NEAR(get(with_others[i], lane), found[i], 1e-13 * found.norm());
      }
    }
  }
}

}  // namespace
}  // namespace quicksand::fluid
