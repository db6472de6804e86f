"""The chart's page, opened in a headless browser: what it shows, and that it can be used by mouse and keyboard."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpgi as gi
from warpgi.image import encode_srgb, tone_map

CHECKOUT = Path(__file__).resolve().parent.parent
SIZE = (40, 24)


@pytest.fixture(scope="module")
def bench():
    """The package, which is part of the checkout alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(CHECKOUT))
        import bench.chart
        import bench.chart_page
        import bench.contender
        import bench.reference

        yield bench


def truth(shift=0.0):
    """Radiances of six orders of magnitude, a colour, and black."""
    x = np.geomspace(1e-3, 1e3, SIZE[0])[None, :, None] * np.array([1.0, 0.7, 0.2])
    picture = np.broadcast_to(x, (SIZE[1], SIZE[0], 3)).copy()
    picture[:4] = 0.0
    return (picture * (1.0 + shift)).astype(np.float32)


@pytest.fixture(scope="module")
def chart(bench, tmp_path_factory):
    """A folder with the page of two contenders on two scenes; pictures are off by known parts."""
    out = tmp_path_factory.mktemp("page")

    def contender(name, errors):
        def load(place):
            def run(settings, seed):
                spp = settings["spp"]
                return bench.contender.Run(
                    truth(errors[spp]), 0.1 * spp, 0.0, {"render": 0.1 * spp}, {"camera_rays": spp}
                )

            return run

        return bench.contender.Contender(name, tuple({"spp": spp} for spp in errors), load)

    made = [contender("path", {1: 0.5, 4: 0.25, 16: 0.1}), contender("</script><b>odd", {2: 0.2, 8: 0.05})]
    about = {"key": "k", "file": "reference.npz", "spp": 2, "seconds": 1.0}
    reference = bench.reference.Reference(np.stack([truth(0.001), truth(-0.001)]).astype(np.float64), about)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.chart, "contenders", lambda names: (made, ["mitsuba is left out: it is not installed"]))
        patch.setattr(bench.chart, "make_reference", lambda *a, **k: reference)
        settings = bench.chart.ChartSettings("cpu", ("furnace", "room"), SIZE, repeats=1)
        bench.chart.run(settings, out, fresh=False)
    row = {
        "method": "path",
        "scene": "caustic",
        "what": "dots",
        "value": 2.0,
        "error": 0.1,
        "bound": 1.0,
        "verdict": "fail",
    }
    (out / "stability.json").write_text(json.dumps({"rows": [row | {"verdict": "fail"}]}))
    bench.chart_page.write_page(out)
    return out


@pytest.fixture(scope="module")
def browser():
    """Chromium without a window."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install -e '.[browser]'", exc_type=ImportError
    )
    names = ("chromium", "chromium-browser", "google-chrome")
    path = os.environ.get("WARPGI_BROWSER") or next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is there, and WARPGI_BROWSER names none")
    with playwright.sync_playwright() as started:
        running = started.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture
def page(browser, chart):
    """The page at a laptop's size, opened offline; whatever it logs fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, offline=True)
    page = context.new_page()
    heard: list[str] = []
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on(
        "request", lambda request: heard.append(request.url) if not request.url.startswith(("file:", "data:")) else None
    )
    page.goto((chart / "index.html").as_uri())
    page.wait_for_function("() => document.body.dataset.shown")
    yield page
    assert heard == []
    context.close()


def shown(page):
    """Scene, point and other side of the pictures on the screen."""
    return page.evaluate("document.body.dataset.shown").split()


def wait_shown(page, *parts):
    page.wait_for_function("text => document.body.dataset.shown === text", arg=" ".join(map(str, parts)))


def pixels_of(page, canvas):
    """Pixels of the canvas that an expression names, shape (H, W, 4)."""
    url = page.evaluate(f"() => {canvas}.toDataURL('image/png')")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGBA")).astype(int)


def screen(page):
    """What the viewer shows."""
    return pixels_of(page, "viewer.canvas")


def layer(page, name):
    """A whole picture as it is painted."""
    return pixels_of(page, f"viewer.layers.{name}")


def dot(page, index):
    return page.locator(f".point[data-index='{index}']")


def test_pictures_keep_eight_bits_of_every_value(bench):
    """Rounding to eight bits, the leading one counted, costs 2^-8 at most, to half floats before 2^-11."""
    rng = np.random.default_rng(1)
    image = np.exp(rng.uniform(np.log(1e-4), np.log(6e4), (30, 20, 3))).astype(np.float32)
    image[0, :5] = [(0, 0, 0), (np.nan, -1.0, np.inf), (1e-9, 1e9, 1.0), (65504, 1, 1), (0, 1, 0)]
    data = np.frombuffer(zlib.decompress(base64.b64decode(bench.chart_page.encode_picture(image))), np.uint8)
    high, low = data.reshape(2, 3, 30, 20).astype(np.int32)
    red, green, blue = 256 * high + low
    bits = np.stack([(red + green) % 8192, green, (blue + green) % 8192], axis=-1) << 3
    values = bits.astype(np.uint16).view(np.float16).astype(np.float32)
    assert np.isfinite(values).all()
    expected = np.clip(np.nan_to_num(image, posinf=65000.0), 0.0, 65000.0)
    np.testing.assert_allclose(values, expected, rtol=2.0**-8 + 2.0**-11, atol=1e-6)


