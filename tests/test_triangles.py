"""Rays against triangles: the tree holds every triangle once, and a walk of it finds what float64 finds."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
import trimesh
import warp as wp

from warpgi.camera import Camera
from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels import scene as scene_kernels
from warpgi.kernels.scene import Hit, closest_hit, occluded, offset_origin, surface_at
from warpgi.kernels.triangles import (
    BLOCK_FLOATS,
    MAX_TREE_DEPTH,
    NODE_FLOATS,
    STACK_SIZE,
    WALK,
    WIDTH,
    TriangleTree,
)
from warpgi.scene import Scene, Shape
from warpgi.triangle_tree import build_triangle_tree

wp.set_module_options({"enable_backward": False})

ULP = 2.0**-24
FAR = 1e38


@wp.kernel
def trace(
    scene: scene_kernels.Scene,
    o: wp.array[wp.vec3],
    d: wp.array[wp.vec3],
    distance: wp.array[float],
    faces: wp.array[int],
    hits: wp.array[wp.vec3],
    blocked: wp.array[int],
):
    i = wp.tid()
    h = closest_hit(scene, o[i], d[i])
    faces[i] = h.face
    hits[i] = wp.vec3(h.t, h.u, h.v)
    blocked[i] = int(occluded(scene, o[i], d[i], distance[i]))


@wp.kernel
def leave_surfaces(
    scene: scene_kernels.Scene,
    own: wp.array[int],
    uv: wp.array[wp.vec2],
    d: wp.array[wp.vec3],
    origin: wp.array[wp.vec3],
    met: wp.array[int],
):
    i = wp.tid()
    h = Hit()
    h.face = own[i]
    h.u = uv[i][0]
    h.v = uv[i][1]
    s = surface_at(scene, h, scene.shapes[scene.face_shapes[h.face]])
    o = offset_origin(s.p, s.ng, s.offset, d[i])
    origin[i] = o
    met[i] = closest_hit(scene, o, d[i]).face


class Rays:
    """What the kernels say of rays against triangles, and the arrays that they walk."""

    def __init__(self, points: np.ndarray, faces: np.ndarray) -> None:
        self.points, self.faces = points.astype(np.float32), faces.astype(np.int32)
        self.host = build_triangle_tree(self.points, self.faces)
        self.scene = scene_kernels.Scene()
        tree = TriangleTree()
        self.arrays = {}
        for name, values in self.host.items():
            dtype = float if values.dtype == np.float32 else int
            self.arrays[name] = wp.array(values, dtype=dtype, device="cpu")
            setattr(tree, name, self.arrays[name])
        self.scene.tree = tree

    def trace(self, o: np.ndarray, d: np.ndarray, distance: float | np.ndarray = FAR):
        """Faces, shape (N,); t, u, v, shape (N, 3); whether something is nearer than `distance`, shape (N,)."""
        count = len(o)
        faces, blocked = (wp.zeros(count, dtype=int, device="cpu") for _ in range(2))
        hits = wp.zeros(count, dtype=wp.vec3, device="cpu")
        rays = [wp.array(x.astype(np.float32), dtype=wp.vec3, device="cpu") for x in (o, d)]
        limit = wp.array(np.broadcast_to(np.float32(distance), (count,)).copy(), dtype=float, device="cpu")
        wp.launch(trace, count, inputs=[self.scene, *rays, limit], outputs=[faces, hits, blocked], device="cpu")
        return faces.numpy(), hits.numpy(), blocked.numpy() != 0

    def exact(self, o: np.ndarray, d: np.ndarray):
        """Nearest hit by Moeller and Trumbore in float64 over all triangles, and whether float32 has to agree.

        Rounding may decide otherwise where a ray passes so near to an edge, or along a plane.
        """
        corner = self.points.astype(np.float64)[self.faces]
        e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        n = np.cross(e1, e2)
        size = np.linalg.norm(e1, axis=1) * np.linalg.norm(e2, axis=1)
        faces, hits, sure = [], [], []
        for origin, direction in zip(o.astype(np.float64), d.astype(np.float64), strict=True):
            s = origin - corner[:, 0]
            det = -(n @ direction)
            with np.errstate(divide="ignore", invalid="ignore"):
                m = np.cross(s, direction)
                v = (e2 * m).sum(axis=1) / det
                w = -(e1 * m).sum(axis=1) / det
                t = (n * s).sum(axis=1) / det
                u = 1.0 - v - w
                edge = np.minimum(np.minimum(u, v), w)
            slant = np.abs(det) / (size * np.linalg.norm(direction))
            best = np.where((edge >= 0.0) & (t > 0.0), t, np.inf)
            k = int(np.argmin(best))
            # errors of barycentric coordinates grow with distance over the triangle's size, seen under its slant
            reach = np.abs(s).max(axis=1) / np.sqrt(size)
            unsure = (np.abs(edge) < 64 * ULP * reach / np.maximum(slant, 1e-12)) | (slant < 1e-6)
            unsure &= (t < best[k] * 1.0001) | ~np.isfinite(t)
            second = np.partition(best, 1)[1] if len(best) > 1 else np.inf
            found = np.isfinite(best[k])
            tie = found and second < best[k] * 1.0001
            faces.append(k if found else -1)
            hits.append((t[k], u[k], v[k]) if found else (FAR, 0.0, 0.0))
            sure.append(not unsure.any() and not tie)
        return np.array(faces), np.array(hits), np.array(sure)


def soup(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles in a cube of side 2, smaller the more there are."""
    rng = np.random.default_rng(seed)
    size = 1.5 * count ** (-1 / 3)
    points = rng.uniform(-1, 1, (count, 1, 3)) + rng.uniform(-size, size, (count, 3, 3))
    return points.reshape(-1, 3).astype(np.float32), np.arange(3 * count).reshape(-1, 3)


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def compare(rays: Rays, o: np.ndarray, d: np.ndarray, sure_at_least: float = 0.9) -> int:
    """Asserts that kernel and float64 agree wherever rounding leaves no choice; returns the number of hits."""
    o, d = o.astype(np.float32), d.astype(np.float32)
    faces, hits, sure = rays.exact(o, d)
    found, values, _ = rays.trace(o, d)
    assert sure.mean() > sure_at_least
    assert np.array_equal(found[sure], faces[sure])
    met = sure & (faces >= 0)
    corner = rays.points.astype(np.float64)[rays.faces[faces[met]]]
    n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    slant = np.abs((n / np.linalg.norm(n, axis=1, keepdims=True) * d[met]).sum(axis=1))
    reach = np.abs(corner - o[met].astype(np.float64)[:, None]).max(axis=(1, 2))
    # t: a corner's distance is rounded by reach 2^-24, and turns into t by the cosine; u, v: by the triangle's size
    assert (np.abs(values[met, 0] - hits[met, 0]) < 16 * ULP * reach / slant).all()
    height = np.linalg.norm(n, axis=1) / np.linalg.norm(corner - corner[:, [1, 2, 0]], axis=2).max(axis=1)
    tolerance = 16 * ULP * reach / (height * slant)
    assert (np.abs(values[met, 1:] - hits[met, 1:]) < tolerance[:, None]).all()
    # shadow rays: nothing before the nearest hit, something just behind it
    t = np.where(faces >= 0, hits[:, 0], 1.0)
    margin = 1e-4
    assert not rays.trace(o, d, t * (1.0 - margin))[2][met].any()
    assert rays.trace(o, d, t * (1.0 + margin))[2][met].all()
    free = sure & (faces < 0)
    assert not rays.trace(o, d)[2][free].any()
    return int(met.sum())


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 64, 1000, 20_000])
def test_walk_agrees_with_brute_force(count):
    """Face, t, u, v and occlusion are those of float64 over all triangles, from inside and from outside."""
    rays = Rays(*soup(count))
    rng = np.random.default_rng(count)
    n = 120 if count > 10_000 else 600
    inside = rng.uniform(-1, 1, (n, 3))
    outside = 4.0 * directions(n, rng)
    aim = rng.uniform(-1, 1, (n, 3)) - outside
    away = directions(n // 4, rng)
    o = np.concatenate([inside, outside, 5.0 * away])
    # directions of any length, and rays that leave everything behind
    d = np.concatenate([directions(n, rng), aim, away])
    assert compare(rays, o, d) > (n // 8 if count > 2 else 10)
    assert (rays.trace(5.0 * away, away)[0] == -1).all()


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scale_does_not_matter(scale):
    """A scene that is a million times smaller or larger gives the same hits."""
    points, faces = soup(300)
    rays = Rays(points * np.float32(scale), faces)
    rng = np.random.default_rng(8)
    assert compare(rays, rng.uniform(-1, 1, (400, 3)) * scale, directions(400, rng)) > 100


@pytest.mark.parametrize("shift", [(100.0, -30.0, 0.0), (0.0, 1000.0, 5000.0)])
def test_distance_from_the_origin_does_not_matter(shift):
    """Triangles far from the origin, where their corners are coarse, are hit where those corners say."""
    points, faces = soup(300)
    rays = Rays(points + np.float32(shift), faces)
    rng = np.random.default_rng(9)
    o = rng.uniform(-1, 1, (400, 3)) + shift
    assert compare(rays, o, directions(400, rng)) > 100


def test_axis_parallel_rays():
    """Rays with one or two zero components meet what float64 meets; the sign of a zero changes nothing."""
    rays = Rays(*soup(1000))
    rng = np.random.default_rng(10)
    o = rng.uniform(-1, 1, (720, 3))
    d = directions(720, rng)
    for i in range(720):
        d[i, i % 3] = 0.0
        if i < 360:
            d[i, (i + 1) % 3] = 0.0
    assert compare(rays, o, d) > 300
    plus, minus = rays.trace(o, np.where(d == 0.0, 0.0, d)), rays.trace(o, np.where(d == 0.0, -0.0, d))
    for a, b in zip(plus, minus, strict=True):
        assert np.array_equal(a, b)


def box(cells: int, half: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed box whose six sides are grids of cells x cells squares, corners shared."""
    grid = np.stack(np.meshgrid(*[np.arange(cells + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    quad = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (q.ravel() for q in (quad[:-1, :-1], quad[1:, :-1], quad[1:, 1:], quad[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points, parts = [], []
    for axis in range(3):
        for side in (0, cells):
            parts.append(faces + len(points) * len(grid))
            points.append(np.insert(grid, axis, side, axis=1))
    keys, index = np.unique(np.concatenate(points), axis=0, return_inverse=True)
    return ((2.0 * keys / cells - 1.0) * half).astype(np.float32), index.ravel()[np.concatenate(parts)]


@pytest.mark.parametrize("middle", [0.0, 1.0])
def test_rays_in_the_plane_of_a_side(middle):
    """A ray that runs within a side of a closed box meets the wall where the side ends: flat boxes have an inside.

    With its middle at 1 the box has sides at 0, which no margin relative to a coordinate moves.
    """
    points, faces = box(4)
    rays = Rays(points + np.float32(middle), faces)
    rng = np.random.default_rng(11)
    for axis, side, zero in itertools.product(range(3), (-1.0, 1.0), (0.0, -0.0)):
        o = rng.uniform(-0.9, 0.9, (300, 3))
        d = directions(300, rng)
        o[:, axis], d[:, axis] = side, zero
        d[:100, (axis + 1) % 3] = 0.0
        d[:100, (axis + 2) % 3] = np.sign(d[:100, (axis + 2) % 3])
        o, d = (o + middle).astype(np.float32), d.astype(np.float32)
        found, hits, _ = rays.trace(o, d)
        assert (found >= 0).all()
        end = o.astype(np.float64) + d * hits[:, :1].astype(np.float64) - middle
        others = np.delete(end, axis, axis=1)
        assert np.abs(np.abs(others).max(axis=1) - 1.0).max() < 8 * ULP


def test_watertight_from_afar():
    """None of a million rays from 100 000 times its size away passes through a closed box.

    So far off, rounding moves a box of the tree against its triangles by hundredths, which only the factor of Ize's
    test makes up for: 10 of these rays get through without it.
    """
    count = 1_000_000
    rays = Rays(*box(64))
    rng = np.random.default_rng(16)
    o = directions(count, rng) * np.float32(1e5)
    found, _, blocked = rays.trace(o, rng.uniform(-0.4, 0.4, (count, 3)) - o)
    assert np.count_nonzero(found < 0) == 0
    assert np.count_nonzero(~blocked) == 0


@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_watertight(shape):
    """None of 400 000 rays from inside a closed mesh, aimed at its edges and at its vertices, finds a way out."""
    if shape == "box":
        points, faces = box(16, np.array([1.0, 0.7, 1.3]))
    else:
        sphere = trimesh.creation.icosphere(subdivisions=4)
        points, faces = sphere.vertices.astype(np.float32), sphere.faces
    rays = Rays(points, faces)
    rng = np.random.default_rng(12)
    count = 200_000
    o = (0.5 * rng.uniform(-1, 1, (2 * count, 3)) * np.abs(points).max(axis=0)).astype(np.float32)
    o[: count // 4] = 0.0
    corner = points[faces[rng.integers(len(faces), size=count)]]
    first = rng.integers(3, size=count)
    a, b = corner[np.arange(count), first], corner[np.arange(count), (first + 1) % 3]
    part = np.where(rng.random(count) < 0.5, 0.5, rng.random(count)).astype(np.float32)[:, None]
    target = np.concatenate([a + (b - a) * part, points[rng.integers(len(points), size=count)]])
    d = target - o
    d[::2] /= np.linalg.norm(d[::2], axis=1, keepdims=True)
    found, _, blocked = rays.trace(o, d)
    assert np.count_nonzero(found < 0) == 0
    assert np.count_nonzero(~blocked) == 0


def check_tree(points: np.ndarray, faces: np.ndarray) -> int:
    """Asserts that every triangle lies in the tree once, inside all boxes above it; returns the depth in nodes."""
    tree = build_triangle_tree(points.astype(np.float32), faces.astype(np.int32))
    corners = points.astype(np.float32)[faces]
    nodes = tree["nodes"].reshape(-1, 6, WIDTH)
    children = tree["children"].reshape(-1, WIDTH)
    blocks = tree["blocks"].reshape(-1, 3, 3, WIDTH).transpose(0, 3, 1, 2)  # block, lane, corner, axis
    lanes = tree["faces"].reshape(-1, WIDTH)
    assert nodes.size == len(nodes) * NODE_FLOATS
    assert blocks.size == len(lanes) * BLOCK_FLOATS
    seen = np.zeros(len(faces), int)
    blocks_seen, nodes_seen, depth = np.zeros(len(blocks), int), np.zeros(len(nodes), int), 0
    level = [(0, np.full(3, -np.inf), np.full(3, np.inf))]
    while level:
        depth += 1
        below = []
        for node, low, high in level:
            nodes_seen[node] += 1
            for k in range(WIDTH):
                child_low, child_high = nodes[node, :3, k], nodes[node, 3:, k]
                if child_low[0] > child_high[0]:
                    continue  # an unused child
                low_k, high_k = np.maximum(low, child_low), np.minimum(high, child_high)
                child = children[node, k]
                if child >= 0:
                    below.append((child, low_k, high_k))
                    continue
                blocks_seen[-1 - child] += 1
                used = np.array(
                    [np.array_equal(blocks[-1 - child, j], corners[lanes[-1 - child, j]]) for j in range(WIDTH)]
                )
                assert (blocks[-1 - child][~used] == 0.0).all()
                np.add.at(seen, lanes[-1 - child][used], 1)
                inside = blocks[-1 - child][used]
                assert (inside >= low_k).all()
                assert (inside <= high_k).all()
        level = below
    assert (nodes_seen == 1).all()
    assert (blocks_seen == 1).all()
    assert (seen == 1).all()
    return depth


def nasty(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that make trees deep or leaves full."""
    rng = np.random.default_rng(13)
    corner = rng.normal(size=(3, 3))
    if name == "shrinking":  # one inside the other, down to the smallest float32 that has all its digits
        triangles = corner * (0.97 ** np.arange(2800))[:, None, None]
    elif name == "receding":  # each twice as far as the one before and as large
        triangles = (corner + np.array([3.0, 0.0, 0.0])) * (2.0 ** np.arange(-60, 60))[:, None, None]
    elif name == "copies":
        triangles = np.broadcast_to(corner, (10_000, 3, 3))
    elif name == "concentric":  # centroids coincide, sizes do not
        triangles = (corner - corner.mean(axis=0)) * rng.uniform(0.1, 1.0, (3000, 1, 1))
    elif name == "row":  # all centroids on a line, thickening towards one end
        triangles = 1e-3 * corner + np.stack([1.01 ** -np.arange(3000.0), *np.zeros((2, 3000))], axis=1)[:, None]
    else:  # a fan of slivers that share a corner
        angle = np.linspace(0, 2 * np.pi, 5001)
        rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        triangles = np.stack([np.zeros((5000, 3)), rim[:-1], rim[1:]], axis=1)
    return triangles.reshape(-1, 3).astype(np.float32), np.arange(3 * len(triangles)).reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 64, 1000])
def test_tree_holds_every_triangle_once(count):
    """Every triangle is in one lane of one leaf, within the boxes of all nodes above."""
    assert check_tree(*soup(count)) <= MAX_TREE_DEPTH


@pytest.mark.parametrize("name", ["shrinking", "receding", "copies", "concentric", "row", "fan"])
def test_nasty_trees_are_whole_and_shallow(name):
    """Inputs that unbalance trees keep every triangle once and stay below the depth that the stack serves."""
    assert check_tree(*nasty(name)) <= MAX_TREE_DEPTH


def test_stack_is_as_large_as_the_depth_needs():
    """The native source's sizes are the Python constants, and the deepest tree allowed fits: 7 stay behind a level."""
    sizes = re.findall(r"(?:int stack|float entry)\[(\d+)\]", WALK)
    assert [int(size) for size in sizes] == [STACK_SIZE, STACK_SIZE]
    assert f"current * {NODE_FLOATS}" in WALK
    assert f"block * {BLOCK_FLOATS}" in WALK
    assert (WIDTH - 1) * MAX_TREE_DEPTH + 1 <= STACK_SIZE


def leaving(mesh: str) -> tuple[np.ndarray, np.ndarray]:
    if mesh == "box":
        return box(8)
    if mesh == "sphere":
        sphere = trimesh.creation.icosphere(subdivisions=3)
        return sphere.vertices, sphere.faces
    return soup(2000, seed=14)


@pytest.mark.parametrize("mesh", ["box", "sphere", "soup"])
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 1e4), (1e-3, 1e6)])
def test_next_ray_never_meets_its_own_triangle(mesh, scale, shift):
    """Of 20 000 rays that leave a surface, to either side, none meets the triangle that it left; so on 15 meshes.

    A tenth of them is almost within the surface. Meshes are as large as 1000, as small as 1/1000, and far away.
    """
    points, faces = leaving(mesh)
    points = np.asarray(points, np.float64) * scale + shift * np.array([1.0, -0.7, 0.3])
    camera = Camera(position=(0, 0, 0), target=(0, 0, 1))
    scene = DeviceScene(Scene([Shape(points, faces)], camera), Device("cpu"))
    rng = np.random.default_rng(15)
    count = 20_000
    kept = len(scene.scene.shapes[0].faces)
    own = rng.integers(kept, size=count).astype(np.int32)
    bary = rng.dirichlet((1.0, 1.0, 1.0), count).astype(np.float32)
    bary[:200] = np.eye(3, dtype=np.float32)[rng.integers(3, size=200)]
    d = directions(count, rng).astype(np.float64)
    n = scene.struct.face_normals.numpy()[own].astype(np.float64)
    flat = slice(200, 2000)
    d[flat] -= n[flat] * (d[flat] * n[flat]).sum(axis=1, keepdims=True) * (1.0 - np.logspace(-7, -1, 1800))[:, None]
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    origin = wp.zeros(count, dtype=wp.vec3, device="cpu")
    met = wp.zeros(count, dtype=int, device="cpu")
    inputs = [wp.array(own, dtype=int, device="cpu"), wp.array(bary[:, :2], dtype=wp.vec2, device="cpu")]
    inputs.append(wp.array(d, dtype=wp.vec3, device="cpu"))
    wp.launch(leave_surfaces, count, inputs=[scene.struct, *inputs], outputs=[origin, met], device="cpu")
    assert np.count_nonzero(met.numpy() == own) == 0
    # and it starts on the side to which it goes, by the float32 triangle's own plane
    corner = scene.struct.points.numpy().astype(np.float64)[scene.struct.indices.numpy().reshape(-1, 3)[own]]
    plane = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    plane /= np.linalg.norm(plane, axis=1, keepdims=True)
    height = ((origin.numpy() - corner[:, 0]) * plane).sum(axis=1)
    side = np.sign((d.astype(np.float64) * n.astype(np.float32)).sum(axis=1))
    assert (height * side > 0.0)[np.abs((d * n).sum(axis=1)) > 4 * ULP].all()
