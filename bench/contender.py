"""One line of the chart: what it is to the rest of the bench."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import warpgi as gi

Settings = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Run:
    """One picture and what it cost."""

    indirect: np.ndarray
    """Indirect radiance, shape (H, W, 3), float32."""
    seconds: float
    """From the loaded scene to pixels on the host, everything compiled."""
    compile_seconds: float = 0.0
    """Beside `seconds`."""
    timings: dict[str, float] = field(default_factory=dict)
    """Parts of `seconds`, by stage."""
    counts: dict[str, int] = field(default_factory=dict)
    """Rays by kind, and what went wrong."""


@dataclass(frozen=True)
class Place:
    """What a contender has to render, and where."""

    scene: gi.Scene
    size: tuple[int, int]
    """(width, height) in pixels."""
    max_depth: int | None
    """Longest path in segments, None: unlimited; light that a contender leaves out beyond that is its error."""
    device: gi.Device


@dataclass(frozen=True)
class Contender:
    """One line of the chart."""

    name: str
    ladder: tuple[Settings, ...]
    """Values of its quality knob, cheapest first; plain JSON."""
    load: Callable[[Place], Callable[[Settings, int], Run]]
    """Takes what need not be timed, such as the scene's upload, and returns (settings, seed) -> Run; a ValueError says
    that it cannot render the scene."""
    version: str = ""
    """Finished runs are taken up again only where this is the same."""

    @property
    def knob(self) -> str:
        """Names of the settings on the ladder."""
        return " x ".join(dict.fromkeys(name for settings in self.ladder for name in settings))

    def quick(self, most: int = 5) -> tuple[Settings, ...]:
        """At most so many of the ladder, evenly and with its first."""
        return self.ladder[:: -(-len(self.ladder) // most)]


def own_run(render: gi.Render, indirect: np.ndarray, compile_seconds: float = 0.0, **stages: float) -> Run:
    """A run out of a render of the library, with the picture made of it and what was spent before and after."""
    # a scene is uploaded once for many pictures
    timings = {name: s for name, s in render.timings.items() if name not in ("compile", "upload")} | stages
    compile_seconds += render.timings["compile"]
    return Run(indirect, sum(timings.values()), compile_seconds, timings, render.counts)


def powers(last: int, factor: int = 2) -> tuple[Settings, ...]:
    """Samples per pixel from 1 to `last`."""
    return tuple({"spp": factor**i} for i in range(64) if factor**i <= last)


def label(settings: Settings) -> str:
    """Settings in a few words, such as "spp 8, rays 256"."""
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in settings.items())
