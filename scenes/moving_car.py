"""After MA06, figure 1: a car drives out of a garage at dusk, the camera follows, and a light goes on."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import Environment, SpotLight
from warpgi.materials import Coated, Diffuse, Emissive, Material
from warpgi.scene import Scene, Shape
from warpgi.scenes.primitives import Mesh, box, lathe, merge, quad
from warpgi.sequence import Sequence

WHEEL = 0.32  # radius [m]
TRACK, AXLES = 0.78, (-1.25, 1.3)  # wheels: half the distance across, and places along the car [m]
PATH = (-2.6, 2.8)  # where the car starts and ends, along x [m]


class Part(NamedTuple):
    """Triangles of one material."""

    mesh: Mesh
    material: Material
    smooth: bool = False


def moving_car(frames: int = 126, light_on: float = 0.4, dusk: float = 0.5) -> Sequence:
    """A car drives along the wall of a yard, the camera goes with it, and a lamp on the wall goes on.

    Args:
        frames: of the drive, 1 or more.
        light_on: when the lamp goes on, in parts of the sequence, in [0, 1].
        dusk: radiance of the sky, W/(sr m^2).
    """
    checks.count("frames", frames)
    checks.number("light_on", light_on, 0.0, 1.0)
    checks.number("dusk", dusk, 0.0)
    yard = _yard()
    body, wheel = _body(), _wheel()
    sky = Environment((0.7 * dusk, 0.85 * dusk, 1.25 * dusk))

    def scene_at(frame: int) -> Scene:
        t = frame / max(frames - 1, 1)
        # speed 0 at both ends
        x = PATH[0] + (PATH[1] - PATH[0]) * (3.0 - 2.0 * t) * t * t
        on = float(frame >= light_on * frames)
        lamp = quad((-0.6, 3.3, -1.5), (1.2, 0, 0), (0, 0, 0.6))
        shapes = [*yard, lamp.shape(Diffuse(0.2), "lamp", Emissive((20.0 * on, 15.0 * on, 9.0 * on)), smooth=False)]
        shapes += [_place(part, name, (x, 0.0, 0.0)) for name, part in body.items()]
        for i, (along, side) in enumerate((a, s) for a in AXLES for s in (-1.0, 1.0)):
            turned = {name: part._replace(mesh=_roll(part.mesh, x / WHEEL)) for name, part in wheel.items()}
            at = (x + along, WHEEL, side * TRACK)
            shapes += [_place(part, f"{name} {i}", at) for name, part in turned.items()]
        # headlights aim a little down; they are on all the time
        beams = [
            SpotLight((x + 2.06, 0.66, side), (1.0, -0.12, 0.0), (16.0, 15.0, 12.0), 0.1, 0.5) for side in (-0.55, 0.55)
        ]
        camera = Camera((0.6 * x + 4.6, 1.55 + 0.5 * t, 4.6 - 0.6 * t), (0.75 * x + 0.3, 0.75, -0.2), fov=44.0)
        return Scene(shapes, camera, [*beams, sky], "moving-car")

    return Sequence(frames, scene_at, name="moving-car")


def _yard() -> list[Shape]:
    """Paving, a wall with pillars and a roof over the lamp, and a coloured wall at the end."""
    floor = quad((-7.0, 0.0, 6.0), (14.0, 0, 0), (0, 0, -8.0)).shape(Diffuse((0.42, 0.40, 0.37)), "floor", smooth=False)
    wall = quad((-7.0, 0.0, -2.0), (14.0, 0, 0), (0, 4.5, 0)).shape(Diffuse((0.72, 0.62, 0.46)), "wall", smooth=False)
    ends = [
        quad((7.0, 0.0, -2.0), (0, 0, 8.0), (0, 4.5, 0)).shape(Diffuse((0.62, 0.18, 0.12)), "end wall", smooth=False),
        quad((-7.0, 0.0, 6.0), (0, 0, -8.0), (0, 4.5, 0)).shape(Diffuse((0.2, 0.36, 0.5)), "start wall", smooth=False),
    ]
    pillars = merge(box((x, 0.0, -2.0), (x + 0.5, 3.4, -1.65), skip="-y -z +y") for x in (-5.0, -2.6, 2.1, 4.5))
    roof = box((-6.0, 3.4, -2.0), (6.0, 3.55, -0.6), skip="-z")
    stone = Diffuse((0.55, 0.53, 0.50))
    return [floor, wall, *ends, merge([pillars, roof]).shape(stone, "pillars and roof", smooth=False)]


def _body() -> dict[str, Part]:
    """A small car that looks along +x, its wheels' lowest points at y = 0."""
    # outline of the car's side, clockwise seen from +z: lower body and cabin
    lower = [
        (-1.95, 0.38),
        (-2.02, 0.70),
        (-1.85, 0.92),
        (-0.9, 0.98),
        (1.0, 0.96),
        (1.85, 0.80),
        (2.05, 0.62),
        (2.0, 0.38),
    ]
    cabin = [(-1.35, 0.97), (-1.0, 1.38), (-0.35, 1.48), (0.25, 1.42), (0.95, 0.96)]
    paint = Coated((0.55, 0.05, 0.04), roughness=0.02)
    glass = Coated((0.03, 0.04, 0.05), roughness=0.01)
    lights = merge(box((2.0, 0.58, z - 0.16), (2.055, 0.70, z + 0.16), skip="-x") for z in (-0.55, 0.55))
    return {
        "body": Part(_extrude(lower, 0.82), paint),
        "cabin": Part(_extrude(cabin, 0.66), glass),
        "headlights": Part(lights, Diffuse((0.8, 0.8, 0.8))),
    }


