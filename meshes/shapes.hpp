// Ready shapes. Lengths in metres, elements about `size` long. Where a grid does, it is a grid: the same input gives the same mesh
// whatever gmsh is installed.
#pragma once

#include "mesh.hpp"

namespace quicksand::meshes {

// Sides are named left, right (x), bottom, top (y), back, front (z), in the order of the axes; periodic ones have no name.
template <int dim>
struct Box {
  Vec<dim> lengths;                     // [m]
  Vec<dim> origin = Vec<dim>::Zero();   // lowest corner [m]
  std::array<bool, dim> periodic = {};  // along each axis
};

// Grid of counts cells, each cut into 2 triangles or 6 tetrahedra, neighbours as mirror images: with even counts the mesh has the symmetries
// of the box, and no element has all its facets but one on the boundary.
template <int dim>
Mesh<dim> box(const Box<dim>& box, const std::type_identity_t<std::array<int, dim>>& counts);

// Unstructured, by gmsh.
template <int dim>
Mesh<dim> box(const Box<dim>& box, double size);

// [0, length] x [0, height], a grid: inflow at x = 0, outflow at x = length, walls.
Mesh<2> channel(double length, double height, double size, bool periodic = false);

// A circle in a channel, by default that of M. Schaefer and S. Turek, "Benchmark computations of laminar flow around a cylinder" (1996),
// in 2D: inflow, outflow, walls, cylinder.
struct CylinderInChannel {
  double length = 2.2, height = 0.41, diameter = 0.1;  // [m]
  Vec<2> centre{0.2, 0.2};                             // [m]
  double ratio = 6.0;                                  // of element lengths far away and at the cylinder [-]
};

// Elements are `size` long at the cylinder, and longer by a fifth of the distance from it until they are ratio * size.
Mesh<2> cylinder_in_channel(double size, const CylinderInChannel& shape = {});

// Between circles around 0: inner, outer.
Mesh<2> annulus(double inner, double outer, double size);

// Around the x axis, a disc drawn out in layers: inflow at x = 0, outflow at x = length, wall.
Mesh<3> pipe(double radius, double length, double size, bool periodic = false);

}  // namespace quicksand::meshes
