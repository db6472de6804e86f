"""A glass ball and a metal ring on a table: light that comes to a diffuse surface by way of glass and metal alone."""

from __future__ import annotations

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.materials import Conductor, Dielectric, Diffuse, Emissive, Mirror
from warpgi.scene import Scene
from warpgi.scenes.primitives import Mesh, disc, grid, icosphere, lathe

CLEARANCE = 5e-4  # glass and metal float this far above the table [m], so that no two surfaces touch


def caustic(lamp_radius: float = 0.12, roughness: float = 0.0, power: float = 50.0) -> Scene:
    """A glass ball that focuses the lamp and a ring that draws the cardioid of its inside on the table.

    Args:
        lamp_radius: radius of the lamp's disc [m], in [0.005, 0.5]; smaller is sharper and harder for a path tracer.
        roughness: of the ring, 0 for a mirror, else that of a `Conductor`, in [1e-5, 1].
        power: radiant flux of the lamp [W].
    """
    checks.number("lamp_radius", lamp_radius, 0.005, 0.5)
    checks.number("roughness", roughness, 0.0, 1.0)
    checks.number("power", power, 0.0)
    gold = (0.95, 0.72, 0.36)
    metal = Conductor(roughness, gold) if roughness > 0.0 else Mirror(gold)
    # Phi = pi A L for a diffuse emitter.
    radiance = power / (np.pi * np.pi * lamp_radius**2)
    lamp = _aim(disc(lamp_radius, 48), (1.7, 1.8, 0.9), (0.0, 0.0, 0.0))
    shapes = [
        _backdrop().shape(Diffuse((0.62, 0.60, 0.57)), "table"),
        icosphere(0.25, 5).move((-0.36, 0.25 + CLEARANCE, 0.16)).shape(Dielectric(1.5), "glass ball"),
        _ring(0.33, 0.02, 0.17).move((0.32, CLEARANCE, 0.0)).shape(metal, "ring"),
        lamp.shape(Diffuse(0.0), "lamp", Emissive((radiance, 0.93 * radiance, 0.82 * radiance))),
    ]
    return Scene(shapes, Camera((0.1, 1.4, 1.8), (-0.03, 0.05, -0.03), fov=36.0), name="caustic")


def _backdrop() -> Mesh:
    # A photographer's sweep: a flat table that bends up behind the objects and fills the picture.
    angle = np.linspace(0.0, 0.5 * np.pi, 17)
    z = np.concatenate([[2.5], -1.2 - 0.8 * np.sin(angle), [-2.0]])
    y = np.concatenate([[0.0], 0.8 - 0.8 * np.cos(angle), [3.0]])
    sides = [np.stack([np.full_like(y, x), y, z], axis=1) for x in (-3.5, 3.5)]
    return grid(np.stack(sides))


def _ring(radius: float, width: float, height: float) -> Mesh:
    inner, outer = radius - width, radius
    return lathe([(inner, height), (inner, 0.0), (outer, 0.0), (outer, height), (inner, height)], 256)


def _aim(mesh: Mesh, position: tuple[float, float, float], target: tuple[float, float, float]) -> Mesh:
    """`mesh` with its +y axis turned from `position` towards `target`."""
    y = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    x = np.cross(y, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    basis = np.stack([x, y, np.cross(x, y)])
    return mesh._replace(vertices=mesh.vertices @ basis + position, normals=mesh.normals @ basis)
