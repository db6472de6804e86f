"""The figures of Lehtinen et al. 2012 on scenes of ours: a picture and its numbers each, from one command."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warpgi as gi
from bench.contenders import sources
from bench.panels import REFERENCE, Budget, Panels, indirect, mitsubas, occlusion, pinhole, whole
from bench.report import circumstances, finite
from warpgi import checks
from warpgi.image import atomic_write, check_output, write_png

GAP = 4  # pixels between panels
WHITE = 1e4  # radiance of the gap
DIFFERENCE = 2.0  # factor on what the lower row shows

QUICK_SPP, QUICK_RAYS = 64, 32
AO_RADIUS = 0.5  # [m]


@dataclass(frozen=True)
class Figure:
    """One figure: its pictures, and what it costs unless told otherwise."""

    shows: str
    """In words."""
    panels: Callable[[Budget], Panels]
    """Makes the pictures."""
    size: tuple[int, int] = (256, 256)
    """Of a panel."""
    rays: int = 256
    """Reconstruction rays per pixel."""
    reference_spp: int = 1024
    """Paths per pixel of the reference."""
    exposure: float = 0.0
    """Stops by which the picture is brightened."""
    crop: tuple[float, float, float, float] | None = None
    """Part of the panels that the picture shows: left, top, right, bottom in [0, 1]; numbers are of all pixels."""


def light_fields(budget: Budget, spp: int, **variants: dict[str, Any]) -> dict[str, Any]:
    """Light-field reconstructions by name, their settings beside samples and rays."""
    return {name.replace("_", " "): gi.LightField(spp=spp, rays=budget.rays, **more) for name, more in variants.items()}


def _diffuse(budget: Budget) -> Panels:
    methods = {"input, 8 spp": gi.PathTracing(spp=8)} | light_fields(budget, 8, light_field={})
    return indirect(budget, gi.scenes.cornell_box, methods)


def _filters(budget: Budget) -> Panels:
    methods = {"input, 8 spp": gi.PathTracing(spp=8)} | light_fields(budget, 8, light_field={})
    methods |= {
        "a-trous": gi.ATrous(spp=8),
        "random parameter filter": gi.RandomParameterFilter(spp=8),
        "irradiance filter": gi.IrradianceFilter(spp=8),
    }
    return indirect(budget, gi.scenes.courtyard, methods)


def _occlusion(budget: Budget) -> Panels:
    method = gi.AmbientOcclusion(spp=4, rays=budget.rays, radius=AO_RADIUS)
    return occlusion(budget, gi.scenes.courtyard, {"reconstruction": method}, AO_RADIUS, spp=4)


def _shrinking(budget: Budget) -> Panels:
    def close() -> gi.Scene:
        scene = gi.scenes.courtyard()
        camera = dataclasses.replace(scene.camera, target=(-2.2, 1.9, -3.0), fov=16.0)
        return dataclasses.replace(scene, camera=camera)

    make = {"radius": AO_RADIUS, "spp": 4, "rays": budget.rays}
    methods = {
        "without shrinking": gi.AmbientOcclusion(**make, shrink=False),
        "with shrinking": gi.AmbientOcclusion(**make),
    }
    return occlusion(budget, close, methods, AO_RADIUS)


def _gloss(budget: Budget) -> Panels:
    depth = 3  # one bounce of indirect light, as in the paper
    methods = {"input, 8 spp": gi.PathTracing(spp=8, max_depth=depth, roulette_depth=None)}
    variants = {"light_field": {"max_depth": depth}, "without_bandwidth": {"max_depth": depth, "bandwidth": False}}
    methods |= light_fields(budget, 8, **variants)
    filtered = {"spp": 8, "max_depth": depth, "glossy": True}
    # the secondary normal's sigma is that of least error among 0.1 to 4
    methods |= {
        "a-trous": gi.ATrous(**filtered),
        "a-trous, secondary normal": gi.ATrous(**filtered, sigma_hit_normal=1.0),
        "random parameter filter": gi.RandomParameterFilter(**filtered),
    }
    return indirect(budget, gi.scenes.statuettes, methods, depth)


def _bandwidth(budget: Budget) -> Panels:
    variants = {"with_bandwidth": {"max_depth": 3}, "without_bandwidth": {"max_depth": 3, "bandwidth": False}}
    return indirect(budget, gi.scenes.statuettes, light_fields(budget, 8, **variants), 3)


def _lens(budget: Budget) -> Panels:
    return whole(budget, gi.scenes.butterflies, {"input, 1 spp": gi.PathTracing(spp=1)} | lens_methods(budget))


def _pinhole(budget: Budget) -> Panels:
    return pinhole(budget, lambda: gi.scenes.butterflies(motion=0.0), lens_methods(budget))


def lens_methods(budget: Budget) -> dict[str, Any]:
    """The two that reconstruct from camera rays, the earlier one first."""
    return {
        "temporal light field": gi.TemporalLightField(spp=1, rays=budget.rays),
        "light field": gi.LightField(spp=1, rays=budget.rays, primary_rays=True),
    }


def _recursive(budget: Budget) -> Panels:
    variants = {"light_field": {}, "light_field,_recursive": {"recursive": 1}}
    methods = {"input, 1 spp": gi.PathTracing(spp=1)} | light_fields(budget, 1, **variants)
    return indirect(budget, gi.scenes.cornell_box, methods)


def _mitsuba(budget: Budget) -> Panels:
    return mitsubas(budget, light_fields(budget, 8, light_field={}), 8)


WIDE = (320, 180)
#: Number in the paper -> what stands for it here; beside them, pictures of ours alone.
FIGURES: dict[str, Figure] = {
    "1": Figure("diffuse indirect light of the Cornell box", _diffuse, exposure=1.0),
    "4": Figure("shrinking of splats, ambient occlusion of foliage close by", _shrinking, reference_spp=512),
    "7": Figure("diffuse indirect light of the courtyard, and filters", _filters, reference_spp=512, exposure=1.0),
    "8": Figure("ambient occlusion of the courtyard", _occlusion, reference_spp=512),
    "9": Figure("glossy reflections of glossy surfaces, and filters", _gloss, WIDE, 512, 4096),
    "10": Figure("the same with and without angular bandwidth", _bandwidth, WIDE, 512, 4096),
    "11": Figure("defocus and motion, beside the earlier method", _lens, (400, 225)),
    "12": Figure(
        "a pinhole's view from rays through a lens, beside the earlier method",
        _pinhole,
        (400, 225),
        crop=(0.3, 0.3, 0.7, 0.75),
    ),
    "13": Figure("one sample per pixel with and without recursive filtering", _recursive, exposure=1.0),
    "mitsuba": Figure("diffuse indirect light of Mitsuba's own Cornell box", _mitsuba, exposure=1.0),
}


def run(
    names: tuple[str, ...],
    out: Path,
    size: tuple[int, int] | None,
    quick: bool,
    device: str | None,
    picture: Path | None,
    fresh: bool,
) -> None:
    """Makes figures that are not there yet: NAME.png, NAME.json and NAME.npz with the panels, in a folder.

    Raises:
        ValueError: there is no such figure, or the picture is one and the figures several.
        OSError: the folder cannot be written.
    """
    for name in names:
        if name not in FIGURES:
            raise ValueError(f"figure holds {name!r}, expected some of {', '.join(FIGURES)}")
    if picture is not None:
        if len(names) != 1:
            raise ValueError(f"picture is one file for {len(names)} figures, expected a single figure with it")
        check_output(picture)
    out.mkdir(parents=True, exist_ok=True)
    for name in names or tuple(n for n in FIGURES if n != "mitsuba"):
        panels = make(name, out, budget_of(FIGURES[name], size, quick, device), fresh)
        if picture is not None:
            write_png(picture, composed(FIGURES[name], panels), FIGURES[name].exposure)
            print(f"wrote {picture}")


def budget_of(figure: Figure, size: tuple[int, int] | None, quick: bool, device: str | None) -> Budget:
    """What a figure may cost: its own, or a quarter of the width and height, few rays and paths."""
    if size is not None:
        checks.image_size(size)
    own = (figure.size[0] // 4, figure.size[1] // 4) if quick else figure.size
    rays, spp = (QUICK_RAYS, QUICK_SPP) if quick else (figure.rays, figure.reference_spp)
    return Budget(size or own, rays, spp, device)


def make(name: str, out: Path, budget: Budget, fresh: bool = False) -> Panels:
    """Panels of one figure, from the folder where the same sources and settings made them, and written there if not."""
    figure = FIGURES[name]
    paths = {kind: out / f"{name}.{kind}" for kind in ("npz", "json", "png")}
    identity = {"figure": name, "sources": sources(), **json.loads(json.dumps(dataclasses.asdict(budget)))}
    if not fresh and all(path.exists() for path in paths.values()):
        found = json.loads(paths["json"].read_text())
        if found.get("identity") == identity:
            print(f"figure {name}: {paths['png']} is there already")
            with np.load(paths["npz"]) as file:
                return {key: file[key] for key in found["panels"]}
    print(f"figure {name}: {figure.shows}")
    panels = figure.panels(budget)
    numbers = measured(panels)
    for panel, values in numbers.items():
        print(f"  {panel}: {', '.join(f'{kind} {value:.4g}' for kind, value in values.items() if value is not None)}")
    about = {"identity": identity, "shows": figure.shows, "panels": list(panels), "difference": DIFFERENCE}
    about |= {"errors": numbers, **circumstances(gi.Device(budget.device), gi.versions())}
    with atomic_write(paths["npz"]) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **panels)  # type: ignore[arg-type]
    write_png(paths["png"], composed(figure, panels), figure.exposure)
    with atomic_write(paths["json"]) as temporary:
        temporary.write_text(json.dumps(finite(about), indent=2, allow_nan=False) + "\n")
    print(f"  wrote {paths['png']}")
    return panels


def measured(panels: Panels) -> dict[str, dict[str, float | None]]:
    """Errors of every panel but the reference, and its mean radiance over the reference's."""
    truth = panels[REFERENCE]
    mean = max(float(truth.mean(dtype=np.float64)), 1e-30)
    return {
        name: gi.compare(panel, truth) | {"energy": float(panel.mean(dtype=np.float64)) / mean}
        for name, panel in panels.items()
        if name != REFERENCE
    }


def composed(figure: Figure, panels: Panels) -> np.ndarray:
    """The picture: panels side by side, below them how far each is from the reference, twice over."""
    left, top, right, bottom = figure.crop or (0.0, 0.0, 1.0, 1.0)
    truth = panels[REFERENCE]
    height, width = truth.shape[:2]
    rows = slice(int(top * height), max(round(bottom * height), 1))
    columns = slice(int(left * width), max(round(right * width), 1))
    upper = [panel[rows, columns] for panel in panels.values()]
    lower = [np.abs(panel - truth)[rows, columns] * DIFFERENCE for panel in panels.values()]
    return _stacked([_stacked(row, axis=1) for row in (upper, lower)], axis=0).astype(np.float32)


def _stacked(parts: list[np.ndarray], axis: int) -> np.ndarray:
    shape = list(parts[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, WHITE, np.float32)
    return np.concatenate([piece for part in parts for piece in (part, gap)][:-1], axis=axis)
