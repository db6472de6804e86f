"""Plants: curved stems as thin tubes, and leaves that are one folded quad each."""

from __future__ import annotations

import numpy as np

from warpgi.scenes.primitives import Mesh, merge, normalize, quads, tubes
from warpgi.scenes.textures import texel

UP = np.array([0.0, 1.0, 0.0])


def leaves(rng: np.random.Generator, base: np.ndarray, along: np.ndarray, length: float, width: float = 0.45) -> Mesh:
    """Rhombic leaves, folded along the midrib, each with the colour of one texel of a palette.

    Args:
        base: where they grow [m], shape (N, 3).
        along: from base to tip, shape (N, 3), any length but 0.
        length: mean length [m]; every leaf differs by up to a third.
        width: over length.
    """
    count = len(base)
    along = normalize(along)
    side = normalize(np.cross(along, UP + 0.8 * rng.standard_normal((count, 3))))
    face = np.cross(side, along)
    size = length * rng.uniform(0.67, 1.33, (count, 1))
    middle, wing = base + 0.45 * size * along, 0.5 * width * size * side
    lift = 0.12 * size * face
    corners = np.stack([base, middle + wing + lift, base + size * along, middle - wing + lift], axis=1)
    mesh = quads(corners)
    return mesh._replace(uv=np.repeat(texel(rng, count), 4, axis=0))


def branches(
    rng: np.random.Generator, parents: np.ndarray, count: int, length: float, spread: float, rise: float, points: int
) -> np.ndarray:
    """Curves that leave random places of the outer parts of `parents`.

    Args:
        parents: curves, shape (P, M, 3).
        count: how many.
        length: mean length [m].
        spread: how far they turn away from the parent's direction, 1 is 45 degrees.
        rise: pull upwards along their way, as a part of the length; below 0 they hang.
        points: on each curve.

    Returns:
        Shape (count, points, 3).
    """
    which = np.arange(count) % len(parents)
    last = parents.shape[1] - 1
    t = rng.uniform(0.35, 1.0, count) * last
    i = np.minimum(t.astype(int), last - 1)
    start, end = parents[which, i], parents[which, i + 1]
    base = start + (t - i)[:, None] * (end - start)
    tangent = normalize(end - start)
    away = rng.standard_normal((count, 3))
    away = normalize(away - (away * tangent).sum(axis=1, keepdims=True) * tangent)
    direction = normalize(tangent + spread * away)
    size = length * rng.uniform(0.7, 1.3, (count, 1))
    s = np.linspace(0.0, 1.0, points)[:, None]
    bend = rise * UP + 0.15 * rng.standard_normal((count, 3))
    return base[:, None] + size[:, None] * (s * direction[:, None] + s**2 * bend[:, None])


def tapered(curves: np.ndarray, thick: float, thin: float, sides: int) -> Mesh:
    """Tubes along curves from radius `thick` to `thin` [m]."""
    count, points, _ = curves.shape
    return tubes(curves, np.broadcast_to(np.linspace(thick, thin, points), (count, points)), sides)


def tree(rng: np.random.Generator, detail: float, height: float = 6.0) -> tuple[Mesh, Mesh]:
    """A tree that stands at the origin.

    Args:
        detail: scales the number of twigs and leaves; 1 is about 130 000 triangles. Fewer leaves are larger, so the
            crown keeps its density.
        height: about that of the crown's top [m].

    Returns:
        Wood and leaves.
    """
    scale = height / 6.0
    s = np.linspace(0.0, 1.0, 9)
    sway = 0.22 * np.sin(2.6 * s) - 0.1 * s
    trunk = scale * np.stack([sway, 2.6 * s, 0.16 * np.sin(4.0 * s)], axis=1)[None]
    limbs = branches(rng, trunk[:, 5:], 8, 2.0 * scale, 1.0, 0.35, 8)
    boughs = branches(rng, limbs, 56, 1.15 * scale, 0.9, 0.15, 7)
    shoots = branches(rng, boughs, max(60, int(336 * min(detail, 1.0))), 0.7 * scale, 0.9, 0.0, 6)
    twigs = branches(rng, shoots, max(80, int(1100 * detail)), 0.42 * scale, 0.9, -0.12, 5)
    wood = [
        tapered(trunk, 0.17 * scale, 0.10 * scale, 14),
        tapered(limbs, 0.085 * scale, 0.035 * scale, 9),
        tapered(boughs, 0.032 * scale, 0.014 * scale, 6),
        tapered(shoots, 0.013 * scale, 0.006 * scale, 4),
        tapered(twigs, 0.0055 * scale, 0.002 * scale, 3),
    ]
    count = max(400, int(44000 * detail))
    base, along = scattered(rng, twigs, count)
    return merge(wood), leaves(rng, base, along, 0.12 * scale * leaf_scale(detail))


