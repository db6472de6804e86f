"""The built-in scenes: closed where they say so, lit, facing the right way, and the same at every build."""

from __future__ import annotations

import inspect
import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh

import warpgi.scenes
from warpgi.lights import DistantLight, PointLight
from warpgi.materials import Conductor, Dielectric, Diffuse
from warpgi.scene import Scene, Shape
from warpgi.scenes import SCENES, build, primitives, spectra

CHEAP = {"courtyard": {"detail": 0.05}, "integrating-sphere": {"subdivisions": 3}}


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: build(name, **CHEAP.get(name, {})) for name in SCENES}


def shape_of(scene: Scene, name: str) -> Shape:
    return next(shape for shape in scene.shapes if shape.name == name)


def welded(shape: Shape) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def solid(mesh: primitives.Mesh) -> trimesh.Trimesh:
    return welded(mesh.shape(Diffuse(0.5)))


def face_normals(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    return (a + b + c) / 3.0, n / np.linalg.norm(n, axis=1, keepdims=True)


def hits(scene: Scene, origins: np.ndarray, directions: np.ndarray, reach: float = math.inf) -> np.ndarray:
    """Whether rays meet any triangle of the scene within `reach`, by Moeller and Trumbore, in float64."""
    corner = np.concatenate([shape.vertices[shape.faces] for shape in scene.shapes])
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    found = []
    for o, d in zip(origins, directions, strict=True):
        p = np.cross(d, edge2)
        det = (edge1 * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = o - corner[:, 0]
            u = (s * p).sum(axis=1) / det
            q = np.cross(s, edge1)
            v = (q @ d) / det
            t = (edge2 * q).sum(axis=1) / det
            found.append(bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < reach)).any()))
    return np.array(found)


def directions(count: int) -> np.ndarray:
    return primitives.normalize(np.random.default_rng(3).standard_normal((count, 3)))


def project(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Picture coordinates of points for a square picture: right and up, each in [-1, 1] inside."""
    right, up, forward = scene.camera.frame()
    d = points - np.asarray(scene.camera.position)
    assert (d @ forward > 0.0).all(), "a point lies behind the camera"
    size = np.tan(np.radians(scene.camera.fov) / 2.0) * (d @ forward)
    return np.stack([d @ right / size, d @ up / size], axis=1)


# --- every scene -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_scene_is_lit_and_sound(scenes, name):
    """Every scene has light, no triangle without an area, finite bounds, and is called what the table calls it."""
    scene = scenes[name]
    assert scene.has_light()
    assert scene.degenerate_count == 0
    assert np.isfinite(scene.bounds()).all()
    assert scene.name == name


@pytest.mark.parametrize("name", SCENES)
def test_two_builds_are_equal_to_the_last_bit(scenes, name):
    """A scene depends on its parameters alone."""
    again = build(name, **CHEAP.get(name, {}))
    for one, two in zip(scenes[name].shapes, again.shapes, strict=True):
        for field in ("vertices", "faces", "normals", "uv"):
            a, b = getattr(one, field), getattr(two, field)
            assert (a is None) == (b is None)
            assert a is None or np.array_equal(a, b)
        assert one.texture is None or np.array_equal(one.texture.pixels, two.texture.pixels)
    assert scenes[name].lights == again.lights
    assert scenes[name].camera == again.camera


@pytest.mark.parametrize("name", SCENES)
def test_shading_normals_are_on_the_faces_side(scenes, name):
    """Shading normals have length 1 and lie within 90 degrees of the face's normal."""
    for shape in scenes[name].shapes:
        if shape.normals is not None:
            assert np.allclose(np.linalg.norm(shape.normals, axis=1), 1.0, atol=1e-6), shape.name
            _, n = face_normals(shape)
            agree = (shape.normals[shape.faces] * n[:, None]).sum(axis=2)
            assert agree.min() > 0.0, f"{shape.name}: {np.count_nonzero(agree.min(axis=1) <= 0)} of {len(n)} faces"


@pytest.mark.parametrize("name", SCENES)
def test_no_two_triangles_are_the_same(scenes, name):
    """No triangle is there twice, in either winding: rays could not tell which they hit."""
    corner = np.concatenate([shape.vertices[shape.faces] for shape in scenes[name].shapes]).round(7)
    order = np.lexsort((corner[..., 2], corner[..., 1], corner[..., 0]), axis=1)
    rows = np.take_along_axis(corner, order[..., None], axis=1).reshape(-1, 9)
    assert len(np.unique(rows, axis=0)) == len(rows)


@pytest.mark.parametrize("name", SCENES)
def test_textures_repeat_at_a_scale_that_can_be_seen(scenes, name):
    """A textured shape has uv that are not all one point, and no face that spans more than 64 repeats."""
    for shape in scenes[name].shapes:
        if shape.texture is not None:
            assert np.ptp(shape.uv, axis=0).min() > 0.0, shape.name
            assert np.ptp(shape.uv[shape.faces], axis=1).max() < 64.0, shape.name


def test_parameters_have_defaults_and_a_docstring():
    """Every scene can be built by its name alone, and its docstring speaks of every parameter."""
    for name, function in SCENES.items():
        for parameter in inspect.signature(function).parameters.values():
            assert parameter.default is not inspect.Parameter.empty
            assert f"{parameter.name}:" in function.__doc__ or f"{parameter.name}, " in function.__doc__, name


@pytest.mark.parametrize("name", SCENES)
def test_camera_looks_at_the_scene(scenes, name):
    """Of 25 rays over a square picture at least three in five meet the scene."""
    camera = scenes[name].camera
    across = np.tan(np.radians(camera.fov) / 2.0) * np.linspace(-0.9, 0.9, 5)
    x, y = (a.ravel() for a in np.meshgrid(across, across))
    d = primitives.normalize(np.stack([x, y, np.ones(25)], axis=1) @ camera.frame())
    assert hits(scenes[name], np.tile(camera.position, (25, 1)), d).mean() >= 0.6


# --- build -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("cornel-box", {}, "did you mean 'cornell-box'.*courtyard"),
        ("courtyard", {"detial": 1.0}, "'detial', did you mean 'detail'"),
        ("cornell-spheres", {"spheres": True}, "'spheres', expected brightness"),
        ("courtyard", {"detail": "much"}, "detail is 'much'"),
        ("courtyard", {"detail": 0.0}, "detail is 0"),
        ("cornell-box", {"spheres": 1}, "spheres is 1"),
        ("furnace", {"albedo": 1.0}, "albedo"),
        ("furnace", {"shape": "cone"}, "shape is 'cone'"),
        ("statuettes", {"figure": 3}, "figure is int"),
        ("leak", {"thickness": 0.0}, "thickness is 0"),
    ],
)
def test_build_names_what_is_wrong(name, parameters, message):
    """An unknown scene, an unknown parameter or a wrong value gives one ValueError that names it."""
    with pytest.raises(ValueError, match=message):
        build(name, **parameters)


