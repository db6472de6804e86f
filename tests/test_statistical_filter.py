"""Statistical filter: claims on sequences whose light and noise are known, and on rendered ones."""

import numpy as np
import pytest
from PIL import Image

import warpgi as gi
from warpgi.__main__ import main
from warpgi.filter_animation import high_share
from warpgi.frame_renderer import frame_seed
from warpgi.image import to_srgb8
from warpgi.modes import Rule, by_epsilon, noise_edges, percent_var, principal_components
from warpgi.resampling import trace_pixels
from warpgi.statistical_filtering import FrameMatrix, Projection

SIDE = 40
PIXELS = SIDE * SIDE


def animation_of(frames):
    """An animation of a flat wall with these indirect layers, shape (N, H, W, 3)."""
    height, width = frames.shape[1:3]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    wall = {
        "normal": np.tile(np.float32([0, 0, 1]), (height, width, 1)),
        "position": np.stack([x, y, np.zeros_like(x)], axis=2),
    }
    renders = [gi.Render({"indirect": np.asarray(frame, np.float32), **wall}) for frame in frames]
    return gi.Animation(renders, tuple(range(len(frames))))


def smooth_images(count, seed=1):
    """Images without much in common, shape (count, SIDE, SIDE, 3), of mean square 1."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 1.0, SIDE)
    waves = rng.normal(size=(count, 3, 4, 4))
    cosines = np.cos(np.pi * np.arange(4)[:, None] * x)
    images = np.einsum("ncij,iy,jx->nyxc", waves, cosines, cosines)
    return images / np.sqrt(np.square(images).mean(axis=(1, 2, 3), keepdims=True))


def rank(count, frames, seed=1):
    """A sequence of exact rank `count`, positive, shape (frames, SIDE, SIDE, 3)."""
    images = smooth_images(count, seed)
    images[0] = 4.0 + 0.5 * images[0]
    t = np.arange(frames) / frames
    courses = np.stack([np.ones(frames), *(np.cos(2.0 * np.pi * (k * t + 0.1 * k * k)) for k in range(1, count))])
    strength = np.append(1.0, 0.9 ** np.arange(1, count))
    return np.einsum("k,kt,kyxc->tyxc", strength, courses, images)


def noise(shape, sigma, seed=0):
    return sigma * np.random.default_rng(seed).normal(size=shape)


def filtered(frames, device=None, **settings):
    result = gi.filter_animation(animation_of(frames), gi.StatisticalFilter(**settings), device or gi.Device("cpu"))
    return result.stack("indirect"), result.modes


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("sigma", [0.05, 0.5])
@pytest.mark.parametrize("kind", ["even", "pixels", "light"])
def test_rank_comes_back(count, sigma, kind):
    """A sequence of exact rank r plus noise has that many modes above the floor, the mean counted as one: noise that is
    even, of a pixel's own strength (ten to one), or in proportion to the light of a frame that triples."""
    signal = rank(count, 36)
    scale = np.ones((1, 1, 1, 1))
    if kind == "pixels":
        scale = np.exp(np.random.default_rng(3).uniform(0.0, np.log(10.0), (1, SIDE, SIDE, 1))) / 4.0
    if kind == "light":
        scale = np.linspace(1.0, 3.0, 36)[:, None, None, None]
        signal = signal * scale
    _, modes = filtered(signal + scale * noise(signal.shape, sigma), epsilon=0.0, per_pixel=False)
    expected = 1 + np.linalg.matrix_rank((signal - signal.mean(axis=0)).reshape(36, -1), tol=1e-6)
    assert expected == (count + 1 if kind == "light" else count)
    assert modes.count == expected
    assert modes.rule is Rule.NOISE_FLOOR
    assert modes.eigenvalues[expected] <= modes.noise_edge < modes.eigenvalues[expected - 1]


