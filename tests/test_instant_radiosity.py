"""Instant radiosity against closed forms, brute force and path tracing: one light, many, and what clamping takes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from scipy.stats import t as student

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.filtering import FilterInput
from warpgi.interleaving import join, make_interleaving
from warpgi.job import Job
from warpgi.kernels.instant_radiosity import View, follow
from warpgi.kernels.rng import INDEPENDENT, make_sampler, sample_2d
from warpgi.kernels.sampling import square_to_triangle
from warpgi.kernels.scene import Scene
from warpgi.kernels.vpls import Joining, Vpls
from warpgi.methods.instant_radiosity import Lighting

wp.set_module_options({"enable_backward": False})

NEAR = gi.NearLight
FLOOR = ([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)], [(0, 1, 2), (0, 2, 3)])


def lighting_of(scene, method, seed=0, size=(8, 8)):
    device = gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    lighting = Lighting(method, Job(on_device, on_device.camera(size), size, seed, device))
    lighting.use(0)
    return lighting


def t_limit(values, tests=1):
    """What Student's t of a mean of so many values exceeds as often as a normal variable does Z_LIMIT."""
    return student.isf(1e-5 / 2.0 / tests, len(values) - 1)


def mean_t(values, expected, tests=1):
    """Largest distance of the means over the first axis from `expected`, over what chance allows."""
    values = np.asarray(values, dtype=np.float64)
    error = values.std(axis=0, ddof=1) / math.sqrt(len(values))
    return np.abs((values.mean(axis=0) - expected) / error).max() / t_limit(values, tests)


def blocks(image, size=8):
    height, width = image.shape[:2]
    return image.astype(np.float64).reshape(height // size, size, width // size, size, 3).mean(axis=(1, 3))


def one_light(**settings):
    """A wall that sees one light: the spot of a narrow beam on the floor, half hidden by a small board."""
    floor = gi.Shape(*FLOOR, gi.Diffuse((0.8, 0.4, 0.2)), name="floor")
    wall = gi.Shape([(-1, 0, -1), (1, 0, -1), (1, 2, -1), (-1, 2, -1)], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5))
    board = gi.Shape([(0.1, 0.1, -0.5), (2, 0.1, -0.5), (2, 0.5, -0.5), (0.1, 0.5, -0.5)], [(0, 1, 2), (0, 2, 3)])
    light = gi.SpotLight((0, 1, 0), (0, -1, 0), 3.0, 0.02, 0.03)
    flux = 3.0 * 2.0 * math.pi * (1.0 - (2.0 * math.cos(0.02) + math.cos(0.03)) / 3.0)
    scene = gi.Scene([floor, wall, board], gi.Camera((0, 1, 2.0), (0, 1, -1), fov=40.0), [light])
    return scene, flux


def test_one_light_has_its_closed_form_and_a_hard_shadow():
    """On a wall: flux x albedos / pi^2 x cosines / distance^2 where the light is seen, exactly 0 where it is not."""
    scene, flux = one_light()
    method = gi.InstantRadiosity(paths=1, spp=1, near_light=NEAR.UNBOUNDED)
    seeds = [s for s in range(20) if len(lighting_of(scene, method, s).vpls.target) == 1]
    render = gi.render(scene, method, (48, 48), seed=seeds[0], device="cpu")
    lighting = lighting_of(scene, method, seeds[0])
    light = lighting.vpls.target.numpy()[0].astype(np.float64) + lighting.job.scene.centre
    assert np.linalg.norm(light) < 0.03
    x = render.layers["position"].astype(np.float64)
    on_wall = (render.layers["normal"][..., 2] > 0.9) & (x[..., 2] < -0.99)
    d = x - light
    distance2 = np.square(d).sum(axis=-1)
    expected = flux * 0.5 * np.array((0.8, 0.4, 0.2)) / math.pi**2
    expected = expected * (d[..., 1] * -d[..., 2] / distance2**2)[..., None]
    # where the line to the light crosses the board's plane
    across = light + d * ((-0.5 - light[2]) / d[..., 2])[..., None]
    inside = np.minimum.reduce([across[..., 0] - 0.1, across[..., 1] - 0.1, 0.5 - across[..., 1]])
    lit, dark = on_wall & (inside < -1e-4), on_wall & (inside > 1e-4)
    assert lit.sum() > 300
    assert dark.sum() > 100
    # a narrow cone's solid angle loses digits in float32: 1 - cos(0.03) = 4.5e-4, of which 6e-8 is 1.3e-4
    np.testing.assert_allclose(render.layers["indirect"][lit], expected[lit], rtol=1e-3)
    assert not render.layers["indirect"][dark].any()


