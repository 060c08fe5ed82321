"""JPEG, TIFF, WebP and BMP: sizes from headers equal the decoded ones, and damaged files are refused quietly."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tensor_stereo.datasets import read_image
from tensor_stereo.datasets.image_size import image_size
from tests.datasets.image_files import tiff

PIXELS = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (60, 81, 3), dtype=np.uint8), (5, 5), 2)
ENCODED = {
    "jpeg": (".jpg", []),
    "progressive jpeg": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "jpeg with restarts": (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
    "tiff, lzw": (".tif", [cv2.IMWRITE_TIFF_COMPRESSION, 5]),
    "tiff, plain": (".tif", [cv2.IMWRITE_TIFF_COMPRESSION, 1]),
    "tiff, deflate": (".tif", [cv2.IMWRITE_TIFF_COMPRESSION, 8]),
    "webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
    "lossless webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    "bmp": (".bmp", []),
}
FILES = {name: cv2.imencode(ending, PIXELS, options)[1].tobytes() for name, (ending, options) in ENCODED.items()}
EXIF = b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
EXIF = EXIF[:2] + (len(EXIF) - 2).to_bytes(2) + EXIF[4:]
FILES["webp with alpha"] = cv2.imencode(".webp", np.dstack([PIXELS, PIXELS[..., 0]]), [cv2.IMWRITE_WEBP_QUALITY, 80])[
    1
].tobytes()
FILES["rotated jpeg"] = FILES["jpeg"][:2] + EXIF + FILES["jpeg"][2:]
FILES["jpeg with a thumbnail"] = (
    FILES["jpeg"][:2] + b"\xff\xe2" + (len(FILES["jpeg"]) + 2).to_bytes(2) + FILES["jpeg"] + FILES["jpeg"][2:]
)


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_size_in_the_header_is_that_of_the_decoded_image(tmp_path, content):
    path = write(tmp_path / "x.bin", content)  # whatever the ending says
    assert image_size(path) == (81, 60)
    assert read_image(path).shape == (3, 60, 81)


@pytest.mark.parametrize("name", ["tiff, lzw", "tiff, plain", "tiff, deflate", "lossless webp", "bmp"])
def test_lossless_formats_keep_every_value_in_the_order_rgb(tmp_path, name):
    image = read_image(write(tmp_path / "a.bin", FILES[name]))
    np.testing.assert_array_equal(image.permute(1, 2, 0).numpy(), PIXELS[..., ::-1])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("ending", "mode"),
    [
        *((ending, mode) for ending in ("tif", "png", "webp", "jpg") for mode in ("L", "RGB")),
        ("tif", "I;16"),
        ("png", "I;16"),
    ],
)
def test_no_format_is_turned(tmp_path, ending, mode, orientation):
    grey = np.array([[255, 255, 255], [0, 0, 255]], np.uint8).repeat(16, 0).repeat(16, 1)
    pixels = {"L": grey, "RGB": np.dstack([grey] * 3), "I;16": grey.astype(np.uint16) * 257}[mode]
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(tmp_path / f"a.{ending}", exif=exif)
    image = read_image(tmp_path / f"a.{ending}")
    assert image_size(tmp_path / f"a.{ending}") == (48, 32)
    np.testing.assert_allclose(image[0].numpy(), grey, atol=40 if ending in ("webp", "jpg") else 0)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_orientation_is_put_aside_in_either_order_of_bytes(tmp_path, order, big):
    path = write(tmp_path / "a.tif", tiff([0, 257 * 7, 65535], 16, order=order, big=big, tags={274: 6}))
    assert read_image(path).tolist() == [[[0, 7, 255]]]


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_size_of_a_tiff_needs_no_known_mode(tmp_path, bits, order, big):
    path = write(tmp_path / "a.tif", tiff([1, 2, 3, 4, 5], bits, order=order, big=big))
    assert image_size(path) == (5, 1)


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
@pytest.mark.parametrize("part", [0.5, 0.9, -6, -1])
def test_truncated_file_is_refused_quietly(tmp_path, content, part, capfd):
    stop = int(len(content) * part) if isinstance(part, float) else part
    path = write(tmp_path / "short.bin", content[:stop])
    with pytest.raises(ValueError, match=r"short\.bin cannot be decoded"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", [name for name in FILES if "jpeg" in name])
def test_jpeg_whose_end_is_zeros_is_refused(tmp_path, name, capfd):
    content = FILES[name]
    half = content[: 3 * len(content) // 4]
    with pytest.raises(ValueError, match=r"the JPEG file is truncated"):
        read_image(write(tmp_path / "a.jpg", half + bytes(len(content) - len(half))))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
@pytest.mark.parametrize("more", [bytes(100), b"a camera's own appendix"])
def test_what_follows_the_image_does_not_count(tmp_path, content, more):
    assert read_image(write(tmp_path / "a.bin", content + more)).shape == (3, 60, 81)


def test_damaged_strip_of_a_tiff_is_refused_quietly(tmp_path, capfd):
    content = bytearray(FILES["tiff, deflate"])
    content[len(content) // 2] ^= 255
    with pytest.raises(ValueError, match="the TIFF file is truncated or damaged"):
        read_image(write(tmp_path / "a.tif", bytes(content)))
    with pytest.raises(ValueError, match="the TIFF file is truncated or damaged"):
        read_image(write(tmp_path / "b.tif", tiff([1, 2, 3], 16, tags={279: 7})))
    assert capfd.readouterr() == ("", "")


def test_tiff_packed_by_zlib_is_read(tmp_path):
    samples = [0, 257 * 100, 65535]
    assert read_image(write(tmp_path / "a.tif", tiff(samples, 16, deflate=True))).flatten().tolist() == [0, 100, 255]


@given(
    name=st.sampled_from(sorted(FILES)), length=st.integers(0, 200), place=st.integers(0, 60), value=st.integers(0, 255)
)
def test_damaged_header_gives_a_size_or_an_error_that_names_the_file(tmp_path_factory, name, length, place, value):
    content = bytearray(FILES[name][: length or None])
    if place < len(content):
        content[place] = value
    path = tmp_path_factory.getbasetemp() / "header.bin"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            width, height = image_size(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:
            assert isinstance(width, int)
            assert isinstance(height, int)


@pytest.mark.parametrize("ending", ["jpg", "webp", "bmp"])
def test_size_of_a_large_image_is_told_without_a_warning(tmp_path, ending, monkeypatch):
    Image.new("L", (64, 48)).save(tmp_path / f"a.{ending}")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with pytest.raises(Image.DecompressionBombError):
        Image.open(tmp_path / f"a.{ending}")
    assert image_size(tmp_path / f"a.{ending}") == (64, 48)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.jpg"):
        image_size(tmp_path / "nowhere.jpg")


def test_size_needs_neither_torch_nor_opencv(tmp_path):
    path = write(tmp_path / "a.jpg", FILES["jpeg"])
    code = (
        "import sys; from tensor_stereo.datasets.image_size import image_size; image_size(sys.argv[1]); "
        "print({'torch', 'cv2', 'matplotlib'} & sys.modules.keys() or 'none')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout == "none\n"
