"""The meshless hierarchy: discs that cover, functions that sum to one, and light that is finer where it varies."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

import warpgi as gi
from warpgi.meshless import SUPPORT, MeshlessHierarchy, Refinement
from warpgi.poisson_disc import SAME_SIDE, poisson_disc
from warpgi.reconstruction import PrimaryHits

UP = (0.0, 0.0, 1.0)


def corner(count, seed=0):
    """Points of three walls that meet, and their normals."""
    rng = np.random.default_rng(seed)
    axis = rng.integers(0, 3, count)
    position = rng.random((count, 3))
    position[np.arange(count), axis] = 0.0
    return position.astype(np.float32), np.eye(3, dtype=np.float32)[axis]


class Field:
    """Irradiance as a function of place, in the place of rays."""

    def __init__(self, position, light):
        self.position, self.light, self.asked = position, light, []

    def at_hits(self, hits, rays):
        self.asked.append(hits)
        return wp.array(self.light(self.position[hits].astype(np.float64)).astype(np.float32), dtype=wp.vec3)


def hierarchy(position, normal, light, radius=0.25, levels=5, tolerance=0.0, device=None, seed=0):
    hits = PrimaryHits(position, normal, np.ones_like(position), 1)
    field = Field(position, light)
    refinement = Refinement(radius, levels, tolerance, 1)
    result = MeshlessHierarchy(hits, field, device or gi.Device("cpu"), refinement, seed)
    for _ in range(levels):
        result.refine()
    return result, field


def linear(x):
    return 2.0 + x @ np.array([[1.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.5, 0.0, 0.5]])


def square(count, seed=0):
    position = np.random.default_rng(seed).random((count, 3)) * (1, 1, 0)
    return position.astype(np.float32), np.tile(np.float32(UP), (count, 1))


@pytest.mark.parametrize("radius", [0.4, 0.1, 0.02])
def test_discs_are_apart_and_cover(radius):
    """On each wall of a corner no two chosen points are nearer than the radius, and none is left uncovered."""
    position, normal = corner(6000)
    chosen = poisson_disc(position, normal, radius)
    for axis in range(3):
        wall = normal[:, axis] > SAME_SIDE
        tree = cKDTree(position[chosen[wall[chosen]]])
        apart = tree.query(tree.data, k=2)[0][:, 1]
        assert apart.min() >= radius * (1 - 1e-6)
        assert tree.query(position[wall])[0].max() < radius * (1 + 1e-6)


def test_discs_on_a_sphere_are_apart_in_their_metric():
    """On a ball |d|^2 + 8 (d.n)^2 is not below the radius' square for points that face alike; all near one."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(3000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    chosen = poisson_disc(normal, normal, 0.3)
    d = normal[:, None] - normal[chosen][None]
    along = np.maximum(np.einsum("ijk,ik->ij", d, normal) ** 2, np.einsum("ijk,jk->ij", d, normal[chosen]) ** 2)
    metric = np.square(d).sum(axis=-1) + 8.0 * along
    metric[normal @ normal[chosen].T <= SAME_SIDE] = np.inf
    assert metric.min(axis=1).max() < 0.09 * (1 + 1e-5)
    among = metric[chosen]
    np.fill_diagonal(among, np.inf)
    assert among.min() >= 0.09 * (1 - 1e-5)


def test_discs_depend_on_the_seed_alone():
    """One thread or three, any chunk: the same points; another seed, others; what is kept stays."""
    position, normal = corner(3000)
    first = poisson_disc(position, normal, 0.1, seed=3, device=gi.Device("cpu", threads=1))
    np.testing.assert_array_equal(first, poisson_disc(position, normal, 0.1, 3, device=gi.Device("cpu", threads=3)))
    other = poisson_disc(position, normal, 0.1, 3, device=gi.Device("cpu", threads=2, chunk=1))
    np.testing.assert_array_equal(first, other)
    assert not np.array_equal(first, poisson_disc(position, normal, 0.1, 4))
    kept = np.zeros(3000, bool)
    kept[first] = True
    finer = poisson_disc(position, normal, 0.05, 5, kept)
    assert np.isin(first, finer).all()
    np.testing.assert_array_equal(poisson_disc(position, normal, 0.1, 5, kept), first)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 0.0}, "radius is 0"),
        ({"position": np.full((4, 3), np.nan)}, "position holds 12"),
        ({"normal": np.zeros((3, 3))}, "normal has shape"),
        ({"kept": np.zeros(3, bool)}, "kept has shape"),
    ],
)
def test_bad_discs(change, message):
    """A caller's mistake is named."""
    arguments = {"position": np.zeros((4, 3)), "normal": np.tile(UP, (4, 1)), "radius": 0.1} | change
    with pytest.raises(ValueError, match=message):
        poisson_disc(**arguments)
    assert len(poisson_disc(np.zeros((0, 3)), np.zeros((0, 3)), 0.1)) == 0


