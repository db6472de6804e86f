"""`gi.denoise`: filters on the layers of finished pictures, from here and from elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

import warpgi as gi
from warpgi.__main__ import MISUSE, main
from warpgi.image import write_exr

SIZE = (24, 32)
both = pytest.mark.parametrize("method", [gi.ATrous(), gi.IrradianceFilter()], ids=["a-trous", "irradiance-filter"])


def layers(light, **others):
    """Layers of a wall that faces the viewer: an irradiance under a texture of random colours."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    albedo = rng.uniform(0.05, 1.0, (*SIZE, 3)).astype(np.float32)
    values = {
        "indirect": (albedo * np.float32(light)).astype(np.float32),
        "direct": rng.random((*SIZE, 3)).astype(np.float32),
        "emission": np.zeros((*SIZE, 3), np.float32),
        "albedo": albedo,
        "normal": np.broadcast_to(np.float32((0, 0, 1)), (*SIZE, 3)).copy(),
        "position": np.stack([x, y, 0 * x], axis=-1),
        "depth": np.full((*SIZE, 1), 10.0, np.float32),
        "hit_distance": np.full((*SIZE, 1), 30.0, np.float32),
    }
    return values | others


@both
def test_textures_round_trip(method):
    """Even light under any texture comes out as it went in, to rounding; without demodulation the texture blurs."""
    picture = layers((0.5, 1.0, 2.0))
    result = gi.denoise(picture, method).layers
    np.testing.assert_allclose(result["indirect"], picture["indirect"], rtol=4 * 2.0**-23)
    for name in set(picture) - {"indirect"}:
        np.testing.assert_array_equal(result[name], picture[name])
    blurred = gi.denoise(picture, type(method)(demodulate=False)).layers["indirect"]
    assert (blurred.std(axis=(0, 1)) < 0.5 * picture["indirect"].std(axis=(0, 1))).all()


@both
def test_noise_goes_under_a_texture(method):
    """Noise of deviation 0.3 on the light falls to less than a third, for all of the texture's contrast."""
    noise = 1.0 + 0.3 * np.random.default_rng(1).normal(size=(*SIZE, 3))
    picture = layers(noise)
    result = gi.denoise(picture, method).layers["indirect"] / picture["albedo"]
    assert result.std() < 0.1 and result.mean() == pytest.approx(noise.mean(), rel=0.01)


@both
def test_nan_pixels_are_mended_counted_and_spread_nothing(method):
    """A NaN or infinite pixel takes its neighbours' light under its own albedo; nothing else changes."""
    picture = layers((0.5, 1.0, 2.0))
    expected = picture["indirect"].copy()
    picture["indirect"][3, 4, 1], picture["indirect"][10, 10] = np.nan, np.inf
    result = gi.denoise(picture, method)
    assert result.counts["nonfinite_pixels"] == 2
    np.testing.assert_allclose(result.layers["indirect"], expected, rtol=1e-5)
    # features that are wrong as well: it stays as it is, and spreads nothing
    picture["normal"][10, 10] = np.nan
    result = gi.denoise(picture, method).layers["indirect"]
    assert np.isinf(result[10, 10]).all()
    others = np.ones(SIZE, bool)
    others[10, 10] = False
    np.testing.assert_allclose(result[others], expected[others], rtol=1e-5)
    nothing = dict(layers(1.0), indirect=np.full((*SIZE, 3), np.nan, np.float32))
    assert np.isnan(gi.denoise(nothing, method).layers["indirect"]).all()


@both
def test_dark_and_empty_pixels_stay(method):
    """Pixels without a surface, and channels that albedo does not explain, keep their light and darken nobody."""
    picture = layers((0.5, 1.0, 2.0))
    expected = picture["indirect"].copy()
    for name in ("normal", "position", "albedo", "depth"):
        picture[name][:6] = 0.0
    picture["indirect"][:6] = expected[:6] = 7.0  # a sky
    picture["albedo"][12, :, 1] = 0.0  # a metal in a layer of diffuse colour
    picture["indirect"][12, :, 1] = expected[12, :, 1] = 3.0
    result = gi.denoise(picture, method).layers["indirect"]
    np.testing.assert_array_equal(result[:6], expected[:6])
    np.testing.assert_array_equal(result[12, :, 1], expected[12, :, 1])
    np.testing.assert_allclose(result, expected, rtol=4 * 2.0**-23)


@both
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 1)])
def test_smallest_pictures(method, shape):
    """A pixel or a row is filtered as well."""
    height, width = shape
    picture = {name: layer[:height, :width].copy() for name, layer in layers((1.0, 2.0, 3.0)).items()}
    result = gi.denoise(picture, method).layers["indirect"]
    np.testing.assert_allclose(result, picture["indirect"], rtol=4 * 2.0**-23)