def leaf_scale(detail: float) -> float:
    """Leaves grow as they get fewer, up to 4 times, so that a plant covers about as much at any detail."""
    return min(4.0, detail**-0.5)


def scattered(rng: np.random.Generator, curves: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places on curves and outward directions there, (count, 3) each; the thick ends stay bare."""
    which = rng.integers(0, len(curves), count)
    last = curves.shape[1] - 1
    t = rng.uniform(0.25, 1.0, count) * last
    i = np.minimum(t.astype(int), last - 1)
    start, end = curves[which, i], curves[which, i + 1]
    base = start + (t - i)[:, None] * (end - start)
    along = normalize(end - start) + 0.9 * rng.standard_normal((count, 3)) - 0.25 * UP
    return base, along


def potted(rng: np.random.Generator, detail: float, height: float, spread: float) -> tuple[Mesh, Mesh]:
    """A bushy plant that stands at the origin: stems that bow outwards, and their leaves.

    Args:
        detail: scales the number of leaves; 1 is about 700.
        height: of the stems [m].
        spread: how far their tips lean out [m].
    """
    count = max(10, int(30 * min(detail, 1.0)))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    out = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    root = out * rng.uniform(0.0, 0.08, (count, 1))
    size = height * rng.uniform(0.6, 1.1, (count, 1))
    lean = spread * rng.uniform(0.3, 1.2, (count, 1))
    s = np.linspace(0.0, 1.0, 8)[:, None]
    curves = root[:, None] + s * size[:, None] * UP + s**2 * (lean[:, None] * out[:, None] - 0.25 * size[:, None] * UP)
    base, along = scattered(rng, curves, max(24, int(700 * detail)))
    return tapered(curves, 0.007, 0.002, 4), leaves(rng, base, along, 0.15 * min(2.5, leaf_scale(detail)), 0.4)


def vine(rng: np.random.Generator, root: np.ndarray, length: float, detail: float, leaf: float = 0.11):
    """A creeper on a wall that faces +z: woody curves that climb from `root`, and leaves about them.

    Args:
        root: where it leaves the ground or a pot [m].
        length: how far it climbs [m].
        detail: scales the number of leaves; 1 is about 4 500.
        leaf: length of a leaf [m].
    """
    count, points = max(6, int(26 * min(detail, 1.0))), 14
    s = np.linspace(0.0, 1.0, points)
    reach = length * rng.uniform(0.45, 1.0, count)
    lean = rng.normal(0.0, 0.32, count)
    wave, phase = rng.uniform(0.05, 0.22, count), rng.uniform(0.0, 6.0, count)
    x = lean[:, None] * reach[:, None] * s**1.6 + wave[:, None] * np.sin(5.0 * s + phase[:, None])
    z = 0.03 + 0.05 * np.abs(np.sin(4.0 * s + phase[:, None]))
    curves = np.asarray(root) + np.stack([x, reach[:, None] * s, z], axis=2)
    base, along = scattered(rng, curves, max(60, int(4500 * detail)))
    base = base + rng.normal(0.0, 1.0, base.shape) * [0.13, 0.13, 0.0]
    base[:, 2] += np.abs(rng.normal(0.0, 0.09, len(base)))
    along[:, 2] = np.abs(along[:, 2]) + 0.3  # leaves turn away from the wall
    return tapered(curves, 0.016, 0.004, 4), leaves(rng, base, along, leaf * min(3.0, leaf_scale(detail)), 0.8)
