"""The fleet's places in Milvus: one collection per model, the same client for Milvus Lite and a cluster.

A place is one row: what is looked up by and what is judged by are acknowledged, and forgotten, together. Searches give
the small fields; views are fetched by key for those that are judged.
"""

import functools
import logging
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from pnv_fleet.errors import FleetError
from pnv_fleet.places import META, MOST_DIM, MOST_PARTS, PART_CHARACTERS, Place, from_row, to_row

VERSION = 1
_NAME = re.compile(r"pnv_(\d+)_([0-9a-f]{32})")
_KEY_CHARACTERS = 32
_MOST_MESSAGE = 64 << 20  # bytes of one answer of the server
_PAGE = 100  # rows of a scan per answer
_PAGE_VIEWS = 20

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Access:
    """Token and TLS files of a store. Nothing of it is ever shown."""

    token: str = field(default="", repr=False)
    ca: str = field(default="", repr=False)
    certificate: str = field(default="", repr=False)
    key: str = field(default="", repr=False)

    @classmethod
    def from_environment(cls) -> "Access":
        """PNV_FLEET_TOKEN or the file PNV_FLEET_TOKEN_FILE; PNV_FLEET_CA, PNV_FLEET_CERT, PNV_FLEET_KEY (PEM files).

        Raises FleetError for a file that cannot be read.
        """
        token, file = os.environ.get("PNV_FLEET_TOKEN", ""), os.environ.get("PNV_FLEET_TOKEN_FILE", "")
        if file:
            try:
                token = Path(file).read_text().strip()
            except (OSError, UnicodeDecodeError) as error:
                raise FleetError(f"PNV_FLEET_TOKEN_FILE = {file}: {getattr(error, 'strerror', 'no text')}") from None
        files = {name: os.environ.get(f"PNV_FLEET_{name}", "") for name in ("CA", "CERT", "KEY")}
        for name, path in files.items():
            if path and not os.access(path, os.R_OK):
                raise FleetError(f"PNV_FLEET_{name} = {path}; allowed: a readable PEM file")
        return cls(token, files["CA"], files["CERT"], files["KEY"])


@dataclass(frozen=True)
class Hit:
    """A place found by a search, without its view, and the cosine of both global vectors."""

    place: Place
    similarity: float


def _one_line(text: Any) -> str:
    return " ".join(str(text).split())[:200]


def _told(act: Callable[P, T]) -> Callable[P, T]:
    """Whatever the client raises, as one sentence that names the store."""

    @functools.wraps(act)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return act(*args, **kwargs)
        except FleetError:
            raise
        except Exception as error:  # pymilvus, grpc and, in this process, Milvus Lite each raise their own
            store: Any = args[0]
            raise FleetError(f"{store.uri}: {_reason(error)}") from None

    return wrapped


def _reason(error: Exception) -> str:
    text = _one_line(getattr(error, "message", "") or error)
    causes: list[str] = []
    cause: BaseException | None = error
    while cause is not None and len(causes) < 10:  # pymilvus says "cannot connect" on top of what the server said
        causes.append(str(cause))
        cause = cause.__cause__ or cause.__context__
    low = " ".join(causes).lower()
    if "unauthenticated" in low or "auth check" in low or "permission" in low:
        return "the store refuses the token; see PNV_FLEET_TOKEN"
    if "deadline" in low or "timeout" in low:
        return "the store does not answer in time"
    if "unavailable" in low or "fail connecting" in low or "illegal connection" in low or "connection refused" in low:
        return "the store cannot be reached"
    if "no space left" in low or "disk full" in low or "disk quota" in low:
        return f"the store has no room ({text})"
    if "open local milvus failed" in low:
        return "Milvus Lite cannot open it; allowed: its own intact folder, which no other process holds"
    return text or type(error).__name__


