"""Poisson-disc subsets: points of surfaces that are far apart, and near to all others."""

from __future__ import annotations

import itertools

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device, as_device
from warpgi.kernels import poisson_disc as kernels

#: Cosine of the largest angle between normals of one disc, 45 degrees. Points that face elsewhere have their own.
SAME_SIDE = 0.7071

OFFSETS = np.array(list(itertools.product((-1, 0, 1), repeat=3)), np.int64)
COLOURS = 8  # cells whose coordinates are of the same parity are no neighbours

# Cells along an axis; their numbers stay within 63 bits.
MOST_CELLS = 1 << 20


def poisson_disc(
    position: np.ndarray,
    normal: np.ndarray,
    radius: float,
    seed: int = 0,
    kept: np.ndarray | None = None,
    device: str | Device | None = None,
) -> np.ndarray:
    """Chooses points so that discs around them cover all points and hold no other chosen one.

    Points are near where their normals differ by less than 45 degrees and |d|^2 + 8 (d.n)^2 is below `radius` squared,
    for the difference d of their places and either normal n: on a plane, where they are nearer than `radius`. So no two
    chosen points are near, and every point is near to some chosen one. The choice is by random priority in cells (Wei
    2008): the same for any number of threads.

    Args:
        position: places, shape (N, 3).
        normal: unit normals, shape (N, 3).
        radius: of the discs [scene units], above 0.
        seed: which choice.
        kept: points that are chosen already, flags of shape (N,); they may be nearer to each other. None: none are.
        device: where it computes.

    Returns:
        Numbers of the chosen points, ascending, int64; those of `kept` are among them.

    Raises:
        ValueError: an array has another shape or is not finite, or the radius is not above 0.

    Example:
        >>> import numpy as np
        >>> from warpgi.poisson_disc import poisson_disc
        >>> square = np.random.default_rng(0).random((1000, 3)) * (1, 1, 0)
        >>> 60 < len(poisson_disc(square, np.tile((0, 0, 1), (1000, 1)), radius=0.1)) < 100
        True
    """
    position = checks.finite_array("position", position, (None, 3), np.float32)
    normal = checks.finite_array("normal", normal, (len(position), 3), np.float32)
    checks.number("radius", radius, 0.0, open_lower=True)
    if len(position) == 0:
        return np.zeros(0, np.int64)
    first_ones = np.zeros(len(position), bool) if kept is None else np.asarray(kept, bool)
    if first_ones.shape != (len(position),):
        raise ValueError(f"kept has shape {first_ones.shape}, expected {(len(position),)}: a flag for each point")
    where = as_device(device)
    priority = np.random.default_rng(seed).permutation(len(position))
    # those that are there before come first in their cells
    by_priority = np.concatenate([priority[first_ones[priority]], priority[~first_ones[priority]]])
    coordinates = _coordinates(position, radius)
    sizes = coordinates.max(axis=0) + 2
    numbers = _number(coordinates, sizes)
    order = by_priority[np.argsort(numbers[by_priority], kind="stable")]
    cells, first = np.unique(numbers[order], return_index=True)
    of_cell = coordinates[order[first]]
    neighbours = _neighbours(cells, of_cell, sizes)
    before = np.add.reduceat(first_ones[order].astype(np.int64), first)
    taken = where.array(np.arange(len(order), dtype=np.int32), int)
    counts = where.array(before.astype(np.int32), int)
    inputs = [
        where.array(np.append(first, len(order)).astype(np.int32), int),
        where.array(neighbours, int),
        where.array(position[order], wp.vec3),
        where.array(normal[order], wp.vec3),
        float(radius) ** 2,
        SAME_SIDE,
    ]
    colour = (of_cell & 1) @ np.array([1, 2, 4])
    for which in range(COLOURS):
        some = np.flatnonzero(colour == which).astype(np.int32)
        where.launch(kernels.throw_darts, len(some), [where.array(some, int), *inputs], [taken, counts])
    found = counts.numpy()
    places = np.repeat(first, found) + np.arange(found.sum()) - np.repeat(np.cumsum(found) - found, found)
    return np.sort(order[taken.numpy()[places]])


def _coordinates(position: np.ndarray, radius: float) -> np.ndarray:
    """Cells of the points, shape (N, 3), 1 or more: as wide as the radius, and wider where there were too many."""
    low = position.min(axis=0).astype(np.float64)
    extent = float((position.max(axis=0) - low).max())
    # a bit wider: a rounded coordinate is in no cell but the next
    side = max(1.0001 * radius, extent / (MOST_CELLS - 4))
    return 1 + np.floor((position - low) / side).astype(np.int64)


def _number(coordinates: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return (coordinates[:, 0] * sizes[1] + coordinates[:, 1]) * sizes[2] + coordinates[:, 2]


def _neighbours(cells: np.ndarray, coordinates: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Places in `cells` of the 27 around each, itself included, and -1 for empty ones; shape (C, 27), int32."""
    result = np.empty((len(cells), len(OFFSETS)), np.int32)
    for column, offset in enumerate(OFFSETS):
        wanted = _number(coordinates + offset, sizes)
        place = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        result[:, column] = np.where(cells[place] == wanted, place, -1)
    return result
