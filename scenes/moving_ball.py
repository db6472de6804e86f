"""MA06, figure 3: a ball that moves over the floor of the Cornell box and takes its contact shadow along."""

from __future__ import annotations

from warpgi import checks
from warpgi.materials import Diffuse
from warpgi.scene import Scene
from warpgi.scenes.cornell import cornell_box
from warpgi.scenes.primitives import icosphere
from warpgi.scenes.spectra import WHITE, reflectance_rgb
from warpgi.sequence import Sequence

RADIUS = 0.085  # of the ball [m]
REACH = 0.33  # how far it goes [m]


def moving_ball(frames: int = 150, subdivisions: int = 4) -> Sequence:
    """A white ball that goes from right to left before another one, on the floor of the Cornell box.

    Args:
        frames: from one side to the other, 1 or more.
        subdivisions: a ball has 20 * 4^subdivisions triangles, 1 to 6.
    """
    checks.count("frames", frames)
    checks.count("subdivisions", subdivisions, 1, 6)
    box = cornell_box()
    white = Diffuse(reflectance_rgb(WHITE))
    # half a millimetre above the floor, so that the lowest point is not in its plane
    still = icosphere(0.11, subdivisions).move((0.34, 0.1105, 0.40)).shape(white, "still ball")
    walls = [*box.shapes[:4], still]
    ball = icosphere(RADIUS, subdivisions)

    def scene_at(frame: int) -> Scene:
        x = 0.278 + REACH * (frame / max(frames - 1, 1) - 0.5)
        moved = ball.move((x, RADIUS + 0.0005, 0.16)).shape(white, "moving ball")
        return Scene([*walls, moved], box.camera, name="moving-ball")

    return Sequence(frames, scene_at, name="moving-ball")
