"""`render_animation`: frame after frame of a sequence, kept in files, so that a run that was stopped goes on."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpgi import checks
from warpgi.animation import Animation
from warpgi.cluster import open_cluster
from warpgi.cluster_frames import cluster_frames
from warpgi.device import Device, as_device
from warpgi.filter_animation import filter_frames
from warpgi.frame_files import FrameFiles
from warpgi.frame_renderer import FrameRenderer
from warpgi.methods import Method, PathTracing, PointFilter, StatisticalFilter
from warpgi.point_animation import render_points
from warpgi.progress import Progress, progress_bar
from warpgi.render import check_method
from warpgi.result import Render
from warpgi.sequence import Sequence

if TYPE_CHECKING:
    from distributed import Client


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
    cluster: bool | str | Client = False,
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
        cluster: render frames on workers of Dask distributed, to the same last bit (`pip install warpgi[cluster]`):
            True for processes of this machine's that share its cores, the address of a scheduler, or a
            `distributed.Client`. The sequence is pickled with the script's functions in it; those of other modules
            are imported there. Files are written here. A worker that dies leaves its frames to others. Processes import
            the script, so it must ask for them under `if __name__ == "__main__"`.

    Returns:
        The frames, with times and counts of what was rendered.

    Raises:
        TypeError, ValueError: an argument is wrong, or a frame's scene is; frames before it stay.
        ImportError: `cluster` is asked for and Dask distributed is not installed.
        OSError: a file cannot be written, or the cluster cannot be reached or started.
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
        if cluster is not False and cluster is not None:
            raise ValueError("cluster is given, expected False: PointFilter renders on this machine alone")
        return render_points(sequence, on_points, size, seed, as_device(device), progress, out, resume, numbers)
    pattern = None if out is None else noisy_pattern(out) if filtered else out
    files = None if pattern is None else FrameFiles(pattern)
    renderer = FrameRenderer(sequence, estimator, size, seed, as_device(device), vary_seed)
    with open_cluster(cluster, renderer.device) as workers:
        find = files.find if files and resume else _nothing
        frames_made = (
            _frames_here(renderer, numbers, find)
            if workers is None
            else cluster_frames(workers, renderer, numbers, find)
        )
        with closing(frames_made), progress_bar(progress) as report:
            animation = _keep_frames(frames_made, numbers, sequence.fps, files, report)
        if filtered is None:
            return animation
        resample = renderer.resample(filtered)
        result = filter_frames(animation, filtered, renderer.device, progress, out, resume, resample, workers)
    result.timings = dict(Counter(animation.timings) + Counter(result.timings))
    return result


def _nothing(number: int, identity: str) -> None:
    return None


def _frames_here(
    renderer: FrameRenderer, numbers: tuple[int, ...], find: Callable[[int, str], Render | None]
) -> Generator[tuple[int, str, Render, bool]]:
    """Frames in ascending order: number, identity, picture, and whether it was rendered and not found."""
    for number in numbers:
        frame = renderer.open(number)
        picture = find(number, frame.identity)
        yield number, frame.identity, picture or renderer.render(frame), picture is None


def _keep_frames(
    made: Iterable[tuple[int, str, Render, bool]],
    numbers: tuple[int, ...],
    fps: float,
    files: FrameFiles | None,
    report: Callable[[Progress], None] | None,
) -> Animation:
    """Frames as they are made, in any order, to files or into memory."""
    sources: dict[int, Render | Path] = {}
    rendered: list[int] = []
    timings: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    started = time.perf_counter()
    for number, identity, picture, is_new in made:
        if is_new:
            rendered.append(number)
            timings.update(picture.timings)
            if files:
                files.save(number, identity, picture)
        counts.update(picture.counts)
        sources[number] = picture if files is None else files.path(number)
        if report is not None:
            report(Progress(len(sources), len(numbers), "frames", time.perf_counter() - started, dict(counts)))
    in_order = [sources[number] for number in numbers]
    return Animation(in_order, numbers, fps, dict(timings), dict(counts), tuple(sorted(rendered)))


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
