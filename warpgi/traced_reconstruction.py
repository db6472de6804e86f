"""Reconstruction where the scene is at hand: it stops the rays, and splats give their light."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpgi.device_scene import DeviceScene
from warpgi.kernels import traced_gather
from warpgi.kernels.hemisphere import Hemispheres
from warpgi.kernels.light_field import Gathered, Receivers
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.reconstruction import Reconstruction

#: What it launches beside a reconstruction.
KERNELS = (traced_gather.gather_traced,)


class TracedReconstruction(Reconstruction):
    """A reconstruction whose rays know the scene: no surface is guessed, and none is taken for another.

    Args:
        scene: what the samples were taken of.
        arguments: as for `Reconstruction`; positions are relative to the device's origin.
    """

    def __init__(self, scene: DeviceScene, *arguments: Any, **more: Any) -> None:
        self.scene = scene
        self.step = float(OFFSET_ULPS) * scene.radius
        super().__init__(*arguments, **more)

    def _middle(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return np.zeros(3, np.float32)

    def _fit(self) -> None:
        self.tree.refit_as_balls()

    def _send(self, hemispheres: Hemispheres, count: int, outputs: list[wp.array]) -> None:
        inputs = [self.scene.struct, self.tree.struct, hemispheres, self.seed, self.step, self.noise]
        self.device.launch(traced_gather.trace_splat_strata, count, inputs, outputs)

    def _trace(self, receivers: Receivers, gathered: Gathered, size: int, first: int, count: int, each: int) -> None:
        inputs = [self.scene.struct, self.tree.struct, receivers, each, first, count, self.seed, self.step, self.noise]
        self.device.launch(traced_gather.gather_traced, size, inputs, [gathered])
        self.counts["reconstruction_rays"] += size * count
