"""Scenes from files: what is read, where it ends up in the world, and what is refused."""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import math
import struct

import numpy as np
import pytest
from PIL import Image

from warpgi import Camera, Conductor, Dielectric, Diffuse, DistantLight, Environment, Mirror, PointLight, SpotLight
from warpgi.load import load_scene
from warpgi.materials import Texture

# A cube of edge 2 around the origin, counter-clockwise seen from outside: its signed volume is +8.
CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
CUBE_QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
CUBE_FACES = CUBE_QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float32)
SQUARE_FACES = np.array([(0, 1, 2), (0, 2, 3)])
# float32 in the file: 24 bits, and a transform adds a few roundings of values below 10.
FLOAT32 = {"rtol": 1e-6, "atol": 1e-6}


class Gltf:
    """A glTF document under construction: JSON and one buffer, made by hand."""

    def __init__(self, **top):
        self.json = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], **top}
        self.data = b""

    def view(self, data: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values, normalized=False) -> int:
        values = np.ascontiguousarray(values)
        component = {"float32": 5126, "uint32": 5125, "uint16": 5123}[values.dtype.name]
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[1 if values.ndim == 1 else values.shape[1]]
        item = {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values)}
        self.json["accessors"].append({**item, "type": kind, "normalized": normalized})
        return len(self.json["accessors"]) - 1

    def mesh(self, vertices, faces, material=None, normals=None, uv=None, name="thing") -> int:
        attributes = {"POSITION": self.accessor(np.asarray(vertices, dtype=np.float32))}
        if normals is not None:
            attributes["NORMAL"] = self.accessor(np.asarray(normals, dtype=np.float32))
        if uv is not None:
            uv = np.asarray(uv)
            attributes["TEXCOORD_0"] = self.accessor(uv, normalized=uv.dtype == np.uint16)
        primitive = {"attributes": attributes, "indices": self.accessor(np.asarray(faces, np.uint32).ravel())}
        if material is not None:
            primitive["material"] = material
        self.json["meshes"].append({"name": name, "primitives": [primitive]})
        return len(self.json["meshes"]) - 1

    def glb(self) -> bytes:
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def gltf(self, uri=None) -> str:
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        self.json["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.json)

    def load(self, folder):
        path = folder / "scene.glb"
        path.write_bytes(self.glb())
        return load_scene(path)


def png(pixels) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(stream, "PNG")
    return stream.getvalue()


def to_linear(srgb):
    c = np.asarray(srgb) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def signed_volume(shape) -> float:
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def one_square(**material):
    file = Gltf(materials=[material], nodes=[{"mesh": 0}])
    file.mesh(SQUARE, SQUARE_FACES, material=0)
    return file


# ---- transforms


def test_mirrored_nested_node_keeps_its_outside(tmp_path):
    """A cube below a rotated and a mirrored, unevenly scaled node lands where the matrices say, outside outside."""
    file = Gltf(
        nodes=[
            {"children": [1], "translation": [5, 0, 0], "rotation": [0, 0, math.sqrt(0.5), math.sqrt(0.5)]},
            {"mesh": 0, "scale": [-1, 2, 3], "translation": [0, 1, 0]},
        ],
        scenes=[{"nodes": [0]}],
    )
    file.mesh(CUBE, CUBE_FACES, normals=CUBE / math.sqrt(3.0))
    (shape,) = file.load(tmp_path).shapes
    scaled = CUBE * (-1, 2, 3) + (0, 1, 0)
    # A quarter turn about z takes (x, y) to (-y, x).
    expected = np.stack([5.0 - scaled[:, 1], scaled[:, 0], scaled[:, 2]], axis=1)
    np.testing.assert_allclose(shape.vertices, expected, **FLOAT32)
    assert signed_volume(shape) == pytest.approx(8.0 * 6.0, rel=1e-6)
    # Inverse transpose of the scale, then the same turn; the length is 1.
    bent = CUBE / (-1, 2, 3)
    bent = np.stack([-bent[:, 1], bent[:, 0], bent[:, 2]], axis=1)
    np.testing.assert_allclose(shape.normals, bent / np.linalg.norm(bent, axis=1)[:, None], **FLOAT32)


def test_matrix_node_and_children_of_a_camera(tmp_path):
    """A `matrix` is column-major, and what hangs below a camera node is seen."""
    matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]
    file = Gltf(
        cameras=[{"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}],
        nodes=[{"matrix": matrix, "camera": 0, "children": [1]}, {"mesh": 0, "translation": [0, 0, -3]}],
    )
    file.mesh(SQUARE, SQUARE_FACES)
    scene = file.load(tmp_path)
    np.testing.assert_allclose(scene.shapes[0].vertices, np.add(SQUARE, (7, 8, 6)), **FLOAT32)
    assert scene.camera.position == (7, 8, 9)


def test_an_instance_is_a_shape(tmp_path):
    """A mesh that two nodes share is there twice; only the default scene is read."""
    file = Gltf(
        nodes=[{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 4]}, {"mesh": 0}],
        scenes=[{"nodes": [2]}, {"nodes": [0, 1]}],
    )
    file.json["scene"] = 1
    file.mesh(SQUARE, SQUARE_FACES)
    shapes = file.load(tmp_path).shapes
    assert [shape.vertices[:, 2].max() for shape in shapes] == [0, 4]


def test_normals_only_where_the_file_has_them(tmp_path):
    """A mesh without normals stays flat; a normal of length 0 becomes the mean of its triangles'."""
    file = Gltf(nodes=[{"mesh": 0}, {"mesh": 1}])
    file.mesh(SQUARE, SQUARE_FACES)
    file.mesh(SQUARE, SQUARE_FACES, normals=[(0, 0, 1), (0, 0, 0), (0, 0, 2), (0, 0, 1)])
    flat, smooth = file.load(tmp_path).shapes
    assert flat.normals is None
    np.testing.assert_allclose(smooth.normals, [(0, 0, 1)] * 4, atol=1e-12)


def test_unused_vertices_are_dropped(tmp_path):
    """A vertex that no face names neither moves the camera nor has to be finite."""
    file = Gltf(nodes=[{"mesh": 0}])
    file.mesh([*SQUARE, (np.nan, 1e9, 0)], SQUARE_FACES)
    assert len(file.load(tmp_path).shapes[0].vertices) == 4


# ---- camera and lights


def test_camera_looks_down_minus_z_of_its_node(tmp_path):
    """Position, direction, up and vertical fov of a camera come from its node and yfov."""
    turn = [0, math.sqrt(0.5), 0, math.sqrt(0.5)]  # a quarter turn about y takes -z to -x
    file = Gltf(
        cameras=[{"type": "perspective", "perspective": {"yfov": 1.0, "aspectRatio": 2.0, "znear": 0.1}}],
        nodes=[{"mesh": 0}, {"children": [2], "translation": [1, 2, 3]}, {"camera": 0, "rotation": turn}],
    )
    file.mesh(SQUARE, SQUARE_FACES)
    camera = file.load(tmp_path).camera
    assert camera.position == (1, 2, 3)
    np.testing.assert_allclose(camera.frame(), [(0, 0, -1), (0, 1, 0), (-1, 0, 0)], atol=1e-12)
    assert camera.fov == pytest.approx(math.degrees(1.0))


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_default_camera_frames_the_scene(tmp_path, offset):
    """Without a camera every vertex is inside the view's cone, with a margin of 5 %, and seen from above."""
    (tmp_path / "cube.obj").write_text(
        "".join(f"v {x + offset} {y} {z}\n" for x, y, z in CUBE * (3, 1, 1))
        + "".join("f {} {} {}\n".format(*(face + 1)) for face in CUBE_FACES)
    )
    scene = load_scene(tmp_path / "cube.obj")
    camera = scene.camera
    local = (scene.shapes[0].vertices - camera.position) @ camera.frame().T
    assert camera.fov == 40.0
    assert np.degrees(np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])).max() < 20.0
    np.testing.assert_allclose(camera.target, (offset, 0, 0), atol=1e-9)
    distance = math.dist(camera.position, camera.target)
    assert distance * math.sin(math.radians(20.0)) == pytest.approx(1.05 * math.sqrt(11.0), rel=1e-9)
    assert camera.position[1] > 1.0


