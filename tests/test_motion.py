"""Shapes in motion and the thin lens: what is blurred, where the blur lies, and what a still scene keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from noise import Z_LIMIT
from scipy import stats

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.kernels import rays
from warpgi.reconstruction import pixel_means
from warpgi.scenes import primitives

FACES = [(0, 1, 2), (0, 2, 3)]
SQUARE = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])


class Moving(gi.Scene):
    """A scene that goes the way of those that move, whether it does or not."""

    moves = True


def square(size, centre, material=None, emission=None, motion=None, flip=False):
    faces = [face[::-1] for face in FACES] if flip else FACES
    return gi.Shape(SQUARE * size + centre, faces, material or gi.Diffuse(0.5), emission, motion=motion)


def room():
    """A floor, a quad that flies over it and turns, and a lamp that flies, turns and grows."""
    floor = gi.Shape([(-2, 0, -2), (-2, 0, 2), (2, 0, 2), (2, 0, -2)], FACES, gi.Diffuse((0.7, 0.6, 0.5)))
    quad = gi.Shape(
        SQUARE * 0.4 + (-0.6, 0.6, 0.0),
        FACES,
        gi.Diffuse((0.2, 0.5, 0.8)),
        motion=[(0.9, 0.3, 0.2), (1.3, -0.2, 0.0), (1.1, 0.1, -0.5), (0.8, 0.2, 0.4)],
    )
    lamp = gi.Shape(
        np.array([(-0.2, 1.6, -0.2), (0.2, 1.6, -0.2), (0.2, 1.6, 0.2), (-0.2, 1.6, 0.2)]),
        FACES,
        gi.Diffuse(0.3),
        gi.Emissive((12.0, 11.0, 9.0)),
        motion=[(0.4, 0.2, -0.2), (0.9, -0.3, -0.1), (1.0, 0.1, 0.5), (0.2, 0.3, 0.3)],
    )
    return gi.Scene([floor, quad, lamp], gi.Camera((0.0, 1.2, 3.6), (0.0, 0.6, 0.0), fov=44))


def frozen(scene, time):
    """The scene as it stands at one time, without any motion."""
    shapes = [
        dataclasses.replace(s, vertices=s.vertices + time * (0.0 if s.motion is None else s.motion), motion=None)
        for s in scene.shapes
    ]
    return dataclasses.replace(scene, shapes=shapes)


def largest_t(one, other, side=4):
    """Largest Student t of two lists of pictures over blocks, as a standard normal's z, corrected for their number."""

    def blocks(pictures):
        x = np.array(pictures, dtype=np.float64)
        n, h, w, c = x.shape
        return x.reshape(n, h // side, side, w // side, side, c).mean(axis=(2, 4))

    one, other = blocks(one), blocks(other)
    error = np.sqrt(one.var(axis=0, ddof=1) / len(one) + other.var(axis=0, ddof=1) / len(other))
    error = np.maximum(error, 1e-6 * np.abs(other).mean())
    t = np.abs(one.mean(axis=0) - other.mean(axis=0)) / error
    p = 2.0 * stats.t.sf(t.max(), min(len(one), len(other)) - 1) * t.size
    return float(stats.norm.isf(min(p, 1.0) / 2.0))


@pytest.mark.parametrize("layer", ["emission", "direct", "indirect"])
def test_blur_is_the_mean_of_still_pictures(layer):
    """A picture of what moves, turns and grows, lamp included, is the mean of still pictures at random times."""
    scene, size = room(), (24, 24)
    method = gi.PathTracing(spp=8, sampler=gi.Sampler.INDEPENDENT, max_depth=4)
    times = np.random.default_rng(1).random(200)
    blurred = [gi.render(scene, method, size=size, seed=s).layers[layer] for s in range(40)]
    still = [gi.render(frozen(scene, t), method, size=size, seed=1000 + s).layers[layer] for s, t in enumerate(times)]
    assert largest_t(blurred, still) < Z_LIMIT


def test_shutter_at_one_instant_is_the_still_picture():
    """With a shutter that opens and closes at one time the picture is that of the scene moved there."""
    scene, size = room(), (24, 24)
    method = gi.PathTracing(spp=16, sampler=gi.Sampler.INDEPENDENT, max_depth=3)
    camera = dataclasses.replace(scene.camera, shutter=(0.7, 0.7))
    ours = [gi.render(dataclasses.replace(scene, camera=camera), method, size=size, seed=s).image for s in range(24)]
    still = [gi.render(frozen(scene, 0.7), method, size=size, seed=100 + s).image for s in range(24)]
    assert largest_t(ours, still) < Z_LIMIT


@pytest.mark.parametrize("name", ["cornell-box", "cornell-spheres", "statuettes", "courtyard"])
def test_still_scene_through_the_motion_path_is_the_same_to_the_last_bit(name):
    """Interpolated boxes and corners that go nowhere give the hits, normals and light of the still path."""
    parameters = {"courtyard": {"detail": 0.05}, "statuettes": {"resolution": 24}}.get(name, {})
    scene = gi.scenes.build(name, **parameters)
    moving = Moving(scene.shapes, scene.camera, scene.lights, scene.name)
    assert DeviceScene(moving, gi.Device("cpu")).struct.moving == 1
    method = gi.PathTracing(spp=2)
    still, same = (gi.render(s, method, size=(40, 40)) for s in (scene, moving))
    for layer, values in still.layers.items():
        np.testing.assert_array_equal(same.layers[layer].view("u4"), values.view("u4"), layer)
    assert same.counts == still.counts


def test_rays_meet_moving_triangles_where_a_tree_of_still_ones_does():
    """At any time a ray hits the triangle, at the distance, that it hits in a scene built of the triangles moved there.

    Rounding may send a ray that grazes an edge past it: fewer than one in ten thousand, and no ray slips through.
    """
    rng = np.random.default_rng(5)
    balls = primitives.icosphere(0.2, 3)
    shapes = []
    for offset in rng.uniform(-1.0, 1.0, (12, 3)):
        turned = balls.vertices @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        motion = 1.5 * turned - balls.vertices + rng.uniform(-1.0, 1.0, 3)
        shapes.append(gi.Shape(balls.vertices + offset, balls.faces, motion=motion))
    scene = gi.Scene(shapes, gi.Camera((0, 0, 5), (0, 0, 0)))
    device, count = gi.Device("cpu"), 50_000
    moving = DeviceScene(scene, device)
    for time in (0.0, 0.3, 0.77, 1.0):
        still = DeviceScene(frozen(scene, time), device)
        shift = (still.centre - moving.centre).astype(np.float32)
        o = rng.uniform(-2.0, 2.0, (count, 3)).astype(np.float32)
        d = rng.uniform(-0.9, 0.9, (count, 3)) - o
        d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
        found = []
        for where, origins in ((moving, o), (still, o - shift)):
            hits = rays.Hits()
            for name, dtype in (("t", float), ("u", float), ("v", float), ("face", int)):
                setattr(hits, name, device.zeros(count, dtype))
            where.struct.time = time
            inputs = [where.struct, device.array(origins, wp.vec3), device.array(d, wp.vec3)]
            device.launch(rays.trace_closest_hits, count, inputs, [hits])
            found.append((hits.face.numpy(), hits.t.numpy()))
        (face, t), (other, s) = found
        assert 0.1 < (face >= 0).mean() < 0.9
        same = (face == other) & ((face < 0) | (np.abs(t - s) < 1e-4))
        assert (~same).mean() < 1e-4


def test_methods_that_take_no_motion_say_so():
    """A scene that moves is refused in one sentence by what would show it still."""
    with pytest.raises(ValueError, match="the scene moves, which AmbientOcclusion cannot render, expected one of Path"):
        gi.render(room(), gi.AmbientOcclusion(), size=(8, 8))


def test_a_still_scene_carries_no_motion():
    """Motion of zero is none; a scene without any keeps no bytes for it, and goes the still path."""
    scene = gi.Scene([square(1.0, (0, 0, 0), motion=(0, 0, 0))], gi.Camera((0, 0, 3), (0, 0, 0)), [gi.Environment(1.0)])
    assert scene.shapes[0].motion is None and not scene.moves
    struct = DeviceScene(scene, gi.Device("cpu")).struct
    assert struct.moving == 0 and struct.motion.size == 0 and struct.tree.node_motion is None


def moments(picture):
    """Mean and variance of the light's place in a picture [pixels], from its first channel."""
    weight = picture[..., 0].astype(np.float64)
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
    total = weight.sum()
    mean = np.array([(weight * x).sum(), (weight * y).sum()]) / total
    return mean, (weight * ((x - mean[0]) ** 2 + (y - mean[1]) ** 2)).sum() / total


def test_a_moving_points_footprint_is_where_the_closed_form_puts_it():
    """A lamp of half a pixel that flies past and away leaves light along the perspective image of its way.

    A point at X + t V is seen at f (X + t V) / (Z + t W), and its square, which faces the camera, covers an area in
    the picture that goes with 1 / depth^2: the share of light left of each column is the integral of that over time.
    """
    size, count = 64, 400
    f = 0.5 * size / np.tan(np.radians(20.0))
    start, way = np.array([-0.9, 0.2, -3.0]), np.array([2.2, 0.3, -2.0])
    half = 0.25 * 3.0 / f
    lamp = square(half, start, gi.Diffuse(0.0), gi.Emissive(1.0), motion=way)
    camera = gi.Camera((0, 0, 0), (0, 0, -1), fov=40)
    picture = gi.render(gi.Scene([lamp], camera), gi.PathTracing(spp=count, max_depth=1), size=(size, size)).image
    column = picture[..., 0].sum(axis=0, dtype=np.float64)
    t = (np.arange(20_000) + 0.5) / 20_000
    p = start + t[:, None] * way
    x = 0.5 * size + f * p[:, 0] / -p[:, 2]
    reach = f * half / -p[:, 2]
    area = (2.0 * reach) ** 2
    # light left of the right edge of each column: the square's part that is there
    edges = np.arange(1, size + 1)
    part = np.clip((edges[:, None] - (x - reach)) / (2.0 * reach), 0.0, 1.0)
    expected = (part * area).mean(axis=1)
    assert column.sum() == pytest.approx(area.mean(), rel=5.0 * np.sqrt(1.0 / (count * area.mean())))
    # a binomial share of the samples that met it; the largest of 64
    sigma = np.sqrt(expected / count)
    assert (np.abs(np.cumsum(column) - expected) < 5.0 * sigma + 1e-3).all()
    y = 0.5 * size - f * p[:, 1] / -p[:, 2]
    assert moments(picture)[0][1] == pytest.approx((y * area).sum() / area.sum(), abs=0.1)
    assert (picture.sum(axis=(0, 2))[: int(x[0]) - 1] == 0.0).all()


@pytest.mark.parametrize(("distance", "focus"), [(2.0, 4.0), (4.0, 4.0), (9.0, 4.0)])
def test_a_points_blur_is_the_circle_of_confusion(distance, focus):
    """A point at depth z is a uniform disc of radius R |1 - f/z| over the size of a pixel in the plane of focus f."""
    size, lens, fov = 96, 0.12, 30.0
    pixel = 2.0 * focus * np.tan(np.radians(fov / 2.0)) / size
    radius = lens * abs(1.0 - focus / distance) / pixel
    half = 0.5 * pixel * distance / focus
    lamp = square(half, (0.01, 0.02, -distance), gi.Diffuse(0.0), gi.Emissive(1.0))
    camera = gi.Camera((0, 0, 0), (0, 0, -1), fov=fov, lens_radius=lens, focus_distance=focus)
    picture = gi.render(gi.Scene([lamp], camera), gi.PathTracing(spp=400, max_depth=1), size=(size, size)).image
    mean, variance = moments(picture)
    # a uniform disc and the uniform square of one pixel's side, each seen through a pixel of side 1
    expected = radius**2 / 2.0 + 1.0 / 6.0 + 1.0 / 6.0
    met = float(picture[..., 0].sum()) * 400
    assert variance == pytest.approx(expected, rel=5.0 / np.sqrt(met), abs=0.01)
    focal = 0.5 * size / np.tan(np.radians(fov / 2.0))
    middle = [48 + focal * 0.01 / distance, 48 - focal * 0.02 / distance]
    np.testing.assert_allclose(mean, middle, atol=5.0 * np.sqrt(variance / met))
    y, x = np.mgrid[:size, :size] + 0.5
    away = np.hypot(x - middle[0], y - middle[1])
    assert (picture[away > radius + 2.0] == 0.0).all()
    assert (picture[away < radius - 2.0] > 0.0).all()


def lens_room():
    scene = room()
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, lens_radius=0.1, focus_distance=3.0))