def test_build_returns_the_scene_alone(scenes):
    """`build` drops what is known of the light; the functions of analytic scenes return it."""
    assert all(isinstance(scene, Scene) for scene in scenes.values())
    scene, expected = warpgi.scenes.furnace()
    assert isinstance(scene, Scene)
    assert expected.radiance is not None


# --- Cornell box -------------------------------------------------------------------------------------------------


def test_cornell_camera_is_the_published_one(scenes):
    """The field of view is that of a 35 mm lens on 25 mm of film, 39.31 degrees."""
    camera = scenes["cornell-box"].camera
    assert camera.fov == pytest.approx(39.3077, abs=1e-4)
    assert math.tan(math.radians(camera.fov) / 2.0) * 35.0 == pytest.approx(12.5)
    assert camera.position == pytest.approx((0.278, 0.273, -0.8))


@pytest.mark.parametrize("name", ["cornell-box", "cornell-spheres"])
def test_cornell_red_wall_is_on_the_left(scenes, name):
    """In the picture the red wall is on the left and the green one on the right."""
    scene = scenes[name]
    for shape, side, channel in (("left wall", -1.0, 0), ("right wall", 1.0, 1)):
        wall = shape_of(scene, shape)
        assert np.sign(project(scene, wall.vertices)[:, 0]).tolist() == [side] * 4
        assert np.argmax(wall.material.albedo) == channel


def test_cornell_colours_follow_from_the_measured_spectra():
    """Paints as RGB lie within what was measured, white is grey within 2 %, and the lamp is near the usual (17, 12, 4).

    The bounds are the smallest and the largest reflectance in the published tables.
    """
    white, green, red = (spectra.reflectance_rgb(table) for table in (spectra.WHITE, spectra.GREEN, spectra.RED))
    assert min(white) > 0.70
    assert max(white) / min(white) < 1.03
    assert 0.30 < green[1] < 0.481
    assert 0.40 < red[0] < 0.657
    assert max(green[0], green[2]) < 0.5 * green[1]
    assert max(red[1:]) < 0.15 * red[0]
    assert spectra.lamp_rgb() == pytest.approx((17.0, 12.0, 4.0), abs=1.2)


