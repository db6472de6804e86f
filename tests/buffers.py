"""Sample buffers made by hand, for the filters."""

from __future__ import annotations

import numpy as np

import warpgi as gi


def plane(width=24, height=16, spp=4, radiance=None, seed=0, position=None, normal=(0.0, 0.0, 1.0), **arrays):
    """A buffer of a wall that faces the viewer, a unit a pixel, lit from a ceiling of points; white.

    `radiance`, `position` and `normal` are values, or functions of the samples' x and y.
    """
    rng = np.random.default_rng(seed)
    count = width * height * spp
    pixel = np.arange(count) // spp
    x, y = pixel % width + rng.random(count), pixel // width + rng.random(count)

    def rows(value):
        return np.broadcast_to(value(x, y) if callable(value) else value, (count, 3)).astype(np.float32)

    origin = rows(position or (lambda x, y: np.stack([x, y, 0.0 * x], axis=1)))
    away = np.stack([rng.uniform(-1, 1, count), rng.uniform(-1, 1, count), rng.uniform(0.2, 1, count)], axis=1)
    hit = (origin + 20.0 * away).astype(np.float32)
    values = {
        "radiance": rows(rng.random((count, 3)) if radiance is None else radiance),
        "origin": origin,
        "hit": hit,
        "origin_normal": rows(normal),
        "hit_normal": rows((0.0, 0.0, -1.0)),
        "albedo": np.ones((count, 3), np.float32),
    }
    return gi.SampleBuffer(width, height, spp, **(values | arrays))


def halves(low, high, edge=12.0):
    """A function of x and y that is `low` left of the edge and `high` right of it."""
    return lambda x, y: np.where((x < edge)[:, None], np.asarray(low, float), np.asarray(high, float))
