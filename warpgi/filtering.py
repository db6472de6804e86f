"""What image-space filters work on, from a sample buffer or from the layers of a picture, and how they are run.

Filters work on light without the texture that it falls on: radiance divided by albedo, which is irradiance over pi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from warpgi import checks
from warpgi.device import Device
from warpgi.film import Film
from warpgi.job import Job
from warpgi.materials import Diffuse
from warpgi.methods.path import NEVER, Sampler, check_paths
from warpgi.reconstruction import PrimaryHits, pixel_means
from warpgi.samples import NO_HIT, SampleBuffer
from warpgi.sampling import PRIMARY_BYTES, SECONDARY_BYTES, trace_sample_buffer

# Below this share of reflected light, albedo does not explain what a pixel shows: metal in a layer of diffuse colour.
SMALLEST_ALBEDO = 1e-3

# Least that light of glossy surfaces is divided by: normal reflectance of a coat, which is there over black too.
COAT_REFLECTANCE = 0.04

# Field of view, across the larger side, with which depth alone is taken for positions: tan of half of 40 degrees.
ASSUMED_TAN = 0.364


@dataclass(frozen=True, eq=False)
class FilterInput:
    """N rows in pixel order, one or more a pixel; a filtered row is albedo x filtered value + rest. float32."""

    width: int
    height: int
    pixel: np.ndarray
    """Pixel y * width + x of each row, shape (N,), int32."""
    value: np.ndarray
    """Demodulated radiance, shape (N, 3); 0 where not known."""
    known: np.ndarray
    """1 where a channel of `value` is known, else 0, shape (N, 3)."""
    albedo: np.ndarray
    """What multiplies the filtered value, shape (N, 3)."""
    rest: np.ndarray
    """Light that is not filtered, shape (N, 3); NaN where a pixel cannot be mended."""
    normal: np.ndarray
    """Shape (N, 3); 0 where a row is not filtered."""
    position: np.ndarray
    """Shape (N, 3); finite."""
    hit_normal: np.ndarray | None = None
    """Normal of the secondary hit, against the ray where it escaped, shape (N, 3); None: not known."""
    hit_distance: np.ndarray | None = None
    """Harmonic mean distance of secondary hits, shape (N,), 0: none met anything; None: not known."""
    samples: SampleBuffer | None = None
    """What it was made of, where the rows are its samples or their pixels."""
    counts: dict[str, int] = field(default_factory=dict)
    """What is wrong with the input, by kind."""

    @property
    def first(self) -> np.ndarray:
        """First row of each pixel, and N: shape (width height + 1,), int32."""
        return np.searchsorted(self.pixel, np.arange(self.width * self.height + 1)).astype(np.int32)

    @property
    def filtered(self) -> np.ndarray:
        """Which rows take part, shape (N,), bool."""
        return np.asarray(self.normal.any(axis=1))

    def footprint(self) -> np.ndarray:
        """Distance of the positions of neighbouring pixels, shape (N,): the least over a pixel's four sides."""
        size = (self.height, self.width)
        count = np.bincount(self.pixel[self.filtered], minlength=self.width * self.height)
        weights = [self.position[:, c] * self.filtered for c in range(3)]
        sums = [np.bincount(self.pixel, weight, count.size) for weight in weights]
        with np.errstate(invalid="ignore"):
            position = (np.stack(sums, axis=-1) / np.where(count > 0, count, np.nan)[:, None]).reshape(*size, 3)
        least = np.full(size, np.inf)
        for axis in (0, 1):
            # two pixels apart, as a pixel's own mean position is somewhere in it
            step = min(2, size[axis] - 1)
            if step < 1:
                continue
            ahead = [slice(None)] * 2
            behind = list(ahead)
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            distance = np.linalg.norm(position[tuple(ahead)] - position[tuple(behind)], axis=-1) / step
            for side in (tuple(ahead), tuple(behind)):
                least[side] = np.fmin(least[side], distance)
        known = np.isfinite(least)
        # a pixel alone among others' edges takes what is usual; a picture of one pixel has nothing to compare with
        least[~known] = np.median(least[known]) if known.any() else 1.0
        return least.astype(np.float32).reshape(-1)[self.pixel]

    def light(self, value: np.ndarray, filled: np.ndarray) -> np.ndarray:
        """Rows of filtered light, shape (N, 3); a channel that is 0 in `filled` is NaN where its albedo is not 0."""
        with np.errstate(invalid="ignore"):
            value = np.where((filled > 0) | (self.albedo == 0), value, np.float32(np.nan))
            return value * self.albedo + self.rest

    def picture(self, rows: np.ndarray) -> np.ndarray:
        """Mean of each pixel's rows, shape (height, width, 3)."""
        if len(self.pixel) == self.width * self.height:
            return rows.reshape(self.height, self.width, 3).astype(np.float32)
        assert self.samples is not None
        return pixel_means(self.samples, rows)


