"""Light sampling: lights are picked by their power, and a sample's weight is unbiased for every kind of light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import warp as wp

from warpgi.camera import Camera
from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels import scene as scene_kernels
from warpgi.kernels.lights import light_probability, pick_light, sample_light
from warpgi.lights import DistantLight, Light, PointLight, SpotLight
from warpgi.materials import Emissive
from warpgi.scene import Scene, Shape

wp.set_module_options({"enable_backward": False})

LEVEL = 1e-4
COUNT = 400_000
# A two-sided test of a mean at 1e-5: a dozen of them in this file.
SIGMAS = 4.5
ULP = 2.0**-24


@wp.kernel
def pick(scene: scene_kernels.Scene, choice: wp.array[float], index: wp.array[int], share: wp.array[float]):
    i = wp.tid()
    index[i] = pick_light(scene, choice[i])
    share[i] = light_probability(scene, index[i])


@wp.kernel
def sample_lights(
    scene: scene_kernels.Scene,
    p: wp.vec3,
    u: wp.array[wp.vec2],
    choice: wp.array[float],
    wi: wp.array[wp.vec3],
    weight: wp.array[wp.vec3],
    target: wp.array[wp.vec3],
    pdf: wp.array[float],
):
    i = wp.tid()
    s = sample_light(scene, p, u[i], choice[i])
    wi[i] = s.wi
    weight[i] = s.weight
    target[i] = s.target
    pdf[i] = s.pdf


# A rectangle that faces down, and one askew; corners in order, counter-clockwise from the side that shines.
CEILING = np.array([(-1.0, 2.0, -0.5), (1.0, 2.0, -0.5), (1.0, 2.0, 0.5), (-1.0, 2.0, 0.5)])
PANEL = np.array([(2.0, 0.5, -1.0), (2.5, 0.5, 0.5), (2.5, 1.5, 0.5), (2.0, 1.5, -1.0)])
QUAD = [(0, 1, 2), (0, 2, 3)]
RADIANCE = (3.0, 1.0, 2.0)
POINT = PointLight(position=(-0.5, 1.2, 0.8), intensity=(1.0, 2.0, 0.5))
SPOT = SpotLight(position=(1.0, 3.0, 0.3), direction=(-0.2, -1.0, 0.1), intensity=6.0, inner_angle=0.2, outer_angle=0.7)
SUN = DistantLight(direction=(0.3, -1.0, 0.4), irradiance=(0.2, 0.3, 0.1))
FLOOR = Shape([(-3, -0.5, -3), (3, -0.5, 3), (3, -0.5, -3), (-3, -0.5, 3)], [(0, 1, 2), (0, 3, 1)])


def emitter(corners: np.ndarray, two_sided: bool = False, radiance=RADIANCE, faces=QUAD) -> Shape:
    return Shape(corners, faces, emission=Emissive(radiance, two_sided=two_sided))


def device_scene(shapes: Sequence[Shape] = (), lights: Sequence[Light] = ()) -> DeviceScene:
    camera = Camera(position=(0, 1, 5), target=(0, 1, 0))
    return DeviceScene(Scene([FLOOR, *shapes], camera, lights), Device("cpu"))


def sample(scene: DeviceScene, p: Sequence[float], count: int = COUNT):
    """wi, weight, target (N, 3) and pdf (N,), float64; targets in world coordinates."""
    u = np.random.default_rng(1).random((count, 3), dtype=np.float32)
    out = [wp.zeros(count, dtype=wp.vec3, device="cpu") for _ in range(3)]
    pdf = wp.zeros(count, dtype=float, device="cpu")
    inputs = [scene.struct, wp.vec3(*(np.asarray(p) - scene.centre))]
    inputs.append(wp.array(np.ascontiguousarray(u[:, :2]), dtype=wp.vec2, device="cpu"))
    inputs.append(wp.array(np.ascontiguousarray(u[:, 2]), dtype=float, device="cpu"))
    wp.launch(sample_lights, count, inputs=inputs, outputs=[*out, pdf], device="cpu")
    wi, weight, target = (x.numpy().astype(np.float64) for x in out)
    assert np.isfinite(weight).all()
    return wi, weight, target + scene.centre, pdf.numpy().astype(np.float64)


def irradiance(scene: DeviceScene, p: Sequence[float], n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance at p, shape (3,), and its standard error."""
    wi, weight, _, _ = sample(scene, p)
    values = weight * np.maximum(wi @ n, 0.0)[:, None]
    return values.mean(axis=0), values.std(axis=0) / np.sqrt(COUNT)


