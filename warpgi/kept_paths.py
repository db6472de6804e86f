"""Light paths that are kept from frame to frame (Laine, Saransaari, Kontkanen, Lehtinen, Aila 2007)."""

from __future__ import annotations

import numpy as np

from warpgi.device_scene import DeviceScene
from warpgi.kernels.photons import Start
from warpgi.light_domains import Domain, domains
from warpgi.photons import PhotonSource, Shot

# Points of a domain that measure the cells of its paths, for each path; and those that look for the largest hole.
CELL_POINTS = 256
HOLE_POINTS = 32
# An aim that moved less, as rounding does, has not.
STILL = 1e-5
# A path is kept where it meets the point that it met before, to this part of the scene's radius.
SAME_PLACE = 1e-4
# Powers of the root of x^6 = x + 1: Roberts' lattice in five dimensions; of x^3 = x + 1: in two.
LATTICE = 1.1347241384015194 ** -np.arange(1.0, 6.0)
PLANE = 1.324717957244746 ** -np.arange(1.0, 3.0)

PATH = np.dtype(
    [
        ("light", int),  # which domain
        ("key", int),
        ("face", int),  # of a lamp's triangles
        ("u", float, 2),
        ("aim", float, 2),
        ("met", int),  # triangle, -1: none
        ("bary", float, 2),
        ("far", float, 3),  # direction of one that met none
    ]
)


