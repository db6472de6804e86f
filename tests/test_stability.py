"""The table of known failures says what it measured, and whether that is within its bound."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import warpgi as gi

CHECKOUT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bench(monkeypatch):
    """The package, which is part of the checkout alone."""
    monkeypatch.syspath_prepend(str(CHECKOUT))
    import bench.__main__
    import bench.failures.failure
    import bench.failures.light_field
    import bench.failures.path
    import bench.stability

    return bench


def rows(bench, *values):
    """Failures that are known to have such values and bounds."""
    from bench.failures.failure import Failure, Value

    return tuple(
        Failure("path", f"scene {i}", "something wrong", bound, lambda device, value=value: Value(value, 0.25))
        for i, (value, bound) in enumerate(values)
    )


@pytest.mark.parametrize(
    ("value", "bound", "verdict", "status"),
    [(1.0, 1.0, "pass", 0), (1.001, 1.0, "fail", 1), (math.nan, 1.0, "fail", 1), (5.0, None, "open", 0)],
)
def test_a_broken_bound_is_told(bench, monkeypatch, tmp_path, capsys, value, bound, verdict, status):
    """A value beyond its bound fails, as does one that is no number, and the exit status says so; no bound is open."""
    monkeypatch.setattr(bench.stability, "FAILURES", rows(bench, (0.5, 1.0), (value, bound)))
    assert bench.__main__.main(["stability", "--device", "cpu", "--out", str(tmp_path / "new")]) == status
    content = json.loads((tmp_path / "new" / "stability.json").read_text())
    assert [row["verdict"] for row in content["rows"]] == ["pass", verdict]
    assert content["rows"][1]["value"] == (None if math.isnan(value) else value)
    assert {"commit", "versions", "device", "cpu", "date"} <= set(content)
    out = capsys.readouterr().out
    assert "0.5 ± 0.25" in out and "scene 1" in out
    assert ("1 of 2 bounds are broken" in out) == bool(status)


def test_rows_of_some_methods_can_be_measured_alone(bench, tmp_path, capsys):
    """--methods picks rows; an unknown name is one sentence, and status 2."""
    arguments = ["stability", "--device", "cpu", "--out", str(tmp_path), "--methods"]
    assert bench.__main__.main([*arguments, "ambient-occlusion"]) == 0
    content = json.loads((tmp_path / "stability.json").read_text())
    assert {row["method"] for row in content["rows"]} == {"ambient-occlusion"}
    capsys.readouterr()
    assert bench.__main__.main([*arguments, "photons"]) == 2
    assert "methods holds 'photons', expected some of path, light-field" in capsys.readouterr().err


def test_every_row_is_of_a_method_and_once(bench):
    """Rows name methods of the library, have bounds above 0 or none, and no two are alike."""
    table = bench.stability.FAILURES
    assert {row.method for row in table} <= {*gi.METHODS, *gi.methods.SEQUENCE_METHODS}
    assert all(row.bound is None or row.bound > 0.0 for row in table)
    assert len({(row.method, row.scene, row.what) for row in table}) == len(table)


def test_measures_see_what_they_are_for(bench, monkeypatch):
    """Light in the dark room, and caustics that are not found, show in their rows as what they are."""
    light_field, device = bench.failures.light_field, gi.Device("cpu")
    picture = np.ones((36, 48, 3))
    picture[:, 26:] = 0.25
    monkeypatch.setattr(light_field, "indirect", lambda *_: picture)
    assert light_field.leak(device) == (0.25, 0.0)
    monkeypatch.undo()

    path = bench.failures.path
    monkeypatch.setattr(path, "SIZE", (32, 32))
    lost = path.point_light_caustics(device).value
    # the ring brings more light there than the table's surroundings, and of it nothing is found
    assert 0.5 < lost < 1.0
