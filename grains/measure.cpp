#include "measure.hpp"

#include "errors.hpp"

#include <complex>

namespace quicksand {

template <int dim>
Profile<dim> profile(const Simulation<dim>& simulation, int axis, double low, double high, int bins) {
  if (axis < 0 || axis >= dim) fail("profile: axis must be 0 to {}, got {}", dim - 1, axis);
  if (!is_finite(low) || !is_finite(high) || !(high > low)) fail("profile: low < high must be finite, got {} and {} m", low, high);
  if (bins < 1 || bins > 1000000) fail("profile: bins must be 1 to 1000000, got {}", bins);
  const Grains<dim>& grains = simulation.grains();
  Profile<dim> out;
  out.solid.assign(bins, 0.0);
  out.momentum.assign(bins, Vec<dim>::Zero());
  out.second.assign(bins, Vec<dim>::Zero());
  const double thickness = (high - low) / bins;
  for (int k = 0; k < grains.size(); ++k) {
    if (grains.wall[k] >= 0) continue;
    const double r = grains.r[k], y = simulation.box().wrap(grains.x[k])[axis];
    const int first = static_cast<int>(std::clamp(std::floor((y - r - low) / thickness), 0.0, double(bins)));
    const int last = static_cast<int>(std::clamp(std::floor((y + r - low) / thickness), -1.0, bins - 1.0));
    double below = y - r < low ? solid_below<dim>(r, low - y) : 0.0;
    for (int b = first; b <= last; ++b) {
      const double top = low + (b + 1) * thickness;
      const double next = y + r <= top ? solid_volume<dim>(r) : solid_below<dim>(r, top - y);
      const Vec<dim>& v = grains.body[k].v;
      out.solid[b] += next - below;
      out.momentum[b] += (next - below) * v;
      out.second[b] += (next - below) * v.cwiseAbs2();
      below = next;
    }
  }
  return out;
}

double psi6(const Simulation<2>& simulation, double low, double high) {
  if (std::isnan(low) || std::isnan(high)) fail("psi6: low and high must be numbers, got {} and {} m", low, high);
  const Grains<2>& grains = simulation.grains();
  std::vector<Vec<2>> x;
  std::vector<double> r;
  for (int k = 0; k < grains.size(); ++k)
    if (grains.wall[k] < 0) x.push_back(simulation.box().wrap(grains.x[k])), r.push_back(grains.r[k]);
  const CloseGrains<2> close(x, r, simulation.box(), 1.3, 0.0);
  std::vector<std::complex<double>> order(x.size());
  std::vector<int> neighbours(x.size(), 0);
  for (std::size_t i = 0; i < x.size(); ++i)
    close.visit(static_cast<int>(i), [&](int a, int b, int code) {
      const Vec<2> branch = x[b] - x[a] + periodic_shift(simulation.box(), code);
      const std::complex<double> bond = std::polar(1.0, 6.0 * std::atan2(branch.y(), branch.x()));
      order[a] += bond, order[b] += bond;  // 6 theta and 6 (theta + pi) are the same angle
      ++neighbours[a], ++neighbours[b];
    });
  double sum = 0.0;
  int n = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    if (x[i].y() < low || x[i].y() > high) continue;
    ++n;
    if (neighbours[i] > 0) sum += std::abs(order[i]) / neighbours[i];
  }
  return sum / n;
}

template Profile<2> profile(const Simulation<2>&, int, double, double, int);
template Profile<3> profile(const Simulation<3>&, int, double, double, int);

}  // namespace quicksand
