"""The pictures of a figure: what came in, what methods make of it, and the truth last."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import warpgi as gi
from bench.mitsuba_peer import LLVM, require
from bench.reference import FIRST_SEED, make_reference
from bench.report import progress
from warpgi import checks
from warpgi.reconstruction import pixel_means
from warpgi.samples import NO_HIT

#: Pictures of shape (H, W, 3) by name, the reference's last.
Panels = dict[str, np.ndarray]
Methods = Mapping[str, Any]

REFERENCE = "reference"
OCCLUSION_SPP = 16  # of one part of a reference
MITSUBA_SPP = 64


@dataclass(frozen=True)
class Budget:
    """How much a figure may cost."""

    size: tuple[int, int]
    """(width, height) of a panel in pixels."""
    rays: int
    """Reconstruction rays per pixel."""
    reference_spp: int
    """Paths per pixel of the reference."""
    device: str | None = None
    """Where everything is rendered."""


def indirect(
    budget: Budget,
    scene: Callable[[], gi.Scene],
    methods: Methods,
    max_depth: int | None = None,
    filters: Methods | None = None,
) -> Panels:
    """Indirect light by each method, by filters of the first method's picture, and path-traced."""
    built = scene()
    renders = {
        name: gi.render(built, method, budget.size, 0, budget.device, progress=True) for name, method in methods.items()
    }
    noisy = next(iter(renders.values()))
    renders |= {name: gi.denoise(noisy, method, device=budget.device) for name, method in (filters or {}).items()}
    with progress() as bar:
        task = bar.add_task(REFERENCE, total=None)
        truth = make_reference(
            built,
            budget.size,
            budget.reference_spp,
            max_depth,
            device=gi.Device(budget.device),
            report=lambda done, total: bar.update(task, completed=done, total=total),
        )
    return {name: render.layers["indirect"] for name, render in renders.items()} | {REFERENCE: truth.image}


def occlusion(
    budget: Budget, scene: Callable[[], gi.Scene], methods: Methods, radius: float, spp: int | None = None
) -> Panels:
    """Ambient occlusion by each method and ray-traced, after the input of `spp` rays where that is given."""
    checks.count("reference_spp", budget.reference_spp)
    built = scene()
    traced = partial(_open_share, built, budget=budget, radius=radius)
    found = {} if spp is None else {f"input, {spp} spp": traced(spp=spp, seed=0)}
    for name, method in methods.items():
        found[name] = gi.render(built, method, budget.size, 0, budget.device, progress=True).image
    parts = range(-(-budget.reference_spp // OCCLUSION_SPP))
    truth = [traced(spp=OCCLUSION_SPP, seed=FIRST_SEED + part) for part in parts]
    return found | {REFERENCE: np.mean(truth, axis=0, dtype=np.float64).astype(np.float32)}


def _open_share(scene: gi.Scene, budget: Budget, radius: float, spp: int, seed: int) -> np.ndarray:
    """Share of secondary rays that meet nothing within the radius, shape (H, W, 3)."""
    samples = gi.sample(scene, spp, budget.size, seed, budget.device, max_depth=2)
    state = samples.checked
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(samples.hit - samples.origin, axis=1)
    far = (np.abs(samples.hit).max(axis=1) >= NO_HIT) | (distance >= radius)
    seen = state.is_primary & far
    return pixel_means(samples, np.repeat(seen[:, None].astype(np.float32), 3, axis=1))


def whole(budget: Budget, scene: Callable[[], gi.Scene], methods: Methods) -> Panels:
    """All light that a lens sees by each method, and path-traced."""
    built = scene()
    checks.count("reference_spp", budget.reference_spp)
    # the same input for all; the reference's paths are others
    every = dict(methods) | {REFERENCE: gi.PathTracing(spp=budget.reference_spp)}
    return {
        name: gi.render(
            built, method, budget.size, FIRST_SEED if name == REFERENCE else 0, budget.device, progress=True
        ).image
        for name, method in every.items()
    }


def pinhole(budget: Budget, scene: Callable[[], gi.Scene], methods: Methods) -> Panels:
    """What samples of a still scene through a lens tell of its view through the lens's centre."""
    built = scene()
    checks.count("reference_spp", budget.reference_spp)
    device = gi.Device(budget.device)
    samples = gi.sample(built, 1, budget.size, 0, device, primary=True)
    found = {"input, 1 spp, through the lens": pixel_means(samples, samples.radiance)}
    for name, method in methods.items():
        state = method.reconstruction(samples, device, 0)
        state.lens.stop = 0.0
        state.gather(0, budget.rays, budget.rays)
        found[name] = state.image()
    sharp = replace(built, camera=replace(built.camera, lens_radius=0.0))
    truth = gi.render(sharp, gi.PathTracing(spp=budget.reference_spp), budget.size, FIRST_SEED, device, True)
    return found | {REFERENCE: truth.image}


def mitsubas(budget: Budget, methods: Methods, spp: int) -> Panels:
    """Indirect light of Mitsuba's own Cornell box: samples by Mitsuba, reconstructions, Mitsuba's reference.

    Raises:
        MissingPeer: Mitsuba is not installed, or its vectorised variant does not run here.
    """
    checks.count("reference_spp", budget.reference_spp)
    mi = require(LLVM)
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": budget.size[0], "height": budget.size[1], "rfilter": {"type": "box"}}
    loaded = mi.load_dict(box)
    samples = gi.sample_from_mitsuba(loaded, spp, budget.size)
    found = {f"input, {spp} spp": pixel_means(samples, samples.albedo * samples.radiance)} | {
        name: gi.reconstruct(samples, method, device=budget.device, progress=True).layers["indirect"]
        for name, method in methods.items()
    }
    # pictures of one seed are of the same paths, so that their difference has no noise of direct light
    paths = [mi.load_dict({"type": "path", "max_depth": depth}) for depth in (-1, 2)]
    pictures = [
        np.subtract(*(np.array(mi.render(loaded, integrator=path, spp=MITSUBA_SPP, seed=seed)) for path in paths))
        for seed in range(-(-budget.reference_spp // MITSUBA_SPP))
    ]
    return found | {REFERENCE: np.mean(pictures, axis=0)}
