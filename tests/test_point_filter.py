"""Statistical filter at points of surfaces: what stays fixed, what is seen, and what is known of the light there."""

from dataclasses import replace

import numpy as np
import pytest

import warpgi as gi
from warpgi.__main__ import main
from warpgi.animate import render_animation
from warpgi.device_scene import DeviceScene
from warpgi.frame_renderer import frame_seed
from warpgi.point_animation import PointRun
from warpgi.scenes.primitives import box, quad

SIZE = (24, 24)
FEW = {"spp": 1, "rays": 4, "spacing": 4.0, "light_samples": 1}


def run_of(sequence, device=None, traced=True, **settings):
    """Points of a sequence and, `traced`, their filtered light."""
    numbers = tuple(range(sequence.frames))
    run = PointRun(sequence, gi.PointFilter(**(FEW | settings)), SIZE, 0, device or gi.Device("cpu"), numbers)
    for number in numbers:
        run.look_at(number)
    run.choose()
    if traced:
        for number in numbers:
            run.trace(number)
        run.filter()
    return run


def filtered(run):
    """Filtered light at the points, shape (N, P, 3)."""
    return np.stack([run.filtered(i)[0][:, 0] for i in range(len(run.numbers))])


def noisy(run):
    return np.stack([run._load("irradiance", i)[:, 0] for i in range(len(run.numbers))])


def still(frames):
    scene = gi.scenes.cornell_box()
    return gi.Sequence(frames, lambda frame: scene)


def ball(frames=4):
    return gi.scenes.moving_ball(frames=frames, subdivisions=2)


@pytest.fixture(scope="module")
def still_run():
    return run_of(still(16))


def test_a_still_scene_is_its_mean(still_run):
    """Each point of a still scene comes out at its mean over the frames, with one basis function."""
    assert still_run.modes.count == 1
    expected = np.tile(noisy(still_run).mean(axis=0, dtype=np.float64), (16, 1, 1))
    np.testing.assert_allclose(filtered(still_run), expected, rtol=1e-5, atol=1e-6)


def test_variance_falls_by_the_number_of_frames(still_run):
    """Filtered light and the mean of 16 other frames at the same points differ by two parts of 1/16 of the variance of
    single frames."""
    jobs = [still_run._job(n, frame_seed(77, n)) for n in range(16)]
    light = np.stack([still_run.lights[0].trace(job)[0][:, 0] for job in jobs])
    single = noisy(still_run).var(axis=0, ddof=1).mean()
    difference = light.mean(axis=0) - filtered(still_run)[0]
    # some thousand values: their mean square is known to a few percent
    assert np.square(difference).mean() == pytest.approx(2.0 * single / 16, rel=0.2)


def test_a_light_that_goes_on_stays_a_step():
    """Of a light that goes on at one frame less than 2 % comes to the frame before, or is missing after."""
    scene = gi.scenes.cornell_box()
    lamp = next(i for i, shape in enumerate(scene.shapes) if shape.emission is not None)

    def scene_at(frame):
        strength = 1.0 if frame < 8 else 5.0
        shape = replace(scene.shapes[lamp], emission=gi.Emissive(tuple(strength * np.ones(3))))
        return replace(scene, shapes=[*scene.shapes[:lamp], shape, *scene.shapes[lamp + 1 :]])

    run = run_of(gi.Sequence(16, scene_at), rays=256, spacing=2.0)
    light = filtered(run).sum(axis=(1, 2))
    before, after = light[:7].mean(), light[9:].mean()
    assert after == pytest.approx(5.0 * before, rel=0.02)
    # beside what leaks, all points of a frame together have the noise of its paths
    sigma = noisy(run).sum(axis=(1, 2))[8:].std(ddof=1)
    assert sigma < 0.01 * (after - before)
    assert abs(light[7] - before) < 0.02 * (after - before)
    assert abs(light[8] - after) < 0.02 * (after - before) + 2.0 * sigma


