"""One side of the courtyard: arcade, gallery behind it, upper wall with windows, and a tiled roof.

Every function builds the north side, which faces +z, in world coordinates; the other three are the same, turned.
Pieces that meet their turned copies at the corners reach over one corner only, so that nothing is there twice.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise

import numpy as np

from warpgi.scenes.primitives import Mesh, box, grid, merge, prism, quad, quads, revolution, scatter, tubes
from warpgi.scenes.textures import texel

HALF = 6.0  # half the court's width, to the wall's face [m]
WALL = 0.45  # thickness of the arcade's wall
BACK = 9.2  # gallery's back wall
STEP, EDGE = 0.15, 5.55  # height of the gallery's floor, and where it begins
SPRING, RADIUS = 2.3, 0.95  # where the arches spring, and their radius
CEILING, STOREY, TOP = 3.6, 3.9, 7.0
EAVES, SLOPE = 5.4, 0.42  # where the roof begins, and its rise over run
BAYS = 2.4 * np.arange(-2, 3)  # centres of the arches
COLUMNS = 2.4 * np.arange(-2, 2) + 1.2

Parts = defaultdict[str, list[Mesh]]


def north_side(rng: np.random.Generator, detail: float) -> Parts:
    """Everything of the north side, by the name of its material."""
    parts: Parts = defaultdict(list)
    fine = detail**0.5
    _arcade(parts, max(6, round(40 * fine)))
    _columns(parts, max(8, round(36 * fine)))
    _gallery(parts, rng)
    _upper_wall(parts, slats=max(4, round(16 * min(1.0, fine))))
    _roof(parts, rng, max(3, round(8 * fine)), wide=max(1.0, 0.5 / fine))
    return parts


def _arcade(parts: Parts, steps: int) -> None:
    front, back, ring = -HALF, -HALF - WALL, []
    angle = np.linspace(np.pi, 0.0, steps + 1)
    x = np.concatenate([[-HALF], *(c + RADIUS * np.cos(angle) for c in BAYS), [HALF]])
    y = np.concatenate([[SPRING], *([SPRING + RADIUS * np.sin(angle)] * len(BAYS)), [SPRING]])
    parts["wall"].append(_strip(x, y, np.full_like(y, STOREY), front))
    x[[0, -1]] = -HALF - WALL, HALF + WALL  # the gallery's side is longer
    parts["gallery"].append(_strip(x, y, np.full_like(y, CEILING), back).flip())
    for centre in BAYS:
        arch = np.stack([centre + RADIUS * np.cos(angle), SPRING + RADIUS * np.sin(angle)], axis=1)
        at = [np.insert(arch, 2, z, axis=1) for z in (front, back)]
        ring.append(grid(np.stack(at, axis=1)).flip())
        # Archivolt: a moulding that follows the arch, in section a quarter step outwards from the wall.
        section = [(0.0, 0.0), (0.0, 0.05), (0.05, 0.07), (0.10, 0.055), (0.15, 0.06), (0.17, 0.03), (0.17, -0.01)]
        for (r0, d0), (r1, d1) in pairwise(section):
            edge = [
                np.stack(
                    [
                        centre + (RADIUS + r) * np.cos(angle),
                        SPRING + (RADIUS + r) * np.sin(angle),
                        np.full_like(angle, front + d),
                    ],
                    axis=1,
                )
                for r, d in ((r0, d0), (r1, d1))
            ]
            parts["stone"].append(grid(np.stack(edge, axis=1)).flip())
    parts["stone"] += ring


def _strip(x: np.ndarray, low: np.ndarray, high: np.ndarray, z: float) -> Mesh:
    """A wall at z that faces +z between two heights that change along x."""
    keep = np.diff(x) > 1e-9
    a, b = np.stack([x, low, np.full_like(x, z)], axis=1), np.stack([x, high, np.full_like(x, z)], axis=1)
    mesh = quads(np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1)[keep])
    return mesh._replace(uv=mesh.vertices[:, :2].copy())


def _columns(parts: Parts, segments: int) -> None:
    bead = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7)
    torus = np.stack([0.215 + 0.045 * np.cos(bead), 0.165 + 0.045 * np.sin(bead)], axis=1)
    s = np.linspace(0.0, 1.0, 12)
    shaft = np.stack([0.205 - 0.035 * s**1.8, 0.21 + 1.66 * s], axis=1)
    collar = np.stack([0.17 + 0.03 * np.cos(bead), 1.90 + 0.03 * np.sin(bead)], axis=1)
    bell = np.stack([0.17 + 0.11 * s**2.2, 1.93 + 0.15 * s], axis=1)
    pieces = [revolution(p, segments) for p in (torus, shaft, collar, bell)]
    pieces += [box((-0.28, 0.0, -0.28), (0.28, 0.12, 0.28), skip="-y"), box((-0.31, 2.08, -0.29), (0.31, 2.155, 0.29))]
    column = merge(pieces).move((0.0, STEP, -HALF - 0.5 * WALL))
    parts["stone"].append(scatter(column, np.stack([COLUMNS, 0 * COLUMNS, 0 * COLUMNS], axis=1)))
    # The corner's pier is an L of two prisms that share no face; its outline follows the wall above.
    a, b, c = -HALF - WALL, -HALF, -HALF + 0.25
    for low, high, grow in (
        (STEP, SPRING + 0.005, 0.0),
        (STEP, STEP + 0.14, 0.04),
        (SPRING - 0.075, SPRING + 0.006, 0.04),
    ):
        wide = [(a - grow, b + grow), (c + grow, b + grow), (c + grow, a - grow), (a - grow, a - grow)]
        narrow = [(a - grow, c + grow), (b + grow, c + grow), (b + grow, b + grow), (a - grow, b + grow)]
        parts["stone"] += [prism(wide, low, high), prism(narrow, low, high)]


def _gallery(parts: Parts, rng: np.random.Generator) -> None:
    parts["terracotta"].append(_slab(-EDGE, BACK, -BACK, -EDGE, STEP))
    parts["stone"].append(quad((-EDGE, 0.0, -EDGE), (2 * EDGE, 0, 0), (0, STEP, 0)))
    parts["gallery"].append(quad((-BACK, STEP, -BACK), (2 * BACK, 0, 0), (0, CEILING - STEP, 0)))
    inner = HALF + WALL
    parts["wood"].append(_slab(-inner, BACK, -BACK, -inner, CEILING).flip())
    outside = BACK + 0.15  # the house's back, up to the roof
    parts["wall"].append(quad((outside, 0.0, -outside), (-2 * outside, 0, 0), (0, TOP + 1.6, 0)))
    for x in np.arange(-inner + 0.5, BACK, 0.62):
        width = rng.uniform(0.07, 0.09)
        parts["wood"].append(box((x - width, CEILING - 0.2, -BACK), (x + width, CEILING, -inner), skip="+y -z"))
    for x in BAYS[[0, 2, 4]]:  # doors with stone frames
        parts["door"].append(box((x - 0.55, STEP, -BACK), (x + 0.55, 2.45, -BACK + 0.05), skip="-y -z"))
        for panel in (-0.27, 0.27):
            for low, high in ((0.35, 1.15), (1.3, 2.3)):
                corner = (x + panel - 0.19, low, -BACK + 0.05)
                parts["door"].append(box(corner, (x + panel + 0.19, high, -BACK + 0.075), skip="-z"))
        for side in (-0.64, 0.64):
            parts["stone"].append(box((x + side - 0.09, STEP, -BACK), (x + side + 0.09, 2.45, -BACK + 0.09), skip="-z"))
        parts["stone"].append(box((x - 0.8, 2.45, -BACK), (x + 0.8, 2.65, -BACK + 0.12), skip="-z"))


def _slab(x0: float, x1: float, z0: float, z1: float, y: float) -> Mesh:
    mesh = quad((x0, y, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1))
    return mesh._replace(uv=mesh.vertices[:, [0, 2]].copy())


def _upper_wall(parts: Parts, slats: int) -> None:
    z, depth, half = -HALF, 0.28, 0.48
    openings = [(c, STOREY + 0.16 if c == 0.0 else 4.75, 6.25) for c in BAYS]  # the middle one is a door to the balcony
    last = -HALF
    for centre, low, high in openings:
        left, right = centre - half, centre + half
        for x0, x1, y0, y1 in ((last, left, STOREY, TOP), (left, right, STOREY, low), (left, right, high, TOP)):
            parts["wall"].append(_strip(np.array([x0, x1]), np.array([y0, y0]), np.array([y1, y1]), z))
        parts["wall"].append(box((left, low, z - depth), (right, high, z), inward=True, skip="-z +z"))
        parts["pane"].append(quad((left, low, z - depth), (2 * half, 0, 0), (0, high - low, 0)))
        bars = [box((centre - 0.025, low, z - depth), (centre + 0.025, high, z - depth + 0.04), skip="-z")]
        for y in np.linspace(low, high, 5)[1:-1]:
            bars.append(box((left, y - 0.018, z - depth), (right, y + 0.018, z - depth + 0.035), skip="-z"))
        parts["shutter"] += bars
        for side in (-1.0, 1.0):
            parts["shutter"].append(_shutter(slats, 0.46, high - low).move((centre + side * 0.735, low, z + 0.01)))
        if low > 4.5:
            sill = box((left - 0.08, low - 0.07, z), (right + 0.08, low, z + 0.11), skip="-z")
            parts["stone"].append(sill)
        last = right
    parts["wall"].append(_strip(np.array([last, HALF]), np.full(2, STOREY), np.full(2, TOP), z))
    for low, high, out in ((STOREY - 0.06, STOREY + 0.06, 0.10), (STOREY + 0.06, STOREY + 0.11, 0.05)):
        parts["stone"].append(box((-HALF, low, z), (HALF - out, high, z + out), skip="-x -z"))
    for low, high, out in ((TOP - 0.22, TOP - 0.12, 0.08), (TOP - 0.12, TOP, 0.16)):
        parts["stone"].append(box((-HALF, low, z), (HALF - out, high, z + out), skip="-x -z"))
    _balcony(parts, STOREY + 0.16)


def _shutter(slats: int, width: float, height: float) -> Mesh:
    """A louvred shutter about x = 0 that stands on y = 0 with its back at z = 0."""
    w, rail, thick = 0.5 * width, 0.05, 0.035
    pieces = [
        box((-w, 0.0, 0.0), (-w + rail, height, thick)),
        box((w - rail, 0.0, 0.0), (w, height, thick)),
        box((-w + rail, 0.0, 0.0), (w - rail, 0.07, thick)),
        box((-w + rail, height - 0.07, 0.0), (w - rail, height, thick)),
    ]
    step = (height - 0.14) / slats
    slat = box((-w + rail, 0.0, 0.004), (w - rail, 0.012, 0.030))
    tilt = slat.vertices[:, 1] - 0.9 * (slat.vertices[:, 2] - 0.004)  # outer edge lower: it sheds the rain
    slat = slat._replace(vertices=np.stack([slat.vertices[:, 0], tilt, slat.vertices[:, 2]], axis=1))
    at = 0.07 + step * (np.arange(slats) + 0.6)
    pieces.append(scatter(slat, np.stack([0 * at, at, 0 * at], axis=1)))
    return merge(pieces)


def _balcony(parts: Parts, floor: float) -> None:
    z, half, out = -HALF, 1.05, 0.75
    parts["stone"].append(box((-half, floor - 0.13, z), (half, floor, z + out), skip="-z"))
    for x in (-0.75, 0.75):  # brackets
        parts["stone"].append(box((x - 0.08, floor - 0.42, z), (x + 0.08, floor - 0.13, z + 0.4), skip="-z +y"))
    x = np.linspace(-half + 0.06, half - 0.06, 22)
    deep = np.linspace(z + 0.1, z + out - 0.06, 8)[:-1]
    posts = [(a, z + out - 0.06) for a in x] + [(s * (half - 0.06), b) for s in (-1.0, 1.0) for b in deep]
    posts_low = np.array([(a, floor, b) for a, b in posts])
    rise = np.array([0.0, 0.95, 0.0])
    curves = posts_low[:, None] + np.linspace(0.0, 1.0, 2)[:, None] * rise
    parts["iron"].append(tubes(curves, np.full(curves.shape[:2], 0.009), 5))
    parts["iron"].append(box((-half + 0.03, floor + 0.95, z + out - 0.09), (half - 0.03, floor + 0.98, z + out - 0.03)))
    for side in (-half + 0.03, half - 0.09):
        parts["iron"].append(box((side, floor + 0.95, z), (side + 0.06, floor + 0.98, z + out - 0.09), skip="-z +z"))


def _roof(parts: Parts, rng: np.random.Generator, sides: int, wide: float) -> None:
    """Barrel tiles, `wide` times as large as usual, on a deck that overhangs the wall; below it the rafters' ends."""
    depth, spacing, course = BACK + 0.3 - EAVES, 0.22 * wide, 0.36 * wide
    far = EAVES + depth
    deck = np.array([(-EAVES, 0, -EAVES), (EAVES, 0, -EAVES), (far, 0, -far), (-far, 0, -far)])
    parts["wood"].append(_sloped(quads(deck[None])).flip().move((0, -0.04, 0)))
    x = np.arange(-EAVES - depth, EAVES + depth, spacing) + 0.5 * spacing
    first = np.maximum(0.0, np.abs(x) - EAVES)  # the valley between two roofs runs along |x| = -z
    rows = [(u, f, int((depth - f) / course) + 1) for u, f in zip(x, first, strict=True)]
    start = np.concatenate([np.stack([np.full(n, u), np.arange(n) * course + f], axis=1) for u, f, n in rows])
    start += rng.normal(0.0, 0.006, start.shape)
    angle = np.linspace(np.pi, 0.0, sides + 1)
    ends = [
        np.stack([wide * r * np.cos(angle), wide * r * np.sin(angle) + lift, np.full_like(angle, z)], axis=1)
        for r, lift, z in ((0.105, 0.045, 0.0), (0.085, 0.0, -course - 0.06))
    ]
    tile = grid(np.stack(ends))
    places = np.stack([start[:, 0], np.zeros(len(start)), -EAVES - start[:, 1]], axis=1)
    parts["roof"].append(_sloped(scatter(tile, places, texel(rng, len(places)))))
    gutter = _sloped(quads(deck[None]))
    parts["roof"].append(gutter._replace(uv=np.full((4, 2), 0.53)))
    for u in np.arange(-EAVES + 0.35, EAVES, 0.5):
        rafter = box((u - 0.045, -0.19, -HALF - 0.05), (u + 0.045, -0.045, -EAVES - 0.06), skip="+y -z")
        parts["wood"].append(_sloped(rafter))


def _sloped(mesh: Mesh) -> Mesh:
    """The mesh, sheared from the level onto the roof's slope."""
    v, n = mesh.vertices.copy(), mesh.normals.copy()
    v[:, 1] += TOP + 0.1 + SLOPE * (-v[:, 2] - EAVES)
    n[:, 2] += SLOPE * n[:, 1]  # a shear moves normals by its inverse transpose
    return mesh._replace(vertices=v, normals=n / np.linalg.norm(n, axis=1, keepdims=True))
