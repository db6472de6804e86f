"""What `render` promises a caller: errors before work, warnings, progress, and nothing lost on Ctrl-C."""

import dataclasses
import os
import signal
import threading

import numpy as np
import pytest

import warpgi as gi

TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
CAMERA = gi.Camera((0, 0, 3), (0, 0, 0))


def scene_of(*shapes, **rest):
    return gi.Scene(shapes or [gi.Shape(TRIANGLE, [(0, 1, 2)])], CAMERA, **rest)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: gi.Shape([(0, 0, np.nan), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]), ValueError, "shape vertices holds 1 "),
        (lambda: gi.Shape([(0, 0, np.inf), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]), ValueError, "shape vertices holds 1 "),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, 3)]), ValueError, "name vertex 3, expected 0 to 2"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, -1)]), ValueError, "name vertex -1, expected 0 to 2"),
        (lambda: gi.Shape(TRIANGLE, [(0.0, 1.0, 2.0)]), ValueError, "faces have shape .* expected whole numbers"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1)]), ValueError, "faces have shape"),
        (lambda: gi.Shape("abc", [(0, 1, 2)]), TypeError, "shape vertices is str"),
        (lambda: gi.Shape([], np.zeros((0, 3), int)), ValueError, "shape vertices has shape|at least one face"),
        (lambda: gi.Shape(TRIANGLE, np.zeros((0, 3), int)), ValueError, "at least one face"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, 1)]), ValueError, "no triangle with an area"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, 2)], normals=[(0, 0, 1)]), ValueError, "shape normals has shape"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, 2)], material="gold"), TypeError, "material is str"),
        (lambda: gi.Shape(TRIANGLE, [(0, 1, 2)], emission=5.0), TypeError, "emission is float"),
        (
            lambda: gi.Shape(TRIANGLE, [(0, 1, 2)], gi.Diffuse(gi.Texture(np.ones((2, 2, 3))))),
            ValueError,
            "has a texture but no uv",
        ),
        (lambda: gi.Diffuse(1.5), ValueError, "albedo is .* inside \\[0, 1\\]"),
        (lambda: gi.Diffuse((0.1, -0.1, 0.1)), ValueError, "albedo is"),
        (lambda: gi.Diffuse((0.1, 0.1)), ValueError, "albedo has shape"),
        (lambda: gi.Mirror(np.nan), ValueError, "reflectance holds"),
        (lambda: gi.Conductor(roughness=0.0), ValueError, "roughness is 0"),
        (lambda: gi.Conductor(eta=1.0), ValueError, "eta and k belong together"),
        (lambda: gi.Dielectric(0.5), ValueError, "ior is 0.5"),
        (lambda: gi.Emissive(-1.0), ValueError, "radiance is"),
        (lambda: gi.Texture(np.ones((2, 2))), ValueError, "texture pixels has shape"),
        (lambda: gi.Texture(np.full((2, 2, 3), 2.0)), ValueError, "leave \\[0, 1\\]"),
        (lambda: gi.PointLight((0, 0), 1.0), ValueError, "position has shape"),
        (lambda: gi.DistantLight((0, 0, 0), 1.0), ValueError, "direction is the zero vector"),
        (lambda: gi.SpotLight((0, 0, 0), (0, 0, 1), 1.0, 0.5, 0.4), ValueError, "inner_angle is 0.5"),
        (lambda: gi.Camera((0, 0, 0), (0, 0, 0)), ValueError, "camera target is the camera position"),
        (lambda: gi.Camera((0, 0, 0), (0, 1, 0)), ValueError, "camera up is parallel"),
        (lambda: gi.Camera((0, 0, 0), (0, 0, 1), fov=0), ValueError, "camera fov is 0"),
        (lambda: gi.Scene([], CAMERA), ValueError, "scene has no shapes"),
        (lambda: gi.Scene([1], CAMERA), TypeError, "shapes holds int"),
        (lambda: scene_of(lights=[1]), TypeError, "lights holds int"),
        (lambda: scene_of(lights=[gi.Environment(1.0)] * 2), ValueError, "more than one Environment"),
        (lambda: gi.PathTracing(spp=0), ValueError, "spp is 0"),
        (lambda: gi.PathTracing(spp=1.5), TypeError, "spp is 1.5"),
        (lambda: gi.PathTracing(max_depth=0), ValueError, "max_depth is 0"),
        (lambda: gi.PathTracing(roulette_depth=None), ValueError, "paths never end"),
        (lambda: gi.PathTracing(sampler="sobol"), TypeError, "sampler is 'sobol'"),
        (lambda: gi.render("cornell-box"), TypeError, "scene is str"),
        (lambda: gi.render(scene_of(), "path"), TypeError, "method is str"),
        (lambda: gi.render(scene_of(), size=(0, 4)), ValueError, "width is 0"),
        (lambda: gi.render(scene_of(), size=(4, -4)), ValueError, "height is -4"),
        (lambda: gi.render(scene_of(), size=4), ValueError, "size is 4"),
        (lambda: gi.render(scene_of(), size=(2**20, 2**20)), ValueError, "fewer than 2\\^31 pixels"),
        (lambda: gi.render(scene_of(), seed=-1), ValueError, "seed is -1"),
        (lambda: gi.render(scene_of(), device=3), TypeError, "device is int"),
    ],
)
def test_bad_input_is_named(make, error, message):
    """A caller's mistake is one sentence that names the argument, raised before any kernel runs."""
    with pytest.raises(error, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_degenerate_triangles_are_dropped_and_counted():
    """Triangles without area leave the picture as it is and are reported."""
    clean = scene_of(lights=[gi.Environment(1.0)])
    vertices = [*TRIANGLE, (0.5, 0.0, 0.0)]
    spoilt = scene_of(gi.Shape(vertices, [(0, 1, 2), (1, 1, 2), (0, 3, 1), (2, 2, 2)]), lights=[gi.Environment(1.0)])
    a, b = (gi.render(scene, gi.PathTracing(spp=4), size=(8, 8)) for scene in (clean, spoilt))
    assert (a.counts["degenerate_triangles"], b.counts["degenerate_triangles"]) == (0, 3)
    np.testing.assert_array_equal(a.image, b.image)


def test_a_scene_without_light_is_black_and_warned_of():
    """No light is no error: the picture is black, and a warning says why."""
    with pytest.warns(UserWarning, match="no light: the picture is black"):
        render = gi.render(scene_of(), gi.PathTracing(spp=2), size=(8, 8))
    assert not render.image.any()
    assert render.layers["albedo"].any()


def test_same_seed_same_picture_other_seed_other_picture():
    """A picture is a function of scene, settings and seed."""
    scene = gi.scenes.cornell_box()
    a, b, c = (gi.render(scene, gi.PathTracing(spp=2), size=(16, 16), seed=s).image for s in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert (a != c).mean() > 0.5


def test_progress_reports_every_pass():
    """A progress function sees samples grow to the total, with rays that add up to the render's."""
    seen = []
    render = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=7), size=(16, 16), progress=seen.append)
    assert [state.total for state in seen] == [7] * len(seen)
    done = [state.done for state in seen]
    assert done == sorted(set(done))
    assert done[-1] == 7
    assert seen[-1].counts["closest_hit_rays"] == render.counts["closest_hit_rays"]
    assert render.counts["camera_rays"] == 7 * 256
    assert seen[-1].rays_per_second > 0


