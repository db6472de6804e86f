"""A rendered sequence: pictures in memory or in files, one a frame."""

from __future__ import annotations

import os
from collections.abc import Iterator
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from warpgi.frame_files import frame_path
from warpgi.image import PathLike, atomic_write, to_srgb8
from warpgi.modes import Modes
from warpgi.result import Render

# White pixels between animations side by side.
GAP = 4


@dataclass(eq=False)
class Animation:
    """The frames of a rendered sequence; those in files are read when they are asked for, one at a time.

    Raises:
        ValueError: there is not one source a frame.

    Example:
        >>> import warpgi as gi
        >>> animation = gi.render_animation(gi.scenes.moving_light(frames=2), gi.PathTracing(spp=1), size=(8, 8))
        >>> len(animation), animation[1].image.shape
        (2, (8, 8, 3))
    """

    sources: Series[Render | Path]
    """Each frame's picture, or its file."""
    frames: Series[int]
    """Each frame's number in the sequence."""
    fps: float = 24.0
    """Frames per second."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by stage, of the frames that were rendered and not found."""
    counts: dict[str, int] = field(default_factory=dict)
    """Sums of the frames' counts."""
    rendered: tuple[int, ...] = ()
    """Numbers of the frames that were rendered and not found."""
    modes: Modes | None = None
    """Basis functions of the sequence, where it was filtered by these."""

    def __post_init__(self) -> None:
        if len(self.sources) != len(self.frames) or not self.sources:
            raise ValueError(f"sources holds {len(self.sources)} of {len(self.frames)} frames, expected each of them")

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: int) -> Render:
        source = self.sources[index]
        return source if isinstance(source, Render) else Render.load(source)

    def __iter__(self) -> Iterator[Render]:
        return (self[index] for index in range(len(self)))

    @classmethod
    def load(cls, pattern: PathLike, fps: float = 24.0) -> Animation:
        """The frames in files, of this or another renderer, from the first number on up to the first that is not there.

        Args:
            pattern: their path with a place for the number, such as "folder/frame-{:04d}.exr"; the first is 0 or 1.
            fps: frames per second.

        Raises:
            TypeError, ValueError: it is no such pattern.
            FileNotFoundError: there is no frame 0 and no frame 1.
        """
        path = frame_path(pattern)
        first = next((number for number in (0, 1) if path(number).exists()), None)
        if first is None:
            raise FileNotFoundError(f"{path(0)} does not exist, expected the first frame")
        last = first
        while path(last).exists():
            last += 1
        return cls([path(number) for number in range(first, last)], tuple(range(first, last)), fps)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files of the frames, where there are any."""
        return tuple(source for source in self.sources if isinstance(source, Path))

    def stack(self, layer: str = "image") -> np.ndarray:
        """One layer of all frames, shape (N, H, W, C), float32: all of it in memory.

        Raises:
            ValueError: a frame has no such layer.
        """
        return np.stack([frame_layer(frame, layer) for frame in self])


def write_preview(path: PathLike, *animations: Animation, layer: str = "image", exposure: float = 0.0) -> None:
    """Writes animations side by side, such as noisy, filtered and reference, as one animated PNG (APNG, by Pillow).

    One frame of each is in memory at a time, and all of the 8-bit pictures.

    Args:
        path: the file to write; its suffix is .png or .apng.
        animations: of equally many frames of one size.
        layer: which layer to show.
        exposure: stops, in [-64, 64]; 1 doubles the light.

    Raises:
        ValueError: the suffix is another one, or animations differ in length or size, or lack the layer.
        OSError: the file cannot be written.

    Example:
        >>> import warpgi as gi
        >>> noisy = gi.render_animation(gi.scenes.moving_light(frames=2), gi.PathTracing(spp=1), size=(8, 8))
        >>> gi.write_preview("preview.jpg", noisy)
        Traceback (most recent call last):
        ValueError: preview is preview.jpg, expected a name that ends in .png or .apng
    """
    if Path(path).suffix.lower() not in (".png", ".apng"):
        raise ValueError(f"preview is {os.fspath(path)}, expected a name that ends in .png or .apng")
    if not animations or len({len(animation) for animation in animations}) > 1:
        lengths = ", ".join(str(len(animation)) for animation in animations) or "none"
        raise ValueError(f"animations have {lengths} frames, expected equally many")
    pictures = []
    for frames in zip(*animations, strict=True):
        parts = [to_srgb8(frame_layer(frame, layer), exposure)[0] for frame in frames]
        if len({part.shape for part in parts}) > 1:
            raise ValueError(f"animations have frames of {' and '.join(str(part.shape[:2]) for part in parts)} pixels")
        gap = np.full((parts[0].shape[0], GAP, 3), 255, np.uint8)
        row = [each for part in parts for each in (part, gap)][:-1]
        pictures.append(Image.fromarray(np.concatenate(row, axis=1)))
    duration = 1000.0 / animations[0].fps
    with atomic_write(path) as temporary:
        pictures[0].save(temporary, format="PNG", save_all=True, append_images=pictures[1:], duration=duration, loop=0)


def frame_layer(frame: Render, name: str) -> np.ndarray:
    """One layer of a picture, shape (H, W, C); "image" is always there.

    Raises:
        ValueError: there is none.
    """
    if name == "image":
        return frame.image
    if name not in frame.layers:
        raise ValueError(f"layer is {name!r}, expected one of image, {', '.join(frame.layers)}")
    return frame.layers[name]