def unit(v) -> np.ndarray:
    return np.asarray(v, np.float64) / np.linalg.norm(v)


def polygon_irradiance(corners: np.ndarray, p: Sequence[float], n: np.ndarray) -> float:
    """Irradiance from a polygon of radiance 1 above the horizon (Lambert 1760): 1/2 sum of angle times cosine."""
    v = corners - np.asarray(p)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(v, np.roll(v, -1, axis=0), strict=True):
        cross = np.cross(a, b)
        angle = np.arctan2(np.linalg.norm(cross), a @ b)
        total += 0.5 * angle * (cross @ n) / np.linalg.norm(cross)
    return abs(total)


def solid_angle(corners: np.ndarray, p: Sequence[float]) -> float:
    """Of a quadrilateral, as two triangles (Van Oosterom, Strackee 1983)."""
    total = 0.0
    for face in QUAD:
        a, b, c = (unit(corners[i] - np.asarray(p)) for i in face)
        total += 2.0 * np.arctan2(abs(a @ np.cross(b, c)), 1.0 + a @ b + b @ c + c @ a)
    return total


def cone(light: SpotLight, cos: np.ndarray) -> np.ndarray:
    """Share of the axis's intensity at an angle, by KHR_lights_punctual."""
    inner, outer = np.cos(light.inner_angle), np.cos(light.outer_angle)
    return np.clip((cos - outer) / (inner - outer), 0.0, 1.0) ** 2


UP = np.array([0.0, 1.0, 0.0])
HERE = (0.3, 0.0, -0.4)


def test_lights_are_picked_by_their_power(chi_square):
    """Every triangle and light is picked in proportion to the power that it sends out.

    pi L A for a triangle, twice that if two-sided, 4 pi I for a point, the integral of its intensity for a spot, and
    E pi r^2 for parallel light on a scene of radius r.
    """
    slim = np.array([(0.0, 1.0, 0.0), (0.3, 1.0, 0.0), (0.0, 1.1, 0.0)])
    shapes = [emitter(CEILING), emitter(PANEL, two_sided=True), emitter(slim, faces=[(0, 1, 2)])]
    scene = device_scene(shapes, [POINT, SPOT, SUN])
    mean = np.mean(RADIANCE)
    powers = [np.pi * mean * area * (1 + shape.emission.two_sided) for shape in shapes for area in shape.areas()]
    powers.append(4.0 * np.pi * np.mean(POINT.intensity))
    cos = (np.arange(100_000) + 0.5) / 100_000
    powers.append(2.0 * np.pi * np.mean(SPOT.intensity) * cone(SPOT, cos).mean())
    low, high = scene.scene.bounds()
    powers.append(np.mean(SUN.irradiance) * np.pi * np.square(0.5 * (high - low)).sum())
    expected = np.array(powers) / np.sum(powers)

    choice = wp.array(np.random.default_rng(2).random(COUNT, dtype=np.float32), dtype=float, device="cpu")
    index = wp.zeros(COUNT, dtype=int, device="cpu")
    share = wp.zeros(COUNT, dtype=float, device="cpu")
    wp.launch(pick, COUNT, inputs=[scene.struct, choice], outputs=[index, share], device="cpu")
    counts = np.bincount(index.numpy(), minlength=len(expected))
    # the kernel's own shares first: they say which light is off
    shares = np.array([share.numpy()[index.numpy() == i][0] for i in range(len(expected))])
    assert chi_square(counts, shares.astype(np.float64) * COUNT) > LEVEL
    assert shares == pytest.approx(expected, abs=4 * ULP)
    assert chi_square(counts, expected * COUNT) > LEVEL


