"""Pictures for the README, each from one command."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warpgi as gi
from warpgi import checks
from warpgi.image import check_output, write_png

GAP = 4  # pixels between panels
WHITE = 1e4  # radiance of the gap


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
    built = gi.scenes.build(scene)
    methods = {
        f"input, {spp} spp": gi.PathTracing(spp=spp),
        f"reconstruction, {spp} spp and {rays} rays": gi.LightField(spp=spp, rays=rays),
        f"reference, {reference_spp} spp": gi.PathTracing(spp=reference_spp),
    }
    panels = [
        gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
        for seed, method in enumerate(methods.values())
    ]
    for name, panel in zip(methods, panels[:2], strict=False):
        errors = gi.compare(panel, panels[2])
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in errors.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    write_png(out, np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1), exposure)
    print(f"wrote {out}")