def test_render_names_what_made_it():
    """A render carries method, settings, seed, scene, device, versions and the stages' seconds."""
    render = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=2), size=(8, 8), seed=5, device="cpu")
    assert (render.method, render.seed, render.spp, render.scene, render.device) == ("path", 5, 2, "cornell-box", "cpu")
    assert render.settings == {"spp": 2, "max_depth": None, "roulette_depth": 5, "sampler": "sobol"}
    assert list(render.timings) == ["compile", "upload", "prepare", "estimate", "image"]
    assert render.timings["estimate"] > 0
    assert set(render.versions) == {"warpgi", "warp", "numpy", "python"}


@pytest.mark.parametrize("bands", [1, 3])
def test_interrupt_keeps_what_is_finished(bands):
    """Ctrl-C ends a render between launches and hands over every finished sample, as if fewer had been asked for."""
    scene = gi.scenes.cornell_box()
    size = (48, 48)
    limit = gi.device.DEFAULT_MEMORY_LIMIT
    if bands > 1:
        limit = gi.device_scene.DeviceScene(scene, gi.Device("cpu")).nbytes
        limit += gi.film.BYTES_PER_PIXEL * (48 * 48 // bands + 1)
    done = []

    def press(state):
        done.append(state.done)
        if len(done) == 2:
            threading.Thread(target=os.kill, args=(os.getpid(), signal.SIGINT)).start()

    method = gi.PathTracing(spp=100_000_000)
    with pytest.raises(gi.Interrupted) as caught:
        gi.render(scene, method, size=size, device=gi.Device("cpu", memory_limit=limit), progress=press)
    render = caught.value.render
    assert done[-1] <= render.spp < method.spp
    assert np.isfinite(render.image).all()
    assert render.image.min() >= 0.0
    if bands == 1:
        whole = gi.render(scene, dataclasses.replace(method, spp=render.spp), size=size)
        np.testing.assert_array_equal(render.image, whole.image)
