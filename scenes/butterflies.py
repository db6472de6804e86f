"""Butterflies over a meadow, some in focus and some far out, their wings in motion: LALD12's figures 11 and 12."""

from __future__ import annotations

import dataclasses

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment
from warpgi.materials import Diffuse, Texture
from warpgi.scene import Scene, Shape
from warpgi.scenes.primitives import Mesh, grid, merge, quad, tubes
from warpgi.scenes.textures import noise

SPAN = 0.085  # length of a wing [m]
FOCUS = 0.8  # distance of what is sharp [m]
SIZE = 256  # texels along each side of a wing's texture
BACKDROP = 3.2  # its distance [m]

# Outline of fore and hind wing: angle above the outward direction in degrees, and length in parts of SPAN.
OUTLINE = (
    [(-8, 0.70), (4, 0.76), (16, 0.80), (30, 0.92), (42, 1.06), (52, 1.10), (58, 0.94), (66, 0.55), (80, 0.14)],
    [(-82, 0.30), (-68, 0.66), (-54, 0.80), (-40, 0.84), (-26, 0.82), (-12, 0.78), (0, 0.70), (12, 0.50), (20, 0.2)],
)
# Ground, cells, border and spots of the wings.
LIVERIES = (
    ((0.86, 0.33, 0.05), (0.95, 0.52, 0.12), (0.03, 0.02, 0.02), (0.90, 0.88, 0.82)),
    ((0.08, 0.22, 0.70), (0.20, 0.50, 0.92), (0.02, 0.02, 0.05), (0.75, 0.85, 0.95)),
    ((0.88, 0.80, 0.22), (0.95, 0.90, 0.50), (0.10, 0.06, 0.02), (0.80, 0.20, 0.10)),
    ((0.82, 0.84, 0.80), (0.92, 0.93, 0.90), (0.12, 0.10, 0.10), (0.70, 0.55, 0.15)),
)


