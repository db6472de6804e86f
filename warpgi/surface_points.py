"""Points fixed to the surfaces of a sequence, where its camera sees them, and what is known between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warpgi.device_scene import DeviceScene
from warpgi.job import Job
from warpgi.kernels import surface_points as kernels
from warpgi.poisson_disc import SAME_SIDE, poisson_disc
from warpgi.reconstruction import NOISE_ULPS, PrimaryHits
from warpgi.splat_tree import SplatTree

#: Radius in which a point counts, in times that of the part of the surface to which it is the nearest one.
SUPPORT = 2.0

# Radii of discs from one level to the next finer one fall by the root of 2; so many levels at most.
LEVELS_PER_OCTAVE = 2
MOST_LEVELS = 24

# Places that are looked at together; a place takes 40 bytes here and on the device.
CHUNK = 1 << 20

PLACES: dict[str, Any] = {
    "face": int,
    "bary": wp.vec2,
    "side": float,
    "position": wp.vec3,
    "normal": wp.vec3,
    "width": float,
}


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """P points, each fixed to its triangle."""

    face: np.ndarray
    """Triangle, counted over all shapes, shape (P,), int32."""
    bary: np.ndarray
    """Barycentric coordinates of the triangle's first two corners, shape (P, 2), float32."""
    side: np.ndarray
    """1 on the side of the triangle's normal, else -1; shape (P,), float32."""
    position: np.ndarray
    """Place in the rest pose, relative to that scene's centre, shape (P, 3), float32."""
    normal: np.ndarray
    """Unit shading normal there, on its side, shape (P, 3), float32."""
    shape: np.ndarray
    """Number of the shape, shape (P,), int32."""
    radius: np.ndarray
    """Distance of the farthest place seen to which it is the nearest point [scene units of the rest pose], shape (P,),
    float32."""

    def __len__(self) -> int:
        return len(self.face)

    def some(self, which: np.ndarray) -> SurfacePoints:
        """Those of some numbers or flags."""
        return SurfacePoints(**{name: values[which] for name, values in vars(self).items()})

    def placed(self, scene: DeviceScene) -> tuple[np.ndarray, np.ndarray]:
        """Positions in a frame's scene, relative to its centre, and normals, both of shape (P, 3), float32."""
        device, count = scene.device, len(self)
        position, normal = (device.zeros(count, wp.vec3) for _ in range(2))
        inputs = [device.array(self.face, int), device.array(self.bary, wp.vec2), device.array(self.side, float)]
        device.launch(kernels.place_points, count, [scene.struct, *inputs], [position, normal])
        return position.numpy(), normal.numpy()


@dataclass(eq=False)
class PointCollector:
    """Chooses points frame by frame, so that discs of some pixels' width cover all that the camera sees.

    Discs are the largest, down from level to level, that are no wider than what any frame asks for at a place: a
    Poisson-disc set whose density follows the footprint of the camera's path. What no frame sees gets no point.

    Args:
        rest: the scene whose distances count.
        spacing: radius of discs in pixels.
        seed: which points.
        exponent: largest Blinn exponent of glossy surfaces that get points; 0: diffuse ones alone.
    """

    rest: DeviceScene
    spacing: float
    seed: int
    exponent: float = 0.0
    _waiting: list[dict[str, np.ndarray]] = field(default_factory=list)
    _points: dict[str, np.ndarray] | None = None

    def add_frame(self, job: Job, rays_per_pixel: int) -> None:
        """Looks at what a frame's camera sees."""
        device = job.device
        count = job.size[0] * job.size[1] * rays_per_pixel
        places = kernels.Places()
        for name, dtype in PLACES.items():
            setattr(places, name, device.zeros(count, dtype))
        inputs = [job.scene.struct, self.rest.struct, job.camera, job.seed, rays_per_pixel, self.exponent]
        device.launch(kernels.trace_places, count, inputs, [places])
        met = np.flatnonzero(places.face.numpy() >= 0)
        self._waiting.append({name: getattr(places, name).numpy()[met] for name in PLACES})
        if sum(len(each["face"]) for each in self._waiting) >= CHUNK:
            self._choose()

    def points(self) -> SurfacePoints:
        """The points for all frames so far.

        Raises:
            ValueError: the camera sees no surface that scatters light.
        """
        self._choose()
        if self._points is None or len(self._points["face"]) == 0:
            raise ValueError("the camera sees no surface on which points could lie in any frame")
        names = ("face", "bary", "side", "position", "normal", "shape", "radius")
        return SurfacePoints(**{name: self._points[name] for name in names})

    def _choose(self) -> None:
        """Adds points for the places that wait, shape by shape."""
        if not self._waiting:
            return
        new = {name: np.concatenate([each[name] for each in self._waiting]) for name in PLACES}
        self._waiting = []
        of_face = np.repeat(np.arange(len(self.rest.first_face) - 1), np.diff(self.rest.first_face)).astype(np.int32)
        new["shape"] = of_face[new["face"]]
        new["radius"] = np.zeros(len(new["face"]), np.float32)
        kept = self._points or {name: values[:0] for name, values in new.items()}
        both = {name: np.concatenate([kept[name], new[name]]) for name in new}
        is_kept = np.arange(len(both["face"])) < len(kept["face"])
        parts = []
        for shape in np.unique(new["shape"]):
            here = both["shape"] == shape
            parts.append(self._choose_on({name: values[here] for name, values in both.items()}, is_kept[here]))
        others = ~np.isin(kept["shape"], new["shape"])
        parts.append({name: values[others] for name, values in kept.items()})
        self._points = {name: np.concatenate([part[name] for part in parts]) for name in both}

    def _choose_on(self, places: dict[str, np.ndarray], is_kept: np.ndarray) -> dict[str, np.ndarray]:
        """Points of one shape, from places of which some are points already."""
        device = self.rest.device
        wanted = np.maximum(self.spacing * places["width"], 1e-30).astype(np.float64)
        level = np.floor(LEVELS_PER_OCTAVE * np.log2(wanted)).astype(np.int64)
        level = np.maximum(level, level.max() - MOST_LEVELS)
        chosen = is_kept.copy()
        for each in np.unique(level)[::-1]:
            # a place that asks for fine discs may do with coarse ones for a start
            some = np.flatnonzero((level <= each) | chosen)
            found = poisson_disc(
                places["position"][some], places["normal"][some], _radius(each), self.seed, chosen[some], device
            )
            chosen[some[found]] = True
        points = {name: values[chosen] for name, values in places.items()}
        self._measure(points, places, level)
        return points

    def _measure(self, points: dict[str, np.ndarray], places: dict[str, np.ndarray], level: np.ndarray) -> None:
        """Widens points' radii to the farthest place to which each is the nearest, and to half of what it asked for."""
        device = self.rest.device
        grid = wp.HashGrid(32, 32, 32, device=device.warp)
        position, normal = (device.array(points[name], wp.vec3) for name in ("position", "normal"))
        farthest = points["radius"].astype(np.float64)
        least = np.full(len(farthest), np.inf)
        for each in np.unique(level):
            some = np.flatnonzero(level == each)
            radius = 1.0001 * _radius(each)
            grid.build(position, radius)
            nearest, distance = device.zeros(len(some), int), device.zeros(len(some), float)
            inputs = [grid.id, position, normal]
            inputs += [device.array(places[name][some], wp.vec3) for name in ("position", "normal")]
            device.launch(kernels.nearest_points, len(some), [*inputs, radius, SAME_SIDE], [nearest, distance])
            near = nearest.numpy()
            met = near >= 0
            np.maximum.at(farthest, near[met], distance.numpy()[met])
            np.minimum.at(least, near[met], 0.5 * _radius(each))
        points["radius"] = np.maximum(farthest, np.where(np.isfinite(least), least, 0.0)).astype(np.float32)


