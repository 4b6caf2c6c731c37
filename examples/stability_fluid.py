"""Where the fluid stays right, and where it stops: nine hard cases, each against what is known exactly.

    ./run examples/stability_fluid.py --out out/stability_fluid

Flags
    --cases NAME ...    of the names below (all)
    --out DIR           results.json, tables.md and figures (out/stability_fluid)
    --quick             fewer rows on coarser meshes: half a minute in all

steps       void fraction from 1 to 0.15 or 0.05 over one to eight elements, with flow through: fluxes, pressure, overshoots
rest        fluid at rest in void fractions with steps: spurious velocities
peclet      layers thinner than an element: cell Peclet numbers 0.1 to 1000
courant     steps of 0.1 to 1000 times the time to cross an element: vortices that decay, a cavity that starts
small_steps steps of 1 to 1e-10 s from a developed flow, and from rest: does the stabilisation spoil the pressure
darcy       a resistance beta from nothing to Darcy's limit: beta h^2 / eta from 0 to 1e8
aspect      elements of aspect 1 to 200: errors, iterations
backflow    fluid that comes in through an outflow: vortices, pressures that reverse
reynolds    the Reynolds number rises until no steady flow is found, and steps in time at the same number

results.json, flat: lists CASE_KEY over the rows of each case, in the order of tables.md. Keys of every case:
    scene element dim             p1p1 or p2p1
    newton linear                 iterations, over all steps
    volume_error                  largest of a step's report [-]
    steps wall_time               solves made, seconds they took
    said                          "" or how the exception begins that ended the run
Keys of one case, relative to the exact value unless said:
    steps_width [elements]; steps_low, the lowest void fraction; steps_reynolds, rho U L / eta, L = 1 m; steps_beta, in the low part
        [kg/(m^3 s)]; steps_section_error, largest error of the flux through a section; steps_pressure_error, of the fall of pressure;
        steps_overshoot, velocity beyond its exact range, over the highest; steps_flux_error, largest |U - exact| at a node over U
    rest_gravity direction; rest_fastest, |u| over g dt (steady: over sqrt(g L)); rest_pressure_error, over rho g L
    peclet_number of an element; peclet_overshoot, velocity beyond its exact range over the jump; peclet_away_error, largest error two elements
        and more from the layer, over the jump
    courant_number; courant_dt [s]; courant_energy, of the vortices at the end over the exact one; courant_growth, largest energy at any time
        over that at the start (cavity: over the steady one); courant_velocity_error, relative L2, at the end (cavity: to the steady flow)
    small_steps_dt [s]; small_steps_before, relative L2 error of the pressure before; small_steps_first small_steps_tenth after one and ten
        steps; small_steps_velocity_error after ten
    darcy_number, beta h^2 / eta; darcy_velocity_error darcy_pressure_error, relative L2; darcy_flux_error; darcy_overshoot, velocity beyond its
        exact range, over the range
    aspect_number, longest over shortest edge along axes; aspect_velocity_error aspect_pressure_error, relative L2; aspect_solver
    backflow_strength, reversed over mean speed, or Reynolds number of the flow that reverses; backflow_growth, largest energy over that at the
        start or over the exact one; backflow_end, relative L2 distance from the exact flow at the end, or of the known flux;
    reynolds_number; reynolds_start; reynolds_fastest_return, lowest velocity along the middle of the cavity [lid]; reynolds_reference of it;
        reynolds_change, of the last iteration or of the last step over its dt
"""

import time
import warnings
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

warnings.filterwarnings("ignore", "Fluid: the void fraction")  # steep ones are the case
ELEMENTS = ("p1p1", "p2p1")
MEASURED = ("section_error", "pressure_error", "overshoot", "flux_error", "away_error", "velocity_error", "fastest", "fastest_return", "change")
COLOURS = ("#1f5fa8", "#c2452d", "#2e7d4f", "#8a5a00", "#222222", "#9aa5b1")


