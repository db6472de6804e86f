"""Rooms whose light is known in closed form: furnace, integrating sphere, CIE 171:2006 test 5.8, and a leak test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import PointLight
from warpgi.materials import Colour, Diffuse, Emissive
from warpgi.scene import Scene, Shape
from warpgi.scenes.primitives import Mesh, box, icosphere, merge, quad

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Expected:
    """What is known of a scene's light; None where nothing is.

    Example:
        >>> from warpgi.scenes import furnace
        >>> scene, expected = furnace(albedo=0.5, emission=1.0)
        >>> expected.radiance
        (2.0, 2.0, 2.0)
    """

    radiance: RGB | None = None
    """Radiance along every camera ray, direct and indirect together, linear RGB, W/(sr m^2)."""
    indirect_irradiance: RGB | None = None
    """Irradiance of light that was reflected at least once, mean over the room's surface, linear RGB, W/m^2."""
    indirect_radiance: RGB | None = None
    """Reflected radiance that is due to `indirect_irradiance`, linear RGB, W/(sr m^2)."""
    uniform: bool = False
    """Whether the indirect values hold at every point, and not in the mean alone."""


def furnace(
    albedo: Colour = 0.5, emission: Colour = 1.0, shape: Literal["cube", "sphere", "blocks"] = "cube"
) -> tuple[Scene, Expected]:
    """A closed room where every surface emits and reflects alike: L = emission / (1 - albedo) along every ray.

    Args:
        albedo: reflectance of all surfaces, linear RGB in [0, 0.99].
        emission: emitted radiance of all surfaces, linear RGB, W/(sr m^2).
        shape: "cube" of 2 m, "sphere" of radius 1 m, or "blocks", the cube with two boxes and a ball in it.
    """
    albedo, emission = checks.rgb("albedo", albedo, upper=0.99), checks.rgb("emission", emission)
    cube = box((-1, -1, -1), (1, 1, 1), inward=True)
    if shape == "cube":
        mesh = cube
    elif shape == "sphere":
        mesh = icosphere(1.0, 4).flip()
    elif shape == "blocks":
        tall = box((-0.7, -0.9, -0.8), (-0.2, 0.4, -0.3))
        low = box((0.2, -0.9, -0.6), (0.7, -0.4, -0.1))
        mesh = merge([cube, tall, low, icosphere(0.25, 3).move((0.45, 0.1, -0.35))])
    else:
        raise ValueError(f"shape is {shape!r}, expected 'cube', 'sphere' or 'blocks'")
    camera = Camera((0.1, 0.05, 0.8), (0.0, -0.1, -1.0), fov=80.0)
    surface = mesh.shape(Diffuse(albedo), "furnace", Emissive(emission), smooth=False)
    radiance = tuple(e / (1.0 - a) for e, a in zip(emission, albedo, strict=True))
    return Scene([surface], camera, name="furnace"), Expected(radiance=radiance, uniform=True)


def integrating_sphere(
    albedo: Colour = 0.5, power: Colour = 100.0, radius: float = 1.0, subdivisions: int = 5
) -> tuple[Scene, Expected]:
    """The inside of a sphere with a point light at its centre: indirect irradiance power a / (S (1 - a)) everywhere.

    Args:
        albedo: reflectance of the wall, linear RGB in [0, 0.99].
        power: radiant flux of the light [W], linear RGB.
        radius: of the sphere [m], above 0.
        subdivisions: the wall has 20 * 4^subdivisions triangles, 2 to 7; S is their area, not the sphere's.
    """
    albedo, power = checks.rgb("albedo", albedo, upper=0.99), checks.rgb("power", power)
    checks.number("radius", radius, 0.0, open_lower=True)
    wall = icosphere(radius, checks.count("subdivisions", subdivisions, 2, 7)).flip()
    camera = Camera((0.0, 0.1 * radius, 0.6 * radius), (0.0, -0.1 * radius, -radius), fov=70.0)
    return _lit_room("integrating-sphere", wall, albedo, power, camera, uniform=True)


