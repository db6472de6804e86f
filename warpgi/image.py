"""Images on disk: float EXR with named channels and tone-mapped PNG; a file is written whole or not at all."""

from __future__ import annotations

import mmap
import os
import secrets
import stat
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from warpgi import checks

PathLike = str | os.PathLike[str]

#: What pictures can be saved as.
SUFFIXES = (".exr", ".png")

# Khronos PBR Neutral (2024): highlights above K_S are compressed, K_D is how fast they lose their colour.
K_S = 0.8
K_D = 0.15

MAGENTA = (255, 0, 255)

# Rows per chunk by the number that names the compression in the file (OpenEXR, "OpenEXR File Layout").
CHUNK_ROWS = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, 10: 256, 11: 32}
TILED, DEEP, MULTI_PART = 0x200, 0x800, 0x1000  # flags of the version field


def check_output(path: PathLike) -> Path:
    """Refuses a picture's path that could not be written, before any time goes into the picture.

    It makes an empty file beside the target and deletes it: only this finds read-only and full disks too.

    Args:
        path: where a picture is to be saved; the suffix is .exr or .png, in any case.

    Returns:
        The same path.

    Raises:
        ValueError: the suffix is another one.
        OSError: the directory is missing or takes no file, or the path is a directory or a device.

    Example:
        >>> check_output("picture.jpg")
        Traceback (most recent call last):
        ValueError: output is picture.jpg, expected a name that ends in .exr or .png
    """
    output_suffix(path)
    _, temporary = _new_temporary(path)
    temporary.unlink()
    return Path(path)


def output_suffix(path: PathLike) -> str:
    """The suffix of a picture's path in lower case.

    Raises:
        ValueError: it is none of `SUFFIXES`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"output is {os.fspath(path)}, expected a name that ends in {' or '.join(SUFFIXES)}")
    return suffix


@contextmanager
def atomic_write(path: PathLike) -> Iterator[Path]:
    """A temporary file to fill, which takes the place of `path` when the block ends well, and goes away when not.

    Whoever opens `path` finds the old file or the whole new one, also after a crash: the bytes are on the disk before
    the name changes. A process that is killed may leave `.warpgi-*.tmp` behind, in the same directory.

    Args:
        path: the file to be; a symbolic link is followed, not replaced.

    Raises:
        OSError: the directory is missing, or the disk refuses.
    """
    target, temporary = _new_temporary(path)
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise
    with suppress(OSError):  # the picture is there; not every system can flush a directory
        directory = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def _new_temporary(path: PathLike) -> tuple[Path, Path]:
    target = Path(os.path.realpath(path))
    try:
        # realpath stops at what it cannot follow, so a file in place of a directory shows up here.
        if not stat.S_ISREG(target.stat().st_mode):
            raise OSError("it is no regular file")
    except FileNotFoundError:
        if not target.parent.is_dir():
            raise FileNotFoundError(f"cannot write {os.fspath(path)}: there is no directory {target.parent}") from None
    except OSError as error:
        raise _cannot_write(path, error) from error
    # The name is short, since the target's own may be as long as the file system allows. mkstemp would give a file
    # that its owner alone may read, whatever the umask says.
    temporary = target.parent / f".warpgi-{secrets.token_hex(8)}.tmp"
    try:
        open(temporary, "xb").close()
    except OSError as error:
        raise _cannot_write(path, error) from error
    return target, temporary


def _cannot_write(path: PathLike, error: OSError) -> OSError:
    return type(error)(f"cannot write {os.fspath(path)}: {error.strerror or error}")


def write_exr(path: PathLike, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str]) -> None:
    """Writes one part of 32-bit float channels, ZIP-compressed, without loss.

    Half floats would be smaller, but positions and depths need more than their 11 bits, variances more than their
    range, and a picture that is loaded again shall be the same to the bit.

    Args:
        path: the file to write.
        channels: EXR channel name -> float32 pixels, shape (H, W), all of one shape.
        attributes: attribute name -> text; what is no Unicode is written as escapes.

    Raises:
        OSError: the file cannot be written, or not whole.
    """
    # The binding reads strided arrays as if they were dense, and writes nonsense without a word.
    pixels = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in channels.items()}
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, text in attributes.items():
        header[name] = text.encode("utf-8", "backslashreplace").decode("utf-8")
    with atomic_write(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except RuntimeError as error:
            # 'Failed to write pixel data to image file "...". No space left on device.': the last part is news.
            raise OSError(str(error).rstrip(".").rpartition(". ")[2]) from error
        try:
            _part_count(temporary)  # a short last write passes the binding unnoticed
        except ValueError as error:
            raise OSError("the disk took only a part of it") from error


def read_exr(path: PathLike) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Reads the channels of an EXR file, whoever wrote it.

    The pixels are those of the data window. Half floats become float32; channels of whole numbers (object ids) are
    left out. In a file of several parts a channel without a layer takes its part's name as one.

    Args:
        path: the file to read.

    Returns:
        Channel name -> float32 pixels, shape (H, W), and attribute name -> text of the first part.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no EXR file, an incomplete or damaged one, or one of deep data.
    """
    name = os.fspath(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"{name} does not exist, expected an EXR file")
    if not os.path.isfile(path):
        raise ValueError(f"{name} is no file, expected an EXR file")
    # The binding meets a cut file with lines on stderr and stdout and an empty result, so look before it does.
    part_count = _part_count(Path(path), name)
    channels: dict[str, np.ndarray] = {}
    try:
        parts = OpenEXR.File(name, separate_channels=True).parts
        for index, part in enumerate(parts):
            for channel, pixels in part.channels.items():
                if pixels.pixels.dtype.kind == "f":
                    layered = f"{part.name()}.{channel}" if index > 0 and "." not in channel else channel
                    channels[layered] = np.asarray(pixels.pixels, dtype=np.float32)
        attributes = {key: value for key, value in parts[0].header.items() if isinstance(value, str)} if parts else {}
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise ValueError(f"{name} is a damaged EXR file: {error}") from error
    if len(parts) != part_count:
        raise ValueError(f"{name} is a damaged EXR file: {len(parts)} of its {part_count} parts can be decoded")
    return channels, attributes


