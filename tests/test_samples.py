"""Sample buffers: what they refuse and count, and that the authors' file format keeps every bit."""

from __future__ import annotations

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warpgi import image
from warpgi.samples import NO_HIT, OPTIONAL, REQUIRED, SampleBuffer, escaped_hit, unit

COC = "CoC coefficients (coc radius = C0/w+C1)"
MATRIX = np.arange(16.0).reshape(4, 4) / 3
MATRIX_LINE = "Pixel-to-camera matrix: " + ",".join(map(repr, MATRIX.ravel().tolist()))
VALUES = {1.2: 14, 1.3: 16, 2.0: 33, 2.1: 34, 2.2: 39}

# where the channels of 2.0, 2.1 and 2.2 stand in a row of the file
COLUMNS = {
    "image_xy": slice(0, 2),
    "bandwidth": 2,
    "lens": slice(3, 5),
    "time": 5,
    "radiance": slice(6, 9),
    "origin_motion": slice(9, 12),
    "origin_normal": slice(12, 15),
    "albedo": slice(15, 18),
    "origin": slice(18, 21),
    "hit": slice(21, 24),
    "hit_motion": slice(24, 27),
    "hit_normal": slice(27, 30),
    "direct": slice(30, 33),
    "throughput": slice(33, 36),
    "hit_direct": slice(36, 39),
}


def table(count: int, values: int = 39, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-9.0, 9.0, (count, values)).astype(np.float32)


def any_bits(count: int, finite: bool = False) -> np.ndarray:
    """Rows of 39 floats of every kind: denormal, both zeros, and NaNs of many payloads if not `finite`."""
    bits = np.random.default_rng(5).integers(0, 2**32, (count, 39), dtype=np.uint32)
    bits[::3, ::2] = 0x80000000
    rows = bits.view(np.float32)
    if finite:
        rows[~np.isfinite(rows)] = 1.0
    return rows


def header(version: float = 2.2, encoding: str = "binary", width=3, height=2, spp=4, samples: int | None = None) -> str:
    lines = [f"Version {version}", f"Width {width}", f"Height {height}", f"Samples per pixel {spp}"]
    lines += [f"Samples {samples}"] * (samples is not None)
    lines += ["Motion model: perspective"] * (version == 1.3)
    lines += [f"{COC}: -1.5,0.25"] * (version >= 1.3)
    lines += [MATRIX_LINE] * (version >= 2.0)
    lines += [f"Encoding = {encoding}"] if version >= 1.3 else [""]
    return "\n".join([*lines, "the,last,line,is,not,interpreted"]) + "\n"


def as_text(rows: np.ndarray, end: str = "\n") -> str:
    return "".join(",".join(f"{value:.9g}" for value in row) + end for row in rows.tolist())


def write(path: Path, head: str, data: bytes) -> Path:
    path.write_bytes(data)
    Path(f"{path}.header").write_text(head, encoding="ascii", newline="")
    return path


def buffer(count: int = 8, **fields) -> SampleBuffer:
    """A lean buffer of one row, without faults."""
    arrays = {name: table(count, 3, seed) for seed, name in enumerate(REQUIRED)}
    return SampleBuffer(**{"width": count, "height": 1, "spp": 1, **arrays, **fields})


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and np.array_equal(np.ascontiguousarray(a).view("u4"), np.ascontiguousarray(b).view("u4"))


def test_binary_round_trip_keeps_every_bit(tmp_path):
    """Loading and saving version 2.2 in binary gives the same bytes: NaN payloads, -0 and denormals included."""
    rows = any_bits(24)
    path = write(tmp_path / "in.bin", header(), rows.tobytes())
    loaded = SampleBuffer.load(path)
    for name, columns in COLUMNS.items():
        array = getattr(loaded, name)
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
        assert same_bits(array, rows[:, columns]), name
    assert loaded.coc == (-1.5, 0.25)
    assert np.array_equal(loaded.pixel_to_camera, MATRIX)
    loaded.save(tmp_path / "out.bin")
    assert (tmp_path / "out.bin").read_bytes() == rows.tobytes()
    again = SampleBuffer.load(tmp_path / "out.bin")
    assert again.coc == loaded.coc
    assert np.array_equal(again.pixel_to_camera, MATRIX)
    assert (again.width, again.height, again.spp) == (3, 2, 4)


