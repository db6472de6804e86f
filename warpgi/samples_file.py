"""The sample-buffer format of Lehtinen et al.'s program (2011, 2012): header and table of numbers, text or binary."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

from warpgi.image import PathLike, atomic_write

_START = (("image_xy", 2), ("bandwidth", 1), ("lens", 2), ("time", 1), ("radiance", 3), ("origin_motion", 3))
_RAY = (("origin_normal", 3), ("albedo", 3), ("origin", 3), ("hit", 3), ("hit_motion", 3), ("hit_normal", 3))
_V20 = (*_START, *_RAY, ("direct", 3))

#: Version -> its channels in the order of the file, with their number of values.
LAYOUTS: Mapping[float, tuple[tuple[str, int], ...]] = {
    1.2: (
        *(("image_xy", 2), ("lens", 2), ("time", 1), ("radiance", 3), ("depth", 1), ("coc_radius", 1)),
        *(("motion", 2), ("depth_gradient", 2)),
    ),
    1.3: (
        *(("image_xy", 2), ("projected_depth", 1), ("depth", 1), ("lens", 2), ("time", 1), ("radiance", 3)),
        *(("alpha", 1), ("motion", 3), ("depth_gradient", 2)),
    ),
    2.0: _V20,
    2.1: (*_V20, ("exponent", 1)),
    2.2: (*_V20, ("throughput", 3), ("hit_direct", 3)),
}

# The last line of the header: for people only.
_COLUMNS_20 = (
    "x,y,w,u,v,t,r,g,b,pri_mv(3d),pri_normal(3d),albedo(3d),"
    "sec_origin(3d),sec_hitpoint(3d),sec_mv(3d),sec_normal(3d),direct(3d)"
)
COLUMNS = {2.1: f"{_COLUMNS_20},bandwidth", 2.2: f"{_COLUMNS_20},sec_albedo(3d),sec_direct(3d)"}

NUMBER = re.compile(r"[ \t]*[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|inf(inity)?)[ \t]*", re.ASCII | re.IGNORECASE)
LINE_END = re.compile(rb",[ \t]*$", re.MULTILINE)
LONGEST_LINE = 4096  # of a header: a binary file may hold no line end at all
LARGEST = 2**31 - 1
BLOCK_BYTES = 1 << 23  # of text read at a time
BLOCK_SAMPLES = 1 << 14  # written at a time


@dataclass(frozen=True)
class Header:
    """What a header says."""

    version: float
    width: int
    height: int
    spp: int
    """0 in version 2.1, where pixels hold different numbers of samples."""
    count: int
    """Samples in the file."""
    coc: tuple[float, float] = (0.0, 0.0)
    pixel_to_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    text: bool = True
    motion_model: str = "affine"

    @property
    def irregular(self) -> bool:
        """Whether x and y place a sample, not its index."""
        return self.version == 2.1

    @property
    def values(self) -> int:
        """Numbers per sample."""
        return sum(size for _, size in LAYOUTS[self.version])


def name_of(path: PathLike) -> str:
    """A path as it stands in messages."""
    return os.fspath(path)


def read(path: PathLike) -> tuple[Header, dict[str, np.ndarray]]:
    """The header, and every channel of its version as a contiguous float32 array, shape (N,) or (N, size).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the header cannot be read, or the data is not what it announces.
    """
    name = name_of(path)
    with open(path, "rb") as file:
        beside = False
        with suppress(FileNotFoundError), open(name + ".header", "rb") as header_file:
            beside = True
            header, _ = _read_header(name + ".header", header_file)
        line = 0
        if not beside:
            if not file.peek(7).startswith(b"Version"):
                raise ValueError(f"{name} has no header: {name}.header is missing, and line 1 is no Version line")
            header, line = _read_header(name, file)
            if not header.text:
                raise ValueError(f"{name} is binary below its own header, expected the header in {name}.header")
        _check_size(name, file, header)  # before anything of that size is allocated
        blocks = _text_blocks(name, file, header, line) if header.text else _binary_blocks(name, file, header)
        return header, _channels(header, blocks)


def write(path: PathLike, header: Header, channels: Mapping[str, np.ndarray | None]) -> None:
    """Writes data and header; channels that are missing or None are 0.

    Raises:
        OSError: a file cannot be written.
    """
    header_name = name_of(path) + ".header"
    with atomic_write(header_name) as header_temporary:
        header_temporary.write_text(_header_text(header), encoding="ascii", newline="\n")
        with atomic_write(path) as temporary:
            with open(temporary, "wb") as file:
                row = ",".join(["%.9g"] * header.values) + "\n"  # 9 digits tell any two float32 apart
                for block in _blocks(header, channels):
                    if header.text:
                        file.write((row * len(block) % tuple(block.ravel().tolist())).encode("ascii"))
                    else:
                        block.tofile(file)
                file.flush()
                os.fsync(file.fileno())
            # From here on nothing is left to do but to rename: an old header must not describe new data.
            with suppress(FileNotFoundError):
                os.unlink(os.path.realpath(header_name))


def _blocks(header: Header, channels: Mapping[str, np.ndarray | None]) -> Iterator[np.ndarray]:
    for first in range(0, header.count, BLOCK_SAMPLES):
        block = np.zeros((min(BLOCK_SAMPLES, header.count - first), header.values), dtype="<f4")
        start = 0
        for channel, size in LAYOUTS[header.version]:
            values = channels.get(channel)
            if values is not None:
                block[:, start : start + size] = values[first : first + len(block)].reshape(-1, size)
            start += size
        yield block


def _header_text(header: Header) -> str:
    lines = [f"Version {header.version}", f"Width {header.width}", f"Height {header.height}"]
    lines += (
        ["Samples per pixel -1", f"Samples {header.count}"] if header.irregular else [f"Samples per pixel {header.spp}"]
    )
    matrix = ",".join(map(repr, header.pixel_to_camera.ravel().tolist()))
    lines += [
        f"CoC coefficients (coc radius = C0/w+C1): {header.coc[0]!r},{header.coc[1]!r}",
        f"Pixel-to-camera matrix: {matrix}",
        f"Encoding = {'text' if header.text else 'binary'}",
        COLUMNS[header.version],
    ]
    return "\n".join(lines) + "\n"


class _Lines:
    """The lines of a header, one after the other; blank ones are passed over."""

    def __init__(self, name: str, file: BinaryIO) -> None:
        self.name, self.file, self.number = name, file, 0
        self.text = ""
        self._next()

    def _next(self) -> None:
        self.text = ""
        while not self.text:
            raw = self.file.readline(LONGEST_LINE)
            if not raw:
                return
            self.number += 1
            if len(raw) == LONGEST_LINE:
                raise ValueError(f"{self.name} line {self.number} is longer than any line of a header")
            self.text = raw.decode("ascii", errors="replace").strip()

    def starts(self, key: str) -> bool:
        return self.text.startswith(key)

    def take(self, key: str, want: str, parse: Callable[[str], list[float]]) -> list[float]:
        """The numbers after `key` in this line; goes on to the next."""
        numbers = parse(self.text[len(key) :]) if self.starts(key) else []
        if not numbers:
            got = f"line {self.number} is {_short(self.text)}" if self.text else f"ends after line {self.number}"
            raise ValueError(f"{self.name} {got}, expected {key!r} and {want}")
        self._next()
        return numbers

    def count(self, key: str, lower: int = 1) -> int:
        number = self.number
        (value,) = self.take(key, "a whole number", _integer)
        if not lower <= value <= LARGEST:
            raise ValueError(
                f"{self.name} line {number} is {key!r} {int(value)}, expected a whole number from {lower} to {LARGEST}"
            )
        return int(value)

    def numbers(self, key: str, size: int) -> list[float]:
        return self.take(key, f"{size} finite numbers, comma-separated", lambda text: _numbers(text, size))

    def word(self, key: str, words: tuple[str, ...]) -> str:
        found = self.text[len(key) :].strip()
        self.take(key, " or ".join(words), lambda _: [1.0] if found in words else [])
        return found

    def end(self) -> int:
        """Passes over the line that names the columns; returns its number."""
        if not self.text:
            raise ValueError(f"{self.name} ends after line {self.number}, expected a line that names the columns")
        return self.number


def _read_header(name: str, file: BinaryIO) -> tuple[Header, int]:
    """The header, and the number of its last line; the file stands after it."""
    lines = _Lines(name, file)
    versions = ", ".join(map(str, LAYOUTS))
    (version,) = lines.take("Version", f"one of {versions}", lambda text: _numbers(text, 1))
    if version not in LAYOUTS:
        raise ValueError(f"{name} line 1 says version {version:g}, expected one of {versions}")
    width, height = lines.count("Width"), lines.count("Height")
    key = "Samples per pixel"
    spp_line, spp = lines.number, lines.count(key, lower=-1)
    if lines.starts("Samples ") and version == 2.0:
        version = 2.1  # the authors' writer of 2.1 puts "Version 2.0"
    if version == 2.1:
        spp, count = 0, lines.count("Samples")
    elif spp < 1:
        raise ValueError(f"{name} line {spp_line} is {key!r} {spp}, expected a whole number from 1 to {LARGEST}")
    else:
        count = width * height * spp
    known: dict = {"version": version, "width": width, "height": height, "spp": spp, "count": count}
    if version == 1.3:
        known["motion_model"] = lines.word("Motion model:", ("affine", "perspective"))
    if version >= 1.3:
        c0, c1 = lines.numbers("CoC coefficients (coc radius = C0/w+C1):", 2)
        known["coc"] = (c0, c1)
    key = "Pixel-to-camera matrix:"
    if version >= 2.0 or lines.starts(key):
        known["pixel_to_camera"] = np.array(lines.numbers(key, 16)).reshape(4, 4)
    if version >= 1.3:
        known["text"] = lines.word("Encoding =", ("binary", "text")) == "text"
    return Header(**known), lines.end()


def _check_size(name: str, file: BinaryIO, header: Header) -> None:
    size = os.fstat(file.fileno()).st_size - file.tell()
    numbers = header.count * header.values  # Python's integers have no 32 bits to overflow
    if header.text and size < 2 * numbers - 1:  # a digit and a comma each
        raise ValueError(f"{name} holds {size} bytes of text, expected {2 * numbers - 1} or more: {_announced(header)}")
    if not header.text and size != 4 * numbers:
        raise ValueError(
            f"{name} holds {size} bytes, expected {4 * numbers}: {_announced(header)} of {header.values} float32"
        )


def _channels(header: Header, blocks: Iterator[np.ndarray]) -> dict[str, np.ndarray]:
    layout = LAYOUTS[header.version]
    table = {name: np.empty((header.count, size), dtype=np.float32) for name, size in layout}
    row = 0
    for block in blocks:
        start = 0
        for name, size in layout:
            table[name][row : row + len(block)] = block[:, start : start + size]
            start += size
        row += len(block)
    return {name: table[name][:, 0] if size == 1 else table[name] for name, size in layout}


def _binary_blocks(name: str, file: BinaryIO, header: Header) -> Iterator[np.ndarray]:
    for first in range(0, header.count, BLOCK_SAMPLES):
        count = min(BLOCK_SAMPLES, header.count - first)
        block = np.fromfile(file, dtype="<f4", count=count * header.values)
        if block.size != count * header.values:
            raise ValueError(f"{name} became shorter while it was read")
        yield block.reshape(count, header.values)


def _text_blocks(name: str, file: BinaryIO, header: Header, line: int) -> Iterator[np.ndarray]:
    """Parts of a text that starts after line `line`, which together are all the samples."""
    row = 0
    rest = b""
    while row <= header.count:
        block = file.read(BLOCK_BYTES)
        lines, newline, rest = (rest + block).rpartition(b"\n") if block else (rest, b"", b"")
        part = _parse_text(name, lines + newline, header, line)
        row, line = row + len(part), line + lines.count(b"\n") + len(newline)
        if row <= header.count:
            yield part
        if not block:
            break
    if row > header.count:
        raise ValueError(f"{name} holds more samples than its header says: {_announced(header)}")
    if row < header.count:
        raise ValueError(f"{name} ends after {row} samples, expected {header.count}: {_announced(header)}")


def _parse_text(name: str, raw: bytes, header: Header, line: int) -> np.ndarray:
    """The samples in whole lines of text, of which the first comes after line `line`."""
    text = LINE_END.sub(b"", raw.replace(b"\r\n", b"\n")).decode("latin-1")
    if not text.strip():
        return np.empty((0, header.values), dtype=np.float32)
    try:
        part = np.loadtxt(io.StringIO(text), dtype=np.float32, delimiter=",", comments=None, ndmin=2)
        if part.shape[1] != header.values:
            raise ValueError(f"{part.shape[1]} columns")
    except ValueError as error:
        raise ValueError(_text_fault(name, text, header, line) or f"{name} cannot be read: {error}") from error
    return part


def _text_fault(name: str, text: str, header: Header, line: int) -> str:
    for number, row in enumerate(text.split("\n"), line + 1):
        values = row.split(",") if row else []
        bad = next((value for value in values if not NUMBER.fullmatch(value)), None)
        if row and bad is not None:
            return f"{name} line {number} holds {_short(bad)}, expected numbers, comma-separated"
        if row and len(values) != header.values:
            return f"{name} line {number} holds {len(values)} numbers, expected {header.values}"
    return ""


def _announced(header: Header) -> str:
    if header.irregular:
        return f"{header.count} samples"
    return f"{header.width} x {header.height} pixels of {header.spp} samples"


def _integer(text: str) -> list[float]:
    # not through float, which would round
    found = re.fullmatch(r"\s+([+-]?\d{1,30})", text, re.ASCII)
    return [int(found[1])] if found else []


def _numbers(text: str, size: int) -> list[float]:
    parts = text.strip().removesuffix(",").split(",")
    if len(parts) != size or not all(NUMBER.fullmatch(part) for part in parts):
        return []
    values = [float(part) for part in parts]
    return values if all(map(math.isfinite, values)) else []


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
