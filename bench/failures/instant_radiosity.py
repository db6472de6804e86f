"""Where instant radiosity fails: spikes near lights, corners that go dark where these are cut off, and flicker."""

from __future__ import annotations

from functools import partial

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, mean_value
from bench.reference import make_reference

SIZE = (48, 48)
PATHS = 64
REFERENCE_SPP = 1024


def spikes(near: gi.NearLight, device: gi.Device) -> Value:
    """How many times as bright as the truth the worst pixel is, of those that are not nearly black."""
    scene = gi.scenes.cornell_box()
    truth = make_reference(scene, SIZE, REFERENCE_SPP, device=device).image.mean(axis=2, dtype=np.float64)
    method = gi.InstantRadiosity(paths=PATHS, near_light=near)
    pictures = [indirect(scene, method, SIZE, seed, device).mean(axis=2) for seed in range(4)]
    bright = truth > 0.1 * truth.mean()
    return mean_value([float((picture[bright] / truth[bright]).max()) for picture in pictures])


def edges(near: gi.NearLight, device: gi.Device) -> Value:
    """Light missing along edges of an evenly lit room, of either sign where it is kept."""
    scene, _ = gi.scenes.furnace(albedo=0.5)
    values = []
    for seed in range(8):
        render = gi.render(scene, gi.InstantRadiosity(paths=PATHS, set_spp=1, near_light=near), SIZE, seed, device)
        light = render.layers["indirect"].mean(axis=2, dtype=np.float64)
        # the wall is at 1 in one coordinate; how near is the next to it?
        second = np.sort(np.abs(render.layers["position"]), axis=2)[..., 1]
        values.append(float(1.0 - light[second > 0.95].mean() / light[second < 0.8].mean()))
    value = mean_value(values)
    return value if near is gi.NearLight.CLAMPED else Value(abs(value.value), value.error)


def flicker(paths: int, renewed: int | None, device: gi.Device) -> Value:
    """Flicker of indirect light over its mean, while a light moves under the Cornell box's ceiling."""
    sequence, frames, size = gi.scenes.moving_light(frames=100), range(6), (32, 32)
    path = gi.PathTracing(spp=REFERENCE_SPP // 2)
    truth = np.stack(
        [gi.render(sequence.scene(i), path, size, 99, device).layers["indirect"] for i in frames], dtype=np.float64
    )
    values = []
    for seed in range(3):
        method = gi.InstantRadiosity(paths=paths, renewed_paths=renewed)
        animation = gi.render_animation(sequence, method, size, seed, device, frames=frames)
        values.append(gi.flicker(animation.stack("indirect"), truth) / truth.mean())
    return mean_value(values)


ROWS = (
    *(
        Failure(
            "instant-radiosity",
            "moving-light",
            f"flicker over the mean, {paths} paths, {'fresh' if renewed is None else f'{renewed} renewed'}",
            bound,
            partial(flicker, paths, renewed),
        )
        for paths, renewed, bound in ((16, None, None), (64, None, None), (256, None, None), (64, 2, 0.12))
    ),
    *(
        Failure(
            "instant-radiosity",
            "cornell-box",
            f"brightest pixel over the truth, {PATHS} paths, {near.value}",
            bound,
            partial(spikes, near),
        )
        for near, bound in (
            (gi.NearLight.UNBOUNDED, None),
            (gi.NearLight.CLAMPED, 8.0),
            (gi.NearLight.COMPENSATED, 8.0),
            (gi.NearLight.SPHERICAL, 8.0),
        )
    ),
    *(
        Failure("instant-radiosity", "furnace", f"light missing along edges, {near.value}", bound, partial(edges, near))
        for near, bound in (
            (gi.NearLight.CLAMPED, None),
            (gi.NearLight.COMPENSATED, 0.04),
            (gi.NearLight.SPHERICAL, None),
        )
    ),
)