def sample_rows(samples: SampleBuffer) -> FilterInput:
    """A row for each sample, diffuse primary hits and such glossy ones as are in the buffer.

    What glossy hits reflect is divided by their reflectance, so that its texture stays sharp.
    """
    _check_secondary(samples)
    primary, usable = _usable(samples)
    zero = np.float32(0.0)
    radiance, albedo = samples.radiance, samples.albedo
    glossy = _glossy(samples)
    if glossy.any():
        if samples.weight is None or samples.reflectance is None:
            raise ValueError("samples hold glossy primary hits without weight or reflectance, expected both")
        # a glossy hit that sent no ray, for all would be absorbed, has a ray of no length
        usable |= glossy & (samples.hit == samples.origin).all(axis=1)
        scale = np.where(glossy[:, None], np.maximum(samples.reflectance, np.float32(COAT_REFLECTANCE)), np.float32(1))
        radiance, albedo = radiance * samples.weight / scale, albedo * scale
    return FilterInput(
        width=samples.width,
        height=samples.height,
        pixel=samples.pixel_of_sample,
        value=np.where(usable[:, None], radiance, zero),
        known=np.repeat(usable[:, None], 3, axis=1).astype(np.float32),
        albedo=np.where(primary[:, None], albedo, zero),
        rest=np.zeros((len(samples), 3), np.float32),
        normal=np.where(primary[:, None], samples.unit_origin_normal, zero),
        position=np.where(primary[:, None], samples.origin, zero),
        hit_normal=np.where(samples.checked.is_splat[:, None], samples.unit_hit_normal, -samples.direction),
        samples=samples,
        counts=_faults(samples),
    )


def pixel_rows(samples: SampleBuffer) -> FilterInput:
    """A row for each pixel: means over its samples, with the harmonic mean distance of secondary hits."""
    _check_secondary(samples)
    if _glossy(samples).any():
        # what they reflect depends on where it is seen from
        raise ValueError("samples hold glossy primary hits, expected only diffuse ones: those of glossy=False")
    primary, usable = _usable(samples)
    return _mean_rows(
        samples,
        PrimaryHits(samples.origin, samples.unit_origin_normal, samples.albedo, samples.spp),
        primary,
        usable,
        samples.radiance,
        hit_distance(samples).reshape(-1),
    )


def gathered_rows(
    samples: SampleBuffer, hits: PrimaryHits | None, incident: np.ndarray, inverse_distance: np.ndarray
) -> FilterInput:
    """A row for each pixel: means over its primary hits of the light that was gathered there.

    Args:
        samples: what the light was gathered from.
        hits: where; None: at the samples' own primary hits.
        incident: irradiance over pi, shape (M, 3).
        inverse_distance: mean of one over the distance to what was met, shape (M,).
    """
    if hits is None:
        hits = PrimaryHits(samples.origin, samples.unit_origin_normal, samples.albedo, samples.spp)
        primary = samples.checked.is_primary
    else:
        primary = np.abs(hits.origin).max(axis=1) < NO_HIT
    inverse = np.stack([inverse_distance, primary, primary], axis=1).astype(np.float32)
    sums = _hit_means(samples, hits, inverse)
    distance = _divide(sums[:, 1], sums[:, 0], sums[:, 0] > 0)
    return _mean_rows(samples, hits, primary, primary, incident, distance)


def _mean_rows(
    samples: SampleBuffer,
    hits: PrimaryHits,
    primary: np.ndarray,
    usable: np.ndarray,
    incident: np.ndarray,
    distance: np.ndarray,
) -> FilterInput:
    """A row for each pixel, of the incident light at its usable hits and the features of its primary ones."""

    def mean(flags: np.ndarray, values: np.ndarray) -> np.ndarray:
        return _hit_means(samples, hits, np.where(flags[:, None], values, np.float32(0.0)))

    ones = np.ones((len(primary), 3), np.float32)
    seen, sent = mean(primary, ones), mean(usable, ones)
    carried = mean(usable, hits.albedo)
    known = carried > SMALLEST_ALBEDO * sent
    light = mean(usable, hits.albedo * np.where(usable[:, None], incident, np.float32(0.0)))
    albedo = mean(primary, hits.albedo)
    return FilterInput(
        width=samples.width,
        height=samples.height,
        pixel=np.arange(len(seen), dtype=np.int32),
        value=_divide(light, carried, known),
        known=known.astype(np.float32),
        # what so dark a surface reflects stays as it came
        albedo=np.where(known | (sent == 0), albedo, np.float32(0.0)),
        rest=np.where(known, np.float32(0.0), light),
        normal=mean(primary, hits.normal),
        position=_divide(mean(primary, hits.origin), seen, seen > 0),
        hit_distance=distance,
        samples=samples,
        counts=_faults(samples),
    )


