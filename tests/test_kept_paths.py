"""Light paths kept from frame to frame: aims found again, weights that fill their domain, and less flicker."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.kept_paths import PATH, KeptPaths
from warpgi.light_domains import disc_to_square, domains, square_to_disc
from warpgi.photons import PhotonSource

SIZE = (24, 24)
QUAD = [(0, 1, 2), (0, 2, 3)]
FLOOR = gi.Shape([(-2, 0, -2), (-2, 0, 2), (2, 0, 2), (2, 0, -2)], QUAD, gi.Diffuse(0.5), name="floor")
CAMERA = gi.Camera((0, 1, 4), (0, 0.5, 0))
PANEL = [(-0.3, 1.5, -0.3), (0.3, 1.5, -0.3), (0.3, 1.5, 0.3), (-0.3, 1.5, 0.3)]
LIGHTS = {
    "lamp": ([gi.Shape(PANEL, QUAD, gi.Diffuse(0.0), gi.Emissive(2.0))], []),
    "lamp on both sides": ([gi.Shape(PANEL, QUAD, gi.Diffuse(0.0), gi.Emissive(2.0, two_sided=True))], []),
    "point": ([], [gi.PointLight((0.2, 1.0, 0.1), 2.0)]),
    "spot": ([], [gi.SpotLight((0.2, 1.0, 0.1), (0.3, -1.0, 0.1), 2.0, 0.4, 0.8)]),
    "sun": ([], [gi.DistantLight((0.5, -1.0, 0.2), 2.0)]),
    "sky": ([], [gi.Environment(0.7)]),
    "several": ([], [gi.PointLight((0.2, 1.0, 0.1), 2.0), gi.DistantLight((0.5, -1.0, 0.2), 2.0), gi.Environment(0.7)]),
}


def source_of(scene, seed=0):
    return PhotonSource(DeviceScene(scene, gi.Device("cpu")), seed, 1, sharpest=20.0)


def lit(name):
    shapes, lights = LIGHTS[name]
    return gi.Scene([FLOOR, *shapes], CAMERA, lights)


@pytest.mark.parametrize("name", LIGHTS)
def test_aims_lead_to_the_point_that_they_are_for(name):
    """A path that is aimed at the point that another met meets that point too, for every kind of light."""
    source = source_of(lit(name))
    kept = KeptPaths(source, 200, 1)
    before = kept.paths.copy()
    assert (before["met"] >= 0).sum() > 20
    assert not kept._turn_aims(source.scene)
    np.testing.assert_array_equal(before["aim"], kept.paths["aim"])
    for light, domain in enumerate(kept.domains):
        some = before[before["light"] == light]
        met = some["met"] >= 0
        places = source.scene.scene.shapes[0].vertices  # all that is met first is the floor or the lamp
        assert np.abs(places).max() == 2.0
        aim, can = domain.aim_at(some["face"], some["u"], some["far"], np.ones(len(some), bool))
        if domain.triangles is not None or domain.position is not None:
            assert can.all()
            np.testing.assert_allclose(domain.embed(aim), domain.embed(some["aim"]), atol=1e-6)
        assert met.any() or domain.share == 0.0 or name == "lamp on both sides"


@pytest.mark.parametrize("name", LIGHTS)
def test_kept_paths_carry_the_flux_of_their_lights(name):
    """Voronoi cells add up to each light's domain, and what arrives on a floor is what drawn paths bring there."""
    scene = lit(name)
    scene = dataclasses.replace(scene, shapes=[dataclasses.replace(FLOOR, material=gi.Diffuse(0.0)), *scene.shapes[1:]])
    source = source_of(scene)
    kept = KeptPaths(source, 400, 1)
    for light, domain in enumerate(kept.domains):
        assert kept.weights()[kept.paths["light"] == light].sum() == pytest.approx(1.0)
        assert domain.share > 0.0
    drawn = source.shoot(40_000, 0)
    expected = drawn.photons.flux.numpy()[: drawn.count, 0].sum(dtype=np.float64)
    found = kept.shoot(source).photons.flux.numpy()[:, 0].sum(dtype=np.float64)
    # of 400 even cells some 80 lie across the floor's border: each of these is half right
    assert found == pytest.approx(expected, rel=4.4 * 0.5 * math.sqrt(80.0) / 200.0)


def test_disc_and_square_are_inverse():
    """The way back from the concentric disc, with its axes and its centre."""
    square = np.concatenate([np.random.default_rng(0).random((1000, 2)), [(0.5, 0.5), (0.5, 0.7), (0.1, 0.5)]])
    np.testing.assert_allclose(disc_to_square(square_to_disc(square)), square, atol=1e-12)


def test_paths_whose_light_is_blocked_are_replaced():
    """A board that comes between light and floor takes away the paths that went through it, and no others."""
    light = [gi.PointLight((0.0, 1.0, 0.0), 2.0)]
    board = gi.Shape([(-5, 0, 0), (-4, 0, 0), (-4, 0, 1), (-5, 0, 1)], QUAD, name="board")
    source = source_of(gi.Scene([FLOOR, board], CAMERA, light))
    kept = KeptPaths(source, 200, 1)
    before = {int(path["key"]): path for path in kept.paths}
    # at half the height: it hides floor from -1 to 1 along x, 0 to 2 along z
    moved = dataclasses.replace(board, vertices=np.add(board.vertices, (4.5, 0.5, 0.0)))
    half = np.array([(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, 0.5, 1.0), (-0.5, 0.5, 1.0)])
    np.testing.assert_allclose(moved.vertices, half)
    after = kept.advance(source_of(gi.Scene([FLOOR, moved], CAMERA, light)), budget=1000)
    directions = np.array([path["far"] for path in before.values()])
    through = np.full((len(directions), 2), np.inf)
    down = directions[:, 1] < 0.0
    through[down] = -0.5 * directions[down][:, ::2] / directions[down][:, 1:2]
    hidden = (np.abs(through[:, 0]) < 0.5) & (through[:, 1] > 0.0) & (through[:, 1] < 1.0)
    gone = set(before) - {int(key) for key in after.paths["key"]}
    assert 5 < hidden.sum() < 100
    assert gone == {key for key, dark in zip(before, hidden, strict=True) if dark}
    assert len(after.paths) == 200
    assert after.made == hidden.sum()


