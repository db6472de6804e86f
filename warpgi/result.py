"""What a method gives back: layers of one picture, and how they came about."""

from __future__ import annotations

import enum
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from warpgi.image import PathLike, output_suffix, read_exr, write_exr, write_png

#: Opens the names of the EXR attributes that warpgi writes: "warpgi:method" and so on.
PREFIX = "warpgi:"


class Layer(NamedTuple):
    """How a layer is called in memory and on disk."""

    channels: tuple[str, ...]
    """Its EXR channels, in the order of its last axis."""
    meaning: str
    """What its values are."""
    aliases: tuple[str, ...] = ()
    """Names by which other tools know it, lower case, first come first served; "" is a channel without a layer."""
    spellings: tuple[str, ...] = ("RGB",)
    """Letters that may end the channels of these."""


#: Every layer that a `Render` may hold; all are linear float32, shape (H, W, number of channels).
LAYERS: Mapping[str, Layer] = {
    "image": Layer(
        ("R", "G", "B"),
        "the whole radiance [W/(sr m^2)]; a layer only where it is not the sum of emission, direct and indirect",
        ("combined",),
    ),
    "emission": Layer(
        ("emission.R", "emission.G", "emission.B"),
        "radiance of lights seen directly, mean over the samples [W/(sr m^2)]",
    ),
    "direct": Layer(
        ("direct.R", "direct.G", "direct.B"),
        "radiance after one scattering, mean over the samples [W/(sr m^2)]",
    ),
    "indirect": Layer(
        ("indirect.R", "indirect.G", "indirect.B"),
        "radiance after two scatterings or more, mean over the samples [W/(sr m^2)]",
    ),
    "albedo": Layer(
        ("albedo.R", "albedo.G", "albedo.B"),
        "reflectance at the first hit, mean over the samples, 0 where they miss",
        ("albedo", "denoising albedo", "diffcol"),
    ),
    "normal": Layer(
        ("normal.X", "normal.Y", "normal.Z"),
        "world shading normal at the first hit, mean over the samples, 0 where they miss; not normalised",
        ("normal", "denoising normal", "sh_normal", "normals", "nn", "ns", "n"),
        ("XYZ", "RGB"),
    ),
    "position": Layer(
        ("position.X", "position.Y", "position.Z"),
        "world position of the first hit, mean over the samples that hit [scene units]; 0 where none does",
        ("position", "pos", "p"),
        ("XYZ", "RGB"),
    ),
    "depth": Layer(
        ("depth.Z",),
        "distance along the camera ray, mean over the samples that hit [scene units]; 0 where none does",
        ("depth", "denoising depth", "dd", "dd.y", ""),
        ("Z", "T", "V"),
    ),
    "hit_distance": Layer(
        ("hit_distance.Z",),
        "harmonic mean distance from the first hits to what the rays going on from there met [scene units]; rays that"
        " met nothing count as infinite; 0 where all did",
    ),
    "records": Layer(
        ("records.Z",),
        "1 in pixels where an irradiance cache has a record, else 0",
    ),
    "variance": Layer(
        ("variance.R", "variance.G", "variance.B"),
        "estimated variance of the pixel's mean in `image`, per channel [squared radiance]",
    ),
}

#: The layers that add up to the image.
PARTS = ("emission", "direct", "indirect")


