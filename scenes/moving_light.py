"""MA06, figure 2: a point light that moves in a circle under the ceiling of the Cornell box."""

from __future__ import annotations

import math
from dataclasses import replace

from warpgi import checks
from warpgi.lights import PointLight
from warpgi.scene import Scene
from warpgi.scenes.cornell import HEIGHT, cornell_box
from warpgi.sequence import Sequence

CENTRE = (0.278, 0.2795)  # x, z of the box's middle [m]
BELOW = 0.12  # distance from the ceiling [m]


def moving_light(frames: int = 100, radius: float = 0.15, power: float = 4.0) -> Sequence:
    """A point light that goes once in a circle under the ceiling of the Cornell box, whose lamp is off.

    Args:
        frames: of one turn, 1 or more.
        radius: of the circle [m], in [0, 0.25]; at 0 the sequence is still.
        power: radiant flux of the light [W], the same in each channel.
    """
    checks.number("radius", radius, 0.0, 0.25)
    checks.number("power", power, 0.0)
    box = cornell_box()
    shapes = [replace(shape, emission=None) for shape in box.shapes]
    intensity = (power / (4.0 * math.pi),) * 3

    def scene_at(frame: int) -> Scene:
        angle = 2.0 * math.pi * frame / frames
        x, z = CENTRE[0] + radius * math.cos(angle), CENTRE[1] + radius * math.sin(angle)
        light = PointLight((x, HEIGHT / 1000.0 - BELOW, z), intensity)
        return Scene(shapes, box.camera, [light], "moving-light")

    return Sequence(frames, scene_at, name="moving-light")
