"""The statistical filter against its paper's table: seconds, error and flicker of sequences (MA06, table 1)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import warpgi as gi
from bench.mitsuba_peer import MissingPeer
from bench.point_animations import filtered_points
from bench.reference import Reference, make_reference
from bench.report import circumstances, finite, progress
from warpgi import checks
from warpgi.filter_animation import FilterRun
from warpgi.frame_renderer import FrameRenderer
from warpgi.image import atomic_write, check_output
from warpgi.metrics import RELMSE_EPSILON, RELMSE_MEAN
from warpgi.modes import Modes

#: Samples per pixel of the paper's high-sample renders.
HIGH_SPP = 512


@dataclass(frozen=True)
class Contest:
    """What is compared, of one sequence."""

    scene: str
    size: tuple[int, int] = (64, 64)
    spp: int = 32
    frames: int | None = None
    pairs: int = 5
    reference_spp: int = 4096
    device: str | None = None


@dataclass(frozen=True)
class Standing:
    """One way to make the sequence."""

    name: str
    seconds: float
    """Of the whole sequence."""
    relmse: float
    flicker: float
    """RMS change of the error from frame to frame [radiance]."""


def run(contest: Contest, json: Path | None, picture: Path | None) -> list[Standing]:
    """Measures, prints the table, and writes the numbers and a picture of the basis functions."""
    import json as jsons

    if picture is not None:
        check_output(picture)
    checks.image_size(contest.size)
    device = gi.Device(contest.device)
    frames = {} if contest.frames is None else {"frames": contest.frames}
    sequence = gi.scenes.build_sequence(contest.scene, **frames)
    # pairs of neighbouring frames, evenly over the sequence, at which all is judged
    first = np.linspace(0, sequence.frames - 2, contest.pairs).round().astype(int)
    judged = sorted({int(f) + d for f in first for d in (0, 1)})
    judge = Judge(sequence, judged, contest, device)
    gi.render(sequence.scene(0), gi.PathTracing(spp=1), contest.size, 0, device)  # compiles
    noisy, noisy_seconds = _timed(
        lambda: gi.render_animation(sequence, gi.PathTracing(spp=contest.spp), contest.size, 0, device, True)
    )
    gi.filter_animation(gi.Animation([noisy[0]], (0,)), device=device)
    smooth, filter_seconds = _timed(lambda: gi.filter_animation(noisy, device=device))
    modes = smooth.modes
    assert modes is not None
    stack = noisy.stack("indirect")
    chosen, chosen_seconds, average_spp = importance_sampled(sequence, noisy, judged, contest, device)
    cache, cache_seconds = _timed_after_compile(sequence, gi.IrradianceCache(), judged, contest, device)
    high, high_seconds = _timed(
        lambda: gi.render_animation(
            sequence, gi.PathTracing(spp=HIGH_SPP), contest.size, 1, device, True, frames=judged
        )
    )
    width = max(1, round(sequence.frames / max(float(modes.truncation.mean()), 1.0)))
    boxed, box_seconds = _timed(lambda: box_filter(stack, width))
    standings = [
        judge.standing(f"noisy, {contest.spp} spp", noisy_seconds, stack[judged]),
        judge.standing("statistical filter", noisy_seconds + filter_seconds, smooth.stack("indirect")[judged]),
        judge.standing(f"and {HIGH_SPP} spp by map", noisy_seconds + chosen_seconds, chosen),
        judge.standing(f"box filter, {width} frames", noisy_seconds + box_seconds, boxed[judged]),
        *oidn(judge, noisy, noisy_seconds, device),
        *filtered_points(judge, sequence, contest, device),
        judge.standing("irradiance cache", cache_seconds * sequence.frames / len(judged), cache),
        judge.standing(f"path, {HIGH_SPP} spp", high_seconds * sequence.frames / len(judged), high.stack("indirect")),
    ]
    report(contest, sequence, standings, modes, filter_seconds / noisy_seconds, average_spp)
    if picture is not None:
        plot_modes(modes, picture)
        print(f"wrote {picture}")
    if json is not None:
        found = {
            "contest": asdict(contest),
            "standings": [asdict(standing) for standing in standings],
            "modes": modes.count,
            "rule": modes.rule.value,
            "mean_truncation": float(modes.truncation.mean()),
            "average_spp": average_spp,
            "filter_seconds": filter_seconds,
            "judged_frames": judged,
        }
        with atomic_write(json) as temporary:
            temporary.write_text(jsons.dumps(finite(circumstances(device, gi.versions()) | found), indent=2) + "\n")
        print(f"wrote {json}")
    return standings


class Judge:
    """References of some frames; errors are products of differences to two independent halves, free of their noise."""

    def __init__(self, sequence: gi.Sequence, frames: list[int], contest: Contest, device: gi.Device) -> None:
        self.frames = frames
        references: list[Reference] = []
        with progress() as bar:
            task = bar.add_task("references", total=len(frames))
            for frame in frames:
                scene = sequence.scene(frame)
                references.append(make_reference(scene, contest.size, contest.reference_spp, device=device))
                bar.advance(task)
        self.halves = np.stack([reference.halves for reference in references], axis=1)

    def standing(self, name: str, seconds: float, images: np.ndarray) -> Standing:
        """Measures of the judged frames' indirect light, shape (n, H, W, 3)."""
        a, b = (images - half for half in self.halves)
        truth = self.halves.mean(axis=0)
        scale = RELMSE_MEAN / truth.mean()
        relmse = float((scale**2 * a * b / (np.square(scale * truth) + RELMSE_EPSILON)).mean())
        pairs = [i for i, frame in enumerate(self.frames[:-1]) if self.frames[i + 1] == frame + 1]
        change = [np.mean((a[i + 1] - a[i]) * (b[i + 1] - b[i])) for i in pairs]
        return Standing(name, seconds, relmse, float(np.sqrt(max(np.mean(change), 0.0))))