def test_the_floor_is_the_edge_of_noise():
    """The bound on noise alone is where Marchenko and Pastur say, or up to 10 % above as it takes a noisy frame's sum
    of squares, itself known to 3 %; a still picture's largest eigenvalue of noise is below in all of 20 draws."""
    frames, sigma = 60, 0.3
    ratios = []
    for seed in range(20):
        data = 5.0 + noise((frames, 24, 24, 3), sigma, seed)
        columns = data.reshape(frames, -1).T
        values, vectors = principal_components(columns.T @ columns)
        edge = noise_edges(columns.T @ columns, values, vectors, columns.shape[0])[1]
        law = sigma**2 * (np.sqrt(columns.shape[0]) + np.sqrt(frames)) ** 2
        assert law < edge < 1.1 * law
        ratios.append(values[1] / edge)
    assert np.mean(ratios) > 0.85
    assert max(ratios) < 1.0


def test_a_still_sequence_is_its_mean():
    """Still light: every frame is the mean over the frames, to float32, and its variance is that of a frame divided by
    their number."""
    frames, sigma = 50, 0.4
    truth = 6.0 + smooth_images(1)[0].clip(-3.0)
    noisy = truth + noise((frames, SIDE, SIDE, 3), sigma)
    result, modes = filtered(noisy)
    assert modes.count == 1
    np.testing.assert_allclose(result, np.broadcast_to(noisy.mean(axis=0), result.shape), rtol=1e-5)
    # a chi-square over 4800 values: standard error 2 %
    assert np.square(result - truth).mean() == pytest.approx(sigma**2 / frames, rel=0.1)


def test_a_ramp_is_exact_with_one_mode():
    """Light that changes linearly in time needs one mode beside the mean, and comes back to float32."""
    images = smooth_images(2).clip(-1.5)
    ramp = 2.0 + images[0] + np.arange(20)[:, None, None, None] * (2.0 + images[1])
    result, modes = filtered(ramp)
    assert modes.count == 2
    assert modes.rule is Rule.EPSILON
    np.testing.assert_allclose(result, ramp, rtol=2e-5)


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_a_step_stays_a_step(sigma):
    """A light that goes on at one frame: less than 2 % of it is seen in the frame before or missing in the next."""
    before, after = 2.0 + 0.5 * smooth_images(2).clip(-3.0)
    after = before + 2.0 * after.clip(0.0)
    signal = np.concatenate([np.tile(before, (15, 1, 1, 1)), np.tile(after, (25, 1, 1, 1))])
    result, modes = filtered(signal + noise(signal.shape, sigma))
    assert modes.count == 2
    step = after - before
    for frame, expected in ((14, 0.0), (15, 1.0)):
        seen = ((result[frame] - before) * step).sum() / np.square(step).sum()
        assert abs(seen - expected) < 0.02


def test_a_flash_of_one_frame_stays():
    """Light that is there in one frame only is no noise, however much of that frame it is."""
    still = 2.0 + 0.5 * smooth_images(2).clip(-3.0)
    signal = np.tile(still[0], (30, 1, 1, 1))
    signal[11] += 3.0 * still[1]
    result, modes = filtered(signal + noise(signal.shape, 0.3))
    assert modes.count == 2
    flash = 3.0 * still[1]
    seen = ((result - still[0]) * flash).sum(axis=(1, 2, 3)) / np.square(flash).sum()
    np.testing.assert_allclose(seen, np.arange(30) == 11, atol=0.02)


def test_hues_do_not_drift():
    """Light of one hue whose blue is ten times as noisy as its red: the hue of each frame's sum stays what it is, to
    within the noise of that sum."""
    hue = np.array([1.0, 0.6, 0.2])
    course = 2.0 + np.cos(np.arange(40) / 5.0)
    pattern = 3.0 + smooth_images(2)[..., 0]
    signal = course[:, None, None] * pattern[0] + (course[::-1] ** 2)[:, None, None] * 0.3 * pattern[1]
    signal = signal[..., None] * hue
    sigma = np.array([0.05, 0.1, 0.5])
    result, _ = filtered(signal + noise(signal.shape, sigma))
    sums, true = result.sum(axis=(1, 2)), signal.sum(axis=(1, 2))
    error = np.abs(sums / sums.sum(axis=1, keepdims=True) - hue / hue.sum())
    bound = 4.4 * sigma * SIDE / true.sum(axis=1, keepdims=True)
    assert (error < bound + 1e-6).all()


