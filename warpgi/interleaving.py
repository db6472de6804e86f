"""Interleaved sampling (Keller, Heidrich 2001): pixels of a square share out lights, and their light is joined."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.film import Film
from warpgi.filtering import SMALLEST_ALBEDO, FilterInput
from warpgi.job import Job
from warpgi.kernels import interleaving as kernels

# Difference of normals, and distance from a pixel's plane in that of neighbouring pixels, at which weights fall to 1/e.
SIGMA_NORMAL = 0.5
SIGMA_PLANE = 1.0
#: Device bytes of a pixel: its means, and the filter's arrays.
PIXEL_BYTES = 4 * (3 + 3 + 3 + 3 + 1 + 3 + 3 + 3)


def make_interleaving(side: int, job: Job) -> kernels.Interleaving:
    """Empty means of the pixels of a picture, or no room for any where `side` is 1."""
    interleaving = kernels.Interleaving()
    interleaving.side, (interleaving.width, interleaving.height) = side, job.size
    count = job.size[0] * job.size[1] if side > 1 else 0
    interleaving.light, interleaving.albedo = (job.device.zeros(count, wp.vec3) for _ in range(2))
    return interleaving


def mean_rows(interleaving: kernels.Interleaving, film: Film) -> FilterInput:
    """A row for each pixel: the light that its diffuse first hits reflect, over their albedo."""
    light, albedo = interleaving.light.numpy(), interleaving.albedo.numpy()
    known = albedo > SMALLEST_ALBEDO
    zero = np.float32(0.0)
    return FilterInput(
        width=film.width,
        height=film.height,
        pixel=np.arange(film.pixel_count, dtype=np.int32),
        value=np.divide(light, albedo, out=np.zeros_like(light), where=known),
        known=known.astype(np.float32),
        albedo=np.where(known, albedo, zero),
        rest=np.where(known, zero, light),
        normal=np.where(known.any(axis=1)[:, None], film.field("normal"), zero),
        position=film.field("position").copy(),
    )


def join(rows: FilterInput, interleaving: kernels.Interleaving, job: Job) -> np.ndarray:
    """Light of all subsets at every pixel, shape (height, width, 3)."""
    device = job.device
    surfaces = kernels.Surfaces()
    surfaces.normal, surfaces.position = device.array(rows.normal, wp.vec3), device.array(rows.position, wp.vec3)
    surfaces.footprint = device.array(rows.footprint(), float)
    surfaces.normal_falloff, surfaces.plane_falloff = SIGMA_NORMAL**-2, SIGMA_PLANE**-2
    joined = device.zeros(len(rows.pixel), wp.vec3)
    inputs = [interleaving, surfaces, device.array(rows.value, wp.vec3), device.array(rows.known, wp.vec3)]
    device.launch(kernels.join_subsets, len(rows.pixel), inputs, [joined])
    return rows.picture(rows.light(joined.numpy(), rows.known))
