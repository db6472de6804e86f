"""Virtual point lights: pairs of a pixel and a light per second, with shadow rays and with none."""

from __future__ import annotations

import numpy as np

import warpgi as gi
from bench.report import Row, paired_ratio, row
from bench.turns import take_turns
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.job import Job
from warpgi.methods.instant_radiosity import Lighting

SEED = 1
PATHS = 64
# Pixels along a side: more would measure no better.
MOST_PIXELS = 128


class VplBench:
    """A picture of one sample per pixel, lit by one set of lights.

    Args:
        on_device: the scene.
        size: of the picture at most.
    """

    def __init__(self, on_device: DeviceScene, size: tuple[int, int]) -> None:
        self.device = on_device.device
        size = (min(size[0], MOST_PIXELS), min(size[1], MOST_PIXELS))
        self.method = gi.InstantRadiosity(paths=PATHS, spp=1, near_light=gi.NearLight.CLAMPED, light_samples=1)
        self.job = Job(on_device, on_device.camera(size), size, SEED, self.device)
        self.film = Film(size, self.device, self.device.memory_limit - on_device.nbytes)
        self.lighting: Lighting = self.method.prepare(self.job, self.film)
        self.count = size[0] * size[1] * self.lighting.counts["vpls"]

    def light(self, map_side: int) -> None:
        """Camera rays, direct light, and all lights at every pixel; with `map_side` -1 through walls."""
        self.lighting.vpls.map_side = map_side
        self.method.estimate(self.job, self.lighting, self.film, 0, 1)


def vpl_rows(scene: str, on_device: DeviceScene, size: tuple[int, int], repeats: int) -> list[Row]:
    """Rates with and without visibility; none where light reaches no surface."""
    bench = VplBench(on_device, size)
    if bench.count == 0:
        return []
    shadowed, seen = "VPL connections", "VPL connections, all seen"
    jobs = {shadowed: lambda: bench.light(0), seen: lambda: bench.light(-1)}
    seconds = take_turns(jobs, repeats, bench.device)
    rates = {name: bench.count / np.array(values) for name, values in seconds.items()}
    note = f"{bench.lighting.counts['vpls']} lights of {PATHS} paths, camera rays and direct light included"
    ratio = paired_ratio(rates[shadowed], rates[seen])
    return [
        row(scene, shadowed, rates[shadowed], "connections/s", ratio=ratio, versus=seen, note=note),
        row(scene, seen, rates[seen], "connections/s", note="no shadow rays to lights"),
    ]
