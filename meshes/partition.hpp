// Cutting a mesh into parts of equal size that touch little, by METIS.
#pragma once

#include "mesh.hpp"

namespace quicksand::meshes {

// Part of each element, 0 to parts - 1, none of them empty. Neighbours across a period count as neighbours. The same mesh is always cut the
// same way. G. Karypis and V. Kumar, SIAM J. Sci. Comput. 20 (1998): multilevel k-way.
template <int dim>
std::vector<int> partition(const Mesh<dim>& mesh, int parts);

}  // namespace quicksand::meshes
