"""The command line of the bench."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from bench import chart, figures, rays, reconstruction, stability

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
    out: Path,
    scene: str = "cornell-box",
    methods: tuple[str, ...] = ("light-field",),
    size: tuple[int, int] = (256, 256),
    spp: int = 8,
    rays: int = 256,
    reference_spp: int = 1024,
    exposure: float = 0.0,
    device: str | None = None,
) -> None:
    """Picture of the indirect light of a scene: input, methods and reference side by side.

    Args:
        out: PNG to write.
        scene: Built-in scene, or mitsuba-cornell-box: Mitsuba's own, which Mitsuba samples and path-traces.
        methods: Methods that work on samples: light-field, a-trous, ...
        size: Width and height of each panel in pixels.
        spp: Input samples per pixel.
        rays: Reconstruction rays per pixel.
        reference_spp: Paths per pixel of the reference.
        exposure: Stops by which the picture is brightened.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
    """
    figures.side_by_side(out, scene, methods, size, spp, rays, reference_spp, exposure, device)


def cache_command(
    out: Path = Path("cache.png"),
    size: tuple[int, int] = (256, 256),
    reference_spp: int = 1024,
    device: str | None = None,
) -> None:
    """Irradiance caches beside their reference, and where their records are.

    Args:
        out: the PNG.
        size: width and height in pixels of each part.
        reference_spp: paths per pixel of the reference.
        device: cpu, cuda:0, ...; a GPU if there is one.
    """
    figures.cache(out, size, reference_spp, device)


def lens_command(
    out: Path,
    size: tuple[int, int] = (640, 360),
    rays: int = 192,
    reference_spp: int = 1024,
    device: str | None = None,
    json: Path | None = None,
) -> None:
    """Picture of defocus and motion: 1 spp of butterflies, both methods that reconstruct from it, and the reference.

    Args:
        out: PNG to write.
        size: Width and height of each panel in pixels.
        rays: Reconstruction rays per pixel.
        reference_spp: Paths per pixel of the reference.
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        json: File for the numbers.
    """
    figures.lens(out, size, rays, reference_spp, device, json)


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
    app.command(lens_command, name="lens")
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