def test_render_keeps_what_it_is():
    """Scene, seed, spp and the input's settings stay; the variance, which no longer holds, goes."""
    noisy = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=4), size=(32, 32), seed=3)
    result = gi.denoise(noisy, gi.ATrous(iterations=3))
    assert (result.method, result.scene, result.spp, result.seed) == ("a-trous", "cornell-box", 4, 3)
    assert result.settings["iterations"] == 3
    assert result.settings["input"] == {"method": "path", "settings": noisy.settings}
    assert set(result.layers) == set(noisy.layers) - {"variance"}
    assert set(result.timings) >= {"compile", "prepare", "estimate", "image"}
    reference = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=512), size=(32, 32), seed=9).image
    assert gi.compare(result.image, reference)["relmse"] < 0.5 * gi.compare(noisy.image, reference)["relmse"]


def test_an_image_alone_and_an_image_beside():
    """Without an indirect layer the image is filtered; beside one it changes by as much as that."""
    picture = layers(1.0 + 0.3 * np.random.default_rng(1).normal(size=(*SIZE, 3)))
    parts = {name: picture.pop(name) for name in ("direct", "emission", "indirect")}
    alone = gi.denoise(picture | {"image": parts["indirect"]})
    filtered = gi.denoise(picture | {"indirect": parts["indirect"]})
    np.testing.assert_array_equal(alone.layers["image"], filtered.layers["indirect"])
    image = parts["indirect"] + 2.0
    both_layers = gi.denoise(picture | {"indirect": parts["indirect"], "image": image})
    np.testing.assert_allclose(both_layers.image, filtered.layers["indirect"] + 2.0, atol=1e-6)


@pytest.mark.parametrize("sky", [0.0, 1e10, np.inf])
def test_depth_knows_the_sky(sky):
    """Without normals, depth says where nothing was met, as programs write it: such pixels stay and darken nobody."""
    picture = layers((0.5, 1.0, 2.0))
    del picture["normal"], picture["position"]
    picture["depth"][:5], picture["indirect"][:5] = sky, 7.0
    for sigma_position in (None, 7.0):
        result = gi.denoise(picture, gi.ATrous(sigma_normal=None, sigma_position=sigma_position))
        assert result.counts["nonfinite_pixels"] == 0
        np.testing.assert_allclose(result.layers["indirect"], picture["indirect"], rtol=4 * 2.0**-23)


def test_depth_stands_in_for_position():
    """A step in depth alone keeps the light of both sides apart; without depth or position it takes a setting."""
    picture = layers(1.0)
    del picture["position"]
    picture["albedo"][:] = 1.0
    picture["depth"][:, 16:] = 20.0
    picture["indirect"][:, :16], picture["indirect"][:, 16:] = 1.0, 2.0
    result = gi.denoise(picture).layers["indirect"]
    # 5 passes, sigma 7 pixels of a 40 degree view at depth 20
    pixel = 20.0 * 2.0 * np.tan(np.radians(20.0)) / 32
    leak = 5 * np.exp(-((10.0 / (7.0 * pixel)) ** 2))
    np.testing.assert_allclose(result, picture["indirect"], atol=leak)
    flat = {name: layer for name, layer in picture.items() if name != "depth"}
    with pytest.raises(ValueError, match="expected position or depth too, or sigma_position None"):
        gi.denoise(flat)
    mixed = gi.denoise(flat, gi.ATrous(sigma_position=None)).layers["indirect"]
    assert 1.2 < mixed[10, 15].mean() < 1.8


@pytest.mark.parametrize(
    ("missing", "method", "message"),
    [
        ("albedo", gi.ATrous(), "expected albedo too, or demodulate off"),
        ("normal", gi.ATrous(), "expected normal too, or sigma_normal None"),
        ("normal", gi.IrradianceFilter(), "expected normal too"),
        ("hit_distance", gi.IrradianceFilter(), "expected hit_distance too"),
    ],
)
def test_missing_layers_are_named(missing, method, message):
    """A layer that the settings need and that is not there is named, with the way around it."""
    picture = layers(1.0)
    del picture[missing]
    with pytest.raises(ValueError, match=message):
        gi.denoise(picture, method)
    if method == gi.ATrous():
        without = gi.ATrous(**({"demodulate": False} if missing == "albedo" else {"sigma_normal": None}))
        assert np.isfinite(gi.denoise(picture, without).image).all()