def test_no_light_means_a_white_environment(tmp_path):
    """A file without any light is lit by radiance 1 from everywhere; one that emits is not."""
    assert one_square().load(tmp_path).lights == (Environment((1.0, 1.0, 1.0)),)
    assert one_square(emissiveFactor=[1, 0, 0]).load(tmp_path).lights == ()


def test_punctual_lights(tmp_path):
    """Candela and lux become W/sr and W/m^2 by 683 lm/W; spot and sun shine along -z of their node."""
    down = [-math.sqrt(0.5), 0, 0, math.sqrt(0.5)]  # about x: -z to -y
    lights = [
        {"type": "point", "intensity": 683.0, "color": [1, 0.5, 0]},
        {"type": "spot", "intensity": 1366.0, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6}},
        {"type": "directional", "intensity": 2049.0},
    ]
    file = Gltf(
        extensions={"KHR_lights_punctual": {"lights": lights}},
        nodes=[
            {"mesh": 0},
            *(
                {"translation": [0, i, 0], "rotation": down, "extensions": {"KHR_lights_punctual": {"light": i}}}
                for i in range(3)
            ),
        ],
    )
    file.mesh(SQUARE, SQUARE_FACES)
    point, spot, sun = file.load(tmp_path).lights
    assert isinstance(point, PointLight)
    assert isinstance(spot, SpotLight)
    assert isinstance(sun, DistantLight)
    assert (point.position, spot.position) == ((0, 0, 0), (0, 1, 0))
    np.testing.assert_allclose(point.intensity, (1, 0.5, 0), rtol=1e-12)
    np.testing.assert_allclose(spot.intensity, (2, 2, 2), rtol=1e-12)
    np.testing.assert_allclose(sun.irradiance, (3, 3, 3), rtol=1e-12)
    np.testing.assert_allclose([spot.direction, sun.direction], [(0, -1, 0)] * 2, atol=1e-12)
    assert (spot.inner_angle, spot.outer_angle) == (0.2, 0.6)


