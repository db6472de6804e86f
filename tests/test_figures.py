"""Figures of the paper, each from one command: what is written, that its numbers are of its panels, and mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpgi as gi

CHECKOUT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """The package, which is part of the checkout alone; references are kept elsewhere."""
    monkeypatch.syspath_prepend(str(CHECKOUT))
    import bench.__main__
    import bench.figures
    import bench.panels
    import bench.reference

    monkeypatch.setattr(bench.reference.make_reference, "__defaults__", (None, None, lambda *_: None, tmp_path))
    return bench


def test_every_figure_of_results_is_there(bench):
    """Figures 1, 4 and 7 to 13 of the paper; each says what it shows."""
    assert set(bench.figures.FIGURES) == {"1", "4", *map(str, range(7, 14)), "mitsuba"}
    assert all(figure.shows for figure in bench.figures.FIGURES.values())


@pytest.mark.parametrize("name", ["1", "4", "9", "11", "12", "13"])
def test_numbers_are_those_of_the_panels(bench, tmp_path, name):
    """JSON, picture and panels belong together: errors are `gi.compare` of each panel and the reference.

    The picture shows all panels in a row, and the differences below; what is done is not done again.
    """
    budget = bench.panels.Budget((20, 12), 8, 16, "cpu")
    panels = bench.figures.make(name, tmp_path, budget)
    assert list(panels)[-1] == "reference" and len(panels) >= 3
    about = json.loads((tmp_path / f"{name}.json").read_text())
    assert about["panels"] == list(panels) and list(about["errors"]) == list(panels)[:-1]
    assert about["identity"]["size"] == [20, 12] and {"commit", "versions", "device"} <= set(about)
    for panel, errors in about["errors"].items():
        assert panels[panel].shape == (12, 20, 3)
        expected = gi.compare(panels[panel], panels["reference"])
        assert {kind: errors[kind] for kind in expected} == pytest.approx(expected)
        assert errors["energy"] == pytest.approx(
            panels[panel].mean(dtype=float) / panels["reference"].mean(dtype=float)
        )
    left, top, right, bottom = bench.figures.FIGURES[name].crop or (0, 0, 1, 1)
    width, height = round(right * 20) - int(left * 20), round(bottom * 12) - int(top * 12)
    with Image.open(tmp_path / f"{name}.png") as picture:
        assert picture.size == (len(panels) * (width + 4) - 4, 2 * height + 4)
    stamp = (tmp_path / f"{name}.json").stat().st_mtime_ns
    again = bench.figures.make(name, tmp_path, budget)
    assert (tmp_path / f"{name}.json").stat().st_mtime_ns == stamp
    for panel, picture in panels.items():
        np.testing.assert_array_equal(again[panel], picture)


def test_lower_row_is_twice_the_difference(bench):
    """Differences stand below their panels, black below the reference."""
    panels = {"a": np.full((2, 3, 3), 0.25, np.float32), "reference": np.full((2, 3, 3), 0.375, np.float32)}
    picture = bench.figures.composed(bench.figures.FIGURES["1"], panels)
    assert picture.shape == (2 * 2 + 4, 2 * 3 + 4, 3)
    assert (picture[-2:, :3] == 0.25).all() and (picture[-2:, -3:] == 0.0).all()
    assert (picture[:2, :3] == 0.25).all() and (picture[:2, -3:] == 0.375).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--figure", "3"), "figure holds '3'"),
        (("--figure", "1", "4", "--picture", "a.png"), "picture is one file for 2 figures"),
        (("--figure", "1", "--size", "0", "8"), "width is 0"),
    ],
)
def test_mistakes_are_one_sentence(bench, capsys, tmp_path, arguments, words):
    """An unknown figure and the like end with status 2."""
    assert bench.__main__.main(["figures", "--out", str(tmp_path / "f"), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
