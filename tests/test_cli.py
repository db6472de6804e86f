"""The command line does what its help says, and a mistake is one sentence with exit status 2."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from PIL import Image

import warpgi as gi
from warpgi.__main__ import INTERRUPTED, MISUSE, main


def run(*arguments, capsys=None):
    status = main([str(argument) for argument in arguments])
    return status, *(capsys.readouterr() if capsys else ())


def test_render_writes_the_picture_of_the_library(tmp_path, capsys):
    """`warpgi render` writes the EXR and PNG that `gi.render` and `save` give for the same settings."""
    exr, png = tmp_path / "a.exr", tmp_path / "a.png"
    options = ("--spp", 3, "--max-depth", 4, "--sampler", "independent", "--size", 20, 12, "--seed", 7)
    status, out, _ = run(
        "render", "cornell-box", "path", *options, "--device", "cpu", "--out", exr, "--out", png, capsys=capsys
    )
    assert status == 0
    assert "cornell-box, path, 3 spp, 20 x 12 on cpu" in out
    assert f"wrote {exr}" in out
    assert f"wrote {png}" in out
    method = gi.PathTracing(spp=3, max_depth=4, sampler=gi.Sampler.INDEPENDENT)
    expected = gi.render(gi.scenes.cornell_box(), method, size=(20, 12), seed=7, device="cpu")
    loaded = gi.Render.load(exr)
    np.testing.assert_array_equal(loaded.image, expected.image)
    assert loaded.settings == expected.settings
    with Image.open(png) as image:
        assert image.size == (20, 12)


def test_path_tracing_is_the_default_and_scene_parameters_work(tmp_path, capsys):
    """Without a method it is path tracing; name=value after a colon sets a scene's parameter."""
    out = tmp_path / "f.exr"
    status, text, _ = run("render", "furnace:albedo=0.75,shape=sphere", "--size", 4, 4, "--out", out, capsys=capsys)
    assert status == 0
    assert "furnace, path, 64 spp" in text
    assert gi.Render.load(out).image.mean() == pytest.approx(4.0, rel=0.2)


def test_a_render_goes_on_from_its_checkpoint(tmp_path, capsys):
    """--checkpoint keeps what --seconds or a smaller --spp left undone, and the next run ends as one run would."""
    out, half = tmp_path / "a.exr", tmp_path / "half.npz"
    arguments = ["--size", "8", "8", "--device", "cpu", "--out", str(out)]
    method = ["photon-map", "--photons", "1000", "--caustic-photons", "1000", "--map-spp", "2"]
    for spp in ("3", "6"):
        command = ["render", "caustic", *arguments, "--checkpoint", str(half), *method, "--spp", spp]
        assert main(command) == 0
    whole = gi.PhotonMap(photons=1000, caustic_photons=1000, map_spp=2, spp=6)
    expected = gi.render(gi.scenes.build("caustic"), whole, (8, 8), device="cpu")
    np.testing.assert_array_equal(gi.Render.load(out).image, expected.image)
    assert main(["render", "caustic", *arguments, "--checkpoint", str(half), "--seed", "1", *method]) == 2
    assert "is of another render: seed is 0 there, 1 here" in capsys.readouterr().err


def test_a_mesh_file_of_ones_own(tmp_path, capsys):
    """A file is a scene too, by its suffix."""
    mesh = tmp_path / "tetra.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    status, text, _ = run(
        "render", mesh, "path", "--spp", 2, "--size", 8, 8, "--out", tmp_path / "t.png", capsys=capsys
    )
    assert status == 0
    assert "tetra, path" in text


def test_compare(tmp_path, capsys):
    """`warpgi compare` prints the library's four measures, of the whole picture or of one layer."""
    scene = gi.scenes.cornell_box()
    a, b = (gi.render(scene, gi.PathTracing(spp=spp), size=(16, 16)) for spp in (1, 4))
    a.save(tmp_path / "a.exr")
    b.save(tmp_path / "b.exr")
    for layer in ("image", "indirect"):
        status, out, _ = run("compare", tmp_path / "a.exr", tmp_path / "b.exr", "--layer", layer, capsys=capsys)
        assert status == 0
        values = dict(line.split() for line in out.splitlines())
        pair = [x.image if layer == "image" else x.layers[layer] for x in (a, b)]
        for name, value in gi.compare(*pair).items():
            assert float(values[name]) == pytest.approx(value, rel=1e-4)


def test_reconstruct_makes_the_picture_of_the_library(tmp_path, capsys):
    """`warpgi reconstruct` writes what `gi.reconstruct` gives for the same file and settings."""
    path, out = tmp_path / "samples.bin", tmp_path / "a.exr"
    gi.sample(gi.scenes.cornell_box(), spp=2, size=(12, 8)).save(path)
    status, text, _ = run("reconstruct", path, "light-field", "--rays", 16, "--seed", 3, "--out", out, capsys=capsys)
    assert status == 0
    assert "light-field, 2 spp, 12 x 8" in text
    expected = gi.reconstruct(gi.SampleBuffer.load(path), gi.LightField(rays=16), seed=3)
    np.testing.assert_array_equal(gi.Render.load(out).layers["indirect"], expected.layers["indirect"])