class Run:
    """A flow, and the worst of what its reports say."""

    def __init__(self, scene, mesh, element, density=1.0, viscosity=1.0, **settings):
        self.flow = fluid.Fluid(mesh, density=density, viscosity=viscosity, element=element, **settings)
        self.scene, self.element, self.mesh = scene, element, mesh
        self.newton = self.linear = self.steps = 0
        self.volume_error = self.wall_time = self.change = 0.0
        self.message = ""

    def _take(self, solve):
        start = time.perf_counter()
        try:
            report = solve()
        except fluid.NotConverged as error:
            self.message = str(error)
            return False
        finally:
            self.wall_time += time.perf_counter() - start
        self.steps += 1
        self.newton += report.newton_iterations
        self.linear += report.linear_iterations
        self.volume_error = max(self.volume_error, report.volume_error)
        self.change = report.change
        return True

    def steady(self):
        return self._take(self.flow.solve_steady)

    def go(self, dt, steps=1, look=None):
        for _ in range(steps):
            if not self._take(lambda: self.flow.step(dt)):
                return False
            if look:
                look()
        return True

    def row(self, **keys):
        if self.message and not self.steps:
            keys |= {name: None for name in keys if name in MEASURED}
        return {"scene": self.scene, "element": self.element, "dim": self.flow.dim} | keys | {
            "newton": self.newton, "linear": self.linear, "volume_error": self.volume_error, "steps": self.steps, "wall_time": self.wall_time,
            "said": self.message.split(",")[0][:60]}


def sides(dim):
    return ("left", "right", "bottom", "top", "back", "front")[:2 * dim]


def beyond(values, low, high):
    """How far values leave a range."""
    return float(max(values.max() - high, low - values.min(), 0.0))


def rms(vectors):
    return float(np.sqrt((np.asarray(vectors) ** 2).sum() / len(vectors)))


def mean_square(flow, velocity=0.0):
    """Of |u - velocity| over the nodes of a regular mesh [m^2/s^2]: its kinetic energy, for ratios."""
    return rms(flow.velocity - velocity) ** 2


# The void fraction falls from 1 to `low`, and what one-dimensional flow with U = 1 does in it: p' = -rho u u' - beta u/eps + 2 eta u'',
# beta in proportion to 1 - eps. Over one element straight, between nodes; over more as 3 s^2 - 2 s^3.

def steps(flags):
    rows, n = [], 8 if flags.quick else 16
    h = 1 / n
    media = ((1.0, 0.0), (1e-3, 0.0), (1e-3, 1e3))  # viscosity [Pa s], beta in the low part
    cases = [(element, 2, "straight", width, low, *medium) for element in ELEMENTS for width in (1, 2, 4, 8) for low in (0.15, 0.05) for medium in media]
    cases += [(element, 2, "inclined", width, low, *medium) for element in ELEMENTS for width in (1, 4) for low in (0.15, 0.05) for medium in media[:2]]
    cases += [(element, 3, "straight", width, 0.15, *media[1]) for element in ELEMENTS for width in (1, 4)]
    for element, dim, scene, width, low, viscosity, beta in cases[::5] if flags.quick else cases:
        straight = scene == "straight"
        lengths = np.array([2.0, 0.5 if dim == 2 else 2 * h, 2 * h][:dim]) if straight else np.array([2.0, 2.0])
        mesh = meshes.box(lengths, counts=np.round(lengths / h).astype(int))
        along, start, run = np.eye(dim)[0] if straight else np.ones(2) / np.sqrt(2), 0.75 if straight else 1.75, Run(scene, mesh, element, 1.0, viscosity)
        flow = run.flow

        def profile(x):
            s = np.clip(((x[:, 0] if straight else x[:, 0] + x[:, 1]) - start) / (width * h), 0, 1)
            return 1 - (1 - low) * (s if width == 1 else s * s * (3 - 2 * s))

        flow.void_fraction = profile(mesh.nodes if width == 1 else flow.nodes)
        velocity = lambda x, t: along / profile(x)[:, None]
        for side in sides(dim):
            flow.slip(side) if straight else flow.inflow(side, velocity)
        if straight:
            flow.inflow("left", velocity)
            flow.outflow("right")
        if beta:
            flow.reaction(beta=lambda x, t: beta * (1 - profile(x)) / (1 - low))
        run.steady()
        ends = np.array([[0.25] + [h] * (dim - 1), [1.75] + [h] * (dim - 1)] if straight else [[0.25, 0.25], [1.75, 1.75]])
        line = np.linspace(*ends, 20001)
        eps, s = profile(line), line @ along
        resistance = beta * (1 - eps) / (1 - low) / eps**2
        exact = 0.5 * (low**-2 - 1) + 0.5 * ((resistance[1:] + resistance[:-1]) * np.diff(s)).sum()
        fall = -np.diff(flow.probe(ends)["pressure"])[0]
        u = flow.velocity @ along
        section = None
        if straight and dim == 2:  # the rule of the element along lines of the grid
            x, flux = flow.nodes, flow.velocity[:, 0] * flow.void_fraction
            for k in range(round(2 / h) + 1):
                on = np.abs(x[:, 0] - k * h) < 1e-9
                f = flux[on][np.argsort(x[on, 1])]
                w = np.ones(len(f)) if element == "p1p1" else np.where(np.arange(len(f)) % 2, 4 / 3, 2 / 3)
                w[[0, -1]] *= 0.5
                section = max(section or 0.0, abs(w @ f / w.sum() - 1))
        rows.append(run.row(width=width, low=low, reynolds=1 / viscosity, beta=beta, section_error=section, pressure_error=abs(fall / exact - 1),
                            overshoot=beyond(u, 1.0, 1 / low) * low, flux_error=float(np.abs(flow.velocity * flow.void_fraction[:, None] - along).max())))
    return rows, {}


