"""Profiles: averages over time in a cell whose height changes."""

import numpy as np
import pytest

from quicksand.grains import Profiles, Simulation


class Flow:
    """Solid fraction 0.75 in a cell of width 0.2 m, v_x = rate y (y = 0 at mid-height) + noise, v_y = noise."""

    def __init__(self, rate):
        self.time, self.rate = 0.0, rate

    def profile(self, axis, low, high, bins):
        assert axis == 1
        y = low + (np.arange(bins) + 0.5) * (high - low) / bins - (low + high) / 2
        solid = np.full(bins, 0.75 * 0.2 * (high - low) / bins)
        velocity = np.column_stack([self.rate * y, 0 * y])
        return {"solid": solid, "momentum": solid[:, None] * velocity, "second": solid[:, None] * (velocity**2 + (4e-4, 1e-4))}


def test_a_linear_flow_gives_its_rate_solid_fraction_and_temperature():
    flow, profiles = Flow(rate=5.0), Profiles(axis=1, bins=40, cross_section=0.2)
    for flow.time in (1.0, 2.0, 3.0):
        profiles.sample(flow, -0.05, 0.05)
    mean = profiles.mean(start=2.0)
    np.testing.assert_allclose(mean.solid_fraction, 0.75, rtol=1e-12)
    np.testing.assert_allclose(mean.temperature, [[4e-4, 1e-4]] * 40, rtol=1e-9)
    assert mean.shear_rate() == pytest.approx(5.0, rel=1e-12)
    assert mean.height == pytest.approx(0.1) and mean.position[0] == pytest.approx(0.1 / 80)


def test_a_layer_that_changes_speed_as_a_whole_is_not_hot():
    flow, profiles = Flow(rate=1.0), Profiles(axis=1, bins=10, cross_section=0.2)
    for flow.rate in (1.0, 9.0):
        profiles.sample(flow, -0.05, 0.05)
    np.testing.assert_allclose(profiles.mean(0.0).temperature, [[4e-4, 1e-4]] * 10, rtol=1e-9)


def test_bins_follow_the_walls():
    # The same wall speeds at heights of 0.08 and 0.12 m, solid in proportion to the height (phi the same in both): the mean
    # height is 0.1 m, and the velocity of a bin, U (2 y/h), the same at both times.
    flow, profiles = Flow(rate=None), Profiles(axis=1, bins=20, cross_section=0.2)
    for height in (0.08, 0.12):
        flow.rate = 1.0 / height
        profiles.sample(flow, 0.3 - height / 2, 0.3 + height / 2)
    mean = profiles.mean(start=0.0)
    np.testing.assert_allclose(mean.solid_fraction, 0.75, rtol=1e-12)
    assert mean.shear_rate() == pytest.approx(1.0 / 0.1, rel=1e-12)


def test_only_the_middle_half_counts_for_the_shear_rate():
    profiles = Profiles(axis=1, bins=8, cross_section=0.2)
    flow = Flow(rate=5.0)
    profiles.sample(flow, 0.0, 0.1)
    profile = profiles.mean(0.0)
    profile.velocity[[0, 1, -2, -1]] = 100.0  # slip at the walls
    assert profile.shear_rate() == pytest.approx(5.0, rel=1e-12)


def test_no_samples_give_no_profile():
    profiles = Profiles(axis=1, bins=8, cross_section=0.2)
    assert profiles.mean(0.0) is None
    profiles.sample(Flow(rate=1.0), 0.0, 0.1)
    assert profiles.mean(0.5) is None and profiles.mean(None) is None


def test_grains_fill_the_bins_by_their_exact_area():
    # Two discs of radius 5 mm at y = 5 and 15 mm, one moving: the lower half of the cell holds one, the upper the other.
    sim = Simulation(dim=2, period=(0.04, None))
    sim.set_friction("grain", "grain", 0.0)
    sim.add(np.array([[0.0, 0.005], [0.0, 0.015]]), 0.005, velocity=np.array([[0.0, 0.0], [2.0, 0.0]]))
    profiles = Profiles(axis=1, bins=2, cross_section=0.04)
    profiles.sample(sim, 0.0, 0.02)
    mean = profiles.mean(0.0)
    np.testing.assert_allclose(mean.solid_fraction, np.pi * 0.005**2 / (0.04 * 0.01), rtol=1e-7)  # arc cosines near 1
    np.testing.assert_allclose(mean.velocity, [[0.0, 0.0], [2.0, 0.0]], atol=1e-7)
    np.testing.assert_allclose(mean.temperature, 0.0, atol=1e-7)
    assert mean.shear_rate() == pytest.approx(200.0, rel=1e-7)