def moved(scene, offset):
    """All of a scene, carried along."""
    shift = np.asarray(offset, float)
    camera = scene.camera
    ends = (tuple(np.add(end, shift)) for end in (camera.position, camera.target))
    shapes = [replace(shape, vertices=shape.vertices + shift) for shape in scene.shapes]
    return replace(scene, shapes=shapes, camera=replace(camera, position=next(ends), target=next(ends)))


def test_light_that_moves_along_stays():
    """Where shapes, lights and camera move as one, each point's light with the same random numbers stays the same."""
    scene = gi.scenes.cornell_box()
    run = run_of(gi.Sequence(3, lambda frame: moved(scene, (0.3 * frame, 0.0, -0.1 * frame))), traced=False)
    first, *others = (run.lights[0].trace(run._job(n, 3))[0] for n in range(3))
    for other in others:
        # rounding turns a path in a thousand at an edge
        same = np.isclose(other, first, rtol=1e-3, atol=1e-4).all(axis=(1, 2))
        assert same.mean() > 0.97


def deforming(frames=3, seed=4):
    """A cube in a room whose vertices go by another affine map in each frame, seen from all around it."""
    rng = np.random.default_rng(seed)
    maps = [(np.eye(3), np.zeros(3))]
    maps += [(np.eye(3) + 0.3 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=3)) for _ in range(frames - 1)]
    cube = box((-0.5,) * 3, (0.5,) * 3).shape(gi.Diffuse(0.5), "cube", smooth=False)
    room = box((-4,) * 3, (4,) * 3, inward=True).shape(gi.Diffuse(0.5), "room", smooth=False)

    def scene_at(frame):
        matrix, offset = maps[frame]
        at = 3.0 * np.array([np.cos(2.0 * frame), 0.4, np.sin(2.0 * frame)])
        shape = replace(cube, vertices=cube.vertices @ matrix.T + offset)
        return gi.Scene([room, shape], gi.Camera(tuple(at), (0, 0, 0)), [gi.PointLight((0, 3, 0), 1.0)])

    return gi.Sequence(frames, scene_at, deforms=True), maps


def test_points_go_where_their_surface_goes():
    """A point at p of a shape that is mapped by x -> A x + b goes to A p + b, its normal with the surface's."""
    sequence, maps = deforming()
    run = run_of(sequence, traced=False)
    on_cube = run.points.shape == 1
    assert on_cube.sum() > 20
    rest = run.points.position + run.rest.centre
    for number, (matrix, offset) in enumerate(maps):
        scene = run._job(number, 0).scene
        position, normal = run.points.placed(scene)
        np.testing.assert_allclose(
            (position + scene.centre)[on_cube], rest[on_cube] @ matrix.T + offset, rtol=0.0, atol=1e-5
        )
        turned = run.points.normal @ np.linalg.inv(matrix) * np.sign(np.linalg.det(matrix))
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        np.testing.assert_allclose(normal[on_cube], turned[on_cube], rtol=0.0, atol=1e-4)
        np.testing.assert_allclose((position + scene.centre)[~on_cube], rest[~on_cube], rtol=0.0, atol=1e-5)


def blocked(triangles, start, end):
    """Whether each segment meets a triangle before its end, by brute force in float64."""
    a, b, c = (triangles[None, :, i] for i in range(3))
    d = (end - start)[:, None]
    h = np.cross(d, c - a)
    determinant = np.einsum("pti,pti->pt", b - a, h)
    with np.errstate(divide="ignore", invalid="ignore"):
        f = 1.0 / determinant
        s = start[:, None] - a
        u = f * np.einsum("pti,pti->pt", s, h)
        q = np.cross(s, b - a)
        v = f * np.einsum("pti,pti->pt", np.broadcast_to(d, q.shape), q)
        t = f * np.einsum("pti,pti->pt", c - a, q)
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & (t < 0.999)).any(axis=1)


