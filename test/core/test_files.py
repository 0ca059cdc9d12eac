"""Model files, official checkpoints and downloads: what loads, and how everything else is refused."""

import hashlib
import http.server
import pickle
import shutil
import socket
import tempfile
import threading
import time
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import save_file

from pnv_core.describe import download as published
from pnv_core.describe.checkpoints import load_checkpoint
from pnv_core.describe.describer import Describer
from pnv_core.describe.model_files import load_model, save_model
from pnv_core.describe.trunks.vgg16 import vgg16_trunk
from pnv_core.errors import ModelError
from test.core.small import HEIGHT, WIDTH, small_model
from test.tally import count, tally


def official(clusters=3, dim=5, dtype=torch.float64, prefix=""):
    """A checkpoint in the published layout: full-size VGG16 shapes, zeros except where it matters."""
    trunk = vgg16_trunk().tensor_shapes()
    state = {f"encoder.{prefix}{k.removeprefix('features.')}": torch.zeros(shape) for k, shape in trunk.items()}
    state[f"pool.{prefix}centroids"] = torch.randn(clusters, 512)
    state[f"pool.{prefix}conv.weight"] = torch.randn(clusters, 512, 1, 1)
    state["WPCA.0.weight"] = torch.randn(dim, clusters * 512, 1, 1, dtype=dtype)
    state["WPCA.0.bias"] = torch.randn(dim, dtype=dtype)
    return {"num_pcs": dim, "state_dict": state}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_official_checkpoints_load_with_k_and_d_from_their_shapes(tmp_path, dtype, prefix):
    content = official(clusters=7, dim=9, dtype=dtype, prefix=prefix)
    torch.save(content, tmp_path / "x.pth.tar")
    model = load_checkpoint(tmp_path / "x.pth.tar")
    assert (model.clusters, model.global_dim, model.patch_dim) == (7, 9, 9)
    state = content["state_dict"]
    assert np.array_equal(model.tensors["netvlad.centroids"], state[f"pool.{prefix}centroids"])
    assert np.array_equal(model.tensors["global_projection.weight"], state["WPCA.0.weight"].float().flatten(1))


def _without(key):
    return lambda c: c["state_dict"].pop(key)


def _with(key, tensor):
    return lambda c: c["state_dict"].update({key: tensor})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without("encoder.28.bias"), "lacks encoder.28.bias"),
        (_without("WPCA.0.weight"), "lacks WPCA.0.weight"),
        (_with("pool.conv.bias", torch.zeros(3)), "unexpected keys pool.conv.bias"),
        (
            _with("encoder.0.weight", torch.zeros(64, 1, 3, 3)),
            r"features.0.weight has shape \(64, 1, 3, 3\); allowed: \(64, 3, 3, 3\)",
        ),
        (_with("pool.centroids", torch.zeros(3, 256)), r"centroids has shape \(3, 256\); allowed: \(K, 512\)"),
        (_with("pool.centroids", torch.full((3, 512), float("nan"))), "not finite"),
        (_with("WPCA.0.weight", torch.zeros(5, 99, 1, 1)), r"weight has shape \(5, 99\); allowed: \(5, 1536\)"),
        (_with("WPCA.0.weight", torch.zeros(5, 1536)), "allowed: a 1x1 convolution"),
        (lambda c: c.update(num_pcs=6), "num_pcs says 6 but WPCA.0.bias has 5 entries"),
        (lambda c: c.pop("state_dict"), "allowed: a dict of num_pcs and state_dict"),
    ],
)
def test_a_checkpoint_that_differs_is_refused_by_name(tmp_path, change, message):
    content = official()
    change(content)
    torch.save(content, tmp_path / "x.pth.tar")
    with pytest.raises(ModelError, match=message) as refused:
        load_checkpoint(tmp_path / "x.pth.tar")
    assert "x.pth.tar" in str(refused.value)
    assert "\n" not in str(refused.value)


class _Evil:
    def __reduce__(self):
        return (Path.touch, (Path("/tmp/pnv_pickle_was_executed"),))


def test_a_pickle_of_objects_is_refused_and_not_executed(tmp_path):
    marker = Path("/tmp/pnv_pickle_was_executed")
    marker.unlink(missing_ok=True)
    torch.save({"num_pcs": 1, "state_dict": {"x": _Evil()}}, tmp_path / "evil.pth.tar")
    (tmp_path / "bare.pth").write_bytes(pickle.dumps(_Evil()))
    for name in ("evil.pth.tar", "bare.pth"):
        with pytest.raises(ModelError, match=name):
            load_checkpoint(tmp_path / name)
    assert not marker.exists()


