"""Figures of a study, as PNG files. Drawn by matplotlib's Agg canvas: no window, no global state."""

import numpy as np

from quicksand.grains import contact_lines

INK, FAINT, BLUE, RED, GREEN = "#222222", "#9aa5b1", "#1f5fa8", "#c2452d", "#2e7d4f"
STYLE = {
    "font.size": 10, "axes.edgecolor": INK, "axes.labelcolor": INK, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.color": "#e6e9ed", "grid.linewidth": 0.7, "axes.axisbelow": True, "lines.linewidth": 1.3,
    "legend.frameon": False, "legend.fontsize": 9, "savefig.dpi": 150, "mathtext.fontset": "dejavusans",
}


def _figure(rows, columns, size, **options):
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def _styled(draw):
    """Run a drawing function in the style of all figures."""
    import functools

    @functools.wraps(draw)
    def styled(*args, **kwargs):
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return styled


@_styled
def plot_series(path, time, panels, steady_from=None, red="mean"):
    """Time series below each other, the steady window shaded and its means drawn.

    Parameters
    ----------
    path : pathlib.Path
    time : (n,) array
        [s]
    panels : list of (label, series, mean)
        series (n,) array; mean is a number or None. The few most extreme samples may leave the panel.
    steady_from : float, optional
        Start of the steady window [s].
    red : str
        What the numbers drawn over it are.
    """
    figure, axes = _figure(len(panels), 1, (8, 1.9 * len(panels)), sharex=True, squeeze=False)
    for axis, (label, series, mean) in zip(axes[:, 0], panels):
        axis.plot(time, series, color=BLUE, linewidth=0.6)
        axis.set_ylabel(label)
        finite = series[np.isfinite(series)]
        if finite.size:
            low, high = np.percentile(finite, [0.1, 99.9])
            room = 0.08 * (high - low) or 0.05 * abs(high) or 1.0
            axis.set_ylim(low - room, high + room)
        if steady_from is not None:
            axis.axvspan(steady_from, time[-1], color=GREEN, alpha=0.1, linewidth=0)
            if mean is not None:
                axis.plot([steady_from, time[-1]], [mean, mean], color=RED)
                axis.annotate(f"{mean:.4g}", (1.01, mean), xycoords=("axes fraction", "data"), color=RED, va="center",
                              annotation_clip=False)
    axes[-1, 0].set_xlabel("$t$ [s]")
    axes[-1, 0].set_xlim(0, time[-1])
    if steady_from is not None:
        axes[0, 0].set_title(f"shaded: steady from $t$ = {steady_from:.2f} s, red: {red}", fontsize=9, color=INK, loc="right")
    figure.savefig(path)


@_styled
def plot_profile(path, profile, wall_rate):
    """Solid fraction, velocity and temperature across the cell.

    Parameters
    ----------
    path : pathlib.Path
    profile : quicksand.grains.Profile
    wall_rate : float
        Difference of the walls' speeds over the height [1/s].
    """
    figure, (phi, velocity, temperature) = _figure(1, 3, (11, 4.4), sharey=True)
    y, middle = 1e3 * profile.position, profile.height / 2
    phi.plot(profile.solid_fraction, y, color=BLUE)
    phi.set(xlabel=r"solid fraction $\phi$ [-]", ylabel="$y$ above the lower wall [mm]", ylim=(0, 1e3 * profile.height))

    velocity.plot(profile.velocity[:, 0], y, ".", color=BLUE)
    velocity.plot(wall_rate * (profile.position - middle), y, color=FAINT, label=f"walls, {wall_rate:.3g} 1/s")
    slope = profile.shear_rate()
    if slope is not None:
        inside = np.abs(profile.position - middle) <= profile.height / 4
        offset = np.nanmean(profile.velocity[inside, 0])
        velocity.plot(offset + slope * (profile.position[inside] - middle), y[inside], color=RED, label=f"bulk, {slope:.3g} 1/s")
    velocity.set(xlabel=r"$\langle v_x \rangle$ [m/s]")
    velocity.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)

    temperature.plot(profile.temperature[:, 0], y, color=BLUE, label="$T_x$")
    temperature.plot(profile.temperature[:, 1], y, color=RED, label="$T_y$")
    temperature.set(xlabel=r"$\langle v^2 \rangle - \langle v \rangle^2$ [m$^2$/s$^2$]")
    if np.nanmax(profile.temperature) > 10 * np.nanmin(profile.temperature) > 0:
        temperature.set_xscale("log")
    else:
        temperature.set_xlim(left=0)
        temperature.ticklabel_format(axis="x", style="sci", scilimits=(-2, 2), useMathText=True)
    temperature.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    figure.savefig(path)


