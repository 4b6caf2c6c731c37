"""Flow through a random bed of grains: its pressure gradient against the drag law, and when the bed fluidises.

    ./run examples/packed_bed.py --periodic --fixed --mesh-over-d 3
    ./run examples/packed_bed.py --periodic --free --dim 3
    ./run examples/packed_bed.py --open
    ./run examples/packed_bed.py --fluidise --quick --mesh-over-d 2

Beds are random: points spread evenly (J. H. Halton), whose spheres are pushed apart until none overlap; open ones then settle under gravity, without fluid. `error` is that of the mean pressure gradient, against
(1 - eps)/V gamma u_s/eps at the bed's eps and the superficial velocity found, u_s = U/eps the slip (3D; gamma of discs is that of spheres, per volume of solids).

--periodic  a box of 24 d (3D: 12 d, free 9 d) that repeats along all axes; a body force on the fluid, what the law says for --velocity, stands for the pressure gradient
--open      a bed 24 d (3D: 10 d) wide between two layers of clear fluid, which comes in at the top; gradient and porosity in the middle, away from the
            ends by the kernel's reach and two elements: the kernel smears the ends. The middle is 24 d deep in 2D, 10 d in 3D, before the bed settles.
--fixed     the grains are held
--free      they are let go once the flow through the held bed is steady. Periodic: they get the opposite body force, so that all forces add up to zero, and are jammed, with overlaps
            of a percent that balance, so that contacts hold each other. Nothing holds the bed as a whole: velocities are relative to its mean. Discs jam at eps = 0.12, where `error` is
            that of the packing and its channels: compare `error_held`. Open: the flow alone presses the bed on its screen; not measured (docs/coupling.md).
--fluidise  a bed that has settled under gravity on the screen, through which the flow comes; its velocity rises step by step. Minimum fluidisation is where
            the gradient in the middle, as long as the bed rests, would be the weight less buoyancy, (1 - eps) (rho_s - rho_f) g; of the law, where its gradient is, in layers of
            the fluid's void fraction. The kernel smears the bed's ends, where so drag is less: the whole drop reaches the weight per area later, `velocity_mf_whole`, and so does that
            of the law, `velocity_mf_whole_law`. Velocities end near that of the law: a bed that moves is not measured.

Flags
    --dim 2|3            (2)
    --diameter D         [m] (1e-3)
    --velocity U         superficial [m/s] (1e-4)
    --viscosity E        [Pa s] (1e-3)
    --density R          of the grains [kg/m^3] (2500)
    --fluid-density R    [kg/m^3] (1000)
    --drag LAW           di_felice, gidaspow or beetstra (di_felice)
    --mesh-over-d R      element length [-] (3)
    --kernel NAME        smooth or hat (smooth)
    --kernel-over-d R    its standard deviation [-] (1.5)
    --element NAME       p1p1 or p2p1 (p1p1)
    --stiffness K        k = dt gamma/m, which sets the time step [-] (1e4; --fluidise 0.1)
    --periodic | --open, --fixed | --free, --fluidise    (--periodic --fixed)
    --seed N             of the bed (0)
    --quick              --fluidise: three velocities, below that of fluidisation
    --out DIR            results.json, bed.png (out/packed_bed)

results.json
    porosity                            1 - N V/volume; open: in the middle [-]
    pressure_drop pressure_drop_law     over the box, or over the middle; fluidised: the last, and the weight less buoyancy per area [Pa]
    error                               pressure_drop/pressure_drop_law - 1 [-]
    velocity_found                      superficial [m/s]
    velocity_mf velocity_mf_law error_mf   minimum fluidisation [m/s] [m/s] [-]; null without --fluidise
    velocity_mf_whole velocity_mf_whole_law   of the whole bed, see above [m/s]; null likewise
    error_held                          periodic: of the same bed held [-]; null otherwise
    error_local                         periodic: of the fluid alone, with the same law as a drag in each point of its void fraction: what the packing is off the law by, and no scheme
                                        between grains and fluid; null otherwise [-]
    void_fraction_min                   at nodes: a field that reaches 0 ends the run [-]
    grain_speed                         fastest grain, relative to the mean of all, over the superficial velocity, at the end [-]
    overlap                             periodic: largest of two grains, over d [-]
    grains steps dt                     [-] [-] [s]
    unconverged_steps                   of the grains, sub-steps accepted above the tolerance; null where they are held
    momentum_error volume_error carried_impulse   largest of a step after the first [-]
    fluid_share exchange_share grains_share       of wall_time [-]
    wall_time dofs                      [s]; unknowns
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.spatial import cKDTree
from scipy.stats import qmc

from quicksand import coupling, fluid, grains, meshes, study

GRAVITY = 9.81  # m/s^2
SOLIDS = {2: 0.7, 3: 0.56}  # dense, below the density at which random packings jam (0.84 and 0.64)
SETTLE = 0.03  # time step over sqrt(d/g)
FREE_STEPS = 5
JAMMED = {2: 0.9, 3: 0.66}  # above it, to start from: 0.875 and 0.645 or so are left


def spheres_void_fraction(eps):
    """Of spheres packed as closely as the discs."""
    return 1 - 2 / np.sqrt(np.pi * np.sqrt(3)) * (1 - eps) ** 1.5


def gradient(flags, eps, superficial):
    """The law's pressure gradient in a uniform bed [Pa/m]."""
    slip = superficial / eps
    seen = eps if flags.dim == 3 else spheres_void_fraction(eps)
    gamma = coupling.drag_coefficient(flags.drag, slip, seen, flags.diameter, flags.fluid_density, flags.viscosity)
    return (1 - eps) / (np.pi * flags.diameter**3 / 6) * gamma * slip / eps