def test_refusals():
    """What is no picture, no filter, or a filter of samples is refused in a sentence."""
    picture = layers(1.0)
    with pytest.raises(TypeError, match="RandomParameterFilter works on samples, not on pixels"):
        gi.denoise(picture, gi.RandomParameterFilter())
    with pytest.raises(TypeError, match="method is LightField, expected ATrous or IrradianceFilter"):
        gi.denoise(picture, gi.LightField())
    with pytest.raises(TypeError, match="picture is ndarray, expected a Render"):
        gi.denoise(picture["indirect"])
    with pytest.raises(ValueError, match="sigma_hit_normal is set"):
        gi.denoise(picture, gi.ATrous(sigma_hit_normal=1.0))
    with pytest.raises(ValueError, match="expected one of image"):
        gi.denoise({"albedo": picture["albedo"], "normal": picture["normal"]})
    with pytest.raises(ValueError, match="memory_limit is 1000 bytes"):
        gi.denoise(picture, device=gi.Device("cpu", memory_limit=1000))


def blender_file(path):
    """A multi-layer file with the passes that Blender writes for its denoiser, with a sky at depth 1e10."""
    picture = layers(1.0 + 0.3 * np.random.default_rng(1).normal(size=(*SIZE, 3)))
    picture["indirect"][:5], picture["normal"][:5], picture["depth"][:5] = 0.5, 0.0, 1e10
    channels = {}
    for name, letters, layer in (
        ("Combined", "RGB", "indirect"),
        ("Denoising Albedo", "RGB", "albedo"),
        ("Denoising Normal", "XYZ", "normal"),
        ("Denoising Depth", "Z", "depth"),
    ):
        for index, letter in enumerate(letters):
            channels[f"ViewLayer.{name}.{letter}"] = np.ascontiguousarray(picture[layer][..., index])
    write_exr(path, channels, {})
    return picture


def run(*arguments, capsys):
    status = main([str(argument) for argument in arguments])
    return status, *capsys.readouterr()


def test_command_line_denoises_another_renderers_file(tmp_path, capsys):
    """`warpgi denoise` writes what `gi.denoise` gives for Blender's passes, with settings as options; the sky stays."""
    source, out = tmp_path / "blender.exr", tmp_path / "out.exr"
    picture = blender_file(source)
    status, text, err = run(
        "denoise", source, "a-trous", "--iterations", 3, "--sigma-color", 8, "--out", out, capsys=capsys
    )
    assert status == 0 and not err
    assert "a-trous" in text and f"wrote {out}" in text
    expected = gi.denoise(gi.Render.load(source), gi.ATrous(iterations=3, sigma_color=8.0))
    result = gi.Render.load(out)
    np.testing.assert_array_equal(result.image, expected.image)
    np.testing.assert_array_equal(result.image[:5], picture["indirect"][:5])
    ratio = result.image[5:] / picture["albedo"][5:]
    assert ratio.std() < 0.15 < 0.3 - 0.1


def test_command_line_defaults_to_a_trous(tmp_path, capsys):
    """Without a filter's name it is À-Trous; wrong pixels are told."""
    source = tmp_path / "a.exr"
    picture = layers(1.0)
    picture["indirect"][2, 2] = np.nan
    gi.Render(picture).save(source)
    status, text, err = run("denoise", source, "--out", tmp_path / "b.png", capsys=capsys)
    assert status == 0 and "a-trous" in text
    assert "1 pixels were not finite" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.exr",), "missing.exr"),
        (("in.exr", "--out", "x.jpg"), "x.jpg"),
        (("in.exr", "irradiance-filter"), "expected hit_distance too"),
        (("in.exr", "a-trous", "--sigma-hit-normal", "1"), "sigma_hit_normal is set"),
        (("in.exr", "--memory-limit", "0"), "memory-limit is 0"),
        (("flat.exr",), "expected albedo too"),
    ],
)
def test_command_line_mistakes(arguments, message, tmp_path, monkeypatch, capsys):
    """Exit status 2 and one sentence."""
    monkeypatch.chdir(tmp_path)
    blender_file("in.exr")
    gi.Render({"image": np.ones((4, 4, 3), np.float32)}).save("flat.exr")
    status, out, err = run("denoise", *arguments, capsys=capsys)
    errors = [line for line in err.splitlines() if not line.startswith("warpgi: warning: no --out")]
    assert status == MISUSE and out == ""
    assert len(errors) == 1 and errors[0].startswith("warpgi: error: ") and message in errors[0]


@pytest.mark.parametrize("arguments", [("random-parameter-filter",), ("a-trous", "--iterations", "0")])
def test_command_line_misuse(arguments, capsys):
    """What the option parser refuses ends with status 2 as well."""
    with pytest.raises(SystemExit) as caught:
        main(["denoise", "in.exr", *arguments])
    assert caught.value.code == MISUSE
    assert "Traceback" not in "".join(capsys.readouterr())