def test_the_page_is_one_file_of_sane_size(bench, chart, tmp_path):
    """It names no other file and allows no network; 256 x 256 pixels of noise take less than half a megabyte."""
    page = (chart / "index.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:)|@import|url\(|https?://(?!www\.w3\.org)", page)
    assert "default-src 'none'" in page
    assert page.count("</script>") == page.count("<script")
    rng = np.random.default_rng(2)
    assert len(bench.chart_page.encode_picture(rng.exponential(size=(256, 256, 3)))) < 500_000


def test_hovering_tells_the_settings(page):
    """The pointer over a point shows who it is, its settings and its numbers, and they go with it."""
    assert page.locator(".point").count() == 5
    dot(page, 1).hover()
    tip = page.locator("#tip")
    assert tip.is_visible()
    text = tip.inner_text()
    assert "path" in text and "spp 4" in text and "0.4 s" in text and "relMSE" in text
    page.mouse.move(5, 5)
    assert not tip.is_visible()


def test_a_click_picks_a_point(page):
    """Its pictures, name, numbers and command are shown."""
    dot(page, 2).click()
    wait_shown(page, "furnace", 2, "reference")
    assert page.locator("#tag-a").inner_text() == "path, spp 16"
    details = page.locator("#details").inner_text()
    assert "1.6" in details and "warpgi render furnace path --spp 16 --size 40 24 --seed 0" in details
    assert dot(page, 2).get_attribute("aria-pressed") == "true"
    dot(page, 4).click()
    wait_shown(page, "furnace", 4, "reference")
    assert page.locator("#tag-a").inner_text() == "</script><b>odd, spp 8"


def test_colours_are_the_librarys(page):
    """At two exposures a picture on the screen is `tone_map` and sRGB of its radiance, to two levels of 255.

    Two levels: rounding of the embedded value to 2^-8 is up to one, in the encoding, and rounding up the other.
    """
    dot(page, 0).click()
    wait_shown(page, "furnace", 0, "reference")
    before = screen(page)
    for stops in (-2.0, 3.5):
        page.locator("#exposure").fill(str(stops))
        for name, shift in (("a", 0.5), ("b", 0.0)):
            expected = np.round(255.0 * encode_srgb(tone_map(truth(shift), stops)))
            pixels = layer(page, name)
            assert (pixels[..., 3] == 255).all()
            assert np.abs(pixels[..., :3] - expected).max() <= 2.0
        after = screen(page)
        assert (before != after).any()
        before = after
    assert page.locator("#stops").inner_text() == "+3.50 EV"


def test_the_error_map_adds_up_to_relmse(page, chart):
    """Its mean is the relMSE that results.json has, up to what rounding the pictures costs."""
    content = json.loads((chart / "results.json").read_text())
    for index in (0, 3):
        dot(page, index).click()
        wait_shown(page, "furnace", index, "reference")
        map_mean = page.evaluate(
            "() => { const e = relativeSquares(viewer.a.radiance, viewer.b.radiance);"
            " return e.reduce((s, x) => s + x, 0) / e.length; }"
        )
        assert map_mean == pytest.approx(content["scenes"]["furnace"]["points"][index]["relmse_measured"], rel=0.05)


def test_the_viewer_compares_in_four_ways(page):
    """Divider, flip, side by side and error each show other pixels; the divider moves, flip shows the other side."""
    dot(page, 0).click()
    wait_shown(page, "furnace", 0, "reference")
    page.locator("#exposure").fill("0")
    seen = {}
    for name in ("Divider", "Flip", "Side by side", "Error"):
        page.get_by_role("radio", name=name).click()
        seen[name] = screen(page)
        assert page.get_by_role("radio", name=name).get_attribute("aria-checked") == "true"
        assert page.locator("#scale").is_visible() == (name == "Error")
    flip, error = seen["Flip"], seen["Error"]
    assert flip.shape == error.shape == seen["Divider"].shape != seen["Side by side"].shape
    assert (flip != error).any() and (flip != seen["Divider"]).any()
    page.get_by_role("radio", name="Flip").click()
    page.locator("#stage").click(position={"x": 50, "y": 50})
    flipped = screen(page)
    assert (flipped != flip).any() and page.locator("#tag-b").inner_text() == "reference"
    # left of the divider is one side, right of it the other
    middle = flip.shape[1] // 2
    np.testing.assert_array_equal(seen["Divider"][:, : middle - 2], flip[:, : middle - 2])
    np.testing.assert_array_equal(seen["Divider"][:, middle + 2 :], flipped[:, middle + 2 :])

    page.get_by_role("radio", name="Divider").click()
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + 60)
    page.mouse.up()
    np.testing.assert_array_equal(screen(page)[:, : int(middle * 1.7)], flip[:, : int(middle * 1.7)])


