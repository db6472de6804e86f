"""The splat hierarchy against brute force: tree, neighbours, shrinking, and the first apparent surface along a ray."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import warpgi as gi
from warpgi.kernels import light_field as kernels
from warpgi.kernels.splats import SplatTree as SplatTreeStruct
from warpgi.kernels.splats import first_surface, nearest_facing, vec10
from warpgi.reconstruction import NOISE_ULPS
from warpgi.splat_tree import LANES, SHRINK_PASSES, SplatTree, compact_order

wp.set_module_options({"enable_backward": False})

NO_RAYS = np.zeros(0, np.int32)  # none left the scene

STRETCH = 3.0**2 - 1.0  # alpha = 3: |d|^2 + (alpha^2 - 1) (d.n)^2
ALL_SIDES = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]

# Floating point: a few operations on float32 differences; ties closer than the second number are left out.
ROUNDING, TIE = 2e-6, 2e-5
SAME_SIDE = 0.1  # least cosine between the normals of neighbours


@wp.kernel
def look(
    offset: int,
    tree: SplatTreeStruct,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    noise: float,
    reach: float,
    result: wp.array[vec10],
):
    """One thread owns one ray; splats alone, or two, keep 1/2 and 2/3 of their radius, as in section 2.5."""
    i = offset + wp.tid()
    result[i] = first_surface(tree, origins[i], directions[i], noise, reach, 0.25, 4.0 / 9.0)


@wp.kernel
def find_facing(offset: int, tree: SplatTreeStruct, x: wp.vec3, d: wp.vec3, nearest: wp.array[int]):
    nearest[offset + wp.tid()] = nearest_facing(tree, x, d)


class Splats:
    """A tree over given splats, whose radii may be given too, and what rays see of it."""

    def __init__(self, hits, normals, radiance=None, radii=None, device=None):
        self.device = device or gi.Device("cpu")
        self.hits = np.asarray(hits, dtype=np.float32).reshape(-1, 3)
        count = len(self.hits)
        normals = np.broadcast_to(np.asarray(normals, dtype=np.float64), (count, 3))
        self.normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        radiance = np.eye(3)[np.arange(count) % 3] if radiance is None else radiance
        self.radiance = np.broadcast_to(np.asarray(radiance, dtype=np.float32), (count, 3))
        self.noise = NOISE_ULPS * max(float(np.abs(self.hits).max()), 1e-30)
        arrays = [self.device.array(x, wp.vec3) for x in (self.hits, self.normals, self.radiance)]
        self.tree = SplatTree(self.device, *arrays, np.arange(count, dtype=np.int32), self.noise)
        self.order = self.tree.order.numpy()
        if radii is not None:
            self.set_radii(radii)

    def set_radii(self, radii):
        radii = np.broadcast_to(np.asarray(radii, dtype=np.float32), len(self.hits))
        self.tree.set_radius2(self.device.array((radii * radii)[self.order], float))

    def radii(self):
        """In the order of the samples."""
        result = np.empty(len(self.hits), np.float32)
        result[self.order] = self.tree.radii()
        return result

    def rays(self, origins):
        rays = kernels.Rays()
        rays.origins = self.device.array(np.asarray(origins, dtype=np.float32), wp.vec3)
        rays.hits, rays.order = self.device.array(self.hits, wp.vec3), self.tree.order
        return rays

    def look(self, origins, directions, reach=1e30):
        """Radiance, weight, weight within reach, splats, cut gathers, surfaces passed, where all face away,
        distance times weight: (N, 10)."""
        origins = np.asarray(origins, dtype=np.float32).reshape(-1, 3)
        directions = unit(np.asarray(directions, dtype=np.float64).reshape(-1, 3)).astype(np.float32)
        result = self.device.zeros(len(origins), vec10)
        arrays = [self.device.array(x, wp.vec3) for x in (origins, directions)]
        self.device.launch(look, len(origins), [self.tree.struct, *arrays, self.noise, reach], [result])
        return result.numpy().astype(np.float64)

    def see(self, origin, direction):
        """One ray: (mean radiance, splats in the surface, surfaces passed)."""
        (found,) = self.look(origin, direction)
        return found[:3] / max(found[3], 1e-30), int(found[5]), int(found[7])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def surfaces(count, seed=0):
    """Points as scenes have them: walls, a ball, scattered leaves and doubles, with normals of either side."""
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(-1.0, 1.0, (count, 3)), unit(rng.normal(size=(count, 3)))
    kind = rng.integers(0, 4, count)
    for axis in range(3):
        wall = (kind == 0) & (rng.integers(0, 3, count) == axis)
        points[wall, axis] = 1.0
        normals[wall] = -np.eye(3)[axis]
    ball = kind == 1
    points[ball], normals[ball] = 0.4 * normals[ball], normals[ball]
    twice = (kind == 2) & (rng.uniform(size=count) < 0.1)
    points[twice] = points[rng.integers(0, count, twice.sum())]
    return points.astype(np.float32), normals.astype(np.float32)


def walk(splats):
    """Blocks below the root, each with the path of (node, child) that leads there."""
    first, found, stack = splats.tree.struct.first.numpy(), [], [(0, ())]
    while stack:
        node, path = stack.pop()
        low, high = boxes(splats)[0][node], boxes(splats)[1][node]
        for child in range(LANES):
            if (low[:, child] <= high[:, child]).all():
                here = (*path, (node, child))
                if first[node] >= 0:
                    stack.append((int(first[node]) + child, here))
                else:
                    found.append((-1 - int(first[node]) + child, here))
    return found


def boxes(splats):
    nodes = splats.tree.struct.nodes.numpy().reshape(-1, 2, 3, LANES)
    return nodes[:, 0], nodes[:, 1]


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 511, 512, 513, 4097])
def test_tree_holds_every_splat_once_in_boxes_that_contain_its_disc(count):
    """Whatever the count, every block hangs in the tree once, and all boxes above a splat contain its disc."""
    splats = Splats(*surfaces(count))
    assert sorted(splats.order) == list(range(count))
    radii = np.random.default_rng(1).uniform(0.0, 0.3, count).astype(np.float32)
    for size in (radii, 0.1 * radii):  # growing and shrinking alike
        splats.set_radii(size)
        blocks = splats.tree.struct.blocks.numpy().reshape(-1, 10, LANES)
        assert np.count_nonzero(blocks[:, 6] >= 0.0) == count
        found = walk(splats)
        assert sorted(block for block, _ in found) == list(range(-(-count // LANES)))
        assert len({len(path) for _, path in found}) == 1  # all leaves lie on one level
        low, high = boxes(splats)
        for block, path in found:
            lanes = blocks[block, 6] >= 0.0
            centre, n, r2 = blocks[block, 0:3, lanes], blocks[block, 3:6, lanes], blocks[block, 6, lanes]
            # a disc reaches r sqrt(1 - n^2) along an axis
            reach = np.sqrt(r2[:, None].astype(np.float64) * np.maximum(0.0, 1.0 - n.astype(np.float64) ** 2))
            for node, child in path:
                # the margin holds what float32 rounds
                assert (low[node, :, child] <= centre - reach).all()
                assert (high[node, :, child] >= centre + reach).all()
    expected = np.empty((count, 9), np.float32)
    lanes = blocks.transpose(0, 2, 1).reshape(-1, 10)[:count]
    expected[:, 0:3], expected[:, 3:6] = splats.hits[splats.order], splats.normals[splats.order]
    expected[:, 6:9] = splats.radiance[splats.order]
    np.testing.assert_array_equal(lanes[:, [0, 1, 2, 3, 4, 5, 7, 8, 9]], expected)
    np.testing.assert_allclose(lanes[:, 6], size[splats.order] ** 2, rtol=1e-6)


@pytest.mark.parametrize("sorted_above", [None, 1024])
@pytest.mark.parametrize("count", [1, 8, 9, 500, 5000])
def test_order_halves_every_segment_across_its_longest_side(count, sorted_above):
    """Nothing in the first half of a segment lies beyond its second half, in order found by threads or by sorting."""
    points = np.random.default_rng(count).random((count + 3, 3)).astype(np.float32) * np.float32([1.0, 2.0, 0.5])
    points[::3, 0] = 0.25  # many in one plane
    device, chosen = gi.Device("cpu"), np.arange(3, count + 3, dtype=np.int32)
    order = compact_order(device, device.array(points, wp.vec3), chosen, sorted_above).numpy()
    assert sorted(order) == list(chosen)
    size, places = LANES, points[order]
    while size < count:
        size *= 2
        for begin in range(0, count - size // 2, size):
            part = places[begin : begin + size]
            axis = np.argmax(np.ptp(part, axis=0))
            first, second = part[: size // 2, axis], part[size // 2 :, axis]
            # sort keys tell places apart that lie a step from each other
            assert first.max() <= second.min() + (np.ptp(part[:, axis]) * 2.0**-22 if sorted_above else 0.0)


def test_every_input_ray_shrinks_in_one_pass():
    """The passes share the places of the tree out."""
    places = np.concatenate([np.arange(first, 1000, step) for parts in SHRINK_PASSES for first, step in parts])
    assert sorted(places) == list(range(1000))


def test_levels_have_an_eighth_of_the_nodes_below():
    """8 blocks fit under one node, 9 need two and a root, 64 blocks two levels, 65 three."""
    levels = {}
    for count in (8, 64, 65, 512, 513, 4096, 4097):
        tree = Splats(*surfaces(count)).tree
        levels[count] = [size for _, size in tree.levels]
        starts = [start for start, _ in tree.levels]
        assert starts == list(np.cumsum([0, *levels[count][:0:-1]])[::-1])
    assert levels == {
        8: [1],
        64: [1],
        65: [2, 1],
        512: [8, 1],
        513: [9, 2, 1],
        4096: [64, 8, 1],
        4097: [65, 9, 2, 1],
    }


def brute_force_radius2(points, normals, k, which):
    """Squared radii of some samples in float64, and where they are sure: no two candidates about equally near."""
    points, normals = points.astype(np.float64), normals.astype(np.float64)
    radius2, sure = np.empty(len(which)), np.ones(len(which), dtype=bool)
    for row, i in enumerate(which):
        d = points - points[i]
        plain = (d * d).sum(axis=1)
        # neither itself nor a sample at the very same place, nor the other side of something thin
        facing = normals @ normals[i]
        other = (plain > 0.0) & (facing > SAME_SIDE)
        unsure = np.abs(facing - SAME_SIDE).min() < 1e-6
        if not other.any():
            radius2[row] = 0.5 * 0.5 * 3.0  # half of its ray
            continue
        plain = plain[other]
        metric = plain + STRETCH * (d[other] @ normals[i]) ** 2
        order = np.argsort(metric)
        place = min(k - 1, len(order)) - 1
        radius2[row] = plain[order[place]]
        tied = np.abs(metric - metric[order[place]]) < TIE * metric
        sure[row] = np.ptp(plain[tied]) <= TIE * radius2[row] and not unsure
    return radius2, sure


@pytest.mark.parametrize("k", [2, 12, 32])
@pytest.mark.parametrize("count", [*range(2, 21, 3), 1000, 30_000])
def test_radius_is_the_distance_of_the_kth_neighbour(count, k):
    """A splat's radius is the plain distance of the k-th sample, itself counted, in the metric that stretches along n.

    With fewer than k samples the farthest counts; samples at the very same place are no neighbours, nor are those
    that face another way.
    """
    points, normals = surfaces(count, seed=k)
    splats = Splats(points, normals)
    splats.tree.size_by_neighbours(splats.rays(points + 1.0), k, 3.0)
    which = np.random.default_rng(2).permutation(count)[:150]
    expected, sure = brute_force_radius2(points, splats.normals, k, which)
    assert sure.mean() > 0.9
    np.testing.assert_allclose(splats.radii()[which][sure] ** 2, expected[sure], rtol=4 * ROUNDING)
    # the metric matters: in plain distance it is another neighbour for many
    if k == 12 and count == 1000:
        isotropic = Splats(points, normals)
        isotropic.tree.size_by_neighbours(isotropic.rays(points + 1.0), k, 1.0)
        assert (np.abs(isotropic.radii() - splats.radii()) > 1e-3 * splats.radii()).mean() > 0.3


@pytest.mark.parametrize("count", [1, 5, 40, 400])
def test_without_any_neighbour_a_radius_is_half_of_the_ray(count):
    """One sample, or any number in one place, is as large as half of its ray is long, and seen."""
    points = np.broadcast_to(np.float32([0.3, 0.2, 0.1]), (count, 3))
    splats = Splats(points, (0.0, 0.0, 1.0), radiance=(1.0, 2.0, 3.0))
    splats.tree.size_by_neighbours(splats.rays(points + np.float32([0.0, 0.0, 0.5])), 12, 3.0)
    np.testing.assert_allclose(splats.radii(), 0.25, rtol=1e-6)
    (found,) = splats.look((0.35, 0.2, 0.6), (0.0, 0.0, -1.0))
    assert found[3] > 0.0
    np.testing.assert_allclose(found[:3] / found[3], (1.0, 2.0, 3.0), rtol=1e-5)


def crossings(splats, origins, radius2, margin):
    """For every splat the least squared distance at which another's ray crosses it, float64, and whether it is sure."""
    hits, normals = splats.hits.astype(np.float64), splats.normals.astype(np.float64)
    least, sure, total = radius2.copy(), np.ones(len(hits), dtype=bool), 0
    for j, (o, h) in enumerate(zip(np.asarray(origins, dtype=np.float32).astype(np.float64), hits, strict=True)):
        length = np.linalg.norm(h - o)
        d = (h - o) / length
        end = max(margin * length, splats.noise)
        facing = normals @ d
        t = ((hits - o) * normals).sum(axis=1) / facing
        e2 = ((t[:, None] * d - (hits - o)) ** 2).sum(axis=1)
        crossed = (e2 < radius2) & (t > end) & (t < length - end)
        crossed[j] = False
        total += np.count_nonzero(crossed)
        unsure = (np.abs(t - end) < 1e-4) | (np.abs(t - length + end) < 1e-4) | (np.abs(facing) < 3e-3)
        unsure[j] = False
        sure &= ~(unsure & (e2 < 1.1 * radius2))
        least[crossed] = np.minimum(least[crossed], e2[crossed])
    return least, sure, total


