"""Open Image Denoise as a peer: what goes in comes out without its noise."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import warpgi as gi

CHECKOUT = Path(__file__).resolve().parent.parent
SIZE = (64, 48)


@pytest.fixture(scope="module")
def peer():
    """The bench's module, which is part of the checkout alone."""
    pytest.importorskip("pyoidn", reason="pyoidn is not installed: pip install 'warpgi[peers]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(CHECKOUT))
        import bench.oidn_peer

        yield bench.oidn_peer


@pytest.fixture(scope="module")
def layers():
    return gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=8), SIZE, device="cpu").layers


@pytest.mark.parametrize("prefilter", [False, True])
@pytest.mark.parametrize("demodulate", [False, True])
def test_noise_goes(peer, layers, demodulate, prefilter):
    """A noisy layer comes nearer to the truth, upright, its brightness kept, and its time told apart."""
    truth = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=256), SIZE, 1, device="cpu").layers["indirect"]
    noisy = layers["indirect"]
    before = noisy.copy()
    done = peer.OidnPeer(2, demodulate, prefilter).denoise(noisy, layers["albedo"], layers["normal"])
    assert done.layer.shape == noisy.shape
    assert done.layer.dtype == np.float32
    assert gi.compare(done.layer, truth)["relmse"] < 0.5 * gi.compare(noisy, truth)["relmse"]
    # the input's own standard error of the mean
    error = np.std(noisy - truth, axis=(0, 1)) / np.sqrt(noisy.shape[0] * noisy.shape[1])
    assert (np.abs(done.layer.mean(axis=(0, 1)) - noisy.mean(axis=(0, 1))) < 4.4 * error).all()
    assert done.seconds > 0.0
    assert done.setup_seconds > 0.0
    np.testing.assert_array_equal(noisy, before)


def test_textures_and_normals_guide_it(peer):
    """An edge that only the guides show stays where it is, in light as noisy as can be."""
    height, width = 32, 64
    rng = np.random.default_rng(0)
    albedo = np.full((height, width, 3), 0.8, np.float32)
    albedo[:, width // 2 :] = 0.2
    normal = np.broadcast_to(np.float32((0, 0, 1)), albedo.shape)
    noisy = (albedo * rng.exponential(1.0, (height, width, 1))).astype(np.float32)
    guided = peer.OidnPeer(2).denoise(noisy, albedo, normal).layer
    blind = peer.OidnPeer(2).denoise(noisy, np.ones_like(albedo), normal).layer
    edge = np.s_[:, width // 2 - 2 : width // 2 + 2]
    assert np.square(guided - albedo)[edge].mean() < 0.5 * np.square(blind - albedo)[edge].mean()


def test_demodulation_keeps_what_no_surface_reflects(peer, layers):
    """Pixels without albedo are black before and after, and finite."""
    albedo = layers["albedo"].copy()
    albedo[:8] = 0.0
    noisy = layers["indirect"].copy()
    noisy[:8] = 0.0
    result = peer.OidnPeer(2, demodulate=True).denoise(noisy, albedo, layers["normal"]).layer
    assert np.isfinite(result).all()
    assert np.abs(result[:6]).max() < 1e-2 * noisy.mean()


def test_a_missing_filter_is_one_sentence(peer, monkeypatch):
    """Without pyoidn the peer says how to get it."""
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(ValueError, match="pip install warpgi"):
        peer.OidnPeer(1)