def seen(scene, position):
    """Which points the scene's camera sees, by brute force."""
    right, up, forward = scene.camera.frame()
    d = position - np.asarray(scene.camera.position)
    depth = d @ forward
    tangent = np.tan(np.radians(scene.camera.fov) / 2.0)
    inside = (depth > 0) & (np.abs(d @ right) <= 1.001 * tangent * depth) & (np.abs(d @ up) <= 1.001 * tangent * depth)
    triangles = np.concatenate([shape.vertices[shape.faces] for shape in scene.shapes])
    start = np.tile(np.asarray(scene.camera.position, float), (len(position), 1))
    return inside & ~blocked(triangles, start, position)


def test_what_no_frame_sees_is_not_computed():
    """Every point is seen in some frame, and each frame sees some, by brute force; a wall's hidden side has none."""
    sequence, _ = deforming()
    run = run_of(sequence, traced=False)
    counts = []
    for number in range(sequence.frames):
        scene = run._job(number, 0).scene
        position, _ = run.points.placed(scene)
        counts.append(seen(sequence.scene(number), position + scene.centre))
    assert np.any(counts, axis=0).all()
    assert all(0.05 < each.mean() < 1.0 for each in counts)
    # what of the cube's six sides no frame shows
    ng = np.round(run.points.normal[run.points.shape == 1]).astype(int)
    assert {tuple(n) for n in ng} < {tuple(s * e) for e in np.eye(3, dtype=int) for s in (1, -1)}


def test_points_are_as_dense_as_the_nearest_view():
    """Points of a floor lie `spacing` pixels apart where a camera that comes down is nearest, and have gaps no wider
    than that; a half of it is as near as they get."""
    floor = quad((-5, 0, 5), (10, 0, 0), (0, 0, -10)).shape(gi.Diffuse(0.5), "floor", smooth=False)

    def scene_at(frame):
        camera = gi.Camera((0.0, 4.0 / 2**frame, 0.0), (0, 0, 0), (0, 0, 1), fov=90.0)
        return gi.Scene([floor], camera, [gi.Environment(1.0)])

    run = run_of(gi.Sequence(2, scene_at), traced=False, spacing=2.0)
    at = run.points.position[:, ::2].astype(float)
    distance = np.linalg.norm(at[:, None] - at, axis=2) + 9.0 * np.eye(len(at))
    inner = np.abs(at).max(axis=1) < 1.6
    for part, height in ((inner, 2.0), (np.abs(at).max(axis=1) > 2.4, 4.0)):
        wanted = 2.0 * 2.0 * height / SIZE[0]
        nearest = distance[part].min(axis=1)
        # radii are rounded down to powers of the root of 2; the footprint grows towards the corners of the picture
        assert nearest.min() >= wanted / np.sqrt(2.0) - 1e-6
        assert np.median(nearest) < 1.5 * wanted


@pytest.fixture(scope="module")
def ball_run():
    return run_of(ball())


def test_a_constant_is_kept_everywhere(ball_run):
    """Weights are a partition of unity: light that all points agree on is what each primary hit gets, and nearly all
    hits have points."""
    for index in range(4):
        picture, state = hits_of(ball_run, index)
        constant = np.tile(np.float32([1.0, 2.0, 3.0]), (len(ball_run.points), 1, 1))
        met = np.flatnonzero(state.face >= 0).astype(np.int32)
        values, found = ball_run.lights[0].lookup.at_hits(picture, state, met, constant)
        expected = np.tile([1.0, 2.0, 3.0], (np.count_nonzero(found), 1))
        np.testing.assert_allclose(values.numpy()[found > 0], expected, rtol=1e-5)
        assert np.count_nonzero(found == 0) < 0.01 * len(met)


def hits_of(run, index):
    """A frame's scene on the device and its primary hits."""
    from warpgi.film import Film
    from warpgi.methods.path import NEVER, Sampler
    from warpgi.sampling import path_settings, trace_primary_hits

    job = run._job(run.numbers[index], 11)
    film = Film(run.size, run.device, run.device.memory_limit)
    paths = path_settings(job, 2, NEVER, Sampler.SOBOL)
    return job.scene, trace_primary_hits(job, film, 2, 1, paths, with_place=True)


