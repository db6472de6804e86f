"""Sequences: what may change from frame to frame, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.fingerprint import fingerprint
from warpgi.scenes import SEQUENCES, build_sequence
from warpgi.sequence import rigid_motion


def turned(shape, angle, offset):
    """The shape, turned about y and moved."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    normals = None if shape.normals is None else shape.normals @ matrix.T
    return replace(shape, vertices=shape.vertices @ matrix.T + offset, normals=normals), matrix


def two_frames(change, **settings):
    """A sequence whose second frame is the Cornell box as `change` makes it."""
    box = gi.scenes.cornell_box()
    box = replace(box, lights=[gi.PointLight((0.2, 0.3, 0.2), 1.0)])
    return gi.Sequence(2, lambda frame: change(box) if frame else box, **settings)


def with_block(box, block):
    return replace(box, shapes=[*box.shapes[:4], block, *box.shapes[5:]])


@pytest.mark.parametrize("name", SEQUENCES)
def test_built_in_sequences(name):
    """Each has as many frames as MA06's, its name, and may be cut to a few; every frame may follow the first."""
    expected = {"moving-light": 100, "moving-ball": 150, "moving-car": 126}
    sequence = build_sequence(name)
    assert sequence.frames == expected[name]
    assert build_sequence(name, frames=3).frames == 3
    prints = {sequence.scene(frame).fingerprint for frame in range(0, sequence.frames, 7)}
    assert len(prints) == len(range(0, sequence.frames, 7))
    assert sequence.scene(5).fingerprint == build_sequence(name).scene(5).fingerprint
    assert sequence.scene(0).name == name


def test_a_light_goes_on_at_one_frame():
    """The lamp of moving-car is dark up to a frame and has one strength from there on."""
    sequence = build_sequence("moving-car", light_on=0.5)
    strength = [
        max(next(s for s in sequence.scene(frame).shapes if s.name == "lamp").emission.radiance)
        for frame in range(sequence.frames)
    ]
    np.testing.assert_array_equal(strength, np.where(np.arange(126) < 63, 0.0, max(strength)))


@pytest.mark.parametrize(
    "change",
    [
        lambda box: replace(box, camera=replace(box.camera, fov=30.0)),
        lambda box: replace(box, lights=[gi.PointLight((0.1, 0.3, 0.2), 0.0)]),
        lambda box: with_block(box, turned(box.shapes[4], 0.3, (0.1, 0.0, 0.0))[0]),
        lambda box: with_block(box, replace(box.shapes[4], material=gi.Mirror(), emission=gi.Emissive())),
    ],
    ids=["camera", "light", "rigid", "material"],
)
def test_what_may_change(change):
    """Camera, lights, rigid motion, materials and emission may; each makes another scene."""
    sequence = two_frames(change)
    assert sequence.scene(1).fingerprint != sequence.scene(0).fingerprint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda box: replace(box, shapes=box.shapes[1:]), "frame 1 has shapes"),
        (lambda box: replace(box, shapes=box.shapes[:-1]), "frame 1 has shapes 5, expected 6"),
        (lambda box: with_block(box, replace(box.shapes[4], name="brick")), "shapes brick, expected short block"),
        (lambda box: replace(box, lights=[gi.Environment(1.0)]), "lights Environment, expected PointLight"),
        (lambda box: replace(box, lights=[]), "frame 1 has lights"),
        (lambda box: with_block(box, replace(box.shapes[4], faces=box.shapes[4].faces[1:])), "short block has other"),
        (lambda box: with_block(box, replace(box.shapes[4], vertices=1.01 * box.shapes[4].vertices)), "deformed"),
        (lambda box: with_block(box, replace(box.shapes[4], vertices=box.shapes[4].vertices * [-1, 1, 1])), "deformed"),
        (lambda box: box.shapes, "gives tuple for frame 1, expected Scene"),
    ],
)
def test_what_may_not_change(change, message):
    """Other shapes, faces or kinds of lights, and a shape that is scaled or mirrored, are named with the frame."""
    with pytest.raises((ValueError, TypeError), match=message):
        two_frames(change).scene(1)


