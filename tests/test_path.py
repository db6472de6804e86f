"""The path tracer against closed forms, conservation laws and itself at other settings."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from noise import Z_LIMIT, mean_z, two_sample_z

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.kernels import rng
from warpgi.kernels.path import PathSettings, trace_path
from warpgi.kernels.rng import make_sampler, sample_2d
from warpgi.kernels.sampling import make_frame, square_to_cosine_hemisphere, square_to_triangle, to_world
from warpgi.kernels.scene import Scene, offset_origin, ray_offset

wp.set_module_options({"enable_backward": False})

ALBEDOS = (0.1, 0.3, 0.5, 0.7, 0.9)


def tracing(spp, **settings):
    """Path tracing whose variance layer is unbiased."""
    return gi.PathTracing(spp=spp, **{"sampler": gi.Sampler.INDEPENDENT, **settings})


@wp.kernel
def gather(
    offset: int,
    scene: Scene,
    settings: PathSettings,
    face_cdf: wp.array[float],
    first_face: int,
    result: wp.array2d[wp.vec3],
):
    """One path from a uniform point of the surface along a cosine-distributed direction into (emission, rest)."""
    i = offset + wp.tid()
    sampler = make_sampler(settings.seed, i, 0, rng.INDEPENDENT)
    place = sample_2d(sampler, 100)
    face = first_face + wp.lower_bound(face_cdf, sample_2d(sampler, 101)[0])
    a = scene.points[scene.indices[3 * face]]
    b = scene.points[scene.indices[3 * face + 1]]
    c = scene.points[scene.indices[3 * face + 2]]
    bary = square_to_triangle(place)
    n = scene.face_normals[face]
    d = to_world(make_frame(n), square_to_cosine_hemisphere(sample_2d(sampler, 102)))
    o = offset_origin(a * bary[0] + b * bary[1] + c * bary[2], n, ray_offset(a, b, c), d)
    path = trace_path(scene, settings, sampler, 0, o, d, 0.0)
    result[i, 0] = path.emission
    result[i, 1] = path.direct + path.indirect


def mean_irradiance(scene, shape, count, seed=1):
    """Irradiance over a shape's surface, emitted and reflected part, with standard errors; channel 0."""
    device = gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    areas = scene.shapes[shape].areas()
    settings = PathSettings()
    settings.max_depth, settings.roulette_depth, settings.sampler, settings.seed = 2**31 - 1, 5, rng.INDEPENDENT, seed
    result = device.zeros((count, 2), wp.vec3)
    cdf = device.array((np.cumsum(areas) / areas.sum()).astype(np.float32), float)
    inputs = [on_device.struct, settings, cdf, int(on_device.first_face[shape])]
    device.launch(gather, count, inputs, [result])
    values = np.pi * result.numpy()[:, :, 0].astype(np.float64)
    return values.mean(axis=0), values.std(axis=0) / np.sqrt(count)


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("shape", ["cube", "sphere", "blocks"])
@pytest.mark.parametrize("sampler", gi.Sampler)
def test_furnace(albedo, shape, sampler):
    """Every pixel of a furnace sees emission / (1 - albedo)."""
    scene, expected = gi.scenes.furnace(albedo=albedo, emission=(1.0, 2.0, 0.5), shape=shape)
    render = gi.render(scene, tracing(64, sampler=sampler), size=(32, 32))
    z = mean_z(render.image, render.layers["variance"], np.array(expected.radiance))
    assert np.abs(z).max() < Z_LIMIT
    if albedo == 0.0:
        np.testing.assert_allclose(render.image, np.broadcast_to(expected.radiance, render.image.shape), rtol=1e-6)
    assert render.counts["nonfinite"] == 0


@pytest.mark.parametrize(
    "material",
    [gi.Diffuse(1.0), gi.Mirror(1.0), gi.Dielectric(1.5), gi.Dielectric(1.0)],
    ids=["diffuse", "mirror", "glass", "nothing"],
)
def test_object_that_loses_nothing_vanishes_in_a_furnace(material):
    """A ball that absorbs nothing has the radiance of the furnace around it, whatever it does with light."""
    scene, expected = gi.scenes.furnace(albedo=0.5)
    from warpgi.scenes.primitives import icosphere

    ball = icosphere(0.5, 3).move((0.0, 0.0, -0.3)).shape(material, "ball", smooth=False)
    scene = dataclasses.replace(scene, shapes=[*scene.shapes, ball])
    render = gi.render(scene, tracing(64), size=(32, 32))
    assert np.abs(mean_z(render.image, render.layers["variance"], np.array(expected.radiance))).max() < Z_LIMIT


