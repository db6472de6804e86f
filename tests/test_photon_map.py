"""Photon mapping against closed forms and path tracing: means, caustics, leaks, and how progress converges."""

from __future__ import annotations

import dataclasses
import math
import sys

import numpy as np
import pytest
import warp as wp
from noise import Z_LIMIT
from scipy.integrate import quad
from test_photons import box, estimate

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.job import Job
from warpgi.kernels.density import Density
from warpgi.kernels.photon_map import gather_irradiance
from warpgi.methods.photon_map import Mapping
from warpgi.metrics import count_fireflies
from warpgi.photons import PhotonSource
from warpgi.scenes import caustic, furnace, integrating_sphere, leak

SMALL = {"photons": 20_000, "caustic_photons": 20_000}


def mapping_of(scene, method, seed=0):
    device = gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    return Mapping(method, Job(on_device, on_device.camera((8, 8)), (8, 8), seed, device))


@pytest.mark.parametrize("gather", [0, 16])
def test_integrating_sphere(gather):
    """Inside of a sphere the indirect light is the same everywhere: the mean over maps is the closed form."""
    scene, expected = integrating_sphere(albedo=0.5, subdivisions=4)
    # flattened discs lose a little on a curved wall; 10 000 photons on 12.6 m^2: 50 of them reach 0.14 m
    method = gi.PhotonMap(photons=10_000, spp=4, map_spp=1, shrink=1.0, flatten=1.0, final_gather=gather // 2)
    method = dataclasses.replace(method, sampler=gi.Sampler.INDEPENDENT)
    means = [gi.render(scene, method, (8, 8), seed=seed, device="cpu").layers["indirect"].mean() for seed in range(12)]
    error = np.std(means, ddof=1) / math.sqrt(len(means))
    # Student's t of 11 degrees: 1e-3 at 4.4
    assert abs(np.mean(means) - expected.indirect_radiance[0]) < Z_LIMIT * error


def test_furnace_mean():
    """In a furnace of cubes the radiance is emission / (1 - albedo), at edges and corners too with the correction."""
    scene, expected = furnace(albedo=0.5, shape="blocks")
    method = gi.PhotonMap(photons=100_000, spp=4, edge_rays=16, final_gather=16)
    image = gi.render(scene, method, (32, 32), device="cpu").image
    assert image.mean() == pytest.approx(expected.radiance[0], rel=0.005)
    # half of it is the map's, whose 50 photons scatter by 1 / sqrt(40), averaged over 64 rays of a pixel
    assert np.abs(image / expected.radiance[0] - 1.0).max() < 0.5 * 5.0 / math.sqrt(40.0 * 64.0)
    # what the map alone shows is as right in the mean, and dark along edges without the correction
    seen = gi.render(scene, dataclasses.replace(method, final_gather=0), (32, 32), device="cpu").image
    bare = dataclasses.replace(method, edge_rays=0)
    dark = gi.render(scene, dataclasses.replace(bare, final_gather=0), (32, 32), device="cpu").image
    assert abs(seen.mean() - expected.radiance[0]) < abs(dark.mean() - expected.radiance[0])
    # nor do rays bring that home from corners, if they go on where they are near
    few = dataclasses.replace(bare, photons=20_000)
    errors = [
        np.abs(
            gi.render(scene, dataclasses.replace(few, near=near), (32, 32), device="cpu").image - expected.radiance[0]
        )
        for near in (0.0, 1.0)
    ]
    assert errors[1].mean() < 0.9 * errors[0].mean()


def test_progress_converges_at_the_published_rate():
    """Knaus, Zwicker 2011, with alpha = 2/3: variance falls as N^-2/3, bias as N^-1/3 (their eqs. 14 and 20).

    Under a lamp at height 1 over a floor, within radius r, the mean irradiance is 2 (1 - 1/sqrt(1 + r^2)) / r^2 of that
    at the foot, so that each pass's bias is known. 400 such floors at once are as many repeats.
    """
    side, passes, alpha = 20, 64, 2.0 / 3.0
    places = [(4.0 * i, 4.0 * j) for i in range(side) for j in range(side)]
    shapes, lights = [], []
    for x, z in places:
        corners = [(x - 1, 0, z - 1), (x + 1, 0, z - 1), (x + 1, 0, z + 1), (x - 1, 0, z + 1)]
        shapes.append(gi.Shape(corners, [(0, 2, 1), (0, 3, 2)], gi.Diffuse(0.0)))
        lights.append(gi.SpotLight((x, 1, z), (0, -1, 0), 1.0, 0.55, 0.6))
    scene = gi.Scene(shapes, gi.Camera((0, 5, 0), (0, 0, 0.1)), lights)
    method = gi.PhotonMap(neighbours=0, radius=0.5, kernel=gi.Kernel.CONSTANT, shrink=alpha)
    mapping = mapping_of(scene, method)
    source = PhotonSource(mapping.job.scene, 3, 0)
    device = mapping.job.device
    x = np.array([(x, 0.0, z) for x, z in places]) - mapping.job.scene.centre
    x, n = device.array(x, wp.vec3), device.array(np.tile((0.0, 1.0, 0.0), (len(places), 1)), wp.vec3)
    found, radius2 = [], []
    for number in range(passes):
        shot = source.shoot(100 * len(places), number)
        tree = source.tree(shot, np.arange(shot.count, dtype=np.int32))
        result = device.zeros(len(places), Density)
        look = mapping.lookup(0, 0.5, mapping.radius_scale2(number))
        device.launch(estimate, len(places), [tree.struct, mapping.job.scene.struct, look, x, n], [result])
        found.append(result.numpy()["irradiance"][:, 0].astype(np.float64))
        radius2.append(float(look.limit2 * look.scale2))
    counts = np.arange(1, passes + 1)
    # r_{i+1}^2 = r_i^2 (i + alpha) / (i + 1)
    np.testing.assert_allclose(
        np.divide(radius2[1:], radius2[:-1]), (counts[:-1] + alpha) / (counts[:-1] + 1), rtol=1e-5
    )
    running = np.cumsum(found, axis=0) / counts[:, None]
    r2 = np.array(radius2)
    known = np.cumsum(2.0 * (1.0 - 1.0 / np.sqrt(1.0 + r2)) / r2) / counts
    error = running.std(axis=1, ddof=1) / math.sqrt(len(places))
    assert (np.abs(running.mean(axis=1) - known) < Z_LIMIT * error).all()
    # passes from N / 2 to N, so that the sums' beginnings do not hide the rates: bias and variance of their mean
    ends = np.array([8, 16, 32, 64])
    late = np.array([np.mean(found[n // 2 : n], axis=0) for n in ends])
    bias, variance = 1.0 - late.mean(axis=1), late.var(axis=1, ddof=1)
    slopes = [np.polyfit(np.log(ends), np.log(values), 1)[0] for values in (bias, variance)]
    # over log 8 an error of e at the ends tilts the line by e sqrt(2) / 2.08 at most: 2 % of the bias, 7 % of a
    # variance over 400; the bias is r^2 but for its square, which at a radius of 0.3 is 0.03 of it
    assert slopes[0] == pytest.approx(alpha - 1.0, abs=0.03 + 3.0 * 0.02 * 0.68)
    assert slopes[1] == pytest.approx(-alpha, abs=3.0 * 0.07 * 0.68)


def test_maps_follow_each_other_in_constant_memory():
    """Every map has photons of its own, and takes the place of the one before."""
    mapping = mapping_of(caustic(), gi.PhotonMap(**SMALL))
    seen, sizes = [], []
    for number in range(4):
        mapping.use(number)
        trees = (mapping.maps.diffuse, mapping.maps.caustic)
        seen.append([tree.blocks.numpy()[:8].tobytes() for tree in trees])
        sizes.append(sum(tree.nbytes for tree in mapping._trees))
    assert all(len({blocks[i] for blocks in seen}) == 4 for i in range(2))
    # counts of photons scatter by 1 / sqrt(20 000), some tenfold where paths are long
    assert max(sizes) < 1.1 * min(sizes)


def test_caustic_of_a_glass_ball():
    """Behind a glass ball light comes together where a path tracer finds it, and as much of it."""
    scene = caustic(lamp_radius=0.3)
    shapes = [shape for shape in scene.shapes if shape.name != "ring"]
    focus = (-0.57, 0.0, 0.05)
    camera = gi.Camera((-1.2, 0.9, -0.9), focus, fov=30.0)
    scene = dataclasses.replace(scene, shapes=shapes, camera=camera)
    size = (32, 32)
    reference = gi.render(scene, gi.PathTracing(spp=1024), size, device="cpu")
    picture = gi.render(scene, gi.PhotonMap(spp=64, map_spp=8, caustic_photons=100_000), size, seed=1, device="cpu")
    a, b = (render.layers["indirect"].sum(axis=2).astype(np.float64) for render in (reference, picture))
    error = math.sqrt(reference.layers["variance"].sum(axis=2).sum())
    # three channels that go together: their standard deviations add up
    assert abs(a.sum() - b.sum()) < Z_LIMIT * math.sqrt(3.0) * error + 0.01 * a.sum()
    y, x = np.mgrid[:32, :32]
    bright = [np.where(light > 0.25 * light.max(), light, 0.0) for light in (a, b)]
    centres = [np.array([(x * light).sum(), (y * light).sum()]) / light.sum() for light in bright]
    assert np.abs(centres[0] - centres[1]).max() < 0.5
    assert a.max() > 5.0 * np.median(a)


def test_pictures_agree_with_path_tracing():
    """Mirrors, glass, rough metal, coats, sun, sky: photon maps show what paths show, but for noise and some blur."""
    size = (32, 32)
    metal = caustic(lamp_radius=0.3, roughness=0.2)
    open_air = dataclasses.replace(metal, lights=[gi.Environment((0.2, 0.3, 0.5)), gi.DistantLight((1, -2, -1), 2.0)])
    box = gi.scenes.build("cornell-box")
    shapes = [
        shape if shape.emission else dataclasses.replace(shape, material=gi.Coated(shape.material.albedo, 0.1))
        for shape in box.shapes
    ]
    varnished = dataclasses.replace(box, shapes=shapes, lights=[gi.PointLight((0.4, 0.3, 0.1), 0.5)])
    for scene in (gi.scenes.build("cornell-spheres"), open_air, varnished):
        reference = gi.render(scene, gi.PathTracing(spp=256), size, device="cpu")
        for gather in (0, 4):
            method = gi.PhotonMap(photons=100_000, final_gather=gather, edge_rays=8)
            picture = gi.render(scene, method, size, seed=1, device="cpu")
            a, b = (render.image.reshape(4, 8, 4, 8, 3).mean(axis=(1, 3)) for render in (reference, picture))
            error = np.sqrt(reference.layers["variance"].reshape(4, 8, 4, 8, 3).mean(axis=(1, 3)) / 64.0)
            assert (np.abs(a - b) < Z_LIMIT * error + 0.08 * a + 0.01 * a.mean()).all()
            # the scatter of the means of 16 blocks is below 1 %; 0.5 % of bias was seen
            assert b.mean() == pytest.approx(a.mean(), rel=0.02)


@pytest.mark.parametrize("gather", [0, 2])
def test_glass_that_is_seen_shows_both_its_lobes(gather):
    """One camera path shows a lamp that glass reflects at its 4 %, and what is behind the glass at the rest, without
    the noise of a choice between the two."""
    corners, faces = np.float64([(-9, 0, -9), (9, 0, -9), (9, 0, 9), (-9, 0, 9)]), [(0, 2, 1), (0, 3, 2)]
    down = [face[::-1] for face in faces]
    above, below = (0, 3, 0), (0, -1, 0)
    glass = gi.Shape(corners, faces, gi.Dielectric(1.5))
    lamp = gi.Shape(corners + above, down, gi.Diffuse(0.0), gi.Emissive(2.0))
    glow = gi.Shape(corners + below, faces, gi.Diffuse(0.0), gi.Emissive(1.0))
    camera = gi.Camera((0, 1, 0), (0, 0, 0), up=(0, 0, 1), fov=2.0)
    method = gi.PhotonMap(spp=1, photons=100, caustic_photons=100, final_gather=gather)
    # at normal incidence; of light that is refracted radiance falls by the square of the index, as there is no way out
    reflected = ((1.5 - 1.0) / (1.5 + 1.0)) ** 2
    for shapes, light in (([glass, lamp], 2.0 * reflected), ([glass, glow], (1.0 - reflected) / 1.5**2)):
        image = gi.render(gi.Scene(shapes, camera), method, (8, 8), device="cpu").image
        # directions within 1.5 degrees of the normal
        np.testing.assert_allclose(image, light, rtol=1e-3)


def test_gather_rays_make_no_dots_of_caustics():
    """Light of caustics elsewhere is neither lost nor counted twice, and no pixel of the ceiling, which looks down on a
    caustic, is far from its neighbours."""
    scene = gi.scenes.cornell_spheres()
    settings = {"photons": 100_000, "caustic_photons": 50_000, "spp": 4}
    seen, gathered = (
        gi.render(scene, gi.PhotonMap(final_gather=rays, **settings), (64, 64), device="cpu").layers["indirect"]
        for rays in (0, 8)
    )
    # of the light that the spheres do not show, whose reflections are noise of the camera paths; that of caustics
    # elsewhere is a tenth of it
    walls = np.s_[2:30, 4:60]
    assert gathered[walls].mean() == pytest.approx(seen[walls].mean(), rel=0.02)
    ceiling = gathered[2:6, 10:54].sum(axis=2)
    # it is itself half as bright again in the middle; a ray in 32 that met the caustic would make it twice that
    assert ceiling.max() < 1.8 * ceiling.mean()


def test_gather_rays_may_go_on():
    """Where gather rays end changes no mean: light and caustics of the surfaces that they pass take the map's place."""
    corners = [(x, 0.95, z) for x, z in ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9))]
    mirror = gi.Shape(corners, [(0, 1, 2), (0, 2, 3)], gi.Mirror(0.9))
    walls = box(2.0, flip=True, material=gi.Diffuse(0.6))
    up = gi.SpotLight((0, 0, 0), (0, 1, 0), 2.0, 0.5, 0.6)  # all of its light comes to the walls over the mirror
    method = gi.PhotonMap(photons=50_000, caustic_photons=50_000, spp=8)
    camera = gi.Camera((-0.8, 0.8, -0.8), (0.3, -1, 0.3), fov=60.0)
    for lights in ([up], [gi.PointLight((0.2, 0.1, 0.3), 1.0)]):
        scene = gi.Scene([walls, mirror], camera, lights)
        means = []
        for settings in ({}, {"final_gather": 8, "near": 0.0}, {"final_gather": 8, "near": 1e6}):
            render = gi.render(scene, dataclasses.replace(method, **settings), (16, 16), device="cpu")
            means.append(render.layers["indirect"].mean(dtype=np.float64))
        # 2 000 rays' worth of noise each, and the map's own 0.5 %
        np.testing.assert_allclose(means, means[0], rtol=0.02)


def test_a_coat_weighs_gathered_light_by_its_angle():
    """Light that only grazes a coated floor gets in by what its coat lets through there, as for photons."""
    floor = [(-1, 0, -1), (3, 0, -1), (3, 0, 1), (-1, 0, 1)]
    wall = [(3, 0, -1), (3, 0.4, -1), (3, 0.4, 1), (3, 0, 1)]
    faces = [(0, 2, 1), (0, 3, 2)]
    shapes = [gi.Shape(floor, faces, gi.Coated(0.8, 0.5)), gi.Shape(wall, [f[::-1] for f in faces], gi.Diffuse(0.8))]
    lamp = gi.SpotLight((0, 0.2, 0), (1, 0, 0), 10.0, 0.05, 0.06)  # lights the wall alone
    scene = gi.Scene(shapes, gi.Camera((1, 2, 0), (1.01, 0, 0), fov=30.0), [lamp])
    seen, gathered = (
        gi.render(scene, gi.PhotonMap(**settings), (8, 8), device="cpu").layers["indirect"].mean(dtype=np.float64)
        for settings in ({"photons": 400_000}, {"photons": 50_000, "spp": 256, "final_gather": 16})
    )
    # some 1 % of 260 000 rays meet the wall, and as many photons are seen: 2 % each; without the weight 14 % were seen
    assert gathered == pytest.approx(seen, rel=0.08)


def test_the_cache_gathers_from_photons():
    """Records whose rays read the map show what paths show, caustics once; in a sphere it is the closed form."""
    scene, expected = integrating_sphere(albedo=0.5, subdivisions=4)
    method = gi.IrradianceCache(photons=50_000, rays=256, spp=4)
    sphere = gi.render(scene, method, (16, 16), device="cpu")
    assert sphere.layers["indirect"].mean() == pytest.approx(expected.indirect_radiance[0], rel=0.02)
    scene = gi.scenes.build("cornell-spheres")
    reference = gi.render(scene, gi.PathTracing(spp=1024), (32, 32), seed=1, device="cpu")
    render = gi.render(scene, dataclasses.replace(method, rays=512), (32, 32), device="cpu")
    a, b = (r.layers["indirect"].reshape(4, 8, 4, 8, 3).mean(axis=(1, 3)) for r in (reference, render))
    error = np.sqrt(reference.layers["variance"].reshape(4, 8, 4, 8, 3).mean(axis=(1, 3)) / 64.0)
    assert (np.abs(a - b) < Z_LIMIT * error + 0.1 * a + 0.02 * a.mean()).all()
    assert b.mean() == pytest.approx(a.mean(), rel=0.03)
    assert render.counts["photons"] > 0
    assert render.counts["records"] < 32 * 32
    with pytest.raises(ValueError, match="photons and records are both given"):
        gi.IrradianceCache(photons=1000, records="a.npz")


def test_shading_normals_count_for_photons_as_for_paths():
    """Interpolated normals turn light about; its adjoint, which photons follow, agrees (Veach 1997, sec. 5.3)."""
    faces = [(0, 2, 1), (0, 3, 2)]
    tilted, aside = (np.tile(n, (4, 1)) for n in ((-0.5, 1.0, 0.0), (-1.0, 0.0, 0.7)))
    corners = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)]
    floor = gi.Shape(corners, faces, gi.Diffuse(0.8), normals=tilted)
    corners = [(1, 0, -1), (1, 2, -1), (1, 2, 1), (1, 0, 1)]
    wall = gi.Shape(corners, faces, gi.Diffuse(0.8), normals=aside)
    camera = gi.Camera((-3, 1, 0), (1, 1, 0), fov=22.0)
    scene = gi.Scene([floor, wall], camera, [gi.DistantLight((0.5, -1.0, 0.2), 1.0)])
    method = gi.PathTracing(spp=1024, sampler=gi.Sampler.INDEPENDENT)
    expected = gi.render(scene, method, (16, 16), device="cpu").layers["indirect"].mean(dtype=np.float64)
    method = gi.PhotonMap(photons=20_000, spp=8, map_spp=1, shrink=1.0, neighbours=20)
    found = gi.render(scene, method, (16, 16), seed=1, device="cpu").layers["indirect"].mean(dtype=np.float64)
    # 2.6e5 paths know it to 0.5 %, some 4e4 photons too; 20 of these blur little
    assert found == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    ("rejects", "edge_rays", "most", "gathered_most"),
    [(True, 0, 0.6, 0.05), (True, 8, 1.25, 0.05), (False, 0, 1.25, 0.5)],
    ids=["rejecting", "edges corrected", "taking all"],
)
def test_leak_is_bounded(rejects, edge_rays, most, gathered_most):
    """Light gets through a wall 1 mm thick no farther than the radius, and is at most as bright as on the lit side.

    At the foot of the wall the disc is half on either side: half as bright. The correction for edges doubles what is
    there, and without rejection the wall's own back is lit through it.
    """
    radius = 0.2
    scene, _ = leak(open_front=True)
    settings = {"edge_rays": edge_rays} | ({} if rejects else {"normal_angle": 180.0, "flatten": 1.0})
    method = gi.PhotonMap(neighbours=0, radius=radius, photons=50_000, spp=4, **settings)
    render = gi.render(scene, method, (96, 48), device="cpu")
    light, position = render.layers["indirect"].max(axis=2), render.layers["position"]
    met = render.layers["depth"][..., 0] > 0.0
    dark, lit = met & (position[..., 0] > 0.01), light[met & (position[..., 0] < -0.01)]
    far = dark & (position[..., 0] > radius + 0.1)  # a pixel is no wider than 0.1
    assert far.sum() > 1000
    assert light[far].max() == 0.0
    # over the lit room's brightest: some 100 photons to an estimate scatter by a tenth
    assert 0.0 < light[dark].max() < most * lit.max()
    # gather rays do not see through walls, but the map that they read is wrong near the foot of one
    gathered = gi.render(scene, dataclasses.replace(method, final_gather=8), (96, 48), device="cpu")
    assert gathered.layers["indirect"].max(axis=2)[dark].mean() < gathered_most * lit.mean()