# ---- materials


def test_emissive_strength_and_sides(tmp_path):
    """Radiance is factor times strength, and a double-sided material emits on both sides."""
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 10.0}}
    emission = one_square(emissiveFactor=[1, 0.5, 0], extensions=strength).load(tmp_path).shapes[0].emission
    assert emission.radiance == (10, 5, 0)
    assert not emission.two_sided
    assert one_square(emissiveFactor=[1, 1, 1], doubleSided=True).load(tmp_path).shapes[0].emission.two_sided


def test_emissive_texture_becomes_its_mean(tmp_path):
    """Emission has no texture: the mean of its linear colours is taken, with a warning."""
    file = one_square(emissiveFactor=[1, 1, 1], emissiveTexture={"index": 0})
    file.json["textures"] = [{"source": 0}]
    file.json["images"] = [{"bufferView": file.view(png([[(255, 0, 128)], [(0, 0, 128)]])), "mimeType": "image/png"}]
    with pytest.warns(UserWarning, match="emissive texture"):
        scene = file.load(tmp_path)
    np.testing.assert_allclose(scene.shapes[0].emission.radiance, (0.5, 0, to_linear(128)), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("uv_type", [np.float32, np.uint16])
def test_base_texture_is_decoded_tinted_and_upright(tmp_path, uv_type):
    """The albedo is the linear texture times the factor, and glTF's v = 0, the top row, is our v = 1."""
    uv = np.array([(0, 1), (1, 1), (1, 0), (0, 0)]) * (65535 if uv_type is np.uint16 else 1)
    pixels = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (128, 128, 128)]])
    pbr = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 1, 1], "metallicFactor": 0}
    file = Gltf(materials=[{"pbrMetallicRoughness": pbr}], nodes=[{"mesh": 0}], textures=[{"source": 0}])
    file.json["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(png(pixels)).decode()}]
    file.mesh(SQUARE, SQUARE_FACES, material=0, uv=uv.astype(uv_type))
    (shape,) = file.load(tmp_path).shapes
    np.testing.assert_allclose(shape.texture.pixels, to_linear(pixels) * (0.5, 1, 1), rtol=1e-6)
    np.testing.assert_allclose(shape.uv, [(0, 0), (1, 0), (1, 1), (0, 1)], atol=1e-12)


def test_texture_transform_example(tmp_path):
    """The example of KHR_texture_transform covers the lower left quadrant of the picture."""
    transform = {"offset": [0, 1], "rotation": math.pi / 2, "scale": [0.5, 0.5]}
    texture = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    file = Gltf(materials=[{"pbrMetallicRoughness": {"baseColorTexture": texture}}], nodes=[{"mesh": 0}])
    file.json["textures"] = [{"source": 0}]
    file.json["images"] = [{"bufferView": file.view(png(np.zeros((2, 2, 3)))), "mimeType": "image/png"}]
    file.mesh(SQUARE, SQUARE_FACES, material=0, uv=np.array([(0, 1), (1, 1), (1, 0), (0, 0)], dtype=np.float32))
    uv = file.load(tmp_path).shapes[0].uv
    np.testing.assert_allclose([uv.min(axis=0), uv.max(axis=0)], [(0, 0), (0.5, 0.5)], atol=1e-7)


def test_texture_without_uv_becomes_its_mean(tmp_path):
    """A texture on a mesh without texture coordinates is its mean colour, with a warning."""
    file = one_square(pbrMetallicRoughness={"baseColorTexture": {"index": 0}, "metallicFactor": 0})
    file.json["textures"] = [{"source": 0}]
    file.json["images"] = [{"bufferView": file.view(png([[(255, 255, 255), (0, 0, 0)]])), "mimeType": "image/png"}]
    with pytest.warns(UserWarning, match="no texture coordinates"):
        scene = file.load(tmp_path)
    np.testing.assert_allclose(scene.shapes[0].material.albedo, (0.5, 0.5, 0.5), rtol=1e-6)


def test_metals_mirrors_and_glass(tmp_path):
    """Materials go by their index, also where names repeat, and become the nearest that the library has."""
    metal = {"baseColorFactor": [1, 0.5, 0.25, 1], "metallicFactor": 1.0}
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_ior": {"ior": 1.7}}
    file = Gltf(
        materials=[
            {"name": "same", "pbrMetallicRoughness": {**metal, "roughnessFactor": 0.5}},
            {"name": "same", "pbrMetallicRoughness": {**metal, "roughnessFactor": 0.0}},
            {"name": "same", "pbrMetallicRoughness": {"metallicFactor": 0.0}, "extensions": glass},
            {"name": "same", "pbrMetallicRoughness": {**metal, "metallicFactor": 0.4}},
            {"name": "same", "pbrMetallicRoughness": {**metal, "roughnessFactor": 1.0}},
        ],
        nodes=[{"mesh": i} for i in range(5)],
    )
    for i in range(5):
        file.mesh(SQUARE, SQUARE_FACES, material=i)
    rough, mirror, dielectric, plastic, roughest = (shape.material for shape in file.load(tmp_path).shapes)
    alpha = 0.5**2
    assert isinstance(rough, Conductor)
    assert rough.reflectance == (1, 0.5, 0.25)
    assert rough.roughness == pytest.approx(1.0 / (2.0 / alpha**2 - 2.0))
    assert mirror == Mirror((1, 0.5, 0.25))
    assert dielectric == Dielectric(1.7)
    assert plastic == Diffuse((1, 0.5, 0.25))
    assert roughest.roughness == 1.0


# ---- Wavefront, Stanford, stereolithography

SQUARE_OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def write_obj(folder, mtl, obj=SQUARE_OBJ + "mtllib a.mtl\nusemtl red paint\nf 1/1 2/2 3/3 4/4\n"):
    (folder / "a.obj").write_text(obj)
    if mtl is not None:
        (folder / "a.mtl").write_text(mtl)
    return folder / "a.obj"


def test_obj_with_textured_material(tmp_path):
    """map_Kd with options, a blank in its name and a backslash is found, decoded and multiplied by Kd."""
    pixels = np.array([[(255, 128, 0)]])
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "red wood.png").write_bytes(png(pixels))
    mtl = "newmtl other\nKd 0 1 0\nnewmtl red paint\nKd 0.5 1 1\nmap_Kd -clamp on maps\\red wood.png\n"
    (shape,) = load_scene(write_obj(tmp_path, mtl)).shapes
    assert shape.name == "red paint"
    assert len(shape.faces) == 2
    np.testing.assert_allclose(shape.texture.pixels, to_linear(pixels)[None][0] * (0.5, 1, 1), rtol=1e-6)
    np.testing.assert_allclose(shape.uv, shape.vertices[:, :2])