@pytest.mark.parametrize("margin", [0.0, 1e-3, 0.1])
def test_shrinking_is_the_least_over_all_crossing_rays(margin):
    """A splat ends as small as the nearest crossing of any input ray, all rays judged by the original radii."""
    points, normals = surfaces(400, seed=3)
    origins = np.random.default_rng(4).uniform(-1.0, 1.0, points.shape).astype(np.float32)
    splats = Splats(points, normals)
    rays = splats.rays(origins)
    splats.tree.size_by_neighbours(rays, 12, 3.0)
    before = splats.radii().astype(np.float64) ** 2
    expected, sure, total = crossings(splats, origins, before, margin)
    assert sure.mean() > 0.6 and (expected < before).mean() > 0.5
    # a hundredth of the crossings may go either way in float32
    assert splats.tree.count_crossed(rays, margin) == pytest.approx(total, rel=0.01)
    splats.tree.shrink(rays, margin, NO_RAYS, 1.0)
    after = splats.radii().astype(np.float64) ** 2
    np.testing.assert_allclose(after[sure], expected[sure], rtol=1e-3, atol=1e-6 * before.mean())


@pytest.mark.parametrize("count", [2, 30, 3000])
def test_no_input_ray_is_occluded_after_shrinking(count):
    """Retracing every input ray crosses splats before shrinking, and finds none after it; no radius has grown."""
    points, normals = surfaces(count, seed=5)
    origins = np.random.default_rng(6).uniform(-1.0, 1.0, points.shape).astype(np.float32)
    if count == 2:
        # the second ray goes through the first splat
        points = np.float32([(0, 0, 0), (0.1, 0, -1)])
        normals, origins = np.float32([(0, 0, 1), (0, 0, 1)]), np.float32([(0, 0, 1), (0.1, 0, 1)])
    splats = Splats(points, normals)
    rays = splats.rays(origins)
    splats.tree.size_by_neighbours(rays, 12, 3.0)
    before = splats.radii()
    assert splats.tree.count_crossed(rays, 1e-3) > 0
    splats.tree.shrink(rays, 1e-3, NO_RAYS, 1.0)
    assert splats.tree.count_crossed(rays, 1e-3) == 0
    assert (splats.radii() <= before).all() and (splats.radii() < before).any()


