"""Triangle meshes of simple solids; every one comes with shading normals and with texture coordinates in metres."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh

from warpgi.materials import Emissive, Material
from warpgi.scene import Shape


class Mesh(NamedTuple):
    """Arrays of a triangle mesh; faces are counter-clockwise seen from the normals' side."""

    vertices: np.ndarray
    """Positions [m], shape (V, 3)."""
    faces: np.ndarray
    """Vertex indices, shape (F, 3)."""
    normals: np.ndarray
    """Unit shading normals, shape (V, 3)."""
    uv: np.ndarray
    """Texture coordinates, shape (V, 2)."""

    def shape(
        self, material: Material, name: str = "shape", emission: Emissive | None = None, smooth: bool = True
    ) -> Shape:
        """A `Shape` of these triangles; without `smooth` it has no shading normals."""
        normals = self.normals if smooth else None
        return Shape(self.vertices, self.faces, material, emission, normals=normals, uv=self.uv, name=name)

    def move(self, offset: Any) -> Mesh:
        """The mesh, moved by `offset`."""
        return self._replace(vertices=self.vertices + np.asarray(offset, dtype=np.float64))

    def turn(self, angle: float) -> Mesh:
        """The mesh, turned about the y axis by `angle` radians, counter-clockwise seen from above."""
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return self._replace(vertices=self.vertices @ matrix.T, normals=self.normals @ matrix.T)

    def flip(self) -> Mesh:
        """The mesh, facing the other way."""
        return self._replace(faces=self.faces[:, ::-1].copy(), normals=-self.normals)

    def paint(self, scale: float = 1.0, offset: Sequence[float] = (0.0, 0.0)) -> Mesh:
        """The mesh with uv times `scale` plus `offset`; scale 0 gives all of it the colour of one texel."""
        return self._replace(uv=self.uv * scale + np.asarray(offset))


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several."""
    parts = list(meshes)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uv for part in parts]),
    )


def scatter(mesh: Mesh, offsets: np.ndarray, uv: np.ndarray | None = None) -> Mesh:
    """A copy of `mesh` at every offset, shape (N, 3); with `uv`, shape (N, 2), each copy has one texture coordinate."""
    count, size = len(offsets), len(mesh.vertices)
    faces = (np.arange(count)[:, None, None] * size + mesh.faces).reshape(-1, 3)
    vertices = (np.asarray(offsets, dtype=np.float64)[:, None] + mesh.vertices).reshape(-1, 3)
    coordinates = np.tile(mesh.uv, (count, 1)) if uv is None else np.repeat(uv, size, axis=0)
    return Mesh(vertices, faces, np.tile(mesh.normals, (count, 1)), coordinates)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Shading normals of a welded mesh: the mean over the faces about a vertex, weighted by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], np.cross(b - a, c - a))
    return normalize(normals)


def normalize(v: np.ndarray) -> np.ndarray:
    """Vectors at unit length; zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0.0, length, 1.0)


def quad(corner: Any, edge_u: Any, edge_v: Any) -> Mesh:
    """A parallelogram that faces edge_u x edge_v."""
    corner, edge_u, edge_v = (np.asarray(a, dtype=np.float64) for a in (corner, edge_u, edge_v))
    vertices = corner + np.array([np.zeros(3), edge_u, edge_u + edge_v, edge_v])
    normals = np.tile(normalize(np.cross(edge_u, edge_v)), (4, 1))
    width, height = np.linalg.norm(edge_u), np.linalg.norm(edge_v)
    uv = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), normals, uv)


def quads(corners: np.ndarray) -> Mesh:
    """Many quads at once from their corners in counter-clockwise order, shape (N, 4, 3); uv is 0."""
    n = len(corners)
    normals = normalize(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]))
    faces = (np.arange(n)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), faces, np.repeat(normals, 4, axis=0), np.zeros((4 * n, 2)))


