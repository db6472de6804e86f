"""Scenes from .obj with .mtl, .ply and .stl, parsed by trimesh; the references in them are read here, before it is."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl

from warpgi.load_parts import (
    GREY,
    Parts,
    SceneFileError,
    albedo_texture,
    asset_bytes,
    asset_path,
    emissive,
    fan,
    image_pixels,
    mean_colour,
    pbr_material,
    reflectance,
)
from warpgi.materials import Colour, Dielectric, Diffuse, Emissive, Material, Mirror, Texture


def read_stl(path: Path) -> Parts:
    """The solids of a .stl; it knows neither shared vertices nor materials, so they are flat and grey."""
    return _placed(load_stl(io.BytesIO(path.read_bytes())), path.stem)


def read_ply(path: Path) -> Parts:
    """The faces of a .ply, with its vertex normals, in the mean of its vertex or face colours."""
    data = path.read_bytes()
    if b"texturefile" in data[: data.find(b"end_header")].lower():
        warnings.warn(f"{path.name} names a texture, which is not read from .ply", stacklevel=2)
    # Without fix_texture trimesh leaves the vertices as they stand: it would reorder them and not their normals.
    return _placed(load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True), path.stem)


def _placed(loaded: dict[str, Any], name: str) -> Parts:
    parts = Parts()
    meshes = loaded.get("geometry", {name: loaded})
    for key, mesh in meshes.items():
        faces = mesh.get("faces")
        if faces is None:
            parts.empty.append(key)
            continue
        parts.add(
            key, mesh["vertices"], _triangles(faces), _vertex_colour(mesh, key), normals=mesh.get("vertex_normals")
        )
    return parts


def _triangles(faces: Any) -> np.ndarray:
    """Polygons of equal size, shape (F, n), as triangles; others trimesh has cut already."""
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] < 3:
        raise SceneFileError(f"its faces have shape {faces.shape}, expected three corners or more each")
    if not np.issubdtype(faces.dtype, np.integer):
        raise SceneFileError(f"its faces are {faces.dtype}, expected whole numbers")
    corners, _ = fan(np.full(len(faces), faces.shape[1]))
    return faces.reshape(-1)[corners]


def _vertex_colour(mesh: dict[str, Any], name: str) -> Material:
    """Diffuse with the mean linear vertex or face colour, grey without any; bytes and fractions are sRGB."""
    colours = next((c for c in (mesh.get("vertex_colors"), mesh.get("face_colors")) if c is not None), None)
    if colours is None or len(colours) == 0:
        return GREY
    values = np.asarray(colours)[:, :3]
    if values.dtype.kind == "f" and values.max() <= 1.0:
        values = values * 255.0
    pixels = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    if np.ptp(pixels, axis=0).max() > 1:
        warnings.warn(f"{name} has vertex colours, their mean is taken for all of it", stacklevel=2)
    return Diffuse(mean_colour(Texture.from_srgb(pixels[None])))


# ---- Wavefront


def read_obj(path: Path) -> Parts:
    """The faces of a .obj, one shape per material of its .mtl."""
    text = path.read_bytes().decode("utf-8", errors="replace").replace("\r\n", "\n").replace("\\\n", " ")
    # trimesh finds a statement by "\nf " and the like, and reads commented ones too.
    text = "\n" + re.sub(r"(?m)^[ \t]*(#.*)?|[ \t]+$", "", text.replace("\t", " ")) + "\n"
    materials = _materials(text, path)
    numbers = {name: i for i, name in enumerate(dict.fromkeys(re.findall(r"(?m)^usemtl +(.*)$", text)))}
    names = list(numbers)

    # Its own reading of a .mtl opens textures and drops errors, so it gets one of names only: 0, 1, ...
    text = re.sub(r"(?m)^mtllib.*$", "", text)
    text = re.sub(r"(?m)^usemtl +(.*)$", lambda match: f"usemtl {numbers[match[1]]}", text)
    text = "mtllib names\n" + _absolute_indices(text)
    stub = "".join(f"newmtl {i}\n" for i in range(len(names)))
    with warnings.catch_warnings():
        # numpy only warns where it stops in the middle of the numbers.
        warnings.filterwarnings("error", message="string or file could not be read", category=DeprecationWarning)
        try:
            loaded = load_obj(io.StringIO(text), resolver={"names": stub})
        except DeprecationWarning as error:
            raise SceneFileError("its faces or vertices hold something that is no number") from error

    parts = Parts()
    meshes = loaded.get("geometry", {"": loaded})  # before 5.0 trimesh gives a single mesh as it is
    for mesh in reversed(meshes.values()):  # and always pops them from the end of the file
        visual = mesh.get("visual")
        number = str(getattr(getattr(visual, "material", None), "name", ""))
        name = names[int(number)] if number.isdigit() else path.stem
        if "faces" not in mesh:
            parts.empty.append(name)
            continue
        material, emission = materials[name] if name in materials else (_vertex_colour(mesh, name), None)
        uv = getattr(visual, "uv", None)
        parts.add(
            name,
            mesh["vertices"],
            _triangles(mesh["faces"]),
            material,
            normals=mesh.get("vertex_normals"),
            uv=uv if uv is not None and len(uv) == len(mesh["vertices"]) else None,
            emission=emission,
        )
    return parts


def _absolute_indices(text: str) -> str:
    """Faces that count back from their own line, as negative indices do; trimesh counts back from the file's end."""
    if not re.search(r"(?m)^f .*-", text):
        return text
    seen = {"v": 0, "vt": 0, "vn": 0}
    kinds = ("v", "vt", "vn")
    lines = text.split("\n")
    for i, line in enumerate(lines):
        keyword, _, rest = line.partition(" ")
        if keyword in seen:
            seen[keyword] += 1
        elif keyword == "f" and "-" in rest:
            corners = []
            for corner in rest.split():
                indices = [
                    str(seen[kind] + 1 + int(index)) if index.startswith("-") else index
                    for kind, index in zip(kinds, corner.split("/"), strict=False)
                ]
                if any(index.startswith("-") or index == "0" for index in indices):
                    raise SceneFileError(f"its face {line!r} counts back beyond the first vertex")
                corners.append("/".join(indices))
            lines[i] = "f " + " ".join(corners)
    return "\n".join(lines)


