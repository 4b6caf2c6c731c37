// quicksand.grains in Python: numpy arrays in, numpy arrays out, grains in the order of adding.
#include "errors.hpp"
#include "measure.hpp"

#include <omp.h>
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

namespace py = pybind11;
using namespace py::literals;

namespace {

using namespace quicksand;
using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;

// A C-contiguous float64 array is read in place; others are converted first.
template <class T>
std::span<const T> as_span(const Array& a, const char* where, const char* what) {
  constexpr int width = sizeof(T) / sizeof(double);
  const bool fits = width == 1 ? a.ndim() == 1 : (a.ndim() == 2 && a.shape(1) == width);
  if (!fits)
    fail("{}: {} must be an array of shape {}", where, what,
                                            width == 1 ? std::string("(n,)") : fmt::format("(n, {})", width));
  return {reinterpret_cast<const T*>(a.data()), static_cast<std::size_t>(a.shape(0))};
}

// Hands a vector to numpy without copying it.
template <class T>
Array to_numpy(std::vector<T>&& values) {
  auto* kept = new std::vector<T>(std::move(values));
  const py::capsule owner(kept, [](void* p) { delete static_cast<std::vector<T>*>(p); });
  std::vector<py::ssize_t> shape{static_cast<py::ssize_t>(kept->size())};
  if (sizeof(T) > sizeof(double)) shape.push_back(sizeof(T) / sizeof(double));
  return Array(shape, reinterpret_cast<const double*>(kept->data()), owner);
}

template <int dim>
struct WallHandle {
  py::object owner;  // keeps the simulation alive
  Simulation<dim>* simulation;
  int number;
  const Wall<dim>& wall() const { return simulation->walls()[number]; }
};

using PerAxis = std::optional<std::vector<std::optional<double>>>;

// velocity and load per axis -> drive() and load(); an axis with neither is held.
template <int dim>
WallHandle<dim> driven(py::object self, int number, const PerAxis& velocity, const PerAxis& load, std::optional<double> mass) {
  auto* simulation = self.cast<Simulation<dim>*>();
  for (const auto* axes : {&velocity, &load})
    if (*axes && (*axes)->size() != dim)
      fail("wall: velocity and load need one entry per axis ({}), None where not driven", dim);
  for (int k = 0; k < dim; ++k) {
    const bool by_velocity = velocity && (*velocity)[k], by_load = load && (*load)[k];
    if (by_velocity && by_load)
      fail("wall: axis {} is driven by velocity and by load; give one of them", k);
    if (by_load) simulation->load(number, k, *(*load)[k], mass);
    else simulation->drive(number, k, by_velocity ? *(*velocity)[k] : 0.0);
  }
  return {self, simulation, number};
}

Solver solver_named(const std::string& name) {
  if (name == "nlgs") return Solver::nlgs;
  if (name == "active_set") return Solver::active_set;
  fail("Simulation: solver must be 'active_set' or 'nlgs', got '{}'", name);
}

SubSteps sub_steps_named(const std::string& name) {
  if (name == "relative") return SubSteps::relative;
  if (name == "absolute") return SubSteps::absolute;
  fail("Simulation: sub_step_rule must be 'relative' or 'absolute', got '{}'", name);
}

template <int dim>
void bind(py::module_& m, const char* suffix) {
  using Sim = Simulation<dim>;
  using Report = StepReport<dim>;
  using Handle = WallHandle<dim>;
  auto named = [&](const char* name) { return fmt::format("{}{}", name, suffix); };

  py::class_<Report>(m, named("StepReport").c_str(), "What a step says of itself. Energies in J (2D: J per m of depth).")
      .def_readonly("time", &Report::time, "at the end [s]")
      .def_readonly("dt", &Report::dt, "[s]")
      .def_readonly("sub_steps", &Report::sub_steps)
      .def_readonly("sweeps", &Report::sweeps, "of all sub-steps")
      .def_readonly("updates", &Report::updates, "contacts visited in the sweeps")
      .def_readonly("candidates", &Report::candidates, "contacts within the alert distance, mean over sub-steps")
      .def_readonly("contacts", &Report::contacts, "load-bearing contacts between grains, mean over sub-steps")
      .def_readonly("residual", &Report::residual, "largest of the sub-steps, energy norm of the natural map [-]")
      .def_readonly("worst_contact", &Report::worst_contact, "largest h W_nn |e| of one contact [m]")
      .def_readonly("max_overlap", &Report::max_overlap, "[m]")
      .def_readonly("unconverged", &Report::unconverged, "sub-steps accepted above the tolerance")
      .def_readonly("work_walls", &Report::work_walls, "work of driven walls and of loads [J]")
      .def_readonly("work_forces", &Report::work_forces, "work of gravity and forces on grains [J]")
      .def_readonly("dissipation", &Report::dissipation, "in contacts [J]")
      .def_readonly("kinetic_energy", &Report::kinetic_energy, "at the end, load-driven walls included [J]")
      .def_readonly("energy_balance_error", &Report::energy_balance_error, "[J]")
      .def_readonly("virial_contacts", &Report::virial_contacts,
                    "(dim, dim), mean over dt of the sum over grain contacts of force x branch [J]; / volume = stress [Pa]")
      .def_readonly("virial_wall_contacts", &Report::virial_wall_contacts, "the same between walls and grains [J]")
      .def_readonly("virial_kinetic", &Report::virial_kinetic, "sum of m v x v at the end, in the frame of the box [J]")
      .def_readonly("branch_length", &Report::branch_length, "mean over load-bearing contacts between grains [m]")
      .def_readonly("coordination", &Report::coordination, "2 load-bearing contacts between grains / grains [-]");

  py::class_<Handle>(m, named("Wall").c_str(), "A wall of a Simulation.")
      .def_property_readonly("number", [](const Handle& h) { return h.number; })
      .def_property_readonly("position", [](const Handle& h) { return h.wall().point; }, "(dim,) a point of it [m]")
      .def_property_readonly("velocity", [](const Handle& h) { return h.wall().v; }, "(dim,) [m/s]")
      .def_property_readonly("force", [](const Handle& h) { return h.wall().force; },
                             "(dim,) contact force on it, mean over the last step [N] (2D: N/m)")
      .def_property_readonly("load", [](const Handle& h) { return h.wall().load; }, "(dim,) [N] (2D: N/m)")
      .def_property_readonly("mass", [](const Handle& h) { return h.wall().mass; },
                             "of load-driven axes [kg] (2D: kg/m); 0: set at the first step")
      .def("drive", [](const Handle& h, int axis, double velocity) { h.simulation->drive(h.number, axis, velocity); }, "axis"_a, "velocity"_a, "From now on drive an axis by velocity [m/s].")
      .def("set_load", [](const Handle& h, int axis, double load) { h.simulation->load(h.number, axis, load, std::nullopt); }, "axis"_a, "load"_a, "From now on drive an axis by load [N] (2D: N/m).");

  py::class_<Sim>(m, named("Simulation").c_str(), "A scene of grains and walls; made by Simulation(dim=...).")
      .def("add",
           [](Sim& s, const Array& x, const py::object& radius, double density, const std::optional<Array>& velocity,
              const std::optional<Array>& spin, const std::string& material) {
             const auto xs = as_span<Vec<dim>>(x, "add", "position");
             Array r = py::isinstance<py::float_>(radius) || py::isinstance<py::int_>(radius)
                           ? to_numpy(std::vector<double>(xs.size(), radius.cast<double>()))
                           : radius.cast<Array>();
             const int first = s.add(xs, as_span<double>(r, "add", "radius"), density,
                                     velocity ? as_span<Vec<dim>>(*velocity, "add", "velocity") : std::span<const Vec<dim>>{},
                                     spin ? as_span<Spin<dim>>(*spin, "add", "spin") : std::span<const Spin<dim>>{}, material);
             return py::make_tuple(first, s.count());
           },
           "position"_a, "radius"_a, "density"_a = 1000.0, "velocity"_a = py::none(), "spin"_a = py::none(),
           "material"_a = "grain",
           "Add grains.\n\nParameters\n----------\nposition : (n, dim) [m]\nradius : (n,) or float [m]\ndensity : float [kg/m^3]\n"
           "velocity : (n, dim) [m/s], optional\nspin : (n,) in 2D, (n, 3) in 3D [rad/s], optional\nmaterial : str\n\n"
           "Returns\n-------\n(first, last + 1) : ids of the new grains\n\nRaises\n------\nValueError : a radius <= 0, values that are "
           "not finite, an unknown material, a period below four diameters")
      .def("add_plane",
           [](py::object self, const Vec<dim>& point, const Vec<dim>& normal, const std::string& material,
              const PerAxis& velocity, const PerAxis& load, std::optional<double> mass) {
             const int w = self.cast<Sim*>()->add_plane(point, normal, material);
             return driven<dim>(self, w, velocity, load, mass);
           },
           "point"_a, "normal"_a, "material"_a = "wall", "velocity"_a = py::none(), "load"_a = py::none(), "mass"_a = py::none(),
           "Add a plane wall; the grains are on the side its normal points to.\n\n"
           "Each axis is driven by velocity [m/s], by load [N] (2D: N/m), or held (None in both). `mass` [kg] (2D: kg/m) is that of the\n"
           "load-driven axes; default: a tenth of the mass of the grains present at the first step (steady states do not depend on it).")
      .def("set_friction", &Sim::set_friction, "a"_a, "b"_a, "friction"_a,
           "Coulomb friction [-] between two materials; names the materials. Every pair that may touch must be set.")
      .def("set_restitution", &Sim::set_restitution, "a"_a, "b"_a, "normal"_a, "tangential"_a = 0.0,
           "Newton restitution [-] in [0, 1]: u_n+ = -normal u_n-; tangential likewise. Off by default.")
      .def("set_inertia", &Sim::set_inertia, "ratio"_a, "I/(m r^2) of every grain [-]; default 1/2 in 2D, 2/5 in 3D.")
      .def("attach",
           [](Sim& s, const Handle& wall, const Array& x, const py::object& radius, const std::string& material) {
             const auto xs = as_span<Vec<dim>>(x, "attach", "position");
             Array r = py::isinstance<py::float_>(radius) || py::isinstance<py::int_>(radius)
                           ? to_numpy(std::vector<double>(xs.size(), radius.cast<double>()))
                           : radius.cast<Array>();
             s.attach(wall.number, xs, as_span<double>(r, "attach", "radius"), material);
           },
           "wall"_a, "position"_a, "radius"_a, "material"_a = "grain",
           "Fix grains to a wall, which they make rough: (n, dim) [m], (n,) or float [m]. They move with it and do not count as grains.")
      .def("step",
           [](Sim& s, double dt) {
             py::gil_scoped_release release;
             return s.step(dt);
           },
           "dt"_a, "Advance by dt [s], in as many sub-steps as the motion asks for. Returns a StepReport.\n\n"
           "Raises NotConverged when a sub-step misses its tolerance, unless accept_unconverged.")
      .def("profile",
           [](const Sim& s, int axis, double low, double high, int bins) {
             Profile<dim> p = profile(s, axis, low, high, bins);
             return py::dict("solid"_a = to_numpy(std::move(p.solid)), "momentum"_a = to_numpy(std::move(p.momentum)),
                             "second"_a = to_numpy(std::move(p.second)));
           },
           "axis"_a, "low"_a, "high"_a, "bins"_a,
           "Sums over slices along an axis, to be added up over time: dict of solid (bins,) [m^dim], momentum (bins, dim) = sum of\n"
           "solid x velocity, second (bins, dim) = sum of solid x velocity^2. Grains are cut exactly.")
      .def("contacts",
           [](const Sim& s) {
             ContactList<dim> c = s.contacts();
             py::array_t<std::int64_t> i(c.i.size(), c.i.data()), j(c.j.size(), c.j.data());
             return py::dict("grain_i"_a = i, "grain_j"_a = j, "normal"_a = to_numpy(std::move(c.normal)),
                             "point"_a = to_numpy(std::move(c.point)), "force_normal"_a = to_numpy(std::move(c.force_normal)),
                             "force_tangential"_a = to_numpy(std::move(c.force_tangential)));
           },
           "Load-bearing contacts of the last sub-step: grain_i, grain_j (ids; wall w is -1 - w), normal (n, dim) from i to j,\n"
           "point (n, dim) [m], force_normal (n,) and force_tangential (n, dim) on j [N] (2D: N/m).")
      .def("state",
           [](const Sim& s) {
             const std::vector<char> bytes = s.state();
             return py::array_t<std::uint8_t>(bytes.size(), reinterpret_cast<const std::uint8_t*>(bytes.data()));
           },
           "All that the next step depends on, the number of threads left out: (n,) uint8, for restore() by the same version.")
      .def("restore",
           [](Sim& s, const py::array_t<std::uint8_t, py::array::c_style>& state) {
             s.restore({reinterpret_cast<const char*>(state.data()), static_cast<std::size_t>(state.size())});
           },
           "state"_a, "Become the scene that state() was taken of; it goes on bit for bit. Its walls are numbered as they were.\n\n"
           "Raises\n------\nValueError : of another version or dimension, or damaged; nothing is changed then")
      .def_property_readonly("time", &Sim::time, "[s]")
      .def_property_readonly("count", &Sim::count, "number of grains, those fixed to walls not counted")
      .def_property_readonly("dim", [](const Sim&) { return dim; })
      .def_property_readonly("memory", &Sim::memory, "bytes held for grains and contacts")
      .def_property_readonly("detections", [](const Sim& s) { return s.neighbours().found; }, "times neighbours were found anew")
      .def_property_readonly("period", [](const Sim& s) { return s.box().period; }, "(dim,) [m]; 0: not periodic")
      .def_readwrite("gravity", &Sim::gravity, "(dim,) [m/s^2]; assign a whole vector")
      .def_property("position",
                    [](const Sim& s) { return to_numpy(s.by_id([&](const Grains<dim>& g, int k) { return Vec<dim>(s.box().wrap(g.x[k])); })); },
                    [](Sim& s, const Array& a) { s.set_position(as_span<Vec<dim>>(a, "position", "position")); },
                    "(n, dim) [m], a copy; periodic axes in [-L/2, L/2)")
      .def_property("velocity",
                    [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return Vec<dim>(g.body[k].v); })); },
                    [](Sim& s, const Array& a) { s.set_velocity(as_span<Vec<dim>>(a, "velocity", "velocity")); },
                    "(n, dim) [m/s], a copy")
      .def_property("spin",
                    [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return Spin<dim>(g.body[k].s / g.r[k]); })); },
                    [](Sim& s, const Array& a) { s.set_omega(as_span<Spin<dim>>(a, "spin", "spin")); },
                    "angular velocity, (n,) in 2D, (n, 3) in 3D [rad/s], a copy")
      .def_property_readonly("radius", [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return g.r[k]; })); },
                             "(n,) [m], a copy")
      .def_property_readonly("mass", [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return 1.0 / g.body[k].inv_m; })); },
                             "(n,) [kg] (2D: kg/m), a copy")
      .def("set_force", [](Sim& s, const std::optional<Array>& f) {
             s.set_force(f ? as_span<Vec<dim>>(*f, "set_force", "force") : std::span<const Vec<dim>>{});
           }, "force"_a, "External force on each grain from now on, (n, dim) [N] (2D: N/m); None: none.")
      .def_property("tolerance", [](const Sim& s) { return s.settings.solve.tolerance; },
                    [](Sim& s, double v) {
                      if (!(v > 0)) fail("tolerance: must be > 0, got {}", v);
                      s.settings.solve.tolerance = v;
                    }, "of every sub-step, on the residual [-]; no contact may be wrong by more than tolerance/20 mean diameters")
      .def_property("max_sweeps", [](const Sim& s) { return s.settings.solve.max_sweeps; },
                    [](Sim& s, int v) {
                      if (v < 1) fail("max_sweeps: must be >= 1, got {}", v);
                      s.settings.solve.max_sweeps = v;
                    }, "before the fallback, and again as many for it")
      .def_property("omega", [](const Sim& s) { return s.settings.solve.omega; },
                    [](Sim& s, double v) {
                      if (!(v >= 1 && v < 2)) fail("omega: must be in [1, 2), got {}", v);
                      s.settings.solve.omega = v;
                    }, "over-relaxation to start from [-]")
      .def_property("active_sweeps", [](const Sim& s) { return s.settings.solve.active_sweeps; },
                    [](Sim& s, int v) {
                      if (v < 1) fail("active_sweeps: must be >= 1, got {}", v);
                      s.settings.solve.active_sweeps = v;
                    }, "over unsettled contacts between sweeps over all")
      .def_property("sub_step_motion", [](const Sim& s) { return s.settings.sub_step_motion; },
                    [](Sim& s, double v) {
                      if (!(v > 0 && v <= 0.5)) fail("sub_step_motion: must be in (0, 0.5], got {}", v);
                      s.settings.sub_step_motion = v;
                    }, "largest motion of a pair in a sub-step over the distance of its centres [-]")
      .def_property("rest_speed", [](const Sim& s) { return s.settings.rest_speed; },
                    [](Sim& s, double v) {
                      if (!(v >= 0)) fail("rest_speed: must be >= 0 m/s, got {}", v);
                      s.settings.rest_speed = v;
                    }, "contacts that approach more slowly do not rebound [m/s]")
      .def_property("solver", [](const Sim& s) { return s.settings.solver == Solver::nlgs ? "nlgs" : "active_set"; },
                    [](Sim& s, const std::string& v) { s.settings.solver = solver_named(v); }, "'active_set' or 'nlgs'")
      .def_property("sub_step_rule", [](const Sim& s) { return s.settings.sub_steps == SubSteps::relative ? "relative" : "absolute"; },
                    [](Sim& s, const std::string& v) { s.settings.sub_steps = sub_steps_named(v); },
                    "'relative': motion of neighbours; 'absolute': ceil(8 v_max dt/r_min), the rule of the MigFlow thesis")
      .def_property("accept_unconverged", [](const Sim& s) { return s.settings.accept_unconverged; },
                    [](Sim& s, bool v) { s.settings.accept_unconverged = v; },
                    "go on after a sub-step that missed its tolerance; such sub-steps are counted in the report")
      .def_property("threads", [](const Sim& s) { return s.settings.threads; },
                    [](Sim& s, int v) {
                      if (v < 1) fail("threads: must be >= 1, got {}", v);
                      s.settings.threads = v;
                    }, "at most; fewer where more would be slower. Results do not depend on it, bit for bit");
}

