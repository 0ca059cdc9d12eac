"""The store over the wire: Milvus Lite's server, and servers that refuse, lie or are no longer there."""

import base64
import shutil
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from pnv_fleet.errors import FleetError
from pnv_fleet.maps import thin
from pnv_fleet.places import descriptor_of, layouts_of, parts_of
from pnv_fleet.store import Access, PlaceStore, connect
from test.fleet.worlds import DIM, descriptor, new_model, place

PARTS = parts_of(layouts_of(descriptor(0)))


@pytest.fixture
def store(server):
    opened = PlaceStore(server.uri, new_model(), Access(), DIM, PARTS)
    yield opened
    opened.close()


def test_what_was_put_is_found_and_fetched(store):
    places = [place(n, ("alpha", "beta")[n % 2], (float(n), 0.0, 0.0)) for n in range(30)]
    store.put(places)
    hits, refused = store.search(places[7].vector, 5)
    assert refused == []
    assert hits[0].place.ref == places[7].ref
    assert hits[0].similarity == pytest.approx(1.0, abs=1e-5)
    truth = sorted(range(30), key=lambda n: -float(places[n].vector @ places[7].vector))[:5]
    assert [h.place.keyframe for h in hits] == truth
    fetched, _ = store.fetch([places[7].key, "0" * 32])
    assert list(fetched) == [places[7].key]
    assert fetched[places[7].key].view == places[7].view
    assert descriptor_of(fetched[places[7].key], descriptor(7)).patches[0].rows == 3


def test_a_search_keeps_to_its_expression(store):
    store.put([place(n, ("alpha", "beta")[n % 2]) for n in range(20)])
    hits, _ = store.search(place(4).vector, 20, 'robot != "alpha"')
    assert {h.place.robot for h in hits} == {"beta"}


def test_what_is_put_twice_is_stored_once(store):
    store.put([place(n) for n in range(10)])
    store.put([place(n) for n in range(5, 15)])
    assert store.count() == 15


def test_places_are_forgotten_by_robot_and_by_area(store):
    store.put([place(n, ("alpha", "beta")[n % 2], (float(n), 0.0, 0.0)) for n in range(20)])
    assert store.forget('robot == "alpha"') == 10
    assert store.forget("posed == true and x > 10") == 5
    assert sorted(p.keyframe for p in store.scan()) == [1, 3, 5, 7, 9]
    assert store.forget('robot == "nobody"') == 0


def test_places_that_newer_ones_cover_are_forgotten(store):
    old = [place(n) for n in range(4)]
    again = [replace(place(n + 10), vector=old[n].vector) for n in (1, 3)]  # the same two places, later
    store.put(old + again)
    assert thin(store, 0.95) == 2
    assert sorted(p.keyframe for p in store.scan()) == [0, 2, 11, 13]


def test_a_scan_gives_every_place_once(store):
    store.put([place(n) for n in range(250)])
    assert sorted(p.keyframe for p in store.scan()) == list(range(250))
    assert all(p.view for p in store.scan(views=True))


def test_without_creating_only_what_is_there_is_opened(server, store):
    store.put([place(0)])
    model = store.collection[-32:]
    assert PlaceStore(server.uri, model, Access()).count() == 1
    with pytest.raises(FleetError, match=f"holds no places of model.*{model}"):
        PlaceStore(server.uri, "f" * 64, Access())


def test_a_collection_of_other_fields_is_refused_by_name(server):
    from pymilvus import DataType

    model = new_model()
    client = connect(server.uri, Access(), 10.0)
    schema = client.create_schema(auto_id=False)
    schema.add_field("key", DataType.VARCHAR, max_length=32, is_primary=True)
    schema.add_field("vector", DataType.FLOAT_VECTOR, dim=DIM)
    client.create_collection(f"pnv_1_{model[:32]}", schema=schema)
    with pytest.raises(FleetError, match=f"pnv_1_{model[:32]} has a foreign schema"):
        PlaceStore(server.uri, model, Access(), DIM, PARTS)


def test_a_collection_of_another_dimension_is_refused(server, store):
    with pytest.raises(FleetError, match="foreign schema"):
        PlaceStore(server.uri, store.collection[-32:], Access(), 2 * DIM, PARTS)


def test_a_newer_version_is_refused_by_name(server):
    model = new_model()
    connect(server.uri, Access(), 10.0).create_collection(f"pnv_2_{model[:32]}", dimension=8)
    with pytest.raises(FleetError, match=f"pnv_2_{model[:32]} of a newer version; allowed: 1"):
        PlaceStore(server.uri, model, Access(), DIM, PARTS)


