"""The methods, by the name that the command line and the bench know them by."""

from typing import Any, Protocol

import numpy as np
import warp as wp

from warpgi.film import Film
from warpgi.job import Job
from warpgi.methods.a_trous import ATrous
from warpgi.methods.ambient_occlusion import AmbientOcclusion
from warpgi.methods.instant_radiosity import InstantRadiosity, NearLight
from warpgi.methods.irradiance_cache import IrradianceCache
from warpgi.methods.irradiance_filter import IrradianceFilter
from warpgi.methods.light_field import LightField
from warpgi.methods.meshless_hierarchy import MeshlessHierarchy
from warpgi.methods.path import PathTracing, Sampler
from warpgi.methods.photon_map import Kernel, PhotonMap
from warpgi.methods.point_filter import PointFilter
from warpgi.methods.random_parameter_filter import RandomParameterFilter
from warpgi.methods.statistical_filter import StatisticalFilter
from warpgi.methods.temporal_light_field import TemporalLightField


class Method(Protocol):
    """What `render` asks of a method's settings."""

    @property
    def spp(self) -> int:
        """Samples per pixel."""

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches, to be compiled first."""

    def passes(self) -> tuple[int, str]:
        """How many units of work there are, and what they are called."""

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film, for a picture of (width, height)."""

    def prepare(self, job: Job, film: Film) -> Any:
        """Builds what it needs for this scene: its state."""

    def estimate(self, job: Job, state: Any, film: Film, first: int, count: int) -> None:
        """Does units `first` to `first + count - 1` of its passes."""

    def finish(self, job: Job, state: Any, film: Film) -> dict[str, np.ndarray]:
        """Makes the film a picture out of the units done so far; returns layers that take the place of the film's."""

    def counts(self, state: Any) -> dict[str, int]:
        """What it counts beside the film."""


class FrameMethod(Method, Protocol):
    """What `render_animation` asks, beside that, of a method whose frames build on each other.

    It is asked for the state of every frame in order, also of frames whose pictures are there already or not needed;
    the picture of a frame then depends on all frames up to it.
    """

    def prepare_next(self, job: Job, film: Film, before: Any) -> Any:
        """Builds the state of a frame, as `prepare` does, from that of the frame before, None for frame 0.

        `before` may be changed or used up; `estimate` changes nothing that is read here.
        """


#: Name of a method, the stem of its files, -> its settings.
METHODS: dict[str, type] = {
    "path": PathTracing,
    "light-field": LightField,
    "ambient-occlusion": AmbientOcclusion,
    "a-trous": ATrous,
    "random-parameter-filter": RandomParameterFilter,
    "irradiance-cache": IrradianceCache,
    "irradiance-filter": IrradianceFilter,
    "photon-map": PhotonMap,
    "instant-radiosity": InstantRadiosity,
    "temporal-light-field": TemporalLightField,
    "meshless-hierarchy": MeshlessHierarchy,
}

#: Methods of whole sequences, which `render_animation` takes and `render` does not.
SEQUENCE_METHODS: dict[str, type] = {"statistical-filter": StatisticalFilter, "point-filter": PointFilter}

#: Those that make a picture of a sample buffer alone, and those that filter the layers of a finished one.
RECONSTRUCTIONS = {name: kind for name, kind in METHODS.items() if hasattr(kind, "layers")}
DENOISERS = {name: kind for name, kind in METHODS.items() if hasattr(kind, "on_layers")}

__all__ = [
    "DENOISERS",
    "METHODS",
    "RECONSTRUCTIONS",
    "SEQUENCE_METHODS",
    "ATrous",
    "AmbientOcclusion",
    "FrameMethod",
    "InstantRadiosity",
    "IrradianceCache",
    "IrradianceFilter",
    "Kernel",
    "LightField",
    "MeshlessHierarchy",
    "Method",
    "NearLight",
    "PathTracing",
    "PhotonMap",
    "PointFilter",
    "RandomParameterFilter",
    "Sampler",
    "StatisticalFilter",
    "TemporalLightField",
]