@pytest.mark.parametrize("keep", [0, 1, 100, 50_000])
def test_a_truncated_checkpoint_is_refused(tmp_path, keep):
    torch.save(official(), tmp_path / "whole.pth.tar")
    (tmp_path / "cut.pth.tar").write_bytes((tmp_path / "whole.pth.tar").read_bytes()[:keep])
    with pytest.raises(ModelError, match="cut.pth.tar"):
        load_checkpoint(tmp_path / "cut.pth.tar")


def test_a_saved_model_describes_as_before(tmp_path):
    model = small_model()
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    before = Describer(model).describe(image)
    save_model(model, tmp_path / "m.safetensors")
    loaded = load_model(tmp_path / "m.safetensors")
    assert loaded.info == model.info
    assert loaded.fingerprint() == model.fingerprint()
    after = Describer(loaded).describe(image)
    assert np.array_equal(before.global_vector, after.global_vector)
    assert np.array_equal(before.patches[0].descriptors, after.patches[0].descriptors)


def test_a_damaged_model_file_is_refused_wherever_the_damage_is(tmp_path):
    path = tmp_path / "m.safetensors"
    save_model(small_model(), path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in [*range(0, 64, 7), *rng.integers(64, len(whole), 40)]:
        flipped = bytearray(whole)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            loaded = load_model(path)
        except ModelError:
            continue
        assert loaded.fingerprint() == small_model().fingerprint()  # the flip hit words such as the provenance
    for keep in (0, 5, 100, len(whole) - 1):
        path.write_bytes(whole[:keep])
        with pytest.raises(ModelError, match="m.safetensors"):
            load_model(path)


def test_a_failed_save_leaves_the_old_model(tmp_path, monkeypatch):
    path = tmp_path / "m.safetensors"
    save_model(small_model(), path)
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        save_model(small_model(seed=1), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"]


class _Server(http.server.ThreadingHTTPServer):
    """Serves `content` at every path, with ranges; cuts the connection after `cut` bytes once, if set."""

    content = b""
    cut: int | None = None
    ranges: list[str | None]


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        self.server.ranges.append(wanted)
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted else 0
        if start >= len(self.server.content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(self.server.content)}")
            self.end_headers()
            return
        body = self.server.content[start:]
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.server.cut is not None:
            body, self.server.cut = body[: self.server.cut], None
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch, tmp_path):
    server = _Server(("127.0.0.1", 0), _Handler)
    server.content = np.random.default_rng(0).bytes(300_000)
    server.ranges = []
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(published, "_BASE_URL", f"http://127.0.0.1:{server.server_port}/")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(published, "_require_model", lambda item, part: None)  # these tests are of the transfer
    yield server
    server.shutdown()


_ANSWERS = {
    "a login page": b"HTTP/1.1 200 OK\r\n\r\n<html>please log in</html>",
    "nothing": b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n",
    "a body cut": b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\nabc",
    "a body cut, no length": b"HTTP/1.1 200 OK\r\n\r\nPK\x03\x04",
    "no HTTP": b"hello\r\n\r\n",
    "hardly HTTP": b"\x00\xff\r\n",
    "an odd length": b"HTTP/1.1 200 OK\r\nContent-Length: many\r\n\r\nabc",
    "a length without end": b"HTTP/1.1 200 OK\r\nContent-Length: 99999999999999\r\n\r\nabc",
    "a chunk cut": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\nabc",
    "a pickle": b"HTTP/1.1 200 OK\r\n\r\n" + pickle.dumps({"num_pcs": 128}),
}


@pytest.mark.parametrize("kind", _ANSWERS)
def test_an_answer_that_is_no_model_is_refused_in_one_line_and_not_remembered(kind, monkeypatch, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer():
            connection, _ = listening.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(_ANSWERS[kind])

        threading.Thread(target=answer, daemon=True).start()
        monkeypatch.setattr(published, "_BASE_URL", f"http://127.0.0.1:{listening.getsockname()[1]}/")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        with pytest.raises(ModelError) as refused:
            published.fetch("mapillary_WPCA128")
    assert "\n" not in str(refused.value)
    item = published.PUBLISHED["mapillary_WPCA128"]
    assert not item.path.exists()
    assert published.recorded_sha256(item) is None
    tally("9 answers of a server that are no model", 1, 1)


@pytest.mark.parametrize(("pause", "words"), [(0.02, "bytes came in 0.5 s; run the command again"), (0, "more than")])
def test_a_body_without_end_is_given_up_be_it_slow_or_fast(pause, words, monkeypatch, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer():
            connection, _ = listening.accept()
            with connection, suppress(OSError):
                connection.recv(4096)
                connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
                while True:
                    connection.sendall(bytes(1 if pause else 100_000))
                    time.sleep(pause)

        threading.Thread(target=answer, daemon=True).start()
        monkeypatch.setattr(published, "_BASE_URL", f"http://127.0.0.1:{listening.getsockname()[1]}/")
        monkeypatch.setattr(published, "_PATIENCE_S", 0.5)
        monkeypatch.setattr(published, "_MOST_BYTES", 50_000_000)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        with pytest.raises(ModelError, match=words) as refused:
            published.fetch("mapillary_WPCA128")
    assert "\n" not in str(refused.value)
    assert not published.PUBLISHED["mapillary_WPCA128"].path.exists()
    tally("9 answers without end", 1, 1)


def test_an_archive_that_unpacks_to_more_than_it_is_is_refused_before(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(50_000_000))
    with pytest.raises(ModelError, match="bytes that unpack to 50000000"):
        load_checkpoint(tmp_path / "bomb.pth")


METADATA = st.one_of(
    st.text(max_size=30),
    st.sampled_from(["null", "[]", "{}", "Infinity", "[Infinity]", "NaN", "[" * 5000, "x" * 10**6, "-1", "1e999",
                     "[0.5]", '{"no_such": 1}', '{"stages": []}', '{"a": [1]}', "[" + "9" * 5000 + "]", "16"]),
)  # fmt: skip


NAMES = ("trunk", "trunk_options", "image_width", "image_height", "patch_sizes", "patch_weights", "provenance",
         "calibration", "format", "fingerprint")  # fmt: skip


@given(st.dictionaries(st.sampled_from(NAMES), METADATA, min_size=1, max_size=3))
@settings(max_examples=count(100, 5000), deadline=None, database=None)
def test_metadata_of_a_model_that_says_other_things_is_refused_in_one_line(changes):
    folder = Path(tempfile.mkdtemp())
    save_model(small_model(), folder / "m.safetensors")
    with safe_open(folder / "m.safetensors", framework="np") as file:
        metadata = file.metadata() | changes
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    save_file(tensors, folder / "m.safetensors", metadata)
    try:
        load_model(folder / "m.safetensors")
    except ModelError as error:
        assert "\n" not in str(error)
        assert len(str(error)) <= 1000
    finally:
        shutil.rmtree(folder)
    tally("8 models whose metadata says other things", 1, 1)


def test_a_download_is_placed_whole_and_its_hash_recorded(server, tmp_path):
    counted = []
    path = published.fetch("mapillary_WPCA128", lambda done, total: counted.append((done, total)))
    assert path == tmp_path / "cache" / "pnv_ros" / "mapillary_WPCA128.pth.tar"
    assert path.read_bytes() == server.content
    assert counted[-1] == (300_000, 300_000)
    assert (
        published.recorded_sha256(published.PUBLISHED["mapillary_WPCA128"])
        == hashlib.sha256(server.content).hexdigest()
    )


def test_an_interrupted_download_resumes_where_it_stopped(server):
    server.cut = 100_000
    with pytest.raises(ModelError, match=r"100000 of 300000 bytes arrived; run the command again to resume"):
        published.fetch("pittsburgh_WPCA512")
    path = published.fetch("pittsburgh_WPCA512")
    assert path.read_bytes() == server.content
    assert server.ranges == [None, "bytes=100000-"]


def test_a_stale_part_longer_than_the_file_is_discarded(server):
    part = published.PUBLISHED["mapillary_WPCA512"].path.with_name("mapillary_WPCA512.pth.tar.part")
    part.parent.mkdir(parents=True)
    part.write_bytes(server.content + b"more")
    with pytest.raises(ModelError, match="300004 bytes are here but the file has 300000"):
        published.fetch("mapillary_WPCA512")
    assert published.fetch("mapillary_WPCA512").read_bytes() == server.content


def test_a_file_that_differs_from_the_recorded_hash_is_discarded(server):
    path = published.fetch("mapillary_WPCA128")
    first = server.content
    server.content = first[:-1] + b"?"
    path.unlink()
    with pytest.raises(ModelError, match="differs from the recorded"):
        published.fetch("mapillary_WPCA128")
    assert not path.exists()


def test_without_network_the_message_says_where_to_put_the_file(monkeypatch, tmp_path):
    monkeypatch.setattr(published, "_BASE_URL", "http://127.0.0.1:9/")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ModelError, match=r"cannot be reached .*copy the file to .*pnv_ros by hand"):
        published.fetch("mapillary_WPCA4096")
    with pytest.raises(ModelError, match="allowed: mapillary_WPCA128"):
        published.fetch("resnet")
