"""Light-field reconstruction of glossy surfaces, against closed forms, path tracing and the diffuse reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpgi as gi
from warpgi.glossy_reconstruction import GlossyReconstruction
from warpgi.kernels.glossy_light_field import Lobes
from warpgi.kernels.glossy_splats import largest_lobe
from warpgi.samples import SampleBuffer, unit

wp.set_module_options({"enable_backward": False})

# Two parts of a floor, each seen from its own eye: both look at the ceiling, the second at half of what the first sees.
EYES = np.array([(0.0, -4.0, 3.0), (3.0, -3.0, 3.0)])
MIDDLES = np.array([(0.0, 0.0, 0.0), (1.75, 0.25, 0.0)])
FLOOR = gi.Conductor(2e-3, (0.9, 0.7, 0.5))
CEILING_EXPONENT = 900.0
SIZE, SPP = 40, 8


def reflect(d, n):
    return d - 2.0 * (d * n).sum(-1, keepdims=True) * n


def blinn_rays(normal, wo, material, u):
    """Directions and f cos / pdf of a rough metal by its half vectors, in numpy; shapes (..., 3)."""
    e = 1.0 / material.roughness
    cos_h = u[..., 0] ** (1.0 / (e + 1.0))
    sin_h, phi = np.sqrt(1.0 - cos_h**2), 2.0 * np.pi * u[..., 1]
    h = np.stack([sin_h * np.cos(phi), sin_h * np.sin(phi), cos_h], axis=-1)  # about the normal +z
    oh = (wo * h).sum(-1)
    d = 2.0 * oh[..., None] * h - wo
    cos_o, cos_i = (wo * normal).sum(-1), (d * normal).sum(-1)
    g = np.minimum(1.0, 2.0 * cos_h * np.minimum(cos_o, cos_i) / oh)
    f = np.asarray(material.reflectance) + (1.0 - np.asarray(material.reflectance)) * (1.0 - oh[..., None]) ** 5
    return d, f * (g * (e + 2.0) / (e + 1.0) * oh / cos_o)[..., None]


def highlight(d, sun):
    """Light that a glossy ceiling sends against rays along d: one lobe about the mirrored sun, as its BSDF would."""
    away = (reflect(d, np.array([0.0, 0.0, 1.0])) * sun).sum(-1) - 1.0
    return np.exp(0.25 * CEILING_EXPONENT * away)[..., None] * np.array([1.0, 0.8, 0.6])


@pytest.fixture(scope="module")
def ceiling():
    """A buffer of a rough metal floor that sees a glossy ceiling, and its first part's picture by quadrature."""
    rng = np.random.default_rng(3)
    up = np.array([0.0, 0.0, 1.0])
    sun = unit(np.array([[0.0, 0.8, -0.6]]))[0].astype(np.float64)
    pixel = np.arange(2 * SIZE * SIZE * SPP) // SPP
    x, y = pixel % (2 * SIZE), pixel // (2 * SIZE)
    part = x // SIZE
    origin = np.zeros((len(pixel), 3))
    origin[:, :2] = 2.0 * (np.stack([x % SIZE, y], axis=-1) + rng.random((len(pixel), 2))) / SIZE - 1.0
    origin += MIDDLES[part]
    wo = unit(EYES[part] - origin).astype(np.float64)
    d, _ = blinn_rays(up, wo, FLOOR, rng.random((len(pixel), 2)))
    samples = SampleBuffer(
        2 * SIZE,
        SIZE,
        SPP,
        radiance=highlight(d, sun).astype(np.float32),
        origin=origin.astype(np.float32),
        hit=(origin + d / d[:, 2:]).astype(np.float32),
        origin_normal=np.broadcast_to(up, origin.shape).astype(np.float32),
        hit_normal=np.broadcast_to(-up, origin.shape).astype(np.float32),
        albedo=np.ones(origin.shape, np.float32),
        bandwidth=np.full(len(pixel), CEILING_EXPONENT, np.float32),
        wo=wo.astype(np.float32),
        material=np.zeros(len(pixel), np.int32),
        reflectance=np.broadcast_to(FLOOR.reflectance, origin.shape).astype(np.float32),
        materials=(FLOOR,),
    )
    side = 24
    strata = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2) + 0.5) / side
    rays, weight = blinn_rays(up, wo[None, part == 0][:, ::2], FLOOR, strata)
    truth = (highlight(rays, sun) * weight).mean(axis=0)
    return samples, truth.reshape(SIZE, SIZE, SPP // 2, 3).mean(axis=2)


def shape_of(picture):
    """Centroid and standard deviation of a highlight, both in pixels, shape (2,)."""
    weight = picture.sum(axis=-1, dtype=np.float64)
    at = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) + 0.5
    centre = (at * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
    return centre, np.sqrt((np.square(at - centre) * weight[..., None]).sum(axis=(0, 1)) / weight.sum())


def test_a_highlight_keeps_place_and_width(ceiling):
    """Light that varies with direction is put where it belongs: to half a pixel, as wide as it is to 5 %.

    Taken for diffuse, the same samples blur and shift it by more.
    """
    samples, truth = ceiling
    centre, width = shape_of(truth)
    found = {}
    for bandwidth in (True, False):
        picture = gi.reconstruct(samples, gi.LightField(rays=512, bandwidth=bandwidth)).layers["indirect"][:, :SIZE]
        found[bandwidth] = shape_of(picture)
        print(bandwidth, found[bandwidth], centre, width, gi.compare(picture, truth.astype("f4")))
    assert np.abs(found[True][0] - centre).max() < 0.5
    assert np.abs(found[True][1] / width - 1.0).max() < 0.05
    assert np.abs(found[False][0] - centre).max() > 0.5
    assert np.abs(found[False][1] / width - 1.0).max() > 0.05


def test_no_bandwidth_at_all_is_the_diffuse_path():
    """A buffer whose bandwidths are 0 gives the same bits as one without: no lobe is made, and none is looked for."""
    for samples in (
        gi.sample(gi.scenes.cornell_box(), spp=4, size=(16, 16), recursive=True),
        gi.sample(gi.scenes.furnace(albedo=0.5, shape="blocks")[0], spp=4, size=(12, 12), recursive=True),
    ):
        for recursive in (0, 1):
            method = gi.LightField(rays=256, recursive=recursive)
            plain = gi.reconstruct(samples, method)
            zero = replace(samples, bandwidth=np.zeros(len(samples), np.float32))
            state = method.reconstruction(zero, gi.Device("cpu"), 0)
            assert isinstance(state, GlossyReconstruction)
            glossy = gi.reconstruct(zero, method)
            np.testing.assert_array_equal(glossy.layers["indirect"].view("u4"), plain.layers["indirect"].view("u4"))
            assert glossy.counts.pop("lobes") == 0 and glossy.counts == plain.counts


@wp.kernel
def query(
    lobes: Lobes,
    x: wp.array[wp.vec3],
    n: wp.array[wp.vec3],
    d: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    found: wp.array[int],
):
    i = wp.tid()
    found[i] = largest_lobe(lobes.tree, lobes.axes, lobes.cones, x[i], n[i], d[i], axis[i], 2.0, lobes.stretch)


def bumpy(count=700, seed=5):
    """Samples of a bumpy glossy ceiling, seen from all about below, of two bandwidths."""
    rng = np.random.default_rng(seed)
    hit = np.concatenate([rng.uniform(-1.0, 1.0, (count, 2)), np.ones((count, 1))], axis=1)
    hit[:, 2] += 0.05 * np.sin(5.0 * hit[:, 0])
    slope = np.stack([0.25 * np.cos(5.0 * hit[:, 0]), np.zeros(count), -np.ones(count)], axis=1)
    origin = np.concatenate([rng.uniform(-1.0, 1.0, (count, 2)), np.zeros((count, 1))], axis=1)
    up = np.tile(np.float32([0, 0, 1]), (count, 1))
    light = {"radiance": rng.random((count, 3)).astype("f4"), "albedo": np.ones((count, 3), "f4")}
    bandwidth = np.where(rng.random(count) < 0.5, 4.0, 60.0).astype("f4")
    points = {"origin": origin.astype("f4"), "hit": hit.astype("f4"), "origin_normal": up, "hit_normal": unit(slope)}
    return SampleBuffer(count, 1, 1, **light, **points, bandwidth=bandwidth)


def test_lobes_against_brute_force():
    """Sizes are the distance of the k-th neighbour of like direction, and the largest filter is found, as all say."""
    samples = bumpy()
    state = gi.LightField().reconstruction(samples, gi.Device("cpu"), 0)
    order = state.lobe_tree.order.numpy()
    hit, n = samples.hit[order].astype(np.float64), samples.unit_hit_normal[order].astype(np.float64)
    axis, kappa = reflect(samples.direction[order].astype(np.float64), n), samples.kappa[order].astype(np.float64)
    apart = hit[None] - hit[:, None]
    plain2 = np.square(apart).sum(-1)
    metric2 = plain2 + 8.0 * np.einsum("ijk,ik->ij", apart, n) ** 2
    faces = n @ n.T > 0.1
    wanted = []
    for i in range(len(hit)):
        near = np.sort(np.where(faces[i] & (np.arange(len(hit)) != i), metric2[i], np.inf))
        first = np.flatnonzero(metric2[i] == near[10])[0]
        limit = plain2[i, first] * 1000.0 / 12.0 * 1.001
        threshold = 0.5
        while True:
            alike = np.exp(kappa[i] * (axis @ axis[i] - 1.0)) >= threshold
            usable = np.flatnonzero(alike & faces[i] & (metric2[i] < limit) & (np.arange(len(hit)) != i))
            if len(usable) >= 11 or threshold <= 0.01:
                break
            threshold = max(0.75 * threshold, 0.01)
        usable = usable[np.argsort(metric2[i, usable])][:11]
        wanted.append(np.sqrt(plain2[i, usable[-1]] if len(usable) else plain2[i, first]))
    radii = state.lobe_tree.radii().astype(np.float64)
    # rounding decides otherwise where a direction lies on the threshold
    assert np.isclose(radii, wanted, rtol=1e-4).mean() > 0.99

    rng = np.random.default_rng(6)
    count = 400
    place = rng.integers(0, len(hit), count)
    x = (hit[place] + rng.normal(0.0, 0.02, (count, 3))).astype("f4")
    d = unit(np.concatenate([rng.uniform(-1, 1, (count, 2)), np.ones((count, 1))], axis=1))
    mirrored = reflect(d, n[place].astype("f4"))
    inputs = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (x, n[place].astype("f4"), d, mirrored)]
    found = wp.zeros(count, dtype=int, device="cpu")
    centre = 0.5 * (samples.hit.min(axis=0) + samples.hit.max(axis=0))
    assert np.allclose(state._hits.numpy(), samples.hit - centre, atol=1e-6)
    inputs[0] = wp.array((x - centre).astype("f4"), dtype=wp.vec3, device="cpu")
    wp.launch(query, count, inputs=[state.lobes, *inputs], outputs=[found], device="cpu")
    found = found.numpy()
    away = x[:, None] - hit
    part2 = (np.square(away).sum(-1) + 8.0 * (away * n).sum(-1) ** 2) / radii**2
    spatial = np.minimum(1.0, (1.0 - np.sqrt(part2)) / np.minimum(1.0, radii / 2.0))
    usable = (part2 < 1.0) & (d @ n.T < 0.0) & (n[place] @ n.T > 0.5)
    value = np.where(usable, np.exp(kappa * (mirrored @ axis.T - 1.0)) * spatial, -1.0)
    best = value.max(axis=1)
    assert ((best > 0.0) == (found >= 0)).mean() > 0.99
    met = (found >= 0) & (best > 0.0)
    assert met.mean() > 0.8
    np.testing.assert_allclose(value[np.arange(count), found][met], best[met], rtol=1e-3, atol=1e-9)


