// Volume-averaged flow on a simplex mesh: conditions on named boundaries, void fraction, a distributed reaction, steps in time and steady
// states. Equations: equations.hpp; unknowns: space.hpp. Every rank calls every function, in the same order.
#pragma once

#include "petsc.hpp"
#include "space.hpp"

#include <functional>
#include <optional>
#include <stdexcept>

namespace quicksand::fluid {

// Values at points and a time [s]; called with all points at once.
template <int dim>
using VectorField = std::function<std::vector<Vec<dim>>(std::span<const Vec<dim>> x, double t)>;
template <int dim>
using ScalarField = std::function<std::vector<double>(std::span<const Vec<dim>> x, double t)>;

enum class Advection {
  none,          // Stokes
  extrapolated,  // by a velocity known before the step: one linear system a step
  newton,        // to `newton_tolerance`
};
enum class Scheme { backward_euler, bdf2 };

struct NotConverged : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct Settings {
  Advection advection = Advection::extrapolated;
  Scheme scheme = Scheme::bdf2;
  double newton_tolerance = 1e-9;  // change of the last iteration, relative to the solution, in U and in p
  int max_newton = 30;
  std::optional<LinearSettings> linear;  // none: direct in 2D; in 3D ilu with order 1, fieldsplit with order 2
};

struct Report {
  int newton_iterations = 0, linear_iterations = 0, factorisations = 0;
  double change = 0.0;           // of the last Newton iteration
  double net_inflow = 0.0;       // through all boundaries relative to the mesh [m^dim/s]
  double pore_volume_rate = 0.0; // d/dt of int eps over the domain [m^dim/s]
  double volume_error = 0.0;     // of their balance, less 1e-14 of the volume, relative to the fastest flow through all of the boundary and all changes of eps [-]
  // The largest of any element: of the flow relative to the mesh, at its middle, h the length of the element along it.
  double courant = 0.0;          // |u - w| dt/h [-]; 0 where the flow is steady
  double peclet = 0.0;           // rho |u - w| h/eta [-]
  double eps_jump = 0.0;         // highest void fraction less the lowest, over the lowest [-]
  double assembly_time = 0.0, solve_time = 0.0;  // [s]
};

template <int dim>
class Fluid {
 public:
  Fluid(std::shared_ptr<const Mesh<dim>> mesh, int order, Properties<dim> properties);

  Properties<dim> properties;
  Settings settings;

  // Velocities are those of the fluid, u = U/eps. Where boundaries meet, walls and inflows come first; each of them says what crosses it, and
  // the one set last the rest.
  void set_wall(const std::string& boundary, VectorField<dim> velocity);
  void set_inflow(const std::string& boundary, VectorField<dim> velocity);
  void set_slip(const std::string& boundary);
  // The traction is -p n. Fluid that enters against the flow brings no momentum.
  void set_outflow(const std::string& boundary, ScalarField<dim> pressure);
  // Lets fluid through: tangential velocity of the plate, traction -p n along the normal; entering fluid has the plate's velocity.
  void set_permeable(const std::string& boundary, VectorField<dim> velocity, ScalarField<dim> pressure);
  // Moves a boundary, from the next step on; walls and plates without a velocity of their own go with it. The mesh inside follows:
  enum class MeshMotion {
    harmonic,  // each component harmonic on the mesh at the start; boundaries that do not move let nodes slide along the axes they are normal to none of
    stretch,   // linear between two boundaries that move as a whole, along the line that joins them
  };
  void move_boundary(const std::string& boundary, VectorField<dim> velocity);
  MeshMotion mesh_motion = MeshMotion::harmonic;
  // Where no boundary knows the pressure its mean is 0, or this [Pa].
  void set_mean_pressure(double pressure);

