"""Steady-state detection and block averages, against series whose answer is known in closed form."""

import numpy as np
import pytest
from scipy.signal import lfilter

from quicksand.grains import block_average, detect_steady_state, ratio_error

DT = 1e-3
TIME = DT * np.arange(1, 10001)


def autoregressive(n, a, rng):
    """x_k = a x_(k-1) + noise, stationary, of variance 1."""
    noise = rng.normal(size=n) * np.sqrt(1 - a**2)
    noise[0] = rng.normal()
    return lfilter([1.0], [1.0, -a], noise)


def test_a_constant_height_is_steady_from_a_tenth_of_the_time():
    found = detect_steady_state(TIME, np.full(TIME.size, 0.1))
    assert found.criterion == "stabilisation"
    assert found.time == pytest.approx(1.0) and found.height == pytest.approx(0.1)


def test_a_slowly_damped_oscillation_is_steady_at_its_eighth_crossing():
    # Zeros of the cosine at (k - 1/2) pi / w. The amplitude is still 8 % there, far outside 0.5 %: the other criterion is late.
    # Tolerance: what is left at the end, 0.3 exp(-5) = 0.002, is the error of h_conv and shifts a crossing at 0.08 x 9.4 /s
    # by 2.6 ms; one more sample of delay, the first beyond the zero.
    w = 3 * np.pi
    found = detect_steady_state(TIME, 0.1 * (1 + 0.3 * np.exp(-TIME / 2) * np.cos(w * TIME)))
    assert found.criterion == "oscillation"
    assert found.time == pytest.approx(7.5 * np.pi / w, abs=3.7 * DT)


def test_a_fast_decay_is_steady_when_it_is_within_half_a_percent():
    # exp(-t) = 0.005 at 5.3 s. 5 of the 100 samples may lie before that, and h_conv is exp(-9.95) above the limit 0.1.
    found = detect_steady_state(TIME, 0.1 * (1 + np.exp(-TIME)))
    assert found.criterion == "stabilisation"
    assert found.time == pytest.approx(-np.log(0.005 + np.exp(-9.95)) - 5 * DT, abs=2.1 * DT)


def test_nothing_is_steady_before_a_tenth_of_the_time():
    found = detect_steady_state(TIME, 0.1 * (1 + 0.3 * np.exp(-TIME / 2) * np.cos(100 * TIME)))  # 8 crossings in 0.25 s
    assert found.criterion == "oscillation" and found.time == pytest.approx(1.0)


def test_a_height_that_grows_without_end_never_settles():
    found = detect_steady_state(TIME, np.exp(TIME))  # 10 % within 100 samples, always from below: no sign change but one
    assert found.time is None and found.criterion is None
    assert found.height == pytest.approx(np.exp(TIME[-100:]).mean())


@pytest.mark.parametrize("outliers, first", [(5, 0), (6, 1)])
def test_a_window_is_stable_with_five_outliers_in_a_hundred_and_not_with_six(outliers, first):
    height = np.full(1000, 1.0)
    height[:outliers] = 1.006  # all in the first windows; only upwards: no crossing
    time = np.arange(1000) + 9000.0  # so late that the tenth of the total time does not matter
    assert detect_steady_state(time, height).time == time[first]


@pytest.mark.parametrize("dip, criterion", [(0.5e-4, "stabilisation"), (2e-4, "oscillation")])
def test_excursions_within_the_dead_band_are_no_crossings(dip, criterion):
    height = np.full(1000, 1.0)
    height[:500:2], height[1:500:2] = 1.01, 1.0 - dip
    assert detect_steady_state(np.arange(1000) + 9000.0, height).criterion == criterion


def test_fewer_samples_than_a_window_tell_nothing():
    found = detect_steady_state(TIME[:99], np.ones(99))
    assert found.time is None and found.height is None


def test_heights_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite"):
        detect_steady_state(TIME, np.full(TIME.size, np.nan))


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9, 0.98])
def test_the_error_of_the_mean_of_an_autoregressive_series_is_the_exact_one(a):
    # Var(mean) = (1/n) [(1+a)/(1-a) - 2a (1-a^n) / (n (1-a)^2)]. 5000 samples are 50 correlation lengths at a = 0.98. One error
    # then scatters by 20 %, the mean square of 300 by 2-3 %; the bias is documented as within 6 % (12 % in the square).
    n, rng = 5000, np.random.default_rng(1)
    exact = ((1 + a) / (1 - a) - 2 * a * (1 - a**n) / (n * (1 - a) ** 2)) / n
    averages = [block_average(autoregressive(n, a, rng)) for _ in range(300)]
    assert np.mean([average.error**2 for average in averages]) / exact == pytest.approx(1.0, abs=0.15)
    # What an error bar promises: the true mean, 0, lies within one of them in 68 % of cases. Of 300: 3 % is one sigma.
    assert np.mean([abs(average.mean) < average.error for average in averages]) == pytest.approx(0.68, abs=0.09)
    assert np.mean([average.std for average in averages]) == pytest.approx(1.0, abs=0.02)


def test_independent_samples_have_the_textbook_error():
    samples = np.random.default_rng(2).normal(3.0, 0.5, 100_000)
    average = block_average(samples)
    assert average.error == pytest.approx(0.5 / np.sqrt(100_000), rel=0.05)  # 33 000 blocks: 0.4 % is one sigma
    assert average.mean == samples.mean() and average.std == samples.std()


def test_a_constant_has_no_error():
    assert block_average(np.full(100, 0.1)).error == pytest.approx(0.0, abs=1e-16)


def test_a_series_shorter_than_its_memory_has_no_error_bar():
    assert block_average([]) is None
    assert block_average(np.arange(11.0)).error is None
    assert block_average(np.linspace(0, 1, 1000)).error is None  # a drift
    assert block_average(autoregressive(1000, 0.999, np.random.default_rng(3))).error is None


def test_what_numerator_and_denominator_share_does_not_blur_their_ratio():
    # a = 0.4 b + e: the error of <a>/<b> is that of <e> over <b>, however much b fluctuates.
    n, rng = 20_000, np.random.default_rng(4)
    b = 5.0 + autoregressive(n, 0.9, rng)
    a = 0.4 * b + rng.normal(0.0, 0.1, n)
    assert ratio_error(a, b) == pytest.approx(0.1 / np.sqrt(n) / 5.0, rel=0.05)  # 6700 blocks: 0.9 % is one sigma
    assert ratio_error([], []) is None and ratio_error(np.ones(100), np.zeros(100)) is None
