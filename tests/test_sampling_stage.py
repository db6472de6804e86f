"""The input of reconstruction, `gi.sample` and what renders with it leave alone, against path tracing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from noise import Z_LIMIT
from scipy import stats

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.reconstruction import pixel_means
from warpgi.samples import NO_HIT, REQUIRED

SEEDS = 8


def blocks(picture, side=8):
    height, width = (n // side for n in picture.shape[:2])
    return picture.astype(np.float64).reshape(height, side, width, side, 3).mean(axis=(1, 3))


def largest_t(one, other):
    """Largest Student t of two lists of pictures, as a normal variable's z, Bonferroni-corrected for their number."""
    one, other = np.array(one), np.array(other)
    difference = np.abs(one.mean(axis=0) - other.mean(axis=0))
    error = np.sqrt(one.var(axis=0, ddof=1) / len(one) + other.var(axis=0, ddof=1) / len(other))
    error = np.maximum(error, 1e-6 * np.abs(other).mean())
    # the fewer degrees of freedom of the two, which is cautious
    p = 2.0 * stats.t.sf((difference / error).max(), min(len(one), len(other)) - 1) * difference.size
    return float(stats.norm.isf(min(p, 1.0) / 2.0))


def traced(scene, layer, size, spp=64, seeds=SEEDS, **settings):
    method = gi.PathTracing(spp=spp, sampler=gi.Sampler.INDEPENDENT, **settings)
    return [gi.render(scene, method, size=size, seed=100 + s).layers[layer] for s in range(seeds)]


def test_a_sample_takes_72_bytes():
    """Six vectors are carried, and with `recursive` two more; nothing that a still, diffuse, pinhole scene lacks."""
    scene = gi.scenes.cornell_box()
    assert gi.sample(scene, spp=2, size=(8, 6)).bytes_per_sample == 72
    samples = gi.sample(scene, spp=2, size=(8, 6), recursive=True)
    assert samples.bytes_per_sample == 96
    assert (samples.width, samples.height, samples.spp, len(samples)) == (8, 6, 2, 96)


@pytest.mark.parametrize("depth", [None, 3])
def test_samples_are_the_path_tracers_indirect_light(depth):
    """The mean of albedo times radiance over a pixel is what path tracing calls indirect light, within noise."""
    scene, size = gi.scenes.cornell_box(), (32, 32)
    ours = []
    for seed in range(SEEDS):
        samples = gi.sample(scene, spp=32, size=size, seed=seed, max_depth=depth)
        ours.append(blocks(pixel_means(samples, samples.albedo * samples.radiance)))
    theirs = [blocks(picture) for picture in traced(scene, "indirect", size, spp=32, max_depth=depth)]
    assert largest_t(ours, theirs) < Z_LIMIT


def test_radiance_is_direct_light_and_throughput_times_the_rest():
    """Radiance is never below the direct light at the hit, and equal to it where paths end there."""
    scene = gi.scenes.cornell_box()
    samples = gi.sample(scene, spp=8, size=(16, 16), recursive=True)
    splats = samples.checked.is_splat
    assert (samples.radiance[splats] >= samples.hit_direct[splats] * (1 - 1e-6)).all()
    assert (samples.throughput[splats] > 0.0).any(axis=1).all() and samples.throughput.max() <= 1.0
    short = gi.sample(scene, spp=8, size=(16, 16), recursive=True, max_depth=3)
    np.testing.assert_array_equal(short.radiance, short.hit_direct)
    np.testing.assert_array_equal(gi.sample(scene, spp=8, size=(16, 16), max_depth=2).radiance, 0.0)


