"""One row of the table of failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import warpgi as gi


class Value(NamedTuple):
    """What was measured."""

    value: float
    error: float | None = None
    """Standard error; None where it is not known."""


@dataclass(frozen=True)
class Failure:
    """Something that a method does wrong, as a number of which less is better."""

    method: str
    scene: str
    what: str
    """What is measured, in words."""
    bound: float | None
    """The most that is tolerated; None where nothing is promised."""
    measure: Callable[[gi.Device], Value]


def mean_value(values: Sequence[float]) -> Value:
    """The mean of independent measurements and its standard error."""
    return Value(float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values))))


def indirect(scene: gi.Scene, method: object, size: tuple[int, int], seed: int, device: gi.Device) -> np.ndarray:
    """Indirect radiance, shape (H, W, 3), float64."""
    return gi.render(scene, method, size, seed, device).layers["indirect"].astype(np.float64)  # type: ignore[arg-type]


def inside_ring(scene: gi.Scene, render: gi.Render) -> np.ndarray:
    """Pixels of the table that the ring of scene `caustic` surrounds, where it draws its caustic; shape (H, W)."""
    ring = next(shape for shape in scene.shapes if shape.name == "ring").vertices
    low, high = ring.min(axis=0), ring.max(axis=0)
    position = render.layers["position"]
    apart = np.linalg.norm(position[..., ::2] - 0.5 * (low + high)[::2], axis=2)
    # the ring floats above the table, and is 6 % of its radius thick
    return (apart < 0.85 * 0.5 * (high - low)[0]) & (position[..., 1] < low[1])
