"""The irradiance cache against closed forms, conservation and the path tracer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.irradiance import Irradiance, PathSource
from warpgi.job import Job
from warpgi.methods.path import NEVER, Sampler
from warpgi.reconstruction import PrimaryHits
from warpgi.record_cache import COARSEST, RecordCache, grids
from warpgi.records import Records
from warpgi.sampling import path_settings, trace_sample_buffer
from warpgi.traced_reconstruction import TracedReconstruction

SIDE = 64
WHITE = np.ones((SIDE * SIDE, 3), np.float32)


def floor_hits(albedo=WHITE):
    """A picture of the unit square z = 0 from above, a hit in the middle of each pixel."""
    x, y = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE, (np.arange(SIDE) + 0.5) / SIDE)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    return PrimaryHits(points, normals, albedo, 1)


class KnownLight:
    """A source that knows irradiance and its derivative as functions of x and y."""

    def __init__(self, hits, value, slope, radius):
        self.hits, self.value, self.slope, self.radius = hits, value, slope, radius
        self.counts = {}

    def at_points(self, points, normals, keys, rings, sectors):
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        value = np.repeat(self.value(x, y)[:, None], 3, axis=1).astype(np.float32)
        along = [np.broadcast_to(part, x.shape) for part in (*self.slope(x, y), 0.0)]
        translation = np.repeat(np.stack(along, axis=-1)[:, None], 3, axis=1).astype(np.float32)
        distance = np.full(len(x), self.radius, np.float32)
        return Irradiance(value, np.zeros_like(translation), translation, distance, distance)

    def at_hits(self, hits, rays):
        x, y, _ = self.hits.origin[hits].astype(np.float64).T
        return wp.array(np.repeat(self.value(x, y)[:, None], 3, axis=1), dtype=wp.vec3, device="cpu")


def filled(hits, source, device=None, **settings):
    """A cache of that light; one that extrapolates does not think the light's change too fast."""
    caching = gi.IrradianceCache(
        **{"max_radius": 1e9, "min_radius": 0.0, "finest": 1, "spread": 1e9} | settings
    ).caching
    cache = RecordCache(device or gi.Device("cpu"), hits, (SIDE, SIDE), source, caching)
    cache.fill(0, len(cache.rounds))
    return cache