def test_hostile_rows_are_left_out_by_name_and_the_others_are_found(store):
    good = [place(n) for n in range(5)]
    store.put(good)
    bad = replace(place(6), vector=good[0].vector)
    row = {"robot": "evil", "texture": float("nan"), "vector": good[0].vector}
    from pnv_fleet.places import to_row

    client = store._client
    client.upsert(store.collection, [to_row(bad, PARTS) | row | {"key": "a" * 32}])
    client.upsert(store.collection, [to_row(bad, PARTS) | {"robot": "evil", "key": "b" * 32, "keyframe": -(2**60)}])
    client.upsert(store.collection, [to_row(bad, PARTS) | {"robot": "evil", "key": "c" * 32, "camera": "x" * 1000}])
    lie = base64.b64encode(b"PNVV" + bytes(30_000)).decode()
    client.upsert(store.collection, [to_row(bad, PARTS) | {"robot": "liar", "key": bad.key, "view_0": lie}])
    hits, refused = store.search(good[0].vector, 10)
    assert {h.place.robot for h in hits} == {"alpha", "liar"}
    assert len(refused) == 3
    assert all("evil" in line and "\n" not in line and len(line) < 300 for line in refused)
    told = [p for p in store.scan() if isinstance(p, str)]
    assert len(told) == 3


def test_a_vector_that_is_no_number_does_not_hide_the_others(store):
    from pnv_fleet.places import to_row

    good = [place(n) for n in range(5)]
    store.put(good)
    nothing = to_row(place(6, "evil"), PARTS) | {"vector": np.full(DIM, np.nan, np.float32)}
    store._client.upsert(store.collection, [nothing])
    hits, _ = store.search(good[3].vector, 3)
    assert hits[0].place.keyframe == 3
    assert all(h.place.robot == "alpha" for h in hits)


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("http://user:secret@127.0.0.1:1", "PNV_FLEET_TOKEN"),
        ("places.sqlite", "allowed: http://HOST:PORT"),
        ("http://127.0.0.1:1", "cannot be reached"),
    ],
)
def test_an_address_that_leads_nowhere_is_refused_in_one_line(uri, words):
    pytest.importorskip("pymilvus", reason="the extra `fleet` is not installed")
    with pytest.raises(FleetError, match=words) as refusal:
        PlaceStore(uri, "0" * 64, Access(), DIM, PARTS, timeout_s=2.0)
    assert "\n" not in str(refusal.value)
    assert "secret" not in str(refusal.value)


def test_a_server_that_never_answers_is_left_after_the_timeout():
    pytest.importorskip("pymilvus", reason="the extra `fleet` is not installed")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        start = time.monotonic()
        with pytest.raises(FleetError, match="127.0.0.1"):
            PlaceStore(f"http://127.0.0.1:{silent.getsockname()[1]}", "0" * 64, Access(), DIM, PARTS, timeout_s=1.0)
        assert time.monotonic() - start < 60  # without a limit: never


@contextmanager
def lite_behind(tmp_path, *interceptors, credentials=None):
    """host:port of Milvus Lite's own service behind grpc's interceptors or TLS, which its command line has not."""
    grpc = pytest.importorskip("grpc", reason="the extra `fleet` is not installed")
    pytest.importorskip("milvus_lite", reason="the extra `fleet` is not installed")
    from milvus_lite.adapter.grpc.servicer import MilvusServicer
    from milvus_lite.db import MilvusLite
    from pymilvus.grpc_gen import milvus_pb2_grpc

    database = MilvusLite(str(tmp_path / "places.db"))
    guarded = grpc.server(ThreadPoolExecutor(2), interceptors=interceptors)
    milvus_pb2_grpc.add_MilvusServiceServicer_to_server(MilvusServicer(database), guarded)
    if credentials is None:
        port = guarded.add_insecure_port("127.0.0.1:0")
    else:
        port = guarded.add_secure_port("127.0.0.1:0", credentials)
    guarded.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        guarded.stop(None)
        database.close()