def test_text_round_trip_keeps_every_number(tmp_path):
    """Nine digits bring every float32 back, all 39 of a sample; NaN and infinity come back as such."""
    rows = any_bits(24, finite=True)
    rows[0, 6:9] = np.nan, np.inf, -np.inf
    SampleBuffer.load(write(tmp_path / "in.bin", header(), rows.tobytes())).save(tmp_path / "out.txt")
    lines = (tmp_path / "out.txt").read_text().splitlines()
    assert [line.count(",") for line in lines] == [38] * 24
    again = SampleBuffer.load(tmp_path / "out.txt")
    assert np.isnan(again.radiance[0, 0])
    assert again.radiance[0, 1:].tolist() == [np.inf, -np.inf]
    for name, columns in COLUMNS.items():
        assert same_bits(getattr(again, name)[1:], rows[1:, columns]), name


def test_suffix_or_argument_chooses_text(tmp_path):
    """A name that ends in .txt is written as text, any other as binary, unless `text` says otherwise."""
    whole = buffer()
    for name, text, want in [("a.TXT", None, 1), ("a.bin", None, 0), ("a", True, 1), ("b.txt", False, 0)]:
        whole.save(tmp_path / name, text=text)
        assert f"Encoding = {'text' if want else 'binary'}\n" in (tmp_path / f"{name}.header").read_text()
        assert same_bits(SampleBuffer.load(tmp_path / name).hit, whole.hit)


@pytest.mark.parametrize("version", [2.0, 2.2])
@pytest.mark.parametrize("form", ["binary", "text", "comma", "windows", "one file"])
def test_reads_versions_2_0_and_2_2(tmp_path, version, form):
    """Both are read from binary, and from text with or without a comma at the end, or below their own header."""
    rows = table(24, VALUES[version])
    head = header(version, "binary" if form == "binary" else "text")
    path = tmp_path / "samples"
    if form == "one file":
        path.write_text(head + as_text(rows))
    elif form == "windows":
        write(path, head.replace("\n", "\r\n"), as_text(rows, " , \r\n").encode())
    else:
        write(
            path, head, rows.tobytes() if form == "binary" else as_text(rows, ",\n" if form == "comma" else "").encode()
        )
        if form == "text":
            path.write_text(as_text(rows).rstrip("\n") + "\n\n")
    loaded = SampleBuffer.load(path)
    for name, columns in COLUMNS.items():
        stop = columns if isinstance(columns, int) else columns.stop - 1
        if stop >= rows.shape[1]:
            assert getattr(loaded, name) is None, name
        else:
            assert same_bits(getattr(loaded, name), rows[:, columns]), name
    assert loaded.has_secondary_rays
    assert loaded.coc == (-1.5, 0.25)


def test_long_text_is_read_block_by_block(tmp_path, monkeypatch):
    """Where the blocks of a text file are cut does not matter, nor for the line number of a fault."""
    rows = table(24)
    path = write(tmp_path / "a.txt", header(encoding="text"), as_text(rows, ",\n").encode())
    wrong = write(tmp_path / "b.txt", header(encoding="text"), as_text(rows[:20]).encode() + b"\n\n1,2\n" + b"0," * 999)
    for size in (1, 7, 333, 1000, 4096):
        monkeypatch.setattr("warpgi.samples_file.BLOCK_BYTES", size)
        assert same_bits(SampleBuffer.load(path).hit_direct, rows[:, 36:39])
        with pytest.raises(ValueError, match=r"b\.txt line 23 holds 2 numbers, expected 39"):
            SampleBuffer.load(wrong)


@pytest.mark.parametrize("encoding", ["binary", "text"])
def test_irregular_samples_lie_where_their_coordinates_say(tmp_path, encoding):
    """A sample of version 2.1 belongs to the pixel (floor x, floor y); a pixel may hold any number of samples."""
    rows = table(5, 34)
    rows[:, 33] = 0.0
    rows[:, :2] = [(0.5, 0.25), (2.75, 0.0), (2.0, 0.5), (0.0, 1.0), (1.5, 1.999)]
    data = rows.tobytes() if encoding == "binary" else as_text(rows).encode()
    head = header(2.1, encoding, spp=-1, samples=5)
    loaded = SampleBuffer.load(write(tmp_path / "a", head, data))
    assert loaded.pixel_of_sample.tolist() == [0, 2, 2, 3, 4]
    assert loaded.spp == 0
    assert len(loaded) == 5
    assert same_bits(loaded.bandwidth, rows[:, 2])
    loaded.save(tmp_path / "b", text=encoding == "text")
    assert (tmp_path / "b").read_bytes() == data
    assert SampleBuffer.load(tmp_path / "b").pixel.tolist() == [0, 2, 2, 3, 4]
    # the authors' own writer of 2.1 says 2.0
    same = SampleBuffer.load(write(tmp_path / "c", head.replace("2.1", "2.0"), data))
    assert same.pixel.tolist() == [0, 2, 2, 3, 4]


