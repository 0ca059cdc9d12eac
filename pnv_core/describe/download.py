"""Where models come from: the shipped one, the published checkpoints in a cache folder, or a file.

Facts of the published files: Patch-NetVLAD repository, download_models.py, and its hosting page.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pnv_core.errors import ModelError
from pnv_core.files import atomic_write

DEFAULT_MODEL = Path(__file__).parents[1] / "models" / "default.safetensors"
_BASE_URL = "https://huggingface.co/TobiasRobotics/Patch-NetVLAD/resolve/main/"
_CHUNK = 1 << 20
_TIMEOUT_S = 30
_PATIENCE_S, _LEAST_BYTES = 60.0, 100_000  # so much must come in so long, else the largest file would take days
_MOST_BYTES = 2_500_000_000  # the largest published file takes 0.6 GB, in float64 1.2 GB


@dataclass(frozen=True)
class Published:
    """A published checkpoint. `clusters` (K) and `dim` (P) are what its name promises."""

    name: str
    remote: str
    clusters: int
    dim: int

    @property
    def url(self) -> str:
        return f"{_BASE_URL}{self.remote}?download=true"

    @property
    def path(self) -> Path:
        return cache_folder() / f"{self.name}.pth.tar"


PUBLISHED = {
    p.name: p
    for p in [Published(f"mapillary_WPCA{d}", f"mapillary_WPCA{d}.pth.tar", 16, d) for d in (128, 512, 4096)]
    + [Published(f"pittsburgh_WPCA{d}", f"pitts_WPCA{d}.pth.tar", 64, d) for d in (128, 512, 4096)]
}


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/pnv_ros, by default ~/.cache/pnv_ros."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "pnv_ros"


def resolve_weights(weights: str) -> Path:
    """'default', a published name or a file -> an existing file. Raises ModelError saying what to do."""
    if weights == "default":
        return DEFAULT_MODEL
    if weights in PUBLISHED:
        path = PUBLISHED[weights].path
        if not path.exists():
            raise ModelError(
                f"weights {weights!r} are not on this machine ({path}); fetch them with: pnv weights fetch {weights}"
            )
        return path
    path = Path(os.path.expanduser(weights))  # of pathlib: a RuntimeError for a user that is not there
    if not path.is_file():
        raise ModelError(
            f"weights {weights!r}: no such file; allowed: default, {', '.join(PUBLISHED)}, or a model file"
        )
    return path


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fetch(name: str, progress: Callable[[int, int], None] = lambda done, total: None) -> Path:
    """Download a published checkpoint into the cache folder: resumed where it stopped, checked, renamed.

    The publisher gives no hashes: a download must load as the model of its name before it is put in place; the sha256
    of the first is recorded beside the file, and later ones must equal it. `progress(done, total)` counts bytes; total
    is 0 where the server does not say.
    Raises ModelError for an unknown name, an unreachable network, or a file that differs.
    """
    if name not in PUBLISHED:
        raise ModelError(f"{name!r} is no published model; allowed: {', '.join(PUBLISHED)}")
    item = PUBLISHED[name]
    item.path.parent.mkdir(parents=True, exist_ok=True)
    part = item.path.with_name(item.path.name + ".part")
    total = _download(item.url, part, progress)
    if total and part.stat().st_size != total:
        raise ModelError(f"{name}: {part.stat().st_size} of {total} bytes arrived; run the command again to resume")
    digest = file_sha256(part)
    recorded = recorded_sha256(item)
    if recorded and recorded != digest:
        part.unlink()
        raise ModelError(f"{name}: sha256 {digest} differs from the recorded {recorded}; the download was discarded")
    try:
        _require_model(item, part)
    except ModelError:
        part.unlink()
        raise
    with part.open("rb") as file:
        os.fsync(file.fileno())
    os.replace(part, item.path)
    if not recorded:
        record = {"sha256": digest, "bytes": item.path.stat().st_size, "url": item.url}
        with atomic_write(_record(item)) as out:
            out.write(json.dumps(record, indent=1).encode())
    return item.path


def _require_model(item: Published, part: Path) -> None:
    """Raises ModelError unless the file is the checkpoint that its name promises."""
    from pnv_core.describe.checkpoints import load_checkpoint

    try:
        model = load_checkpoint(part)
    except ModelError as error:
        with part.open("rb") as file:
            begins = file.read(40)
        raise ModelError(
            f"{item.name}: what {item.url} sent is no checkpoint ({part.stat().st_size} bytes, {begins!r}), and was "
            f"discarded: {error}"
        ) from None
    found = model.clusters, model.global_dim
    if found != (item.clusters, item.dim):
        raise ModelError(f"{item.name}: K, D = {found} arrived; allowed: {item.clusters}, {item.dim}; it was discarded")


def recorded_sha256(item: Published) -> str | None:
    """The hash recorded at the first fetch, or None."""
    try:
        return str(json.loads(_record(item).read_text())["sha256"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError) as error:
        raise ModelError(f"{_record(item)}: not a readable hash record ({error}); delete it to record anew") from None


def _record(item: Published) -> Path:
    return item.path.with_name(item.path.name + ".json")


def _download(url: str, part: Path, progress: Callable[[int, int], None]) -> int:
    """Append what is missing of `url` to `part`; the full size in bytes, 0 if unknown."""
    import http.client  # a robot that has its model waits for neither
    import urllib.error
    import urllib.request

    have = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            resumed = answer.status == 206
            length = max(0, int(answer.headers.get("Content-Length") or 0))
            if length > _MOST_BYTES:
                raise ModelError(f"{url}: {length} bytes are offered; allowed: {_MOST_BYTES}")
            total = (have if resumed else 0) + length if length else 0
            if total:
                free = shutil.disk_usage(part.parent).free
                if free < length:
                    raise ModelError(f"{part.parent} has {free >> 20} MB free; {length >> 20} MB are needed")
            done = have if resumed else 0
            since, then = time.monotonic(), done
            with part.open("ab" if resumed else "wb") as out:
                while chunk := answer.read1(_CHUNK):  # what is there; `read` would wait for all of it
                    out.write(chunk)
                    done += len(chunk)
                    if time.monotonic() - since > _PATIENCE_S:
                        if done - then < _LEAST_BYTES:
                            raise ModelError(
                                f"{url}: only {done - then} bytes came in {_PATIENCE_S:g} s; run the command again to "
                                "resume"
                            )
                        since, then = time.monotonic(), done
                    if done > _MOST_BYTES:
                        raise ModelError(f"{url}: more than {_MOST_BYTES} bytes came; delete {part} to begin anew")
                    progress(done, total)
            return total
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # there is nothing after what is here: whole, or longer than the file
            size = str(error.headers.get("Content-Range", "")).rpartition("/")[2]
            if size.isdigit() and int(size) != have:
                part.unlink()
                raise ModelError(
                    f"{url}: {have} bytes are here but the file has {size}; discarded, run the command again"
                ) from None
            return have
        raise ModelError(f"{url}: the server answered {error.code} {error.reason}") from None
    except ModelError:
        raise
    except (urllib.error.URLError, TimeoutError, ConnectionError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", None) or f"{type(error).__name__}: {error}"
        raise ModelError(
            f"{url}: cannot be reached ({reason}); check the network, or copy the file to {part.parent} by hand"
        ) from None