def test_obj_materials(tmp_path):
    """Kd, Ke, illum 5 and 7 and the metalness Pm say what a material is; shapes come in the file's order."""
    names = ["lamp", "mirror", "glass", "metal", "undefined"]
    mtl = (
        "newmtl lamp\nKd 0 0 0\nKe 4 2 1\nnewmtl mirror\nillum 5\nKs .9 .9 .9\nnewmtl glass\nillum 7\nNi 1.3\n"
        "newmtl metal\nKd .5 .5 .5\nPm 1\nPr 0.5\n"
    )
    obj = "mtllib a.mtl\n" + SQUARE_OBJ + "".join(f"# usemtl wrong\nusemtl {name}\n f\t1 2 3\n" for name in names)
    with pytest.warns(UserWarning, match="undefined"):
        shapes = load_scene(write_obj(tmp_path, mtl, obj)).shapes
    assert [shape.name for shape in shapes] == names
    assert shapes[0].emission.radiance == (4, 2, 1)
    assert shapes[1].material == Mirror((0.9, 0.9, 0.9))
    assert shapes[2].material == Dielectric(1.3)
    assert shapes[3].material.roughness == pytest.approx(0.5**4 / (2 - 2 * 0.5**4))
    assert shapes[4].material == Diffuse(0.8)


def test_obj_relative_indices(tmp_path):
    """Negative indices count back from their own line, not from the end of the file."""
    obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    (shape,) = load_scene(write_obj(tmp_path, None, obj)).shapes
    np.testing.assert_array_equal(shape.vertices[shape.faces][:, :, 2], [(0, 0, 0), (5, 5, 5)])


