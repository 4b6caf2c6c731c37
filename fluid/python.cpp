// quicksand.fluid in Python: numpy arrays in and out; fields are numbers, arrays, or functions of (x, t) called with all points at once.
#include "fluid.hpp"
#include "words.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <map>

namespace py = pybind11;
using namespace py::literals;

namespace {

using namespace quicksand::fluid;
using Array = py::array_t<double, py::array::c_style>;

std::string shape_of(const Array& a) { return fmt::format("({})", fmt::join(a.shape(), a.shape() + a.ndim(), ", ")); }

Array numbers(const py::object& value, const char* what) {
  Array a = Array::ensure(value);
  if (!a) {
    PyErr_Clear();
    throw py::type_error(fmt::format("{} must be numbers or an array of them, got {}", what, std::string(py::repr(value))));
  }
  return a;
}

template <class T>
py::array_t<T> copied(const std::vector<T>& values) {
  return py::array_t<T>(values.size(), values.data());
}

template <int dim>
Array copied(std::span<const Vec<dim>> values) {
  return Array({static_cast<py::ssize_t>(values.size()), static_cast<py::ssize_t>(dim)}, values.empty() ? nullptr : values[0].data());
}

// One vector for n points, from one for all or an array (n, dim).
template <int dim>
std::vector<Vec<dim>> vectors(const py::object& value, std::size_t n, const char* what) {
  const Array a = numbers(value, what);
  std::vector<Vec<dim>> v(n);
  if (a.ndim() == 1 && a.shape(0) == dim) {
    std::fill(v.begin(), v.end(), Eigen::Map<const Vec<dim>>(a.data()));
  } else if (a.ndim() == 2 && a.shape(0) == static_cast<py::ssize_t>(n) && a.shape(1) == dim) {
    for (std::size_t k = 0; k < n; ++k) v[k] = Eigen::Map<const Vec<dim>>(a.data() + dim * k);
  } else {
    throw std::invalid_argument(fmt::format("{} must have shape ({},) or ({}, {}), got {}", what, dim, n, dim, shape_of(a)));
  }
  return v;
}

std::vector<double> scalars(const py::object& value, std::size_t n, const char* what) {
  const Array a = numbers(value, what);
  if (a.ndim() == 0) return std::vector<double>(n, *a.data());
  if (a.ndim() != 1 || a.shape(0) != static_cast<py::ssize_t>(n)) throw std::invalid_argument(fmt::format("{} must be a number or have shape ({},), got {}", what, n, shape_of(a)));
  return {a.data(), a.data() + n};
}

template <int dim>
VectorField<dim> vector_field(const py::object& value, const char* what) {
  if (!PyCallable_Check(value.ptr())) {
    const Vec<dim> v = vectors<dim>(value, 1, what)[0];
    return [v](std::span<const Vec<dim>> x, double) { return std::vector<Vec<dim>>(x.size(), v); };
  }
  return [value, what](std::span<const Vec<dim>> x, double t) { return vectors<dim>(value(copied<dim>(x), t), x.size(), what); };
}

template <int dim>
ScalarField<dim> scalar_field(const py::object& value, const char* what) {
  if (!PyCallable_Check(value.ptr())) {
    const double v = scalars(value, 1, what)[0];
    return [v](std::span<const Vec<dim>> x, double) { return std::vector<double>(x.size(), v); };
  }
  return [value, what](std::span<const Vec<dim>> x, double t) { return scalars(value(copied<dim>(x), t), x.size(), what); };
}

constexpr Words<int> elements = {{"p1p1", 1}, {"p2p1", 2}};
constexpr Words<Advection> advections = {{"none", Advection::none}, {"extrapolated", Advection::extrapolated}, {"newton", Advection::newton}};
constexpr Words<Scheme> schemes = {{"bdf2", Scheme::bdf2}, {"backward_euler", Scheme::backward_euler}};
constexpr Words<Method> methods = {{"direct", Method::direct}, {"ilu", Method::ilu}, {"fieldsplit", Method::fieldsplit}};

// What is given as a field and used at the quadrature points of a step.
struct Distributed {
  py::object beta = py::none(), target = py::none(), force = py::none();
};

template <int dim>
struct FluidInPython : Fluid<dim> {
  using Fluid<dim>::Fluid;
  Distributed distributed;
  py::object eps_of_time = py::none();
  bool warned_of_eps = false;

