"""Global illumination on NVIDIA Warp: a path tracer as the reference, and methods that make indirect light cheap."""

from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight
from warpgi.device import Device
from warpgi.materials import Conductor, Dielectric, Diffuse, Emissive, Mirror, Texture
from warpgi.methods import METHODS, PathTracing, Sampler
from warpgi.progress import Progress
from warpgi.render import Interrupted, render
from warpgi.scene import Scene, Shape

__version__ = "0.1.0"
__all__ = [
    "METHODS",
    "Camera",
    "Conductor",
    "Dielectric",
    "Diffuse",
    "Device",
    "DistantLight",
    "Emissive",
    "Environment",
    "Interrupted",
    "Mirror",
    "PathTracing",
    "PointLight",
    "Progress",
    "Sampler",
    "Scene",
    "Shape",
    "SpotLight",
    "Texture",
    "render",
]