@_styled
def plot_flow_curves(path, curves, label):
    """mu(I) and phi(I) on a logarithmic axis: filled markers flow, open ones do not; lines are fits, dashed ones published.

    Parameters
    ----------
    path : pathlib.Path
    curves : list of dict
        label, colour; i, mu, mu_err, phi, phi_err, flowing: (n,) arrays; fit, thesis: functions mu(I), or None.
    label : str
        Of the axis of I.
    """
    figure, axes = _figure(1, 2, (11, 4.4))
    for curve in curves:
        colour, flowing = curve["colour"], curve["flowing"]
        for axis, name in zip(axes, ("mu", "phi")):
            for chosen, face in ((flowing, colour), (~flowing, "white")):
                axis.errorbar(curve["i"][chosen], curve[name][chosen], np.nan_to_num(curve[f"{name}_err"][chosen]), fmt="o", color=colour,
                              markerfacecolor=face, markersize=5, elinewidth=0.8, label=curve["label"] if face == colour else None)
        i = np.geomspace(curve["i"][flowing].min(), curve["i"][flowing].max()) if flowing.any() else np.empty(0)
        for function, style in ((curve["fit"], "-"), (curve["thesis"], "--")):
            if function and i.size:
                axes[0].plot(i, function(i), style, color=colour, linewidth=1)
    for axis, name in zip(axes, (r"$\mu$ [-]", r"$\phi$ [-]")):
        axis.set(xscale="log", xlabel=label, ylabel=name)
    axes[0].legend()
    published = "; dashed: the thesis's" if any(curve["thesis"] for curve in curves) else ""
    axes[0].set_title(f"filled: flowing, open: not; lines: fits{published}", fontsize=9, loc="left")
    figure.savefig(path)


@_styled
def plot_snapshot(path, sim, low, high, fixed=None, title=""):
    """Discs coloured by v_x, with the normal contact forces as lines between centres (force chains).

    Parameters
    ----------
    path : pathlib.Path
    sim : quicksand.grains.Simulation
        Two-dimensional, periodic in x.
    low, high : float
        Heights of the walls [m].
    fixed : (position (n, 2), radius (n,)), optional
        Discs that belong to the walls [m].
    title : str
    """
    from matplotlib.collections import LineCollection

    period, height = sim.period[0], high - low
    figure, axis = _figure(1, 1, (11, min(1.5 + 9.5 * height / period, 20)))
    position, radius, speed = sim.position, sim.radius, sim.velocity[:, 0]
    bound = max(np.abs(speed).max(), 1e-12)
    discs = _discs(axis, position, radius, period, speed, cmap="RdBu_r", clim=(-bound, bound), linewidths=0.25, edgecolors=FAINT)
    if fixed is not None:
        _discs(axis, *fixed, period, None, facecolors=FAINT, edgecolors=INK, linewidths=0.25)
    for y in (low, high):
        axis.axhline(y, color=INK, linewidth=1.5)

    lines, force = _force_chains(sim, period)
    if force.size:
        thickest = np.percentile(force, 99)
        widths = 2.5 * np.minimum(force / thickest, 2.0) if thickest > 0 else 0.0
        axis.add_collection(LineCollection(lines, linewidths=widths, colors=INK, capstyle="round"))
        axis.text(1.0, -0.09, f"line width proportional to the normal force, 2.5 points: {thickest:.2g} N/m",
                  transform=axis.transAxes, ha="right", va="top", fontsize=8, color=INK)

    edge = 0.02 * height + (2 * radius.mean() if fixed is not None else 0.0)
    axis.set(xlim=(-period / 2, period / 2), ylim=(low - edge, high + edge), aspect="equal", xlabel="$x$ [m]", ylabel="$y$ [m]")
    axis.grid(False)
    axis.set_title(title, fontsize=10)
    figure.colorbar(discs, ax=axis, label="$v_x$ [m/s]", fraction=0.025, pad=0.01)
    figure.savefig(path, dpi=200, bbox_inches="tight")