def test_streaming_equals_in_core():
    """Four frames in memory at a time or all of them, one thread or three: the same bits."""
    signal = rank(3, 23)
    noisy = signal + noise(signal.shape, 0.3)
    whole, modes = filtered(noisy)
    for device in (gi.Device("cpu", memory_limit=100_000), gi.Device("cpu", threads=1), gi.Device("cpu", threads=3)):
        matrix = FrameMatrix(lambda i: noisy[i], 23, (SIDE, SIDE), device)
        assert len(matrix.blocks) == (6 if device.memory_limit == 100_000 else 1)
        part, others = filtered(noisy, device)
        np.testing.assert_array_equal(part, whole)
        np.testing.assert_array_equal(others.eigenvalues, modes.eigenvalues)
        np.testing.assert_array_equal(others.truncation, modes.truncation)


def test_products_are_those_of_float64():
    """D^T D of frames of any number, pixels of any number: to float32's rounding over one strip of rows."""
    device = gi.Device("cpu")
    for frames, side in ((1, 1), (5, 13), (9, 31)):
        data = np.random.default_rng(0).random((frames, side, side, 3), np.float32)
        gram = FrameMatrix(lambda i, data=data: data[i], frames, (side, side), device).gram()
        columns = data.reshape(frames, -1).T.astype(np.float64)
        np.testing.assert_allclose(gram, columns.T @ columns, rtol=1e-6)
        np.testing.assert_array_equal(gram, gram.T)


def test_paper_s_rules():
    """The lowest x that leaves epsilon or less and whose next mode explains epsilon_change or less."""
    values = np.array([90.0, 7.0, 2.0, 0.6, 0.3, 0.1])
    np.testing.assert_allclose(percent_var(values), [1.0, 0.1, 0.03, 0.01, 0.004, 0.001, 0.0], atol=1e-12)
    assert by_epsilon(values, 0.05, 1.0) == 2
    assert by_epsilon(values, 0.005, 1.0) == 4
    assert by_epsilon(values, 0.005, 0.0035) == 4
    assert by_epsilon(values, 0.005, 0.002) == 5
    assert by_epsilon(values, 1.0, 0.002) == 5
    assert by_epsilon(np.full(100, 1.0), 0.005, 0.001) == 100


def test_epsilon_is_reported_where_it_stops_first():
    """With little noise the paper's rules stop before the floor; with much the floor does."""
    signal = rank(6, 30)
    _, modes = filtered(signal + noise(signal.shape, 0.001), epsilon=0.05, epsilon_change=0.05)
    assert modes.rule is Rule.EPSILON
    assert modes.count < 6
    _, modes = filtered(signal + noise(signal.shape, 0.5), epsilon=0.005)
    assert (modes.rule, modes.count) == (Rule.NOISE_FLOOR, 6)
    _, modes = filtered(signal, modes=2)
    assert (modes.rule, modes.count) == (Rule.BY_HAND, 2)
    _, modes = filtered(signal + noise(signal.shape, 0.01), epsilon=0.0, max_modes=3)
    assert (modes.rule, modes.count) == (Rule.LIMIT, 3)


def test_pixels_choose_their_own_number():
    """One half still, the other of rank 6: the map says 1 and 6, and the still half's noise falls by that ratio."""
    signal = rank(6, 48)
    half = SIDE // 2
    signal[:, :, :half] = signal[0, :, :half]
    noisy = signal + noise(signal.shape, 0.3)
    result, modes = filtered(noisy, epsilon=0.0)
    uniform, _ = filtered(noisy, epsilon=0.0, per_pixel=False)
    assert modes.count >= 6
    inner = modes.truncation[:, 3 : half - 8], modes.truncation[:, half + 8 : -3]
    assert inner[0].max() < 1.5
    assert inner[1].mean() == pytest.approx(6.0, abs=0.5)
    still = [np.square(x - signal)[:, :, : half - 8].mean() for x in (result, uniform)]
    # noise goes with the number of modes; bias of the rest is below it
    assert still[0] / still[1] == pytest.approx(1.0 / modes.count, rel=0.25)
    moving = [np.square(x - signal)[:, :, half + 8 :].mean() for x in (result, uniform)]
    assert moving[0] < 1.2 * moving[1]


