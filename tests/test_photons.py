"""Photons: flux is conserved from any light over any surface, and densities are what brute force and theory say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from noise import Z_LIMIT
from scipy.spatial import cKDTree

import warpgi as gi
import warpgi.photons
from warpgi.coat import POWERS, fit_coat
from warpgi.coat import fresnel as smooth_fresnel
from warpgi.device_scene import DeviceScene
from warpgi.job import Job
from warpgi.kernels.density import (
    Density,
    Lookup,
    density,
    kernel_weight,
    near_photons,
    nearest_photons,
    nearest_place,
    vec8,
)
from warpgi.kernels.photons import CAUSTIC, DIRECT, ECHO, INDIRECT
from warpgi.kernels.rng import INDEPENDENT, SOBOL
from warpgi.kernels.scene import Scene
from warpgi.kernels.splats import SplatTree as SplatTreeStruct
from warpgi.methods.photon_map import SHAPES, Mapping
from warpgi.photons import PhotonSource
from warpgi.scenes import furnace, leak, room

wp.set_module_options({"enable_backward": False})

CAMERA = gi.Camera((0, 0, 5), (0, 0, 0))
CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]  # normals outward
TRIANGLES = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]


@wp.kernel
def estimate(
    offset: int,
    tree: SplatTreeStruct,
    scene: Scene,
    look: Lookup,
    x: wp.array[wp.vec3],
    n: wp.array[wp.vec3],
    result: wp.array[Density],
):
    """Irradiance at each point."""
    i = offset + wp.tid()
    result[i] = density(tree, scene, look, x[i], n[i], 0.0, i, 0)


@wp.kernel
def search(
    offset: int,
    tree: SplatTreeStruct,
    centres: SplatTreeStruct,
    covers: SplatTreeStruct,
    x: wp.array[wp.vec3],
    n: wp.array[wp.vec3],
    k: int,
    guess2: float,
    limit2: float,
    scale2: float,
    stretch: float,
    facing: float,
    result: wp.array[vec8],
    near: wp.array[vec8],
    place: wp.array[int],
):
    """The three searches at each point."""
    i = offset + wp.tid()
    result[i] = nearest_photons(tree, x[i], n[i], k, guess2, limit2, scale2, stretch, facing, 0)
    near[i] = near_photons(tree, x[i], n[i], limit2, stretch, facing, 0)
    place[i] = nearest_place(centres, covers, wp.min(limit2, 0.1), x[i], n[i], stretch, facing)


@wp.kernel
def weights(offset: int, v: wp.array[float], shape: int, result: wp.array[float]):
    """Kernel over v = d^2 / h^2."""
    i = offset + wp.tid()
    result[i] = kernel_weight(v[i], shape)


def source_of(scene, seed=0, sampler=INDEPENDENT, **device):
    return PhotonSource(DeviceScene(scene, gi.Device("cpu", **device)), seed, int(sampler))


def arrays(shot):
    p = shot.photons
    return [a.numpy()[: shot.count] for a in (p.position, p.normal, p.flux, p.kind)]


def flux_z(shot, expected):
    """Standard errors between the sum of the photons' flux and what is expected, first channel.

    Where every path carries the same, float32 is all that is off: cosines of a narrow spot leave 1e-5 of it.
    """
    flux = shot.photons.flux.numpy()[:, 0].astype(np.float64)
    ends = np.cumsum(shot.stored)
    sums = np.append(0.0, np.cumsum(flux))
    each = sums[ends] - sums[ends - shot.stored]
    return (each.sum() - expected) / max(each.std(ddof=1) * math.sqrt(len(each)), 1e-5 * expected)


@pytest.mark.parametrize("albedo", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_flux_balance(albedo):
    """In a closed room the photons' flux adds up to that of the lights over 1 - albedo."""
    scene, _ = room(albedo=albedo, flux=100.0)
    assert abs(flux_z(source_of(scene).shoot(20_000, 0), 100.0 / (1.0 - albedo))) < Z_LIMIT
    for shape in ("cube", "blocks"):
        scene, _ = furnace(albedo=albedo, emission=2.0, shape=shape)
        emitted = math.pi * 2.0 * scene.shapes[0].areas().sum()
        assert abs(flux_z(source_of(scene).shoot(20_000, 0), emitted / (1.0 - albedo))) < Z_LIMIT


