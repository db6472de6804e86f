"""Render: one set of layers that survives the disk and that other tools can read and write."""

from __future__ import annotations

import enum
import json

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from warpgi.result import LAYERS, Render


def noise(channel_count: int = 3, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((10, 14, channel_count), dtype=np.float32)


def full_render() -> Render:
    layers = {
        name: noise(len(layer.channels), seed) for seed, (name, layer) in enumerate(LAYERS.items()) if name != "image"
    }
    return Render(
        layers,
        timings={"compile": 1.25, "upload": 0.1, "prepare": 0.0, "estimate": 1 / 3, "image": 1e-5},
        counts={"camera_rays": 2**40, "nonfinite": 0},
        method="light_field",
        settings={"spp": 8, "radius": float("inf"), "bounds": (1.0, 2.0), "name": 'a "b" ü', "part": {"on": True}},
        seed=2**63 + 1,
        spp=8,
        scene="Küche",
        device="cpu",
        versions={"warpgi": "0.1.0", "warp": "1.19.0"},
    )


def raw(path) -> tuple[dict[str, np.ndarray], dict]:
    file = OpenEXR.File(str(path), separate_channels=True)
    return {name: channel.pixels for name, channel in file.channels().items()}, file.header()


def write_raw(path, names: list[str], pixel_type=np.float32) -> dict[str, np.ndarray]:
    channels = {name: noise(1, seed)[..., 0].astype(pixel_type) for seed, name in enumerate(names)}
    OpenEXR.File({}, dict(channels)).write(str(path))  # it replaces the values of what it is given
    return channels


def test_image_is_the_sum_of_the_parts_that_exist():
    """image = emission + direct + indirect in float32, whichever are there; alone a part is the image."""
    emission, direct, indirect = (noise(seed=seed) for seed in range(3))
    assert np.array_equal(
        Render({"emission": emission, "direct": direct, "indirect": indirect}).image, emission + direct + indirect
    )
    assert np.array_equal(Render({"direct": direct, "albedo": noise()}).image, direct)
    assert np.array_equal(Render({"direct": direct, "image": indirect}).image, indirect)
    with pytest.raises(ValueError, match="render holds albedo, expected one of image, emission"):
        _ = Render({"albedo": noise()}).image


def test_image_does_not_change_the_layers():
    """Asking for the image twice gives the same, and the layers stay as they were."""
    render = Render({"emission": noise(), "direct": noise(seed=1)})
    assert np.array_equal(render.image, render.image)
    assert np.array_equal(render.layers["emission"], noise())


def test_exr_keeps_everything(tmp_path):
    """All layers come back to the bit, and so do timings, counts, settings, seed and names."""
    render = full_render()
    render.layers["depth"][0, 0] = np.inf
    render.layers["position"][1, 1] = np.nan
    render.save(tmp_path / "a.exr")
    loaded = Render.load(tmp_path / "a.exr")
    assert list(loaded.layers) == list(render.layers)
    for name, pixels in render.layers.items():
        assert loaded.layers[name].dtype == np.float32
        assert np.array_equal(loaded.layers[name].view(np.uint32), pixels.view(np.uint32)), name
    for field in ("timings", "counts", "method", "settings", "seed", "spp", "scene", "device", "versions"):
        assert getattr(loaded, field) == getattr(render, field), field
    loaded.save(tmp_path / "b.exr")
    assert (tmp_path / "b.exr").read_bytes() == (tmp_path / "a.exr").read_bytes()


def test_exr_channels_have_the_names_that_other_tools_read(tmp_path):
    """The image is plain R, G, B and each layer follows the table; all are 32-bit floats, ZIP-compressed."""
    render = full_render()
    render.save(tmp_path / "a.exr")
    channels, header = raw(tmp_path / "a.exr")
    names = ["R", "G", "B", "depth.Z", "hit_distance.Z", "records.Z"]
    names += [f"{layer}.{c}" for layer in ("emission", "direct", "indirect", "albedo", "variance") for c in "RGB"]
    names += [f"{layer}.{c}" for layer in ("normal", "position") for c in "XYZ"]
    assert sorted(channels) == sorted(names)
    assert {pixels.dtype for pixels in channels.values()} == {np.dtype(np.float32)}
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    for index, name in enumerate("RGB"):
        assert np.array_equal(channels[name], render.image[..., index])
        assert np.array_equal(channels[f"indirect.{name}"], render.layers["indirect"][..., index])
        assert np.array_equal(channels[f"normal.{'XYZ'[index]}"], render.layers["normal"][..., index])
    assert np.array_equal(channels["depth.Z"], render.layers["depth"][..., 0])


def test_exr_attributes_tell_how_it_was_made(tmp_path):
    """Any EXR tool shows method, scene, seed, spp and seconds as text, and JSON for the rest."""
    render = full_render()
    render.save(tmp_path / "a.exr")
    _, header = raw(tmp_path / "a.exr")
    text = {name: header[f"warpgi:{name}"] for name in ("method", "scene", "device", "seed", "spp")}
    assert text == {"method": "light_field", "scene": "Küche", "device": "cpu", "seed": str(2**63 + 1), "spp": "8"}
    assert float(header["warpgi:seconds"]) == pytest.approx(1.25 + 0.1 + 1 / 3 + 1e-5, rel=1e-5)
    for name in ("settings", "timings", "counts", "versions"):
        assert json.loads(header[f"warpgi:{name}"]) == getattr(render, name)


def test_non_finite_radiance_is_kept_in_exr_and_shown_in_png(tmp_path):
    """A wrong pixel stays wrong in the EXR, and magenta in the PNG; its layers are not taken for another image."""
    render = Render({"emission": noise(), "indirect": noise(seed=1)})
    render.layers["emission"][2, 3, 0] = np.inf
    render.layers["indirect"][2, 3, 0] = -np.inf
    render.save(tmp_path / "a.exr")
    loaded = Render.load(tmp_path / "a.exr")
    assert list(loaded.layers) == ["emission", "indirect"]
    assert np.isnan(loaded.image[2, 3, 0])
    with pytest.warns(RuntimeWarning, match="1 pixels in magenta"):
        render.save(tmp_path / "a.png")


def test_png_takes_the_exposure(tmp_path):
    """Two stops up, 0.1 is shown as 0.4: sRGB(0.4) = 0.6652, code 170."""
    Render({"direct": np.full((2, 2, 3), 0.1, np.float32)}).save(tmp_path / "a.png", exposure=2.0)
    with Image.open(tmp_path / "a.png") as picture:
        assert np.unique(np.asarray(picture)).tolist() == [170]


def test_unknown_suffixes_are_refused(tmp_path):
    """Only .exr and .png are known, in any case."""
    with pytest.raises(ValueError, match=r"a\.tiff, expected a name that ends in \.exr or \.png"):
        full_render().save(tmp_path / "a.tiff")
    with pytest.raises(FileNotFoundError, match="there is no directory"):
        full_render().save(tmp_path / "none" / "a.exr")
    full_render().save(tmp_path / "a.EXR")
    assert Render.load(tmp_path / "a.EXR").spp == 8


FOREIGN = {
    "plain": (["R", "G", "B"], {"image": "RGB"}),
    "plain with alpha and depth": (["R", "G", "B", "A", "Z"], {"image": "RGB", "depth": ["Z"]}),
    "two spellings": (["Depth.T", "Depth.V", "Depth.Z"], {"depth": ["Depth.Z"]}),
    "blender": (
        [f"ViewLayer.Combined.{c}" for c in "RGBA"]
        + [f"ViewLayer.{layer}.{c}" for layer in ("DiffCol", "DiffDir", "DiffInd", "Emit") for c in "RGB"]
        + [f"ViewLayer.{layer}.{c}" for layer in ("Normal", "Position") for c in "XYZ"]
        + ["ViewLayer.Depth.Z", "ViewLayer.Mist.Z", "ViewLayer.IndexOB.X"],
        {
            "image": [f"ViewLayer.Combined.{c}" for c in "RGB"],
            "albedo": [f"ViewLayer.DiffCol.{c}" for c in "RGB"],
            "normal": [f"ViewLayer.Normal.{c}" for c in "XYZ"],
            "position": [f"ViewLayer.Position.{c}" for c in "XYZ"],
            "depth": ["ViewLayer.Depth.Z"],
        },
    ),
    "blender with denoising data": (
        [f"Composite.Combined.{c}" for c in "RGBA"]
        + [f"View Layer.{layer}.{c}" for layer in ("Combined", "Denoising Albedo", "DiffCol") for c in "RGB"]
        + [f"View Layer.{layer}.{c}" for layer in ("Denoising Normal",) for c in "XYZ"],
        {
            "image": [f"View Layer.Combined.{c}" for c in "RGB"],
            "albedo": [f"View Layer.Denoising Albedo.{c}" for c in "RGB"],
            "normal": [f"View Layer.Denoising Normal.{c}" for c in "XYZ"],
        },
    ),
    # As Mitsuba 3.9.1 wrote it for aovs = "dd:depth,pos:position,nn:sh_normal,gn:geo_normal,albedo:albedo,uv:uv".
    "mitsuba": (
        [*"RGB", "dd.T", "uv.U", "uv.V"]
        + [f"{layer}.{c}" for layer in ("pos", "nn", "gn") for c in "XYZ"]
        + [f"{layer}.{c}" for layer in ("albedo", "img") for c in "RGB"],
        {
            "image": "RGB",
            "albedo": [f"albedo.{c}" for c in "RGB"],
            "normal": [f"nn.{c}" for c in "XYZ"],
            "position": [f"pos.{c}" for c in "XYZ"],
            "depth": ["dd.T"],
        },
    ),
    "mitsuba as documented": (
        [*"RGB", "dd.y.T", *(f"nn.{c}" for c in "XYZ")],
        {"image": "RGB", "normal": [f"nn.{c}" for c in "XYZ"], "depth": ["dd.y.T"]},
    ),
    # Its Variance is that of the samples, not of their mean, and its u and v are texture coordinates.
    "pbrt": (
        [*"RGB", "u", "v", "dzdx", "dzdy"]
        + [f"{layer}.{c}" for layer in ("P", "N", "Ns") for c in "XYZ"]
        + [f"{layer}.{c}" for layer in ("Albedo", "Variance", "RelativeVariance") for c in "RGB"],
        {
            "image": "RGB",
            "albedo": [f"Albedo.{c}" for c in "RGB"],
            "normal": [f"Ns.{c}" for c in "XYZ"],
            "position": [f"P.{c}" for c in "XYZ"],
        },
    ),
}


@pytest.mark.parametrize("pixel_type", [np.float16, np.float32])
@pytest.mark.parametrize("tool", FOREIGN)
def test_files_of_other_tools_load_as_far_as_known(tmp_path, tool, pixel_type):
    """Blender, Mitsuba, pbrt and plain RGB files give the layers that they name, unchanged, and no others."""
    names, expected = FOREIGN[tool]
    channels = write_raw(tmp_path / "a.exr", names, pixel_type)
    render = Render.load(tmp_path / "a.exr")
    assert sorted(render.layers) == sorted(expected)
    for layer, sources in expected.items():
        for index, source in enumerate(sources):
            assert np.array_equal(render.layers[layer][..., index], channels[source]), (layer, source)
    assert (render.method, render.seed, render.spp, render.settings) == ("", 0, 0, {})


def test_a_foreign_image_beside_parts_is_kept(tmp_path):
    """Where R, G, B is not the sum of the parts, as after denoising, it stays the image, also through warpgi."""
    write_raw(tmp_path / "a.exr", [*"RGB", *(f"direct.{c}" for c in "RGB")])
    render = Render.load(tmp_path / "a.exr")
    assert list(render.layers) == ["image", "direct"]
    render.save(tmp_path / "b.exr")
    again = Render.load(tmp_path / "b.exr")
    assert list(again.layers) == ["image", "direct"]
    assert np.array_equal(again.image, render.image)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["ch00", "ch01"], "holds ch00, ch01, expected R, G, B or a known layer"),
        ([f"{v}.Combined.{c}" for v in ("front", "back") for c in "RGB"], "image as (front|back).Combined and as"),
    ],
)
def test_unclear_files_are_refused(tmp_path, names, message):
    """A file with no known layer, or with two view layers, raises one sentence with its name."""
    write_raw(tmp_path / "a.exr", names)
    with pytest.raises(ValueError, match=message) as caught:
        Render.load(tmp_path / "a.exr")
    assert "a.exr" in str(caught.value)