def random_bed(lengths, solids, seed):
    """Positions about 0 of grains of diameter 1 in a periodic box, the lengths of the box, and the largest overlap.

    Evenly spread points whose spheres repel each other as they overlap, until none does. Where there is no room for that they jam, and shrink, that is the box grows, until the
    largest overlap is a percent: overlaps are then forces that balance on every grain, so that contacts that only push hold each other, whatever else acts: C. O'Hern, L. Silbert,
    A. Liu and S. Nagel, PRE 68 (2003)."""
    dim, box = len(lengths), np.array(lengths, float)
    count = round(solids * box.prod() / (np.pi / 4 if dim == 2 else np.pi / 6))
    # Points spread more evenly than independent ones: without the clusters and holes that would be channels for the flow.
    x = qmc.Halton(dim, seed=seed).random(int(1.1 * count * box.max() ** dim / box.prod()) + 50) * box.max()
    x = x[(x < box).all(axis=1)][:count]
    size, mean, listed = 1.001, 1e-3, None  # a little larger than they are: the last gaps would close in vain

    def overlaps(flat):
        nonlocal listed, pairs
        y = flat.reshape(-1, dim)
        if listed is None or np.abs(y - listed).max() > 0.1:
            listed, pairs = y.copy(), cKDTree(y % box, boxsize=box).query_pairs(1.4, output_type="ndarray").T
        apart = y[pairs[0]] - y[pairs[1]]
        apart -= box * np.round(apart / box)
        overlap = 1 - np.linalg.norm(apart, axis=1) / size
        return apart[overlap > 0], overlap[overlap > 0], pairs[:, overlap > 0]

    def energy(flat):
        apart, overlap, (i, j) = overlaps(flat)
        force = (overlap / (size**2 * (1 - overlap)))[:, None] * apart
        return 0.5 * overlap @ overlap, np.stack([np.bincount(j, f, count) - np.bincount(i, f, count) for f in force.T], axis=1).ravel().astype(float)  # of none: integers

    pairs = None
    while True:
        x = minimize(energy, x.ravel(), jac=True, method="L-BFGS-B", options={"gtol": 1e-3 * mean, "ftol": 0, "maxiter": 10000, "maxfun": 20000, "maxcor": 20}).x.reshape(-1, dim)
        overlap = overlaps(x.ravel())[1]
        if overlap.max(initial=0.0) < 1e-5:
            return x % box - box / 2, box, 0.0
        if overlap.max() < 0.01:
            return (x % box - box / 2) / size, box / size, overlap.max()
        mean = overlap.mean()
        size *= 1 - 0.8 * mean


