"""Image messages to frames: rosbags-image and hand-made colours are the oracles."""

import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import PIL.ImageFile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.image import image_to_cvimage
from sensor_msgs.msg import CompressedImage, Image

from msg_adapters.images import ENCODINGS, MAX_SIDE, message_to_frame
from pnv_core.errors import ImageError

STAMP = SimpleNamespace(sec=1_700_000_000, nanosec=999_999_999)
BYTES = {name: e.channels * np.dtype(e.dtype).itemsize for name, e in ENCODINGS.items()}


def image(encoding, width, height, data, step=None, is_bigendian=0):
    step = width * BYTES.get(encoding, 1) if step is None else step
    return SimpleNamespace(header=SimpleNamespace(stamp=STAMP), encoding=encoding, width=width, height=height,
                           step=step, is_bigendian=is_bigendian, data=data)  # fmt: skip


def compressed(data, format="jpeg"):
    return SimpleNamespace(header=SimpleNamespace(stamp=STAMP), format=format, data=data)


def rgb(message):
    return message_to_frame(message, "camera").rgb


def noise(seed, *shape):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def photo(height=48, width=64):
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3, y * 4, (x + y) * 2], axis=2).astype(np.uint8)


@pytest.mark.parametrize("encoding", [e for e in ENCODINGS if "UC" not in e and "16" not in e])
def test_every_encoding_agrees_with_rosbags_image(encoding):
    message = image(encoding, 32, 24, noise(1, 24 * 32 * BYTES[encoding]))
    assert np.array_equal(rgb(message), image_to_cvimage(message, "rgb8"))


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_16_bit_grey_is_scaled_by_the_bits_in_use(encoding):
    full = np.linspace(0, 65535, 16 * 16).astype(np.uint16)
    assert rgb(image(encoding, 16, 16, full.tobytes())).max() == 255
    expected = np.round(full / 257.0).reshape(16, 16)
    assert np.abs(rgb(image(encoding, 16, 16, full.tobytes()))[..., 0] - expected).max() <= 0.5
    twelve_bit = full >> 4
    assert np.abs(rgb(image(encoding, 16, 16, twelve_bit.tobytes()))[..., 0] - expected).max() <= 1


@pytest.mark.parametrize(("encoding", "grid"), [("bayer_rggb8", "rggb"), ("bayer_bggr8", "bggr"),
                                                ("bayer_gbrg8", "gbrg"), ("bayer_grbg8", "grbg")])  # fmt: skip
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_bayer_sensor_that_sees_one_colour_gives_that_colour(encoding, grid, channel):
    tile = np.array([255 if colour == "rgb"[channel] else 0 for colour in grid], np.uint8).reshape(2, 2)
    centre = rgb(image(encoding, 32, 32, np.tile(tile, (16, 16)).tobytes()))[4:-4, 4:-4]
    assert centre[..., channel].min() == 255
    assert np.delete(centre, channel, axis=2).max() == 0


@given(
    encoding=st.sampled_from(sorted(ENCODINGS)),
    half_width=st.integers(8, 40),
    height=st.integers(16, 50),
    padding=st.integers(0, 70),
    big=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_row_padding_and_byte_order_do_not_change_the_picture(encoding, half_width, height, padding, big, seed):
    width, row = 2 * half_width, 2 * half_width * BYTES[encoding]
    rows = noise(seed, height, row)
    plain = rgb(image(encoding, width, height, rows.tobytes()))
    assert plain.shape == (height, width, 3)
    assert plain.dtype == np.uint8
    if big and ENCODINGS[encoding].dtype == "u2":
        rows = rows.reshape(height, width, 2)[..., ::-1].reshape(height, row)
    padded = np.hstack([rows, noise(seed + 1, height, padding)]).tobytes() + b"tail"
    assert np.array_equal(rgb(image(encoding, width, height, padded, row + padding, int(big))), plain)


def test_a_live_message_and_a_double_give_the_same_frame():
    pixels = photo()
    live = Image(encoding="rgb8", width=64, height=48, step=192, data=pixels.tobytes())
    live.header.stamp.sec, live.header.stamp.nanosec = STAMP.sec, STAMP.nanosec
    frame = message_to_frame(live, "front")
    assert (frame.stamp_ns, frame.camera) == (1_700_000_000_999_999_999, "front")
    assert np.array_equal(frame.rgb, pixels)


def test_a_frame_owns_its_pixels():
    pixels = photo()
    message = image("rgb8", 64, 48, pixels.reshape(-1))
    frame = message_to_frame(message, "camera")
    pixels[:] = 0
    assert frame.rgb.any()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (image("rgb9", 32, 32, b""), "'rgb9' is unknown; allowed: 16UC1, 8UC1"),
        (image("rgb8", 32, 32, bytes(3072), step=95), "step 95 is smaller than a row; allowed: at least 96"),
        (image("rgb8", 32, 32, bytes(3071)), "3071 bytes; allowed: at least step * height = 3072"),
        (image("rgb8", 1, 1, bytes(3)), "1x1 pixels; allowed: sides of 16 to 16384"),
        (image("rgb8", 20000, 480, b""), "20000x480 pixels; allowed"),
        (image("mono8", 2**32 - 1, 2**32 - 1, b"", step=2**32 - 1), "allowed: sides"),
        (image("mono8", 16384, 16384, b""), "at most 67108864 pixels"),
        (image("yuv422", 33, 32, bytes(33 * 64)), "33 wide; allowed: an even width"),
    ],
)
def test_an_unusable_image_is_refused_in_one_line(message, words):
    with pytest.raises(ImageError) as refusal:
        rgb(message)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def encoded(extension, pixels):
    return cv2.imencode(extension, pixels)[1].tobytes()


