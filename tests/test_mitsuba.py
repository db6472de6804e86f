"""Mitsuba 3 renders our scenes as we do, and reconstruction takes its samples."""

from __future__ import annotations

import doctest
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from noise import Z_LIMIT, mean_z, two_sample_z
from scipy import stats

import warpgi as gi
from warpgi import mitsuba_samples, mitsuba_scene

CHECKOUT = Path(__file__).resolve().parent.parent
SIZE = (32, 24)  # not square: the camera's field of view is that of its height
RUNS = 32  # pictures whose scatter is the variance


@pytest.fixture(scope="module")
def peers():
    """The bench's module, which is part of the checkout alone."""
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'warpgi[peers]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(CHECKOUT))
        import bench.mitsuba_peer

        yield bench.mitsuba_peer


@pytest.fixture
def llvm(peers):
    """Mitsuba with its vectorised variant set."""
    if peers.llvm_fault() is not None:
        pytest.skip(f"mitsuba's llvm_ad_rgb does not run here: {peers.llvm_fault()}")
    return peers.require(peers.LLVM)


def picture(pictures):
    """Mean of independent pictures and the variance of that mean, as `two_sample_z` takes them."""
    pictures = np.asarray(pictures, np.float64)
    return SimpleNamespace(
        image=pictures.mean(axis=0), layers={"variance": pictures.var(axis=0, ddof=1) / len(pictures)}
    )


def assert_agree(ours, theirs):
    """Blocks of 8 x 8 pixels, and the whole pictures, differ by no more than noise."""
    assert two_sample_z(ours, theirs) < Z_LIMIT
    variance = ours.layers["variance"] + theirs.layers["variance"]
    z = mean_z(ours.image - theirs.image, variance, 0.0)
    assert np.abs(z).max() < Z_LIMIT, z


def compare(peers, scene, spp, variant="llvm_ad_rgb", size=SIZE, max_depth=5, runs=RUNS, **settings):
    """Both path tracers' pictures of a scene, `spp` * `runs` paths per pixel each."""
    peer = peers.MitsubaPeer(scene, size, max_depth, 2, variant, **settings)
    theirs = picture([peer.render(spp, seed) for seed in range(runs)])
    method = gi.PathTracing(
        spp=spp * runs, max_depth=max_depth, roulette_depth=None, sampler=gi.Sampler.INDEPENDENT
    )  # whose variance layer is unbiased
    return gi.render(scene, method, size, seed=1, device="cpu"), theirs


@pytest.mark.parametrize(
    ("name", "spp", "parameters"),
    [("cornell-box", 32, {}), ("statuettes", 32, {"resolution": 24}), ("courtyard", 12, {"detail": 0.05})],
)
def test_mitsuba_path_traces_the_same_picture(llvm, peers, name, spp, parameters):
    """Two path tracers that share no line of code agree on paints, glossy metal, textures and shading normals."""
    assert_agree(*compare(peers, gi.scenes.build(name, **parameters), spp))


# What follows stands on a floor with a wall behind, seen aslant.
GREY = gi.Diffuse((0.6, 0.5, 0.4))
CAMERA = gi.Camera((1.2, 1.3, 3.0), (0.1, 0.4, 0.0), fov=50.0)
SKY = gi.Environment((0.5, 0.7, 1.0))
SUN = gi.DistantLight((-0.5, -1.0, -0.3), (2.0, 1.8, 1.5))


def quad(corner, u, v, material=GREY, **fields):
    corner, u, v = (np.array(value, float) for value in (corner, u, v))
    vertices = [corner, corner + u, corner + u + v, corner + v]
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    return gi.Shape(vertices, [(0, 1, 2), (0, 2, 3)], material, uv=uv * (1.6, 1.3) + (0.3, -0.4), **fields)


