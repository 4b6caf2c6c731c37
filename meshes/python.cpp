// quicksand.meshes in Python. Arrays are copies: they outlive the mesh, and writing to them does not change it. gmsh has one global state:
// the lock of the interpreter is kept throughout.
#include "errors.hpp"
#include "gmsh.hpp"
#include "partition.hpp"
#include "shapes.hpp"

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <optional>

namespace py = pybind11;
using namespace py::literals;

namespace {

using namespace quicksand::meshes;

py::array_t<int> to_numpy(const std::vector<int>& values) { return py::array_t<int>(values.size(), values.data()); }

template <std::size_t n>
py::array_t<int> to_numpy(const std::vector<std::array<int, n>>& rows) {
  return py::array_t<int>({rows.size(), n}, rows.empty() ? nullptr : rows[0].data());
}

template <int dim>
py::array_t<double> to_numpy(const std::vector<Vec<dim>>& rows) {
  return py::array_t<double>({rows.size(), std::size_t(dim)}, rows.empty() ? nullptr : rows[0].data());
}

template <int dim>
std::string describe(const Mesh<dim>& mesh) {
  std::string boundaries;
  for (std::size_t b = 0; b < mesh.boundary_names.size(); ++b)
    boundaries += fmt::format("{}'{}' ({} facets)", b ? ", " : "", mesh.boundary_names[b], std::count(mesh.boundary.begin(), mesh.boundary.end(), int(b)));
  std::size_t images = 0;
  for (std::size_t k = 0; k < mesh.master.size(); ++k) images += mesh.master[k] != static_cast<int>(k);
  return fmt::format("Mesh{}D: {} nodes ({} of them periodic images), {} elements; regions '{}'; boundaries {}", dim, mesh.nodes.size(), images,
                     mesh.elements.size(), fmt::join(mesh.region_names, "', '"), boundaries.empty() ? "none" : boundaries);
}

template <int dim>
void bind(py::module_& m) {
  using M = Mesh<dim>;
  py::class_<M, std::shared_ptr<M>>(m, fmt::format("Mesh{}D", dim).c_str(), R"(A mesh of triangles (2D) or tetrahedra (3D) with named regions and boundaries.

Made by `read`, `current_model` or a shape. Arrays are copies of what the mesh holds. Volumes are areas in 2D, areas are lengths.)")
      .def_property_readonly_static("dim", [](const py::object&) { return dim; })
      .def_property_readonly("nodes", [](const M& mesh) { return to_numpy<dim>(mesh.nodes); }, "(nodes, dim) [m]")
      .def_property_readonly("elements", [](const M& mesh) { return to_numpy(mesh.elements); }, "(elements, dim + 1) nodes; the volume is positive")
      .def_property_readonly("region", [](const M& mesh) { return to_numpy(mesh.region); }, "(elements,) index into region_names")
      .def_readonly("region_names", &M::region_names, "physical groups of dimension dim, or 'domain'")
      .def_property_readonly("facets", [](const M& mesh) { return to_numpy(mesh.facets); },
                             "(facets, dim) nodes of every facet on the boundary, and of those in a physical group inside the mesh or on periodic "
                             "sides; the normal points from the first of its elements to the second (2D: to the right of the way from the first "
                             "node to the second)")
      .def_property_readonly("facet_elements", [](const M& mesh) { return to_numpy(mesh.facet_elements); },
                             "(facets, 2) elements; the second is -1 on the boundary, the one across the period on a periodic side")
      .def_property_readonly("boundary", [](const M& mesh) { return to_numpy(mesh.boundary); }, "(facets,) index into boundary_names")
      .def_readonly("boundary_names", &M::boundary_names, "physical groups of dimension dim - 1")
      .def_property_readonly("master", [](const M& mesh) { return to_numpy(mesh.master); },
                             "(nodes,) node k is the periodic image of node master[k]; elsewhere master[k] = k")
      .def_property_readonly("volume", [](const M& mesh) { return volume(mesh); }, "of all elements [m^dim]")
      .def("boundary_area", [](const M& mesh, const std::string& name) { return boundary_area(mesh, name); }, "name"_a,
           R"(Area of a boundary [m^(dim-1)].

Raises ValueError, which lists the boundaries there are, if none has this name.)")
      .def("partition", [](const M& mesh, int parts) { return to_numpy(partition(mesh, parts)); }, "parts"_a, R"(Cut the mesh into parts of equal size that touch little, by METIS.

Returns
-------
(elements,) int array
    Part of each element, 0 to parts - 1, none of them empty. Elements across a period are neighbours. Always the same for the
    same mesh.

Raises ValueError if parts is not between 1 and the number of elements.)")
      .def("__repr__", &describe<dim>);
}

// Calls `call` with dim as a constant.
template <class Any, class Two, class Three>
AnyMesh of_dimension(std::optional<int> dim, const char* where, Any&& any, Two&& two, Three&& three) {
  if (!dim) return any();
  if (*dim == 2) return two();
  if (*dim == 3) return three();
  fail("{}: dim must be 2, 3 or None (what the mesh has), got {}", where, *dim);
}

template <int dim>
AnyMesh make_box(const std::vector<double>& lengths, const std::optional<std::vector<int>>& counts, const std::optional<double>& size,
                 const std::optional<std::vector<bool>>& periodic, const std::optional<std::vector<double>>& origin) {
  Box<dim> shape{.lengths = Eigen::Map<const Vec<dim>>(lengths.data())};
  auto check_axes = [](std::size_t n, const char* what) {
    if (n != dim) fail("box: {} must have an entry per axis, {}, got {}", what, dim, n);
  };
  if (periodic) {
    check_axes(periodic->size(), "periodic");
    std::copy(periodic->begin(), periodic->end(), shape.periodic.begin());
  }
  if (origin) {
    check_axes(origin->size(), "origin");
    shape.origin = Eigen::Map<const Vec<dim>>(origin->data());
  }
  if (counts.has_value() == size.has_value()) fail("box: give counts (a grid) or size (unstructured), one of them");
  if (size) return box(shape, *size);
  check_axes(counts->size(), "counts");
  std::array<int, dim> cells;
  std::copy(counts->begin(), counts->end(), cells.begin());
  return box(shape, cells);
}

}  // namespace