def _discs(axis, position, radius, period, value, **options):
    """Add discs and, for those that cross an end of the period, their images on the other side."""
    from matplotlib.collections import EllipseCollection

    x = (position[:, 0] + period / 2) % period - period / 2
    crossing = np.flatnonzero(np.abs(x) + radius > period / 2)
    which = np.concatenate([np.arange(len(x)), crossing])
    offsets = np.column_stack([x, position[:, 1]])[which]
    offsets[len(x):, 0] -= np.copysign(period, x[crossing])
    diameter = 2 * radius[which]
    discs = EllipseCollection(diameter, diameter, 0.0, units="xy", offsets=offsets, offset_transform=axis.transData,
                              array=None if value is None else value[which], **options)
    return axis.add_collection(discs)


def _force_chains(sim, period):
    """Segments (n, 2, 2) [m] of contacts, and their normal forces (n,) [N/m]; one that leaves the period is drawn from both ends."""
    segments, contacts = contact_lines(sim)
    force, end = contacts["force_normal"], segments[:, 1]
    leaves = np.abs(end[:, 0]) > period / 2
    shift = np.column_stack([np.copysign(period, end[leaves, 0]), np.zeros(leaves.sum())])
    return np.concatenate([segments, segments[leaves] - shift[:, None, :]]), np.concatenate([force, force[leaves]])


@_styled
def plot_errors(path, iterations, errors, tolerance):
    """Error over iterations, both on logarithmic axes, and the tolerance.

    Parameters
    ----------
    path : pathlib.Path
    iterations : (n,) sequence
    errors : (n,) sequence
        [-]
    tolerance : float
    """
    figure, axis = _figure(1, 1, (6, 4))
    axis.loglog(np.asarray(iterations) + 1, errors, color=BLUE, marker=".")
    axis.axhline(tolerance, color=RED, linewidth=0.8, label="tolerance")
    axis.set_xlabel("iterations + 1")
    axis.set_ylabel("error [-]")
    axis.legend()
    figure.savefig(path)


@_styled
def plot_lines(path, x_label, y_label, panels, scales=("log", "log"), steps=False, points=False, diagonal=False):
    """Curves side by side, panels share their axes.

    Parameters
    ----------
    path : pathlib.Path
    x_label, y_label : str
    panels : list of (title, [(label, colour, x, y), ...])
        x, y (n,) arrays; NaN: no point.
    scales : (str, str)
        Of matplotlib's axes.
    steps : bool
        y keeps its value until the next x.
    points : bool
        Points without lines.
    diagonal : bool
        The line y = x.
    """
    figure, axes = _figure(1, len(panels), (1.5 + 3.5 * len(panels), 3.8), sharex=True, sharey=True, squeeze=False)
    for axis, (title, curves) in zip(axes[0], panels):
        for label, colour, x, y in curves:
            axis.plot(x, y, color=colour, marker="" if steps else ".", linestyle="none" if points else "-", label=label,
                      drawstyle="steps-post" if steps else "default")
        if diagonal:
            ends = [min(np.min(x) for _, _, x, _ in curves), max(np.max(x) for _, _, x, _ in curves)]
            axis.plot(ends, ends, color=FAINT, linewidth=0.8)
        axis.set(xscale=scales[0], yscale=scales[1], title=title, xlabel=x_label)
        axis.legend()
    axes[0, 0].set_ylabel(y_label)
    figure.savefig(path)


