"""Reconstruction where the scene is at hand: it stops the rays, and splats give their light."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpgi.glossy_reconstruction import surfaces_of
from warpgi.job import Job
from warpgi.kernels import traced_gather
from warpgi.kernels.glossy_light_field import Surfaces
from warpgi.kernels.hemisphere import Hemispheres
from warpgi.kernels.light_field import Gathered, Receivers
from warpgi.kernels.path import PathSettings
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.reconstruction import PrimaryHits, Reconstruction

#: What it launches beside a reconstruction.
KERNELS = (traced_gather.gather_traced,)


class TracedReconstruction(Reconstruction):
    """A reconstruction whose rays know the scene: no surface is guessed, and none is taken for another.

    Where no splat covers what a ray met, or where it is so near that splats are too coarse, a path is traced instead.

    Args:
        job: the scene that the samples were taken of.
        paths: settings of these paths, the segment to the point from which they start counted.
        arguments: as for `Reconstruction`; positions are relative to the device's origin.
    """

    def __init__(self, job: Job, paths: PathSettings, *arguments: Any, **more: Any) -> None:
        self.scene, self.paths = job.scene, paths
        super().__init__(*arguments, **more)

    def _upload(self, splats: np.ndarray, receivers: PrimaryHits | None) -> None:
        super()._upload(splats, receivers)
        self.surfaces = surfaces_of(self.samples, receivers, self.device)

    def _relight(self, splats: np.ndarray, rays: int) -> None:
        # what a glossy splat sent is no multiple of the light that all directions bring it
        kappa = self.samples.kappa
        surfaces, self.surfaces = self.surfaces, Surfaces()
        super()._relight(splats if kappa is None else splats[kappa[splats] == 0.0], rays)
        self.surfaces = surfaces

    def all_counts(self) -> dict[str, int]:
        """Rays so far, and those of them that became paths."""
        counts = super().all_counts()
        counts["path_rays"] = counts.pop("undersampled_surfaces")
        return counts

    def _middle(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return np.zeros(3, np.float32)

    def _fit(self) -> None:
        self.tree.refit_as_balls()

    @property
    def _light(self) -> traced_gather.Light:
        light = traced_gather.Light()
        light.tree, light.paths, light.noise = self.tree.struct, self.paths, self.noise
        light.step = float(OFFSET_ULPS) * self.scene.radius
        return light

    def _send(self, hemispheres: Hemispheres, count: int, outputs: list[wp.array]) -> None:
        inputs = [self.scene.struct, self._light, hemispheres, self.seed]
        self.device.launch(traced_gather.trace_splat_strata, count, inputs, outputs)

    def _trace(self, receivers: Receivers, gathered: Gathered, size: int, first: int, count: int, each: int) -> None:
        inputs = [self.scene.struct, self._light, self.surfaces, receivers, each, first, count, self.seed]
        self.device.launch(traced_gather.gather_traced, size, inputs, [gathered])
        self.counts["reconstruction_rays"] += size * count