def test_a_budget_bounds_what_is_made():
    """Never more than so many new paths a frame, never more than so many in all; a still frame makes none."""
    sequence = gi.scenes.moving_light(frames=20)
    kept = KeptPaths(source_of(sequence.scene(0)), 40, 1)
    for number in range(1, 8):
        kept = kept.advance(source_of(sequence.scene(number)), 3)
        assert kept.made <= 3
        assert len(kept.paths) <= 40
    last = kept.paths.copy()
    still = kept.advance(source_of(sequence.scene(7)), 3)
    assert still.made == 0
    assert last.dtype == PATH
    np.testing.assert_array_equal(still.paths, last)


def test_a_light_that_goes_on_gets_its_paths():
    """A light of strength 0 has none, and its share of them as soon as it shines."""
    bright, dark = gi.PointLight((0.5, 1, 0), 2.0), gi.PointLight((-0.5, 1, 0), 0.0)
    kept = KeptPaths(source_of(gi.Scene([FLOOR], CAMERA, [bright, dark])), 40, 1)
    assert np.bincount(kept.paths["light"], minlength=2).tolist() == [40, 0]
    both = [bright, dataclasses.replace(dark, intensity=2.0)]
    source = source_of(gi.Scene([FLOOR], CAMERA, both))
    for _ in range(4):
        kept = kept.advance(source, 10)
    assert np.bincount(kept.paths["light"], minlength=2).tolist() == [20, 20]
    assert len(domains(source.scene, source.emission)) == 2
    with pytest.raises(ValueError, match="paths is 1, expected 2 or more"):
        KeptPaths(source, 1, 1)


def test_kept_paths_light_as_drawn_ones_do():
    """After a dozen frames of a moving lamp the picture's mean over many sequences is the path tracer's."""
    sequence = gi.scenes.moving_light(frames=100)
    method = gi.InstantRadiosity(paths=32, spp=1, renewed_paths=3)
    means = []
    for seed in range(16):
        animation = gi.render_animation(sequence, method, (16, 16), seed, "cpu", frames=[10])
        means.append(animation[0].layers["indirect"].mean(dtype=np.float64))
    expected = gi.render(sequence.scene(10), gi.PathTracing(spp=1024), (16, 16), device="cpu").layers["indirect"].mean()
    # Student's t of 15 degrees: 1e-3 at 4.1; the reference's error is a tenth of that of 16 sets
    assert abs(np.mean(means) - expected) < 4.1 * np.std(means, ddof=1) / 4.0 < 0.2 * expected


def test_flicker_is_a_quarter():
    """At 64 paths kept sets flicker at most a quarter as much as fresh ones, at no more shadow rays."""
    sequence = gi.scenes.moving_light(frames=100)
    frames = range(6)
    references = np.stack(
        [
            gi.render(sequence.scene(i), gi.PathTracing(spp=512), SIZE, seed=5, device="cpu").layers["indirect"]
            for i in frames
        ]
    )
    method = gi.InstantRadiosity(paths=64)
    flicker, rays = {}, {}
    for renewed in (None, 2):
        kind = dataclasses.replace(method, renewed_paths=renewed)
        animation = gi.render_animation(sequence, kind, SIZE, 0, "cpu", frames=frames)
        flicker[renewed] = gi.flicker(animation.stack("indirect"), references)
        rays[renewed] = animation.counts["shadow_rays"]
    assert flicker[2] < 0.25 * flicker[None]
    assert rays[2] < 1.2 * rays[None]


def test_resumed_frames_are_the_same(tmp_path):
    """A frame that is rendered again, with those before it in files, is the one of a whole run, to the last bit."""
    sequence = gi.scenes.moving_ball(frames=4, subdivisions=1)
    method = gi.InstantRadiosity(paths=16, spp=1, renewed_paths=2)
    out = tmp_path / "f-{}.exr"
    gi.render_animation(sequence, method, (12, 8), device="cpu", out=out)
    whole = {path.name: path.read_bytes() for path in tmp_path.glob("*.exr")}
    (tmp_path / "f-2.exr").unlink()
    animation = gi.render_animation(sequence, method, (12, 8), device="cpu", out=out, resume=True)
    assert animation.rendered == (2,)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.exr")} == whole
    still = gi.Sequence(2, lambda frame: sequence.scene(0))
    frames = gi.render_animation(still, method, (12, 8), device="cpu")
    np.testing.assert_array_equal(frames[0].image, frames[1].image)


def test_one_set_is_kept():
    """Several sets a picture and kept paths exclude each other."""
    with pytest.raises(ValueError, match="renewed_paths is given, expected None where set_spp is 1"):
        gi.InstantRadiosity(renewed_paths=2, set_spp=1)
    with pytest.raises(ValueError, match="renewed_paths is -1"):
        gi.InstantRadiosity(renewed_paths=-1)