def test_truncation_between_whole_numbers():
    """A truncation of 2.3 is 0.7 of the solution with 2 and 0.3 of that with 3."""
    signal = 10.0 + rank(4, 20)
    projection = Projection(
        FrameMatrix(lambda i: signal[i], 20, (SIDE, SIDE), gi.Device("cpu")),
        gi.StatisticalFilter(modes=4, per_pixel=False),
        (SIDE, SIDE),
        dict,
    )
    frames = {}
    for truncation in (2.0, 2.3, 3.0):
        projection._truncation.fill_(truncation)
        frames[truncation] = projection.frame(7)
    np.testing.assert_allclose(frames[2.3], 0.7 * frames[2.0] + 0.3 * frames[3.0], rtol=1e-4, atol=1e-5)


def test_one_frame_stays_as_it_is():
    """One frame has one mode, itself: nothing is known of its noise."""
    frame = rank(3, 1) + noise((1, SIDE, SIDE, 3), 0.3)
    result, modes = filtered(frame)
    assert modes.count == 1
    np.testing.assert_allclose(result, frame.clip(0.0), rtol=1e-5, atol=1e-6)


def test_pixels_that_are_no_numbers_are_counted():
    """They come out as black at the worst, and every frame says how many it had."""
    frames = smooth_images(4)
    frames[1][2, 3, 0], frames[1][5, 5], frames[2][0, 0, 1] = np.nan, np.inf, -np.inf
    result = gi.filter_animation(animation_of(frames))
    assert np.isfinite(result.stack("indirect")).all()
    assert [result[k].counts.get("nonfinite_pixels", 0) for k in range(4)] == [0, 2, 1, 0]
    assert result.counts["nonfinite_pixels"] == 3


def test_more_frames_than_pixels():
    """A picture of four pixels over fifty frames is filtered too, and a still one comes to its mean."""
    noisy = 5.0 + noise((50, 2, 2, 3), 0.2)
    result, modes = filtered(noisy)
    assert modes.count == 1
    assert np.square(result - 5.0).mean() < np.square(noisy - 5.0).mean() / 5.0


# --- rendered sequences ------------------------------------------------------------------------------------------

SIZE = (16, 16)


def light(frames=5):
    return gi.scenes.moving_light(frames=frames)