def test_colour_matching_fit_has_the_cie_peaks():
    """The fit peaks where the CIE 1931 functions do (599, 556, 446 nm, within 5 nm) and its integrals agree to 1 %."""
    matching = spectra.colour_matching(spectra.WAVELENGTHS)
    assert np.abs(spectra.WAVELENGTHS[matching.argmax(axis=0)] - [599.0, 556.0, 446.0]).max() <= 5.0
    total = matching.sum(axis=0)
    assert total == pytest.approx(np.full(3, 106.8), rel=0.01)


def test_cornell_box_is_closed_but_for_its_front(scenes):
    """Rays from the middle that do not leave through the front plane hit something."""
    origin, d = np.array([0.278, 0.35, 0.2]), directions(400)
    front = origin - d * (origin[2] / d[:, 2:])
    through = (d[:, 2] < 0.0) & (front[:, :2] > -0.001).all(axis=1) & (front[:, :2] < [0.557, 0.55]).all(axis=1)
    found = hits(scenes["cornell-box"], np.tile(origin, (len(d), 1)), d)
    assert found[~through].all()
    assert np.count_nonzero(~found) > 20


def test_cornell_lamp_faces_down_and_fills_its_hole(scenes):
    """The lamp emits downwards, and ceiling and lamp together have the area of the whole ceiling."""
    scene = scenes["cornell-box"]
    lamp, white = shape_of(scene, "lamp"), shape_of(scene, "floor, back and ceiling")
    assert np.allclose(face_normals(lamp)[1], [0.0, -1.0, 0.0])
    assert lamp.areas().sum() == pytest.approx(0.130 * 0.105)
    centre, normal = face_normals(white)
    ceiling = (centre[:, 1] > 0.548) & (normal[:, 1] < -0.99)
    assert white.areas()[ceiling].sum() + lamp.areas().sum() == pytest.approx(0.556 * 0.5592)


@pytest.mark.parametrize("block", ["short block", "tall block"])
def test_cornell_blocks_stand_on_the_floor(scenes, block):
    """A block reaches the floor, has no bottom in the floor's plane, and its faces look outwards."""
    shape = shape_of(scenes["cornell-box"], block)
    centre, normal = face_normals(shape)
    assert shape.vertices[:, 1].min() == 0.0
    assert normal[:, 1].min() > -0.5
    assert ((centre - shape.vertices.mean(axis=0)) * normal).sum(axis=1).min() > 0.0


def test_cornell_balls_are_inside_and_above_the_floor(scenes):
    """Mirror and glass ball touch neither a wall nor the floor; the glass faces outwards."""
    scene = scenes["cornell-spheres"]
    for name in ("mirror ball", "glass ball"):
        ball = shape_of(scene, name)
        assert (ball.vertices.min(axis=0) > 0.0).all()
        assert (ball.vertices.max(axis=0) < [0.5496, 0.5488, 0.5592]).all()
    assert isinstance(ball.material, Dielectric)
    assert welded(ball).volume == pytest.approx(4.0 / 3.0 * math.pi * 0.1**3, rel=0.005)


# --- rooms with a known answer -----------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["cube", "sphere", "blocks"])
def test_furnace_is_closed_and_faces_inwards(shape):
    """A furnace is watertight, its walls face the camera's side, and it expects Le / (1 - a)."""
    scene, expected = warpgi.scenes.furnace(albedo=(0.5, 0.25, 0.9), emission=(1.0, 3.0, 0.5), shape=shape)
    assert expected.radiance == pytest.approx((2.0, 4.0, 5.0))
    mesh = welded(scene.shapes[0])
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume < 0.0
    centre, normal = face_normals(scene.shapes[0])
    if shape != "blocks":
        assert (centre * normal).sum(axis=1).max() < 0.0
    assert hits(scene, np.tile(scene.camera.position, (50, 1)), directions(50)).all()


@pytest.mark.parametrize("name", ["furnace", "integrating-sphere", "room", "leak"])
def test_camera_and_light_are_inside_closed_rooms(scenes, name):
    """Camera and point light lie inside the room, and every ray from the camera hits a wall."""
    scene = scenes[name]
    low, high = scene.bounds()
    places = [scene.camera.position] + [light.position for light in scene.lights if isinstance(light, PointLight)]
    for place in places:
        assert (np.array(place) > low + 0.05).all()
        assert (np.array(place) < high - 0.05).all()
        assert hits(scene, np.tile(place, (100, 1)), directions(100)).all()


