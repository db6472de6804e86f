"""Principal components of a sequence of pictures: how many there are, and what they look like."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from enum import Enum

import numpy as np

from warpgi.image import PathLike, atomic_write

# Rounding of the frames' products, in parts of the largest: eigenvalues below are nothing.
GRAM_ROUNDING = 1e-6

# Share of the frames whose noise is at most what the floor allows; the rest may hold a flash of light.
QUIET_SHARE = 0.9


class Rule(Enum):
    """What stopped the choice of M."""

    EPSILON = "epsilon"
    """The paper's two rules: little variance is left, and one more basis function would explain little."""
    NOISE_FLOOR = "noise floor"
    """No further eigenvalue is above what noise alone makes."""
    BY_HAND = "by hand"
    """The setting `modes`."""
    LIMIT = "limit"
    """The setting `max_modes`, or the number of frames."""


@dataclass(eq=False)
class Modes:
    """Basis functions of a sequence and how they were chosen."""

    eigenvalues: np.ndarray
    """Squared length of the sequence along each basis function, shape (N,): of the mean picture, then falling."""
    weights: np.ndarray
    """Part w of each kept basis function in each frame, shape (N, K); columns have length 1."""
    basis: np.ndarray
    """Basis functions, shape (K, H, W, 3), float32, the first in proportion to the mean picture; frame t is the sum of
    weights[t, k] basis[k]."""
    count: int
    """M, the number of basis functions that the whole sequence takes, the mean picture among them."""
    rule: Rule
    """What stopped the choice of M."""
    noise_edge: float
    """Largest eigenvalue that noise alone is expected to make."""
    truncation: np.ndarray
    """M of every pixel, shape (H, W), float32, at most `count`."""
    average_spp: float | None = None
    """Paths per pixel and frame, those of importance sampling included; None: not known."""

    @property
    def percent_var(self) -> np.ndarray:
        """Part of the variance that the first 0, 1, ... N basis functions leave unexplained, shape (N + 1,)."""
        return percent_var(self.eigenvalues)

    def save(self, path: PathLike) -> None:
        """Writes it as .npz.

        Raises:
            OSError: the file cannot be written.
        """
        fields = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        fields |= {"count": np.array(self.count), "rule": np.array(self.rule.value)}
        fields |= {"noise_edge": np.array(self.noise_edge)}
        if self.average_spp is not None:
            fields["average_spp"] = np.array(self.average_spp)
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **fields)

    @classmethod
    def load(cls, path: PathLike) -> Modes:
        """Reads what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is another file or a damaged one.
        """
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
                fields = {name: data[name] for name in data.files}
            average = fields.pop("average_spp", None)
            return cls(
                count=int(fields.pop("count")),
                rule=Rule(str(fields.pop("rule"))),
                noise_edge=float(fields.pop("noise_edge")),
                average_spp=None if average is None else float(average),
                **fields,
            )
        except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{os.fspath(path)} holds no basis functions, expected a file of Modes.save") from error


def percent_var(eigenvalues: np.ndarray) -> np.ndarray:
    """Part of the variance that the first 0, 1, ... N modes leave unexplained (MA06, sec. 2.3), shape (N + 1,)."""
    kept = np.concatenate([[0.0], np.cumsum(np.maximum(eigenvalues, 0.0))])
    return 1.0 - kept / max(kept[-1], 1e-300)


def by_epsilon(eigenvalues: np.ndarray, epsilon: float, epsilon_change: float) -> int | None:
    """The lowest x >= 1 with percentVar(x) <= epsilon and percentVar(x) - percentVar(x + 1) <= epsilon_change."""
    left = percent_var(eigenvalues)
    change = np.append(left[:-1] - left[1:], 0.0)
    fits = (left <= epsilon) & (change <= epsilon_change)
    fits[0] = False
    # rounding, where nothing is left
    return int(np.argmax(fits)) if fits.any() else None


def principal_components(gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared lengths, shape (N,), of a sequence along an orthonormal basis of time, in columns, shape (N, N).

    The first basis function is the mean picture, the same in all frames, and the others are the principal components
    of what differs from it, largest first. In the paper's plain expansion the first one is near the mean picture too;
    where it is the mean, whatever is still comes out at its mean over time with one basis function.

    Args:
        gram: D^T D, shape (N, N).
    """
    count = len(gram)
    mean = np.full((count, 1), 1.0 / np.sqrt(count))
    values, vectors = np.linalg.eigh(_centred(gram))
    # one eigenvector of the centred matrix is the mean's, with eigenvalue 0; rounding may mix it with others like it
    rest = vectors[:, ::-1] - mean @ (mean.T @ vectors[:, ::-1])
    lengths = np.linalg.norm(rest, axis=0)
    keep = np.sort(np.argsort(-lengths, kind="stable")[: count - 1])
    rest = rest[:, keep] / lengths[keep]
    # a decomposition leaves signs open: the first frame's larger half decides
    rest = rest * np.where(np.sum(rest**3, axis=0) < 0.0, -1.0, 1.0)
    first = float(gram.sum()) / count
    return np.concatenate([[first], np.maximum(values[::-1][keep], 0.0)]), np.concatenate([mean, rest], axis=1)


def _centred(gram: np.ndarray) -> np.ndarray:
    """D^T D without the mean over columns."""
    rows = gram.mean(axis=0)
    return gram - rows[:, None] - rows[None, :] + rows.mean()


def noise_edges(gram: np.ndarray, eigenvalues: np.ndarray, vectors: np.ndarray, effective: float) -> np.ndarray:
    """The largest eigenvalue that noise would make if the first x modes were all the signal, shape (N,), x below N.

    What x modes leave of a frame is its noise, s at most in any frame; N columns of P independent values of variance
    s / P give eigenvalues up to s (1 + sqrt(N / P))^2 (Marchenko, Pastur 1967). Where rows differ in variance the
    effective P = (sum of variances)^2 / (sum of their squares) takes its place. As noise goes with light, s is also
    bounded by its usual share of a frame's light, so that a flash in few frames is no noise.

    Args:
        gram: D^T D, shape (N, N).
        eigenvalues, vectors: its `principal_components`.
        effective: number of independent rows; infinite gives the lower bound s.
    """
    count = len(eigenvalues)
    length = np.maximum(np.diag(gram), 1e-300)
    explained = np.cumsum(np.square(vectors[:, 1:]) * eigenvalues[1:], axis=1)
    left = np.concatenate(
        [length[:, None], np.diag(_centred(gram))[:, None], np.empty((count, max(count - 2, 0)))], axis=1
    )
    left = left[:, :count]
    left[:, 2:] = left[:, 1:2] - explained[:, : count - 2]
    left = np.maximum(left, 0.0) * count / (count - np.arange(count))
    usual = np.quantile(left / length[:, None], QUIET_SHARE, axis=0) * length.max()
    noise = np.minimum(left.max(axis=0), usual)
    return noise * (1.0 + np.sqrt(count / effective)) ** 2 + GRAM_ROUNDING * length.max()


def by_noise(gram: np.ndarray, eigenvalues: np.ndarray, vectors: np.ndarray, effective: float) -> tuple[int, float]:
    """The lowest x >= 1 so that the next eigenvalue is at most what noise makes, and that bound."""
    edges = noise_edges(gram, eigenvalues, vectors, effective)
    fits = eigenvalues <= edges
    fits[0] = False
    count = int(np.argmax(fits)) if fits.any() else len(eigenvalues)
    return count, float(edges[min(count, len(edges) - 1)])
