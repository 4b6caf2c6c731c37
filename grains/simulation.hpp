// Non-Smooth Contact Dynamics of a scene: the Moreau-Jean step, first order, and the report every step gives of itself.
#pragma once

#include "grains.hpp"
#include "neighbours.hpp"
#include "solvers.hpp"

#include <optional>

namespace quicksand {

enum class Solver { automatic, nlgs, active_set, accelerated, newton };

enum class SubSteps {
  relative,  // motion of a pair relative to each other, in a sub-step, below `sub_step_motion` of the distance of their centres
  absolute,  // ceil(8 v_max dt/r_min): the rule of the MigFlow thesis, from speeds in the frame of the box
};

struct Settings {
  Solver solver = Solver::automatic;
  SolverSettings solve;
  SubSteps sub_steps = SubSteps::relative;
  double sub_step_motion = 0.1;     // [-]
  double rest_speed = 0.0;          // contacts that approach more slowly do not rebound [m/s]
  bool accept_unconverged = false;  // false: a step that misses its tolerance throws NotConverged
  int threads = 1;                  // at most; fewer where more would be slower. Results do not depend on it
};

void check(const Settings& settings, const char* where);  // throws std::invalid_argument

// A sub-step missed its tolerance after all sweeps and fallbacks. The scene has taken the sub-step all the same.
struct NotConverged : std::runtime_error {
  using std::runtime_error::runtime_error;
};

template <int dim>
struct StepReport {
  double time = 0.0;              // at the end [s]
  double dt = 0.0;                // [s]
  int sub_steps = 0;
  int sweeps = 0;                 // of all sub-steps
  long updates = 0;               // contacts visited in them
  double solve_time = 0.0;        // wall time of the contact solver [s]
  long candidates = 0;            // contacts within the alert distance, mean over sub-steps
  long contacts = 0;              // of these load-bearing, mean over sub-steps
  double residual = 0.0;          // largest of the sub-steps [-]
  double worst_contact = 0.0;     // largest h W_nn |e| of one contact [m]
  double max_overlap = 0.0;       // at the starts of the sub-steps, before repair [m]
  int unconverged = 0;            // sub-steps accepted above the tolerance
  double work_walls = 0.0;        // by driven walls and by loads [J] (2D: J/m, as all energies)
  double work_forces = 0.0;       // by gravity and external forces [J]
  double dissipation = 0.0;       // in contacts [J]
  double kinetic_energy = 0.0;    // at the end, load-driven walls included [J]
  double energy_balance_error = 0.0;  // change of kinetic energy - work + dissipation [J]
  Mat<dim> virial_contacts = Mat<dim>::Zero();       // sum over grain contacts of force x branch, mean over dt [J]
  Mat<dim> virial_wall_contacts = Mat<dim>::Zero();  // the same between walls and the grains they touch
  Mat<dim> virial_kinetic = Mat<dim>::Zero();        // sum of m v x v at the end, in the frame of the box [J]
  double branch_length = 0.0;     // mean over load-bearing grain contacts [m]; 0: none
  double coordination = 0.0;      // 2 contacts between grains / grains [-]
};

// Load-bearing contacts of the last sub-step, for output.
template <int dim>
struct ContactList {
  std::vector<std::int64_t> i, j;   // ids; wall w is -1 - w and always i
  std::vector<Vec<dim>> normal;     // from i to j
  std::vector<Vec<dim>> point;      // [m]
  std::vector<double> force_normal; // [N] (2D: N/m)
  std::vector<Vec<dim>> force_tangential;  // on j [N]
};

template <int dim>
class Simulation {
 public:
  explicit Simulation(const Vec<dim>& period);

  Settings settings;
  Vec<dim> gravity = Vec<dim>::Zero();  // [m/s^2]

