"""The irradiance filter against its formula, and the distances that it goes by."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from buffers import plane

import warpgi as gi
from warpgi.filtering import hit_distance
from warpgi.methods.irradiance_filter import PARTS, SurfaceFilter
from warpgi.reconstruction import Reconstruction
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


SPARSE = gi.IrradianceFilter(spp=2, rays=8, primary_hits=4, light_samples=4)


def test_lengths_of_reconstruction_rays_in_a_room():
    """Mean of one over their lengths is what distances to a cube's walls say; nothing is kept where nobody asks.

    Of primary hits at least 0.5 off the edges, so that lengths are too: 1/length then has a standard deviation below
    its mean, and of some 60 000 rays, a quarter of that number used here for safety, the error is 1/120 at 1 sigma.
    """
    scene, _ = gi.scenes.room()  # of half width 2
    samples = gi.sample(scene, spp=4, size=(32, 32))
    sizing = gi.LightField().preprocessing
    found = Reconstruction(samples, gi.Device("cpu"), sizing, 0, with_distance=True)
    found.gather(0, 64, 64)
    used = np.sort(np.abs(samples.origin), axis=1)[:, 1] < 1.5
    rng = np.random.default_rng(0)
    # cosine-distributed: a point of the sphere around the tip of the normal
    tip = np.repeat(samples.unit_origin_normal, 64, axis=0)
    d = unit(tip + unit(rng.normal(size=tip.shape))).reshape(-1, 64, 3)
    with np.errstate(divide="ignore"):
        along = np.where(d == 0.0, np.inf, (2.0 * np.sign(d) - samples.origin[:, None]) / d)
    own = np.abs(samples.origin)[:, None].max(axis=-1, keepdims=True) == np.abs(samples.origin)[:, None]
    inverse = 1.0 / np.where(own & (along < 1e-3), np.inf, along).min(axis=-1)
    assert found.inverse_distance()[used].mean() == pytest.approx(inverse[used].mean(), rel=4.4 / 120)
    assert Reconstruction(samples, gi.Device("cpu"), sizing, 0)._gathered.inverse_distance.size == 0


def test_sparse_then_filtered_furnace():
    """Even light stays even: a^2 Le / (1 - a) at every pixel, within what few rays without support can do."""
    scene, expected = gi.scenes.furnace(albedo=0.5)
    picture = gi.render(scene, SPARSE, size=(24, 24)).layers["indirect"]
    wanted = np.array(expected.radiance) * 0.5 * 0.5
    # 12 input paths of 8 % scatter and more within a splat, 32 rays in a support of 8 pixels
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), wanted, rtol=0.02)
    assert picture.std() < 0.05 * picture.mean()


def test_sparse_then_filtered_beats_both_alone():
    """Of the same samples: a third of the error of the rays alone, and less than that of the filter alone."""
    scene, size = gi.scenes.cornell_box(), (48, 48)
    truth = gi.render(scene, gi.PathTracing(spp=512), size=size, seed=9).layers["indirect"]

    def error(method):
        renders = [gi.render(scene, method, size=size, seed=seed).layers["indirect"] for seed in (1, 2)]
        return np.mean([gi.compare(picture, truth)["relmse"] for picture in renders])

    sparse = error(SPARSE)
    assert sparse < error(gi.LightField(spp=2, rays=8, primary_hits=4, light_samples=4)) / 3.0
    assert sparse < error(gi.IrradianceFilter(spp=2, light_samples=4))


def test_sparse_then_filtered_is_the_same_however_it_is_cut():
    """One thread or two, any chunk, any cut into steps: the same bits."""
    scene, size = gi.scenes.cornell_box(), (20, 14)
    one, two = (
        gi.render(scene, SPARSE, size=size, device=gi.Device("cpu", threads=n, chunk=c)) for n, c in ((1, None), (2, 7))
    )
    np.testing.assert_array_equal(one.layers["indirect"], two.layers["indirect"])
    assert one.counts == two.counts
    samples = gi.sample(scene, spp=2, size=size)
    total = SPARSE.passes(2)[0]
    pictures = []
    for cuts in ([0, total], [0, 1, 3, 7, total], [0, 4, 5, total]):
        state = SPARSE.reconstruction(samples, gi.Device("cpu"), 0)
        for first, stop in itertools.pairwise(cuts):
            state.gather(first, stop - first, total)
        pictures.append(state.picture())
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])
    np.testing.assert_array_equal(gi.reconstruct(samples, SPARSE).layers["indirect"], pictures[0])


def test_gathered_light_where_the_filter_has_not_been():
    """A picture that is stopped before the filter begins is what the rays brought."""
    scene, size = gi.scenes.cornell_box(), (16, 16)
    samples = gi.sample(scene, spp=4, size=size)
    state = gi.IrradianceFilter(spp=4, rays=32).reconstruction(samples, gi.Device("cpu"), 0)
    state.gather(0, 8, 8 + PARTS)
    whole = gi.reconstruct(samples, gi.LightField(rays=32)).layers["indirect"]
    np.testing.assert_allclose(state.picture(), whole, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"support": 0.0}, "support is 0"),
        ({"min_radius": 0.0}, "min_radius is 0"),
        ({"max_radius": 1.0}, "max_radius is 1"),
        ({"angle": 181.0}, "angle is 181"),
        ({"rays": -1}, "rays is -1"),
        ({"spp": 4, "rays": 8, "primary_hits": 2}, "primary_hits is 2"),
        ({"spp": 4, "primary_hits": 8}, "primary_hits is 8, expected None where rays is 0"),
    ],
)
def test_settings_out_of_range(settings, message):
    """Each setting has its range."""
    with pytest.raises(ValueError, match=message):
        gi.IrradianceFilter(**settings)
