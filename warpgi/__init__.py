"""Global illumination on NVIDIA Warp: a path tracer as the reference, and methods that make indirect light cheap."""

from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight
from warpgi.materials import Conductor, Dielectric, Diffuse, Emissive, Mirror, Texture
from warpgi.scene import Scene, Shape

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "Conductor",
    "Dielectric",
    "Diffuse",
    "DistantLight",
    "Emissive",
    "Environment",
    "Mirror",
    "PointLight",
    "Scene",
    "Shape",
    "SpotLight",
    "Texture",
]