def test_shrinking_does_not_depend_on_threads():
    """1, 2 and 3 threads, in pieces of any size, give the same bits."""
    points, normals = surfaces(2000, seed=7)
    origins = np.random.default_rng(8).uniform(-1.0, 1.0, points.shape).astype(np.float32)
    results = []
    for device in (gi.Device("cpu", 1), gi.Device("cpu", 2, chunk=13), gi.Device("cpu", 3, chunk=64)):
        splats = Splats(points, normals, device=device)
        rays = splats.rays(origins)
        splats.tree.size_by_neighbours(rays, 12, 3.0)
        splats.tree.shrink(rays, 1e-3, NO_RAYS, 1.0)
        results.append(splats.radii().view("u4"))
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def turned(vectors, sides):
    return np.asarray(vectors, dtype=np.float64)[..., list(sides)]


def both_orders(hits, normals, radiance, radii, origin, direction):
    """What one ray sees with the samples in either order, and with the axes in every cyclic order."""
    hits, normals, radiance = (np.asarray(x, dtype=np.float64) for x in (hits, normals, radiance))
    for order in (slice(None), slice(None, None, -1)):
        for sides in ALL_SIDES:
            splats = Splats(
                turned(hits[order], sides), turned(normals[order], sides), radiance[order], np.asarray(radii)[order]
            )
            yield splats.see(turned(origin, sides), turned(direction, sides))


