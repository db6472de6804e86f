"""The scene as the host knows it: shapes, lights and a camera, checked once, never changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.fingerprint import fingerprint
from warpgi.lights import DistantLight, Environment, Light, PointLight, SpotLight
from warpgi.materials import Coated, Conductor, Dielectric, Diffuse, Emissive, Material, Mirror

# A triangle whose doubled area is below this part of its longest edge squared has no usable normal.
DEGENERATE_RATIO = 1e-10


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles of one material.

    Example:
        >>> import warpgi as gi
        >>> shape = gi.Shape([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], material=gi.Diffuse(0.5))
        >>> shape.faces.shape
        (1, 3)

    Raises:
        TypeError, ValueError: an array has a wrong shape, holds NaN, or a face names a vertex that is not there.
    """

    vertices: Any
    """World positions, shape (V, 3), finite; kept in float64 so that a scene far from the origin loses nothing."""
    faces: Any
    """Vertex indices, counter-clockwise seen from the normal's side, shape (F, 3). Degenerate ones are dropped."""
    material: Material = field(default_factory=Diffuse)
    """What the surface reflects or refracts."""
    emission: Emissive | None = None
    """What it emits."""
    normals: Any = None
    """Shading normals at the vertices, shape (V, 3), or None for flat triangles."""
    uv: Any = None
    """Texture coordinates at the vertices, shape (V, 2); needed where the material has a texture."""
    name: str = "shape"
    """How errors call it."""
    motion: Any = None
    """How far its vertices go in a straight line from time 0 to 1 [world units], one vector or shape (V, 3); None where
    it is still. Shading normals turn with their triangle."""
    degenerate_count: int = field(default=0, init=False)
    """Triangles that were dropped because they have no area."""

    def __post_init__(self) -> None:
        name = self.name
        vertices = checks.finite_array(f"{name} vertices", self.vertices, (None, 3))
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
            raise ValueError(f"{name} faces have shape {faces.shape} of {faces.dtype}, expected whole numbers (N, 3)")
        if len(vertices) == 0 or len(faces) == 0:
            raise ValueError(f"{name} has {len(vertices)} vertices and {len(faces)} faces, expected at least one face")
        if faces.min() < 0 or faces.max() >= len(vertices):
            bad = faces.min() if faces.min() < 0 else faces.max()
            raise ValueError(f"{name} faces name vertex {bad}, expected 0 to {len(vertices) - 1}")
        if not isinstance(self.material, (Diffuse, Conductor, Mirror, Dielectric, Coated)):
            raise TypeError(f"{name} material is {type(self.material).__name__}, expected a warpgi material")
        if self.emission is not None and not isinstance(self.emission, Emissive):
            raise TypeError(f"{name} emission is {type(self.emission).__name__}, expected Emissive")

        corner = vertices[faces]
        edges = corner[:, [1, 2, 0]] - corner
        longest = np.square(edges).sum(axis=2).max(axis=1)
        doubled_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        keep = doubled_area > DEGENERATE_RATIO * longest
        if not keep.any():
            raise ValueError(f"{name} has no triangle with an area, expected at least one")

        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(faces[keep], dtype=np.int32))
        object.__setattr__(self, "degenerate_count", int(np.count_nonzero(~keep)))
        if self.normals is not None:
            normals = checks.finite_array(f"{name} normals", self.normals, (len(vertices), 3))
            object.__setattr__(self, "normals", normals)
        if self.motion is not None:
            object.__setattr__(self, "motion", self._checked_motion())
        if self.uv is not None:
            object.__setattr__(self, "uv", checks.finite_array(f"{name} uv", self.uv, (len(vertices), 2)))
        if self.uv is None and self.texture is not None:
            raise ValueError(f"{name} has a texture but no uv, expected uv of shape ({len(vertices)}, 2)")

    def _checked_motion(self) -> np.ndarray | None:
        name, count = self.name, len(self.vertices)
        motion = np.asarray(self.motion)
        if motion.ndim < 2:
            motion = np.broadcast_to(checks.finite_array(f"{name} motion", self.motion, (3,)), (count, 3))
        motion = checks.finite_array(f"{name} motion", motion, (count, 3))
        return np.ascontiguousarray(motion) if motion.any() else None

    @property
    def texture(self):
        """The material's texture, or None."""
        from warpgi.materials import Texture

        value = getattr(self.material, "albedo", getattr(self.material, "reflectance", None))
        return value if isinstance(value, Texture) else None

    @cached_property
    def geometry_fingerprint(self) -> str:
        """SHA-256 of its triangles and what is interpolated over them: all but name, material and emission."""
        return fingerprint(self.vertices, self.faces, self.normals, self.uv, self.motion)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that it is."""
        return fingerprint(self.name, self.geometry_fingerprint, self.material, self.emission)

    def areas(self) -> np.ndarray:
        """Area of every triangle, shape (F,), float64."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