def test_many_lights_add_up():
    """In a convex room the picture is the sum over all lights, as numpy adds it up in float64."""
    scene, _ = gi.scenes.room(albedo=(0.3, 0.5, 0.7))
    method = gi.InstantRadiosity(paths=50, spp=1, near_light=NEAR.CLAMPED, near_distance=0.5)
    render = gi.render(scene, method, (16, 16), device="cpu")
    lighting = lighting_of(scene, method)
    fields = ("target", "normal", "intensity")
    y, ny, intensity = (getattr(lighting.vpls, name).numpy().astype(np.float64) for name in fields)
    x = render.layers["position"].reshape(-1, 1, 3) - lighting.job.scene.centre
    nx = render.layers["normal"].reshape(-1, 1, 3).astype(np.float64)
    d = y - x
    distance2 = np.square(d).sum(axis=2)
    cosines = np.maximum((d * nx).sum(axis=2), 0.0) * np.maximum(-(d * ny).sum(axis=2), 0.0)
    geometry = np.minimum(cosines / distance2**2, 1.0 / 0.5**2)
    expected = np.array((0.3, 0.5, 0.7)) / math.pi * (geometry @ intensity)
    np.testing.assert_allclose(render.layers["indirect"].reshape(-1, 3), expected, rtol=1e-4)
    assert render.counts["vpls"] == len(y)
    # of each light the flux: albedo x flux / pi; mean albedo 0.5 doubles the lamp's
    assert intensity.sum(axis=0)[1] * math.pi / 0.5 == pytest.approx(10000.0 / (1.0 - 0.5), rel=0.3)


def lost_to_clamping(origin, direction, near, rays=20_000):
    """Share of even light from all around that clamping takes, where camera rays meet a cube of side 2."""
    rng = np.random.default_rng(0)
    with np.errstate(divide="ignore"):
        t = np.where(direction > 0, (1.0 - origin) / direction, (-1.0 - origin) / direction).min(axis=1)
    x = origin + t[:, None] * direction
    axis = np.abs(x).argmax(axis=1)
    rows = np.arange(len(x))
    pick = rng.integers(len(x), size=rays)
    x, axis = x[pick], axis[pick]
    rows = np.arange(rays)
    inward = -np.sign(x[rows, axis])
    r, phi = np.sqrt(rng.random(rays)), 2.0 * math.pi * rng.random(rays)
    d = np.empty((rays, 3))
    cos = np.sqrt(1.0 - r * r)
    d[rows, axis] = cos * inward
    d[rows, (axis + 1) % 3], d[rows, (axis + 2) % 3] = r * np.cos(phi), r * np.sin(phi)
    x[rows, axis] *= 1.0 - 1e-12
    t = np.where(d > 0, (1.0 - x) / d, (-1.0 - x) / d)
    hit = t.argmin(axis=1)
    t = t[rows, hit]
    geometry = cos * np.abs(d[rows, hit]) / t**2
    lost = np.maximum(1.0 - near**-2 / geometry, 0.0)
    return lost.mean(), lost.std() / math.sqrt(rays)


