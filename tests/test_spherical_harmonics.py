"""Spherical harmonics at points of glossy surfaces: against other harmonics, quadrature, and path tracing."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.special import lpmv

import warpgi as gi
from warpgi.point_animation import PointRun
from warpgi.point_light import Harmonics, order_for
from warpgi.reconstruction import PrimaryHits
from warpgi.scenes.primitives import quad

SIZE = (16, 16)
METAL = gi.Conductor(roughness=0.05, reflectance=(0.9, 0.6, 0.3))


def harmonics(d, order):
    """Real orthonormal harmonics of directions (N, 3), shape (N, (order + 1)^2), by scipy's Legendre functions."""
    from math import factorial

    phi = np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for l in range(order + 1):  # noqa: E741
        for m in range(-l, l + 1):
            k = np.sqrt((2 * l + 1) / (4 * np.pi) * factorial(l - abs(m)) / factorial(l + abs(m)))
            turn = 1.0 if m == 0 else np.sqrt(2.0) * (np.cos(m * phi) if m > 0 else np.sin(-m * phi))
            columns.append(k * lpmv(abs(m), l, d[:, 2]) * turn)
    return np.stack(columns, axis=1)


def frame_of(n):
    """Two tangents and the normal, rows."""
    s = np.cross(n, [1.0, 0.0, 0.0] if abs(n[0]) < 0.9 else [0.0, 1.0, 0.0])
    s /= np.linalg.norm(s)
    return np.stack([s, np.cross(n, s), n])


def hemisphere(n, nodes=24):
    """Directions about n, and weights that integrate polynomials up to degree 4 nodes - 1, even in the height."""
    z, weight = np.polynomial.legendre.leggauss(2 * nodes)
    z, weight = z[nodes:], weight[nodes:]
    phi = 2.0 * np.pi * (np.arange(2 * nodes) + 0.5) / (2 * nodes)
    r = np.sqrt(1.0 - z**2)
    local = np.stack(
        [np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.outer(z, np.ones(2 * nodes))], axis=-1
    ).reshape(-1, 3)
    return local @ frame_of(n), np.repeat(weight, 2 * nodes) * np.pi / nodes


def field_of(seed):
    """Light of degree 5: positive, and no symmetry but that about no plane."""
    axes = np.random.default_rng(seed).normal(size=(3, 5, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)

    def light(d):
        return 1.5 + np.stack([np.prod(d @ each.T, axis=1) * 8.0 + (d @ each[0]) for each in axes], axis=1)

    return light


@pytest.fixture(scope="module")
def plate():
    """A metal plate under a lamp, and its points."""
    metal = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)).shape(METAL, "plate", smooth=False)
    scene = gi.Scene([metal], gi.Camera((0.3, 1.5, 1.2), (0, 0, 0)), [gi.PointLight((0, 2, 0), 1.0)])
    run = PointRun(gi.Sequence(1, lambda _: scene), gi.PointFilter(roughness=0.05), SIZE, 0, gi.Device("cpu"), (0,))
    run.look_at(0)
    run.choose()
    return run


def projected(light, field, normals):
    """Coefficients that a light's points with these normals find for a field, by exact quadrature."""
    parts = [hemisphere(n) for n in normals]
    size = len(parts[0][1])
    directions = np.concatenate([d for d, _ in parts])
    # strata have equal solid angles, which weights turn into those of the nodes
    scale = np.concatenate([w for _, w in parts])[:, None] * size / (2.0 * np.pi)
    strata = np.concatenate([field(directions) * scale, np.ones((len(directions), 1))], axis=1)
    device = gi.Device("cpu")
    arrays = (device.array(directions.astype(np.float32), wp.vec3), device.array(strata.astype(np.float32), wp.vec4))
    return light.projected(*arrays, size, np.asarray(normals, np.float32))


