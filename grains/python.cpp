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
using Array = py::array_t<double, py::array::c_style>;  // no forcecast: what loses a part, complex numbers say, is a TypeError

// A C-contiguous float64 array is read in place; others are converted first.
template <class T>
std::span<const T> as_span(const Array& a, const char* where, const char* what) {
  constexpr int width = sizeof(T) / sizeof(double);
  const bool fits = width == 1 ? a.ndim() == 1 : (a.ndim() == 2 && a.shape(1) == width);
  if (!fits)
    fail("{}: {} must be an array of shape {}, got ({})", where, what,
         width == 1 ? std::string("(n,)") : fmt::format("(n, {})", width), fmt::join(a.shape(), a.shape() + a.ndim(), ", "));
  return {reinterpret_cast<const T*>(a.data()), static_cast<std::size_t>(a.shape(0))};
}

// The same where None stands for zeros: an empty array is not None.
template <class T>
std::span<const T> as_span(const std::optional<Array>& a, const char* where, const char* what, std::size_t n) {
  if (!a) return {};
  const auto values = as_span<T>(*a, where, what);
  if (values.empty() && n > 0) fail("{}: one {} per grain, got 0 for {} grains", where, what, n);
  return values;
}

template <int dim>
Vec<dim> as_vector(const Array& a, const char* where, const char* what) {
  if (a.ndim() != 1 || a.shape(0) != dim)
    fail("{}: {} must have shape ({},), got ({})", where, what, dim, fmt::join(a.shape(), a.shape() + a.ndim(), ", "));
  return Eigen::Map<const Vec<dim>>(a.data());
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

// A radius for each of n grains, from one for all or an array.
Array radii(const py::object& radius, std::size_t n, const char* where) {
  const Array r = Array::ensure(radius);
  if (!r) throw py::type_error(fmt::format("{}: radius must be a number or an array of shape (n,), got {}", where,
                                           std::string(py::repr(radius))));
  return r.ndim() == 0 ? to_numpy(std::vector<double>(n, *r.data())) : r;
}

template <int dim>
Vec<dim> finite_gravity(const Array& a) {
  const Vec<dim> g = as_vector<dim>(a, "Simulation", "gravity");
  if (!is_finite(g.norm())) fail("Simulation: gravity must be finite, got ({}) m/s^2", fmt::join(g, ", "));
  return g;
}

template <int dim>
struct WallHandle {
  py::object owner;  // keeps the simulation alive
  Simulation<dim>* simulation;
  int number;
  const Wall<dim>& wall() const { return simulation->walls()[number]; }
};

using PerAxis = std::optional<std::vector<std::optional<double>>>;

// A wall from `add`, with velocity and load per axis -> drive() and set_load(); an axis with neither is held. All is checked before
// there is a wall: none stays behind when something is wrong.
template <int dim, class Add>
WallHandle<dim> add_driven(const py::object& self, const char* where, const PerAxis& velocity, const PerAxis& load,
                           std::optional<double> mass, Add&& add) {
  auto& simulation = self.cast<Simulation<dim>&>();
  for (const auto& [axes, name] : {std::pair{&velocity, "velocity"}, std::pair{&load, "load"}})
    if (*axes && (*axes)->size() != dim)
      fail("{}: {} needs one entry per axis ({}), None where not driven, got {}", where, name, dim, (*axes)->size());
  bool loaded = false;
  auto of_axis = [](const PerAxis& axes, int k) { return axes ? (*axes)[k] : std::nullopt; };
  for (int k = 0; k < dim; ++k) {
    const auto v = of_axis(velocity, k), f = of_axis(load, k);
    if (v && f) fail("{}: axis {} is driven by velocity ({} m/s) and by load ({} N); give one of them", where, k, *v, *f);
    if (v && !is_finite(*v)) fail("{}: velocity must be finite, got {} m/s (axis {})", where, *v, k);
    if (f && !is_finite(*f)) fail("{}: load must be finite, got {} N (axis {})", where, *f, k);
    loaded |= f.has_value();
  }
  if (mass) check_positive(*mass, fmt::format("{}: mass", where), "kg");
  if (mass && !loaded) fail("{}: mass is that of load-driven axes, and no axis has a load, got {} kg", where, *mass);
  const int number = add(simulation);
  for (int k = 0; k < dim; ++k) {
    if (const auto f = of_axis(load, k)) simulation.set_load(number, k, *f, mass);
    else simulation.drive(number, k, of_axis(velocity, k).value_or(0.0));
  }
  return {self, &simulation, number};
}

// Facets of the named boundaries of a mesh, known by its attributes only: grains are built and run without meshes.
template <int dim>
std::vector<int> add_boundaries(Simulation<dim>& simulation, const py::object& mesh, const std::vector<std::string>& names,
                                const std::string& material, const PerAxis& velocity) {
  for (const char* what : {"nodes", "facets", "boundary", "boundary_names"})
    if (!py::hasattr(mesh, what))
      throw py::type_error(fmt::format("walls: mesh must have nodes, facets, boundary and boundary_names, as those of quicksand.meshes, got {}",
                                       std::string(py::repr(mesh))));
  if (velocity && velocity->size() != dim) fail("walls: velocity needs one entry per axis ({}), None where held, got {}", dim, velocity->size());
  for (int k = 0; k < dim && velocity; ++k)
    if (const double v = (*velocity)[k].value_or(0.0); !is_finite(v)) fail("walls: velocity must be finite, got {} m/s (axis {})", v, k);
  using Numbers = py::array_t<int, py::array::c_style | py::array::forcecast>;
  const auto nodes_kept = mesh.attr("nodes").cast<Array>();
  const auto nodes = as_span<Vec<dim>>(nodes_kept, "walls", "nodes of the mesh");
  const auto facets = mesh.attr("facets").cast<Numbers>(), boundary = mesh.attr("boundary").cast<Numbers>();
  const auto known = mesh.attr("boundary_names").cast<std::vector<std::string>>();
  if (facets.ndim() != 2 || facets.shape(1) != dim || boundary.ndim() != 1 || boundary.shape(0) != facets.shape(0))
    fail("walls: facets of the mesh must have shape (n, {}), boundary (n,)", dim);
  std::vector<char> wanted(known.size(), false);
  for (const std::string& name : names) {
    const auto at = std::find(known.begin(), known.end(), name);
    if (at == known.end()) fail("walls: the mesh has no boundary '{}', known: '{}'", name, fmt::join(known, "', '"));
    wanted[at - known.begin()] = true;
  }
  std::vector<std::array<Vec<dim>, dim>> corners;
  for (py::ssize_t f = 0; f < facets.shape(0); ++f) {
    if (!wanted.at(boundary.at(f))) continue;
    corners.emplace_back();
    for (int k = 0; k < dim; ++k) {
      const int node = facets.at(f, k);
      if (node < 0 || node >= static_cast<int>(nodes.size())) fail("walls: no node {} in the mesh (facet {})", node, f);
      corners.back()[k] = nodes[node];
    }
  }
  const std::vector<int> numbers = simulation.add_facets(corners, material);
  for (const int wall : numbers)
    for (int k = 0; k < dim && velocity; ++k) simulation.drive(wall, k, (*velocity)[k].value_or(0.0));
  return numbers;
}

constexpr std::array solver_names{"auto", "nlgs", "active_set", "accelerated", "newton"};  // in the order of Solver

Solver solver_named(const std::string& name) {
  for (std::size_t k = 0; k < solver_names.size(); ++k)
    if (name == solver_names[k]) return static_cast<Solver>(k);
  fail("Simulation: solver must be one of '{}', got '{}'", fmt::join(solver_names, "', '"), name);
}

SubSteps sub_steps_named(const std::string& name) {
  if (name == "relative") return SubSteps::relative;
  if (name == "absolute") return SubSteps::absolute;
  fail("Simulation: sub_step_rule must be 'relative' or 'absolute', got '{}'", name);
}

template <int dim>
py::dict to_python(const DelassusProblem<dim>& problem, const Eigen::VectorXd& r) {
  std::vector<int> row_start{0}, column;
  std::vector<double> value;
  for (int c = 0; c < problem.contacts(); ++c)
    for (int a = 0; a < dim; ++a) {
      for (int k = problem.row_start[c]; k < problem.row_start[c + 1]; ++k)
        for (int b = 0; b < dim; ++b) column.push_back(dim * problem.column[k] + b), value.push_back(problem.blocks[k](a, b));
      row_start.push_back(static_cast<int>(column.size()));
    }
  return py::dict("row_start"_a = py::array_t<int>(row_start.size(), row_start.data()), "column"_a = py::array_t<int>(column.size(), column.data()),
                  "value"_a = to_numpy(std::move(value)), "q"_a = problem.q, "friction"_a = to_numpy(std::vector<double>(problem.friction)),
                  "r"_a = r, "u"_a = contact_velocity(problem, r));
}

using Indices = py::array_t<int, py::array::c_style>;

std::span<const int> as_span(const Indices& a) { return {a.data(), static_cast<std::size_t>(a.size())}; }

template <int dim>
std::pair<DelassusProblem<dim>, Eigen::VectorXd> from_python(const Indices& row_start, const Indices& column, const Array& value, const Array& q,
                                                             const Array& friction, const std::optional<Array>& start, const char* where) {
  DelassusProblem<dim> problem = delassus_problem<dim>(as_span(row_start), as_span(column), as_span<double>(value, where, "value"),
                                                       as_span<double>(q, where, "q"), as_span<double>(friction, where, "friction"));
  Eigen::VectorXd r = Eigen::VectorXd::Zero(problem.q.size());
  if (start) {
    const auto from = as_span<double>(*start, where, "start");
    if (static_cast<Eigen::Index>(from.size()) != r.size()) fail("{}: start must have {} entries, got {}", where, r.size(), from.size());
    for (double x : from)
      if (!is_finite(x)) fail("{}: start must be finite, got {}", where, x);
    r = Eigen::Map<const Eigen::VectorXd>(from.data(), r.size());
  }
  return {std::move(problem), std::move(r)};
}

template <int dim>
py::dict solve_contact_problem(const Indices& row_start, const Indices& column, const Array& value, const Array& q, const Array& friction,
                               const std::string& solver, double tolerance, int max_iterations, const std::optional<Array>& start) {
  constexpr const char* where = "solve_contact_problem";
  check_positive(tolerance, fmt::format("{}: tolerance", where), "");
  if (max_iterations < 1) fail("{}: max_iterations must be >= 1, got {}", where, max_iterations);
  auto [problem, r] = from_python<dim>(row_start, column, value, q, friction, start, where);
  DelassusSettings settings;
  settings.tolerance = tolerance, settings.max_iterations = max_iterations;
  using Solve = DelassusReport (*)(const DelassusProblem<dim>&, Eigen::VectorXd&, const DelassusSettings&);
  Solve solve = nullptr;
  if (solver == "auto") solve = solve_auto<dim>;
  if (solver == "nlgs") solve = solve_nlgs<dim>;
  if (solver == "accelerated") solve = solve_accelerated<dim>;
  if (solver == "newton") solve = solve_newton<dim>;
  if (!solve) fail("{}: solver must be 'auto', 'nlgs', 'accelerated' or 'newton', got '{}'", where, solver);
  DelassusReport report;
  {
    py::gil_scoped_release release;
    report = solve(problem, r, settings);
  }
  return py::dict("r"_a = r, "u"_a = contact_velocity(problem, r), "solver"_a = report.solver, "iterations"_a = report.iterations,
                  "error"_a = report.error, "converged"_a = report.converged, "error_history"_a = report.error_history,
                  "iteration_history"_a = report.iteration_history);
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
      .def_readonly("solve_time", &Report::solve_time, "wall time of the contact solver [s]")
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
      .def("set_load", [](const Handle& h, int axis, double load) { h.simulation->set_load(h.number, axis, load, std::nullopt); }, "axis"_a, "load"_a, "From now on drive an axis by load [N] (2D: N/m).");

  py::class_<Sim> simulation(m, named("Simulation").c_str(), "A scene of grains and walls; made by Simulation(dim=...).");
  simulation
      .def("add",
           [](Sim& s, const Array& x, const py::object& radius, double density, const std::optional<Array>& velocity,
              const std::optional<Array>& spin, const std::string& material) {
             const auto xs = as_span<Vec<dim>>(x, "add", "position");
             const Array r = radii(radius, xs.size(), "add");
             const int first = s.add(xs, as_span<double>(r, "add", "radius"), density,
                                     as_span<Vec<dim>>(velocity, "add", "velocity", xs.size()),
                                     as_span<Spin<dim>>(spin, "add", "spin", xs.size()), material);
             return py::make_tuple(first, s.count());
           },
           "position"_a, "radius"_a, "density"_a = 1000.0, "velocity"_a = py::none(), "spin"_a = py::none(),
           "material"_a = "grain",
           "Add grains.\n\nParameters\n----------\nposition : (n, dim) [m]\nradius : (n,) or float [m]\ndensity : float [kg/m^3]\n"
           "velocity : (n, dim) [m/s], optional\nspin : (n,) in 2D, (n, 3) in 3D [rad/s], optional\nmaterial : str\n\n"
           "Returns\n-------\n(first, last + 1) : ids of the new grains\n\nRaises\n------\nValueError : a radius <= 0, values that are "
           "not finite, an unknown material, a period below four diameters")
      .def("remove",
           [](Sim& s, const py::object& object) {
             const auto ids = py::array::ensure(object);
             if (!ids) throw py::type_error(fmt::format("remove: ids must be integers of shape (n,), got {}", std::string(py::repr(object))));
             if (ids.ndim() != 1 || (ids.size() > 0 && ids.dtype().kind() != 'i'))  // as integers, a mask would name grains 0 and 1
               fail("remove: ids must be integers of shape (n,), got {} of {} dimensions", std::string(py::str(ids.dtype())), ids.ndim());
             const auto values = py::array_t<std::int64_t, py::array::c_style | py::array::forcecast>(ids);
             std::vector<int> narrow;
             for (py::ssize_t k = 0; k < values.size(); ++k) {
               if (values.at(k) < 0 || values.at(k) >= s.count()) fail("remove: no grain {}, the scene has {}", values.at(k), s.count());
               narrow.push_back(static_cast<int>(values.at(k)));
             }
             s.remove(narrow);
           },
           "ids"_a,
           "Take grains out of the scene, (n,) int. The ids of the others close up, in their order, and their contacts keep their impulses.\n\n"
           "Raises\n------\nValueError : an id that no grain has, or twice the same; nothing is changed then")
      .def("add_plane",
           [](const py::object& self, const Array& point, const Array& normal, const std::string& material,
              const PerAxis& velocity, const PerAxis& load, std::optional<double> mass) {
             return add_driven<dim>(self, "add_plane", velocity, load, mass, [&](Sim& s) {
               return s.add_plane(as_vector<dim>(point, "add_plane", "point"), as_vector<dim>(normal, "add_plane", "normal"), material);
             });
           },
           "point"_a, "normal"_a, "material"_a = "wall", "velocity"_a = py::none(), "load"_a = py::none(), "mass"_a = py::none(),
           "Add a plane wall; the grains are on the side its normal points to.\n\n"
           "Each axis is driven by velocity [m/s], by load [N] (2D: N/m), or held (None in both). `mass` [kg] (2D: kg/m) is that of the\n"
           "load-driven axes; default: a tenth of the mass of the grains present at the first step (steady states do not depend on it).")
      .def("walls", &add_boundaries<dim>, "mesh"_a, "names"_a, "material"_a = "wall", "velocity"_a = py::none(),
           "Make walls of boundaries of a mesh: each of their facets, segments in 2D and triangles in 3D, met from both sides. A grain passes\n"
           "from one to the next without noticing. Returns the list of their numbers, for wall(number).\n\n"
           "Parameters\n----------\nmesh : of quicksand.meshes, or anything with its nodes, facets, boundary and boundary_names\n"
           "names : list of str, boundaries\nmaterial : str\nvelocity : per axis [m/s], of all of them as one; None: held\n\n"
           "Raises\n------\nValueError : a name that no boundary has, a mesh of another dimension, an unknown material; no wall is added then")
      .def("wall", [](const py::object& self, int number) {
             auto& s = self.cast<Sim&>();
             if (number < 0 || number >= static_cast<int>(s.walls().size())) fail("wall: no wall {}, the scene has {}", number, s.walls().size());
             return Handle{self, &s, number};
           }, "number"_a, "The wall of that number.")
      .def_property_readonly("wall_force", [](const Sim& s) {
             std::vector<Vec<dim>> force;
             for (const Wall<dim>& wall : s.walls()) force.push_back(wall.force);
             return to_numpy(std::move(force));
           }, "(walls, dim) contact force on each wall by number, mean over the last step [N] (2D: N/m)")
      .def("set_friction", &Sim::set_friction, "a"_a, "b"_a, "friction"_a,
           "Coulomb friction [-] between two materials; names the materials. Every pair that may touch must be set.")
      .def("set_restitution", &Sim::set_restitution, "a"_a, "b"_a, "normal"_a, "tangential"_a = 0.0,
           "Newton restitution [-] in [0, 1]: u_n+ = -normal u_n-; tangential likewise. Off by default.")
      .def("set_inertia", &Sim::set_inertia, "ratio"_a, "I/(m r^2) of every grain [-]; default 1/2 in 2D, 2/5 in 3D.")
      .def("attach",
           [](Sim& s, const Handle& wall, const Array& x, const py::object& radius, const std::string& material) {
             if (wall.simulation != &s) fail("attach: wall {} belongs to another simulation", wall.number);
             const auto xs = as_span<Vec<dim>>(x, "attach", "position");
             const Array r = radii(radius, xs.size(), "attach");
             s.attach(wall.number, xs, as_span<double>(r, "attach", "radius"), material);
           },
           "wall"_a, "position"_a, "radius"_a, "material"_a = "grain",
           "Fix grains to a wall, which they make rough: (n, dim) [m], (n,) or float [m]. They move with it and do not count as grains.")
      .def("check", &Sim::check, "dt"_a,
           "Raise what step(dt) would refuse: a ValueError on overlaps, walls that cross, pairs of materials without friction...")
      .def("step",
           [](Sim& s, double dt) {
             py::gil_scoped_release release;
             return s.step(dt);
           },
           "dt"_a, "Advance by dt [s], in as many sub-steps as the motion asks for. Returns a StepReport.\n\n"
           "Raises\n------\nValueError : dt <= 0; where things were put since the last step: overlaps deeper than the smaller radius, grains "
           "behind a\n    wall, walls that cross. Nothing has moved then\n"
           "NotConverged : a sub-step misses its tolerance, unless accept_unconverged")
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
      .def("_contact_problem",
           [](Sim& s) {
             const auto [problem, r] = s.contact_problem();
             return to_python(problem, r);
           },
           "See contact_problem().")
      .def("global_error",
           [](Sim& s) {
             const auto [problem, r] = s.contact_problem();
             py::gil_scoped_release release;
             return global_error(problem, r);
           },
           "Estimate of how far the last sub-step's solution is from the exact one, relative, in the energy norm: what its velocities\n"
           "still miss over all that contacts change in them [-]; inf where there was none. The residual is local and hides errors\n"
           "that vary smoothly over many layers. Costs a factorisation, or a solve to a thousandth of the residual: for a look, not for every step.")
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
      .def_property("gravity", [](const Sim& s) { return s.gravity; },
                    [](Sim& s, const Array& a) { s.gravity = finite_gravity<dim>(a); }, "(dim,) [m/s^2], a copy; assign a whole vector")
      .def_property("position",
                    [](const Sim& s) { return to_numpy(s.by_id([&](const Grains<dim>& g, int k) { return Vec<dim>(s.box().wrap(g.x[k])); })); },
                    [](Sim& s, const Array& a) { s.set_position(as_span<Vec<dim>>(a, "set_position", "position")); },
                    "(n, dim) [m], a copy; periodic axes in [-L/2, L/2)")
      .def_property("velocity",
                    [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return Vec<dim>(g.body[k].v); })); },
                    [](Sim& s, const Array& a) { s.set_velocity(as_span<Vec<dim>>(a, "set_velocity", "velocity")); },
                    "(n, dim) [m/s], a copy")
      .def_property("spin",
                    [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return Spin<dim>(g.body[k].s / g.r[k]); })); },
                    [](Sim& s, const Array& a) { s.set_spin(as_span<Spin<dim>>(a, "set_spin", "spin")); },
                    "angular velocity, (n,) in 2D, (n, 3) in 3D [rad/s], a copy")
      .def_property_readonly("radius", [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return g.r[k]; })); },
                             "(n,) [m], a copy")
      .def_property_readonly("mass", [](const Sim& s) { return to_numpy(s.by_id([](const Grains<dim>& g, int k) { return 1.0 / g.body[k].inv_m; })); },
                             "(n,) [kg] (2D: kg/m), a copy")
      .def("set_force", [](Sim& s, const std::optional<Array>& f) {
             s.set_force(as_span<Vec<dim>>(f, "set_force", "force", s.count()));
           }, "force"_a, "External force on each grain from now on, (n, dim) [N] (2D: N/m); None: none.")
      .def("set_drag", [](Sim& s, const std::optional<Array>& gamma, const std::optional<Array>& u, const std::optional<Array>& added_mass) {
             s.set_drag(as_span<double>(gamma, "set_drag", "coefficient", s.count()), as_span<Vec<dim>>(u, "set_drag", "velocity", s.count()),
                        as_span<double>(added_mass, "set_drag", "added_mass", s.count()));
           }, "coefficient"_a, "velocity"_a = py::none(), "added_mass"_a = py::none(),
           "Drag of a fluid on each grain from now on: the force gamma (u - v), v the velocity at the end of each sub-step, so that any\n"
           "gamma is stable; it exerts no torque. Grains added later have none. set_drag(None): none.\n\n"
           "Parameters\n----------\ncoefficient : gamma, (n,) [kg/s] (2D: kg/(m s))\nvelocity : u, (n, dim) [m/s]\n"
           "added_mass : m_a of the fluid that goes along with a grain, (n,) [kg] (2D: kg/m); None: none. The grain feels -m_a dv/dt besides: to contacts, drag,\n"
           "    weight and forces it is as heavy as m + m_a, but spins as before; m_a Du/Dt of the fluid, where there is one, belongs to set_force\n\n"
           "Raises\n------\nValueError : a coefficient or mass < 0, values that are not finite, sizes other than the number of grains")
      .def_property_readonly("drag_impulse", [](const Sim& s) { return to_numpy(std::vector<Vec<dim>>(s.drag_impulse())); },
                             "(n, dim) impulse of the drag, and of -m_a dv/dt, over the last step [N s] (2D: N s/m); ValueError without drag, as the next two")
      .def_property_readonly("contact_impulse", [](const Sim& s) { return to_numpy(std::vector<Vec<dim>>(s.contact_impulse())); },
                             "(n, dim) impulse of all contacts of a grain together over the last step [N s] (2D: N s/m)")
      .def_property_readonly("in_contact", [](const Sim& s) {
             py::array_t<bool> out(s.in_contact().size());
             std::copy(s.in_contact().begin(), s.in_contact().end(), out.mutable_data());
             return out;
           }, "(n,) bool: whether any contact of the grain bore load in any sub-step of the last step")
      .def_property("solver", [](const Sim& s) { return solver_names[static_cast<int>(s.settings.solver)]; },
                    [](Sim& s, const std::string& v) { s.settings.solver = solver_named(v); }, "'auto': 'active_set', after some hundred sweeps 'accelerated', then 'newton' and 'nlgs' should it run out of sweeps")
      .def_property("sub_step_rule", [](const Sim& s) { return s.settings.sub_steps == SubSteps::relative ? "relative" : "absolute"; },
                    [](Sim& s, const std::string& v) { s.settings.sub_steps = sub_steps_named(v); },
                    "'relative': motion of neighbours; 'absolute': ceil(8 v_max dt/r_min), the rule of the MigFlow thesis");

  // Settings are checked together before any of them counts.
  auto setting = [&](const char* name, auto field, const char* doc) {
    using Value = std::decay_t<decltype(field(std::declval<Settings&>()))>;
    auto set = [field](Sim& s, Value value) {
      Settings next = s.settings;
      field(next) = value;
      check(next, "Simulation");
      s.settings = next;
    };
    simulation.def_property(name, [field](Sim& s) { return field(s.settings); },
                            py::cpp_function(set, py::name(name), py::is_method(simulation)), doc);
  };
  setting("tolerance", [](Settings& s) -> double& { return s.solve.tolerance; },
          "of every sub-step, on the residual [-]; no contact may be wrong by more than 6 % of the tolerance in mean diameters");
  setting("max_sweeps", [](Settings& s) -> int& { return s.solve.max_sweeps; },
          "before the fallback");
  setting("omega", [](Settings& s) -> double& { return s.solve.omega; },
          "over-relaxation to start from [-]");
  setting("active_sweeps", [](Settings& s) -> int& { return s.solve.active_sweeps; },
          "over unsettled contacts between sweeps over all");
  setting("sub_step_motion", [](Settings& s) -> double& { return s.sub_step_motion; },
          "largest motion of a pair in a sub-step over the distance of its centres [-]");
  setting("rest_speed", [](Settings& s) -> double& { return s.rest_speed; },
          "contacts that approach more slowly do not rebound [m/s]");
  setting("accept_unconverged", [](Settings& s) -> bool& { return s.accept_unconverged; },
          "go on after a sub-step that missed its tolerance; such sub-steps are counted in the report");
  setting("threads", [](Settings& s) -> int& { return s.threads; },
          "at most; fewer where more would be slower. Results do not depend on it, bit for bit");
}