def test_filtered_frames_keep_all_but_the_indirect_light(tmp_path):
    """`render_animation` with the filter equals rendering, then filtering, in memory and in files; direct light and
    features are the noisy frames'."""
    method = gi.StatisticalFilter(spp=4)
    memory = gi.render_animation(light(), method, SIZE, device="cpu")
    files = gi.render_animation(light(), method, SIZE, device="cpu", out=tmp_path / "f-{:02d}.exr")
    noisy = gi.render_animation(light(), gi.PathTracing(spp=4), SIZE, device="cpu")
    apart = gi.filter_animation(noisy, method, "cpu")
    for number in range(5):
        for layer in ("direct", "normal", "albedo"):
            np.testing.assert_array_equal(files[number].layers[layer], noisy[number].layers[layer])
        for other in (files, apart):
            np.testing.assert_array_equal(memory[number].layers["indirect"], other[number].layers["indirect"])
        assert "variance" not in files[number].layers
        assert files[number].method == "statistical-filter"
        assert files[number].settings["input"]["method"] == "path"
    assert memory.modes.average_spp == 4
    kept = gi.Modes.load(tmp_path / "modes.npz")
    np.testing.assert_array_equal(kept.basis, memory.modes.basis)
    assert (kept.count, kept.rule, kept.average_spp) == (memory.modes.count, memory.modes.rule, 4)
    sums = np.einsum("k,kyxc->yxc", kept.weights[2], kept.basis)
    flat = gi.render_animation(light(), gi.StatisticalFilter(spp=4, per_pixel=False), SIZE, device="cpu")
    np.testing.assert_allclose(flat[2].layers["indirect"], sums.clip(0.0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "estimator", [gi.LightField(spp=1, rays=8), gi.PhotonMap(spp=1, photons=500), gi.AmbientOcclusion(spp=1, rays=4)]
)
def test_any_estimator_in_front(estimator):
    """Noisy frames may come from any method; light of the estimators that make it keeps its mean within 2 %."""
    method = gi.StatisticalFilter(estimator=estimator)
    result = gi.render_animation(light(), method, SIZE, device="cpu")
    noisy = gi.render_animation(light(), estimator, SIZE, device="cpu")
    assert result.stack().mean() == pytest.approx(noisy.stack().mean(), rel=0.02)
    assert (result[0].image != noisy[0].image).any()


def test_damaged_files_are_made_again(tmp_path):
    """Cut noisy and filtered frames are found and made again, and no others; the files end as they were."""
    method = gi.StatisticalFilter(spp=2)
    out = tmp_path / "f-{:02d}.exr"
    gi.render_animation(light(), method, SIZE, device="cpu", out=out)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.exr")}
    assert len(before) == 10
    for path in (tmp_path / "noisy" / "f-01.exr", tmp_path / "f-03.exr"):
        path.write_bytes(before[path][:-100])
    again = gi.render_animation(light(), method, SIZE, device="cpu", out=out, resume=True)
    assert again.rendered == (3,)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.exr")} == before
    other = gi.render_animation(light(), gi.StatisticalFilter(spp=2, modes=1), SIZE, device="cpu", out=out, resume=True)
    assert other.rendered == (0, 1, 2, 3, 4)


@pytest.mark.parametrize("name", ["moving-light", "moving-ball"])
def test_chosen_pixels_are_those_of_the_whole_picture(name):
    """Sampling some pixels gives what rendering the picture gives there, to the last bit."""
    scene = gi.scenes.build_sequence(name, frames=3).scene(1)
    method = gi.PathTracing(spp=3)
    whole = gi.render(scene, method, (12, 10), seed=9, device="cpu").layers["indirect"].reshape(-1, 3)
    pixels = np.array([0, 17, 55, 119])
    np.testing.assert_array_equal(trace_pixels(scene, pixels, method, (12, 10), 9, gi.Device("cpu")), whole[pixels])


def test_importance_sampling():
    """Pixels whose M is above modes_low are mixed with new samples as in the paper's formula, others left alone; the
    reported samples per pixel are those that were taken."""
    base = gi.StatisticalFilter(spp=2, modes=3)
    high = gi.StatisticalFilter(spp=2, modes=3, high_spp=8, modes_low=1.2, modes_high=2.0)
    plain = gi.render_animation(light(), base, SIZE, device="cpu")
    mixed = gi.render_animation(light(), high, SIZE, device="cpu")
    truncation = plain.modes.truncation
    share = high_share(truncation, high)
    np.testing.assert_allclose(share, np.clip((truncation - 1.2) / 0.8, 0.0, 1.0), atol=1e-6)
    assert 0 < (share > 0).sum() < share.size
    pixels = np.arange(share.size)
    for number in range(5):
        a, b = plain[number].layers["indirect"], mixed[number].layers["indirect"]
        np.testing.assert_array_equal(a[share == 0], b[share == 0])
        seed = frame_seed(frame_seed(0, number), number)
        new = trace_pixels(light().scene(number), pixels, gi.PathTracing(spp=8), SIZE, seed, gi.Device("cpu"))
        expected = (1.0 - share[..., None]) * a + share[..., None] * new.reshape(a.shape)
        np.testing.assert_allclose(b, expected, rtol=1e-5, atol=1e-6)
    assert mixed.modes.average_spp == 2 + 8 * (share > 0).mean()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spp": 0}, "spp is 0"),
        ({"epsilon": -1.0}, "epsilon is -1"),
        ({"epsilon_change": 2.0}, "epsilon_change is 2"),
        ({"modes": 0}, "modes is 0"),
        ({"max_modes": 0}, "max_modes is 0"),
        ({"map_radius": -1.0}, "map_radius is -1"),
        ({"high_spp": -1}, "high_spp is -1"),
        ({"modes_low": 5.0, "modes_high": 5.0}, "modes_high is 5"),
    ],
)
def test_bad_settings(settings, message):
    """A setting out of range is named."""
    with pytest.raises(ValueError, match=message):
        gi.StatisticalFilter(**settings)