  // Of the coming step, at the nodes of the mesh or at all of nodes(): in (0, 1].
  void set_void_fraction(std::span<const double> eps);
  // Flux and pressure to start from; also the past of the first step.
  void set_velocity(std::span<const Vec<dim>> u);
  void set_pressure(std::span<const double> p);
  // At quadrature_points(), element by element, or at the nodes of the mesh, linear between them; empty: none.
  void set_reaction(std::vector<Reaction<dim>> reaction);
  std::vector<Vec<dim>> quadrature_points() const;
  std::vector<double> quadrature_weights() const;  // they add up to the volume [m^dim]
  // The reaction is beta (target - (u - u before)) + force - yield (grad p - grad p before): what beta and yield stand for is then no more than the
  // change of a force that is told otherwise.
  bool reaction_on_change = false;
  // The grains' void fraction is that of the start of a step: d(eps)/dt lags behind by one, and where grains follow the fluid, u ~ v, a column
  // of more than half solids would answer every step with a larger one, u = -(1 - eps)/eps v. With this set, continuity takes the change of the
  // solid's flux that goes with the fluid's own in advance, and gives back what it took a step before:
  //   d(eps)/dt + div(U + a - a before) = 0,  a = f (u - u before), f the solid fraction that follows, given with the reaction:
  // of second order in time, no volume is lost, and none crosses a boundary. Where grains are held it would do harm.
  bool grains_follow = false;

  // Moves the mesh for the coming step of dt, so that what is set then is of the mesh where it will be; step() does it where this was not called.
  void move(double dt);
  Report step(double dt);
  Report solve_steady();

  // mark() before a step and back() after it: the step can be made again, with another reaction.
  void mark();
  void back();

  // All that changes from step to step; conditions, fields and settings do not belong to it. The step after state() factorises anew, so that
  // a run that goes on and one that is restored there, on as many ranks, stay the same bit for bit; on several ranks not with MUMPS, which adds
  // up messages as they come. restore() throws std::invalid_argument where the state is of another mesh or element.
  std::vector<double> state();
  void restore(std::span<const double> state);

  double time() const { return time_; }
  const Mesh<dim>& mesh() const { return *mesh_; }
  const Space<dim>& space() const { return space_; }
  int velocity_order() const { return space_.order; }
  // Nodes of the mesh, then with order 2 the middles of edges [m]; values there.
  std::vector<Vec<dim>> nodes() const;
  std::vector<Vec<dim>> velocity() const;      // u [m/s]
  std::vector<double> void_fraction() const;
  std::vector<double> pressure() const;        // at the nodes of the mesh [Pa]

  // Of the fluid on a boundary [N] (2D: N/m): pressure, and the viscous traction as the momentum balance has it.
  Vec<dim> force(const std::string& boundary) const;
  // Its moment about a point: in 2D one number, along the axis out of the plane [N m/m], in 3D a vector [N m].
  using Moment = Eigen::Matrix<double, dim == 2 ? 1 : 3, 1>;
  Moment torque(const std::string& boundary, const Vec<dim>& centre) const;
  // int (U - eps w) . n over the last step along a named boundary, or named facets inside [m^dim/s]: relative to the mesh.
  double flux(const std::string& boundary) const;
  // u in an element, after the last step or the one before [m/s].
  Vec<dim> velocity_in(int element, const Barycentric<dim>& l, int steps_ago = 0) const;
  struct Probe {
    Vec<dim> velocity;
    double pressure;
    Vec<dim> pressure_gradient;
  };
  std::vector<Probe> probe(std::span<const Vec<dim>> x) const;
  // Projected on the nodes of the mesh with lumped masses, int N f/int N of each: what grains are told, adjoint to fields that are linear between nodes.
  struct Projected {
    std::vector<Vec<dim>> velocity;           // u [m/s]
    std::vector<Vec<dim>> pressure_gradient;  // [Pa/m], with the step to the pressure outside where that is given
    std::vector<Vec<dim>> viscous_force;      // div(2 eta D(u)), the traction at the boundary included [N/m^3]
    std::vector<Vec<dim>> convection;         // (u - w) . grad u, w the velocity of the mesh [m/s^2]; empty where it was not asked for
  };
  Projected projected(bool convection = false) const;
  // Of the last step: what its equations leave open, summed over all that is not held; and the force of the reaction on the fluid [N] (2D: N/m).
  Vec<dim> momentum_residual() const;
  Vec<dim> reaction_force() const;
  // Relative L2 errors against a known flow, by a rule of degree 4 or more.
  struct Error {
    double velocity, pressure;
  };
  Error error(const VectorField<dim>& velocity, const ScalarField<dim>& pressure) const;