  // Once per fluid. 2: the void fraction triples over an element, the flux there is off by more than 10 % with p1p1 (docs/stability_fluid.md).
  // No word on Peclet numbers: whether p2p1 oscillates above 10 depends on the layers there are, a cavity at 20 is right to 0.03 %.
  Report warned(Report report) {
    if (report.eps_jump > 2 && !warned_of_eps && rank() == 0) {
      warned_of_eps = true;
      if (PyErr_WarnEx(PyExc_RuntimeWarning, fmt::format("Fluid: the void fraction should less than triple over an element, rises {:.3g}-fold: fluxes there may be off by 10 % and more; "
                                                         "smooth it over four elements", 1 + report.eps_jump).c_str(), 1) < 0)
        throw py::error_already_set();
    }
    return report;
  }

  // Fields that are functions, at time t.
  void evaluate(double t) {
    if (!eps_of_time.is_none()) {
      const auto x = this->nodes();
      this->set_void_fraction(scalars(eps_of_time(copied<dim>(std::span<const Vec<dim>>(x)), t), x.size(), "void_fraction"));
    }
    if (distributed.beta.is_none() && distributed.force.is_none()) return;
    const auto x = this->quadrature_points();
    std::vector<Reaction<dim>> reaction(x.size());
    auto at_points = [&](const py::object& field) -> py::object {
      return PyCallable_Check(field.ptr()) ? py::object(field(copied<dim>(std::span<const Vec<dim>>(x)), t)) : field;
    };
    if (!distributed.beta.is_none()) {
      const auto beta = scalars(at_points(distributed.beta), x.size(), "set_reaction: beta");
      for (std::size_t k = 0; k < x.size(); ++k) reaction[k].beta = beta[k];
      if (!distributed.target.is_none()) {
        const auto target = vectors<dim>(at_points(distributed.target), x.size(), "set_reaction: target");
        for (std::size_t k = 0; k < x.size(); ++k) reaction[k].beta_target = beta[k] * target[k];
      }
    }
    if (!distributed.force.is_none()) {
      const auto force = vectors<dim>(at_points(distributed.force), x.size(), "set_reaction: force");
      for (std::size_t k = 0; k < x.size(); ++k) reaction[k].force = force[k];
    }
    this->set_reaction(std::move(reaction));
  }
};

// The mesh as it is, with its fields; with order 2 in the order of nodes of XDMF's quadratic cells, images of edges across a period apart.
template <int dim>
py::dict frame(const FluidInPython<dim>& f) {
  const auto& space = f.space();
  auto x = f.nodes(), u = f.velocity();
  auto p = f.pressure(), eps = f.void_fraction();
  std::vector<int> index(space.nodes(), -1);  // of the middles of edges among nodes()
  for (int node = 0; node < space.nodes(); ++node)
    if (!space.is_vertex(node)) {
      index[node] = static_cast<int>(p.size());
      p.push_back(0.5 * (p[space.between[node][0]] + p[space.between[node][1]]));
    }
  std::map<std::array<int, 2>, int> images;  // by the ends of the edge
  const auto& elements = f.mesh().elements;
  py::array_t<int> connectivity({static_cast<int>(elements.size()), space.per_element});
  auto to = connectivity.mutable_unchecked<2>();
  for (std::size_t e = 0; e < elements.size(); ++e) {
    for (int a = 0; a <= dim; ++a) to(e, a) = elements[e][a];
    for (int k = 0; dim + 1 + k < space.per_element; ++k) {
      // XDMF goes round the triangle, and from it to the fourth corner.
      constexpr std::array<int, 6> place = dim == 2 ? std::array{0, 2, 1, 0, 0, 0} : std::array{0, 2, 3, 1, 4, 5};
      const int a = elements[e][simplex_edges<dim>[k][0]], b = elements[e][simplex_edges<dim>[k][1]];
      int at = index[space.node_of[e * space.per_element + dim + 1 + k]];
      const Vec<dim> middle = 0.5 * (x[a] + x[b]);
      if ((middle - x[at]).norm() > 1e-6 * (x[a] - x[b]).norm()) {
        const auto [image, is_new] = images.try_emplace({std::min(a, b), std::max(a, b)}, static_cast<int>(x.size()));
        if (is_new) x.push_back(middle), u.push_back(u[at]), p.push_back(p[at]), eps.push_back(eps[at]);
        at = image->second;
      }
      to(e, dim + 1 + place[k]) = at;
    }
  }
  auto three = [](const std::vector<Vec<dim>>& v) {
    Array rows({v.size(), std::size_t(3)});
    for (std::size_t k = 0; k < v.size(); ++k)
      for (int i = 0; i < 3; ++i) rows.mutable_at(k, i) = i < dim ? v[k][i] : 0.0;
    return rows;
  };
  return py::dict("fluid"_a = py::dict("position"_a = three(x), "connectivity"_a = connectivity, "velocity"_a = three(u), "pressure"_a = copied(p), "void_fraction"_a = copied(eps)));
}

template <int dim>
void add_fluid(py::module_& m, const char* name) {
  using F = FluidInPython<dim>;
  static constexpr Words<typename F::MeshMotion> motions = {{"harmonic", F::MeshMotion::harmonic}, {"stretch", F::MeshMotion::stretch}};
  py::class_<Fluid<dim>>(m, fmt::format("_{}", name).c_str());  // what quicksand.coupling takes
  py::class_<F, Fluid<dim>>(m, name)
      .def(py::init([](std::shared_ptr<Mesh<dim>> mesh, double density, double viscosity, const std::string& element, const py::object& gravity) {
             Properties<dim> properties;
             properties.density = density, properties.viscosity = viscosity;
             if (!gravity.is_none()) properties.gravity = vectors<dim>(gravity, 1, "Fluid: gravity")[0];
             if (!properties.gravity.allFinite()) throw std::invalid_argument("Fluid: gravity must be finite [m/s^2]");
             return std::make_unique<F>(mesh, one_of("Fluid: element", element, elements), properties);
           }),
           "mesh"_a, py::kw_only(), "density"_a, "viscosity"_a, "element"_a = "p1p1", "gravity"_a = py::none())
      .def("wall", [](F& f, const std::string& b, const py::object& v) { f.set_wall(b, v.is_none() ? VectorField<dim>() : vector_field<dim>(v, "wall: velocity")); },
           "boundary"_a, "velocity"_a = py::none(), "No slip. velocity (dim,) or f(x (n, dim), t) -> (n, dim) [m/s]; none: that of the boundary, at rest unless `move_boundary` moves it.")
      .def("inflow", [](F& f, const std::string& b, const py::object& v) { f.set_inflow(b, vector_field<dim>(v, "inflow: velocity")); }, "boundary"_a, "velocity"_a,
           "Velocity (dim,) or f(x, t) [m/s]. At the rim a wall holds the fluid instead when it is set later.")
      .def("slip", &F::set_slip, "boundary"_a, "No flow through, no traction along: a smooth wall, or a plane of symmetry.")
      .def("outflow", [](F& f, const std::string& b, const py::object& p) { f.set_outflow(b, scalar_field<dim>(p, "outflow: pressure")); }, "boundary"_a, "pressure"_a = 0.0,
           "Traction -p n, pressure a number or f(x, t) [Pa]. Fluid that comes in brings no momentum.")
      .def("permeable",
           [](F& f, const std::string& b, const py::object& v, const py::object& p) {
             f.set_permeable(b, v.is_none() ? VectorField<dim>() : vector_field<dim>(v, "permeable: velocity"), scalar_field<dim>(p, "permeable: pressure"));
           },
           "boundary"_a, "velocity"_a = py::none(), "pressure"_a = 0.0,
           "A plate that lets fluid through: the fluid slides with it (its velocity [m/s]; none: that of the boundary), and crosses it against the pressure behind [Pa].")
      .def("move_boundary", [](F& f, const std::string& b, const py::object& v) { f.move_boundary(b, vector_field<dim>(v, "move_boundary: velocity")); }, "boundary"_a, "velocity"_a,
           "Moves a boundary from the next step on, at (dim,) or f(x, t) [m/s], and the mesh with it: see `mesh_motion`.")
      .def_property("mesh_motion", [](const F& f) { return word_for(f.mesh_motion, motions); },
                    [](F& f, const std::string& name) { f.mesh_motion = one_of("mesh_motion", name, motions); },
                    "of the inside: \"harmonic\" (nodes on boundaries that stay slide along axes), or \"stretch\", linear between two boundaries that move as a whole")
      .def("mean_pressure", &F::set_mean_pressure, "pressure"_a = 0.0, "Mean pressure [Pa] where no boundary gives one.")
      .def_property("void_fraction", [](const F& f) { return copied(f.void_fraction()); },
                    [](F& f, const py::object& eps) {
                      if (PyCallable_Check(eps.ptr())) {
                        f.eps_of_time = eps;
                        f.evaluate(f.time());
                        return;
                      }
                      f.eps_of_time = py::none();
                      const Array a = numbers(eps, "void_fraction");
                      const auto values = a.ndim() == 0 ? std::vector<double>(f.mesh().nodes.size(), *a.data()) : scalars(eps, a.size(), "void_fraction");
                      f.set_void_fraction(values);
                    },
                    "Of the coming step, in (0, 1]: a number, an array over the nodes of the mesh or over all `nodes`, or f(x, t). The first that is set holds at the start as well.")
      .def("reaction",
           [](F& f, const py::object& beta, const py::object& target, const py::object& force) {
             f.distributed = {beta, target, force};
             if (beta.is_none() && force.is_none()) f.set_reaction({});
             f.evaluate(f.time());
           },
           "beta"_a = py::none(), "target"_a = py::none(), "force"_a = py::none(),
           "Force on the fluid per volume, beta (target - u) + force [N/m^3]: beta a number, an array over `quadrature_points`, or f(x, t) [kg/(m^3 s)]; target [m/s] and force likewise, (dim,)\n"
           "or (n, dim). Without arguments: none.")
      .def_readwrite("grains_follow", &F::grains_follow, "Continuity takes in advance what of the solid's flux goes with the fluid's own: set by `quicksand.coupling` where grains move.")
      .def("step", [](F& f, double dt) { f.evaluate(f.time() + dt); return f.warned(f.step(dt)); }, "dt"_a,
           "A step of dt [s]. Raises NotConverged, with the state as before the step.")
      .def("solve_steady", [](F& f) { f.evaluate(f.time()); return f.warned(f.solve_steady()); }, "The steady flow, from the present one. Raises NotConverged.")
      .def("set_velocity", [](F& f, const py::object& u) { f.set_velocity(vectors<dim>(u, f.nodes().size(), "set_velocity: velocity")); }, "velocity"_a, "At `nodes`, (n, dim) or one for all [m/s].")
      .def("set_pressure", [](F& f, const py::object& p) { f.set_pressure(scalars(p, f.mesh().nodes.size(), "set_pressure: pressure")); }, "pressure"_a, "At the nodes of the mesh [Pa].")
      .def("state", [](F& f) { return copied(f.state()); },
           "All that changes from step to step (n,), for `restore`; conditions, fields and settings do not belong to it. The next step factorises anew, so that a run that goes on and one\n"
           "that is restored, on as many processes, stay the same bit for bit.")
      .def("restore", [](F& f, const Array& state) { f.restore({state.data(), static_cast<std::size_t>(state.size())}); }, "state"_a,
           "As it was when `state` was taken. Raises ValueError where the mesh or the element is another.")
      .def("frame", &frame<dim>, "For `Frames.write`: {\"fluid\": position, connectivity, velocity, pressure, void_fraction}.")
      .def_property_readonly("nodes", [](const F& f) { const auto x = f.nodes(); return copied<dim>(std::span<const Vec<dim>>(x)); }, "(n, dim) [m]: the nodes of the mesh, with p2p1 then the middles of edges.")
      .def_property_readonly("velocity", [](const F& f) { const auto u = f.velocity(); return copied<dim>(std::span<const Vec<dim>>(u)); }, "of the fluid at `nodes` (n, dim) [m/s]")
      .def_property_readonly("pressure", [](const F& f) { return copied(f.pressure()); }, "at the nodes of the mesh (n,) [Pa]")
      .def_property_readonly("quadrature_points", [](const F& f) { const auto x = f.quadrature_points(); return copied<dim>(std::span<const Vec<dim>>(x)); }, "(n, dim) [m]")
      .def_property_readonly("time", &F::time, "[s]")
      .def_property_readonly("dofs", [](const F& f) { return f.space().dofs(); }, "unknowns")
      .def_property_readonly("dim", [](const F&) { return dim; })
      .def_property_readonly("mesh", [](const F& f) { return std::const_pointer_cast<Mesh<dim>>(f.space().mesh); }, "as it was at the start: `nodes` tells where it is")
      .def_property_readonly("element", [](const F& f) { return word_for(f.velocity_order(), elements); })
      .def("force", &F::force, "boundary"_a, "Of the fluid on a boundary (dim,) [N] (2D: N/m).")
      .def("torque",
           [](const F& f, const std::string& boundary, const py::object& centre) -> py::object {
             const Vec<dim> about = centre.is_none() ? Vec<dim>(Vec<dim>::Zero()) : vectors<dim>(centre, 1, "torque: centre")[0];
             const auto moment = f.torque(boundary, about);
             if constexpr (dim == 2) return py::cast(moment[0]);
             else return py::cast(moment);
           },
           "boundary"_a, "centre"_a = py::none(), "Moment of that force about a point (dim,) [m], by default the origin: 2D a number, anticlockwise [N m/m], 3D (3,) [N m].")
      .def("flux", &F::flux, "boundary"_a, "int eps (u - w) . n over named facets, out of the domain or along their normal, w the velocity of the mesh; mean of the last step [m^3/s] (2D: m^2/s).")
      .def("probe",
           [](const F& f, const py::object& points) {
             const Array a = numbers(points, "probe: points");
             const std::size_t n = a.ndim() == 2 ? a.shape(0) : 1;
             const auto found = f.probe(vectors<dim>(points, n, "probe: points"));
             std::vector<Vec<dim>> u, grad;
             std::vector<double> p;
             for (const auto& one : found) u.push_back(one.velocity), p.push_back(one.pressure), grad.push_back(one.pressure_gradient);
             return py::dict("velocity"_a = copied<dim>(std::span<const Vec<dim>>(u)), "pressure"_a = copied(p), "pressure_gradient"_a = copied<dim>(std::span<const Vec<dim>>(grad)));
           },
           "points"_a, "At points (n, dim) [m]: dict of velocity (n, dim) [m/s], pressure (n,) [Pa], pressure_gradient (n, dim) [Pa/m].")
      .def("error",
           [](const F& f, const py::object& u, const py::object& p) {
             const auto e = f.error(vector_field<dim>(u, "error: velocity"), scalar_field<dim>(p, "error: pressure"));
             return std::pair(e.velocity, e.pressure);
           },
           "velocity"_a, "pressure"_a, "Relative L2 errors of velocity and pressure against fields f(x, t) at the present time.")
      .def_property("advection", [](const F& f) { return word_for(f.settings.advection, advections); },
                    [](F& f, const std::string& name) {
                      f.settings.advection = one_of("advection", name, advections);
                    },
                    "\"none\" (Stokes), \"extrapolated\" (one linear system a step), \"newton\"")
      .def_property("scheme", [](const F& f) { return word_for(f.settings.scheme, schemes); },
                    [](F& f, const std::string& name) { f.settings.scheme = one_of("scheme", name, schemes); },
                    "\"bdf2\" (its first step is backward Euler) or \"backward_euler\"")
      .def_property("solver", [](const F& f) { return f.settings.linear ? word_for(f.settings.linear->method, methods) : "auto"; },
                    [](F& f, const std::string& name) {
                      if (name == "auto") f.settings.linear.reset();
                      else f.settings.linear = LinearSettings{.method = one_of("solver", name, methods)};
                    },
                    "of the linear systems, before the first step: \"direct\" (MUMPS), \"ilu\", \"fieldsplit\", or \"auto\": direct in 2D, in 3D ilu for p1p1 and fieldsplit for p2p1")
      .def_property("newton_tolerance", [](const F& f) { return f.settings.newton_tolerance; }, [](F& f, double v) { f.settings.newton_tolerance = v; })
      .def_property("max_newton", [](const F& f) { return f.settings.max_newton; }, [](F& f, int v) { f.settings.max_newton = v; });
}

}  // namespace

