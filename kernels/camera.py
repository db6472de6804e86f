"""Camera rays: pinhole or thin lens."""

import warp as wp

from warpgi.kernels.sampling import square_to_disc

wp.set_module_options({"enable_backward": False})


@wp.struct
class Camera:
    position: wp.vec3  # relative to the scene's centre
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    tan_x: float  # tangent of half the horizontal field of view
    tan_y: float
    lens_radius: float
    focus_distance: float
    shutter_open: float  # scene time
    shutter_length: float
    width: int
    height: int


@wp.struct
class Ray:
    o: wp.vec3
    d: wp.vec3


@wp.func
def camera_ray(camera: Camera, x: float, y: float, lens: wp.vec2):
    """Ray through film position (x, y) in pixels, y down; `lens` in the unit square."""
    sx = (2.0 * x / float(camera.width) - 1.0) * camera.tan_x
    sy = (1.0 - 2.0 * y / float(camera.height)) * camera.tan_y
    d = camera.forward + camera.right * sx + camera.up * sy
    ray = Ray()
    ray.o = camera.position
    if camera.lens_radius > 0.0:
        disc = square_to_disc(lens) * camera.lens_radius
        shift = camera.right * disc[0] + camera.up * disc[1]
        ray.o = camera.position + shift
        d = d * camera.focus_distance - shift
    ray.d = wp.normalize(d)
    return ray


@wp.func
def shutter_time(camera: Camera, u: float):
    """Scene time at the part u of the shutter's interval."""
    return camera.shutter_open + camera.shutter_length * u
