"""Irradiance at points with its gradients, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

import warpgi as gi
from warpgi.irradiance import sum_hemispheres

# A rectangle of constant radiance above the point, and what a ray sees beside it is black.
LOW, HIGH, HEIGHT = np.array([-0.6, -0.4]), np.array([0.9, 0.7]), 1.0
CORNERS = np.array([(x, y, HEIGHT) for x, y in ((-0.6, -0.4), (-0.6, 0.7), (0.9, 0.7), (0.9, -0.4))])
POINT, UP = np.array([0.5, -0.2, 0.0]), np.array([0.0, 0.0, 1.0])
RADIANCE = np.array([1.0, 0.5, 2.0])


def polygon_irradiance(point, normal):
    """Lambert's formula for a polygon of unit radiance above the horizon."""
    rays = CORNERS - point
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(rays, np.roll(rays, -1, axis=0), strict=True):
        axis = np.cross(a, b)
        total += np.arccos(np.clip(a @ b, -1.0, 1.0)) * (axis / np.linalg.norm(axis)) @ normal
    return 0.5 * abs(total)


def slope_of_move(direction, step=1e-4):
    ends = [polygon_irradiance(POINT + sign * step * direction, UP) for sign in (1, -1)]
    return (ends[0] - ends[1]) / (2.0 * step)


def slope_of_turn(axis, step=1e-4):
    ends = []
    for sign in (1, -1):
        normal = UP + sign * step * np.cross(axis, UP)
        ends.append(polygon_irradiance(POINT, normal / np.linalg.norm(normal)))
    return (ends[0] - ends[1]) / (2.0 * step)


def fill_with_rectangle(hemispheres, strata, count):
    """A random ray in each stratum: the rectangle's radiance and distance, or black from far away."""
    rings, sectors = hemispheres.rings, hemispheres.sectors
    rng = np.random.default_rng(1)
    s2 = (np.arange(rings) + rng.random((count, sectors, rings))) / rings
    phi = 2.0 * np.pi * (np.arange(sectors)[:, None] + rng.random((count, sectors, rings))) / sectors
    p = hemispheres.points.numpy().astype(np.float64)[:, None, None]
    t = (HEIGHT - p[..., 2]) / np.sqrt(1.0 - s2)
    flat = np.stack([np.cos(phi), np.sin(phi)], axis=-1) * (t * np.sqrt(s2))[..., None]
    at = p[..., :2] + flat
    inside = ((at > LOW) & (at < HIGH)).all(axis=-1)
    values = np.empty((count, sectors, rings, 4), np.float32)
    values[..., :3] = inside[..., None] * RADIANCE
    values[..., 3] = np.where(inside, t, 1e30)
    strata.assign(values.reshape(-1, 4))


@pytest.fixture(scope="module")
def rectangle():
    """What strata under the rectangle say of the light there."""
    points, normals = (a[None].astype(np.float32) for a in (POINT, UP))
    return sum_hemispheres(gi.Device("cpu"), points, normals, np.zeros(1, np.int32), 128, 512, fill_with_rectangle)


def test_irradiance(rectangle):
    """Under a rectangle irradiance is Lambert's formula, and the nearest thing is straight above."""
    # strata that the edge crosses decide: a few hundred of 65536, each with a variance below 1/4
    np.testing.assert_allclose(rectangle.value[0], polygon_irradiance(POINT, UP) * RADIANCE, rtol=2e-3)
    assert rectangle.nearest[0] == pytest.approx(HEIGHT, abs=1e-3)


def test_translation_gradient(rectangle):
    """It is the finite difference of Lambert's formula, within 2 % of its length, and lies in the surface."""
    expected = np.array([slope_of_move(axis) for axis in np.eye(3)[:2]])
    within = 0.02 * np.linalg.norm(expected)
    for channel, radiance in enumerate(RADIANCE):
        found = rectangle.translation[0, channel]
        assert np.linalg.norm(found[:2] - radiance * expected) < within * radiance
        assert found[2] == 0.0


def test_rotation_gradient(rectangle):
    """The same for turns of the normal: its sign is that of E(n') = E(n) + (n x n').G."""
    expected = np.array([slope_of_turn(axis) for axis in np.eye(3)[:2]])
    within = 0.02 * np.linalg.norm(expected)
    for channel, radiance in enumerate(RADIANCE):
        assert np.linalg.norm(rectangle.rotation[0, channel, :2] - radiance * expected) < within * radiance


def test_gradients_of_constant_light():
    """Light that is the same from everywhere changes neither by moving nor by turning, but where the horizon does."""

    def fill(hemispheres, strata, count):
        strata.assign(np.tile(np.array([1.0, 1.0, 1.0, 2.0], np.float32), (len(strata), 1)))

    normals = np.array([(0, 0, 1), (0.6, 0, -0.8), (0.48, 0.6, 0.64)], np.float32)
    keys = np.arange(3, dtype=np.int32)
    found = sum_hemispheres(gi.Device("cpu"), np.zeros((3, 3), np.float32), normals, keys, 8, 24, fill)
    np.testing.assert_allclose(found.value, np.pi, rtol=1e-6)
    np.testing.assert_allclose(found.harmonic, 2.0, rtol=1e-6)
    for gradient in (found.rotation, found.translation):
        np.testing.assert_allclose(gradient, 0.0, atol=1e-5)


def test_strata_without_support_are_left_out():
    """Irradiance is the mean over strata that know something."""

    def fill(hemispheres, strata, count):
        values = np.tile(np.array([1.0, 2.0, 3.0, 2.0], np.float32), (len(strata), 1))
        values[::3] = (9.0, 9.0, 9.0, -1.0)
        strata.assign(values)

    point, normal = np.zeros((1, 3), np.float32), UP[None].astype(np.float32)
    found = sum_hemispheres(gi.Device("cpu"), point, normal, np.zeros(1, np.int32), 6, 12, fill)
    np.testing.assert_allclose(found.value[0], np.pi * np.array([1.0, 2.0, 3.0]), rtol=1e-6)
    assert found.harmonic[0] == pytest.approx(2.0, rel=1e-6)