def test_constant_light_needs_two_levels():
    """Basis functions are a partition of unity: a constant is exact, and nothing beyond the second level is asked."""
    position, normal = corner(4000)
    found, field = hierarchy(position, normal, lambda x: np.full((len(x), 3), (1.0, 2.0, 3.0)), tolerance=1e-3)
    np.testing.assert_allclose(found.value.numpy(), np.tile((1.0, 2.0, 3.0), (4000, 1)), rtol=2e-6)
    assert len(field.asked) == 2
    assert found.counts["unsupported_hits"] == 0


def test_linear_light_within_gradient_times_support():
    """Sums of values within the support of radius 2 r: no level leaves more than gradient x 2 r, refined everywhere."""
    position, normal = square(4000)
    gradient = np.linalg.norm([[1.0, 0.5, 0.0], [0.0, 0.5, 1.0]], axis=0)
    for levels in (1, 2, 3, 4):
        found, _ = hierarchy(position, normal, linear, levels=levels)
        error = np.abs(found.value.numpy() - linear(position.astype(np.float64))).max(axis=0)
        assert (error <= gradient * SUPPORT * 0.25 * 0.5 ** (levels - 1)).all()


def test_error_falls_with_the_radius_and_ends_at_every_point():
    """At tolerance 0 the RMS error falls at least as the radius does, and is rounding once discs hold one hit each."""
    position, normal = square(1500)

    def light(x):
        return 2.0 + np.sin(5.0 * x @ np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))

    truth = light(position.astype(np.float64))
    errors = []
    for levels in (2, 3, 4, 5):
        found, _ = hierarchy(position, normal, light, radius=0.4, levels=levels)
        errors.append(np.sqrt(np.mean(np.square(found.value.numpy() - truth))))
    assert np.polyfit(np.log(0.5 ** np.arange(4)), np.log(errors), 1)[0] > 1.0
    found, _ = hierarchy(position, normal, light, radius=0.4, levels=14)
    assert found.known.all()
    assert np.abs(found.value.numpy() - truth).max() < 1e-4


def test_points_lie_where_light_varies():
    """A step of light: points of the finer levels are near it, and fewer than half of those without tolerance."""
    position, normal = square(20_000)

    def step(x):
        return np.repeat(np.where(x[:, :1] < 0.5, 1.0, 3.0), 3, axis=1)

    found, field = hierarchy(position, normal, step, radius=0.08, levels=4, tolerance=0.05)
    # a level is wrong within its support of where the one before was: within 2 R in all, R the first level's support
    finest = position[np.concatenate(field.asked[2:]), 0]
    assert np.abs(finest - 0.5).max() < 2 * SUPPORT * 0.08
    _, everywhere = hierarchy(position, normal, step, radius=0.08, levels=4)
    assert sum(map(len, field.asked)) < 0.5 * sum(map(len, everywhere.asked))
    far = np.abs(position[:, 0] - 0.5) > 2 * SUPPORT * 0.08
    np.testing.assert_allclose(found.value.numpy()[far], step(position)[far], rtol=1e-5)


def test_walls_of_a_corner_do_not_mix():
    """Walls at right angles share no light, however near: each keeps its own constant to rounding."""
    position, normal = corner(3000)
    light = 1.0 + 9.0 * normal.argmax(axis=1)
    hits = PrimaryHits(position, normal, np.ones_like(position), 1)

    class Own:
        def at_hits(self, hits, rays):
            return wp.array(np.repeat(light[hits, None], 3, axis=1).astype(np.float32), dtype=wp.vec3)

    found = MeshlessHierarchy(hits, Own(), gi.Device("cpu"), Refinement(0.3, 2, 0.0, 1), 0)
    found.refine()
    np.testing.assert_allclose(found.value.numpy()[:, 0], light, rtol=1e-6)


