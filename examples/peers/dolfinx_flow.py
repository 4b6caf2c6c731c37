"""The flows of speed_accuracy_fluid.py by FEniCSx (Debian's python3-dolfinx 0.5): Taylor-Hood, MUMPS, the same equations for U = eps u and p.

    /usr/bin/python3 examples/peers/dolfinx_flow.py '{"case": "V1", "cells": 16, "viscosity": 0.1}'

Prints JSON: error_u error_p (cylinder: c_d c_l dp) dofs wall_time. Time is that of assembly and solution; making meshes, spaces and forms, and compiling
them, is apart. Advection as ours: Stokes, two Picard iterations, then Newton's, to a change of 1e-9; in time extrapolated, BDF2 after one backward Euler step.
"""

import json
import sys
import time

import dolfinx
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc
from mpi4py import MPI
from petsc4py import PETSc

spec = json.loads(sys.argv[1])
case, eta = spec["case"], spec["viscosity"]
comm = MPI.COMM_SELF
if case == "cylinder":
    data = np.load(spec["mesh"])
    domain = mesh.create_mesh(comm, data["elements"].astype(np.int64), data["nodes"], ufl.Mesh(ufl.VectorElement("Lagrange", ufl.triangle, 1)))
else:
    domain = mesh.create_rectangle(comm, [[-1, -1], [1, 1]], [spec["cells"]] * 2, mesh.CellType.triangle, diagonal=mesh.DiagonalType.left_right)
element = ufl.MixedElement(ufl.VectorElement("Lagrange", domain.ufl_cell(), 2), ufl.FiniteElement("Lagrange", domain.ufl_cell(), 1))
space = fem.FunctionSpace(domain, element)
x, dx = ufl.SpatialCoordinate(domain), ufl.Measure("dx", domain, metadata={"quadrature_degree": 4})
t = fem.Constant(domain, 0.0)
inv_dt, order2, advect, newton = (fem.Constant(domain, 0.0) for _ in range(4))  # BDF2: order2 = 1; Newton: newton = 1

s = ufl.sin(ufl.pi * x[0]) * ufl.sin(ufl.pi * x[1])
along = 2 / ufl.pi * s * ufl.as_vector([-s.dx(1), s.dx(0)])
p_exact, eps, rate = s, 0.5 + s / 4, 0 * s
if case == "V1":
    u_exact = along
elif case == "V2":
    eps, u_exact = ufl.exp(-s - 1), ufl.as_vector([ufl.exp(s - 1)] * 2)
elif case == "unsteady":
    p_exact, eps, rate = s * ufl.cos(t), 0.5 + s * ufl.cos(t) / 4, -s * ufl.sin(t) / 4
    u_exact = (ufl.cos(t) * along - ufl.sin(t) / (8 * ufl.pi**2) * ufl.grad(s)) / eps
    u_t = ((-ufl.sin(t) * along - ufl.cos(t) / (8 * ufl.pi**2) * ufl.grad(s)) - u_exact * rate) / eps
else:
    eps, p_exact, u_exact = 1 + 0 * x[0], 0 * x[0], ufl.as_vector([4 * 0.3 * x[1] * (0.41 - x[1]) / 0.41**2, 0 * x[0]])


def viscous(u):
    return eta * (ufl.grad(u) + ufl.grad(u).T)


force = ufl.as_vector([0 * x[0], 0 * x[0]])
if case != "cylinder":
    force = eps * (ufl.grad(u_exact) * u_exact + ufl.grad(p_exact) - ufl.div(viscous(u_exact)))
    if case == "unsteady":
        force += eps * u_t

(U, p), (w, q) = ufl.TrialFunctions(space), ufl.TestFunctions(space)
now, before, before2, guess = (fem.Function(space) for _ in range(4))
G, B, B2 = (ufl.split(f)[0] for f in (guess, before, before2))
u, g = U / eps, G / eps
eps_old = ufl.replace(eps, {t: t - 1 / inv_dt}) if case == "unsteady" else eps
eps_old2 = ufl.replace(eps, {t: t - 2 / inv_dt}) if case == "unsteady" else eps
a0, a1, a2 = inv_dt * (1 + order2 / 2), -inv_dt * (1 + order2), inv_dt * order2 / 2
# Momentum as in equations.hpp, the pressure by parts: with the velocity held all around, or a traction of 0, nothing is left at the boundary.
left = (a0 * ufl.dot(U, w) + advect * ufl.dot(ufl.dot(ufl.grad(u), G), w) + advect * newton * ufl.dot(ufl.dot(ufl.grad(g), U), w)
        + ufl.inner(viscous(u), ufl.grad(eps * w)) - p * ufl.div(eps * w) + q * ufl.div(U)) * dx
right = (ufl.dot(force + advect * newton * ufl.dot(ufl.grad(g), G), w) - q * rate) * dx
if case == "unsteady":
    right -= eps * ufl.dot(a1 * B / eps_old + a2 * B2 / eps_old2, w) * dx
if case == "cylinder":  # at the outflow -p n + eta grad u n = 0, as ours
    n, ds = ufl.FacetNormal(domain), ufl.Measure("ds", domain)
    out = ufl.conditional(ufl.gt(x[0], 2.2 - 1e-6), 1.0, 0.0)
    left -= out * eta * ufl.dot(ufl.dot(ufl.grad(u).T, n), w) * ds
