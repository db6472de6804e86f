"""A scene from a file: the format's reader, then a camera and a light where the file has none."""

from __future__ import annotations

import importlib.util
import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpgi.camera import Camera
from warpgi.lights import Environment
from warpgi.load_parts import Parts, SceneFileError
from warpgi.scene import Scene, Shape

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".usd", ".usda", ".usdc", ".usdz")


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """The scene in a .glb, .gltf, .obj, .ply or .stl file, or with the `usd` extra in a .usd, .usda, .usdc or .usdz.

    What a file does not say: without a camera, one with a vertical fov of 40 degrees frames the whole scene from
    slightly above and to the side; without a light, `Environment((1, 1, 1))` lights it; a mesh without a material is
    diffuse, albedo 0.8. World space is in the file's own units with y up; USD is turned and scaled to that, in metres.

    Materials become the nearest of this library's: metallic at least 0.5 a `Conductor`, or a `Mirror` where it is
    sharper than a Conductor can be; transmission above 0.5 (KHR_materials_transmission, USD opacity below 0.5, mtl
    illum 7) a `Dielectric`, which must enclose a volume and has no colour; all else `Diffuse`. Only the base colour
    is textured; other textures and vertex colours count by their mean, with a warning. Textures repeat, alpha is
    ignored, and skins, morphs and animation stay at rest.

    Lights keep the radiometry that was meant. KHR_lights_punctual is photometric: candela and lux are divided by
    683 lm/W, what Blender's exporter multiplies watts by. Emissive colours and UsdLux intensities are taken as
    radiance, W/(sr m^2).

    Args:
        path: The file. What it refers to (buffers, textures, .mtl, USD layers) must lie in its folder or below.

    Returns:
        The scene, with one shape per mesh instance and material. Triangles without area are dropped and counted in
        `Scene.degenerate_count`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: its extension is unknown, it is damaged or has no triangles, or it refers to a texture that is
            missing or to a file outside its folder.
        ImportError: it is a USD file and usd-core is not installed.

    Example:
        >>> import pathlib, tempfile, warpgi as gi
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "triangle.obj")
        ...     _ = path.write_text("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
        ...     scene = gi.load_scene(path)
        >>> scene.triangle_count, scene.lights
        (1, (Environment(radiance=(1.0, 1.0, 1.0)),))
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"path {str(path)!r} is no file, expected a scene")
    if suffix not in SUFFIXES:
        raise ValueError(f"path {str(path)!r} has the extension {suffix!r}, expected one of {', '.join(SUFFIXES)}")
    try:
        parts = _read(path, suffix)
    except SceneFileError as error:
        raise ValueError(f"{path.name}: {error}") from error
    if not parts.shapes:
        raise ValueError(f"{path.name}: it has no triangle with an area, expected at least one")
    for name in parts.empty:
        warnings.warn(f"{path.name}: {name} has no triangle with an area and is left out", stacklevel=2)

    lit = parts.lights or any(shape.emission is not None for shape in parts.shapes)
    lights = parts.lights if lit else [Environment((1.0, 1.0, 1.0))]
    return Scene(parts.shapes, parts.camera or framing_camera(parts.shapes), lights, name=path.stem)


def _reader(path: Path, suffix: str) -> Callable[[Path], Parts]:
    """The function that reads such a file; only now, as trimesh and pxr take long to import."""
    if suffix in (".glb", ".gltf"):
        from warpgi.load_gltf import read_gltf

        return read_gltf
    if suffix in (".obj", ".ply", ".stl"):
        from warpgi import load_mesh

        return {".obj": load_mesh.read_obj, ".ply": load_mesh.read_ply, ".stl": load_mesh.read_stl}[suffix]
    if importlib.util.find_spec("pxr") is None:
        raise ImportError(f"{path.name} needs usd-core, which is not installed: pip install warpgi[usd]")
    from warpgi.load_usd import read_usd

    return read_usd


def _read(path: Path, suffix: str) -> Parts:
    """What the suffix's reader finds; any way in which it fails on a damaged file becomes one sentence."""
    read = _reader(path, suffix)
    try:
        return read(path)
    except (SceneFileError, Warning):
        raise
    except Exception as error:
        lines = str(error).strip().splitlines()
        reason = f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__
        raise SceneFileError(f"it cannot be read as {suffix} ({reason})") from error


def framing_camera(shapes: list[Shape]) -> Camera:
    """A camera that sees the bounding sphere with a margin of 5 %, from the front, right and above."""
    fov = 40.0
    low = np.min([shape.vertices.min(axis=0) for shape in shapes], axis=0)
    high = np.max([shape.vertices.max(axis=0) for shape in shapes], axis=0)
    centre = 0.5 * (low + high)
    radius = max(float(np.linalg.norm(shape.vertices - centre, axis=1).max()) for shape in shapes)
    side = np.array([0.5, 0.4, 1.0])
    distance = 1.05 * radius / math.sin(math.radians(0.5 * fov))
    x, y, z = (centre + distance * side / np.linalg.norm(side)).tolist()
    return Camera((x, y, z), tuple(centre.tolist()), fov=fov)
