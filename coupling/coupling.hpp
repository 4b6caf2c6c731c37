// Fluid and grains together: unresolved FEM-DEM after the averaged equations of Anderson and Jackson, "model A". A step of dt:
//   1. the mesh follows the walls, the void fraction is that of the grains where they are;
//   2. the fluid makes its step. What it does to the grains is implicit in its velocity and pressure, and so is, as far as it can be known, what
//      they do in answer: see below;
//   3. the grains make theirs, in as many sub-steps as they need: drag implicit in the contact problem, pressure gradient and viscous stress given;
//   A pass of 2 and 3 is made again where the two disagree by more than a tolerance, with the grains' last answer to begin with;
//   4. what the grains got from drag and the fluid did not give, carry_i, is handed to the fluid in the next step: none is lost.
// A grain's drag, linear about the slip s_0 that is expected, F = gamma (u - v - s), and the rest on it, R = m g - V grad p + V div(2 eta D(u)), move it
// over dt in n sub-steps, were it free, such that drag's impulse is
//   J/dt = c_gamma (u - s - v_0) - c R,   c = 1 - (1 - (1 + k/n)^-n)/k,   c_gamma = gamma (1 - c),   k = dt gamma/m.
// Grains that bore no contact in the last step are taken so. Of others nothing is known: contacts may hold them, or whole clusters be free to go.
//   J/dt = gamma (u - s - v_0) + c V (grad p - grad p before)
// needs to know nothing. Of a mode of uniform motion, phases bound to each other by continuity or not, with grains free, held, or anything between, as
// part of clusters of any mass, the amplification is at most 1 for k from 1e-3 to 1e6, densities of grains from 0.5 to 1000 times the fluid's and
// solids up to 0.6, together with Fluid::grains_follow (and 1.3 up to 0.8 of light grains, if they are confined). Three things are needed for that:
// the target v_0, for a free grain's answer given to a held one is explicit drag, unstable for k > 2; the answer to the pressure, c V; and that
// continuity knows what follows the fluid: all grains but those that lean on a wall, by whatever chain of contacts. Theirs would be a false alarm
// that swings on, in a bed with clear fluid above. Grains that a wall holds count less by a fifth in each step: at once, a bed that lifts off its screen and falls back, held for some
// steps and not for the next, was driven on until pressures were a thousand times its weight.
// Drag sees the flow where the grain is, u_i = u(x_i), and gives it to the fluid by the kernel: -sum_i K_i gamma_i (u_i - v_i). Implicit, that would couple
// all nodes within a kernel. Its usual short form, beta (u - v), beta = sum gamma_i K_i, couples neighbours only, but drags all of the fluid within a
// kernel along with a grain that differs from it by shear: a viscosity of beta r_0^2, in dense beds hundreds of times the fluid's. (The mean over the
// kernel in the place of u_i has no such viscosity, but the flow must then be what, averaged, is as the grains are: along walls it overshoots.) So
// beta takes the change of u over the step only (Fluid::reaction_on_change), the rest is as it was: the Fourier transform of K is between 0 and 1,
// this is a contraction, however large beta dt is.
// By the same transform grains would hardly hold flow in waves shorter than the kernel: on fine elements it would find its way around each of them. So the
// fluid gets a force besides, that adds up to zero and that no grain knows of,
//   -beta (1 - P)^3 w,   w = (1 - P)^3 u + (1 - (1 - P)^3) (u_i - v_i),   P f = sum_g B_g b_g f_g/beta,   beta = sum_g B_g b_g,
// at nodes; b_g = sum_i beta_i B_g(x_i)/w_g, f_g = sum_a M_a B_g(x_a) f_a/sum_a M_a B_g(x_a), and of grains' slip the mean weighted by beta_i B_g(x_i) instead. beta (1 - P) is
// symmetric, its rows add up to zero, it is positive and less than beta: with it all is a contraction still, where a bed ends as well. w is the slip, but of waves that
// no mean over grains can show, in which they count as at rest: held grains hold the flow by 1 - P + (1 - P)^4 or more of what a drag in each point would. From fluid and grains
// that move alike it takes (1 - P)^6, 0.004 in waves of 2 pi r_0: no viscosity. The first 1 - P is made exact of linear fields, by their mean slope, as P bends
// them along walls. Elements of 2.5 radii and more hold no such waves.
// Likewise c V takes the change of grad p only, which grains feel averaged and elements have as it is: a bed that
// is let go keeps the flow that it had when it was held.
// Added mass m_a (Du/Dt - dv/dt), m_a = C_m rho V: T. R. Auton, J. C. R. Hunt and M. Prud'homme, J. Fluid Mech. 197 (1988), M. R. Maxey and J. J. Riley, Phys.
// Fluids 26 (1983). Du/Dt is (u - u before)/dt + (u - w) . grad u of before, w the mesh's velocity, means over the kernel as grad p is: so the phases agree on it.
// Grains are as heavy as M = m + m_a in their step, k = dt gamma/M, and with c of above and 1 - C = (1 - c) m/M, C in the place of c, J of both together is
//   J/dt = (1 - C) (gamma (u - s - v_0) + m_a Du/Dt) - C R of free grains, gamma (u - s - v_0) + m_a Du/Dt + C V (grad p - grad p before) of others;
// the fluid is heavier by what stands before u - u before. Of the mode above amplifications are then 1.00 at solids 0.3 and 1.08 at 0.6, for densities from
// 0.001 times the fluid's; without it, where pressure binds the phases, 300 and 600 at 0.001 and 2.3 and 4.7 at 0.1. Explicit, it would have m_a/m.
#pragma once