def test_deformation_on_request():
    """With `deforms` vertices may move as they like; faces still may not change."""
    stretch = two_frames(lambda box: with_block(box, replace(box.shapes[4], vertices=1.01 * box.shapes[4].vertices)))
    with pytest.raises(ValueError, match="or deforms True"):
        stretch.scene(1)
    assert replace(stretch, deforms=True).scene(1).name == "cornell-box"


def test_rigid_motion_is_found():
    """The rotation and translation that moved a shape come back to rounding, also far from the origin."""
    shape = gi.scenes.cornell_spheres().shapes[-1]
    for offset in ((0.0, 0.0, 0.0), (1e5, -2e5, 3e5)):
        after, matrix = turned(shape, 2.5, offset)
        rotation, translation = rigid_motion(shape, after)
        np.testing.assert_allclose(rotation, matrix, atol=1e-9)
        np.testing.assert_allclose(translation, offset, atol=1e-9 + 1e-9 * np.abs(offset).max())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": 0}, "frames is 0"),
        ({"fps": 0.0}, "fps is 0"),
        ({"scene_at": None}, "scene_at is NoneType"),
    ],
)
def test_bad_sequences(arguments, message):
    """A wrong argument is named."""
    good = {"frames": 2, "scene_at": lambda frame: gi.scenes.cornell_box()}
    with pytest.raises((ValueError, TypeError), match=message):
        gi.Sequence(**(good | arguments))


def test_no_such_frame_or_sequence():
    """A frame out of range and a name with a slip are named, the latter with what was meant."""
    with pytest.raises(ValueError, match="frame is 2, expected a whole number from 0 to 1"):
        two_frames(lambda box: box).scene(2)
    with pytest.raises(ValueError, match="did you mean 'moving-light'"):
        build_sequence("moving-ligth")
    with pytest.raises(ValueError, match="sequence moving-ball has no parameter 'radius'"):
        build_sequence("moving-ball", radius=1.0)


def test_fingerprints_tell_scenes_apart():
    """Equal scenes have one fingerprint; a vertex, a texel, a light, the camera or a name each make another."""
    floor = gi.Shape(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
        [(0, 1, 2)],
        gi.Diffuse(gi.Texture(np.full((2, 2, 3), 0.5))),
        uv=np.eye(3)[:, :2],
    )
    scene = gi.Scene([floor], gi.Camera((0, 0, 3), (0, 0, 0)), [gi.Environment(1.0)])
    texels = np.full((2, 2, 3), 0.5)
    texels[1, 1, 2] = 0.25
    moved = floor.vertices + np.array([[0, 0, 1e-12], [0, 0, 0], [0, 0, 0]])
    others = [
        replace(scene, shapes=[replace(floor, vertices=moved)]),
        replace(scene, shapes=[replace(floor, material=gi.Diffuse(gi.Texture(texels)))]),
        replace(scene, lights=[gi.Environment(1.5)]),
        replace(scene, camera=gi.Camera((0, 0, 3), (0, 0, 0), fov=41.0)),
        replace(scene, name="other"),
    ]
    prints = [each.fingerprint for each in (scene, *others)]
    assert len(set(prints)) == len(prints)
    assert replace(scene, shapes=[replace(floor)]).fingerprint == scene.fingerprint
    assert fingerprint([1, 2], [3]) != fingerprint([1], [2, 3])
    assert fingerprint(np.zeros(4)) != fingerprint(np.zeros((2, 2)))


def test_triangles_that_stay_are_shared():
    """A scene that differs in paint and light alone takes the arrays of the one before; a moved shape does not."""
    device = gi.Device("cpu")
    sequence = build_sequence("moving-light", frames=4)
    first = DeviceScene(sequence.scene(0), device)
    second = DeviceScene(sequence.scene(1), device, first)
    assert second.struct.points.ptr == first.struct.points.ptr
    assert second.struct.lights.ptr != first.struct.lights.ptr
    assert second.nbytes == first.nbytes
    balls = build_sequence("moving-ball", frames=4, subdivisions=1)
    one = DeviceScene(balls.scene(0), device)
    two = DeviceScene(balls.scene(1), device, one)
    assert two.struct.points.ptr != one.struct.points.ptr