def test_irregular_samples_are_sorted_and_checked(tmp_path):
    """Samples out of pixel order are sorted, equal pixels kept in order; one outside the picture is refused."""
    rows = table(4, 34)
    rows[:, 33] = [1.0, 2.0, 0.0, 3.0]
    rows[:, :2] = [(1.5, 1.5), (0.5, 0.5), (1.2, 1.2), (2.5, 0.5)]
    head = header(2.1, spp=-1, samples=4)
    loaded = SampleBuffer.load(write(tmp_path / "a", head, rows.tobytes()))
    assert loaded.pixel.tolist() == [0, 2, 4, 4]
    assert same_bits(loaded.hit, rows[[1, 3, 0, 2], 21:24])
    assert loaded.bandwidth.tolist() == [2.0, 3.0, 1.0, 0.0]  # version 2.1's own channel, the last one
    for x, y in [(3.0, 0.0), (-0.1, 0.0), (0.0, 2.0), (np.nan, 0.0), (np.inf, 0.0)]:
        rows[2, :2] = x, y
        with pytest.raises(ValueError, match=r"sample 2 lies at .*, expected a place inside 3 x 2 pixels"):
            SampleBuffer.load(write(tmp_path / "a", head, rows.tobytes()))


def test_irregular_buffers_are_saved_where_2_1_can_hold_them(tmp_path):
    """Without image_xy the pixels' centres are written; what 2.1 has no place for is refused, not dropped."""
    pixel = np.array([0, 0, 3, 7], np.int32)
    lean = buffer(4, width=4, height=2, spp=0, pixel=pixel)
    lean.save(tmp_path / "a")
    again = SampleBuffer.load(tmp_path / "a")
    assert again.pixel.tolist() == pixel.tolist()
    assert same_bits(again.hit, lean.hit)
    assert again.image_xy.tolist() == [[0.5, 0.5], [0.5, 0.5], [3.5, 0.5], [3.5, 1.5]]
    with pytest.raises(ValueError, match=r"version 2\.1, for irregular samples, cannot hold throughput"):
        replace(lean, throughput=lean.albedo).save(tmp_path / "b")
    with pytest.raises(ValueError, match="image_xy and pixel place samples differently"):
        replace(lean, image_xy=np.full((4, 2), 0.5, np.float32)).save(tmp_path / "b")
    assert not (tmp_path / "b").exists()
    assert not (tmp_path / "b.header").exists()


@pytest.mark.parametrize("form", ["1.2 one file", "1.2 text", "1.3 text", "1.3 binary"])
def test_reads_versions_1_2_and_1_3_without_loss(tmp_path, form):
    """Their channels come back as recorded, under names; as secondary rays they all miss, and cannot be saved."""
    version = float(form[:3])
    rows = table(24, VALUES[version])
    head = header(version, "binary" if "binary" in form else "text")
    path = tmp_path / "a"
    if form == "1.2 one file":
        path.write_text(head + as_text(rows, ",\n"))
    else:
        write(path, head, rows.tobytes() if "binary" in form else as_text(rows).encode())
    loaded = SampleBuffer.load(path)
    screen = loaded.screen
    if version == 1.2:
        parts = [loaded.image_xy, loaded.lens, loaded.time, loaded.radiance, screen.depth, screen.coc_radius]
        parts += [screen.motion, screen.depth_gradient]
        assert screen.motion_model == "affine"
    else:
        parts = [loaded.image_xy, screen.projected_depth, screen.depth, loaded.lens, loaded.time, loaded.radiance]
        parts += [screen.alpha, screen.motion, screen.depth_gradient]
        assert screen.motion_model == "perspective"
        assert loaded.coc == (-1.5, 0.25)
    assert same_bits(np.column_stack(parts), rows)
    assert not loaded.has_secondary_rays
    assert loaded.checked.counts["primary_missed"] == 24
    with pytest.raises(ValueError, match="the buffer holds no secondary rays"):
        loaded.save(tmp_path / "b")


def test_channels_of_zeros_are_not_carried(tmp_path):
    """A static, pinhole, diffuse file has no motion, lens, time or bandwidth arrays: 72 bytes a sample."""
    rows = np.zeros((24, 39), np.float32)
    rows[:, 6:9] = 1.0
    rows[::2, 9:12] = -0.0
    loaded = SampleBuffer.load(write(tmp_path / "a", header(), rows.tobytes()))
    assert [name for name in OPTIONAL if getattr(loaded, name) is not None] == []
    assert loaded.bytes_per_sample == 72
    assert loaded.kappa is None
    rows[7, 2] = 4.0
    loaded = SampleBuffer.load(write(tmp_path / "a", header(), rows.tobytes()))
    assert loaded.bytes_per_sample == 76
    assert loaded.kappa[6:9].tolist() == [0.0, 8.0, 0.0]
    assert loaded.bandwidth.dtype == loaded.kappa.dtype == np.float32


