"""A query judged against the fleet's places: the judge, the gates and the sequence of local candidates."""

from collections import OrderedDict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.decide.consistency import DOUBT, SequenceMemory, window_of
from pnv_core.decide.gates import decided
from pnv_core.decide.judge import AROUND, Judge
from pnv_core.types import LoopClosure, PlaceDescriptor, Query
from pnv_fleet.errors import FleetError
from pnv_fleet.places import descriptor_of, row_bytes
from pnv_fleet.store import PlaceStore

_CACHED = 256  # places whose view is kept, about 0.2 MB each: neighbouring queries meet the same candidates


class Answers:
    """What the fleet knows of queries asked in order. One thread.

    `like` is any descriptor of this model: what the store gives must have its shapes.
    `received` counts the bytes of views that were fetched, `refused` what the store gave and was not believed.
    """

    def __init__(self, config: Config, calibration: dict | None, like: PlaceDescriptor) -> None:
        self.config = config
        self.received = 0
        self.refused: list[str] = []
        self._judge = Judge(config.replace(threads=1), calibration)
        self._sequence = SequenceMemory()
        self._like = like
        self._cache: OrderedDict[str, PlaceDescriptor] = OrderedDict()

    def to(self, query: Query, store: PlaceStore, where: str = "") -> list[LoopClosure]:
        """Every candidate of the fleet that was examined, best first. Raises FleetError where the store fails."""
        descriptor = query.descriptor
        vector = np.asarray(descriptor.global_vector, np.float32)
        hits, refused = store.search(vector, max(self.config.candidates, AROUND), where)
        around = [(hit.place.ref, hit.similarity) for hit in hits]
        descriptors, more = self._descriptors(store, [hit.place.key for hit in hits[: self.config.candidates]])
        self.refused += refused + more
        known = [hit for hit in hits if hit.place.key in descriptors]
        candidates = [(hit.place.ref, hit.similarity) for hit in known]
        references = [descriptors[hit.place.key] for hit in known]
        closures = self._judge.judge(
            query.ref, descriptor, query.predecessor, candidates, references, self.config, around
        )
        self._sequence.remember(query.ref.camera, closures, window_of(self.config.consistency + DOUBT))
        return [decided(closure, self.config, self._sequence) for closure in closures]

    def keep(self, rgb: NDArray[np.uint8]) -> bytes:
        """(H, W, 3) uint8 -> what is kept of an image to verify it."""
        return self._judge.verifier.keep(rgb, "")

    def forget(self) -> None:
        """What comes next does not follow what went before."""
        self._sequence.forget()

    def _descriptors(self, store: PlaceStore, keys: list[str]) -> tuple[dict[str, PlaceDescriptor], list[str]]:
        found = {key: self._cache[key] for key in keys if key in self._cache}
        places, refused = store.fetch([key for key in keys if key not in found])
        for key, place in places.items():
            self.received += row_bytes(place)
            try:
                found[key] = descriptor_of(place, self._like)
            except FleetError as error:
                refused.append(f"{store.uri}: {error} (of {place.robot})")
        for key in keys:
            if key in found:
                self._cache[key] = found[key]
                self._cache.move_to_end(key)
        while len(self._cache) > _CACHED:
            self._cache.popitem(last=False)
        return found, refused


def of_robot(query: Query, robot: str, session: int) -> Query:
    """The query as the fleet knows it; `session` as in Place."""
    return replace(query, ref=replace(query.ref, robot=robot, session=session // 10**9))