@dataclass
class _Mtl:
    """The statements of one `newmtl` that matter here, with the defaults of the format."""

    kd: Any = (0.8, 0.8, 0.8)
    ks: Any = (0.0, 0.0, 0.0)
    ke: Any = (0.0, 0.0, 0.0)
    ni: float = 1.5
    pm: float = 0.0
    pr: float = 1.0
    illum: int = 2
    map_kd: str | None = None


def _materials(text: str, path: Path) -> dict[str, tuple[Material, Emissive | None]]:
    """The materials of every .mtl that a .obj names; a missing .mtl is a warning, a missing texture an error."""
    found: dict[str, _Mtl] = {}
    libraries = re.findall(r"(?m)^mtllib +(.*)$", text)
    for reference in libraries:
        # The format allows several names in a line, exporters allow blanks in a name.
        whole = asset_path(path.parent, reference, "mtllib").is_file()
        for name in [reference] if whole else reference.split():
            file = asset_path(path.parent, name, "mtllib")
            if file.is_file():
                found.update(_parse_mtl(file.read_bytes().decode("utf-8", errors="replace")))
            else:
                warnings.warn(f"{path.name} names {name!r}, which is missing: its materials are grey", stacklevel=2)
    for mtl in found.values():  # all of them, before the first is opened
        if mtl.map_kd is not None:
            asset_path(path.parent, mtl.map_kd, "texture")
    used = set(re.findall(r"(?m)^usemtl +(.*)$", text))
    if found and used - found.keys():
        warnings.warn(f"{path.name} uses materials that no .mtl defines: {sorted(used - found.keys())}", stacklevel=2)
    return {name: _mtl_material(mtl, path.parent) for name, mtl in found.items() if name in used}


def _parse_mtl(text: str) -> dict[str, _Mtl]:
    found: dict[str, _Mtl] = {}
    mtl = _Mtl()
    for line in text.splitlines():
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        keyword, rest = keyword.lower(), rest.strip()
        if keyword == "newmtl":
            mtl = found[rest] = _Mtl()
        elif keyword == "map_kd":
            mtl.map_kd = _map_file(rest)
        elif keyword in ("kd", "ks", "ke"):
            values = [float(x) for x in rest.split()[:3]]
            setattr(mtl, keyword, values * 3 if len(values) == 1 else values)
        elif keyword in ("ni", "pm", "pr"):
            setattr(mtl, keyword, float(rest))
        elif keyword == "illum":
            mtl.illum = int(rest)
    return found


def _map_file(arguments: str) -> str:
    """The file name behind a map's options, which take one to three values each."""
    match = re.match(r"((-(?:o|s|t)( +[-+.\deE]+){1,3}|-mm( +\S+){2}|-[a-z]+ +\S+) +)*", arguments)
    options = match[0] if match else ""
    if re.search(r"-[ost] ", options):
        warnings.warn(f"the map options {options.strip()!r} are not applied", stacklevel=2)
    return arguments[len(options) :]


def _mtl_material(mtl: _Mtl, folder: Path) -> tuple[Material, Emissive | None]:
    base: Colour | Texture = reflectance(mtl.kd)
    emission = emissive(mtl.ke)
    if mtl.illum == 5:
        return Mirror(reflectance(mtl.ks)), emission
    if mtl.illum == 7:
        return Dielectric(min(max(mtl.ni, 1.0), 4.0)), emission
    if mtl.map_kd is not None:
        pixels = image_pixels(asset_bytes(folder, mtl.map_kd, "texture"), mtl.map_kd)
        base = albedo_texture(pixels, np.asarray(base))
    return pbr_material(base, mtl.pm, mtl.pr), emission
