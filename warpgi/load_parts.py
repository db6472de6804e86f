"""What the scene readers share: asset paths that stay in the scene's folder, images, materials, placed meshes."""

from __future__ import annotations

import dataclasses
import io
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from warpgi.camera import Camera
from warpgi.lights import Light
from warpgi.materials import RGB, Coated, Colour, Conductor, Dielectric, Diffuse, Emissive, Material, Mirror, Texture
from warpgi.scene import Shape

GREY = Diffuse(0.8)
# PIL starts a PostScript interpreter for EPS: a scene from a stranger gets only formats that are plain pictures.
IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")


class SceneFileError(ValueError):
    """A sentence a reader wrote itself; whatever else escapes a reader is put into such a sentence."""


@dataclass
class Parts:
    """What a reader has found so far."""

    shapes: list[Shape] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    camera: Camera | None = None
    empty: list[str] = field(default_factory=list)
    """Meshes whose triangles all have no area, or that have none."""

    def add(
        self,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        material: Material = GREY,
        *,
        transform: np.ndarray | None = None,
        normals: np.ndarray | None = None,
        uv: np.ndarray | None = None,
        emission: Emissive | None = None,
    ) -> None:
        """Append a mesh, placed by `transform`, without the vertices that no face names.

        A transform that mirrors flips the winding, so that the outside stays outside. Normals go by the cofactor
        matrix: it is the inverse transpose times the determinant, and exists where a scale is 0.
        """
        faces = np.asarray(faces)
        if faces.size == 0:
            self.empty.append(name)
            return
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise SceneFileError(f"{name} has a face that names vertex {faces.max()} of {len(vertices)}")
        used = np.zeros(len(vertices), dtype=bool)
        used[faces] = True
        faces = (np.cumsum(used) - 1)[faces]
        vertices = np.asarray(vertices, dtype=np.float64)[used]
        normals = None if normals is None else np.asarray(normals, dtype=np.float64)[used]
        uv = None if uv is None else np.asarray(uv, dtype=np.float64)[used]
        if not np.isfinite(vertices).all() or (uv is not None and not np.isfinite(uv).all()):
            raise SceneFileError(f"{name} holds vertices or texture coordinates that are NaN or infinite")

        if transform is not None:
            linear = transform[:3, :3]
            vertices = vertices @ linear.T + transform[:3, 3]
            sign = -1.0 if np.linalg.det(linear) < 0.0 else 1.0
            if sign < 0.0:
                faces = faces[:, ::-1]
            if normals is not None:
                cofactors = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]])
                normals = sign * normals @ cofactors.T
        if normals is not None:
            normals = _unit_normals(normals, vertices, faces)

        textured = isinstance(getattr(material, "albedo", getattr(material, "reflectance", None)), Texture)
        if textured and uv is None:
            warnings.warn(f"{name} has no texture coordinates, its texture became its mean colour", stacklevel=2)
            material = _without_texture(material)
        try:
            shape = Shape(vertices, faces, material, emission, normals, uv if textured else None, name)
        except ValueError:  # everything else a Shape refuses was checked above: no triangle has an area
            self.empty.append(name)
            return
        self.shapes.append(shape)


def _without_texture(material: Material) -> Material:
    if isinstance(material, (Diffuse, Coated)):
        return dataclasses.replace(material, albedo=mean_colour(material.albedo))
    if isinstance(material, Dielectric):
        return material
    return dataclasses.replace(material, reflectance=mean_colour(material.reflectance))