@dataclass(eq=False)
class Render:
    """One picture, the same for every method.

    Raises:
        TypeError, ValueError: a layer is unknown, no float32 array, or of another size than the others; settings hold
            what JSON cannot.

    Example:
        >>> import numpy as np
        >>> render = Render({"direct": np.ones((4, 6, 3), np.float32)}, method="path", spp=8)
        >>> render.image.shape
        (4, 6, 3)
    """

    layers: dict[str, np.ndarray]
    """Layer name -> linear float32 pixels, shape (H, W, C), row 0 on top; `LAYERS` says what each means."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by stage: compile, upload, prepare, estimate, image."""
    counts: dict[str, int] = field(default_factory=dict)
    """Rays by kind, dropped samples ("nonfinite"), and whatever the method counts."""
    method: str = ""
    """Its name in METHODS."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Its settings as JSON has them: tuples become lists, Enums their values."""
    seed: int = 0
    """What every random number came from."""
    spp: int = 0
    """Samples per pixel that it holds; 0: unknown."""
    scene: str = ""
    """The scene's name."""
    device: str = ""
    """What computed it."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of warpgi, Warp and the like."""
    identity: str = ""
    """Digest of all that a frame of an animation depends on."""

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("layers is empty, expected at least one layer")
        size: tuple[int, ...] = ()
        for name, pixels in self.layers.items():
            if name not in LAYERS:
                raise ValueError(f"layers holds {name!r}, expected names out of {', '.join(LAYERS)}")
            depth = len(LAYERS[name].channels)
            if not isinstance(pixels, np.ndarray) or pixels.dtype != np.float32:
                kind = f"{pixels.dtype} values" if isinstance(pixels, np.ndarray) else type(pixels).__name__
                raise TypeError(f"layer {name} is of {kind}, expected a float32 array")
            if pixels.ndim != 3 or pixels.shape[2] != depth or pixels.size == 0:
                raise ValueError(f"layer {name} has shape {pixels.shape}, expected (H, W, {depth}) with H, W above 0")
            if size and pixels.shape[:2] != size:
                raise ValueError(f"layer {name} has {pixels.shape[:2]} pixels, expected {size} as in the other layers")
            size = pixels.shape[:2]
        self.timings = {name: float(seconds) for name, seconds in self.timings.items()}
        self.counts = {name: int(count) for name, count in self.counts.items()}
        try:
            self.settings = json.loads(json.dumps(self.settings, default=_plain))
        except (TypeError, ValueError) as error:
            raise TypeError(f"settings of {self.method or 'the method'} cannot be kept as JSON: {error}") from error

    @property
    def image(self) -> np.ndarray:
        """Linear radiance, shape (H, W, 3) float32: the layer "image", else the sum of emission, direct and indirect.

        Raises:
            ValueError: it holds none of these layers.
        """
        if "image" in self.layers:
            return self.layers["image"]
        total = self._sum_of_parts()
        if total is None:
            raise ValueError(f"render holds {', '.join(self.layers)}, expected one of image, {', '.join(PARTS)}")
        return total

    def _sum_of_parts(self) -> np.ndarray | None:
        parts = [self.layers[name] for name in PARTS if name in self.layers]
        if not parts:
            return None
        total = parts[0].copy()
        with np.errstate(over="ignore", invalid="ignore"):  # a wrong pixel is seen as NaN or infinity
            for part in parts[1:]:
                total += part
        return total

    def save(self, path: PathLike, exposure: float = 0.0) -> None:
        """Writes it as .exr, whole and without loss, or as .png, tone-mapped for looking at.

        The EXR holds every layer as 32-bit floats, the image as plain R, G, B, and the rest of the fields as text
        attributes whose names begin with "warpgi:" (JSON for all but names and whole numbers). The file appears under
        its name when it is complete.

        Args:
            path: where to write; the suffix decides.
            exposure: stops, in [-64, 64], for .png alone; 1 doubles the light.

        Raises:
            ValueError: the suffix is unknown, or there is no image to show.
            OSError: the file cannot be written.

        Warns:
            RuntimeWarning: pixels that are NaN or infinite are magenta in the .png.
        """
        if output_suffix(path) == ".png":
            write_png(path, self.image, exposure)
            return
        layers = dict(self.layers)
        if any(name in layers for name in PARTS):
            layers["image"] = self.image
        channels = {
            channel: pixels[..., index]
            for name, pixels in layers.items()
            for index, channel in enumerate(LAYERS[name].channels)
        }
        write_exr(path, channels, self._attributes())

    def _attributes(self) -> dict[str, str]:
        values = {name: str(getattr(self, name)) for name in ("method", "scene", "device", "seed", "spp")}
        if self.identity:
            values["identity"] = self.identity
        values |= {name: json.dumps(getattr(self, name)) for name in ("settings", "timings", "counts", "versions")}
        values["seconds"] = f"{sum(self.timings.values()):.6g}"  # for people; `load` reads the timings
        return {PREFIX + name: text for name, text in values.items()}

    @classmethod
    def load(cls, path: PathLike) -> Render:
        """Reads an EXR file: one of warpgi's as it was saved, one of another tool as far as its layers are known.

        Known are Blender's multi-layer passes (Combined, Denoising Albedo, DiffCol, Normal, Position, Depth), the
        channels of Mitsuba's `aov` integrator where these have usual names (albedo, sh_normal, nn, position, pos,
        depth, dd), those of pbrt's `gbuffer` film, and plain R, G, B and Z. Values stay as they are in the file, in
        the meaning that the tool gives them: Blender's Depth is measured along the viewing direction, not along the
        ray. A picture that is not the sum of its parts comes as the layer "image".

        Args:
            path: the file to read, whatever its suffix.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no EXR file, a damaged one, holds no known layer, or one layer twice.
        """
        channels, attributes = read_exr(path)
        name = os.fspath(path)
        layers = _known_layers(name, channels)
        if not layers:
            raise ValueError(
                f"{name} holds {', '.join(channels) or 'no float channel'}, expected R, G, B or a known layer"
            )
        own = {key[len(PREFIX) :]: text for key, text in attributes.items() if key.startswith(PREFIX)}
        fields: dict[str, Any] = {key: own.get(key, "") for key in ("method", "scene", "device", "identity")}
        for key, kind in [
            ("seed", int),
            ("spp", int),
            *((key, dict) for key in ("settings", "timings", "counts", "versions")),
        ]:
            fields[key] = _parse(name, key, own[key], kind) if key in own else kind()
        try:
            render = cls(layers, **fields)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} cannot be loaded: {error}") from error
        total = render._sum_of_parts()
        if total is not None and "image" in layers and np.array_equal(layers["image"], total, equal_nan=True):
            del render.layers["image"]
        return render


