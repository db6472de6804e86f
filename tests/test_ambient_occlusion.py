"""Ambient occlusion against closed forms: walls on a floor, seen from a floor's points."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import warpgi as gi
from warpgi.samples import SampleBuffer, escaped_hit

LENGTH, HEIGHT = 3.0, 1.0


def floor_and_walls(walls):
    """A floor with walls of 3 m x 1 m in the planes x = 0 and z = 0, the floor seen from 1 m above."""
    faces = [(0, 1, 2), (0, 2, 3)]
    floor = gi.Shape([(-9, 0, -9), (-9, 0, 9), (9, 0, 9), (9, 0, -9)], faces, gi.Diffuse(0.5))
    corners = [wall_corners(axis) for axis in range(walls)]
    shapes = [gi.Shape(points, faces, gi.Diffuse(0.5)) for points in corners]
    camera = gi.Camera((0.6, 1.0, 0.6), (0.6, 0.0, 0.6), up=(0, 0, -1), fov=50)
    return gi.Scene([floor, *shapes], camera, [gi.Environment(1.0)]), corners


def wall_corners(axis):
    along = LENGTH * np.eye(3)[2 - 2 * axis]
    up = np.array([0.0, HEIGHT, 0.0])
    start = np.zeros(3)
    return np.array([start, start + along, start + along + up, start + up])


def form_factor(points, corners):
    """Share of a floor point's cosine-weighted hemisphere that a polygon fills (Lambert 1760)."""
    total = np.zeros(len(points))
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        u, v = a - points, b - points
        cross = np.cross(u, v)
        length = np.linalg.norm(cross, axis=1)
        total += np.arctan2(length, (u * v).sum(axis=1)) * cross[:, 1] / np.maximum(length, 1e-30)
    return np.abs(total) / (2.0 * np.pi)


def within_reach(points, radius, walls):
    """The same share for walls without end that count to a radius: where d.axis > distance / radius, on the unit disc.

    Cosine-weighted directions are uniform on the disc below them (Malley), so shares are areas of it.
    """
    grid = (np.arange(800) + 0.5) / 400.0 - 1.0
    x, z = np.meshgrid(grid, grid)
    inside = x * x + z * z < 1.0
    x, z = x[inside], z[inside]
    result = np.empty(len(points))
    for i, (px, _, pz) in enumerate(points):
        met = x < -px / radius
        if walls == 2:
            met |= z < -pz / radius
        result[i] = met.mean()
    return result


def test_the_closed_forms_agree():
    """A wall without end fills (acos c - c sqrt(1 - c^2)) / pi within a radius of 1/c distances; both forms say so."""
    points = np.array([(0.2, 0.0, 0.3), (0.5, 0.0, 0.5)])
    c = points[:, 0] / 0.8
    expected = (np.arccos(c) - c * np.sqrt(1.0 - c * c)) / np.pi
    np.testing.assert_allclose(within_reach(points, 0.8, 1), expected, atol=1e-3)
    huge = np.array([(0.0, 0.0, -1e4), (0.0, 0.0, 1e4), (0.0, 1e4, 1e4), (0.0, 1e4, -1e4)])
    np.testing.assert_allclose(form_factor(points, huge), 0.5, atol=1e-3)


@pytest.mark.parametrize("walls", [1, 2], ids=["half-plane", "corner"])
@pytest.mark.parametrize("radius", [np.inf, 0.8])
def test_walls_on_a_floor(walls, radius):
    """Visibility is 1 minus the walls' form factors at every pixel.

    A pixel's 256 rays miss by some 256^-0.75 = 0.016, four times which its worst of 576 may; a wall's splats stand out
    over its edges, or count by their centre's distance, by half of their radius of 0.1 m, and fill up to 0.02 too much.
    """
    scene, corners = floor_and_walls(walls)
    render = gi.render(scene, gi.AmbientOcclusion(spp=4, rays=256, radius=radius), size=(24, 24))
    position = render.layers["position"].reshape(-1, 3).astype(np.float64)
    assert position[:, [0, 2]].min() > 0.1 and np.abs(position[:, 1]).max() < 1e-5
    if radius == np.inf:
        filled = sum(form_factor(position, polygon) for polygon in corners)
    else:
        assert radius < HEIGHT
        filled = within_reach(position, radius, walls)
    assert np.ptp(filled) > 0.2
    image = render.image.astype(np.float64)
    np.testing.assert_array_equal(image, image[..., :1].repeat(3, axis=2))  # grey
    difference = image[..., 0].ravel() - (1.0 - filled)
    assert abs(difference.mean()) < 0.02, f"mean {difference.mean():.4f}"
    assert np.abs(difference).max() < 0.08, f"largest {np.abs(difference).max():.4f}"


def test_more_samples_come_closer():
    """The error of the corner falls with the samples of its walls: splats shrink as their number grows."""
    scene, corners = floor_and_walls(2)
    errors = []
    for spp in (1, 4, 16):
        render = gi.render(scene, gi.AmbientOcclusion(spp=spp, rays=256), size=(24, 24), seed=2)
        position = render.layers["position"].reshape(-1, 3).astype(np.float64)
        filled = sum(form_factor(position, polygon) for polygon in corners)
        errors.append(np.sqrt(np.square(render.image[..., 0].ravel() - (1.0 - filled)).mean()))
    assert errors[0] > errors[1] > errors[2]


