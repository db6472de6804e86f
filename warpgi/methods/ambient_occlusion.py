"""Ambient occlusion from a few samples (Lehtinen et al. 2012, section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels.neighbours import MAX_NEIGHBOURS
from warpgi.kernels.samples import trace_samples
from warpgi.methods.path import NEVER, Sampler
from warpgi.reconstruction import BYTES_PER_SAMPLE, KERNELS, Preprocessing, Reconstruction, pixel_means
from warpgi.samples import SampleBuffer
from warpgi.sampling import PRIMARY_BYTES, SECONDARY_BYTES, trace_sample_buffer

VISIBILITY_DEPTH = 2  # segments: to the primary hit, and from there to whatever is near


@dataclass(frozen=True, kw_only=True)
class AmbientOcclusion:
    """Cosine-weighted share of the hemisphere without a surface within `radius`, from a few rays per pixel.

    The picture is the layer "image", grey: 1 is open, 0 closed or nothing diffuse to be seen.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 4
    """Input rays per pixel."""
    rays: int = 256
    """Reconstruction rays per pixel, shared out over its samples."""
    radius: float = math.inf
    """Distance [scene units] from which on a surface no longer occludes, above 0."""
    neighbours: int = 12
    """Samples that lie within a splat's radius at first, itself counted, in [2, 32]."""
    alpha: float = 3.0
    """Factor by which distances along a splat's normal count for more, 1 or above."""
    margin: float = 1e-3
    """Part of an input ray at either end in which the splats that it crosses do not shrink, in [0, 0.5)."""
    shrink: bool = True
    """Shrink the splats that input rays cross, so that nothing is in the way of what was seen; False lets leaves and
    edges grow (Lehtinen et al. 2012, fig. 4)."""
    lone_radius: float = 1.0
    """Part of its radius that a splat keeps where it alone is the first surface on a ray, in (0, 1]."""

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        checks.count("rays", self.rays)
        if self.radius != math.inf:
            checks.number("radius", self.radius, 0.0, open_lower=True)
        checks.count("neighbours", self.neighbours, 2, MAX_NEIGHBOURS)
        checks.number("alpha", self.alpha, 1.0)
        checks.number("margin", self.margin, 0.0, 0.499)
        checks.number("lone_radius", self.lone_radius, 0.0, 1.0, open_lower=True)

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return False

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_samples, *KERNELS)

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Reconstruction rays for each primary hit, at `spp` of them in a pixel, and what to call them."""
        return max(1, round(self.rays / (spp or self.spp))), "rays per hit"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        return size[0] * size[1] * self.spp * (PRIMARY_BYTES + SECONDARY_BYTES + BYTES_PER_SAMPLE)

    def prepare(self, job: Job, film: Film) -> Reconstruction:
        """Traces the input rays and makes splats of their hits."""
        samples, _ = trace_sample_buffer(
            job, film, self.spp, self.spp, 0, VISIBILITY_DEPTH, NEVER, Sampler.SOBOL, False
        )
        return self.reconstruction(samples, job.device, job.seed)

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> Reconstruction:
        """Splats made of a sample buffer, ready for `gather`."""
        preprocessing = Preprocessing(self.neighbours, self.alpha, self.margin, self.lone_radius, self.shrink)
        return Reconstruction(samples, device, preprocessing, seed, reach=self.radius)

    def estimate(self, job: Job, state: Reconstruction, film: Film, first: int, count: int) -> None:
        """Sends `count` reconstruction rays from every primary hit."""
        state.gather(first, count, self.passes()[0])

    def finish(self, job: Job, state: Reconstruction, film: Film) -> dict[str, np.ndarray]:
        """The picture, in place of the film's."""
        return self.layers(state)

    def layers(self, state: Reconstruction) -> dict[str, np.ndarray]:
        """Mean visibility of each pixel's primary hits."""
        visible = np.where(state.samples.checked.is_primary, 1.0 - state.near(), 0.0).astype(np.float32)
        return {"image": pixel_means(state.samples, np.repeat(visible[:, None], 3, axis=1))}

    def counts(self, state: Reconstruction) -> dict[str, int]:
        """Reconstruction rays, and what was dropped, cut short or without support."""
        return state.all_counts()