def test_bad_arguments(tmp_path):
    """What cannot be filtered is refused in one sentence."""
    noisy = animation_of(rank(2, 3))
    with pytest.raises(TypeError, match="method is StatisticalFilter, which is for a Sequence"):
        gi.render(gi.scenes.cornell_box(), gi.StatisticalFilter())
    with pytest.raises(TypeError, match="noisy is list"):
        gi.filter_animation([])
    with pytest.raises(TypeError, match="method is PathTracing, expected StatisticalFilter"):
        gi.filter_animation(noisy, gi.PathTracing())
    with pytest.raises(ValueError, match="high_spp is 8, expected 0"):
        gi.filter_animation(noisy, gi.StatisticalFilter(high_spp=8))
    with pytest.raises(ValueError, match="vary_seed is False, expected True"):
        gi.render_animation(light(2), gi.StatisticalFilter(spp=1), SIZE, vary_seed=False)
    with pytest.raises(TypeError, match="method is StatisticalFilter, which is for a Sequence"):
        gi.render_animation(light(2), gi.StatisticalFilter(estimator=gi.StatisticalFilter()), SIZE)
    bare = gi.Animation([gi.Render({"indirect": np.full((4, 4, 3), v, np.float32)}) for v in range(3)], (0, 1, 2))
    with pytest.raises(ValueError, match="frames hold no layer normal"):
        gi.filter_animation(bare, gi.StatisticalFilter(modes=2))
    sizes = gi.Animation([gi.Render({"indirect": np.ones((4, n, 3), np.float32)}) for n in (4, 5)], (0, 1))
    with pytest.raises(ValueError, match="frame 1 has"):
        gi.filter_animation(sizes)
    (tmp_path / "modes.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="holds no basis functions"):
        gi.Modes.load(tmp_path / "modes.npz")


def test_filter_on_the_command_line(tmp_path, capsys):
    """`warpgi animate` with the filter writes what `warpgi filter` makes of the noisy frames it keeps, and both say how
    many modes there are."""
    frames = ["moving-light:frames=3", "statistical-filter", "--spp", "2", "--size", "8", "8", "--device", "cpu"]
    assert main(["animate", *frames, "--out", str(tmp_path / "a" / "f-{:02d}.exr")]) == 0
    assert "modes (chosen:" in capsys.readouterr().out
    noisy, out = tmp_path / "a" / "noisy" / "f-{:02d}.exr", tmp_path / "b" / "f-{:02d}.exr"
    assert main(["filter", str(noisy), "--device", "cpu", "--out", str(out)]) == 0
    assert "3 frames filtered, 0 found" in capsys.readouterr().out
    for number in range(3):
        ours, theirs = (gi.Render.load(tmp_path / folder / f"f-{number:02d}.exr") for folder in "ab")
        np.testing.assert_array_equal(ours.image, theirs.image)
    assert main(["filter", str(tmp_path / "none-{:02d}.exr")]) == 2
    assert "none-00.exr does not exist" in capsys.readouterr().err


def test_preview(tmp_path, capsys):
    """Noisy, filtered and reference side by side, an animated PNG of as many pictures as frames, at the sequence's
    speed; animations that do not fit together are refused."""
    noisy = gi.render_animation(light(3), gi.PathTracing(spp=1), SIZE, device="cpu", out=tmp_path / "n-{:02d}.exr")
    smooth = gi.filter_animation(noisy, device="cpu")
    gi.write_preview(tmp_path / "a.png", noisy, smooth, noisy, exposure=1.0)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (3 * 16 + 2 * 4, 16)
        assert image.n_frames == 3
        image.seek(2)
        assert image.info["duration"] == pytest.approx(1000.0 / 24.0, abs=1.0)
        shown = np.asarray(image.convert("RGB"))
    np.testing.assert_array_equal(shown[:, 20:36], to_srgb8(smooth[2].image, 1.0)[0])
    np.testing.assert_array_equal(shown[:, 40:], to_srgb8(noisy[2].image, 1.0)[0])
    with pytest.raises(ValueError, match="have 3, 1 frames"):
        gi.write_preview(tmp_path / "b.png", noisy, gi.Animation([noisy[0]], (0,)))
    files = str(tmp_path / "n-{:02d}.exr")
    out = ["--out", str(tmp_path / "f" / "f-{:02d}.exr"), "--device", "cpu"]
    assert main(["filter", files, *out, "--reference", files, "--preview", str(tmp_path / "c.png")]) == 0
    with Image.open(tmp_path / "c.png") as image:
        assert (image.size, image.n_frames) == ((56, 16), 3)