def ball(material, smooth=True, levels=2, **fields):
    from warpgi.scenes.primitives import icosphere

    mesh = icosphere(0.5, levels).move((0.0, 0.55, 0.0))
    uv = np.stack([2.0 * mesh.normals[:, 0], mesh.normals[:, 1]], axis=1)
    normals = mesh.normals if smooth else None
    return gi.Shape(mesh.vertices, mesh.faces, material, normals=normals, uv=uv, name="ball", **fields)


def stage(*shapes, lights=(), floor=GREY, camera=CAMERA):
    ground = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), floor, name="floor")
    return gi.Scene([ground, quad((-2, 0, -1.5), (4, 0, 0), (0, 2, 0)), *shapes], camera, lights)


def stripes():
    """A texture that no turn or mirror image maps to itself."""
    pixels = np.zeros((5, 4, 3))
    pixels[..., 0] = np.linspace(0.1, 0.9, 5)[:, None]
    pixels[..., 1] = np.linspace(0.0, 0.8, 4) ** 2
    pixels[1, 2] = (0.9, 0.1, 0.8)
    return gi.Texture(pixels)


def leaf():
    """A square whose shading normals lean far over, each its own way, with the sun behind it."""
    flat = quad((-0.6, 0.2, 0.3), (1.2, 0.0, 0.1), (0.0, 1.0, -0.2))
    normals = [(-1.0, -0.8, 0.4), (1.0, -1.0, 0.3), (0.9, 1.2, 0.5), (-1.2, 0.9, 0.3)]
    return gi.Shape(flat.vertices, flat.faces, gi.Diffuse((0.7, 0.8, 0.6)), normals=normals)


LAMP = {"corner": (-0.6, 0.5, 0.6), "u": (0.4, 0.7, 0.0), "v": (0.3, 0.0, -0.5)}
STAGES = {
    "texture": stage(lights=[SKY], floor=gi.Diffuse(stripes())),
    "point light": stage(ball(GREY, smooth=False), lights=[gi.PointLight((0.8, 1.5, 0.9), (3.0, 2.0, 1.0))]),
    "spot light": stage(lights=[gi.SpotLight((0.8, 2.0, 1.0), (-0.4, -1.0, -0.5), (9.0, 8.0, 7.0), 0.2, 0.7)]),
    "parallel light": stage(ball(GREY), lights=[SUN]),
    "lamp": stage(quad(**LAMP, emission=gi.Emissive((5.0, 4.0, 3.0)))),
    "lamp of two sides": stage(quad(**LAMP, emission=gi.Emissive((5.0, 4.0, 3.0), two_sided=True))),
    "round lamp": stage(ball(gi.Diffuse(0.0), levels=0, emission=gi.Emissive((2.0, 3.0, 4.0)))),
    "mirror": stage(ball(gi.Mirror(stripes())), lights=[SUN, SKY]),
    "flat mirror": stage(ball(gi.Mirror(stripes()), smooth=False), lights=[SUN, SKY]),
    "glass": stage(ball(gi.Dielectric(1.4), smooth=False), lights=[SUN, SKY]),
    "metal": stage(ball(gi.Conductor(0.1, stripes())), lights=[SUN, SKY]),
    "gold": stage(ball(gi.Conductor(0.03, eta=(0.14, 0.37, 1.44), k=(3.98, 2.38, 1.6))), lights=[SUN, SKY]),
    "leaf": stage(leaf(), lights=[SKY, gi.DistantLight((-0.3, -1.0, 0.5), 5.0)]),
    "lens": stage(
        quad(**LAMP, emission=gi.Emissive((5.0, 4.0, 3.0))),
        floor=gi.Diffuse(stripes()),
        camera=gi.Camera(CAMERA.position, CAMERA.target, lens_radius=0.15, focus_distance=2.0),
    ),
}


@pytest.mark.parametrize("name", STAGES)
def test_everything_in_a_scene_has_its_counterpart(llvm, peers, name):
    """Each kind of light, material, texture and camera comes out alike."""
    assert_agree(*compare(peers, STAGES[name], 8, max_depth=4))