def test_obj_polygons_and_normals(tmp_path):
    """Polygons of any size are cut into fans, and vn is kept as it stands."""
    angles = np.arange(5) * 2 * math.pi / 5
    obj = "".join(f"v {math.cos(a)} {math.sin(a)} 0\n" for a in angles) + "vn 0 0.6 0.8\nf 1//1 2//1 3//1 4//1 5//1\n"
    (shape,) = load_scene(write_obj(tmp_path, None, obj)).shapes
    assert shape.areas().sum() == pytest.approx(2.5 * math.sin(2 * math.pi / 5), rel=1e-12)
    np.testing.assert_allclose(shape.normals, [(0, 0.6, 0.8)] * 5, rtol=1e-12)


def test_missing_mtl_is_a_warning(tmp_path):
    """Without its .mtl a file is grey."""
    with pytest.warns(UserWarning, match=r"a\.mtl"):
        scene = load_scene(write_obj(tmp_path, None))
    assert scene.shapes[0].material == Diffuse(0.8)


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{extra}element face 1
property list uchar int vertex_indices
end_header
"""


def test_ply_colours_and_normals(tmp_path):
    """The albedo is the mean of the linear vertex colours, with a warning where they vary; normals are kept."""
    kinds = [f"property uchar {c}\n" for c in ("red", "green", "blue")] + [f"property float n{c}\n" for c in "xyz"]
    rows = [f"{x} {y} {z} {255 * (i % 2)} 128 0 0 0 1\n" for i, (x, y, z) in enumerate(SQUARE)]
    (tmp_path / "a.ply").write_text(PLY.format(extra="".join(kinds)) + "".join(rows) + "4 0 1 2 3\n")
    with pytest.warns(UserWarning, match="vertex colours"):
        (shape,) = load_scene(tmp_path / "a.ply").shapes
    np.testing.assert_allclose(shape.material.albedo, (0.5, to_linear(128), 0), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(shape.normals, [(0, 0, 1)] * 4)


def test_ply_with_texture_coordinates_keeps_its_normals(tmp_path):
    """Texture coordinates per face corner, which split vertices in trimesh, leave normals where they are."""
    header = PLY.format(extra="".join(f"property float n{c}\n" for c in "xyz")).replace("face 1", "face 2")
    header = header.replace("end_header", "property list uchar float texcoord\nend_header")
    rows = "".join(f"{x} {y} {z} {x} {y} 1\n" for x, y, z in SQUARE)
    (tmp_path / "a.ply").write_text(header + rows + "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 1 0 0 1 0 1\n")
    (shape,) = load_scene(tmp_path / "a.ply").shapes
    expected = np.add(shape.vertices, (0, 0, 1))
    np.testing.assert_allclose(shape.normals, expected / np.linalg.norm(expected, axis=1)[:, None], **FLOAT32)


def test_plain_ply_and_stl_are_grey_and_flat(tmp_path):
    """Without colours and normals in the file a shape is diffuse 0.8 and has none."""
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in SQUARE)
    (tmp_path / "a.ply").write_text(PLY.format(extra="") + rows + "4 0 1 2 3\n")
    (tmp_path / "a.stl").write_bytes(stl(SQUARE[SQUARE_FACES]))
    for name in ("a.ply", "a.stl"):
        (shape,) = load_scene(tmp_path / name).shapes
        assert shape.material == Diffuse(0.8)
        assert shape.normals is None
        assert shape.areas().sum() == 1.0


def stl(triangles) -> bytes:
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + rows


# ---- what is refused


@pytest.mark.parametrize(
    "reference", ["../../secret.png", "..\\..\\secret.png", "{absolute}", "link.png", "sub/../../s.png"]
)
def test_mtl_texture_outside_is_refused(tmp_path, reference):
    """A texture outside the scene's folder is refused however the .mtl gets there, though it exists."""
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    for secret in (tmp_path / "secret.png", tmp_path / "a" / "s.png"):
        secret.write_bytes(png([[(1, 2, 3)]]))
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    mtl = f"newmtl red paint\nmap_Kd {reference.format(absolute=tmp_path / 'secret.png')}\n"
    with pytest.raises(ValueError, match="outside the scene's folder"):
        load_scene(write_obj(folder, mtl))


def test_unused_mtl_texture_outside_is_refused(tmp_path):
    """Every map_Kd of a .mtl is checked before the first is opened, used or not."""
    with pytest.raises(ValueError, match="outside the scene's folder"):
        load_scene(write_obj(tmp_path, "newmtl red paint\nmap_Kd none.png\nnewmtl unused\nmap_Kd ../secret.png\n"))


