// quicksand.coupling in Python.
#include "coupling.hpp"

#include "fluid/words.hpp"

#include <fmt/format.h>
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

namespace py = pybind11;
using namespace py::literals;

namespace {

using namespace quicksand;
using namespace quicksand::coupling;  // Settings and Report say whose
using Array = py::array_t<double, py::array::c_style>;

template <class T>
Array to_numpy(const std::vector<T>& values) {
  std::vector<py::ssize_t> shape{static_cast<py::ssize_t>(values.size())};
  if (sizeof(T) > sizeof(double)) shape.push_back(sizeof(T) / sizeof(double));
  return Array(shape, reinterpret_cast<const double*>(values.data()));
}

using fluid::one_of, fluid::Words;
using Law = Eight (*)(const Suspensions&);
constexpr Words<Law> laws = {{"di_felice", di_felice}, {"gidaspow", gidaspow}, {"beetstra", beetstra}};
constexpr Words<Shape> kernels = {{"smooth", Shape::smooth}, {"hat", Shape::hat}};
constexpr Words<Discs> kinds_of_discs = {{"spheres", Discs::spheres}, {"cylinders", Discs::cylinders}};

DragLaw drag_law(const py::object& law) {
  if (!PyCallable_Check(law.ptr())) return of_each(one_of("Coupling: drag", py::cast<std::string>(law), laws));
  return [law](std::span<const Suspension> seen, std::span<double> gamma) {
    if (seen.empty()) return;
    std::vector<double> slip, eps, diameter;
    for (const Suspension& s : seen) slip.push_back(s.slip), eps.push_back(s.eps), diameter.push_back(s.diameter);
    const Array given = Array::ensure(law(to_numpy(slip), to_numpy(eps), to_numpy(diameter), seen[0].density, seen[0].viscosity));
    if (!given || given.ndim() != 1 || given.shape(0) != static_cast<py::ssize_t>(seen.size())) {
      PyErr_Clear();
      throw std::invalid_argument(fmt::format("Coupling: the drag law must return an array of shape ({},), gamma of each grain [kg/s]", seen.size()));
    }
    std::copy_n(given.data(), seen.size(), gamma.begin());
  };
}

template <int dim>
struct CouplingInPython : Coupling<dim> {
  using Coupling<dim>::Coupling;
  py::object callback = py::none();
};

template <int dim>
void bind(py::module_& m, const char* suffix) {
  using R = coupling::Report<dim>;
  using C = CouplingInPython<dim>;
  py::class_<R>(m, fmt::format("Report{}", suffix).c_str(), "What a step did.")
      .def_readonly("time", &R::time, "of the grains, at the end [s]")
      .def_readonly("dt", &R::dt, "[s]")
      .def_readonly("grains", &R::grains, "report of the grains' step")
      .def_readonly("fluid", &R::fluid, "report of the fluid's step")
      .def_property_readonly("drag", [](const R& r) { return r.drag; }, "and added mass on all grains, mean over the step (dim,) [N] (2D: N/m)")
      .def_readonly("passes", &R::passes, "of fluid and grains")
      .def_readonly("exchanged_impulse", &R::exchanged_impulse, "sum over grains of |impulse of drag and added mass| [N s] (2D: N s/m)")
      .def_readonly("carried_impulse", &R::carried_impulse, "|impulse that the fluid gave less what the grains got|, handed to the fluid in the next step, over exchanged_impulse [-]")
      .def_readonly("disagreement", &R::disagreement, "the same summed grain by grain [-]")
      .def_readonly("momentum_error", &R::momentum_error, "of fluid, grains and carried impulse, less what boundaries and bodies gave, over exchanged_impulse [-]")
      .def_property_readonly("volume_error", [](const R& r) { return r.fluid.volume_error; }, "of the fluid's balance of volume [-]")
      .def_readonly("removed", &R::removed, "grains that left through outlets")
      .def_readonly("fluid_time", &R::fluid_time, "wall time [s]")
      .def_readonly("grains_time", &R::grains_time, "[s]")
      .def_readonly("exchange_time", &R::exchange_time, "[s]");
  py::class_<C>(m, fmt::format("Coupling{}", suffix).c_str())
      .def(py::init([](Simulation<dim>& grains, fluid::Fluid<dim>& fluid, const std::string& kernel, double radius, const py::object& drag, const std::string& discs, bool undisturbed,
                       double added_mass, bool fluid_moves, bool grains_move) {
             coupling::Settings settings;
             settings.kernel = one_of("Coupling: kernel", kernel, kernels);
             settings.kernel_radius = radius;
             settings.drag = drag_law(drag);
             settings.discs = one_of("Coupling: discs", discs, kinds_of_discs);
             settings.undisturbed = undisturbed, settings.added_mass = added_mass;
             settings.fluid_moves = fluid_moves, settings.grains_move = grains_move;
             return std::make_unique<C>(grains, fluid, std::move(settings));
           }),
           py::keep_alive<1, 2>(), py::keep_alive<1, 3>(), "grains"_a, "fluid"_a, "kernel"_a, "kernel_radius"_a, "drag"_a, "discs"_a, "undisturbed"_a, "added_mass"_a, "fluid_moves"_a, "grains_move"_a)
      .def("follow", [](C& c, const std::string& boundary, const py::object& wall) { c.follow(boundary, py::cast<int>(wall.attr("number"))); }, "boundary"_a, "wall"_a,
           "From now on a boundary of the mesh goes with a wall of the grains, along axes that are not periodic.")
      .def("outlet", &C::set_outlet, "boundary"_a, "Grains whose centre leaves the mesh by this boundary are removed from now on.")
      .def("step",
           [](C& c, double dt) {
             if (!c.callback.is_none()) c.callback();
             return c.step(dt);
           },
           "dt"_a, "A step of dt [s] of fluid and grains. Raises NotConverged of either; ValueError where a grain has left the mesh.")
      .def_readwrite("callback", &C::callback, "Called before each step, without arguments; None: nothing.")
      .def("state", [](const C& c) { return to_numpy(c.state()); }, "With the states of grains and fluid all that the next step depends on (n,).")
      .def("restore", [](C& c, const Array& state) { c.restore({state.data(), static_cast<std::size_t>(state.size())}); }, "state"_a)
      .def_property("tolerance", [](const C& c) { return c.settings.tolerance; },
                    [](C& c, double tolerance) {
                      if (!(tolerance > 0)) throw std::invalid_argument(fmt::format("Coupling: tolerance must be > 0, got {}", tolerance));
                      c.settings.tolerance = tolerance;
                    },
                    "of the phases' `disagreement` [-], above which another pass of fluid and grains is made, `max_passes` at most; infinite by default: one pass")
      .def_property("max_passes", [](const C& c) { return c.settings.max_passes; },
                    [](C& c, int passes) {
                      if (passes < 1) throw std::invalid_argument(fmt::format("Coupling: max_passes must be >= 1, got {}", passes));
                      c.settings.max_passes = passes;
                    })
      .def_property_readonly("removed", &C::removed, "grains that left through outlets so far")
      .def_property_readonly("drag_force", [](const C& c) { return to_numpy(c.drag_force()); }, "and that of added mass on each grain, mean over the last step (n, dim) [N] (2D: N/m)")
      .def_property_readonly("stress_force", [](const C& c) { return to_numpy(c.stress_force()); }, "volume times (-grad p + div(2 eta D(u))) of each grain (n, dim) [N] (2D: N/m)")
      .def_property_readonly("fluid_velocity", [](const C& c) { return to_numpy(c.fluid_velocity()); }, "where each grain is (n, dim) [m/s]")
      .def_property_readonly("void_fraction", [](const C& c) { return to_numpy(c.void_fraction()); }, "where each grain is (n,)");
}

}  // namespace

PYBIND11_MODULE(_coupling, m) {
  py::module_::import("quicksand.grains");
  py::module_::import("quicksand.fluid");
  bind<2>(m, "2D");
  bind<3>(m, "3D");
  m.def(
      "drag_coefficient",
      [](const py::object& law, double slip, double void_fraction, double diameter, double density, double viscosity) {
        const Suspension seen{diameter, void_fraction, slip, density, viscosity};
        double gamma = 0.0;
        drag_law(law)({&seen, 1}, {&gamma, 1});
        return gamma;
      },
      "law"_a, "slip"_a, "void_fraction"_a, "diameter"_a, "density"_a, "viscosity"_a, "gamma [kg/s] of a sphere: the drag is gamma times the slip of the phases [m/s].");
}