def test_light_is_not_taken_from_another_shape(ball_run):
    """A ball's hits read the ball's points alone, wherever it is, though others were near it in the rest pose."""
    for index in (0, 3):
        scene, hits = hits_of(ball_run, index)
        own = np.repeat(ball_run.points.shape[:, None, None], 3, axis=2).astype(np.float32)
        met = np.flatnonzero(hits.face >= 0).astype(np.int32)
        values, found = ball_run.lights[0].lookup.at_hits(scene, hits, met, own)
        shapes = np.searchsorted(scene.first_face, hits.face[met], side="right") - 1
        np.testing.assert_allclose(values.numpy()[found > 0, 0], shapes[found > 0], rtol=1e-5, atol=1e-5)


def test_inside_of_a_sphere():
    """In an integrating sphere each pixel has the light of irradiance P a / (S (1 - a)), but for what longer paths than
    are allowed would bring."""
    scene, expected = gi.scenes.integrating_sphere()
    sequence = gi.Sequence(2, lambda frame: scene)
    method = gi.PointFilter(**(FEW | {"max_depth": 24, "roulette_depth": None}))
    picture = gi.render_animation(sequence, method, SIZE, 0, gi.Device("cpu"))[1].layers["indirect"]
    # flat triangles, and a lens of light that is the same for all of them to within their sag
    np.testing.assert_allclose(picture, np.broadcast_to(expected.indirect_radiance, picture.shape), rtol=5e-3)


def test_both_sides_have_points():
    """A floor that is seen from the back of its triangles has the light of one that is seen from the front."""
    floor = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)).shape(gi.Diffuse(0.5), "floor", smooth=False)
    wall = quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)).shape(gi.Diffuse(0.9), "wall", smooth=False)
    camera, light = gi.Camera((0.2, 1.0, 2.4), (0, 0.1, 0)), gi.PointLight((0.5, 1.5, 0.5), 3.0)
    sums = []
    for front in (floor, replace(floor, faces=floor.faces[:, ::-1])):
        scene = gi.Scene([front, wall], camera, [light])
        sequence = gi.Sequence(1, lambda _, scene=scene: scene)
        picture = gi.render_animation(sequence, gi.PointFilter(spp=2, rays=256), SIZE, 0, gi.Device("cpu"))[0]
        assert picture.counts["fallback_hits"] < 20
        on_floor = picture.layers["position"][..., 1:2] < 0.01
        sums.append(np.where(on_floor, picture.layers["indirect"], 0.0).sum())
    assert sums[0] > 0.0
    assert sums[1] == pytest.approx(sums[0], rel=0.05)


def test_same_for_any_number_of_threads(ball_run):
    """Points, light and pictures do not depend on threads or chunks."""
    other = run_of(ball(), device=gi.Device("cpu", 3, chunk=7))
    for name in ("face", "bary", "radius"):
        np.testing.assert_array_equal(getattr(other.points, name), getattr(ball_run.points, name))
    np.testing.assert_array_equal(filtered(other), filtered(ball_run))
    np.testing.assert_array_equal(other.picture(2).image, ball_run.picture(2).image)


def test_pictures_agree_with_path_tracing():
    """The mean indirect light of a picture is path tracing's, within 5 %, with a ball and its contact shadow."""
    method = gi.PointFilter(spp=2, rays=64, spacing=2.0)
    picture = gi.render_animation(ball(3), method, (32, 32), 0, gi.Device("cpu"))[1].layers["indirect"]
    truth = gi.render(ball(3).scene(1), gi.PathTracing(spp=64), (32, 32), 1, gi.Device("cpu")).layers["indirect"]
    assert picture.mean() == pytest.approx(truth.mean(), rel=0.05)
    blocks = [image.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (picture, truth)]
    assert np.abs(blocks[0] - blocks[1]).mean() < 0.1 * truth.mean()