def test_constant_time_and_lens_are_not_carried_where_they_say_nothing(tmp_path):
    """A constant time goes if nothing moves, a constant lens if nothing blurs, and only then."""
    rows = np.zeros((24, 39), np.float32)
    rows[:, 3:6] = 0.25, -0.5, 0.75
    sharp = header().replace("-1.5,0.25", "-0.000000,0.000000")
    still = SampleBuffer.load(write(tmp_path / "a", sharp, rows.tobytes()))
    assert still.time is None
    assert still.lens is None
    blurred = SampleBuffer.load(write(tmp_path / "a", header(), rows.tobytes()))
    assert blurred.time is None
    assert same_bits(blurred.lens, rows[:, 3:5])
    rows[3, 26] = 1.0
    moving = SampleBuffer.load(write(tmp_path / "a", sharp, rows.tobytes()))
    assert same_bits(moving.time, rows[:, 5])
    assert moving.lens is None
    rows[3, 4] = 1.0
    assert SampleBuffer.load(write(tmp_path / "a", sharp, rows.tobytes())).lens is not None


def test_arrays_are_taken_without_a_copy():
    """float32 arrays in C order are kept as they are, Warp's on the cpu too; others in float32 are put in order."""
    arrays = {name: table(8, 3, seed) for seed, name in enumerate(REQUIRED)}
    arrays |= {name: table(8, size or 1)[:, : size or 1].copy() for name, size in OPTIONAL.items()}
    arrays = {name: array[:, 0].copy() if OPTIONAL.get(name) == 0 else array for name, array in arrays.items()}
    pixel = np.arange(8, dtype=np.int32)
    whole = SampleBuffer(4, 2, 0, **arrays, pixel=pixel)
    for name, array in {**arrays, "pixel": pixel}.items():
        assert np.shares_memory(getattr(whole, name), array), name
    hits = wp.array(arrays["hit"], dtype=wp.vec3, device="cpu")
    assert np.shares_memory(replace(whole, hit=hits).hit, hits.numpy())
    strided = replace(whole, hit=table(8, 9)[:, 3:6]).hit
    assert strided.flags.c_contiguous
    assert same_bits(strided, table(8, 9)[:, 3:6])
    assert whole.bytes_per_sample == 4 * (6 * 3 + sum(size or 1 for size in OPTIONAL.values()) + 1)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"radiance": np.zeros((7, 3), np.float32)}, r"radiance has shape \(7, 3\), expected \(8, 3\): 8 x 1 pixels"),
        ({"hit": np.zeros((8, 3))}, "hit is an array of float64, expected an array of float32"),
        ({"origin": [[0.0] * 3] * 8}, "origin is list, expected an array of float32"),
        ({"albedo": None}, "albedo is NoneType, expected an array of float32"),
        ({"albedo": [[1.0], [1.0, 2.0]]}, "albedo is list, expected an array of float32"),
        ({"time": np.zeros((8, 1), np.float32)}, r"time has shape \(8, 1\), expected \(8,\)"),
        ({"lens": np.zeros((8, 3), np.float32)}, r"lens has shape \(8, 3\), expected \(8, 2\)"),
        ({"height": 0}, "height is 0, expected a whole number from 1"),
        ({"spp": -1}, "spp is -1, expected a whole number from 0"),
        ({"coc": (0.0, np.nan)}, "coc holds 1 values that are NaN"),
        ({"pixel_to_camera": np.eye(3)}, r"pixel_to_camera has shape \(3, 3\), expected \(4, 4\)"),
        ({"pixel": np.zeros(8, np.int32)}, "spp is 1, expected 0 where pixel says"),
        ({"spp": 0, "pixel": np.zeros(8)}, "pixel is an array of float64, expected an array of int32"),
        ({"spp": 0, "pixel": np.zeros((8, 1), np.int32)}, r"pixel has shape \(8, 1\), expected \(8,\): one index"),
        ({"spp": 0, "pixel": np.arange(1, 9, dtype=np.int32)}, "pixel runs from 1 to 8, expected values from 0 to 7"),
        ({"spp": 0, "pixel": np.array([0, 2, 1, 3, 3, 3, 3, 3], np.int32)}, "pixel falls somewhere"),
        ({"spp": 0, "pixel": np.arange(7, dtype=np.int32)}, r"radiance has shape \(8, 3\), expected \(7, 3\): one row"),
    ],
)
def test_wrong_arguments_are_refused_by_name(wrong, message):
    """One sentence says which argument is wrong, what came and what was wanted."""
    with pytest.raises((TypeError, ValueError), match=message):
        buffer(**wrong)


