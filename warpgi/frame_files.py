"""The files of an animation: one a frame, each of which says what it is of."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from warpgi.image import PathLike, check_output
from warpgi.result import Render


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
