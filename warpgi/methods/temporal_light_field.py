"""Temporal light-field reconstruction (Lehtinen et al. 2011): defocus and motion from a few camera rays, as it was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels.primary_samples import trace_primary_samples
from warpgi.lens_reconstruction import PRIMARY_SAMPLE_BYTES
from warpgi.methods.path import NEVER, Sampler, check_paths
from warpgi.samples import SampleBuffer
from warpgi.sampling import trace_primary_buffer
from warpgi.temporal_reconstruction import KERNELS, TemporalReconstruction


@dataclass(frozen=True, kw_only=True)
class TemporalLightField:
    """Defocus and motion blur from camera rays that move along their trajectories over the screen.

    The earlier method (Lehtinen, Aila, Chen, Laine, Durand 2011), which `LightField(primary_rays=True)` is compared
    with: samples near a place of the picture, seen through one point of the lens at one time, are grouped by depth
    into surfaces, a crossing of trajectories telling two surfaces apart; the first that surrounds the place answers.
    The picture is the layer "image".

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 1
    """Input paths per pixel."""
    rays: int = 128
    """Places, lens points and times per pixel at which it reconstructs; noise falls and time grows with it."""
    radius: float | None = None
    """Distance within which samples are gathered [pixels]; None: the largest hole of the samples' pattern in any view
    through lens and shutter."""
    max_depth: int | None = None
    """Longest path in segments; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end an input path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where the input paths' random numbers come from."""
    takes_motion: ClassVar[bool] = True

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        checks.count("rays", self.rays)
        if self.radius is not None:
            checks.number("radius", self.radius, 0.0, 64.0, open_lower=True)
        check_paths(self.max_depth, self.roulette_depth, self.sampler)

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_primary_samples, *KERNELS)

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Reconstructions of each pixel, and what to call them."""
        return self.rays, "rays"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        return size[0] * size[1] * self.spp * PRIMARY_SAMPLE_BYTES

    def prepare(self, job: Job, film: Film) -> TemporalReconstruction:
        """Traces the input and puts its trajectories into a tree."""
        depths = self.max_depth or NEVER, self.roulette_depth or NEVER
        return self.reconstruction(
            trace_primary_buffer(job, film, self.spp, *depths, self.sampler), job.device, job.seed
        )

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> TemporalReconstruction:
        """The trajectories of a buffer of primary rays, ready for `gather`."""
        return TemporalReconstruction(samples, device, seed, self.radius)

    def estimate(self, job: Job, state: TemporalReconstruction, film: Film, first: int, count: int) -> None:
        """Reconstructs `count` times in every pixel."""
        state.gather(first, count, self.rays)

    def finish(self, job: Job, state: TemporalReconstruction, film: Film) -> dict[str, np.ndarray]:
        """The picture, in place of the film's."""
        return self.layers(state)

    def layers(self, state: TemporalReconstruction) -> dict[str, np.ndarray]:
        """The picture."""
        return {"image": state.image()}

    def counts(self, state: TemporalReconstruction) -> dict[str, int]:
        """Reconstructions, and what was dropped, cut short or without support."""
        return state.all_counts()