LEAF, WALL, BEYOND = np.eye(3)


@pytest.mark.parametrize("direction", [(0, 0, -1), (0.3, 0.1, -1), (2, 0, -1)])
def test_a_plane_is_one_surface(direction):
    """Two samples of one plane are mixed by their tents, however obliquely it is seen."""
    hits = np.array([(-0.2, 0.0, 0.0), (0.3, 0.1, 0.0)])
    origin = -2.0 * np.array(direction, dtype=np.float64)
    weights = 1.0 - np.linalg.norm(hits, axis=1)
    for radiance, size, _ in both_orders(hits, [(0, 0, 1)] * 2, [LEAF, WALL], [1.0, 1.0], origin, direction):
        assert size == 2
        np.testing.assert_allclose(radiance[:2], weights / weights.sum(), rtol=1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["convex", "concave"])
@pytest.mark.parametrize("shift", [0.05, -0.05])
def test_a_corner_is_one_surface(side, shift):
    """Two sides that meet at a right angle, seen from without or from within, are one surface."""
    # x = 0 and z = 0 meet along y; the ray comes along the diagonal, a little to one side
    hits = np.array([(0.0, 0.0, -0.3), (-0.3, 0.0, 0.0)]) * side
    normals = [(1, 0, 0), (0, 0, 1)]
    origin, direction = np.array([2.0 + shift, 0.0, 2.0 - shift]), (-1, 0, -1)
    for radiance, size, _ in both_orders(hits, normals, [LEAF, WALL], [0.8, 0.8], origin, direction):
        assert size == 2
        assert radiance[0] > 0.1 and radiance[1] > 0.1