def test_faulty_samples_are_counted_and_left_out():
    """Each fault leaves out the part of the sample that it spoils and counts once, under its first name."""
    fields = {name: getattr(buffer(16), name).copy() for name in REQUIRED} | {"bandwidth": np.ones(16, np.float32)}
    fields["throughput"] = fields["albedo"].copy()
    fields["radiance"][0, 1] = np.nan  # 0-5: splat only
    fields["radiance"][1, 2] = np.inf
    fields["hit"][2, 0] = np.nan
    fields["hit"][3] = fields["origin"][3]
    fields["hit_normal"][4] = 0.0
    fields["bandwidth"][5] = np.inf
    fields["albedo"][6, 0] = np.nan  # 6-7: primary hit only
    fields["origin_normal"][7] = -0.0
    fields["origin"][8, 2] = np.nan  # 8-9: both
    fields["origin"][9], fields["hit"][9] = (NO_HIT, np.nan, 0.0), 0.0
    fields["origin"][10] = -1e10, 0.0, 0.0  # no primary hit: nothing else matters
    fields["radiance"][10] = np.nan
    fields["hit"][11] = 0.0, 2e10, 0.0  # escaped, and what it has of a hit is not read
    fields["hit_normal"][11], fields["throughput"][11], fields["bandwidth"][11] = np.nan, np.nan, -np.inf
    fields["hit"][12] = 0.0, np.inf, 0.0  # escaped, but nobody knows where to
    fields["hit_normal"][13] = np.inf
    fields["hit"][14], fields["origin_normal"][14] = (1e30, 1e30, -1e30), np.nan
    fields["throughput"][14] = np.nan
    whole = buffer(16, **fields)
    state = whole.checked
    not_primary, escaped = {6, 7, 8, 9, 10, 14}, {11, 14}
    not_splat = {0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13, 14}
    assert set(np.flatnonzero(~state.is_primary)) == not_primary
    assert set(np.flatnonzero(~state.is_splat)) == not_splat
    assert set(np.flatnonzero(state.is_escaped)) == escaped
    assert state.counts == {
        "nonfinite": 8,  # 0, 1, 2, 5, 6, 8, 9, 12
        "zero_length": 1,  # 3
        "bad_normal": 4,  # 4, 7, 13, 14
        "primary_missed": 1,
        "escaped": 2,
    }
    assert whole.checked is state
    assert np.isfinite(whole.direction).all()
    assert (whole.direction.any(axis=1) == (state.is_splat | state.is_escaped)).all()


def test_sound_buffers_have_no_faults_down_to_none_at_all():
    """Nothing is counted in a sound buffer, of whatever size, spp = 0 included; offsets far below 1 are lengths."""
    for count in (0, 1, 9):
        fields = {"width": 3, "spp": 0} if count == 0 else {}
        state = buffer(count, **fields).checked
        assert state.is_primary.all()
        assert state.is_splat.all()
        assert not state.is_escaped.any()
        assert set(state.counts.values()) == {0}
        assert len(state.is_splat) == count
    origin = np.full((8, 3), 1.0, np.float32)
    near = buffer(origin=origin, hit=np.nextafter(origin, np.float32(2.0)))
    tiny = buffer(origin=np.zeros((8, 3), np.float32), hit=np.full((8, 3), 1e-45, np.float32))
    for whole in (near, tiny):
        assert whole.checked.is_splat.all()
        assert np.allclose(whole.direction, 3**-0.5, rtol=1e-6)


def test_directions_of_escaped_rays_survive_the_file(tmp_path):
    """A direction d, put far out by `escaped_hit`, comes back from the file within float32; so do points of 3e38."""
    rng = np.random.default_rng(3)
    direction = unit(rng.normal(size=(64, 3)))
    origin = rng.uniform(-1e3, 1e3, (64, 3)).astype(np.float32)
    hit = escaped_hit(origin, direction)
    hit[32:] = direction[32:] * np.float32(3e38)
    for name in ("a.bin", "a.txt"):
        buffer(64, origin=origin, hit=hit).save(tmp_path / name)
        again = SampleBuffer.load(tmp_path / name)
        assert again.checked.is_escaped.all()
        assert again.checked.counts["escaped"] == 64
        assert same_bits(again.hit, hit)
        # origin / distance is below 1e3 / 1e11; the rest is rounding of hit and of the result
        assert np.abs(again.direction - direction).max() < 3e-7


