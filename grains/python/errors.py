"""Checks of arguments, as errors.hpp in C++: an exception names function, rule, value and unit."""

import math
import numbers
import operator

import numpy as np


def check_number(what, value, unit, above=None, at_least=None):
    """Raise unless `value` is a finite number within its lower bound; `what` is "function: argument"."""
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{what} must be a number [{unit}], got {value!r}")
    try:
        value = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        value = math.inf
    if not math.isfinite(value) or (above is not None and value <= above) or (at_least is not None and value < at_least):
        rule = f"> {above:g} {unit}" if above is not None else f">= {at_least:g} {unit}" if at_least is not None else "a number"
        raise ValueError(f"{what} must be {rule} and finite, got {value:g} {unit}")


def check_whole(what, value, low, high):
    """Raise unless `value` is a whole number in [low, high]."""
    try:
        value = operator.index(value)
    except TypeError:
        raise TypeError(f"{what} must be a whole number, got {value!r}") from None
    if not low <= value <= high:
        raise ValueError(f"{what} must be {low} to {high}, got {value}")


def finite_series(what, values, unit):
    """`values` as an (n,) array of floats."""
    values = np.asarray(values)
    if values.dtype.kind not in "biuf":
        raise TypeError(f"{what} must be numbers [{unit}], got an array of {values.dtype}")
    if values.ndim != 1:
        raise ValueError(f"{what} must have shape (n,), got {values.shape}")
    values = values.astype(float)
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(f"{what} must be finite, got {values[bad]} {unit} (sample {bad})")
    return values