#include "drag.hpp"
#include "kernel.hpp"
#include "wake.hpp"

#include "fluid/fluid.hpp"
#include "grains/simulation.hpp"

#include <limits>
#include <map>

namespace quicksand::coupling {

// gamma [kg/s] of spheres; one call for many.
using DragLaw = std::function<void(std::span<const Suspension>, std::span<double> gamma)>;
DragLaw of_each(Eight (*law)(const Suspensions&));

struct Settings {
  Shape kernel = Shape::smooth;
  double kernel_radius = 0.0;  // [m]
  DragLaw drag;
  Discs discs = Discs::spheres;
  bool undisturbed = false;    // drag by the flow without the grain's own wake (wake.hpp), spheres only
  bool fluid_moves = true;     // false: it stays what it is, and feels no grain
  bool grains_move = true;     // false: a bed that is held
  double added_mass = 0.0;     // C_m [-], 0.5 of a sphere by itself; 0: none
  double tolerance = std::numeric_limits<double>::infinity();  // of the phases' disagreement; above it another pass is made
  int max_passes = 20;
};

template <int dim>
struct Report {
  double time = 0.0, dt = 0.0;              // of the grains [s]
  StepReport<dim> grains;
  fluid::Report fluid;
  int passes = 0;                           // of fluid and grains
  Vec<dim> drag = Vec<dim>::Zero();         // and added mass, on all grains, mean over dt [N] (2D: N/m)
  double exchanged_impulse = 0.0;           // sum of |J_i| [N s]
  double carried_impulse = 0.0;             // |sum of carry_i| over it [-]
  double disagreement = 0.0;                // sum of |carry_i| over it [-]
  double momentum_error = 0.0;              // of fluid, grains and carried impulse, less boundaries and bodies, over it [-]
  int removed = 0;                          // grains that left through outlets
  double fluid_time = 0.0, grains_time = 0.0, exchange_time = 0.0;  // [s]
};

template <int dim>
class Coupling {
 public:
  // Both stay the caller's, and must live on; forces and drag of the grains, void fraction and reaction of the fluid are set by this from now on.
  Coupling(Simulation<dim>& grains, fluid::Fluid<dim>& fluid, Settings settings);