def test_gathered_irradiance_of_any_points():
    """Points and normals anywhere get their indirect irradiance and the harmonic mean distance of what is around."""
    scene, expected = integrating_sphere(albedo=0.5, subdivisions=4)
    mapping = mapping_of(scene, gi.PhotonMap(photons=100_000, final_gather=256))
    mapping.use(0)
    rng = np.random.default_rng(0)
    n = rng.normal(size=(64, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    device = mapping.job.device
    x, n = device.array(-0.98 * n, wp.vec3), device.array(n, wp.vec3)
    irradiance, inverse = device.zeros(64, wp.vec3), device.zeros(64, float)
    inputs = [mapping.job.scene.struct, mapping.maps, mapping.view, x, n]
    device.launch(gather_irradiance, 64, inputs, [irradiance, inverse])
    # all light that has been reflected is albedo times all light
    assert irradiance.numpy().mean() == pytest.approx(expected.indirect_irradiance[0], rel=0.01)
    # chords from 0.98 of a unit sphere's radius; of 64 x 256 rays the mean of 1 / distance is known to 0.5 %, and the
    # ball of triangles is somewhat smaller
    r = 0.98
    known = quad(lambda c: 2.0 * c / (r * c + math.sqrt(r * r * c * c + 1.0 - r * r)), 0.0, 1.0)[0]
    assert inverse.numpy().mean() == pytest.approx(known, rel=0.02)


def test_photons_as_the_source_of_reconstruction():
    """Secondary hits that read a photon map have no noise of their own, and bring caustics to primary hits."""
    scene = gi.scenes.build("cornell-spheres")
    reference = gi.render(scene, gi.PhotonMap(spp=64, map_spp=8, final_gather=8), (32, 32), seed=9, device="cpu")
    expected = reference.layers["indirect"]
    paths, photons = (
        gi.render(scene, gi.LightField(spp=4, rays=64, photons=n), (32, 32), device="cpu") for n in (0, 50_000)
    )
    assert photons.layers["indirect"].mean() == pytest.approx(expected.mean(), rel=0.03)
    errors = [gi.compare(render.layers["indirect"], expected)["relmse"] for render in (paths, photons)]
    assert errors[1] < 0.5 * errors[0]
    samples = [gi.LightField(spp=4, rays=64, photons=n) for n in (0, 50_000)]
    assert samples[0].device_bytes((8, 8)) < samples[1].device_bytes((8, 8))


def test_pictures_do_not_depend_on_threads_or_memory():
    """One thread, two, and the film in bands: the same picture to the last bit."""
    scene = gi.scenes.build("cornell-spheres")
    method = gi.PhotonMap(**SMALL, spp=4, map_spp=2, final_gather=2, edge_rays=4)
    one = gi.render(scene, method, (32, 32), device=gi.Device("cpu", threads=1))
    two = gi.render(scene, method, (32, 32), device=gi.Device("cpu", threads=2, chunk=13))
    limit = DeviceScene(scene, gi.Device("cpu")).nbytes + method.device_bytes((32, 32)) + 400 * 140
    bands = gi.render(scene, method, (32, 32), device=gi.Device("cpu", memory_limit=limit))
    for other in (two, bands):
        np.testing.assert_array_equal(one.image, other.image)


@pytest.mark.parametrize("name", ["path", "photon-map", "instant-radiosity"])
def test_a_resumed_render_equals_one_run(tmp_path, monkeypatch, name):
    """Stopped by Ctrl-C, in the middle of a map, and gone on from the checkpoint: the same picture, bit for bit."""
    scene = caustic()
    method = {
        "path": gi.PathTracing(spp=12),
        "photon-map": gi.PhotonMap(**SMALL, spp=12, map_spp=5),
        "instant-radiosity": gi.InstantRadiosity(paths=16, spp=12, set_spp=5),
    }[name]
    whole = gi.render(scene, method, (16, 16), device="cpu")
    path = tmp_path / "half.npz"

    def press(state):
        if state.done >= 3:
            raise KeyboardInterrupt

    with pytest.raises(gi.Interrupted):
        gi.render(scene, method, (16, 16), device="cpu", progress=press, checkpoint=path)
    monkeypatch.setattr(sys.modules["warpgi.render"], "SAVE_SECONDS", 0.0)
    resumed = gi.render(scene, method, (16, 16), device="cpu", checkpoint=path)
    np.testing.assert_array_equal(whole.image, resumed.image)
    np.testing.assert_array_equal(whole.layers["variance"], resumed.layers["variance"])
    assert (resumed.spp, resumed.counts["camera_rays"]) == (whole.spp, whole.counts["camera_rays"])
    again = gi.render(scene, dataclasses.replace(method, spp=3), (16, 16), device="cpu", checkpoint=path)
    np.testing.assert_array_equal(whole.image, again.image)
    with pytest.raises(ValueError, match="is of another render: seed is 0 there, 1 here"):
        gi.render(scene, method, (16, 16), seed=1, device="cpu", checkpoint=path)
    with pytest.raises(ValueError, match="is of another render: scene is"):
        gi.render(caustic(power=51.0), method, (16, 16), device="cpu", checkpoint=path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="is damaged or no checkpoint"):
        gi.render(scene, method, (16, 16), device="cpu", checkpoint=path)


def test_renders_end_by_time_or_error():
    """`seconds` and `error` end a render of any length; the error is that of the samples."""
    scene = gi.scenes.cornell_box()
    method = gi.PathTracing(spp=1_000_000, sampler=gi.Sampler.INDEPENDENT)
    short = gi.render(scene, method, (16, 16), device="cpu", seconds=0.2)
    assert 1 < short.spp < method.spp
    good = gi.render(scene, method, (32, 32), device="cpu", error=0.005)
    reference = gi.render(scene, gi.PathTracing(spp=2048), (32, 32), seed=1, device="cpu")
    # relMSE of the difference of two pictures, over a thousand pixels of heavy tails; passes end late, not early
    error = gi.compare(good.image, reference.image)["relmse"]
    assert 0.0025 < error < 0.0075
    with pytest.raises(ValueError, match="error is given, expected None: LightField keeps more than its film"):
        gi.render(scene, gi.LightField(), (16, 16), device="cpu", error=0.01)
    with pytest.raises(ValueError, match="seconds is 0"):
        gi.render(scene, method, (16, 16), device="cpu", seconds=0.0)


def test_fireflies_are_counted():
    """A path tracer says how many of its pixels hold light that it hardly finds; photon maps have none there."""
    image = np.full((12, 12, 3), 0.1, np.float32)
    image[2, 3] = image[6, 6, 1] = 5.0
    image[9:11, :] = 5.0
    image[0, 0] = 0.3
    noise = 0.1 * image**2
    assert count_fireflies(image, noise) == 2
    assert count_fireflies(image, 0.0 * noise) == 2
    noise[2, 3] = 0.01
    assert count_fireflies(image, noise) == 1
    scene = caustic()
    paths = gi.render(scene, gi.PathTracing(spp=64), (48, 48), device="cpu")
    photons = gi.render(scene, gi.PhotonMap(spp=8), (48, 48), device="cpu")
    assert paths.counts["fireflies"] > 10
    assert photons.counts["fireflies"] <= 2


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"photons": 0}, ValueError, "photons is 0"),
        ({"neighbours": 1}, ValueError, "neighbours is 1, expected 0, or 2 or more"),
        ({"neighbours": 257}, ValueError, "neighbours is 257"),
        ({"neighbours": 0}, ValueError, "neighbours is 0 and radius is None"),
        ({"radius": -1.0}, ValueError, "radius is -1"),
        ({"kernel": "cone"}, TypeError, "kernel is 'cone', expected a Kernel"),
        ({"shrink": 0.0}, ValueError, "shrink is 0"),
        ({"flatten": 0.5}, ValueError, "flatten is 0.5"),
        ({"map_spp": 0}, ValueError, "map_spp is 0"),
        ({"sampler": 1}, TypeError, "sampler is 1"),
        ({"edge_rays": 257}, ValueError, "edge_rays is 257"),
    ],
)
def test_bad_settings_are_named(settings, error, message):
    """A caller's mistake is one sentence that names the setting."""
    with pytest.raises(error, match=message):
        gi.PhotonMap(**settings)