def base(flags, lengths, periodic, origin, gravity):
    d = flags.diameter
    cells = [max(2, round(length / flags.mesh_over_d)) for length in lengths]
    mesh = meshes.box([length * d for length in lengths], cells, periodic=periodic, origin=[a * d for a in origin])
    flow = fluid.Fluid(mesh, density=flags.fluid_density, viscosity=flags.viscosity, element=flags.element, gravity=gravity)
    sim = grains.Simulation(dim=flags.dim, period=[length * d if p else None for length, p in zip(lengths, periodic)])
    sim.set_friction("grain", "grain", 0.5), sim.set_friction("grain", "wall", 0.5)
    return flow, sim


def couple(flags, sim, flow, grains_move):
    return coupling.Coupling(sim, flow, kernel=flags.kernel, kernel_radius=flags.kernel_over_d * flags.diameter, drag=flags.drag, grains_move=grains_move)


def superficial_velocity(flow, axis):
    """Mean of eps u over the mesh [m/s]; of linear elements, up to the product of two linear functions."""
    corners = flow.mesh.elements
    x = flow.nodes[corners]
    weight = np.abs(np.linalg.det(x[:, 1:] - x[:, :1]))
    n = len(flow.mesh.nodes)
    eps, u = flow.void_fraction[:n][corners], flow.velocity[:n, axis][corners]
    mean = (eps.sum(axis=1) * u.sum(axis=1) + (eps * u).sum(axis=1)) / ((flow.dim + 1) * (flow.dim + 2))  # exact for linear eps and u
    return (weight * mean).sum() / weight.sum()


def solid(flags):
    return np.pi * flags.diameter**2 / 4 if flags.dim == 2 else np.pi * flags.diameter**3 / 6


def time_step(flags, sim, eps):
    """k relaxation times of a grain."""
    gamma = gradient(flags, eps, flags.velocity) * eps * solid(flags) / (1 - eps) / (flags.velocity / eps)
    return flags.stiffness * sim.mass[0] / gamma


def through(both, dt, speed, reports):
    """Steps until the flow through a held bed is steady."""
    before = 0.0
    for _ in range(300):
        reports.append(both.step(dt))
        now = speed()
        if abs(now - before) <= 1e-6 * abs(now):
            break
        before = now


def periodic_bed(flags, side, x):
    """Grains at x [d] in a fluid that a body force drives; the void fraction, and the force [N/m^3]."""
    eps = 1 - len(x) * solid(flags) / (side * flags.diameter) ** flags.dim
    driven = gradient(flags, eps, flags.velocity)
    flow, sim = base(flags, [side] * flags.dim, [True] * flags.dim, [-side / 2] * flags.dim, [driven / flags.fluid_density] + [0.0] * (flags.dim - 1))
    flow.mean_pressure(0.0)
    sim.add(x * flags.diameter, flags.diameter / 2, density=flags.density)
    return flow, sim, eps, driven


def local_error(flags, side, x, void_fraction, superficial):
    """`error` where the fluid meets the law in each point of this void fraction, without grains."""
    flow, _, eps, driven = periodic_bed(flags, side, x)
    flow.void_fraction = void_fraction
    corners, points = flow.mesh.elements, flow.quadrature_points
    per_element = len(points) // len(corners)
    # Barycentric coordinates, the same in all elements, from the first: it lies on no periodic side's other end.
    shape = np.linalg.solve(np.vstack([flow.nodes[corners[0]].T, np.ones(flow.dim + 1)]), np.vstack([points[:per_element].T, np.ones(per_element)])).T
    of_node = np.array([gradient(flags, e, superficial) * e**2 / superficial for e in void_fraction[:len(flow.mesh.nodes)]])
    flow.reaction(beta=(of_node[corners] @ shape.T).ravel(), target=np.zeros(flow.dim))
    flow.solve_steady()
    return driven / gradient(flags, eps, superficial_velocity(flow, 0)) - 1


