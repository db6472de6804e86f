"""What all image-space filters have in common, on sample buffers and in renders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buffers import halves, plane

import warpgi as gi
from warpgi.filtering import SampleFilter, sample_rows
from warpgi.reconstruction import pixel_means

# what sends reconstruction rays by default is no image-space filter
FILTERS = {
    name: kind for name, kind in gi.METHODS.items() if issubclass(kind, SampleFilter) and not getattr(kind, "rays", 0)
}
each_filter = pytest.mark.parametrize("kind", FILTERS.values(), ids=FILTERS.keys())


def indirect(samples, method, **settings):
    return gi.reconstruct(samples, method, **settings).layers["indirect"]


def unfiltered(samples):
    """Mean of what each pixel's samples reflect."""
    usable = samples.checked.is_primary & (samples.checked.is_splat | samples.checked.is_escaped)
    light = samples.albedo * np.where(usable[:, None], samples.radiance, np.float32(0.0))
    return pixel_means(samples, np.where(samples.checked.is_primary[:, None], light, np.float32(0.0)))


@pytest.fixture(scope="module")
def box():
    """The Cornell box at 8 spp, and 512 spp of it."""
    scene = gi.scenes.cornell_box()
    reference = gi.render(scene, gi.PathTracing(spp=512), size=(64, 64), seed=9).layers["indirect"]
    return gi.sample(scene, spp=8, size=(64, 64)), reference


@each_filter
def test_constant_light_stays_constant(kind):
    """Equal radiance stays equal to the bit; under a texture to float32's rounding."""
    color = np.array([0.3, 0.7, 0.1], np.float32)
    samples = plane(radiance=color)
    np.testing.assert_array_equal(indirect(samples, kind()), np.broadcast_to(color, (16, 24, 3)))
    albedo = np.random.default_rng(1).random((len(samples), 3)).astype(np.float32)
    textured = replace(samples, albedo=albedo)
    # a few roundings of 2^-24 each: divide, multiply, two means
    np.testing.assert_allclose(indirect(textured, kind()), pixel_means(samples, albedo) * color, rtol=4 * 2.0**-23)


# Half of what was measured here over three seeds, 15 to 17, 15 and 4: what is left is mostly bias at this size, for
# which there is no closed form.
FACTORS = {"a-trous": 7.5, "irradiance-filter": 7.5, "random-parameter-filter": 2.0}


@pytest.mark.parametrize("name", FILTERS)
def test_noise_falls_and_energy_stays(name, box):
    """On the Cornell box relMSE falls by the factor above, and mean light stays within 0.5 %; with RPF, all of it."""
    samples, reference = box
    before, after = unfiltered(samples), indirect(samples, FILTERS[name]())
    errors = [gi.compare(picture, reference)["relmse"] for picture in (before, after)]
    assert errors[1] * FACTORS[name] < errors[0]
    axis = None
    tolerance = 5e-3
    if name == "random-parameter-filter":
        axis, tolerance = (0, 1), 2.0**-23  # each channel, to the rounding of float32 pixels
    means = [picture.mean(axis=axis, dtype=np.float64) for picture in (after, before)]
    np.testing.assert_allclose(*means, rtol=tolerance)


@each_filter
@pytest.mark.parametrize(("width", "height", "spp"), [(1, 1, 1), (1, 1, 8), (2, 1, 1), (7, 1, 2), (1, 5, 3)])
def test_smallest_pictures(kind, width, height, spp):
    """Pictures of a pixel or a row are filtered, within the range of their samples; a single sample stays as it is."""
    samples = plane(width, height, spp)
    picture = indirect(samples, kind())
    assert (picture >= samples.radiance.min(axis=0)).all() and (picture <= samples.radiance.max(axis=0)).all()
    if len(samples) == 1:
        np.testing.assert_array_equal(picture, unfiltered(samples))


@each_filter
def test_one_sample_per_pixel(kind):
    """At 1 spp a plane is filtered too: less than half of the noise is left; with RPF, which finds no statistics in a
    pixel, some less than all."""
    samples = plane(spp=1)
    share = 0.9 if kind is gi.RandomParameterFilter else 0.5
    assert indirect(samples, kind()).std() < share * unfiltered(samples).std()