def box(scale, flip=False, **shape):
    faces = [face[::-1] for face in TRIANGLES] if flip else TRIANGLES
    return gi.Shape(np.multiply(CUBE, scale), faces, **shape)


PANE = ([(-0.2, 0, -0.2), (0.2, 0, -0.2), (0.2, 0, 0.2), (-0.2, 0, 0.2)], [(0, 1, 2), (0, 2, 3)])
INNER, OUTER = 0.3, 0.7
SPOT_ANGLE = 2.0 * math.pi * (1.0 - (2.0 * math.cos(INNER) + math.cos(OUTER)) / 3.0)
SUN = np.array([1.0, -2.0, 0.5]) / math.sqrt(5.25)
INSIDE = {  # in a black closed box: flux in W
    "point": ([gi.PointLight((0.3, 0.1, 0.2), 3.0)], None, 4.0 * math.pi * 3.0),
    "spot": ([gi.SpotLight((0.3, 0.1, 0.2), (1, 2, 3), 3.0, INNER, OUTER)], None, 3.0 * SPOT_ANGLE),
    "narrow spot": (
        [gi.SpotLight((0, 0, 0), (0, -1, 0), 3.0, 0.05, 0.06)],
        None,
        3.0 * 2.0 * math.pi * (1.0 - (2.0 * math.cos(0.05) + math.cos(0.06)) / 3.0),
    ),
    "area": ([], gi.Emissive(3.0), math.pi * 3.0 * 0.16),
    "two-sided area": ([], gi.Emissive(3.0, two_sided=True), 2.0 * math.pi * 3.0 * 0.16),
    "several": (
        [gi.PointLight((0.3, 0.1, 0.2), 3.0), gi.PointLight((-0.5, 0.1, 0.2), 0.01)],
        gi.Emissive(3.0),
        math.pi * (4.0 * 3.01 + 3.0 * 0.16),
    ),
}


@pytest.mark.parametrize("name", INSIDE)
def test_lights_in_a_box_emit_their_power(name):
    """Every light's photons carry its radiant flux, by its closed form."""
    lights, emission, expected = INSIDE[name]
    black = gi.Diffuse(0.0)
    shapes = [box(2.0, flip=True, material=black), gi.Shape(*PANE, material=black, emission=emission)]
    shot = source_of(gi.Scene(shapes, CAMERA, lights)).shoot(50_000, 0)
    assert abs(flux_z(shot, expected)) < Z_LIMIT
    assert (shot.stored == 1).all()


@pytest.mark.parametrize(
    ("light", "expected"),
    [(gi.DistantLight(tuple(SUN), 5.0), 5.0 * np.abs(SUN).sum()), (gi.Environment(2.0), 2.0 * math.pi * 6.0)],
    ids=["distant", "environment"],
)
def test_lights_from_outside(light, expected):
    """A convex body gets irradiance times its shadow from the sun, and pi L times its area from a sky."""
    shot = source_of(gi.Scene([box(1.0, material=gi.Diffuse(0.0))], CAMERA, [light])).shoot(50_000, 0)
    assert abs(flux_z(shot, expected)) < Z_LIMIT


