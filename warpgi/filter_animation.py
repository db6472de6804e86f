"""`filter_animation`: the statistical filter on the frames of a rendered sequence."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from warpgi.animation import Animation, frame_layer
from warpgi.cluster import Cluster, open_cluster
from warpgi.device import Device, as_device
from warpgi.fingerprint import fingerprint
from warpgi.frame_files import FrameFiles, make_frames
from warpgi.kernels import irradiance_filter, statistical_filter
from warpgi.methods.statistical_filter import StatisticalFilter
from warpgi.progress import Progress
from warpgi.render import provenance
from warpgi.result import Render
from warpgi.statistical_filtering import FrameMatrix, PixelSmoother, Projection
from warpgi.timing import Timings

if TYPE_CHECKING:
    from distributed import Client

# File beside the filtered frames that holds the basis functions.
MODES = "modes.npz"


def filter_animation(
    noisy: Animation,
    method: StatisticalFilter | None = None,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    cluster: bool | str | Client = False,
) -> Animation:
    """Filters the layer "indirect" of a rendered sequence in time, or where there is none its image.

    Frames are read one at a time, in a pass for the products of all pairs, one for the basis functions, and one that
    writes; where all frames of the layer fit into half the device's memory limit they are read once for the first two.
    The result is the same to the last bit.

    Args:
        noisy: the frames, in memory or in files, of this or another renderer; noise that differs from frame to frame.
        method: settings; those that say how frames are rendered mean nothing here.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        progress: True shows a bar on standard error; a function gets a `Progress` after every frame.
        out: the filtered frames' files, such as "folder/frame-{:04d}.exr"; basis functions go to modes.npz beside them.
            None keeps frames in memory.
        resume: keep filtered frames that are whole and of these very noisy ones.
        cluster: multiply frames on workers of Dask distributed, as `render_animation` takes them; pictures are read
            and written here.

    Returns:
        The frames, the filtered layer in place of its input and without "variance", which they no longer have; and
        `modes`, the basis functions and truncations. Pixels that were not finite count as black, and in
        `counts["nonfinite_pixels"]`.

    Raises:
        TypeError, ValueError: an argument is wrong or a layer is missing.
        ImportError: `cluster` is asked for and Dask distributed is not installed.
        OSError: a file cannot be written, or the cluster cannot be reached.

    Example:
        >>> import warpgi as gi
        >>> noisy = gi.render_animation(gi.scenes.moving_light(frames=4), gi.PathTracing(spp=4), size=(16, 16))
        >>> filtered = gi.filter_animation(noisy)
        >>> filtered.modes.basis.shape[1:]
        (16, 16, 3)
    """
    if not isinstance(noisy, Animation):
        raise TypeError(f"noisy is {type(noisy).__name__}, expected Animation")
    method = StatisticalFilter() if method is None else method
    if not isinstance(method, StatisticalFilter):
        raise TypeError(f"method is {type(method).__name__}, expected StatisticalFilter")
    if method.high_spp:
        raise ValueError(f"high_spp is {method.high_spp}, expected 0: there is no scene, use render_animation")
    device = as_device(device)
    with open_cluster(cluster, device) as workers:
        return filter_frames(noisy, method, device, progress, out, resume, cluster=workers)


#: Gives the layer of a frame, by its number, at some pixels, shape (n, 3), sampled anew.
Resample = Callable[[int, np.ndarray], np.ndarray]


def filter_frames(
    noisy: Animation,
    method: StatisticalFilter,
    device: Device,
    progress: bool | Callable[[Progress], None] = False,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    resample: Resample | None = None,
    cluster: Cluster | None = None,
) -> Animation:
    """`filter_animation` with its arguments checked, and importance sampling where the scene is at hand."""
    files = None if out is None else FrameFiles(out)
    if resume and files is None:
        raise ValueError("resume is True, expected False where out is None: there are no files to go on from")
    run = FilterRun(noisy, method, device, resample, cluster)
    counts: Counter[str] = Counter()
    sources, rendered = make_frames(noisy.frames, run.identity, run.frame, files, resume, run.timings, counts, progress)
    if files:
        run.modes.save(files.path(noisy.frames[0]).with_name(MODES))
    return Animation(sources, noisy.frames, noisy.fps, dict(run.timings), dict(counts), tuple(rendered), run.modes)


class FilterRun:
    """The filter on one rendered sequence.

    Timings: "read" is what it takes to get at the frames, "filter" what is computed, "resample" importance sampling.

    Attributes:
        modes: basis functions and truncations.
        identity: digest of all that the filtered frames depend on.
    """

    def __init__(
        self,
        noisy: Animation,
        method: StatisticalFilter,
        device: Device,
        resample: Resample | None,
        cluster: Cluster | None = None,
    ) -> None:
        self.noisy, self.method, self.device, self._resample = noisy, method, device, resample
        self.timings = Timings()
        with self.timings.stage("compile"):
            device.load((statistical_filter.project, irradiance_filter.filter_pixels))
        first = noisy[0]
        self.layer = "indirect" if "indirect" in first.layers else "image"
        self.height, self.width = first.image.shape[:2]
        self._features = FeatureMeans()
        self._identities: dict[int, str] = {}
        self._nonfinite: dict[int, int] = {}  # pixels, by frame
        size = (self.width, self.height)
        with self.timings.stage("filter"):
            matrix = FrameMatrix(self._load, len(noisy), size, device)
            smooth = PixelSmoother(method, size, device, self._features.means)
            self._projection = Projection(matrix, method, size, smooth, cluster=cluster)
        # reading happened in there
        self.timings["filter"] -= self.timings["read"]
        self.modes = self._projection.modes
        share = high_share(self.modes.truncation, method) if resample else np.zeros((self.height, self.width))
        self._pixels = np.flatnonzero(share)
        self._share = share.reshape(-1, 1)[self._pixels]
        extra = method.high_spp * len(self._pixels) / share.size
        self.modes.average_spp = first.spp + extra if first.spp else None
        self.identity = fingerprint(method, [self._identities[i] for i in range(len(noisy))], len(self._pixels))

    def frame(self, index: int) -> Render:
        """The filtered picture of one frame."""
        with self.timings.stage("filter"):
            values = self._projection.frame(index)
        if len(self._pixels) and self._resample:
            with self.timings.stage("resample"):
                flat = values.reshape(-1, 3)
                high = self._resample(self.noisy.frames[index], self._pixels)
                flat[self._pixels] = (1.0 - self._share) * flat[self._pixels] + self._share * high
        with self.timings.stage("read"):
            picture = self.noisy[index]
        layers = {name: pixels for name, pixels in picture.layers.items() if name != "variance"}
        if self.layer == "indirect" and "image" in layers:
            layers["image"] = layers["image"] + (values - layers["indirect"])
        layers[self.layer] = values
        lost = self._nonfinite[index]
        result = Render(
            layers,
            counts=picture.counts | ({"nonfinite_pixels": lost} if lost else {}),
            spp=picture.spp,
            scene=picture.scene,
            **provenance(self.method, picture.seed, self.device),
        )
        result.settings["input"] = {"method": picture.method, "settings": picture.settings}
        return result

    def _load(self, index: int) -> np.ndarray:
        with self.timings.stage("read"):
            picture = self.noisy[index]
            values = frame_layer(picture, self.layer)
            if values.shape[:2] != (self.height, self.width):
                want = (self.height, self.width)
                raise ValueError(f"frame {self.noisy.frames[index]} has {values.shape[:2]} pixels, expected {want}")
            if index not in self._identities:
                self._features.add(picture)
                self._identities[index] = picture.identity or fingerprint(values)
            finite = np.isfinite(values)
            self._nonfinite[index] = int(np.count_nonzero(~finite.all(axis=2)))
            return np.where(finite, values, np.float32(0.0))


def high_share(truncation: np.ndarray, method: StatisticalFilter) -> np.ndarray:
    """Share alpha of pixels that are sampled anew (MA06, sec. 3.2), shape (H, W), float32 in [0, 1]."""
    if not method.high_spp:
        return np.zeros_like(truncation)
    alpha = (truncation - method.modes_low) / (method.modes_high - method.modes_low)
    return np.clip(alpha, 0.0, 1.0).astype(np.float32)


class FeatureMeans:
    """Means of the feature layers over frames, which say what surfaces pixels show."""

    LAYERS = ("normal", "position", "depth")

    def __init__(self) -> None:
        self._sums: dict[str, np.ndarray] = {}
        self._count = 0

    def add(self, picture: Render) -> None:
        """Adds a frame; a layer that one frame lacks is left out."""
        first = self._count == 0
        names = [name for name in self.LAYERS if name in picture.layers and (first or name in self._sums)]
        self._sums = {name: self._sums.get(name, 0.0) + picture.layers[name].astype(np.float64) for name in names}
        self._count += 1

    def means(self) -> Mapping[str, np.ndarray]:
        """Means of the layers, float32.

        Raises:
            ValueError: frames have no normal.
        """
        if "normal" not in self._sums:
            raise ValueError("frames hold no layer normal, expected it, or map_radius 0")
        return {name: (total / self._count).astype(np.float32) for name, total in self._sums.items()}
