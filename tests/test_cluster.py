"""Sequences on Dask workers: the files of one process, also where a worker dies."""

import os
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
from test_animation import PATH, SIZE, contents
from test_statistical_filter import animation_of, noise, rank

import warpgi as gi
from warpgi import cluster as clusters
from warpgi import cluster_frames
from warpgi.__main__ import main
from warpgi.frame_renderer import FrameRenderer
from warpgi.statistical_filtering import FrameMatrix

distributed = pytest.importorskip("distributed", reason="the extra `cluster` brings it")


@pytest.fixture(scope="module")
def client():
    """Two processes of one thread each."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", memory_limit=None, silence_logs="CRITICAL"
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        yield client


def animate(out, sequence, method=PATH, **settings):
    return gi.render_animation(sequence, method, SIZE, 3, "cpu", out=out / "f-{:03d}.exr", **settings)


def test_a_killed_worker_changes_no_file(tmp_path, client):
    """SIGKILL to a worker in the middle: the files are those of one process to the last bit, frames that were there
    and whole are kept, one cut short is rendered again, and progress goes over all."""
    speed = 0.01  # of a sequence that this file alone knows: functions go to the workers too
    light = [gi.PointLight((0.1 + speed * frame, 0.4, 0.3), 0.5) for frame in range(12)]
    box = gi.scenes.cornell_box()
    sequence = gi.Sequence(12, lambda frame: gi.Scene(box.shapes, box.camera, [light[frame]]))
    method = gi.PathTracing(spp=300)
    animate(tmp_path / "one", sequence, method)
    there = tmp_path / "many"
    animate(there, sequence, method, frames=[0, 1])
    data = (there / "f-001.exr").read_bytes()
    (there / "f-001.exr").write_bytes(data[: len(data) // 2])
    victim = next(iter(client.run(os.getpid).values()))
    heard = []

    def kill(state):
        heard.append(state.done)
        if state.done == 3:
            os.kill(victim, signal.SIGKILL)

    animation = animate(there, sequence, method, resume=True, cluster=client, progress=kill)
    assert animation.rendered == tuple(range(1, 12))
    assert animation.frames == tuple(range(12))
    assert heard == list(range(1, 13))
    assert victim not in client.run(os.getpid).values()
    assert contents(there) == contents(tmp_path / "one")


def test_state_is_carried_on_every_worker(tmp_path, client):
    """Frames that depend on those before them are the same wherever they are rendered."""
    method = gi.InstantRadiosity(paths=16, spp=1, renewed_paths=2)
    sequence = gi.scenes.moving_light(frames=5)
    animate(tmp_path / "one", sequence, method)
    animate(tmp_path / "many", sequence, method, frames=[1, 2, 4], cluster=client)
    animate(tmp_path / "many", sequence, method, resume=True, cluster=client)
    assert contents(tmp_path / "many") == contents(tmp_path / "one")


def test_a_frame_that_is_rendered_late(client):
    """A worker that was past a frame goes back for it, as where another died, with the state of the frames before."""
    renderer = FrameRenderer(
        gi.scenes.moving_light(frames=4),
        gi.InstantRadiosity(paths=16, spp=1, renewed_paths=2),
        SIZE,
        3,
        gi.Device("cpu"),
        True,
    )
    recipe = cluster_frames._recipe(renderer)
    identities = dict(renderer.identities(range(4)))
    worker = list(client.nthreads())[:1]
    for number in (3, 1):
        identity, picture = client.submit(cluster_frames._render, "run", recipe, number, workers=worker).result()
        assert identity == identities[number]
        expected = FrameRenderer(renderer.sequence, renderer.method, SIZE, 3, renderer.device, True)
        np.testing.assert_array_equal(picture.image, expected.render(expected.open(number)).image)


@pytest.mark.parametrize("size", [(40, 40), (96, 64)], ids=["one slab", "several"])
def test_products_of_frames_are_the_same(client, size):
    """The matrix of products of all pairs is the same to the last bit here and there, in core and streamed."""
    frames = np.random.default_rng(1).normal(size=(11, size[1], size[0], 3)).astype(np.float32)
    device = gi.Device("cpu")
    expected = FrameMatrix(frames.__getitem__, 11, size, device).gram()
    small = gi.Device("cpu", memory_limit=4 * 4 * 3 * size[0] * size[1] * 2)
    there = clusters.Cluster(client, "test")
    for each in (device, small):
        matrix = FrameMatrix(frames.__getitem__, 11, size, each)
        np.testing.assert_array_equal(matrix.gram(there), expected)
    assert len(matrix.blocks) > 1


def test_filtered_sequences_are_the_same(tmp_path, client):
    """Noisy frames, filtered frames and basis functions, of a rendered sequence and of any frames."""
    method = gi.StatisticalFilter(spp=2, high_spp=4, modes_low=0.5)
    sequence = gi.scenes.moving_light(frames=4)
    for name, cluster in (("one", False), ("many", client)):
        animation = animate(tmp_path / name, sequence, method, cluster=cluster)
        assert animation.modes.average_spp > 2.0
    for folder in ("", "noisy"):
        assert contents(tmp_path / "many" / folder) == contents(tmp_path / "one" / folder)
    assert (tmp_path / "many" / "modes.npz").read_bytes() == (tmp_path / "one" / "modes.npz").read_bytes()
    frames = animation_of(rank(3, 9) + noise((9, 40, 40, 3), 0.1))
    here, there = (
        gi.filter_animation(frames, device="cpu", cluster=each).stack("indirect") for each in (False, client)
    )
    np.testing.assert_array_equal(here, there)


def test_errors_of_a_worker_arrive(client, monkeypatch):
    """What fails on a worker fails here, with the same words; the workers stay usable."""
    there = clusters.Cluster(client, "test")
    with pytest.raises(ValueError, match="invalid literal"):
        list(there.run(int, [("a", "1"), ("b", "x")]))
    assert dict(there.run(int, [("a", "1"), ("b", "2")])) == {"a": 1, "b": 2}
    monkeypatch.setattr(client.cluster.scheduler, "allowed_failures", 0)
    with pytest.raises(ChildProcessError, match="cluster test: workers died"):
        list(there.run(os._exit, [("a", 1)]))
    lock = threading.Lock()
    sequence = gi.Sequence(1, lambda frame: lock and gi.scenes.cornell_box())
    with pytest.raises(TypeError, match=r"sequence sequence cannot be sent to a cluster: .*lock"):
        gi.render_animation(sequence, PATH, SIZE, device="cpu", cluster=client)


def test_the_command_line_makes_workers_or_finds_them(tmp_path, client, capsys):
    """`--cluster` alone uses this machine's cores, with an address the scheduler there; both write the same files, and
    `warpgi filter` too."""
    arguments = ["animate", "moving-light:frames=3", "path", "--spp", "2", "--size", "12", "8", "--device", "cpu"]
    for name, cluster in (("one", None), ("cores", []), ("address", [client.scheduler.address])):
        options = [] if cluster is None else ["--cluster", *cluster]
        out = str(tmp_path / name / "f-{:03d}.exr")
        assert main([*arguments, "--threads", "1", *options, "--out", out]) == 0
        filtered = str(tmp_path / name / "filtered" / "f-{:03d}.exr")
        if name != "cores":
            assert main(["filter", out, "--device", "cpu", *options, "--out", filtered]) == 0
        assert contents(tmp_path / name) == contents(tmp_path / "one")
    assert contents(tmp_path / "address" / "filtered") == contents(tmp_path / "one" / "filtered")
    # of Dask's own affairs nothing is heard
    assert all("pixels are far brighter" in line for line in capsys.readouterr().err.splitlines())


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (["nowhere"], "cluster is 'nowhere', expected the address of a Dask scheduler such as tcp://host:8786"),
        (["a:1", "b:2"], "cluster is a:1 b:2, expected one address"),
        (["nope://a:1"], "cluster nope://a:1 cannot be reached"),
        (["CLOSED"], "cannot be reached, expected a Dask scheduler there"),
    ],
)
def test_mistakes_end_with_one_sentence(address, message, tmp_path, monkeypatch, capsys):
    """Exit status 2 and one sentence that names the cluster, for a port where nobody listens too; no frame is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 0.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        closed = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    words = [closed if word == "CLOSED" else word for word in address]
    assert main(["animate", "moving-light:frames=2", "--device", "cpu", "--cluster", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warpgi: error: cluster ")
    assert message in line
    assert not list(tmp_path.rglob("*.exr"))


def test_a_scheduler_without_workers(monkeypatch):
    """It is named, and how to start one is said."""
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=":0", silence_logs="CRITICAL") as local,
        pytest.raises(ConnectionError, match="has no worker, expected one: dask worker tcp://"),
    ):
        gi.render_animation(gi.scenes.moving_light(frames=1), PATH, SIZE, cluster=local.scheduler_address)


def test_a_script_that_its_own_workers_run(tmp_path):
    """A script that does not guard its main part against being imported is told so."""
    script = tmp_path / "script.py"
    script.write_text(
        "import warpgi as gi\n"
        "sequence = gi.scenes.moving_light(frames=1)\n"
        "gi.render_animation(sequence, gi.PathTracing(spp=1), (4, 4), device='cpu', cluster=True)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ChildProcessError: cluster of this machine: processes did not start")
    assert "under if __name__ == '__main__'" in last


def test_a_module_that_workers_lack(client):
    """It is named."""
    with pytest.raises(ImportError, match="cluster test: a worker says No module named 'nowhere', expected it"):
        list(clusters.Cluster(client, "test").run(__import__, [(0, "nowhere")]))


def test_without_dask(monkeypatch, tmp_path, capsys):
    """The extra that is missing is named; other types are refused."""
    with pytest.raises(TypeError, match="cluster is int, expected an address"):
        gi.render_animation(gi.scenes.moving_light(frames=1), PATH, SIZE, cluster=3)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["animate", "moving-light:frames=1", "--cluster"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warpgi: error: cluster needs Dask distributed")
    assert line.endswith("pip install warpgi[cluster]")
