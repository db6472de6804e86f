"""The irradiance filter against its formula, and the distances that it goes by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buffers import plane

import warpgi as gi
from warpgi.filtering import hit_distance
from warpgi.methods.irradiance_filter import SurfaceFilter
from warpgi.samples import unit


def brute_force(values, known, normal, position, radius, angle):
    """All pixels against all, in float64."""
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1) / radius[:, None]
    # 1 - cos of unit normals, of which float32 leaves the differences exact and not the lengths
    fall = 0.5 * np.square(normal[:, None].astype(np.float64) - normal[None]).sum(axis=-1)
    turn = np.sqrt(fall / (1.0 - np.cos(np.radians(angle))))
    weight = np.maximum(0.0, 1.0 - distance) * np.maximum(0.0, 1.0 - turn)
    weight[~normal.any(axis=1)] = weight[:, ~normal.any(axis=1)] = 0.0
    return (weight @ (values * known)) / np.maximum(weight @ known, 1e-30)


def test_weights_follow_the_formula():
    """Values, normals, radii and gaps at random on a wavy surface: the filter is the direct sum over all pixels."""
    rng = np.random.default_rng(2)
    width, height = 13, 9
    count = width * height
    y, x = np.divmod(np.arange(count), width)
    position = np.stack([x, y, 0.5 * np.sin(x)], axis=1).astype(np.float32)
    normal = unit(np.stack([0.3 * rng.normal(size=count), 0.3 * rng.normal(size=count), np.ones(count)], axis=1))
    normal[[5, 60]] = 0.0
    known = (rng.random((count, 3)) > 0.1).astype(np.float32)
    values = rng.random((count, 3)).astype(np.float32)
    radius = rng.uniform(1.0, 6.0, count).astype(np.float32)
    surfaces = SurfaceFilter((width, height), normal, position, gi.Device("cpu"), reach=20, angle=60.0)
    expected = brute_force(values, known, normal, position.astype(np.float64), radius, 60.0)
    part = normal.any(axis=1)
    np.testing.assert_allclose(surfaces.run(values, known, radius)[part], expected[part], rtol=2e-5)
    # what is not part of it stays as it is
    np.testing.assert_array_equal(surfaces.run(values, known, radius)[~part], (values * known)[~part])


def test_reach_bounds_the_support():
    """However large the radius, nothing farther than `reach` pixels counts."""
    width = 21
    position = np.stack([np.arange(width), np.zeros(width), np.zeros(width)], axis=1).astype(np.float32)
    normal = np.tile(np.float32((0, 0, 1)), (width, 1))
    value = np.zeros((width, 3), np.float32)
    value[10] = 1.0
    surfaces = SurfaceFilter((width, 1), normal, position, gi.Device("cpu"), reach=3, angle=40.0)
    result = surfaces.run(value, np.ones_like(value), np.full(width, 1e6, np.float32))[:, 0]
    assert (result[7:14] > 0).all() and not result[:7].any() and not result[14:].any()


def test_support_follows_the_harmonic_mean_distance():
    """Twice as far hits, twice the radius, until the bounds in pixels."""
    samples = plane(30, 30, 4)
    near = replace(samples, hit=samples.origin + 0.25 * (samples.hit - samples.origin))
    method = gi.IrradianceFilter(support=0.5, min_radius=0.3, max_radius=100.0)
    radii = [method.reconstruction(s, gi.Device("cpu"), 0).radius for s in (samples, near)]
    np.testing.assert_allclose(radii[0], 4.0 * radii[1], rtol=1e-5)
    # the smallest radius, over which distances are smoothed, is less than a pixel here
    inverse = 1.0 / np.linalg.norm(samples.hit - samples.origin, axis=1).reshape(900, 4)
    np.testing.assert_allclose(radii[0], 0.5 / inverse.mean(axis=1), rtol=1e-5)
    bounded = gi.IrradianceFilter(support=0.5, min_radius=2.0, max_radius=3.0).reconstruction(
        samples, gi.Device("cpu"), 0
    )
    footprint = bounded.rows.footprint()
    assert (bounded.radius >= 2.0 * footprint * (1 - 1e-6)).all()
    assert (bounded.radius <= 3.0 * footprint * (1 + 1e-6)).all()


def test_hit_distance_of_samples():
    """It is the harmonic mean of a pixel's lengths; escaped rays count as infinite; 0 where all escaped."""
    samples = plane(2, 1, 4)
    hit = samples.hit.copy()
    hit[2] = samples.direction[2] * 1e11
    hit[4:] = samples.direction[4:] * 1e11
    length = np.linalg.norm(samples.hit - samples.origin, axis=1)[[0, 1, 3]]
    expected = 4.0 / np.sum(1.0 / length)
    found = hit_distance(replace(samples, hit=hit))
    assert found.shape == (1, 2, 1)
    np.testing.assert_allclose(found[0, :, 0], [expected, 0.0], rtol=1e-6)


@pytest.mark.parametrize("method", [gi.PathTracing(spp=64, max_depth=3), gi.LightField(spp=64, rays=64, max_depth=3)])
def test_hit_distance_in_a_sphere_is_its_radius(method):
    """Chords from a point of a sphere are 2 R cos; over cosine-distributed directions the mean of 1/chord is 1/R.

    Of 64 x 1024 rays; the variance of 1/chord is log(1/angle) / 2 R^2, below 6 with angles above 1e-5, so the standard
    error is 2.5 / 256 at most. The sphere is of 20 480 triangles, whose edges add some short chords.
    """
    scene, _ = gi.scenes.integrating_sphere(radius=3.0)
    layer = gi.render(scene, method, size=(32, 32)).layers["hit_distance"]
    assert layer.shape == (32, 32, 1)
    assert 1.0 / np.mean(1.0 / layer.astype(np.float64)) == pytest.approx(3.0, rel=4.4 * 2.5 / 256)


def test_hit_distance_where_no_ray_goes_on():
    """An open wall under the sky, and paths that end at the first hit: 0."""
    wall = gi.Shape([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5))
    scene = gi.Scene([wall], gi.Camera((0, 0, 2), (0, 0, 0)), [gi.Environment(1.0)])
    assert not gi.render(scene, gi.PathTracing(spp=4), size=(8, 8)).layers["hit_distance"].any()
    box = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=4, max_depth=1), size=(8, 8))
    assert not box.layers["hit_distance"].any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"support": 0.0}, "support is 0"),
        ({"min_radius": 0.0}, "min_radius is 0"),
        ({"max_radius": 1.0}, "max_radius is 1"),
        ({"angle": 181.0}, "angle is 181"),
    ],
)
def test_settings_out_of_range(settings, message):
    """Each setting has its range."""
    with pytest.raises(ValueError, match=message):
        gi.IrradianceFilter(**settings)