@pytest.mark.parametrize("albedo", ALBEDOS)
def test_room(albedo):
    """The mean indirect irradiance of a closed room is flux a / (area (1 - a)): CIE 171:2006 test 5.8."""
    scene, expected = gi.scenes.room(albedo=albedo, flux=10000.0)
    (_, indirect), (_, error) = mean_irradiance(scene, 0, 400_000)
    assert abs(indirect - expected.indirect_irradiance[0]) < Z_LIMIT * error
    assert error < 0.01 * indirect
    if albedo == 0.5:
        assert expected.indirect_irradiance[0] == pytest.approx(104.2, abs=0.05)


@pytest.mark.parametrize("albedo", ALBEDOS)
def test_integrating_sphere(albedo):
    """Inside a sphere indirect light is the same at every point: flux a^2 / (pi area (1 - a)) in each quarter."""
    scene, expected = gi.scenes.integrating_sphere(albedo=albedo)
    render = gi.render(scene, tracing(128), size=(32, 32))
    # a single-bounce path has no light sampling noise of its own: the direct part is exact at the centre's light
    squares = render.layers["variance"]
    for rows in (slice(0, 16), slice(16, 32)):
        for columns in (slice(0, 16), slice(16, 32)):
            part = render.layers["indirect"][rows, columns]
            z = mean_z(part, squares[rows, columns], np.array(expected.indirect_radiance))
            # the wall is a polyhedron: points at its corners are a little farther out
            error = np.abs(part.mean(axis=(0, 1)) / expected.indirect_radiance - 1.0).max()
            assert np.abs(z).max() < Z_LIMIT or error < 1e-3


def test_form_factors():
    """Unit squares exchange 0.1998 of their light face to face at distance 1, and 0.2000 at a right angle."""
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)
    faces = [(0, 1, 2), (0, 2, 3)]
    receiver = gi.Shape(square, faces, gi.Diffuse(0.0))
    opposite = gi.Shape(np.add(square, (0, 0, 1))[::-1], faces, gi.Diffuse(0.0), gi.Emissive(1.0))
    upright = gi.Shape(square[:, [0, 2, 1]], faces, gi.Diffuse(0.0), gi.Emissive(1.0, two_sided=True))
    camera = gi.Camera((0.5, 0.5, 3.0), (0.5, 0.5, 0.0))
    # Howell, catalogue of radiation configuration factors, C-11 and C-14, for unit squares
    for emitter, factor in ((opposite, 0.199825), (upright, 0.200044)):
        (emitted, _), (error, _) = mean_irradiance(gi.Scene([receiver, emitter], camera), 0, 1_000_000)
        assert abs(emitted / np.pi - factor) < Z_LIMIT * error / np.pi
        assert error / np.pi < 0.001


def polygon_irradiance(points, normal, corners):
    """Irradiance from a polygon of radiance 1 (Lambert 1760), at points with that normal, polygon in front."""
    total = np.zeros(len(points))
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        u, v = a - points, b - points
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        cross = np.cross(u, v)
        length = np.linalg.norm(cross, axis=1)
        total += np.arctan2(length, (u * v).sum(axis=1)) * (cross @ normal) / length
    return 0.5 * np.abs(total)


@pytest.mark.parametrize("two_sided", [False, True])
def test_direct_light_of_a_rectangle(two_sided):
    """Direct light on a floor is albedo / pi times Lambert's polygon formula, at every pixel."""
    corners = np.array([(-0.3, 1.0, -0.2), (0.5, 1.0, -0.2), (0.5, 1.0, 0.4), (-0.3, 1.0, 0.4)])
    lamp = gi.Shape(corners, [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.0), gi.Emissive(2.0, two_sided=two_sided))
    floor = gi.Shape([(-2, 0, -2), (-2, 0, 2), (2, 0, 2), (2, 0, -2)], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.6))
    scene = gi.Scene([floor, lamp], gi.Camera((0.0, 0.6, 0.1), (0.0, 0.0, 0.0), up=(0, 0, -1), fov=70))
    assert scene.shapes[1].areas().sum() == pytest.approx(0.48)
    render = gi.render(scene, tracing(256), size=(32, 32))
    position = render.layers["position"].reshape(-1, 3).astype(np.float64)
    expected = 0.6 / np.pi * 2.0 * polygon_irradiance(position, np.array([0.0, 1.0, 0.0]), corners)
    error = np.sqrt(render.layers["variance"][..., 0].ravel())
    z = (render.layers["direct"][..., 0].ravel() - expected) / error
    assert np.abs(z).max() < 5.5  # 1024 pixels whose noise is not quite normal
    assert abs(z.mean()) < Z_LIMIT / 32.0
    assert render.layers["indirect"].max() == 0.0


