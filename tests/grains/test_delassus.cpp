// Contact problems with W written out: the same problem as that of the scene, the same solution by every solver, and an error
// estimate that sees what the residual hides.
#include "scenes.hpp"

namespace quicksand::test {
namespace {

template <class D>
class Delassus : public ::testing::Test {};
TYPED_TEST_SUITE(Delassus, Dimensions, DimensionName);

// Grains thrown together over a floor, under a plate that is held along one axis and pressed along another: all kinds of contacts.
template <int dim>
Simulation<dim> heap(Solver solver, double friction) {
  Vec<dim> period = Vec<dim>::Zero();
  period[0] = 0.02;
  auto sim = scene<dim>(friction, period);
  sim.settings.solver = solver;
  sim.gravity = in_plane<dim>(0, -g);
  std::array<int, dim> cells;
  cells.fill(4);
  add_gas<dim>(sim, cells, 0.5);
  sim.add_plane(in_plane<dim>(0, -7e-3), in_plane<dim>(0, 1), "wall");
  const int top = sim.add_plane(in_plane<dim>(0, 7e-3), in_plane<dim>(0, -1), "wall");
  sim.drive(top, 0, 0.1);
  sim.set_load(top, 1, -0.5, 1e-3);
  if constexpr (dim == 3)
    for (const double side : {-1.0, 1.0}) sim.add_plane(Vec<3>(0, 0, 7e-3 * side), Vec<3>(0, 0, -side), "wall");
  return sim;
}

// The energy account of a step counts contacts that push; what pulls, or holds more than friction can, would be missing there.
TYPED_TEST(Delassus, however_loose_the_tolerance_impulses_stay_in_their_friction_cones) {
  constexpr int dim = TypeParam::value;
  for (const auto solver : {Solver::nlgs, Solver::active_set, Solver::accelerated, Solver::newton, Solver::automatic}) {
    auto sim = heap<dim>(solver, 0.4);
    sim.settings.solve.tolerance = 0.1;
    for (int step = 0; step < 40; ++step) {
      sim.step(1e-3);
      const auto [problem, r] = sim.contact_problem();
      for (int c = 0; c < problem.contacts(); ++c) {
        ASSERT_GE(r[dim * c], 0);
        ASSERT_LE(r.template segment<dim - 1>(dim * c + 1).norm(), problem.friction[c] * r[dim * c] * (1 + 1e-12));
      }
    }
  }
}

TYPED_TEST(Delassus, the_problem_written_out_holds_the_velocities_of_the_scene) {
  constexpr int dim = TypeParam::value;
  auto sim = heap<dim>(Solver::nlgs, 0.4);
  for (int k = 0; k < 40; ++k) sim.step(1e-3);
  const auto [problem, r] = sim.contact_problem();
  ASSERT_GT(problem.contacts(), 20);
  // Obeys the law, as the scene says of itself.
  const Eigen::VectorXd u = contact_velocity(problem, r);
  double off = 0.0, fastest = 0.0;
  for (int c = 0; c < problem.contacts(); ++c) {
    EXPECT_GE(r[dim * c], 0);
    EXPECT_GE(u[dim * c], -1e-8);  // tolerance 1e-9 of velocities up to 1 m/s
    off = std::max(off, r[dim * c] * std::abs(u[dim * c]));
    fastest = std::max(fastest, std::abs(u[dim * c]));
  }
  EXPECT_GT(fastest, 1e-3);
  EXPECT_LT(off, 1e-8 * r.maxCoeff());
  // W is symmetric and, by u . r = r.W r + q.r, no contact gains energy: r.W r >= 0.
  for (int c = 0; c < problem.contacts(); ++c)
    for (int k = problem.row_start[c]; k < problem.row_start[c + 1]; ++k) {
      const int d = problem.column[k];
      const auto begin = problem.column.begin() + problem.row_start[d], end = problem.column.begin() + problem.row_start[d + 1];
      const auto back = std::lower_bound(begin, end, c);
      ASSERT_TRUE(back != end && *back == c);
      const Mat<dim> transposed = problem.blocks[back - problem.column.begin()].transpose();
      EXPECT_LT((problem.blocks[k] - transposed).norm(), 1e-12 * problem.blocks[problem.diagonal[c]].norm());
    }
  EXPECT_GT(r.dot(u - problem.q), 0);
}

// From the same state: over many steps collisions would amplify the tolerance.
TYPED_TEST(Delassus, every_solver_finds_the_same_motion) {
  constexpr int dim = TypeParam::value;
  for (const double friction : {0.0, 0.4}) {
    auto sim = heap<dim>(Solver::automatic, friction);
    for (int k = 0; k < 20; ++k) {
      sim.step(1e-3);
      const std::vector<char> state = sim.state();
      std::vector<Vec<dim>> first;
      for (Solver solver : {Solver::nlgs, Solver::active_set, Solver::accelerated, Solver::newton, Solver::automatic}) {
        sim.restore(state);
        sim.settings.solver = solver;
        EXPECT_EQ(sim.step(1e-4).unconverged, 0) << static_cast<int>(solver);
        const auto v = velocities(sim);
        if (first.empty()) first = v;
        for (std::size_t k = 0; k < v.size(); ++k) EXPECT_LT((v[k] - first[k]).norm(), 1e-7);  // speeds of 0.5 m/s
      }
      sim.restore(state);
    }
  }
}

TYPED_TEST(Delassus, all_solvers_of_problems_written_out_agree_on_the_velocities) {
  constexpr int dim = TypeParam::value;
  auto sim = heap<dim>(Solver::nlgs, 0.4);
  for (int k = 0; k < 40; ++k) sim.step(1e-3);
  const auto [problem, found] = sim.contact_problem();
  const Eigen::VectorXd u = contact_velocity(problem, found);
  const DelassusSettings settings{.norm = Norm::energy, .tolerance = 1e-9, .max_iterations = 200000};
  using Solve = DelassusReport (*)(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);
  for (Solve solve : std::initializer_list<Solve>{solve_nlgs<dim>, solve_accelerated<dim>, solve_newton<dim>, solve_auto<dim>}) {
    Eigen::VectorXd r = Eigen::VectorXd::Zero(found.size());
    const DelassusReport report = solve(problem, r, settings);
    EXPECT_TRUE(report.converged);
    EXPECT_LT((contact_velocity(problem, r) - u).norm(), 1e-6 * u.norm());
  }
}

// Sweeps grow with the height of a pile when accelerated, with its square otherwise; in a wide pile of touching grains too.
TYPED_TEST(Delassus, accelerated_sweeps_grow_with_the_height) {
  constexpr int dim = TypeParam::value;
  auto sweeps = [](Solver solver, int layers) {
    auto sim = column<dim>(layers);
    sim.settings.solver = solver;
    sim.settings.solve.tolerance = 1e-6 / (layers * layers);  // the same error of the forces
    sim.settings.solve.max_sweeps = 1000000;
    const int made = sim.step(1e-3).sweeps;
    for (double force : sim.contacts().force_normal) EXPECT_GT(force, 0.99 * mass<dim>(1e-3) * g);
    return made;
  };
  EXPECT_GT(sweeps(Solver::nlgs, 80), 10 * sweeps(Solver::nlgs, 20));
  EXPECT_LT(sweeps(Solver::accelerated, 80), 7 * sweeps(Solver::accelerated, 20));
  EXPECT_LT(10 * sweeps(Solver::accelerated, 80), sweeps(Solver::nlgs, 80));
}

// Sweeps carry weight by one layer at a time, a Newton step through all of them.
TYPED_TEST(Delassus, newton_carries_the_weight_of_320_layers_in_a_few_iterations) {
  constexpr int dim = TypeParam::value;
  for (const int layers : {10, 320}) {
    auto sim = column<dim>(layers);
    sim.settings.solver = Solver::newton;
    const auto report = sim.step(1e-3);
    EXPECT_LE(report.sweeps, 10);
    const auto list = sim.contacts();
    ASSERT_EQ(static_cast<int>(list.point.size()), layers);
    for (std::size_t c = 0; c < list.point.size(); ++c) {
      const int above = layers - static_cast<int>(std::lround(list.point[c][1] / 2e-3));
      EXPECT_NEAR(list.force_normal[c], above * mass<dim>(1e-3) * g, 1e-4 * layers * mass<dim>(1e-3) * g);
    }
    EXPECT_LT(sim.contacts().force_normal.front() / (layers * mass<dim>(1e-3) * g), 1 + 1e-4);
  }
}

// Bodies fall by g h in a step unless contacts stop them: the error of the velocities, exactly known, over g h.
TYPED_TEST(Delassus, the_global_error_is_known_where_the_residual_hides_it) {
  constexpr int dim = TypeParam::value;
  for (const int sweeps : {10, 100, 1000}) {
    auto sim = column<dim>(80);
    sim.settings.solver = Solver::nlgs;
    sim.settings.solve.max_sweeps = sweeps;
    sim.settings.accept_unconverged = true;
    const double residual = sim.step(1e-3).residual;
    double v2 = 0.0;
    for (const Vec<dim>& v : velocities(sim)) v2 += v.squaredNorm();
    const double error = std::sqrt(v2 / 80) / (g * 1e-3);
    const auto [problem, r] = sim.contact_problem();
    EXPECT_NEAR(global_error(problem, r), error, 1e-3 * error) << sweeps;
    EXPECT_GT(error, 10 * residual);
  }
  auto sim = column<dim>(80);
  sim.settings.solver = Solver::newton;
  sim.step(1e-3);
  const auto [problem, r] = sim.contact_problem();
  EXPECT_LT(global_error(problem, r), 1e-3);
}

TYPED_TEST(Delassus, auto_goes_on_by_newton_where_sweeps_run_out) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(200);
  sim.settings.solve.max_sweeps = 50;
  const auto report = sim.step(1e-3);
  EXPECT_EQ(report.unconverged, 0);
  EXPECT_LE(report.sweeps, 100);
}

TYPED_TEST(Delassus, there_is_no_contact_problem_before_a_step_nor_after_a_change_from_outside) {
  constexpr int dim = TypeParam::value;
  auto sim = column<dim>(3);
  EXPECT_THROW(sim.contact_problem(), std::invalid_argument);
  sim.step(1e-3);
  EXPECT_EQ(sim.contact_problem().first.contacts(), 3);
  const std::vector<char> state = sim.state();
  auto twin = column<dim>(0);
  const auto refuses = [](Simulation<dim>& of) {
    EXPECT_THROW(of.contact_problem(), std::invalid_argument);
    of.step(1e-3);
    EXPECT_EQ(of.contact_problem().first.contacts(), 3);
  };
  twin.restore(state);  // holds no contacts of its own
  refuses(twin);
  sim.restore(state);
  refuses(sim);
  sim.set_velocity(velocities(sim));
  refuses(sim);
  sim.set_spin(spins(sim));
  refuses(sim);
  sim.drive(0, 0, 0.0);
  refuses(sim);
  add<dim>(sim, in_plane<dim>(0.1, 0.1), 1e-3);
  sim.check(1e-3);
  EXPECT_THROW(sim.contact_problem(), std::invalid_argument);
}

}  // namespace
}  // namespace quicksand::test
