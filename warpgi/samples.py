"""Sample buffers: the secondary rays from which the light field is reconstructed (Lehtinen et al. 2012)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, fields
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np

from warpgi import checks, samples_file
from warpgi.image import PathLike

#: A point with a coordinate of this size or above says that its ray hit nothing.
NO_HIT = 1e10

# How far along an escaped ray `escaped_hit` puts the point: the largest coordinate of a unit vector is above 0.57.
ESCAPED_DISTANCE = 1e11

REQUIRED = ("radiance", "origin", "hit", "origin_normal", "hit_normal", "albedo")

# Optional array -> its columns, 0 where it has one axis.
OPTIONAL = {
    "bandwidth": 0,
    "image_xy": 2,
    "lens": 2,
    "time": 0,
    "origin_motion": 3,
    "hit_motion": 3,
    "direct": 3,
    "throughput": 3,
    "hit_direct": 3,
}


# Optional arrays that no version of the file format has.
UNFILED = {"wo": 3, "reflectance": 3, "base_radiance": 3, "weight": 3}
UNFILED_INTEGERS = ("material", "layer")


class Checked(NamedTuple):
    """What each sample of a buffer is good for."""

    is_primary: np.ndarray
    """Has a primary hit that can be shaded: bool, shape (N,)."""
    is_splat: np.ndarray
    """Has a secondary hit that can be a splat: bool, shape (N,); whatever its primary normal and albedo are."""
    is_escaped: np.ndarray
    """Has a secondary ray that left the scene, of known direction: bool, shape (N,); never a splat too."""
    counts: dict[str, int]
    """Samples not used, or in part, each counted once under its first fault: "nonfinite", "zero_length", "bad_normal";
    and the states "primary_missed" and "escaped", which are no faults."""


@dataclass(frozen=True, eq=False)
class ScreenSamples:
    """What the versions 1.2 and 1.3 of the file format hold besides colour, lens and time: no secondary rays."""

    depth: np.ndarray
    """Camera-space depth, positive and larger farther away (z in 1.2, w in 1.3), shape (N,)."""
    motion: np.ndarray
    """Over the shutter: (x, y) in pixels, shape (N, 2) in 1.2; of (x w, y w, w), shape (N, 3), in 1.3."""
    depth_gradient: np.ndarray
    """d depth / d (x, y), shape (N, 2)."""
    coc_radius: np.ndarray | None = None
    """Radius of the circle of confusion [pixels], shape (N,), in 1.2."""
    projected_depth: np.ndarray | None = None
    """z/w, shape (N,), in 1.3."""
    alpha: np.ndarray | None = None
    """Coverage, shape (N,), in 1.3."""
    motion_model: str = "affine"
    """As the file says: "affine" or "perspective"."""


@dataclass(frozen=True, eq=False, repr=False)
class SampleBuffer:
    """Secondary rays with what they saw, N samples in pixel order (y, then x, then sample), all in one space.

    It carries only what the scene needs: without motion, lens, glossy surfaces or recursive filtering the arrays for
    them stay None. Arrays are float32; those in C order are kept as they are, not copied, so do not change them once
    `checked` was called. A ray that hit nothing is marked as in the file format: `origin` or `hit` has a coordinate of
    1e10 or above (`escaped_hit` makes such a hit from a direction). Normals need not be of exactly unit length.

    Raises:
        TypeError, ValueError: an argument is of another shape or type, or `pixel` is out of order or range.

    Example:
        >>> import numpy as np
        >>> ones = np.ones((8, 3), np.float32)
        >>> buffer = SampleBuffer(2, 1, 4, radiance=ones, origin=0 * ones, hit=ones, origin_normal=ones,
        ...                       hit_normal=-ones, albedo=ones)
        >>> buffer.bytes_per_sample, buffer.checked.counts["zero_length"]
        (72, 0)
    """

    width: int
    """Pixels in a row."""
    height: int
    """Rows."""
    spp: int
    """Samples per pixel: N = width * height * spp; 0 where `pixel` places them."""
    radiance: np.ndarray
    """Radiance along the secondary ray, from hit to origin [W/(sr m^2)], shape (N, 3)."""
    origin: np.ndarray
    """The primary hit, where the secondary ray starts, shape (N, 3); a coordinate of 1e10 or above: no primary hit."""
    hit: np.ndarray
    """The secondary hit, shape (N, 3); a coordinate of 1e10 or above: the ray left the scene towards there."""
    origin_normal: np.ndarray
    """Normal at `origin`, shape (N, 3)."""
    hit_normal: np.ndarray
    """Normal at `hit`, shape (N, 3); not read where there is no hit."""
    albedo: np.ndarray
    """Reflectance of the primary hit, shape (N, 3)."""
    pixel: np.ndarray | None = None
    """Pixel y * width + x of each sample, int32 in ascending order, shape (N,); None: `spp` samples in every pixel."""
    bandwidth: np.ndarray | None = None
    """Angular bandwidth w of the BRDF at the secondary hit, a Blinn exponent, 0 where diffuse, shape (N,)."""
    image_xy: np.ndarray | None = None
    """Where in the picture the sample was taken [pixels], shape (N, 2)."""
    lens: np.ndarray | None = None
    """Lens coordinates in [-1, 1], shape (N, 2)."""
    time: np.ndarray | None = None
    """Time in [0, 1] at which the sample was taken, shape (N,)."""
    origin_motion: np.ndarray | None = None
    """Motion of `origin` from time 0 to 1, shape (N, 3)."""
    hit_motion: np.ndarray | None = None
    """Motion of `hit` from time 0 to 1, shape (N, 3)."""
    direct: np.ndarray | None = None
    """Direct light at the primary hit, not part of `radiance` [W/(sr m^2)], shape (N, 3)."""
    throughput: np.ndarray | None = None
    """Path throughput at the secondary hit: what its indirect light is multiplied by, shape (N, 3)."""
    hit_direct: np.ndarray | None = None
    """Direct light at the secondary hit, part of `radiance` [W/(sr m^2)], shape (N, 3)."""
    wo: np.ndarray | None = None
    """Unit vector from `origin` to what sees it, shape (N, 3); goes with `material`. Files hold neither it nor the
    five arrays below, which only glossy surfaces need."""
    material: np.ndarray | None = None
    """Number in `materials` of the primary hit's, int32, shape (N,)."""
    reflectance: np.ndarray | None = None
    """Albedo or reflectance of that material at `origin`, shape (N, 3). Where it is not diffuse, `albedo` is what
    multiplies its BSDF: 1, or what mirrors before it left."""
    layer: np.ndarray | None = None
    """Layer that the secondary ray was drawn from, int32, shape (N,): 0 diffuse, 1 glossy."""
    base_radiance: np.ndarray | None = None
    """Part of `radiance` that left the secondary hit by way of a diffuse layer, shape (N, 3); the rest has
    `bandwidth`."""
    weight: np.ndarray | None = None
    """What a glossy primary hit reflects of `radiance`, its BSDF times cosine over the density of the ray's direction;
    1 where it is diffuse, shape (N, 3). Image-space filters need it."""
    materials: tuple[Any, ...] = ()
    """What `material` counts."""
    beyond: SampleBuffer | None = None
    """The path's next segments where secondary rays met mirrors: from there (`origin`, `origin_normal`) to what is
    seen in the mirror, with all light along them; `albedo` is what the mirror reflects, `pixel` the sample's number
    here, in a picture of one row. Files do not hold it."""
    coc: tuple[float, float] = (0.0, 0.0)
    """C0, C1: the circle of confusion at depth z has the radius C0/z + C1 [pixels]."""
    pixel_to_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    """From pixels to points on the focal plane in camera space, shape (4, 4), float64."""
    screen: ScreenSamples | None = None
    """What a file of version 1.2 or 1.3 holds in place of secondary rays; then every `origin` and `hit` is no hit."""

    def __post_init__(self) -> None:
        for name, lower in (("width", 1), ("height", 1), ("spp", 0)):
            object.__setattr__(self, name, checks.count(name, getattr(self, name), lower))
        if self.pixel is None:
            count = self.width * self.height * self.spp
            reason = f"{self.width} x {self.height} pixels of {self.spp} samples"
        else:
            object.__setattr__(self, "pixel", self._checked_pixel())
            count = len(self.pixel)
            reason = "one row for each value of pixel"
        for name in REQUIRED:
            object.__setattr__(self, name, _array(name, getattr(self, name), (count, 3), np.float32, reason))
        for name, columns in OPTIONAL.items():
            shape = (count, columns) if columns else (count,)
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _array(name, getattr(self, name), shape, np.float32, reason))
        for name, columns in UNFILED.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _array(name, getattr(self, name), (count, columns), np.float32, reason))
        for name in UNFILED_INTEGERS:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _array(name, getattr(self, name), (count,), np.int32, reason))
        if self.beyond is not None and (self.beyond.pixel is None or self.beyond.width != count):
            raise ValueError(f"beyond lacks pixel or is not {count} pixels wide, expected the samples' numbers there")
        object.__setattr__(self, "coc", tuple(checks.finite_array("coc", self.coc, (2,)).tolist()))
        matrix = checks.finite_array("pixel_to_camera", self.pixel_to_camera, (4, 4))
        object.__setattr__(self, "pixel_to_camera", matrix)

    def _checked_pixel(self) -> np.ndarray:
        if self.spp:
            raise ValueError(f"spp is {self.spp}, expected 0 where pixel says where each sample lies")
        pixel = _array("pixel", self.pixel, None, np.int32, "one index per sample")
        if len(pixel) and (pixel[0] < 0 or pixel[-1] >= self.width * self.height):
            raise ValueError(
                f"pixel runs from {pixel[0]} to {pixel[-1]}, expected values from 0 to {self.width * self.height - 1}"
            )
        if (pixel[1:] < pixel[:-1]).any():
            raise ValueError("pixel falls somewhere, expected ascending values: samples stand in pixel order")
        return pixel

    def __len__(self) -> int:
        return len(self.radiance)

    def __repr__(self) -> str:
        spp = f"{self.spp} spp" if self.pixel is None else f"{len(self)} samples"
        optional = [name for name in (*OPTIONAL, *UNFILED, *UNFILED_INTEGERS) if getattr(self, name) is not None]
        return f"SampleBuffer({self.width} x {self.height}, {spp}{', with ' if optional else ''}{', '.join(optional)})"

    @property
    def has_secondary_rays(self) -> bool:
        """Whether it can be reconstructed from; not so for files of version 1.2 and 1.3."""
        return self.screen is None

    @property
    def bytes_per_sample(self) -> int:
        """Bytes on the host for one sample: 72, and more for each optional array."""
        names = (*REQUIRED, *OPTIONAL, *UNFILED, *UNFILED_INTEGERS, "pixel")
        arrays = [getattr(self, name) for name in names]
        if self.screen is not None:
            arrays += [value for value in vars(self.screen).values() if isinstance(value, np.ndarray)]
        return sum(array.itemsize * math.prod(array.shape[1:]) for array in arrays if array is not None)

    @property
    def pixel_of_sample(self) -> np.ndarray:
        """Pixel y * width + x of every sample, shape (N,), int32."""
        if self.pixel is not None:
            return self.pixel
        return (np.arange(len(self)) // max(self.spp, 1)).astype(np.int32)

    @property
    @np.errstate(invalid="ignore")
    def kappa(self) -> np.ndarray | None:
        """Concentration of the von Mises-Fisher lobe, 4 sqrt(bandwidth), shape (N,); 0 is diffuse; None: all are."""
        return None if self.bandwidth is None else 4.0 * np.sqrt(np.maximum(self.bandwidth, np.float32(0.0)))

    @property
    def unit_origin_normal(self) -> np.ndarray:
        """`origin_normal` made unit length, shape (N, 3), float32; 0 where it has no direction."""
        return unit(self.origin_normal)

    @property
    def unit_hit_normal(self) -> np.ndarray:
        """`hit_normal` made unit length, shape (N, 3), float32; 0 where it has no direction."""
        return unit(self.hit_normal)

    @property
    @np.errstate(invalid="ignore")
    def direction(self) -> np.ndarray:
        """Unit vector from origin to hit, shape (N, 3), float32; 0 where the sample is neither splat nor escaped."""
        state = self.checked
        used = (state.is_splat | state.is_escaped)[:, None]
        return unit(np.where(used, self.hit - self.origin, np.float32(0.0)))

    @cached_property
    @np.errstate(invalid="ignore")
    def checked(self) -> Checked:
        """Which samples can be used for what, and how many cannot; computed once.

        A sample without a primary hit is not looked at further. Else a primary hit needs a finite `origin`, `albedo`
        and whatever else is recorded there, and a normal that has a direction; a splat needs the same of the secondary
        hit, and one that is not the origin itself; an escaped ray needs a finite `origin`, `hit` and `radiance`. So a
        primary hit can be shaded where its own secondary ray is faulty, and the other way round.
        """
        missed = _largest(self.origin) >= NO_HIT
        far = _largest(self.hit) >= NO_HIT
        primary = _finite(
            self.origin,
            self.albedo,
            self.direct,
            self.origin_motion,
            self.image_xy,
            self.lens,
            self.time,
            self.wo,
            self.reflectance,
        )
        ray = _finite(self.origin, self.hit, self.radiance, self.weight)
        rest = _finite(self.origin, self.bandwidth, self.hit_motion, self.time, self.throughput, self.hit_direct)
        rest = rest if self.base_radiance is None else rest & _finite(self.base_radiance)
        secondary = ray & (far | rest)
        zero_length = _all(self.hit == self.origin)
        origin_normal, hit_normal = _has_direction(self.origin_normal), _has_direction(self.hit_normal)

        is_primary = ~missed & primary & origin_normal
        is_escaped = ~missed & far & ray
        is_splat = ~missed & ~far & secondary & ~zero_length & hit_normal
        faulty = ~missed & ~(is_primary & (is_splat | is_escaped))
        nonfinite = faulty & ~(primary & secondary)
        zero_length = faulty & ~nonfinite & zero_length
        counts = {
            "nonfinite": nonfinite,
            "zero_length": zero_length,
            "bad_normal": faulty & ~nonfinite & ~zero_length,
            "primary_missed": missed,
            "escaped": is_escaped,
        }
        totals = {name: int(np.count_nonzero(flags)) for name, flags in counts.items()}
        return Checked(is_primary, is_splat, is_escaped, totals)

    @classmethod
    @np.errstate(invalid="ignore")  # a file may hold any bits, and merely to compare a signalling NaN would warn
    def load(cls, path: PathLike) -> SampleBuffer:
        """Reads a file in the format of Lehtinen et al.'s program, version 1.2, 1.3, 2.0, 2.1 or 2.2, text or binary.

        The header stands in a file of the same name with ".header" after it, or at the top of a text file. Optional
        channels that are 0 throughout, of either sign, become None; so does the time where it is constant and nothing
        moves, and the lens where it is constant and the circle of confusion is 0. Samples of version 2.1 are placed by
        their x and y, and sorted by pixel where they are not. Version 1.2 and 1.3 hold no secondary rays (`screen`).
        No sample is dropped here: `checked` says what is wrong with them.

        Args:
            path: the data file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the header cannot be read, or the data is not what it announces.
        """
        if not os.path.isfile(path):
            raise FileNotFoundError(f"{os.fspath(path)} does not exist, expected a sample buffer")
        header, channels = samples_file.read(path)
        known: dict[str, Any] = {"width": header.width, "height": header.height, "spp": header.spp, "coc": header.coc}
        if header.version < 2.0:
            return cls(**known, **_screen_fields(header, channels))
        if "exponent" in channels:  # 2.1 has a bandwidth of its own; w serves where that is 0
            exponent = channels.pop("exponent")
            channels["bandwidth"] = exponent if exponent.any() else channels["bandwidth"]
        optional = _needed({name: channels[name] for name in OPTIONAL if name in channels}, header.coc)
        arrays: dict[str, Any] = {name: channels[name] for name in REQUIRED} | optional
        if header.irregular:
            # image_xy may have gone as all zeros: every sample then lies in the first pixel
            pixel = _place(samples_file.name_of(path), channels["image_xy"], header.width, header.height)
            if (pixel[1:] < pixel[:-1]).any():
                order = np.argsort(pixel, kind="stable")
                pixel, arrays = pixel[order], {name: array[order] for name, array in arrays.items()}
            arrays["pixel"] = pixel
        return cls(**known, pixel_to_camera=header.pixel_to_camera, **arrays)

    @np.errstate(invalid="ignore")
    def save(self, path: PathLike, text: bool | None = None) -> None:
        """Writes it in version 2.2 of the format, all 39 values; where `pixel` places the samples, in version 2.1.

        Binary keeps every bit, text (9 digits) every number. Arrays that are None are written as 0. Data and header
        appear under their names when they are complete, the data first. When a file is overwritten, its old header
        goes away just before: a process killed in between leaves data without a header, never with another's.

        Args:
            path: the data file; the header's name is the same with ".header" after it.
            text: write numbers as text, two to three times as large; None: if the name ends in .txt.

        Raises:
            ValueError: there is no sample or no secondary ray, or version 2.1 cannot hold what is there.
            OSError: a file cannot be written.
        """
        name = samples_file.name_of(path)
        if len(self) == 0:
            raise ValueError(f"cannot write {name}: the buffer holds no sample")
        if not self.has_secondary_rays:
            raise ValueError(f"cannot write {name}: the buffer holds no secondary rays, which version 2.2 is made of")
        channels = {name: getattr(self, name) for name in (*REQUIRED, *OPTIONAL)}
        if self.pixel is not None:
            for extra in ("throughput", "hit_direct"):
                if channels.pop(extra) is not None:
                    raise ValueError(f"cannot write {name}: version 2.1, for irregular samples, cannot hold {extra}")
            if self.image_xy is None:
                centres = np.stack([self.pixel % self.width, self.pixel // self.width], axis=1) + 0.5
                channels["image_xy"] = centres.astype(np.float32)
            elif not np.array_equal(_place(name, self.image_xy, self.width, self.height), self.pixel):
                raise ValueError(f"cannot write {name}: image_xy and pixel place samples differently")
        header = samples_file.Header(
            version=2.2 if self.pixel is None else 2.1,
            width=self.width,
            height=self.height,
            spp=self.spp,
            count=len(self),
            coc=self.coc,
            pixel_to_camera=self.pixel_to_camera,
            text=name.lower().endswith(".txt") if text is None else bool(text),
        )
        samples_file.write(path, header, channels)


def escaped_hit(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The `hit` of rays that left the scene in these unit directions: far out, where the format reads "no hit".

    Args:
        origin: shape (N, 3).
        direction: unit vectors, shape (N, 3).

    Returns:
        Shape (N, 3), float32; the direction from `origin` to it is the given one to float32 precision.
    """
    far = np.asarray(origin, dtype=np.float64) + ESCAPED_DISTANCE * np.asarray(direction, dtype=np.float64)
    return far.astype(np.float32)


@np.errstate(invalid="ignore")
def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors, shape (N, 3), made unit length as float32; 0 where they are 0 or not finite.

    The squares are float64: those of a far point's coordinates or of a tiny normal's are beyond float32.
    """
    exact = vectors.astype(np.float64, copy=False)
    length = np.sqrt(np.einsum("ij,ij->i", exact, exact))[:, None]
    good = np.isfinite(length) & (length > 0.0)
    return np.divide(exact, length, out=np.zeros_like(exact), where=good).astype(np.float32)


def _array(name: str, value: Any, shape: tuple[int, ...] | None, dtype: type[np.generic], reason: str) -> np.ndarray:
    try:
        array = np.asarray(value)  # no copy of numpy's arrays, nor of Warp's on the cpu
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} is {type(value).__name__}, expected an array of {np.dtype(dtype).name}") from error
    if array.dtype != dtype:
        kind = f"an array of {array.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise TypeError(f"{name} is {kind}, expected an array of {np.dtype(dtype).name}")
    shape = (array.size,) if shape is None else shape
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}: {reason}")
    return np.ascontiguousarray(array)


def _largest(points: np.ndarray) -> np.ndarray:
    # the largest coordinate; NaN where one is, which is not "no hit"
    x, y, z = np.abs(points).T
    return np.maximum(np.maximum(x, y), z)


def _finite(first: np.ndarray, *others: np.ndarray | None) -> np.ndarray:
    flags = np.ones(len(first), dtype=bool)
    for array in (first, *others):
        if array is not None:
            flags &= np.isfinite(array) if array.ndim == 1 else _all(np.isfinite(array))
    return flags


def _has_direction(vectors: np.ndarray) -> np.ndarray:
    return _finite(vectors) & ~_all(vectors == 0.0)


def _all(flags: np.ndarray) -> np.ndarray:
    # of each row; numpy's reduction over a short last axis is several times slower
    return reduce(np.logical_and, flags.T)


def _needed(optional: dict[str, np.ndarray], coc: tuple[float, float]) -> dict[str, np.ndarray]:
    needed = {name: array for name, array in optional.items() if array.any()}
    still = "origin_motion" not in needed and "hit_motion" not in needed
    for name, unused in (("time", still), ("lens", coc == (0.0, 0.0))):
        if unused and name in needed and (needed[name] == needed[name][0]).all():
            del needed[name]
    return needed


def _place(name: str, image_xy: np.ndarray, width: int, height: int) -> np.ndarray:
    x, y = np.floor(image_xy.astype(np.float64)).T
    outside = ~((x >= 0) & (x < width) & (y >= 0) & (y < height))
    if outside.any():
        first = int(np.argmax(outside))
        at = ", ".join(f"{value:g}" for value in image_xy[first])
        raise ValueError(f"{name}: sample {first} lies at ({at}), expected a place inside {width} x {height} pixels")
    return (y * width + x).astype(np.int32)


def _screen_fields(header: samples_file.Header, channels: dict[str, np.ndarray]) -> dict[str, Any]:
    names = [entry.name for entry in fields(ScreenSamples)]
    screen = ScreenSamples(
        **{name: channels[name] for name in names if name in channels}, motion_model=header.motion_model
    )
    nothing = np.full((header.count, 3), ESCAPED_DISTANCE, dtype=np.float32)
    zero = np.zeros((header.count, 3), dtype=np.float32)
    arrays = {"origin": nothing, "hit": nothing, "origin_normal": zero, "hit_normal": zero, "albedo": zero}
    # lens and time are what these files are for: they go only where they are 0
    kept = {name: channels[name] for name in ("image_xy", "lens", "time") if channels[name].any()}
    return {"radiance": channels["radiance"], "screen": screen, **arrays, **kept}