def test_point_spot_and_distant_light():
    """A floor's radiance is albedo / pi times I cos / d^2, with the cone of KHR_lights_punctual, or E cos."""
    floor = gi.Shape([(-9, 0, -9), (-9, 0, 9), (9, 0, 9), (9, 0, -9)], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5))
    camera = gi.Camera((0.0, 2.0, 0.0), (0.0, 0.0, 0.0), up=(0, 0, -1), fov=60)
    source = np.array((0.5, 1.5, -0.25))
    lights = {
        "point": gi.PointLight(tuple(source), (1.0, 2.0, 3.0)),
        "spot": gi.SpotLight(tuple(source), (0, -1, 0), (1.0, 2.0, 3.0), inner_angle=0.2, outer_angle=0.6),
        "distant": gi.DistantLight((0.6, -0.8, 0.0), (1.0, 2.0, 3.0)),
    }
    for name, light in lights.items():
        # one sample a pixel: then the position layer is where the light was evaluated
        render = gi.render(gi.Scene([floor], camera, [light]), tracing(1), size=(24, 24))
        to_light = source - render.layers["position"].astype(np.float64)
        distance = np.linalg.norm(to_light, axis=-1)
        cosine = to_light[..., 1] / distance
        expected = cosine / distance**2
        if name == "distant":
            expected = np.full_like(cosine, 0.8)
        if name == "spot":
            inner, outer = np.cos(0.2), np.cos(0.6)
            expected = expected * np.clip((cosine - outer) / (inner - outer), 0.0, 1.0) ** 2
        expected = 0.5 / np.pi * expected[..., None] * (1.0, 2.0, 3.0)
        np.testing.assert_allclose(render.image, expected, rtol=1e-4, atol=1e-6)


def test_environment_on_a_convex_body():
    """A convex body under a uniform sky of radiance L has radiance albedo L everywhere, and no indirect light."""
    from warpgi.scenes.primitives import icosphere

    ball = icosphere(1.0, 3).shape(gi.Diffuse((0.8, 0.5, 0.2)), "ball", smooth=False)
    scene = gi.Scene([ball], gi.Camera((0, 0, 3), (0, 0, 0), fov=20), [gi.Environment(2.0)])
    render = gi.render(scene, tracing(4), size=(16, 16))
    np.testing.assert_allclose(render.image, np.broadcast_to((1.6, 1.0, 0.4), (16, 16, 3)), rtol=1e-5)
    assert render.layers["indirect"].max() == 0.0


def test_no_light_leaks_through_a_thin_wall():
    """A closed dark room beside a lit one is black, exactly."""
    scene, _ = gi.scenes.leak(thickness=1e-4)
    assert gi.render(scene, tracing(16), size=(48, 48)).image.max() == 0.0


def test_error_falls_with_the_square_root_of_spp():
    """The distance between two seeds' pictures falls as spp^-1/2."""
    scene = gi.scenes.cornell_box()
    counts = np.array([4, 16, 64, 256])
    errors = []
    for spp in counts:
        a, b = (gi.render(scene, tracing(int(spp)), size=(32, 32), seed=seed) for seed in (1, 2))
        errors.append(np.sqrt(np.square(a.layers["indirect"] - b.layers["indirect"]).mean()))
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # 1024 pixels a point know a log error to 1 / sqrt(2 * 1024) = 2 %, the slope over three decades of 2 to 0.7 %
    assert slope == pytest.approx(-0.5, abs=0.03)


def test_sobol_does_better_than_independent():
    """Stratified samples are closer to the reference at the same count; a smaller picture than the claim needs."""
    scene = gi.scenes.cornell_box()
    reference = gi.render(scene, gi.PathTracing(spp=2048), size=(32, 32), seed=9).image
    error = {}
    for sampler in gi.Sampler:
        image = gi.render(scene, gi.PathTracing(spp=64, sampler=sampler), size=(32, 32)).image
        error[sampler] = np.sqrt(np.square(image - reference).mean())
    assert error[gi.Sampler.SOBOL] < 0.9 * error[gi.Sampler.INDEPENDENT]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"max_depth": 12, "roulette_depth": 1}, {"max_depth": 12, "roulette_depth": None}),
        ({"sampler": gi.Sampler.SOBOL}, {"sampler": gi.Sampler.INDEPENDENT}),
    ],
    ids=["roulette", "sampler"],
)
@pytest.mark.parametrize("scene", ["cornell-box", "cornell-spheres", "statuettes"])
def test_settings_agree(one, other, scene):
    """Roulette and the sampler change the noise of a picture, never its mean."""
    scene = gi.scenes.build(scene)
    a = gi.render(scene, tracing(96, **one), size=(40, 40), seed=3)
    b = gi.render(scene, tracing(96, **other), size=(40, 40), seed=4)
    assert two_sample_z(a, b) < Z_LIMIT


