"""The scene's arrays on a device."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import warp as wp

from warpgi.coat import fit_coat
from warpgi.device import Device
from warpgi.kernels import camera as camera_kernels
from warpgi.kernels import scene as kernels
from warpgi.kernels import triangles as triangle_kernels
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight
from warpgi.materials import Coated, Conductor, Dielectric, Diffuse, Material, Mirror, Texture
from warpgi.scene import Scene, Shape
from warpgi.triangle_tree import build_triangle_tree

KINDS = {
    Diffuse: kernels.DIFFUSE,
    Conductor: kernels.CONDUCTOR,
    Mirror: kernels.MIRROR,
    Dielectric: kernels.DIELECTRIC,
    Coated: kernels.COATED,
}

# Running sums of shares are float32: a light too weak for them would never be picked, so that each shape or light gets
# this share of the power at least, divided by their number.
LEAST_SHARE = 1e-3


# Fields of the struct that depend on triangles alone.
GEOMETRY = ("points", "indices", "face_normals", "face_shapes", "normals", "uvs", "moving", "motion", "tree")


class DeviceScene:
    """What kernels see of a scene, positions taken relative to its centre so that float32 serves far-away scenes.

    Args:
        scene: the scene.
        device: where its arrays live.
        before: another scene on that device, whose triangles and their tree are shared where they are the same.

    Attributes:
        struct: the `kernels.scene.Scene` argument of kernels.
        centre: float64 world position of the device's origin, shape (3,).
        power: radiant flux of all lights but the environment, mean over the channels [W], as light sampling knows it.
        nbytes: bytes of all arrays on the device.
    """

    def __init__(self, scene: Scene, device: Device, before: DeviceScene | None = None) -> None:
        self.scene = scene
        self.device = device
        low, high = scene.bounds()
        self.centre = 0.5 * (low + high)
        self.radius = 0.5 * float(np.linalg.norm(high - low))
        self.nbytes = 0
        self._arrays: list[wp.array] = []
        self._geometry_arrays: list[wp.array] = []
        self.first_face = np.cumsum([0] + [len(shape.faces) for shape in scene.shapes])
        self.struct = kernels.Scene()
        if before is not None and before.geometry == self.geometry:
            self._share_geometry(before)
        else:
            self._add_geometry()
        self._add_textures()
        self._add_lights_and_shapes()

    def camera(self, size: tuple[int, int]) -> camera_kernels.Camera:
        """The scene's camera for pictures of `size` = (width, height)."""
        camera = self.scene.camera
        right, up, forward = camera.frame()
        result = camera_kernels.Camera()
        result.position = wp.vec3(*(np.asarray(camera.position) - self.centre))
        result.right, result.up, result.forward = wp.vec3(*right), wp.vec3(*up), wp.vec3(*forward)
        result.tan_y = float(np.tan(np.radians(camera.fov) / 2.0))
        result.tan_x = result.tan_y * size[0] / size[1]
        result.lens_radius = camera.lens_radius
        distance = float(np.linalg.norm(np.subtract(camera.target, camera.position)))
        result.focus_distance = camera.focus_distance or distance
        result.shutter_open, result.shutter_length = camera.shutter[0], camera.shutter[1] - camera.shutter[0]
        result.width, result.height = size
        return result

    @cached_property
    def geometry(self) -> tuple[str, ...]:
        """Fingerprints of the shapes' triangles."""
        return tuple(shape.geometry_fingerprint for shape in self.scene.shapes)

    def _share_geometry(self, before: DeviceScene) -> None:
        for name in GEOMETRY:
            setattr(self.struct, name, getattr(before.struct, name))
        self._arrays += before._geometry_arrays
        self._geometry_arrays = before._geometry_arrays
        self.nbytes += sum(array.capacity for array in self._arrays)

    def _upload(self, values: np.ndarray, dtype: object) -> wp.array:
        array = self.device.array(values, dtype)
        self._arrays.append(array)  # structs do not keep their arrays alive
        self.nbytes += array.capacity
        return array

    def _add_geometry(self) -> None:
        shapes = self.scene.shapes
        starts = np.cumsum([0] + [len(shape.vertices) for shape in shapes])
        points = np.concatenate([shape.vertices - self.centre for shape in shapes])
        faces = np.concatenate([shape.faces + start for shape, start in zip(shapes, starts[:-1], strict=True)]).astype(
            np.int32
        )
        shape_of_face = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(shape.faces) for shape in shapes])
        a, b, c = (points[faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)

        struct = self.struct
        struct.points = self._upload(points.astype(np.float32), wp.vec3)
        struct.indices = self._upload(faces.ravel(), int)
        struct.face_normals = self._upload(normals.astype(np.float32), wp.vec3)
        struct.face_shapes = self._upload(shape_of_face, int)
        struct.normals = self._upload(_per_vertex([s.normals for s in shapes], starts, 3), wp.vec3)
        struct.uvs = self._upload(_per_vertex([s.uv for s in shapes], starts, 2), wp.vec2)
        struct.moving, struct.time = int(self.scene.moves), 0.0
        motion = None
        if struct.moving:
            still = [shape.motion is None for shape in shapes]
            motion = np.concatenate(
                [np.zeros_like(s.vertices) if none else s.motion for s, none in zip(shapes, still, strict=True)]
            ).astype(np.float32)
        struct.motion = self._upload(np.zeros((0, 3), np.float32) if motion is None else motion, wp.vec3)
        tree = triangle_kernels.TriangleTree()
        for name, values in build_triangle_tree(points.astype(np.float32), faces, motion).items():
            setattr(tree, name, self._upload(values, float if values.dtype == np.float32 else int))
        struct.tree = tree
        self._geometry_arrays = list(self._arrays)

    def _add_textures(self) -> None:
        self._textures: dict[int, int] = {}
        records: list[kernels.TextureRecord] = []
        texels: list[np.ndarray] = []
        start = 0
        for shape in self.scene.shapes:
            texture = shape.texture
            if texture is None or id(texture) in self._textures:
                continue
            self._textures[id(texture)] = len(records)
            height, width = texture.pixels.shape[:2]
            record = kernels.TextureRecord()
            record.start, record.width, record.height = start, width, height
            records.append(record)
            texels.append(texture.pixels.reshape(-1, 3).astype(np.float16))
            start += width * height
        self.struct.textures = self._upload(records, kernels.TextureRecord)  # type: ignore[arg-type]
        self.struct.texels = self._upload(np.concatenate(texels) if texels else np.zeros((0, 3), np.float16), wp.vec3h)

    def _add_lights_and_shapes(self) -> None:
        density: dict[int, float] = {}  # power per area of emissive shapes
        parts: list[np.ndarray] = []
        powers: list[np.ndarray] = []
        environment = np.zeros(3)
        for i, shape in enumerate(self.scene.shapes):
            if shape.emission is None or np.max(shape.emission.radiance) <= 0.0:
                continue
            density[i] = np.pi * float(np.mean(shape.emission.radiance)) * (2 if shape.emission.two_sided else 1)
            part = _light_records(len(shape.faces))
            part["face"] = np.arange(self.first_face[i], self.first_face[i + 1])
            parts.append(part)
            powers.append(density[i] * shape.areas())
        for light in self.scene.lights:
            if isinstance(light, Environment):
                environment = np.asarray(light.radiance)
                continue
            part, watts = self._light_record(light)
            if watts > 0.0:
                parts.append(part)
                powers.append(np.array([watts]))
        floor = LEAST_SHARE * sum(part.sum() for part in powers) / max(len(powers), 1)
        raise_by = [max(1.0, floor / part.sum()) for part in powers]
        powers = [part * factor for part, factor in zip(powers, raise_by, strict=True)]
        density = {i: value * factor for (i, value), factor in zip(density.items(), raise_by, strict=False)}
        power = np.concatenate(powers) if powers else np.zeros(0)
        self.power = float(power.sum())
        total = self.power or 1.0
        struct = self.struct
        struct.environment = wp.vec3(*environment)
        struct.light_count = len(power)
        struct.lights = self._upload(np.concatenate([_light_records(0), *parts]), kernels.LightRecord)
        cdf = np.cumsum(power / total)
        cdf[-1:] = 1.0
        struct.light_cdf = self._upload(cdf.astype(np.float32), float)
        struct.visible_light = int(bool(density) or environment.max() > 0.0)
        records = [self._shape_record(s, density.get(i, 0.0) / total) for i, s in enumerate(self.scene.shapes)]
        struct.shapes = self._upload(records, kernels.ShapeRecord)  # type: ignore[arg-type]

    def _light_record(self, light: PointLight | SpotLight | DistantLight) -> tuple[np.ndarray, float]:
        """One light's record, shape (1,), and its power [W]."""
        record = _light_records(1)
        if isinstance(light, DistantLight):
            record["distant"] = 1
            record["direction"] = light.direction
            record["radiance"] = light.irradiance
            return record, float(np.mean(light.irradiance)) * np.pi * self.radius**2
        record["position"] = np.asarray(light.position) - self.centre
        record["radiance"] = light.intensity
        if isinstance(light, PointLight):
            return record, float(np.mean(light.intensity)) * 4.0 * np.pi
        inner, outer = np.cos(light.inner_angle), np.cos(light.outer_angle)
        scale = 1.0 / max(inner - outer, 1e-6)
        record["direction"] = light.direction
        record["cone_scale"] = scale
        record["cone_offset"] = -outer * scale
        return record, float(np.mean(light.intensity)) * 2.0 * np.pi * (1.0 - (2.0 * inner + outer) / 3.0)

    def _shape_record(self, shape: Shape, light_pdf: float) -> kernels.ShapeRecord:
        record = material_record(shape.material)
        if shape.texture is not None:
            record.texture = self._textures[id(shape.texture)]
        if shape.emission is not None:
            record.emission = wp.vec3(*shape.emission.radiance)  # type: ignore[misc]
            record.two_sided = int(shape.emission.two_sided)
            record.light_pdf = light_pdf
        record.has_normals = int(shape.normals is not None)
        return record


def material_record(material: Material) -> kernels.ShapeRecord:
    """What a BSDF needs of a material; a texture's place is taken by white."""
    record = kernels.ShapeRecord()
    record.kind = int(KINDS[type(material)])
    record.texture = -1
    record.ior = 1.0
    if isinstance(material, Dielectric):
        record.ior = material.ior
    else:
        colour = material.albedo if isinstance(material, (Diffuse, Coated)) else material.reflectance
        record.albedo = wp.vec3(1.0) if isinstance(colour, Texture) else wp.vec3(*colour)  # type: ignore[misc]
    if isinstance(material, Conductor):
        record.exponent = 1.0 / material.roughness
        if material.eta is not None and material.k is not None:
            record.eta = wp.vec3(*material.eta)  # type: ignore[misc]
            record.k = wp.vec3(*material.k)  # type: ignore[misc]
    if isinstance(material, Coated):
        coat = fit_coat(material.roughness, material.ior)
        record.exponent, record.ior = 1.0 / material.roughness, material.ior
        record.eta, record.k = wp.vec3(*coat.coefficients[:3]), wp.vec3(*coat.coefficients[3:])
        record.coat = wp.vec3(coat.excess, 1.0 / coat.transmitted, coat.internal)
    return record


def _light_records(count: int) -> np.ndarray:
    """Records of point lights at the origin, to be filled in."""
    records = np.zeros(count, dtype=kernels.LightRecord.numpy_dtype())
    records["face"] = -1
    records["cone_offset"] = 1.0
    return records


def _per_vertex(parts: list[np.ndarray | None], starts: np.ndarray, width: int) -> np.ndarray:
    """The shapes' per-vertex values one after another; empty where no shape has any."""
    if all(part is None for part in parts):
        return np.zeros((0, width), np.float32)
    values = np.zeros((int(starts[-1]), width), np.float32)
    for part, start in zip(parts, starts[:-1], strict=True):
        if part is not None:
            values[start : start + len(part)] = part
    return values