def room(floor, ceiling):
    """A floor seen from the side, under a ceiling that a light from below lights."""

    def flat(material, height, size, faces):
        corners = [(-size, height, -size), (-size, height, size), (size, height, size), (size, height, -size)]
        return gi.Shape(corners, faces, material)

    shapes = [flat(floor, 0.0, 1.0, [(0, 1, 2), (0, 2, 3)]), flat(ceiling, 1.0, 4.0, [(0, 2, 1), (0, 3, 2)])]
    camera = gi.Camera((0.0, 0.6, 1.6), (0.0, 0.0, 0.0), fov=40)
    return gi.Scene(shapes, camera, [gi.PointLight((0.3, 0.5, -0.2), (2.0, 1.5, 1.0))])


@pytest.mark.parametrize("ceiling", [gi.Coated(0.5, 0.02), gi.Conductor(0.02), gi.Mirror(0.8)])
def test_energy(ceiling):
    """Over a coated floor the picture's mean light is path tracing's to 2 %, under a mirror too."""
    scene, size = room(gi.Coated(0.6, 0.05), ceiling), (24, 24)
    means = [gi.render(scene, gi.LightField(spp=8, rays=64), size, seed=s).layers["indirect"].mean() for s in range(8)]
    truth = [gi.render(scene, gi.PathTracing(spp=128), size, seed=100 + s).layers["indirect"].mean() for s in range(8)]
    error = np.sqrt((np.var(means, ddof=1) + np.var(truth, ddof=1)) / 8)
    assert abs(np.mean(means) - np.mean(truth)) < 0.02 * np.mean(truth) + 3.0 * error
    assert error < 0.025 * np.mean(truth)