@each_filter
def test_nothing_crosses_an_edge_of_normals(kind):
    """Two walls at a right angle keep their own light.

    À-Trous leaks at most exp(-|dn|^2 / sigma^2) = e^-8 in each of 5 passes; the others look at nothing beyond.
    """
    samples = plane(radiance=halves(0.0, 1.0), normal=halves((0, 0, 1), (1, 0, 0)))
    picture = indirect(samples, kind())
    leak = 5 * np.exp(-8.0) if kind is gi.ATrous else 0.0
    assert (picture[:, :12] <= leak).all()
    assert (picture[:, 12:] >= 1.0 - leak).all()


@each_filter
def test_nothing_crosses_an_edge_of_depth(kind):
    """Two parallel walls, one 30 pixels behind the other, keep their own light.

    À-Trous leaks at most exp(-(30 / 7 f)^2) in each of 5 passes, f the distance of neighbouring pixels, 1 or a little
    more as their samples fall.
    """
    samples = plane(
        radiance=halves(0.0, 1.0), position=lambda x, y: np.stack([x, y, np.where(x < 12, 0.0, 30.0)], axis=1)
    )
    picture = indirect(samples, kind())
    leak = 5 * np.exp(-((30.0 / (7.0 * 1.4)) ** 2)) if kind is gi.ATrous else 0.0
    assert sample_rows(samples).footprint().max() < 1.4
    assert (picture[:, :12] <= leak).all()
    assert (picture[:, 12:] >= 1.0 - leak).all()


@each_filter
def test_wrong_samples_are_counted_and_spread_nothing(kind):
    """NaN, infinity and rays without length are left out of their neighbours: what they say is lost."""
    samples = plane(radiance=(0.25, 0.5, 1.0))
    radiance, hit, normal = samples.radiance.copy(), samples.hit.copy(), samples.hit_normal.copy()
    radiance[100, 1], radiance[333] = np.nan, np.inf
    hit[401], normal[402] = samples.origin[401], 0.0
    picture = gi.reconstruct(replace(samples, radiance=radiance, hit=hit, hit_normal=normal), kind())
    counts = {name: picture.counts[name] for name in ("nonfinite", "zero_length", "bad_normal")}
    assert counts == {"nonfinite": 2, "zero_length": 1, "bad_normal": 1}
    np.testing.assert_allclose(picture.layers["indirect"], np.broadcast_to((0.25, 0.5, 1.0), (16, 24, 3)), rtol=1e-6)


@each_filter
def test_pixels_without_a_surface(kind):
    """What misses stays black and darkens nobody; a buffer of misses alone gives a black picture."""
    samples = plane(radiance=(0.25, 0.5, 1.0))
    origin = samples.origin.copy()
    origin[: 4 * 24 * 4] = 1e11  # four rows of sky
    picture = indirect(replace(samples, origin=origin), kind())
    assert not picture[:4].any()
    np.testing.assert_array_equal(picture[4:], np.broadcast_to(np.float32((0.25, 0.5, 1.0)), (12, 24, 3)))
    assert not indirect(replace(samples, origin=np.full_like(origin, 1e11)), kind()).any()


@each_filter
@pytest.mark.parametrize("channel", ["position", "normal", "hit"])
def test_constant_channels(kind, channel):
    """A feature that never varies, or only by rounding, tells nothing and breaks nothing."""
    samples = plane(position=(1.0, 2.0, 3.0)) if channel == "position" else plane()
    if channel == "hit":
        samples = replace(samples, hit=np.broadcast_to(np.float32((3, 4, 5)), samples.hit.shape).copy())
    picture = indirect(samples, kind())
    assert np.isfinite(picture).all()
    assert picture.std() < 0.7 * unfiltered(samples).std()


@each_filter
def test_escaped_rays_bring_their_light(kind):
    """Light of rays that left the scene is filtered as any other: a sky of one radiance stays so to the bit."""
    samples = plane(radiance=(0.2, 0.4, 0.6))
    hit = samples.hit.copy()
    hit[::3] = (samples.direction * np.float32(1e11))[::3]
    picture = indirect(replace(samples, hit=hit), kind())
    np.testing.assert_array_equal(picture, np.broadcast_to(np.float32((0.2, 0.4, 0.6)), (16, 24, 3)))


