"""Files that decoders complain about, or that claim more than they hold."""

from __future__ import annotations

import os
import struct

import cv2
import numpy as np
import pytest

from tensor_stereo.datasets.images import read_image
from tests.datasets.test_formats import GREY, png, write


def jpeg() -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def test_a_jpeg_whose_data_are_damaged_is_refused_and_nothing_is_printed(tmp_path, capfd):
    whole = jpeg()
    start = whole.index(b"\xff\xda") + 14
    refused = 0
    for place in range(start, len(whole) - 4, 97):
        damaged = whole[:place] + b"\xff\xd9" + whole[-2:]  # an early end
        with pytest.raises(ValueError, match=r"im0\.jpg cannot be decoded as an image: Corrupt JPEG data"):
            read_image(write(tmp_path / "im0.jpg", damaged))
        refused += 1
    assert refused > 10
    assert capfd.readouterr() == ("", "")
    assert read_image(write(tmp_path / "im0.jpg", whole)).shape == (3, 60, 80)


def test_a_png_with_right_checksums_and_wrong_data_is_refused_and_nothing_is_printed(tmp_path, capfd):
    for rows in (b"\0" * 50, b"\x09" + bytes(40) + b"\0" + bytes(40)):  # too few, an unknown filter
        with pytest.raises(ValueError, match=r"im0\.png cannot be decoded as an image"):
            read_image(write(tmp_path / "im0.png", png(40, 2, 8, GREY, rows)))
    assert capfd.readouterr() == ("", "")


def test_other_messages_of_the_process_are_not_lost(tmp_path, capfd):
    from tensor_stereo.datasets.decoder_messages import caught_messages

    with caught_messages() as messages:
        os.write(2, b"libpng warning: iCCP: known incorrect sRGB profile\n\nsomebody else\n")
    assert messages.damage == ""
    assert capfd.readouterr().err == "somebody else\n"


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_a_header_that_claims_gigabytes_is_refused_before_decoding(tmp_path, kind):
    if kind == "png":
        content = png(40000, 40000, 8, GREY, b"\0" * 100)
    else:
        content = jpeg()
        place = content.index(b"\xff\xc0") + 5
        content = content[:place] + struct.pack(">HH", 32767, 32767) + content[place + 4 :]
    with pytest.raises(
        ValueError, match=r"must have at most 134217728 pixels, its header says (40000 x 40000|32767 x 3)"
    ):
        read_image(write(tmp_path / f"im0.{kind}", content))


def test_a_float_map_with_signalling_nan_is_unknown_there(tmp_path, recwarn):
    from tensor_stereo.datasets import PairFiles, read_pair

    values = struct.pack("<4I", 0x7F800001, 0x7F000000, 0x3F800000, 0xFF800000)  # signalling NaN, 1.7e38, 1, -inf
    disparity = write(tmp_path / "d.PFM", b"Pf\n4 1\n-1\n" + values)
    view = write(tmp_path / "im.pgm", b"P5 4 1 255 1234")
    found = read_pair(PairFiles("a", "b", view, view, disparity, 0.1)).disparity_gt
    assert found.isnan().tolist() == [[True, True, False, True]]
    assert found[0, 2] == 10
    assert not recwarn.list


def test_a_damaged_bitmap_of_netpbm_prints_nothing(tmp_path, capfd):
    with pytest.raises(ValueError, match=r"im0\.pgm cannot be decoded as an image"):
        read_image(write(tmp_path / "im0.pgm", b"P1 made for tests\n96 72\n255\n24 24 0x10 24"))
    assert capfd.readouterr() == ("", "")