def test_primary_samples_are_the_path_tracers_paths():
    """Their means are path tracing's picture of the same seed, to rounding; what still pinholes lack is not there."""
    for scene in (lens_room(), gi.scenes.cornell_box()):
        samples = gi.sample(scene, spp=4, size=(20, 12), primary=True, seed=3)
        picture = gi.render(scene, gi.PathTracing(spp=4), size=(20, 12), seed=3).image
        np.testing.assert_allclose(pixel_means(samples, samples.radiance), picture, rtol=1e-5, atol=1e-6)
        for name in ("time", "lens", "hit_motion"):
            assert (getattr(samples, name) is None) == (scene.name == "cornell-box")
        assert samples.origin_motion is None and samples.bandwidth is None
    assert samples.coc == (0.0, 0.0) and (samples.origin == 0.0).all()
    with pytest.raises(ValueError, match="primary goes with neither"):
        gi.sample(scene, primary=True, glossy=True)


def test_primary_samples_lie_on_the_rays_of_a_thin_lens():
    """Lens point, hit and the image of the film position on the focal plane are on one line, and hits on the shapes.

    The circle of confusion at the hit's depth is the distance in pixels, at lens coordinate 1, of the hit from the
    film position, seen from the lens's centre.
    """
    scene = lens_room()
    samples = gi.sample(scene, spp=8, size=(24, 16), primary=True)
    met = samples.checked.is_splat
    assert met.mean() > 0.3
    xy = np.concatenate([samples.image_xy, np.zeros((len(samples), 1)), np.ones((len(samples), 1))], axis=1)[met]
    focal = (xy @ samples.pixel_to_camera.T)[:, :3]
    origin, hit = (a[met].astype(np.float64) for a in (samples.origin, samples.hit))
    np.testing.assert_allclose(origin[:, :2], 0.1 * samples.lens[met], atol=1e-6)
    line = np.cross(focal - origin, hit - origin)
    assert np.abs(line).max() < 1e-4
    # seen from the centre
    depth = -hit[:, 2]
    matrix = samples.pixel_to_camera
    seen = hit * (3.0 / depth)[:, None]
    x, y = (seen[:, 0] - matrix[0, 3]) / matrix[0, 0], (seen[:, 1] - matrix[1, 3]) / matrix[1, 1]
    coc = samples.coc[0] / depth + samples.coc[1]
    lens = samples.lens[met]
    np.testing.assert_allclose(xy[:, 0] - x, coc * lens[:, 0], atol=2e-3)
    np.testing.assert_allclose(y - xy[:, 1], coc * lens[:, 1], atol=2e-3)


