"""JSON with a few values replaced, removed, doubled or swapped, as a careless or hostile hand leaves it."""

import copy

from hypothesis import strategies as st


def places(value, path=()):
    """Every place in nested JSON."""
    yield path
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.integers(-3, 100) | st.floats() | st.text(max_size=20)
    | st.sampled_from([10**9, 2**53, 2**63 - 1, "../victim/segment-00000001-0000.pnv", "/etc/passwd", "map.json",
                       "segment-00000001-0000.pnv", "segment-00000009-0000.pnv", "\0", "front", [[0, 10**9]],
                       [[5, 0]], [[0, 2**62]], "x" * 5000]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip


@st.composite
def edited(draw, body):
    """The body with one to three values replaced, removed, doubled or swapped."""
    body = copy.deepcopy(body)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.sampled_from([p for p in places(body) if p]))
        holder = body
        for key in place[:-1]:
            holder = holder[key]
        kind = draw(st.sampled_from(["replace", "near", "remove", "double", "reverse"]))
        value = holder[place[-1]]
        if kind == "near" and isinstance(value, int) and not isinstance(value, bool):
            holder[place[-1]] = value + draw(st.sampled_from([-1, 1, -2, 2, 2**31, 2**63, -(2**63)]))
        elif kind == "remove":
            del holder[place[-1]]
        elif kind == "double" and isinstance(value, list):
            holder[place[-1]] = value + value
        elif kind == "reverse" and isinstance(value, list):
            holder[place[-1]] = value[::-1]
        else:
            holder[place[-1]] = copy.deepcopy(draw(JSON))  # what is drawn is shared with later draws
        if not isinstance(body, dict):
            break
    return body