def importance_sampled(
    sequence: gi.Sequence, noisy: gi.Animation, frames: list[int], contest: Contest, device: gi.Device
) -> tuple[np.ndarray, float, float]:
    """Judged frames of the filter with high samples where its map asks for them (MA06, sec. 3.2).

    Returns:
        Their indirect light; seconds of filter and sampling for all frames, were each as costly; average spp.
    """
    method = gi.StatisticalFilter(spp=contest.spp, high_spp=HIGH_SPP)
    renderer = FrameRenderer(sequence, method.noisy, contest.size, 0, device, vary_seed=True)
    resample = renderer.resample(method)
    assert resample is not None
    resample(0, np.arange(1))  # compiles
    run, once = _timed(lambda: FilterRun(noisy, method, device, resample))
    images, often = _timed(lambda: np.stack([run.frame(frame).layers["indirect"] for frame in frames]))
    return images, once + often * sequence.frames / len(frames), float(run.modes.average_spp)


def box_filter(stack: np.ndarray, width: int) -> np.ndarray:
    """Mean over `width` frames about each, as many as there are at the ends."""
    sums = np.concatenate([np.zeros_like(stack[:1], np.float64), np.cumsum(stack, axis=0, dtype=np.float64)])
    index = np.arange(len(stack))
    low, high = np.maximum(index - width // 2, 0), np.minimum(index - width // 2 + width, len(stack))
    return (sums[high] - sums[low]) / (high - low)[:, None, None, None]


def oidn(judge: Judge, noisy: gi.Animation, seconds: float, device: gi.Device) -> list[Standing]:
    """Intel's denoiser frame by frame; nothing where it is not installed."""
    try:
        from bench.oidn_peer import OidnPeer

        peer = OidnPeer(device.threads)
    except MissingPeer as error:
        print(error)
        return []
    found = []
    for frame in judge.frames:
        layers = noisy[frame].layers
        found.append(peer.denoise(*(layers[name] for name in ("indirect", "albedo", "normal"))))
    mean = float(np.mean([each.seconds for each in found]))
    images = np.stack([each.layer for each in found])
    return [judge.standing("oidn, frame by frame", seconds + mean * len(noisy), images)]


def report(
    contest: Contest,
    sequence: gi.Sequence,
    standings: Sequence[Standing],
    modes: Modes,
    filter_share: float,
    average_spp: float,
) -> None:
    """Prints what was found."""
    width, height = contest.size
    table = Table(box=None, header_style="bold")
    for heading in ("", "seconds", "speed-up", "relMSE", "flicker"):
        table.add_column(heading, justify="right" if heading else "left")
    slowest = standings[-1].seconds
    for each in standings:
        numbers = f"{each.seconds:.1f}", f"{slowest / each.seconds:.1f}", f"{each.relmse:.5f}", f"{each.flicker:.5f}"
        table.add_row(each.name, *numbers)
    print(f"{contest.scene}, {sequence.frames} frames of {width} x {height}, indirect light")
    Console(width=100).print(table)
    print(
        f"{modes.count} modes by {modes.rule.value}, {modes.truncation.mean():.2f} in the mean over pixels;"
        f" filtering takes {100.0 * filter_share:.1f} % of rendering;"
        f" {average_spp:.1f} spp in the mean with {HIGH_SPP} where the map asks for them"
    )


def plot_modes(modes: Modes, path: Path) -> None:
    """Basis functions, truncation map and percentVar in one picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = min(len(modes.basis), 7)
    figure, axes = pyplot.subplots(1, shown + 2, figsize=(2.1 * (shown + 2), 2.5), constrained_layout=True)
    for k in range(shown):
        image = modes.basis[k] / max(float(np.quantile(np.abs(modes.basis[k]), 0.99)), 1e-30)
        axes[k].imshow(np.clip(image if k == 0 else 0.5 + 0.5 * image, 0.0, 1.0), interpolation="nearest")
        axes[k].set_title("mean" if k == 0 else f"mode {k + 1}", fontsize=9)
    drawn = axes[shown].imshow(modes.truncation, cmap="turbo", interpolation="nearest")
    axes[shown].set_title("truncation", fontsize=9)
    figure.colorbar(drawn, ax=axes[shown], fraction=0.046)
    for axis in axes[: shown + 1]:
        axis.set_axis_off()
    curve = np.maximum(modes.percent_var[1:], 1e-6)
    axes[-1].semilogy(np.arange(1, len(curve) + 1)[:40], curve[:40], ".-", markersize=4)
    axes[-1].axvline(modes.count, color="tab:red", linewidth=1)
    axes[-1].set_title(f"percentVar, M = {modes.count}", fontsize=9)
    axes[-1].tick_params(labelsize=7)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    pyplot.close(figure)


def _timed_after_compile(
    sequence: gi.Sequence, method: gi.IrradianceCache, frames: list[int], contest: Contest, device: gi.Device
) -> tuple[np.ndarray, float]:
    gi.render(sequence.scene(0), method, (8, 8), 0, device)
    animation, seconds = _timed(
        lambda: gi.render_animation(sequence, method, contest.size, 2, device, True, frames=frames)
    )
    return animation.stack("indirect"), seconds


def _timed(work: Callable[[], object]) -> tuple:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