template <int dim>
py::object make(const PerAxis& period, const std::optional<Array>& gravity) {
  Vec<dim> lengths = Vec<dim>::Zero();
  if (period) {
    if (period->size() != dim)
      fail("Simulation: period needs one entry per axis ({}), None where not periodic, got {}", dim, period->size());
    for (int k = 0; k < dim; ++k) lengths[k] = (*period)[k].value_or(0.0);
  }
  auto simulation = std::make_unique<Simulation<dim>>(lengths);
  if (gravity) simulation->gravity = finite_gravity<dim>(*gravity);
  simulation->settings.threads = std::min(omp_get_max_threads(), 1024);
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
      [](const py::object& self, const Array& start, const Array& end, const std::string& material, const PerAxis& velocity,
         const PerAxis& load, std::optional<double> mass) {
        return add_driven<2>(self, "add_segment", velocity, load, mass, [&](Simulation<2>& s) {
          return s.add_segment(as_vector<2>(start, "add_segment", "start"), as_vector<2>(end, "add_segment", "end"), material);
        });
      },
      py::name("add_segment"), py::is_method(m.attr("Simulation2D")), "start"_a, "end"_a, "material"_a = "wall",
      "velocity"_a = py::none(), "load"_a = py::none(), "mass"_a = py::none(),
      "Add a straight wall between two points [m], met from both sides. Driven as add_plane.");
  m.attr("Simulation3D").attr("add_triangle") = py::cpp_function(
      [](const py::object& self, const Array& a, const Array& b, const Array& c, const std::string& material, const PerAxis& velocity,
         const PerAxis& load, std::optional<double> mass) {
        return add_driven<3>(self, "add_triangle", velocity, load, mass, [&](Simulation<3>& s) {
          return s.add_triangle(as_vector<3>(a, "add_triangle", "a"), as_vector<3>(b, "add_triangle", "b"), as_vector<3>(c, "add_triangle", "c"), material);
        });
      },
      py::name("add_triangle"), py::is_method(m.attr("Simulation3D")), "a"_a, "b"_a, "c"_a, "material"_a = "wall",
      "velocity"_a = py::none(), "load"_a = py::none(), "mass"_a = py::none(),
      "Add a triangle by its corners [m], met from both sides. Driven as add_plane.");
  m.attr("Simulation2D").attr("psi6") = py::cpp_function(
      &psi6, py::name("psi6"), py::is_method(m.attr("Simulation2D")), "low"_a, "high"_a,
      "Hexagonal order: mean over grains with low <= y <= high [m] of |mean exp(6 i theta)| over neighbours nearer than\n"
      "1.3 (r_i + r_j) [-].");
  m.def(
      "contact_problem_global_error",
      [](int dim, const Indices& row_start, const Indices& column, const Array& value, const Array& q, const Array& friction, const Array& r) {
        constexpr const char* where = "global_error";
        if (dim != 2 && dim != 3) fail("{}: dim must be 2 or 3, got {}", where, dim);
        auto of = [&](auto problem_and_r) {
          py::gil_scoped_release release;
          return global_error(problem_and_r.first, problem_and_r.second);
        };
        return dim == 2 ? of(from_python<2>(row_start, column, value, q, friction, r, where))
                        : of(from_python<3>(row_start, column, value, q, friction, r, where));
      },
      "dim"_a, "row_start"_a, "column"_a, "value"_a, "q"_a, "friction"_a, "r"_a, "See ContactProblem.global_error.");
  m.def(
      "solve_contact_problem",
      [](int dim, const Indices& row_start, const Indices& column, const Array& value, const Array& q, const Array& friction,
         const std::string& solver, double tolerance, int max_iterations, const std::optional<Array>& start) {
        if (dim != 2 && dim != 3) fail("solve_contact_problem: dim must be 2 or 3, got {}", dim);
        return (dim == 2 ? solve_contact_problem<2> : solve_contact_problem<3>)(row_start, column, value, q, friction, solver, tolerance,
                                                                               max_iterations, start);
      },
      "dim"_a, "row_start"_a, "column"_a, "value"_a, "q"_a, "friction"_a, "solver"_a, "tolerance"_a, "max_iterations"_a, "start"_a,
      "See ContactProblem.solve.");
  m.def(
      "Simulation",
      [](int dim, const PerAxis& period, const std::optional<Array>& gravity, const py::kwargs& settings) {
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