def _part_count(path: Path, name: str = "") -> int:
    """The number of parts of an EXR file, whose pixels are all there as far as the chunks' sizes tell.

    Raises:
        ValueError: the file is none, incomplete, or holds deep data.
    """
    name = name or str(path)
    with open(path, "rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError(f"{name} is no EXR file: its first four bytes are others")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                return _walk_parts(data)
            except (IndexError, struct.error) as error:
                raise ValueError(f"{name} is an incomplete EXR file of {len(data)} bytes") from error
            except ValueError as error:
                raise ValueError(f"{name} is no EXR file that can be read: {error}") from error


def _walk_parts(data: mmap.mmap) -> int:
    # IndexError and struct.error mean that the file ends too early.
    (version,) = struct.unpack_from("<i", data, 4)
    headers = []
    at = 8
    while True:
        header, at = _walk_header(data, at)
        headers.append(header)
        if not version & MULTI_PART:
            break
        if data[at] == 0:
            at += 1
            break
    if version & DEEP or any(header.get(b"type", b"").startswith(b"deep") for header in headers):
        raise ValueError("it holds deep data, expected flat pixels")
    for header in headers:
        tiled = header.get(b"type") == b"tiledimage" if version & MULTI_PART else bool(version & TILED)
        chunk_count = _chunk_count(header, tiled)
        if chunk_count is None:
            continue  # tiles of a single part: left to the library
        # Each chunk opens with its part, its row or its tile, and the size of what follows.
        size_at = (4 if version & MULTI_PART else 0) + (16 if tiled else 4)
        for (offset,) in struct.iter_unpack("<Q", _span(data, at, 8 * chunk_count)):
            (size,) = struct.unpack_from("<i", _span(data, offset + size_at, 4))
            if offset < at or size < 0:
                raise IndexError("a chunk that was never written")
            _span(data, offset + size_at + 4, size, copy=False)
        at += 8 * chunk_count
    return len(headers)


def _walk_header(data: mmap.mmap, at: int) -> tuple[dict[bytes, bytes], int]:
    header = {}
    while data[at] != 0:
        name_end = data.find(b"\0", at)
        type_end = data.find(b"\0", name_end + 1)
        if name_end < 0 or type_end < 0:
            raise IndexError("a header without an end")
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        if size < 0:
            raise ValueError("an attribute has a negative size")
        header[data[at:name_end]] = _span(data, type_end + 5, size)
        at = type_end + 5 + size
    return header, at + 1


def _chunk_count(header: dict[bytes, bytes], tiled: bool) -> int | None:
    if b"chunkCount" in header:
        (count,) = struct.unpack("<i", header[b"chunkCount"])
        return max(count, 0)
    if tiled or b"dataWindow" not in header or b"compression" not in header:
        return None
    _, first, _, last = struct.unpack("<4i", header[b"dataWindow"])
    rows = CHUNK_ROWS.get(header[b"compression"][0])
    return None if rows is None else max(-(-(last - first + 1) // rows), 0)


def _span(data: mmap.mmap, at: int, size: int, copy: bool = True) -> bytes:
    if at + size > len(data):
        raise IndexError("the file ends too early")
    return data[at : at + size] if copy else b""


def encode_srgb(linear: Any) -> np.ndarray:
    """Linear values, clamped to [0, 1], in the sRGB encoding (IEC 61966-2-1): what PSNR and FLIP compare.

    v = 12.92 x up to x = 0.0031308, then 1.055 x^(1/2.4) - 0.055.

    Args:
        linear: any shape; NaN stays NaN.

    Returns:
        Values in [0, 1], float64, of the same shape.

    Example:
        >>> round(float(encode_srgb(0.18)), 4)
        0.4614
    """
    x = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def tone_map(image: Any, exposure: float = 0.0) -> np.ndarray:
    """Radiance to display-linear values in [0, 1]: the identity up to 0.8, then a shoulder that keeps the hue.

    With c = 2^exposure * image and its largest channel p, colours with p <= 0.8 stay as they are, mid-grey among them.
    Above it p becomes p' = 1 - 0.2^2 / (p - 0.6), which meets the identity with slope 1 and tends to 1; the colour is
    scaled by p'/p, and mixed with white p' by 1 - 1 / (0.15 (p - p') + 1), as bright lights look. This is the Khronos
    PBR Neutral tone mapper (2024) without its subtraction of 0.04, which undoes a Fresnel reflection of product
    shots and would darken mid-grey. Each channel grows with exposure.

    Args:
        image: linear radiance, shape (H, W, 3), finite; values below 0 become 0.
        exposure: stops, in [-64, 64]; 1 doubles the light.

    Returns:
        Shape (H, W, 3), float64; still to be sRGB-encoded.

    Example:
        >>> tone_map([[[0.18, 0.5, 0.8]]]).tolist()
        [[[0.18, 0.5, 0.8]]]
    """
    colour = checks.finite_array("image", image, (None, None, 3))
    colour = np.maximum(colour, 0.0) * 2.0 ** checks.number("exposure", exposure, -64.0, 64.0)
    peak = colour.max(axis=2, keepdims=True)
    bright = np.maximum(peak, K_S)  # so that what is not used below divides by no zero
    compressed = 1.0 - (1.0 - K_S) ** 2 / (bright + 1.0 - 2.0 * K_S)
    keep = 1.0 / (K_D * (bright - compressed) + 1.0)
    return np.where(peak <= K_S, colour, colour / bright * compressed * keep + compressed * (1.0 - keep))


def to_srgb8(image: Any, exposure: float = 0.0) -> tuple[np.ndarray, int]:
    """Radiance as 8-bit sRGB, shape (H, W, 3), by `tone_map`, then `encode_srgb`; and how many pixels are magenta.

    Args:
        image: linear radiance, shape (H, W, 3). Pixels with NaN or infinity are painted magenta.
        exposure: stops, in [-64, 64].

    Raises:
        ValueError: the image has another shape.
    """
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 3 or values.shape[2] != 3 or values.size == 0:
        raise ValueError(f"image has shape {values.shape}, expected (H, W, 3) with H, W above 0")
    bad = np.asarray(~np.isfinite(values).all(axis=2))
    mapped = tone_map(np.where(bad[..., None], 0.0, values), exposure)
    pixels = np.floor(255.0 * encode_srgb(mapped) + 0.5).astype(np.uint8)
    pixels[bad] = MAGENTA
    return pixels, int(np.count_nonzero(bad))


def write_png(path: PathLike, image: Any, exposure: float = 0.0) -> int:
    """Writes radiance as an 8-bit sRGB picture: `tone_map`, then `encode_srgb`, rounded.

    Args:
        path: the file to write.
        image: linear radiance, shape (H, W, 3). Pixels with NaN or infinity are painted magenta and warned of.
        exposure: stops, in [-64, 64]; 1 doubles the light.

    Returns:
        The number of magenta pixels.

    Raises:
        ValueError: the image has another shape.
        OSError: the file cannot be written.
    """
    pixels, bad_count = to_srgb8(image, exposure)
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
    if bad_count:
        warnings.warn(
            f"{os.fspath(path)} shows {bad_count} pixels in magenta: they are NaN or infinite",
            RuntimeWarning,
            stacklevel=2,
        )
    return bad_count
