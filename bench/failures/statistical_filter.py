"""Where the statistical filter fails: too few or too many modes, and too few frames."""

from __future__ import annotations

from functools import cache

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value

SIZE = (48, 48)
FRAMES = 40
SPP = 16
TRUTH_SPP = 256


@cache
def _stacks(device: gi.Device) -> tuple[gi.Animation, np.ndarray]:
    """Noisy frames of moving-ball, and frames nearly without noise."""
    ball = gi.scenes.moving_ball(frames=FRAMES)
    noisy = gi.render_animation(ball, gi.PathTracing(spp=SPP), SIZE, 0, device)
    truth = gi.render_animation(ball, gi.PathTracing(spp=TRUTH_SPP), SIZE, 1, device)
    return noisy, truth.stack("indirect").astype(np.float64)


def _error(device: gi.Device, **settings: object) -> Value:
    """Mean squared error of the filtered frames in parts of that of the noisy ones."""
    noisy, truth = _stacks(device)
    smooth = gi.filter_animation(noisy, gi.StatisticalFilter(**settings), device)  # type: ignore[arg-type]
    errors = [np.square(each.stack("indirect") - truth).mean() for each in (smooth, noisy)]
    return Value(float(errors[0] / errors[1]))


def _of_frames(count: int, device: gi.Device) -> Value:
    """The same for a few frames out of the middle alone."""
    noisy, truth = _stacks(device)
    middle = range((FRAMES - count) // 2, (FRAMES - count) // 2 + count)
    few = gi.Animation([noisy[i] for i in middle], tuple(range(count)))
    smooth = gi.filter_animation(few, device=device)
    errors = [np.square(each.stack("indirect") - truth[middle.start : middle.stop]).mean() for each in (smooth, few)]
    return Value(float(errors[0] / errors[1]))


def _more_frames_than_pixels(device: gi.Device) -> Value:
    """Error left of a still 4 x 4 picture over 64 frames, in parts of what averaging would leave."""
    truth = np.random.default_rng(2).uniform(1.0, 2.0, (4, 4, 3))
    noise = 0.3 * np.random.default_rng(3).normal(size=(64, 4, 4, 3))
    renders = [
        gi.Render(
            {
                "indirect": (truth + each).astype(np.float32),
                "normal": np.tile(np.float32([0, 0, 1]), (4, 4, 1)),
                "depth": np.ones((4, 4, 1), np.float32),
            }
        )
        for each in noise
    ]
    smooth = gi.filter_animation(gi.Animation(renders, tuple(range(64))), device=device).stack("indirect")
    return Value(float(np.square(smooth - truth).mean() / (0.3**2 / 64)))


NAME, BALL, WHAT = "statistical-filter", "moving-ball", "squared error in parts of the noisy frames', "
ROWS = (
    Failure(NAME, BALL, WHAT + "M as it is chosen", 0.25, lambda device: _error(device)),
    Failure(NAME, BALL, WHAT + "M = 1 loses the contact shadow", None, lambda device: _error(device, modes=1)),
    Failure(
        NAME, BALL, WHAT + "M = 20 brings noise back", None, lambda device: _error(device, modes=20, per_pixel=False)
    ),
    Failure(NAME, BALL, WHAT + "M = 20, but per pixel", 0.25, lambda device: _error(device, modes=20)),
    Failure(NAME, BALL, WHAT + "one frame alone", None, lambda device: _of_frames(1, device)),
    Failure(NAME, BALL, WHAT + "two frames alone", None, lambda device: _of_frames(2, device)),
    Failure(NAME, "64 frames of 4 x 4", "squared error in parts of averaging's", 2.0, _more_frames_than_pixels),
)