 private:
  enum class Kind { none, wall, inflow, slip, outflow, permeable };
  struct Condition {
    Kind kind = Kind::none;
    int turn = 0;  // of setting
    VectorField<dim> velocity;  // none: that of the mesh
    ScalarField<dim> pressure;
  };
  struct Harmonic;
  struct Held {  // of a velocity node
    Mat<dim> frame = Mat<dim>::Identity();  // its axes as columns
    int last = 0;                           // held axes: 0 ... last - 1
    Vec<dim> value = Vec<dim>::Zero();      // of U along them
  };

  int boundary_index(const char* function, const std::string& name) const;
  int outer_boundary(const char* function, const std::string& name) const;
  Condition& condition(const char* function, const std::string& name, Kind kind);
  void check_conditions(const char* function) const;
  bool has_pressure_reference() const;
  template <class Visit>
  void each_part(Visit&& visit);
  std::vector<double> parts();
  void set_parts(std::span<const double> parts);
  void move_mesh(double t, double dt);
  void undo_move();
  std::vector<Vec<dim>> harmonic(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity);
  std::vector<Vec<dim>> stretch(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity) const;
  double pore_volume(const std::vector<double>& eps) const;
  double swept(int boundary, double dt) const;
  std::vector<double> solve_step(double t, const TimeWeights& time, Report& report);
  void hold(double t);
  void evaluate_outside(double t);
  template <int order, class T>
  struct Input;  // of an element, or of as many as T has lanes
  template <int order, class T>
  void gather(std::span<const int> elements, Input<order, T>& to) const;
  std::vector<Vec<dim>> eps_slopes() const;
  std::vector<Vec<dim>> subscales(const std::vector<double>& x, const TimeWeights& time) const;
  void keep_advance();
  std::vector<Vec<dim>> advances(const std::vector<double>& x, double dt) const;
  template <class Use>
  void each_point(Use&& use) const;
  template <class Use>
  void each_open_point(Use&& use, int steps_ago = 0) const;
  double yield_at(const std::array<int, dim + 1>& corners, const Barycentric<dim>& l) const;
  template <int order, class T>
  void scatter(int local, int lane, const ElementSystem<dim, order, T>& system);
  template <int order>
  void assemble(const TimeWeights& time, bool newton);
  template <int order>
  void add_boundaries();
  std::vector<double> solve(const char* function, const std::vector<double>& start, const TimeWeights& time, bool newton, double tolerance, Report& report);
  std::vector<double> times_matrix(const std::vector<double>& x) const;
  std::vector<double> eps_change(double dt) const;
  template <class Use>
  void loads(const char* function, const std::string& boundary, Use&& use) const;
  std::vector<int> node_numbers() const;
  template <class T = double>
  struct InElement {
    VecOf<dim, T> u;       // [m/s]
    Mat<dim, T> stress;    // 2 eta D(u) [Pa]
    T eps;
    Mat<dim, T> slope;     // d u_i/d x_j [1/s]
  };
  template <int order, class T>
  struct AtNodes {  // of an element, or of as many as T has lanes
    std::array<T, shape_count<dim, order>> eps;
    std::array<VecOf<dim, T>, shape_count<dim, order>> flux;
    std::array<VecOf<dim, T>, dim + 1> x, mesh_velocity;
    std::array<T, dim + 1> pressure;
  };
  template <int order, class T>
  AtNodes<order, T> at_nodes(int first, int count) const;
  template <int order, class T>
  InElement<T> flow_at(const AtNodes<order, T>& nodes, const Barycentric<dim>& l, const Geometry<dim, T>& g) const;
  template <int order>
  Vec<dim> velocity_at(int element, const Barycentric<dim>& l, int steps_ago) const;
  InElement<> flow_in(int element, const Barycentric<dim>& l, const Geometry<dim>& g) const;
  double pressure_in(int element, const Barycentric<dim>& l, int steps_ago = 0) const;
  Vec<dim> pressure_slope(int element, const Geometry<dim>& g, int steps_ago = 0) const;
  Vec<dim> mesh_velocity_at(int node) const;
  std::vector<std::pair<int, Vec<dim>>> facet_nodes(int facet) const;
  void spread_surplus(const char* function, const std::vector<double>& x, const TimeWeights& time, std::vector<double>& missing) const;
  std::vector<double> vertex_volumes() const;
  double mean_pressure(const std::vector<double>& x) const;
  double relative_change(const std::vector<double>& x, const std::vector<double>& before) const;
  double flux_of(const std::vector<double>& x, int boundary) const;
  void judge_elements(Report& report, const std::vector<double>& x, double dt) const;
  void account(Report& report, const std::vector<double>& x, const TimeWeights& time) const;
  [[noreturn]] void throw_newton(const char* function, const Report& report) const;

