"""Drives on which no place is seen twice, through the default model and settings: nothing may be confirmed."""

from pnv_core.describe.describer import load_describer
from pnv_core.images import list_images, read_image
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame


def confirmed(files, step_s):
    """(query, match) image numbers of the accepted closures."""
    recognizer = PlaceRecognizer(load_describer(exclude_recent_s=15.0))
    number = {round(i * step_s * 1e9): i for i in range(len(files))}
    found = []
    for stamp, i in number.items():
        closures = recognizer.process(Frame(stamp, "front", read_image(files[i])))
        found += [(number[c.query.stamp_ns], number[c.match.stamp_ns]) for c in closures if c.accepted]
    return found


def test_a_drive_without_a_revisit_closes_no_loop(shared):
    files = list_images(shared / "data/kitti03_noloop/images")
    assert confirmed(files[::3], step_s=3 * 0.2076) == []


def test_two_floors_that_look_alike_are_not_joined(shared):
    first, second = (list_images(shared / "data/multifloor_corridor_noloop" / f) for f in ("floor1", "floor2"))
    joined = [(q, m) for q, m in confirmed(first + second, step_s=0.5) if q >= len(first) > m]
    assert joined == []
