"""Statistical acceleration where camera and objects move (Meyer, Anderson 2006, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.irradiance import STRATA_BYTES
from warpgi.job import Job
from warpgi.kernels import bvh, statistical_filter, surface_points
from warpgi.kernels.hemisphere import sum_strata
from warpgi.kernels.irradiance_cache import reflect_irradiance
from warpgi.kernels.light_field import add_reflected
from warpgi.kernels.path_strata import trace_strata
from warpgi.kernels.poisson_disc import throw_darts
from warpgi.kernels.samples import trace_samples
from warpgi.kernels.spherical_harmonics import project_directions
from warpgi.methods.path import Sampler, check_paths
from warpgi.methods.statistical_filter import StatisticalFilter
from warpgi.sampling import PRIMARY_BYTES

if TYPE_CHECKING:
    from warpgi.point_animation import FramePoints

#: Below, harmonics would be too many: 361 for a lobe of this roughness.
LEAST_ROUGHNESS = 0.005

#: Device bytes of a primary hit beside those of tracing it: its place, irradiance, what it reflects, a mark.
BYTES_PER_HIT = 12 + 2 * 12 + 4


@dataclass(frozen=True, kw_only=True)
class PointFilter:
    """Statistical filter on points of surfaces (Meyer, Anderson 2006, 3.1), for cameras and objects that move.

    Points are fixed to surfaces wherever any frame sees them, as dense as the camera's path asks for; each frame's
    irradiance at all of them is traced with few paths, filtered in time by its principal components, and looked up by
    the pictures. So what a point knows over time is light alone, whatever moves or deforms. Diffuse surfaces take
    part, and glossy ones with harmonics of the light in place of irradiance, down to `roughness`; sharper ones, mirrors
    and glass keep light that is path-traced from each pixel.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 8
    """Primary hits per pixel of each picture, a camera ray each, which make edges and textures."""
    rays: int = 64
    """Paths per point and frame, one to a stratum of its hemisphere."""
    spacing: float = 3.0
    """Distance of points [pixels], in the frame that sees them largest, above 0; more blurs contact shadows, less takes
    points, and time, with its inverse square."""
    epsilon: float = 0.0
    """Part of the variance, the mean's included, that may stay unexplained, in [0, 1]; 0: noise alone ends the choice.
    The paper's 0.005 loses a small moving shadow where paths are many."""
    epsilon_change: float = 0.001
    """Part of the variance that one basis function more may explain, in [0, 1]."""
    modes: int | None = None
    """Number of basis functions by hand, the mean over time counted; None chooses it."""
    max_modes: int = 48
    """Largest number that is chosen; memory grows with it."""
    per_point: bool = True
    """Choose the number for every point too, never above that of the whole: the least of bias and noise around it."""
    roughness: float | None = 0.01
    """Least roughness of glossy surfaces that take part, 0.005 to 1: their points keep harmonics, about 2 over
    it of them; None: no glossy surface does."""
    lobe_rays: int = 128
    """Directions per pixel by which glossy surfaces ask for these."""
    light_samples: int = 32
    """Shadow rays to lights per pixel, shared out over its primary hits, which make the direct light."""
    fallback_rays: int = 64
    """Paths per pixel where no point serves."""
    max_depth: int | None = None
    """Longest path in segments, mirrors before a point not counted; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end a path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where the paths' random numbers come from."""

    def __post_init__(self) -> None:
        for name in ("spp", "rays", "lobe_rays", "light_samples", "fallback_rays"):
            checks.count(name, getattr(self, name))
        checks.number("spacing", self.spacing, 0.0, open_lower=True)
        if self.roughness is not None:
            checks.number("roughness", self.roughness, LEAST_ROUGHNESS, 1.0)
        check_paths(self.max_depth, self.roulette_depth, self.sampler)
        _ = self.filter  # checks the rest

    @property
    def filter(self) -> StatisticalFilter:
        """How points are filtered in time."""
        return StatisticalFilter(
            epsilon=self.epsilon,
            epsilon_change=self.epsilon_change,
            modes=self.modes,
            max_modes=self.max_modes,
            per_pixel=self.per_point,
        )

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches: a kernel of each module."""
        points = (surface_points.trace_places, throw_darts, trace_strata, sum_strata, statistical_filter.project)
        return (*points, bvh.fill_blocks, trace_samples, reflect_irradiance, add_reflected, project_directions)

    def passes(self) -> tuple[int, str]:
        """A picture is made of one lookup."""
        return 1, "lookups"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        return size[0] * size[1] * self.spp * (2 * PRIMARY_BYTES + BYTES_PER_HIT) + STRATA_BYTES

    def estimate(self, job: Job, state: FramePoints, film: Film, first: int, count: int) -> None:
        """Looks up light at the primary hits."""
        state.look_up(job)

    def finish(self, job: Job, state: FramePoints, film: Film) -> dict[str, np.ndarray]:
        """Adds the light to the film's indirect layer."""
        for band in film.bands:
            job.device.launch(add_reflected, len(band), [film.load(band), state.reflected, self.spp])
        return {}

    def counts(self, state: Any) -> dict[str, int]:
        """Points, primary hits without one, and rays."""
        return state.counts