def test_a_spot_is_as_bright_as_its_cone_says():
    """The mean cosine to a spot's axis, over its flux, is that of KHR_lights_punctual's intensity."""
    shapes = [box(2.0, flip=True, material=gi.Diffuse(0.0))]
    shot = source_of(gi.Scene(shapes, CAMERA, [gi.SpotLight((0, 0, 0), (0, -1, 0), 3.0, INNER, OUTER)])).shoot(
        50_000, 0
    )
    position, _, flux, _ = (a.astype(np.float64) for a in arrays(shot))
    cosine = -position[:, 1] / np.linalg.norm(position, axis=1)
    inner, outer = math.cos(INNER), math.cos(OUTER)
    c = np.linspace(outer, 1.0, 100_001)
    intensity = np.clip((c - outer) / (inner - outer), 0.0, 1.0) ** 2
    error = cosine.std() / math.sqrt(len(cosine))
    assert abs((cosine * flux[:, 0]).sum() / flux[:, 0].sum() - (c * intensity).sum() / intensity.sum()) < 4.4 * error


def test_aimed_flux_in_closed_form():
    """A window of a glass that does nothing, as wide as a cube's side, gets a sixth of a point light's flux."""
    window = gi.Shape(np.subtract(np.multiply(PANE[0], (5, 1, 5)), (0, 1, 0)), PANE[1], gi.Dielectric(1.0))
    scene = gi.Scene([box(6.0, flip=True, material=gi.Diffuse(0.0)), window], CAMERA, [gi.PointLight((0, 0, 0), 1.0)])
    shot = source_of(scene).shoot_caustics(50_000, 0)
    assert abs(flux_z(shot, 4.0 * math.pi / 6.0)) < Z_LIMIT
    assert shot.count > 0.4 * shot.paths


