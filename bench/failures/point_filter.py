"""Where the filter at points of surfaces fails: too few points, or too few modes, lose a contact shadow."""

from __future__ import annotations

from functools import cache

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect

SIZE = (48, 48)
FRAMES = 12
MIDDLE = FRAMES // 2
TRUTH_SPP = 512


@cache
def _truth(device: gi.Device) -> np.ndarray:
    scene = gi.scenes.moving_ball(frames=FRAMES).scene(MIDDLE)
    return indirect(scene, gi.PathTracing(spp=TRUTH_SPP), SIZE, 1, device)


def _shadow(device: gi.Device, **settings: object) -> Value:
    """RMS error of light around the moving ball's contact with the floor, in parts of the light there."""
    ball = gi.scenes.moving_ball(frames=FRAMES)
    method = gi.PointFilter(**({"spp": 2, "rays": 64} | settings))  # type: ignore[arg-type]
    picture = gi.render_animation(ball, method, SIZE, 0, device)[MIDDLE]
    position = picture.layers["position"]
    shape = ball.scene(MIDDLE).shapes[-1].vertices
    middle, radius = shape.mean(axis=0), float(np.ptp(shape[:, 0])) / 2.0
    apart = np.linalg.norm(position[..., ::2] - middle[::2], axis=2)
    near = (apart < 1.1 * radius) & (position[..., 1] < 0.01 * radius)
    truth = _truth(device)[near]
    return Value(float(np.sqrt(np.square(picture.layers["indirect"][near] - truth).mean()) / truth.mean()))


NAME, BALL = "point-filter", "moving-ball"
WHAT = "RMS error of light in the contact shadow, in parts of its mean, "
ROWS = (
    Failure(NAME, BALL, WHAT + "points 2 pixels apart", 0.5, lambda device: _shadow(device, spacing=2.0)),
    Failure(NAME, BALL, WHAT + "24 pixels apart: too few lose it", None, lambda device: _shadow(device, spacing=24.0)),
    Failure(NAME, BALL, WHAT + "M = 1 loses it", None, lambda device: _shadow(device, spacing=2.0, modes=1)),
    Failure(
        NAME,
        BALL,
        WHAT + "the paper's epsilon and many paths lose it",
        None,
        lambda device: _shadow(device, spacing=2.0, rays=512, epsilon=0.005),
    ),
)
