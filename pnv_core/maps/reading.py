"""Reading a map as it is at one moment, whatever another process saves into it meanwhile."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BufferedReader
from itertools import pairwise
from pathlib import Path

from pnv_core.errors import MapError
from pnv_core.maps.manifest import Manifest, Segment, count_of, holds, read_manifest, runs_of
from pnv_core.maps.segment import SavedKeyframe, open_segment, read_segment


@dataclass(frozen=True, eq=False)
class OpenMap:
    """A manifest and its segments, all opened: what a save removes stays readable as long as this is open."""

    folder: Path
    manifest: Manifest
    files: tuple[BufferedReader, ...]

    def keyframes(self) -> Iterator[SavedKeyframe]:
        """The keyframes by ascending id, each checked. Raises MapError at the first that is not whole or not listed."""
        for segment, file in zip(self.manifest.segments, self.files, strict=True):
            yield from self._of(segment, file)

    def _of(self, segment: Segment, file: BufferedReader) -> Iterator[SavedKeyframe]:
        path, manifest = self.folder / segment.file, self.manifest
        ids: list[int] = []
        most = count_of(segment.ids)
        for header, kf in read_segment(path, file, segment.digest):
            if (header.fingerprint, header.dim) != (manifest.fingerprint, manifest.dim):
                raise MapError(
                    f"{path} is of model {header.fingerprint}; allowed: {manifest.fingerprint}, as the map's"
                )
            ids.append(kf.ref.id)
            if len(ids) > most:
                break
            if not holds(segment.live, kf.ref.id):
                continue
            if not kf.sound:
                raise MapError(f"{path}: keyframe {kf.ref.id} has values that no describer gives")
            if kf.ref.camera not in manifest.cameras or kf.ref.session >= manifest.next_session:
                raise MapError(f"{path}: camera or session of keyframe {kf.ref.id} is not of this map")
            yield kf
        if any(a >= b for a, b in pairwise(ids)) or runs_of(ids) != segment.ids:
            raise MapError(f"{path} does not hold the keyframes that the map lists")


@contextmanager
def open_map(folder: Path) -> Iterator[OpenMap]:
    """The map in a folder. Raises MapError, naming the file and what is wrong with it."""
    with ExitStack() as files:
        manifest = read_manifest(folder)
        while True:
            try:
                opened = [files.enter_context(open_segment(folder / s.file, s.bytes)) for s in manifest.segments]
                break
            except MapError:
                files.close()
                now = read_manifest(folder)
                if now == manifest:
                    raise
                manifest = now  # saved meanwhile: the segments of the state before are gone
        yield OpenMap(folder, manifest, tuple(opened))
