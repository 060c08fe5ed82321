from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from tensor_stereo.datasets.camera import Calibration, read_calibration
from tensor_stereo.datasets.image_size import image_size
from tensor_stereo.datasets.images import read_disparity_png, read_image, read_occlusion_mask
from tensor_stereo.datasets.pfm import read_pfm, write_pfm


def png(width: int, height: int, bits: int, color_type: int, rows: bytes, extra: bytes = b"") -> bytes:
    """A PNG by the letter of its specification; ``rows`` holds each row after its filter byte 0."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    if extra:
        extra = chunk(b"PLTE", extra)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


GREY, RGB, PALETTE, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


# portable float maps


@pytest.mark.parametrize(("scale", "order"), [(b"-1", "<"), (b"1.0", ">"), (b"-0.003922", "<"), (b"2.5e2", ">")])
def test_pfm_rows_are_bottom_up_and_the_scale_gives_only_the_byte_order(tmp_path, scale, order):
    bottom, top = (1.5, -2.0, 0.25), (7.0, float("inf"), 65504.0)
    path = write(tmp_path / "disp0.pfm", b"Pf\n3 2\n" + scale + b"\n" + struct.pack(order + "6f", *bottom, *top))
    values = read_pfm(path)
    assert values.dtype == np.float32
    assert values.dtype.isnative
    assert values.flags.c_contiguous
    assert values.tolist() == [list(top), list(bottom)]


@pytest.mark.parametrize("header", [b"Pf\n1 1\n-1\n", b"Pf\r\n1 1\r\n-1\r\n", b"Pf 1 1 -1 ", b"Pf\n1 1 \n-1.000 \n"])
def test_pfm_header_may_be_spaced_in_any_way(tmp_path, header):
    path = write(tmp_path / "a.pfm", header + struct.pack("<f", 3.5))
    assert read_pfm(path).tolist() == [[3.5]]


def test_pfm_data_that_start_with_a_newline_are_data(tmp_path):
    value = struct.unpack("<f", b"\n \n\n")[0]
    assert read_pfm(write(tmp_path / "a.pfm", b"Pf\n1 1\n-1\n\n \n\n")).tolist() == [[value]]


shapes = npst.array_shapes(min_dims=2, max_dims=2, max_side=9)
maps = st.one_of(shapes, shapes.map(lambda shape: (*shape, 3))).flatmap(lambda shape: npst.arrays(np.float32, shape))


@given(values=maps, byte_order=st.sampled_from(["little", "big"]))
def test_pfm_round_trip_keeps_every_bit(tmp_path_factory, values, byte_order):
    path = tmp_path_factory.getbasetemp() / "round_trip.pfm"
    write_pfm(path, values, byte_order=byte_order)
    back = read_pfm(path)
    assert back.shape == values.shape
    assert back.tobytes() == values.tobytes()


@pytest.mark.parametrize("byte_order", ["little", "big"])
@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 3)])
def test_written_pfm_is_what_opencv_reads(tmp_path, shape, byte_order):
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    write_pfm(tmp_path / "a.pfm", values, byte_order=byte_order)
    read = cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED)  # multiplies by the header's scale, here 1
    np.testing.assert_array_equal(read if values.ndim == 2 else read[..., ::-1], values)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no PFM file"),
        (b"P6\n2 1\n255\n" + bytes(6), "no PFM file"),
        (b"pf\n1 1\n-1\n" + bytes(4), "no PFM file"),
        (b"Pf\n2\n", "no PFM file"),
        (b"Pf\n-2 1\n-1\n" + bytes(8), "no PFM file"),
        (b"Pf\n1 1\nnan\n" + bytes(4), "no PFM file"),
        (b"Pf\n1 1\n0.0\n" + bytes(4), "byte order"),
        (b"Pf\n0 3\n-1\n", "must be positive"),
        (b"Pf\n2 2\n-1\n" + bytes(15), "need 16 bytes after the header, the file has 15"),
        (b"Pf\n2 2\n-1\n" + bytes(17), "need 16 bytes after the header, the file has 17"),
        (b"PF\n2 2\n-1\n" + bytes(16), "need 48 bytes"),
        (b"Pf\n999999999 999999999\n-1\n" + bytes(16), "need 3999999992000000004 bytes"),
        (b"Pf\n99999999999 1\n-1\n" + bytes(16), "no PFM file"),
    ],
)
def test_damaged_pfm_is_refused_with_its_name(tmp_path, content, message):
    path = write(tmp_path / "broken.pfm", content)
    with pytest.raises(ValueError, match=message) as error:
        read_pfm(path)
    assert str(path) in str(error.value)


def test_missing_pfm_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pfm"):
        read_pfm(tmp_path / "nowhere.pfm")


@pytest.mark.parametrize(
    ("values", "byte_order", "error"),
    [
        (np.zeros((2, 2)), "little", TypeError),
        (np.zeros((2, 2), np.float32), "native", ValueError),
        (np.zeros((0, 2), np.float32), "little", ValueError),
        (np.zeros(4, np.float32), "little", ValueError),
        (np.zeros((2, 2, 2), np.float32), "little", ValueError),
    ],
)
def test_write_pfm_refuses_what_the_format_cannot_hold(tmp_path, values, byte_order, error):
    with pytest.raises(error):
        write_pfm(tmp_path / "a.pfm", values, byte_order=byte_order)
    assert not (tmp_path / "a.pfm").exists()


# images


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (png(2, 1, 8, GREY, b"\0\x07\xff"), [[[7, 255]]]),
        (png(8, 1, 1, GREY, b"\0\xa0"), [[[255, 0, 255, 0, 0, 0, 0, 0]]]),
        (png(1, 2, 8, RGB, b"\0\x01\x02\x03\0\x04\x05\x06"), [[[1], [4]], [[2], [5]], [[3], [6]]]),
        (png(2, 1, 8, RGBA, b"\0\x01\x02\x03\x00\x04\x05\x06\xff"), [[[1, 4]], [[2, 5]], [[3, 6]]]),
        (png(2, 1, 8, PALETTE, b"\0\x01\x00", bytes([10, 20, 30, 40, 50, 60])), [[[40, 10]], [[50, 20]], [[60, 30]]]),
        (png(1, 1, 8, GREY_ALPHA, b"\0\x07\x80"), [[[7]], [[7]], [[7]]]),
        (png(3, 1, 16, GREY, b"\0" + struct.pack(">3H", 65535, 257 * 10 + 128, 257 * 10 + 129)), [[[255, 10, 11]]]),
        (png(1, 1, 16, RGB, b"\0" + struct.pack(">3H", 257, 514, 65 * 257)), [[[1]], [[2]], [[65]]]),
        (b"P6 1 1 255 \x01\x02\x03", [[[1]], [[2]], [[3]]]),
        (b"P5 2 1 255 \x01\x02", [[[1, 2]]]),
    ],
    ids=["grey", "1-bit", "rgb", "rgba", "palette", "grey-alpha", "grey16", "rgb16", "ppm", "pgm"],
)
def test_image_is_channels_first_uint8_in_rgb_order(tmp_path, content, expected):
    image = read_image(write(tmp_path / "im0.png", content))
    assert image.dtype.is_floating_point is False
    assert image.element_size() == 1
    assert image.is_contiguous()
    assert image.tolist() == expected


def test_exif_rotation_is_not_applied(tmp_path):
    pixels = np.zeros((2, 4), np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    tiff = (
        b"MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0) + bytes(4)
    )  # orientation 6: rotated by 90
    exif = b"\xff\xe1" + struct.pack(">H", 2 + 6 + len(tiff)) + b"Exif\0\0" + tiff
    path = write(tmp_path / "im0.jpg", jpeg[:2] + exif + jpeg[2:])
    assert cv2.imread(str(path)).shape[:2] == (4, 2)  # the tag is there
    assert read_image(path).shape == (1, 2, 4)


WHOLE = png(40, 30, 8, RGB, b"".join(b"\0" + np.random.default_rng(y).bytes(120) for y in range(30)))
DAMAGED = {
    "empty": b"",
    "text": b"this is no image",
    "truncated": WHOLE[: len(WHOLE) // 2],
    "end cut off": WHOLE[:-6],
    "bit flipped": WHOLE[:2000] + bytes([WHOLE[2000] ^ 255]) + WHOLE[2001:],
    "short ppm": b"P6 4 4 255 \x01\x02\x03",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED.keys())
@pytest.mark.parametrize("read", [read_image, lambda path: read_disparity_png(path, 4), read_occlusion_mask])
def test_damaged_image_is_refused_with_its_name(tmp_path, read, content, capfd):
    path = write(tmp_path / "im0.png", content)
    with pytest.raises(ValueError, match=r"empty|cannot be decoded") as error:
        read(path)
    assert str(path) in str(error.value)
    if content.startswith(b"\x89PNG"):  # libpng would add a line of its own
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "read", [read_image, lambda path: read_disparity_png(path, 4), read_occlusion_mask, image_size]
)
def test_missing_image_is_named(tmp_path, read):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.png"):
        read(tmp_path / "nowhere.png")


def test_float_image_is_refused(tmp_path):
    write_pfm(tmp_path / "im0.pfm", np.ones((2, 2), np.float32))
    with pytest.raises(ValueError, match="8 or 16 bits"):
        read_image(tmp_path / "im0.pfm")


@pytest.mark.parametrize("name", ["a.png", "a.ppm", "a.pgm", "ü.png"])
@pytest.mark.parametrize("shape", [(3, 7), (480, 300)])
def test_image_size_is_that_of_the_decoded_image(tmp_path, name, shape):
    pixels = np.zeros(shape if name.endswith("pgm") else (*shape, 3), np.uint8)
    path = write(tmp_path / name, cv2.imencode(Path(name).suffix, pixels)[1].tobytes())
    assert image_size(path) == shape[::-1] == tuple(read_image(path).shape[:0:-1])


def test_image_size_skips_netpbm_comments(tmp_path):
    content = b"P5\n# written by a scanner\n# 9 9\n5 2 # width, height\n255\n" + bytes(10)
    assert image_size(write(tmp_path / "a.pgm", content)) == (5, 2)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff\xe0JFIF", b"\x89PNG\r\n\x1a\n", b"P6\n12"])
def test_image_size_refuses_other_headers(tmp_path, content):
    path = write(tmp_path / "view1.png", content)
    with pytest.raises(ValueError, match=r"view1\.png"):
        image_size(path)


# integer disparity maps and masks


def test_8_bit_disparity_is_value_over_scale_and_nan_at_zero(tmp_path):
    disparity = read_disparity_png(write(tmp_path / "disp1.png", png(3, 1, 8, GREY, b"\0\x00\x01\xff")), 3)
    assert disparity.dtype == np.float32
    np.testing.assert_array_equal(disparity, np.array([[np.nan, 1 / 3, 85]], np.float32))


def test_16_bit_disparity_keeps_all_its_bits(tmp_path):
    rows = b"\0" + struct.pack(">3H", 0, 1, 65535)
    disparity = read_disparity_png(write(tmp_path / "000046_10.png", png(3, 1, 16, GREY, rows)), 256)
    np.testing.assert_array_equal(disparity, np.array([[np.nan, 1 / 256, 65535 / 256]], np.float32))


def test_disparity_with_three_equal_channels_is_grey(tmp_path):
    path = write(tmp_path / "disp2.png", png(2, 1, 8, RGB, b"\0" + bytes([8, 8, 8, 16, 16, 16])))
    assert read_disparity_png(path, 8).tolist() == [[1.0, 2.0]]


def test_coloured_disparity_is_refused(tmp_path):
    path = write(tmp_path / "disp2.png", png(2, 1, 8, RGB, b"\0" + bytes([8, 8, 8, 16, 0, 16])))
    with pytest.raises(ValueError, match=r"disp2\.png must be grey"):
        read_disparity_png(path, 8)


def test_kitti_map_reduced_to_8_bits_is_refused(tmp_path):
    path = write(tmp_path / "disp.png", png(2, 1, 8, GREY, b"\0\x08\x09"))
    with pytest.raises(ValueError, match="more than 8 bits"):
        read_disparity_png(path, 256)


@pytest.mark.parametrize("scale", [0, -3, float("nan"), float("inf")])
def test_scale_must_be_positive(tmp_path, scale):
    path = write(tmp_path / "disp.png", png(2, 1, 8, GREY, b"\0\x08\x09"))
    with pytest.raises(ValueError, match="--gt-scale"):
        read_disparity_png(path, scale)


def test_float_map_is_no_integer_disparity(tmp_path):
    write_pfm(tmp_path / "disp.pfm", np.ones((2, 2), np.float32))
    with pytest.raises(ValueError, match="8-bit or 16-bit"):
        read_disparity_png(tmp_path / "disp.pfm", 1)


def test_mask_tells_occluded_from_visible_and_unknown(tmp_path):
    path = write(tmp_path / "mask0nocc.png", png(3, 1, 8, GREY, b"\0\x00\x80\xff"))
    assert read_occlusion_mask(path).tolist() == [[False, True, False]]


def test_mask_with_other_values_is_refused(tmp_path):
    path = write(tmp_path / "mask0nocc.png", png(3, 1, 8, GREY, b"\0\x00\x7f\xff"))
    with pytest.raises(ValueError, match=r"mask0nocc\.png must hold only 0, 128 and 255, found \[127\]"):
        read_occlusion_mask(path)


# calibration

CALIB = """cam0=[ 992.854 0 263.061 ; 0 992.854 239.773 ; 0 0 1 ]
cam1=[ 992.854 0 299.693 ; 0 992.854 239.773 ; 0 0 1 ]
doffs= 36.633
 baseline= 195.187\x20