def test_room_gives_the_number_of_cie_171():
    """CIE 171:2006 test 5.8: 10 000 lm in a cube of 4 m with reflectance 0.5 give 104.2 lx of indirect light."""
    scene, expected = warpgi.scenes.room()
    assert expected.indirect_irradiance == pytest.approx((104.1667,) * 3, abs=1e-3)
    assert expected.indirect_radiance == pytest.approx((0.5 / math.pi * 104.1667,) * 3, abs=1e-3)
    assert scene.shapes[0].areas().sum() == pytest.approx(96.0)
    assert welded(scene.shapes[0]).volume == pytest.approx(-64.0)
    assert 4.0 * math.pi * scene.lights[0].intensity[0] == pytest.approx(10000.0)


def test_integrating_sphere_uses_the_area_of_its_triangles():
    """The expected irradiance is that of the polyhedron, and tends to the round sphere's from above."""
    values = []
    for subdivisions in (3, 5):
        scene, expected = warpgi.scenes.integrating_sphere(0.8, 50.0, 2.0, subdivisions)
        area = scene.shapes[0].areas().sum()
        assert len(scene.shapes[0].faces) == 20 * 4**subdivisions
        assert expected.indirect_irradiance[0] == pytest.approx(50.0 * 0.8 / (0.2 * area))
        assert expected.uniform
        values.append(expected.indirect_irradiance[0])
        mesh = welded(scene.shapes[0])
        assert mesh.is_watertight
        assert mesh.volume < 0.0
    limit = 50.0 * 0.8 / (0.2 * 4.0 * math.pi * 4.0)
    assert values[0] > values[1] > limit
    assert values[1] == pytest.approx(limit, rel=1e-3)


def test_leak_rooms_are_closed_and_apart():
    """Both rooms are watertight and face inwards, with exactly the wall's thickness between them."""
    scene, expected = warpgi.scenes.leak(thickness=0.001)
    lit, dark = shape_of(scene, "lit room"), shape_of(scene, "dark room")
    for shape in (lit, dark):
        assert welded(shape).is_watertight
        assert welded(shape).volume < 0.0
    assert dark.vertices[:, 0].min() - lit.vertices[:, 0].max() == pytest.approx(0.001)
    assert expected.radiance == (0.0, 0.0, 0.0)
    assert dark.vertices[:, 0].min() < scene.camera.position[0] < dark.vertices[:, 0].max()
    lamp = shape_of(scene, "lamp")
    assert np.allclose(face_normals(lamp)[1], [0.0, -1.0, 0.0])
    assert lamp.vertices[:, 0].max() < lit.vertices[:, 0].max()
    assert lamp.vertices[:, 1].max() < lit.vertices[:, 1].max()


def test_leak_with_open_front_shows_the_dark_room_on_the_right():
    """From outside, the lit room is left of the wall and the dark one right of it, and both are seen."""
    scene, _ = warpgi.scenes.leak(open_front=True)
    for name, side in (("lit room", -1.0), ("dark room", 1.0)):
        shape = shape_of(scene, name)
        _, normal = face_normals(shape)
        assert normal[:, 2].min() > -0.5
        assert (side * project(scene, shape.vertices)[:, 0]).min() > 0.0
        assert scene.camera.position[2] > shape.vertices[:, 2].max()


# --- statuettes, caustic, courtyard ------------------------------------------------------------------------------


def test_statuettes_have_the_papers_roughnesses(scenes):
    """LALD12, footnote 2: 0.01, 0.05, 0.25 from left to right, ground 0.01; a distant light and no other."""
    scene = scenes["statuettes"]
    ground, *figures = scene.shapes
    assert ground.material.roughness == 0.01
    assert [shape.material.roughness for shape in figures] == [0.01, 0.05, 0.25]
    across = [project(scene, shape.vertices)[:, 0] for shape in figures]
    assert all(a.mean() < b.mean() for a, b in pairwise(across))
    assert min(a.min() for a in across) > -1.0
    assert max(a.max() for a in across) < 1.0
    assert [type(light) for light in scene.lights] == [DistantLight]
    assert all(isinstance(shape.material, Conductor) for shape in scene.shapes)


