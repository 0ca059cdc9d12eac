"""A broken camera: publishes malformed messages made by hypothesis, a good image after every so many.

python -m test.ros.malform --count 10000 --good-every 100
Prints: offered N malformed and M good
"""

import argparse
import struct
import sys
import time
import zlib
from array import array

import cv2
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from sensor_msgs.msg import CompressedImage, Image

from msg_adapters.images import ENCODINGS
from test.ros.camera import EPOCH_S, RELIABLE, Health, compressed, image, scene
from test.ros.processes import NODE, PATIENCE_S, Listener, wait_until

PACE_S = 0.002  # the node unpacks and refuses one in less


def png_claiming(width: int, height: int) -> bytes:
    """A small file that unpacks to this size."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100_000))) + chunk(b"IEND", b"")


def images() -> st.SearchStrategy[Image]:
    sizes = st.one_of(st.integers(0, 64), st.integers(0, 2**32 - 1))
    return st.builds(
        Image,
        encoding=st.one_of(st.sampled_from(sorted(ENCODINGS)), st.text(st.characters(codec="ascii"), max_size=12)),
        width=sizes,
        height=sizes,
        step=st.one_of(st.integers(0, 256), st.integers(0, 2**32 - 1)),
        is_bigendian=st.integers(0, 255),
        data=st.binary(max_size=20_000).map(lambda b: array("B", b)),
    )


def files() -> st.SearchStrategy[bytes]:
    jpeg, png = (cv2.imencode(e, scene(0))[1].tobytes() for e in (".jpg", ".png"))

    def damaged(data: bytes, at: float, junk: bytes) -> bytes:
        start = int(at * len(data))
        return data[:start] + junk + data[start + len(junk) :]

    whole = st.sampled_from([jpeg, png])
    return st.one_of(
        st.binary(max_size=2000),
        st.builds(lambda data, share: data[: int(share * len(data))], whole, st.floats(0, 1)),
        st.builds(damaged, whole, st.floats(0, 1), st.binary(min_size=1, max_size=64)),
        st.binary(max_size=500).map(lambda b: b"\xff\xd8\xff" + b + b"\xff\xd9"),
        st.builds(png_claiming, st.integers(0, 2**31 - 1), st.integers(0, 2**31 - 1)),
    )


def compressed_images() -> st.SearchStrategy[CompressedImage]:
    names = st.one_of(st.sampled_from(["jpeg", "png", "rgb8; jpeg compressed bgr8", "16UC1; compressedDepth png"]),
                      st.text(st.characters(codec="ascii"), max_size=30))  # fmt: skip
    return st.builds(CompressedImage, format=names, data=files().map(lambda b: array("B", b)))


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--good-every", type=int, default=50)
    parser.add_argument("--begin", type=int, default=EPOCH_S, help="seconds of the first stamp")
    args = parser.parse_args()
    camera = Listener("broken_camera")
    publishers = {
        Image: camera.node.create_publisher(Image, "raw", RELIABLE),
        CompressedImage: camera.node.create_publisher(CompressedImage, "packed/compressed", RELIABLE),
    }
    for publisher in publishers.values():
        wait_until(publisher.get_subscription_count, PATIENCE_S, "a listener")
    camera.met_by(NODE)
    stamp_ns, offered, good, health = args.begin * 10**9, 0, 0, Health(camera)
    before = health.dealt_with()

    def settled() -> None:
        wait_until(lambda: health.dealt_with() - before >= offered + good, PATIENCE_S, "the node to deal with them all")

    def good_ones() -> None:
        nonlocal stamp_ns, good
        settled()  # nothing waits in the slot
        for make, kind in ((image, Image), (compressed, CompressedImage)):
            stamp_ns += 10**9
            publishers[kind].publish(make(scene(good), stamp_ns))
            good += 1
            settled()

    @settings(max_examples=args.count, deadline=None, database=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(
        message=st.one_of(images(), compressed_images()),
        stamp=st.one_of(st.none(), st.none(), st.none(), st.integers(0, EPOCH_S)),
        frame_id=st.text(st.characters(codec="ascii"), max_size=20),
    )
    def offer(message: Image | CompressedImage, stamp: int | None, frame_id: str) -> None:
        nonlocal stamp_ns, offered
        stamp_ns += 1000
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        message.header.stamp.sec, message.header.stamp.nanosec = (seconds, nanoseconds) if stamp is None else (stamp, 0)
        message.header.frame_id = frame_id
        publishers[type(message)].publish(message)
        offered += 1
        time.sleep(PACE_S)
        if offered % args.good_every == 0:
            good_ones()

    offer()
    good_ones()
    camera.close()
    print(f"offered {offered} malformed and {good} good")
    return 0


if __name__ == "__main__":
    sys.exit(main())