template <int dim>
py::object make(const std::optional<std::vector<std::optional<double>>>& period, const py::object& gravity) {
  Vec<dim> lengths = Vec<dim>::Zero();
  if (period) {
    if (period->size() != dim)
      fail("Simulation: period needs one entry per axis ({}), None where not periodic", dim);
    for (int k = 0; k < dim; ++k) lengths[k] = (*period)[k].value_or(0.0);
  }
  auto simulation = std::make_unique<Simulation<dim>>(lengths);
  if (!gravity.is_none()) simulation->gravity = gravity.cast<Vec<dim>>();
  if (!simulation->gravity.allFinite()) fail("Simulation: gravity [m/s^2] must be finite");
  simulation->settings.threads = omp_get_max_threads();
  return py::cast(std::move(simulation));
}

}  // namespace

PYBIND11_MODULE(_grains, m) {
  m.doc() = "Discs and spheres by Non-Smooth Contact Dynamics.";
  m.attr("__version__") = QUICKSAND_VERSION;
  py::register_exception<NotConverged>(m, "NotConverged", PyExc_RuntimeError);
  bind<2>(m, "2D");
  bind<3>(m, "3D");
  m.attr("Simulation2D").attr("add_segment") = py::cpp_function(
      [](py::object self, const Vec<2>& start, const Vec<2>& end, const std::string& material, const PerAxis& velocity,
         const PerAxis& load, std::optional<double> mass) {
        const int w = self.cast<Simulation<2>*>()->add_segment(start, end, material);
        return driven<2>(self, w, velocity, load, mass);
      },
      py::name("add_segment"), py::is_method(m.attr("Simulation2D")), "start"_a, "end"_a, "material"_a = "wall",
      "velocity"_a = py::none(), "load"_a = py::none(), "mass"_a = py::none(),
      "Add a straight wall between two points [m], met from both sides. Driven as add_plane.");
  m.attr("Simulation2D").attr("psi6") = py::cpp_function(
      &psi6, py::name("psi6"), py::is_method(m.attr("Simulation2D")), "low"_a, "high"_a,
      "Hexagonal order: mean over grains with low <= y <= high [m] of |mean exp(6 i theta)| over neighbours nearer than\n"
      "1.3 (r_i + r_j) [-].");
  m.def(
      "Simulation",
      [](int dim, const std::optional<std::vector<std::optional<double>>>& period, const py::object& gravity,
         const py::kwargs& settings) {
        if (dim != 2 && dim != 3) fail("Simulation: dim must be 2 or 3, got {}", dim);
        py::object simulation = dim == 2 ? make<2>(period, gravity) : make<3>(period, gravity);
        for (const auto& [name, value] : settings) {
          static const std::vector<std::string> known{"threads", "tolerance", "solver", "max_sweeps", "omega", "active_sweeps",
                                                      "sub_step_motion", "sub_step_rule", "rest_speed", "accept_unconverged"};
          if (std::find(known.begin(), known.end(), name.cast<std::string>()) == known.end())
            fail("Simulation: unknown setting '{}', known: {}", name.cast<std::string>(),
                                                    fmt::join(known, ", "));
          if (!value.is_none()) py::setattr(simulation, name, value);
        }
        return simulation;
      },
      "dim"_a = 2, "period"_a = py::none(), "gravity"_a = py::none(),
      "An empty scene.\n\nParameters\n----------\ndim : 2 (discs, per metre of depth) or 3 (spheres)\nperiod : per axis [m], None where not "
      "periodic; the box is [-L/2, L/2)\ngravity : (dim,) [m/s^2]\nthreads, tolerance, solver, max_sweeps, omega, active_sweeps, "
      "sub_step_motion, sub_step_rule, rest_speed,\naccept_unconverged : settings, see the properties of the same names");
}