def test_layers_of_two_sizes_are_refused(tmp_path):
    """Layers of different sizes, here parts with their own data windows, cannot make one Render."""
    parts = []
    for name, height in (("image", 4), ("albedo", 2)):
        header = {"name": name, "displayWindow": ((0, 0), (3, 3)), "dataWindow": ((0, 0), (3, height - 1))}
        parts.append(OpenEXR.Part(header, {c: np.zeros((height, 4), np.float32) for c in "RGB"}))
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr cannot be loaded: layer albedo has \(2, 4\) pixels"):
        Render.load(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("attribute", "text"),
    [
        ("settings", "{"),
        ("settings", "[]"),
        ("counts", '{"rays": "many"}'),
        ("seed", "1.5"),
        ("spp", ""),
        ("spp", "true"),
    ],
)
def test_edited_metadata_is_refused(tmp_path, attribute, text):
    """Attributes that are not as warpgi writes them raise a ValueError with the file's name."""
    channels = {c: np.zeros((2, 2), np.float32) for c in "RGB"}
    OpenEXR.File({f"warpgi:{attribute}": text}, channels).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr"):
        Render.load(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("layers", "error", "message"),
    [
        ({}, ValueError, "layers is empty"),
        ({"beauty": noise()}, ValueError, "layers holds 'beauty', expected names out of image, emission"),
        ({"direct": noise().astype(np.float64)}, TypeError, "layer direct is of float64 values"),
        ({"direct": [[0.0]]}, TypeError, "layer direct is of list"),
        ({"depth": noise()}, ValueError, r"layer depth has shape \(10, 14, 3\), expected \(H, W, 1\)"),
        ({"depth": noise()[..., 0]}, ValueError, r"layer depth has shape \(10, 14\)"),
        ({"direct": noise()[:0]}, ValueError, "with H, W above 0"),
        ({"direct": noise(), "albedo": noise()[1:]}, ValueError, r"layer albedo has \(9, 14\) pixels"),
    ],
)
def test_wrong_layers_are_refused(layers, error, message):
    """An unknown name, another type or shape, and layers of two sizes each raise one sentence with the layer."""
    with pytest.raises(error, match=message):
        Render(layers)


def test_metadata_is_what_json_keeps():
    """numpy numbers and Enums become plain ones at once, so that saving cannot fail after the work; objects cannot."""

    class Kernel(enum.Enum):
        CONE = "cone"

    settings = {"rays": np.int64(3), "kernel": Kernel.CONE, "range": (1, np.float32(0.5))}
    render = Render(
        {"direct": noise()}, settings=settings, counts={"rays": np.int64(5)}, timings={"image": np.float32(2)}
    )
    assert render.settings == {"rays": 3, "kernel": "cone", "range": [1, 0.5]}
    assert type(render.counts["rays"]) is int
    assert type(render.timings["image"]) is float
    with pytest.raises(TypeError, match="settings of path cannot be kept as JSON: object"):
        Render({"direct": noise()}, method="path", settings={"device": object()})
