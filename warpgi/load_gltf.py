"""Scenes from glTF 2.0 (Khronos 2021): the triangles through trimesh, all else from the JSON.

trimesh (5.2) drops lights and emissive strengths, keeps one camera without its parents, and hides what hangs below a
camera node. So it gets a document of one mesh per primitive, named by its indices; nodes and materials are read here.
"""

from __future__ import annotations

import base64
import io
import json
import math
import struct
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from trimesh.exchange.gltf import load_gltf

from warpgi.camera import Camera
from warpgi.lights import DistantLight, Light, PointLight, SpotLight
from warpgi.load_parts import (
    GREY,
    Parts,
    SceneFileError,
    albedo_texture,
    asset_bytes,
    asset_path,
    emissive,
    image_pixels,
    mean_colour,
    pbr_material,
    reflectance,
)
from warpgi.materials import Colour, Diffuse, Emissive, Material, Texture

# The luminous efficacy that Blender's exporter multiplies by: dividing gives back the watts that were typed there.
LUMENS_PER_WATT = 683.0
# Extensions that a file may *require*; KHR_materials_* only change how well we match.
KNOWN = {"KHR_lights_punctual", "KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp"}
TRIANGLES, STRIP, FAN = 4, 5, 6


def read_gltf(path: Path) -> Parts:
    """Everything a .gltf or .glb holds that a scene can hold."""
    data = path.read_bytes()
    document, binary = _split_glb(data) if path.suffix.lower() == ".glb" else (json.loads(data), b"")
    return _Reader(document, binary, path).read()


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20 or data[:4] != b"glTF":
        raise SceneFileError("it does not start with the header of a .glb")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data):
        raise SceneFileError(f"its header says version {version} and {length} bytes, there are {len(data)}")
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise SceneFileError(f"its chunk at byte {at} says {size} bytes and is cut off")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if b"JSON" not in chunks:
        raise SceneFileError("it has no JSON chunk")
    return json.loads(chunks[b"JSON"]), chunks.get(b"BIN\0", b"")