def _unit_normals(normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of length 1; one that is 0 or NaN in the file becomes the area-weighted mean of its triangles'."""
    length = np.linalg.norm(normals, axis=1)
    bad = ~(np.isfinite(length) & (length > 0.0))
    if bad.any():
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        area_normals = np.repeat(np.cross(b - a, c - a), 3, axis=0)
        mean = np.stack([np.bincount(faces.ravel(), area_normals[:, i], len(vertices)) for i in range(3)], axis=1)
        normals = np.where(bad[:, None], mean, normals)
        length = np.linalg.norm(normals, axis=1)
        normals[length == 0.0] = (0.0, 1.0, 0.0)  # a vertex of triangles without area, which are dropped
    return normals / np.where(length > 0.0, length, 1.0)[:, None]


def fan(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fans over polygons of `counts` corners: corner indices, shape (T, 3), and the polygon of each triangle, (T,)."""
    triangles = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    first = (np.cumsum(counts) - counts)[polygon]
    step = np.arange(len(polygon)) - (np.cumsum(triangles) - triangles)[polygon]
    return np.stack([first, first + step + 1, first + step + 2], axis=1), polygon


def asset_path(folder: Path, reference: str, what: str, base: Path | None = None) -> Path:
    """The file that `reference` names from `base`, which is `folder` itself unless given, with links resolved.

    Raises:
        SceneFileError: it lies outside `folder`, however it says so: absolute, by `..` or through a link.
    """
    root = folder.resolve()
    resolved = ((base or root) / reference.replace("\\", "/")).resolve()
    if not resolved.is_relative_to(root):
        raise SceneFileError(f"{what} {reference!r} lies outside the scene's folder {str(root)!r}, which is refused")
    return resolved


def asset_bytes(folder: Path, reference: str, what: str) -> bytes:
    """The content of the file that `reference` names; refuses what lies outside `folder` and what is missing."""
    resolved = asset_path(folder, reference, what)
    if not resolved.is_file():
        raise SceneFileError(f"{what} {reference!r} is missing in {str(folder)!r}")
    return resolved.read_bytes()


def image_pixels(data: bytes, name: str) -> np.ndarray:
    """An encoded picture as uint8, shape (H, W, 3); 16-bit grey keeps its high byte, alpha is dropped."""
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
            if image.mode.startswith("I"):
                return np.repeat((np.asarray(image) >> 8).astype(np.uint8)[..., None], 3, axis=2)
            return np.asarray(image.convert("RGB"))
    except UnidentifiedImageError as error:
        raise SceneFileError(f"texture {name!r} is none of {', '.join(IMAGE_FORMATS)}") from error
    except Exception as error:
        raise SceneFileError(f"texture {name!r} is no picture that can be read: {error}") from error


def albedo_texture(pixels: np.ndarray, factor: Colour | np.ndarray = 1.0) -> Texture:
    """sRGB pixels as linear reflectance times `factor`."""
    linear = Texture.from_srgb(pixels)
    if np.all(np.equal(factor, 1.0)):
        return linear
    return Texture(np.clip(linear.pixels * np.asarray(factor, dtype=np.float32), 0.0, 1.0))


def mean_colour(colour: Colour | Texture | np.ndarray) -> RGB:
    """The mean of a texture or of rows of colours, shape (..., 3), or the colour itself."""
    values = np.asarray(colour.pixels if isinstance(colour, Texture) else colour, dtype=np.float64)
    red, green, blue = np.broadcast_to(values, (*values.shape[:-1], 3)).reshape(-1, 3).mean(axis=0).tolist()
    return red, green, blue


def reflectance(values: object) -> RGB:
    """Three numbers of a file, clipped to [0, 1]."""
    red, green, blue = np.clip(np.asarray(values, dtype=np.float64).reshape(3), 0.0, 1.0).tolist()
    return red, green, blue


def pbr_material(
    base: Colour | Texture, metallic: float, roughness: float, transmission: float = 0.0, ior: float = 1.5
) -> Material:
    """The nearest material to a metallic-roughness one, which is a mix that this library does not have.

    A metal's alpha = roughness^2 gives the Blinn exponent e = 2 / alpha^2 - 2 (Walter et al. 2007, sec. 5.2 relates
    Phong and Beckmann lobes so), and Conductor's roughness is 1 / e; below its range the metal is a mirror.
    """
    if metallic >= 0.5:
        alpha_squared = min(max(roughness, 0.0), 1.0) ** 4
        inverse_exponent = alpha_squared / (2.0 * (1.0 - alpha_squared)) if alpha_squared < 1.0 else 1.0
        return Mirror(base) if inverse_exponent < 1e-5 else Conductor(min(inverse_exponent, 1.0), base)
    if transmission > 0.5:
        return Dielectric(min(max(ior, 1.0), 4.0))
    return Diffuse(base)


def emissive(radiance: object, two_sided: bool = False) -> Emissive | None:
    """Emission of that linear radiance, or None where it is black."""
    values = np.maximum(np.asarray(radiance, dtype=np.float64).reshape(3), 0.0)
    red, green, blue = values.tolist()
    return Emissive((red, green, blue), two_sided) if values.any() else None