@pytest.mark.parametrize("facing", [1.0, -1.0], ids=["positive", "negative"])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.2, -0.1), (-0.3, 0.2)])
@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_a_leaf_before_a_wall_is_a_surface_of_its_own(facing, offset, tilt):
    """The event line meets the st plane in the positive, or the negative, half-spaces of both: the leaf alone answers.

    The seed has the positive ones only; its authors added the negative ones in an erratum.
    """
    hits = np.array([(*offset, 1.0), (0.1, 0.0, 0.0)])
    normals = np.array([(tilt, 0.0, 1.0), (0.0, tilt, 1.0)]) * facing
    origin, direction = np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, -1.0])
    # where the line is at the height of the ray's origin
    s = (hits[0] - origin) @ direction / ((hits[0] - hits[1]) @ direction)
    x = hits[0] + s * (hits[1] - hits[0])
    assert (np.sign(((x - hits) * normals).sum(axis=1)) == facing).all()
    for radiance, size, passed in both_orders(hits, normals, [LEAF, WALL], [0.8, 0.8], origin, direction):
        assert size == 1 and passed == 0
        np.testing.assert_array_equal(radiance, LEAF)


@pytest.mark.parametrize("gap", [1.0, 0.81, 0.79, 0.001])
@pytest.mark.parametrize("offset", [0.0, 0.39, 0.41, 0.7])
@pytest.mark.parametrize("order", ["back first", "front first"])
def test_what_is_seen_from_behind_hides_what_lies_beyond(gap, offset, order):
    """Opposite sides are one thin surface while nearer than the smaller radius, and two surfaces beyond; also where the
    back is met in the outer half of its radius, as the splats on the far side of a box are that jut out over its edges.

    As half-spaces of opposite normals hold no event together, the printed test would let all light through a back.
    """
    sides = [(0, 0, -1), (0, 0, 1)] if order == "back first" else [(0, 0, 1), (0, 0, -1)]
    front = sides.index((0, 0, 1))
    for radii in ([0.8, 0.8], [0.8, 2.0], [2.0, 0.8]):
        args = [(0, 0, gap), (0, 0, 0)], sides, [LEAF, WALL], radii, (0, offset, 4), (0, 0, -1)
        hides = gap > 0.8 and offset < 0.5 * radii[1 - front]
        if hides and offset > 0.5 * radii[0]:
            continue  # alone in the first surface, it would be passed through
        for radiance, size, _ in both_orders(*args):
            assert size == (1 if hides else 2)
            np.testing.assert_allclose(radiance, LEAF if hides else (LEAF, WALL)[front], atol=1e-6)