def test_points_lie_on_the_scene():
    """Origins and hits are in world coordinates, on the walls of a room away from the origin; normals point inwards."""
    scene, _ = gi.scenes.room()
    far = (30.0, -20.0, 10.0)
    shapes = [dataclasses.replace(shape, vertices=shape.vertices + far) for shape in scene.shapes]
    camera = dataclasses.replace(
        scene.camera, position=np.add(scene.camera.position, far), target=np.add(scene.camera.target, far)
    )
    lights = [dataclasses.replace(light, position=np.add(light.position, far)) for light in scene.lights]
    samples = gi.sample(dataclasses.replace(scene, shapes=shapes, camera=camera, lights=lights), spp=4, size=(12, 12))
    assert samples.checked.is_splat.all()
    for points, normals in ((samples.origin, samples.origin_normal), (samples.hit, samples.hit_normal)):
        local = points.astype(np.float64) - far
        np.testing.assert_allclose(np.abs(local).max(axis=1), 2.0, atol=1e-5)  # on a wall of the 4 m cube
        np.testing.assert_allclose((local * normals).sum(axis=1), -2.0, atol=1e-5)  # whose normal points inwards
    along = samples.direction
    assert ((along * samples.origin_normal).sum(axis=1) > 0.0).all()
    assert ((along * samples.hit_normal).sum(axis=1) < 0.0).all()
    # cosine-distributed directions: the mean cosine is 2/3, its standard deviation sqrt(1/18)
    cosine = (along * samples.origin_normal).sum(axis=1)
    assert abs(cosine.mean() - 2.0 / 3.0) < Z_LIMIT * np.sqrt(1.0 / 18.0 / len(cosine))


def test_escaped_rays_are_recorded():
    """Rays that leave are kept with their direction, as many as the geometry lets out, and without radiance."""
    square = [(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)]
    floor = gi.Shape(square, [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5))
    lid = gi.Shape([(50 * x, 1, 50 * z) for x, _, z in square], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.0))
    camera = gi.Camera((0.0, 0.9, 0.0), (0.0, 0.0, 0.0), up=(0, 0, -1), fov=60)
    open_scene = gi.Scene([floor], camera, [gi.Environment(2.0)])
    samples = gi.sample(open_scene, spp=8, size=(16, 16))
    state = samples.checked
    assert state.is_primary.all() and state.is_escaped.all() and not state.is_splat.any()
    d = samples.direction
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-6)
    assert (d[:, 1] > 0.0).all()
    assert abs(d[:, 1].mean() - 2.0 / 3.0) < Z_LIMIT * np.sqrt(1.0 / 18.0 / len(d))
    # what comes from the environment at once is direct light
    np.testing.assert_array_equal(samples.radiance, 0.0)
    closed = gi.sample(gi.Scene([floor, lid], camera, [gi.Environment(2.0)]), spp=8, size=(16, 16))
    assert closed.checked.is_splat.mean() > 0.999
    # beside the floor there is no primary hit
    wide = gi.sample(dataclasses.replace(open_scene, camera=dataclasses.replace(camera, fov=150)), spp=2, size=(16, 16))
    missed = np.abs(wide.origin).max(axis=1) >= NO_HIT
    assert 0.5 < missed.mean() < 0.95
    assert wide.checked.counts["primary_missed"] == missed.sum() and not wide.checked.is_primary[missed].any()