class _Reader:
    def __init__(self, document: dict[str, Any], binary: bytes, path: Path) -> None:
        self.document, self.binary, self.folder = document, binary, path.parent
        self.materials: dict[int, tuple[Material, Emissive | None]] = {}
        major = str(document.get("asset", {}).get("version", "")).split(".")[0]
        if major != "2":
            raise SceneFileError(f"its asset version starts with {major!r}, expected '2'")
        for name in document.get("extensionsRequired", []):
            if name not in KNOWN and not name.startswith("KHR_materials_"):
                raise SceneFileError(f"it requires the extension {name}, which is not supported")
        for kind in ("buffers", "images"):  # all of them, before the first is opened
            for item in document.get(kind, []):
                if "uri" in item and not item["uri"].startswith("data:"):
                    asset_path(self.folder, unquote(item["uri"]), f"{kind[:-1]} uri")

    def read(self) -> Parts:
        parts = Parts()
        placed = list(self._nodes())
        if not self.document.get("nodes"):
            placed = [({"mesh": i}, np.eye(4)) for i in range(len(self.document.get("meshes", [])))]
        for node, transform in placed:
            if "mesh" in node:
                self._add_mesh(parts, node, transform)
            if "camera" in node and parts.camera is None:
                parts.camera = _camera(self.document["cameras"][node["camera"]], transform)
            light = node.get("extensions", {}).get("KHR_lights_punctual")
            if light is not None:
                lights = self.document["extensions"]["KHR_lights_punctual"]["lights"]
                parts.lights.append(_light(lights[light["light"]], transform))
        return parts

    def _nodes(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """Every node of the default scene with its transform to the world, parents first."""
        nodes = self.document.get("nodes", [])
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [i for i in range(len(nodes)) if i not in children]
        stack = [(root, np.eye(4)) for root in reversed(roots)]
        seen: set[int] = set()
        while stack:
            index, parent = stack.pop()
            if index in seen:
                raise SceneFileError(f"its node {index} hangs in the scene twice")
            seen.add(index)
            transform = parent @ _local_transform(nodes[index])
            stack.extend((child, transform) for child in reversed(nodes[index].get("children", [])))
            yield nodes[index], transform

    # ---- geometry

    @cached_property
    def buffers(self) -> list[bytes]:
        buffers = []
        for i, item in enumerate(self.document.get("buffers", [])):
            data = self._uri_bytes(item["uri"], "buffer uri") if "uri" in item else self.binary
            if len(data) < item["byteLength"]:
                raise SceneFileError(f"its buffer {i} has {len(data)} bytes, expected {item['byteLength']}")
            buffers.append(data)
        return buffers

    def _uri_bytes(self, uri: str, what: str) -> bytes:
        if not uri.startswith("data:"):
            return asset_bytes(self.folder, unquote(uri), what)
        head, _, payload = uri.partition(",")
        return base64.b64decode(unquote(payload)) if head.endswith(";base64") else unquote_to_bytes(payload)

    @cached_property
    def geometry(self) -> dict[str, dict[str, Any]]:
        """Per primitive "mesh.primitive": vertices, faces, and the file's own normals, uv and colours, undecoded."""
        meshes = []
        for i, mesh in enumerate(self.document.get("meshes", [])):
            for j, primitive in enumerate(mesh["primitives"]):
                mode = primitive.get("mode", TRIANGLES)
                if mode == FAN:
                    warnings.warn(f"{mesh.get('name', i)} has a triangle fan, which is left out", stacklevel=2)
                if mode not in (TRIANGLES, STRIP) or "POSITION" not in primitive["attributes"]:
                    continue
                # A leading underscore makes it a custom attribute, which trimesh hands over as it stands.
                attributes = {
                    name if name in ("POSITION", "NORMAL") else f"_{name}": accessor
                    for name, accessor in primitive["attributes"].items()
                    if name in ("POSITION", "NORMAL", "COLOR_0") or name.startswith("TEXCOORD_")
                }
                stripped = {"attributes": attributes, "mode": mode}
                if "indices" in primitive:
                    stripped["indices"] = primitive["indices"]
                for accessor in (*attributes.values(), *([primitive["indices"]] if "indices" in primitive else [])):
                    item = self.document["accessors"][accessor]
                    if "sparse" in item or "bufferView" not in item:  # trimesh would read zeros
                        raise SceneFileError(
                            f"its accessor {accessor} is sparse or without data, which is not supported"
                        )
                meshes.append({"name": f"{i}.{j}", "primitives": [stripped]})
        if not meshes:
            return {}
        header = {
            "asset": {"version": "2.0"},
            "buffers": [{"uri": str(i)} for i in range(len(self.buffers))],
            "bufferViews": self.document.get("bufferViews", []),
            "accessors": self.document["accessors"],
            "meshes": meshes,
        }
        contents = {str(i): data for i, data in enumerate(self.buffers)}
        return load_gltf(io.BytesIO(json.dumps(header).encode()), resolver=contents, skip_materials=True)["geometry"]

    def _decoded(self, values: np.ndarray, accessor: int) -> np.ndarray:
        """Accessor values as floats (glTF 2.0, sec. 3.11): normalized integers are fractions."""
        if values.dtype.kind == "f" or not self.document["accessors"][accessor].get("normalized"):
            return values.astype(np.float64)
        return np.maximum(values / np.iinfo(values.dtype).max, -1.0)

    def _add_mesh(self, parts: Parts, node: dict[str, Any], transform: np.ndarray) -> None:
        mesh = self.document["meshes"][node["mesh"]]
        name = str(node.get("name", mesh.get("name", f"mesh {node['mesh']}")))
        if "skin" in node:
            warnings.warn(f"{name} is skinned, it is shown without its skeleton", stacklevel=2)
        for j, primitive in enumerate(mesh["primitives"]):
            loaded = self.geometry.get(f"{node['mesh']}.{j}")
            if loaded is None:
                continue
            accessors, custom = primitive["attributes"], loaded.get("vertex_attributes", {})
            material, emission = self._material(primitive.get("material"))
            uv_info = self._base_texture(primitive.get("material"))
            uv = None
            if uv_info is not None:
                transform_extension = uv_info.get("extensions", {}).get("KHR_texture_transform", {})
                key = f"TEXCOORD_{transform_extension.get('texCoord', uv_info.get('texCoord', 0))}"
                if key in accessors:
                    uv = _uv(self._decoded(custom[f"_{key}"], accessors[key]), transform_extension)
            if "COLOR_0" in accessors:
                colours = self._decoded(custom["_COLOR_0"], accessors["COLOR_0"])[:, :3]
                material = _tinted(material, colours, name)
            normals = loaded.get("vertex_normals")
            parts.add(
                name if len(mesh["primitives"]) == 1 else f"{name} {j}",
                self._decoded(loaded["vertices"], accessors["POSITION"]),
                loaded["faces"],
                material,
                transform=transform,
                normals=None if normals is None else self._decoded(normals, accessors["NORMAL"]),
                uv=uv,
                emission=emission,
            )

    # ---- materials

    def _base_texture(self, index: int | None) -> dict[str, Any] | None:
        if index is None:
            return None
        return self.document["materials"][index].get("pbrMetallicRoughness", {}).get("baseColorTexture")

    def _pixels(self, texture_info: dict[str, Any]) -> np.ndarray:
        texture = self.document["textures"][texture_info["index"]]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            raise SceneFileError(f"its texture {texture_info['index']} has no source that can be read")
        image = self.document["images"][source]
        if "uri" in image:
            data, name = self._uri_bytes(image["uri"], "texture"), image["uri"][:80]
        else:
            view = self.document["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            data = self.buffers[view["buffer"]][start : start + view["byteLength"]]
            name = str(image.get("name", source))
        return image_pixels(data, name)

    def _material(self, index: int | None) -> tuple[Material, Emissive | None]:
        if index is None:
            return GREY, None
        if index not in self.materials:
            self.materials[index] = self._new_material(self.document["materials"][index], index)
        return self.materials[index]

    def _new_material(self, item: dict[str, Any], index: int) -> tuple[Material, Emissive | None]:
        name = item.get("name", f"material {index}")
        extensions = item.get("extensions", {})
        pbr = item.get("pbrMetallicRoughness", {})
        if item.get("alphaMode", "OPAQUE") != "OPAQUE":
            warnings.warn(f"{name} has alpha mode {item['alphaMode']}, it is shown opaque", stacklevel=2)

        base: Colour | Texture = reflectance(pbr.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3])
        if "baseColorTexture" in pbr:
            base = albedo_texture(self._pixels(pbr["baseColorTexture"]), np.asarray(base))
        metallic, roughness = pbr.get("metallicFactor", 1.0), pbr.get("roughnessFactor", 1.0)
        if "metallicRoughnessTexture" in pbr:  # data, not colour: green is roughness and blue metallic, linear
            mean = self._pixels(pbr["metallicRoughnessTexture"]).reshape(-1, 3).mean(axis=0) / 255.0
            roughness, metallic = roughness * mean[1], metallic * mean[2]
        transmission = extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0)
        ior = extensions.get("KHR_materials_ior", {}).get("ior", 1.5)

        radiance = np.asarray(item.get("emissiveFactor", (0.0, 0.0, 0.0)), dtype=np.float64)
        radiance = radiance * extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        if "emissiveTexture" in item and radiance.any():
            warnings.warn(f"{name} has an emissive texture, it emits the mean of it everywhere", stacklevel=2)
            radiance = radiance * mean_colour(albedo_texture(self._pixels(item["emissiveTexture"])))
        material = pbr_material(base, metallic, roughness, transmission, ior)
        return material, emissive(radiance, bool(item.get("doubleSided", False)))


