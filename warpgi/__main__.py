"""The command line: the library's own calls, their settings as options, their errors in one sentence."""

from __future__ import annotations

import ast
import math
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

import warpgi as gi
from warpgi.animate import noisy_pattern
from warpgi.cluster_option import ClusterOption, chosen_cluster
from warpgi.frame_files import frame_path
from warpgi.image import check_output
from warpgi.load import SUFFIXES
from warpgi.methods import DENOISERS as DENOISING_METHODS
from warpgi.methods import RECONSTRUCTIONS as RECONSTRUCTION_METHODS
from warpgi.methods import SEQUENCE_METHODS
from warpgi.progress import RAY_KINDS

MISUSE = 2  # exit status for a caller's mistake
INTERRUPTED = 130

# Counts of what a user should hear of.
WRONG = {
    "nonfinite": "samples were not finite and were dropped",
    "nonfinite_pixels": "pixels were not finite and were left out",
    "zero_length": "samples had no length and were dropped",
    "bad_normal": "samples had no normal and were dropped",
    "degenerate_triangles": "triangles without area were dropped",
    "fireflies": "pixels are far brighter than all around: light that paths hardly find",
    "nonfinite_photons": "photons were not finite and were dropped",
    "missing_support": "reconstruction rays found no sample and were left out",
    "cut_gathers": "reconstruction rays met more samples than were looked at",
}


def _subcommands(methods: Mapping[str, type]) -> Any:
    """One subcommand a method, so that a new method is here by being listed."""
    return tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in methods.items()},
        {name: (kind.__doc__ or "").strip().splitlines()[0] for name, kind in methods.items()},
    )


METHOD_SETTINGS: Any = _subcommands(gi.METHODS)
RECONSTRUCTIONS: Any = _subcommands(RECONSTRUCTION_METHODS)
DENOISERS: Any = _subcommands(DENOISING_METHODS)
SEQUENCE_SETTINGS: Any = _subcommands(gi.METHODS | SEQUENCE_METHODS)
SEQUENCE_FILTERS: Any = _subcommands({"statistical-filter": gi.StatisticalFilter})


@dataclass(frozen=True)
class RenderCommand:
    """Render a scene and write the picture."""

    scene: tyro.conf.Positional[str]
    """A built-in scene, with parameters as in courtyard:detail=0.2, or a .glb, .gltf, .obj, .ply, .stl or .usd file."""
    method: METHOD_SETTINGS = field(default_factory=gi.PathTracing)  # type: ignore[valid-type]
    """How to render it; path tracing by default."""
    size: tuple[int, int] = (256, 256)
    """Width and height in pixels."""
    seed: int = 0
    """Which random numbers."""
    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Where the picture goes: .exr with all layers, .png tone-mapped; may be given more than once."""
    exposure: float = 0.0
    """Stops by which a .png is brightened."""
    seconds: float | None = None
    """Time after which the picture is taken as it is."""
    error: float | None = None
    """relMSE, by the samples' variance, below which it is good enough."""
    checkpoint: Path | None = None
    """Where the unfinished picture is kept, and from which it goes on if it is there."""
    device: str | None = None
    """cpu, cuda:0, ...; a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all by default."""
    memory_limit: float = 3.0
    """GiB that the render's arrays may take on the device."""

    def run(self) -> None:
        device = _prepare(self.out, self.device, self.threads, self.memory_limit)
        scene = open_scene(self.scene)

        def work() -> gi.Render:
            ends: dict[str, Any] = {"seconds": self.seconds, "error": self.error, "checkpoint": self.checkpoint}
            return gi.render(scene, self.method, self.size, self.seed, device, sys.stderr.isatty(), **ends)

        _make(work, self.out, self.exposure)