def run_periodic(flags):
    side = 24 if flags.dim == 2 else 9 if flags.free else 12
    x, box, overlap = random_bed([side] * flags.dim, (JAMMED if flags.free else SOLIDS)[flags.dim], flags.seed)
    side = box[0]
    length = side * flags.diameter
    flow, sim, eps, driven = periodic_bed(flags, side, x)
    both, reports = couple(flags, sim, flow, False), []
    dt = time_step(flags, sim, eps)
    start = time.perf_counter()
    through(both, dt, lambda: superficial_velocity(flow, 0), reports)
    found = superficial_velocity(flow, 0)
    held = driven / gradient(flags, eps, found) - 1
    local = local_error(flags, side, x, flow.void_fraction, found)
    if flags.free:
        sim.gravity = [-driven * eps * length**flags.dim / sim.mass.sum()] + [0.0] * (flags.dim - 1)
        sim.tolerance, sim.accept_unconverged = 1e-3, True  # what contacts leave open is speed, of the share of the slip that the tolerance says; steps that miss it are counted
        both, reports = couple(flags, sim, flow, True), []
        for _ in range(FREE_STEPS):
            reports.append(both.step(dt))
        # Nothing holds the bed as a whole: what matters is the flow relative to it.
        found = superficial_velocity(flow, 0) - eps * (sim.mass @ sim.velocity[:, 0]) / sim.mass.sum()
    return flow, sim, reports, time.perf_counter() - start, {
        "porosity": eps, "pressure_drop": driven * length, "pressure_drop_law": gradient(flags, eps, found) * length, "velocity_found": found, "dt": dt, "overlap": overlap,
        "error_held": held, "error_local": local}, None


def settle(flags, sim):
    """Onto the screen, under gravity in the absence of fluid, and to rest."""
    sim.gravity = [0.0] * (flags.dim - 1) + [-GRAVITY]
    for _ in range(400):
        sim.step(SETTLE * np.sqrt(flags.diameter / GRAVITY))
    sim.velocity, sim.spin = 0 * sim.velocity, 0 * sim.spin
    # What contacts leave open moves grains by the load's acceleration times dt times this: little beside the flow. Steps that miss it are counted.
    sim.tolerance, sim.accept_unconverged, sim.max_sweeps = 1e-5, True, 500


def middle(y, low, high):
    """A window of mean 1, J. von Hann's: sharp ends would cut the porosity of a slice with an error of a layer's."""
    s = (y - low) / (high - low)
    return np.where((s > 0) & (s < 1), 2 * np.sin(np.pi * np.clip(s, 0, 1)) ** 2, 0.0)


def porosity_of(sim, flags, low, high, area):
    """Of the grains between two heights, as `middle` weighs them."""
    return 1 - solid(flags) * middle(sim.position[:, -1], low, high).sum() / (area * (high - low))


def section_pressure(flow, flags, heights, width):
    """Mean over horizontal sections (n,) [Pa]."""
    rows = (np.arange(24) + 0.5) / 24 * width - width / 2
    across = np.stack(np.meshgrid(*[rows[:: 1 if flags.dim == 2 else 3]] * (flags.dim - 1), indexing="ij"), -1).reshape(-1, flags.dim - 1)
    points = np.concatenate([np.column_stack([across, np.full(len(across), y)]) for y in heights])
    return flow.probe(points)["pressure"].reshape(len(heights), -1).mean(axis=1)


def end_of(flags):
    """How far the end of a bed is smeared [d]: weights reach as far as the kernel and an element, and the void fraction and the pressure one more."""
    return 3.3 * flags.kernel_over_d * (flags.kernel == "smooth") + 2 * flags.mesh_over_d


def clear_of(flags):
    return int(np.ceil(4 * flags.kernel_over_d + 2 * flags.mesh_over_d))


