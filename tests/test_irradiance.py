"""Irradiance at points with its gradients, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import warpgi as gi
from warpgi.irradiance import _irradiance

RECTANGLE = np.array([(-0.6, -0.4, 1.0), (-0.6, 0.7, 1.0), (0.9, 0.7, 1.0), (0.9, -0.4, 1.0)])  # seen from below
POINT = np.array([0.5, -0.2, 0.0])
RADIANCE = np.array([1.0, 0.5, 2.0])


def polygon_irradiance(point, normal, corners=RECTANGLE):
    """Lambert's formula for a polygon of unit radiance that lies above the horizon."""
    rays = corners - point
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(rays, np.roll(rays, -1, axis=0), strict=True):
        axis = np.cross(a, b)
        total += np.arccos(np.clip(a @ b, -1.0, 1.0)) * (axis / np.linalg.norm(axis)) @ normal
    return 0.5 * abs(total)


def strata_of_rectangle(hemispheres, strata, count):
    """Fills the strata: radiance where the rectangle is, distance there or to a black sky."""
    rings, sectors = hemispheres.rings, hemispheres.sectors
    rng = np.random.default_rng(1)
    out = np.zeros((count, sectors, rings, 4), np.float32)
    s2 = (np.arange(rings) + rng.random((count, sectors, rings))) / rings
    phi = 2.0 * np.pi * (np.arange(sectors)[:, None] + rng.random((count, sectors, rings))) / sectors
    points = hemispheres.points.numpy().astype(np.float64)[:, None, None]
    t = (1.0 - points[..., 2]) / np.sqrt(1.0 - s2)
    x, y = points[..., 0] + t * np.sqrt(s2) * np.cos(phi), points[..., 1] + t * np.sqrt(s2) * np.sin(phi)
    inside = (np.abs(x - 0.15) < 0.75) & (np.abs(y - 0.15) < 0.55)
    out[..., :3] = inside[..., None] * RADIANCE
    out[..., 3] = np.where(inside, t, 1e30)
    strata.assign(out.reshape(-1, 4))


@pytest.fixture(scope="module")
def rectangle():
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    points = POINT[None].astype(np.float32)
    device = gi.Device("cpu")
    return _irradiance(device, points, up, np.zeros(1, np.int32), 128, 512, strata_of_rectangle)


def test_irradiance_of_a_rectangle(rectangle):
    """Irradiance under a rectangle is Lambert's polygon formula, and the nearest hit is straight above."""
    expected = polygon_irradiance(POINT, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(rectangle.value[0], expected * RADIANCE, rtol=2e-3)
    assert rectangle.nearest[0] == pytest.approx(1.0, abs=1e-3)


def test_translation_gradient(rectangle):
    """It is within 2 % of Lambert's formula's finite difference."""
    up, step = np.array([0.0, 0.0, 1.0]), 1e-4
    moves = [(polygon_irradiance(POINT + d, up) - polygon_irradiance(POINT - d, up)) / (2 * step) for d in step * np.eye(3)[:2]]
    size = np.linalg.norm(moves)
    print(rectangle.translation[0] / RADIANCE[:, None], moves)
    for channel in range(3):
        np.testing.assert_allclose(rectangle.translation[0, channel, :2], RADIANCE[channel] * np.array(moves), atol=0.02 * size * RADIANCE[channel])


def test_rotation_gradient(rectangle):
    step = 1e-3
    for axis in np.eye(3)[:2]:
        up = np.array([0.0, 0.0, 1.0])
        values = []
        for sign in (1, -1):
            n = up + sign * step * np.cross(axis, up)
            n /= np.linalg.norm(n)
            values.append(polygon_irradiance(POINT, n))
        slope = (values[0] - values[1]) / (2 * step)
        print(rectangle.rotation[0] @ axis / RADIANCE, slope)
        np.testing.assert_allclose(rectangle.rotation[0] @ axis, slope * RADIANCE, atol=0.02 * np.linalg.norm(rectangle.rotation[0, 0]) * RADIANCE)
