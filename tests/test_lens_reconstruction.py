"""Defocus and motion from primary rays: the light field through a lens, by both methods, against path tracing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import warpgi as gi
from warpgi.lens_reconstruction import LensReconstruction
from warpgi.reconstruction import Preprocessing
from warpgi.temporal_reconstruction import TemporalReconstruction

FACES = [(0, 1, 2), (0, 2, 3)]
SQUARE = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
METHODS = {
    "light-field": gi.LightField(spp=1, rays=64, primary_rays=True),
    "temporal-light-field": gi.TemporalLightField(spp=1, rays=64),
}
SIZE = (48, 32)


def lamp(size, centre, radiance, motion=None):
    return gi.Shape(SQUARE * size + centre, FACES, gi.Diffuse(0.0), gi.Emissive(radiance), motion=motion)


def layers(motion=(0.8, 0.0, 0.0), aperture=0.1, front_depth=-2.0):
    """A grey square in front of a red one, both emissive, on black: the front one moves and is out of focus."""
    shapes = [
        lamp(3.0, (0, 0, -4), (0.8, 0.1, 0.1)),
        lamp(0.35, (-0.4, 0.05, front_depth), (0.5, 0.5, 0.5), motion),
    ]
    camera = gi.Camera((0, 0, 0), (0, 0, -1), fov=40, lens_radius=aperture, focus_distance=4.0)
    return gi.Scene(shapes, camera)


@pytest.fixture(scope="module")
def reference():
    return gi.render(layers(), gi.PathTracing(spp=2048, max_depth=1), size=SIZE).image


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_blur_is_that_of_path_tracing(method, reference):
    """From one sample per pixel comes path tracing's picture: the noise of the input falls to a third at least.

    Energy is kept to 2 %: a front whose rim is off by a tenth of a pixel all around would change it by as much.
    """
    picture = gi.render(layers(), method, size=SIZE)
    samples = gi.sample(layers(), spp=1, size=SIZE, primary=True)
    noise = np.sqrt(np.mean((samples.radiance.reshape(reference.shape) - reference) ** 2))
    assert np.sqrt(np.mean((picture.image - reference) ** 2)) < noise / 3.0
    assert picture.image.mean() == pytest.approx(reference.mean(), rel=0.02)
    assert picture.counts["filled_pixels"] == 0 and picture.counts["nonfinite"] == 0
    assert picture.counts["reconstruction_rays"] == 64 * SIZE[0] * SIZE[1]


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_one_radiance_everywhere_is_kept(method):
    """Where all that is seen has one radiance the picture has it in every pixel, to rounding."""
    scene = layers()
    shapes = [dataclasses.replace(shape, emission=gi.Emissive((0.3, 0.6, 0.9))) for shape in scene.shapes]
    image = gi.render(dataclasses.replace(scene, shapes=shapes), method, size=SIZE).image
    np.testing.assert_allclose(image, np.broadcast_to(np.float32([0.3, 0.6, 0.9]), image.shape), rtol=1e-5)


def reconstruct(samples, kind, rays=8):
    device = gi.Device("cpu")
    if kind == "temporal":
        state = TemporalReconstruction(samples, device, 3, 1.8)
    else:
        state = LensReconstruction(samples, device, Preprocessing(12, 3.0, 1e-3, 1.0), 3)
    state.gather(0, rays, rays)
    return state.image()


def test_a_rim_in_focus_stays_where_it_is():
    """The sides of a bright square in focus before a dark wall lie where they should, to a twentieth of a pixel.

    That is 4 standard errors of the mean over the seeds.
    """
    scene = gi.Scene(
        [lamp(3.0, (0, 0, -4), (0, 0, 0.01)), lamp(0.4, (0.03, 0.05, -2.0), (1, 1, 1))],
        gi.Camera((0, 0, 0), (0, 0, -1), fov=40, lens_radius=0.1, focus_distance=2.0),
    )
    side = 0.8 / (2.0 * np.tan(np.radians(20.0)) * 2.0 / 32)
    method = METHODS["light-field"]
    areas = [gi.render(scene, method, size=SIZE, seed=seed).image[..., 0].sum() for seed in range(8)]
    assert abs(np.sqrt(np.mean(areas)) - side) / 2.0 < 0.05


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_an_edge_out_of_focus_is_blurred_by_the_lens(method, upright):
    """An edge between black and white, far behind the focus, becomes the integral of a disc, whichever way it runs.

    Of a uniform disc of radius c the part on one side of a line at the distance s c is 1/2 + (s sqrt(1-s^2) + asin
    s)/pi. What is left is the noise of 64 rays, of mean deviation below 1 / (2 sqrt(64)), over a line of 24 pixels.
    """
    sides = [(-3.0, 0.0, -4.0), (3.0, 0.0, -4.0)] if upright else [(0.0, 3.0, -4.0), (0.0, -3.0, -4.0)]
    shapes = [lamp(3.0, side, light) for side, light in zip(sides, ((1, 1, 1), (0, 0, 0.01)), strict=True)]
    camera = gi.Camera((0, 0, 0), (0, 0, -1), fov=40, lens_radius=0.3, focus_distance=2.0)
    image = gi.render(gi.Scene(shapes, camera), method, size=(32, 32)).image[..., 0]
    profile = image[4:-4].mean(axis=0) if upright else image[:, 4:-4].mean(axis=1)
    radius = 0.3 * (1.0 - 2.0 / 4.0) / (2.0 * np.tan(np.radians(20.0)) * 2.0 / 32)
    s = np.clip((np.arange(32) + 0.5 - 16.0) / radius, -1.0, 1.0)
    expected = 0.5 - (s * np.sqrt(1.0 - s * s) + np.arcsin(s)) / np.pi
    # and half a pixel of smoothing by samples two pixels apart, where the profile bends the most
    assert np.abs(profile - expected)[3:-3].max() < 4.4 * 0.0625 / np.sqrt(24) + 0.02


@pytest.mark.parametrize("kind", ["light field", "temporal"])
def test_still_samples_through_the_motion_path_are_the_same(kind, monkeypatch):
    """Motion of zero, at whatever times, gives what the still path gives, to the last bit with one tolerance for both.

    Only where normals may be of another time does the motion path allow surfaces more of a bend.
    """
    monkeypatch.setattr("warpgi.lens_reconstruction.MOVING_SLOPE", 0.01)
    samples = gi.sample(gi.scenes.butterflies(motion=0.0), spp=1, size=SIZE, primary=True)
    assert samples.time is None and samples.hit_motion is None
    time = np.random.default_rng(0).random(len(samples)).astype(np.float32)
    moving = dataclasses.replace(samples, time=time, hit_motion=np.zeros_like(samples.hit))
    np.testing.assert_array_equal(reconstruct(moving, kind).view("u4"), reconstruct(samples, kind).view("u4"))


@pytest.mark.parametrize("kind", ["light field", "temporal"])
def test_time_moves_samples_along_their_way(kind):
    """A surface that fills the picture and moves straight gives, from samples of time 0 alone, its blur over all times.

    The way is two pixels of the picture, so an edge between black and white becomes a ramp of that width.
    """
    pixel = 2.0 * np.tan(np.radians(20.0)) * 2.0 / 32
    shapes = [
        lamp(3.0, (-3.0, 0, -2.0), (1, 1, 1), (8.0 * pixel, 0, 0)),
        lamp(3.0, (3.0, 0, -2.0), (0, 0, 0.01), (8.0 * pixel, 0, 0)),
    ]
    camera = gi.Camera((0, 0, 0), (0, 0, -1), fov=40, shutter=(0.0, 1.0))
    samples = gi.sample(gi.Scene(shapes, camera), spp=1, size=SIZE, primary=True)
    image = reconstruct(samples, kind, rays=64)
    column = image[4:-4, :, 0].mean(axis=0)
    # the edge runs from the middle to 8 pixels right of it: the share of the time in which it is past a pixel
    expected = np.clip((8.0 - (np.arange(48) + 0.5 - 24.0)) / 8.0, 0.0, 1.0)
    assert np.abs(column - expected)[4:-4].max() < 0.06
    assert abs(column.sum() - expected.sum()) < 0.25


@pytest.mark.parametrize("kind", ["light field", "temporal"])
def test_disoccluded_background_has_no_holes(kind):
    """Behind a square that moves fast lies background that no sample saw then: nothing is black, holes are filled."""
    scene = layers(motion=(1.2, 0.4, 0.0), aperture=0.0)
    samples = gi.sample(scene, spp=1, size=SIZE, primary=True)
    image = reconstruct(samples, kind, rays=64)
    assert np.isfinite(image).all()
    assert image[..., 0].min() > 0.45  # the darkest thing in the red channel has 0.5


@pytest.mark.parametrize("kind", ["light field", "temporal"])
def test_same_bits_for_any_threads(kind):
    """The number of threads and the cut of the grid change nothing."""
    samples = gi.sample(gi.scenes.butterflies(), spp=1, size=(24, 16), primary=True)
    method = METHODS["light-field" if kind == "light field" else "temporal-light-field"]
    devices = [gi.Device("cpu", 1), gi.Device("cpu", 2, chunk=5), gi.Device("cpu", 3, chunk=64)]
    first, *rest = [gi.reconstruct(samples, method, device=device).layers["image"] for device in devices]
    for other in rest:
        np.testing.assert_array_equal(other.view("u4"), first.view("u4"))


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_buffer_alone_gives_the_same_picture(method, tmp_path):
    """`reconstruct` on the rays of `sample`, also after a file, is `render`: no scene is needed."""
    scene = gi.scenes.butterflies()
    whole = gi.render(scene, method, size=(32, 20), seed=2).image
    samples = gi.sample(scene, spp=1, size=(32, 20), seed=2, primary=True)
    np.testing.assert_array_equal(gi.reconstruct(samples, method, seed=2).layers["image"], whole)
    samples.save(tmp_path / "rays.bin")
    again = gi.reconstruct(gi.SampleBuffer.load(tmp_path / "rays.bin"), method, seed=2).layers["image"]
    np.testing.assert_allclose(again, whole, atol=1e-3 * whole.max())


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_the_sky_behind_is_kept(method):
    """Rays that left the scene answer for what lies behind everything."""
    scene = layers()
    scene = dataclasses.replace(scene, shapes=scene.shapes[1:], lights=[gi.Environment((0.2, 0.4, 0.9))])
    image = gi.render(scene, method, size=SIZE).image
    expected = gi.render(scene, gi.PathTracing(spp=512, max_depth=1), size=SIZE).image
    assert image.mean() == pytest.approx(expected.mean(), rel=0.03)
    # out of the reach of samples at the layer's rim
    assert np.allclose(image[:, -5:], (0.2, 0.4, 0.9), rtol=1e-4)


def test_radius_of_the_earlier_method_is_the_patterns_dispersion():
    """The largest hole of jittered pixels without lens or motion lies between those of a grid and of two empty pixels.

    No point of a pixel's corner is farther than sqrt(2) from the sample of some pixel about it; of a regular grid the
    largest hole has the radius sqrt(1/2). Lens and motion only tear larger holes.
    """
    still = gi.sample(gi.scenes.butterflies(motion=0.0, aperture=0.0), spp=1, size=(64, 40), primary=True)
    device = gi.Device("cpu")
    radius = TemporalReconstruction(still, device, 0).radius
    assert np.sqrt(0.5) < radius < np.sqrt(2.0)
    moving = gi.sample(gi.scenes.butterflies(), spp=1, size=(64, 40), primary=True)
    assert TemporalReconstruction(moving, device, 0).radius > radius
    y, x = np.mgrid[:40, :64] + np.float32(0.5)
    grid = dataclasses.replace(still, image_xy=np.float32(np.stack([x.ravel(), y.ravel()], axis=1)))
    assert TemporalReconstruction(grid, device, 0).radius == pytest.approx(np.sqrt(0.5), abs=0.2)


def test_wrong_buffers_are_refused():
    """Secondary rays, and settings out of range, are refused in a sentence."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=1, size=(8, 8))
    bare = dataclasses.replace(samples, pixel_to_camera=np.eye(4))
    for method in METHODS.values():
        with pytest.raises(ValueError, match="samples lack the camera of primary rays"):
            gi.reconstruct(bare, method)
    with pytest.raises(ValueError, match="rays is 0"):
        gi.TemporalLightField(rays=0)
    with pytest.raises(ValueError, match="radius is 0"):
        gi.TemporalLightField(radius=0.0)
    with pytest.raises(ValueError, match="the scene moves, which LightField cannot render"):
        gi.render(gi.scenes.butterflies(), gi.LightField(), size=(8, 8))


@pytest.mark.parametrize(("kind", "part"), [("light field", 0.5), ("temporal", 1.0)])
def test_samples_of_a_lens_know_the_view_of_its_centre(kind, part):
    """Rays through the lens's centre alone give the pinhole's picture, nearer than what the lens sees; ours by half.

    The earlier method takes samples from its worst-case radius, which keeps it from more.
    """
    scene = layers(motion=None, aperture=0.5)
    sharp = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, lens_radius=0.0))
    truth = gi.render(sharp, gi.PathTracing(spp=256, max_depth=1), size=SIZE).image
    blurred = gi.render(scene, gi.PathTracing(spp=256, max_depth=1), size=SIZE).image
    samples = gi.sample(scene, spp=1, size=SIZE, primary=True)
    method = METHODS["light-field" if kind == "light field" else "temporal-light-field"]
    state = method.reconstruction(samples, gi.Device("cpu"), 0)
    state.lens.stop = 0.0
    state.gather(0, 32, 32)
    assert np.sqrt(np.mean((state.image() - truth) ** 2)) < part * np.sqrt(np.mean((blurred - truth) ** 2))