def test_the_scalar_variant_runs_the_plugins_too(peers):
    """Metal, shading normals and a spot light through a renderer that calls Python for each."""
    spot = gi.SpotLight((0.8, 2.0, 1.0), (-0.4, -1.0, -0.5), (9.0, 8.0, 7.0), 0.2, 0.7)
    scene = stage(ball(gi.Conductor(0.2, stripes())), lights=[spot, SKY])
    assert_agree(*compare(peers, scene, 1, peers.SCALAR, size=(24, 16), max_depth=3, exact=True))


def test_stock_materials_are_close(llvm, peers):
    """Where not exact: no plugin of ours, and the same picture to a tenth in every channel."""
    coated = gi.Coated((0.7, 0.4, 0.2), 0.02)
    for material, floor in ((gi.Conductor(0.1, (0.9, 0.6, 0.3)), GREY), (coated, coated)):
        scene = stage(ball(material), quad(**LAMP), lights=[SUN, SKY], floor=floor)
        ours, theirs = compare(peers, scene, 8, exact=False)
        np.testing.assert_allclose(theirs.image.mean(axis=(0, 1)), ours.image.mean(axis=(0, 1)), rtol=0.1)
        print(theirs.image.mean(axis=(0, 1)) / ours.image.mean(axis=(0, 1)))
    for scene in STAGES.values():
        own, exact = (str(llvm.load_dict(gi.to_mitsuba(scene, (8, 8), exact=exact))) for exact in (False, True))
        assert "Surface[" not in own and "Spot[" not in own
        assert mitsuba_scene.needs_plugins(scene) == ("Surface[" in exact or "Spot[" in exact)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_indirect_layers_agree(peers, request, variant):
    """Mitsuba's indirect light, freed of direct light sample by sample, is our layer, without noise of direct light."""
    if variant == peers.LLVM:
        request.getfixturevalue("llvm")
    scene, spp = gi.scenes.cornell_box(), 4
    peer = peers.MitsubaPeer(scene, SIZE, 6, 2, variant)
    theirs = [peer.indirect(spp, seed) for seed in range(RUNS)]
    assert peer.seconds > 0.0
    method = gi.PathTracing(spp=spp, max_depth=6, roulette_depth=None, sampler=gi.Sampler.INDEPENDENT)
    ours = [gi.render(scene, method, SIZE, seed, "cpu").layers["indirect"] for seed in range(RUNS)]
    assert_agree(picture(ours), picture(theirs))
    # float32 leaves of direct light what it rounds off the lamp's radiance
    assert np.min(theirs) >= -1e-6 * peer.render(spp, 0).max()
    pictures = [peer.render(1, seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[2]).any()


def test_passes_of_a_wavefront_make_one_picture(llvm, peers, monkeypatch):
    """What does not fit into one wavefront is rendered in several, of independent samples."""
    peer = peers.MitsubaPeer(STAGES["texture"], (16, 16), 3, 2, peers.LLVM)
    whole = picture([peer.render(8, seed) for seed in range(RUNS)])
    monkeypatch.setattr(peers, "WAVEFRONT", 4 * 16 * 16)
    parts = picture([peer.render(8, seed + RUNS) for seed in range(RUNS)])
    assert_agree(whole, parts)
    ratio = parts.layers["variance"].sum() / whole.layers["variance"].sum()
    # of two variances, 256 pixels of RUNS - 1 degrees of freedom each
    freedom = (RUNS - 1) * 256
    assert ratio < stats.f.isf(1e-5, freedom, freedom)


def box(mi, size, **film):
    scene = mi.cornell_box()
    # film of another shape keeps the width that is seen
    scene["sensor"]["fov_axis"] = "x"
    scene["sensor"]["film"] |= {"width": size[0], "height": size[1], "rfilter": {"type": "box"}} | film
    return mi.load_dict(scene)


def indirect_pictures(mi, scene, spp, seeds, max_depth=-1):
    """Mitsuba's own: whole pictures less what one scattering brings, of the same paths."""
    whole, direct = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (max_depth, 2))
    render = lambda integrator, seed: np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))  # noqa: E731
    return [render(whole, seed) - render(direct, seed) for seed in seeds]