def test_samples_move_with_their_shapes():
    """A hit moved back by its time lies in the shape's place at time 0, for points of the lens and for secondary rays.

    The shutter opens for part of the time: samples tell their part of it, and motion over it.
    """
    scene = room()
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, shutter=(0.25, 0.75)))
    right, up, forward = scene.camera.frame()
    quad = scene.shapes[1]
    opened = quad.vertices + 0.25 * quad.motion
    samples = gi.sample(scene, spp=32, size=(24, 16), primary=True)
    met = samples.checked.is_splat & (samples.hit_motion != 0.0).any(axis=1)
    assert samples.time.min() >= 0.0 and samples.time.max() < 1.0 and abs(samples.time.mean() - 0.5) < 0.02
    back = samples.hit[met] - samples.time[met, None] * samples.hit_motion[met]
    points = back @ np.stack([right, up, -forward]) + scene.camera.position
    secondary = gi.sample(scene, spp=8, size=(24, 16))
    state, moved = secondary.checked, (secondary.hit_motion != 0.0).any(axis=1)
    below = secondary.hit - secondary.time[:, None] * secondary.hit_motion
    above = secondary.origin - secondary.time[:, None] * secondary.origin_motion
    moved_origin = state.is_primary & (secondary.origin_motion != 0.0).any(axis=1)
    for places in (points, below[state.is_splat & moved], above[moved_origin]):
        on_quad = np.abs(places[:, 2]) < 0.35  # of the two that move, the lamp is above
        on_quad &= places[:, 1] < 1.3
        assert on_quad.sum() > 20
        # in one of the two triangles of the quad as it was when the shutter opened
        distance = np.full(on_quad.sum(), np.inf)
        for face in quad.faces:
            a, b, c = opened[face]
            n = np.cross(b - a, c - a)
            n /= np.linalg.norm(n)
            p = places[on_quad] - a
            plane = np.abs(p @ n)
            uv = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), p.T, rcond=None)[0]
            inside = (uv > -1e-4).all(axis=0) & (uv.sum(axis=0) < 1.0 + 1e-4)
            distance = np.where(inside, np.minimum(distance, plane), distance)
        assert distance.max() < 1e-5


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ((1.0, 2.0), "shape motion has shape"),
        (np.zeros((3, 3)), "shape motion has shape"),
        ((np.nan, 0.0, 0.0), "shape motion holds 1 values that are NaN"),
        ("fast", "shape motion is str"),
    ],
)
def test_wrong_motion_is_refused(motion, message):
    """Motion is one vector, or one for each vertex, and finite."""
    with pytest.raises((TypeError, ValueError), match=message):
        square(1.0, (0, 0, 0), motion=motion)


@pytest.mark.parametrize("shutter", [(0.5, 0.2), (-0.1, 1.0), (0.0, 1.1), (0.0,), (0.0, np.nan)])
def test_wrong_shutter_is_refused(shutter):
    """A shutter is two ascending times in [0, 1]."""
    with pytest.raises(ValueError, match="camera shutter"):
        gi.Camera((0, 0, 0), (0, 0, 1), shutter=shutter)
