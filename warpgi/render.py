"""Rendering: the loop over passes and bands that every method shares."""

from __future__ import annotations

import dataclasses
import platform
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import warpgi
from warpgi import checks
from warpgi.checkpoint import SAVE_SECONDS, Checkpoint
from warpgi.device import Device, as_device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.job import Job
from warpgi.methods import METHODS, SEQUENCE_METHODS, Method, PathTracing
from warpgi.metrics import count_fireflies
from warpgi.passes import PASS_SECONDS, Passes
from warpgi.progress import Progress, progress_bar
from warpgi.result import PARTS, Render
from warpgi.scene import Scene
from warpgi.timing import Timings

# Where bands travel to and from the device they must be worth the way.
BAND_SECONDS = 4.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a render; `render` holds what was finished, or None, and `passes` says how much that is."""

    def __init__(self, render: Render | None, passes: Passes) -> None:
        super().__init__("render interrupted")
        self.render = render
        self.passes = passes


class Ends(NamedTuple):
    """What ends a render before its time, as `render` takes it."""

    seconds: float | None = None
    error: float | None = None
    checkpoint: str | Path | None = None


def render(
    scene: Scene,
    method: Method | None = None,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
    seconds: float | None = None,
    error: float | None = None,
    checkpoint: str | Path | None = None,
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
        seconds: time after which the picture is taken as it is, above 0; looked at between passes.
        error: relMSE below which the picture is good enough, above 0, as far as noise goes: estimated from the samples'
            variance, which with several samples to a photon map is too small.
        checkpoint: file in which the unfinished picture is kept, and from which it goes on if it is there; the result
            equals that of one run bit for bit, and `spp` may have been raised.

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
    check_method(scene, method)
    size = checks.image_size(size)
    seed = checks.count("seed", seed, 0)
    _check_end(method, seconds, error, checkpoint)
    where = as_device(device)
    if method.needs_light and not scene.has_light():
        warnings.warn("the scene has no light: the picture is black", stacklevel=2)

    ends = Ends(seconds, error, checkpoint)
    return render_scene(scene, method, size, seed, where, progress, ends)[0]


def render_scene(
    scene: Scene,
    method: Method,
    size: tuple[int, int],
    seed: int,
    where: Device,
    progress: bool | Callable[[Progress], None] = False,
    ends: Ends | None = None,
    before: DeviceScene | None = None,
    prepare: Callable[[Job, Film], Any] | None = None,
) -> tuple[Render, DeviceScene, Any]:
    """`render` with its arguments checked, and what one frame of a sequence can leave to the next.

    Args:
        scene, method, size, seed, where, progress, ends: as in `render`.
        before: arrays of the frame before on this device, to share.
        prepare: what makes the method's state; its own `prepare` by default.

    Returns:
        The picture, the scene's arrays on the device, and the method's state.
    """
    seconds, error, checkpoint = ends or Ends()
    timings = Timings()
    with timings.stage("compile"):
        where.load(method.kernels)
    with timings.stage("upload"):
        on_device = DeviceScene(scene, where, before)
        film = Film(size, where, where.memory_limit - on_device.nbytes - method.device_bytes(size))
        job = Job(on_device, on_device.camera(size), size, seed, where)
    passes = Passes(*method.passes())
    kept = None
    if checkpoint is not None:
        kept = Checkpoint(Path(checkpoint), method, job)
        kept.restore(film)
        passes.done = kept.done
    interrupted = False

    def counts_so_far() -> dict[str, int]:
        counts = method.counts(state)
        before = kept.counts if kept else {}
        return film.counts() | {name: count + before.get(name, 0) for name, count in counts.items()}

    saved = time.perf_counter()

    def between(elapsed: float) -> bool:
        nonlocal saved
        if kept is not None and time.perf_counter() - saved >= SAVE_SECONDS:
            kept.save(film, passes.done, counts_so_far())
            saved = time.perf_counter()
        if seconds is not None and elapsed >= seconds:
            return True
        return error is not None and film.relative_variance() <= error

    state: Any = None
    try:
        with timings.stage("prepare"):
            state = (prepare or method.prepare)(job, film)
            where.synchronize()
        with timings.stage("estimate"), progress_bar(progress) as report:
            passes.run(
                lambda first, count: method.estimate(job, state, film, first, count),
                where,
                report,
                counts_so_far,
                PASS_SECONDS if len(film.bands) == 1 else BAND_SECONDS,
                between,
            )
    except KeyboardInterrupt:
        if passes.done == 0 or state is None:
            raise Interrupted(None, passes) from None
        interrupted = True
    with timings.stage("image"):
        if kept is not None:
            kept.save(film, passes.done, counts_so_far())
        special = method.finish(job, state, film)
        layers = film.layers(on_device.centre) | special
        if "image" in special:
            layers = {name: layer for name, layer in layers.items() if name not in (*PARTS, "variance")}
        counts = counts_so_far() | {"degenerate_triangles": scene.degenerate_count}
        if "indirect" in layers:
            counts["fireflies"] = count_fireflies(layers["indirect"], layers["variance"])
        result = Render(
            layers=layers,
            timings=dict(timings),
            counts=counts,
            spp=min(film.spp(), method.spp),
            scene=scene.name,
            **provenance(method, seed, where),
        )
    result.timings["image"] = timings["image"]
    if interrupted:
        raise Interrupted(result, passes)
    return result, on_device, state


def provenance(method: Any, seed: int, device: Device) -> dict[str, Any]:
    """Fields of a `Render` that say what made it."""
    return {
        "method": next(name for name, kind in (METHODS | SEQUENCE_METHODS).items() if isinstance(method, kind)),
        "settings": dataclasses.asdict(method),
        "seed": seed,
        "device": device.name,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what a picture depends on."""
    return {
        "warpgi": warpgi.__version__,
        "warp": wp.config.version,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def _check_end(method: Method, seconds: float | None, error: float | None, checkpoint: str | Path | None) -> None:
    if seconds is not None:
        checks.number("seconds", seconds, 0.0, open_lower=True)
    if error is not None:
        checks.number("error", error, 0.0, open_lower=True)
    if checkpoint is not None and not isinstance(checkpoint, (str, Path)):
        raise TypeError(f"checkpoint is {type(checkpoint).__name__}, expected a path")
    for name, value in (("error", error), ("checkpoint", checkpoint)):
        if value is not None and not getattr(method, "keeps_all_in_film", False):
            raise ValueError(f"{name} is given, expected None: {type(method).__name__} keeps more than its film")


def check_method(scene: Scene, method: Any) -> None:
    """Refuses what is no scene or no method, and a scene that the method cannot render.

    Raises:
        TypeError, ValueError: it is such.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is {type(scene).__name__}, expected Scene")
    if isinstance(method, tuple(SEQUENCE_METHODS.values())):
        raise TypeError(f"method is {type(method).__name__}, which is for a Sequence in render_animation")
    if not isinstance(method, tuple(METHODS.values())):
        names = ", ".join(kind.__name__ for kind in METHODS.values())
        raise TypeError(f"method is {type(method).__name__}, expected the settings of one: {names}")
    if scene.moves and not getattr(method, "takes_motion", False):
        able = [kind.__name__ for kind in METHODS.values() if getattr(kind, "takes_motion", False) is True]
        want = ", ".join([*able, "LightField(primary_rays=True)"])
        raise ValueError(f"the scene moves, which {type(method).__name__} cannot render, expected one of {want}")