def transformed(scene, scale, shift):
    """The scene scaled about the origin, then moved; radiances stay."""
    shift = np.asarray(shift, dtype=np.float64)
    shapes = [dataclasses.replace(shape, vertices=shape.vertices * scale + shift) for shape in scene.shapes]
    position, target = (np.asarray(p) * scale + shift for p in (scene.camera.position, scene.camera.target))
    return dataclasses.replace(
        scene, shapes=shapes, camera=dataclasses.replace(scene.camera, position=position, target=target)
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_scale_and_place_do_not_matter(scale, shift):
    """A scene a thousand times smaller or larger, or 10 km away, gives the same picture within noise."""
    scene = gi.scenes.cornell_spheres()
    original = gi.render(scene, tracing(64), size=(40, 40), seed=1)
    moved = gi.render(transformed(scene, scale, (shift, -shift, 0.5 * shift)), tracing(64), size=(40, 40), seed=2)
    assert two_sample_z(original, moved) < Z_LIMIT
    # the same seed takes the same paths but where rounding decides otherwise
    same = gi.render(transformed(scene, scale, (shift, -shift, 0.5 * shift)), tracing(64), size=(40, 40), seed=1)
    close = np.isclose(same.image, original.image, rtol=1e-2, atol=1e-3 * original.image.mean()).mean()
    assert close > 0.9


def test_layers_by_path_length():
    """Depth 1 is emission alone, depth 2 adds direct light, and deeper paths leave both as they are."""
    scene = gi.scenes.cornell_box()
    renders = {d: gi.render(scene, tracing(8, max_depth=d, roulette_depth=None), size=(24, 24)) for d in (1, 2, 5)}
    for depth, render in renders.items():
        assert (render.layers["direct"].max() > 0.0) == (depth >= 2)
        assert (render.layers["indirect"].max() > 0.0) == (depth >= 3)
        np.testing.assert_array_equal(render.layers["emission"], renders[1].layers["emission"])
    np.testing.assert_array_equal(renders[5].layers["direct"], renders[2].layers["direct"])


def test_feature_layers():
    """Albedo, normal, position and depth are those of the first hit; world space, whatever the device's origin."""
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0, 0], pixels[0, 1], pixels[1, 0], pixels[1, 1] = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, 0.5, 0.5)
    wall = gi.Shape(
        [(10, 0, 7), (12, 0, 7), (12, 2, 7), (10, 2, 7)],
        [(0, 1, 2), (0, 2, 3)],
        gi.Diffuse(gi.Texture(pixels)),
        uv=[(0, 0), (1, 0), (1, 1), (0, 1)],
    )
    scene = gi.Scene([wall], gi.Camera((11, 1, 9), (11, 1, 7), fov=90), [gi.Environment(1.0)])
    render = gi.render(scene, tracing(1), size=(64, 64))
    hit = render.layers["depth"][..., 0] > 0
    np.testing.assert_allclose(render.layers["normal"][hit], [(0, 0, 1)] * hit.sum(), atol=1e-6)
    position = render.layers["position"][hit].astype(np.float64)
    np.testing.assert_allclose(position[:, 2], 7.0, atol=1e-5)
    distance = np.linalg.norm(position - (11, 1, 9), axis=1)
    np.testing.assert_allclose(render.layers["depth"][hit][:, 0], distance, rtol=1e-5)
    # at texel centres (a quarter and three quarters of the wall) the texture is read as it is, first row on top
    for corner, (x, y) in (((0, 0), (10.5, 1.5)), ((0, 1), (11.5, 1.5)), ((1, 0), (10.5, 0.5)), ((1, 1), (11.5, 0.5))):
        nearest = np.linalg.norm(position[:, :2] - (x, y), axis=1).argmin()
        np.testing.assert_allclose(render.layers["albedo"][hit][nearest], pixels[corner], atol=0.06)
    assert not render.layers["position"][~hit].any()


def test_nonfinite_samples_are_dropped_and_counted():
    """Radiance beyond float32 makes a sample infinite: it is counted and leaves no mark on the picture."""
    scene, _ = gi.scenes.furnace(albedo=0.9, emission=3.0e38)
    render = gi.render(scene, tracing(4), size=(8, 8))
    assert 0 < render.counts["nonfinite"] <= 256
    assert render.counts["camera_rays"] == 256
    assert np.isfinite(render.image).all()


def test_variance_layer_is_that_of_the_mean():
    """Over many seeds the pixel means scatter as the variance layer says."""
    scene = gi.scenes.cornell_box()
    renders = [gi.render(scene, tracing(8), size=(16, 16), seed=seed) for seed in range(64)]
    scatter = np.var([r.image for r in renders], axis=0, ddof=1).mean()
    stated = np.array([r.layers["variance"].mean() for r in renders])
    assert abs(stated.mean() - scatter) < Z_LIMIT * stated.std() / 8.0 + Z_LIMIT * scatter * np.sqrt(2.0 / 64 / 768) * 3