def standing_bed(flags, gravity, clear):
    """A bed on a screen at height 0, `clear` fluid below and above [d], settled where it is free; and its height [m]."""
    d, width = flags.diameter, (24 if flags.dim == 2 else 10) // (2 if flags.fluidise else 1)
    depth = int(np.ceil(2 * end_of(flags))) + (12 if flags.fluidise else width)
    x, _, _ = random_bed([width] * (flags.dim - 1) + [depth], SOLIDS[flags.dim], flags.seed)
    periodic = [True] * (flags.dim - 1) + [False]
    lengths = [width] * (flags.dim - 1) + [depth + 1 + sum(clear)]
    flow, sim = base(flags, lengths, periodic, [-width / 2] * (flags.dim - 1) + [-clear[0]], gravity)
    sim.add_plane([0.0] * flags.dim, [0.0] * (flags.dim - 1) + [1.0])
    x[:, -1] += depth / 2 + 0.5
    sim.add(x * d, d / 2, density=flags.density)
    settle(flags, sim)
    return flow, sim, width * d, np.quantile(sim.position[:, -1], 0.98)


def run_open(flags):
    d = flags.diameter
    clear = clear_of(flags)
    flow, sim, width, top = standing_bed(flags, [0.0] * flags.dim, (clear, clear))
    flow.inflow("top" if flags.dim == 2 else "front", [0.0] * (flags.dim - 1) + [-flags.velocity])
    flow.outflow("bottom" if flags.dim == 2 else "back")
    sim.gravity = [0.0] * flags.dim
    low, high = end_of(flags) * d, top - end_of(flags) * d
    eps = porosity_of(sim, flags, low, high, width ** (flags.dim - 1))
    both, reports = couple(flags, sim, flow, False), []
    dt = time_step(flags, sim, eps)
    heights = np.linspace(low, high, 101)
    start = time.perf_counter()
    through(both, dt, lambda: section_pressure(flow, flags, heights[:1], width)[0], reports)
    if flags.free:
        both, reports = couple(flags, sim, flow, True), []
        for _ in range(FREE_STEPS):
            reports.append(both.step(dt))
    seconds = time.perf_counter() - start
    eps = porosity_of(sim, flags, low, high, width ** (flags.dim - 1))
    pressure = section_pressure(flow, flags, heights, width)
    drop = (np.diff(pressure) * middle((heights[1:] + heights[:-1]) / 2, low, high)).sum()
    law = gradient(flags, eps, flags.velocity)
    whole = np.linspace(-clear * d * 0.99, top + clear * d * 0.99, 200)
    return flow, sim, reports, seconds, {
        "porosity": eps, "pressure_drop": drop, "pressure_drop_law": law * (high - low), "velocity_found": flags.velocity, "dt": dt}, (
        "$y/d$", [("$p$ [Pa]", [("law, in the middle", study.FAINT, heights / d, pressure.mean() + law * (heights - heights.mean())),
                                ("fluid", study.BLUE, whole / d, section_pressure(flow, flags, whole, width))])])