def _hit_means(samples: SampleBuffer, hits: PrimaryHits, values: np.ndarray) -> np.ndarray:
    """Mean of each pixel's hits, (M, 3) -> (H W, 3) float32."""
    if hits.per_pixel == samples.spp:
        return pixel_means(samples, values).reshape(-1, 3)
    return values.reshape(-1, hits.per_pixel, 3).mean(axis=1, dtype=np.float64).astype(np.float32)


def layer_rows(
    layers: Mapping[str, np.ndarray], name: str, demodulate: bool, normal: bool, position: bool
) -> FilterInput:
    """A row for each pixel of layer `name`, with the feature layers that are asked for.

    Raises:
        ValueError: a layer that is asked for is missing.
    """
    light = layers[name]
    height, width = light.shape[:2]
    flat = {key: layer.reshape(height * width, -1) for key, layer in layers.items()}
    features = []
    if demodulate:
        _need(layers, "albedo", "demodulate off")
        features.append(flat["albedo"])
    if normal:
        _need(layers, "normal", "sigma_normal None")
        features.append(flat["normal"])
    places = _positions(layers) if position else np.zeros((height * width, 3), np.float32)
    features.append(places)

    good = np.isfinite(np.concatenate(features, axis=1)).all(axis=1)
    met = flat["normal"].any(axis=1) if normal else np.ones(len(good), dtype=bool)
    if "depth" in layers:
        depth = flat["depth"][:, 0]
        met &= ~(depth <= 0.0) & ~(depth >= NO_HIT)  # other programs write 0, 1e10 or infinity for the sky
    takes = (good & met)[:, None]
    finite = np.isfinite(flat[name])
    zero, one = np.float32(0.0), np.float32(1.0)
    albedo = (
        np.where(takes, flat["albedo"], zero) if demodulate else np.where(takes, one, zero) * np.ones(3, np.float32)
    )
    albedo = np.where(albedo > SMALLEST_ALBEDO, albedo, zero)
    known = takes & finite & (albedo > 0)
    up = np.array([0.0, 0.0, 1.0], np.float32)
    return FilterInput(
        width=width,
        height=height,
        pixel=np.arange(height * width, dtype=np.int32),
        value=_divide(flat[name], albedo, known),
        known=known.astype(np.float32),
        albedo=albedo,
        rest=np.where(albedo > 0, zero, flat[name]),
        normal=np.where(takes, flat["normal"] if normal else up, zero),
        position=np.where(takes, places, zero),
        hit_distance=flat["hit_distance"][:, 0] if "hit_distance" in layers else None,
        counts={"nonfinite_pixels": int((~finite.all(axis=1) | (met & ~good)).sum())},
    )


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def hit_distance(samples: SampleBuffer) -> np.ndarray:
    """Harmonic mean length of each pixel's secondary rays, shape (H, W, 1); 0 where all left the scene."""
    usable = _usable(samples)[1]
    d = samples.hit.astype(np.float64) - samples.origin
    inverse = np.where(usable & samples.checked.is_splat, 1.0 / np.sqrt(np.einsum("ij,ij->i", d, d)), 0.0)
    sums = pixel_means(samples, np.stack([inverse, usable, usable], axis=1))
    return _divide(sums[..., 1:2], sums[..., :1], sums[..., :1] > 0)


class Filtering(Protocol):
    """A filter at work."""

    def gather(self, first: int, count: int, total: int) -> None:
        """Does units `first` to `first + count - 1` of `total`."""

    def picture(self) -> np.ndarray:
        """Filtered light of what was done so far, shape (H, W, 3)."""

    def all_counts(self) -> dict[str, int]:
        """What was left out."""