def test_a_wrong_token_is_said_without_the_token(tmp_path):
    grpc = pytest.importorskip("grpc", reason="the extra `fleet` is not installed")

    class Guard(grpc.ServerInterceptor):
        """As a Milvus with authorization: every call carries the token in base64."""

        def intercept_service(self, continuation, details):
            given = dict(details.invocation_metadata).get("authorization", "")
            if given == base64.b64encode(b"robot:right").decode():
                return continuation(details)
            refuse = lambda request, context: context.abort(grpc.StatusCode.UNAUTHENTICATED, "auth check failure")  # noqa: E731
            return grpc.unary_unary_rpc_method_handler(refuse)

    with lite_behind(tmp_path, Guard()) as address:
        uri = f"http://{address}"
        PlaceStore(uri, "1" * 64, Access("robot:right"), DIM, PARTS).put([place(0)])
        for token in ("robot:wr0ng", ""):
            with pytest.raises(FleetError, match="refuses the token") as refusal:
                PlaceStore(uri, "1" * 64, Access(token), DIM, PARTS, timeout_s=2.0)
            assert "wr0ng" not in str(refusal.value)
            assert "wr0ng" not in repr(Access(token))


def certificate(folder, name):
    """(certificate, key) of 127.0.0.1 in PEM files, signed by itself."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    files = folder / f"{name}.pem", folder / f"{name}.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1", "-out", files[0], "-keyout", files[1]],
        check=True, capture_output=True,
    )  # fmt: skip
    return files


@pytest.mark.parametrize("mutual", [False, True])
def test_a_store_behind_tls_takes_those_that_trust_it_and_are_trusted(tmp_path, monkeypatch, mutual):
    grpc = pytest.importorskip("grpc", reason="the extra `fleet` is not installed")
    served, robot = certificate(tmp_path, "store"), certificate(tmp_path, "robot")
    pair = [(served[1].read_bytes(), served[0].read_bytes())]
    credentials = grpc.ssl_server_credentials(pair, robot[0].read_bytes() if mutual else None, mutual)
    with lite_behind(tmp_path, credentials=credentials) as address:
        monkeypatch.setenv("PNV_FLEET_CA", str(served[0]))
        if mutual:
            with pytest.raises(FleetError, match="127.0.0.1"):
                PlaceStore(f"https://{address}", "1" * 64, Access.from_environment(), DIM, PARTS, timeout_s=2.0)
            monkeypatch.setenv("PNV_FLEET_CERT", str(robot[0]))
            monkeypatch.setenv("PNV_FLEET_KEY", str(robot[1]))
        store = PlaceStore(f"https://{address}", "1" * 64, Access.from_environment(), DIM, PARTS)
        store.put([place(0)])
        assert store.count() == 1
        stranger = certificate(tmp_path, "stranger")
        for uri, access in ((f"http://{address}", Access()), (f"https://{address}", Access(ca=str(stranger[0])))):
            with pytest.raises(FleetError, match="127.0.0.1") as refusal:
                PlaceStore(uri, "1" * 64, access, DIM, PARTS, timeout_s=2.0)
            assert "\n" not in str(refusal.value)


def test_access_comes_from_the_environment_and_files(tmp_path, monkeypatch):
    (tmp_path / "token").write_text("robot:secret\n")
    monkeypatch.setenv("PNV_FLEET_TOKEN_FILE", str(tmp_path / "token"))
    assert Access.from_environment().token == "robot:secret"
    monkeypatch.setenv("PNV_FLEET_CA", str(tmp_path / "nothing.pem"))
    with pytest.raises(FleetError, match="PNV_FLEET_CA"):
        Access.from_environment()


def test_a_file_that_is_no_store_is_said_in_one_line(tmp_path):
    pytest.importorskip("milvus_lite", reason="the extra `fleet` is not installed")
    (tmp_path / "places.db").write_text("rubbish")
    with pytest.raises(FleetError, match="cannot open it; allowed"):
        PlaceStore(str(tmp_path / "places.db"), "2" * 64, Access(), DIM, PARTS)
    assert (tmp_path / "places.db").read_text() == "rubbish"


def test_a_truncated_store_file_is_said_in_one_line(tmp_path):
    pytest.importorskip("milvus_lite", reason="the extra `fleet` is not installed")
    from milvus_lite.server_manager import server_manager_instance

    path = str(tmp_path / "places.db")
    first = PlaceStore(path, "2" * 64, Access(), DIM, PARTS)
    first.put([place(n) for n in range(50)])
    first._client.flush(first.collection)
    first.close()
    server_manager_instance.release_server(path)
    for file in (tmp_path / "places.db").rglob("*"):
        if file.is_file() and file.stat().st_size > 100:
            with open(file, "r+b") as damaged:
                damaged.truncate(file.stat().st_size // 2)
    with pytest.raises(FleetError, match=r"places\.db") as refusal:
        PlaceStore(path, "2" * 64, Access(), DIM, PARTS).search(place(0).vector, 3)
    assert "\n" not in str(refusal.value)
