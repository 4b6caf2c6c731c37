"""Frictional contact problems by themselves: files, errors, solutions, and those that a scene leaves."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import sparse

from quicksand import grains

DATA = sorted((Path(__file__).parents[1] / "data" / "frictional_contact").glob("*.hdf5"))


def one(dim=2, q=(-1.0, 0.0), friction=0.5, W=None):
    return grains.ContactProblem(dim, np.eye(dim) if W is None else np.asarray(W), q, [friction])


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem[:20])
def test_auto_and_newton_solve_every_third_party_problem(path):
    problem = grains.read_fclib(path)
    for solver in ("auto", "newton"):
        found = problem.solve(solver, tolerance=1e-8)
        assert found.converged and found.error <= 1e-8
        assert problem.error(found.r) == pytest.approx(found.error, rel=1e-4)  # two programs' rounding of W r + q
        np.testing.assert_allclose(found.u, problem.W @ found.r + problem.q, atol=1e-12)
        r = found.r.reshape(-1, problem.dim)
        assert (np.linalg.norm(r[:, 1:], axis=1) <= problem.friction * r[:, 0] + 2e-8 * max(np.linalg.norm(r), 1)).all()  # |q| = 1


def test_sweeps_alone_stop_short_of_three_of_them():
    # What the issue is about: were they easy, the test above would say nothing.
    for name in ("BoxesStack1", "OneObject", "fc2d"):
        path, = (path for path in DATA if path.name.startswith(name))
        assert not grains.read_fclib(path).solve("nlgs", max_iterations=20000).converged


def test_one_contact_open_sticking_and_sliding_in_closed_form():
    assert one(q=(1.0, 3.0)).solve().r == pytest.approx([0, 0])
    assert one(q=(-1.0, 0.3)).solve().r == pytest.approx([1, -0.3])
    assert one(q=(-1.0, 2.0)).solve().r == pytest.approx([1, -0.5])      # slides, friction against it
    # Coupled: W_nt = 0.4. Sliding to +t: r_t = -0.5 r_n, 0 = r_n + 0.4 r_t - 1 -> r_n = 1/0.8, u_t = 0.4 r_n + 2 r_t + 3 > 0
    found = one(q=(-1.0, 3.0), W=[[1, 0.4], [0.4, 2]]).solve(tolerance=1e-12)
    assert found.r == pytest.approx([1.25, -0.625]) and found.u == pytest.approx([0, 3 + 0.5 - 1.25])
    # 3D: the sliding velocity is opposite to friction, and the normal one zero
    W = np.array([[1, 0.2, -0.1], [0.2, 2, 0.3], [-0.1, 0.3, 1.5]])
    for solver in ("auto", "nlgs", "accelerated", "newton"):
        found = one(3, (-1.0, 2.0, -1.0), 0.5, W).solve(solver, tolerance=1e-12)
        t, u_t = found.r[1:], found.u[1:]
        assert np.linalg.norm(t) == pytest.approx(0.5 * found.r[0]) and found.u[0] == pytest.approx(0, abs=1e-11)
        assert t @ u_t == pytest.approx(-np.linalg.norm(t) * np.linalg.norm(u_t))


def test_the_error_of_simple_violations_is_known_in_closed_form():
    assert one(q=(1.0, 0.0)).error([0, 0]) == 0
    assert one(q=(-1.0, 0.0)).error([0, 0]) == pytest.approx(1)          # e = (1, 0), |q| = |u| = 1
    assert one(q=(-1.0, 0.0)).error([1, 0]) == 0
    assert one(q=(-1.0, 0.3)).error([1, 0]) == pytest.approx(0.3 * np.sqrt(1 + 0.5**2) / np.hypot(1, 0.3))  # slips within the cone
    assert one(q=(0.5, 0.0), friction=0.0).error([0, 0]) == 0            # open, without friction
    assert one(q=(0.0, 0.0)).error([0, 0]) == 0


def test_scaling_changes_the_units_and_nothing_else():
    problem = grains.read_fclib(next(path for path in DATA if path.name.startswith("Confeti")))
    heavy = grains.ContactProblem(3, 1e4 * problem.W, 1e-3 * problem.q, problem.friction, description="in SI")
    scaled, impulse, velocity = heavy.dimensionless()
    assert scaled.W.diagonal().mean() == pytest.approx(1) and np.linalg.norm(scaled.q) == pytest.approx(1)
    assert scaled.description.startswith("in SI; dimensionless")
    found = scaled.solve(tolerance=1e-10)
    np.testing.assert_allclose(velocity * found.u, heavy.W @ (impulse * found.r) + heavy.q, atol=1e-12 * velocity)


def test_files_come_back_bit_for_bit(tmp_path):
    problem = grains.read_fclib(DATA[0])
    found = problem.solve()
    grains.write_fclib(tmp_path / "a.hdf5", problem, found)
    again = grains.read_fclib(tmp_path / "a.hdf5")
    assert (again.W != problem.W).nnz == 0 and again.dim == problem.dim
    for name in ("q", "friction"):
        np.testing.assert_array_equal(getattr(again, name), getattr(problem, name))
    assert (again.title, again.description) == (problem.title, problem.description)
    r, u = grains.read_solution(tmp_path / "a.hdf5")
    np.testing.assert_array_equal(r, found.r)
    np.testing.assert_array_equal(u, found.u)
    assert grains.read_solution(DATA[0]) is None


@pytest.mark.parametrize("nz", ["triplets", -2])
def test_triplets_and_rows_are_read_as_well_as_columns(tmp_path, nz):
    problem = grains.read_fclib(DATA[0])
    shutil.copy(DATA[0], tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        W = file["fclib_local/W"]
        for name in ("p", "i", "x"):
            del W[name]
        rows = problem.W.tocoo() if nz == "triplets" else problem.W
        W["nz"][0] = rows.nnz if nz == "triplets" else nz
        W["i"], W["p"] = (rows.row, rows.col) if nz == "triplets" else (rows.indices, rows.indptr)
        W["x"] = rows.data
    assert abs(grains.read_fclib(tmp_path / "a.hdf5").W - problem.W).max() == 0


def broken(path, how):
    shutil.copy(DATA[0], path)
    if how == "cut":
        path.write_bytes(path.read_bytes()[:5000])
        return
    with h5py.File(path, "r+") as file:
        if how == "global":
            file.move("fclib_local", "fclib_global")
        elif how == "nothing":
            del file["fclib_local"]
        elif how == "constraints":
            file.create_group("fclib_local/R")
        elif how == "no q":
            file.move("fclib_local/vectors/q", "fclib_local/vectors/a")
        elif how == "kind":
            file["fclib_local/W/nz"][0] = -7
        elif how == "triplets":
            file["fclib_local/W/nz"][0] = 10**6
        elif how == "short":
            del file["fclib_local/vectors/mu"]
            file["fclib_local/vectors/mu"] = np.ones(3)
        elif how == "index":
            file["fclib_local/W/i"][3] = 10**6
        elif how == "nan":
            file["fclib_local/vectors/q"][3] = np.nan


@pytest.mark.parametrize("how, says", [("cut", "damaged"), ("global", "fclib_global"), ("nothing", "no group fclib_local"),
                                       ("constraints", "equality constraints"), ("no q", "only vectors/a"), ("kind", "nz must be"), ("triplets", "nz must be"), ("short", "entries per contact"),
                                       ("index", "a.hdf5"), ("nan", "finite")])
def test_a_file_that_cannot_be_used_says_why(tmp_path, how, says):
    broken(tmp_path / "a.hdf5", how)
    with pytest.raises(ValueError, match=says) as error:
        grains.read_fclib(tmp_path / "a.hdf5")
    assert "a.hdf5" in str(error.value)
    with pytest.raises(OSError):
        grains.read_fclib(tmp_path / "none.hdf5")


@pytest.mark.parametrize("make, says", [
    (lambda: one(dim=4, q=np.zeros(4)), "dim must be 2 or 3, got 4"),
    (lambda: one(q=np.zeros(3)), "q must have 2 entries per contact"),
    (lambda: one(W=np.eye(3)), "W must be 2 x 2"),
    (lambda: one(q=(np.inf, 0)), "q must be finite"),
    (lambda: one(W=[[np.nan, 0], [0, 1]]), "W must be finite"),
    (lambda: one(friction=-0.1), "friction must be >= 0, got -0.1"),
    (lambda: one(W=np.diag([0.0, 1.0])), "W_nn of every contact must be > 0"),
    (lambda: one().solve("lu"), "solver must be 'auto', 'nlgs', 'accelerated' or 'newton', got 'lu'"),
    (lambda: one().solve(tolerance=0), "tolerance must be > 0"),
    (lambda: one().solve(max_iterations=0), "max_iterations must be >= 1"),
    (lambda: one().solve(start=np.zeros(5)), "solve: r must be 2 finite numbers"),
    (lambda: one().solve(start=np.full(2, np.nan)), "solve: r must be 2 finite numbers"),
    (lambda: one(q=(0, 0)).error([np.nan, 0]), "r must be 2 finite numbers"),
    (lambda: one().error(np.zeros(5)), "r must be 2 finite numbers"),
    (lambda: one().global_error(np.zeros(5)), "global_error: r must be 2 finite numbers"),
])
def test_bad_input_names_the_rule(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_the_matrix_may_be_of_any_kind_and_stays_as_it_was():
    twice = sparse.csr_matrix((np.array([0.5, 0.5, 1.0]), np.array([0, 0, 1], np.int64), np.array([0, 2, 3], np.int64)), shape=(2, 2))
    for W in (twice, twice.tocoo(), [[1, 0], [0, 1]], np.eye(2, dtype=int)):
        assert grains.ContactProblem(2, W, (-1.0, 0.3), [0.5]).solve().r == pytest.approx([1, -0.3])
    assert twice.nnz == 3


def test_a_solution_that_does_not_fit_is_refused(tmp_path):
    problem = grains.read_fclib(DATA[0])
    grains.write_fclib(tmp_path / "a.hdf5", problem, problem.solve())
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["solution/r"][0] = np.nan
    with pytest.raises(ValueError, match="a.hdf5: r and u must be"):
        grains.read_solution(tmp_path / "a.hdf5")


def test_no_contacts_are_no_problem():
    nothing = grains.ContactProblem(2, sparse.csr_matrix((0, 0)), [], [])
    assert nothing.solve().converged and nothing.error([]) == 0 and nothing.dimensionless()[0].contacts == 0


def column(layers):
    sim = grains.Simulation(dim=2, gravity=(0, -9.81), tolerance=1e-9, solver="newton")
    sim.set_friction("grain", "grain", 0.3)
    sim.set_friction("grain", "wall", 0.3)
    sim.add(np.column_stack([np.zeros(layers), (2 * np.arange(layers) + 1) * 1e-3]), 1e-3, density=2500)
    sim.add_plane((0, 0), (0, 1))
    return sim


def test_a_step_leaves_its_problem_and_solution(tmp_path):
    sim = column(20)
    with pytest.raises(ValueError, match="before the first step"):
        grains.contact_problem(sim)
    sim.step(1e-3)
    problem, r = grains.contact_problem(sim, title="20 layers")
    # The floor's contact comes last: its impulse is the weight of all times the step.
    assert problem.contacts == 20 and r[-2] == pytest.approx(9.81 * sim.mass.sum() * 1e-3, rel=1e-6)
    scaled, impulse, _ = problem.dimensionless()
    grains.write_fclib(tmp_path / "step.hdf5", scaled)
    again = grains.read_fclib(tmp_path / "step.hdf5")
    assert again.title == "20 layers" and again.error(r / impulse) < 1e-8
    for solver in ("auto", "nlgs", "accelerated", "newton"):
        found = again.solve(solver, tolerance=1e-10)
        np.testing.assert_allclose(impulse * found.r, r, atol=1e-6 * r.max())


def test_the_global_error_is_that_of_the_velocities():
    sim = column(80)
    sim.solver, sim.accept_unconverged, sim.max_sweeps = "nlgs", True, 100
    report = sim.step(1e-3)
    error = np.sqrt((sim.velocity**2).sum(axis=1).mean()) / (9.81 * 1e-3)  # all should be at rest, without contacts all fall by g h
    assert sim.global_error() == pytest.approx(error, rel=1e-3)
    assert error > 0.8 > 0.01 > report.residual
    problem, r = grains.contact_problem(sim)
    assert problem.global_error(r) == pytest.approx(error, rel=1e-3)