@dataclass(frozen=True)
class AnimateCommand:
    """Render a sequence, a file a frame; a run that was stopped goes on with --resume."""

    sequence: tyro.conf.Positional[str]
    """A built-in sequence, with parameters as in moving-light:frames=20."""
    method: SEQUENCE_SETTINGS = field(default_factory=gi.PathTracing)  # type: ignore[valid-type]
    """How to render it; path tracing by default."""
    size: tuple[int, int] = (256, 256)
    """Width and height in pixels."""
    seed: int = 0
    """Which random numbers."""
    frames: tuple[int, int] | None = None
    """First frame, and the one after the last; all by default."""
    out: str = "frames/frame-{:04d}.exr"
    """The frames' files; the folder is made."""
    resume: bool = False
    """Keep files that are whole and of these very frames, and render the others."""
    vary_seed: bool = True
    """Each frame has random numbers of its own; without, a still sequence has equal frames."""
    preview: Path | None = None
    """Animated PNG of the frames; of filtered ones their noisy input is beside them."""
    exposure: float = 0.0
    """Stops by which the preview is brightened."""
    device: str | None = None
    """cpu, cuda:0, ...; a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all by default."""
    memory_limit: float = 3.0
    """GiB that a frame's arrays may take on the device."""
    cluster: ClusterOption = None
    """Render frames on Dask workers: of this machine's cores, or of the scheduler at an address, as tcp://host:8786."""

    def run(self) -> None:
        device = _device(self.device, self.threads, self.memory_limit)
        sequence = open_sequence(self.sequence)
        frames = None if self.frames is None else _frame_range(*self.frames)
        animation = gi.render_animation(
            sequence,
            self.method,
            self.size,
            self.seed,
            device,
            sys.stderr.isatty(),
            self.out,
            self.resume,
            frames,
            self.vary_seed,
            chosen_cluster(self.cluster),
        )
        _told(sequence.name, animation, "rendered")
        if self.preview is not None:
            shown = [animation]
            if isinstance(self.method, gi.StatisticalFilter):
                path = frame_path(noisy_pattern(self.out))
                shown.insert(0, gi.Animation([path(number) for number in animation.frames], animation.frames))
            _show(self.preview, shown, self.exposure)


@dataclass(frozen=True)
class FilterCommand:
    """Filter the frames of a rendered sequence in time, whoever rendered them."""

    frames: tyro.conf.Positional[str]
    """The frames' files, such as folder/frame-{:04d}.exr, from number 0 or 1 on."""
    method: SEQUENCE_FILTERS = field(default_factory=gi.StatisticalFilter)  # type: ignore[valid-type]
    """The filter; its settings of noisy frames mean nothing here."""
    out: str = "filtered/frame-{:04d}.exr"
    """The filtered frames' files, with modes.npz, the basis functions, beside them."""
    resume: bool = False
    """Keep filtered frames that are whole and of these very noisy ones."""
    preview: Path | None = None
    """Animated PNG: noisy and filtered frames, and the reference's if there are any, side by side."""
    reference: str | None = None
    """Files of reference frames for the preview."""
    exposure: float = 0.0
    """Stops by which the preview is brightened."""
    device: str | None = None
    """cpu, cuda:0, ...; a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all by default."""
    memory_limit: float = 3.0
    """GiB that arrays may take; longer sequences are read several times."""
    cluster: ClusterOption = None
    """Multiply frames on Dask workers: of this machine's cores, or of the scheduler at an address."""

    def run(self) -> None:
        device = _device(self.device, self.threads, self.memory_limit)
        noisy = gi.Animation.load(self.frames)
        bar, cluster = sys.stderr.isatty(), chosen_cluster(self.cluster)
        animation = gi.filter_animation(noisy, self.method, device, bar, self.out, self.resume, cluster)
        _told(self.frames, animation, "filtered")
        if self.preview is not None:
            reference = [] if self.reference is None else [gi.Animation.load(self.reference)]
            _show(self.preview, [noisy, animation, *reference], self.exposure)


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct a picture from a sample buffer; no scene is needed."""

    samples: tyro.conf.Positional[Path]
    """The sample buffer, with its .header beside it."""
    method: RECONSTRUCTIONS = field(default_factory=gi.LightField)  # type: ignore[valid-type]
    """What to reconstruct: indirect light by default."""
    seed: int = 0
    """Which random numbers."""
    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Where the picture goes: .exr with all layers, .png tone-mapped; may be given more than once."""
    exposure: float = 0.0
    """Stops by which a .png is brightened."""
    device: str | None = None
    """cpu, cuda:0, ...; a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all by default."""
    memory_limit: float = 3.0
    """GiB that the arrays may take on the device."""

    def run(self) -> None:
        device = _prepare(self.out, self.device, self.threads, self.memory_limit)
        samples = gi.SampleBuffer.load(self.samples)

        def work() -> gi.Render:
            return gi.reconstruct(samples, self.method, self.seed, device, progress=sys.stderr.isatty())

        _make(work, self.out, self.exposure)