def test_furnace():
    """In a furnace the reflected light is E a / (1 - a) with compensation, and less by what the bound takes without.

    At a point clamping takes the mean of max(0, 1 - bound / G) over cosine-weighted directions, counted here by rays of
    numpy's in a cube.
    """
    albedo, near, size = 0.5, 0.4, (16, 16)
    scene, expected = gi.scenes.furnace(albedo=albedo)
    reflected = expected.radiance[0] - 1.0
    whole = albedo * reflected
    method = gi.InstantRadiosity(paths=40, spp=2, near_distance=near, sampler=gi.Sampler.INDEPENDENT)
    means = {
        kind: [
            gi.render(scene, dataclasses.replace(method, near_light=kind), size, seed, "cpu").layers["indirect"].mean()
            for seed in range(24)
        ]
        for kind in (NEAR.CLAMPED, NEAR.COMPENSATED, NEAR.UNBOUNDED)
    }
    assert mean_t(means[NEAR.COMPENSATED], whole) < 1.0
    assert mean_t(means[NEAR.UNBOUNDED], whole) < 1.0
    camera = scene.camera
    right, up, forward = camera.frame()
    grid = (np.arange(64) + 0.5) / 32.0 - 1.0
    tan = math.tan(math.radians(camera.fov) / 2.0)
    sx, sy = (g.reshape(-1, 1) * tan for g in np.meshgrid(grid, grid))
    lost, error = lost_to_clamping(np.asarray(camera.position), forward + right * sx + up * sy, near)
    assert lost > 0.05  # or nothing is shown
    # numpy's rays know the loss to a few parts in a thousand, as the renders do
    apart = abs(np.mean(means[NEAR.CLAMPED]) - whole * (1.0 - lost))
    renders = np.std(means[NEAR.CLAMPED], ddof=1) / math.sqrt(24)
    assert apart < t_limit(means[NEAR.CLAMPED]) * math.hypot(renders, whole * error)
    assert np.mean(means[NEAR.CLAMPED]) < np.mean(means[NEAR.COMPENSATED])


@wp.kernel
def see_surface(
    offset: int,
    scene: Scene,
    vpls: Vpls,
    joining: Joining,
    view: View,
    height: float,
    cdf: wp.array[float],
    result: wp.array[wp.vec3],
):
    """Indirect radiance of a uniform point of the surface, seen from `height` above it."""
    i = offset + wp.tid()
    sampler = make_sampler(view.seed, i, 0, INDEPENDENT)
    face = wp.lower_bound(cdf, sample_2d(sampler, 1000)[0])
    bary = square_to_triangle(sample_2d(sampler, 1001))
    p = wp.vec3(0.0)
    for corner in range(3):
        p = p + scene.points[scene.indices[3 * face + corner]] * bary[corner]
    n = scene.face_normals[face]
    path = follow(scene, vpls, joining, view, 0, 1, i, 0, sampler, p + n * height, -n)
    result[i] = path.indirect


@pytest.mark.parametrize("near", [NEAR.COMPENSATED, NEAR.UNBOUNDED])
def test_room(near):
    """The mean indirect irradiance of a closed room is flux a / (area (1 - a)): CIE 171:2006 test 5.8, 104.2 lx."""
    scene, expected = gi.scenes.room(albedo=0.5, flux=10000.0)
    areas = scene.shapes[0].areas()
    cdf = (np.cumsum(areas) / areas.sum()).astype(np.float32)
    method = gi.InstantRadiosity(paths=64, near_light=near)
    means = []
    for seed in range(32):
        lighting = lighting_of(scene, method, seed)
        device = lighting.job.device
        result = device.zeros(500, wp.vec3)
        inputs = [lighting.job.scene.struct, lighting.vpls, lighting.joining, lighting.view]
        device.launch(see_surface, 500, [*inputs, 0.01, device.array(cdf, float)], [result])
        means.append(math.pi / 0.5 * result.numpy()[:, 0].mean(dtype=np.float64))
    assert mean_t(means, expected.indirect_irradiance[0]) < 1.0
    assert np.std(means) / math.sqrt(len(means)) < 0.02 * expected.indirect_irradiance[0]


def open_air():
    """Metal, glass, sun and sky."""
    scene = gi.scenes.caustic(lamp_radius=0.3, roughness=0.2)
    return dataclasses.replace(scene, lights=[gi.Environment((0.2, 0.3, 0.5)), gi.DistantLight((1, -2, -1), 2.0)])


def coated(roughness):
    """The Cornell box with blocks and walls of plastic."""
    box = gi.scenes.cornell_box()
    plastic = gi.Coated((0.2, 0.4, 0.7), roughness=roughness)
    shapes = [s if s.emission is not None else dataclasses.replace(s, material=plastic) for s in box.shapes]
    return dataclasses.replace(box, shapes=shapes)