def test_band_limited_light_comes_back(plate):
    """Harmonics of light of degree 5, above the horizon of any normal and mirrored below, give it back exactly."""
    light = plate.lights[0]
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(6, 3))
    normals[0] = (0, 0, 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    field = field_of(1)
    for n, coefficients in zip(normals, _even(light, field, normals), strict=True):
        d = rng.normal(size=(200, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        expected = 0.5 * (field(d) + field(d - 2.0 * np.outer(d @ n, n)))
        np.testing.assert_allclose(harmonics(d, light.order) @ coefficients, expected, atol=2e-4)


def _even(light, field, normals):
    """Coefficients of the fields that are symmetric about each normal's plane."""
    return [
        projected(light, lambda d, n=n: 0.5 * (field(d) + field(d - 2.0 * np.outer(d @ n, n))), [n])[0] for n in normals
    ]


def test_order_by_roughness():
    """A Phong lobe of exponent 1 / (4 roughness) keeps less than 5 % of harmonics above the order, by quadrature."""
    for roughness in (0.2, 0.05, 0.02, 0.01):
        order, s = order_for(roughness), 0.25 / roughness
        z, weight = np.polynomial.legendre.leggauss(400)
        lobe = (s + 1.0) / (2.0 * np.pi) * np.maximum(z, 0.0) ** s
        kept = [2.0 * np.pi * np.sum(weight * lobe * lpmv(0, k, z)) for k in (order - 2, order + 1)]
        assert abs(kept[1]) < 0.06
        assert order == 2 or kept[0] > 0.03


def metal_value(n, wo, wi):
    """f cos of METAL: Torrance-Sparrow, Blinn, Schlick."""
    h = wi + wo
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    cos_o, cos_i, cos_h, oh = wo @ n, wi @ n, h @ n, h @ wo
    e = 1.0 / METAL.roughness
    d = (e + 2.0) / (2.0 * np.pi) * np.maximum(cos_h, 0.0) ** e
    g = np.minimum(1.0, np.minimum(2.0 * cos_h * cos_o / oh, 2.0 * cos_h * cos_i / oh))
    r = np.asarray(METAL.reflectance)
    f = r + (1.0 - r) * ((1.0 - oh) ** 5)[:, None]
    return np.where((cos_i > 0.0)[:, None], f * (d * g / (4.0 * cos_o))[:, None], 0.0)


def test_lobe_against_quadrature(plate):
    """What metal reflects of light of degree 5 is its BSDF times that light over the hemisphere, by quadrature, within
    the error of 4096 directions."""
    light = plate.lights[0]
    up = np.array([0.0, 1.0, 0.0])
    field = field_of(3)
    even = _even(light, field, [up])[0]
    job = plate._job(0, 7)
    wo = np.array([(0.0, 1.0, 0.0), (0.6, 0.8, 0.0), (0.3, 0.5, -0.6), (-0.5, 0.3, 0.5)])
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    count = len(wo)
    origin = np.float32([(0.1, 0.0, 0.2)]).repeat(count, 0)
    ones = np.ones((count, 3), np.float32)
    hits = PrimaryHits(
        origin,
        np.tile(up, (count, 1)).astype(np.float32),
        ones,
        1,
        np.zeros(count, np.int32),
        wo.astype(np.float32),
        np.tile(METAL.reflectance, (count, 1)).astype(np.float32),
        np.zeros(count, np.int32),
        np.float32([(0.3, 0.3)]).repeat(count, 0),
    )
    many = Harmonics(light.points, np.array([True]), plate.rest, gi.PointFilter(roughness=0.05, lobe_rays=4096))
    reflected = plate.device.zeros(count, wp.vec3)
    values = np.tile(even[None].astype(np.float32), (len(light.points), 1, 1))
    assert many.reflect(job, hits, values, reflected) == {"dark_hits": 0}
    d, weight = hemisphere(up, 96)
    mirrored = 0.5 * (field(d) + field(d - 2.0 * np.outer(d @ up, up)))
    assert mirrored.min() > 0.0
    expected = [np.sum(metal_value(up, each, d) * mirrored * weight[:, None], axis=0) for each in wo]
    np.testing.assert_allclose(reflected.numpy(), expected, rtol=6e-3)


def turned(scene, angle):
    """All of a scene, turned about the x axis."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    shapes = [replace(shape, vertices=shape.vertices @ matrix.T) for shape in scene.shapes]
    lights = [replace(light, position=tuple(matrix @ light.position)) for light in scene.lights]
    camera = replace(
        scene.camera,
        position=tuple(matrix @ scene.camera.position),
        target=tuple(matrix @ scene.camera.target),
        up=tuple(matrix @ scene.camera.up),
    )
    return replace(scene, shapes=shapes, lights=lights, camera=camera)


def in_a_corner(material):
    """A floor of a material beside a red wall, under a point light."""
    floor = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)).shape(material, "floor", smooth=False)
    wall = quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)).shape(gi.Diffuse((0.9, 0.3, 0.2)), "wall", smooth=False)
    camera = gi.Camera((0.2, 1.0, 2.4), (0, 0.1, 0), fov=50.0)
    return gi.Scene([floor, wall], camera, [gi.PointLight((0.5, 1.5, 0.5), 3.0)])


def test_light_that_turns_along_keeps_its_harmonics():
    """Where a glossy floor, its wall and light turn as one, coefficients stay the same but for noise."""
    scene = in_a_corner(METAL)
    sequence = gi.Sequence(2, lambda frame: turned(scene, 1.3 * frame))
    method = gi.PointFilter(roughness=0.05, rays=4096, spacing=6.0)
    run = PointRun(sequence, method, SIZE, 0, gi.Device("cpu"), (0, 1))
    for number in (0, 1):
        run.look_at(number)
    run.choose()
    light = next(light for light in run.lights if light.name == "harmonics")
    first, second = (light.trace(run._job(n, 5 + n))[0].astype(float) for n in (0, 1))
    assert np.linalg.norm(first - second) < 0.05 * np.linalg.norm(first)


def test_a_diffuse_scene_pays_nothing():
    """One irradiance a point is all that a diffuse scene has; what is smoother than asked for gets no point."""
    for material, names in (
        (gi.Diffuse(0.5), ["irradiance"]),
        (METAL, ["irradiance", "harmonics"]),
        (gi.Conductor(roughness=0.04), ["irradiance"]),
        (gi.Mirror(), ["irradiance"]),
    ):
        scene = in_a_corner(material)
        method = gi.PointFilter(roughness=0.05)
        run = PointRun(gi.Sequence(1, lambda _, scene=scene: scene), method, SIZE, 0, gi.Device("cpu"), (0,))
        run.look_at(0)
        run.choose()
        assert [light.name for light in run.lights] == names
        assert run.lights[0].width == 1
        assert ((run.points.shape == 0).any()) == (len(names) == 2 or isinstance(material, gi.Diffuse))


@pytest.mark.parametrize("material", [METAL, gi.Coated((0.6, 0.3, 0.1), roughness=0.05)])
def test_glossy_floor_agrees_with_path_tracing(material):
    """The light of a glossy floor is path tracing's, in the mean within 5 %, and in blocks of pixels."""
    scene = in_a_corner(material)
    sequence = gi.Sequence(4, lambda _: scene)
    method = gi.PointFilter(spp=4, rays=256, spacing=2.0, roughness=0.05)
    size, device = (32, 32), gi.Device("cpu")
    picture = gi.render_animation(sequence, method, size, 0, device)[0]
    truth = gi.render(scene, gi.PathTracing(spp=512), size, 1, device)
    floor = (truth.layers["normal"][..., 1] > 0.99)[..., None]
    ours, theirs = (np.where(floor, each.layers["indirect"], 0.0) for each in (picture, truth))
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.05)
    blocks = [image.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (ours, theirs)]
    assert np.abs(blocks[0] - blocks[1]).sum() < 0.1 * blocks[1].sum()
    np.testing.assert_allclose(picture.layers["direct"].mean(), truth.layers["direct"].mean(), rtol=0.02)


def test_materials_that_change():
    """A floor that is diffuse in one frame and metal in the next, by a wall that stays metal, has path tracing's light
    in both: irradiance would serve the first alone. 256 paths at some hundred points leave a noise of 3 %."""
    camera, light = gi.Camera((0.2, 1.0, 2.4), (0.0, 0.1, 0.0)), gi.PointLight((0.5, 1.5, 0.5), 3.0)
    metal = gi.Conductor(roughness=0.1)
    wall = quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)).shape(metal, "wall", smooth=False)
    floor = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)).shape(gi.Diffuse(0.7), "floor", smooth=False)
    scenes = [gi.Scene([replace(floor, material=each), wall], camera, [light]) for each in (gi.Diffuse(0.7), metal)]
    method = gi.PointFilter(spp=2, rays=256, spacing=2.0, modes=2, per_point=False)
    size, device = (24, 24), gi.Device("cpu")
    pictures = gi.render_animation(gi.Sequence(2, scenes.__getitem__), method, size, 0, device)
    for picture, scene in zip(pictures, scenes, strict=True):
        truth = gi.render(scene, gi.PathTracing(spp=512), size, 5, device)
        on_floor = picture.layers["position"][..., 1] < 0.01
        ours, theirs = (each.layers["indirect"][on_floor].mean() for each in (picture, truth))
        assert ours == pytest.approx(theirs, rel=0.1)
