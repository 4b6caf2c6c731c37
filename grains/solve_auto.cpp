// Which solver a scene gets: by the number of its contacts, their shape, and how far the ones before have come.
#include "solvers.hpp"

#include <numeric>

namespace quicksand {

namespace {

// In fewer contacts than that there is nothing to leave out, and over-relaxation may carry forces that balance each other, as those of a
// wedged disc, far away.
constexpr std::size_t few_contacts = 100;
// What the active set has not solved by then reaches over many layers.
constexpr int local_sweeps = 300;
// Factorising W of more contacts than that takes half a second; they are wide rather than tall, and sweeps do.
template <int dim>
constexpr std::size_t newton_contacts = dim == 2 ? 10000 : 2000;

// Few contacts side by side and many layers: W fills in little, and sweeps would have to carry forces through all layers. Layers are
// those of a walk along the contacts that starts at one grain of each connected part.
template <int dim>
bool is_narrow(const Problem<dim>& problem, std::size_t contacts) {
  constexpr std::size_t widest = 4;  // contacts a layer
  const int bodies = static_cast<int>(problem.bodies.size());
  std::vector<int> first(bodies + 1, 0), neighbour(2 * contacts), reached;
  auto each_pair = [&](auto&& visit) {
    for (std::size_t b = 0; b < problem.blocks.size(); ++b)
      for (int k = problem.blocks[b].begin; k < problem.blocks[b].begin + problem.count[b]; ++k) visit(problem.contacts[k].i, problem.contacts[k].j);
  };
  each_pair([&](int i, int j) { ++first[i], ++first[j]; });
  std::partial_sum(first.begin(), first.end(), first.begin());
  each_pair([&](int i, int j) { neighbour[--first[i]] = j, neighbour[--first[j]] = i; });
  std::vector<char> seen(bodies, false);
  auto reach = [&](int body) {
    if (!seen[body]) seen[body] = true, reached.push_back(body);
  };
  std::size_t layers = 0, done = 0;
  auto walk = [&] {
    for (; done < reached.size(); ++layers)
      for (const std::size_t end = reached.size(); done < end; ++done)
        for (int k = first[reached[done]]; k < first[reached[done] + 1]; ++k) reach(neighbour[k]);
  };
  for (int body = 0; body < bodies; ++body)
    if (first[body] < first[body + 1]) reach(body), walk();
  return contacts <= widest * layers;
}

// To look costs less than sweeps up to that many contacts; in more of them only what sweeps could not solve is worth it.
constexpr std::size_t look_first = 1000;

// Newton's method in a narrow scene. It converges quadratically and factorises in no time, so a thousandth of the tolerance costs an iteration
// or two; an iterate within the tolerance itself may still have forces wrong by their own size, because residuals are local.
template <int dim>
SolveReport solve_narrow(Problem<dim>& problem, SolverSettings settings) {
  const double tolerance = settings.tolerance, worst = settings.worst;
  settings.tolerance = std::max(1e-3 * tolerance, std::min(tolerance, 1e-8)), settings.worst *= settings.tolerance / tolerance;
  SolveReport report = solve_newton(problem, settings);
  report.converged |= report.residual <= tolerance && report.worst <= worst;
  return report;
}

}  // namespace

template <int dim>
SolveReport solve_auto(Problem<dim>& problem, const SolverSettings& settings) {
  SolverSettings few = settings;
  few.max_sweeps = std::min(settings.max_sweeps, local_sweeps);
  few.max_newton = std::max(settings.max_newton / 5, 1);  // near the solution it converges soon or cycles
  const std::size_t contacts = std::accumulate(problem.count.begin(), problem.count.end(), problem.wall_contacts.size());
  SolveReport report;
  report.converged = false;
  auto go_on = [&](const SolveReport& more) {
    report = {report.sweeps + more.sweeps, report.updates + more.updates, more.residual, more.worst, more.converged};
  };
  bool narrow = false;
  auto look = [&] {
    narrow = is_narrow(problem, contacts);
    if (narrow) go_on(solve_narrow(problem, few));
  };
  if (contacts <= look_first) look();
  if (!report.converged && contacts >= few_contacts) go_on(solve_active_set(problem, few));
  if (!report.converged && contacts > look_first && contacts <= newton_contacts<dim>) look();
  if (!report.converged && (contacts < few_contacts || settings.max_sweeps > local_sweeps)) go_on(solve_accelerated(problem, settings));
  if (!report.converged && contacts <= newton_contacts<dim> && !narrow) go_on(solve_newton(problem, few));
  if (!report.converged) go_on(solve_nlgs(problem, settings));
  return report;
}

template SolveReport solve_auto(Problem<2>&, const SolverSettings&);
template SolveReport solve_auto(Problem<3>&, const SolverSettings&);

}  // namespace quicksand
