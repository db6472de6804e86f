"""Rendering: the loop over passes and bands that every method shares."""

from __future__ import annotations

import dataclasses
import platform
import time
import warnings
from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

import warpgi
from warpgi import checks
from warpgi.device import Device, as_device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.job import Job
from warpgi.methods import METHODS, PathTracing
from warpgi.progress import Progress, progress_bar
from warpgi.result import Render
from warpgi.scene import Scene
from warpgi.timing import Timings

# A pass is as many samples as take about this long: short enough for a live bar and a prompt Ctrl-C.
PASS_SECONDS = 0.4
# Where bands travel to and from the device they must be worth the way.
BAND_SECONDS = 4.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a render; `render` holds what was finished, or None."""

    def __init__(self, render: Render | None) -> None:
        super().__init__("render interrupted")
        self.render = render


def render(
    scene: Scene,
    method: PathTracing | None = None,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
) -> Render:
    """Renders a scene.

    The same scene, method, size and seed give the same picture for any number of threads and any memory limit.

    Args:
        scene: what to render.
        method: how; its settings say what more samples cost. Path tracing by default.
        size: (width, height) in pixels.
        seed: which random numbers, 0 to 2^31 - 1.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        progress: True shows a bar on standard error; a function gets a `Progress` after every pass.

    Returns:
        The layers, timings by stage and counts.

    Raises:
        TypeError, ValueError: an argument is wrong; nothing has been computed then.
        Interrupted: Ctrl-C; a KeyboardInterrupt that carries the picture so far.

    Example:
        >>> import warpgi as gi
        >>> picture = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=1), size=(8, 8))
        >>> picture.image.shape
        (8, 8, 3)
    """
    method = PathTracing() if method is None else method
    _check(scene, method, size)
    seed = checks.count("seed", seed, 0)
    where = as_device(device)
    if not scene.has_light():
        warnings.warn("the scene has no light: the picture is black", stacklevel=2)

    timings = Timings()
    with timings.stage("compile"):
        where.load(method.kernels)
    with timings.stage("upload"):
        on_device = DeviceScene(scene, where)
        film = Film(size, where, where.memory_limit - on_device.nbytes)
        job = Job(on_device, on_device.camera(size), size, seed, where)
    interrupted = False
    try:
        with timings.stage("prepare"):
            state = method.prepare(job)
            where.synchronize()
        with timings.stage("estimate"), progress_bar(progress) as report:
            _estimate(method, job, state, film, report)
    except KeyboardInterrupt:
        interrupted = True
    spp = film.spp()
    if interrupted and spp == 0:
        raise Interrupted(None)
    with timings.stage("image"):
        result = Render(
            layers=film.layers(on_device.centre),
            timings=dict(timings),
            counts={**film.counts(), "degenerate_triangles": scene.degenerate_count},
            method=next(name for name, kind in METHODS.items() if isinstance(method, kind)),
            settings=_plain(dataclasses.asdict(method)),
            seed=seed,
            spp=spp,
            scene=scene.name,
            device=where.name,
            versions=versions(),
        )
    result.timings["image"] = timings["image"]
    if interrupted:
        raise Interrupted(result)
    return result


def versions() -> dict[str, str]:
    """Versions of what a picture depends on."""
    return {
        "warpgi": warpgi.__version__,
        "warp": wp.config.version,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def _estimate(method: PathTracing, job: Job, state: Any, film: Film, report: Callable[[Progress], None] | None) -> None:
    """All samples of all bands, in passes whose length follows the clock; the picture does not depend on them."""
    done, samples = 0, 1
    target = PASS_SECONDS if len(film.bands) == 1 else BAND_SECONDS
    started = time.perf_counter()
    while done < method.spp:
        samples = min(samples, method.spp - done)
        pass_start = time.perf_counter()
        for band in film.bands:
            method.estimate(job, state, film.load(band), done, samples)
        job.device.synchronize()
        done += samples
        seconds = time.perf_counter() - pass_start
        if report is not None:
            report(Progress(done, method.spp, time.perf_counter() - started, film.counts()))
        samples = max(1, min(4 * samples, int(samples * target / max(seconds, 1e-6))))


def _check(scene: Scene, method: PathTracing, size: tuple[int, int]) -> None:
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is {type(scene).__name__}, expected Scene")
    if not isinstance(method, tuple(METHODS.values())):
        names = ", ".join(kind.__name__ for kind in METHODS.values())
        raise TypeError(f"method is {type(method).__name__}, expected the settings of one: {names}")
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"size is {size!r}, expected (width, height)")
    for name, value in zip(("width", "height"), size, strict=True):
        checks.count(name, value)
    if size[0] * size[1] >= 2**31:
        raise ValueError(f"size is {size[0]} x {size[1]}, expected fewer than 2^31 pixels")


def _plain(value: Any) -> Any:
    """Settings as JSON knows them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value.value if isinstance(value, Enum) else value
