"""Scenes from USD (Pixar, usd-core): meshes, UsdPreviewSurface, UsdLux and a camera, at the stage's first time.

A stage is turned to y up and scaled to metres, lights too: radiance does not change by that, and the power of a light
with a size follows from the size. Subdivision surfaces are taken as their control cage.
"""

from __future__ import annotations

import math
import posixpath
import warnings
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils

from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight
from warpgi.load_parts import (
    GREY,
    Parts,
    SceneFileError,
    albedo_texture,
    asset_path,
    emissive,
    fan,
    image_pixels,
    mean_colour,
    pbr_material,
    reflectance,
)
from warpgi.materials import Colour, Diffuse, Emissive, Material

# A rectangle of UsdLux lies in the x-y plane and shines along -z, so its corners go clockwise seen from +z.
RECT_CORNERS = np.array([(-0.5, -0.5, 0.0), (-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0)])
RECT_FACES = np.array([(0, 1, 2), (0, 2, 3)])
TIME = Usd.TimeCode.EarliestTime()


def read_usd(path: Path) -> Parts:
    """Everything the stage holds that a scene can hold."""
    try:
        _check_references(path)
        return _Reader(Usd.Stage.Open(str(path.resolve())), path).read()
    except Tf.ErrorException as error:
        raise SceneFileError(
            f"it cannot be read as USD ({str(error).strip().splitlines()[0].split(' : ')[-1]})"
        ) from error


def _check_references(path: Path) -> None:
    """Refuses a layer that refers outside the folder, in every layer below `path`, before a stage composes them."""
    folder = path.parent.resolve()
    packed = path.suffix.lower() == ".usdz"
    queue, seen = [str(path.resolve())], set()
    while queue:
        layer = queue.pop()
        if layer in seen:
            continue
        seen.add(layer)
        sublayers, references, payloads = UsdUtils.ExtractExternalReferences(layer)
        for reference in (*sublayers, *references, *payloads):
            if reference.startswith("`") or "://" in reference:
                raise SceneFileError(f"it refers to {reference!r}, an expression or address, which is refused")
            is_layer = Sdf.FileFormat.FindByExtension(PurePosixPath(reference).suffix[1:]) is not None
            if packed:
                inner = posixpath.dirname(layer.partition("[")[2].rstrip("]"))
                target = posixpath.normpath(posixpath.join(inner, reference))
                if target.startswith(("/", "..")):
                    raise SceneFileError(f"asset {reference!r} lies outside the .usdz, which is refused")
                if is_layer:
                    queue.append(f"{path.resolve()}[{target}]")
                continue
            file = asset_path(folder, reference, "asset", base=Path(layer).parent)
            if is_layer:
                # USD would go on to look for it in the working directory.
                if not file.is_file():
                    raise SceneFileError(f"asset {reference!r} is missing in {str(folder)!r}")
                queue.append(str(file))


