"""Mitsuba 3 (Jakob et al. 2022) as a peer: a warpgi scene in its terms, rendered by its scalar path tracer."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from warpgi import Camera, Diffuse, Scene, Shape, Texture

VARIANT = "scalar_rgb"

# Russian roulette begins beyond every path, so that all paths do the same.
NEVER = 1 << 20

# It numbers the pixels' random streams from seed * width * height on, over blocks that reach beyond the picture;
# seeds this far apart share no stream.
SEED_STEP = 16


class MissingPeer(ValueError):
    """Mitsuba is not installed."""


class NoCounterpart(ValueError):
    """A scene holds something that Mitsuba would render otherwise."""


class MitsubaPeer:
    """A scene loaded into Mitsuba, to be rendered over and over.

    Args:
        scene: diffuse surfaces without textures, area lights and a pinhole camera.
        size: (width, height) in pixels.
        max_depth: longest path in segments; 1 sees emitters only, in Mitsuba as here.
        threads: CPU threads.

    Raises:
        MissingPeer: Mitsuba is not installed.
        NoCounterpart: the scene holds something else.
    """

    def __init__(self, scene: Scene, size: tuple[int, int], max_depth: int, threads: int) -> None:
        try:
            import drjit
            import mitsuba
        except ImportError as error:
            raise MissingPeer("mitsuba is not installed, expected it for --peers: pip install warpgi[peers]") from error
        mitsuba.set_variant(VARIANT)
        self.mitsuba = mitsuba
        self.drjit = drjit
        self.version: str = mitsuba.__version__
        self.threads = threads
        with TemporaryDirectory(prefix="warpgi-mitsuba-") as folder:
            self.scene = mitsuba.load_dict(export_scene(scene, size, max_depth, Path(folder)))

    def render(self, spp: int, seed: int) -> np.ndarray:
        """Linear radiance, shape (H, W, 3), float32."""
        # the main thread is one of them
        self.drjit.set_thread_count(self.threads)
        return np.array(self.mitsuba.render(self.scene, spp=spp, seed=SEED_STEP * seed), dtype=np.float32)


def export_scene(scene: Scene, size: tuple[int, int], max_depth: int, folder: Path) -> dict[str, Any]:
    """The dictionary that `mitsuba.load_dict` takes; triangles go through PLY files in `folder`.

    A Mitsuba variant has to be set.

    Raises:
        NoCounterpart: the scene holds something else.
    """
    if scene.lights:
        raise NoCounterpart(f"scene {scene.name} has lights beside its shapes")
    result = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth, "rr_depth": NEVER},
        "sensor": _sensor(scene.camera, size),
    }
    for index, shape in enumerate(scene.shapes):
        path = folder / f"{index}.ply"
        _write_ply(path, shape)
        result[f"shape{index}"] = {"type": "ply", "filename": os.fspath(path), "face_normals": True, **_surface(shape)}
    return result


def _sensor(camera: Camera, size: tuple[int, int]) -> dict[str, Any]:
    from mitsuba import ScalarTransform4f

    if camera.lens_radius > 0.0:
        raise NoCounterpart("the camera has a lens")
    origin, target, up = (list(v) for v in (camera.position, camera.target, camera.up))
    return {
        "type": "perspective",
        "fov": camera.fov,
        "fov_axis": "y",
        "near_clip": 1e-4,
        "to_world": ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def _surface(shape: Shape) -> dict[str, Any]:
    if not isinstance(shape.material, Diffuse) or isinstance(shape.material.albedo, Texture):
        raise NoCounterpart(f"{shape.name} is not Diffuse of one colour")
    if shape.normals is not None:
        raise NoCounterpart(f"{shape.name} has vertex normals")
    diffuse = {"type": "diffuse", "reflectance": _rgb(shape.material.albedo)}
    result: dict[str, Any] = {"bsdf": {"type": "twosided", "bsdf": diffuse}}
    if shape.emission is not None:
        if shape.emission.two_sided:
            raise NoCounterpart(f"{shape.name} emits on both sides")
        result["emitter"] = {"type": "area", "radiance": _rgb(shape.emission.radiance)}
    return result


def _rgb(colour: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) for value in colour]}


def _write_ply(path: Path, shape: Shape) -> None:
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(shape.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(shape.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(shape.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, shape.faces
    path.write_bytes(header.encode() + shape.vertices.astype("<f4").tobytes() + faces.tobytes())