def box(low: Any, high: Any, inward: bool = False, skip: str = "") -> Mesh:
    """An axis-parallel box.

    Args:
        low, high: two opposite corners, low below high in every coordinate.
        inward: faces look into the box, as a room's do.
        skip: sides that are left out, as in "-y +z".
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    x, y, z = np.diag(high - low)
    sides = {
        "-x": quad(low, z, y),
        "+x": quad(low + x + z, -z, y),
        "-y": quad(low, x, z),
        "+y": quad(low + y + z, x, -z),
        "-z": quad(low + x, -x, y),
        "+z": quad(low + z, x, y),
    }
    kept = merge(side for name, side in sides.items() if name not in skip.split())
    return kept.flip() if inward else kept


def prism(polygon: Any, low: float, high: float) -> Mesh:
    """An upright prism without a bottom.

    Args:
        polygon: (x, z) of a convex base's corners, counter-clockwise seen from above, shape (N, 2).
        low, high: heights of base and top [m].
    """
    polygon = np.asarray(polygon, dtype=np.float64)
    base = np.insert(polygon, 1, low, axis=1)
    lift = np.array([0.0, high - low, 0.0])
    sides = [quad(a, b - a, lift) for a, b in zip(base, np.roll(base, -1, axis=0), strict=True)]
    count = len(polygon)
    fan = np.stack([np.zeros(count - 2), np.arange(1, count - 1), np.arange(2, count)], axis=1).astype(int)
    top = Mesh(base + lift, fan, np.tile([0.0, 1.0, 0.0], (count, 1)), polygon.copy())
    return merge([*sides, top])


def grid(points: np.ndarray, wrap_u: bool = False, wrap_v: bool = False) -> Mesh:
    """A surface through points, shape (M, N, 3), that faces d/du x d/dv, u along the first axis, v along the second.

    Args:
        points: positions; a row may shrink to one point, as at the pole of a sphere.
        wrap_u, wrap_v: the last row (column) is the first one again, so normals go across the seam.
    """
    m, n, _ = points.shape
    du, dv = _slope(points, 0, wrap_u), _slope(points, 1, wrap_v)
    normals = np.cross(du, dv)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = normals / np.where(length > 0.0, length, 1.0)
    for row, neighbour in ((0, 1), (-1, -2)):  # poles: the slope along the row is 0
        if np.ptp(points[row], axis=0).max() < 1e-12:
            normals[row] = normalize(normals[neighbour].mean(axis=0))
    along_u = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=2).max(axis=1).cumsum()
    along_v = np.linalg.norm(np.diff(points, axis=1, prepend=points[:, :1]), axis=2).max(axis=0).cumsum()
    uv = np.stack(np.meshgrid(along_u, along_v, indexing="ij"), axis=2)
    i = np.arange(m * n).reshape(m, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1).reshape(-1, 3)
    flat = points.reshape(-1, 3)
    corner = flat[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    longest = np.square(corner - corner[:, [1, 2, 0]]).sum(axis=2).max(axis=1)
    return Mesh(flat, faces[area > 1e-9 * longest], normals.reshape(-1, 3), uv.reshape(-1, 2))


def _slope(points: np.ndarray, axis: int, wrap: bool) -> np.ndarray:
    slope = np.gradient(points, axis=axis)
    if wrap:
        p = np.moveaxis(points, axis, 0)
        np.moveaxis(slope, axis, 0)[[0, -1]] = 0.5 * (p[1] - p[-2])
    return slope


def revolution(profile: Any, segments: int = 32) -> Mesh:
    """The surface of revolution about the y axis of a curve.

    Args:
        profile: (radius, y) along the curve, shape (N, 2); going up with the solid at its inner side it faces outward.
        segments: corners of the polygon that stands for the circle.
    """
    profile = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    c, s = np.cos(angle), np.sin(angle)
    c[-1], s[-1] = c[0], s[0]  # the seam closes to the last bit
    r, y = profile[:, 0, None], profile[:, 1, None]
    return grid(np.stack([r * c, np.broadcast_to(y, (len(profile), segments + 1)), r * s], axis=2), wrap_v=True)


def lathe(profile: Any, segments: int = 32) -> Mesh:
    """As `revolution`, with a crease at every point of the profile."""
    profile = np.asarray(profile, dtype=np.float64)
    return merge(revolution(profile[i : i + 2], segments) for i in range(len(profile) - 1))


def disc(radius: float, segments: int = 32) -> Mesh:
    """A disc in the plane y = 0 that faces up."""
    mesh = revolution([(radius, 0.0), (0.0, 0.0)], segments)
    return mesh._replace(normals=np.tile([0.0, 1.0, 0.0], (len(mesh.vertices), 1)), uv=mesh.vertices[:, [0, 2]])


def torus(radius: float, thickness: float, segments: int = 64, sides: int = 24) -> Mesh:
    """A torus about the y axis; `thickness` is the radius of its tube."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    profile = np.stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)], axis=1)
    profile[-1] = profile[0]
    mesh = revolution(profile, segments)
    v = mesh.vertices - radius * normalize(mesh.vertices * [1.0, 0.0, 1.0])
    return mesh._replace(normals=normalize(v))


def icosphere(radius: float, subdivisions: int = 4) -> Mesh:
    """A sphere about the origin of 20 * 4^subdivisions triangles."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    normals = normalize(np.asarray(sphere.vertices, dtype=np.float64))
    uv = np.stack([np.arctan2(normals[:, 2], normals[:, 0]), np.arcsin(np.clip(normals[:, 1], -1.0, 1.0))], axis=1)
    return Mesh(normals * radius, np.asarray(sphere.faces, dtype=np.int64), normals, uv * radius)


def tubes(paths: np.ndarray, radii: np.ndarray, sides: int = 6) -> Mesh:
    """Round tubes along curves: stems, twigs, trunks.

    Args:
        paths: points of each curve [m], shape (S, N, 3), N at least 2.
        radii: radius at each point, shape (S, N), above 0.
        sides: corners of the cross-section.
    """
    count, n, _ = paths.shape
    tangent = normalize(np.gradient(paths, axis=1))
    # One reference per curve: the axis its mean tangent is furthest from, so that it never runs along the curve.
    axis = np.eye(3)[np.abs(tangent.mean(axis=1)).argmin(axis=1)][:, None, :]
    side = normalize(axis - (axis * tangent).sum(axis=2, keepdims=True) * tangent)
    other = np.cross(tangent, side)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    around = np.cos(angle)[:, None] * side[:, :, None] + np.sin(angle)[:, None] * other[:, :, None]
    vertices = paths[:, :, None] + radii[:, :, None, None] * around
    ring = np.arange(n - 1)[:, None] * sides
    a, b = ring + np.arange(sides), ring + (np.arange(sides) + 1) % sides
    one = np.stack([a, b, b + sides, a, b + sides, a + sides], axis=2).reshape(-1, 3)
    faces = (np.arange(count)[:, None, None] * (n * sides) + one).reshape(-1, 3)
    # u runs half-way round and back, so that there is no seam; v is the length along the curve.
    u = np.pi * radii[:, :, None] * np.abs(2.0 * np.arange(sides) / sides - 1.0)
    v = np.linalg.norm(np.diff(paths, axis=1, prepend=paths[:, :1]), axis=2).cumsum(axis=1)
    uv = np.stack([u, np.broadcast_to(v[:, :, None], u.shape)], axis=3).reshape(-1, 2)
    return Mesh(vertices.reshape(-1, 3), faces, around.reshape(-1, 3), uv)
