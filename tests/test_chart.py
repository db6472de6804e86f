"""The chart's numbers are right for pictures and times that are known; nothing measured is lost or stale."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpgi as gi
from warpgi.__main__ import main as warpgi_main

CHECKOUT = Path(__file__).resolve().parent.parent
SIZE = (48, 40)


@pytest.fixture
def bench(monkeypatch):
    """The package, which is part of the checkout alone."""
    monkeypatch.syspath_prepend(str(CHECKOUT))
    import bench.__main__
    import bench.chart
    import bench.chart_plot
    import bench.chart_report
    import bench.contenders
    import bench.reference
    import bench.runs

    return bench


def truth():
    """A picture of several brightnesses."""
    x = np.linspace(0.05, 2.0, SIZE[0])
    return np.broadcast_to(x[None, :, None], (SIZE[1], SIZE[0], 3)) * np.array([1.0, 0.5, 0.25])


def weights(reference):
    """relMSE is the mean of these times squared differences (the library's definition, by hand)."""
    scale = 0.5 / reference.mean()
    return scale**2 / (np.square(scale * reference) + 0.01)


def noisy(rng, sigma):
    return truth() + sigma * rng.normal(size=truth().shape)


def synthetic_reference(bench, sigma, seed=1):
    """A reference whose mean has standard error `sigma`: that of each half is larger by a square root of 2."""
    rng = np.random.default_rng(seed)
    halves = np.stack([noisy(rng, np.sqrt(2.0) * sigma) for _ in range(2)])
    about = {"key": "synthetic", "file": f"synthetic-{sigma}-{seed}.npz", "spp": 2, "seconds": 0.0}
    return bench.reference.Reference(halves, about)


def synthetic(bench, name="synthetic", spps=(1, 4, 16), sigma=0.2, second=0.1, runs=None, version="1", stop=None):
    """A contender of known error, sigma / sqrt(spp) in every pixel, and known time, `second` a sample."""
    from bench.contender import Contender, Run

    def load(place):
        def run(settings, seed):
            if runs is not None:
                runs.append((name, settings["spp"], seed))
                if stop is not None and len(runs) == stop:
                    raise KeyboardInterrupt
            spp = settings["spp"]
            rng = np.random.default_rng((seed, spp, len(name)))
            picture = noisy(rng, sigma / np.sqrt(spp)).astype(np.float32)
            return Run(picture, second * spp, 3.0, {"render": second * spp}, {"camera_rays": spp})

        return run

    return Contender(name, tuple({"spp": spp} for spp in spps), load, version)


@pytest.fixture
def make_chart(bench, monkeypatch, tmp_path):
    """Makes charts of synthetic contenders in one folder; one run each is untimed, to warm up."""

    def make(contenders, sigma=1e-3, **settings):
        monkeypatch.setattr(bench.chart, "contenders", lambda names: (list(contenders), ["someone is left out"]))
        monkeypatch.setattr(bench.chart, "make_reference", lambda *a, **k: synthetic_reference(bench, sigma))
        given = {"device": "cpu", "scenes": ("furnace",), "size": SIZE, "repeats": 1} | settings
        return bench.chart.Chart(bench.chart.ChartSettings(**given), tmp_path)

    return make


def point(bench, contender, seconds, relmse, at_floor=False):
    from bench.chart_report import Point

    numbers = {"seconds": seconds, "seconds_low": seconds, "seconds_high": seconds, "compile_seconds": 0.0}
    errors = {"relmse": relmse, "relmse_measured": relmse, "rmse": 0.1, "psnr": 30.0, "flip": None}
    about = {"timings": {}, "counts": {}, "runs": ("a.npz",), "at_floor": at_floor}
    return Point("box", contender, {"spp": 1}, (0,), **numbers, **errors, **about)


def power_law(bench, name, factor, exponent=-1.0, seconds=(0.2, 0.9, 4.0, 20.0)):
    return [point(bench, name, t, factor * t**exponent) for t in seconds]


def test_known_error_and_time_come_out(bench, make_chart):
    """Pictures with noise of a known variance show that relMSE, at the known time; compile time stays apart.

    A mean of squares of n normal variables is off by sqrt(2 / n) of it, 5 times which is allowed.
    """
    sigma = 0.2
    chart = make_chart([synthetic(bench, sigma=sigma)], sigma=0.01, repeats=3)
    chart.measure()
    points = chart.points()
    assert [p.settings["spp"] for p in points] == [1, 4, 16]
    for p in points:
        spp = p.settings["spp"]
        expected = sigma**2 / spp * weights(truth()).mean()
        assert p.relmse == pytest.approx(expected, rel=5.0 * np.sqrt(2.0 / (3 * truth().size)))
        assert p.relmse_measured == pytest.approx(p.relmse + 0.01**2 * weights(truth()).mean(), rel=0.05)
        assert p.rmse == pytest.approx(np.hypot(sigma / np.sqrt(spp), 0.01), rel=0.05)
        assert p.seconds == p.seconds_low == p.seconds_high == pytest.approx(0.1 * spp)
        assert p.compile_seconds == 3.0
        assert p.seeds == (0, 1, 2)
        assert p.counts == {"camera_rays": spp}


def test_times_are_medians_and_errors_means(bench, make_chart):
    """Of three repeats the middle time counts, the lowest and highest are told."""
    from bench.contender import Contender, Run

    seconds = {0: 5.0, 1: 1.0, 2: 2.0}

    def load(place):
        return lambda settings, seed: Run((truth() * (1.0 + 0.1 * seed)).astype(np.float32), seconds[seed])

    chart = make_chart([Contender("slow", ({"spp": 1},), load)], sigma=0.0, repeats=3)
    chart.measure()
    (found,) = chart.points()
    assert (found.seconds, found.seconds_low, found.seconds_high) == (2.0, 1.0, 5.0)
    expected = np.mean([(weights(truth()) * np.square(0.1 * seed * truth())).mean() for seed in range(3)])
    assert found.relmse == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_references_noise_is_known(bench, seed):
    """Halves that scatter by sqrt(2) sigma make a mean that scatters by sigma: relMSE, PSNR and the map say so.

    The tolerance is 5 standard errors of a variance of as many values.
    """
    sigma = 0.02
    reference = synthetic_reference(bench, sigma, seed)
    slack = 5.0 * np.sqrt(2.0 / truth().size)
    expected = sigma**2 * weights(truth()).mean()
    # weights differ between pixels by a factor of 30: a quarter as many count
    assert reference.noise["relmse"] == pytest.approx(expected, rel=2 * slack)
    assert np.square(reference.standard_error).mean() == pytest.approx(sigma**2, rel=slack)
    # a perfect picture shows the reference's noise alone, before it is taken off
    errors = reference.judge(truth().astype(np.float32))
    assert errors["relmse_measured"] == pytest.approx(expected, rel=2 * slack)
    assert abs(errors["relmse"]) < 3 * slack * expected
    # grey, for the encoding is straight there and weighs all pixels alike
    rng = np.random.default_rng(seed)
    grey = 0.25 + np.sqrt(2.0) * 0.01 * rng.normal(size=(2, *truth().shape))
    reference = bench.reference.Reference(grey, {})
    perfect = gi.compare(np.full(truth().shape, 0.25), reference.image)["psnr"]
    assert reference.noise["psnr"] == pytest.approx(perfect, abs=2 * 10.0 * np.log10(1.0 + slack))


def test_nobody_is_judged_below_the_references_noise(bench, make_chart):
    """Errors above the floor are right though the reference is noisy; those below are at the floor and marked."""
    sigma = 0.05
    chart = make_chart([synthetic(bench, spps=(1, 2, 100, 10000), sigma=0.1)], sigma=sigma, repeats=2)
    chart.measure()
    floor = chart.references["furnace"].noise["relmse"]
    points = chart.points()
    assert [p.at_floor for p in points] == [False, False, True, True]
    for p, spp in zip(points[:2], (1, 2), strict=True):
        # at 2 spp the reference adds half of the error
        assert p.relmse == pytest.approx(0.1**2 / spp * weights(truth()).mean(), rel=0.1)
    assert points[2].relmse == points[3].relmse == floor
    results = chart.results()["scenes"]["furnace"]
    # equally at the floor, the faster one is better; no line is drawn to an error that is not known
    assert results["front"] == [0, 1, 2]
    assert results["lines"] == {"synthetic": [0, 1]}


def test_interpolation_is_exact_on_a_power_law(bench):
    """Between the points of error = 3 / t both directions give the law to rounding, and nothing beyond them."""
    report = bench.chart_report
    line = report.Line(power_law(bench, "a", 3.0))
    for t in np.geomspace(0.2, 20.0, 37):
        assert line.error_at(t) == pytest.approx(3.0 / t, rel=1e-12)
        assert line.seconds_at(3.0 / t) == pytest.approx(t, rel=1e-12)
    for t in (0.199, 20.1):
        assert line.error_at(t) is None
        assert line.seconds_at(3.0 / t) is None
    lone = report.Line([point(bench, "a", 1.0, 0.5)])
    assert (lone.error_at(1.0), lone.error_at(1.1), lone.seconds_at(0.5)) == (0.5, None, 1.0)
    assert report.Line([]).error_at(1.0) is None


def test_tables_compare_at_equal_time_and_equal_error(bench):
    """Columns are round numbers within what was measured; each entry is the law's, and else none."""
    points = power_law(bench, "a", 3.0) + power_law(bench, "b", 1.0, -0.5, (1.0, 100.0))
    table = bench.chart_report.equal_time(points)
    assert table.columns == (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
    assert table.rows["a"] == pytest.approx((10.0, 3.0, 1.0, 0.3, None, None))
    assert table.rows["b"] == pytest.approx((None, 1.0, 3**-0.5, 10**-0.5, 30**-0.5, 0.1))
    table = bench.chart_report.equal_error(points)
    assert table.columns == (10.0, 3.0, 1.0, 0.3, 0.1)
    assert table.rows["a"] == pytest.approx((0.3, 1.0, 3.0, 10.0, None))
    assert table.rows["b"] == pytest.approx((None, None, 1.0, 1.0 / 0.09, 100.0))
    assert table.best == ("a", "a", "b", "a", "b")
    assert bench.chart_report.equal_time([]).columns == ()


def test_the_reference_is_a_path_tracer_too(bench):
    """Where path tracing's own runs are too noisy, the table has its time by the noise of the reference: of 64 samples
    and relMSE 0.25, at 2 s for 16; nothing is said of errors below that, or without a run that tells its speed."""
    path = [replace(point(bench, "path", 2.0, 1.0), settings={"spp": 16}), point(bench, "path", 0.2, 15.0)]
    points = path + power_law(bench, "photons", 1.0, seconds=(0.3, 10.0))
    noise = bench.chart_report.PathNoise(64, 0.25)
    row = bench.chart_report.PATH_BY_NOISE
    table = bench.chart_report.equal_error(points, noise)
    assert table.columns == (10.0, 3.0, 1.0, 0.3, 0.1)
    # spp 16 has relMSE 1 by that noise as well
    assert table.rows[row] == pytest.approx((0.2, 2.0 / 3.0, 2.0, 2.0 / 0.3, None))
    assert table.best == bench.chart_report.equal_error(points).best
    assert set(bench.chart_report.equal_error(points[2:], noise).rows[row]) == {None}


def test_nobody_is_best_by_the_absence_of_others(bench):
    """Where the only entry is beaten by somebody whose line ended before, at less time and error, there is no best."""
    fast = power_law(bench, "fast", 0.01, seconds=(0.1, 1.0))
    slow = power_law(bench, "slow", 1.0, seconds=(0.5, 5.0))
    table = bench.chart_report.equal_time([*slow, *fast])
    assert dict(zip(table.columns, table.best, strict=True)) == {0.1: "fast", 0.3: "fast", 1.0: "fast", 3.0: None}
    # a point at the floor has no place on a line, but is at least so good
    table = bench.chart_report.equal_time([*slow, point(bench, "floored", 0.2, 0.01, at_floor=True)])
    assert table.rows["floored"] == (None, None) and table.best == (None, None)


def test_who_is_worse_in_both_is_not_on_the_front(bench):
    """The front holds exactly the points that no other beats in one and matches in the other."""
    good = power_law(bench, "good", 1.0)
    bad = [point(bench, "bad", 1.1 * p.seconds, 1.1 * p.relmse) for p in good]
    same_time = point(bench, "bad", good[1].seconds, 2.0 * good[1].relmse)
    same_error = point(bench, "bad", 2.0 * good[1].seconds, good[1].relmse)
    assert bench.chart_report.pareto_front([*bad, same_time, *reversed(good), same_error]) == good
    # within a line too: a dearer setting that is no better is not on it
    assert bench.chart_report.Line([*bad, *good]).points == good


def test_the_report_names_all(bench, capsys):
    """Tables, front and floor are printed; a number that was not measured is a dash."""
    points = [*power_law(bench, "good", 1.0), *power_law(bench, "bad", 9.0, seconds=(1.0, 10.0))]
    points.append(point(bench, "good", 99.0, 1e-3, at_floor=True))
    bench.chart_report.print_report(points)
    out = capsys.readouterr().out
    assert "box: relMSE at equal time" in out and "box: seconds at equal relMSE" in out
    row = next(line for line in out.splitlines() if line.split()[:1] == ["bad"])
    assert row.split()[1:] == ["-", "9", "3", "0.9"]
    assert "below the reference's noise: good (spp 1)" in out
    assert "Pareto front, fast to good: good" in out and "bad (" not in out


def test_a_rerun_does_what_is_missing(bench, make_chart, tmp_path, capsys):
    """Ctrl-C keeps what was finished and reports it; the next run takes it up, and ends as one without a break."""
    runs: list[tuple] = []
    interrupted = [synthetic(bench, "one", runs=runs, stop=4), synthetic(bench, "another", runs=runs)]
    chart = make_chart(interrupted)
    settings = chart.settings
    with pytest.raises(KeyboardInterrupt):
        bench.chart.run(settings, tmp_path, fresh=False)
    # a warm-up, two settings, and one that was broken off
    assert [run[1] for run in runs] == [1, 1, 4, 16]
    content = json.loads((tmp_path / "results.json").read_text())
    assert [p["settings"]["spp"] for p in content["scenes"]["furnace"]["points"]] == [1, 4]

    runs.clear()
    make_chart([synthetic(bench, "one", runs=runs), synthetic(bench, "another", runs=runs)])
    bench.chart.run(settings, tmp_path, fresh=False)
    assert runs == [("one", 1, 0), ("one", 16, 0), ("another", 1, 0), *(("another", n, 0) for n in (1, 4, 16))]
    resumed = json.loads((tmp_path / "results.json").read_text())["scenes"]

    runs.clear()
    bench.chart.run(settings, tmp_path, fresh=False)
    assert runs == []
    more = replace(settings, repeats=2)
    bench.chart.run(more, tmp_path, fresh=False)
    assert [run for run in runs if run[2] == 1] and {run[2] for run in runs} == {1}
    runs.clear()
    bench.chart.run(settings, tmp_path, fresh=True)
    assert len(runs) == 8
    assert json.loads((tmp_path / "results.json").read_text())["scenes"] == resumed
    capsys.readouterr()


def test_what_changed_is_measured_again(bench, make_chart):
    """Another version of the contender, depth, size or scene takes up nothing; another reference judges anew."""
    runs: list[tuple] = []
    make_chart([synthetic(bench, runs=runs)]).measure()
    first = len(runs)
    make_chart([synthetic(bench, runs=runs)]).measure()
    assert len(runs) == first
    for contender, settings in (
        (synthetic(bench, runs=runs, version="2"), {}),
        (synthetic(bench, runs=runs), {"max_depth": 5}),
        (synthetic(bench, runs=runs), {"threads": 1}),
    ):
        before = len(runs)
        make_chart([contender], **settings).measure()
        assert len(runs) == before + first
    before = len(runs)
    old = make_chart([synthetic(bench, runs=runs)])
    old.measure()
    new = make_chart([synthetic(bench, runs=runs)], sigma=0.02)
    new.measure()
    assert len(runs) == before
    assert new.points()[0].relmse_measured != old.points()[0].relmse_measured
    assert new.points()[0].relmse == pytest.approx(old.points()[0].relmse, rel=0.1)


def test_an_interrupted_write_leaves_no_half_file(bench, monkeypatch, tmp_path):
    """A run that cannot be written whole is not there, and no old one is lost; nor is a reference."""
    from bench.contender import Run

    store = bench.runs.RunStore(tmp_path / "runs")
    run, identity = Run(truth().astype(np.float32), 1.0), {"scene": "a"}
    store.save(identity, run, {"reference": "a"})
    before = store.path(identity).read_bytes()

    def half(file, **arrays):
        file.write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", half)
    for other in (identity, {"scene": "b"}):
        with pytest.raises(KeyboardInterrupt):
            store.save(other, run, {"reference": "a"})
    assert [path.read_bytes() for path in (tmp_path / "runs").iterdir()] == [before]
    assert store.load({"scene": "b"}) is None
    loaded, errors = store.load(identity)
    np.testing.assert_array_equal(loaded.indirect, run.indirect)
    assert errors == {"reference": "a"}
    store.path({"scene": "c"}).write_bytes(before[: len(before) // 2])
    assert store.load({"scene": "c"}) is None


def small_reference(bench, cache, spp=32, scene=None, size=(8, 8), **more):
    return bench.reference.make_reference(scene or gi.scenes.cornell_box(), size, spp, cache=cache, **more)


def test_a_reference_is_continued_and_kept(bench, monkeypatch, tmp_path):
    """A Ctrl-C costs one of 16 pictures; the rest makes the same bits, and what is finished is not rendered again."""
    whole = small_reference(bench, tmp_path / "whole")
    calls = []
    render = gi.render

    def counted(*arguments):
        calls.append(arguments[3])
        if len(calls) == 6:
            raise KeyboardInterrupt
        return render(*arguments)

    monkeypatch.setattr(bench.reference.gi, "render", counted)
    with pytest.raises(KeyboardInterrupt):
        small_reference(bench, tmp_path / "parts")
    assert [path.suffix for path in (tmp_path / "parts").iterdir()] == [".npz"]
    continued = small_reference(bench, tmp_path / "parts")
    assert calls == [bench.reference.FIRST_SEED + i for i in (0, 1, 2, 3, 4, 5, *range(5, 16))]
    np.testing.assert_array_equal(continued.halves, whole.halves)
    again = small_reference(bench, tmp_path / "parts")
    assert len(calls) == 17
    np.testing.assert_array_equal(again.halves, whole.halves)
    # a file that something else broke is made anew
    (path,) = (tmp_path / "parts").iterdir()
    path.write_bytes(path.read_bytes()[:500])
    np.testing.assert_array_equal(small_reference(bench, tmp_path / "parts").halves, whole.halves)
    assert len(calls) == 33


def test_a_references_noise_is_that_of_its_pixels(bench, tmp_path):
    """Against one of 64 times the paths, a reference is off by its own noise and that one's, both as they tell.

    Blocks of pixels are near normal; the ratio of two sums of 147 squares is within 0.5 to 2 but once in 10^4.
    """
    scene, size = gi.scenes.furnace(albedo=0.5, shape="blocks")[0], (28, 28)
    small = small_reference(bench, tmp_path, 16, scene, size)
    large = small_reference(bench, tmp_path, 1024, scene, size)

    def blocks(values):
        return np.reshape(values, (7, 4, 7, 4, 3)).mean(axis=(1, 3))

    told = np.square(0.5 * blocks(small.halves[0] - small.halves[1])).mean()
    told += np.square(0.5 * blocks(large.halves[0] - large.halves[1])).mean()
    found = np.square(blocks(small.halves.mean(axis=0) - large.halves.mean(axis=0))).mean()
    assert 0.5 < found / told < 2.0
    assert small.noise["relmse"] > 10.0 * large.noise["relmse"]


def test_a_stale_reference_is_not_taken(bench, monkeypatch):
    """A vertex, a colour, the camera, the size, the depth, spp or the compiled code: each makes another key."""
    device = gi.Device("cpu")

    def key(scene=None, size=(8, 8), method=None):
        return bench.reference.fingerprint(
            scene or gi.scenes.cornell_box(), size, method or gi.PathTracing(spp=1), device
        )

    box = gi.scenes.cornell_box()
    assert key() == key(box)
    moved = box.shapes[0].vertices.copy()
    moved[0, 0] += 1e-3
    dark = replace(box.shapes[0], material=gi.Diffuse(0.123))
    keys = [
        key(),
        key(replace(box, shapes=[replace(box.shapes[0], vertices=moved), *box.shapes[1:]])),
        key(replace(box, shapes=[dark, *box.shapes[1:]])),
        key(replace(box, camera=replace(box.camera, fov=box.camera.fov + 0.01))),
        key(replace(box, lights=[gi.Environment(0.01)])),
        key(size=(8, 9)),
        key(method=gi.PathTracing(spp=2)),
        key(method=gi.PathTracing(spp=1, max_depth=9)),
    ]
    (kernel,) = gi.PathTracing().kernels
    code = kernel.module.get_module_hash(1)
    monkeypatch.setattr(kernel.module, "get_module_hash", lambda block: code[::-1])
    keys.append(key())
    assert len(set(keys)) == len(keys)


def test_no_two_lines_look_alike(bench):
    """Colour and marker together tell every contender from all others."""
    count = len(bench.contenders.LADDERS) + len(bench.contenders.PEERS)
    assert len({bench.chart_plot.style(index) for index in range(count)}) == count


def test_another_process_finds_the_reference(bench):
    """The key of a scene depends on values alone, so that a reference serves every later run."""
    asked = "import warpgi as gi; from bench.reference import fingerprint as key; "
    asked += "print(key(gi.scenes.cornell_box(), (8, 8), gi.PathTracing(spp=1), gi.Device('cpu')))"
    folder = bench.reference.CHECKOUT
    there = subprocess.run([sys.executable, "-c", asked], cwd=folder, capture_output=True, text=True, check=True)
    here = bench.reference.fingerprint(gi.scenes.cornell_box(), (8, 8), gi.PathTracing(spp=1), gi.Device("cpu"))
    assert there.stdout.strip() == here


def test_every_method_is_charted_or_said_not_to_be(bench):
    """A method that is listed in METHODS has a ladder of settings that it takes, or a reason why there is none."""
    for name, kind in gi.METHODS.items():
        assert (name in bench.contenders.LADDERS) != (name in bench.contenders.NO_LIGHT), name
        for settings in bench.contenders.LADDERS.get(name, ()):
            kind(**settings)
            json.dumps(settings)
    contenders, notes = bench.contenders.contenders(tuple(gi.METHODS))
    assert [c.name for c in contenders] == [name for name in gi.METHODS if name in bench.contenders.LADDERS]
    assert len(notes) == len(gi.METHODS) - len(contenders)
    for contender in contenders:
        assert 1 <= len(contender.quick()) <= 5 and contender.quick()[0] == contender.ladder[0]


def test_a_missing_peer_is_one_line(bench, monkeypatch, make_chart):
    """Who is not installed, or cannot render a scene, is told of and left out; the others go on."""

    def missing():
        raise ImportError("it is not installed")

    def refuse(place):
        raise ValueError("it knows no lamp")

    monkeypatch.setattr(bench.contenders, "PEERS", {"peer": missing})
    contenders, notes = bench.contenders.contenders(("path", "peer"))
    assert [c.name for c in contenders] == ["path"]
    assert notes == ["peer is left out: it is not installed"]
    chart = make_chart([replace(synthetic(bench, "picky"), load=refuse), synthetic(bench)])
    chart.measure()
    assert chart.notes == ["someone is left out", "picky is left out on furnace: it knows no lamp"]
    assert {p.contender for p in chart.points()} == {"synthetic"}


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A chart of two methods on a small picture, by the command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(CHECKOUT))
        import bench.__main__
        import bench.chart
        import bench.contenders

        out = tmp_path_factory.mktemp("chart")
        patch.setattr(bench.chart.Chart.__init__, "__defaults__", (out / "cache",))
        patch.setitem(bench.contenders.LADDERS, "path", ({"spp": 1}, {"spp": 4}))
        patch.setitem(bench.contenders.LADDERS, "light-field", ({"spp": 1, "rays": 16}, {"spp": 4, "rays": 16}))
        arguments = "chart --scene cornell-box --size 16 16 --methods path light-field --repeats 2 --reference-spp 64"
        arguments += f" --device cpu --threads 2 --seed 5 --max-depth 6 --out {out}"
        assert bench.__main__.main(arguments.split()) == 0
    return out


def test_results_are_enough_to_run_a_point_again(real, tmp_path):
    """From what results.json says of a point, a user's own call or command makes the same picture, bit for bit."""
    content = json.loads((real / "results.json").read_text())
    assert {"commit", "dirty", "date", "cpu", "threads", "device", "device_name", "system"} <= set(content)
    assert {"warpgi", "warp", "numpy", "python"} <= set(content["versions"])
    points = content["scenes"]["cornell-box"]["points"]
    assert [(p["contender"], p["settings"]["spp"]) for p in points] == [
        ("path", 1), ("path", 4), ("light-field", 1), ("light-field", 4)
    ]  # fmt: skip
    for p in points:
        method = gi.METHODS[p["contender"]](max_depth=content["settings"]["max_depth"], **p["settings"])
        scene = gi.scenes.build(p["scene"])
        for seed, name in zip(p["seeds"], p["runs"], strict=True):
            render = gi.render(scene, method, tuple(content["settings"]["size"]), seed, content["device"])
            with np.load(real / "runs" / name) as file:
                np.testing.assert_array_equal(file["indirect"], render.layers["indirect"])
        assert p["seeds"] == [5, 6]
        assert p["seconds"] == pytest.approx(np.median([p["seconds_low"], p["seconds_high"]]))
        command = p["command"].replace("a.exr", str(tmp_path / "a.exr")).split()
        assert command[0] == "warpgi" and warpgi_main(command[1:]) == 0
        with np.load(real / "runs" / p["runs"][0]) as file:
            np.testing.assert_array_equal(gi.Render.load(tmp_path / "a.exr").layers["indirect"], file["indirect"])
    reference = content["scenes"]["cornell-box"]["reference"]
    assert reference["spp"] == 64 and len(reference["seeds"]) == 16
    assert not set(reference["seeds"]) & {5, 6}
    assert reference["settings"]["max_depth"] == 6 and reference["noise"]["relmse"] > 0.0


def test_the_picture_is_drawn(bench, real, tmp_path):
    """chart.png shows a panel a scene, with a line for every method."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install -e '.[bench]'")
    from PIL import Image

    content = json.loads((real / "results.json").read_text())
    bench.chart_plot.draw(tmp_path / "one.png", content)
    content["scenes"]["again"] = content["scenes"]["cornell-box"]
    bench.chart_plot.draw(tmp_path / "two.png", content)
    one, two = (np.asarray(Image.open(tmp_path / name).convert("RGB")) for name in ("one.png", "two.png"))
    assert two.shape[1] == pytest.approx(2 * one.shape[1], rel=0.01)
    for index in (0, 1):
        colour = [int(bench.chart_plot.style(index)[0][i : i + 2], 16) for i in (1, 3, 5)]
        assert 100 < (one == colour).all(axis=2).sum() < (two == colour).all(axis=2).sum()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--scene cornell-bax", "did you mean 'cornell-box'"),
        ("--scene nowhere.glb", "nowhere.glb"),
        ("--methods paths", "methods holds 'paths'"),
        ("--size 0 8", "width is 0"),
        ("--repeats 0", "repeats is 0"),
        ("--seed -1", "seed is -1"),
        ("--max-depth 0", "max_depth is 0"),
        (
            "--reference-spp 33 --scene furnace --size 8 8 --methods path",
            "reference_spp is 33, expected a multiple of 2",
        ),
        ("--device abacus", "device is 'abacus'"),
        ("--out /dev/null/chart", "/dev/null"),
    ],
)
def test_a_mistake_is_one_sentence(bench, capsys, tmp_path, arguments, words):
    """A caller's mistake ends with status 2."""
    assert bench.__main__.main(["chart", "--out", str(tmp_path), *arguments.split()]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1]