def test_mtllib_outside_is_refused(tmp_path):
    """A .mtl outside the scene's folder is refused."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.mtl").write_text("newmtl a\n")
    with pytest.raises(ValueError, match="outside the scene's folder"):
        load_scene(write_obj(tmp_path / "sub", None, SQUARE_OBJ + "mtllib ../a.mtl\nf 1 2 3\n"))


@pytest.mark.parametrize("uri", ["../secret", "..%2Fsecret", "{absolute}", "link"])
@pytest.mark.parametrize("kind", ["buffer", "image"])
def test_gltf_uri_outside_is_refused(tmp_path, kind, uri):
    """A buffer or image outside the scene's folder is refused, percent signs or not, also where nothing uses it."""
    folder = tmp_path / "a"
    folder.mkdir()
    file = one_square()
    (tmp_path / "secret").write_bytes(file.data)
    (folder / "link").symlink_to(tmp_path / "secret")
    uri = uri.format(absolute=tmp_path / "secret")
    if kind == "image":
        file.json["images"] = [{"uri": uri}]
    (folder / "a.gltf").write_text(file.gltf(uri if kind == "buffer" else None))
    with pytest.raises(ValueError, match=f"{kind} uri .* outside the scene's folder"):
        load_scene(folder / "a.gltf")


def test_gltf_beside_its_buffer_and_texture(tmp_path):
    """Files in the scene's folder are read, and a missing or broken texture is an error that names it."""
    pbr = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    file = Gltf(materials=[{"pbrMetallicRoughness": pbr}], textures=[{"source": 0}], images=[{"uri": "a%20b.png"}])
    file.json["nodes"] = [{"mesh": 0}]
    file.mesh(SQUARE, SQUARE_FACES, material=0, uv=SQUARE[:, :2])
    (tmp_path / "a.bin").write_bytes(file.data)
    (tmp_path / "a.gltf").write_text(file.gltf("a.bin"))
    with pytest.raises(ValueError, match=r"texture 'a b.png' is missing"):
        load_scene(tmp_path / "a.gltf")
    (tmp_path / "a b.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"texture 'a%20b.png' is none of PNG"):
        load_scene(tmp_path / "a.gltf")
    (tmp_path / "a b.png").write_bytes(png([[(255, 255, 255)]]))
    assert isinstance(load_scene(tmp_path / "a.gltf").shapes[0].material.albedo, Texture)


def test_missing_texture_of_mtl_is_an_error(tmp_path):
    """A .mtl whose texture is missing is refused with the texture's name."""
    with pytest.raises(ValueError, match=r"'none\.png' is missing"):
        load_scene(write_obj(tmp_path, "newmtl red paint\nmap_Kd none.png\n"))


def test_postscript_is_no_texture(tmp_path):
    """PIL would run a PostScript interpreter for an .eps, so no such texture is opened."""
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n")
    with pytest.raises(ValueError, match="is none of PNG"):
        load_scene(write_obj(tmp_path, "newmtl red paint\nmap_Kd a.png\n"))


def test_wrong_paths(tmp_path):
    """A missing file is FileNotFoundError, an unknown extension a ValueError that lists the known ones."""
    with pytest.raises(FileNotFoundError, match=r"none\.glb"):
        load_scene(tmp_path / "none.glb")
    (tmp_path / "a.blend").write_bytes(b"")
    with pytest.raises(ValueError, match=r"'\.blend', expected one of \.glb, .*\.usdz"):
        load_scene(tmp_path / "a.blend")


def textured_glb() -> bytes:
    pbr = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    file = Gltf(materials=[{"pbrMetallicRoughness": pbr}], textures=[{"source": 0}], nodes=[{"mesh": 0}])
    file.mesh(CUBE, CUBE_FACES, material=0, uv=CUBE[:, :2], normals=CUBE)
    file.json["images"] = [{"bufferView": file.view(png(np.zeros((4, 4, 3)))), "mimeType": "image/png"}]
    return file.glb()


def whole_files() -> dict[str, bytes]:
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in SQUARE)
    return {
        "a.glb": textured_glb(),
        "a.gltf": one_square().gltf().encode(),
        "a.obj": (SQUARE_OBJ + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\nf -1 -2 -3\n").encode(),
        "a.ply": (PLY.format(extra="") + rows + "4 0 1 2 3\n").encode(),
        "a.stl": stl(CUBE[CUBE_FACES]),
    }


def refusal(path) -> str | None:
    """The message of the ValueError that a file leads to; any other exception goes through."""
    try:
        load_scene(path)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", whole_files())
def test_a_cut_file_is_a_value_error(tmp_path, name):
    """Wherever a file is cut off, it is a scene or a ValueError of one line that names the file."""
    data = whole_files()[name]
    path = tmp_path / name
    path.write_bytes(data)
    load_scene(path)
    for cut in np.linspace(0, len(data) - 1, 20).astype(int):
        path.write_bytes(data[:cut])
        message = refusal(path)
        assert message is None or (message.startswith(name) and "\n" not in message)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damaged_glb_bytes(tmp_path):
    """Whatever a byte of a .glb becomes, it is a scene or a ValueError."""
    data = textured_glb()
    rng = np.random.default_rng(1)
    for _ in range(150):
        broken = bytearray(data)
        broken[rng.integers(12, len(data))] = rng.integers(256)
        (tmp_path / "a.glb").write_bytes(broken)
        refusal(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"asset": {"version": "1.0"}}, "version"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"nodes": [{"children": [0], "mesh": 0}], "scenes": [{"nodes": [0]}]}, "twice"),
        ({"nodes": [{"mesh": 7}]}, "IndexError"),
        ({"nodes": []}, None),
        ({"meshes": [], "nodes": []}, "no triangle"),
    ],
)
def test_documents_that_are_refused(tmp_path, change, message):
    """What cannot be shown as the file means it is refused in a sentence; meshes without nodes are shown."""
    file = one_square()
    file.json.update(change)
    if message is None:
        assert len(file.load(tmp_path).shapes) == 1
    else:
        with pytest.raises(ValueError, match=message):
            file.load(tmp_path)