def test_resume_leaves_the_same_files(tmp_path):
    """Damaged light and pictures are made again, whole ones kept; the files are those of one run."""
    out = str(tmp_path / "f-{:04d}.exr")
    arguments = {"sequence": ball(3), "method": gi.PointFilter(**FEW), "size": (16, 16), "device": gi.Device("cpu")}
    first = render_animation(**arguments, out=out)
    assert first.rendered == (0, 1, 2)
    files = [*tmp_path.glob("*.exr"), *tmp_path.glob("points/*.npz")]
    assert len(files) == 6
    before = {path: path.read_bytes() for path in files}
    for path in (tmp_path / "points" / "f-0001.npz", tmp_path / "f-0002.exr"):
        path.write_bytes(path.read_bytes()[:200])
    second = render_animation(**arguments, out=out, resume=True)
    assert second.rendered == (2,)
    assert second.counts["point_rays"] == first.counts["point_rays"] // 3
    assert {path: path.read_bytes() for path in tmp_path.glob("*.exr")} == {
        path: data for path, data in before.items() if path.suffix == ".exr"
    }
    assert np.array_equal(second.modes.basis, gi.Modes.load(tmp_path / "modes.npz").basis)


def test_light_that_is_no_number_is_counted(monkeypatch):
    """A point without finite light is dark for that frame, and counted; the others keep theirs."""
    run = run_of(still(1), traced=False)
    (light,) = run.lights
    values = np.ones((len(run.points), 1, 3), np.float32)
    values[[1, 4], 0, 2] = np.nan, np.inf
    monkeypatch.setattr(light, "trace", lambda job: (values, 0))
    run.trace(0)
    assert run.counts["nonfinite"] == 2
    assert run._load("irradiance", 0).sum() == values.size - 2


def test_on_the_command_line(tmp_path, capsys):
    """`warpgi animate` writes a picture a frame, and says how many modes there are."""
    arguments = ["moving-car:frames=3", "point-filter", "--spp", "1", "--rays", "4", "--size", "16", "9"]
    assert main(["animate", *arguments, "--out", str(tmp_path / "f-{:04d}.exr"), "--device", "cpu"]) == 0
    assert "modes" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.exr"))) == 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"rays": 0}, "rays is 0"), ({"spacing": 0.0}, "spacing is 0"), ({"epsilon": 2.0}, "epsilon is 2")],
)
def test_bad_settings(settings, message):
    """A wrong setting is named."""
    with pytest.raises(ValueError, match=message):
        gi.PointFilter(**settings)


def test_bad_arguments():
    """What cannot be is refused in one sentence: equal noise, a scene that moves by itself, nothing in sight."""
    method, device = gi.PointFilter(**FEW), gi.Device("cpu")
    with pytest.raises(ValueError, match="vary_seed"):
        gi.render_animation(still(2), method, SIZE, vary_seed=False)
    with pytest.raises(TypeError, match="PointFilter, which is for a Sequence"):
        gi.render(gi.scenes.cornell_box(), method)
    scene = gi.scenes.cornell_box()
    moving = replace(scene, shapes=[replace(scene.shapes[0], motion=(0.1, 0, 0)), *scene.shapes[1:]])
    with pytest.raises(ValueError, match="the scene moves"):
        gi.render_animation(gi.Sequence(1, lambda frame: moving), method, SIZE, device=device)
    away = replace(scene, camera=gi.Camera((0, 0, -9), (0, 0, -99)))
    with pytest.raises(ValueError, match="sees no surface"):
        gi.render_animation(gi.Sequence(1, lambda frame: away), method, SIZE, device=device)


def test_rest_scene_is_the_first_frame(ball_run):
    """Distances are those of frame 0."""
    scene = DeviceScene(ball().scene(0), gi.Device("cpu"))
    np.testing.assert_allclose(ball_run.points.placed(scene)[0], ball_run.points.position, atol=1e-6)