def rest(flags):
    """Nothing moves in a closed box; where pores shrink, nothing moves across gravity."""
    rows, n, rho, g, dt = [], 6, 1000.0, 9.81, 0.01
    rng = np.random.default_rng(0)
    for element in ELEMENTS:
        for dim in (2, 3):
            cells = n if dim == 2 else 4
            for scene in ("step", "random", "step, beta", "step, steady", "step sinks"):
                for axis in (0, 1):
                    if scene == "step sinks" and axis == 0:
                        continue
                    mesh = meshes.box([1.0] * dim, counts=[cells] * dim)
                    run = Run(scene, mesh, element, rho, 1e-3, gravity=-g * np.eye(dim)[axis])
                    flow = run.flow
                    for side in sides(dim):
                        flow.wall(side)
                    step = lambda x: np.where(x[:, 0] < 0.4, 1.0, 0.05)
                    if scene != "step sinks":
                        flow.void_fraction = rng.uniform(0.05, 1.0, len(mesh.nodes)) if scene == "random" else step(mesh.nodes)
                    if scene == "step, beta":
                        flow.reaction(beta=lambda x, t: np.where(x[:, 0] < 0.5, 0.0, 1e8), target=np.zeros(dim))
                    if scene == "step sinks":  # the step is across gravity and the pores shrink: what they lose leaves at the top
                        flow.outflow("top")
                        for side in sides(dim)[:2] + sides(dim)[4:]:
                            flow.slip(side)
                        shrinking = lambda x, t: np.where(x[:, 1] < 0.4, 1.0, 0.15) * (1 - 0.1 * t)
                        flow.void_fraction = shrinking(mesh.nodes, 0.0)
                        for k in range(5):
                            flow.void_fraction = shrinking(mesh.nodes, (k + 1) * dt)
                            run.go(dt)
                        fastest = np.abs(flow.velocity[:, [k for k in range(dim) if k != 1]]).max() / (g * dt)
                    elif scene == "step, steady":
                        run.steady()
                        fastest = np.abs(flow.velocity).max() / np.sqrt(g)
                    else:
                        run.go(dt, 5)
                        fastest = np.abs(flow.velocity).max() / (g * dt)
                    x = mesh.nodes[:, axis]
                    p = flow.pressure
                    off = p - p.mean() + rho * g * (x - x.mean())
                    rows.append(run.row(gravity="xy"[axis], fastest=float(fastest), pressure_error=float(np.abs(off).max() / (rho * g))))
    return rows, {}


def peclet(flags):
    """Suction: u = (1 - exp(-y/d))/(1 - exp(-1/d)), d = eta/(rho V), between plates that let V through, an exact flow. Skew: a jump of speed
    along a line at 35 degrees, convected."""
    rows, n, jump, angle = [], 20, 0.5, np.radians(35)
    h, along = 1 / n, np.array([np.cos(angle), np.sin(angle)])
    for element in ELEMENTS:
        for number in (0.1, 1.0, 10.0, 100.0, 1000.0)[::2 if flags.quick else 1]:
            run = Run("suction", meshes.box([4 * h, 1.0], counts=[4, n], periodic=[True, False]), element, 1.0, h / number)
            flow, d = run.flow, h / number
            flow.inflow("bottom", [0.0, -1.0])
            flow.inflow("top", [1.0, -1.0])
            run.steady()
            y, u = flow.nodes[:, 1], flow.velocity[:, 0]
            error = np.abs(u - np.expm1(-y / d) / np.expm1(-1 / d))
            rows.append(run.row(number=number, overshoot=beyond(u, 0, 1), away_error=float(error[y > 1.99 * h].max())))
        for number in (0.1, 1.0, 10.0, 100.0, 1000.0)[::2 if flags.quick else 1]:
            run = Run("skew", meshes.box([1.0, 1.0], counts=[n, n]), element, 1.0, h / number)
            flow, across = run.flow, np.array([-along[1], along[0]])
            offset = lambda x: (x - [0.0, 0.22]) @ across
            inflow = lambda x, t: along * (1 + jump * (offset(x) > 0))[:, None]
            for side in ("right", "top"):
                flow.outflow(side)
            for side in ("left", "bottom"):
                flow.inflow(side, inflow)
            run.steady()
            u = flow.velocity @ along
            far = np.abs(offset(flow.nodes)) > 2 * h if number >= 100 else None
            rows.append(run.row(number=number, overshoot=beyond(u, 1, 1 + jump) / jump,
                                away_error=None if far is None else float(np.abs(flow.velocity - inflow(flow.nodes, 0))[far].max() / jump)))
    return rows, {}