@pytest.mark.parametrize("name", ["cornell-box", "cornell-spheres", "statuettes"])
def test_what_is_not_reconstructed_is_path_traced(name):
    """Mirrors, glass and metal keep their light: over the whole picture all methods' means agree within noise.

    Splats that stand out over edges may add 1 % of indirect light.
    """
    scene = gi.scenes.statuettes(resolution=16, sky=0.3) if name == "statuettes" else gi.scenes.build(name)
    size = (24, 24)
    for layer in ("emission", "direct", "indirect"):
        ours = np.array(
            [
                gi.render(scene, gi.LightField(spp=8, rays=32), size=size, seed=s).layers[layer].mean(axis=(0, 1))
                for s in range(SEEDS)
            ],
            dtype=np.float64,
        )
        theirs = np.array([x.mean(axis=(0, 1)) for x in traced(scene, layer, size, spp=32)], dtype=np.float64)
        difference = np.abs(ours.mean(axis=0) - theirs.mean(axis=0))
        error = np.sqrt((ours.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / SEEDS)
        bias = 0.01 * theirs.mean(axis=0) if layer == "indirect" and name != "statuettes" else 0.0
        limit = stats.t.isf(stats.norm.sf(Z_LIMIT), SEEDS - 1)
        assert (difference <= limit * error + bias + 1e-6).all(), layer


def test_mirrors_before_the_first_diffuse_hit_are_walked_through():
    """Behind a perfect mirror the samples are those of the mirrored camera: same light, albedo times reflectance."""
    room, _ = gi.scenes.integrating_sphere(albedo=0.5, subdivisions=4)
    corners = [(-0.8, -0.8, -0.3), (0.8, -0.8, -0.3), (0.8, 0.8, -0.3), (-0.8, 0.8, -0.3)]
    mirror = gi.Shape(np.array(corners) * 0.4, [(0, 1, 2), (0, 2, 3)], gi.Mirror(0.8))
    camera = gi.Camera((0.0, 0.0, 0.5), (0.0, 0.0, -0.12), fov=30)
    samples = gi.sample(dataclasses.replace(room, shapes=[*room.shapes, mirror], camera=camera), spp=4, size=(8, 8))
    assert samples.checked.is_primary.all()
    np.testing.assert_allclose(samples.albedo, 0.5 * 0.8, rtol=1e-5)
    # the camera looks along -z, yet the wall that it sees by way of the mirror is that behind it
    assert (samples.origin[:, 2] > 0.3).all()


def test_lights_seen_by_secondary_rays_are_left_out():
    """Emission that a secondary ray meets is direct light: radiance of a furnace is a Le / (1 - a), without Le."""
    scene, _ = gi.scenes.furnace(albedo=0.5, emission=2.0)
    values = np.array([gi.sample(scene, spp=4, size=(16, 16), seed=s).radiance.mean() for s in range(SEEDS)])
    error = values.std(ddof=1) / np.sqrt(SEEDS)
    assert abs(values.mean() - 2.0) < stats.t.isf(stats.norm.sf(Z_LIMIT), SEEDS - 1) * error
    assert error < 0.02


def test_same_bits_for_any_threads_and_bands():
    """Neither threads nor the memory limit, which cuts the film into bands, change a sample or a picture."""
    scene = gi.scenes.cornell_spheres()
    size, method = (20, 20), gi.LightField(spp=2, rays=8)
    devices = [gi.Device("cpu", 1), gi.Device("cpu", 2, chunk=7), gi.Device("cpu", 3, chunk=64)]
    first, *rest = [gi.sample(scene, spp=2, size=size, device=device, recursive=True) for device in devices]
    for other in rest:
        for name in (*REQUIRED, "throughput", "hit_direct"):
            np.testing.assert_array_equal(getattr(first, name).view("u4"), getattr(other, name).view("u4"))
    whole = gi.render(scene, method, size=size, device=devices[0])
    need = DeviceScene(scene, devices[0]).nbytes + method.device_bytes(size)
    for spare in (20_000, 60_000):
        device = gi.Device("cpu", 2, memory_limit=need + spare)
        banded = gi.render(scene, method, size=size, device=device)
        for name, layer in whole.layers.items():
            np.testing.assert_array_equal(banded.layers[name].view("u4"), layer.view("u4"))


def test_seeds_differ():
    """Another seed is another buffer; the same seed the same one."""
    scene = gi.scenes.cornell_box()
    a, b, c = (gi.sample(scene, spp=1, size=(8, 8), seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(a.hit, b.hit)
    assert (a.hit != c.hit).any(axis=1).mean() > 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spp": 0}, "spp is 0, expected"),
        ({"size": (0, 8)}, "width is 0, expected"),
        ({"seed": -1}, "seed is -1, expected"),
        ({"max_depth": 0}, "max_depth is 0, expected"),
        ({"device": "tpu"}, "device is 'tpu', expected"),
        ({"device": gi.Device("cpu", memory_limit=10_000)}, "memory_limit"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    """Each argument says in one sentence what came and what was wanted."""
    with pytest.raises((TypeError, ValueError), match=message) as error:
        gi.sample(gi.scenes.cornell_box(), **{"size": (32, 32), **arguments})
    assert "\n" not in str(error.value)
    with pytest.raises(TypeError, match="scene is str, expected Scene"):
        gi.sample("cornell-box")
