"""Pictures for the README, each from one command."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import Any

import numpy as np

import warpgi as gi
from bench.mitsuba_peer import LLVM, require
from bench.reference import make_reference
from bench.report import progress
from warpgi import checks
from warpgi.image import atomic_write, check_output, write_png
from warpgi.methods import RECONSTRUCTIONS, Method
from warpgi.reconstruction import pixel_means

#: Pictures of shape (H, W, 3) by name, and the reference's last; measures of all but that against it.
Panels = tuple[dict[str, np.ndarray], list[dict[str, Any]]]

GAP = 4  # pixels between panels
WHITE = 1e4  # radiance of the gap

# Mitsuba's own scene, sampled and path-traced by Mitsuba.
MITSUBA_BOX = "mitsuba-cornell-box"
MITSUBA_SPP = 64  # of one picture of its reference


def side_by_side(
    out: Path,
    scene: str,
    methods: tuple[str, ...],
    size: tuple[int, int],
    spp: int,
    rays: int,
    reference_spp: int,
    exposure: float,
    device: str | None,
) -> None:
    """Indirect light of one scene, left to right: the input, each method, the path-traced reference."""
    check_output(out)
    show = panels_of_mitsuba if scene == MITSUBA_BOX else panels_of_ours
    panels, errors = show(scene, size, spp, chosen(methods, spp, rays), reference_spp, device)
    for name, found in zip(panels, errors, strict=False):  # the reference has none
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in found.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    row = [part for picture in panels.values() for part in (picture, gap)][:-1]
    write_png(out, np.concatenate(row, axis=1), exposure)
    print(f"wrote {out}")


def cache(out: Path, size: tuple[int, int], reference_spp: int, device: str | None) -> None:
    """Indirect light of the Cornell box by both irradiance caches, the records of the second, and the reference."""
    check_output(out)
    scene, where = gi.scenes.cornell_box(), gi.Device(device)
    hybrid = gi.LightField(spp=1, primary_hits=8, rays=64, record_rays=1024, cache=True, recursive=1, recursive_rays=4)
    reference = make_reference(scene, size, reference_spp, device=where)
    renders = [gi.render(scene, method, size, device=where) for method in (gi.IrradianceCache(), hybrid)]
    for render in renders:
        error = reference.judge(render.layers["indirect"])["relmse"]
        print(f"{render.method}: relmse {error:.3g}, {dumps(render.counts)}")
    pictures = [render.layers["indirect"] for render in renders]
    dots = np.where(renders[1].layers["records"] > 0.0, np.float32([1.0, 0.8, 0.0]), 0.3 * pictures[1])
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    row = [part for picture in (*pictures, dots, reference.image) for part in (picture, gap)][:-1]
    write_png(out, np.concatenate(row, axis=1).astype(np.float32), 1.0)
    print(f"wrote {out}")


def chosen(methods: tuple[str, ...], spp: int, rays: int) -> dict[str, Method]:
    """Settings of the named methods.

    Raises:
        ValueError: one does not work on samples.
    """
    result = {}
    for name in methods:
        if name not in RECONSTRUCTIONS:
            raise ValueError(f"methods holds {name!r}, expected names out of {', '.join(RECONSTRUCTIONS)}")
        kind = RECONSTRUCTIONS[name]
        result[f"{name}, {spp} spp"] = kind(spp=spp, rays=rays) if getattr(kind, "rays", 0) else kind(spp=spp)
    return result


def panels_of_ours(
    scene: str,
    size: tuple[int, int],
    spp: int,
    methods: dict[str, Method],
    reference_spp: int,
    device: str | None,
) -> Panels:
    """Input, reconstructions and reference of a built-in scene, and the errors of all but the last."""
    built = gi.scenes.build(scene)
    panels: dict[str, Method] = {f"input, {spp} spp": gi.PathTracing(spp=spp)} | methods
    with progress() as bar:
        task = bar.add_task("reference", total=None)
        reference = make_reference(
            built,
            size,
            reference_spp,
            device=gi.Device(device),
            report=lambda done, total: bar.update(task, completed=done, total=total),
        )
    pictures = {
        name: gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
        for seed, (name, method) in enumerate(panels.items())
    }
    errors = [reference.judge(picture) for picture in pictures.values()]
    return pictures | {"reference": reference.image}, errors


def panels_of_mitsuba(
    scene: str,
    size: tuple[int, int],
    spp: int,
    methods: dict[str, Method],
    reference_spp: int,
    device: str | None,
) -> Panels:
    """The same of Mitsuba's own Cornell box: samples by Mitsuba, reconstructions, Mitsuba's reference.

    Raises:
        ValueError: the reference has no samples.
        MissingPeer: Mitsuba is not installed, or its vectorised variant does not run here.
    """
    checks.count("reference_spp", reference_spp)
    mi = require(LLVM)
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    loaded = mi.load_dict(box)
    samples = gi.sample_from_mitsuba(loaded, spp, size)
    panels = {f"input, {spp} spp": pixel_means(samples, samples.albedo * samples.radiance)} | {
        name: gi.reconstruct(samples, method, device=device, progress=True).layers["indirect"]
        for name, method in methods.items()
    }
    # pictures of one seed are of the same paths, so that their difference has no noise of direct light
    whole, direct = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (-1, 2))
    pictures = [
        np.subtract(*(mi.render(loaded, integrator=path, spp=MITSUBA_SPP, seed=seed) for path in (whole, direct)))
        for seed in range(-(-reference_spp // MITSUBA_SPP))
    ]
    reference = np.mean(pictures, axis=0)
    return panels | {"reference": reference}, [gi.compare(panel, reference) for panel in panels.values()]


def lens(
    out: Path, size: tuple[int, int], rays: int, reference_spp: int, device: str | None, json: Path | None
) -> None:
    """Defocus and motion of the butterflies: the input of 1 spp, the earlier method, reconstruction, the reference."""
    check_output(out)
    checks.count("reference_spp", reference_spp)
    scene = gi.scenes.butterflies()
    methods = {
        "input": gi.PathTracing(spp=1),
        "temporal light field": gi.TemporalLightField(spp=1, rays=rays),
        "light field": gi.LightField(spp=1, rays=rays, neighbours=8, primary_rays=True),
        "reference": gi.PathTracing(spp=reference_spp),
    }
    # the same input for all; the reference's paths are others
    renders = [gi.render(scene, method, size, name == "reference", device, True) for name, method in methods.items()]
    numbers: dict[str, Any] = {}
    for name, render in zip(methods, renders[:3], strict=False):
        errors = gi.compare(render.image, renders[3].image)
        energy = float(render.image.mean(dtype=np.float64) / renders[3].image.mean(dtype=np.float64))
        numbers[name] = errors | {"energy": energy, "seconds": sum(render.timings.values())}
        print(
            f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in numbers[name].items() if value is not None)}"
        )
    if json is not None:
        about = {"size": size, "rays": rays, "reference_spp": reference_spp, "methods": numbers}
        with atomic_write(json) as file:
            file.write_text(dumps(about, indent=1))
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    rows = [np.concatenate([renders[i].image, gap, renders[i + 1].image], axis=1) for i in (0, 2)]
    write_png(out, np.concatenate([rows[0], np.full((GAP, *rows[0].shape[1:]), WHITE, np.float32), rows[1]]))
    print(f"wrote {out}")
