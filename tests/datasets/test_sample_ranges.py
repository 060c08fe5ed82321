"""Samples of other than 8 and 16 bits become 8 bits by their own range; maps keep what they store."""

from __future__ import annotations

import struct
import warnings
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.datasets import SampleRangeWarning, read_disparity_png, read_image, read_occlusion_mask
from tensor_stereo.limits import LimitError
from tests.datasets.image_files import png16, tiff


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def to_8_bits(value: int, largest: int) -> int:
    """value * 255 / largest, rounded half up, in rational arithmetic."""
    return int(Fraction(255 * value, largest) + Fraction(1, 2))


def netpbm(kind: int, samples: list[int], maxval: int) -> bytes:
    """Kinds of netpbm: P2 and P3 are text, P5 and P6 binary; P3 and P6 have three channels."""
    width = len(samples) // (3 if kind in (3, 6) else 1)
    head = f"P{kind}\n# by a camera\n{width} 1\n{maxval}\n".encode()
    if kind in (2, 3):
        return head + " ".join(map(str, samples)).encode() + b"\n"
    return head + struct.pack(f">{len(samples)}{'H' if maxval > 255 else 'B'}", *samples)


@pytest.mark.parametrize("kind", [2, 3, 5, 6])
@pytest.mark.parametrize("maxval", [1, 15, 100, 254, 255, 256, 1023, 4095, 16383, 65535])
def test_netpbm_is_scaled_by_its_maxval(tmp_path, kind, maxval):
    samples = [0, maxval // 3, maxval // 2, maxval - 1, maxval, maxval]
    image = read_image(write(tmp_path / "a.ppm", netpbm(kind, samples, maxval)))
    assert image.permute(1, 2, 0).flatten().tolist() == [to_8_bits(value, maxval) for value in samples]


def test_ten_bits_have_all_grey_levels(tmp_path):
    assert len(read_image(write(tmp_path / "a.pgm", netpbm(5, list(range(1024)), 1023))).unique()) == 256


@pytest.mark.parametrize("kind", [2, 5])
def test_sample_above_maxval_is_refused(tmp_path, kind):
    with pytest.raises(ValueError, match=r"a\.pgm must hold samples of at most 100, as it says itself, found 101"):
        read_image(write(tmp_path / "a.pgm", netpbm(kind, [0, 101], 100)))


@pytest.mark.parametrize("kind", [2, 5])
@pytest.mark.parametrize("maxval", [15, 100, 1023])
def test_map_in_a_pgm_is_not_scaled(tmp_path, kind, maxval):
    path = write(tmp_path / "disp.pgm", netpbm(kind, [0, 4, 10], maxval))
    np.testing.assert_array_equal(read_disparity_png(path, 4), np.array([[np.nan, 1, 2.5]], np.float32))


def test_mask_in_a_text_pgm_is_not_scaled(tmp_path):
    path = write(tmp_path / "mask.pgm", netpbm(2, [0, 128], 200))
    assert read_occlusion_mask(path).tolist() == [[False, True]]


@pytest.mark.parametrize(
    "content",
    [b"P5 0 1 255\n", b"P5 2 1 0\nab", b"P5 2 1 70000\nabcd", b"P5 2 1 4095\nabc", b"P2 2 1 9\n1", b"P3 1 1 9\n1 x 3"],
)
def test_damaged_netpbm_is_refused_quietly(tmp_path, content, capfd):
    with pytest.raises(ValueError, match=r"a\.pgm cannot be decoded"):
        read_image(write(tmp_path / "a.pgm", content))
    assert capfd.readouterr() == ("", "")


@given(value=st.integers(0, 2**16 - 1), bits=st.integers(8, 15), fill=st.sampled_from(["shift", "replicate", "none"]))
def test_sbit_of_a_png_undoes_every_fill(tmp_path_factory, value, bits, fill):
    largest = 2**bits - 1
    samples = [largest, value & largest, 0x55AA & largest]
    digits = [format(sample, f"0{bits}b") for sample in samples]
    stored = {
        "shift": [sample << (16 - bits) for sample in samples],
        "replicate": [int((text * 3)[:16], 2) for text in digits],
        "none": samples,
    }[fill]
    path = tmp_path_factory.getbasetemp() / "sbit.png"
    path.write_bytes(png16([stored], bytes([bits])))
    assert read_image(path).flatten().tolist() == [to_8_bits(sample, largest) for sample in samples]


def test_alpha_says_nothing_of_the_range_of_colours(tmp_path):
    colours = [4095, 0, 2048]
    path = write(tmp_path / "a.png", png16([[*(value << 4 for value in colours), 0xFFFF]], bytes([12, 12, 12, 16]), 4))
    assert read_image(path).flatten().tolist() == [255, 0, to_8_bits(2048, 4095)]


def test_samples_that_fit_no_fill_have_the_full_range(tmp_path):
    samples = [65535, 0x8001, 257 * 100]
    image = read_image(write(tmp_path / "a.png", png16([samples], bytes([12]))))
    assert image.flatten().tolist() == [to_8_bits(sample, 65535) for sample in samples]


def test_map_with_sbit_keeps_what_it_stores(tmp_path):
    path = write(tmp_path / "disp.png", png16([[0, 256 << 4]], bytes([12])))
    assert read_disparity_png(path, 256)[0, 1] == 16


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_tiff_is_scaled_by_its_bits(tmp_path, bits, order, big):
    largest = 2**bits - 1
    samples = [0, largest // 3, largest // 2, largest]
    path = write(tmp_path / "a.tif", tiff(samples, bits, order=order, big=big))
    assert read_image(path).flatten().tolist() == [to_8_bits(value, largest) for value in samples]
    assert read_disparity_png(path, 1)[0, 1:].tolist() == samples[1:]


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_tiff_whose_zero_is_white_is_turned_over(tmp_path, bits):
    largest = 2**bits - 1
    samples = [0, largest // 3, largest]
    path = write(tmp_path / "a.tif", tiff(samples, bits, tags={262: 0}))
    assert read_image(path).flatten().tolist() == [to_8_bits(largest - value, largest) for value in samples]


def test_tiff_of_16_bits_is_scaled_by_a_largest_sample_that_is_a_range(tmp_path):
    samples = [0, 1000, 4095]
    image = read_image(write(tmp_path / "a.tif", tiff(samples, 16, tags={281: 4095})))
    assert image.flatten().tolist() == [to_8_bits(value, 4095) for value in samples]


def test_tiff_of_16_bits_is_not_scaled_by_a_largest_sample_that_is_a_statistic(tmp_path):
    samples = [0, 1000, 40000]
    image = read_image(write(tmp_path / "a.tif", tiff(samples, 16, tags={281: 40000})))
    assert image.flatten().tolist() == [to_8_bits(value, 65535) for value in samples]


SAMPLES = [0, 1365, 4095]
OPEN = {
    "png": png16([SAMPLES]),
    "png with sBIT 16": png16([SAMPLES], bytes([16])),
    "tiff": tiff(SAMPLES, 16),
    "pgm": netpbm(5, SAMPLES, 65535),
}


@pytest.mark.parametrize("content", OPEN.values(), ids=OPEN)
def test_bits_can_be_given_where_the_file_does_not_tell(tmp_path, content):
    path = write(tmp_path / "a.png", content)
    assert read_image(path, sample_bits=12).flatten().tolist() == [0, 85, 255]
    assert read_image(path, sample_bits=np.int64(13)).flatten().tolist() == [0, 42, 127]


@pytest.mark.parametrize("content", OPEN.values(), ids=OPEN)
def test_dark_samples_of_an_open_range_are_told(tmp_path, content):
    path = write(tmp_path / "dark one.png", content)
    with pytest.warns(
        SampleRangeWarning, match=r"dark one\.png holds samples of 16 bits, none above 4095.*--sample-bits"
    ):
        image = read_image(path)
    assert image.flatten().tolist() == [0, 5, 16]


@pytest.mark.parametrize("samples", [[0, 0], [0, 2**14]])
def test_black_and_bright_images_are_not_told(tmp_path, samples):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_image(write(tmp_path / "a.png", png16([samples])))


def test_sample_above_the_given_bits_names_the_file(tmp_path):
    path = write(tmp_path / "a.png", png16([[0, 4096]]))
    with pytest.raises(ValueError, match=r"a\.png must hold samples of at most 4095 .*--sample-bits.* found 4096"):
        read_image(path, sample_bits=12)


@pytest.mark.parametrize(
    "content",
    [cv2.imencode(".png", np.array([[0, 200]], np.uint8))[1].tobytes(), netpbm(5, [0, 800], 1020), tiff([0, 802], 10)],
)
def test_given_bits_do_not_touch_files_that_tell_theirs(tmp_path, content):
    assert read_image(write(tmp_path / "a.png", content), sample_bits=16).flatten().tolist() == [0, 200]


@pytest.mark.parametrize(("bits", "error"), [(7, LimitError), (17, LimitError), (12.0, TypeError), (True, TypeError)])
def test_bits_are_checked_before_the_file_is_opened(bits, error):
    with pytest.raises(error, match="sample_bits must"):
        read_image("nowhere.png", sample_bits=bits)