class PlaceStore:
    """The collection of one model. Every method raises FleetError; each call ends within `timeout_s`. Any thread.

    `dim` and `parts` create the collection where there is none; without them only an existing one is opened.
    """

    def __init__(
        self, uri: str, fingerprint: str, access: Access, dim: int = 0, parts: int = 0, timeout_s: float = 10.0
    ) -> None:
        self.uri, self._timeout = uri, timeout_s
        self.collection = f"pnv_{VERSION}_{fingerprint[:32]}"
        self._client = connect(uri, access, timeout_s)
        self.dim, self.parts = self._opened(dim, parts)

    @_told
    def _opened(self, dim: int, parts: int) -> tuple[int, int]:
        names = self._client.list_collections(timeout=self._timeout)
        ours = [m for n in names if isinstance(n, str) and (m := _NAME.fullmatch(n))]
        self.others = tuple(sorted(m[2] for m in ours if int(m[1]) == VERSION and m[0] != self.collection))
        if self.collection not in names:
            newer = [m[0] for m in ours if m[2] == self.collection[-32:] and int(m[1]) > VERSION]
            if newer:
                raise FleetError(f"{self.uri} holds {newer[0]} of a newer version; allowed: {VERSION}")
            if not dim:
                models = ", ".join(self.others) or "none"
                raise FleetError(f"{self.uri} holds no places of model {self.collection[-32:]}; it holds: {models}")
            self._create(dim, parts)
        given = self._client.describe_collection(self.collection, timeout=self._timeout)
        found = fields_of(given)
        if not dim:
            dim = int(found.get("vector", ("", 0))[1])
            parts = sum(name.startswith("view_") for name in found)
        if not (0 < dim <= MOST_DIM and 0 < parts <= MOST_PARTS) or found != _fields(dim, parts):
            wrong = sorted(set(found.items()) ^ set(_fields(dim, parts).items()))[:3]
            raise FleetError(f"{self.uri}: collection {self.collection} has a foreign schema ({_one_line(wrong)})")
        self._client.load_collection(self.collection, timeout=self._timeout)
        return dim, parts

    def _create(self, dim: int, parts: int) -> None:
        from pymilvus import DataType

        schema = self._client.create_schema(auto_id=False, enable_dynamic_field=False)
        for name, (kind, size) in _fields(dim, parts).items():
            more: dict[str, Any] = {"max_length": size} if kind == "VARCHAR" else {"dim": size} if size else {}
            if name.startswith("view_"):
                more["mmap_enabled"] = True  # a cluster keeps views on its disk, not in its memory
            schema.add_field(name, DataType[kind], is_primary=name == "key", **more)
        index = self._client.prepare_index_params()
        index.add_index("vector", index_type="AUTOINDEX", metric_type="COSINE")
        self._client.create_collection(
            self.collection, schema=schema, index_params=index, consistency_level="Bounded", timeout=self._timeout
        )

    @_told
    def search(self, vector: NDArray[np.float32], k: int, where: str = "") -> tuple[list[Hit], list[str]]:
        """The k most similar places that fulfil an expression, best first, and what was refused of what came back."""
        found = self._client.search(
            self.collection, [vector], anns_field="vector", limit=k, filter=where, output_fields=list(META),
            search_params={"metric_type": "COSINE", "params": {"ef": max(64, 4 * k)}}, timeout=self._timeout,
        )  # fmt: skip
        hits, refused = [], []
        for row in list(found[0])[:k] if found else []:
            try:
                similarity = float(row["distance"])
                if not -1.01 < similarity < 1.01:  # not-a-number as well
                    raise FleetError(f"a row with similarity {similarity:g}; allowed: -1 to 1")
                hits.append(Hit(from_row(row["entity"], self.dim), max(-1.0, min(1.0, similarity))))
            except FleetError as error:
                refused.append(f"{self.uri}: {error}")
        return hits, refused

    @_told
    def fetch(self, keys: Sequence[str]) -> tuple[dict[str, Place], list[str]]:
        """Places with vector and view by key, and what was refused; a key that is gone is left out."""
        if not keys:
            return {}, []
        rows = self._client.query(
            self.collection, ids=list(keys), output_fields=self._all(), timeout=self._timeout
        )  # fmt: skip
        places: dict[str, Place] = {}
        refused = []
        for row in list(rows)[: len(keys)]:
            try:
                place = from_row(row, self.dim, self.parts)
                places[place.key] = place
            except FleetError as error:
                refused.append(f"{self.uri}: {error}")
        return {key: places[key] for key in keys if key in places}, refused

    @_told
    def put(self, places: Sequence[Place]) -> None:
        """Store places; when this returns, the store has acknowledged them. A place stored before is replaced."""
        rows = [to_row(place, self.parts) for place in places]
        done = self._client.upsert(self.collection, rows, timeout=self._timeout)
        if done.get("upsert_count") != len(rows):
            raise FleetError(f"{self.uri} acknowledged {done.get('upsert_count')} of {len(rows)} keyframes")

    @_told
    def forget(self, where: str) -> int:
        """Delete the places that fulfil an expression; how many there were."""
        count = self.count(where)
        if count:
            self._client.delete(self.collection, filter=where, timeout=self._timeout)
        return count

    @_told
    def count(self, where: str = "") -> int:
        found = self._client.query(
            self.collection, filter=where, output_fields=["count(*)"], consistency_level="Strong", timeout=self._timeout
        )
        return int(found[0]["count(*)"])

    def scan(self, where: str = "", views: bool = False) -> Iterator[Place | str]:
        """Every place that fulfils an expression, page by page; a row that is not believed as a sentence."""
        fields = self._all() if views else list(META)
        pages = self._pages(where, fields, _PAGE_VIEWS if views else _PAGE)
        for page in pages:
            for row in page:
                try:
                    yield from_row(row, self.dim, self.parts if views else 0)
                except FleetError as error:
                    yield str(error)

    def _pages(self, where: str, fields: list[str], size: int) -> Iterator[list[dict[str, Any]]]:
        @_told
        def begin(store: PlaceStore) -> Any:
            return store._client.query_iterator(
                store.collection, batch_size=size, filter=where, output_fields=fields, timeout=store._timeout,
                consistency_level="Strong",
            )  # fmt: skip

        @_told
        def following(store: PlaceStore) -> list[dict[str, Any]]:
            return list(pages.next())

        pages = begin(self)
        while page := following(self):
            yield page
        pages.close()

    @_told
    def version(self) -> str:
        """Of the server."""
        return _one_line(self._client.get_server_version(timeout=self._timeout))

    def close(self) -> None:
        self._client.close()

    def _all(self) -> list[str]:
        return [*META, "vector", *(f"view_{part}" for part in range(self.parts))]