PYBIND11_MODULE(_meshes, m) {
  // A missing file is a FileNotFoundError with its name, as from open().
  py::register_exception_translator([](std::exception_ptr p) {
    try {
      if (p) std::rethrow_exception(p);
    } catch (const std::filesystem::filesystem_error& e) {
      errno = e.code().value();
      PyErr_SetFromErrnoWithFilename(PyExc_OSError, e.path1().c_str());
    }
  });
  bind<2>(m);
  bind<3>(m);

  m.def("read", [](const std::filesystem::path& path, std::optional<int> dim) {
        return of_dimension(dim, "read", [&] { return read_mesh(path); }, [&] { return read_mesh<2>(path); }, [&] { return read_mesh<3>(path); });
      }, "path"_a, "dim"_a = py::none(), R"(Read a .msh file (2.2, 4.1), or mesh a .geo script, by gmsh.

Physical groups of dimension dim are the regions; if there are any, elements outside of them are left out, if there are none, all
elements are the region 'domain'. Physical groups of dimension dim - 1 are the boundaries: every facet on the boundary must be in one,
those of periodic sides excepted. A group without a name goes by its number (gmsh gives a name to one group only: a second one of
the same name has none). A named facet inside the mesh keeps the direction it has in gmsh.

A gmsh session that is alive in this process keeps its models and options, but for options that a .geo script sets.

Parameters
----------
path : str or path
dim : int, optional
    2 or 3; without it the dimension that the mesh has.

Returns
-------
Mesh2D or Mesh3D

Raises
------
FileNotFoundError
ValueError
    What gmsh complains of, or a defect of the mesh: another dimension, no elements; curved or non-simplex elements, flat ones, some that are
    turned over, some that overlap; boundary facets without a group; elements or facets in two groups; periodic sides that do not match
    to 1e-8 of the period, or are no translations of each other; a period too short for two layers of elements.)");
  m.def("current_model", [](std::optional<int> dim) {
        return of_dimension(dim, "current_model", [] { return current_model(); }, [] { return current_model<2>(); }, [] { return current_model<3>(); });
      }, "dim"_a = py::none(), R"(The mesh of the current model of a gmsh that is alive in this process, after `gmsh.model.mesh.generate`.

The model is not changed. The `gmsh` imported must be the one that loads the system's library (Debian: python3-gmsh). Everything else
is as in `read`.)");

  m.def("box", [](const std::vector<double>& lengths, const std::optional<std::vector<int>>& counts, std::optional<double> size,
                  const std::optional<std::vector<bool>>& periodic, const std::optional<std::vector<double>>& origin) {
        if (lengths.size() == 2) return make_box<2>(lengths, counts, size, periodic, origin);
        if (lengths.size() == 3) return make_box<3>(lengths, counts, size, periodic, origin);
        fail("box: lengths must have 2 or 3 entries, got {}", lengths.size());
      }, "lengths"_a, "counts"_a = py::none(), py::kw_only(), "size"_a = py::none(), "periodic"_a = py::none(), "origin"_a = py::none(), R"(A rectangle or a box.

Boundaries: left, right (x), bottom, top (y), back, front (z), each the lower side first; periodic sides have no name.

Parameters
----------
lengths : (dim,) floats
    [m]
counts : (dim,) ints
    A grid of so many cells, each cut into 2 triangles or 6 tetrahedra, neighbours as mirror images. With even counts the mesh has the
    symmetries of the box.
size : float
    Instead of counts: unstructured, elements about so long [m].
periodic : (dim,) bools
origin : (dim,) floats
    Lowest corner [m], 0 by default.

Returns
-------
Mesh2D or Mesh3D)");
  m.def("channel", &channel, "length"_a, "height"_a, "size"_a, "periodic"_a = false, R"(A plane channel [0, length] x [0, height], a grid of elements at most `size` long along the axes; all in m.

Boundaries: inflow (x = 0), outflow (x = length), walls. periodic: along x, and only walls is left.

Returns Mesh2D.)");
  m.def("cylinder_in_channel", [](double size, double ratio, double length, double height, double diameter, const std::array<double, 2>& centre) {
        return cylinder_in_channel(size, {.length = length, .height = height, .diameter = diameter, .centre = {centre[0], centre[1]}, .ratio = ratio});
      }, "size"_a, py::kw_only(), "ratio"_a = CylinderInChannel{}.ratio, "length"_a = CylinderInChannel{}.length, "height"_a = CylinderInChannel{}.height, "diameter"_a = CylinderInChannel{}.diameter,
        "centre"_a = std::array<double, 2>{0.2, 0.2}, R"(A circle in a plane channel, by default that of M. Schaefer and S. Turek (1996).

Boundaries: inflow (x = 0), outflow (x = length), walls, cylinder.

Parameters
----------
size : float
    Length of elements at the cylinder [m]. They grow by a fifth of the distance from it.
ratio : float
    Elements are at most ratio * size long [-].
length, height, diameter : float
    [m]
centre : (2,) floats
    of the circle [m]

Returns
-------
Mesh2D)");
  m.def("annulus", &annulus, "inner"_a, "outer"_a, "size"_a, R"(Between two circles around 0 with radii inner and outer, elements about `size` long; all in m.

Boundaries: inner, outer. Nodes on them lie on the circles.

Returns Mesh2D.)");
  m.def("pipe", &quicksand::meshes::pipe, "radius"_a, "length"_a, "size"_a, "periodic"_a = false, R"(A circular pipe around the x axis from 0 to length, layers of elements about `size` long; all in m.

Boundaries: inflow (x = 0), outflow (x = length), wall. periodic: along x, and only wall is left.

Returns Mesh3D.)");
}
