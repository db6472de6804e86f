"""The bench measures what it says, and another renderer sees the same picture."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import warpgi as gi
from warpgi.device_scene import DeviceScene
from warpgi.scenes import build

CHECKOUT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bench(monkeypatch):
    """The package, which is part of the checkout alone."""
    monkeypatch.syspath_prepend(str(CHECKOUT))
    import bench.__main__
    import bench.mitsuba_peer
    import bench.rays
    import bench.reconstruction

    return bench


def test_rays_prints_a_table_and_writes_json(tmp_path):
    """One command measures every kind of ray, and says with what."""
    out = tmp_path / "out.json"
    arguments = ["--device", "cpu", "--scenes", "cornell-box", "--size", "32", "32", "--repeats", "1", "--json", out]
    command = [sys.executable, "-m", "bench", "rays", *arguments]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    content = json.loads(out.read_text())
    rows = {row["what"]: row for row in content["rows"]}
    for name in rows:
        assert name in done.stdout
    kinds = ("closest hit, camera rays", "closest hit, secondary rays", "shadow rays", "path tracing, depth 6")
    stages = ("reconstruction", "build", "knn", "shrink", "preprocessing", "sample, host", "sample, device")
    assert set(kinds) | set(stages) <= set(rows)
    for row in content["rows"]:
        assert row["low"] <= row["value"] <= row["high"]
        assert row["value"] > 0.0
    for name in kinds[:2]:
        assert rows[name]["versus"] == "wp.mesh_query_ray"
        assert rows[name]["ratio"] > 0.0
    for name in ("VPL connections", "VPL connections, all seen"):
        assert rows[name]["unit"] == "connections/s"
    assert rows["VPL connections"]["versus"] == "VPL connections, all seen"
    assert rows["sample, host"]["value"] == 72
    for name, authors in content["settings"]["authors"].items():
        per_yardstick = rows[name]["value"] / rows["scipy cKDTree"]["value"]
        assert rows[name]["ratio"] == pytest.approx(per_yardstick)
        assert rows[f"{name}, times the authors'"]["value"] == pytest.approx(per_yardstick / authors["of_yardstick"])
    assert content["device"] == "cpu"
    assert content["settings"]["size"] == [32, 32]
    assert {"warpgi", "warp", "numpy"} <= set(content["versions"])
    assert {"commit", "dirty", "date", "cpu", "threads"} <= set(content)
    assert list(tmp_path.iterdir()) == [out]


def test_rays_takes_a_sample_buffer(bench, capsys, monkeypatch, tmp_path):
    """`--samples` measures reconstruction on a buffer of whatever origin; its rows bear the file's name."""
    monkeypatch.setattr(bench.rays, "compile_rows", lambda device: [])
    gi.sample(build("cornell-box"), 2, (8, 8), device="cpu").save(tmp_path / "box.bin")
    arguments = ["--device", "cpu", "--repeats", "1", "--samples", str(tmp_path / "box.bin"), "--scenes"]
    assert bench.__main__.main(["rays", *arguments]) == 0
    out = capsys.readouterr().out
    assert "box.bin" in out
    assert "of 128 samples" in out


def test_without_scipy_there_is_no_yardstick(bench, monkeypatch):
    """Rates are measured all the same, and a note says what is missing."""
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    device = gi.Device("cpu")
    assert bench.reconstruction.yardstick(device) is None
    samples = gi.sample(build("cornell-box"), 1, (8, 8), device=device)
    rows = {row.what: row for row in bench.reconstruction.stage_rows("box", samples, device, 1, None)}
    assert "scipy is not installed" in rows["reconstruction"].note
    assert rows["reconstruction"].ratio is None


def test_scaling_compares_rays_samples_and_scenes(bench, tmp_path, capsys):
    """Every case but the first of its kind has a ratio to that one."""
    out = tmp_path / "out.json"
    arguments = ["--device", "cpu", "--size", "16", "16", "--rays", "8", "16", "--spp", "1", "2", "--repeats", "1"]
    assert bench.__main__.main(["scaling", *arguments, "--json", str(out)]) == 0
    capsys.readouterr()
    content = json.loads(out.read_text())
    versus = {(row["scene"], row["what"]): row["versus"] for row in content["rows"]}
    assert versus["cornell-box", "16 rays, 2 spp"] == "8 rays"
    assert versus["cornell-box", "2 spp, 16 rays"] == "1 spp"
    assert versus["courtyard", "16 rays, 2 spp"] == "cornell-box"
    assert versus["cornell-box", "8 rays, 2 spp"] is None
    for row in content["rows"]:
        assert row["value"] > 0.0
        assert (row["ratio"] is None) == (row["versus"] is None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--size 0 0", "width is 0"),
        ("--reference-spp 0", "reference_spp is 0"),
        ("--out a.txt", "a.txt"),
    ],
)
def test_the_picture_of_caches_refuses_mistakes(bench, capsys, arguments, words):
    """Before anything is rendered, in one sentence."""
    given = arguments if "--out" in arguments else f"{arguments} --out a.png"
    assert bench.__main__.main(["cache", *given.split()]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--device abacus", "device is 'abacus'"),
        ("--scenes cornell-bax", "did you mean 'cornell-box'"),
        ("--size 0 32", "width is 0"),
        ("--threads 0", "threads is 0"),
        ("--samples nowhere.bin", "nowhere.bin"),
        ("--json nowhere/out.json", "nowhere"),
    ],
)
def test_a_mistake_is_one_sentence(bench, capsys, arguments, words):
    """A caller's mistake ends with status 2 before anything is measured."""
    assert bench.__main__.main(["rays", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_missing_peer_is_one_sentence(bench, capsys, monkeypatch):
    """Without Mitsuba the bench says how to get it."""
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert bench.__main__.main(["rays", "--device", "cpu", "--scenes", "cornell-box", "--peers"]) == 2
    assert "pip install warpgi[peers]" in capsys.readouterr().err


def test_cornell_box_agrees_with_mitsuba(bench):
    """Mitsuba 3 and ours see the same mean radiance in every block of 8 x 8 pixels, and in the whole picture."""
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install warpgi[peers]")
    size, count = (64, 64), 64
    scene, device = build("cornell-box"), gi.Device("cpu")
    on_device = DeviceScene(scene, device)
    method = gi.PathTracing(spp=1, max_depth=6, roulette_depth=None, sampler=gi.Sampler.INDEPENDENT)
    peer = bench.mitsuba_peer.MitsubaPeer(scene, size, method.max_depth, device.threads)
    # pictures of one sample per pixel are independent of each other, so their scatter is the variance
    ours = [bench.rays.render_picture(on_device, method, size, seed)[0] for seed in range(count)]
    theirs = [peer.render(1, seed) for seed in range(count)]

    means = [np.mean(pictures, axis=(1, 2), dtype=np.float64) for pictures in (ours, theirs)]
    assert stats.ttest_ind(*means, equal_var=False).pvalue.min() > 0.01 / 3
    blocks = [np.reshape(pictures, (count, 8, 8, 8, 8, 3)).mean(axis=(2, 4)) for pictures in (ours, theirs)]
    lit = (blocks[0] + blocks[1]).max(axis=0) > 0.0
    p = stats.ttest_ind(blocks[0][:, lit], blocks[1][:, lit], equal_var=False).pvalue
    assert p.min() > 0.01 / p.size