def _known_layers(path: str, channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    groups: dict[str, dict[str, np.ndarray]] = {}
    for channel, pixels in channels.items():
        group, _, letter = channel.rpartition(".")
        groups.setdefault(group, {})[letter.upper()] = pixels
    layers = {}
    for name, layer in LAYERS.items():
        if all(channel in channels for channel in layer.channels):
            layers[name] = _stack(path, name, [channels[channel] for channel in layer.channels])
            continue
        for alias in layer.aliases:
            # Without a layer's name the first spelling is the only one: pbrt has a "v" of another kind.
            spellings = layer.spellings if alias else layer.spellings[:1]
            found = {}
            for group, letters in groups.items():
                spelling = next((s for s in spellings if set(s) <= set(letters)), None)
                if spelling and alias in (group.lower(), group.rpartition(".")[2].lower()):
                    found[group] = [letters[letter] for letter in spelling]
            if len(found) > 1:  # older Blenders add a view layer of what the compositor made
                found = {group: pixels for group, pixels in found.items() if not group.lower().startswith("composite.")}
            if len(found) > 1:
                raise ValueError(f"{path} holds layer {name} as {' and as '.join(found)}, expected one view layer")
            if found:
                layers[name] = _stack(path, name, *found.values())
                break
    return layers


def _stack(path: str, name: str, pixels: list[np.ndarray]) -> np.ndarray:
    if len({channel.shape for channel in pixels}) > 1:
        raise ValueError(f"{path} has channels of different sizes in layer {name}, expected no subsampling")
    return np.stack(pixels, axis=-1)


def _parse(path: str, key: str, text: str, kind: type) -> Any:
    try:
        value = json.loads(text)
    except ValueError:
        value = None
    if type(value) is not kind:
        raise ValueError(
            f"{path} has {PREFIX}{key} = {text[:40]!r}, expected {'JSON' if kind is dict else 'a whole number'}"
        )
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not one of its types")