def test_every_choice_picks_a_light():
    """The smallest and the largest number below 1 pick the first and the last light that has power."""
    dark = emitter(PANEL, radiance=0.0)
    scene = device_scene([dark, emitter(CEILING)], [PointLight((0, 1, 0), 0.0), POINT])
    assert scene.struct.light_count == 3
    choice = wp.array(np.float32([0.0, 1.0 - 2.0**-24]), dtype=float, device="cpu")
    index, share = wp.zeros(2, dtype=int, device="cpu"), wp.zeros(2, dtype=float, device="cpu")
    wp.launch(pick, 2, inputs=[scene.struct, choice], outputs=[index, share], device="cpu")
    assert index.numpy().tolist() == [0, 2]
    assert (share.numpy() > 0.0).all()


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("corners", [CEILING, PANEL], ids=["ceiling", "panel"])
def test_irradiance_of_a_rectangle(corners, two_sided):
    """The mean of weight times cosine is Lambert's polygon formula, and the mean of 1/pdf the light's solid angle."""
    scene = device_scene([emitter(corners, two_sided)])
    n = unit((0.5, 1.0, 0.1))
    mean, error = irradiance(scene, HERE, n)
    expected = polygon_irradiance(corners, HERE, n) * np.array(RADIANCE)
    assert (np.abs(mean - expected) < SIGMAS * error + 32 * ULP * expected).all()
    assert (error < 0.01 * expected).all()
    pdf = sample(scene, HERE)[3]
    assert (pdf > 0.0).all()
    error = (1.0 / pdf).std() / np.sqrt(COUNT)
    assert abs((1.0 / pdf).mean() - solid_angle(corners, HERE)) < SIGMAS * error + 1e-6


def test_pdf_is_per_solid_angle():
    """pdf is the area density times distance^2 over the light's cosine, the target lies where wi points.

    The density is the light's share of the power over its area; the target is off the surface on p's side.
    """
    scene = device_scene([emitter(CEILING), emitter(PANEL, two_sided=True)], [POINT])
    wi, weight, target, pdf = sample(scene, HERE)
    p = np.asarray(HERE)
    powers = [2.0, 2.0 * np.linalg.norm([0.5, 0.0, 1.5])]  # areas, the second seen from both sides
    total = np.pi * np.mean(RADIANCE) * sum(powers) + 4.0 * np.pi * np.mean(POINT.intensity)
    seen = 0
    for corners, sides in ((CEILING, 1), (PANEL, 2)):
        n = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
        distance = ((corners[0] - p) @ n) / (wi @ n)
        q = p + wi * distance[:, None]
        mine = (pdf > 0.0) & (np.linalg.norm(q - target, axis=1) < 1e-3)
        assert mine.sum() > 1000
        seen += mine.sum()
        density = sides * np.pi * np.mean(RADIANCE) / total
        expected = density * distance**2 / np.abs(wi @ n)
        # positions are float32 within a scene of size 6, distances here are 1 to 3
        assert np.abs(pdf / expected - 1.0)[mine].max() < 64 * ULP
        assert np.abs(weight * expected[:, None] / np.array(RADIANCE) - 1.0)[mine].max() < 64 * ULP
        away = ((target - corners[0]) @ n) * np.sign((p - corners[0]) @ n)
        assert (away[mine] > 0.0).all()
        assert away[mine].max() < 1e-4
    assert seen == (pdf > 0.0).sum()


def test_the_back_of_a_one_sided_light_is_dark():
    """Behind a one-sided light the weight is 0; a two-sided one shines on both sides alike."""
    above = HERE * np.array([1.0, 0.0, 1.0]) + [0.0, 4.0, 0.0]
    down = np.array([0.0, -1.0, 0.0])
    assert not sample(device_scene([emitter(CEILING)]), above, 1000)[1].any()
    scene = device_scene([emitter(CEILING, two_sided=True)])
    mean, error = irradiance(scene, above, down)
    expected = polygon_irradiance(CEILING, above, down) * np.array(RADIANCE)
    assert (np.abs(mean - expected) < SIGMAS * error + 32 * ULP * expected).all()
    # CEILING winds so that its normal points down
    assert np.cross(CEILING[1] - CEILING[0], CEILING[2] - CEILING[0])[1] < 0.0


