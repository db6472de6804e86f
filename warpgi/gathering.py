"""Final gathering as a source of irradiance: rays from a cache's records read photon maps where they end."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.irradiance import Irradiance, sum_hemispheres
from warpgi.job import Job
from warpgi.kernels import hemisphere
from warpgi.kernels import photon_strata as kernels
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.methods.photon_map import caustics_at_hits, gathering_map
from warpgi.reconstruction import PrimaryHits


class GatheringSource:
    """Irradiance but for caustics, by rays that end at their first hit and read photon maps there (Jensen 1996).

    Args:
        job: the scene.
        hits: the primary hits, relative to the device's origin.
        photons: paths from the lights for each map.
    """

    def __init__(self, job: Job, hits: PrimaryHits, photons: int) -> None:
        self.device, self.scene, self.per_pixel = job.device, job.scene, hits.per_pixel
        self.step = float(OFFSET_ULPS) * job.scene.radius
        self._mapping = gathering_map(job, photons)
        self._hits = hits
        self._origins, self._normals = (self.device.array(a, wp.vec3) for a in (hits.origin, hits.normal))
        self.counts = {"record_rays": 0, "fallback_rays": 0} | self._mapping.counts

    def at_points(
        self, points: np.ndarray, normals: np.ndarray, keys: np.ndarray, rings: int, sectors: int
    ) -> Irradiance:
        """See `IrradianceSource`."""

        def fill(hemispheres: hemisphere.Hemispheres, strata: wp.array, count: int) -> None:
            self.device.launch(kernels.gather_strata, count, [*self._inputs, hemispheres], [strata])

        self.counts["record_rays"] += len(points) * rings * sectors
        return sum_hemispheres(self.device, points, normals, keys, rings, sectors, fill)

    def at_hits(self, hits: np.ndarray, rays: int) -> wp.array:
        """See `IrradianceSource`."""
        result = self.device.zeros(len(hits), wp.vec3)
        inputs = [*self._inputs, self.device.array(hits, int), self._origins, self._normals, self.per_pixel, rays]
        self.device.launch(kernels.gather_at_hits, len(hits), inputs, [result])
        self.counts["fallback_rays"] += len(hits) * rays
        return result

    def caustics(self) -> wp.array:
        """Caustic light that each primary hit reflects, vec3 on the device."""
        return caustics_at_hits(self._mapping, self._hits)

    @property
    def _inputs(self) -> list[object]:
        return [self.scene.struct, self._mapping.maps, self._mapping.view, self.step]
