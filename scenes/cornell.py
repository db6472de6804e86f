"""The Cornell box as it was measured (Cornell University Program of Computer Graphics, "Cornell Box Data")."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.materials import Dielectric, Diffuse, Emissive, Mirror
from warpgi.scene import Scene, Shape
from warpgi.scenes.primitives import Mesh, icosphere, merge, quads
from warpgi.scenes.spectra import GREEN, RED, WHITE, lamp_rgb, reflectance_rgb

# Corners in millimetres, as published; x grows to the picture's left, so the red wall at 552.8 is on the left.
HEIGHT, DEPTH = 548.8, 559.2
FLOOR = [(552.8, 0, 0), (0, 0, 0), (0, 0, 559.2), (549.6, 0, 559.2)]
CEILING = [(556, 548.8, 0), (556, 548.8, 559.2), (0, 548.8, 559.2), (0, 548.8, 0)]
LAMP = [(343, 548.8, 227), (343, 548.8, 332), (213, 548.8, 332), (213, 548.8, 227)]
BACK = [(549.6, 0, 559.2), (0, 0, 559.2), (0, 548.8, 559.2), (556, 548.8, 559.2)]
RIGHT = [(0, 0, 559.2), (0, 0, 0), (0, 548.8, 0), (0, 548.8, 559.2)]
LEFT = [(552.8, 0, 0), (549.6, 0, 559.2), (556, 548.8, 559.2), (556, 548.8, 0)]
SHORT_BLOCK = [(130, 65), (82, 225), (240, 272), (290, 114)]  # x, z of the top's corners
TALL_BLOCK = [(423, 247), (265, 296), (314, 456), (472, 406)]
SHORT_HEIGHT, TALL_HEIGHT = 165.0, 330.0
LAMP_REFLECTANCE = 0.78
FOCAL_LENGTH, FILM = 35.0, 25.0  # mm


def cornell_box(spheres: bool = False, brightness: float = 2.5) -> Scene:
    """The Cornell box in metres, with the measured paints and lamp as linear sRGB.

    The lamp fills a hole in the ceiling, so no two surfaces are in one plane on top of each other. The front is open.

    Args:
        spheres: a mirror ball and a glass ball in place of the two blocks, for caustics.
        brightness: factor on the lamp's published emission, which has no unit; at 1 the lamp's radiance is
            (17.2, 11.5, 3.1), close to the (17, 12, 4) that many renderers take.

    Example:
        >>> import warpgi as gi
        >>> scene = gi.scenes.cornell_box()
        >>> scene.triangle_count
        38
    """
    checks.number("brightness", brightness, 0.0)
    white, green, red = (Diffuse(reflectance_rgb(table)) for table in (WHITE, GREEN, RED))
    shapes = [
        merge([_walls(FLOOR), _walls(BACK), _ceiling()]).shape(white, "floor, back and ceiling", smooth=False),
        _walls(RIGHT).shape(green, "right wall", smooth=False),
        _walls(LEFT).shape(red, "left wall", smooth=False),
        _walls(LAMP).shape(
            Diffuse(LAMP_REFLECTANCE), "lamp", Emissive(tuple(brightness * c for c in lamp_rgb())), smooth=False
        ),
    ]
    shapes += _balls() if spheres else _blocks(white)
    fov = math.degrees(2.0 * math.atan(0.5 * FILM / FOCAL_LENGTH))
    camera = Camera((0.278, 0.273, -0.8), (0.278, 0.273, 0.0), fov=fov)
    return Scene(shapes, camera, name="cornell-spheres" if spheres else "cornell-box")


def cornell_spheres(brightness: float = 2.5) -> Scene:
    """The Cornell box with a mirror ball and a glass ball in place of the two blocks.

    Args:
        brightness: factor on the lamp's published emission.
    """
    return cornell_box(spheres=True, brightness=brightness)


def _walls(*corners: list[tuple[float, float, float]]) -> Mesh:
    return quads(np.array(corners, dtype=np.float64) / 1000.0)


def _ceiling() -> Mesh:
    # A frame around the lamp: each side is the quad between an edge of the ceiling and the same edge of the hole.
    return _walls(*([CEILING[i], CEILING[(i + 1) % 4], LAMP[(i + 1) % 4], LAMP[i]] for i in range(4)))


def _blocks(white: Diffuse) -> list[Shape]:
    return [
        _block(SHORT_BLOCK, SHORT_HEIGHT).shape(white, "short block", smooth=False),
        _block(TALL_BLOCK, TALL_HEIGHT).shape(white, "tall block", smooth=False),
    ]


def _block(corners: list[tuple[float, float]], height: float) -> Mesh:
    # No bottom: it would lie in the plane of the floor.
    top = [(x, height, z) for x, z in corners]
    sides = []
    for (x0, z0), (x1, z1) in pairwise([*corners, corners[0]]):
        sides.append([(x0, height, z0), (x0, 0.0, z0), (x1, 0.0, z1), (x1, height, z1)])
    return _walls(top, *sides)


def _balls() -> list[Shape]:
    # Half a millimetre above the floor: glass that cuts the floor would trap light between the two.
    mirror = icosphere(0.1, 5).move((0.38, 0.1005, 0.37))
    glass = icosphere(0.1, 5).move((0.17, 0.1005, 0.18))
    return [mirror.shape(Mirror((0.95, 0.95, 0.95)), "mirror ball"), glass.shape(Dielectric(1.5), "glass ball")]