@pytest.mark.parametrize(
    ("scene", "settings"),
    [
        (gi.scenes.cornell_box, {"near_light": NEAR.UNBOUNDED}),
        (gi.scenes.cornell_box, {}),
        (gi.scenes.cornell_spheres, {}),
        (open_air, {}),
        (open_air, {"min_roughness": 0.5, "near_light": NEAR.UNBOUNDED}),
        (lambda: coated(0.3), {}),
        (lambda: coated(0.03), {}),
    ],
    ids=["unbounded", "compensated", "mirror and glass", "metal", "metal by rays", "plastic", "smooth plastic"],
)
def test_agrees_with_path_tracing(scene, settings):
    """Unclamped or compensated, sets of lights converge to the path tracer's picture, whatever reflects."""
    size, spp, sets = (16, 16), 512, 16
    scene = scene()
    reference = gi.render(scene, gi.PathTracing(spp=spp, sampler=gi.Sampler.INDEPENDENT), size, seed=77, device="cpu")
    method = gi.InstantRadiosity(paths=100, spp=4, set_spp=1, sampler=gi.Sampler.INDEPENDENT, **settings)
    renders = [gi.render(scene, method, size, seed, "cpu") for seed in range(sets)]
    for layer in ("indirect", "direct"):
        found = np.array([blocks(render.layers[layer]) for render in renders])
        expected = blocks(reference.layers[layer])
        variance = found.var(axis=0, ddof=1) / sets + blocks(reference.layers["variance"]) / 64.0
        t = np.abs(found.mean(axis=0) - expected) / np.sqrt(variance)
        assert t.max() < t_limit(found, t.size), layer
    means = np.array([render.layers["indirect"].mean(dtype=np.float64) for render in renders])
    squares = means.var(ddof=1) / sets + reference.layers["variance"].mean() / (size[0] * size[1])
    apart = abs(means.mean() - reference.layers["indirect"].mean(dtype=np.float64))
    assert apart < t_limit(means) * math.sqrt(squares)


def test_shading_normals_count_as_for_paths():
    """Interpolated normals at both ends of a connection weigh light as they do along paths."""
    faces = [(0, 2, 1), (0, 3, 2)]
    tilted, aside = (np.tile(n, (4, 1)) for n in ((-0.5, 1.0, 0.0), (-1.0, 0.0, 0.7)))
    floor = gi.Shape([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], faces, gi.Diffuse(0.8), normals=tilted)
    wall = gi.Shape([(1, 0, -1), (1, 2, -1), (1, 2, 1), (1, 0, 1)], faces, gi.Diffuse(0.8), normals=aside)
    scene = gi.Scene(
        [floor, wall], gi.Camera((-3, 1, 0), (1, 1, 0), fov=22.0), [gi.DistantLight((0.5, -1.0, 0.2), 1.0)]
    )
    method = gi.PathTracing(spp=1024, sampler=gi.Sampler.INDEPENDENT)
    expected = gi.render(scene, method, (16, 16), device="cpu").layers["indirect"].mean(dtype=np.float64)
    method = gi.InstantRadiosity(paths=500, spp=4)
    means = [gi.render(scene, method, (16, 16), seed, "cpu").layers["indirect"].mean() for seed in range(16)]
    # 2.6e5 paths know it to 0.5 %
    error = math.hypot(np.std(means, ddof=1) / 4.0, 0.005 * expected)
    assert abs(np.mean(means) - expected) < t_limit(means) * error < 0.1 * expected


def test_no_spike_is_left():
    """A pixel that clamping, compensation or spheres leave beyond the truth is a fraction of an unbounded spike."""
    scene, size = gi.scenes.cornell_box(), (32, 32)
    truth = gi.render(scene, gi.PathTracing(spp=1024), size, seed=9, device="cpu").layers["indirect"]
    excess, energy = {}, {}
    for kind in NEAR:
        method = gi.InstantRadiosity(paths=64, spp=2, near_light=kind)
        pictures = [gi.render(scene, method, size, seed, "cpu").layers["indirect"] for seed in range(6)]
        excess[kind] = max(float((picture - truth).max()) for picture in pictures) / truth.mean()
        energy[kind] = np.mean(pictures, dtype=np.float64) / truth.mean(dtype=np.float64)
    for kind in (NEAR.CLAMPED, NEAR.COMPENSATED, NEAR.SPHERICAL):
        assert excess[kind] < 0.4 * excess[NEAR.UNBOUNDED]
    assert energy[NEAR.CLAMPED] < energy[NEAR.COMPENSATED]


