"""Textures made in code: plaster, stone, tiles, brick and wood as linear reflectance that repeats without a seam."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpgi.materials import Texture

RGB = tuple[float, float, float]
SIZE = 256  # texels along each side


def noise(rng: np.random.Generator, exponent: float, stretch: float = 1.0) -> np.ndarray:
    """Periodic noise with the spectrum 1 / frequency^exponent, mean 0, deviation 1, shape (SIZE, SIZE).

    `stretch` above 1 draws it out along x, as the grain of wood.
    """
    fy, fx = np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij")
    frequency = np.hypot(fy, stretch * fx)
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / frequency**exponent, s=(SIZE, SIZE))
    return (field - field.mean()) / field.std()


def _texture(colour: np.ndarray) -> Texture:
    return Texture(np.clip(colour, 0.01, 0.95).astype(np.float32))


def mottled(rng: np.random.Generator, colour: RGB, strength: float, exponent: float = 1.2, stretch: float = 1.0):
    """One colour with cloudy variation: plaster, stone, soil, and wood with `stretch`."""
    value = 1.0 + strength * noise(rng, exponent, stretch) + 0.25 * strength * noise(rng, 0.3)
    return _texture(np.asarray(colour) * value[..., None])


def plaster(rng: np.random.Generator, colour: RGB, worn: RGB) -> Texture:
    """Limewash over an older coat that shows through where it has worn off."""
    shade = 1.0 + 0.09 * noise(rng, 1.3) + 0.03 * noise(rng, 0.2)
    patch = np.clip(2.2 * (noise(rng, 1.6) - 1.35), 0.0, 1.0)[..., None]
    return _texture(((1.0 - patch) * colour + patch * np.asarray(worn)) * shade[..., None])


def tiles(rng: np.random.Generator, colours: Sequence[RGB], joint: RGB, count: int = 4, width: float = 2.5) -> Texture:
    """Square tiles that take turns in colour diagonally, with joints of `width` texels."""
    row, column, distance = _cells(count, count, shift=0.0)
    which = (row + column) % len(colours)
    shade = 1.0 + 0.13 * rng.standard_normal((count, count))[row, column] + 0.08 * noise(rng, 1.0)
    return _joined(np.asarray(colours)[which] * shade[..., None], joint, distance, width)


def bricks(rng: np.random.Generator, colour: RGB, joint: RGB, rows: int = 8, columns: int = 4) -> Texture:
    """Bricks in running bond."""
    row, column, distance = _cells(rows, columns, shift=0.5)
    tint = rng.standard_normal((rows, columns, 1))[row, column] * [0.16, 0.20, 0.22]
    grain = 0.12 * noise(rng, 0.8)[..., None]
    return _joined(np.asarray(colour) * (1.0 + tint + grain), joint, distance, 3.0)


def palette(rng: np.random.Generator, colours: Sequence[RGB], spread: float) -> Texture:
    """16 x 16 texels of given colours, each with its own shade: one uv per leaf or roof tile picks one."""
    pick = np.asarray(colours)[rng.integers(0, len(colours), (16, 16))]
    return _texture(pick * (1.0 + spread * rng.standard_normal((16, 16, 1))))


def texel(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random uv at centres of a palette's texels, shape (count, 2)."""
    return (rng.integers(0, 16, (count, 2)) + 0.5) / 16.0


def _cells(rows: int, columns: int, shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and distance to the nearest edge [texels] for every texel; odd rows are shifted by part of a cell."""
    y, x = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5, indexing="ij")
    v = y * rows / SIZE
    row = v.astype(int)
    u = (x * columns / SIZE + shift * (row % 2)) % columns
    column = u.astype(int)
    across = np.minimum(u % 1.0, 1.0 - u % 1.0) * SIZE / columns
    return row, column, np.minimum(across, np.minimum(v % 1.0, 1.0 - v % 1.0) * SIZE / rows)


def _joined(colour: np.ndarray, joint: RGB, distance: np.ndarray, width: float) -> Texture:
    inner = np.clip(distance - 0.5 * width + 0.5, 0.0, 1.0)[..., None]
    return _texture(inner * colour + (1.0 - inner) * np.asarray(joint))
