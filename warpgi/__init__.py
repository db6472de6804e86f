"""Global illumination on NVIDIA Warp: a path tracer as the reference, and methods that make indirect light cheap."""

__version__ = "0.1.0"

from warpgi import scenes  # type: ignore[attr-defined]
from warpgi.animate import render_animation
from warpgi.animation import Animation, write_preview
from warpgi.camera import Camera
from warpgi.denoise import denoise
from warpgi.device import Device
from warpgi.filter_animation import filter_animation
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight
from warpgi.load import load_scene
from warpgi.materials import Coated, Conductor, Dielectric, Diffuse, Emissive, Mirror, Texture
from warpgi.methods import (
    METHODS,
    AmbientOcclusion,
    ATrous,
    InstantRadiosity,
    IrradianceCache,
    IrradianceFilter,
    Kernel,
    LightField,
    MeshlessHierarchy,
    NearLight,
    PathTracing,
    PhotonMap,
    PointFilter,
    RandomParameterFilter,
    Sampler,
    StatisticalFilter,
    TemporalLightField,
)
from warpgi.metrics import compare, flicker
from warpgi.mitsuba_samples import sample_from_mitsuba
from warpgi.mitsuba_scene import to_mitsuba
from warpgi.modes import Modes
from warpgi.progress import Progress
from warpgi.reconstruct import reconstruct
from warpgi.render import Interrupted, render, versions
from warpgi.result import Render
from warpgi.samples import SampleBuffer
from warpgi.sampling import sample
from warpgi.scene import Scene, Shape
from warpgi.sequence import Sequence

__all__ = [
    "METHODS",
    "ATrous",
    "AmbientOcclusion",
    "Animation",
    "Camera",
    "Coated",
    "Conductor",
    "Device",
    "Dielectric",
    "Diffuse",
    "DistantLight",
    "Emissive",
    "Environment",
    "InstantRadiosity",
    "Interrupted",
    "IrradianceCache",
    "IrradianceFilter",
    "Kernel",
    "LightField",
    "MeshlessHierarchy",
    "Mirror",
    "Modes",
    "NearLight",
    "PathTracing",
    "PhotonMap",
    "PointFilter",
    "PointLight",
    "Progress",
    "RandomParameterFilter",
    "Render",
    "SampleBuffer",
    "Sampler",
    "Scene",
    "Sequence",
    "Shape",
    "SpotLight",
    "StatisticalFilter",
    "TemporalLightField",
    "Texture",
    "compare",
    "denoise",
    "filter_animation",
    "flicker",
    "load_scene",
    "reconstruct",
    "render",
    "render_animation",
    "sample",
    "sample_from_mitsuba",
    "scenes",
    "to_mitsuba",
    "versions",
    "write_preview",
]
