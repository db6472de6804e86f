"""Statistical acceleration of animations (Meyer, Anderson 2006)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from warpgi import checks
from warpgi.methods.path import PathTracing


@dataclass(frozen=True, kw_only=True)
class StatisticalFilter:
    """Statistical filter (Meyer, Anderson 2006): projects a noisy sequence on its own first principal components.

    The first basis function is the mean picture, so that M = 1 is the mean over time; the others are the principal
    components of what differs from it. Pixels should show the same surface in all frames, as a still camera sees still
    things: what moves through the picture takes many basis functions.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 32
    """Paths per pixel of the noisy frames, where `estimator` is None."""
    estimator: Any = None
    """Settings of the method that makes the noisy frames; None: path tracing with `spp`."""
    epsilon: float = 0.005
    """Part of the variance that may stay unexplained, in [0, 1]; the truncation M is the lowest number of basis
    functions that satisfies this and the next, unless the rest is noise already."""
    epsilon_change: float = 0.001
    """Part of the variance that one basis function more may explain, in [0, 1]."""
    modes: int | None = None
    """M by hand, the mean picture counted; None chooses it."""
    max_modes: int = 48
    """Largest M that is chosen; memory grows with it."""
    per_pixel: bool = True
    """Choose M for every pixel too, never above that of the whole: the least of bias and noise around it."""
    map_radius: float = 6.0
    """Radius over which the per-pixel truncation is smoothed, in distances of neighbouring pixels; 0: not at all."""
    high_spp: int = 0
    """Paths per pixel where a pixel's M is above `modes_low`, which take the place of filtered light; 0: nowhere."""
    modes_low: float = 4.0
    """M up to which a pixel is filtered alone; the paper's M_min."""
    modes_high: float = 7.0
    """M from which on it is `high_spp` alone, above `modes_low`; the paper's M_max."""

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        checks.number("epsilon", self.epsilon, 0.0, 1.0)
        checks.number("epsilon_change", self.epsilon_change, 0.0, 1.0)
        if self.modes is not None:
            checks.count("modes", self.modes)
        checks.count("max_modes", self.max_modes)
        checks.number("map_radius", self.map_radius, 0.0, 1e4)
        checks.count("high_spp", self.high_spp, 0)
        checks.number("modes_low", self.modes_low, 0.0)
        checks.number("modes_high", self.modes_high, self.modes_low, open_lower=True)

    @property
    def noisy(self) -> Any:
        """Settings of the method that makes the noisy frames."""
        return PathTracing(spp=self.spp) if self.estimator is None else self.estimator