@dataclass(frozen=True, eq=False)
class Scene:
    """Shapes, lights and a camera.

    Raises:
        TypeError, ValueError: something in it is of the wrong kind, or there are two environments.
    """

    shapes: Sequence[Shape]
    """At least one shape."""
    camera: Camera
    """From where the picture is taken."""
    lights: Sequence[Light] = ()
    """Lights beside the emissive shapes; at most one `Environment`."""
    name: str = "scene"
    """Written into the metadata of pictures."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "shapes", tuple(self.shapes))
        object.__setattr__(self, "lights", tuple(self.lights))
        if not self.shapes:
            raise ValueError("scene has no shapes, expected at least one")
        for shape in self.shapes:
            if not isinstance(shape, Shape):
                raise TypeError(f"shapes holds {type(shape).__name__}, expected Shape")
        for light in self.lights:
            if not isinstance(light, (PointLight, SpotLight, DistantLight, Environment)):
                raise TypeError(f"lights holds {type(light).__name__}, expected a warpgi light")
        if sum(isinstance(light, Environment) for light in self.lights) > 1:
            raise ValueError("lights holds more than one Environment, expected at most one")
        if not isinstance(self.camera, Camera):
            raise TypeError(f"camera is {type(self.camera).__name__}, expected Camera")

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that a picture of it depends on."""
        return fingerprint(self.name, self.camera, self.lights, self.shapes)

    @property
    def triangle_count(self) -> int:
        """Triangles in all shapes."""
        return sum(len(shape.faces) for shape in self.shapes)

    @property
    def degenerate_count(self) -> int:
        """Triangles that were dropped because they have no area."""
        return sum(shape.degenerate_count for shape in self.shapes)

    @property
    def moves(self) -> bool:
        """Whether any shape does."""
        return any(shape.motion is not None for shape in self.shapes)

    @property
    def is_glossy(self) -> bool:
        """Whether any shape has a glossy lobe of some width, or is a mirror."""
        return any(isinstance(shape.material, (Conductor, Coated, Mirror)) for shape in self.shapes)

    @property
    def has_mirrors(self) -> bool:
        """Whether any shape is a mirror."""
        return any(isinstance(shape.material, Mirror) for shape in self.shapes)

    def bounds(self) -> np.ndarray:
        """Smallest and largest vertex coordinates at any time, shape (2, 3), float64."""
        ends = [shape.vertices for shape in self.shapes]
        ends += [shape.vertices + shape.motion for shape in self.shapes if shape.motion is not None]
        return np.stack([np.min([e.min(axis=0) for e in ends], axis=0), np.max([e.max(axis=0) for e in ends], axis=0)])

    def has_light(self) -> bool:
        """Whether anything in it emits."""
        for shape in self.shapes:
            if shape.emission is not None and max(shape.emission.radiance) > 0.0:  # type: ignore[arg-type]
                return True
        return any(_strength(light) > 0.0 for light in self.lights)


def _strength(light: Light) -> float:
    if isinstance(light, DistantLight):
        return max(light.irradiance)  # type: ignore[arg-type]
    if isinstance(light, Environment):
        return max(light.radiance)  # type: ignore[arg-type]
    return max(light.intensity)  # type: ignore[arg-type]
