"""Photon maps on a device: paths from the lights, what they left behind, and trees over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels import photons as kernels
from warpgi.materials import Diffuse
from warpgi.splat_tree import SplatTree

# Paths traced at a time, and photons of a path that find room at once; more of them mean tracing it again.
BATCH = 1 << 17
SLOTS = 4
FIELDS = {"position": wp.vec3, "normal": wp.vec3, "flux": wp.vec3, "kind": int}
#: What those need who read photons as lights.
SURFACE_FIELDS = {"face": int, "bary": wp.vec2, "incident": wp.vec3}
PHOTON_BYTES = 3 * 12 + 4
BATCH_BYTES = BATCH * (SLOTS * PHOTON_BYTES + 20)
#: Device bytes of a photon in a tree: the lane of its block, nodes, order and sort keys.
TREE_BYTES = 40 + 4 + 4 + 16

# Position rounding in units of float32's spacing at the largest coordinate.
NOISE_ULPS = 4.0 * 2.0**-24

# Paths that find out where caustics come from, and the part of later ones that goes anywhere all the same.
PILOT_PATHS = 1 << 16
PILOT_SHARE = 0.1


@dataclass(frozen=True)
class Shot:
    """Photons on the device."""

    photons: kernels.Photons
    """Arrays of `count` photons."""
    count: int
    paths: int
    rays: int
    dropped: int
    """Photons that were not finite."""
    cells: np.ndarray
    """Cell of the aim of each path, shape (paths,)."""
    stored: np.ndarray
    """Photons of each path, shape (paths,)."""
    first_face: np.ndarray | None = None
    """Triangle that each path met first, -1: none, shape (paths,); of paths whose starts were given."""
    first_bary: np.ndarray | None = None
    """Where it did, shape (paths, 2)."""

    def of_kind(self, *kinds: int) -> np.ndarray:
        """Numbers of the photons of these kinds, int32."""
        return np.flatnonzero(np.isin(self.photons.kind.numpy(), kinds)).astype(np.int32)


class PhotonSource:
    """Sends photons into a scene.

    Args:
        scene: on the device.
        seed: which random numbers.
        sampler: INDEPENDENT or SOBOL.
        sharpest: Blinn exponent up to which glossy lobes leave photons too, each with all that a light needs; 0: only
            diffuse surfaces, for densities.
    """

    def __init__(self, scene: DeviceScene, seed: int, sampler: int, sharpest: float = 0.0) -> None:
        self.scene, self.device = scene, scene.device
        self.fields = FIELDS | (SURFACE_FIELDS if sharpest > 0.0 else {})
        self.noise = NOISE_ULPS * max(scene.radius, 1e-30)
        self.has_caustics = any(not isinstance(shape.material, Diffuse) for shape in scene.scene.shapes)
        emission = kernels.Emission()
        # another stream than the camera's
        emission.seed, emission.sampler = -1 - seed, sampler
        emission.radius, emission.sharpest = scene.radius, sharpest
        sky = float(np.mean(scene.struct.environment)) * 4.0 * np.pi**2 * scene.radius**2
        emission.environment = sky / max(sky + scene.power, 1e-30)
        self.dark = sky + scene.power <= 0.0
        emission.starts = self.device.zeros(0, kernels.Start)
        self.emission = emission
        self._anywhere = self.device.zeros(0, float)
        self._aim: wp.array | None = None

    def shoot(self, paths: int, number: int) -> Shot:
        """All photons of `paths` paths of map `number`."""
        return self._shoot(paths, number, False, self._anywhere)

    def shoot_caustics(self, paths: int, number: int) -> Shot:
        """The caustic photons of `paths` paths, aimed where earlier ones found such."""
        if self._aim is None:
            self._aim = self._learn_aim()
        return self._shoot(paths, number, True, self._aim)

    def shoot_from(self, starts: np.ndarray) -> Shot:
        """All photons of paths with these starts, records of `kernels.photons.Start`."""
        self.emission.starts = self.device.array(starts, kernels.Start)
        shot = self._shoot(len(starts), 0, False, self._anywhere)
        self.emission.starts = self.device.zeros(0, kernels.Start)
        return shot

    def tree(self, shot: Shot, indices: np.ndarray) -> SplatTree:
        """A tree over some photons."""
        p = shot.photons
        return SplatTree(self.device, p.position, p.normal, p.flux, indices, self.noise)

    def _learn_aim(self) -> wp.array:
        """Running sum of the cells' probabilities: those from which a pilot's paths made caustics, and around them."""
        pilot = self._shoot(PILOT_PATHS, -1, True, self._anywhere)
        shape = (int(kernels.LIGHT_CELLS), int(kernels.AIM_CELLS), int(kernels.AIM_CELLS))
        size = int(np.prod(shape))
        found = (np.bincount(pilot.cells[pilot.stored > 0], minlength=size) > 0).reshape(shape)
        if not found.any():
            return self._anywhere
        wide = np.pad(found, ((0, 0), (1, 1), (1, 1)))
        rows, columns = shape[1:]
        around = np.any([wide[:, y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)
        chance = (1.0 - PILOT_SHARE) * around.ravel() / around.sum() + PILOT_SHARE / size
        cdf = np.cumsum(chance)
        cdf[-1] = 1.0
        return self.device.array(cdf.astype(np.float32), float)

    def _shoot(self, paths: int, number: int, caustics: bool, aim: wp.array) -> Shot:
        device, emission = self.device, self.emission
        emission.map, emission.part, emission.caustics, emission.aim_cdf = number, 1.0 / paths, int(caustics), aim
        slots = 1 if caustics else SLOTS
        size = min(paths, BATCH)
        given = len(emission.starts) > 0
        room = _photons(device, size * slots, self.fields)
        tracks = kernels.Tracks()
        for name in ("stored", "rays", "dropped", "cell"):
            setattr(tracks, name, device.zeros(size, int))
        if given:
            tracks.face, tracks.bary = device.zeros(size, int), device.zeros(size, wp.vec2)
            first_face, first_bary = np.full(paths, -1, np.int32), np.zeros((paths, 2), np.float32)
        ends = device.zeros(size, int)
        parts: list[tuple[kernels.Photons, int]] = []
        cells, stored = np.empty(paths, np.int32), np.empty(paths, np.int32)
        rays = dropped = total = 0
        for first in range(0, 0 if self.dark else paths, size):
            count = min(size, paths - first)
            inputs = [self.scene.struct, emission, first, slots]
            device.launch(kernels.shoot, count, inputs, [room, tracks])
            wp.utils.array_scan(tracks.stored[:count], ends[:count], inclusive=True)
            device.synchronize()
            found = int(ends.numpy()[count - 1])
            total += found
            need = total * 2 * PHOTON_BYTES + BATCH_BYTES
            if need > device.memory_limit:
                raise ValueError(
                    f"memory_limit is {device.memory_limit} bytes, expected more than {need} for the photons of"
                    f" {first + count} of {paths} paths"
                )
            part = _photons(device, found, self.fields)
            device.launch(kernels.pack, count, [*inputs, room, ends], [part])
            parts.append((part, found))
            rays += int(tracks.rays.numpy()[:count].sum(dtype=np.int64))
            dropped += int(tracks.dropped.numpy()[:count].sum(dtype=np.int64))
            cells[first : first + count] = tracks.cell.numpy()[:count]
            stored[first : first + count] = tracks.stored.numpy()[:count]
            if given:
                first_face[first : first + count] = tracks.face.numpy()[:count]
                first_bary[first : first + count] = tracks.bary.numpy()[:count]
        photons = parts[0][0] if len(parts) == 1 else _joined(device, parts, total, self.fields)
        firsts = (first_face, first_bary) if given else ()
        return Shot(photons, total, paths, rays, dropped, cells, stored, *firsts)


def _photons(device: Device, count: int, fields: dict[str, type]) -> kernels.Photons:
    result = kernels.Photons()
    for name, dtype in fields.items():
        setattr(result, name, device.zeros(count, dtype))
    return result


def _joined(
    device: Device, parts: list[tuple[kernels.Photons, int]], total: int, fields: dict[str, type]
) -> kernels.Photons:
    result = _photons(device, total, fields)
    start = 0
    for part, count in parts:
        for name in fields:
            wp.copy(getattr(result, name), getattr(part, name), start, 0, count)
        start += count
    return result
