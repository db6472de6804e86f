"""The device layer: every core, any chunk, any memory limit, one source for CUDA."""

import importlib
import pkgutil

import numpy as np
import pytest
import warp as wp

import warpgi as gi
import warpgi.kernels

wp.set_module_options({"enable_backward": False})


def kernels_of(name):
    module = importlib.import_module(f"warpgi.kernels.{name}")
    return [
        value
        for value in vars(module).values()
        if isinstance(value, wp.Kernel) and value.module.name == module.__name__
    ]


# files of device functions alone are compiled with the kernels that call them
KERNEL_MODULES = sorted(m.name for m in pkgutil.iter_modules(warpgi.kernels.__path__) if kernels_of(m.name))


@wp.kernel
def square(offset: int, values: wp.array[int], result: wp.array[int]):
    i = offset + wp.tid()
    result[i] = values[i] * values[i]


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("chunk", [None, 1, 7, 10_000])
@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_launch_covers_every_index_once(threads, chunk, count):
    """Each index below the count is computed, none beyond, for any number of threads and any chunk."""
    device = gi.Device("cpu", threads=threads, chunk=chunk)
    result = device.array(np.full(1001, -1), int)
    device.launch(square, count, [device.array(np.arange(1001), int)], [result])
    np.testing.assert_array_equal(result.numpy()[:count], np.arange(count) ** 2)
    assert (result.numpy()[count:] == -1).all()


def test_worker_errors_reach_the_caller():
    """What goes wrong in a worker thread is raised in the caller's."""
    device = gi.Device("cpu", threads=2)
    with pytest.raises(RuntimeError, match="square"):
        device.launch(square, 1000, [device.zeros(10, float)], [device.zeros(1000, int)])


def same_pictures(one, other):
    for name, layer in one.layers.items():
        np.testing.assert_array_equal(layer, other.layers[name], err_msg=name)
    assert one.counts == other.counts


@pytest.mark.parametrize("sampler", gi.Sampler)
def test_threads_chunks_and_memory_do_not_change_a_picture(sampler):
    """One thread or many, any chunk, one band or many: bit-equal layers and equal counts."""
    scene = gi.scenes.cornell_spheres()
    method = gi.PathTracing(spp=5, sampler=sampler)
    scene_bytes = warpgi.device_scene.DeviceScene(scene, gi.Device("cpu")).nbytes

    def render(**device):
        return gi.render(scene, method, size=(37, 23), device=gi.Device("cpu", **device))

    first = render(threads=1)
    same_pictures(first, render(threads=2))
    same_pictures(first, render(threads=3, chunk=17))
    # room for a hundred pixels: nine bands
    same_pictures(first, render(memory_limit=scene_bytes + 100 * warpgi.film.BYTES_PER_PIXEL))


def test_passes_do_not_change_a_picture(monkeypatch):
    """However the clock cuts the samples into passes, the picture is the same to the last bit."""
    scene = gi.scenes.cornell_box()
    pictures = []
    for seconds in (0.0, 10.0):
        monkeypatch.setitem(gi.render.__globals__, "PASS_SECONDS", seconds)
        pictures.append(gi.render(scene, gi.PathTracing(spp=9), size=(16, 16)))
    same_pictures(*pictures)


def test_memory_limit_too_small():
    """A limit that cannot hold the scene and one pixel is refused before anything is computed."""
    with pytest.raises(ValueError, match="memory_limit is 1000 bytes, expected enough"):
        gi.render(gi.scenes.cornell_box(), size=(8, 8), device=gi.Device("cpu", memory_limit=1000))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "cuda:99"}, "device is 'cuda:99'"),
        ({"name": "gpu"}, "device is 'gpu'"),
        ({"name": "cpu", "threads": 0}, "threads is 0"),
        ({"name": "cpu", "memory_limit": 0}, "memory_limit is 0"),
        ({"name": "cpu", "chunk": -1}, "chunk is -1"),
    ],
)
def test_bad_devices(arguments, message):
    """A device that is not there, or numbers out of range, are named in one sentence."""
    with pytest.raises(ValueError, match=message):
        gi.Device(**arguments)


@pytest.mark.parametrize("name", KERNEL_MODULES)
def test_compiles_for_cuda(name, tmp_path):
    """Every kernel module compiles to PTX for sm_75, the GTX 16 series, without a GPU or its driver."""
    module = importlib.import_module(f"warpgi.kernels.{name}")
    wp.compile_aot_module(wp.get_module(module.__name__), arch=[75], module_dir=tmp_path, use_ptx=True)
    ptx = list(tmp_path.glob("*.ptx"))
    assert len(ptx) == 1
    text = ptx[0].read_text()
    assert ".target sm_75" in text
    assert all(kernel.key in text for kernel in kernels_of(name))
