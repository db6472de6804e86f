"""Pictures for the README, each from one command."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warpgi as gi
from bench.mitsuba_peer import LLVM, require
from warpgi import checks
from warpgi.image import check_output, write_png
from warpgi.reconstruction import pixel_means

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
    checks.count("reference_spp", reference_spp)
    if scene == MITSUBA_BOX:
        panels = mitsuba_panels(size, spp, rays, reference_spp, device)
    else:
        built = gi.scenes.build(scene)
        methods = (gi.PathTracing(spp=spp), gi.LightField(spp=spp, rays=rays), gi.PathTracing(spp=reference_spp))
        panels = [
            gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
            for seed, method in enumerate(methods)
        ]
    names = (f"input, {spp} spp", f"reconstruction, {spp} spp and {rays} rays")
    for name, panel in zip(names, panels[:2], strict=True):
        errors = gi.compare(panel, panels[2])
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in errors.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    write_png(out, np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1), exposure)
    print(f"wrote {out}")


def mitsuba_panels(
    size: tuple[int, int], spp: int, rays: int, reference_spp: int, device: str | None
) -> list[np.ndarray]:
    """Indirect light of Mitsuba's own Cornell box: samples by Mitsuba, their reconstruction, Mitsuba's reference.

    Raises:
        MissingPeer: Mitsuba is not installed, or its vectorised variant does not run here.
    """
    mi = require(LLVM)
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    loaded = mi.load_dict(scene)
    samples = gi.sample_from_mitsuba(loaded, spp, size)
    reconstruction = gi.reconstruct(samples, gi.LightField(rays=rays), device=device, progress=True)
    # pictures of one seed are of the same paths, so that their difference has no noise of direct light
    whole, direct = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (-1, 2))
    seeds = range(max(1, reference_spp // MITSUBA_SPP))
    reference = np.mean(
        [
            np.subtract(*(mi.render(loaded, integrator=path, spp=MITSUBA_SPP, seed=seed) for path in (whole, direct)))
            for seed in seeds
        ],
        axis=0,
    )
    return [pixel_means(samples, samples.albedo * samples.radiance), reconstruction.layers["indirect"], reference]