def means_of_samples(samples):
    from warpgi.reconstruction import pixel_means

    return pixel_means(samples, samples.albedo * samples.radiance)


@pytest.fixture(scope="module")
def reference(peers):
    """Indirect light of Mitsuba's Cornell box, path-traced there."""
    if peers.llvm_fault() is not None:
        pytest.skip(f"mitsuba's llvm_ad_rgb does not run here: {peers.llvm_fault()}")
    mi = peers.require(peers.LLVM)
    return picture(indirect_pictures(mi, box(mi, SIZE), 32, range(RUNS)))


@pytest.mark.parametrize("spp", [5, 8])  # no grid of strata, and one
def test_samples_from_mitsuba_bring_its_indirect_light(llvm, reference, spp):
    """Albedo times radiance of the samples of Mitsuba's Cornell box is its own indirect light, at any size."""
    scene = llvm.load_dict(llvm.cornell_box())
    sampled = picture([means_of_samples(gi.sample_from_mitsuba(scene, spp, SIZE, seed)) for seed in range(RUNS)])
    assert_agree(sampled, reference)


def test_mitsubas_cornell_box_is_reconstructed(llvm, reference):
    """Reconstruction has the samples' mean to 2 % and a standard error, and a tenth of their error."""
    scene = box(llvm, SIZE)
    buffers = [gi.sample_from_mitsuba(scene, 8, SIZE, seed) for seed in range(8)]
    pictures = [gi.reconstruct(buffer, gi.LightField(rays=64)).layers["indirect"] for buffer in buffers]
    wanted = reference.image.mean(axis=(0, 1))
    means = np.mean(pictures, axis=(1, 2))
    error = means.std(axis=0, ddof=1) / len(means) ** 0.5
    limit = stats.t.isf(stats.norm.sf(Z_LIMIT), len(means) - 1)
    assert (np.abs(means.mean(axis=0) - wanted) < 0.02 * wanted + limit * error).all()
    exact = reference.image.astype(np.float32)
    before = gi.compare(means_of_samples(buffers[0]), exact)["relmse"]
    assert gi.compare(pictures[0], exact)["relmse"] < 0.1 * before


def test_a_buffer_depends_on_its_seed_alone(llvm, monkeypatch):
    """The same seed, the same samples; another, others; and bands of rows draw numbers of their own."""
    paint = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    scene = room(llvm, plate(llvm, paint))
    first, again, other = (gi.sample_from_mitsuba(scene, 2, (16, 16), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.origin, again.origin)
    np.testing.assert_array_equal(first.hit, again.hit)
    assert (first.hit != other.hit).any()
    monkeypatch.setattr(mitsuba_samples, "WAVEFRONT", 2 * 16 * 4)
    bands = gi.sample_from_mitsuba(scene, 2, (16, 16), 3)
    assert len(bands) == len(first)
    # of the plane that they see, places within pixels: the same would be the same distance apart everywhere
    places = bands.origin.reshape(4, -1, 3)
    pixel = np.ptp(bands.origin[:, 0]) / 16
    for band in range(1, 4):
        assert np.std(places[band] - places[0], axis=0).max() > 0.1 * pixel


def test_the_scene_keeps_its_film(llvm):
    """Size and crop of the film are as before, even when sampling fails half way."""
    scene = box(llvm, (20, 10), crop_width=6, crop_height=4, crop_offset_x=3, crop_offset_y=2)
    film = scene.sensors()[0].film()
    before = list(film.size()), list(film.crop_size()), list(film.crop_offset())
    gi.sample_from_mitsuba(scene, 1, (8, 8))
    resized = mitsuba_samples._film_size(llvm, scene.sensors()[0], (4, 4))
    resized.__enter__()
    assert list(film.size()) == [4, 4]
    assert resized.__exit__(RuntimeError, RuntimeError(), None) is not True
    assert before == (list(film.size()), list(film.crop_size()), list(film.crop_offset()))


def room(mi, front):
    """A lit floor behind what the camera sees first, seen from above."""
    transform = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": transform().rotate([1, 0, 0], -90).scale(20),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}},
            },
            "front": front,
            "light": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "to_world": transform().look_at(origin=[0, 4, 0], target=[0, 0, 0], up=[0, 0, 1]),
            },
        }
    )


