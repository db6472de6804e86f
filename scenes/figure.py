"""A sitting hare as an implicit surface, and naive surface nets (Gibson 1998) that make triangles of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warpgi.scenes.primitives import Mesh, normalize, vertex_normals

Field = Callable[[np.ndarray], np.ndarray]
# Grid steps from one corner of a cell to the other end of each of its 12 edges.
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]


def hare(resolution: int = 64) -> Mesh:
    """A hare 1.3 m tall on a round base, looking along +z, its base at y = 0.

    Args:
        resolution: cells over its height; the triangle count grows with its square, about 17 000 at 64.
    """
    low, high = np.array([-0.55, -0.05, -0.6]), np.array([0.55, 1.45, 0.6])
    return surface_nets(hare_distance, low, high, (high - low)[1] / resolution)


def surface_nets(field: Field, low: np.ndarray, high: np.ndarray, cell: float) -> Mesh:
    """Triangles of the surface where `field` is 0, facing where it is positive.

    Args:
        field: from points (N, 3) to values (N,), about the signed distance [m]; positive on the border of the grid.
        low, high: corners of the grid [m].
        cell: edge of a grid cell [m].
    """
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[i] + cell * np.arange(counts[i]) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=3)
    value = field(points.reshape(-1, 3)).reshape(counts)
    inside = value < 0.0

    # One vertex per cell that the surface cuts: the mean of the cuts of its edges.
    cells = counts - 1
    corner = [tuple(slice(c, c + n) for c, n in zip(offset, cells, strict=True)) for offset in CORNERS]
    mixed = sum(inside[c].astype(int) for c in corner)
    active = np.argwhere((mixed > 0) & (mixed < 8))
    total, hits = np.zeros((len(active), 3)), np.zeros((len(active), 1))
    for a, b in EDGES:
        at_a, at_b = (value[tuple((active + CORNERS[e]).T)][:, None] for e in (a, b))
        cut = (at_a < 0.0) != (at_b < 0.0)
        t = np.where(cut, at_a / np.where(cut, at_a - at_b, 1.0), 0.0)
        total += cut * (CORNERS[a] + t * (CORNERS[b] - CORNERS[a]))
        hits += cut
    vertices = low + cell * (active + total / hits)
    normals = _gradient(field, vertices, 0.1 * cell)
    # Half a Newton step smooths the net; a whole one would fold it at creases.
    vertices = vertices - 0.5 * field(vertices)[:, None] * normals

    # One quad per grid edge that the surface cuts, through the four cells about it.
    number = np.full(tuple(cells), -1)
    number[tuple(active.T)] = np.arange(len(active))
    faces = []
    for axis in range(3):
        v, w = (axis + 1) % 3, (axis + 2) % 3
        first = np.moveaxis(inside, axis, 0)
        cut = np.argwhere(np.moveaxis(first[:-1] != first[1:], 0, axis))
        step_v, step_w = np.eye(3, dtype=int)[v], np.eye(3, dtype=int)[w]
        ring = [number[tuple((cut - offset).T)] for offset in (0 * step_v, step_v, step_v + step_w, step_w)]
        quad = np.stack(ring, axis=1)
        leaves = inside[tuple(cut.T)]  # the surface faces along +axis where the edge goes out of the solid
        quad = np.where(leaves[:, None], quad, quad[:, ::-1])
        faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    found = np.concatenate(faces)
    # Normals of the triangles, not of the field: where a net folds at a crease the two differ by more than 90 degrees.
    return Mesh(vertices, found, vertex_normals(vertices, found), vertices[:, :2].copy())


def _gradient(field: Field, p: np.ndarray, step: float) -> np.ndarray:
    offsets = step * np.eye(3)
    return normalize(np.stack([field(p + o) - field(p - o) for o in offsets], axis=1))


def hare_distance(p: np.ndarray) -> np.ndarray:
    """About the signed distance to the hare [m]; p has shape (N, 3)."""
    mirrored = np.stack([np.abs(p[:, 0]), p[:, 1] - 0.07, p[:, 2]], axis=1)
    q = p - [0.0, 0.07, 0.0]
    d = _ellipsoid(q, (0.0, 0.30, -0.10), (0.25, 0.29, 0.29))  # rump
    d = _blend(d, _ellipsoid(q, (0.0, 0.44, 0.09), (0.18, 0.26, 0.17)), 0.10)  # chest
    d = _blend(d, _ellipsoid(mirrored, (0.20, 0.20, -0.03), (0.11, 0.20, 0.21)), 0.05)  # thighs
    d = _blend(d, _ellipsoid(mirrored, (0.20, 0.045, 0.17), (0.07, 0.055, 0.17)), 0.04)  # hind feet
    d = _blend(d, _capsule(mirrored, (0.09, 0.40, 0.17), (0.085, 0.06, 0.25), 0.062, 0.045), 0.05)  # forelegs
    d = _blend(d, _ellipsoid(mirrored, (0.085, 0.04, 0.30), (0.055, 0.045, 0.09)), 0.03)  # paws
    d = _blend(d, _ellipsoid(q, (0.0, 0.20, -0.40), (0.09, 0.09, 0.09)), 0.03)  # tail
    head = _ellipsoid(q, (0.0, 0.78, 0.16), (0.135, 0.135, 0.17))
    head = _blend(head, _ellipsoid(q, (0.0, 0.725, 0.30), (0.08, 0.065, 0.085)), 0.06)  # muzzle
    head = _blend(head, _ellipsoid(mirrored, (0.055, 0.715, 0.28), (0.065, 0.06, 0.07)), 0.05)  # cheeks
    for side, tip in ((-1.0, (-0.14, 1.27, -0.02)), (1.0, (0.21, 1.20, 0.06))):
        root = (0.055 * side, 0.86, 0.11)
        ear = _capsule(q, root, tip, 0.045, 0.058)
        hollow = _capsule(q - [0.0, 0.0, 0.065], (0.07 * side, 0.95, 0.11), tip, 0.034, 0.034)
        head = _blend(head, -_blend(-ear, hollow, 0.02), 0.025)
    d = _blend(d, head, 0.07)
    d = _blend(d, _ellipsoid(mirrored, (0.098, 0.80, 0.255), (0.027, 0.030, 0.027)), 0.006)  # eyes
    d = _blend(d, _ellipsoid(q, (0.0, 0.765, 0.375), (0.022, 0.016, 0.018)), 0.012)  # nose
    # The base: a round slab with rounded edges.
    radial = np.hypot(p[:, 0], p[:, 2]) - 0.44
    height = np.abs(p[:, 1] - 0.045) - 0.005
    slab = np.hypot(np.maximum(radial, 0.0), np.maximum(height, 0.0)) + np.minimum(np.maximum(radial, height), 0.0)
    return _blend(d, slab - 0.04, 0.02)


def _ellipsoid(p: np.ndarray, centre: tuple, radii: tuple) -> np.ndarray:
    # First-order distance: f / |grad f| of the quadric.
    k0 = np.linalg.norm((p - centre) / radii, axis=1)
    k1 = np.linalg.norm((p - centre) / np.square(radii), axis=1)
    return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


def _capsule(p: np.ndarray, a: tuple, b: tuple, radius_a: float, radius_b: float) -> np.ndarray:
    axis = np.subtract(b, a)
    t = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(p - a - t[:, None] * axis, axis=1) - (radius_a + t * (radius_b - radius_a))


def _blend(d: np.ndarray, e: np.ndarray, width: float) -> np.ndarray:
    # Smooth minimum, quadratic over `width`.
    h = np.maximum(width - np.abs(d - e), 0.0) / width
    return np.minimum(d, e) - 0.25 * width * h * h
