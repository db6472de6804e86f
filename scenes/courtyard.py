"""An inner courtyard after the spirit of SAN MIGUEL (LALD12, fig. 7): much of what is seen is lit indirectly."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment
from warpgi.materials import Conductor, Diffuse, Material
from warpgi.scene import Scene
from warpgi.scenes import plants, textures
from warpgi.scenes.architecture import EDGE, HALF, STEP, Parts, north_side
from warpgi.scenes.primitives import Mesh, box, disc, lathe, merge, quad, revolution, scatter

SEED = 1612
LEAF_GREENS = ((0.10, 0.22, 0.04), (0.16, 0.30, 0.06), (0.22, 0.36, 0.09), (0.07, 0.17, 0.05))
POT_GREENS = ((0.08, 0.24, 0.07), (0.18, 0.34, 0.10), (0.30, 0.40, 0.14), (0.10, 0.20, 0.12))
BLOSSOM = ((0.62, 0.05, 0.26), (0.70, 0.10, 0.38), (0.55, 0.03, 0.15), (0.16, 0.28, 0.07))
CLAY = ((0.50, 0.20, 0.10), (0.58, 0.26, 0.13), (0.44, 0.17, 0.09), (0.52, 0.30, 0.19))
# Texture repeats per metre of uv.
SCALES = {"wall": 0.25, "gallery": 0.25, "stone": 0.6, "terracotta": 0.7, "paving": 0.45, "wood": 0.5, "brick": 0.9}
FACETED = ("shutter", "pane", "iron", "paving", "terracotta")


def courtyard(detail: float = 1.0, sun: float = 12.0, sky: float = 1.1) -> Scene:
    """A courtyard of 12 m with arcades on four sides, a tree, potted plants, creepers and tiled roofs.

    The camera stands in the shade of the arcade. At detail 1 it has about 390 000 triangles, 160 000
    of them leaves.

    Args:
        detail: scales the number of triangles, in [0.02, 20].
        sun: irradiance of the sun on a surface that faces it [W/m^2].
        sky: radiance of the sky, W/(sr m^2).
    """
    checks.number("detail", detail, 0.02, 20.0)
    checks.number("sun", sun, 0.0)
    checks.number("sky", sky, 0.0)
    rng = np.random.default_rng(SEED)
    parts: Parts = defaultdict(list)
    for quarter in range(4):
        for name, meshes in north_side(rng, detail).items():
            parts[name] += [mesh.turn(0.5 * np.pi * quarter) for mesh in meshes]
    paving = quad((-EDGE, 0.0, EDGE), (2 * EDGE, 0, 0), (0, 0, -2 * EDGE))
    parts["paving"].append(paving)
    _tree(parts, rng, detail)
    _pots(parts, rng, detail)
    _creepers(parts, rng, detail)
    for x, z, angle in ((-3.2, 1.3, 0.3), (2.7, 2.9, 1.1), (3.4, -2.6, 2.0)):
        _table(parts, (x, 0.0, z), angle, max(8, round(40 * detail**0.5)))

    materials = _materials(rng)
    shapes = []
    for name, meshes in parts.items():
        mesh = merge(meshes).paint(SCALES.get(name, 1.0))
        shapes.append(mesh.shape(materials[name], name, smooth=name not in FACETED))
    lights = [
        DistantLight((-0.42, -1.0, -0.55), (sun, 0.88 * sun, 0.70 * sun)),
        Environment((0.55 * sky, 0.80 * sky, 1.25 * sky)),
    ]
    camera = Camera((-2.5, 1.6, 8.1), (-1.1, 2.5, -3.0), fov=58.0)
    return Scene(shapes, camera, lights, name="courtyard")


def _materials(rng: np.random.Generator) -> dict[str, Material]:
    textured = {
        "wall": textures.plaster(rng, (0.72, 0.44, 0.20), (0.66, 0.58, 0.46)),
        "gallery": textures.plaster(rng, (0.74, 0.66, 0.52), (0.55, 0.38, 0.26)),
        "stone": textures.mottled(rng, (0.60, 0.54, 0.46), 0.10),
        "terracotta": textures.tiles(rng, [(0.50, 0.23, 0.13), (0.56, 0.28, 0.16)], (0.42, 0.38, 0.33), 4, 3.0),
        "paving": textures.tiles(rng, [(0.56, 0.51, 0.43), (0.38, 0.33, 0.28)], (0.25, 0.22, 0.19), 4, 3.5),
        "wood": textures.mottled(rng, (0.24, 0.14, 0.08), 0.22, 1.1, stretch=8.0),
        "door": textures.mottled(rng, (0.16, 0.22, 0.20), 0.15, 1.1, stretch=6.0),
        "shutter": textures.mottled(rng, (0.11, 0.27, 0.28), 0.12, 1.0, stretch=6.0),
        "brick": textures.bricks(rng, (0.46, 0.20, 0.12), (0.55, 0.50, 0.43)),
        "soil": textures.mottled(rng, (0.09, 0.06, 0.04), 0.35, 0.6),
        "bark": textures.mottled(rng, (0.23, 0.17, 0.12), 0.2, 0.9),
        "roof": textures.palette(rng, CLAY, 0.15),
        "clay": textures.mottled(rng, (0.56, 0.26, 0.14), 0.12),
        "leaf": textures.palette(rng, LEAF_GREENS, 0.2),
        "potted": textures.palette(rng, POT_GREENS, 0.2),
        "blossom": textures.palette(rng, BLOSSOM, 0.2),
    }
    materials: dict[str, Material] = {name: Diffuse(texture) for name, texture in textured.items()}
    materials["pane"] = Conductor(0.002, (0.08, 0.10, 0.12))
    materials["iron"] = Diffuse((0.05, 0.05, 0.055))
    materials["linen"] = Diffuse((0.78, 0.76, 0.70))
    return materials


def _tree(parts: Parts, rng: np.random.Generator, detail: float) -> None:
    wood, crown = plants.tree(rng, detail)
    parts["bark"].append(wood.move((0.0, 0.4, 0.0)))
    parts["leaf"].append(crown.move((0.0, 0.4, 0.0)))
    # An octagonal brick planter with a stone rim: a lathe of 8 sides.
    parts["brick"].append(lathe([(1.15, 0.0), (1.15, 0.42)], 8))
    parts["stone"].append(lathe([(1.15, 0.42), (1.25, 0.42), (1.25, 0.52), (0.9, 0.52), (0.9, 0.40)], 8))
    parts["soil"].append(disc(1.0, 8).move((0.0, 0.42, 0.0)))
    angle = rng.uniform(0.0, 2.0 * np.pi, 9)
    for a in angle:
        stems, leaves = plants.potted(rng, detail, 0.35, 0.2)
        place = (0.7 * np.cos(a), 0.42, 0.7 * np.sin(a))
        parts["potted"] += [stems.paint(0.0, (0.09, 0.09)).move(place), leaves.move(place)]


def _pots(parts: Parts, rng: np.random.Generator, detail: float) -> None:
    segments = max(8, round(32 * detail**0.5))
    near = EDGE - 0.45
    places = [(x, -near) for x in (-3.6, -1.2, 1.2, 3.6)] + [(-near, z) for z in (-3.4, -0.9, 3.4)]
    places += [(near, z) for z in (-3.5, -1.3, 1.3, 3.7)] + [(0.1, near), (2.2, near), (-4.95, -4.95), (4.95, -4.95)]
    for i, (x, z) in enumerate(places):
        radius, height = rng.uniform(0.2, 0.3), rng.uniform(0.32, 0.5)
        x, z = x + rng.normal(0.0, 0.1), z + rng.normal(0.0, 0.06)
        parts["clay"].append(_pot(radius, height, segments).move((x, 0.0, z)))
        parts["soil"].append(disc(0.9 * radius, segments).move((x, 0.9 * height, z)))
        stems, leaves = plants.potted(rng, detail, rng.uniform(0.5, 1.1), rng.uniform(0.2, 0.45))
        place = (x, 0.9 * height, z)
        parts["potted"].append(stems.paint(0.0, (0.09, 0.09)).move(place))
        parts["blossom" if i % 4 == 2 else "potted"].append(leaves.move(place))


def _creepers(parts: Parts, rng: np.random.Generator, detail: float) -> None:
    for name, root, length, quarter in (
        ("blossom", (-1.2, STEP, -HALF + 0.24), 6.0, 0),
        ("leaf", (5.55, STEP, -HALF), 6.2, 0),
        ("leaf", (-3.7, STEP, -HALF + 0.24), 5.2, 1),
        ("blossom", (3.6, STEP, -HALF + 0.24), 5.6, 3),
    ):
        wood, leaves = plants.vine(rng, np.array(root), length, detail)
        parts["bark"].append(wood.turn(0.5 * np.pi * quarter))
        parts[name].append(leaves.turn(0.5 * np.pi * quarter))


def _table(parts: Parts, place: tuple[float, float, float], angle: float, segments: int) -> None:
    s = np.linspace(0.0, 1.0, 9)
    leg = revolution(np.stack([0.05 + 0.2 * (1.0 - s) ** 4, 0.7 * s], axis=1), segments)
    top = lathe([(0.0, 0.70), (0.55, 0.70), (0.57, 0.715), (0.57, 0.735), (0.55, 0.75), (0.0, 0.75)], segments)
    parts["wood"].append(merge([leg, top]).move(place))
    cloth = lathe([(0.40, 0.752), (0.40, 0.757), (0.0, 0.757)], segments)
    parts["linen"].append(cloth.move(place))
    parts["clay"].append(_pot(0.07, 0.14, segments).move(np.add(place, (0.1, 0.757, 0.05))))
    for k in range(3):
        turn = angle + 2.0 * np.pi * k / 3.0
        chair = _chair().move((0.0, 0.0, 0.78)).turn(turn).move(place)
        parts["wood"].append(chair)


def _chair() -> Mesh:
    """A chair that faces -z, on y = 0."""
    leg = box((-0.02, 0.0, -0.02), (0.02, 0.45, 0.02), skip="-y +y")
    legs = scatter(leg, np.array([(x, 0.0, z) for x in (-0.19, 0.19) for z in (-0.19, 0.19)]))
    slat = box((-0.025, 0.49, 0.175), (0.025, 0.90, 0.20))
    slats = scatter(slat, np.array([(x, 0.0, 0.0) for x in (-0.14, -0.047, 0.047, 0.14)]))
    rail = box((-0.21, 0.88, 0.165), (0.21, 0.95, 0.21))
    posts = scatter(box((-0.02, 0.49, 0.165), (0.02, 0.89, 0.205)), np.array([(-0.19, 0.0, 0.0), (0.19, 0.0, 0.0)]))
    return merge([legs, box((-0.22, 0.45, -0.22), (0.22, 0.49, 0.22)), slats, rail, posts])


def _pot(radius: float, height: float, segments: int) -> Mesh:
    """A flower pot with a rim, open above, on y = 0."""
    r, h = radius, height
    outside = [
        (0.68 * r, 0.0),
        (0.92 * r, 0.82 * h),
        (1.05 * r, 0.84 * h),
        (1.08 * r, h),
        (0.95 * r, h),
        (0.9 * r, 0.9 * h),
    ]
    return lathe(outside, segments)