def test_a_light_seen_from_its_own_plane_is_dark():
    """At a point of a light itself, or beside it in its plane, no weight is infinite or NaN."""
    for two_sided in (False, True):
        scene = device_scene([emitter(CEILING, two_sided)])
        for p in ((0.0, 2.0, 0.0), (3.0, 2.0, 0.0), tuple(CEILING[0])):
            wi, weight, _, _ = sample(scene, p, 1000)
            values = weight * np.abs(wi @ UP)[:, None]
            assert np.isfinite(values).all()


def test_point_light():
    """Irradiance of a point light is I cos / d^2, the same for every sample."""
    to_light = np.array(POINT.position) - HERE
    mean, error = irradiance(device_scene(lights=[POINT]), HERE, UP)
    expected = np.array(POINT.intensity) * to_light[1] / np.linalg.norm(to_light) ** 3
    assert mean == pytest.approx(expected, rel=32 * ULP)
    assert (error < 1e-8).all()


@pytest.mark.parametrize("angle", [0.0, 0.19, 0.21, 0.45, 0.69, 0.71, 1.2, 3.0])
def test_spot_light(angle):
    """Inside the inner cone a spot is a point light, outside the outer one dark, between them as glTF has it."""
    axis = unit(SPOT.direction)
    across = unit(np.cross(axis, [0.0, 0.0, 1.0]))
    p = np.array(SPOT.position) + 1.7 * (np.cos(angle) * axis + np.sin(angle) * across)
    wi, weight, target, pdf = sample(device_scene(lights=[SPOT]), p, 100)
    expected = 6.0 / 1.7**2 * cone(SPOT, np.cos(angle))
    # a cosine's rounding is divided by cos(inner) - cos(outer) = 0.215
    assert weight == pytest.approx(expected, abs=6.0 / 1.7**2 * 64 * ULP / 0.215)
    assert np.abs(wi - unit(np.array(SPOT.position) - p)).max() < 32 * ULP
    assert np.abs(target - SPOT.position).max() < 32 * ULP
    assert (pdf == 0.0).all()


def test_distant_light():
    """Parallel light gives E cos everywhere, from against its direction."""
    for p in (HERE, (100.0, 30.0, -20.0)):
        mean, _ = irradiance(device_scene(lights=[SUN]), p, UP)
        assert mean == pytest.approx(-unit(SUN.direction)[1] * np.array(SUN.irradiance), rel=32 * ULP)


def test_all_lights_together():
    """With every kind of light in one scene the mean is the sum of what each gives alone."""
    scene = device_scene([emitter(CEILING), emitter(PANEL, two_sided=True)], [POINT, SPOT, SUN])
    n = unit((0.5, 1.0, 0.1))
    mean, error = irradiance(scene, HERE, n)
    expected = sum(polygon_irradiance(c, HERE, n) for c in (CEILING, PANEL)) * np.array(RADIANCE)
    for light in (POINT, SPOT):
        v = np.array(light.position) - HERE
        cos = -unit(v) @ unit(light.direction) if light is SPOT else 1.0
        share = cone(light, cos) if light is SPOT else 1.0
        expected = expected + np.array(light.intensity) * share * max(unit(v) @ n, 0.0) / (v @ v)
    expected = expected + np.array(SUN.irradiance) * -(unit(SUN.direction) @ n)
    assert (np.abs(mean - expected) < SIGMAS * error + 32 * ULP * expected).all()


def test_a_weak_light_beside_a_strong_one_is_kept():
    """A lamp with a billionth of the sun's power lights what is near it, so it has to be picked at times.

    A running sum in float32 would round its share to 0, and its light would be missing from the picture.
    """
    lamp = PointLight(position=(0.0, 0.5, 0.0), intensity=1e-2)
    sun = DistantLight(direction=(0.0, -1.0, 0.0), irradiance=1e6)
    scene = device_scene(lights=[lamp, sun, PointLight(position=(1.0, 0.5, 0.0), intensity=1e-2)])
    cdf = scene.struct.light_cdf.numpy().astype(np.float64)
    assert (np.diff(cdf, prepend=0.0) > 0.0).all()