def courant(flags):
    rows, n, nu = [], 16 if flags.quick else 32, 0.01
    carried = np.array([1.0, 0.5])

    def vortices(x, t):
        x = x - carried * t
        return carried + np.exp(-2 * nu * t) * np.column_stack([np.sin(x[:, 0]) * np.cos(x[:, 1]), -np.cos(x[:, 0]) * np.sin(x[:, 1])])

    def pressure(x, t):
        x = x - carried * t
        return 0.25 * np.exp(-4 * nu * t) * np.cos(2 * x).sum(axis=1)

    numbers = (1.0, 100.0) if flags.quick else (0.1, 1.0, 10.0, 100.0, 1000.0)
    for element in ELEMENTS:
        for number in numbers:
            for advection in ("extrapolated", "newton"):
                if advection == "newton" and number < 1:
                    continue
                side = 2 * np.pi
                run = Run(f"vortices, {advection}", meshes.box([side] * 2, counts=[n] * 2, periodic=[True] * 2), element, 1.0, nu)
                flow = run.flow
                flow.advection = advection
                flow.set_velocity(vortices(flow.nodes, 0))
                flow.set_pressure(pressure(run.mesh.nodes, 0))
                dt = number * side / n / 2.0
                start, energies = mean_square(flow, carried), []
                run.go(dt, max(10, round(1 / dt)), lambda: energies.append(mean_square(flow, carried)))
                error = rms(flow.velocity - vortices(flow.nodes, flow.time)) / rms(vortices(flow.nodes, 0) - carried)
                rows.append(run.row(number=number, dt=dt, energy=energies[-1] / start / np.exp(-4 * nu * flow.time) if number <= 10 and energies else None,
                                    growth=max(energies, default=np.nan) / start, velocity_error=error))
        n_cavity, reynolds = 12 if flags.quick else 24, 400
        still = cavity(n_cavity, element, reynolds)
        still.steady()
        for number in numbers:
            for advection in ("extrapolated", "newton"):
                if advection == "newton" and number < 10:
                    continue
                run, energies = cavity(n_cavity, element, reynolds), []
                run.scene, run.flow.advection = f"cavity, {advection}", advection
                dt, start = number / n_cavity, mean_square(still.flow)
                run.go(dt, 40, lambda: energies.append(mean_square(run.flow)))
                rows.append(run.row(number=number, dt=dt, energy=None, growth=max(energies, default=np.nan) / start,
                                    velocity_error=rms(run.flow.velocity - still.flow.velocity) / rms(still.flow.velocity) if number >= 10 else None))
    return rows, {}


def cavity(n, element, reynolds):
    run = Run("cavity", meshes.box([1.0, 1.0], counts=[n, n]), element, 1.0, 1 / reynolds)
    run.flow.wall("top", [1.0, 0.0])
    for side in ("left", "right", "bottom"):
        run.flow.wall(side)
    return run