def test_jpeg_and_png_decode_to_rgb():
    bgr = photo()[..., ::-1]
    assert np.array_equal(rgb(compressed(encoded(".png", bgr), "bgr8; png compressed bgr8")), photo())
    assert np.abs(rgb(compressed(encoded(".jpg", bgr))).astype(int) - photo()).mean() < 4
    alpha = np.dstack([bgr, np.full(bgr.shape[:2], 7, np.uint8)])
    assert np.array_equal(rgb(compressed(encoded(".png", alpha), "png")), photo())


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_a_16_bit_png_decodes_to_its_upper_byte(shape):
    deep = np.linspace(0, 65535, np.prod(shape)).astype(np.uint16).reshape(shape)
    expected = deep[..., ::-1] if deep.ndim == 3 else np.repeat(deep[..., None], 3, axis=2)
    assert np.abs(rgb(compressed(encoded(".png", deep), "mono16; png")) - expected / 257.0).max() <= 0.51


def png_claiming(width, height):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(1_000_000))) + chunk(b"IEND", b"")


def test_a_decompression_bomb_is_refused_from_its_header(monkeypatch):
    for unpacking in ((PIL.ImageFile.ImageFile, "load"), (cv2, "imdecode")):
        monkeypatch.setattr(*unpacking, lambda *_: pytest.fail("the bomb was unpacked"))
    for size in [(60_000, 60_000), (2**31 - 1, 2**31 - 1), (MAX_SIDE, MAX_SIDE)]:
        with pytest.raises(ImageError, match="pixels; allowed"):
            rgb(compressed(png_claiming(*size), "png"))
    huge_jpeg = bytearray(encoded(".jpg", photo()))
    at = huge_jpeg.index(b"\xff\xc0")
    huge_jpeg[at + 5 : at + 9] = struct.pack(">HH", 65500, 65500)
    with pytest.raises(ImageError, match=r"4290250000 pixels; allowed"):
        rgb(compressed(bytes(huge_jpeg)))


def test_a_jpeg_of_a_thousand_scans_is_refused():
    data = encoded(".jpg", photo())
    with pytest.raises(ImageError, match="1001 scans; allowed: at most 100"):
        rgb(compressed(data[:-2] + b"\xff\xda" * 1000 + data[-2:]))


@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_a_truncated_file_is_refused_and_not_filled_with_grey(extension):
    data = encoded(extension, noise(5, 240, 320, 3))
    for share in (0.0, 0.01, 0.3, 0.9, 0.999):
        with pytest.raises(ImageError):
            rgb(compressed(data[: int(share * len(data))]))


def test_a_jpeg_is_decoded_at_the_fraction_that_is_enough():
    picture = cv2.resize(noise(4, 45, 80, 3), (1280, 720), interpolation=cv2.INTER_CUBIC)
    message = compressed(cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())
    for enough, shape in (
        ((1280, 720), (720, 1280)), ((641, 288), (720, 1280)), ((640, 288), (360, 640)), ((200, 180), (180, 320))
    ):  # fmt: skip
        small = message_to_frame(message, "camera", enough).rgb
        assert small.shape[:2] == shape
        averaged = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - averaged).mean() < 2.0
    cut = compressed(message.data[: len(message.data) // 2])
    with pytest.raises(ImageError, match="cannot be decoded"):
        message_to_frame(cut, "camera", (640, 288))


def test_other_formats_are_refused_by_name():
    with pytest.raises(ImageError, match="is a depth image; allowed: jpeg, png"):
        rgb(compressed(bytes(100), "16UC1; compressedDepth png"))
    with pytest.raises(ImageError, match="starts with 42 4d .* allowed: jpeg, png"):
        rgb(compressed(encoded(".bmp", photo())))
    with pytest.raises(ImageError, match="starts with nothing"):
        rgb(compressed(b""))


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(
        st.builds(
            image,
            encoding=st.one_of(st.sampled_from(sorted(ENCODINGS)), st.text(max_size=8)),
            width=st.one_of(st.integers(0, 64), st.integers(0, 2**32 - 1)),
            height=st.one_of(st.integers(0, 64), st.integers(0, 2**32 - 1)),
            step=st.one_of(st.integers(0, 256), st.integers(0, 2**32 - 1)),
            is_bigendian=st.integers(0, 255),
            data=st.binary(max_size=20_000),
        ),
        st.builds(
            compressed,
            data=st.one_of(
                st.binary(max_size=200),
                st.binary(max_size=200).map(lambda b: b"\xff\xd8\xff" + b + b"\xff\xd9"),
                st.binary(max_size=200).map(lambda b: b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b + b"IEND"),
            ),
            format=st.text(max_size=12),
        ),
    )
)
def test_any_message_gives_a_frame_or_one_line(message):
    try:
        pixels = rgb(message)
    except ImageError as refusal:
        assert "\n" not in str(refusal)
    else:
        assert pixels.dtype == np.uint8
        assert pixels.shape[2] == 3


@settings(max_examples=100, deadline=None)
@given(extension=st.sampled_from([".jpg", ".png"]), where=st.floats(0, 1), value=st.binary(min_size=1, max_size=4))
def test_a_damaged_file_gives_a_frame_or_one_line(extension, where, value):
    data = bytearray(encoded(extension, photo()))
    at = int(where * (len(data) - len(value)))
    data[at : at + len(value)] = value
    try:
        pixels = rgb(CompressedImage(format="jpeg", data=bytes(data)))
    except ImageError as refusal:
        assert "\n" not in str(refusal)
    else:
        assert pixels.ndim == 3