@each_filter
def test_threads_do_not_change_a_picture(kind):
    """One thread or many, any chunk: the same picture to the last bit, with a scene and without."""
    scene = gi.scenes.cornell_box()
    devices = [gi.Device("cpu", threads=1), gi.Device("cpu", threads=2), gi.Device("cpu", threads=3, chunk=17)]
    renders = [gi.render(scene, kind(spp=3), size=(19, 13), device=device) for device in devices]
    samples = gi.sample(scene, spp=3, size=(19, 13))
    pictures = [indirect(samples, kind(), device=device) for device in devices]
    for other in (1, 2):
        np.testing.assert_array_equal(renders[0].layers["indirect"], renders[other].layers["indirect"])
        np.testing.assert_array_equal(pictures[0], pictures[other])


@each_filter
def test_passes_do_not_change_a_picture(kind):
    """However its units of work are cut into passes, the picture is the same to the last bit."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=2, size=(17, 11))
    total = kind().passes()[0]
    whole, parts = (kind().reconstruction(samples, gi.Device("cpu"), 0) for _ in range(2))
    whole.gather(0, total, total)
    for unit in range(total):
        parts.gather(unit, 1, total)
    np.testing.assert_array_equal(whole.picture(), parts.picture())
    assert (whole.picture() != kind().reconstruction(samples, gi.Device("cpu"), 0).picture()).any()


@each_filter
def test_render_filters_what_reconstruct_filters(kind):
    """A render's indirect layer is that of its own samples, and what is not diffuse is the same by any filter."""
    scene = gi.scenes.cornell_box()
    picture = gi.render(scene, kind(spp=4), size=(16, 12))
    samples = gi.sample(scene, spp=4, size=(16, 12))
    # positions differ by their rounding, and so, at times, do RPF's choices
    filtered = indirect(samples, kind())
    tolerance = 5e-3 if kind is gi.RandomParameterFilter else 1e-6
    np.testing.assert_allclose(picture.layers["indirect"], filtered, rtol=0, atol=tolerance * filtered.max())
    metal = gi.scenes.statuettes(resolution=16)
    method = gi.ATrous(spp=2) if kind is not gi.ATrous else gi.IrradianceFilter(spp=2)
    kept = gi.render(metal, method, size=(16, 12)).layers["indirect"]
    np.testing.assert_array_equal(gi.render(metal, kind(spp=2), size=(16, 12)).layers["indirect"], kept)


@each_filter
def test_irregular_buffers(kind):
    """Samples placed by `pixel`, some pixels without any, are filtered as those in order are."""
    samples = plane(spp=4, radiance=(0.25, 0.5, 1.0))
    keep = np.ones(len(samples), bool)
    keep[5:17] = False
    names = ("radiance", "origin", "hit", "origin_normal", "hit_normal", "albedo")
    arrays = {name: getattr(samples, name)[keep] for name in names}
    pixel = samples.pixel_of_sample[keep]
    picture = indirect(gi.SampleBuffer(24, 16, 0, pixel=pixel, **arrays), kind())
    present = np.bincount(pixel, minlength=384).reshape(16, 24) > 0
    np.testing.assert_allclose(picture[present], np.broadcast_to((0.25, 0.5, 1.0), (present.sum(), 3)), rtol=1e-6)
    assert not picture[~present].any()


@each_filter
def test_refusals(kind):
    """A buffer without secondary rays and one that does not fit are refused in a sentence."""
    samples = plane()
    with pytest.raises(ValueError, match="memory_limit is 1000 bytes"):
        gi.reconstruct(samples, kind(), device=gi.Device("cpu", memory_limit=1000))
    metal = gi.Shape([(-1, 0, -1), (-1, 0, 1), (1, 0, 1)], [(0, 1, 2)], gi.Conductor(0.05))
    scene = gi.Scene([metal], gi.Camera((0, 1, 1), (0, 0, 0)), [gi.Environment((1, 1, 1))])
    words = "without weight" if hasattr(kind, "glossy") else "expected only diffuse ones"
    with pytest.raises(ValueError, match=f"glossy primary hits.*{words}"):
        gi.reconstruct(replace(gi.sample(scene, 1, (8, 8), glossy=True), weight=None), kind())
    with pytest.raises(ValueError, match="spp is 0"):
        kind(spp=0)
    with pytest.raises(ValueError, match="never end"):
        kind(roulette_depth=None)


