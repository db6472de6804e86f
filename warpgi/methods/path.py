"""Path tracing: the unbiased reference that every other method is judged against."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels import rng
from warpgi.kernels.path import PathSettings, trace_paths


class Sampler(Enum):
    """Where random numbers come from."""

    SOBOL = "sobol"
    """Owen-scrambled Sobol pairs (Burley 2020): stratified over a pixel's samples, less noise at the same count."""
    INDEPENDENT = "independent"
    """Independent numbers: the `variance` layer is then unbiased, with SOBOL it is too large."""


NEVER = 2**31 - 1


def check_paths(max_depth: int | None, roulette_depth: int | None, sampler: Sampler) -> None:
    """Refuses settings of paths that are out of range, and paths that would never end.

    Raises:
        TypeError, ValueError: they are such.
    """
    if max_depth is not None:
        checks.count("max_depth", max_depth)
    if roulette_depth is not None:
        checks.count("roulette_depth", roulette_depth)
    if max_depth is None and roulette_depth is None:
        raise ValueError("max_depth and roulette_depth are both None, expected one of them, or paths never end")
    if not isinstance(sampler, Sampler):
        raise TypeError(f"sampler is {sampler!r}, expected a Sampler")


@dataclass(frozen=True, kw_only=True)
class PathTracing:
    """Path tracing (Kajiya 1986) with multiple importance sampling (Veach 1997); unbiased at any setting of roulette.

    Light that only a chain of perfect mirrors or glass could bring from a point or distant light is not found.

    Raises:
        TypeError, ValueError: a setting is out of range, or paths would never end.
    """

    spp: int = 64
    """Paths per pixel; the error falls with its square root, the time grows with it."""
    max_depth: int | None = None
    """Longest path in segments: 1 sees emitters only, 2 adds direct light; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end a path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where random numbers come from."""

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        check_paths(self.max_depth, self.roulette_depth, self.sampler)

    takes_motion: ClassVar[bool] = True

    @property
    def keeps_all_in_film(self) -> bool:
        """Whether the film is all that a later pass needs of earlier ones."""
        return True

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_paths,)

    def passes(self) -> tuple[int, str]:
        """Samples per pixel, the unit of its passes."""
        return self.spp, "spp"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        return 0

    def prepare(self, job: Job, film: Film) -> PathSettings:
        """The kernel's settings: path tracing builds nothing for a scene."""
        settings = PathSettings()
        settings.max_depth = self.max_depth or NEVER
        settings.roulette_depth = self.roulette_depth or NEVER
        settings.sampler = int(rng.SOBOL if self.sampler is Sampler.SOBOL else rng.INDEPENDENT)
        settings.seed, settings.layers = job.seed, 0
        return settings

    def estimate(self, job: Job, state: PathSettings, film: Film, first: int, count: int) -> None:
        """Adds samples `first` to `first + count - 1` of every pixel."""
        for band in film.bands:
            inputs = [job.scene.struct, job.camera, state, first, count]
            job.device.launch(trace_paths, len(band), inputs, [film.load(band)])

    def finish(self, job: Job, state: PathSettings, film: Film) -> dict[str, np.ndarray]:
        """Nothing: every pass left a finished picture in the film."""
        return {}

    def counts(self, state: PathSettings) -> dict[str, int]:
        """Nothing beside the film's counts."""
        return {}