class KeptPaths:
    """The paths of a frame; each keeps the point that it met first, and its random numbers from there on.

    Args:
        source: of the first frame.
        count: paths to have.
        seed: which random numbers.
    """

    def __init__(self, source: PhotonSource, count: int, seed: int) -> None:
        self.count, self.seed = count, seed
        self.shift = np.random.default_rng(seed).random(5)
        self.next_key = 0
        self.domains = self._domains(source)
        wanted = self._wanted()
        self.paths = np.zeros(0, PATH)
        for light, number in enumerate(wanted):
            self._add(light, self._lattice(number))
        self.made = len(self.paths)
        self._learn(source)

    def advance(self, source: PhotonSource, budget: int) -> KeptPaths:
        """Paths of the next frame: those of which light still reaches the same point, and at most `budget` new ones."""
        self.domains = self._domains(source)
        wanted = self._wanted()
        moved = self._turn_aims(source.scene)
        shot = source.shoot_from(self.starts(np.ones(len(self.paths))))
        self.paths = self.paths[self._meets_the_same(source.scene, shot)]
        start = self.next_key
        for light in np.argsort(np.bincount(self.paths["light"], minlength=len(wanted)) - wanted):
            have = int((self.paths["light"] == light).sum())
            room = budget - (self.next_key - start)
            for _ in range(min(max(int(wanted[light]) - have, 0), room)):
                if len(self.paths) >= self.count:
                    most = int(np.argmax(np.bincount(self.paths["light"], minlength=len(wanted)) - wanted))
                    self.paths = np.delete(self.paths, self._crowded(most)[0])
                self._add(int(light), self._hole(int(light))[0][None])
        while moved and self.next_key - start < budget and self._spread():
            pass
        self.made = self.next_key - start
        if self.made:
            self._learn(source)
        return self

    def starts(self, weights: np.ndarray) -> np.ndarray:
        """Records for the device."""
        records = np.zeros(len(self.paths), Start.numpy_dtype())
        for light, domain in enumerate(self.domains):
            of = self.paths["light"] == light
            records["light"][of] = domain.records[self.paths["face"][of]]
            records["weight"][of] = domain.share * weights[of]
            records["side"][of] = domain.side
        for name in ("u", "aim", "key"):
            records[name] = self.paths[name]
        return records

    def weights(self) -> np.ndarray:
        """Parts of their lights' domains that are nearest to each path: its Voronoi cell, shape (N,)."""
        result = np.zeros(len(self.paths))
        for light, domain in enumerate(self.domains):
            of = np.flatnonzero(self.paths["light"] == light)
            if len(of):
                points = domain.embed(_lattice_points(CELL_POINTS * len(of)))
                nearest = _nearest(points, domain.embed(self.paths["aim"][of]))[0]
                result[of] = np.bincount(nearest, minlength=len(of)) / len(points)
        return result

    def shoot(self, source: PhotonSource) -> Shot:
        """Their photons."""
        return source.shoot_from(self.starts(self.weights()))

    def _domains(self, source: PhotonSource) -> list[Domain]:
        found = domains(source.scene, source.emission)
        lit = sum(domain.share > 0.0 for domain in found)
        if lit > self.count:
            raise ValueError(f"paths is {self.count}, expected {lit} or more: one for each light and side of a lamp")
        return found

    def _wanted(self) -> np.ndarray:
        """How many paths each light is to have: by power, one at least."""
        share = np.array([domain.share for domain in self.domains])
        if not share.any():
            return np.zeros(len(share), int)
        exact = share / share.sum() * self.count
        number = np.where(share > 0.0, np.maximum(np.floor(exact), 1), 0).astype(int)
        for i in np.argsort(number - exact)[: max(self.count - number.sum(), 0)]:
            number[i] += 1
        while number.sum() > self.count:
            number[np.argmax(number - exact)] -= 1
        return number

    def _lattice(self, number: int) -> np.ndarray:
        k = np.arange(number)[:, None]
        return (self.shift[:2] + k * PLANE) % 1.0

    def _add(self, light: int, aim: np.ndarray) -> None:
        new = np.zeros(len(aim), PATH)
        keys = self.next_key + np.arange(len(aim))
        spot = (self.shift + keys[:, None] * LATTICE) % 1.0
        new["light"], new["key"], new["aim"], new["u"] = light, keys, aim, spot[:, 2:4]
        triangles = self.domains[light].triangles
        if triangles is not None:
            area = np.linalg.norm(
                np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
            )
            new["face"] = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), spot[:, 4]), len(area) - 1)
        self.paths = np.concatenate([self.paths, new])
        self.next_key += len(aim)

    def _learn(self, source: PhotonSource) -> None:
        """Writes down what the paths meet first."""
        shot = source.shoot_from(self.starts(np.ones(len(self.paths))))
        self.paths["met"], self.paths["bary"] = shot.first_face, shot.first_bary
        for light, domain in enumerate(self.domains):
            of = self.paths["light"] == light
            some = self.paths[of]
            self.paths["far"][of] = domain.directions(some["face"], some["u"], some["aim"])

    def _turn_aims(self, scene: DeviceScene) -> bool:
        """Aims of the moved lights at the same points; paths that cannot be aimed so are gone. Whether any moved."""
        met = self.paths["met"] >= 0
        target = np.where(met[:, None], _places(scene, self.paths["met"], self.paths["bary"]), self.paths["far"])
        can = np.zeros(len(met), bool)
        moved = False
        for light, domain in enumerate(self.domains):
            of = np.flatnonzero(self.paths["light"] == light)
            if not len(of) or domain.share <= 0.0:
                continue
            some = self.paths[of]
            aim, can[of] = domain.aim_at(some["face"], some["u"], target[of], ~met[of])
            if domain.position is None and domain.triangles is None:
                aim[~met[of]], can[of[~met[of]]] = some["aim"][~met[of]], True  # a line that meets nothing has no point
            far = np.linalg.norm(domain.embed(aim) - domain.embed(some["aim"]), axis=1) > STILL
            self.paths["aim"][of] = np.where(far[:, None], aim, some["aim"])
            moved |= bool(far.any())
        self.paths = self.paths[can]
        return moved

    def _meets_the_same(self, scene: DeviceScene, shot: Shot) -> np.ndarray:
        assert shot.first_face is not None and shot.first_bary is not None
        met, now = self.paths["met"] >= 0, shot.first_face >= 0
        before = _places(scene, self.paths["met"], self.paths["bary"])
        after = _places(scene, shot.first_face, shot.first_bary.astype(np.float64))
        near = np.linalg.norm(after - before, axis=1) < SAME_PLACE * scene.radius
        return (met == now) & (~met | near)

    def _hole(self, light: int) -> tuple[np.ndarray, float]:
        """The aim that is farthest from all paths of a light, and its distance."""
        domain, of = self.domains[light], self.paths["light"] == light
        aims = _lattice_points(HOLE_POINTS * max(int(of.sum()), 16))
        aims = (aims + np.random.default_rng([self.seed, self.next_key]).random(2)) % 1.0
        if not of.any():
            return aims[0], np.inf
        distance = _nearest(domain.embed(aims), domain.embed(self.paths["aim"][of]))[1]
        best = int(distance.argmax())
        return aims[best], float(distance[best])

    def _crowded(self, light: int) -> tuple[int, float]:
        """Number of the path of a light that has another nearest to it, and their distance."""
        of = np.flatnonzero(self.paths["light"] == light)
        if len(of) < 3:
            return int(of[0]) if len(of) else -1, np.inf
        site = self.domains[light].embed(self.paths["aim"][of])
        apart = np.linalg.norm(site[:, None] - site[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        i, j = np.unravel_index(apart.argmin(), apart.shape)
        # of the two, the one with its other neighbours nearer
        second = np.partition(apart[[i, j]], 1, axis=1)[:, 1]
        return int(of[i if second[0] < second[1] else j]), float(apart[i, j])

    def _spread(self) -> bool:
        """Takes a crowded path of a light away for one in its largest hole, where that is larger."""
        for light in range(len(self.domains)):
            crowded, apart = self._crowded(light)
            aim, hole = self._hole(light)
            if apart < hole < np.inf:
                self.paths = np.delete(self.paths, crowded)
                self._add(light, aim[None])
                return True
        return False


def _lattice_points(count: int) -> np.ndarray:
    return (0.5 + np.arange(count)[:, None] * PLANE) % 1.0


def _nearest(points: np.ndarray, sites: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest site of each point, and its distance."""
    index, distance = np.empty(len(points), int), np.empty(len(points))
    for first in range(0, len(points), 4096):
        some = points[first : first + 4096]
        squares = np.square(some).sum(axis=1)[:, None] + np.square(sites).sum(axis=1) - 2.0 * some @ sites.T
        best = squares.argmin(axis=1)
        index[first : first + 4096] = best
        distance[first : first + 4096] = np.sqrt(np.maximum(squares[np.arange(len(some)), best], 0.0))
    return index, distance


def _places(scene: DeviceScene, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Points of triangles relative to the scene's centre, shape (N, 3); of triangle -1 the centre."""
    result = np.zeros((len(face), 3))
    shape = np.searchsorted(scene.first_face, face, side="right") - 1
    for i in np.unique(shape[face >= 0]):
        of = (shape == i) & (face >= 0)
        one = scene.scene.shapes[i]
        corners = one.vertices[one.faces[face[of] - scene.first_face[i]]] - scene.centre
        u, v = bary[of].T
        weights = np.stack([u, v, 1.0 - u - v], axis=1)
        result[of] = np.einsum("nk,nkc->nc", weights, corners)
    return result