def test_back_faces_give_radiance_only_among_themselves():
    """In one surface front-facing splats alone give radiance; where all face back, all do."""
    hits, up, down = [(-0.1, 0, 0), (0.1, 0, 0)], (0, 0, 1), (0, 0, -1)
    for normals, expected in (
        ([up, down], LEAF),
        ([down, up], WALL),
        ([down, down], 0.5 * (LEAF + WALL)),
        ([up, up], 0.5 * (LEAF + WALL)),
    ):
        for radiance, size, _ in both_orders(hits, normals, [LEAF, WALL], [0.8, 0.8], (0, 0, 3), (0, 0, -1)):
            assert size == 2
            np.testing.assert_allclose(radiance, expected, rtol=1e-5)


def test_a_surface_that_faces_away_is_known_by_its_distance():
    """The distance of the nearest splat where all face away, 0 where one does not; the facing one nearest is found."""
    hits = [(0, 0, 0), (0.1, 0, -0.2), (0, 5, 0), (0, -3, 0), (0, 0.5, 0)]
    up, down = (0, 0, 1), (0, 0, -1)
    o, d = np.float32((0, 0, 3)), np.float32((0, 0, -1))
    away = Splats(hits, [down, down, up, up, down], radii=0.8)
    (found,) = away.look(o, d)
    assert found[8] == pytest.approx(3.0)
    nearest = away.device.zeros(1, int)
    away.device.launch(
        find_facing, 1, [away.tree.struct, wp.vec3(*(o + found[8] * d).tolist()), wp.vec3(*d)], [nearest]
    )
    assert away.order[nearest.numpy()[0]] == 3
    (found,) = Splats(hits, [down, up, up, up, down], radii=0.8).look(o, d)
    assert found[8] == 0.0


@pytest.mark.parametrize("height", [1.0, 0.1, 0.01])
def test_the_receivers_own_surface_is_not_met(height):
    """Rays that start in a splat's plane pass it, at any angle; those from above meet it."""
    splats = Splats([(0, 0, 0), (0, 0, -1)], (0, 0, 1), [LEAF, WALL], [1.0, 4.0])
    for x in (0.0, 0.3):
        np.testing.assert_array_equal(splats.see((x, 0, 0), (0.5, 0, -1))[0], WALL)
        np.testing.assert_array_equal(splats.see((x, 0, height), (-x, 0, -height))[0], LEAF)


@pytest.mark.parametrize(("count", "share"), [(1, 1 / 2), (2, 2 / 3)])
def test_surfaces_of_one_and_two_samples_are_smaller_before_others(count, share):
    """Section 2.5: one-sample surfaces count to 1/2 of their radius, two-sample ones to 2/3, unless nothing follows."""
    turn = np.linspace(0.0, 2.0, count)
    ring = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    for part, kept in ((share - 0.01, True), (share + 0.01, False), (0.97, False)):
        leaf = 0.5 * part * ring + (0.0, 0.0, 1.0)
        wall = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)]
        radii = [0.5] * count + [2.0] * 3
        hits, normals = np.concatenate([leaf, wall]), [(0, 0, 1)] * (count + 3)
        seen = [LEAF] * count + [WALL] * 3
        for radiance, size, passed in both_orders(hits, normals, seen, radii, (0, 0, 3), (0, 0, -1)):
            np.testing.assert_allclose(radiance, LEAF if kept else WALL, rtol=1e-5)
            assert passed == (0 if kept else 1) and size == (count if kept else 3)
        args = (hits[:count], normals[:count], seen[:count], radii[:count], (0, 0, 3), (0, 0, -1))
        for radiance, size, passed in both_orders(*args):
            np.testing.assert_allclose(radiance, LEAF, rtol=1e-5)
            assert passed == 0 and size == count
    # three samples are enough
    hits = np.array([(0.48, 0, 1), (0, 0.48, 1), (-0.48, 0, 1), (0, 0, 0)])
    seen, radii = [LEAF] * 3 + [WALL], [0.5] * 3 + [2.0]
    for radiance, size, _ in both_orders(hits, [(0, 0, 1)] * 4, seen, radii, (0, 0, 3), (0, 0, -1)):
        np.testing.assert_allclose(radiance, LEAF, rtol=1e-5)
        assert size == 3


