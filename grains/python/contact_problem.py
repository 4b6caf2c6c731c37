"""Frictional contact problems by themselves: read, written, measured, solved.

    u = W r + q,   K* contains u + mu |u_t| n  perp  r in K = {|r_t| <= mu r_n}

per contact with components (n, t) in 2D and (n, t1, t2) in 3D; r_n >= 0 pushes apart. Files are those of FCLIB (`fclib_local`): Acary,
Bremond, Koziara, Perignon, INRIA RT-0444 (2014).
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from . import _grains
from .frames import hdf5_bytes, write_whole


@dataclass(frozen=True)
class Solution:
    """What a solver found."""

    r: np.ndarray  # impulses (n,)
    u: np.ndarray  # relative velocities W r + q (n,)
    solver: str  # that made the last iterations: "nlgs", "accelerated" or "newton"
    iterations: int  # sweeps and Newton iterations
    error: float  # of r, see ContactProblem.error
    converged: bool
    error_history: list = field(repr=False)  # whenever it was measured
    iteration_history: list = field(repr=False)  # iterations made by then
    wall_time: float  # of the solver alone [s]


class ContactProblem:
    """A frictional contact problem.

    Parameters
    ----------
    dim : 2 or 3
    W : (n, n) array or scipy sparse matrix
        Delassus operator, n = dim x contacts. It need not be symmetric, its local blocks need not be diagonal.
    q : (n,)
        Velocities without impulses.
    friction : (contacts,)
    title, description : str
        Kept in files.

    Raises
    ------
    ValueError
        Sizes that do not match, values that are not finite, friction < 0, a contact with W_nn <= 0.
    """

    def __init__(self, dim, W, q, friction, title="", description=""):
        from scipy import sparse

        if dim not in (2, 3):
            raise ValueError(f"ContactProblem: dim must be 2 or 3, got {dim}")
        self.dim, self.title, self.description = dim, title, description
        self.q, self.friction = np.array(q, float), np.array(friction, float)
        n = dim * self.friction.size
        if self.friction.ndim != 1 or self.q.shape != (n,):
            raise ValueError(f"ContactProblem: q must have {dim} entries per contact, got shape {self.q.shape} for friction of shape {self.friction.shape}")
        self.W = sparse.csr_matrix(W if sparse.issparse(W) else np.asarray(W, float), dtype=float, copy=True)
        if self.W.shape != (n, n):
            raise ValueError(f"ContactProblem: W must be {n} x {n} for {self.friction.size} contacts in {dim}D, got {self.W.shape}")
        self.W.sum_duplicates()
        for name, values in (("W", self.W.data), ("q", self.q), ("friction", self.friction)):
            if not np.isfinite(values).all():
                raise ValueError(f"ContactProblem: {name} must be finite, got {values[~np.isfinite(values)][0]}")
        if (self.friction < 0).any():
            raise ValueError(f"ContactProblem: friction must be >= 0, got {self.friction.min():g} (contact {self.friction.argmin()})")
        w_nn = self.W.diagonal()[::dim]
        if (w_nn <= 0).any():
            raise ValueError(f"ContactProblem: W_nn of every contact must be > 0, got {w_nn.min():g} (contact {w_nn.argmin()})")

    @property
    def contacts(self):
        """Number of contacts."""
        return self.friction.size

    def error(self, r):
        """Natural map of the De Saxce form: |e| / max(|q|, |u|, |r|), e = r - P_K(r - (u + mu |u_t| n)), on the problem's own numbers.

        Zero exactly at a solution. It means little for a problem with units: see `dimensionless`.
        """
        r = self._impulses(r, "error")
        u = self.W @ r + self.q
        r_c, mu = r.reshape(-1, self.dim), self.friction
        z = r_c - u.reshape(-1, self.dim)
        z[:, 0] -= mu * np.linalg.norm(u.reshape(-1, self.dim)[:, 1:], axis=1)
        z_n, z_t = z[:, 0].copy(), np.linalg.norm(z[:, 1:], axis=1)
        on_cone = np.maximum((z_n + mu * z_t) / (1 + mu**2), 0)
        inside = (z_t <= mu * z_n) & (z_n >= 0)
        projected = z.copy()
        projected[~inside, 0] = on_cone[~inside]
        projected[~inside, 1:] *= (mu * on_cone / np.where(z_t > 0, z_t, 1))[~inside, None]
        size = max(np.linalg.norm(self.q), np.linalg.norm(u), np.linalg.norm(r))
        return float(np.linalg.norm(r_c - projected) / size) if size > 0 else 0.0

    def solve(self, solver="auto", tolerance=1e-8, max_iterations=100000, start=None):
        """Solve the problem.

        Parameters
        ----------
        solver : str
            "nlgs": nonlinear Gauss-Seidel, the reference. "accelerated": the same to and fro with Nesterov's extrapolation. "newton":
            semismooth Newton with proximal points; it also solves systems with more contacts than freedoms, at the cost of a factorisation
            of W each iteration. "auto": "accelerated" while it promises to be cheaper, then "newton".
        tolerance : float
            On `error` [-].
        max_iterations : int
            Sweeps and Newton iterations.
        start : (n,), optional
            Impulses to start from; zero otherwise.

        Returns
        -------
        Solution
            The best r found; `converged` says whether it is within the tolerance.
        """
        start = None if start is None else self._impulses(start, "solve")
        start_time = time.perf_counter()
        found = _grains.solve_contact_problem(*self._arrays(), solver, tolerance, max_iterations, start)
        return Solution(**found, wall_time=time.perf_counter() - start_time)

    def global_error(self, r):
        """Estimate of sqrt(dr . W dr / r* . W r*), dr = r* - r: how far r is from the solution r*, in the energy norm [-].

        `error` is local: in a pile of L layers a small one hides errors L^2 times larger. Costs a factorisation of W, or a solve to a
        thousandth of r's error; inf where no estimate could be made.
        """
        return _grains.contact_problem_global_error(*self._arrays(), self._impulses(r, "global_error"))

    def dimensionless(self):
        """The same problem as FCLIB's collection scales it: mean diagonal of W = 1, |q| = 1.

        Returns
        -------
        problem : ContactProblem
        impulse, velocity : float
            Units of the new r and u: r = impulse x new r, u = velocity x new u.
        """
        w = self.W.diagonal().mean() if self.contacts else 1.0
        velocity = np.linalg.norm(self.q) or 1.0
        impulse = velocity / w
        note = f"dimensionless: r in units of {impulse:.17g}, u in units of {velocity:.17g}"
        text = f"{self.description}; {note}" if self.description else note
        return ContactProblem(self.dim, self.W / w, self.q / velocity, self.friction, self.title, text), impulse, velocity

    def _impulses(self, r, where):
        r = np.asarray(r, float)
        if r.shape != self.q.shape or not np.isfinite(r).all():
            raise ValueError(f"{where}: r must be {self.q.size} finite numbers, got {np.array2string(r, threshold=4)} of shape {r.shape}")
        return r

    def _arrays(self):
        return self.dim, self.W.indptr.astype(np.int32), self.W.indices.astype(np.int32), self.W.data, self.q, self.friction


def contact_problem(sim, title="", description=""):
    """The contact problem of the last sub-step of a simulation, SI units (2D: per metre of depth).

    Returns
    -------
    problem : ContactProblem
        Every pair within the alert distance, those with walls last; q holds gap / h and restitution.
    r : (n,)
        The impulses that the step found [N s].
    """
    from scipy import sparse

    parts = sim._contact_problem()
    n = parts["q"].size
    W = sparse.csr_matrix((parts["value"], parts["column"], parts["row_start"]), shape=(n, n))
    return ContactProblem(sim.dim, W, parts["q"], parts["friction"], title, description), parts["r"]


def write_fclib(path, problem, solution=None):
    """Write a problem, and a solution with `r` and `u` where there is one, as an FCLIB file.

    The file is written whole or not at all (OSError). FCLIB's numbers have no units: write `problem.dimensionless()` where others are
    to measure errors on the file.
    """
    matrix = problem.W.tocsc()

    def fill(file):
        local = file.create_group("fclib_local")
        local["spacedim"] = np.array([problem.dim], np.int32)
        for name, value in (("m", matrix.shape[0]), ("n", matrix.shape[1]), ("nzmax", matrix.nnz), ("nz", -1)):  # -1: compressed columns
            local[f"W/{name}"] = np.array([value], np.int32)
        local["W/p"], local["W/i"], local["W/x"] = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data
        local["vectors/q"], local["vectors/mu"] = problem.q, problem.friction
        local["info/title"], local["info/description"] = problem.title, problem.description
        if solution is not None:
            file["solution/u"], file["solution/r"] = solution.u, solution.r

    write_whole(Path(path), hdf5_bytes(fill))


def read_fclib(path):
    """Read the `fclib_local` problem of an FCLIB file; its matrix as triplets, compressed columns or rows.

    Raises
    ------
    OSError
        There is no such file.
    ValueError
        It is damaged, of another kind, or holds what is not solved here: a global problem, or equality constraints (V, R).
    """
    from scipy import sparse

    def read(file):
        if "fclib_local" not in file:
            kind = "a global problem (fclib_global): condense it to W and q first" if "fclib_global" in file else "no group fclib_local"
            raise ValueError(f"read_fclib: {path} holds {kind}")
        local = file["fclib_local"]
        if "R" in local or "V" in local or "vectors/s" in local:
            raise ValueError(f"read_fclib: {path} has equality constraints (V, R, s): eliminate them first")
        if "vectors/q" not in local:
            raise ValueError(f"read_fclib: {path} has no vectors/q" + (", only vectors/a: rename that, an old FCLIB wrote q so"
                                                                       if "vectors/a" in local else ""))
        m, n, nz = (int(local["W"][name][0]) for name in ("m", "n", "nz"))
        p, i, x = (local["W"][name][()] for name in ("p", "i", "x"))
        if nz < -2 or (nz >= 0 and min(len(p), len(i), len(x)) < nz):
            raise ValueError(f"read_fclib: {path}: nz must be -1 (columns), -2 (rows) or the number of triplets, got {nz} with {len(x)} values")
        if nz >= 0:
            matrix = sparse.coo_matrix((x[:nz], (i[:nz], p[:nz])), shape=(m, n))
        else:
            matrix = (sparse.csc_matrix if nz == -1 else sparse.csr_matrix)((x, i, p), shape=(m, n))
            matrix.check_format()
        info = {name: local["info"][name].asstr()[()] for name in ("title", "description") if f"info/{name}" in local}
        return ContactProblem(int(local["spacedim"][0]), matrix, local["vectors/q"][()], local["vectors/mu"][()], **info)

    return _read(path, read, "read_fclib")


def read_solution(path):
    """(r, u) of the group `solution` of an FCLIB file, or None where it has none. Raises as `read_fclib`."""

    def read(file):
        if "solution" not in file:
            return None
        r, u = (np.asarray(file[f"solution/{name}"][()], float) for name in ("r", "u"))
        n = int(file["fclib_local/W/m"][0])
        if r.shape != (n,) or u.shape != (n,) or not (np.isfinite(r).all() and np.isfinite(u).all()):
            raise ValueError(f"read_solution: {path}: r and u must be {n} finite numbers each, got shapes {r.shape} and {u.shape}")
        return r, u

    return _read(path, read, "read_solution")


def _read(path, read, where):
    import h5py

    with open(path, "rb"):
        pass  # a plain reason where it cannot be read at all
    try:
        with h5py.File(path, "r") as file:
            return read(file)
    except (OSError, KeyError, IndexError, TypeError, RuntimeError) as error:
        raise ValueError(f"{where}: {path} is damaged or no FCLIB file ({error})") from error
    except ValueError as error:
        raise error if str(error).startswith(where) else ValueError(f"{where}: {path}: {error}") from error
