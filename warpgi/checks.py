"""Checks of what a caller gave: each raises one sentence that names the argument, before any kernel runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt


def finite_array(name: str, value: Any, shape: tuple[int | None, ...], dtype: npt.DTypeLike = np.float64) -> np.ndarray:
    """`value` as a finite numpy array of that shape; None in `shape` stands for any length.

    Raises:
        TypeError: it is not numeric.
        ValueError: its shape is another one, or it holds NaN or infinity.
    """
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} is {type(value).__name__}, expected numbers of shape {_shape(shape)}") from error
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has shape {array.shape}, expected {_shape(shape)}")
    bad = np.count_nonzero(~np.isfinite(array))
    if bad:
        raise ValueError(f"{name} holds {bad} values that are NaN or infinite, expected finite numbers")
    return array


def rgb(name: str, value: Any, upper: float = math.inf) -> tuple[float, float, float]:
    """`value`, one number or three, as an RGB triple in [0, upper].

    Raises:
        TypeError, ValueError: it is no such thing.
    """
    if isinstance(value, (int, float)):
        value = (value, value, value)
    array = finite_array(name, value, (3,))
    if array.min() < 0.0 or array.max() > upper:
        want = "0 or more" if math.isinf(upper) else f"inside [0, {upper:g}]"
        raise ValueError(f"{name} is {tuple(array.tolist())}, expected every channel {want}")
    return tuple(array.tolist())


def vector(name: str, value: Any) -> tuple[float, float, float]:
    """`value` as a finite triple.

    Raises:
        TypeError, ValueError: it is no such thing.
    """
    return tuple(finite_array(name, value, (3,)).tolist())


def direction(name: str, value: Any) -> tuple[float, float, float]:
    """`value` as a unit vector.

    Raises:
        TypeError, ValueError: it is no triple, or has length 0.
    """
    array = finite_array(name, value, (3,))
    length = float(np.linalg.norm(array))
    if length == 0.0:
        raise ValueError(f"{name} is the zero vector, expected a direction")
    return tuple((array / length).tolist())


def number(name: str, value: Any, lower: float, upper: float = math.inf, open_lower: bool = False) -> float:
    """`value` as a finite float in [lower, upper], or in (lower, upper] where `open_lower`.

    Raises:
        TypeError, ValueError: it is no such thing.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} is {value!r}, expected a number")
    value = float(value)
    if not math.isfinite(value) or value < lower or value > upper or (open_lower and value == lower):
        want = f"{'(' if open_lower else '['}{lower:g}, {'infinity)' if math.isinf(upper) else f'{upper:g}]'}"
        raise ValueError(f"{name} is {value:g}, expected a number in {want}")
    return value


def count(name: str, value: Any, lower: int = 1, upper: int = 2**31 - 1) -> int:
    """`value` as an int in [lower, upper].

    Raises:
        TypeError, ValueError: it is no such thing.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} is {value!r}, expected a whole number")
    if not lower <= value <= upper:
        raise ValueError(f"{name} is {value}, expected a whole number from {lower} to {upper}")
    return int(value)


def image_size(value: Any) -> tuple[int, int]:
    """`value` as (width, height) in pixels, fewer than 2^31 of them.

    Raises:
        TypeError, ValueError: it is no such thing.
    """
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(f"size is {value!r}, expected (width, height)")
    width, height = (count(name, number) for name, number in zip(("width", "height"), value, strict=True))
    if width * height >= 2**31:
        raise ValueError(f"size is {width} x {height}, expected fewer than 2^31 pixels")
    return width, height


def _shape(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
