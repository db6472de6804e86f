"""The command line of the bench."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from bench import animations, cache_figure, chart, figures, point_animations, rays, reconstruction, stability

BROKEN = 1  # exit status for a method that is worse than its bound
MISUSE = 2  # exit status for a caller's mistake
INTERRUPTED = 130


def rays_command(
    device: str | None = None,
    scenes: tuple[str, ...] = ("cornell-box", "courtyard"),
    size: tuple[int, int] = (256, 256),
    spp: int = 16,
    repeats: int = 7,
    threads: int | None = None,
    peers: bool = False,
    samples: Path | None = None,
    json: Path | None = None,
) -> None:
    """Measure rays, paths and reconstruction rays per second, compile time, upload time and memory.

    Args:
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        scenes: Built-in scenes.
        size: Width and height in pixels.
        spp: Paths per pixel; rays of each kind are width x height x spp too, up to a few millions.
        repeats: Times that everything is measured, in turn; the table shows medians.
        threads: CPU threads; all by default.
        peers: Measure Mitsuba 3 too, on the same pictures, and compare these.
        samples: Sample buffer from which reconstruction is measured too.
        json: File for the measurements and what they were made with.
    """
    rays.run(rays.Settings(device, scenes, size, spp, repeats, threads, peers, samples), json)


def scaling_command(
    device: str | None = None,
    scenes: tuple[str, ...] = ("cornell-box", "courtyard"),
    size: tuple[int, int] = (96, 96),
    rays: tuple[int, ...] = (64, 128, 256),
    spp: tuple[int, ...] = (1, 2, 4, 8),
    repeats: int = 3,
    threads: int | None = None,
    json: Path | None = None,
) -> None:
    """Measure how the time of light-field reconstruction grows, and the memory of a sample.

    Args:
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        scenes: Built-in scenes; others are compared with the first.
        size: Width and height in pixels.
        rays: Reconstruction rays per pixel; the last goes with each of `spp` and of `scenes`.
        spp: Input samples per pixel; the last goes with each of `rays` and of `scenes`.
        repeats: Times that everything is measured, in turn; the table shows medians.
        threads: CPU threads; all by default.
        json: File for the measurements and what they were made with.
    """
    reconstruction.run_scaling(reconstruction.ScalingSettings(device, scenes, size, rays, spp, repeats, threads), json)


def figures_command(
    figure: tuple[str, ...] = (),
    size: tuple[int, int] | None = None,
    quick: bool = False,
    out: Path = Path("out/figures"),
    picture: Path | None = None,
    fresh: bool = False,
    device: str | None = None,
) -> None:
    """Make the figures of Lehtinen et al. 2012 on scenes of ours: pictures, differences times two, and numbers.

    Ctrl-C keeps what is finished; the same command does what is missing.

    Args:
        figure: Numbers of the paper, 1, 4 and 7 to 13, or mitsuba: Mitsuba's own Cornell box; all numbers by default.
        size: Width and height of each panel in pixels, instead of the figure's own.
        quick: A sixteenth of the pixels, 32 rays, and references of 64 spp.
        out: Folder for a PNG, JSON and NPZ (the panels) of each figure.
        picture: Where the PNG of a single figure goes too.
        fresh: Make finished figures anew.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
    """
    figures.run(figure, out, size, quick, device, picture, fresh)


def cache_command(
    out: Path,
    size: tuple[int, int] = (256, 256),
    reference_spp: int = 1024,
    device: str | None = None,
) -> None:
    """Picture of irradiance caches beside their reference, and of where their records are.

    Args:
        out: PNG to write.
        size: Width and height in pixels of each part.
        reference_spp: Paths per pixel of the reference.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
    """
    cache_figure.draw(out, size, reference_spp, device)


def animation_command(
    scene: str = "moving-light",
    size: tuple[int, int] = (64, 64),
    spp: int = 32,
    frames: int | None = None,
    pairs: int = 5,
    reference_spp: int = 4096,
    device: str | None = None,
    json: Path | None = None,
    picture: Path | None = None,
) -> None:
    """Judge the statistical filter on a sequence: seconds, error and flicker beside 512 samples, a box filter and OIDN.

    Args:
        scene: Built-in sequence.
        size: Width and height in pixels.
        spp: Paths per pixel of the noisy frames.
        frames: How many frames; as many as the sequence has by default.
        pairs: Pairs of neighbouring frames at which errors are measured.
        reference_spp: Paths per pixel of these frames' references.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        json: File for the numbers.
        picture: PNG of basis functions, truncation map and percentVar.
    """
    animations.run(animations.Contest(scene, size, spp, frames, pairs, reference_spp, device), json, picture)


def points_command(
    out: Path,
    scene: str = "moving-car",
    size: tuple[int, int] = (128, 72),
    frames: int = 42,
    frame: int = 20,
    reference_spp: int = 512,
    device: str | None = None,
) -> None:
    """Picture of a frame whose light was filtered at points of surfaces, between its noisy input and its reference.

    Args:
        out: PNG to write.
        scene: Built-in sequence.
        size: Width and height in pixels of each part.
        frames: How many frames the sequence has.
        frame: Which of them is shown.
        reference_spp: Paths per pixel of the reference.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
    """
    point_animations.draw(out, scene, size, frames, frame, reference_spp, device)


def chart_command(
    scene: tuple[str, ...] = ("cornell-box", "courtyard"),
    size: tuple[int, int] = (256, 256),
    methods: tuple[str, ...] = (),
    repeats: int = 3,
    seed: int = 0,
    reference_spp: int = 4096,
    max_depth: int | None = None,
    device: str | None = None,
    threads: int | None = None,
    out: Path = Path("out/chart"),
    picture: Path | None = None,
    quick: bool = False,
    fresh: bool = False,
) -> None:
    """Chart error against seconds of every method and peer: tables, a PNG, an HTML page with the pictures.

    Ctrl-C keeps what is finished, and reports it; the same command does what is missing.

    Args:
        scene: Built-in scenes or files, as warpgi render takes them.
        size: Width and height in pixels.
        methods: Which methods and peers; all by default.
        repeats: Times that everything is measured, each with a seed of its own: times are medians, errors means.
        seed: The first of these seeds.
        reference_spp: Paths per pixel of the reference, which is kept in bench/cache.
        max_depth: Longest path in segments; unlimited by default.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        threads: CPU threads; all by default.
        out: Folder for results.json, chart.png, index.html, and the finished runs.
        picture: Where the chart goes as a PNG instead of chart.png in that folder.
        quick: A small chart within three minutes: 64 x 64 pixels, few settings, one repeat, a reference of 1024 spp.
        fresh: Forget the finished runs in that folder.
    """
    settings = chart.ChartSettings(device, scene, size, methods, repeats, seed, reference_spp, max_depth, threads)
    chart.run(settings.made_quick() if quick else settings, out, fresh, picture)


def stability_command(
    methods: tuple[str, ...] = (),
    device: str | None = None,
    threads: int | None = None,
    out: Path = Path("out/chart"),
) -> int:
    """Measure what each method is known to do wrong; the exit status is 1 where a bound is broken.

    Args:
        methods: Which methods; all by default.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        threads: CPU threads; all by default.
        out: Folder for stability.json, and of the chart whose page shows it.
    """
    return 0 if stability.run(out, methods, device, threads) else BROKEN


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns its exit status: 1: a bound is broken, 2: a caller's mistake, 130: Ctrl-C."""
    app = tyro.extras.SubcommandApp()
    app.command(rays_command, name="rays")
    app.command(figures_command, name="figures")
    app.command(scaling_command, name="scaling")
    app.command(cache_command, name="cache")
    app.command(animation_command, name="animation")
    app.command(points_command, name="points")
    app.command(chart_command, name="chart")
    app.command(stability_command, name="stability")
    try:
        return app.cli(prog="python -m bench", args=arguments, config=(tyro.conf.FlagCreatePairsOff,)) or 0
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError) as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return MISUSE


if __name__ == "__main__":
    sys.exit(main())
