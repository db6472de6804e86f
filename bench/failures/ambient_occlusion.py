"""Where ambient occlusion from splats fails: beside a wall, whose splats stand out over its edges."""

from __future__ import annotations

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, mean_value

WALL = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, 1.0, 3.0), (0.0, 1.0, 0.0)])


def wall(device: gi.Device) -> Value:
    """How far mean occlusion of a floor beside a wall is from the wall's form factor."""
    faces = [(0, 1, 2), (0, 2, 3)]
    floor = gi.Shape([(-9, 0, -9), (-9, 0, 9), (9, 0, 9), (9, 0, -9)], faces, gi.Diffuse(0.5))
    camera = gi.Camera((0.6, 1.0, 0.6), (0.6, 0.0, 0.6), up=(0, 0, -1), fov=50)
    scene = gi.Scene([floor, gi.Shape(WALL, faces, gi.Diffuse(0.5))], camera, [gi.Environment(1.0)])
    renders = [gi.render(scene, gi.AmbientOcclusion(spp=4, rays=256), (24, 24), seed, device) for seed in range(4)]
    truth = [_form_factor(render.layers["position"].reshape(-1, 3).astype(np.float64)).mean() for render in renders]
    occluded = [1.0 - float(render.image.mean(dtype=np.float64)) for render in renders]
    excess = mean_value(list(np.subtract(occluded, truth)))
    return Value(abs(excess.value), excess.error)


def _form_factor(points: np.ndarray) -> np.ndarray:
    """Share of a floor point's cosine-weighted hemisphere that the wall fills (Lambert 1760)."""
    total = np.zeros(len(points))
    for a, b in zip(WALL, np.roll(WALL, -1, axis=0), strict=True):
        u, v = a - points, b - points
        cross = np.cross(u, v)
        length = np.linalg.norm(cross, axis=1)
        total += np.arctan2(length, (u * v).sum(axis=1)) * cross[:, 1] / np.maximum(length, 1e-30)
    return np.abs(total) / (2.0 * np.pi)


ROWS = (Failure("ambient-occlusion", "floor and wall", "mean occlusion less the form factor, 4 spp", 0.02, wall),)