def glossy_room():
    """Everything that a glossy hit can be: metal, black metal, coats over colour and black, seen in a mirror too."""
    plate = np.array([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)], float)
    faces = [(0, 1, 2), (0, 2, 3)]
    materials = [
        gi.Conductor(0.05, (0.9, 0.6, 0.3)),
        gi.Conductor(0.3, (0.0, 0.0, 0.0)),
        gi.Coated((0.2, 0.5, 0.7), 0.02),
        gi.Coated((0.0, 0.0, 0.0), 0.1),
        gi.Diffuse((0.4, 0.5, 0.6)),
    ]
    shapes = [gi.Shape(plate + np.array([2 * i - 4, 0, 0]), faces, material) for i, material in enumerate(materials)]
    wall = [(-5, 0, -1), (5, 0, -1), (5, 4, -1), (-5, 4, -1)]
    mirror = [(2, 0, -0.5), (5, 0, -0.5), (5, 3, -0.5), (2, 3, -0.5)]
    shapes += [gi.Shape(wall, faces, gi.Diffuse((0.7, 0.8, 0.5))), gi.Shape(mirror, faces, gi.Mirror((0.9, 0.8, 0.7)))]
    return gi.Scene(shapes, gi.Camera((0, 3, 7), (0, 0.8, 0), fov=60.0), [gi.PointLight((0, 3, 3), (400, 400, 400))])


def test_glossy_light_is_held_pixel_by_pixel():
    """A filter too narrow to reach another sample leaves what glossy surfaces reflect as it is without it.

    The paths are the same, so that the pictures are too: light divided by reflectance and multiplied again, with
    samples that were absorbed counted as black. That each is float32's rounding of one product more bounds the rest.
    """
    scene, size = glossy_room(), (48, 32)
    narrow = {"spp": 4, "sigma_position": 1e-6, "sigma_normal": None, "iterations": 1}
    kept, filtered = (
        gi.render(scene, gi.ATrous(glossy=glossy, **narrow), size, 3).layers["indirect"] for glossy in (False, True)
    )
    assert kept.mean() > 0.01
    np.testing.assert_allclose(filtered, kept, rtol=32 * 2.0**-24, atol=1e-6)
    buffer = gi.sample(scene, 4, size, 3, glossy=True)
    assert set(np.unique(buffer.material[buffer.checked.is_primary])) == set(range(6))


@pytest.mark.parametrize("sigma", [None, 1.0])
def test_statuettes_have_less_noise_and_keep_their_light(sigma):
    """What only glossy surfaces reflect has less error by a fifth, and its mean light but for 6 %.

    The mean differs from the input's by 3 % here over 12 seeds, as rows at edges have fewer others to share with; twice
    that is the bound.
    """
    scene, size = gi.scenes.statuettes(resolution=24), (64, 36)
    methods = gi.PathTracing(spp=8, max_depth=3), gi.ATrous(glossy=True, max_depth=3, sigma_hit_normal=sigma)
    truth = gi.render(scene, gi.PathTracing(spp=256, max_depth=3), size, 9).layers["indirect"]
    pictures = [[gi.render(scene, m, size, seed).layers["indirect"] for seed in range(4)] for m in methods]
    before, after = (np.mean([gi.compare(p, truth)["rmse"] ** 2 for p in row]) for row in pictures)
    assert after < 0.8 * before
    assert np.mean(pictures[1], dtype=float) == pytest.approx(np.mean(pictures[0], dtype=float), rel=0.06)


def test_random_parameter_filter_gives_glossy_light_back():
    """It changes the picture of metal, not its mean light; whether error falls depends on the picture."""
    scene, size = gi.scenes.statuettes(resolution=24), (48, 27)
    methods = (gi.RandomParameterFilter(glossy=glossy, max_depth=3, boxes=(7,)) for glossy in (False, True))
    kept, filtered = (gi.render(scene, method, size, 1).layers["indirect"] for method in methods)
    assert gi.compare(filtered, kept)["relmse"] > 0.01
    np.testing.assert_allclose(filtered.mean(axis=(0, 1), dtype=float), kept.mean(axis=(0, 1), dtype=float), rtol=1e-5)