def _radius(level: int) -> float:
    return float(2.0 ** (level / LEVELS_PER_OCTAVE))


class PointLookup:
    """What is known at points, between them.

    Args:
        points: the points.
        rest: the scene whose distances count.
    """

    def __init__(self, points: SurfacePoints, rest: DeviceScene) -> None:
        device = rest.device
        self.device, self.rest, self.count = device, rest, len(points)
        position, normal = (device.array(array, wp.vec3) for array in (points.position, points.normal))
        noise = NOISE_ULPS * max(float(np.abs(points.position).max()), 1e-30)
        self._tree = SplatTree(device, position, normal, normal, np.arange(len(points), dtype=np.int32), noise)
        self.order = self._tree.order.numpy().copy()
        self._tree.set_radius2(device.array(np.square(SUPPORT * points.radius[self.order]), float))
        self._tree.refit_as_balls()
        self._shapes = device.array(points.shape[self.order], int)
        self._own = (position, normal, device.array(points.shape, int))

    def smoothed(self, values: np.ndarray) -> np.ndarray:
        """Means over the points around each point, shape (P, C), float32."""
        table = self._table(self.count, *self._own)
        padded = np.pad(values.astype(np.float32), ((0, 0), (0, -values.shape[1] % 3)))
        width = padded.shape[1] // 3
        own = self.device.array(padded[self.order].reshape(-1, 3), wp.vec3)
        mixed = self.device.zeros(self.count * width, wp.vec3)
        self.device.launch(kernels.mix_values, self.count * width, [table, width, own], [mixed])
        return mixed.numpy().reshape(self.count, -1)[:, : values.shape[1]]

    def at_hits(
        self, scene: DeviceScene, hits: PrimaryHits, numbers: np.ndarray, values: np.ndarray
    ) -> tuple[wp.array, np.ndarray]:
        """Means of points' values, shape (P, C, 3), around some primary hits of a frame, by number, int32.

        Returns:
            Vec3 on the device, C for each, and how many points each hit has found, on the host.
        """
        device, count, width = self.device, len(numbers), values.shape[1]
        assert hits.face is not None and hits.bary is not None
        own = device.array(values[self.order].reshape(-1, 3), wp.vec3)
        position, normal = device.zeros(count, wp.vec3), device.zeros(count, wp.vec3)
        shape, mixed = device.zeros(count, int), device.zeros(count * width, wp.vec3)
        inputs = [device.array(hits.face[numbers], int), device.array(hits.bary[numbers], wp.vec2)]
        inputs += [device.array(hits.normal[numbers], wp.vec3)]
        places = [scene.struct, self.rest.struct, *inputs]
        device.launch(kernels.place_hits, count, places, [position, normal, shape])
        table = self._table(count, position, normal, shape)
        device.launch(kernels.mix_values, count * width, [table, width, own], [mixed])
        return mixed, table.count.numpy()

    def _table(self, count: int, position: wp.array, normal: wp.array, shape: wp.array) -> kernels.Table:
        table = kernels.Table()
        table.points = self.device.zeros(count * int(kernels.MOST), int)
        table.weights = self.device.zeros(count * int(kernels.MOST), float)
        table.count = self.device.zeros(count, int)
        inputs = [self._tree.struct, self._shapes, position, normal, shape]
        self.device.launch(kernels.find_points, count, inputs, [table])
        return table
