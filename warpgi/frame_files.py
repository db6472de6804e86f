"""The files of an animation: one a frame, each of which says what it is of; and the loop that makes them."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from warpgi.fingerprint import fingerprint
from warpgi.image import PathLike, check_output
from warpgi.progress import Progress, progress_bar
from warpgi.result import Render
from warpgi.timing import Timings


def frame_path(pattern: PathLike) -> Callable[[int], Path]:
    """What gives a frame's path by its number.

    Args:
        pattern: a path with a place for the number, such as "folder/frame-{:04d}.exr".

    Raises:
        TypeError, ValueError: it is no such pattern.
    """
    if not isinstance(pattern, (str, os.PathLike)):
        raise TypeError(f"out is {type(pattern).__name__}, expected a path such as folder/frame-{{:04d}}.exr")
    text = os.fspath(pattern)
    try:
        one, two = (Path(text.format(number)) for number in (0, 1))
    except (IndexError, KeyError, ValueError):
        one = two = Path()
    if one == two or one.suffix.lower() != ".exr" or one.parent != two.parent:
        raise ValueError(f"out is {text}, expected a path such as folder/frame-{{:04d}}.exr")
    return lambda number: Path(text.format(number))


class FrameFiles:
    """The files of an animation's frames.

    Args:
        pattern: their path with a place for the number, such as "folder/frame-{:04d}.exr"; the folder is made.

    Raises:
        TypeError, ValueError: it is no such pattern.
        OSError: the folder takes no file.
    """

    path: Callable[[int], Path]
    """The file of a frame, by its number."""

    def __init__(self, pattern: PathLike) -> None:
        self.path = frame_path(pattern)
        self.path(0).parent.mkdir(parents=True, exist_ok=True)
        check_output(self.path(0))

    def find(self, number: int, identity: str) -> Render | None:
        """The picture of a frame if its file is there, whole, and of this identity."""
        try:
            picture = Render.load(self.path(number))
        except (OSError, ValueError):
            return None
        return picture if picture.identity == identity else None

    def save(self, number: int, identity: str, picture: Render) -> None:
        """Writes a frame's picture, without what differs from run to run."""
        picture.identity = identity
        picture.timings = {}
        picture.save(self.path(number))


def make_frames(
    numbers: Sequence[int],
    identity: str,
    make: Callable[[int], Render],
    files: FrameFiles | None,
    resume: bool,
    timings: Timings,
    counts: Counter[str],
    progress: bool | Callable[[Progress], None],
    uncounted: Collection[str] = (),
) -> tuple[list[Render | Path], list[int]]:
    """Makes pictures of a run that has all frames at hand, and writes them where there are files.

    Args:
        numbers: of the frames.
        identity: digest of all that the pictures depend on, but for the number.
        make: gives the picture of a frame, by its place in `numbers`.
        files: where pictures go; None keeps them.
        resume: take files that are whole and of these frames.
        timings: what writing took is added, as "image".
        counts: those of all pictures are added.
        progress: as `render_animation` takes it.
        uncounted: names of counts that are left out.

    Returns:
        Pictures or their files, and the numbers of those that were made.
    """
    sources: list[Render | Path] = []
    made: list[int] = []
    began = time.perf_counter()
    with progress_bar(progress) as report:
        for index, number in enumerate(numbers):
            own = fingerprint(identity, number)
            picture = files.find(number, own) if files and resume else None
            if picture is None:
                picture = make(index)
                made.append(number)
                if files:
                    with timings.stage("image"):
                        files.save(number, own, picture)
            counts.update({name: count for name, count in picture.counts.items() if name not in uncounted})
            sources.append(picture if files is None else files.path(number))
            if report is not None:
                report(Progress(index + 1, len(numbers), "frames", time.perf_counter() - began, dict(counts)))
    return sources, made
