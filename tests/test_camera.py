"""Camera rays: where they start, where they go, and what the thin lens keeps sharp."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpgi.camera import Camera
from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels.camera import Camera as CameraStruct
from warpgi.kernels.camera import camera_ray
from warpgi.scene import Scene, Shape

wp.set_module_options({"enable_backward": False})

ULP = 2.0**-24
WIDTH, HEIGHT = 96, 54
POSITION, TARGET = np.array([3.0, 1.5, -2.0]), np.array([-1.0, 0.5, 4.0])
DISTANCE = float(np.linalg.norm(TARGET - POSITION))


@wp.kernel
def trace_camera(
    camera: CameraStruct, film: wp.array[wp.vec2], lens: wp.array[wp.vec2], o: wp.array[wp.vec3], d: wp.array[wp.vec3]
):
    i = wp.tid()
    ray = camera_ray(camera, film[i][0], film[i][1], lens[i])
    o[i] = ray.o
    d[i] = ray.d


def rays(camera: Camera, film: np.ndarray, lens: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """World origins and directions, float64, of a camera in a scene whose centre is not the origin."""
    shape = Shape([(10, 0, 0), (14, 0, 0), (10, 2, 6)], [(0, 1, 2)])
    scene = DeviceScene(Scene([shape], camera), Device("cpu"))
    film = np.atleast_2d(film).astype(np.float32)
    lens = np.full((len(film), 2), 0.5) if lens is None else lens
    o, d = (wp.zeros(len(film), dtype=wp.vec3, device="cpu") for _ in range(2))
    inputs = [scene.camera((WIDTH, HEIGHT)), wp.array(film, dtype=wp.vec2, device="cpu")]
    inputs.append(wp.array(lens.astype(np.float32), dtype=wp.vec2, device="cpu"))
    wp.launch(trace_camera, len(film), inputs=inputs, outputs=[o, d], device="cpu")
    return o.numpy().astype(np.float64) + scene.centre, d.numpy().astype(np.float64)


def camera(**changes) -> Camera:
    return Camera(**{"position": tuple(POSITION), "target": tuple(TARGET), "fov": 40.0, **changes})


def test_the_middle_looks_at_the_target():
    """The ray through the middle of the film starts at the position and passes through the target."""
    o, d = rays(camera(), [WIDTH / 2, HEIGHT / 2])
    # positions are float32 relative to a centre some 12 units away
    assert np.abs(o[0] - POSITION).max() < 16 * ULP
    assert np.abs(d[0] - (TARGET - POSITION) / DISTANCE).max() < 4 * ULP


@pytest.mark.parametrize("fov", [10.0, 40.0, 120.0])
def test_field_of_view_and_aspect(fov):
    """`fov` is the vertical angle between the middles of the upper and lower border; pixels are square."""
    film = [[WIDTH / 2, 0], [WIDTH / 2, HEIGHT], [0, HEIGHT / 2], [WIDTH, HEIGHT / 2]]
    _, d = rays(camera(fov=fov), film)
    tan_y = np.tan(np.radians(fov) / 2.0)
    angle = np.arctan2(np.linalg.norm(np.cross(d[0], d[1])), d[0] @ d[1])
    assert angle == pytest.approx(np.radians(fov), rel=1e-6)
    angle = np.arctan2(np.linalg.norm(np.cross(d[2], d[3])), d[2] @ d[3])
    assert angle == pytest.approx(2.0 * np.arctan(tan_y * WIDTH / HEIGHT), rel=1e-6)


def test_y_points_down_and_x_right():
    """From +z the film's x grows with the world's x and its y falls with the world's y; an unlevel `up` is levelled."""
    _, d = rays(Camera(position=(0, 0, 10), target=(0, 0, 0), up=(0.0, 1.0, 0.7)), [[0, 0], [WIDTH, 0], [0, HEIGHT]])
    assert d[0][0] < 0.0 < d[0][1]
    assert d[1][0] > 0.0 < d[1][1]
    assert d[2][0] < 0.0 > d[2][1]
    assert d[0] * [-1, 1, 1] == pytest.approx(d[1], abs=2 * ULP)
    assert d[0] * [1, -1, 1] == pytest.approx(d[2], abs=2 * ULP)


def test_film_positions_lie_on_a_plane():
    """Equal steps on the film are equal steps on a plane across the viewing direction: straight lines stay straight."""
    x, y = np.meshgrid(np.linspace(0, WIDTH, 13), np.linspace(0, HEIGHT, 7))
    o, d = rays(camera(fov=75.0), np.stack([x.ravel(), y.ravel()], axis=1))
    right, up, forward = camera().frame()
    p = d / (d @ forward)[:, None]
    tan_y = np.tan(np.radians(37.5))
    assert np.abs(np.linalg.norm(d, axis=1) - 1.0).max() < 4 * ULP
    assert p @ right == pytest.approx((2 * x.ravel() / WIDTH - 1) * tan_y * WIDTH / HEIGHT, abs=16 * ULP)
    assert p @ up == pytest.approx((1 - 2 * y.ravel() / HEIGHT) * tan_y, abs=16 * ULP)
    assert np.abs(o - POSITION).max() < 16 * ULP


@pytest.mark.parametrize("focus", [None, 3.0])
def test_thin_lens_is_sharp_at_the_focus_distance(focus):
    """Rays of a film point meet where the pinhole's ray crosses the plane at the focus distance; None: the target's.

    Distances count along the viewing direction, so the plane is flat.
    """
    rng = np.random.default_rng(5)
    lens = rng.random((500, 2))
    forward = camera().frame()[2]
    for film in ([0.0, 0.0], [WIDTH / 2, HEIGHT / 2], [70.3, 11.2]):
        o, d = rays(camera(lens_radius=0.4, focus_distance=focus), np.tile(film, (500, 1)), lens)
        _, pinhole = rays(camera(), film)
        distance = focus or DISTANCE
        meeting = POSITION + pinhole[0] * distance / (pinhole[0] @ forward)
        t = (distance - (o - POSITION) @ forward) / (d @ forward)
        # origins are float32 about 12 units from the centre, directions are multiplied by about 10
        assert np.abs(o + d * t[:, None] - meeting).max() < 64 * ULP
        assert np.ptp(o @ camera().frame()[0]) > 0.7  # they do start apart


def test_lens_points_are_uniform_on_the_lens(chi_square):
    """Origins fill a disc of `lens_radius` across the viewing direction evenly: r^2 and the angle are uniform."""
    count, radius = 200_000, 0.4
    lens = np.random.default_rng(6).random((count, 2))
    o, _ = rays(camera(lens_radius=radius), np.tile([WIDTH / 2, HEIGHT / 2], (count, 1)), lens)
    right, up, forward = camera().frame()
    x, y, z = ((o - POSITION) @ axis / radius for axis in (right, up, forward))
    assert np.abs(z).max() < 64 * ULP
    r2 = x * x + y * y
    assert r2.max() < 1.0 + 128 * ULP
    counts = np.histogram2d(np.minimum(r2, 1.0), np.arctan2(y, x), bins=(16, 16), range=[[0, 1], [-np.pi, np.pi]])[0]
    assert chi_square(counts, np.full(256, count / 256)) > 1e-4
