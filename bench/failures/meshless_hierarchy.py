"""Where the meshless hierarchy fails: thin walls, blotches of few rays, and what lies between its first points."""

from __future__ import annotations

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, mean_value
from bench.reference import make_reference

SIZE = (64, 64)


def leak(device: gi.Device) -> Value:
    """Mean light of the dark room over that of the lit one, 4 columns beside the wall left out."""
    scene, _ = gi.scenes.leak(open_front=True)
    pictures = [indirect(scene, gi.MeshlessHierarchy(spp=4, rays=64), (48, 36), seed, device) for seed in range(1, 5)]
    return mean_value([float(picture[:, 26:].mean() / picture[:, :22].mean()) for picture in pictures])


def blotches(device: gi.Device) -> Value:
    """Relative scatter of even light in blocks of 8 x 8 pixels, of a furnace's walls away from its edges."""
    scene, _ = gi.scenes.furnace(albedo=0.5)
    values = []
    for seed in range(4):
        render = gi.render(scene, gi.MeshlessHierarchy(spp=4, rays=64), (48, 48), seed, device)
        image = render.layers["indirect"].mean(axis=2, dtype=np.float64)
        inner = np.sort(np.abs(render.layers["position"]), axis=2)[..., 1] < 0.8
        blocks = image.reshape(6, 8, 6, 8).mean(axis=(1, 3))[inner.reshape(6, 8, 6, 8).all(axis=(1, 3))]
        values.append(float(blocks.std() / blocks.mean()))
    return mean_value(values)


def _low_frequency_error(picture: np.ndarray, truth: np.ndarray) -> float:
    """RMS error after a box of 9 x 9 pixels, over the mean."""
    difference = np.pad((picture - truth).mean(axis=2).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    box = (difference[9:, 9:] - difference[:-9, 9:] - difference[9:, :-9] + difference[:-9, :-9]) / 81.0
    return float(np.sqrt(np.square(box).mean()) / truth.mean())


def splotches(device: gi.Device) -> Value:
    """Low-frequency error over that of as many rays shared out over all pixels, from the same samples."""
    scene = gi.scenes.cornell_box()
    truth = make_reference(scene, SIZE, 1024, device=device).image.astype(np.float64)
    values = []
    for seed in range(1, 5):
        render = gi.render(scene, gi.MeshlessHierarchy(spp=4, rays=64, tolerance=0.4), SIZE, seed, device)
        rays = max(4, round(render.counts["point_rays"] / (SIZE[0] * SIZE[1])))
        per_pixel = indirect(scene, gi.LightField(spp=4, rays=rays), SIZE, seed, device)
        ours = render.layers["indirect"].astype(np.float64)
        values.append(_low_frequency_error(ours, truth) / _low_frequency_error(per_pixel, truth))
    return mean_value(values)


def foliage(device: gi.Device) -> Value:
    """relMSE of leaves over that of 64 rays at every pixel, from the same samples."""
    scene, size = gi.scenes.courtyard(detail=0.05), (64, 48)
    truth = make_reference(scene, size, 512, device=device)
    methods = gi.MeshlessHierarchy(spp=4, rays=64), gi.LightField(spp=4, rays=64)
    ours, theirs = (
        np.array([truth.judge(indirect(scene, method, size, seed, device))["relmse"] for seed in (1, 2, 3)])
        for method in methods
    )
    return mean_value(list(ours / theirs))


def _row(scene: str, what: str, bound: float | None, measure) -> Failure:
    return Failure("meshless-hierarchy", scene, what, bound, measure)


ROWS = (
    _row("leak, open front", "light in the dark room, of the lit one's, 4 spp", 0.01, leak),
    _row("furnace", "scatter of even light over 8 x 8 pixels, 64 rays", 0.01, blotches),
    _row("cornell-box", "error after a 9 x 9 box over that of the same rays at all pixels", 1.5, splotches),
    _row("courtyard", "relMSE over that of 64 rays at every pixel, 4 spp", None, foliage),
)
