"""Rendered sequences: frames that depend on nothing but what they are of, and runs that go on."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

import warpgi as gi
from warpgi.__main__ import main
from warpgi.frame_renderer import frame_seed

SIZE = (12, 8)
PATH = gi.PathTracing(spp=2)


def still(frames):
    box = gi.scenes.cornell_box()
    return gi.Sequence(frames, lambda frame: box, name="still")


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.exr"))}


def animate(out, sequence=None, method=PATH, **settings):
    sequence = sequence or gi.scenes.moving_light(frames=3)
    return gi.render_animation(sequence, method, SIZE, device="cpu", out=out / "f-{:03d}.exr", **settings)


def test_frames_are_those_of_render(tmp_path):
    """In memory or in files, with arrays shared from frame to frame or not, a frame is what `render` makes of it."""
    for sequence in (gi.scenes.moving_light(frames=3), gi.scenes.moving_ball(frames=3, subdivisions=1)):
        memory = gi.render_animation(sequence, PATH, SIZE, seed=5, device="cpu")
        files = animate(tmp_path / sequence.name, sequence, seed=5)
        assert memory.frames == files.frames == memory.rendered == (0, 1, 2)
        for number in range(3):
            expected = gi.render(sequence.scene(number), PATH, SIZE, frame_seed(5, number), "cpu")
            for name, layer in expected.layers.items():
                np.testing.assert_array_equal(memory[number].layers[name], layer)
                np.testing.assert_array_equal(files[number].layers[name], layer)
        assert memory.counts["camera_rays"] == 3 * expected.counts["camera_rays"]
        assert memory.stack().shape == (3, 8, 12, 3)
        assert memory.timings["estimate"] > 0.0


@pytest.mark.parametrize("name", [name for name in gi.METHODS if name != "temporal-light-field"])
def test_a_still_sequence_with_one_seed_has_equal_frames(name):
    """vary_seed False gives bit-equal frames, True frames whose noise differs; for every method."""
    method = gi.METHODS[name]()
    cheap = {"spp": 1, "rays": 4, "photons": 500, "caustic_photons": 500, "paths": 8, "light_samples": 1}
    method = replace(method, **{key: value for key, value in cheap.items() if hasattr(method, key)})
    equal = gi.render_animation(still(2), method, SIZE, device="cpu", vary_seed=False)
    np.testing.assert_array_equal(equal[0].image, equal[1].image)
    varied = gi.render_animation(still(2), method, SIZE, device="cpu")
    assert (varied[0].image != varied[1].image).any()


def test_frame_seeds():
    """Neighbouring seeds and frames share no seed, all fit, and they are what they were."""
    seeds = {frame_seed(seed, frame) for seed in range(20) for frame in range(200)}
    assert len(seeds) == 4000
    assert min(seeds) >= 0 and max(seeds) < 2**31
    assert frame_seed(0, 0) == 2088933833


def test_resume_renders_what_is_missing_and_nothing_else(tmp_path):
    """Whole files of these frames stay untouched; the missing one is rendered; all equal an uninterrupted run."""
    animate(tmp_path / "whole")
    animate(tmp_path / "part", frames=[0, 2])
    kept = (tmp_path / "part" / "f-000.exr").stat().st_mtime_ns
    animation = animate(tmp_path / "part", resume=True)
    assert animation.rendered == (1,)
    assert (tmp_path / "part" / "f-000.exr").stat().st_mtime_ns == kept
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")


def test_truncated_damaged_and_foreign_files_are_rendered_again(tmp_path):
    """A file cut short, one of zeros, one with a flipped byte, a picture from elsewhere, and other settings' frames."""
    sequence = gi.scenes.moving_light(frames=6)
    animate(tmp_path, sequence)
    whole = contents(tmp_path)
    files = [tmp_path / f"f-{number:03d}.exr" for number in range(6)]
    data = files[0].read_bytes()
    files[0].write_bytes(data[: len(data) // 2])
    files[1].write_bytes(bytes(len(data)))
    flipped = bytearray(files[2].read_bytes())
    flipped[-40] ^= 0xFF
    files[2].write_bytes(flipped)
    gi.render(sequence.scene(3), PATH, SIZE, device="cpu").save(files[3])
    gi.render_animation(sequence, gi.PathTracing(spp=1), SIZE, device="cpu", frames=[4], out=tmp_path / "f-{:03d}.exr")
    animation = animate(tmp_path, sequence, resume=True)
    assert animation.rendered == (0, 1, 2, 3, 4)
    assert contents(tmp_path) == whole


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"method": gi.PathTracing(spp=3)},
        {"method": gi.PathTracing(spp=2, sampler=gi.Sampler.INDEPENDENT)},
        {"sequence": gi.scenes.moving_light(frames=3, power=9.0)},
        {"vary_seed": False},
    ],
    ids=["seed", "spp", "sampler", "scene", "vary_seed"],
)
def test_other_settings_make_other_frames(tmp_path, change):
    """A resumed run takes no frame of another seed, method or scene."""
    animate(tmp_path)
    assert animate(tmp_path, resume=True).rendered == ()
    assert animate(tmp_path, resume=True, **change).rendered == (0, 1, 2)