class _Reader:
    def __init__(self, stage: Any, path: Path) -> None:
        self.stage, self.path = stage, path
        self.xforms = UsdGeom.XformCache(TIME)
        self.materials: dict[Any, tuple[Material, Emissive | None, str]] = {}
        self.metres = UsdGeom.GetStageMetersPerUnit(stage)
        self.to_world = np.diag([self.metres] * 3 + [1.0])
        if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:  # (x, y, z) -> (x, z, -y)
            self.to_world = self.to_world @ np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

    def read(self) -> Parts:
        parts = Parts()
        domes: list[np.ndarray] = []
        prims = iter(Usd.PrimRange(self.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
        for prim in prims:
            name = prim.GetName()
            if prim.IsA(UsdGeom.PointInstancer):
                warnings.warn(f"{name} is a point instancer, which is left out", stacklevel=2)
                prims.PruneChildren()
            if not prim.IsA(UsdGeom.Imageable) or self._is_hidden(prim):
                continue
            if prim.IsA(UsdGeom.Mesh):
                self._add_mesh(parts, prim)
            elif prim.IsA(UsdGeom.Camera) and parts.camera is None:
                parts.camera = self._camera(prim)
            elif prim.IsA(UsdLux.DomeLight):
                if UsdLux.DomeLight(prim).GetTextureFileAttr().Get(TIME):
                    warnings.warn(f"{name} has a texture, which is not read: its colour is taken", stacklevel=2)
                domes.append(_emission(prim))
            elif prim.HasAPI(UsdLux.LightAPI):
                self._add_light(parts, prim)
        if domes:
            parts.lights.append(Environment(_triple(np.sum(domes, axis=0))))
        return parts

    def _is_hidden(self, prim: Any) -> bool:
        imageable = UsdGeom.Imageable(prim)
        purpose = imageable.ComputePurpose()
        invisible = imageable.ComputeVisibility(TIME) == UsdGeom.Tokens.invisible
        return invisible or purpose in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)

    def _transform(self, prim: Any) -> np.ndarray:
        # USD multiplies row vectors from the left.
        return self.to_world @ np.array(self.xforms.GetLocalToWorldTransform(prim)).T

    # ---- meshes

    def _add_mesh(self, parts: Parts, prim: Any) -> None:
        mesh, name = UsdGeom.Mesh(prim), prim.GetName()
        points = np.array(mesh.GetPointsAttr().Get(TIME) or np.zeros((0, 3)), dtype=np.float64)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(TIME) or (), dtype=np.int64)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(TIME) or (), dtype=np.int64)
        if len(counts) == 0 or len(indices) == 0:
            parts.empty.append(name)
            return
        if counts.min() < 0 or counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
            raise SceneFileError(f"{name} has {len(indices)} face corners that do not fit its faces and points")
        corners, polygon = fan(counts)
        if mesh.GetOrientationAttr().Get(TIME) == UsdGeom.Tokens.leftHanded:
            corners = corners[:, ::-1]

        # Every corner becomes a vertex where an attribute varies by corner or face.
        primvars = UsdGeom.PrimvarsAPI(prim)
        raw_normals, normals_vary = None, UsdGeom.Tokens.vertex
        if primvars.GetPrimvar("normals"):
            primvar = primvars.GetPrimvar("normals")
            raw_normals, normals_vary = primvar.ComputeFlattened(TIME), primvar.GetInterpolation()
        elif mesh.GetNormalsAttr().HasAuthoredValue():
            raw_normals, normals_vary = mesh.GetNormalsAttr().Get(TIME), mesh.GetNormalsInterpolation()
        normals = _by_corner(raw_normals, normals_vary, counts, indices)

        rest = np.ones(len(counts), dtype=bool)
        groups = []
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            inside = np.zeros(len(counts), dtype=bool)
            inside[np.array(subset.GetIndicesAttr().Get(TIME) or (), dtype=np.int64)] = True
            rest &= ~inside
            groups.append((subset.GetPrim(), inside))
        groups.append((prim, rest))
        for bound, inside in groups:
            if not inside.any():
                continue
            material, emission, st = self._material(bound, prim)
            uv_primvar = primvars.GetPrimvar(st)
            uv = None
            if uv_primvar:
                uv = _by_corner(uv_primvar.ComputeFlattened(TIME), uv_primvar.GetInterpolation(), counts, indices)
            parts.add(
                name if bound == prim else f"{name} {bound.GetName()}",
                points[indices] if normals is not None or uv is not None else points,
                corners[inside[polygon]]
                if normals is not None or uv is not None
                else indices[corners[inside[polygon]]],
                material,
                transform=self._transform(prim),
                normals=normals,
                uv=uv,
                emission=emission,
            )

    # ---- materials

    def _material(self, bound: Any, mesh: Any) -> tuple[Material, Emissive | None, str]:
        """Material, emission and the name of the texture coordinates of what is bound to a mesh or a part of it."""
        material, _ = UsdShade.MaterialBindingAPI(bound).ComputeBoundMaterial()
        if not material:
            colours = UsdGeom.Gprim(mesh).GetDisplayColorAttr().Get(TIME)
            return (Diffuse(reflectance(mean_colour(np.array(colours)))) if colours else GREY), None, "st"
        key = material.GetPath()
        if key not in self.materials:
            shader = material.ComputeSurfaceSource()[0]
            if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
                warnings.warn(f"{key} has no UsdPreviewSurface, it is shown grey", stacklevel=2)
                self.materials[key] = GREY, None, "st"
            else:
                self.materials[key] = self._preview_surface(shader)
        return self.materials[key]

    def _preview_surface(self, shader: Any) -> tuple[Material, Emissive | None, str]:
        base: Colour | Any
        base, texture = self._input(shader, "diffuseColor", (0.18, 0.18, 0.18))
        st = "st"
        if texture is None:
            base = reflectance(base)
        else:
            base = albedo_texture(*base)
            reader = texture.GetInput("st")
            source = reader.GetConnectedSource() if reader and reader.HasConnectedSource() else None
            varname = UsdShade.Shader(source[0].GetPrim()).GetInput("varname") if source else None
            if varname and isinstance(varname.Get(TIME), str):
                st = varname.Get(TIME)
        metallic, roughness, opacity, ior = (
            float(np.mean(self._constant(shader, name, default)))
            for name, default in (("metallic", 0.0), ("roughness", 0.5), ("opacity", 1.0), ("ior", 1.5))
        )
        if self._constant(shader, "useSpecularWorkflow", 0) == 1:
            metallic = 0.0
        radiance = self._constant(shader, "emissiveColor", (0.0, 0.0, 0.0))
        return pbr_material(base, metallic, roughness, 1.0 - opacity, ior), emissive(radiance), st

    def _input(self, shader: Any, name: str, default: Any) -> tuple[Any, Any]:
        """An input's value and None, or (pixels, scale) and the texture shader it comes from."""
        given = shader.GetInput(name)
        attributes = given.GetValueProducingAttributes() if given else []
        if not attributes:
            return default, None
        source = UsdShade.Shader(attributes[0].GetPrim())
        if not UsdShade.Output.IsOutput(attributes[0]):
            value = attributes[0].Get(TIME)
            return (default if value is None else value), None
        if source.GetIdAttr().Get() != "UsdUVTexture":
            warnings.warn(f"{shader.GetPath()} has a {name} that is computed, its default is taken", stacklevel=2)
            return default, None
        file = source.GetInput("file")
        asset = file.GetValueProducingAttributes()[0].Get(TIME) if file and file.GetValueProducingAttributes() else None
        if asset is None:
            raise SceneFileError(f"{source.GetPath()} names no texture file")
        scale = source.GetInput("scale")
        factor = scale.Get(TIME) if scale else None
        pixels = image_pixels(self._asset_bytes(asset), asset.path)
        return (pixels, np.ones(3) if factor is None else np.array(factor)[:3]), source

    def _constant(self, shader: Any, name: str, default: Any) -> Any:
        """An input's value; a colour texture's mean with a warning, a data texture's mean over its channels."""
        value, texture = self._input(shader, name, default)
        if texture is None:
            return value
        warnings.warn(f"{shader.GetPath()} has a texture for {name}, its mean is taken everywhere", stacklevel=3)
        pixels, factor = value
        if name == "emissiveColor":
            return np.multiply(mean_colour(albedo_texture(pixels)), factor)
        connected = shader.GetInput(name).GetConnectedSource()[1]
        channel = {"g": 1, "b": 2}.get(connected, 0)
        return pixels[..., channel].mean() / 255.0 * factor[channel]

    def _asset_bytes(self, asset: Any) -> bytes:
        """A texture's content; the stage has resolved its path, against the layer that names it."""
        resolved = asset.resolvedPath
        if not resolved:
            raise SceneFileError(f"texture {asset.path!r} is missing in {str(self.path.parent)!r}")
        outer = Ar.SplitPackageRelativePathOuter(resolved)[0] if Ar.IsPackageRelativePath(resolved) else resolved
        asset_path(self.path.parent, outer, "texture")
        opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
        with opened:
            return bytes(opened.GetBuffer())

    # ---- lights and camera

    def _add_light(self, parts: Parts, prim: Any) -> None:
        transform = self._transform(prim)
        # The stage's own transform without the scale to metres: UsdLux normalizes by the area in stage units.
        stage_scale = np.abs(np.linalg.det(transform[:3, :3])) ** (1.0 / 3.0) / self.metres
        radiance = _emission(prim)
        normalize = UsdLux.LightAPI(prim).GetNormalizeAttr().Get(TIME)
        position, direction = _triple(transform[:3, 3]), _triple(-transform[:3, 2])
        if prim.IsA(UsdLux.DistantLight):
            angle = math.radians(UsdLux.DistantLight(prim).GetAngleAttr().Get(TIME))
            solid = 1.0 if normalize or angle == 0.0 else math.pi * math.sin(0.5 * angle) ** 2
            parts.lights.append(DistantLight(direction, _triple(solid * radiance)))
        elif prim.IsA(UsdLux.SphereLight):
            radius = UsdLux.SphereLight(prim).GetRadiusAttr().Get(TIME) * stage_scale
            # A sphere of that radiance shows a disc of area pi r^2; normalized, 4 pi r^2 is divided out.
            area = 0.25 if normalize else math.pi * radius * radius
            intensity = _triple(radiance * area * self.metres**2)
            shaping = UsdLux.ShapingAPI(prim)
            cone = shaping.GetShapingConeAngleAttr().Get(TIME) if prim.HasAPI(UsdLux.ShapingAPI) else None
            if cone is not None and 0.0 < cone < 90.0:
                softness = shaping.GetShapingConeSoftnessAttr().Get(TIME) or 0.0
                outer = math.radians(cone)
                inner = outer * min(max(1.0 - softness, 0.0), 0.999)
                parts.lights.append(SpotLight(position, direction, intensity, inner, outer))
            else:
                parts.lights.append(PointLight(position, intensity))
        elif prim.IsA(UsdLux.RectLight):
            light = UsdLux.RectLight(prim)
            size = np.array([light.GetWidthAttr().Get(TIME), light.GetHeightAttr().Get(TIME), 1.0])
            if light.GetTextureFileAttr().Get(TIME):
                warnings.warn(f"{prim.GetName()} has a texture, which is not read: its colour is taken", stacklevel=2)
            if normalize:
                sides = np.linalg.norm(transform[:3, :2], axis=0) * size[:2] / self.metres
                radiance = radiance / max(float(np.prod(sides)), 1e-30)
            emission = emissive(radiance)
            parts.add(
                prim.GetName(), RECT_CORNERS * size, RECT_FACES, Diffuse(0.0), transform=transform, emission=emission
            )
        else:
            warnings.warn(f"{prim.GetName()} is a {prim.GetTypeName()}, which is left out", stacklevel=2)

    def _camera(self, prim: Any) -> Camera | None:
        lens = UsdGeom.Camera(prim).GetCamera(TIME)
        if lens.projection != lens.Perspective:
            warnings.warn("the file's camera is orthographic, the default camera is taken", stacklevel=2)
            return None
        transform = self._transform(prim)
        position = transform[:3, 3]
        forward = -transform[:3, 2] / np.linalg.norm(transform[:3, 2])
        fov = math.degrees(2.0 * math.atan(0.5 * lens.verticalAperture / lens.focalLength))
        return Camera(_triple(position), _triple(position + forward), up=_triple(transform[:3, 1]), fov=fov)


def _by_corner(values: Any, interpolation: str, counts: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    """A primvar's values at every face corner, or None where there is none or their number does not fit."""
    if values is None or len(values) == 0:
        return None
    array = np.array(values, dtype=np.float64)
    if interpolation == UsdGeom.Tokens.constant:
        return np.broadcast_to(array[:1], (len(indices), array.shape[1]))
    if interpolation == UsdGeom.Tokens.uniform:
        return np.repeat(array, counts, axis=0) if len(array) == len(counts) else None
    if interpolation == UsdGeom.Tokens.faceVarying:
        return array if len(array) == len(indices) else None
    return array[indices] if indices.max() < len(array) else None


def _emission(prim: Any) -> np.ndarray:
    """intensity 2^exposure colour, times the colour of a black body where that is enabled."""
    light = UsdLux.LightAPI(prim)
    colour = np.array(light.GetColorAttr().Get(TIME), dtype=np.float64)
    if light.GetEnableColorTemperatureAttr().Get(TIME):
        colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(light.GetColorTemperatureAttr().Get(TIME)))
    return np.maximum(colour * light.GetIntensityAttr().Get(TIME) * 2.0 ** light.GetExposureAttr().Get(TIME), 0.0)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