def test_hare_is_a_closed_solid():
    """Every edge of the hare is run through as often in one direction as in the other, and its faces look outwards."""
    mesh = warpgi.scenes.figure.hare(40)
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward, backward = (np.unique(e, axis=0, return_counts=True) for e in (edges, edges[:, ::-1]))
    assert np.array_equal(forward[0], backward[0])
    assert np.array_equal(forward[1], backward[1])
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0.15


def test_surface_nets_find_a_sphere():
    """The net of a sphere's distance field has its area and volume within 2 %, at a cell of a tenth of the radius."""
    corner = np.array([1.3, 1.3, 1.3])
    net = warpgi.scenes.figure.surface_nets(lambda p: np.linalg.norm(p, axis=1) - 1.0, -corner, corner, 0.1)
    mesh = trimesh.Trimesh(net.vertices, net.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4.0 / 3.0 * math.pi, rel=0.02)
    assert mesh.area == pytest.approx(4.0 * math.pi, rel=0.02)
    # A normal is off by less than the angle under which the centre sees a cell.
    assert (net.normals * primitives.normalize(net.vertices)).sum(axis=1).min() > math.cos(0.1)


def test_statuettes_at_default_have_10_to_40_thousand_triangles():
    """Each statuette has 10 000 to 40 000 triangles at the default resolution."""
    assert 10_000 <= len(warpgi.scenes.figure.hare().faces) <= 40_000


def test_statuettes_take_a_mesh():
    """A given figure is scaled to fit, here to 1 m of width, and stood on the ground, with normals outwards."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=7.0)
    scene = warpgi.scenes.statuettes(figure=(ball.vertices + 30.0, ball.faces))
    for shape in scene.shapes[1:]:
        assert np.ptp(shape.vertices[:, 1]) == pytest.approx(1.0, rel=0.02)
        assert -0.01 < shape.vertices[:, 1].min() < 0.0
        assert len(shape.faces) == 320
        outward = shape.vertices - shape.vertices.mean(axis=0)
        assert (outward * shape.normals).sum(axis=1).min() > 0.0


def test_caustic_lamp_faces_the_table_and_glass_faces_outwards(scenes):
    """The lamp has the stated power and looks at the origin; glass and ring are closed and above the table."""
    scene = scenes["caustic"]
    lamp, glass, ring = (shape_of(scene, name) for name in ("lamp", "glass ball", "ring"))
    centre, normal = face_normals(lamp)
    assert (primitives.normalize(-centre) * normal).sum(axis=1).min() > 0.99
    assert math.pi * lamp.areas().sum() * lamp.emission.radiance[0] == pytest.approx(50.0, rel=0.01)
    for shape in (glass, ring):
        mesh = welded(shape)
        assert mesh.is_watertight
        assert mesh.volume > 0.0
        assert shape.vertices[:, 1].min() > 0.0
    assert isinstance(warpgi.scenes.caustic(roughness=0.01).shapes[2].material, Conductor)


def test_courtyard_is_rich_and_scales():
    """At its default the courtyard has at least 300 000 triangles; `detail` scales them."""
    full, low = warpgi.scenes.courtyard(), warpgi.scenes.courtyard(detail=0.05)
    assert full.degenerate_count == 0
    assert full.triangle_count >= 300_000
    assert low.triangle_count < 0.2 * full.triangle_count
    assert sum(len(shape.faces) // 2 for shape in full.shapes if shape.name in ("leaf", "blossom")) > 50_000


def test_courtyard_camera_stands_in_the_shade(scenes):
    """From the camera the sun is not seen, so that what is near is lit indirectly, but part of the court is lit."""
    scene = scenes["courtyard"]
    sun = -np.array(next(light.direction for light in scene.lights if isinstance(light, DistantLight)))
    assert hits(scene, np.array([scene.camera.position]), sun[None]).all()
    rng = np.random.default_rng(1)
    floor = np.stack([rng.uniform(-5.5, 5.5, 60), np.full(60, 1e-3), rng.uniform(-5.5, 5.5, 60)], axis=1)
    shaded = hits(scene, floor, np.tile(sun, (60, 1))).mean()
    assert 0.3 < shaded < 0.97


def test_courtyard_walls_have_no_holes(scenes):
    """A step in front of the upper wall something is hit on all four sides, and the sun reaches the far side."""
    scene = scenes["courtyard"]
    x = np.linspace(-5.9, 5.9, 24)
    y = np.tile([4.3, 5.5, 6.7], 8)
    for quarter in range(4):
        c, s = round(math.cos(0.5 * math.pi * quarter)), round(math.sin(0.5 * math.pi * quarter))
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        origins = np.stack([x, y, np.full(24, -5.6)], axis=1) @ turn.T
        assert hits(scene, origins, np.tile(turn @ [0.0, 0.0, -1.0], (24, 1)), reach=1.0).all(), quarter
    sun = -np.array(next(light.direction for light in scene.lights if isinstance(light, DistantLight)))
    assert sun[2] > 0.0, "the far wall faces away from the sun"
    far = np.stack([x, np.full(24, 5.0), np.full(24, -5.8)], axis=1)
    assert hits(scene, far, np.tile(sun, (24, 1))).mean() < 0.7


def test_courtyard_is_textured(scenes):
    """Walls, floors and roof carry textures, and none of them is darker or lighter than matter is."""
    textured = {shape.name: shape.texture for shape in scenes["courtyard"].shapes if shape.texture is not None}
    assert {"wall", "gallery", "paving", "terracotta", "brick", "roof", "stone"} <= set(textured)
    for name, texture in textured.items():
        assert 0.02 < texture.pixels.mean() < 0.8, name


# --- primitives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mesh", "volume", "tolerance"),
    [
        (primitives.box((0, 0, 0), (1, 2, 3)), 6.0, 1e-9),
        (primitives.box((0, 0, 0), (1, 2, 3), inward=True), -6.0, 1e-9),
        (primitives.icosphere(1.0, 4), 4.0 / 3.0 * math.pi, 0.01),
        (primitives.torus(1.0, 0.25, 128, 48), 2.0 * math.pi**2 * 0.0625, 0.01),
        (primitives.lathe([(0, 0), (1, 0), (1, 2), (0, 2)], 128), 2.0 * math.pi, 0.01),
        (primitives.lathe([(0.5, 1), (0.5, 0), (1, 0), (1, 1), (0.5, 1)], 128), 0.75 * math.pi, 0.01),
    ],
    ids=["box", "room", "sphere", "torus", "cylinder", "ring"],
)
def test_solids_are_closed_and_have_their_volume(mesh, volume, tolerance):
    """Primitives are watertight, face outwards (inwards: a negative volume) and have the volume of geometry books."""
    closed = solid(mesh)
    assert closed.is_watertight
    assert closed.is_winding_consistent
    assert closed.volume == pytest.approx(volume, rel=tolerance)


def test_revolution_closes_to_the_last_bit():
    """The seam's two copies of a vertex are equal, so no ray slips between them."""
    v = primitives.revolution([(0.3, 0.0), (0.7, 1.0)], 7).vertices.reshape(2, 8, 3)
    assert np.array_equal(v[:, 0], v[:, -1])