def test_leaf_behind_leaf_is_passed_until_something_holds():
    """Several undersampled leaves in a row are all passed through, and the wall answers."""
    heights = np.arange(1.0, 9.0)
    hits = [(0.4, 0.0, z) for z in heights] + [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)]
    splats = Splats(hits, (0, 0, 1), [LEAF] * 8 + [WALL] * 3, [0.5] * 8 + [2.0] * 3)
    radiance, size, passed = splats.see((0, 0, 12), (0, 0, -1))
    np.testing.assert_allclose(radiance, WALL, rtol=1e-5)
    assert (size, passed) == (3, 8)


@pytest.mark.parametrize("count", [64, 65, 100, 1000])
@pytest.mark.parametrize("layout", ["plane", "tilted", "bowl", "sheets"])
def test_any_number_of_overlapping_splats_is_handled(count, layout):
    """More splats than a gather holds: the ray still meets a surface, of one colour here, or says that it was cut.

    In "sheets" all but three of the splats lie behind, and nothing need be cut.
    """
    rng = np.random.default_rng(9)
    hits, normals = np.zeros((count, 3)), np.tile((0.0, 0.0, 1.0), (count, 1))
    hits[:, :2] = rng.uniform(-0.3, 0.3, (count, 2))
    radiance = np.tile(WALL, (count, 1))
    direction = np.array([0.0, 0.0, -1.0])
    if layout == "tilted":
        direction = np.array([0.3, 0.2, -1.0])
    elif layout == "bowl":
        hits[:, 2] = 5.0 - np.sqrt(25.0 - (hits[:, :2] ** 2).sum(axis=1))
        normals = (0.0, 0.0, 5.0) - hits
    elif layout == "sheets":
        hits[:, 2] = -1.0
        hits[-3:, 2], radiance[-3:] = 0.0, LEAF
    splats = Splats(hits, normals, radiance, 1.0)
    (found,) = splats.look(-2.0 * direction, direction)
    assert np.isfinite(found).all() and found[3] > 0.0
    np.testing.assert_allclose(found[:3] / found[3], LEAF if layout == "sheets" else WALL, rtol=1e-5)
    assert (found[6] > 0) == (count > 64 and layout != "sheets")
    assert found[5] == (3 if layout == "sheets" else count) or found[6] > 0


def reference_surface(splats, radii, o, d):
    """Sections 2.3.2 to 2.5 in float64, as they are written; None where some decision is too close to call."""
    hits, normals = splats.hits.astype(np.float64), splats.normals.astype(np.float64)
    r2 = radii.astype(np.float64) ** 2
    to = hits - o
    plane, facing, along = (to * normals).sum(axis=1), normals @ d, to @ d
    t = plane / facing
    e2 = ((t[:, None] * d - to) ** 2).sum(axis=1)
    own = plane**2 <= 1e-6 * r2 + splats.noise**2
    bent = (facing > 0.0) & (along * np.abs(along) < r2)
    met = np.flatnonzero((e2 < r2) & (t > 0.0) & ~own & ~bent)
    near = np.flatnonzero((e2 < 1.02 * r2) & (t > -0.01))
    close = (np.abs(e2 / r2 - 1.0) < 1e-3) | (np.abs(facing) < 0.01) | (np.abs(t) < 1e-3)
    close |= (np.abs(np.abs(along) - radii) < 1e-3) | (np.abs(plane**2 - 1e-6 * r2) < 1e-6 * r2)
    if close[near].any():
        return None
    met = list(met[np.argsort(t[met])])
    passed = 0
    while met:
        surface, rest = [], []
        for i in met:
            for j in surface:
                step = hits[i] - hits[j]
                a, b = step @ normals[j], step @ normals[i]
                slack = np.sqrt(1e-4 * step @ step + 16.0 * splats.noise**2)
                facing_alike = (facing[i] < 0.0) == (facing[j] < 0.0)
                if not facing_alike:
                    slack = max(slack, min(float(radii[i]), float(radii[j])))
                    back = i if facing[i] > 0.0 else j
                    if abs(e2[back] / r2[back] - 0.25) < 1e-3:
                        return None
                    if e2[back] > 0.25 * r2[back]:
                        continue
                for value in (a, b):
                    if abs(abs(value) - slack) < 1e-3 * slack:
                        return None
                if abs(a) > slack and abs(b) > slack:
                    x = hits[j] + along[j] / (along[j] - along[i]) * step
                    # seen from behind a splat shows the other side of its plane
                    towards = normals[[i, j]] * -np.sign(facing[[i, j]])[:, None]
                    sides = (x - hits[[i, j]]) * towards
                    if np.prod(sides.sum(axis=1)) > 0.0:
                        rest = met[len(surface) :]
                        if min(abs(t[rest[0]] - t[surface])) < 1e-5:
                            return None  # which of two crossings in one place comes first
                        break
            if rest:
                break
            surface.append(i)
        part = np.sqrt((e2[surface] / r2[surface]).min())
        if rest and len(surface) <= 2 and part > (0.5 if len(surface) == 1 else 2 / 3):
            met, passed = rest, passed + 1
            continue
        front = [i for i in surface if facing[i] < 0.0] or surface
        w = 1.0 - np.sqrt(e2[front] / r2[front])
        return w @ splats.radiance[front].astype(np.float64), w.sum(), len(surface), passed
    return np.zeros(3), 0.0, 0, passed