  // Each returns the id of the first grain, or the number of the wall. All throw std::invalid_argument on what cannot be.
  int add(std::span<const Vec<dim>> x, std::span<const double> radius, double density, std::span<const Vec<dim>> velocity,
          std::span<const Spin<dim>> omega, const std::string& material);
  int add_plane(const Vec<dim>& point, const Vec<dim>& normal, const std::string& material);
  int add_segment(const Vec<dim>& start, const Vec<dim>& end, const std::string& material);
  void remove(std::span<const int> ids);  // the ids of the others close up, in their order; their contacts keep their impulses
  int add_triangle(const Vec<dim>& a, const Vec<dim>& b, const Vec<dim>& c, const std::string& material);
  // A wall for each facet, by its corners: segments in 2D, triangles in 3D. All of them, or none where one cannot be.
  std::vector<int> add_facets(std::span<const std::array<Vec<dim>, dim>> facets, const std::string& material);
  void drive(int wall, int axis, double velocity);                                // [m/s]
  void set_load(int wall, int axis, double force, std::optional<double> mass);    // [N], [kg]
  void attach(int wall, std::span<const Vec<dim>> x, std::span<const double> radius, const std::string& material);
  void set_friction(const std::string& a, const std::string& b, double friction);
  void set_restitution(const std::string& a, const std::string& b, double normal, double tangential);
  void set_inertia(double ratio);                                             // I/(m r^2) [-]
  void set_force(std::span<const Vec<dim>> force);                            // by id [N]; empty: none

  // From now on a fluid drags every grain with gamma (u - v), v its velocity at the end of a sub-step: stable for any gamma. By id:
  // gamma [kg/s] (2D: kg/(m s)), u [m/s]. It exerts no torque. Empty: none. Grains added later have none.
  // Fluid that goes along with a grain, m_a [kg] (2D: kg/m), has it feel -m_a dv/dt besides, implicit too: it is as heavy as m + m_a to all that pushes it,
  // contacts included, in translation; weight and given forces act on m. Empty: none.
  void set_drag(std::span<const double> coefficient, std::span<const Vec<dim>> velocity, std::span<const double> added_mass = {});

  void check(double dt);  // throws what step(dt) would refuse, and changes nothing
  StepReport<dim> step(double dt);

  // All that the next step depends on, the number of threads left out, as bytes for restore() of a scene of the same version and dimension.
  std::vector<char> state() const;
  void restore(std::span<const char> state);  // throws std::invalid_argument, and then changes nothing

  int count() const { return n_free_; }
  double time() const { return time_; }
  const Box<dim>& box() const { return box_; }
  const Grains<dim>& grains() const { return grains_; }
  const std::vector<Wall<dim>>& walls() const { return walls_; }
  const Neighbours<dim>& neighbours() const { return neighbours_; }
  std::size_t memory() const;  // bytes held in arrays that grow with the number of grains
  ContactList<dim> contacts() const;

  // What the last step did to each grain, by id: kept while there is drag; without it they throw std::invalid_argument.
  const std::vector<Vec<dim>>& drag_impulse() const;       // sum of h gamma (u - v) - m_a (change of v) [N s] (2D: N s/m)
  const std::vector<Vec<dim>>& contact_impulse() const;    // of all contacts together [N s]
  const std::vector<std::uint8_t>& in_contact() const;     // whether any contact bore load in any sub-step
  // By id, bit k: along axis k the grain, or one that it hangs together with by contacts of the last sub-step that bear load, leans on a wall
  // that does not yield that way.
  std::vector<std::uint8_t> held() const;

  // The contact problem of the last sub-step and the impulses that were found for it [N s] (2D: N s/m); see delassus().
  // Throws std::invalid_argument where no sub-step was made since the scene was changed from outside or restored.
  std::pair<DelassusProblem<dim>, Eigen::VectorXd> contact_problem();

  // State by id; for changes from outside between steps.
  template <class Get>
  auto by_id(Get&& get) const {
    std::vector<std::decay_t<decltype(get(grains_, 0))>> out(n_free_);
    each([&](int id, const Grains<dim>& grains, int k) { out[id] = get(grains, k); });
    return out;
  }
  template <class Use>
  void each(Use&& use) const {  // use(id, grains, index), in the order of space
    for (int k = 0; k < grains_.size(); ++k)
      if (grains_.id[k] >= 0) use(grains_.id[k], grains_, k);
  }
  void set_position(std::span<const Vec<dim>> x);
  void set_velocity(std::span<const Vec<dim>> v);
  void set_spin(std::span<const Spin<dim>> omega);

 private:
  struct Motion {
    double speed = 0.0;       // largest of a grain relative to a neighbour [m/s]
    double wall_speed = 0.0;  // largest of a grain relative to a wall near it, across it where it is a plane [m/s]
    double rate = 0.0;    // largest speed of a pair over the distance of its centres [1/s]
    double overlap = 0.0; // [m]
  };
  struct Sums {  // over the contacts of a block, added up in the order of the blocks
    double power = 0.0;   // p . (u before + u after)/2 [J]: minus what the contacts dissipate
    double branch = 0.0;  // [m]
    long contacts = 0, candidates = 0;
    Mat<dim> virial = Mat<dim>::Zero();
  };

