"""What several tests share: the chi-square test of counts against a density."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

# Below so many expected counts a cell is no normal variable; such cells are pooled.
SMALLEST_CELL = 10.0


@pytest.fixture(scope="session")
def chi_square() -> Callable[[np.ndarray, np.ndarray], float]:
    """A function (counts, expected) -> p-value; `expected` holds means and is not scaled to the counts' sum."""

    def p_value(counts: np.ndarray, expected: np.ndarray) -> float:
        counts, expected = np.ravel(counts).astype(float), np.ravel(expected).astype(float)
        order = np.argsort(expected)
        counts, expected = counts[order], expected[order]
        small = int(np.searchsorted(expected, SMALLEST_CELL))
        if small:
            # the small cells together, with as many larger ones as it takes
            while small < len(expected) and expected[:small].sum() < SMALLEST_CELL:
                small += 1
            counts = np.append(counts[:small].sum(), counts[small:])
            expected = np.append(expected[:small].sum(), expected[small:])
        cells = len(counts) if not np.isclose(expected.sum(), counts.sum(), rtol=1e-12) else len(counts) - 1
        return float(stats.chi2.sf((np.square(counts - expected) / expected).sum(), max(cells, 1)))

    return p_value
