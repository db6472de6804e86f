"""Pictures for the README, each from one command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import warpgi as gi
from bench.mitsuba_peer import LLVM, require
from bench.reference import make_reference
from bench.report import progress
from warpgi import checks
from warpgi.image import check_output, write_png
from warpgi.reconstruction import pixel_means

#: Three pictures of shape (H, W, 3), and measures of the first two against the third.
Panels = tuple[list[np.ndarray], list[dict[str, Any]]]

GAP = 4  # pixels between panels
WHITE = 1e4  # radiance of the gap

# Mitsuba's own scene, sampled and path-traced by Mitsuba.
MITSUBA_BOX = "mitsuba-cornell-box"
MITSUBA_SPP = 64  # of one picture of its reference


def light_field(
    out: Path,
    scene: str,
    size: tuple[int, int],
    spp: int,
    rays: int,
    reference_spp: int,
    exposure: float,
    device: str | None,
) -> None:
    """Indirect light of one scene, left to right: the input, its reconstruction, the path-traced reference."""
    check_output(out)
    show = panels_of_mitsuba if scene == MITSUBA_BOX else panels_of_ours
    panels, errors = show(scene, size, spp, rays, reference_spp, device)
    names = (f"input, {spp} spp", f"reconstruction, {spp} spp and {rays} rays")
    for name, found in zip(names, errors, strict=True):
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in found.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    write_png(out, np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1), exposure)
    print(f"wrote {out}")


def panels_of_ours(
    scene: str, size: tuple[int, int], spp: int, rays: int, reference_spp: int, device: str | None
) -> Panels:
    """Input, reconstruction and reference of a built-in scene, and the errors of the first two."""
    built = gi.scenes.build(scene)
    with progress() as bar:
        task = bar.add_task("reference", total=None)
        reference = make_reference(
            built,
            size,
            reference_spp,
            device=gi.Device(device),
            report=lambda done, total: bar.update(task, completed=done, total=total),
        )
    panels = [
        gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
        for seed, method in enumerate((gi.PathTracing(spp=spp), gi.LightField(spp=spp, rays=rays)))
    ]
    return [*panels, reference.image], [reference.judge(panel) for panel in panels]


def panels_of_mitsuba(
    scene: str, size: tuple[int, int], spp: int, rays: int, reference_spp: int, device: str | None
) -> Panels:
    """The same of Mitsuba's own Cornell box: samples by Mitsuba, their reconstruction, Mitsuba's reference.

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
    reconstruction = gi.reconstruct(samples, gi.LightField(rays=rays), device=device, progress=True)
    panels = [pixel_means(samples, samples.albedo * samples.radiance), reconstruction.layers["indirect"]]
    # pictures of one seed are of the same paths, so that their difference has no noise of direct light
    whole, direct = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (-1, 2))
    pictures = [
        np.subtract(*(mi.render(loaded, integrator=path, spp=MITSUBA_SPP, seed=seed) for path in (whole, direct)))
        for seed in range(-(-reference_spp // MITSUBA_SPP))
    ]
    reference = np.mean(pictures, axis=0)
    return [*panels, reference], [gi.compare(panel, reference) for panel in panels]