def butterflies(count: int = 24, aperture: float = 0.012, motion: float = 1.0) -> Scene:
    """A swarm seen through a thin lens while the shutter is open: textured wings that beat, bodies that fly on.

    Args:
        count: butterflies, 1 to 200.
        aperture: radius of the lens [m]; 0 is a pinhole.
        motion: factor on how far everything moves; 0 is still.
    """
    checks.count("count", count, 1, 200)
    checks.number("aperture", aperture, 0.0)
    checks.number("motion", motion, 0.0)
    rng = np.random.default_rng(11)
    liveries = [Diffuse(_wing_texture(rng, *colours)) for colours in LIVERIES]
    bodies = Diffuse((0.05, 0.04, 0.035))
    shapes = [_backdrop(rng)]
    # each in its own cell of the picture, depths in an order that puts near and far ones side by side
    columns = int(np.ceil(np.sqrt(count * 1.6)))
    rows = -(-count // columns)
    cells = rng.permutation(columns * rows)[:count]
    depths = 0.45 * (2.2 / 0.45) ** ((np.arange(count) * 0.618034 + 0.35) % 1.0)
    for i, (cell, depth) in enumerate(zip(cells, depths, strict=True)):
        x = (cell % columns + rng.uniform(0.2, 0.8)) / columns * 2.0 - 1.0
        y = (cell // columns + rng.uniform(0.2, 0.8)) / rows * 2.0 - 1.0
        place = depth * np.array([0.58 * x, 0.32 * y, -1.0])
        name = f"butterfly {i}"
        wings, body = _butterfly(rng, place, motion * (i % 4 != 3))
        shapes += [_moving(wings, liveries[i % 4], f"{name} wings"), _moving(body, bodies, f"{name} body")]
    lights = [DistantLight((-0.45, -0.8, -0.6), (2.6, 2.5, 2.3)), Environment((0.35, 0.42, 0.5))]
    camera = Camera((0, 0, 0), (0, 0, -1), fov=38.0, lens_radius=aperture, focus_distance=FOCUS)
    return Scene(shapes, camera, lights, name="butterflies")


def _moving(ends: tuple[Mesh, Mesh], material: Diffuse, name: str) -> Shape:
    start, end = ends
    shape = start.shape(material, name, smooth=False)
    return dataclasses.replace(shape, motion=end.vertices - start.vertices)


def _butterfly(rng: np.random.Generator, place: np.ndarray, motion: float) -> tuple[tuple[Mesh, Mesh], ...]:
    """Wings and body at the shutter's opening and closing."""
    roll, pitch, yaw = rng.uniform(-1.2, 1.2), rng.uniform(0.2, 1.1), rng.uniform(-0.7, 0.7)
    pose = _turn(2, roll) @ _turn(1, yaw) @ _turn(0, pitch)
    beat = rng.uniform(-0.3, 0.9)
    swing = motion * rng.uniform(0.25, 0.6) * rng.choice([-1.0, 1.0])
    way = motion * (pose @ [0.0, 0.0, -0.02] + rng.uniform(-0.012, 0.012, 3))
    result = []
    for part in (_wings, _body):
        meshes = [part(beat + swing * t) for t in (-0.5, 0.5)]
        places = (place - 0.5 * way, place + 0.5 * way)
        result.append(
            tuple(m._replace(vertices=m.vertices @ pose.T).move(p) for m, p in zip(meshes, places, strict=True))
        )
    return tuple(result)


def _wings(beat: float) -> Mesh:
    """Four wings around a body along -z, raised by `beat` radians."""
    parts = []
    for lift, outline in zip((0.0, -0.0008), OUTLINE, strict=True):
        angle, length = np.array(outline, dtype=np.float64).T
        fine = np.linspace(angle[0], angle[-1], 25)
        length = np.interp(fine, angle, length) * (1.0 + 0.02 * np.cos(1.1 * fine))
        u = np.linspace(0.0, 1.0, 7)[:, None]
        out, along = (u * length * f(np.radians(fine)) for f in (np.cos, np.sin))
        flat = grid(np.stack([out, along, np.zeros_like(out)], axis=2))
        uv = np.stack([flat.vertices[:, 0] / 1.2, 0.5 + flat.vertices[:, 1] / 2.4], axis=1)
        bend = 0.06 * flat.vertices[:, 0] ** 2
        x, y, z = flat.vertices[:, 0], lift / SPAN + bend, -flat.vertices[:, 1]
        c, s = np.cos(beat), np.sin(beat)
        for side in (1.0, -1.0):
            vertices = SPAN * np.stack([side * (0.04 + c * x - s * y), s * x + c * y, z], axis=1)
            parts.append(flat._replace(vertices=vertices, uv=uv))
    return merge(parts)


def _body(beat: float) -> Mesh:
    z = np.linspace(-0.45, 0.6, 10)
    trunk = np.stack([np.zeros(10), np.full(10, -0.01), z], axis=1)
    radius = 0.055 * np.sqrt(np.maximum(1.0 - ((z - 0.05) / 0.58) ** 2, 0.02))
    t = np.linspace(0.0, 1.0, 6)
    feelers = [
        np.stack([side * (0.02 + 0.28 * t), 0.10 * t, -0.42 - 0.5 * t + 0.08 * t * t], axis=1) for side in (-1, 1)
    ]
    parts = [tubes(SPAN * trunk[None], SPAN * radius[None], 8)]
    parts += [tubes(SPAN * line[None], np.full((1, 6), 0.010 * SPAN), 4) for line in feelers]
    return merge(parts)


def _turn(axis: int, angle: float) -> np.ndarray:
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _wing_texture(rng: np.random.Generator, ground, cell, border, spot) -> Texture:
    """Cells between dark veins, a dark border with pale spots; u runs outward, v from hind to fore wing."""
    v, u = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE, indexing="ij")
    x, y = 1.2 * u, 2.4 * (0.5 - v)  # row 0 is v = 1 of the coordinates
    angle, radius = np.degrees(np.arctan2(-y, x)) * -1.0, np.hypot(x, y)
    edge = np.zeros_like(radius)
    for outline in OUTLINE:
        a, length = np.array(outline, dtype=np.float64).T
        edge = np.maximum(edge, np.interp(angle, a, length, left=0.0, right=0.0))
    part = radius / np.maximum(edge, 1e-3)
    shade = 1.0 + 0.12 * noise(rng, 1.2)[..., None]
    colour = np.asarray(ground) + (np.asarray(cell) - ground) * np.clip(1.6 * part - 0.3, 0.0, 1.0)[..., None]
    colour = colour * shade
    vein = np.abs((angle / 11.0) % 1.0 - 0.5) * radius
    ring = np.abs(part - 0.45)
    dark = np.clip(1.5 - 40.0 * np.minimum(vein, np.where(angle > 0, ring, 1.0)), 0.0, 1.0)
    dark = np.maximum(dark, np.clip((part - 0.80) * 25.0, 0.0, 1.0))
    dots = np.hypot(((angle / 5.5) % 1.0 - 0.5) * 0.9, (part - 0.90) * 9.0) < 0.30
    colour = colour + (np.asarray(border) - colour) * dark[..., None]
    colour = np.where(dots[..., None], np.asarray(spot), colour)
    return Texture(np.clip(colour, 0.01, 0.95).astype(np.float32))


def _backdrop(rng: np.random.Generator) -> Shape:
    """A meadow: clouds of green with bright blossoms, on a plane that fills the picture."""
    size = 256
    clouds = noise(rng, 1.6)[..., None]
    colour = (
        np.array([0.16, 0.30, 0.07]) * (1.0 + 0.45 * clouds) + np.array([0.05, 0.03, 0.0]) * noise(rng, 1.2)[..., None]
    )
    y, x = np.mgrid[:size, :size]
    palette = np.array([(0.9, 0.85, 0.2), (0.85, 0.3, 0.45), (0.9, 0.9, 0.92), (0.55, 0.35, 0.8)])
    for _ in range(90):
        cx, cy = rng.integers(0, size, 2)
        dx, dy = ((a - c + size // 2) % size - size // 2 for a, c in ((x, cx), (y, cy)))
        colour = np.where((np.hypot(dx, dy) < rng.uniform(1.0, 3.2))[..., None], palette[rng.integers(4)], colour)
    mesh = quad((-3.0, -2.0, -BACKDROP), (6.0, 0, 0), (0, 4.0, 0))
    mesh = mesh._replace(uv=mesh.uv / 3.0)
    return mesh.shape(Diffuse(Texture(np.clip(colour, 0.01, 0.95).astype(np.float32))), "meadow", smooth=False)