@dataclass(frozen=True)
class DenoiseCommand:
    """Filter the indirect light of a finished picture, or all of it; any renderer's that has feature layers."""

    picture: tyro.conf.Positional[Path]
    """The .exr to filter, with layers for albedo, normal, and position or depth."""
    method: DENOISERS = field(default_factory=gi.ATrous)  # type: ignore[valid-type]
    """The filter: À-Trous by default."""
    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Where the picture goes: .exr with all layers, .png tone-mapped; may be given more than once."""
    exposure: float = 0.0
    """Stops by which a .png is brightened."""
    device: str | None = None
    """cpu, cuda:0, ...; a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all by default."""
    memory_limit: float = 3.0
    """GiB that the arrays may take on the device."""

    def run(self) -> None:
        device = _prepare(self.out, self.device, self.threads, self.memory_limit)
        picture = gi.Render.load(self.picture)

        def work() -> gi.Render:
            return gi.denoise(picture, self.method, device, progress=sys.stderr.isatty())

        _make(work, self.out, self.exposure)


@dataclass(frozen=True)
class CompareCommand:
    """Compare two pictures of one size: relMSE, RMSE, PSNR and FLIP."""

    image: tyro.conf.Positional[Path]
    """The .exr to judge."""
    reference: tyro.conf.Positional[Path]
    """The .exr to judge it by."""
    layer: str = "image"
    """Which layer: image, indirect, direct, ..."""

    def run(self) -> None:
        images = [_layer(path, self.layer) for path in (self.image, self.reference)]
        for name, value in gi.compare(*images).items():
            print(f"{name:8s}{'flip-evaluator is not installed' if value is None else f'{value:.6g}'}")


@dataclass(frozen=True)
class ScenesCommand:
    """List the built-in scenes and sequences."""

    def run(self) -> None:
        _table(gi.scenes.SCENES)
        print("sequences:")
        _table(gi.scenes.SEQUENCES)


@dataclass(frozen=True)
class MethodsCommand:
    """List the methods."""

    def run(self) -> None:
        _table(gi.METHODS)
        print("of sequences:")
        _table(SEQUENCE_METHODS)


@dataclass(frozen=True)
class InfoCommand:
    """Show versions, devices and where compiled kernels are kept."""

    def run(self) -> None:
        import warp as wp

        device = gi.Device()
        for name, version in gi.versions().items():
            print(f"{name:14s}{version}")
        print(f"{'device':14s}{device.name} ({device.warp.name})")
        print(f"{'threads':14s}{device.threads}")
        print(f"{'kernel cache':14s}{wp.config.kernel_cache_dir}")
        print(f"{'scene files':14s}{' '.join(SUFFIXES)}")


COMMANDS = (
    Annotated[RenderCommand, tyro.conf.subcommand("render")]
    | Annotated[AnimateCommand, tyro.conf.subcommand("animate")]
    | Annotated[FilterCommand, tyro.conf.subcommand("filter")]
    | Annotated[ReconstructCommand, tyro.conf.subcommand("reconstruct")]
    | Annotated[DenoiseCommand, tyro.conf.subcommand("denoise")]
    | Annotated[CompareCommand, tyro.conf.subcommand("compare")]
    | Annotated[ScenesCommand, tyro.conf.subcommand("scenes")]
    | Annotated[MethodsCommand, tyro.conf.subcommand("methods")]
    | Annotated[InfoCommand, tyro.conf.subcommand("info")]
)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns its exit status: 0, or 2 for a caller's mistake, or 130 after Ctrl-C."""
    options = (
        tyro.conf.OmitArgPrefixes,
        tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.CascadeSubcommandArgs,
        tyro.conf.EnumChoicesFromValues,
    )
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: _warn(str(message))  # type: ignore[assignment]
            warnings.simplefilter("always", UserWarning)
            warnings.simplefilter("always", RuntimeWarning)
            command: Any = tyro.cli(COMMANDS, prog="warpgi", args=arguments, config=options)  # type: ignore[call-overload]
            command.run()
    except KeyboardInterrupt:
        print("warpgi: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"warpgi: error: {error}", file=sys.stderr)
        return MISUSE
    return 0


def _prepare(out: tuple[Path, ...], device: str | None, threads: int | None, memory_limit: float) -> gi.Device:
    """Refuses outputs that cannot be written before any work is done, and picks the device."""
    for path in out:
        check_output(path)
    if not out:
        _warn("no --out FILE.exr or --out FILE.png: the picture will not be kept")
    return _device(device, threads, memory_limit)


def _device(device: str | None, threads: int | None, memory_limit: float) -> gi.Device:
    if not 0.0 < memory_limit < math.inf:
        raise ValueError(f"memory-limit is {memory_limit:g} GiB, expected a number above 0")
    return gi.Device(device, threads, int(memory_limit * 2**30))


def _make(work: Callable[[], gi.Render], out: tuple[Path, ...], exposure: float) -> None:
    """Does the work and keeps the picture, also what Ctrl-C left of it."""
    try:
        picture = work()
    except gi.Interrupted as stop:
        if stop.render is not None:
            _keep(stop.render, out, exposure)
            print(f"interrupted: the picture holds {stop.passes.done} of {stop.passes.total} {stop.passes.unit}")
        raise
    _keep(picture, out, exposure)


def _keep(picture: gi.Render, out: tuple[Path, ...], exposure: float) -> None:
    for path in out:
        picture.save(path, exposure)
    stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in picture.timings.items() if seconds >= 0.005)
    height, width = picture.image.shape[:2]
    name = f"{picture.scene}, " if picture.scene else ""
    print(f"{name}{picture.method}, {picture.spp} spp, {width} x {height} on {picture.device}: {stages}")
    rays = {kind: picture.counts[kind] for kind in RAY_KINDS if kind in picture.counts}
    seconds = picture.timings["prepare"] + picture.timings["estimate"]
    kinds = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in rays.items())
    if rays:
        print(f"{kinds}: {sum(rays.values()) / max(seconds, 1e-9) / 1e6:.2f} M rays/s")
    _warn_of(picture.counts)
    for path in out:
        print(f"wrote {path}")


