"""Photon maps: photons per second, and k nearest photons beside scipy's cKDTree on the same photons and points.

Points are a picture's first hits, in rows, as a render asks for them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

import warpgi as gi
from bench.report import Row, paired_ratio, row
from bench.turns import take_turns
from warpgi.device_scene import DeviceScene
from warpgi.job import Job
from warpgi.kernels.density import vec8
from warpgi.kernels.photon_map import nearest_of_each
from warpgi.methods.photon_map import Mapping
from warpgi.photons import Shot

YARDSTICK = "scipy cKDTree, photons"
SEED = 1
# Photons in the tree of the search, and those that are looked for at each point.
MOST_PHOTONS = 1_000_000
NEIGHBOURS = 50
# More would measure no better.
MOST_POINTS = 200_000


class PhotonBench:
    """Photons of one scene, and points to look for them at.

    Args:
        scene: where photons fly.
        on_device: the same, uploaded.
        size: of the picture whose first hits are the points.
        photons: in the tree; paths are as many as it takes.
        points: at least so many.
    """

    def __init__(self, scene: gi.Scene, on_device: DeviceScene, size: tuple[int, int], photons: int, points: int):
        device = on_device.device
        self.device = device
        self.mapping = Mapping(gi.PhotonMap(), Job(on_device, on_device.camera(size), size, SEED, device))
        source = self.mapping.source
        pilot = source.shoot(10_000, 0)
        self.paths = max(1, int(1.02 * photons * pilot.paths / max(pilot.count, 1)))
        self.shot = source.shoot(self.paths, 0)
        self.count = min(photons, self.shot.count)
        self.indices = np.arange(self.count, dtype=np.int32)
        self.tree = source.tree(self.shot, self.indices)
        hits = [gi.render(scene, gi.PathTracing(spp=1, max_depth=1), size, seed, device) for seed in (SEED,)]
        while sum(h.layers["depth"].size for h in hits) < points:
            hits.append(gi.render(scene, gi.PathTracing(spp=1, max_depth=1), size, SEED + len(hits), device))
        position = np.concatenate([(h.layers["position"] - on_device.centre).reshape(-1, 3) for h in hits])
        normal = np.concatenate([h.layers["normal"].reshape(-1, 3) for h in hits])
        met = np.linalg.norm(normal, axis=1) > 0.5
        self.points = position[met].astype(np.float32)
        self.inputs = [device.array(self.points, wp.vec3), device.array(normal[met].astype(np.float32), wp.vec3)]
        self.found = device.zeros(len(self.points), vec8)

    def shoot(self) -> Shot:
        """Emits, follows and stores."""
        return self.mapping.source.shoot(self.paths, 0)

    def build(self) -> None:
        """Sorts the photons into their tree."""
        self.mapping.source.tree(self.shot, self.indices)

    def search(self) -> None:
        """The k nearest of each point, of any surface: what scipy is asked too."""
        inputs = [self.tree.struct, *self.inputs, NEIGHBOURS, 0.0, -2.0]
        self.device.launch(nearest_of_each, -(-len(self.points) // 8), inputs, [self.found])


def photon_rows(
    scene: gi.Scene,
    on_device: DeviceScene,
    size: tuple[int, int],
    repeats: int,
    photons: int = MOST_PHOTONS,
) -> list[Row]:
    """Rates of photons stored, of tree building and of searches, and bytes of a photon; `photons` caps their number."""
    bench = PhotonBench(scene, on_device, size, min(photons, MOST_PHOTONS), min(photons, MOST_POINTS))
    if bench.count == 0:
        return []
    jobs: dict[str, Callable[[], object]] = {"photons": bench.shoot, "photon tree": bench.build}
    jobs["photon search"] = bench.search
    tree = None
    try:
        from scipy.spatial import cKDTree

        tree = cKDTree(bench.shot.photons.position.numpy()[: bench.count])
        jobs[YARDSTICK] = lambda: tree.query(bench.points, k=NEIGHBOURS, workers=bench.device.threads)
    except ImportError:
        pass
    seconds = {name: np.array(values) for name, values in take_turns(jobs, repeats, bench.device).items()}
    name, shot = scene.name, bench.shot
    of = f"k = {NEIGHBOURS}, {bench.count} photons, {len(bench.points)} first hits"
    queries = len(bench.points) / seconds["photon search"]
    compared = {}
    yard: list[Row] = []
    if tree is not None:
        rates = len(bench.points) / seconds[YARDSTICK]
        compared = {"ratio": paired_ratio(queries, rates), "versus": YARDSTICK}
        distance = np.sqrt(bench.found.numpy()[:, 5])
        reach = tree.query(bench.points, k=NEIGHBOURS, workers=bench.device.threads)[0][:, -1]
        of += f"; radii differ by {np.abs(distance / reach - 1.0).max():.1g} at most"
        yard.append(row(name, YARDSTICK, rates, "queries/s", note=f"{bench.device.threads} workers"))
    note = f"{shot.count} of {shot.paths} paths, {shot.rays / shot.paths:.2f} rays a path"
    return [
        row(name, "photons, emitted and stored", shot.count / seconds["photons"], "photons/s", note=note),
        row(name, "photon tree", bench.count / seconds["photon tree"], "photons/s"),
        row(name, "photon search", queries, "queries/s", note=of, **compared),
        *yard,
        row(name, "photon in its tree, device", bench.tree.nbytes / bench.count, "B"),
    ]
