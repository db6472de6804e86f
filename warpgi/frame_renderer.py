"""A sequence's frames one by one: their scenes, seeds and identities, and what goes from one to the next."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import warpgi
from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.fingerprint import fingerprint
from warpgi.job import Job
from warpgi.methods import Method, PathTracing, StatisticalFilter
from warpgi.render import check_method, render_scene
from warpgi.resampling import trace_pixels
from warpgi.result import Render
from warpgi.scene import Scene
from warpgi.sequence import Sequence

FORMAT = 1


def frame_seed(seed: int, frame: int) -> int:
    """The seed of one frame, 0 to 2^31 - 1: a hash, so that neighbouring frames and seeds share nothing."""
    return int.from_bytes(hashlib.sha256(f"{seed} {frame}".encode()).digest()[:4], "little") >> 1


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

    @property
    def next(self) -> int:
        """The lowest frame that it can still open; any where nothing is carried."""
        return self._next

    def identities(self, numbers: Iterable[int]) -> Iterator[tuple[int, str]]:
        """Numbers and identities of frames, in ascending order, without any of the device's work."""
        wanted, history = set(numbers), ""
        for number in range(max(wanted) + 1):
            if self.carries or number in wanted:
                identity = self._make(number, history).identity
                history = identity if self.carries else ""
                if number in wanted:
                    yield number, identity

    def open(self, number: int) -> Frame:
        """A frame's scene, seed and identity; of a method that carries state, also of the frames before it."""
        if self.carries:
            for earlier in range(self._next, number):
                self._prepare(self._make(earlier, self._history))
        return self._make(number, self._history)

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

    def _make(self, number: int, history: str) -> Frame:
        scene = self.sequence.scene(number)
        seed = frame_seed(self.seed, number) if self.vary_seed else self.seed
        settings = (FORMAT, warpgi.__version__, type(self.method).__name__, self.method, self.size, seed)
        return Frame(number, scene, seed, fingerprint(settings, scene, history))

    def _prepare(self, frame: Frame) -> None:
        """Brings the method's state past a frame whose picture is not needed."""
        self.device.load(self.method.kernels)
        on_device = DeviceScene(frame.scene, self.device, self._before)
        room = self.device.memory_limit - on_device.nbytes - self.method.device_bytes(self.size)
        job = Job(on_device, on_device.camera(self.size), self.size, frame.seed, self.device)
        film = Film(self.size, self.device, room)
        self._state = self.method.prepare_next(job, film, before=self._state)  # type: ignore[attr-defined]
        self._before, self._next, self._history = on_device, frame.number + 1, frame.identity
