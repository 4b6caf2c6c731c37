"""Profiles across a cell whose walls move: sampled in bins of normalised height, averaged over any time window."""

from dataclasses import dataclass

import numpy as np

from .errors import check_number, check_whole


@dataclass(frozen=True)
class Profile:
    """Time average across a cell; in bins without grains velocity and temperature are NaN."""

    position: np.ndarray  # (bins,) centres of the bins, from the lower wall [m]
    height: float  # mean height [m]
    solid_fraction: np.ndarray  # (bins,) [-]
    velocity: np.ndarray  # (bins, dim) mean over solid area or volume [m/s]
    temperature: np.ndarray  # (bins, dim) about the mean of the bin at each time, per component, the shear across one bin included [m^2/s^2]

    def shear_rate(self):
        """Slope of <v_x> over the middle half of the height by least squares [1/s]; None with fewer than two bins."""
        middle = (np.abs(self.position / self.height - 0.5) <= 0.25) & np.isfinite(self.velocity[:, 0])
        if middle.sum() < 2:
            return None
        return float(np.polyfit(self.position[middle], self.velocity[middle, 0], 1)[0])


class Profiles:
    """Samples of `Simulation.profile`, kept until it is known which of them to average.

    Parameters
    ----------
    axis : int
        Axis across the cell.
    bins : int
    cross_section : float
        Extent of the cell across `axis` [m in 2D, m^2 in 3D].

    Raises
    ------
    ValueError
        When axis is not 0, 1 or 2, bins not in 1 to 1e6, cross_section not > 0.
    """

    def __init__(self, axis, bins, cross_section):
        check_whole("Profiles: axis", axis, 0, 2)
        check_whole("Profiles: bins", bins, 1, 1_000_000)
        check_number("Profiles: cross_section", cross_section, "m (3D: m^2)", above=0)
        self.axis, self.bins, self.cross_section = axis, bins, cross_section
        self.samples = []  # (time, height, profile)

    def sample(self, sim, low, high):
        """Add the profile between `low` and `high` [m] as it is now."""
        self.samples.append((sim.time, high - low, sim.profile(self.axis, low, high, self.bins)))

    def state(self):
        """The samples as arrays, for `restore`."""
        if not self.samples:
            return {}
        time, height, profiles = zip(*self.samples)
        return {"time": np.array(time), "height": np.array(height)} | {
            name: np.array([profile[name] for profile in profiles]) for name in profiles[0]}

    def restore(self, state):
        """Take the samples from what `state` returned."""
        fields = [name for name in state if name not in ("time", "height")]
        self.samples = [(float(time), float(height), {name: state[name][k] for name in fields})
                        for k, (time, height) in enumerate(zip(state.get("time", []), state.get("height", [])))]

    def mean(self, start):
        """Average over the samples with time >= start [s], a `Profile`; None without samples, or where start is None."""
        if start is not None:
            check_number("Profiles.mean: start", start, "s")
        chosen = [(height, profile) for time, height, profile in self.samples if start is not None and time >= start]
        if not chosen:
            return None
        heights = [height for height, _ in chosen]
        solid, momentum = (sum(profile[name] for _, profile in chosen) for name in ("solid", "momentum"))
        height = float(np.mean(heights))
        with np.errstate(invalid="ignore", divide="ignore"):
            velocity = momentum / solid[:, None]
            # About the mean of each sample: layers speed up and slow down as a whole, which is no heat.
            heat = sum(np.nan_to_num(p["second"] - p["momentum"]**2 / p["solid"][:, None]) for _, p in chosen)
            temperature = heat / solid[:, None]
        volume = self.cross_section * sum(heights) / self.bins
        return Profile((np.arange(self.bins) + 0.5) * height / self.bins, height, solid / volume, velocity, temperature)