@pytest.mark.parametrize("degrees", [0.0, 60.0, 85.0])
def test_coats_let_light_in_by_its_angle(degrees):
    """A coated floor's photons are what its coat lets through of a sun's light, over the mean of all directions."""
    material = gi.Coated(0.5, 0.1)
    square = gi.Shape([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [(0, 2, 1), (0, 3, 2)], material)
    angle = math.radians(degrees)
    scene = gi.Scene([square], CAMERA, [gi.DistantLight((math.sin(angle), -math.cos(angle), 0.0), 1.0)])
    shot = source_of(scene).shoot(50_000, 0)
    coat = fit_coat(material.roughness, material.ior)
    cos = math.cos(angle)
    bound = float((1.0 - cos) ** np.array(POWERS) @ coat.coefficients)
    reflected = min(bound, float(smooth_fresnel(np.array(cos), material.ior)) + coat.excess, 1.0)
    assert abs(flux_z(shot, 4.0 * cos * (1.0 - reflected) / coat.transmitted)) < Z_LIMIT


def test_photons_are_of_equal_power():
    """Roulette keeps the largest channel of the flux, whatever surfaces do to it."""
    flux = arrays(source_of(gi.scenes.cornell_box()).shoot(5000, 0))[2]
    # each scattering rounds twice
    np.testing.assert_allclose(flux.max(axis=1), flux.max(), rtol=100 * 2.0**-23)


def test_kinds_of_photons():
    """First hits are direct light; behind mirror or glass come caustics; after a diffuse surface all is indirect, and
    what a caustic sends on is told apart."""
    shot = source_of(gi.scenes.cornell_box()).shoot(5000, 0)
    kind = arrays(shot)[3]
    first = np.cumsum(shot.stored) - shot.stored
    first = first[shot.stored > 0]
    assert (kind[first] == DIRECT).all()
    assert (np.delete(kind, first) == INDIRECT).all()
    wide = np.multiply(PANE[0], (20, 1, 20))
    floor = gi.Shape(np.subtract(wide, (0, 1, 0)), [face[::-1] for face in PANE[1]], gi.Diffuse(0.5))
    mirror = gi.Shape(np.add(wide, (0, 1, 0)), PANE[1], gi.Mirror(1.0))
    up = gi.SpotLight((0, 0, 0), (0, 1, 0), 1.0, 0.1, 0.2)
    shot = source_of(gi.Scene([floor, mirror], CAMERA, [up])).shoot(1000, 0)
    kind = arrays(shot)[3]
    first = np.cumsum(shot.stored) - shot.stored
    assert (kind[first] == CAUSTIC).all()
    # from the floor over the mirror to the floor, that often
    for number, expected in enumerate((ECHO, INDIRECT, INDIRECT), 1):
        assert (kind[first[shot.stored > number] + number] == expected).all()
    assert shot.stored.max() > 3


@pytest.mark.parametrize("name", ["caustic", "cornell-spheres"])
def test_aimed_caustics_bring_the_same_flux(name):
    """Aiming at what makes caustics changes neither flux nor place, and finds more of them."""
    source = source_of(gi.scenes.build(name))
    every, aimed = source.shoot(100_000, 0), source.shoot_caustics(50_000, 0)
    position, _, flux, kind = arrays(every)
    some = kind == CAUSTIC
    centre, flux = position[some].mean(axis=0), flux[some].astype(np.float64)
    others, _, other_flux, _ = arrays(aimed)
    # counts are near Poisson's, and aimed photons not all equal
    error = math.sqrt((flux[:, 0] ** 2).sum() + (other_flux[:, 0].astype(np.float64) ** 2).sum())
    assert abs(flux[:, 0].sum() - other_flux[:, 0].sum(dtype=np.float64)) < Z_LIMIT * error
    weight = other_flux[:, :1] / other_flux[:, 0].sum()
    spread = position[some].std(axis=0) * math.sqrt(1.0 / some.sum() + (weight**2).sum())
    assert (np.abs(centre - (others * weight).sum(axis=0)) < Z_LIMIT * spread).all()
    assert aimed.count / aimed.paths > 2.0 * some.sum() / every.paths


@pytest.mark.parametrize("sampler", [INDEPENDENT, SOBOL])
def test_photons_do_not_depend_on_threads_or_slots(monkeypatch, sampler):
    """The same arrays to the last bit for any number of threads, batches and slots."""
    scene, _ = room(albedo=0.8)
    one = arrays(source_of(scene, sampler=sampler, threads=1).shoot(3000, 5))
    monkeypatch.setattr(warpgi.photons, "SLOTS", 1)
    monkeypatch.setattr(warpgi.photons, "BATCH", 700)
    two = arrays(source_of(scene, sampler=sampler, threads=2, chunk=37).shoot(3000, 5))
    other = arrays(source_of(scene, sampler=sampler).shoot(3000, 6))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(other[0]) != len(one[0]) or (other[0] != one[0]).any()


def test_no_light_no_photons_and_no_memory_no_photons():
    """A dark scene has none; too many for the device are refused in one sentence."""
    dark = gi.Scene([box(1.0)], CAMERA)
    assert source_of(dark).shoot(1000, 0).count == 0
    with pytest.raises(ValueError, match="memory_limit is 100 bytes, expected more than"):
        source_of(room()[0], memory_limit=100).shoot(1000, 0)


def metric2(points, x, n, stretch):
    d = points - x
    return (d * d).sum(axis=1) + stretch * (d @ n) ** 2


@pytest.mark.parametrize("limit", [np.inf, 0.3])
@pytest.mark.parametrize("guess", [0.0, 1e-6, 100.0])
def test_search_equals_brute_force(limit, guess):
    """k nearest, all within a radius, and the nearest that reaches the point: as by looking at every photon, with
    normals and plane heeded."""
    scene, _ = leak(thickness=0.01)
    source = source_of(scene)
    shot = source.shoot(1000, 0)
    position, normal, flux, _ = (a.astype(np.float64) for a in arrays(shot))
    tree = source.tree(shot, np.arange(shot.count, dtype=np.int32))
    rng = np.random.default_rng(1)
    count, k, stretch, facing = 200, 20, 3.0, 0.5
    x = rng.uniform(position.min(axis=0), position.max(axis=0), (count, 3)).astype(np.float32)
    x[::2] = position[rng.integers(0, shot.count, len(x[::2]))]
    n = normal[rng.integers(0, shot.count, count)].astype(np.float32)
    limit2 = min(limit**2, 1e30)
    device = source.device
    found, near = (device.zeros(count, vec8) for _ in range(2))
    place = device.zeros(count, int)
    covers, reach2 = source.tree(shot, np.arange(shot.count, dtype=np.int32)), rng.uniform(0.0, 0.2, shot.count)
    centres = covers.with_present_boxes()
    covers.set_radius2(device.array(reach2[covers.order.numpy()], float))
    covers.refit_as_balls()
    points = [device.array(x, wp.vec3), device.array(n, wp.vec3)]
    device.launch(
        search,
        count,
        [tree.struct, centres, covers.struct, *points, k, guess, limit2, 1.0, stretch, facing],
        [found, near, place],
    )
    finer, unused = device.zeros(count, vec8), [device.zeros(count, vec8), device.zeros(count, int)]
    inputs = [tree.struct, centres, covers.struct, *points, k, guess, limit2, 0.25, stretch, facing]
    device.launch(search, count, inputs, [finer, *unused])
    order, place = covers.order.numpy(), place.numpy()
    assert 0.1 < (place >= 0).mean() < 1.0
    for i in range(count):
        m2 = metric2(position, x[i].astype(np.float64), n[i].astype(np.float64), stretch)
        taken = np.flatnonzero(normal @ n[i] > facing)
        covering = taken[m2[taken] <= reach2[taken]]
        if place[i] < 0:
            assert len(covering) == 0
        else:
            assert m2[order[place[i]]] == pytest.approx(m2[covering].min(), rel=1e-5, abs=1e-12)
        taken = taken[(m2[taken] > 0.0) & (m2[taken] < limit2)]
        taken = taken[np.argsort(m2[taken])]
        sums, h2 = flux[taken[: k - 1]].sum(axis=0), m2[taken[k - 1]] if len(taken) >= k else limit2
        if len(taken) < k:
            sums = flux[taken].sum(axis=0)
        assert found.numpy()[i][3] == pytest.approx(h2, rel=1e-5)
        # a finer map's radius is a part of that, and so are its photons
        assert finer.numpy()[i][3] == pytest.approx(0.25 * h2, rel=1e-5)
        inner = flux[taken[m2[taken] < 0.25 * h2]].sum(axis=0)
        np.testing.assert_allclose(finer.numpy()[i][:3], inner, rtol=1e-5)
        np.testing.assert_allclose(found.numpy()[i][:3], sums, rtol=1e-5)
        if limit < np.inf:
            np.testing.assert_allclose(near.numpy()[i][:3], flux[taken].sum(axis=0), rtol=1e-5)
            assert near.numpy()[i][4] == len(taken)


@pytest.mark.parametrize("k", [2, 3, 50, 256])
def test_radii_equal_scipys(k):
    """The k-th photon is as far away as scipy's cKDTree says, for any k."""
    source = source_of(room()[0])
    shot = source.shoot(2000, 0)
    tree = source.tree(shot, np.arange(shot.count, dtype=np.int32))
    x, n = arrays(shot)[0][:300] + np.float32(1e-3), arrays(shot)[1][:300]
    device = source.device
    found, near, place = device.zeros(300, vec8), device.zeros(300, vec8), device.zeros(300, int)
    inputs = [
        tree.struct,
        tree.struct,
        tree.struct,
        device.array(x, wp.vec3),
        device.array(n, wp.vec3),
        k,
        0.0,
        1e30,
        1.0,
        0.0,
        -2.0,
    ]
    device.launch(search, 300, inputs, [found, near, place])
    expected = cKDTree(arrays(shot)[0]).query(x, k=k)[0][:, -1]
    np.testing.assert_allclose(np.sqrt(found.numpy()[:, 3]), expected, rtol=1e-5)


@pytest.mark.parametrize("kernel", gi.Kernel)
def test_kernels_integrate_to_one(kernel):
    """The integral of K(v) over the disc, v from 0 to 1, is 1, and K is nowhere below 0."""
    v = ((np.arange(10_000) + 0.5) / 10_000).astype(np.float32)
    device = gi.Device("cpu")
    result = device.zeros(len(v), float)
    device.launch(weights, len(v), [device.array(v, float), int(SHAPES[kernel])], [result])
    # the midpoint rule is exact to 1e-6 here but for the cone's root at 0; float32 sums add as much
    assert result.numpy().mean(dtype=np.float64) == pytest.approx(1.0, abs=1e-5)
    assert (result.numpy() >= 0.0).all()


def plane_estimates(kernel, neighbours, at_edge, edge_rays, radius=None):
    """Irradiance over the true one at points so far apart that they share no photons, on an evenly lit square."""
    square = gi.Shape([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [(0, 2, 1), (0, 3, 2)], gi.Diffuse(0.5))
    scene = gi.Scene([square], CAMERA, [gi.DistantLight((0.3, -1.0, 0.2), 1.0)])
    method = gi.PhotonMap(kernel=kernel, neighbours=neighbours, radius=radius, edge_rays=edge_rays)
    device = gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    mapping = Mapping(method, Job(on_device, on_device.camera((8, 8)), (8, 8), 0, device))
    source = source_of(scene, seed=1)
    shot = source.shoot(200_000, 0)
    tree = source.tree(shot, np.arange(shot.count, dtype=np.int32))
    # some 128 000 photons on 4 m^2: 50 of them reach 0.0225 m
    a = np.linspace(-0.9, 0.9, 19)
    if at_edge:
        x = np.concatenate([np.stack([a, 0 * a, s * np.ones(19)], axis=1) for s in (-1, 1)])
        x = np.concatenate([x, x[:, ::-1]]) * 0.999999
    else:
        x = np.stack([*np.meshgrid(a, [0.0], a)], axis=-1).reshape(-1, 3)
    n = np.tile((0.0, 1.0, 0.0), (len(x), 1))
    result = device.zeros(len(x), Density)
    look = mapping.lookup(neighbours, radius, 1.0)
    inputs = [tree.struct, on_device.struct, look, device.array(x, wp.vec3), device.array(n, wp.vec3)]
    device.launch(estimate, len(x), inputs, [result])
    irradiance = 1.0 / math.sqrt(1.0 + 0.3**2 + 0.2**2)
    return result.numpy()["irradiance"][:, 0].astype(np.float64) / irradiance


@pytest.mark.parametrize("radius", [None, 0.02])
@pytest.mark.parametrize("kernel", gi.Kernel)
def test_even_light_on_a_plane(kernel, radius):
    """The estimate's mean is the true irradiance for each kernel, k-nearest and fixed radius, and at the edge too."""
    neighbours = 50 if radius is None else 0
    inner = plane_estimates(kernel, neighbours, False, 0, radius)
    error = inner.std(ddof=1) / math.sqrt(len(inner))
    assert abs(inner.mean() - 1.0) < Z_LIMIT * error
    # without the correction the disc is half empty; k-nearest reaches sqrt 2 as far, and finds the same half
    bare = plane_estimates(kernel, neighbours, True, 0, radius)
    assert bare.mean() == pytest.approx(0.5, abs=Z_LIMIT * bare.std(ddof=1) / math.sqrt(len(bare)))
    edge = plane_estimates(kernel, neighbours, True, 64, radius)
    assert abs(edge.mean() - 1.0) < Z_LIMIT * edge.std(ddof=1) / math.sqrt(len(edge))
    # and the spread is what the photons in a kernel make it
    assert 0.5 < inner.std() / (1.0 / math.sqrt(40.0)) < 2.0
