"""The input of reconstruction, `gi.sample` and what renders with it leave alone, against path tracing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from noise import Z_LIMIT
from scipy import stats

import warpgi as gi
from warpgi.coat import POWERS, fit_coat, fresnel
from warpgi.device_scene import DeviceScene
from warpgi.kernels import bsdf
from warpgi.kernels.scene import ShapeRecord
from warpgi.reconstruction import pixel_means
from warpgi.samples import NO_HIT, REQUIRED

wp.set_module_options({"enable_backward": False})

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


def flat(material, height=0.0, size=1.0, flip=False):
    corners = [(-size, height, -size), (-size, height, size), (size, height, size), (size, height, -size)]
    faces = [(0, 2, 1), (0, 3, 2)] if flip else [(0, 1, 2), (0, 2, 3)]
    return gi.Shape(corners, faces, material)


def glossy_room(floor, ceiling):
    """A floor seen from the side, under a ceiling that a light from below lights."""
    lights = [gi.PointLight((0.3, 0.5, -0.2), (2.0, 1.5, 1.0))]
    camera = gi.Camera((0.0, 0.6, 1.6), (0.0, 0.0, 0.0), fov=40)
    return gi.Scene([flat(floor), flat(ceiling, 1.0, 4.0, flip=True)], camera, lights)


@wp.kernel
def bsdf_weights(
    shapes: wp.array[ShapeRecord],
    material: wp.array[int],
    albedo: wp.array[wp.vec3],
    n: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    weight: wp.array[wp.vec3],
):
    i = wp.tid()
    shape = shapes[material[i]]
    density = bsdf.pdf(shape, n[i], wo[i], wi[i])
    if density > 0.0:
        weight[i] = bsdf.evaluate(shape, albedo[i], n[i], wo[i], wi[i]) / density


@pytest.mark.parametrize(
    "material", [gi.Conductor(0.1, (0.9, 0.6, 0.4)), gi.Coated((0.6, 0.3, 0.2), 0.05), gi.Diffuse(0.6)]
)
def test_glossy_samples_hold_what_their_bsdf_needs(material):
    """BSDF over pdf from material, normal, wo, reflectance and ray alone, times radiance, is path tracing's indirect.

    A ray that was absorbed is one of no length, which counts as black.
    """
    scene, size = glossy_room(material, gi.Diffuse((0.8, 0.7, 0.6))), (16, 16)
    shapes = DeviceScene(scene, gi.Device("cpu"))
    ours = []
    for seed in range(SEEDS):
        samples = gi.sample(scene, spp=32, size=size, seed=seed, glossy=True)
        if isinstance(material, gi.Diffuse):
            assert samples.wo is None and samples.materials == ()
            ours.append(blocks(pixel_means(samples, samples.albedo * samples.radiance)))
            continue
        assert samples.materials == (material, scene.shapes[1].material)
        sent = samples.checked.is_primary & (samples.checked.is_splat | samples.checked.is_escaped)
        vectors = (samples.reflectance, samples.origin_normal, samples.wo, samples.direction)
        inputs = [wp.array(x, dtype=wp.vec3, device="cpu") for x in vectors]
        weight = wp.zeros(len(samples), dtype=wp.vec3, device="cpu")
        records = [shapes.struct.shapes, wp.array(samples.material, dtype=int, device="cpu")]
        wp.launch(bsdf_weights, len(samples), inputs=[*records, *inputs], outputs=[weight], device="cpu")
        diffuse = (samples.material == 1)[:, None]
        value = np.where(diffuse, samples.albedo, samples.albedo * weight.numpy()) * samples.radiance
        ours.append(blocks(pixel_means(samples, np.where(sent[:, None], value, np.float32(0.0)))))
    assert largest_t(ours, [blocks(x) for x in traced(scene, "indirect", size, spp=64)]) < Z_LIMIT


def test_bandwidth_and_layers_of_secondary_hits():
    """Light that leaves a diffuse hit is all of its base, a metal's none, a coat's shared out as its layers reflect.

    The coat without contrast to air adds nothing, one over black is all there is; the exponent is 1 / roughness.
    """
    floor = gi.Coated((0.5, 0.5, 0.5), 0.2)  # makes the scene glossy, whatever hangs over it
    found = {}
    ceilings = {
        "diffuse": gi.Diffuse(0.7),
        "metal": gi.Conductor(0.05),
        "coated": gi.Coated(0.5, 0.05),
        "bare": gi.Coated(0.5, 0.05, ior=1.0),
        "black": gi.Coated(0.0, 0.05),
        "mirror": gi.Mirror(0.8),
    }
    for name, ceiling in ceilings.items():
        samples = gi.sample(glossy_room(floor, ceiling), spp=8, size=(16, 16), glossy=True)
        up = samples.checked.is_splat & (samples.material == 0)
        assert up.mean() > 0.3
        found[name] = samples.radiance[up], samples.base_radiance[up], samples.kappa[up]
    light, base, kappa = found["diffuse"]
    np.testing.assert_array_equal(base, light)
    assert (kappa == 0.0).all()
    light, base, kappa = found["metal"]
    np.testing.assert_array_equal(base, 0.0)
    np.testing.assert_allclose(kappa, 4.0 * np.sqrt(20.0), rtol=1e-6)
    light, base, kappa = found["coated"]
    np.testing.assert_allclose(kappa, 4.0 * np.sqrt(20.0), rtol=1e-6)
    assert (base <= light * (1 + 1e-6)).all() and (base >= 0.0).all()
    assert 0.6 * light.mean() < base.mean() < 0.99 * light.mean()
    np.testing.assert_allclose(found["bare"][1], found["bare"][0], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found["black"][1], 0.0, atol=1e-6)
    assert found["black"][0].mean() > 0.0
    np.testing.assert_array_equal(found["mirror"][1], 0.0)
    assert (found["mirror"][2] > 1000.0).all()


def test_a_coats_light_is_split_as_its_layers_reflect():
    """With one light and no further bounce, base over whole is that of the two terms for the pair of directions."""
    scene = glossy_room(gi.Coated(0.5, 0.2), gi.Coated(0.5, 0.3))
    for seed in range(2):
        one = gi.sample(scene, 16, (16, 16), seed, glossy=True, max_depth=3)
        up = one.checked.is_splat & (one.material == 0) & (one.radiance > 0.0).all(axis=1)
        light = np.array([0.3, 0.5, -0.2]) - one.hit[up]
        wi = light / np.linalg.norm(light, axis=1, keepdims=True)
        wo = -one.direction[up]
        n = one.hit_normal[up].astype(np.float64)
        h = wi + wo
        h /= np.linalg.norm(h, axis=1, keepdims=True)
        cos_i, cos_o, cos_h, oh = ((n * wi).sum(1), (n * wo).sum(1), (n * h).sum(1), (wo * h).sum(1))
        e = 1.0 / 0.3
        g = np.minimum(1.0, 2.0 * cos_h * np.minimum(cos_i, cos_o) / oh)
        coat = fresnel(oh, 1.5) * (e + 2) / (2 * np.pi) * cos_h**e * g / (4.0 * cos_o)
        fit = fit_coat(0.3, 1.5)
        through = 1.0
        for cos in (cos_i, cos_o):
            bound = (1.0 - cos)[:, None] ** np.array(POWERS) @ fit.coefficients
            through = through * (1.0 - np.minimum(bound, fresnel(cos, 1.5) + fit.excess))
        r = fit.internal
        base = 0.5 * (1.0 - r) / (1.0 - 0.5 * r) * through / fit.transmitted * cos_i / np.pi
        np.testing.assert_allclose(one.base_radiance[up, 0] / one.radiance[up, 0], base / (base + coat), rtol=2e-3)
