"""Sequences: a scene as a function of the frame, with what may change from frame to frame checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warpgi import checks
from warpgi.scene import Scene, Shape

# What a rigid motion may miss, in parts of the shape's size: rounding of float64 sines, far below float32.
RIGID_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Sequence:
    """A scene as a function of the frame.

    From frame to frame may change: the camera; position, direction and strength of lights; where a shape is and how it
    is turned; materials and emission. Shapes and lights correspond by their index, triangles by theirs, so all frames
    have the same shapes, by name, of the same faces and texture coordinates, and lights of the same kinds. A light that
    goes on has strength 0 before. What stays the same should be the same object, which is then hashed and sent to the
    device but once.

    Raises:
        TypeError, ValueError: an argument is wrong.

    Example:
        >>> import warpgi as gi
        >>> still = gi.Sequence(3, lambda frame: gi.scenes.cornell_box())
        >>> still.scene(2).name
        'cornell-box'
    """

    frames: int
    """How many frames there are."""
    scene_at: Callable[[int], Scene]
    """The scene of frame 0 to `frames` - 1; the same argument gives an equal scene."""
    fps: float = 24.0
    """Frames per second."""
    deforms: bool = False
    """Whether vertices may move on their own; else a shape moves as a rigid body and all else is refused."""
    name: str = "sequence"
    """How errors call it."""

    def __post_init__(self) -> None:
        checks.count("frames", self.frames)
        checks.number("fps", self.fps, 0.0, open_lower=True)
        if not callable(self.scene_at):
            raise TypeError(f"scene_at is {type(self.scene_at).__name__}, expected a function of the frame")

    def scene(self, frame: int) -> Scene:
        """The scene of one frame.

        Raises:
            TypeError, ValueError: there is no such frame, or its scene differs from frame 0 by what may not change.
        """
        frame = checks.count("frame", frame, 0, self.frames - 1)
        scene = self._made(frame)
        if frame > 0:
            check_correspondence(self._made(0), scene, frame, self.deforms)
        return scene

    def _made(self, frame: int) -> Scene:
        scene = self.scene_at(frame)
        if not isinstance(scene, Scene):
            raise TypeError(f"scene_at gives {type(scene).__name__} for frame {frame}, expected Scene")
        return scene


def check_correspondence(first: Scene, scene: Scene, frame: int, deforms: bool) -> None:
    """Refuses a scene that is not the first one with things moved and painted anew.

    Raises:
        ValueError: it is such.
    """
    names, wanted = ([shape.name for shape in each.shapes] for each in (scene, first))
    if names != wanted:
        other = next((i for i, (a, b) in enumerate(zip(names, wanted, strict=False)) if a != b), None)
        got, want = (f"{len(names)}", f"{len(wanted)}") if other is None else (names[other], wanted[other])
        raise ValueError(f"frame {frame} has shapes {got}, expected {want} as frame 0")
    kinds, wanted = ([type(light).__name__ for light in each.lights] for each in (scene, first))
    if kinds != wanted:
        raise ValueError(f"frame {frame} has lights {', '.join(kinds)}, expected {', '.join(wanted)} as frame 0")
    for before, after in zip(first.shapes, scene.shapes, strict=True):
        if before is after or before.geometry_fingerprint == after.geometry_fingerprint:
            continue
        same = len(before.vertices) == len(after.vertices) and np.array_equal(before.faces, after.faces)
        if not same or not _equal(before.uv, after.uv) or (before.normals is None) != (after.normals is None):
            raise ValueError(f"frame {frame}: {after.name} has other faces or uv, expected those of frame 0")
        if not deforms and rigid_motion(before, after) is None:
            raise ValueError(f"frame {frame}: {after.name} is deformed, expected a rigid motion, or deforms True")


def rigid_motion(before: Shape, after: Shape) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation (3, 3) and translation (3,) that take one shape's vertices to the other's; None: no rigid motion does.

    The rotation is the one of least squared error (Kabsch 1976).
    """
    a, b = before.vertices, after.vertices
    a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((a - a_mean).T @ (b - b_mean))
    turn = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = (u @ turn @ vt).T
    moved = (a - a_mean) @ rotation.T + b_mean
    size = max(float(np.ptp(b, axis=0).max()), 1e-30)
    # far from the origin the coordinates themselves are coarse
    slack = RIGID_TOLERANCE * size + 1e-12 * float(np.abs(b).max())
    if np.abs(moved - b).max() > slack:
        return None
    return rotation, b_mean - rotation @ a_mean


def _equal(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))