PYBIND11_MODULE(_fluid, m) {
  py::module_::import("quicksand.meshes");
  py::register_exception<NotConverged>(m, "NotConverged", PyExc_RuntimeError);
  py::class_<Report>(m, "Report", "What a step did.")
      .def_readonly("newton_iterations", &Report::newton_iterations)
      .def_readonly("linear_iterations", &Report::linear_iterations)
      .def_readonly("factorisations", &Report::factorisations)
      .def_readonly("change", &Report::change, "of the last Newton iteration, relative [-]")
      .def_readonly("net_inflow", &Report::net_inflow, "through all boundaries [m^3/s] (2D: m^2/s)")
      .def_readonly("pore_volume_rate", &Report::pore_volume_rate, "d/dt of the integral of the void fraction [m^3/s]")
      .def_readonly("volume_error", &Report::volume_error, "of their balance, relative to what flows in and out [-]")
      .def_readonly("courant", &Report::courant, "the largest |u - w| dt/h of an element, w the velocity of the mesh, h its length along the flow; steady: 0 [-]")
      .def_readonly("peclet", &Report::peclet, "the largest rho |u - w| h/eta of an element; p2p1 may oscillate from 10 on [-]")
      .def_readonly("eps_jump", &Report::eps_jump, "the largest change of the void fraction over an element, relative to its lowest there [-]")
      .def_readonly("assembly_time", &Report::assembly_time, "[s]")
      .def_readonly("solve_time", &Report::solve_time, "[s]");
  m.def("petsc_options", &set_petsc_options, "options"_a, "Options as on PETSc's command line, \"-ksp_monitor -log_view\", for solvers made afterwards.");
  m.def("rank", &rank, "Number of this process among those of MPI.");
  m.def("ranks", &ranks, "Number of processes.");
  add_fluid<2>(m, "Fluid2D");
  add_fluid<3>(m, "Fluid3D");
}