def plate(mi, bsdf, turn=90):
    """A square between camera and floor, that shows its back to the camera."""
    transform = mi.ScalarTransform4f().translate([0, 2, 0]).rotate([1, 0, 0], turn).scale(5)
    return {"type": "rectangle", "to_world": transform, "bsdf": bsdf}


def test_primary_hits_are_of_diffuse_surfaces(llvm):
    """Glass is looked through, holes too, gloss and the black back of a one-sided paint are left out."""
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}}

    def primary(bsdf):
        samples = gi.sample_from_mitsuba(room(llvm, plate(llvm, bsdf)), 256, (2, 2))
        return samples, samples.checked.is_primary

    samples, is_primary = primary({"type": "thindielectric"})
    through = is_primary.mean()
    assert 0.8 < through < 1.0  # the rest went up into the sky
    np.testing.assert_allclose(samples.origin[is_primary, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(samples.albedo[is_primary], [[0.5, 0.4, 0.3]] * is_primary.sum(), rtol=1e-5)
    np.testing.assert_allclose(samples.origin_normal[is_primary], [[0, 1, 0]] * is_primary.sum(), atol=1e-6)

    for dark in (paint, {"type": "roughconductor"}):
        assert not primary(dark)[1].any()

    samples, is_primary = primary({"type": "twosided", "bsdf": paint})
    assert is_primary.all()
    np.testing.assert_allclose(samples.albedo, [[0.2, 0.3, 0.4]] * len(samples), rtol=1e-5)
    np.testing.assert_allclose(samples.origin_normal, [[0, 1, 0]] * len(samples), atol=1e-6)
    escaped = samples.checked.is_escaped
    assert escaped.all()
    assert (samples.direction[:, 1] > 0.0).all()
    assert (samples.radiance == 0.0).all()  # the sky's own emission is direct light

    samples, is_primary = primary({"type": "mask", "opacity": 0.25, "bsdf": {"type": "twosided", "bsdf": paint}})
    assert is_primary.all()
    above = samples.origin[:, 1] > 1.0
    assert stats.binomtest(int(above.sum()), len(above), 0.25).pvalue > 1e-5
    np.testing.assert_allclose(samples.albedo[above], [[0.2, 0.3, 0.4]] * above.sum(), rtol=1e-5)
    np.testing.assert_allclose(samples.albedo[~above], [[0.5, 0.4, 0.3]] * (~above).sum(), rtol=1e-5)


def test_light_at_secondary_hits(llvm):
    """`recursive` records a direct part that is never more than the whole, and the reflectance there."""
    samples = gi.sample_from_mitsuba(box(llvm, (16, 16)), 8, (16, 16), recursive=True)
    hit = samples.checked.is_splat
    assert (samples.hit_direct <= samples.radiance * (1.0 + 1e-5) + 1e-6).all()
    assert samples.hit_direct[hit].mean() > 0.0
    paints = np.unique(samples.throughput[hit].round(4), axis=0)
    assert len(paints) == 3  # white, green, red
    assert gi.reconstruct(samples, gi.LightField(rays=16, recursive=1)).layers["indirect"].mean() > 0.0
    # two segments from the secondary hit's own light: nothing but that
    short = gi.sample_from_mitsuba(box(llvm, (16, 16)), 8, (16, 16), max_depth=3, recursive=True)
    np.testing.assert_allclose(short.radiance, short.hit_direct, rtol=1e-5, atol=1e-6)
    assert gi.sample_from_mitsuba(box(llvm, (16, 16)), 1, (4, 4), max_depth=2).radiance.max() == 0.0


@pytest.mark.parametrize("module", [mitsuba_samples, mitsuba_scene])
def test_docstring_examples(llvm, module):
    """Every example gives what it says."""
    result = doctest.testmod(module)
    assert result.attempted > 0 and result.failed == 0


def test_the_readmes_snippet(llvm, tmp_path, monkeypatch):
    """What the README shows of Mitsuba runs as it stands."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (CHECKOUT / "README.md").read_text(), re.DOTALL)
    (block,) = (block for block in blocks if "import mitsuba" in block)
    names: dict = {}
    exec(compile(block, "README.md", "exec"), names)
    # a whole picture: the reconstruction's bias is below 2 % and its noise, of half a million samples, far below
    whole = np.array(names["mitsuba"].render(names["scene"], spp=64)).mean(axis=(0, 1))
    np.testing.assert_allclose(names["picture"].mean(axis=(0, 1)), whole, rtol=0.02)


def test_mistakes_are_one_sentence(peers, monkeypatch):
    """Before anything is traced."""
    mi = peers.require(peers.SCALAR)
    scene = gi.scenes.cornell_box()
    with pytest.raises(TypeError, match="scene is int"):
        gi.to_mitsuba(3)
    with pytest.raises(ValueError, match="width is 0"):
        gi.to_mitsuba(scene, (0, 8))
    with pytest.raises(ValueError, match="max_depth is 0"):
        gi.to_mitsuba(scene, max_depth=0)
    glass = stage(ball(gi.Dielectric(), emission=gi.Emissive(1.0, two_sided=True)))
    with pytest.raises(mitsuba_scene.NoCounterpart, match="ball is glass that emits on both sides"):
        gi.to_mitsuba(glass)
    with pytest.raises(mitsuba_scene.NoCounterpart, match="Coated is only nearly"):
        gi.to_mitsuba(stage(ball(gi.Coated())))
    with pytest.raises(ValueError, match="scalar_rgb, expected a vectorised one"):
        gi.sample_from_mitsuba(mi.load_dict(mi.cornell_box()))
    for variant in (None, "llvm_ad_spectral"):
        monkeypatch.setitem(sys.modules, "mitsuba", SimpleNamespace(variant=lambda variant=variant: variant))
        with pytest.raises(ValueError, match=f"variant is {variant}, expected an RGB one"):
            gi.to_mitsuba(scene)
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    for call in (lambda: gi.to_mitsuba(scene), lambda: gi.sample_from_mitsuba(None)):
        with pytest.raises(ImportError, match="pip install 'warpgi"):
            call()


def test_sampling_refuses_what_is_no_scene(llvm):
    """Nor a scene without a camera, or a depth without indirect light."""
    scene = box(llvm, (8, 8))
    with pytest.raises(TypeError, match=r"mi_scene is Scene, expected a mitsuba\.Scene of llvm_ad_rgb"):
        gi.sample_from_mitsuba(gi.scenes.cornell_box())
    with pytest.raises(ValueError, match="no sensor"):
        gi.sample_from_mitsuba(llvm.load_dict({"type": "scene", "a": {"type": "sphere"}}))
    with pytest.raises(ValueError, match="sensor is 1"):
        gi.sample_from_mitsuba(scene, sensor=1)
    with pytest.raises(ValueError, match="max_depth is 1"):
        gi.sample_from_mitsuba(scene, max_depth=1)


def test_llvm_that_is_missing_is_one_sentence(peers, monkeypatch):
    """Where the library cannot be found the peer says so, in a process that goes on."""
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so")
    peers.llvm_fault.cache_clear()
    try:
        with pytest.raises(peers.MissingPeer, match="apt install libllvm19") as raised:
            peers.MitsubaPeer(gi.scenes.cornell_box(), (8, 8), 3, 1, peers.LLVM)
        assert "\n" not in str(raised.value)
    finally:
        peers.llvm_fault.cache_clear()