def test_normals_are_made_unit_length():
    """Normals a little off, far off, huge or denormal come out within one rounding of length 1; zero stays zero."""
    normal = unit(np.random.default_rng(1).normal(size=(8, 3)))
    scale = np.array([1.0, 1.0 + 2e-7, 1.0 + 1e-6, 1e-3, 1e30, 1e-30, 3e38, 0.0])[:, None]
    whole = buffer(origin_normal=(normal * scale).astype(np.float32), hit_normal=np.full((8, 3), 1e-45, np.float32))
    length = np.linalg.norm(whole.unit_origin_normal.astype(np.float64), axis=1)
    assert np.abs(length[:7] - 1.0).max() < 1.5e-7
    assert length[7] == 0.0
    assert np.allclose(whole.unit_hit_normal, 3**-0.5, rtol=1e-6)
    assert whole.unit_hit_normal.dtype == np.float32
    assert whole.checked.counts["bad_normal"] == 1


def test_samples_stand_in_pixel_order():
    """Sample i of a regular buffer belongs to pixel i // spp."""
    whole = buffer(24, width=3, height=2, spp=4)
    assert whole.pixel_of_sample.tolist() == np.repeat(np.arange(6), 4).tolist()
    assert whole.pixel_of_sample.dtype == np.int32
    assert buffer(0, width=3, spp=0).pixel_of_sample.shape == (0,)


REFUSED_HEADERS = [
    (("Version 2.2", "Version 2.3"), "line 1 says version 2.3, expected one of 1.2, 1.3, 2.0, 2.1, 2.2"),
    (("Version 2.2", "Version two"), "line 1 is 'Version two', expected 'Version' and one of"),
    (("Version 2.2\n", ""), "line 1 is 'Width 3', expected 'Version'"),
    (("Width 3", "Width 0"), "line 2 is 'Width' 0, expected a whole number from 1 to 2147483647"),
    (("Width 3", "Width -3"), "line 2 is 'Width' -3, expected a whole number from 1"),
    (("Width 3", "Width 3.5"), "line 2 is 'Width 3.5', expected 'Width' and a whole number"),
    (("Width 3", "Width 1" + "0" * 25), "line 2 is 'Width' 1000"),
    (("Width 3", "Width 1" + "0" * 5000), "line 2 is longer than any line"),
    (("Height 2\n", ""), "line 3 is 'Samples per pixel 4', expected 'Height'"),
    (("pixel 4", "pixel 0"), "line 4 is 'Samples per pixel' 0, expected a whole number from 1"),
    (("pixel 4", "pixel -1"), "line 4 is 'Samples per pixel' -1, expected a whole number from 1"),
    (("-1.5,0.25", "-1.5"), r"line 5 is 'CoC coefficients .*: -1.5', expected .* 2 finite numbers"),
    (("-1.5,0.25", "-1.5,nan"), "line 5 is 'CoC coefficients .* 2 finite numbers"),
    (("-1.5,0.25", "-1.5,1_0"), "line 5 is 'CoC coefficients .* 2 finite numbers"),
    (("matrix: 0.0,", "matrix: "), "line 6 is 'Pixel-to-camera matrix: .* 16 finite numbers"),
    (("matrix: 0.0,", "matrix: x,"), "line 6 is 'Pixel-to-camera matrix: .* 16 finite numbers"),
    (("= binary", "= base64"), "line 7 is 'Encoding = base64', expected 'Encoding =' and binary or text"),
    (("Encoding = binary\n", ""), "line 7 is 'the,last,line,.*', expected 'Encoding =' and binary or text"),
    (("the,last,line,is,not,interpreted\n", ""), "ends after line 7, expected a line that names the columns"),
    (("Width 3", "Width 2"), "holds 3744 bytes, expected 2496: 2 x 2 pixels of 4 samples of 39 float32"),
    (("Width 3", "Width 4"), "holds 3744 bytes, expected 4992"),
]


@pytest.mark.parametrize(("change", "message"), REFUSED_HEADERS, ids=[message[:40] for _, message in REFUSED_HEADERS])
def test_wrong_headers_are_refused_by_line(tmp_path, change, message):
    """A header that cannot be right is refused in one sentence that names the file, the line and what was wanted."""
    head = header()
    assert change[0] in head
    path = write(tmp_path / "a.bin", head.replace(*change), table(24).tobytes())
    with pytest.raises(ValueError, match=message) as caught:
        SampleBuffer.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [1.3, 2.0, 2.1, 2.2])