@dataclass(frozen=True, kw_only=True)
class SampleFilter:
    """What all filters of path-traced samples have in common: how these are traced, and where the result goes."""

    spp: int = 8
    """Input paths per pixel."""
    light_samples: int = 32
    """Shadow rays to lights per pixel, shared out over its samples, which make the direct light."""
    max_depth: int | None = None
    """Longest path in segments; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end an input path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where the input paths' random numbers come from."""

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        checks.count("light_samples", self.light_samples)
        check_paths(self.max_depth, self.roulette_depth, self.sampler)

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def filters_gloss(self) -> bool:
        """Whether it filters what glossy surfaces reflect too."""
        return False

    def filter_bytes(self) -> int:
        """Device memory of the filter for one sample, or for its share of a pixel."""
        raise NotImplementedError

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """How many units of work there are, and what they are called."""
        raise NotImplementedError

    @property
    def hits(self) -> int:
        """Primary hits per pixel that are traced."""
        return self.spp

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> Filtering:
        """The filter on a sample buffer, ready for `gather`."""
        raise NotImplementedError

    def filtering(self, samples: SampleBuffer, hits: PrimaryHits, device: Device, seed: int) -> Filtering:
        """The filter on what was traced: a sample buffer, and `hits` primary hits per pixel."""
        return self.reconstruction(samples, device, seed)

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        return size[0] * size[1] * self.spp * (PRIMARY_BYTES + SECONDARY_BYTES + self.filter_bytes())

    def prepare(self, job: Job, film: Film) -> Filtering:
        """Traces the input, with what is not filtered going to the film."""
        with_gloss = self.filters_gloss and job.scene.scene.is_glossy
        samples, hits = trace_sample_buffer(
            job,
            film,
            self.spp,
            self.hits,
            max(1, self.light_samples // self.hits),
            self.max_depth or NEVER,
            self.roulette_depth or NEVER,
            self.sampler,
            with_hit_light=False,
            with_gloss=with_gloss,
            with_weight=with_gloss,
            with_beyond=False,
        )
        return self.filtering(samples, hits, job.device, job.seed)

    def estimate(self, job: Job, state: Filtering, film: Film, first: int, count: int) -> None:
        """Does `count` units of the filter's work."""
        state.gather(first, count, self.passes()[0])

    def finish(self, job: Job, state: Filtering, film: Film) -> dict[str, np.ndarray]:
        """The indirect layer: what was filtered, and what surfaces that are not diffuse keep."""
        picture = state.picture()
        return {"indirect": picture + film.field("indirect").reshape(picture.shape)}

    def layers(self, state: Filtering) -> dict[str, np.ndarray]:
        """The indirect layer of a sample buffer without a scene."""
        return {"indirect": state.picture()}

    def counts(self, state: Filtering) -> dict[str, int]:
        """What was left out."""
        return state.all_counts()


def check_memory(device: Device, rows: int, row_bytes: int) -> None:
    """Refuses what does not fit.

    Raises:
        ValueError: it is such.
    """
    if rows * row_bytes > device.memory_limit:
        raise ValueError(f"memory_limit is {device.memory_limit} bytes, expected {rows * row_bytes} for the filter")


def _usable(samples: SampleBuffer) -> tuple[np.ndarray, np.ndarray]:
    state = samples.checked
    return state.is_primary, state.is_primary & (state.is_splat | state.is_escaped)


def _faults(samples: SampleBuffer) -> dict[str, int]:
    return {name: count for name, count in samples.checked.counts.items() if name != "primary_missed"}


def _check_secondary(samples: SampleBuffer) -> None:
    if not samples.has_secondary_rays:
        raise ValueError("samples hold no secondary rays, expected a sample buffer of format 2.0 or newer")


def _glossy(samples: SampleBuffer) -> np.ndarray:
    """Which primary hits are not diffuse, shape (N,)."""
    if samples.material is None:
        return np.zeros(len(samples), bool)
    glossy = [number for number, material in enumerate(samples.materials) if not isinstance(material, Diffuse)]
    return samples.checked.is_primary & np.isin(samples.material, glossy)


def _positions(layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """World positions; of a depth layer alone, positions as a camera of usual field of view would see them."""
    if "position" in layers:
        return layers["position"].reshape(-1, 3)
    if "depth" not in layers:
        raise ValueError(f"layers hold {', '.join(layers)}, expected position or depth too, or sigma_position None")
    depth = layers["depth"][..., 0]
    height, width = depth.shape
    scale = 2.0 * ASSUMED_TAN / max(width, height)
    y, x = np.mgrid[:height, :width]
    with np.errstate(invalid="ignore", over="ignore"):  # a sky at infinity is no position
        place = np.stack([(x - 0.5 * width) * scale * depth, (y - 0.5 * height) * scale * depth, depth], axis=-1)
    return place.astype(np.float32).reshape(-1, 3)


def _need(layers: Mapping[str, np.ndarray], name: str, otherwise: str) -> None:
    if name not in layers:
        raise ValueError(f"layers hold {', '.join(layers)}, expected {name} too, or {otherwise}")


def _divide(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.divide(a, b, out=np.zeros(np.broadcast(a, b).shape, np.float32), where=where)