def _wheel() -> dict[str, Part]:
    """A wheel about the z axis at the origin; its five bolts show that it turns."""
    tyre = lathe(
        [(0.2, -0.1), (WHEEL - 0.02, -0.1), (WHEEL, -0.07), (WHEEL, 0.07), (WHEEL - 0.02, 0.1), (0.2, 0.1)], 32
    )
    rim = merge([lathe([(0.2, -0.09), (0.0, -0.06)], 24).flip(), lathe([(0.2, 0.09), (0.0, 0.06)], 24)])
    angles = 2.0 * np.pi * np.arange(5) / 5
    bolts = [
        box((-0.03, side * 0.09 - 0.02, -0.03), (0.03, side * 0.09 + 0.02, 0.03)).move(
            (0.12 * math.cos(a), 0.0, 0.12 * math.sin(a))
        )
        for a in angles
        for side in (-1.0, 1.0)
    ]
    return {
        "tyre": Part(_upright(tyre), Diffuse((0.04, 0.04, 0.045)), smooth=True),
        "rim": Part(_upright(merge([rim, *bolts])), Diffuse((0.6, 0.6, 0.62))),
    }


def _extrude(outline: list[tuple[float, float]], half: float) -> Mesh:
    """The solid between z = -half and half over an outline in x, y, clockwise seen from +z; its side is a fan."""
    points = np.array(outline)
    ring = np.concatenate([points, points[:1]])
    sides = [quad((*a, -half), (0, 0, 2.0 * half), (*(b - a), 0)) for a, b in pairwise(ring)]
    count = len(points)
    fan = np.stack([np.zeros(count - 2), np.arange(1, count - 1), np.arange(2, count)], axis=1).astype(int)
    caps = []
    for z in (-half, half):
        faces = fan if z < 0 else fan[:, ::-1]
        normals = np.tile([0.0, 0.0, np.sign(z)], (count, 1))
        caps.append(Mesh(np.insert(points, 2, z, axis=1), faces, normals, points.copy()))
    return merge([*sides, *caps])


def _upright(mesh: Mesh) -> Mesh:
    """From about the y axis to about the z axis."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return mesh._replace(vertices=mesh.vertices @ turn.T, normals=mesh.normals @ turn.T)


def _roll(mesh: Mesh, angle: float) -> Mesh:
    """Turned about the z axis, as a wheel that rolls towards +x."""
    c, s = math.cos(-angle), math.sin(-angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return mesh._replace(vertices=mesh.vertices @ turn.T, normals=mesh.normals @ turn.T)


def _place(part: Part, name: str, at: tuple[float, float, float]) -> Shape:
    return part.mesh.move(at).shape(part.material, name, smooth=part.smooth)