def run_fluidised(flags):
    d, flags.free = flags.diameter, True
    flow, sim, width, top = standing_bed(flags, [0.0] * (flags.dim - 1) + [-GRAVITY], (clear_of(flags), 12))
    sim.gravity = [0.0] * (flags.dim - 1) + [-GRAVITY]
    area = width ** (flags.dim - 1)
    low, high = end_of(flags) * d, top - end_of(flags) * d
    eps = porosity_of(sim, flags, low, high, area)
    heights = np.linspace(low, high, 101)
    less = (flags.density - flags.fluid_density) * GRAVITY
    law = brentq(lambda u: gradient(flags, eps, u) - (1 - eps) * less, 1e-12, 10.0, xtol=1e-16)
    weight = sim.count * solid(flags) * less / area
    now = [0.0]
    bottom, lid = ("bottom", "top") if flags.dim == 2 else ("back", "front")
    flow.inflow(bottom, lambda x, t: np.tile([0.0] * (flags.dim - 1) + [now[0]], (len(x), 1)))
    flow.outflow(lid)
    both, reports = couple(flags, sim, flow, True), []
    flags.velocity = law
    dt = time_step(flags, sim, eps)
    ratios = np.array([0.2, 0.4, 0.6]) if flags.quick else np.arange(0.2, 1.01, 0.1)
    foot, height = flow.nodes[:, -1].min(), flow.nodes[:, -1].max()
    speeds, drops, gradients = [], [], []
    start = time.perf_counter()
    for ratio in ratios:
        now[0] = ratio * law
        for hold in range(10 if flags.quick else 20):
            reports.append(both.step(dt))
            if hold >= (5 if flags.quick else 10):
                speeds.append(now[0])
                pressure = section_pressure(flow, flags, heights, width)
                gradients.append(-(np.diff(pressure) * middle((heights[1:] + heights[:-1]) / 2, low, high)).sum() / (high - low) - flags.fluid_density * GRAVITY)
                drops.append(section_pressure(flow, flags, [foot], width)[0] - flags.fluid_density * GRAVITY * (height - foot))
    seconds = time.perf_counter() - start
    speeds, drops = np.array(speeds), np.array(drops)
    at = np.unique(speeds)
    mean, inside = (np.array([values[speeds == u].mean() for u in at]) for values in (drops, np.array(gradients)))
    rest = at < 0.75 * law
    # The law in layers of the void fraction as the fluid has it: the kernel smears it, most of all the ends.
    n = len(flow.mesh.nodes)
    levels, of_node = np.unique(np.round(flow.nodes[:n, -1] / d, 6), return_inverse=True)
    level_eps = np.bincount(of_node, flow.void_fraction[:n]) / np.bincount(of_node)

    def fluidises(values, y, weights, target):
        """The velocities at which the law in layers at y, times the factor that fits the bed at rest, and the law itself reach the target; and the laws."""
        layers = np.minimum(np.interp(y / d, levels, level_eps), 1.0)
        target = weights @ (1 - layers) * less if target is None else target

        def of(u):
            return weights @ [gradient(flags, e, u) for e in layers]

        factor = np.mean([value / of(u) for value, u in zip(values[rest], at[rest])])
        return *(brentq(lambda u: k * of(u) - target, 1e-12, 10.0, rtol=1e-9) for k in (factor, 1.0)), np.array([of(u) for u in at]) / target, target

    between = (heights[1:] + heights[:-1]) / 2
    measured, law, laws, load = fluidises(inside, between, middle(between, low, high) / len(between), None)
    whole, whole_law, whole_laws, _ = fluidises(mean, np.linspace(foot, height, 1001), np.full(1001, (height - foot) / 1001), weight)
    return flow, sim, reports, seconds, {
        "porosity": eps, "pressure_drop": mean[-1], "pressure_drop_law": weight, "velocity_found": at[-1], "dt": dt, "velocity_mf": measured, "velocity_mf_law": law,
        "error_mf": measured / law - 1, "velocity_mf_whole": whole, "velocity_mf_whole_law": whole_law}, (
        "$U$ [m/s]", [("gradient / weight", [("law", study.FAINT, at, laws), ("middle", study.BLUE, at, inside / load)]),
                      ("drop / weight", [("law", study.FAINT, at, whole_laws), ("", study.BLUE, at, mean / weight)])])


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--dim", type=int, choices=(2, 3), default=2)
    parser.add_argument("--diameter", type=study.number("m", above=0), default=1e-3)
    parser.add_argument("--velocity", type=study.number("m/s", above=0), default=1e-4)
    parser.add_argument("--viscosity", type=study.number("Pa s", above=0), default=1e-3)
    parser.add_argument("--density", type=study.number("kg/m^3", above=0), default=2500.0)
    parser.add_argument("--fluid-density", type=study.number("kg/m^3", above=0), default=1000.0)
    parser.add_argument("--drag", choices=coupling.LAWS, default="di_felice")
    parser.add_argument("--mesh-over-d", type=study.number("", above=0), default=3.0)
    parser.add_argument("--kernel", choices=("smooth", "hat"), default="smooth")
    parser.add_argument("--kernel-over-d", type=study.number("", above=0), default=1.5)
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p1p1")
    parser.add_argument("--stiffness", type=study.number("", above=0))
    ends, held = parser.add_mutually_exclusive_group(), parser.add_mutually_exclusive_group()
    ends.add_argument("--periodic", dest="open", action="store_false")
    ends.add_argument("--open", action="store_true")
    held.add_argument("--fixed", dest="free", action="store_false")
    held.add_argument("--free", action="store_true")
    parser.add_argument("--fluidise", action="store_true")
    parser.add_argument("--seed", type=study.whole(at_least=0), default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/packed_bed"))
    parser.set_defaults(open=False, free=False)
    flags = parser.parse_args()
    flags.stiffness = flags.stiffness or (0.1 if flags.fluidise else 1e4)
    if flags.fluidise and flags.density <= flags.fluid_density:
        parser.error(f"argument --density: must be above that of the fluid, {flags.fluid_density:g} kg/m^3, for a bed that rests on its screen, got {flags.density:g}")
    return parser, flags


def measure(flags):
    """Results, and what to plot."""
    kept = {name: value for name, value in vars(flags).items() if name not in ("out", "quick")}
    flow, sim, reports, seconds, results, curves = (run_fluidised if flags.fluidise else run_open if flags.open else run_periodic)(flags)
    results = kept | {"velocity_mf": None, "velocity_mf_law": None, "error_mf": None, "velocity_mf_whole": None, "velocity_mf_whole_law": None, "overlap": None, "error_held": None, "error_local": None} | results
    results |= {"error": results["pressure_drop"] / results["pressure_drop_law"] - 1, "void_fraction_min": flow.void_fraction.min(),
                "grain_speed": np.abs(sim.velocity - sim.mass @ sim.velocity / sim.mass.sum()).max() / results["velocity_found"], "grains": sim.count, "steps": len(reports)}
    results |= {"unconverged_steps": sum(r.grains.unconverged for r in reports)} if flags.free else {"unconverged_steps": None}
    results |= {name: max(getattr(r, name) for r in reports[1:] or reports) for name in ("momentum_error", "volume_error", "carried_impulse")}
    results |= {f"{part}_share": sum(getattr(r, f"{part}_time") for r in reports) / seconds for part in ("fluid", "exchange", "grains")}
    return results | {"wall_time": seconds, "dofs": flow.dofs}, flow, curves


def main():
    parser, flags = parse_flags()
    with parser.user_errors(ValueError, OSError, MemoryError, fluid.NotConverged, grains.NotConverged):
        flags.out.mkdir(parents=True, exist_ok=True)
        results, flow, curves = measure(flags)
        study.write_results(flags.out / "results.json", results)
    if curves:
        study.plot_along(flags.out / "bed.png", *curves)
    elif flags.dim == 2:
        n = len(flow.mesh.nodes)
        study.plot_flow(flags.out / "bed.png", flow.mesh, [("void fraction [-]", flow.void_fraction[:n], None, None),
                                                           ("speed [m/s]", np.linalg.norm(flow.velocity[:n], axis=1), None, flow.velocity[:n])])
    units = {"porosity": "-", "pressure_drop": "Pa", "error": "-", "error_local": "-", "velocity_mf": "m/s", "void_fraction_min": "-", "grain_speed": "-", "momentum_error": "-",
             "volume_error": "-", "carried_impulse": "-", "grains": "", "steps": "", "dofs": "", "wall_time": "s"}
    references = {"pressure_drop": f"{results['pressure_drop_law']:.6g}", "error": "0", "momentum_error": "0", "volume_error": "0"}
    if flags.fluidise:
        references |= {"velocity_mf": f"{results['velocity_mf_law']:.6g}"}
    kind = "open at both ends" if flags.open else "periodic"
    study.print_summary("A bed fluidises" if flags.fluidise else f"A {'free' if flags.free else 'held'} bed, {kind}, in {flags.dim}D", results, units, references, "law", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