def _tinted(material: Material, colours: np.ndarray, name: str) -> Material:
    """A diffuse material times the mean of the vertex colours, which glTF stores linear."""
    if not isinstance(material, Diffuse):
        return material
    if np.ptp(colours, axis=0).max() > 1.0 / 255.0:
        warnings.warn(f"{name} has vertex colours, their mean is taken for all of it", stacklevel=2)
    mean = np.clip(mean_colour(colours), 0.0, 1.0)
    if isinstance(material.albedo, Texture):
        return Diffuse(Texture(material.albedo.pixels * mean.astype(np.float32)))
    return Diffuse(reflectance(mean * material.albedo))


def _uv(uv: np.ndarray, extension: dict[str, Any]) -> np.ndarray:
    """KHR_texture_transform applied, and v turned over: glTF's origin is the upper left corner.

    It turns counter-clockwise as seen, so with v downwards; the extension's text and its example say so, its GLSL
    does not.
    """
    if extension:
        angle = extension.get("rotation", 0.0)
        cos, sin = math.cos(angle), math.sin(angle)
        uv = uv * extension.get("scale", (1.0, 1.0)) @ np.array([[cos, -sin], [sin, cos]])
        uv = uv + extension.get("offset", (0.0, 0.0))
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)


def _local_transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.asarray(node["matrix"], dtype=np.float64).reshape(4, 4).T
    transform = np.eye(4)
    x, y, z, w = np.asarray(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64)
    squared = x * x + y * y + z * z + w * w
    s = 2.0 / squared if squared > 0.0 else 0.0
    rotation = np.array([
        [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
    ])  # fmt: skip
    transform[:3, :3] = rotation * np.asarray(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    transform[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return transform


def _camera(item: dict[str, Any], transform: np.ndarray) -> Camera | None:
    if "perspective" not in item:
        warnings.warn("the file's camera is orthographic, the default camera is taken", stacklevel=2)
        return None
    position = transform[:3, 3]
    forward = -transform[:3, 2] / np.linalg.norm(transform[:3, 2])
    fov = math.degrees(item["perspective"]["yfov"])
    return Camera(tuple(position), tuple(position + forward), up=tuple(transform[:3, 1]), fov=fov)


def _light(item: dict[str, Any], transform: np.ndarray) -> Light:
    """A light of KHR_lights_punctual: candela or lux on -Z of its node, whose scale does not matter."""
    strength = item.get("intensity", 1.0) / LUMENS_PER_WATT
    red, green, blue = (np.asarray(item.get("color", (1.0, 1.0, 1.0)), dtype=np.float64) * strength).tolist()
    position, direction = tuple(transform[:3, 3]), tuple(-transform[:3, 2])
    if item["type"] == "directional":
        return DistantLight(direction, (red, green, blue))
    if item["type"] == "point":
        return PointLight(position, (red, green, blue))
    if item["type"] == "spot":
        outer = item.get("spot", {}).get("outerConeAngle", math.pi / 4)
        inner = min(item.get("spot", {}).get("innerConeAngle", 0.0), 0.999 * outer)
        return SpotLight(position, direction, (red, green, blue), inner, outer)
    raise SceneFileError(f"its light {item.get('name', '')!r} is of type {item['type']!r}, which is unknown")