def check_uri(uri: str) -> None:
    """Raises FleetError for what is no address of a store, or holds a password."""
    if "@" in uri:
        raise FleetError("fleet_uri holds a user or password; allowed: the environment variable PNV_FLEET_TOKEN")
    if not uri.startswith(("http://", "https://")) and not uri.endswith(".db"):
        raise FleetError(f"fleet_uri = {uri!r}; allowed: http://HOST:PORT, https://HOST:PORT or a file NAME.db")


def connect(uri: str, access: Access, timeout_s: float) -> Any:
    """A client of its own connection. Raises FleetError."""
    check_uri(uri)
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # read when grpc is imported: its own lines say no more than ours
    try:
        from pymilvus import MilvusClient
    except ImportError:
        raise FleetError("fleet_uri needs pymilvus; allowed: after `pip install pnv_ros[fleet]`") from None
    remote = uri.startswith(("http://", "https://"))
    for name in ("pymilvus", "milvus_lite"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # each failure is told once, in one line, by FleetError
    more: dict[str, Any] = {"dedicated": True} if remote else {}
    if uri.startswith("https://"):
        pems = {"server_pem_path": access.ca} if access.ca and not access.certificate else {}
        if access.certificate:
            pems = {"ca_pem_path": access.ca, "client_pem_path": access.certificate, "client_key_path": access.key}
        more |= {"secure": True, **pems}
    # each call has its own limit of time; pings more often than this make Milvus Lite's server close the connection
    more["grpc_options"] = {"grpc.max_receive_message_length": _MOST_MESSAGE, "grpc.keepalive_time_ms": 600_000}
    try:
        return MilvusClient(uri, token=access.token, timeout=timeout_s, **more)
    except Exception as error:  # its own, grpc's, or of Milvus Lite in this process
        raise FleetError(f"{uri}: {_reason(error)}") from None


def fields_of(description: Any) -> dict[str, tuple[str, int]]:
    """Name, type and size of every field that a store says a collection has."""
    found = {}
    for item in description.get("fields", []):
        size = item.get("params", {}).get("max_length") or item.get("params", {}).get("dim") or 0
        found[str(item.get("name"))[:64]] = (getattr(item.get("type"), "name", "?"), int(size))
    return found


def _fields(dim: int, parts: int) -> dict[str, tuple[str, int]]:
    """The schema: type and size by name."""
    return {
        "key": ("VARCHAR", _KEY_CHARACTERS), "robot": ("VARCHAR", 64), "session": ("INT64", 0),
        "camera": ("VARCHAR", 1020), "keyframe": ("INT64", 0), "stamp_ns": ("INT64", 0), "texture": ("DOUBLE", 0),
        "posed": ("BOOL", 0), "x": ("DOUBLE", 0), "y": ("DOUBLE", 0), "z": ("DOUBLE", 0),
        "vector": ("FLOAT_VECTOR", dim),
        **{f"view_{part}": ("VARCHAR", PART_CHARACTERS) for part in range(parts)},
    }  # fmt: skip
