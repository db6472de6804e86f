"""Records of an irradiance cache: what each knows, and how they are kept on disk."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from warpgi.image import PathLike, atomic_write
from warpgi.irradiance import Irradiance

#: Shape of a record's part in each array.
SHAPES: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "normal": (3,),
    "radius": (),
    "irradiance": (3,),
    "rotation": (3, 3),
    "translation": (3, 3),
}


@dataclass(frozen=True, eq=False)
class Records:
    """N records; all float32."""

    position: np.ndarray
    """Shape (N, 3)."""
    normal: np.ndarray
    """Unit vectors, shape (N, 3)."""
    radius: np.ndarray
    """R: how far from it a record's error is 1 [scene units], shape (N,)."""
    irradiance: np.ndarray
    """Of indirect light [W/m^2], shape (N, 3)."""
    rotation: np.ndarray
    """Derivative by turns of the normal for each channel, shape (N, 3 channels, 3)."""
    translation: np.ndarray
    """Derivative by position for each channel, shape (N, 3 channels, 3)."""

    def __len__(self) -> int:
        return len(self.radius)

    @classmethod
    def empty(cls) -> Records:
        """None."""
        return cls(**{name: np.zeros((0, *shape), np.float32) for name, shape in SHAPES.items()})

    @classmethod
    def joined(cls, parts: Sequence[Records]) -> Records:
        """All of several."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in SHAPES})

    @classmethod
    def made(
        cls,
        position: np.ndarray,
        normal: np.ndarray,
        known: Irradiance,
        smallest: np.ndarray,
        largest: np.ndarray,
        gradients: bool = True,
    ) -> Records:
        """Records at points where irradiance is known, their radii by distances and gradients.

        The radius is the harmonic mean distance of what surrounds the point (Ward et al. 1988), and no larger than
        where the gradient alone would change all of the value; then it is put between `smallest` and `largest`
        (Tabellion, Lamorlette 2004), shape (N,) each, and gradients are made smaller where they would do so within it.
        """
        mean = known.value.mean(axis=1)
        slope = np.linalg.norm(known.translation.mean(axis=1), axis=1)
        reach = np.divide(mean, slope, out=np.full_like(mean, np.inf), where=slope > 0.0)
        radius = np.clip(np.minimum(known.harmonic, reach), smallest, np.maximum(largest, smallest))
        share = np.divide(reach, radius, out=np.ones_like(reach), where=radius > 0.0)
        scale = np.minimum(share, np.float32(1.0))[:, None, None] * np.float32(gradients)
        rotation = known.rotation * np.float32(gradients)
        arrays = (position, normal, radius, known.value, rotation, known.translation * scale)
        return cls(*(np.ascontiguousarray(array, dtype=np.float32) for array in arrays))

    def packed(self) -> np.ndarray:
        """All but position and normal as the kernels take them, shape (N, 24)."""
        count = len(self)
        rows = np.zeros((count, 24), np.float32)
        rows[:, 0], rows[:, 1:4] = self.radius, self.irradiance
        rows[:, 4:13], rows[:, 13:22] = self.rotation.reshape(count, 9), self.translation.reshape(count, 9)
        return rows

    def moved(self, offset: np.ndarray) -> Records:
        """The same with `offset` added to positions."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        return Records(**arrays | {"position": (self.position + offset).astype(np.float32)})

    def save(self, path: PathLike) -> None:
        """Writes an .npz file: whole under its name, or not at all.

        Raises:
            OSError: it cannot be written.
        """
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **{name: getattr(self, name) for name in SHAPES})  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: PathLike) -> Records:
        """Reads what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it holds something else.
        """
        wrong = ValueError(f"records is {path}, expected a file of records that an irradiance cache wrote")
        try:
            # numpy leaves a file of its own open where it finds no archive
            with open(path, "rb") as data, np.load(data) as file:
                arrays = {name: file[name] for name in SHAPES}
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            raise wrong from None
        count = len(arrays["radius"])
        for name, shape in SHAPES.items():
            array = arrays[name]
            if array.dtype != np.float32 or array.shape != (count, *shape) or not np.isfinite(array).all():
                raise wrong
        return cls(**arrays)