def test_sparse_accessors_are_refused(tmp_path):
    """trimesh would read zeros where a sparse accessor has its values, so it is refused."""
    file = one_square()
    file.json["accessors"][0]["sparse"] = {"count": 1}
    with pytest.raises(ValueError, match="sparse"):
        file.load(tmp_path)


def test_shapes_without_area(tmp_path):
    """Triangles without area are counted, a shape of nothing else is left out with a warning, the last one refused."""
    file = Gltf(nodes=[{"mesh": 0}, {"mesh": 1}])
    file.mesh(SQUARE, [(0, 1, 2), (0, 0, 1)])
    file.mesh(SQUARE, [(0, 1, 1)], name="needle")
    with pytest.warns(UserWarning, match="needle .* left out"):
        scene = file.load(tmp_path)
    assert (scene.triangle_count, scene.degenerate_count) == (1, 1)
    file.json["nodes"] = [{"mesh": 1}]
    with pytest.raises(ValueError, match="no triangle with an area"):
        file.load(tmp_path)


def test_usd_without_pxr_names_the_extra(tmp_path, monkeypatch):
    """Where usd-core is missing the error says what to install."""
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install warpgi\[usd\]"):
        load_scene(tmp_path / "a.usda")


# ---- USD

USDA = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
)
def Xform "root"
{
    double3 xformOp:translate = (0, 0, 100)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "cube" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform token orientation = "leftHanded"
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = %s
        point3f[] points = %s
        float3 xformOp:scale = (100, 100, -100)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        rel material:binding = </gold>
    }
    def Mesh "tri"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (100, 0, 0), (0, 100, 0)]
        color3f[] primvars:displayColor = [(0.25, 0.5, 1)]
        normal3f[] normals = [(0, 0, 1), (0, 0, 1), (0, 0, 1)] (interpolation = "faceVarying")
    }
}
def Material "gold"
{
    token outputs:surface.connect = </gold/shader.outputs:surface>
    def Shader "shader"
    {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (1, 0.5, 0.25)
        float inputs:metallic = 1
        float inputs:roughness = 0.5
        color3f inputs:emissiveColor = (0, 0, 3)
        token outputs:surface
    }
}
def DistantLight "sun"
{
    float inputs:intensity = 2
    float inputs:exposure = 1
    bool inputs:normalize = 1
}
def SphereLight "bulb"
{
    float inputs:intensity = 1
    float inputs:radius = 50
    double3 xformOp:translate = (0, 0, 200)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def RectLight "panel"
{
    float inputs:intensity = 7
    float inputs:width = 200
    float inputs:height = 100
}
def DomeLight "sky"
{
    float inputs:intensity = 1
    color3f inputs:color = (0.1, 0.2, 0.3)
}
def Camera "camera"
{
    float focalLength = 50
    float verticalAperture = 20
    double3 xformOp:translate = (0, 0, 500)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


@pytest.fixture
def usd():
    pytest.importorskip("pxr", reason="usd-core is an extra")


def cube_usda() -> str:
    return USDA % (CUBE_QUADS[:, ::-1].ravel().tolist(), [tuple(map(int, v)) for v in CUBE])


@pytest.mark.usefixtures("usd")
def test_usd_scene(tmp_path):
    """A stage in centimetres with z up arrives in metres with y up: meshes, materials, lights and camera."""
    (tmp_path / "a.usda").write_text(cube_usda())
    scene = load_scene(tmp_path / "a.usda")
    cube, tri, panel = scene.shapes
    # Clockwise and declared so; the mirror in its transform leaves the outside where it was. Its centre is at z = 1 m.
    assert signed_volume(cube) == pytest.approx(8.0, rel=1e-6)
    np.testing.assert_allclose(
        [cube.vertices.min(axis=0), cube.vertices.max(axis=0)], [(-1, 0, -1), (1, 2, 1)], **FLOAT32
    )
    assert cube.material.reflectance == (1, 0.5, 0.25)
    assert cube.material.roughness == pytest.approx(0.5**4 / (2 - 2 * 0.5**4))
    assert cube.emission.radiance == (0, 0, 3)
    assert tri.material == Diffuse((0.25, 0.5, 1))
    np.testing.assert_allclose(tri.vertices, [(0, 1, 0), (1, 1, 0), (0, 1, -1)], **FLOAT32)
    np.testing.assert_allclose(tri.normals, [(0, 1, 0)] * 3, atol=1e-12)

    assert panel.areas().sum() == pytest.approx(2.0)
    assert panel.emission.radiance == (7, 7, 7)
    a, b, c = panel.vertices[panel.faces[0]]
    np.testing.assert_allclose(np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a)), (0, -1, 0), atol=1e-9)
    sun, bulb, sky = scene.lights
    np.testing.assert_allclose(sun.direction, (0, -1, 0), atol=1e-12)
    assert sun.irradiance == (4, 4, 4)
    np.testing.assert_allclose(bulb.position, (0, 2, 0), atol=1e-12)
    np.testing.assert_allclose(bulb.intensity, [math.pi * 0.5**2] * 3, rtol=1e-6)
    np.testing.assert_allclose(sky.radiance, (0.1, 0.2, 0.3), rtol=1e-6)
    assert isinstance(scene.camera, Camera)
    np.testing.assert_allclose(scene.camera.frame(), [(1, 0, 0), (0, 0, -1), (0, -1, 0)], atol=1e-9)
    assert scene.camera.fov == pytest.approx(math.degrees(2 * math.atan(0.2)), rel=1e-6)