@pytest.mark.parametrize("encoding", ["binary", "text"])
@pytest.mark.parametrize("size", [(2**16, 2**16, 1), (2**31 - 1, 2**31 - 1, 2**31 - 1), (1000, 1000, 1000)])
def test_counts_that_the_file_cannot_hold_cost_no_memory(tmp_path, version, encoding, size):
    """Such a header is refused before anything is allocated, also where 32 bits overflow to a small product."""
    width, height, spp = size
    samples = min(width * height * spp, 2**31 - 1) if version == 2.1 else None
    head = header(version, encoding, width, height, spp, samples)
    path = write(tmp_path / "a", head, bytes(4 * VALUES[version]))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"a holds \d+ bytes( of text)?, expected \d{10,}"):
            SampleBuffer.load(path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda lines: [*lines[:5], lines[5] + b",1", *lines[6:]], "line 6 holds 40 numbers, expected 39"),
        (lambda lines: [*lines[:5], lines[5].rpartition(b",")[0], *lines[6:]], "line 6 holds 38 numbers"),
        (lambda lines: [line + b",1" for line in lines], "line 1 holds 40 numbers, expected 39"),
        (lambda lines: [*lines[:9], b"", b"1e," + lines[9], *lines[10:]], "line 11 holds '1e', expected numbers"),
        (lambda lines: [*lines[:9], lines[9].replace(b",", b";"), *lines[10:]], r"line 10 holds '.*\.\.\.', expected"),
        (lambda lines: [*lines[:9], lines[9].replace(b",", b",,", 1), *lines[10:]], "line 10 holds '', expected"),
        (lambda lines: [*lines[:9], lines[9] + b",,", *lines[10:]], "line 10 holds '', expected"),
        (lambda lines: [*lines[:9], b"1_0" + lines[9][lines[9].index(b",") :], *lines[10:]], "line 10 holds '1_0'"),
        (lambda lines: lines[:-1], "ends after 23 samples, expected 24: 3 x 2 pixels of 4 samples"),
        (lambda lines: [*lines, lines[0]], "holds more samples than its header says: 3 x 2 pixels"),
    ],
)
def test_wrong_text_is_refused_by_line(tmp_path, damage, message):
    """Lines of another length, what is no number, and too few or too many lines are refused, with the line's number."""
    lines = damage(as_text(table(24)).encode().splitlines())
    path = write(tmp_path / "a.txt", header(encoding="text"), b"\n".join(lines) + b"\n")
    with pytest.raises(ValueError, match=message):
        SampleBuffer.load(path)
    # below its own header the lines count from the top of the file
    below = tmp_path / "b.txt"
    below.write_bytes(header(encoding="text").encode() + b"\n".join(lines) + b"\n")
    if message.startswith("line"):
        number = int(message.split()[1])
        message = message.replace(f"line {number}", f"line {number + 8}", 1)
    with pytest.raises(ValueError, match=message):
        SampleBuffer.load(below)


@pytest.mark.parametrize("encoding", ["binary", "text"])
def test_cut_files_are_noticed(tmp_path, encoding):
    """Data or header cut anywhere is refused with ValueError, and nothing else is ever raised."""
    rows = table(24)
    head, data = header(encoding=encoding), rows.tobytes() if encoding == "binary" else as_text(rows).encode()
    columns = head.index("the,last")
    # nobody can see that the very last number of a text has lost digits
    last = len(data) - 1 if encoding == "binary" else data.rindex(b",")
    for length in np.linspace(0, last, 20).astype(int):
        with pytest.raises(ValueError, match=r"a (holds|ends|line)"):
            SampleBuffer.load(write(tmp_path / "a", head, data[:length]))
    for length in np.linspace(0, columns, 20).astype(int):
        with pytest.raises(ValueError, match=r"a\.header"):
            SampleBuffer.load(write(tmp_path / "a", head[:length], data))
    whole = head.encode() + data
    for length in np.linspace(0, len(head) + last, 20).astype(int):
        (tmp_path / "b").write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"[/\\]b "):
            SampleBuffer.load(tmp_path / "b")


def test_garbage_raises_nothing_but_value_errors(tmp_path):
    """Bytes at random places of data and header are changed: it loads, or ValueError says why not."""
    rng = np.random.default_rng(11)
    rows = table(24)
    messages: list[str] = []
    for encoding, data in (("binary", rows.tobytes()), ("text", as_text(rows).encode())):
        head = header(encoding=encoding).encode()
        loaded = 0
        for _ in range(60):
            both = bytearray(head + data)
            for at in rng.integers(0, len(head) if rng.random() < 0.5 else len(both), 3):
                both[at] = rng.integers(0, 256)
            path = tmp_path / "a"
            path.write_bytes(both[len(head) :])
            Path(f"{path}.header").write_bytes(both[: len(head)])
            try:
                SampleBuffer.load(path)
                loaded += 1
            except ValueError as error:
                messages.append(str(error))
        assert loaded > 0 or encoding == "text"
    assert len(messages) > 30
    assert [message for message in messages if str(path) not in message] == []