def test_a_spot_in_a_mirror_keeps_place_and_width():
    """A spot on a wall below, seen in a mirror above by way of the floor: half a pixel of place, 5 % of width.

    Without the segment after the mirror what is left is the mirror's own light, in the wrong place or wide.
    """
    rng = np.random.default_rng(4)
    up = np.array([0.0, 0.0, 1.0])
    pixel = np.arange(SIZE * SIZE * SPP) // SPP
    origin = np.zeros((len(pixel), 3))
    origin[:, :2] = 2.0 * (np.stack([pixel % SIZE, pixel // SIZE], axis=-1) + rng.random((len(pixel), 2))) / SIZE - 1.0
    wo = unit(EYES[0] - origin).astype(np.float64)

    def along(rays, start):
        """Where rays meet the mirror at height 1, the wall at -1 behind it, and what comes from there."""
        met = start + rays / rays[..., 2:]
        wall = met + reflect(rays, up) / rays[..., 2:] * 2.0
        away2 = np.square(wall[..., :2] - [0.1, 4.2]).sum(-1)
        return met, wall, np.exp(-away2 / 0.18)[..., None] * np.array([1.0, 0.8, 0.6])

    d, _ = blinn_rays(up, wo, FLOOR, rng.random((len(pixel), 2)))
    met, wall, light = along(d, origin)

    def rows(vector):
        return np.broadcast_to(vector, origin.shape).astype(np.float32)

    ends = {"origin": met, "hit": wall, "origin_normal": rows(-up), "hit_normal": rows(up), "radiance": light}
    every = np.arange(len(pixel), dtype=np.int32)
    ends = {name: value.astype(np.float32) for name, value in ends.items()}
    beyond = SampleBuffer(len(pixel), 1, 0, pixel=every, albedo=rows(0.8), **ends)
    samples = SampleBuffer(
        SIZE,
        SIZE,
        SPP,
        radiance=(0.8 * light).astype(np.float32),
        origin=origin.astype(np.float32),
        hit=met.astype(np.float32),
        origin_normal=rows(up),
        hit_normal=rows(-up),
        albedo=rows(1.0),
        bandwidth=np.full(len(pixel), 1e6, np.float32),
        wo=wo.astype(np.float32),
        material=np.zeros(len(pixel), np.int32),
        reflectance=rows(FLOOR.reflectance),
        materials=(FLOOR,),
        beyond=beyond,
    )
    side = 24
    strata = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2) + 0.5) / side
    rays, weight = blinn_rays(up, wo[None, ::2], FLOOR, strata)
    truth = (0.8 * along(rays, origin[None, ::2])[2] * weight).mean(axis=0)
    truth = truth.reshape(SIZE, SIZE, SPP // 2, 3).mean(axis=2)
    centre, width = shape_of(truth)
    picture = gi.reconstruct(samples, gi.LightField(rays=256)).layers["indirect"]
    found = shape_of(picture)
    print(found, centre, width, picture.mean() / truth.mean())
    assert np.abs(found[0] - centre).max() < 0.5
    assert np.abs(found[1] / width - 1.0).max() < 0.05
    assert picture.mean() == pytest.approx(truth.mean(), rel=0.02)
    blurred = shape_of(gi.reconstruct(replace(samples, beyond=None), gi.LightField(rays=256)).layers["indirect"])
    print(blurred)
    assert np.abs(blurred[1] / width - 1.0).max() > 0.05 or np.abs(blurred[0] - centre).max() > 0.5


def test_mirrors_are_walked_on_from():
    """A floor under a mirror: light found at the next segment is nearer to the truth than light of the mirror itself.

    Taken for the mirror's own, as if sent in all directions or in a narrow lobe, it is the light of the wrong place.
    """
    scene, size = room(gi.Diffuse(0.6), gi.Mirror(0.8)), (24, 24)
    truth = np.mean(
        [gi.render(scene, gi.PathTracing(spp=256), size, seed=100 + s).layers["indirect"] for s in range(2)], axis=0
    )
    method = gi.LightField(spp=8, rays=128)
    samples = gi.sample(scene, 8, size, glossy=True)
    assert samples.beyond is not None and samples.beyond.checked.is_splat.sum() > 100
    # the segments join on: what the mirror reflects of one is what comes along the other
    of = samples.beyond.pixel
    np.testing.assert_allclose(samples.hit[of], samples.beyond.origin)
    np.testing.assert_allclose(samples.radiance[of], 0.8 * samples.beyond.radiance, rtol=1e-5)
    n, d = samples.unit_hit_normal[of], samples.direction[of]
    seen = samples.beyond.checked.is_splat
    np.testing.assert_allclose(samples.beyond.direction[seen], reflect(d, n)[seen], atol=1e-4)
    errors = {}
    for name, buffer in (
        ("walked", samples),
        ("lobe", replace(samples, beyond=None)),
        ("diffuse", replace(samples, beyond=None, bandwidth=None)),
    ):
        errors[name] = gi.compare(gi.reconstruct(buffer, method).layers["indirect"], truth)["rmse"]
    assert errors["walked"] < 0.6 * min(errors["lobe"], errors["diffuse"]), errors


def test_same_bits_for_any_threads():
    """Neither the number of threads nor their pieces change a bit, and no light is lost to a layer."""
    samples = gi.sample(room(gi.Coated(0.6, 0.05), gi.Coated(0.5, 0.02)), 4, (16, 16), glossy=True)
    devices = (gi.Device("cpu", 1), gi.Device("cpu", 2, chunk=7), gi.Device("cpu", 3))
    pictures = [gi.reconstruct(samples, gi.LightField(rays=64), device=device).layers["indirect"] for device in devices]
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture.view("u4"), pictures[0].view("u4"))
    # layers apart, and one collapsed bandwidth: the same light, reused otherwise
    collapsed = gi.reconstruct(replace(samples, base_radiance=None), gi.LightField(rays=64)).layers["indirect"]
    assert (collapsed != pictures[0]).any()
    assert collapsed.mean() == pytest.approx(pictures[0].mean(), rel=0.05)


def test_layers_apart_are_nearer_to_the_truth():
    """Light of a coat's diffuse base serves rays of all directions: a fifth less error at least than as one lobe."""
    scene, size = room(gi.Diffuse(0.6), gi.Coated(0.5, 0.02)), (24, 24)
    truth = gi.render(scene, gi.PathTracing(spp=512, max_depth=3), size, seed=100).layers["indirect"]
    samples = gi.sample(scene, 4, size, glossy=True, max_depth=3)
    errors = [
        gi.compare(gi.reconstruct(buffer, gi.LightField(rays=128)).layers["indirect"], truth)["rmse"]
        for buffer in (samples, replace(samples, base_radiance=None))
    ]
    assert errors[0] < 0.8 * errors[1], errors


def test_memory_of_lobes():
    """Diffuse samples cost what they did, 72 bytes on the host and 48 in the tree; a lobe 68 in a tree of its own.

    That is ten floats, its number, and a 64th of a node with an eighth more for the levels above; and a lobe's axis,
    kappa and cones likewise.
    """
    above = 8.0 / 7.0 / 64.0
    splat = 4.0 * (10 + 1 + above * (48 + 1))
    lobe = splat + 4.0 * (4 + above * 56)
    box = gi.sample(gi.scenes.cornell_box(), spp=4, size=(64, 64), glossy=True)
    state = gi.LightField().reconstruction(box, gi.Device("cpu"), 0)
    assert box.bytes_per_sample == 72 and not isinstance(state, GlossyReconstruction)
    assert state.tree.nbytes / state.tree.count == pytest.approx(splat, rel=0.02)
    glossy = gi.sample(room(gi.Diffuse(0.6), gi.Conductor(0.02)), spp=4, size=(64, 64), glossy=True)
    state = gi.LightField().reconstruction(glossy, gi.Device("cpu"), 0)
    assert isinstance(state, GlossyReconstruction) and state.lobe_tree.count == state.tree.count
    arrays = state.lobe_tree.axes.capacity + state.lobe_tree.cones.capacity
    assert (state.lobe_tree.nbytes + arrays) / state.lobe_tree.count == pytest.approx(lobe, rel=0.02)


def test_hair_is_never_brighter_than_its_input():
    """Thin glossy strands under few samples: no pixel sees more radiance than the brightest ray brought."""
    rng = np.random.default_rng(7)
    samples = bumpy(300)
    normal = unit(rng.normal(size=(300, 3)))
    samples = replace(samples, hit_normal=normal, bandwidth=np.full(300, 50.0, np.float32))
    picture = gi.reconstruct(samples, gi.LightField(rays=256))
    assert np.isfinite(picture.layers["indirect"]).all()
    assert picture.layers["indirect"].max() <= samples.radiance.max() * (1.0 + 1e-5)
