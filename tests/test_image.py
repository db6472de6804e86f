"""Images on disk: lossless, whole or absent, and shown by the stated formula."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from warpgi.image import atomic_write, check_output, encode_srgb, read_exr, tone_map, write_exr, write_png


def noise(height: int = 24, width: int = 17, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width), dtype=np.float32)


def bits(pixels: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(pixels).view(np.uint32)


# EXR


def test_every_bit_comes_back(tmp_path):
    """A channel keeps each of its 32 bits: infinities, signed zero, denormals, both kinds of NaN with their payload."""
    pixels = noise()
    special = [0x7F800000, 0xFF800000, 0x80000000, 0x00000001, 0x7FC12345, 0xFFC00000, 0x7F812345, 0x7F7FFFFF]
    pixels.view(np.uint32)[0, : len(special)] = special
    write_exr(tmp_path / "a.exr", {"depth.Z": pixels}, {})
    channels, _ = read_exr(tmp_path / "a.exr")
    assert channels["depth.Z"].dtype == np.float32
    assert np.array_equal(bits(channels["depth.Z"]), bits(pixels))


def test_strided_channels_are_written_as_they_look(tmp_path):
    """Slices of an (H, W, C) array arrive as seen from Python; OpenEXR itself would read them as dense."""
    image = np.random.default_rng(1).random((9, 11, 3), dtype=np.float32)
    write_exr(tmp_path / "a.exr", {name: image[..., i] for i, name in enumerate("RGB")}, {})
    channels, _ = read_exr(tmp_path / "a.exr")
    assert all(np.array_equal(channels[name], image[..., i]) for i, name in enumerate("RGB"))


def test_attributes_come_back_as_text(tmp_path):
    """Empty, long and non-ASCII text survives; bytes that are no Unicode, as in file names, become escapes."""
    attributes = {"warpgi:a": "", "warpgi:b": "x" * 9000, "warpgi:c": "Küche 漢字", "warpgi:d": "\udcff.glb"}
    write_exr(tmp_path / "a.exr", {"R": noise()}, attributes)
    _, found = read_exr(tmp_path / "a.exr")
    own = {name: text for name, text in found.items() if name in attributes}  # OpenEXR 3.3 adds a part name
    assert own == attributes | {"warpgi:d": "\\udcff.glb"}


def test_half_floats_and_data_windows_are_read(tmp_path):
    """Half floats of other tools become float32 exactly; the pixels are those of the data window; ids are left out."""
    half = noise().astype(np.float16)
    header = {"dataWindow": ((2, 3), (18, 26)), "displayWindow": ((0, 0), (99, 99))}
    OpenEXR.File(header, {"R": half, "id": np.ones(half.shape, np.uint32)}).write(str(tmp_path / "a.exr"))
    channels, _ = read_exr(tmp_path / "a.exr")
    assert list(channels) == ["R"]
    assert np.array_equal(channels["R"], half.astype(np.float32))


def test_parts_give_their_names_to_bare_channels(tmp_path):
    """In a multi-part file the channels R of part "albedo" is albedo.R."""
    parts = [OpenEXR.Part({"name": "rgb"}, {"R": noise()}), OpenEXR.Part({"name": "albedo"}, {"R": noise(seed=1)})]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    channels, _ = read_exr(tmp_path / "a.exr")
    assert np.array_equal(channels["R"], noise())
    assert np.array_equal(channels["albedo.R"], noise(seed=1))


COMPRESSIONS = ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"]


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("part_count", [1, 2])
def test_whole_files_of_any_kind_pass_the_check(tmp_path, compression, tiled, part_count):
    """A complete file is read whatever its compression, in rows, tiles or parts; without its last byte it is not."""
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    if tiled:
        tiles = OpenEXR.TileDescription()
        tiles.xSize = tiles.ySize = 16
        header |= {"type": OpenEXR.tiledimage, "tiles": tiles}
    path = tmp_path / "a.exr"
    pixels = noise(70, 40)
    parts = [OpenEXR.Part(header | {"name": name}, {f"{name}.R": pixels}) for name in "ab"[:part_count]]
    OpenEXR.File(parts).write(str(path))
    for channel in read_exr(path)[0].values():
        np.testing.assert_allclose(channel, pixels, atol=0.1)  # some compressions lose

    path.write_bytes(path.read_bytes()[:-1])
    # How many tiles a single part has is left to OpenEXR, which calls the file damaged.
    state = "damaged" if tiled and part_count == 1 else "incomplete"
    with pytest.raises(ValueError, match=rf"a\.exr is an? {state} EXR file"):
        read_exr(path)


@pytest.mark.parametrize("part_count", [1, 2])
def test_a_cut_file_is_a_value_error_wherever_it_ends(tmp_path, capfd, part_count):
    """Each proper prefix of a file raises ValueError with its name, and nothing else is printed."""
    whole, cut = tmp_path / "whole.exr", tmp_path / "cut.exr"
    parts = [OpenEXR.Part({"name": name}, {f"{name}.R": noise(20, 8)}) for name in "ab"[:part_count]]
    OpenEXR.File(parts).write(str(whole))
    data = whole.read_bytes()
    for length in range(len(data)):
        cut.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"cut\.exr is (no|an incomplete) EXR file"):
            read_exr(cut)
    assert capfd.readouterr() == ("", "")


def test_a_file_that_was_never_finished_is_refused(tmp_path, capfd):
    """A table of chunks that still holds its zeros, as a killed writer leaves it, is a ValueError."""
    path = tmp_path / "a.exr"
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION}, {"R": noise(20, 8)}).write(str(path))
    data = bytearray(path.read_bytes())
    table = len(data) - 20 * (8 + 4 + 4 + 8 * 4)  # per row an entry, then its number, its size and 8 floats
    data[table : table + 20 * 8] = bytes(20 * 8)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.exr is an incomplete EXR file"):
        read_exr(path)
    assert capfd.readouterr() == ("", "")


def test_pixels_that_cannot_be_decoded_are_an_error(tmp_path):
    """A broken byte in compressed pixels is a ValueError, where OpenEXR drops the part with a warning on stdout."""
    path = tmp_path / "a.exr"
    write_exr(path, {"R": np.tile(np.linspace(0.0, 1.0, 64, dtype=np.float32), (16, 1))}, {})
    data = bytearray(path.read_bytes())
    data[-30] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.exr is a damaged EXR file: 0 of its 1 parts"):
        read_exr(path)


def test_a_damaged_file_raises_nothing_but_value_errors(tmp_path):
    """A flipped bit leaves the file readable or raises ValueError with its name."""
    path = tmp_path / "a.exr"
    write_exr(path, {name: noise(40, 30) for name in ("R", "G", "depth.Z")}, {"warpgi:scene": "Küche"})
    data = path.read_bytes()
    rng = random.Random(0)
    refused = []
    for _ in range(400):
        damaged = bytearray(data)
        damaged[rng.randrange(800)] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            read_exr(path)
        except ValueError as error:
            refused.append(str(error))
    assert refused
    assert all(str(path) in message for message in refused)


@pytest.mark.parametrize(("name", "error"), [("none.exr", FileNotFoundError), ("", ValueError), ("text", ValueError)])
def test_what_is_no_exr_is_refused_by_name(tmp_path, capfd, name, error):
    """A missing file, a directory and a text file each raise one sentence with the path."""
    (tmp_path / "text").write_text("a text that is long enough for a header")
    with pytest.raises(error, match=str(tmp_path / name)):
        read_exr(tmp_path / name)
    assert capfd.readouterr() == ("", "")


# Writing


def test_check_output_accepts_what_can_be_written(tmp_path, monkeypatch):
    """A new name, an old file, a relative name and capitals are fine, and nothing is left behind or changed."""
    (tmp_path / "old.exr").write_text("old")
    monkeypatch.chdir(tmp_path)
    longest = "x" * 251 + ".exr"
    for path in (tmp_path / "new.exr", tmp_path / "old.exr", "new.png", "NEW.EXR", longest):
        assert check_output(path) == Path(path)
    assert [path.name for path in tmp_path.iterdir()] == ["old.exr"]
    assert (tmp_path / "old.exr").read_text() == "old"


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("a.jpg", ValueError),
        ("a", ValueError),
        (".exr", ValueError),
        ("missing/a.exr", FileNotFoundError),
        ("file/a.exr", NotADirectoryError),
        ("directory.exr", OSError),
        ("x" * 300 + ".exr", OSError),
    ],
)
def test_check_output_refuses_what_cannot_be_written(tmp_path, name, error):
    """An unknown suffix is a ValueError, a place that takes no file an OSError, and both name the path."""
    (tmp_path / "file").write_text("")
    (tmp_path / "directory.exr").mkdir()
    with pytest.raises(error, match=name[-20:]) as caught:
        check_output(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert "Errno" not in str(caught.value)
    if error is not ValueError:
        with pytest.raises(error, match=name[-20:]):
            write_exr(tmp_path / name, {"R": noise()}, {})


def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path):
    """Whatever ends the block, Ctrl-C included, the target keeps its bytes and the temporary goes."""
    path = tmp_path / "a.exr"
    path.write_text("old")
    for error in (RuntimeError("stop"), KeyboardInterrupt()):
        with pytest.raises(type(error)), atomic_write(path) as temporary:  # noqa: PT012
            temporary.write_text("half")
            raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_bytes_are_on_the_disk_before_the_name_changes(tmp_path, monkeypatch):
    """The temporary is flushed before it takes the target's place, or a power cut could leave an empty file."""
    calls = []
    for name in ("fsync", "replace"):
        call = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *args, name=name, call=call: (calls.append(name), call(*args)))
    with atomic_write(tmp_path / "a.exr") as temporary:
        temporary.write_text("new")
    assert calls[:2] == ["fsync", "replace"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
@pytest.mark.parametrize("pixels", [noise(200, 40), np.zeros((200, 40), np.float32)], ids=["noise", "black"])
def test_a_full_disk_is_an_error(tmp_path, pixels):
    """A file that the system cuts short is an OSError; OpenEXR itself says nothing where its last write is cut."""
    import resource

    path = tmp_path / "a.exr"
    path.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400, hard))
    try:
        with pytest.raises(OSError, match=r"cannot write .*a\.exr: "):
            write_exr(path, {"R": pixels}, {})
        with pytest.raises(OSError, match=r"cannot write .*a\.png: "):
            write_png(tmp_path / "a.png", np.stack([noise(200, 200)] * 3, axis=-1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX modes and links")
def test_a_file_has_the_usual_mode_and_links_stay(tmp_path):
    """The file obeys the umask as any other, and a symbolic link still points to the file that was written."""
    (tmp_path / "link.exr").symlink_to("real.exr")
    before = os.umask(0o027)
    try:
        write_exr(tmp_path / "link.exr", {"R": noise()}, {})
    finally:
        os.umask(before)
    assert (tmp_path / "link.exr").is_symlink()
    assert (tmp_path / "real.exr").stat().st_mode & 0o777 == 0o640


# Forks savers from a process that never saves itself: each is killed after the delay that comes in on stdin.
SAVER = """
import os, signal, sys, time
import numpy as np
from warpgi.image import write_exr
rng = np.random.default_rng(0)
pictures = [{c: rng.random((96, 128), dtype=np.float32) for c in ("R", "G", "B", "indirect.R")} for _ in range(2)]
for picture in pictures:
    picture["same"] = picture["R"].copy()
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        while True:
            for number, picture in enumerate(pictures):
                write_exr(sys.argv[1], picture, {"warpgi:seed": str(number)})
    time.sleep(float(line))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("killed", flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_process_leaves_a_whole_file_or_none(tmp_path):
    """After SIGKILL at any moment of a save the target is absent or complete, 40 times over."""
    path = tmp_path / "a.exr"
    delays = random.Random(0)
    command = [sys.executable, "-c", SAVER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as saver:
        assert saver.stdin is not None
        assert saver.stdout is not None
        for _ in range(40):
            print(delays.uniform(0.005, 0.06), file=saver.stdin, flush=True)
            assert saver.stdout.readline() == "killed\n"
            if path.exists():
                channels, attributes = read_exr(path)
                assert attributes["warpgi:seed"] in ("0", "1")
                assert np.array_equal(channels["R"], channels["same"])
        saver.stdin.close()
    assert path.exists()  # or nothing was tested


# Showing


@pytest.mark.parametrize(
    ("linear", "encoded"),
    [
        (0.0, 0.0),
        (0.0031308, 12.92 * 0.0031308),
        (0.18, 0.461356),
        (0.5, 0.735357),
        (1.0, 1.0),
        (-1.0, 0.0),
        (9.0, 1.0),
    ],
)
def test_srgb_values(linear, encoded):
    """The encoding has the values of IEC 61966-2-1 and clamps outside [0, 1]."""
    assert encode_srgb(linear) == pytest.approx(encoded, abs=5e-7)


def test_srgb_inverts_the_decoding_of_textures():
    """The 256 codes of 8 bits, decoded by the standard's other formula, come back."""
    codes = np.arange(256) / 255.0
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    # The standard's two pieces meet to 4e-8 only (0.0031308 is rounded).
    np.testing.assert_allclose(encode_srgb(linear), codes, atol=1e-7)


def test_tone_map_keeps_colours_up_to_the_shoulder():
    """Where no channel exceeds 0.8, the tone curve is the identity, so mid-grey and albedos stay true."""
    image = np.random.default_rng(2).uniform(0.0, 0.8, (8, 8, 3))
    assert np.array_equal(tone_map(image), image)
    assert np.allclose(tone_map(image / 4, exposure=2.0), image, atol=1e-15)


def test_tone_map_takes_negative_light_as_none():
    """What a filter undershoots is shown as 0, and does not tint bright pixels."""
    assert np.array_equal(tone_map([[[-1.0, 0.5, 2.0]]]), tone_map([[[0.0, 0.5, 2.0]]]))


def test_tone_map_is_monotone_and_stays_below_one():
    """For any colour, each channel grows with exposure, from 0 towards white, without a jump at the shoulder."""
    rng = np.random.default_rng(3)
    colours = rng.random((50, 3))
    colours[:5, 1:] = 0.0
    scales = np.geomspace(1e-3, 1e6, 4000)
    mapped = tone_map(colours[:, None] * scales[None, :, None])
    steps = np.diff(mapped, axis=1)
    assert steps.min() >= -1e-15  # rounding of values near 1
    # Slope at most 1, of the identity: no step is longer than the input's, which is 0.52 % of at most 0.8 there.
    assert steps.max() < 0.01
    assert mapped.min() >= 0.0
    assert mapped.max() <= 1.0
    assert mapped[:, -1].min() > 0.99


def test_tone_map_keeps_the_hue():
    """Above the shoulder the order of channels, and the ratio of their differences (the hue), stay."""
    rng = np.random.default_rng(4)
    image = rng.random((20, 20, 3)) * 30.0
    low, middle, high = np.sort(image, axis=2).transpose(2, 0, 1)
    order = np.argsort(image, axis=2)
    mapped_low, mapped_middle, mapped_high = np.take_along_axis(tone_map(image), order, axis=2).transpose(2, 0, 1)
    hue = (middle - low) / (high - low)
    np.testing.assert_allclose((mapped_middle - mapped_low) / (mapped_high - mapped_low), hue, atol=1e-9)


def test_png_pixels_follow_the_formula(tmp_path):
    """A PNG read by Pillow holds round(255 sRGB(tone curve)), here computed by hand for four greys."""
    greys = np.array([0.18, 0.8, 2.0, -0.5])
    # Grey 2: p' = 1 - 0.04 / 1.4; grey stays grey, since white p' is mixed with p'.
    mapped = np.array([0.18, 0.8, 1 - 0.04 / 1.4, 0.0])
    srgb = 1.055 * mapped ** (1 / 2.4) - 0.055
    expected = [round(255 * value) for value in srgb[:3]] + [0]
    count = write_png(tmp_path / "a.png", np.repeat(greys[None, :, None], 3, axis=2).astype(np.float32))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.mode == "RGB"
        pixels = np.asarray(picture)
    assert count == 0
    assert pixels[0].tolist() == [[value] * 3 for value in expected]


def test_png_shows_wrong_pixels_in_magenta(tmp_path):
    """NaN and infinity are painted magenta, counted and warned of; their neighbours are not touched."""
    image = np.full((2, 3, 3), 0.5, np.float32)
    image[0, 0, 1], image[1, 2, 0] = np.nan, -np.inf
    with pytest.warns(RuntimeWarning, match=r"a\.png shows 2 pixels in magenta"):
        assert write_png(tmp_path / "a.png", image) == 2
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture)
    grey = [round(255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055))] * 3
    assert pixels.tolist() == [[[255, 0, 255], grey, grey], [grey, grey, [255, 0, 255]]]


def test_showing_refuses_wrong_arguments(tmp_path):
    """A wrong shape and an exposure out of range are ValueErrors that say so, and no file appears."""
    with pytest.raises(ValueError, match="image has shape"):
        write_png(tmp_path / "a.png", np.zeros((4, 4)))
    with pytest.raises(ValueError, match="exposure is 100"):
        write_png(tmp_path / "a.png", np.zeros((4, 4, 3)), exposure=100.0)
    assert not list(tmp_path.iterdir())