def _show(path: Path, animations: list[gi.Animation], exposure: float) -> None:
    gi.write_preview(path, *animations, exposure=exposure)
    print(f"wrote {path}")


def _told(name: str, animation: gi.Animation, done: str) -> None:
    stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in animation.timings.items() if seconds >= 0.005)
    found = len(animation) - len(animation.rendered)
    print(f"{name}, {len(animation.rendered)} frames {done}, {found} found: {stages}")
    if animation.modes is not None:
        modes = animation.modes
        mean = f"{modes.truncation.mean():.2f} in the mean over pixels"
        spp = "" if modes.average_spp is None else f", {modes.average_spp:.3f} spp in the mean"
        print(f"{modes.count} of {len(modes.eigenvalues)} modes (chosen: {modes.rule.value}), {mean}{spp}")
    _warn_of(animation.counts)
    print(f"wrote {animation.paths[0]} to {animation.paths[-1].name}")


def _warn_of(counts: Mapping[str, int]) -> None:
    for kind, meaning in WRONG.items():
        if counts.get(kind):
            _warn(f"{counts[kind]} {meaning}")


def open_scene(text: str) -> gi.Scene:
    """A file where there is one or the name looks like one, else a built-in scene with its parameters."""
    if Path(text).suffix.lower() in SUFFIXES or Path(text).exists():
        return gi.load_scene(text)
    name, parameters = _parse("scene", text, "courtyard:detail=0.2")
    return gi.scenes.build(name, **parameters)


def open_sequence(text: str) -> gi.Sequence:
    """A built-in sequence with its parameters."""
    name, parameters = _parse("sequence", text, "moving-light:frames=20")
    return gi.scenes.build_sequence(name, **parameters)


def _parse(kind: str, text: str, example: str) -> tuple[str, dict[str, Any]]:
    name, _, rest = text.partition(":")
    parameters: dict[str, Any] = {}
    for item in filter(None, rest.split(",")):
        key, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"{kind} is {text!r}, expected parameters as in {example}")
        try:
            parameters[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            parameters[key] = value
    return name, parameters


def _frame_range(first: int, after: int) -> range:
    if after <= first:
        raise ValueError(f"frames is {first} {after}, expected the first and, larger, the one after the last")
    return range(first, after)


def _layer(path: Path, name: str) -> np.ndarray:
    picture = gi.Render.load(path)
    if name == "image":
        return picture.image
    if name not in picture.layers:
        raise ValueError(f"layer {name!r} is not in {path}, expected one of image, {', '.join(picture.layers)}")
    return picture.layers[name]


def _table(items: Mapping[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False)
    for name, item in items.items():
        table.add_row(name, (item.__doc__ or "").strip().splitlines()[0])
    Console().print(table)


def _warn(message: str) -> None:
    print(f"warpgi: warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
