"""A store of the session: Milvus Lite's own server, in a process of its own."""

import pytest


@pytest.fixture(scope="session")
def server():
    pytest.importorskip("pymilvus", reason="the extra `fleet` is not installed")
    pytest.importorskip("milvus_lite", reason="the extra `fleet` is not installed")
    from benchmarks.fleet import served

    with served() as running:
        yield running