form_a, form_b = fem.form(left), fem.form(right)

V, _ = space.sub(0).collapse()
held = fem.Function(V)
at_nodes = fem.Expression(eps * u_exact, V.element.interpolation_points())
domain.topology.create_connectivity(1, 2)
facets = mesh.exterior_facet_indices(domain.topology)
if case == "cylinder":
    facets = mesh.locate_entities_boundary(domain, 1, lambda y: y[0] < 2.2 - 1e-6)
dofs = fem.locate_dofs_topological((space.sub(0), V), 1, facets)
conditions = [fem.dirichletbc(held, dofs, space.sub(0))]
if case == "cylinder":
    round_facets = mesh.locate_entities_boundary(domain, 1, lambda y: np.hypot(y[0] - 0.2, y[1] - 0.2) < 0.0501)
    on_cylinder = fem.locate_dofs_topological((space.sub(0), V), 1, round_facets)
    at_rest = fem.Function(V)
    conditions = [fem.dirichletbc(held, fem.locate_dofs_topological((space.sub(0), V), 1, np.setdiff1d(facets, round_facets)), space.sub(0)),
                  fem.dirichletbc(at_rest, on_cylinder, space.sub(0))]
else:  # the pressure of one corner; its mean is shifted afterwards
    Q, _ = space.sub(1).collapse()
    pinned = fem.locate_dofs_geometrical((space.sub(1), Q), lambda y: (np.abs(y[0] + 1) < 1e-9) & (np.abs(y[1] + 1) < 1e-9))
    conditions.append(fem.dirichletbc(fem.Function(Q), pinned, space.sub(1)))

matrix = petsc.create_matrix(form_a)
vector = petsc.create_vector(form_b)
ksp = PETSc.KSP().create(comm)
ksp.setType("preonly")
ksp.getPC().setType("lu")
ksp.getPC().setFactorSolverType("mumps")
ksp.setOperators(matrix)


def solve():
    matrix.zeroEntries()
    petsc.assemble_matrix(matrix, form_a, bcs=conditions)
    matrix.assemble()
    with vector.localForm() as local:
        local.set(0.0)
    petsc.assemble_vector(vector, form_b)
    petsc.apply_lifting(vector, [form_a], [conditions])
    petsc.set_bc(vector, conditions)
    ksp.solve(vector, now.vector)


def hold():
    held.interpolate(at_nodes)


hold()
petsc.assemble_matrix(matrix, form_a, bcs=conditions)  # once, so that nothing is compiled or made below
matrix.assemble()
start = time.perf_counter()
if case == "unsteady":
    steps = spec["steps"]
    inv_dt.value, advect.value = steps, 1.0
    first = fem.Function(V)
    first.interpolate(at_nodes)
    before.sub(0).interpolate(first)
    now.x.array[:] = before.x.array
    for k in range(steps):
        t.value = (k + 1) / steps
        order2.value = float(k > 0)
        hold()
        guess.x.array[:] = before.x.array if k == 0 else 2 * before.x.array - before2.x.array
        solve()
        before2.x.array[:], before.x.array[:] = before.x.array, now.x.array
else:
    for k in range(30):
        advect.value, newton.value = float(k > 0), float(k > 2)
        solve()
        change = np.linalg.norm(now.x.array - guess.x.array) / np.linalg.norm(now.x.array)
        guess.x.array[:] = now.x.array
        if change < 1e-9:
            break
seconds = time.perf_counter() - start
results = {"dofs": space.dofmap.index_map.size_global * space.dofmap.index_map_bs, "wall_time": seconds}
found_u, found_p = now.sub(0).collapse(), now.sub(1).collapse()


def integral(expression):
    return fem.assemble_scalar(fem.form(expression * dx))


if case == "cylinder":
    residual = petsc.assemble_vector(fem.form(ufl.action(left, now) - right))
    reaction = residual.array[on_cylinder[0]]
    vectors = V.tabulate_dof_coordinates()
    results["c_d"], results["c_l"] = (float(-500 * reaction[k::2].sum()) for k in range(2))  # unrolled dofs: x, y, x, y, ...
    values = []
    tree = dolfinx.geometry.BoundingBoxTree(domain, 2)
    for point in ([0.15 - 1e-9, 0.2, 0.0], [0.25 + 1e-9, 0.2, 0.0]):
        cells = dolfinx.geometry.compute_colliding_cells(domain, dolfinx.geometry.compute_collisions(tree, np.array([point])), np.array([point]))
        values.append(float(found_p.eval(np.array([point]), cells.links(0)[:1])[0]))
    results["dp"] = values[0] - values[1]
else:
    shift = integral(found_p) / integral(1 + 0 * x[0])
    results["error_u"] = float(np.sqrt(integral(ufl.inner(found_u / eps - u_exact, found_u / eps - u_exact)) / integral(ufl.inner(u_exact, u_exact))))
    results["error_p"] = float(np.sqrt(integral((found_p - shift - p_exact) ** 2) / integral(p_exact**2)))
print(json.dumps(results))
