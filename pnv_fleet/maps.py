"""Saved maps and the fleet: a map goes up, a selection comes down, the store is looked through and thinned."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pnv_core.database.patch_codes import views
from pnv_core.maps.manifest import Manifest
from pnv_core.maps.reading import open_map
from pnv_core.maps.segment import SavedKeyframe
from pnv_core.maps.tools import write_map
from pnv_core.types import ImageRef, PlaceDescriptor
from pnv_fleet.errors import FleetError
from pnv_fleet.places import Place, decode_view, encode_view, layouts_of, robot_name, without_picture
from pnv_fleet.store import PlaceStore

MOST = 20_000  # keyframes of one map that comes down; they are held in memory, about 0.1 MB each
_BATCH = 16


def push(store: PlaceStore, path: Path, robot: str, fingerprint: str, like: PlaceDescriptor, pictures: bool) -> int:
    """Every keyframe of a saved map, under a robot's name; sent again, they are the same places. Gives their number.

    Raises MapError for a damaged map, FleetError for one of another model.
    """
    robot = robot_name(robot)
    with open_map(path) as opened:
        if opened.manifest.fingerprint != fingerprint:
            raise FleetError(f"{path} was made with model {opened.manifest.fingerprint}; allowed: {fingerprint}")
        first = {s.session: s.first_stamp_ns for s in opened.manifest.sessions}
        batch: list[Place] = []
        count = 0
        for kf in opened.keyframes():
            batch.append(_place(kf, robot, first[kf.ref.session], like, pictures))
            if len(batch) == _BATCH:
                store.put(batch)
                count, batch = count + len(batch), []
        if batch:
            store.put(batch)
        return count + len(batch)


def _place(kf: SavedKeyframe, robot: str, session: int, like: PlaceDescriptor, pictures: bool) -> Place:
    buffer = kf.read()
    codes = views(buffer, kf.layouts)
    grids = tuple(c.grid(g.cell) for c, g in zip(codes, like.patches, strict=True))
    picture = buffer[kf.layouts[-1].end if kf.layouts else 0 :].tobytes()
    seen = PlaceDescriptor(np.array(kf.vector), grids, kf.texture, picture)
    view = encode_view(seen if pictures else without_picture(seen))
    return Place(robot, session, kf.ref.camera, kf.ref.id, kf.ref.stamp_ns, kf.texture, seen.global_vector, view)


def pull(
    store: PlaceStore, where: str, output: Path, fingerprint: str, like: PlaceDescriptor, say: Callable[[str], None]
) -> Manifest:
    """The places that fulfil an expression as a map that a node loads; each robot's sessions are sessions of it.

    A row that is not believed is left out and told to `say`. Raises FleetError for none or too many, MapError for an
    output that exists.
    """
    count = store.count(where)
    if not 0 < count <= MOST:
        raise FleetError(f"{count} places are selected; allowed: 1 to {MOST}")
    places: list[Place] = []
    for place in store.scan(where, views=True):
        try:
            if isinstance(place, str):
                raise FleetError(place)
            decode_view(place.view, layouts_of(like))
            places.append(place)
        except FleetError as error:
            say(f"refused {error}")
    if not places:
        raise FleetError(f"none of {count} places is whole; allowed: one at least")
    places.sort(key=lambda p: (p.session, p.robot, p.keyframe))
    keyframes = list(_keyframes(places, like))
    none = Manifest(fingerprint, store.dim, 0, 0, 0, 0, (), (), ())
    sessions = {kf.ref.session for kf in keyframes}
    return write_map(output, none, lambda: keyframes, keyframes[-1].ref.id + 1, len(sessions))


def _keyframes(places: list[Place], like: PlaceDescriptor) -> Iterator[SavedKeyframe]:
    """Ids are counted on from run to run and keep the gaps within one."""
    runs: dict[tuple[str, int], tuple[int, int]] = {}
    last = -1
    for place in places:
        number, base = runs.setdefault((place.robot, place.session), (len(runs), last + 1 - place.keyframe))
        last = max(last + 1, base + place.keyframe)
        layouts, buffer = decode_view(place.view, layouts_of(like))
        ref = ImageRef(last, place.stamp_ns, place.camera, number)
        yield SavedKeyframe(ref, place.vector, layouts, np.frombuffer(buffer, np.uint8), place.texture)


def sessions(store: PlaceStore) -> dict[tuple[str, int], tuple[int, int, int]]:
    """Per robot and session (its first stamp in ns): places, first and last stamp in ns."""
    found: dict[tuple[str, int], tuple[int, int, int]] = {}
    for place in store.scan():
        if not isinstance(place, str):
            count, first, last = found.get((place.robot, place.session), (0, place.stamp_ns, 0))
            found[place.robot, place.session] = count + 1, min(first, place.stamp_ns), max(last, place.stamp_ns)
    return dict(sorted(found.items()))


def thin(store: PlaceStore, similarity: float, where: str = "") -> int:
    """Forget the places that fulfil an expression and of which a newer one, of any robot, is at least so similar.

    Gives their number.
    """
    gone: set[str] = set()
    places = [p for p in store.scan(where) if not isinstance(p, str)]
    for place in sorted(places, key=lambda p: p.stamp_ns):
        full = store.fetch([place.key])[0].get(place.key)
        if full is None:
            continue
        hits, _ = store.search(full.vector, 2, f"stamp_ns > {place.stamp_ns}")
        if any(hit.similarity >= similarity for hit in hits):
            gone.add(place.key)
    for at in range(0, len(gone), 100):
        keys = ", ".join(f'"{key}"' for key in sorted(gone)[at : at + 100])
        store.forget(f"key in [{keys}]")
    return len(gone)
