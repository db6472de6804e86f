"""`render_animation`: frame after frame of a sequence, kept in files, so that a run that was stopped goes on."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warpgi
from warpgi import checks
from warpgi.animation import Animation
from warpgi.device import Device, as_device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.filter_animation import filter_frames
from warpgi.fingerprint import fingerprint
from warpgi.frame_files import FrameFiles
from warpgi.job import Job
from warpgi.methods import Method, PathTracing, PointFilter, StatisticalFilter
from warpgi.point_animation import render_points
from warpgi.progress import Progress, progress_bar
from warpgi.render import check_method, render_scene
from warpgi.resampling import trace_pixels
from warpgi.result import Render
from warpgi.scene import Scene
from warpgi.seeds import frame_seed
from warpgi.sequence import Sequence

FORMAT = 1


def render_animation(
    sequence: Sequence,
    method: Method | StatisticalFilter | PointFilter | None = None,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    frames: Iterable[int] | None = None,
    vary_seed: bool = True,
) -> Animation:
    """Renders a sequence, frame after frame.

    A frame's file depends on its scene, the method, the size and the seed alone, to the last bit: no times are kept in
    it. So a run that was killed, and resumed, leaves the same files as one that was not.

    Args:
        sequence: what to render.
        method: how, as in `render`; path tracing by default. One with `prepare_next` carries state from frame to frame.
            `StatisticalFilter` renders noisy frames, which it keeps in a folder "noisy" beside `out`, and filters them;
            `PointFilter` does the like with light at points of surfaces, for cameras and objects that move.
        size: (width, height) in pixels.
        seed: which random numbers, 0 to 2^31 - 1.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        progress: True shows a bar on standard error; a function gets a `Progress` after every frame.
        out: the frames' files, such as "folder/frame-{:04d}.exr"; the folder is made. None keeps frames in memory.
        resume: keep files that are whole and of this very frame; others are rendered again.
        frames: which frames; all by default.
        vary_seed: each frame has random numbers of its own, made of (seed, frame), so that noise differs from frame to
            frame; False gives all frames the same, so that the frames of a still sequence are equal to the last bit.

    Returns:
        The frames, with times and counts of what was rendered.

    Raises:
        TypeError, ValueError: an argument is wrong, or a frame's scene is; frames before it stay.
        OSError: a file cannot be written.
        KeyboardInterrupt: Ctrl-C; files of finished frames stay.

    Example:
        >>> import warpgi as gi
        >>> sequence = gi.scenes.moving_light(frames=2)
        >>> len(gi.render_animation(sequence, gi.PathTracing(spp=1), size=(8, 8)))
        2
    """
    if not isinstance(sequence, Sequence):
        raise TypeError(f"sequence is {type(sequence).__name__}, expected Sequence")
    method = PathTracing() if method is None else method
    size = checks.image_size(size)
    seed = checks.count("seed", seed, 0)
    numbers = checked_frames(sequence, frames)
    filtered = method if isinstance(method, StatisticalFilter) else None
    estimator: Any = method if filtered is None else filtered.noisy
    on_points = method if isinstance(method, PointFilter) else None
    if (filtered is not None or on_points is not None) and not vary_seed:
        raise ValueError(f"vary_seed is False, expected True: {type(method).__name__} would take equal noise for light")
    if on_points is None:
        check_method(sequence.scene(numbers[0]), estimator)
    if resume and out is None:
        raise ValueError("resume is True, expected False where out is None: there are no files to go on from")
    if on_points is not None:
        return render_points(sequence, on_points, size, seed, as_device(device), progress, out, resume, numbers)
    pattern = None if out is None else noisy_pattern(out) if filtered else out
    files = None if pattern is None else FrameFiles(pattern)
    renderer = FrameRenderer(sequence, estimator, size, seed, as_device(device), vary_seed)
    with progress_bar(progress) as report:
        animation = _render_frames(renderer, numbers, files, resume, report)
    if filtered is None:
        return animation
    result = filter_frames(animation, filtered, renderer.device, progress, out, resume, renderer.resample(filtered))
    result.timings = dict(Counter(animation.timings) + Counter(result.timings))
    return result


def _render_frames(
    renderer: FrameRenderer,
    numbers: tuple[int, ...],
    files: FrameFiles | None,
    resume: bool,
    report: Callable[[Progress], None] | None,
) -> Animation:
    sources: list[Render | Path] = []
    rendered: list[int] = []
    timings: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    started = time.perf_counter()
    for done, number in enumerate(numbers, 1):
        frame = renderer.open(number)
        picture = files.find(number, frame.identity) if files and resume else None
        if picture is None:
            picture = renderer.render(frame)
            rendered.append(number)
            timings.update(picture.timings)
            if files:
                files.save(number, frame.identity, picture)
        counts.update(picture.counts)
        sources.append(picture if files is None else files.path(number))
        if report is not None:
            report(Progress(done, len(numbers), "frames", time.perf_counter() - started, dict(counts)))
    return Animation(sources, numbers, renderer.sequence.fps, dict(timings), dict(counts), tuple(rendered))


def noisy_pattern(out: str | os.PathLike[str]) -> Path:
    """Where the noisy frames of filtered ones are kept: a folder beside them."""
    if not isinstance(out, (str, os.PathLike)):
        raise TypeError(f"out is {type(out).__name__}, expected a path such as folder/frame-{{:04d}}.exr")
    path = Path(out)
    return path.with_name("noisy") / path.name


def checked_frames(sequence: Sequence, frames: Iterable[int] | None) -> tuple[int, ...]:
    """The numbers of the frames to render.

    Raises:
        TypeError, ValueError: a number is none of the sequence's frames, comes after a larger one, or there is none.
    """
    if frames is None:
        return tuple(range(sequence.frames))
    numbers = tuple(checks.count("frames", number, 0, sequence.frames - 1) for number in frames)
    if not numbers or list(numbers) != sorted(set(numbers)):
        raise ValueError(f"frames is {list(numbers)}, expected ascending numbers, at least one")
    return numbers


@dataclass(frozen=True)
class Frame:
    """One frame, ready to render."""

    number: int
    scene: Scene
    seed: int
    identity: str
    """Digest of all that its picture depends on."""


class FrameRenderer:
    """Renders frames in ascending order; triangles that do not move and a method's state go from one to the next."""

    def __init__(
        self,
        sequence: Sequence,
        method: Method,
        size: tuple[int, int],
        seed: int,
        device: Device,
        vary_seed: bool,
    ) -> None:
        self.sequence, self.method, self.size, self.seed = sequence, method, size, seed
        self.device, self.vary_seed = device, vary_seed
        self.carries = hasattr(method, "prepare_next")
        self._before: DeviceScene | None = None
        self._state: Any = None
        self._next = 0  # the frame that `_state` is ready for
        self._history = ""

    def open(self, number: int) -> Frame:
        """A frame's scene, seed and identity; of a method that carries state, also of the frames before it."""
        if self.carries:
            for earlier in range(self._next, number):
                self._prepare(self._make(earlier))
        return self._make(number)

    def render(self, frame: Frame) -> Render:
        """A frame's picture."""
        check_method(frame.scene, self.method)
        prepare = partial(self.method.prepare_next, before=self._state) if self.carries else None  # type: ignore[attr-defined]
        picture, self._before, state = render_scene(
            frame.scene,
            self.method,
            self.size,
            frame.seed,
            self.device,
            before=self._before,
            prepare=prepare,
        )
        if self.carries:
            self._state, self._next, self._history = state, frame.number + 1, frame.identity
        return picture

    def resample(self, method: StatisticalFilter) -> Callable[[int, np.ndarray], np.ndarray] | None:
        """What samples pixels of a frame anew for importance sampling; None: nothing does."""
        if not method.high_spp:
            return None
        paths = PathTracing(spp=method.high_spp)

        def resample(number: int, pixels: np.ndarray) -> np.ndarray:
            # other random numbers than the noisy frame's
            seed = frame_seed(frame_seed(self.seed, number), number)
            return trace_pixels(self.sequence.scene(number), pixels, paths, self.size, seed, self.device)

        return resample

    def _make(self, number: int) -> Frame:
        scene = self.sequence.scene(number)
        seed = frame_seed(self.seed, number) if self.vary_seed else self.seed
        settings = (FORMAT, warpgi.__version__, type(self.method).__name__, self.method, self.size, seed)
        return Frame(number, scene, seed, fingerprint(settings, scene, self._history))

    def _prepare(self, frame: Frame) -> None:
        """Brings the method's state past a frame whose picture is not needed."""
        self.device.load(self.method.kernels)
        on_device = DeviceScene(frame.scene, self.device, self._before)
        room = self.device.memory_limit - on_device.nbytes - self.method.device_bytes(self.size)
        job = Job(on_device, on_device.camera(self.size), self.size, frame.seed, self.device)
        film = Film(self.size, self.device, room)
        self._state = self.method.prepare_next(job, film, before=self._state)  # type: ignore[attr-defined]
        self._before, self._next, self._history = on_device, frame.number + 1, frame.identity