@pytest.mark.parametrize("size", [0.1, 0.3])
def test_gathering_agrees_with_a_reference(size):
    """On random surfaces every ray sees what the algorithm written down in float64 says, undersampling included."""
    points, normals = surfaces(600, seed=11)
    rng = np.random.default_rng(12)
    radii = (size * rng.uniform(0.3, 1.0, len(points))).astype(np.float32)
    splats = Splats(points, normals, rng.uniform(0.0, 5.0, points.shape), radii)
    origins = rng.uniform(-0.95, 0.95, (900, 3)).astype(np.float32)
    directions = unit(rng.normal(size=(900, 3))).astype(np.float32)
    found = splats.look(origins, directions)
    sure = several = skipped = 0
    for ray, o, d in zip(found, origins.astype(np.float64), directions.astype(np.float64), strict=True):
        expected = reference_surface(splats, radii, o, d)
        if expected is None:
            continue
        sure += 1
        several += expected[2] > 1
        skipped += expected[3] > 0
        assert (int(ray[5]), int(ray[7])) == expected[2:]
        # weights near 0 lose digits in 1 - d/r
        np.testing.assert_allclose(ray[:3], expected[0], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(ray[3], expected[1], rtol=1e-4, atol=1e-5)
    assert sure > 250 and several > 40 and skipped > 5


def test_order_of_samples_does_not_matter():
    """Samples in another order are another tree, yet rays see the same beyond float rounding."""
    points, normals = surfaces(2000, seed=13)
    rng = np.random.default_rng(14)
    origins, radiance = rng.uniform(-1.0, 1.0, points.shape), rng.uniform(0.0, 5.0, points.shape)
    eyes, directions = rng.uniform(-0.95, 0.95, (4000, 3)), rng.normal(size=(4000, 3))
    results, sizes = [], []
    for order in (np.arange(len(points)), rng.permutation(len(points))):
        splats = Splats(points[order], normals[order], radiance[order])
        rays = splats.rays(origins[order])
        splats.tree.size_by_neighbours(rays, 12, 3.0)
        splats.tree.shrink(rays, 1e-3, NO_RAYS, 1.0)
        results.append(splats.look(eyes, directions))
        sizes.append(splats.radii()[np.argsort(order)])
    np.testing.assert_array_equal(sizes[0], sizes[1])  # a least value has no order
    counts, sums = [5, 6, 7, 8], [0, 1, 2, 3, 4, 9]  # sums are added up in another order
    np.testing.assert_array_equal(results[0][:, counts], results[1][:, counts])
    np.testing.assert_allclose(results[0][:, sums], results[1][:, sums], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (0, -1, 1)])
def test_axis_parallel_rays_meet_flat_boxes(direction):
    """Rays along axes meet splats whose boxes have no thickness, also where they run in a side of the box."""
    d = unit(np.array(direction, dtype=np.float64))
    rng = np.random.default_rng(15)
    normal = -np.eye(3)[np.argmax(np.abs(d))] * np.sign(d[np.argmax(np.abs(d))])
    hits = rng.uniform(-1.0, 1.0, (200, 3)) * (normal == 0.0)
    splats = Splats(hits, normal, radii=0.2)
    # aimed at the centres
    found = splats.look(splats.hits - 3.0 * d, np.broadcast_to(d, (200, 3)))
    assert (found[:, 5] >= 1).all()
