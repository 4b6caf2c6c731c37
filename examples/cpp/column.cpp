// Collapse of a granular column: discs settle between a wall and a gate, the gate is pulled away, a heap comes to rest.
//
//     cmake -S . -B build -DCMAKE_PREFIX_PATH=... && cmake --build build && build/column     (...: where Quicksand is installed)
//
// Along y there are only weight and floor, so that their impulses are the momentum: int F_y dt = W t + sum m v_y, to rounding.
#include <quicksand/grains/simulation.hpp>

#include <cstdio>
#include <random>

using namespace quicksand;

int main() {
  constexpr double d = 2e-3, width = 0.05, density = 2500.0, g = 9.81, dt = 1e-3;  // [m], [kg/m^3], [m/s^2], [s]
  Simulation<2> sim(Vec<2>::Zero());                                               // periodic in no axis
  sim.gravity = {0.0, -g};
  sim.set_friction("glass", "glass", 0.5);
  sim.set_friction("glass", "side", 0.0);
  sim.settings.solve.tolerance = 0.03;     // lets discs overlap by some 0.3 % of a diameter
  sim.settings.accept_unconverged = true;  // counted instead

  std::mt19937 random(1);
  double weight = 0.0;  // [N/m]: in 2D all is per metre of depth
  for (int k = 0; k < 600; ++k) {
    const double r = std::uniform_real_distribution(0.4 * d, 0.6 * d)(random);
    const Vec<2> x{width / 20 * (k % 20 + 0.5), width / 20 * (k / 20 + 1)};
    sim.add({&x, 1}, {&r, 1}, density, {}, {}, "glass");
    weight += density * solid_volume<2>(r) * g;
  }
  sim.add_plane({0.0, 0.0}, {1.0, 0.0}, "side");
  const int gate = sim.add_plane({width, 0.0}, {-1.0, 0.0}, "side");
  const int floor = sim.add_plane({0.0, 0.0}, {0.0, 1.0}, "glass");
  for (double r = d / 2, at = r; at < 5 * width; at += d) {  // a rough floor: on a flat one the front would roll on and on
    const Vec<2> x{at, 0.0};
    sim.attach(floor, {&x, 1}, {&r, 1}, "glass");
  }

  double impulse = 0.0, overlap = 0.0;  // of the floor [N s/m]; largest [m]
  int unconverged = 0;
  StepReport<2> report;
  while (sim.time() < 1.2) {
    if (sim.time() > 0.3) sim.drive(gate, 0, 3.0);
    report = sim.step(dt);
    impulse -= sim.walls()[floor].force.y() * dt;
    overlap = std::max(overlap, report.max_overlap);
    unconverged += report.unconverged;
  }
  double momentum = 0.0, reach = 0.0;
  for (const Vec<2>& x : sim.by_id([](const Grains<2>& grains, int k) { return grains.x[k]; })) reach = std::max(reach, x.x());
  for (double p : sim.by_id([](const Grains<2>& grains, int k) { return grains.body[k].v.y() / grains.body[k].inv_m; }))
    momentum += p;
  const double error = impulse / (weight * sim.time() + momentum) - 1.0, at_rest = -sim.walls()[floor].force.y() / weight;

  std::printf("run-out %.1f widths, coordination %.2f, largest overlap %.1e d\n", reach / width - 1.0, report.coordination, overlap / d);
  std::printf("floor carries %.4f of the weight, error of its impulse %.0e, %d sub-steps unconverged\n", at_rest, error, unconverged);
  return std::abs(error) < 1e-9 && std::abs(at_rest - 1.0) < 0.01 && overlap < 0.01 * d ? 0 : 1;
}
