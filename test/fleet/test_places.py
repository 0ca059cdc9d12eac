"""What is believed of a row, a view and an outbox entry."""

import base64
import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnv_fleet.errors import FleetError
from pnv_fleet.places import (
    PART_BYTES,
    decode_view,
    descriptor_of,
    encode_view,
    from_bytes,
    from_row,
    layouts_of,
    parts_of,
    robot_name,
    to_bytes,
    to_row,
)
from test.fleet.worlds import DIM, descriptor, place

PARTS = parts_of(layouts_of(descriptor(0)))


def same(a, b) -> bool:
    return (a.ref, a.view, a.position, a.texture) == (b.ref, b.view, b.position, b.texture) and np.allclose(
        a.vector, b.vector
    )


def test_a_place_comes_back_from_its_row_and_from_the_outbox():
    given_place = place(3, position=(1.5, -2.0, 0.25))
    assert same(from_row(to_row(given_place, PARTS), DIM, PARTS), given_place)
    assert same(from_bytes(to_bytes(given_place)), given_place)


def test_a_view_larger_than_one_field_is_cut_and_joined():
    large = replace(place(1), view=np.random.default_rng(0).bytes(2 * PART_BYTES + 1))
    row = to_row(large, 3)
    assert max(len(row[f"view_{i}"]) for i in range(3)) <= 65_535
    assert from_row(row, DIM, 3).view == large.view
    with pytest.raises(FleetError, match="allowed in this collection"):
        to_row(large, 2)


def test_patches_come_back_within_half_a_step_of_int8():
    seen = descriptor(5, b"\xff\xd8picture")
    back = descriptor_of(replace(place(5), view=encode_view(seen)), seen)
    error = np.abs(back.patches[0].descriptors - seen.patches[0].descriptors)
    assert (error <= np.abs(seen.patches[0].descriptors).max(1, keepdims=True) / 254 + 1e-6).all()
    assert back.thumbnail == seen.thumbnail


def sealed(head: bytes, body: bytes = b"") -> bytes:
    """A view with a right checksum, whatever is in it."""
    rest = struct.pack("<H", len(head)) + head + body
    return b"PNVV" + struct.pack("<I", zlib.crc32(rest)) + rest


@pytest.mark.parametrize(
    "view",
    [
        b"",
        b"PNVV",
        encode_view(descriptor(0))[:-1],
        b"XXXX" + encode_view(descriptor(0))[4:],
        sealed(b"not json"),
        sealed(b"[" * 5000),
        sealed(b'{"precision":"int8"}'),
        sealed(b'{"precision":"float64","grids":[]}'),
        sealed(json.dumps({"precision": "int8", "grids": [[2, 2**31, 2**31, 1, 2**31]]}).encode()),
        sealed(json.dumps({"precision": "int8", "grids": [[2, 60_000, 60_000, 1, 60_000]]}).encode()),
        sealed(json.dumps({"precision": "int8", "grids": [[2, -3, 4, 1, 16]]}).encode()),
        sealed(json.dumps({"precision": "int8", "grids": [[2, 3, 4, 1, 16]]}).encode(), b"short"),
        sealed(json.dumps({"precision": "int8", "grids": [[1, 1, 1, 1, 1]] * 1000}).encode()),
        sealed(json.dumps({"precision": "int8", "grids": [["2", None, {}, [], 1]]}).encode()),
        encode_view(descriptor(0, b"PNVF" + b"\xff" * 30)),
        encode_view(descriptor(0, bytes(1 << 18))),
    ],
    ids=range(16),
)
def test_a_view_that_is_not_whole_is_refused_in_one_line(view):
    with pytest.raises(FleetError) as refusal:
        decode_view(view)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


def test_scales_that_are_no_numbers_are_refused():
    seen = descriptor(0)
    layout = layouts_of(seen)[0]
    head = json.dumps({"precision": "int8", "grids": [[2, 3, 4, 1, 16]]}).encode()
    body = bytearray(encode_view(seen)[10 + len(json.dumps({"a": 1})) :][:0] + bytes(layout.end))
    body[layout.scales_at : layout.scales_at + 4] = struct.pack("<f", float("nan"))
    with pytest.raises(FleetError, match="scales"):
        decode_view(sealed(head, bytes(body)))


def test_patches_of_another_shape_than_this_models_are_refused():
    other = replace(descriptor(0), patches=(replace(descriptor(0).patches[0], rows=4, cols=3),))
    with pytest.raises(FleetError, match="another shape"):
        descriptor_of(place(0), other)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("robot", 'x" or "1"=="1'),
        ("robot", "a" * 65),
        ("robot", None),
        ("camera", "c" * 256),
        ("camera", "a\nb"),
        ("session", -1),
        ("keyframe", 2**63 - 1),
        ("keyframe", True),
        ("stamp_ns", 1.5),
        ("stamp_ns", -1),
        ("texture", float("nan")),
        ("texture", 7.0),
        ("x", float("inf")),
        ("vector", [float("nan")] * DIM),
        ("vector", [1.0] * DIM),
        ("vector", [1.0] * (DIM + 1)),
        ("vector", [0.0] * DIM),
        ("vector", "text"),
        ("view_0", "A" * 65_536),
        ("view_0", "no base64!"),
        ("view_0", 7),
    ],
)
def test_a_hostile_row_is_refused_by_what_is_wrong_with_it(name, value):
    row = to_row(place(1, position=(0.0, 0.0, 0.0)), PARTS) | {name: value}
    with pytest.raises(FleetError) as refusal:
        from_row(row, DIM, PARTS)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


@given(st.binary(max_size=200))
def test_no_bytes_make_an_outbox_entry_or_a_view_fail_otherwise(data):
    for read in (from_bytes, decode_view):
        with pytest.raises(FleetError):
            read(data)


def test_a_model_with_patches_too_large_for_a_row_is_refused():
    grid = replace(descriptor(0).patches[0], rows=40, cols=30, descriptors=np.zeros((1200, 4096), np.float32))
    with pytest.raises(FleetError, match="preset"):
        parts_of(layouts_of(replace(descriptor(0), patches=(grid,))))


@pytest.mark.parametrize("name", ["", "a b", 'x"', "r" * 65, "ü"])
def test_robot_names_that_could_end_an_expression_are_refused(name):
    with pytest.raises(FleetError, match="robot name"):
        robot_name(name)


def test_base64_of_a_part_fits_a_field():
    assert len(base64.b64encode(bytes(PART_BYTES))) <= 65_535