def test_clamped_light_of_one_vpl_is_bounded():
    """No light gives a diffuse receiver more than its intensity x bound x albedo / pi."""
    scene, _ = gi.scenes.room(albedo=0.5)
    near = 0.5
    method = gi.InstantRadiosity(paths=20, spp=1, near_light=NEAR.CLAMPED, near_distance=near)
    most = lighting_of(scene, method).vpls.intensity.numpy().max(axis=1).sum() * near**-2 * 0.5 / math.pi
    clamped = gi.render(scene, method, (32, 32), device="cpu").layers["indirect"]
    unbounded = dataclasses.replace(method, near_light=NEAR.UNBOUNDED)
    assert clamped.max() <= most
    assert gi.render(scene, unbounded, (32, 32), device="cpu").layers["indirect"].max() > clamped.max()


def test_shadow_maps_agree_with_shadow_rays():
    """The pictures differ by a texel's width along shadows: half as much with twice as many texels a side."""
    scene, size = gi.scenes.cornell_box(), (32, 32)
    method = gi.InstantRadiosity(paths=32, spp=1, near_light=NEAR.CLAMPED)
    rays = gi.render(scene, method, size, device="cpu")
    exact = rays.layers["indirect"].astype(np.float64)
    differs = []
    for side in (32, 64, 128):
        mapped = gi.render(scene, dataclasses.replace(method, shadow_map=side), size, device="cpu")
        differs.append(np.abs(mapped.layers["indirect"] - exact).mean() / exact.mean())
        # only rays to lamps are left
        assert mapped.counts["shadow_rays"] < 0.1 * rays.counts["shadow_rays"]
    # shadows of some ten edges, a texel wide of 128 and in one of two of the lights
    assert differs[2] < 10.0 / 128.0 / 2.0
    assert differs[2] < 0.7 * differs[1] < 0.7 * 0.7 * differs[0]


def test_shadow_maps_do_not_shadow_flat_walls():
    """Between floor and ceiling lights see all that faces them: pixels are those of shadow rays at any resolution.

    Where walls meet, a texel that sees the one wall hides a strip as wide of the other.
    """
    ceiling = gi.Shape([(x, 1.0, z) for x, _, z in FLOOR[0]], [f[::-1] for f in FLOOR[1]], gi.Diffuse(0.5))
    shapes = [gi.Shape(*FLOOR, gi.Diffuse(0.5)), ceiling]
    scene = gi.Scene(shapes, gi.Camera((0, 0.6, 2.5), (0, 0.5, 0)), [gi.PointLight((0.0, 0.5, 0.0), 1.0)])
    method = gi.InstantRadiosity(paths=32, spp=1, near_light=NEAR.CLAMPED)
    exact, coarse = (
        gi.render(scene, dataclasses.replace(method, shadow_map=side), (32, 32), device="cpu").layers["indirect"]
        for side in (0, 16)
    )
    np.testing.assert_allclose(coarse, exact, rtol=1e-6)


def test_shadow_maps_that_do_not_fit_are_refused():
    """Maps beyond the memory limit are named before they are made."""
    device = gi.Device("cpu", memory_limit=100_000_000)
    with pytest.raises(ValueError, match=r"(memory_limit|shadow_map) is"):
        gi.render(gi.scenes.cornell_box(), gi.InstantRadiosity(shadow_map=4096), (8, 8), device=device)


def joined_of(value, normal, position, side=4):
    """What the filter makes of pixels' values, albedo 1, all known."""
    height, width = value.shape[:2]
    n = height * width
    device = gi.Device("cpu")
    job = Job(None, None, (width, height), 0, device)
    flat = {"value": value, "known": np.ones_like(value), "albedo": np.ones_like(value), "rest": np.zeros_like(value)}
    flat |= {"normal": normal, "position": position}
    rows = {name: np.broadcast_to(a, value.shape).reshape(n, 3).astype(np.float32) for name, a in flat.items()}
    return join(FilterInput(width, height, np.arange(n), **rows), make_interleaving(side, job), job)