def test_zoom_and_pan_show_another_part(page):
    """The wheel enlarges about the pointer, dragging moves, a double click fits; the pointer's pixel is read out."""
    page.get_by_role("radio", name="Flip").click()
    fitted = screen(page)
    box = page.locator("#canvas").bounding_box()
    at = (box["x"] + 0.71 * box["width"], box["y"] + 0.61 * box["height"])
    page.mouse.move(*at)
    assert page.locator("#pixel").inner_text().startswith("28, 14\n")
    before = page.evaluate("viewer.zoom")
    page.mouse.wheel(0, -480)
    page.wait_for_function("before => viewer.zoom > 3.9 * before", arg=before)
    assert page.locator("#pixel").inner_text().startswith("28, 14\n")
    zoomed = screen(page)
    assert (zoomed != fitted).any()
    page.mouse.down()
    page.mouse.move(at[0] - 200, at[1])
    page.mouse.up()
    assert (screen(page) != zoomed).any()
    page.locator("#stage").dblclick(position={"x": 30, "y": 30})
    assert page.evaluate("viewer.x") == SIZE[0] / 2


def test_it_can_be_used_without_a_mouse(page):
    """Tab reaches points and viewer; arrows, digits and letters do what clicks do."""
    dot(page, 0).click()
    wait_shown(page, "furnace", 0, "reference")
    page.locator("#metric").focus()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.dataset.index") == "0"
    page.keyboard.press("ArrowRight")
    wait_shown(page, "furnace", 1, "reference")
    assert page.locator("#tip").is_visible()
    page.keyboard.press("ArrowDown")  # the other contender, at the nearest time
    wait_shown(page, "furnace", 3, "reference")
    page.keyboard.press("ArrowRight")
    wait_shown(page, "furnace", 4, "reference")
    page.locator("#scenes [data-scene=furnace]").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("() => document.body.dataset.shown.startsWith('room')")
    page.locator("#stage").focus()
    stops = page.evaluate("viewer.exposure")
    page.keyboard.press("e")
    assert page.evaluate("viewer.exposure") == stops + 0.5
    for key, mode in (("2", "flip"), ("3", "side"), ("4", "error"), ("1", "split")):
        page.keyboard.press(key)
        assert page.locator("#stage").get_attribute("data-mode") == mode
    page.keyboard.press("Space")
    page.keyboard.press("Space")
    assert page.locator("#stage").get_attribute("data-flipped") == "true"
    zoom = page.evaluate("viewer.zoom")
    page.keyboard.press("+")
    assert page.evaluate("viewer.zoom") > zoom
    page.keyboard.press("0")
    assert page.evaluate("viewer.zoom") == pytest.approx(zoom)


def test_lines_scenes_and_errors_can_be_chosen(page):
    """The legend hides a line, or all others; PSNR turns the chart over; any picture can be the one to compare with."""
    legend = page.locator("#legend button")
    legend.nth(0).click()
    assert page.locator(".point").count() == 2
    assert legend.nth(0).get_attribute("aria-pressed") == "false"
    legend.nth(0).click()
    legend.nth(0).dblclick()
    assert page.locator(".point").count() == 3

    def height(index):
        return dot(page, index).bounding_box()["y"]

    assert height(2) > height(0)
    page.locator("#metric").select_option("psnr")
    assert height(2) < height(0)
    page.locator("#against").select_option("4")
    page.wait_for_function("() => document.body.dataset.shown.endsWith(' 4')")
    assert page.locator("#tag-b").inner_text() == "</script><b>odd, spp 8"
    page.locator("#scenes [data-scene=room]").click()
    page.wait_for_function("() => document.body.dataset.shown.startsWith('room')")
    assert shown(page)[2] == "reference"


@pytest.mark.parametrize("size", [(1920, 1080), (1024, 768), (390, 844)])
def test_it_fits_every_window(page, chart, size):
    """No part is wider than the window, on a desk, a tablet and a phone, and tables and failures are all there."""
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.wait_for_timeout(200)
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert page.locator("#canvas").bounding_box()["width"] <= size[0]
    content = json.loads((chart / "results.json").read_text())["scenes"]["furnace"]
    text = page.locator("#tables").inner_text()
    for name in content["equal_time"]["rows"]:
        assert name in text
    best = [*content["equal_time"]["best"], *content["equal_error"]["best"]]
    assert page.locator("#tables td.best").count() == sum(name is not None for name in best) > 0
    assert "2 ± 0.1" in page.locator("#stability").inner_text()
    assert page.locator("#stability .fail").count() == 1
    assert "mitsuba is left out: it is not installed" in page.locator("#provenance").inner_text()


def test_a_page_without_failures_says_how_to_get_them(bench, chart, tmp_path):
    """Where stability.json is not there, the page names the command."""
    for name in ("results.json", "runs"):
        os.symlink(chart / name, tmp_path / name)
    bench.chart_page.write_page(tmp_path)
    assert "python -m bench stability" in (tmp_path / "index.html").read_text()
    assert json.loads(re.search(r'id="data">(.*?)</script>', (tmp_path / "index.html").read_text(), re.S)[1])
    assert gi.__version__ in (tmp_path / "index.html").read_text()