def small_steps(flags):
    from manufactured import Exact  # beside this file

    rows, n = [], 8 if flags.quick else 16
    dts = (1.0, 1e-4, 1e-8) if flags.quick else (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
    manufactured = Exact("V1", 2, 0.01)

    def channel(element):
        run = Run("channel", meshes.box([2.0, 1.0], counts=[2 * n, n]), element, 1.0, 0.01)
        run.flow.inflow("left", lambda x, t: np.column_stack([x[:, 1] * (1 - x[:, 1]), 0 * x[:, 1]]))
        run.flow.outflow("right")
        for side in ("bottom", "top"):
            run.flow.wall(side)
        run.steady()
        return run, lambda x: 0.02 * (2 - x[:, 0])

    def v1(element, from_exact=False):
        run = Run("V1, exact" if from_exact else "V1", meshes.box([2.0, 2.0], counts=[2 * n, 2 * n], origin=[-1.0, -1.0]), element, 1.0, 0.01)
        for side in sides(2):
            run.flow.wall(side, manufactured.u)
        run.flow.void_fraction = manufactured.eps
        run.flow.reaction(force=manufactured.force)
        if from_exact:
            run.flow.set_velocity(manufactured.u(run.flow.nodes, 0.0))
            run.flow.set_pressure(manufactured.p(run.mesh.nodes, 0.0))
        else:
            run.steady()
        return run, lambda x: manufactured.p(x, 0.0)

    def turning(element):
        run = cavity(2 * n, element, 400)
        run.steady()
        p = run.flow.pressure
        return run, lambda x: p

    def impulse(element):
        """From rest, a force grad(phi) + curl(psi) that begins at once: p = phi, u = t curl(psi) as long as t is small."""
        run = Run("impulse", meshes.box([1.0, 1.0], counts=[n, n]), element, 1.0, 1e-3)
        for side in sides(2):
            run.flow.wall(side)
        s, c = (lambda a: np.sin(np.pi * a)), (lambda a: np.cos(np.pi * a))
        run.flow.reaction(force=lambda x, t: np.pi * np.column_stack([
            -s(x[:, 0]) * c(x[:, 1]) + 2 * s(x[:, 0]) ** 2 * s(x[:, 1]) * c(x[:, 1]),
            -c(x[:, 0]) * s(x[:, 1]) - 2 * s(x[:, 0]) * c(x[:, 0]) * s(x[:, 1]) ** 2]))
        return run, lambda x: c(x[:, 0]) * c(x[:, 1])

    for element in ELEMENTS:
        for make in (channel, v1, lambda e: v1(e, True), turning, impulse):
            for dt in dts:
                run, exact = make(element)
                p, free = exact(run.mesh.nodes), run.scene not in ("channel",)
                off = lambda: rms((run.flow.pressure - p - (run.flow.pressure - p).mean() * free)[:, None]) / rms((p - p.mean() * free)[:, None])
                u0, before = run.flow.velocity, off()
                run.go(dt)
                first = off()
                run.go(dt, 9)
                size = rms(u0)
                rows.append(run.row(dt=dt, before=before, first=first, tenth=off(), velocity_error=rms(run.flow.velocity - u0) / size if size else None))
    return rows, {}


def darcy(flags):
    from manufactured import Exact  # beside this file

    rows, n, eps, eta = [], 8 if flags.quick else 16, 0.5, 1.0
    numbers = (0.0, 1.0, 1e8) if flags.quick else (0.0, 1e-2, 1.0, 1e2, 1e4, 1e6, 1e8)
    exact = Exact("V1", 2, eta)
    for element in ELEMENTS:
        for number in numbers:  # Brinkman's channel: eps grad p = beta u - eps eta u''
            beta = number * eta * n**2
            run = Run("channel", meshes.box([1.0, 1.0], counts=[n, n]), element, 1.0, eta)
            flow = run.flow
            flow.advection = "none"
            flow.outflow("left", 1.0)
            flow.outflow("right", 0.0)
            for side in ("bottom", "top"):
                flow.wall(side)
            flow.void_fraction = eps
            flow.reaction(beta=beta)
            run.steady()
            m = np.sqrt(beta / (eps * eta))
            # cosh(m (y - 1/2))/cosh(m/2) without its large exponentials
            layer = lambda y: (np.exp(m * (y - 1)) + np.exp(-m * y)) / (1 + np.exp(-m))
            u = (lambda x, t: np.column_stack([eps / beta * (1 - layer(x[:, 1])), 0 * x[:, 0]])) if beta else \
                (lambda x, t: np.column_stack([x[:, 1] * (1 - x[:, 1]) / (2 * eta), 0 * x[:, 0]]))
            flux = eps * (eps / beta * (1 - 2 / m * np.tanh(m / 2)) if beta else 1 / (12 * eta))
            errors = flow.error(u, lambda x, t: 1 - x[:, 0])
            top = u(np.array([[0.0, 0.5]]), 0)[0, 0]
            rows.append(run.row(number=number, velocity_error=errors[0], pressure_error=errors[1], flux_error=abs(flow.flux("right") / flux - 1),
                                overshoot=beyond(flow.velocity[:, 0], 0, top) / top))
        for dim in (2, 3):
            for number in numbers:
                cells = 2 * n if dim == 2 else 6
                field = exact if dim == 2 else Exact("V1", 3, eta)
                beta = number * eta * (cells / 2) ** 2
                run = Run("V1", meshes.box([2.0] * dim, counts=[cells] * dim, origin=[-1.0] * dim), element, 1.0, eta)
                flow = run.flow
                for side in sides(dim):
                    flow.wall(side, field.u)
                flow.void_fraction = field.eps
                # p = (1 + beta) s: as large as what it drives
                def force(x, t, field=field, beta=beta, dim=dim):
                    s, c = np.sin(np.pi * x), np.cos(np.pi * x)
                    grad = np.pi * np.column_stack([np.prod([c[:, j] if j == i else s[:, j] for j in range(dim)], axis=0) for i in range(dim)])
                    return field.force(x, t) + beta * field.u(x, t) + beta * field.eps(x, t)[:, None] * grad
                flow.reaction(beta=beta, force=force)
                run.steady()
                errors = flow.error(field.u, lambda x, t: (1 + beta) * field.p(x, t))
                rows.append(run.row(number=number, velocity_error=errors[0], pressure_error=errors[1], flux_error=None, overshoot=None))
        for number in numbers:  # a plug through a porous half: U = 1 throughout
            beta = number * eta * n**2
            run = Run("interface", meshes.box([1.0, 0.5], counts=[n, n // 2]), element, 1.0, eta)
            flow = run.flow
            for side in ("bottom", "top"):
                flow.slip(side)
            flow.inflow("left", [1.0, 0.0])
            flow.outflow("right")
            flow.reaction(beta=lambda x, t: beta * (x[:, 0] > 0.5))
            run.steady()
            errors = flow.error(lambda x, t: np.column_stack([np.ones(len(x)), 0 * x[:, 0]]), lambda x, t: beta * np.minimum(1 - x[:, 0], 0.5) + 1e-300)
            rows.append(run.row(number=number, velocity_error=errors[0], pressure_error=errors[1] if beta else None, flux_error=abs(flow.flux("right") / 0.5 - 1),
                                overshoot=beyond(flow.velocity[:, 0], 1, 1)))
    return rows, {}


def aspect(flags):
    from manufactured import Exact  # beside this file

    rows, n = [], 4 if flags.quick else 12
    exact = Exact("V1", 2, 0.1)
    numbers = (1, 50) if flags.quick else (1, 10, 50, 200)
    for element in ELEMENTS:
        for number in numbers:
            if number > 50:
                continue
            run = Run("V1", meshes.box([2.0, 2.0], counts=[n, n * number], origin=[-1.0, -1.0]), element, 1.0, 0.1)
            for side in sides(2):
                run.flow.wall(side, exact.u)
            run.flow.void_fraction = exact.eps
            run.flow.reaction(force=exact.force)
            run.steady()
            errors = run.flow.error(exact.u, exact.p)
            rows.append(run.row(number=number, solver="direct", velocity_error=errors[0], pressure_error=errors[1]))
        for counts in ((2, 100), (100, 2), (2, 2)):  # Poiseuille, elements along and across
            run = Run(f"channel {counts[0]} x {counts[1]}", meshes.box([1.0, 1.0], counts=counts), element, 1.0, 0.01)
            run.flow.inflow("left", lambda x, t: np.column_stack([x[:, 1] * (1 - x[:, 1]), 0 * x[:, 1]]))
            run.flow.outflow("right")
            for side in ("bottom", "top"):
                run.flow.wall(side)
            run.steady()
            errors = run.flow.error(lambda x, t: np.column_stack([x[:, 1] * (1 - x[:, 1]), 0 * x[:, 1]]), lambda x, t: 0.02 * (1 - x[:, 0]))
            rows.append(run.row(number=max(counts) / min(counts), solver="direct", velocity_error=errors[0], pressure_error=errors[1]))
        for solver in ("ilu" if element == "p1p1" else "fieldsplit", "direct"):
            for number in numbers:
                gap = 1 / number
                mesh = meshes.box([1.0, 1.0, gap], counts=[3 if flags.quick else 6] * 3)
                run = Run("gap", mesh, element, 1.0, gap)  # a plane gap whose walls are close: steps from rest to Poiseuille's flow
                flow = run.flow
                flow.solver = solver
                profile = lambda x, t, gap=gap: np.column_stack([4 * x[:, 2] * (gap - x[:, 2]) / gap**2, 0 * x[:, 0], 0 * x[:, 0]])
                for side in ("bottom", "top"):
                    flow.slip(side)
                flow.outflow("right")
                flow.inflow("left", profile)
                for side in ("back", "front"):
                    flow.wall(side)
                run.go(gap, 5 if flags.quick else 20)
                errors = flow.error(profile, lambda x, t, gap=gap: 8 / gap * (1 - x[:, 0]))
                rows.append(run.row(number=number, solver=solver, velocity_error=errors[0], pressure_error=errors[1]))
    return rows, {}


def backflow(flags):
    rows, n = [], 12 if flags.quick else 24
    for element in ELEMENTS:
        for strength in (2.0,) if flags.quick else (0.5, 2.0, 8.0):  # a vortex, Gaussian, carried out by a stream
            run = Run("vortex", meshes.box([2.0, 1.0], counts=[2 * n, n]), element, 1.0, 1e-3)
            flow, a, mean = run.flow, 0.12, np.array([1.0, 0.0])
            for side in ("bottom", "top"):
                flow.slip(side)
            flow.inflow("left", mean)
            flow.outflow("right")
            r = flow.nodes - [1.4, 0.5]
            swirl = strength * np.exp(0.5 - 0.5 * (r**2).sum(axis=1) / a**2) / a
            flow.set_velocity(mean + swirl[:, None] * np.column_stack([-r[:, 1], r[:, 0]]))
            dt, energies = 0.5 / n / (1 + strength), []
            start = mean_square(flow)
            run.go(dt, 20 if flags.quick else round(2 / dt), lambda: energies.append(mean_square(flow)))
            rows.append(run.row(strength=strength, growth=max(energies, default=np.nan) / start, end=rms(flow.velocity - mean) / strength))
        for number in (100.0,) if flags.quick else (1.0, 100.0, 1e4):  # pressures on both ends, one of which swings
            run = Run("reversal", meshes.box([2.0, 1.0], counts=[n, n]), element, 1.0, 1.0)
            flow, omega = run.flow, 2 * np.pi
            amplitude = number * 24  # speed of Poiseuille's flow is about number
            flow.outflow("left", lambda x, t: np.full(len(x), amplitude * np.sin(omega * t)))
            flow.outflow("right")
            for side in ("bottom", "top"):
                flow.wall(side)
            energies = []
            run.go(0.02, 20 if flags.quick else 150, lambda: energies.append(mean_square(flow)))
            y, root = flow.nodes[:, 1], np.sqrt(1j * omega)
            shape = amplitude / 2 / (1j * omega) * (1 - np.cosh(root * (y - 0.5)) / np.cosh(root / 2))
            exact = max(rms((shape * np.exp(1j * phase)).real[:, None]) ** 2 for phase in np.linspace(0, np.pi, 100))
            rows.append(run.row(strength=number, growth=max(energies, default=np.nan) / exact, end=None))
        for viscosity in (1e-2, 1e-4):  # a siphon: what enters is at rest outside, so that rho u^2 is what it costs
            run = Run("siphon", meshes.box([2.0, 1.0], counts=[n, n // 2]), element, 1.0, viscosity)
            flow = run.flow
            flow.outflow("left", 1.0)
            flow.outflow("right")
            for side in ("bottom", "top"):
                flow.slip(side)
            run.go(0.1, 20 if flags.quick else 200)
            rows.append(run.row(strength=1 / viscosity, growth=mean_square(flow), end=abs(flow.flux("right") - 1)))
    return rows, {}


# Lowest velocity along the middle: U. Ghia, K. N. Ghia and C. T. Shin, J. Comput. Phys. 48 (1982); 1000: O. Botella and R. Peyret, Comput. Fluids 27 (1998).
FASTEST_RETURN = {100: -0.21090, 400: -0.32726, 1000: -0.38857, 3200: -0.41933, 5000: -0.43643, 10000: -0.42735}


def reynolds(flags):
    rows, n = [], 16 if flags.quick else 32

    def fastest_return(run):
        middle = np.column_stack([np.full(201, 0.5), np.linspace(0, 1, 201)])
        return float(run.flow.probe(middle)["velocity"][:, 0].min())

    def row(run, number, start):
        return run.row(number=float(number), start=start, fastest_return=fastest_return(run), reference=FASTEST_RETURN.get(number), change=run.change)

    for element in ELEMENTS:
        for number in (100, 1000) if flags.quick else (100, 400, 1000, 2000, 3200, 5000, 10000, 20000):
            run = cavity(n, element, number)
            found = run.steady()
            rows.append(row(run, number, "rest"))
            if not found:
                break
        before, number = None, 100
        while number <= (1000 if flags.quick else 1e6):
            run = cavity(n, element, number)
            if before:
                run.flow.set_velocity(before.flow.velocity)
                run.flow.set_pressure(before.flow.pressure)
            found = run.steady()
            if not found or number in FASTEST_RETURN or number >= 1e5:
                rows.append(row(run, number, "continued"))
            if not found:
                break
            before, ladder = run, sorted([*FASTEST_RETURN, 2000, 7500, 15000, 20000, 30000, 50000, 75000, 100000, 200000, 500000, 1000000])
            larger = [one for one in ladder if one > number]
            if not larger:
                break
            number = larger[0]
        for number in (1000,) if flags.quick else (1000, 10000, 100000):
            run = cavity(n, element, number)
            speeds = []
            run.go(0.1, 20 if flags.quick else 200, lambda: speeds.append(run.flow.velocity))
            run.change = rms(speeds[-1] - speeds[-2]) / rms(speeds[-1]) / 0.1 if len(speeds) > 1 else np.nan
            rows.append(row(run, number, "steps"))
        if flags.quick:
            continue
        for number in (20, 100, 200, 400, 1000):
            run = Run("cylinder", meshes.cylinder_in_channel(0.01), element, 1.0, 0.1 / number)
            flow = run.flow
            flow.inflow("inflow", lambda x, t: np.column_stack([1.5 * 4 * x[:, 1] * (0.41 - x[:, 1]) / 0.41**2, 0 * x[:, 0]]))
            flow.outflow("outflow")
            for side in ("walls", "cylinder"):
                flow.wall(side)
            found = run.steady()
            rows.append(run.row(number=float(number), start="rest", fastest_return=None, reference=None, change=run.change))
            if not found:
                break
    return rows, {}


def plot(out, results):
    def column(case, name):
        return results.get(f"{case}_{name}", [])

    def pick(case, x, y, **wanted):
        """x and y of the rows in which each key has its wanted value."""
        keep = [k for k in range(len(column(case, x))) if all(column(case, name)[k] == value for name, value in wanted.items())]
        number = lambda v: np.nan if v is None else max(v, 1e-16)
        return np.array([column(case, x)[k] for k in keep], float), np.array([number(column(case, y)[k]) for k in keep], float)

    if "peclet_number" in results:
        study.plot_lines(out / "peclet.png", "$\\rho u h/\\eta$ [-]", "overshoot / jump [-]", [
            (scene, [(element, colour, *pick("peclet", "number", "overshoot", scene=scene, element=element)) for element, colour in zip(ELEMENTS, COLOURS)])
            for scene in ("suction", "skew")], scales=("log", "linear"))
    if "small_steps_dt" in results:
        study.plot_lines(out / "small_steps.png", "$\\Delta t$ [s]", "error of the pressure after one step [-]", [
            (element, [(scene, colour, *pick("small_steps", "dt", "first", scene=scene, element=element))
                       for scene, colour in zip(dict.fromkeys(column("small_steps", "scene")), COLOURS)]) for element in ELEMENTS])
    if "darcy_number" in results:
        study.plot_lines(out / "darcy.png", "$\\beta h^2/\\eta$ [-]", "relative error [-]", [
            (element, [(f"{scene}, {what}", colour, *(v[1:] for v in pick("darcy", "number", f"{what}_error", scene=scene, element=element, dim=2)))
                       for (scene, what), colour in zip([(s, w) for s in ("channel", "V1") for w in ("velocity", "pressure")], COLOURS)]) for element in ELEMENTS])
    if "courant_number" in results:
        study.plot_lines(out / "courant.png", "Courant number [-]", "error of the velocity [-]", [
            (scene, [(element, colour, *pick("courant", "number", "velocity_error", scene=scene, element=element)) for element, colour in zip(ELEMENTS, COLOURS)])
            for scene in ("vortices, extrapolated", "vortices, newton")])


CASES = (steps, rest, peclet, courant, small_steps, darcy, aspect, backflow, reynolds)

if __name__ == "__main__":
    study.run_cases(__doc__, Path("out/stability_fluid"), CASES, plot)