@_styled
def plot_along(path, x_label, panels):
    """Curves over the same axis, a panel below the other for each quantity.

    Parameters
    ----------
    path : pathlib.Path
    x_label : str
    panels : list of (y_label, [(label, colour, x, y), ...])
        x, y (n,) arrays. Colours in FAINT are drawn wide, for what others should lie on.
    """
    figure, axes = _figure(len(panels), 1, (8, 2.2 * len(panels)), sharex=True, squeeze=False)
    for axis, (y_label, curves) in zip(axes[:, 0], panels):
        for label, colour, x, y in curves:
            axis.plot(x, y, color=colour, label=label, linewidth=3.5 if colour == FAINT else 1.0)
        axis.set_ylabel(y_label)
        if len(curves) > 1:
            axis.legend()
    axes[-1, 0].set_xlabel(x_label)
    figure.savefig(path)


@_styled
def plot_flow(path, mesh, panels, window=None, title=""):
    """Fields of a plane flow in colours on its mesh, a panel each, with streamlines.

    Parameters
    ----------
    path : pathlib.Path
    mesh : quicksand.meshes.Mesh2D
    panels : list of (label, values, limit, velocity)
        values at the nodes of the mesh (n,). limit: colours from -limit to limit, or (low, high), values beyond in the colour of the end; None:
        all there are. velocity at the nodes (n, 2) whose streamlines are drawn, or None.
    window : ((x, x), (y, y)), optional
        What is drawn [m]; all by default.
    title : str
    """
    from matplotlib.ticker import MaxNLocator
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    x, y = mesh.nodes.T
    triangles = Triangulation(x, y, mesh.elements)
    (left, right), (bottom, top) = window or ((x.min(), x.max()), (y.min(), y.max()))
    wide = right - left > 1.5 * (top - bottom)
    width = 10 if wide else 6.5  # of a panel
    height = 0.5 + 0.85 * width * (top - bottom) / (right - left)
    rows, columns = (len(panels), 1) if wide else (1, len(panels))
    figure, axes = _figure(rows, columns, (columns * width, rows * height + 0.4), squeeze=False)
    for axis, (label, values, limit, velocity) in zip(axes.flat, panels):
        signed = limit is not None and np.ndim(limit) == 0
        low, high = (-limit, limit) if signed else (values.min(), values.max()) if limit is None else limit
        colours = axis.tricontourf(triangles, values, levels=np.linspace(low, high, 42 if signed else 33), cmap="RdBu_r" if signed else "viridis" if velocity is None else "GnBu",
                                   extend="neither" if limit is None else "both")
        if velocity is not None:
            # Four points across an element of average size follow what the triangles know; streamplot needs them evenly spaced.
            spacing = max(0.5 * np.sqrt(mesh.volume / len(mesh.elements)), (right - left) / 400)
            across, up = (np.linspace(low, high, max(2, round((high - low) / spacing))) for low, high in ((left, right), (bottom, top)))
            grid = np.meshgrid(across, up)
            u, v = (LinearTriInterpolator(triangles, component)(*grid) for component in velocity.T)
            axis.streamplot(across, up, u, v, density=(3.0, 3.0 * (top - bottom) / (right - left)) if wide else 1.4, color=INK, linewidth=0.5, arrowsize=0.6)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="$x$ [m]", ylabel="$y$ [m]")
        axis.grid(False)
        figure.colorbar(colours, cax=axis.inset_axes([1.01, 0.0, 0.1 / width, 1.0]), label=label, ticks=MaxNLocator(6))
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, bbox_inches="tight")