def test_grids_visit_every_pixel_once():
    """All rounds together are every pixel of the finest grid, once."""
    for finest in (1, 2, 4, 32):
        seen = np.zeros((64, 64), int)
        for places in grids(COARSEST, finest):
            for step, x, y in places:
                seen[y::step, x::step] += 1
        start = COARSEST // 2 if finest == COARSEST else 0
        assert (seen[start::finest, start::finest] == 1).all()
        assert seen.sum() == (64 // finest) ** 2


def test_linear_light_is_exact():
    """Between records with exact gradients linear irradiance is met to rounding, and one record could do."""
    hits = floor_hits()
    source = KnownLight(hits, lambda x, y: 3.0 + x - 2.0 * y, lambda x, y: (1.0, -2.0), 0.5)
    cache = filled(hits, source, tolerance=0.3)
    assert 4 < cache.counts["records"] < 400
    x, y, _ = hits.origin.T
    expected = (3.0 + x - 2.0 * y) / np.pi
    found = cache.reflected(1).numpy()
    np.testing.assert_allclose(found, np.repeat(expected[:, None], 3, axis=1), rtol=2e-6)


def test_error_falls_with_the_tolerance():
    """With gradients the error falls as the tolerance squared, without as the tolerance, to the light at every hit."""
    hits = floor_hits()
    source = KnownLight(
        hits,
        lambda x, y: 2.0 + np.sin(5.0 * x) * np.cos(4.0 * y),
        lambda x, y: (5.0 * np.cos(5.0 * x) * np.cos(4.0 * y), -4.0 * np.sin(5.0 * x) * np.sin(4.0 * y)),
        1.0,
    )
    x, y, _ = hits.origin.astype(np.float64).T
    truth = source.value(x, y) / np.pi
    tolerances = np.array([0.4, 0.2, 0.1, 0.05])
    for gradients, least in ((True, 1.7), (False, 0.8)):
        errors = []
        for tolerance in tolerances:
            found = filled(hits, source, tolerance=tolerance, gradients=gradients).reflected(1).numpy()[:, 0]
            errors.append(np.sqrt(np.mean(np.square(found - truth))))
        slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
        assert slope > least, (gradients, errors)
    # below the distance of hits every hit has its own
    found = filled(hits, source, tolerance=1e-3).reflected(1).numpy()[:, 0]
    np.testing.assert_allclose(found, truth, rtol=1e-6)


def test_records_see_albedo_afterwards():
    """What is cached is irradiance: texture is not blurred."""
    albedo = np.random.default_rng(0).random((SIDE * SIDE, 3)).astype(np.float32)
    source = KnownLight(floor_hits(), lambda x, y: np.pi + 0.0 * x, lambda x, y: (0.0, 0.0), 0.3)
    np.testing.assert_allclose(filled(floor_hits(albedo), source).reflected(1).numpy(), albedo, rtol=1e-6)


def test_points_behind_a_record_do_not_use_it():
    """A record lit from above says nothing of a floor below it, however near (Ward et al. 1988)."""
    hits = floor_hits()
    step = hits.origin.copy()
    step[:, 2] = np.where(hits.origin[:, 0] < 0.5, 0.0, -0.1)
    hits = dataclasses.replace(hits, origin=step)

    class Steps(KnownLight):
        def at_points(self, points, normals, keys, rings, sectors):
            known = super().at_points(points, normals, keys, rings, sectors)
            upper = (points[:, 2] > -0.05)[:, None].astype(np.float32)
            return dataclasses.replace(known, value=known.value * upper)

        def at_hits(self, hits, rays):
            raise AssertionError("every hit is to be served by a record")

    source = Steps(hits, lambda x, y: 1.0 + 0.0 * x, lambda x, y: (0.0, 0.0), 1.0)
    found = filled(hits, source, tolerance=0.3, finest=1).reflected(1).numpy()[:, 0] * np.pi
    np.testing.assert_allclose(found[step[:, 2] < -0.05], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "method",
    [gi.IrradianceCache(spp=3, rays=64), gi.LightField(spp=1, rays=16, record_rays=64, primary_hits=3, cache=True)],
)
def test_threads_do_not_change_a_picture(method):
    """One thread or three: the same records and the same picture, bit for bit."""
    scene = gi.scenes.cornell_box()
    one, many = (gi.render(scene, method, (40, 32), device=gi.Device("cpu", threads=n)) for n in (1, 3))
    assert one.counts == many.counts
    assert one.counts["records"] > 20
    for name, layer in one.layers.items():
        np.testing.assert_array_equal(layer, many.layers[name], err_msg=name)


def test_furnace():
    """In a room that is lit alike everywhere the buffer's radiance comes back at every pixel, to rounding."""
    samples = gi.sample(gi.scenes.furnace(albedo=0.5, shape="blocks")[0], spp=2, size=(24, 24))
    samples.radiance[:] = (1.0, 2.0, 0.5)
    render = gi.reconstruct(samples, gi.LightField(cache=True, record_rays=64, rays=16))
    assert render.counts["records"] > 10
    expected = render.layers["albedo"] * np.array([1.0, 2.0, 0.5])
    np.testing.assert_allclose(render.layers["indirect"], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", [gi.IrradianceCache(spp=1, rays=256), gi.LightField(spp=1, cache=True, recursive=1)])
def test_mean_light_of_a_furnace(method):
    """Paths in a closed room of albedo a bring a^2 / (1 - a) after the first two steps, on average."""
    scene, _ = gi.scenes.furnace(albedo=0.5)
    means = [gi.render(scene, method, (24, 24), seed).layers["indirect"].mean(dtype=np.float64) for seed in range(8)]
    assert abs(np.mean(means) - 0.5) < 4.4 * np.std(means, ddof=1) / np.sqrt(len(means))


def test_no_record_serves_across_a_wall():
    """The dark room behind a thin wall stays black, but for pixels that see both: no record of the lit one is used."""
    scene, _ = gi.scenes.leak(open_front=True)
    render = gi.render(scene, gi.IrradianceCache(spp=2, rays=64, light_samples=2), (48, 36))
    x, met = render.layers["position"][..., 0], render.layers["depth"][..., 0] > 0
    light = render.layers["indirect"].mean(axis=2)
    assert light[met & (x < -0.2)].mean() > 0.01
    np.testing.assert_array_equal(light[met & (x > 0.1)], 0.0)


def test_mirrors_and_metal_are_not_cached():
    """What is not diffuse has no records, and the picture's mean is path tracing's, within a per cent and noise."""
    scene = gi.scenes.cornell_spheres()
    renders = [gi.render(scene, gi.IrradianceCache(spp=2, rays=128), (24, 18), seed) for seed in range(6)]
    truth = [gi.render(scene, gi.PathTracing(spp=128), (24, 18), seed) for seed in range(6)]
    ours, theirs = (np.array([r.layers["indirect"].mean(dtype=np.float64) for r in them]) for them in (renders, truth))
    error = np.hypot(ours.std(ddof=1), theirs.std(ddof=1)) / np.sqrt(6)
    assert abs(ours.mean() - theirs.mean()) < 0.01 * theirs.mean() + 4.4 * error
    assert renders[0].counts["hits"] < 2 * 24 * 18


def test_metal_is_gathered_hit_by_hit():
    """A block of rough metal in the box has no record and no filter; its light is path tracing's, within 4 % and noise,
    and what is diffuse beside it is cached as ever. A sample buffer of it needs no scene."""
    box = gi.scenes.cornell_box()
    block = dataclasses.replace(box.shapes[-1], material=gi.Conductor(0.2, (0.9, 0.8, 0.6)))
    scene = gi.Scene([*box.shapes[:-1], block], box.camera, box.lights, name="metal block")
    size, method = (24, 24), gi.LightField(spp=1, primary_hits=4, rays=64, record_rays=64, cache=True)
    truth = [gi.render(scene, gi.PathTracing(spp=64), size, seed) for seed in range(8)]
    ours = [gi.render(scene, method, size, seed) for seed in range(8)]
    assert 0 < ours[0].counts["glossy_hits"] < 0.3 * 4 * 24 * 24
    assert ours[0].counts["records"] > 20
    shows = gi.render(box, gi.PathTracing(spp=4), size).layers["albedo"]
    metal = np.abs(truth[0].layers["albedo"] - shows).max(axis=2) > 0.1
    assert metal.sum() > 20
    for where in (metal, ~metal):
        a, b = (np.array([r.layers["indirect"][where].mean(dtype=np.float64) for r in them]) for them in (ours, truth))
        error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(8)
        assert abs(a.mean() - b.mean()) < 0.04 * b.mean() + 4.4 * error, (a.mean(), b.mean(), error)
    samples = gi.sample(scene, spp=1, size=size, glossy=True)
    alone = gi.reconstruct(samples, gi.LightField(rays=16, record_rays=64, cache=True))
    assert alone.counts["glossy_hits"] > 0
    assert alone.layers["indirect"][metal].mean() > 0.5 * truth[0].layers["indirect"][metal].mean()


def test_records_are_kept_and_used_again(tmp_path):
    """A second picture from the records of the first needs none and is the same; another size needs few."""
    scene = gi.scenes.cornell_box()
    method = gi.IrradianceCache(spp=2, rays=64, records=str(tmp_path / "box.npz"))
    first = gi.render(scene, method, (32, 32))
    second = gi.render(scene, method, (32, 32))
    assert second.counts["record_rays"] == 0
    assert first.layers["records"].sum() == first.counts["records"] == second.counts["records"] > 20
    np.testing.assert_allclose(second.layers["indirect"], first.layers["indirect"], rtol=1e-3, atol=1e-5)
    records = Records.load(method.records)
    low, high = scene.bounds()
    assert ((records.position > low - 1e-3) & (records.position < high + 1e-3)).all()


def test_interrupted_cache_is_a_picture():
    """A cache that is not finished is shown: few records, and single rays elsewhere."""
    hits = floor_hits()
    source = KnownLight(hits, lambda x, y: 1.0 + x, lambda x, y: (1.0, 0.0), 0.1)
    caching = gi.IrradianceCache(max_radius=1e9).caching
    cache = RecordCache(gi.Device("cpu"), hits, (SIDE, SIDE), source, caching)
    cache.fill(0, 1)
    assert np.isfinite(cache.reflected(64).numpy()).all()


def random_normals(count, seed, spread=1.0):
    """Unit vectors around +z."""
    normals = np.random.default_rng(seed).normal(size=(count, 3)) * spread + (0.0, 0.0, 1.0)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


class NoisyLight:
    """A source with nothing for records, whose light at hits is given."""

    def __init__(self, light):
        self.light, self.counts = light, {}

    def at_hits(self, hits, rays):
        return wp.array(np.repeat(self.light[hits][:, None], 3, axis=1).astype(np.float32), dtype=wp.vec3, device="cpu")


def unserved(hits, light, smoothing, rays=16, device=None):
    """Irradiance where no record serves, by that light and the filter."""
    caching = gi.IrradianceCache(smoothing=smoothing).caching
    cache = RecordCache(device or gi.Device("cpu"), hits, (SIDE, SIDE), NoisyLight(light), caching)
    cache.rounds_done = len(cache.rounds)
    return cache.reflected(rays).numpy()[:, 0] * np.pi


def test_radii_by_neighbours():
    """No record reaches farther than R_j + |x_i - x_j| of any other, and as far as that: all pairs are the judge."""
    rng = np.random.default_rng(0)
    count = 500
    normals = random_normals(count, 1, spread=9.0)
    zeros = np.zeros((count, 3, 3), np.float32)
    points = rng.random((count, 3)).astype(np.float32)
    radii = rng.lognormal(-2.0, 1.5, count).astype(np.float32)
    known = Records(points, normals, radii, points, zeros, zeros)
    caching = gi.IrradianceCache().caching
    cache = RecordCache(gi.Device("cpu"), floor_hits(), (SIDE, SIDE), NoisyLight(radii), caching, known)
    distance = np.linalg.norm(points[:, None].astype(np.float64) - points, axis=2)
    expected = (radii + distance).min(axis=1)
    assert (expected < radii).sum() > 100
    order = cache._tree.order.numpy()
    found = cache._kernel_records.values.numpy().reshape(-1, 24)[:, 0]
    np.testing.assert_allclose(found, expected[order], rtol=1e-5)


def test_filter_keeps_what_is_even_and_far():
    """Equal light stays equal, and light of one surface does not reach another that is far behind it."""
    hits = floor_hits()
    points = hits.origin.copy()
    right = points[:, 0] > 0.5
    points[right, 2] = -1.0
    hits = dataclasses.replace(hits, origin=points, normal=random_normals(len(points), 0))
    light = np.where(right, 0.25, 3.0)
    np.testing.assert_allclose(unserved(hits, light, 4.0), light, rtol=1e-5)


def test_filter_follows_normals():
    """Where leaves turn at random noise falls to less than a third, and light follows each hit's own normal."""
    one = floor_hits()
    hits = PrimaryHits(np.repeat(one.origin, 4, axis=0), random_normals(4 * SIDE**2, 1), np.repeat(WHITE, 4, axis=0), 4)
    truth = 2.0 + hits.normal.astype(np.float64) @ (0.5, -0.4, 1.0)
    noise = np.random.default_rng(2).normal(size=truth.shape) * 0.5
    errors = unserved(hits, truth + noise, 4.0) - truth
    still = unserved(hits, truth, 4.0) - truth
    assert np.std(errors - still) < 0.5 / 3
    assert abs(errors.mean()) < 4.4 * 0.5 / (2 * SIDE)
    # what the ridge of 0.1 holds back of the slope, where normals of pixels have a variance of 0.07 along each axis
    assert np.std(still) < 0.7 * truth.std()
    assert np.corrcoef(still, truth)[0, 1] < 0.0


def test_filter_narrows_with_rays():
    """More rays make it narrower until it does nothing: the picture goes to that of the rays alone."""
    hits = floor_hits()
    light = np.random.default_rng(3).random(SIDE * SIDE)
    np.testing.assert_array_equal(unserved(hits, light, 0.0), unserved(hits, light, 0.0, rays=1024))
    changes = [np.abs(unserved(hits, light, 4.0, rays) - light).mean() for rays in (1, 64, 4096)]
    assert changes[0] > changes[1] > changes[2]
    one, many = (unserved(hits, light, 4.0, device=gi.Device("cpu", threads=n)) for n in (1, 3))
    np.testing.assert_array_equal(one, many)


def test_paths_where_splats_do_not_tell():
    """Where all splats are larger than the room every ray is a path, and irradiance that of path tracing."""
    scene = gi.scenes.cornell_box()
    device = gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    size = (16, 16)
    job = Job(on_device, on_device.camera(size), size, 0, device)
    paths = path_settings(job, NEVER, 5, Sampler.SOBOL)
    samples, hits = trace_sample_buffer(
        job, Film(size, device, 1 << 30), 1, 1, 1, NEVER, 5, Sampler.SOBOL, with_hit_light=False
    )
    state = TracedReconstruction(job, paths, samples, device, gi.LightField().preprocessing, 0, hits)
    some = state.primary
    few = state.irradiance_at(some, 16)
    assert 0 < state.all_counts()["path_rays"] < 0.5 * 16 * len(some)
    state.tree.set_radius2(device.array(np.full(state.tree.count, 1e4, np.float32), float))
    state.tree.refit_as_balls()
    before = state.all_counts()
    ours = state.irradiance_at(some, 64).numpy().astype(np.float64).mean(axis=1)
    after = state.all_counts()
    assert sum(after[name] - before[name] for name in ("path_rays", "sky_rays")) == 64 * len(some)
    theirs = PathSource(job, hits, paths).at_hits(some, 64).numpy().astype(np.float64).mean(axis=1)
    # pixels are independent, and so are the directions of the two
    difference = ours - theirs
    assert abs(difference.mean()) < 4.4 * difference.std() / np.sqrt(len(some))
    assert abs(few.numpy().mean() / theirs.mean() - 1.0) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tolerance": 0.0}, "tolerance is 0"),
        ({"overlap": 0.5}, "overlap is 0.5"),
        ({"finest": 3}, "finest is 3, expected a power of 2"),
        ({"min_radius": 9.0, "max_radius": 8.0}, "max_radius is 8"),
        ({"rays": 0}, "rays is 0"),
        ({"smoothing": -1.0}, "smoothing is -1"),
        ({"roulette_depth": None}, "max_depth and roulette_depth"),
    ],
)
def test_bad_settings(settings, message):
    """Settings out of range are named."""
    with pytest.raises(ValueError, match=message):
        gi.IrradianceCache(**settings)


def test_bad_files_and_buffers(tmp_path):
    """A file that holds no records, and samples that lie irregularly, are refused in one sentence."""
    (tmp_path / "no.npz").write_text("nothing")
    with pytest.raises(ValueError, match="expected a file of records"):
        gi.render(gi.scenes.cornell_box(), gi.IrradianceCache(records=str(tmp_path / "no.npz")), (8, 8))
    ones = np.ones((3, 3), np.float32)
    samples = gi.SampleBuffer(
        2,
        1,
        0,
        radiance=ones,
        origin=0 * ones,
        hit=ones,
        origin_normal=ones,
        hit_normal=-ones,
        albedo=ones,
        pixel=np.array([0, 0, 1], np.int32),
    )
    with pytest.raises(ValueError, match="samples lie irregularly"):
        gi.reconstruct(samples, gi.LightField(cache=True))
    with pytest.raises(ValueError, match="cache and primary_rays"):
        gi.LightField(cache=True, primary_rays=True)