def test_open_plane_and_closed_room():
    """Nothing occludes a lone plane, exactly; everything a closed room, unless it is beyond the radius, exactly."""
    plane, _ = floor_and_walls(0)
    method = gi.AmbientOcclusion(spp=2, rays=32)
    np.testing.assert_array_equal(gi.render(plane, method, size=(8, 8)).image, 1.0)
    room, _ = gi.scenes.room()
    np.testing.assert_allclose(
        gi.render(room, gi.AmbientOcclusion(spp=4, rays=32), size=(16, 16)).image, 0.0, atol=0.04
    )
    # the sphere's wall is 1 away from its middle: no chord from a wall's point is shorter than this in most directions
    near = gi.AmbientOcclusion(spp=4, rays=32, radius=1e-4)
    np.testing.assert_array_equal(gi.render(room, near, size=(16, 16)).image, 1.0)


def test_it_needs_no_light():
    """A scene without light has the picture of the lit one, and no warning that it is black."""
    scene, _ = floor_and_walls(1)
    method = gi.AmbientOcclusion(spp=2, rays=32)
    lit = gi.render(scene, method, size=(8, 8)).image
    np.testing.assert_array_equal(gi.render(gi.Scene(scene.shapes, scene.camera), method, size=(8, 8)).image, lit)


def test_radiance_does_not_matter():
    """The buffer's light has no part in it: black, bright and infinite-range samples give the same bits."""
    from dataclasses import replace

    samples = gi.sample(gi.scenes.cornell_box(), spp=4, size=(12, 12))
    method = gi.AmbientOcclusion(rays=64, radius=0.3)
    pictures = [
        gi.reconstruct(replace(samples, radiance=samples.radiance * np.float32(s)), method).image for s in (0, 1, 1e30)
    ]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert 0.3 < pictures[0][pictures[0] > 0.0].mean() < 0.95


def test_unknown_is_not_open():
    """Where no primary hit is, the picture is 0, and every value lies in [0, 1]."""
    samples = gi.sample(gi.scenes.cornell_spheres(), spp=2, size=(24, 24))
    image = gi.reconstruct(samples, gi.AmbientOcclusion(rays=32, radius=0.2)).image
    has = samples.checked.is_primary.reshape(24, 24, 2).any(axis=2)
    assert (image[~has] == 0.0).all() and image.min() >= 0.0 and image.max() <= 1.0
    assert not has.all()


def test_agrees_with_the_authors_program():
    """On the authors' buffer with radius 0.5 the picture is theirs to 35 dB: to 0.018, a tenth of its contrast."""
    folder = Path(os.environ.get("WARPGI_REFERENCE", Path(__file__).parents[1] / "../shared/reference"))
    if not (folder / "cornell64.authors_ao.npy").exists():
        pytest.skip(f"{folder} does not hold cornell64.authors_ao.npy; WARPGI_REFERENCE names the folder that does")
    samples = SampleBuffer.load(folder / "cornell64.bin")
    authors = np.squeeze(np.load(folder / "cornell64.authors_ao.npy")).astype(np.float64)
    image = gi.reconstruct(samples, gi.AmbientOcclusion(rays=256, radius=0.5)).image[..., 0]
    authors = authors if authors.ndim == 2 else authors[..., 0]
    assert 10.0 * np.log10(1.0 / np.square(image - authors).mean()) > 35.0
    # the buffer's own rays know the answer: the share of those that are longer, or left
    state = samples.checked
    with np.errstate(over="ignore"):
        long = state.is_escaped | (np.linalg.norm(samples.hit.astype(np.float64) - samples.origin, axis=1) > 0.5)
    share = long[state.is_primary]
    error = share.std() / np.sqrt(len(share))
    assert abs(image.mean() - share.mean()) < 4.4 * error + 0.005


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": 0.0}, "radius is 0, expected"),
        ({"radius": -1.0}, "radius is -1, expected"),
        ({"radius": float("nan")}, "radius is nan, expected"),
        ({"radius": "far"}, "radius is 'far', expected"),
        ({"spp": 0}, "spp is 0, expected"),
        ({"rays": 0}, "rays is 0, expected"),
        ({"neighbours": 40}, "neighbours is 40, expected"),
        ({"alpha": 0.0}, "alpha is 0, expected"),
        ({"margin": 0.5}, r"margin is 0\.5, expected"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    """Each setting says in one sentence what came and what was wanted."""
    with pytest.raises((TypeError, ValueError), match=message):
        gi.AmbientOcclusion(**settings)


def test_escaped_rays_alone_are_an_open_sky():
    """A buffer in which every ray left has visibility 1, exactly."""
    up = np.tile(np.float32([0.0, 1.0, 0.0]), (12, 1))
    origin = np.zeros((12, 3), np.float32)
    samples = SampleBuffer(
        12,
        1,
        1,
        radiance=0 * up,
        origin=origin,
        hit=escaped_hit(origin, up),
        origin_normal=up,
        hit_normal=0 * up,
        albedo=up,
    )
    np.testing.assert_array_equal(gi.reconstruct(samples, gi.AmbientOcclusion(rays=16)).image, 1.0)


def test_without_shrinking_leaves_grow():
    """Splats that do not shrink stand in the way of what was seen: small far things darken the picture."""
    scene = gi.scenes.butterflies(motion=0.0, aperture=0.0)
    with_it, without = (
        gi.render(scene, gi.AmbientOcclusion(spp=2, rays=16, radius=0.5, shrink=on), size=(32, 20)).image
        for on in (True, False)
    )
    assert without.mean() < with_it.mean() - 0.01