  // A boundary of the mesh that goes with a wall of the grains, along the axes that are not periodic.
  void follow(const std::string& boundary, int wall);
  // Grains whose centre leaves the mesh by this boundary are removed; by another, step() throws.
  void set_outlet(const std::string& boundary);

  Settings settings;  // tolerance and max_passes may change

  Report<dim> step(double dt);

  // With the states of grains and fluid all that the next step depends on.
  std::vector<double> state() const;
  void restore(std::span<const double> state);

  int removed() const { return removed_; }
  // By id, of the last step.
  const std::vector<Vec<dim>>& drag_force() const { return drag_force_; }        // and of added mass, mean over the step [N]
  const std::vector<Vec<dim>>& stress_force() const { return stress_force_; }    // V (-grad p + div(2 eta D(u))) [N]
  const std::vector<Vec<dim>>& fluid_velocity() const { return u_; }             // u where each grain is [m/s]
  const std::vector<double>& void_fraction() const { return eps_at_; }

 private:
  struct Follow {
    int wall;
    Vec<dim> from, velocity;  // where it was at the last step [m], and the boundary's velocity since [m/s]
  };
  struct Drag {        // on one grain: gamma (u - v - shift)
    double gamma = 0.0;                    // [kg/s]
    Vec<dim> shift = Vec<dim>::Zero();     // [m/s]
  };
  struct Answer {      // what the fluid takes J/dt to be: beta (u - shift - v) - given + yield (grad p - grad p known) + inertia (u - u before)
    double beta, yield;                    // [kg/s], [m^dim]
    Vec<dim> v, given, grad_p;             // [m/s], [N], [Pa/m]
    double inertia;                        // [kg/s]
  };

  struct Own { double spread, solids; };  // s of wake.hpp [m]; of 1 - eps where the grain is, its part

  void take_grains();
  void locate();
  double left_of(double k) const;
  double share_of(double k) const;
  void expect_drag(double dt);
  Own own(int i) const;
  void linearise(const std::vector<int>& which, const std::vector<Vec<dim>>& slip, std::vector<double>& growth);
  void answer_as_expected(double dt);
  void answer_as_last(double dt);
  void set_reaction(double dt);
  std::vector<Vec<dim>> short_wave_drag() const;
  void move_grains(double dt, Report<dim>& report);
  void tell_grains();
  double solid_volume_of(int i) const { return solid_volume<dim>(r_[i]); }
  double added_mass_of(int i) const { return settings.added_mass * fluid_.properties.density * solid_volume_of(i); }

  Simulation<dim>& grains_;
  fluid::Fluid<dim>& fluid_;
  std::shared_ptr<const Mesh<dim>> mesh_;
  Walker<dim> walker_;
  Kernel<dim> kernel_;
  std::map<std::string, std::shared_ptr<Follow>> follows_;
  std::vector<char> outlet_;       // of each boundary
  typename fluid::Fluid<dim>::Projected flow_;  // at the nodes of the mesh
  std::vector<double> eps_;

  // Of grains, by id.
  std::vector<Vec<dim>> x_, v_, carry_, drag_force_, stress_force_;
  Vec<dim> grains_error_;          // of their balance of momentum [N s]
  std::vector<Vec<dim>> u_, u_mean_, grad_p_;      // where the grain is; mean over its kernel
  std::vector<Vec<dim>> u_before_, u_mean_before_, grad_p_before_;  // the fluid's step
  std::vector<Vec<dim>> convection_;               // the same time's (u - w) . grad u, mean over the kernel; 0 without added mass
  std::vector<double> r_, m_, eps_at_;
  std::vector<Place<dim>> place_;
  std::vector<char> free_;         // bore no contact in the last step
  std::vector<Vec<dim>> follows_fluid_;            // of each axis: 1, or less where a wall holds the grain
  std::vector<Drag> drag_;
  std::vector<Own> own_;
  std::vector<Answer> answer_;
  int sub_steps_ = 1;              // of the last step
  bool started_ = false;           // the fluid's pressure is that of a flow with grains
  int removed_ = 0;
};

}  // namespace quicksand::coupling
