"""Where path tracing fails: light that it hardly finds, and light that it cannot find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, inside_ring, mean_value
from bench.reference import make_reference

SIZE = (64, 64)
SPP = 64
REFERENCE_SPP = 1024

# How many times as bright as the truth a pixel is called a firefly.
FIREFLY = 5.0
WORST = 0.01  # of the pixels


def fireflies(device: gi.Device) -> Value:
    """Share of pixels that are far too bright."""
    scene = gi.scenes.caustic()
    truth = make_reference(scene, SIZE, REFERENCE_SPP, device=device).image.mean(axis=2)
    method = gi.PathTracing(spp=SPP)
    pictures = [indirect(scene, method, SIZE, seed, device).mean(axis=2) for seed in range(4)]
    return mean_value([float((picture > FIREFLY * truth).mean()) for picture in pictures])


def heavy_tail(device: gi.Device) -> Value:
    """Share of the squared relative error that the worst pixels hold; 0.06 were it normal."""
    scene = gi.scenes.caustic()
    truth = make_reference(scene, SIZE, REFERENCE_SPP, device=device).image.astype(np.float64)
    shares = []
    for seed in range(4):
        picture = indirect(scene, gi.PathTracing(spp=SPP), SIZE, seed, device)
        errors = np.square(picture - truth) / (np.square(truth) + 0.04 * truth.mean() ** 2)
        errors = np.sort(errors.mean(axis=2), axis=None)[::-1]
        shares.append(float(errors[: int(WORST * errors.size)].sum() / errors.sum()))
    return mean_value(shares)


def point_light_caustics(device: gi.Device) -> Value:
    """Share of the light inside the ring that is lost when a point light takes the lamp's place."""
    lamp_lit = gi.scenes.caustic()
    lamp = next(shape for shape in lamp_lit.shapes if shape.name == "lamp")
    # seen along its axis, a disc of radiance L and area A is a point of intensity L A
    intensity = np.asarray(lamp.emission.radiance) * lamp.areas().sum()
    light = gi.PointLight(tuple(lamp.vertices.mean(axis=0)), tuple(intensity))
    point_lit = replace(lamp_lit, shapes=[s for s in lamp_lit.shapes if s is not lamp], lights=[light])
    shares = []
    for seed in range(4):
        renders = [gi.render(scene, gi.PathTracing(spp=SPP), SIZE, seed, device) for scene in (lamp_lit, point_lit)]
        inside = inside_ring(lamp_lit, renders[0])
        found = [render.layers["indirect"][inside].mean(dtype=np.float64) for render in renders]
        shares.append(float(1.0 - found[1] / found[0]))
    return mean_value(shares)


ROWS = (
    Failure("path", "caustic", f"pixels beyond {FIREFLY:g} times the truth at {SPP} spp, share", 0.01, fireflies),
    Failure("path", "caustic", f"relMSE in the worst {WORST:.0%} of pixels at {SPP} spp, share", None, heavy_tail),
    Failure("path", "caustic, point light", "light inside the ring, share not found", None, point_light_caustics),
)