  std::shared_ptr<const Mesh<dim>> mesh_;
  Space<dim> space_;
  std::vector<Condition> conditions_;  // of each boundary
  std::vector<VectorField<dim>> motion_;  // of each boundary; none: it stays
  std::shared_ptr<Harmonic> harmonic_;
  int turns_ = 0;
  std::optional<double> mean_pressure_;
  std::vector<Vec<dim>> position_, old_position_;  // of mesh nodes, now and at the start of the step
  std::vector<Vec<dim>> mesh_velocity_, old_mesh_velocity_;  // of mesh nodes
  std::vector<double> marked_;                     // by mark(), with the next
  double marked_move_ = 0.0;
  std::vector<std::vector<double>> marked_outside_;
  double moved_for_ = 0.0;                         // length of the coming step where move() was called, else 0 [s]
  std::array<std::vector<double>, 3> eps_;         // at velocity nodes: now, one and two steps ago
  std::array<std::vector<double>, 2> x_;           // unknowns, Cartesian, after the last step and the one before
  std::vector<Vec<dim>> eps_slope_;                // order 1: grad eps at the nodes, for the coming step [1/m]
  std::array<std::vector<Vec<dim>>, 2> subscale_;  // order 1: at quadrature points, after the last step and the one before [m/s]
  std::vector<Residual<dim, Lanes>> residual_;     // order 1: of the last system at quadrature points; empty where subscales() has to find it
  std::vector<Vec<dim>> advance_;                  // with grains_follow: dt a of the last step at quadrature points [m]
  std::vector<double> guess_;                      // that advects
  std::array<double, 3> pore_volume_{};            // int eps: now, and one and two steps ago [m^dim]
  std::array<std::vector<double>, 3> swept_;       // by each boundary over this step, the last and the one before: int eps w . n [m^dim]
  TimeWeights time_weights_{};                     // of the last step
  std::array<std::vector<double>, 2> eps_change_;  // over this step and the last: int q (change of eps at a fixed point), per vertex [m^dim]
  std::vector<Reaction<dim>> reaction_;
  std::vector<double> yield_;                      // of the reaction at mesh nodes; empty: 0
  std::vector<Held> held_;
  std::vector<char> has_frame_;
  std::vector<std::vector<double>> outer_pressure_, outer_before_;  // per boundary, at the facets' quadrature points; that of the step before
  std::vector<std::vector<Vec<dim>>> outer_velocity_;
  std::vector<std::vector<int>> facets_of_;          // of each boundary
  std::vector<double> values_, b_;                   // this rank's rows, before conditions
  std::vector<double> reaction_at_nodes_;            // A x - b: what holds the held unknowns
  std::unique_ptr<LinearSolver> solver_;
  double pressure_scale_ = 1.0;  // pressure that weighs as much as a flux of 1 m/s, in the last system [Pa s/m]
  double time_ = 0.0, dt_ = 0.0;
  int steps_ = 0;
  bool eps_started_ = false;
};

}  // namespace quicksand::fluid
