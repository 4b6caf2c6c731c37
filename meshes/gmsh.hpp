// Meshes by gmsh: from its files and scripts, and from a model that lives in this process. All reading and meshing is gmsh's own. gmsh has
// one global state: none of this may run in two threads at once.
#pragma once

#include "mesh.hpp"

#include <filesystem>
#include <functional>
#include <variant>

namespace quicksand::meshes {

using AnyMesh = std::variant<Mesh<2>, Mesh<3>>;

// The mesh of a .msh file, or of a .geo script (meshed here, unless it meshes itself). A gmsh session that is already alive in this process
// keeps its models and options, those that a .geo script sets outside of the usual Mesh ones excepted.
// std::filesystem::filesystem_error: no such file; std::invalid_argument: every defect of the mesh (assemble.hpp), what gmsh
// complains of, curved or non-simplex elements, nodes out of the plane z = 0 in 2D, periods that are no translations.
template <int dim>
Mesh<dim> read_mesh(const std::filesystem::path& path);
AnyMesh read_mesh(const std::filesystem::path& path);  // of the dimension that it has

// The mesh of gmsh's current model, which must have been generated.
template <int dim>
Mesh<dim> current_model();
AnyMesh current_model();

// The mesh of what `draw` makes by calls of gmsh, in a model of its own that is gone afterwards. Elements are about `size` long [m] where
// nothing says less.
template <int dim>
Mesh<dim> mesh_by_gmsh(std::string_view where, double size, const std::function<void()>& draw);

}  // namespace quicksand::meshes
