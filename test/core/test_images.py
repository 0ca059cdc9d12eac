"""One decoder: a picture is the same whichever way it comes. The oracles are the ramps the files were made of."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from msg_adapters.images import message_to_frame
from pnv_core.errors import ImageError
from pnv_core.images import read_image, to_8_bit
from pnv_lab.fit import image_files, read_rgb
from pnv_lab.training.sources import load_set
from test.core.small import small_describer

HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0))
RAMP = np.linspace(0, 255, 48 * 64).reshape(48, 64)  # grey levels from 0 to 255, mean 127.5


def compressed(path):
    return message_to_frame(SimpleNamespace(header=HEADER, format="png", data=path.read_bytes()), "camera").rgb


def raw(grey):
    message = SimpleNamespace(header=HEADER, encoding="mono16", width=64, height=48, step=128, is_bigendian=0,
                              data=grey.tobytes())  # fmt: skip
    return message_to_frame(message, "camera").rgb


def of_a_training_set(path):
    folder = path.parent / f"set_{path.stem}"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / path.name).write_bytes(path.read_bytes())
    (folder / "groups.csv").write_text(f"image,place_or_sequence_id,index_in_sequence\n{path.name},a,0\n")
    return load_set(folder)[0].rgb


READERS = {
    "file": read_image,
    "message": compressed,
    "fit": lambda path: read_rgb(path, 64, 48),
    "training": of_a_training_set,
}


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("colour", [False, True])
def test_a_16_bit_picture_has_the_same_brightness_however_many_bits_the_camera_fills(bits, reader, colour, tmp_path):
    deep = (RAMP / 255 * (2**bits - 1)).round().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), np.dstack([deep] * 3) if colour else deep)
    given = READERS[reader](tmp_path / "deep.png")
    assert given.mean() == pytest.approx(127.5, abs=0.5)
    assert np.abs(given[..., 1] - RAMP).max() <= 1
    assert np.array_equal(raw(deep), given)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_a_hot_pixel_does_not_darken_a_frame(suffix, tmp_path):
    deep = (RAMP / 255 * 4095).round().astype(np.uint16)
    hot = deep.copy()
    hot[20, 30] = 65535
    cv2.imwrite(str(tmp_path / f"hot{suffix}"), hot)
    for given in (read_image(tmp_path / f"hot{suffix}"), raw(hot)):
        differing = np.abs(given[..., 0] - RAMP) > 1
        assert differing.sum() == 1
        assert given[20, 30].tolist() == [255, 255, 255]


@pytest.mark.parametrize("full", [1.0, 255.0, 4095.0, 65535.0])
def test_a_float_tiff_is_read_at_its_own_scale(full, tmp_path):
    cv2.imwrite(str(tmp_path / "f.tiff"), (RAMP / 255 * full).astype(np.float32))
    assert np.abs(read_image(tmp_path / "f.tiff")[..., 2] - RAMP).max() <= 1


@pytest.mark.parametrize(
    ("value", "words"),
    [(np.nan, "not finite"), (-3.0, "negative"), (np.inf, "not finite"), (1e9, "up to 1e\\+09; allowed: 0 to 1 or")],
)
def test_values_that_are_no_picture_are_refused_by_name(value, words, tmp_path):
    cv2.imwrite(str(tmp_path / "f.tiff"), np.full((48, 64), value, np.float32))
    with pytest.raises(ImageError, match=f"f.tiff: holds values .*{words}"):
        read_image(tmp_path / "f.tiff")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("deep", [False, True])
def test_the_rotation_a_camera_noted_is_applied_by_every_reader(orientation, reader, deep, tmp_path):
    upright = np.zeros((48, 64), np.uint8)
    upright[:10, :30] = 200
    upright[40:, 60:] = 90
    # EXIF names where the stored first row and column belong: undone here by Pillow's transpositions
    undo = {2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE", 6: "ROTATE_90",
            7: "TRANSVERSE", 8: "ROTATE_270"}  # fmt: skip
    stored = Image.fromarray(upright)
    if orientation > 1:
        stored = stored.transpose(Image.Transpose[undo[orientation]])
    if deep:
        stored = Image.fromarray(np.asarray(stored).astype(np.uint16) * 257)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / "turned.png", exif=exif)
    given = READERS[reader](tmp_path / "turned.png")
    assert given.shape == (48, 64, 3)
    assert np.array_equal(given[..., 0], upright)


@pytest.mark.parametrize("reader", READERS)
def test_a_bomb_is_refused_by_every_reader_in_one_line(reader, tmp_path):
    Image.new("1", (40000, 40000)).save(tmp_path / "huge.png")
    with pytest.raises(ImageError, match=r"1600000000 pixels; allowed: up to 67 megapixels") as refusal:
        READERS[reader](tmp_path / "huge.png")
    assert "\n" not in str(refusal.value)


def test_fitting_takes_every_kind_of_file_that_describing_takes(tmp_path):
    for suffix in (".pgm", ".webp", ".tif"):
        Image.fromarray(RAMP.astype(np.uint8)).save(tmp_path / f"a{suffix}")
    assert [p.suffix for p in image_files([tmp_path])] == [".pgm", ".tif", ".webp"]


def test_a_12_bit_picture_matches_itself_in_16_bits(tmp_path):
    """Stored in the lower or in the upper bits, it is one picture."""
    rng = np.random.default_rng(0)
    deep = cv2.resize(rng.integers(0, 4096, (20, 24)).astype(np.uint16), (192, 160), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "low.png"), deep)
    cv2.imwrite(str(tmp_path / "high.png"), deep << 4)
    describer = small_describer()
    low, high = (describer.describe(read_image(tmp_path / f"{name}.png")).global_vector for name in ("low", "high"))
    assert low @ high > 0.999


def test_8_bit_pixels_are_left_as_they_are():
    dark = np.arange(16, dtype=np.uint8).reshape(4, 4)
    assert np.array_equal(to_8_bit(dark), dark)