def slanted(height, width):
    """Grid of pixels, and their positions on a plane seen at a slant, whose normal is the z axis."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    return y, x, np.stack([x, 3.0 * y + 0.5 * x, np.ones_like(x)], axis=-1)


@pytest.mark.parametrize("side", [2, 3, 4])
def test_interleaved_light_of_a_plane_is_the_mean_of_its_subsets(side):
    """Each subset's light, linear over a plane, is exact inside; constant, up to the picture's border."""
    y, x, position = slanted(19, 23)
    rng = np.random.default_rng(0)
    base, slope = rng.random((side, side, 3)), 0.1 * rng.random((2, side, side, 3))
    phase = y.astype(int) % side, x.astype(int) % side
    even = joined_of(base[phase], (0.0, 0.0, 1.0), position, side)
    np.testing.assert_allclose(even, np.broadcast_to(base.mean(axis=(0, 1)), even.shape), rtol=1e-5)
    ramp = base[phase] + slope[0][phase] * y[..., None] + slope[1][phase] * x[..., None]
    steepness = slope.mean(axis=(1, 2))
    expected = base.mean(axis=(0, 1)) + steepness[0] * y[..., None] + steepness[1] * x[..., None]
    inside = (slice(side, -side), slice(side, -side))
    np.testing.assert_allclose(joined_of(ramp, (0.0, 0.0, 1.0), position, side)[inside], expected[inside], rtol=1e-5)


@pytest.mark.parametrize("edge", ["corner", "step", "sky"])
def test_interleaved_light_keeps_edges(edge):
    """Light does not cross to a surface of another normal, another plane, or none: but for weights of e^-8."""
    _, x, position = slanted(16, 16)
    right = x >= 7
    normal = np.zeros((*x.shape, 3))
    normal[..., 2] = 1.0
    if edge == "corner":
        normal[right] = (1.0, 0.0, 0.0)
    elif edge == "step":
        position[right, 2] += 3.0
    else:
        normal[right] = 0.0
    value = np.where(right, 100.0, 1.0)[..., None] * np.ones(3)
    found = joined_of(value, normal, position)
    # across a 90 degrees' corner a weight is e^-8; near it up to three times as many tent weights count
    assert np.abs(found[~right] - 1.0).max() < 99.0 * 3.0 * math.exp(-8.0)
    if edge != "sky":
        assert np.abs(found[right] / 100.0 - 1.0).max() < 3.0 * math.exp(-8.0)


def test_interleaved_pictures_are_the_full_ones_for_a_sixteenth_of_the_connections():
    """In a convex room: the same mean, on walls errors of 2 % that fall with the pixels, and one in 16 shadow rays.

    Subsets are 8 lights, sums of which differ by tens of percent; in corners a light may be missed by a pixel or two.
    """
    scene, _ = gi.scenes.room(albedo=(0.3, 0.5, 0.7))
    method = gi.InstantRadiosity(paths=64, spp=1, near_light=NEAR.CLAMPED, near_distance=1.0, light_samples=1)
    apart = {}
    inside = None
    for side in (32, 64):
        full, shared = (
            gi.render(scene, dataclasses.replace(method, interleave=n), (side, side), device="cpu") for n in (1, 4)
        )
        a, b = (render.layers["indirect"].astype(np.float64) for render in (full, shared))
        if inside is None:
            around = np.lib.stride_tricks.sliding_window_view(full.layers["normal"], (7, 7), axis=(0, 1))
            inside = np.pad(np.ptp(around, axis=(3, 4)).max(axis=2) == 0.0, 3)
        apart[side] = math.sqrt(blocks(np.square(b - a), side // 32)[inside].mean()) / a.mean()
        assert b.mean() == pytest.approx(a.mean(), rel=1.0 / side)
        rays = [render.counts["shadow_rays"] - side * side for render in (full, shared)]  # but for the lamp's
        assert rays[0] / rays[1] == pytest.approx(16.0, rel=0.01)
    assert inside.sum() > 300
    assert apart[32] < 0.03
    assert apart[64] < 0.7 * apart[32]


def test_a_pixel_has_all_subsets_in_turn():
    """So many samples of one point as there are subsets: every light once, and the light is that of all."""
    scene, _ = gi.scenes.room()
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, fov=0.01))
    method = gi.InstantRadiosity(paths=40, spp=16, near_light=NEAR.CLAMPED)
    full, shared = (
        gi.render(scene, dataclasses.replace(method, interleave=n), (1, 1), device="cpu").layers["indirect"]
        for n in (1, 4)
    )
    # over 4e-4 m, 2 m from the walls
    np.testing.assert_allclose(shared, full, rtol=1e-3)


def test_interleaved_light_is_right_in_the_mean():
    """Beside mirrors and glass too, with the same lights: the mean is off by no more than chance allows."""
    scene, size = gi.scenes.cornell_spheres(), (16, 16)
    method = gi.InstantRadiosity(paths=50, spp=4, set_spp=1)
    apart = []
    for seed in range(12):
        full, shared = (
            gi.render(scene, dataclasses.replace(method, interleave=n), size, seed, "cpu").layers["indirect"]
            for n in (1, 4)
        )
        apart.append(shared.mean(dtype=np.float64) / full.mean(dtype=np.float64) - 1.0)
    assert mean_t(apart, 0.0) < 1.0
    assert np.std(apart) < 0.05


def test_progress_is_that_of_independent_sets():
    """The squared error of n sets is that of one over n."""
    scene, size = gi.scenes.cornell_box(), (16, 16)
    truth = gi.render(scene, gi.PathTracing(spp=4096), size, seed=9, device="cpu").layers["indirect"]
    errors = {}
    for sets in (1, 16):
        method = gi.InstantRadiosity(paths=16, spp=sets, set_spp=1, sampler=gi.Sampler.INDEPENDENT)
        pictures = [gi.render(scene, method, size, seed, "cpu").layers["indirect"] for seed in range(10)]
        errors[sets] = np.mean([np.square(picture - truth).mean(dtype=np.float64) for picture in pictures])
    # ten errors of shared lights: each known to about its own size over sqrt(10)
    assert errors[1] / errors[16] == pytest.approx(16.0, rel=0.6)


def test_pictures_do_not_depend_on_threads_or_memory():
    """One thread, two, and the film in bands: the same picture to the last bit."""
    scene = gi.scenes.cornell_spheres()
    for near, interleave in ((NEAR.COMPENSATED, 1), (NEAR.SPHERICAL, 1), (NEAR.COMPENSATED, 2)):
        method = gi.InstantRadiosity(paths=16, spp=4, set_spp=2, near_light=near, interleave=interleave)
        one = gi.render(scene, method, (24, 24), device=gi.Device("cpu", threads=1))
        two = gi.render(scene, method, (24, 24), device=gi.Device("cpu", threads=2, chunk=13))
        limit = DeviceScene(scene, gi.Device("cpu")).nbytes + method.device_bytes((24, 24)) + 200 * 140
        bands = gi.render(scene, method, (24, 24), device=gi.Device("cpu", memory_limit=limit))
        for other in (two, bands):
            np.testing.assert_array_equal(one.image, other.image)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"paths": 0}, ValueError, "paths is 0"),
        ({"set_spp": 0}, ValueError, "set_spp is 0"),
        ({"near_light": "clamped"}, TypeError, "near_light is 'clamped', expected a NearLight"),
        ({"near_distance": 0.0}, ValueError, "near_distance is 0"),
        ({"min_roughness": 0.0}, ValueError, "min_roughness is 0"),
        ({"light_samples": 0}, ValueError, "light_samples is 0"),
        ({"sampler": 1}, TypeError, "sampler is 1"),
        ({"shadow_map": 5000}, ValueError, "shadow_map is 5000"),
        ({"interleave": 0}, ValueError, "interleave is 0"),
    ],
)
def test_bad_settings_are_named(settings, error, message):
    """A caller's mistake is one sentence that names the setting."""
    with pytest.raises(error, match=message):
        gi.InstantRadiosity(**settings)
