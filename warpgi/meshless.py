"""Irradiance on surfaces as a sum over levels of points, coarse to fine (Lehtinen et al. 2008)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import meshless_hierarchy as kernels
from warpgi.poisson_disc import poisson_disc
from warpgi.reconstruction import PrimaryHits
from warpgi.samples import NO_HIT

#: Radius of a basis function in times that of its level's discs: wherever a disc covers, its weight is well above 0.
SUPPORT = 2.0

# Cells of the grid along an axis; it goes on periodically.
GRID = 64

# Light below this share of the mean is as good as none: what is relative to it would be noise.
DARK = 0.1

#: Device bytes of a primary hit: position, normal, albedo, value, and what a level needs.
BYTES_PER_HIT = 12 * 4 + 4 * 4


class IrradianceSource(Protocol):
    """Where the irradiance at points comes from."""

    def at_hits(self, hits: np.ndarray, rays: int) -> wp.array:
        """Irradiance at some of the primary hits, by number, int32, from `rays` rays each; vec3 on the device."""


@dataclass(frozen=True)
class Refinement:
    """How a hierarchy is built."""

    radius: float
    """Of the first level's discs [scene units]."""
    levels: int
    tolerance: float
    """Coefficient, relative to irradiance, below which, and not at which, no finer points are needed around a point."""
    rays: int
    """From each point."""


class MeshlessHierarchy:
    """Values at primary hits, level by level.

    Args:
        hits: where light is wanted, and among which points are chosen.
        source: of irradiance.
        device: where it computes.
        refinement: how far it goes.
        seed: which points.
    """

    def __init__(
        self, hits: PrimaryHits, source: IrradianceSource, device: Device, refinement: Refinement, seed: int
    ) -> None:
        self.device, self.source, self.refinement, self.seed = device, source, refinement, seed
        count = len(hits.origin)
        self.primary = np.flatnonzero(np.abs(hits.origin).max(axis=1) < NO_HIT)
        self.position, self.normal = hits.origin, hits.normal
        surface = kernels.Surface()
        surface.position, surface.normal = (device.array(a, wp.vec3) for a in (hits.origin, hits.normal))
        self.surface = surface
        self.albedo = device.array(hits.albedo, wp.vec3)
        self.value = device.zeros(count, wp.vec3)
        self.light = np.zeros((count, 3), np.float32)  # irradiance of the points that have been computed
        self.known = np.zeros(count, bool)
        self.is_point = np.zeros(count, bool)
        self.varies = self.primary[:0]  # points of the last level with coefficients above tolerance
        self.level = 0
        self.counts = {"points": 0, "point_rays": 0, "unresolved_points": 0, "unsupported_hits": 0}
        self._grid = wp.HashGrid(GRID, GRID, GRID, device=device.warp)

    def refine(self) -> None:
        """Adds a level, where the one before it says that light varies."""
        radius = self.refinement.radius * 0.5**self.level
        support = SUPPORT * radius
        wanted = around = self.primary
        if self.level > 0:
            near = self._near(2.0 * support)
            wanted, around = self.primary[near == 2], self.primary[near > 0]
        self.level += 1
        if len(around) == 0:
            return
        chosen = poisson_disc(
            self.position[around], self.normal[around], radius, self.seed, self.is_point[around], self.device
        )
        points = around[chosen]
        self.is_point[points] = True
        self._compute(np.intersect1d(points, wanted, assume_unique=True))
        residual = np.where(self.known[points, None], self.light[points] - self.value.numpy()[points], np.float32(0.0))
        self._add(points, residual, support, around)
        self.varies = (
            points if self.level == 1 else points[self._relative(points, residual) >= self.refinement.tolerance]
        )
        self.counts["unresolved_points"] = len(self.varies)

    def reflected(self) -> wp.array:
        """Indirect light that each primary hit reflects, vec3 on the device."""
        result = self.device.zeros(self.value.size, wp.vec3)
        self.device.launch(kernels.reflect_irradiance, self.value.size, [self.value, self.albedo], [result])
        return result

    def _near(self, support: float) -> np.ndarray:
        """2: in the support of points where light varies, 1: around it, 0: elsewhere; for all primary hits."""
        near = self.device.zeros(len(self.primary), int)
        if len(self.varies):
            inputs = [self.surface, self._level(self.varies, support, 2.0), self.device.array(self.primary, int)]
            self.device.launch(kernels.find_near, len(self.primary), inputs, [near])
        return near.numpy().copy()

    def _compute(self, points: np.ndarray) -> None:
        """Irradiance of those points that have none yet."""
        new = points[~self.known[points]].astype(np.int32)
        if len(new):
            self.light[new] = self.source.at_hits(new, self.refinement.rays).numpy()
            self.known[new] = True
            self.counts["points"] += len(new)
            self.counts["point_rays"] += len(new) * self.refinement.rays

    def _add(self, points: np.ndarray, coefficient: np.ndarray, support: float, receivers: np.ndarray) -> None:
        weight = self.device.zeros(len(receivers), float)
        inputs = [
            self.surface,
            self._level(points, support),
            self.device.array(receivers, int),
            self.device.array(coefficient, wp.vec3),
        ]
        self.device.launch(kernels.add_level, len(receivers), inputs, [self.value, weight])
        self.counts["unsupported_hits"] += int(np.count_nonzero(weight.numpy() <= 0.0))

    def _level(self, points: np.ndarray, support: float, reach: float = 1.0) -> kernels.Level:
        level = kernels.Level()
        self._grid.build(self.device.array(self.position[points], wp.vec3), reach * support)
        level.grid, level.support = self._grid.id, support
        level.points = self.device.array(points, int)
        return level

    def _relative(self, points: np.ndarray, coefficient: np.ndarray) -> np.ndarray:
        """Coefficients over irradiance, the largest of the channels'."""
        mean = float(self.light[self.known].mean()) if self.known.any() else 0.0
        scale = np.maximum(self.light[points].max(axis=1), max(DARK * mean, 1e-30))
        return np.abs(coefficient).max(axis=1) / scale