width= 722\x20
height= 480
ndisp= 190
 isint= 0\x20
vmin= 8\x20
vmax= 181
"""


def test_calibration_ignores_blanks(tmp_path):
    path = write(tmp_path / "calib.txt", CALIB.encode())
    expected = Calibration(
        992.854, 263.061, 299.693, 239.773, 36.633, 195.187, 722, 480, ndisp=190, vmin_px=8, vmax_px=181
    )
    assert read_calibration(path) == expected
    path.write_bytes(CALIB.replace("= ", "=").replace("[ ", "[").replace(" ;", ";").replace("\n", "\r\n").encode())
    assert read_calibration(path) == expected


def test_optional_calibration_is_none(tmp_path):
    text = "".join(line + "\n" for line in CALIB.splitlines() if not line.startswith(("ndisp", "vm")))
    calibration = read_calibration(write(tmp_path / "calib.txt", text.encode()))
    assert (calibration.ndisp, calibration.vmin_px, calibration.vmax_px) == (None, None, None)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("doffs", "offs", "'doffs=...'"),
        ("cam1", "cam2", "'cam1=...'"),
        ("195.187", "wide", "baseline must be a number, got 'wide'"),
        ("722", "722.5", "width must be a positive integer"),
        ("480", "0", "height must be a positive integer"),
        ("= 190", "= inf", "ndisp must be a number"),
        ("263.061 ;", "263.061", "cam0 must be a matrix"),
        ("263.061 ; 0 992.854", "263.061 ; 0 500.1", "cam0 must be a matrix"),
        ("299.693 ; 0 992.854 239.773", "299.693 ; 0 992.854 240", "must share focal length and cy"),
    ],
)
def test_wrong_calibration_names_file_and_value(tmp_path, old, new, message):
    assert old in CALIB
    path = write(tmp_path / "calib.txt", CALIB.replace(old, new, 1).encode())
    with pytest.raises(ValueError, match=message) as error:
        read_calibration(path)
    assert str(path) in str(error.value)


def test_binary_calibration_is_refused(tmp_path):
    with pytest.raises(ValueError, match="not text"):
        read_calibration(write(tmp_path / "calib.txt", b"\xff\xfe\x00"))


def test_calibration_of_middeval3(data_root):
    for scene, size in (("Vintage", (722, 480)), ("Recycle", (720, 486))):
        folder = data_root / "middlebury" / "MiddEval3" / "trainingQ" / scene
        calibration = read_calibration(folder / "calib.txt")
        assert (calibration.width, calibration.height) == size == image_size(folder / "im0.png")
        assert calibration.doffs_px == pytest.approx(calibration.cx1 - calibration.cx0, abs=2e-3)  # printed to 1e-3
        disparity = read_pfm(folder / "disp0GT.pfm")
        assert disparity[np.isfinite(disparity)].max() <= calibration.ndisp