  template <class Archive>
  void visit_state(Archive&& archive);
  void check_places() const;
  void places_changed();
  int add_wall(Wall<dim>& wall, const std::string& material, const char* where);
  void free_walls();
  int choose_threads();
  NearWall<dim> near_wall(const WallPair<dim>& pair) const;
  const Materials::Pair& law_of(const WallPair<dim>& pair) const;
  Motion measure_pairs();
  void repair_overlaps(double allowed);
  double speed_of_missed(double h, double speed, double alert, double wall_alert) const;
  double sub_step_length(double left, double dt, const Motion& motion, double gain) const;  // gain: speed_gain(left)
  void find_contacts(double h, double alert, double wall_alert);
  void join_facets(double wall_alert);
  Problem<dim> problem();
  SolveReport solve_contacts(double h);
  bool rebound(double h);
  void accelerate(double h);
  double speed_gain(double h) const;
  void weigh(double h);
  void unweigh();
  void note_contacts();
  template <class Visit>
  void each_loaded_contact(Visit&& visit) const {  // between grains, of the last sub-step
    for (std::size_t b = 0; b < count_.size(); ++b)
      for (int k = neighbours_.blocks[b].begin; k < neighbours_.blocks[b].begin + count_[b]; ++k)
        if (contacts_[k].p.n > 0) visit(contacts_[k]);
  }
  bool dragged() const { return !drag_.coefficient.empty(); }
  void account(double h, StepReport<dim>& report);
  void move(double h);
  void set_by_id(std::size_t size, const char* where, const char* what) const;
  void check_wall(int wall, const char* where, int axis = 0) const;
  void check_grains(std::span<const Vec<dim>> x, std::span<const double> radius, const char* where) const;

  Box<dim> box_;
  Grains<dim> grains_;
  std::vector<Wall<dim>> walls_;
  Materials materials_;
  Neighbours<dim> neighbours_;
  struct Drag {  // by id; all empty: none
    std::vector<double> coefficient;     // gamma [kg/s] (2D: kg/(m s))
    std::vector<Vec<dim>> velocity;      // u [m/s]
    std::vector<double> added_mass;      // m_a [kg] (2D: kg/m); empty: 0
    double added_mass_of(int id) const { return added_mass.empty() ? 0.0 : added_mass[id]; }
    std::vector<Vec<dim>> impulse, contact_impulse;  // of the last step [N s] (2D: N s/m)
    std::vector<std::uint8_t> in_contact;
  } drag_;
  int n_free_ = 0, n_fixed_ = 0;
  double time_ = 0.0;
  double last_h_ = 0.0;  // sub-step that the stored impulses belong to [s]
  bool contacts_current_ = false;  // velocities are those that the last sub-step's contacts left
  bool places_checked_ = false;  // by check_places(), since grains or walls were last added or moved from outside

  // Scratch of a sub-step; contacts sit in the slots of their block's pairs.
  int threads_ = 1;
  struct Pace {  // seconds per contact update, with one thread and with all, as measured last
    double seconds[2] = {0.0, 0.0};
    int samples[2] = {0, 0};
    int shared = 1;           // what makes the steps: 1, all
    int left = 0, wait = 200; // steps to the next trial of the other, and from that to the one after it
  } pace_;
  double mean_radius_ = 0.0, max_radius_ = 0.0, acceleration_ = 0.0;  // without drag
  double wall_acceleration_ = 0.0;
  double wall_mass_ = 0.0;  // of load-driven walls whose mass nobody gave: a tenth of the grains' [kg]
  bool friction_ = false, restitution_ = false, tangential_restitution_ = false;
  std::vector<double> gap_;
  std::vector<Vec<dim>> wall_normal_;  // of wall pairs, from the wall to the grain
  std::vector<Contact<dim>> contacts_;
  std::vector<WallContact<dim>> wall_contacts_;
  std::vector<int> pair_of_;  // of each contact: where its impulse is kept between sub-steps
  std::vector<int> count_;
  Scratch scratch_;
  std::vector<Tangent<dim>> bias_t_, wall_bias_t_;
  std::vector<Body<dim>> body_before_;
  std::vector<Vec<dim>> wall_before_;
  std::vector<double> spin_ratios_;  // see Problem; empty: no drag
  std::vector<Sums> sums_;
};

}  // namespace quicksand