def room(albedo: Colour = 0.5, flux: Colour = 10000.0) -> tuple[Scene, Expected]:
    """CIE 171:2006 test 5.8: a cube of 4 m with one reflectance and a point light in its centre.

    With 10 000 lm and albedo 0.5 the mean indirect illuminance is 104.2 lx; read W as lm for it.

    Args:
        albedo: reflectance of all surfaces, linear RGB in [0, 0.99].
        flux: of the light [W], linear RGB.
    """
    albedo, flux = checks.rgb("albedo", albedo, upper=0.99), checks.rgb("flux", flux)
    walls = box((-2, -2, -2), (2, 2, 2), inward=True)
    return _lit_room("room", walls, albedo, flux, Camera((1.6, 0.6, 1.8), (-0.8, -0.5, -2.0), fov=65.0))


def _lit_room(name: str, walls: Mesh, albedo: RGB, power: RGB, camera: Camera, uniform: bool = False):
    surface = walls.shape(Diffuse(albedo), name, smooth=False)
    light = PointLight((0.0, 0.0, 0.0), tuple(p / (4.0 * np.pi) for p in power))
    area = float(surface.areas().sum())
    irradiance = tuple(p * a / (area * (1.0 - a)) for p, a in zip(power, albedo, strict=True))
    radiance = tuple(a / np.pi * e for a, e in zip(albedo, irradiance, strict=True))
    expected = Expected(indirect_irradiance=irradiance, indirect_radiance=radiance, uniform=uniform)
    return Scene([surface], camera, [light], name), expected


def leak(
    thickness: float = 0.001, albedo: Colour = 0.7, radiance: Colour = 10.0, open_front: bool = False
) -> tuple[Scene, Expected]:
    """Two rooms with a thin wall between them, one lit and one dark: every pixel of the dark one is 0.

    Whoever looks light up at points nearby, as photon maps, caches and discs do, finds the lit room's through the wall.

    Args:
        thickness: of the wall [m], in [1e-5, 0.5]; smaller is harder.
        albedo: reflectance of all walls, linear RGB in [0, 1].
        radiance: of the lamp, linear RGB, W/(sr m^2).
        open_front: the front walls are gone and the camera stands outside, the lit room on the left half of the
            picture, the dark one on the right. The dark half is still 0, as there is nothing outside to send light
            in; the scene's `Expected` then speaks of the dark room alone.
    """
    half = 0.5 * checks.number("thickness", thickness, 1e-5, 0.5)
    albedo, radiance = checks.rgb("albedo", albedo, upper=1.0), checks.rgb("radiance", radiance)
    skip = "+z" if open_front else ""
    lit = box((-3.0, 0.0, -1.5), (-half, 2.5, 1.5), inward=True, skip=skip)
    dark = box((half, 0.0, -1.5), (3.0, 2.5, 1.5), inward=True, skip=skip)
    shapes: list[Shape] = [
        lit.shape(Diffuse(albedo), "lit room", smooth=False),
        dark.shape(Diffuse(albedo), "dark room", smooth=False),
        box((1.2, 0.0, -0.9), (1.8, 0.8, -0.3)).shape(Diffuse(albedo), "block in the dark", smooth=False),
        quad((-1.9, 2.45, -0.5), (0.8, 0, 0), (0, 0, 0.8)).shape(Diffuse(0.0), "lamp", Emissive(radiance)),
    ]
    if open_front:
        edge = quad((-half, 0.0, 1.5), (2.0 * half, 0, 0), (0, 2.5, 0))
        shapes.append(edge.shape(Diffuse(albedo), "edge of the wall", smooth=False))
        camera = Camera((0.0, 1.25, 6.0), (0.0, 1.25, 0.0), fov=35.0)
    else:
        camera = Camera((2.7, 1.5, 1.3), (0.0, 1.0, -0.4), fov=65.0)
    return Scene(shapes, camera, name="leak"), Expected(radiance=(0.0, 0.0, 0.0), uniform=True)
