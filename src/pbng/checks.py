"""Checks of numbers that users give, with messages that say what they are for."""

import math
from typing import Any

from pbng.errors import InputError


def checked_number(what: str, value: Any, positive: bool = True) -> float:
    """A finite number that is positive, or else not negative; InputError if it is not."""
    try:
        number = math.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or number < 0 or (positive and number == 0):
        wanted = "positive and finite" if positive else "finite and not negative"
        raise InputError(f"{what} must be {wanted}, not {value!r}")
    return number


def checked_vector(what: str, values: Any, n: int = 3) -> tuple[float, ...]:
    """A tuple of n finite numbers; InputError if it is not one."""
    try:
        vector = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected {n} finite numbers, not {values!r}") from None
    if len(vector) != n or not all(math.isfinite(v) for v in vector):
        raise InputError(f"{what}: expected {n} finite numbers, not {vector}")
    return vector