def test_furnace():
    """Reconstructed light of a furnace is a^2 Le / (1 - a) everywhere, within what the splats' noise leaves."""
    scene, expected = gi.scenes.furnace(albedo=0.5)
    render = gi.render(scene, gi.MeshlessHierarchy(spp=4, rays=64, light_samples=4), size=(20, 20))
    wanted = np.array(expected.radiance) * 0.25
    np.testing.assert_allclose(render.layers["indirect"].mean(axis=(0, 1)), wanted, rtol=0.02)
    assert render.counts["unsupported_hits"] == 0


def test_tolerance_zero_is_the_per_pixel_reconstruction():
    """At tolerance 0 every hit is a point in the end: the picture is that of as many rays at every hit."""
    scene, size = gi.scenes.cornell_box(), (14, 14)
    method = gi.MeshlessHierarchy(spp=2, rays=32, tolerance=0.0, levels=16, light_samples=2)
    ours = gi.render(scene, method, size=size)
    theirs = gi.render(scene, gi.LightField(spp=2, rays=64, primary_hits=2, light_samples=2), size=size)
    np.testing.assert_allclose(ours.layers["indirect"], theirs.layers["indirect"], atol=1e-4, rtol=1e-3)


def test_same_picture_for_any_number_of_threads():
    """One thread or two, any chunk: the same bits and counts."""
    method = gi.MeshlessHierarchy(spp=2, rays=16, light_samples=2)
    one, two = (
        gi.render(gi.scenes.cornell_box(), method, size=(20, 20), device=gi.Device("cpu", threads=n, chunk=c))
        for n, c in ((1, None), (2, 7))
    )
    np.testing.assert_array_equal(one.layers["indirect"], two.layers["indirect"])
    assert one.counts == two.counts


def test_fewer_rays_than_one_set_per_pixel():
    """With less than half of the rays, less error than a whole set of them at every pixel."""
    scene, size = gi.scenes.cornell_box(), (64, 64)
    truth = gi.render(scene, gi.PathTracing(spp=256), size=size, seed=9).layers["indirect"]
    ours = gi.render(scene, gi.MeshlessHierarchy(spp=4, rays=64, tolerance=0.5, light_samples=4), size=size)
    theirs = gi.render(scene, gi.LightField(spp=4, rays=64, light_samples=4), size=size)
    assert ours.counts["reconstruction_rays"] < 0.5 * theirs.counts["reconstruction_rays"]
    errors = [gi.compare(r.layers["indirect"], truth)["relmse"] for r in (ours, theirs)]
    assert errors[0] < errors[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tolerance": -0.1}, "tolerance is -0.1"),
        ({"rays": 0}, "rays is 0"),
        ({"radius": 0.0}, "radius is 0"),
        ({"levels": 17}, "levels is 17"),
        ({"spp": 4, "primary_hits": 2}, "primary_hits is 2"),
    ],
)
def test_settings_out_of_range(settings, message):
    """Each setting has its range."""
    with pytest.raises(ValueError, match=message):
        gi.MeshlessHierarchy(**settings)


def test_paths_at_points():
    """With path-traced points the mean picture is path tracing's, within noise and a few per cent, and no splat is
    made; the tolerance may be 0, where every hit is a point, or not."""
    scene, size = gi.scenes.cornell_box(), (16, 16)
    truth = [
        gi.render(scene, gi.PathTracing(spp=64), size, seed).layers["indirect"].mean(dtype=np.float64)
        for seed in range(10, 14)
    ]
    for settings in ({"tolerance": 0.0, "rays": 8}, {"tolerance": 0.4, "rays": 64}):
        method = gi.MeshlessHierarchy(spp=2, light_samples=2, paths=True, **settings)
        renders = [gi.render(scene, method, size, seed) for seed in range(4)]
        means = [render.layers["indirect"].mean(dtype=np.float64) for render in renders]
        error = np.hypot(np.std(means, ddof=1), np.std(truth, ddof=1)) / 2.0
        assert abs(np.mean(means) - np.mean(truth)) < 4.4 * error + 0.02 * np.mean(truth)
        assert "splats" not in renders[0].counts
        assert renders[0].counts["point_rays"] == method.rays * renders[0].counts["points"]


def test_paths_need_a_scene():
    """A sample buffer alone has nothing to trace paths in."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=1, size=(8, 8))
    with pytest.raises(ValueError, match="paths is True"):
        gi.reconstruct(samples, gi.MeshlessHierarchy(paths=True))