def test_missing_files_and_headers_are_named(tmp_path):
    """No file is FileNotFoundError; no header, or one on top of binary data, is a ValueError that says what to do."""
    with pytest.raises(FileNotFoundError, match="a"):
        SampleBuffer.load(tmp_path / "a")
    (tmp_path / "a").write_bytes(table(24).tobytes())
    with pytest.raises(ValueError, match=r"a has no header: .*a\.header is missing, and line 1 is no Version line"):
        SampleBuffer.load(tmp_path / "a")
    (tmp_path / "a").write_bytes(header().encode() + table(24).tobytes())
    with pytest.raises(ValueError, match=r"is binary below its own header, expected the header in .*a\.header"):
        SampleBuffer.load(tmp_path / "a")
    Path(f"{tmp_path}/b.header").write_text(header())
    with pytest.raises(FileNotFoundError, match="b"):
        SampleBuffer.load(tmp_path / "b")


def test_empty_buffers_are_not_saved(tmp_path):
    """A buffer without samples is refused, as its file would be."""
    with pytest.raises(ValueError, match="the buffer holds no sample"):
        buffer(0, width=1, spp=0).save(tmp_path / "a")


@pytest.mark.parametrize("failing", ["data", "header"])
def test_a_failed_save_never_pairs_old_and_new(tmp_path, monkeypatch, failing):
    """Wherever overwriting fails, what is found is the old pair, the new pair, or data that lacks its header."""
    old, new = buffer(), buffer(hit=table(8, 3, 99), coc=(3.0, 4.0))
    path = tmp_path / "a"
    old.save(path)
    done = os.replace

    def replace_or_fail(source, target):
        if str(target).endswith(".header") == (failing == "header"):
            raise OSError("the disk is gone")
        done(source, target)

    monkeypatch.setattr(image.os, "replace", replace_or_fail)
    with pytest.raises(OSError, match="the disk is gone"):
        new.save(path)
    with pytest.raises(ValueError, match="a has no header"):
        SampleBuffer.load(path)
    monkeypatch.undo()
    new.save(path)
    assert same_bits(SampleBuffer.load(path).hit, new.hit)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "a.header"]


def test_a_save_that_cannot_write_leaves_the_old_pair(tmp_path, monkeypatch):
    """As long as the new data is not on the disk, the old file can be loaded."""
    old = buffer()
    old.save(tmp_path / "a")

    def no_space(*_):
        raise OSError("no space left")

    monkeypatch.setattr("warpgi.samples_file.os.fsync", no_space)
    with pytest.raises(OSError, match="no space left"):
        buffer(hit=table(8, 3, 99), coc=(3.0, 4.0)).save(tmp_path / "a")
    monkeypatch.undo()
    again = SampleBuffer.load(tmp_path / "a")
    assert same_bits(again.hit, old.hit)
    assert again.coc == (0.0, 0.0)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "a.header"]


def test_symbolic_links_are_followed(tmp_path):
    """Saving over links writes what they point at, and leaves them links."""
    for name in ("data", "data.header"):
        (tmp_path / f"link-{name}").symlink_to(tmp_path / name)
    whole = buffer()
    for _ in range(2):
        (tmp_path / "a").unlink(missing_ok=True)
        whole.save(tmp_path / "link-data")
        assert (tmp_path / "link-data.header").is_symlink()
        assert (tmp_path / "link-data").is_symlink()
        assert same_bits(SampleBuffer.load(tmp_path / "link-data").hit, whole.hit)


def test_the_authors_file_is_read_as_by_hand(tmp_path):
    """The Cornell box that came with the authors' figures: closed, diffuse, 64 x 64 x 8, and saved again as it was."""
    folder = Path(os.environ.get("WARPGI_REFERENCE", Path(__file__).parents[1] / "../shared/reference"))
    path = folder / "cornell64.bin"
    if not path.exists():
        pytest.skip(f"{path} is not there; WARPGI_REFERENCE names the folder that holds cornell64.bin")
    rows = np.fromfile(path, dtype="<f4").reshape(64 * 64 * 8, 39)
    loaded = SampleBuffer.load(path)
    assert (loaded.width, loaded.height, loaded.spp) == (64, 64, 8)
    for name in ("bandwidth", "lens", "time", "origin_motion", "hit_motion"):
        assert getattr(loaded, name) is None, name
    for name in (*REQUIRED, "image_xy", "direct", "throughput", "hit_direct"):
        assert same_bits(getattr(loaded, name), rows[:, COLUMNS[name]]), name
    assert set(loaded.checked.counts.values()) == {0}
    assert loaded.bytes_per_sample == 116
    x, y = np.floor(loaded.image_xy).astype(int).T
    assert (loaded.pixel_of_sample == y * 64 + x).all()
    loaded.save(tmp_path / "again.bin")
    assert (tmp_path / "again.bin").read_bytes() == path.read_bytes()