@pytest.mark.parametrize(
    "method", [("path", "--spp", "200"), ("instant-radiosity", "--paths", "64", "--renewed-paths", "2", "--spp", "8")]
)
def test_killed_and_resumed_gives_the_same_files(tmp_path, method):
    """SIGKILL in the middle of a run, then --resume: the files of a run that nobody killed, to the last bit; also where
    lights are kept from frame to frame."""
    arguments = ["animate", "moving-light:frames=5", *method, "--size", "32", "32", "--device", "cpu"]
    command = [sys.executable, "-m", "warpgi", *arguments, "--out", str(tmp_path / "killed" / "f-{:03d}.exr")]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL)
    try:
        while not (tmp_path / "killed" / "f-001.exr").exists():
            assert process.poll() is None
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.wait(timeout=60)
    assert not (tmp_path / "killed" / "f-004.exr").exists(), "the run was over before it could be killed"
    assert main([*arguments, "--out", str(tmp_path / "killed" / "f-{:03d}.exr"), "--resume"]) == 0
    assert main([*arguments, "--out", str(tmp_path / "whole" / "f-{:03d}.exr")]) == 0
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


@dataclass(frozen=True, kw_only=True)
class Counting(gi.PathTracing):
    """Path tracing that notes which state each frame's was made from."""

    def prepare_next(self, job, film, before):
        LOG.append((job.seed, before))
        settings = super().prepare(job, film)
        settings.seed = job.seed + (0 if before is None else before.seed % 1000)
        return settings


LOG: list = []


def test_state_goes_from_frame_to_frame(tmp_path):
    """A method with prepare_next gets the state of the frame before, also where that frame's picture was kept, so that
    a resumed run equals a whole one; and a frame depends on those before it."""
    method = Counting(spp=1)
    LOG.clear()
    animate(tmp_path / "whole", method=method)
    assert [before is None for _, before in LOG] == [True, False, False]
    animate(tmp_path / "part", method=method, frames=[1])
    animate(tmp_path / "part", method=method, resume=True)
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    # frame 0 of another sequence, frames 1 and 2 the same: all are other frames
    own = gi.scenes.moving_light(frames=3)
    dark = gi.scenes.moving_light(frames=3, power=0.5)
    other = gi.Sequence(3, lambda frame: (own if frame else dark).scene(frame))
    assert animate(tmp_path / "part", other, method, resume=True).rendered == (0, 1, 2)
    assert animate(tmp_path / "part", own, PATH).rendered == (0, 1, 2)
    assert animate(tmp_path / "part", other, PATH, resume=True).rendered == (0,)


def test_progress_counts_frames():
    """The caller hears of every frame."""
    heard = []
    gi.render_animation(still(3), PATH, SIZE, device="cpu", progress=heard.append)
    assert [(state.done, state.total, state.unit) for state in heard] == [
        (1, 3, "frames"),
        (2, 3, "frames"),
        (3, 3, "frames"),
    ]


def test_a_bad_frame_leaves_the_good_ones(tmp_path):
    """A frame whose scene may not follow the first is named; files of frames before it are there."""
    box, spheres = gi.scenes.cornell_box(), gi.scenes.cornell_spheres()
    sequence = gi.Sequence(3, lambda frame: spheres if frame == 2 else box)
    with pytest.raises(ValueError, match="frame 2 has shapes"):
        animate(tmp_path, sequence)
    assert list(contents(tmp_path)) == ["f-000.exr", "f-001.exr"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sequence": gi.scenes.cornell_box()}, "sequence is Scene, expected Sequence"),
        ({"out": "f.exr"}, "out is f.exr, expected a path such as"),
        ({"out": "f-{:03d}.png"}, "out is f-{:03d}.png"),
        ({"out": "f-{name}.exr"}, "out is f-{name}.exr"),
        ({"out": 3}, "out is int"),
        ({"resume": True}, "resume is True, expected False"),
        ({"frames": [2]}, "frames is 2"),
        ({"frames": [1, 0]}, "ascending"),
        ({"frames": []}, "at least one"),
        ({"seed": -1}, "seed is -1"),
        ({"size": (0, 1)}, "width is 0"),
        ({"method": 3}, "method is int"),
    ],
)
def test_bad_arguments(arguments, message, tmp_path, monkeypatch):
    """A wrong argument is named before anything is rendered."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, TypeError), match=message.replace("{", r"\{").replace("}", r"\}")):
        gi.render_animation(**({"sequence": still(2), "size": SIZE} | arguments))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["moving-lite"], "did you mean 'moving-light'"),
        (["moving-light:frames"], "expected parameters as in moving-light:frames=20"),
        (["moving-light", "--frames", "3", "3"], "frames is 3 3"),
        (["moving-light", "--frames", "0", "101"], "frames is 100"),
        (["moving-light", "--out", "f.exr"], "out is f.exr"),
    ],
)
def test_mistakes_on_the_command_line(arguments, message, capsys, tmp_path, monkeypatch):
    """Exit status 2 and one sentence."""
    monkeypatch.chdir(tmp_path)
    assert main(["animate", *arguments]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Traceback" not in err


def test_flicker():
    """Independent errors of variance s^2 flicker by s sqrt(2); what the reference shows too, and what stays, does
    not."""
    rng = np.random.default_rng(4)
    references = rng.uniform(size=(20, 16, 16, 3))
    stays = rng.normal(size=(16, 16, 3))
    assert gi.flicker(references + stays, references) == pytest.approx(0.0, abs=1e-12)
    noise = 0.3 * rng.normal(size=references.shape)
    # 15360 squares of one and the same spread: 1 % is more than 2.5 standard errors of their root
    assert gi.flicker(references + noise, references) == pytest.approx(0.3 * np.sqrt(2.0), rel=0.02)
    with pytest.raises(ValueError, match="2 frames or more"):
        gi.flicker(references[:1], references[:1])