TEXTURED_USDA = """#usda 1.0
(
    metersPerUnit = 1
)
def Mesh "square" (prepend apiSchemas = ["MaterialBindingAPI"])
{
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    texCoord2f[] primvars:map = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")
    rel material:binding = </m>
}
def Material "m"
{
    token outputs:surface.connect = </m/s.outputs:surface>
    def Shader "s"
    {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </m/t.outputs:rgb>
        token outputs:surface
    }
    def Shader "t"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @%s@
        float2 inputs:st.connect = </m/r.outputs:result>
        float3 outputs:rgb
    }
    def Shader "r"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "map"
        float2 outputs:result
    }
}
"""


@pytest.mark.usefixtures("usd")
def test_usd_texture(tmp_path):
    """A diffuse texture is read with the primvar it names; outside the folder it is refused, missing is an error."""
    folder = tmp_path / "a"
    folder.mkdir()
    pixels = np.array([[(255, 0, 0)], [(0, 128, 0)]])
    for place in (tmp_path, folder):
        (place / "t.png").write_bytes(png(pixels))
    (folder / "a.usda").write_text(TEXTURED_USDA % "./t.png")
    (shape,) = load_scene(folder / "a.usda").shapes
    np.testing.assert_allclose(shape.texture.pixels, to_linear(pixels), rtol=1e-6)
    np.testing.assert_allclose(shape.uv, shape.vertices[:, :2], atol=1e-12)
    for name, reference, message in (
        ("b.usda", "../t.png", "outside the scene's folder"),
        ("c.usda", str(tmp_path / "t.png"), "outside the scene's folder"),
        ("d.usda", "./none.png", "none.png' is missing"),
    ):
        (folder / name).write_text(TEXTURED_USDA % reference)
        with pytest.raises(ValueError, match=message):
            load_scene(folder / name)


@pytest.mark.usefixtures("usd")
def test_usd_layers_outside_are_refused(tmp_path):
    """A layer outside the folder is refused however deep it is referenced."""
    folder = tmp_path / "a"
    folder.mkdir()
    (tmp_path / "secret.usda").write_text(cube_usda())
    (folder / "b.usda").write_text("#usda 1.0\n(\n    subLayers = [@../secret.usda@]\n)\n")
    (folder / "a.usda").write_text("#usda 1.0\n(\n    subLayers = [@./b.usda@]\n)\n")
    with pytest.raises(ValueError, match="outside the scene's folder"):
        load_scene(folder / "a.usda")


@pytest.mark.usefixtures("usd")
def test_cut_usd_is_a_value_error(tmp_path, capfd):
    """Wherever a .usda is cut off, it is a scene or a ValueError."""
    text = cube_usda()
    for cut in np.linspace(0, len(text) - 1, 20).astype(int):
        path = tmp_path / f"a{cut}.usda"  # USD keeps layers by name
        path.write_text(text[:cut])
        message = refusal(path)
        assert message is None or message.startswith(path.name)
    capfd.readouterr()  # USD writes its own warnings to stderr