def test_lists(capsys):
    """`scenes`, `methods` and `info` name all there is."""
    for command, names in (("scenes", gi.scenes.SCENES), ("methods", gi.METHODS), ("info", gi.versions())):
        status, out, _ = run(command, capsys=capsys)
        assert status == 0
        assert all(name in out for name in names)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "cornel-box"), "did you mean 'cornell-box'"),
        (("render", "furnace:colour=3"), "no parameter 'colour'"),
        (("render", "furnace:albedo"), "expected parameters as in"),
        (("render", "furnace:albedo=2"), "albedo is"),
        (("render", "missing.glb"), "missing.glb"),
        (("render", "cornell-box", "--size", "0", "4"), "width is 0"),
        (("render", "cornell-box", "--size", "4", "-4"), "height is -4"),
        (("render", "cornell-box", "--seed", "-1"), "seed is -1"),
        (("render", "cornell-box", "--device", "cuda:99"), "device is 'cuda:99'"),
        (("render", "cornell-box", "--threads", "0"), "threads is 0"),
        (("render", "cornell-box", "--memory-limit", "0"), "memory-limit is 0"),
        (("render", "cornell-box", "--memory-limit", "nan"), "memory-limit is nan"),
        (("render", "cornell-box", "--out", "x.jpg"), "x.jpg"),
        (("render", "cornell-box", "--out", "missing/x.png"), "missing"),
        (("compare", "missing.exr", "missing.exr"), "missing.exr"),
        (("reconstruct", "missing.bin"), "missing.bin does not exist"),
        (("reconstruct", "missing.bin", "--out", "x.gif"), "x.gif"),
        (("render", "cornell-box", "light-field", "--size", "3000", "3000", "--memory-limit", "0.1"), "memory_limit"),
    ],
)
def test_mistakes_end_with_one_sentence(arguments, message, capsys, tmp_path, monkeypatch):
    """Exit status 2, one line on standard error that names the argument, no traceback, nothing on standard output."""
    monkeypatch.chdir(tmp_path)
    status, out, err = run(*arguments, capsys=capsys)
    assert status == MISUSE
    errors = [line for line in err.splitlines() if not line.startswith("warpgi: warning: no --out")]
    assert len(errors) == 1
    assert errors[0].startswith("warpgi: error: ")
    assert message in errors[0]
    assert out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [(), ("render",), ("rendre",), ("render", "cornell-box", "nope"), ("render", "cornell-box", "path", "--spp", "0")],
)
def test_misused_options_end_with_status_2(arguments, capsys):
    """What the option parser refuses ends with status 2 as well."""
    with pytest.raises(SystemExit) as caught:
        main(list(arguments))
    assert caught.value.code == MISUSE
    assert "Traceback" not in "".join(capsys.readouterr())


def test_unknown_layer_and_truncated_file(tmp_path, capsys):
    """A layer that is not there and a file cut short are named."""
    path = tmp_path / "a.exr"
    gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=1), size=(8, 8)).save(path)
    status, _, err = run("compare", path, path, "--layer", "caustics", capsys=capsys)
    assert status == MISUSE
    assert "layer 'caustics' is not in" in err
    path.write_bytes(path.read_bytes()[:500])
    status, _, err = run("compare", path, path, capsys=capsys)
    assert status == MISUSE
    assert str(path) in err


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo-terminals")
def test_bar_and_ctrl_c(tmp_path):
    """A terminal shows rays per second; Ctrl-C writes what is finished, says how much that is, and ends with 130."""
    import pty

    out = tmp_path / "a.exr"
    command = [
        sys.executable,
        "-m",
        "warpgi",
        "render",
        "cornell-box",
        "path",
        "--spp",
        "10000000",
        "--size",
        "32",
        "32",
    ]
    terminal, side = pty.openpty()
    process = subprocess.Popen(
        [*command, "--device", "cpu", "--out", str(out)], stdout=subprocess.PIPE, stderr=side, text=True, cwd=tmp_path
    )
    os.close(side)
    shown = b""
    while not re.search(rb"[1-9]\d*/10000000 spp", shown):
        shown += os.read(terminal, 4096)
    assert b"M rays/s" in shown
    process.send_signal(signal.SIGINT)
    threading.Thread(target=drain, args=(terminal,), daemon=True).start()
    output, _ = process.communicate(timeout=60.0)
    assert process.returncode == INTERRUPTED
    held = int(re.search(r"the picture holds (\d+) of 10000000 spp", output)[1])
    assert gi.Render.load(out).spp == held > 0


def drain(terminal):
    """Reads a terminal to its end, so that its writer never waits."""
    with contextlib.suppress(OSError):
        while os.read(terminal, 4096):
            pass
    os.close(terminal)
