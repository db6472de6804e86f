"""Pictures for the README, each from one command."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warpgi as gi
from bench.reference import make_reference
from bench.report import progress
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
    methods = {
        f"input, {spp} spp": gi.PathTracing(spp=spp),
        f"reconstruction, {spp} spp and {rays} rays": gi.LightField(spp=spp, rays=rays),
    }
    panels = [
        gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
        for seed, method in enumerate(methods.values())
    ]
    for name, panel in zip(methods, panels, strict=True):
        errors = reference.judge(panel)
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in errors.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    write_png(out, np.concatenate([panels[0], gap, panels[1], gap, reference.image], axis=1), exposure)
    print(f"wrote {out}")