def test_primitives_face_where_they_say():
    """A quad faces edge_u x edge_v, a disc up, a tube outwards; turning by a quarter takes +z to +x."""
    shape = primitives.quad((0, 0, 0), (1, 0, 0), (0, 1, 0)).shape(Diffuse(0.5))
    assert np.allclose(face_normals(shape)[1], [0.0, 0.0, 1.0])
    assert np.allclose(face_normals(primitives.disc(1.0).shape(Diffuse(0.5)))[1], [0.0, 1.0, 0.0])
    path = np.array([[[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 0.0]]])
    centre, normal = face_normals(primitives.tubes(path, np.full((1, 3), 0.1)).shape(Diffuse(0.5)))
    assert (centre * normal * [1.0, 0.0, 1.0]).sum(axis=1).min() > 0.0
    turned = primitives.quad((0, 0, 0), (1, 0, 0), (0, 1, 0)).turn(0.5 * math.pi)
    assert np.allclose(turned.normals, [1.0, 0.0, 0.0])


def test_butterflies_are_some_in_focus_and_some_far_out(scenes):
    """Circles of confusion reach from below a pixel to more than five of a 360-line picture; three in four fly."""
    scene = scenes["butterflies"]
    camera = scene.camera
    wings = [shape for shape in scene.shapes if shape.name.endswith("wings")]
    depth = np.array([-shape.vertices[:, 2].mean() for shape in wings])
    pixel = 2.0 * camera.focus_distance * np.tan(np.radians(camera.fov) / 2.0) / 360
    radius = camera.lens_radius / pixel * np.abs(1.0 - camera.focus_distance / depth)
    assert radius.min() < 1.0 and radius.max() > 5.0
    assert sum(shape.motion is not None for shape in wings) == 18
    assert all(shape.texture is not None for shape in wings)
    still = build("butterflies", motion=0.0, aperture=0.0)
    assert scene.moves and not still.moves
