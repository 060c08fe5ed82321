"""Whether the file of an image is whole, told before it is decoded: decoders fill in what is missing, or print.

Sources: PNG specification, 3rd edition, section 5.3; ITU-T T.81 (JPEG), annex B; RFC 9649 (WebP), section 2.4;
Microsoft's BITMAPFILEHEADER and BITMAPINFOHEADER.
"""

from __future__ import annotations

import re
import struct
import zlib

from tensor_stereo.datasets.tiff import STARTS, is_whole_tiff

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8\xff"
_SCAN, _END = 0xDA, 0xD9
_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])", re.DOTALL)  # in entropy-coded data 00 and RSTn are none


def damaged_format(content: bytes) -> str | None:
    """Name of the format if the file is truncated or damaged, None if nothing is known to be wrong with it.

    Args:
        content: The whole file.

    >>> damaged_format(JPEG_START), damaged_format(b"no image")
    ('JPEG', None)
    """
    if content.startswith(PNG_SIGNATURE):
        return None if _is_whole_png(content) else "PNG"
    if content.startswith(JPEG_START):
        return None if _is_whole_jpeg(content) else "JPEG"
    if content.startswith(STARTS):
        return None if is_whole_tiff(content) else "TIFF"
    if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        return None if int.from_bytes(content[4:8], "little") + 8 <= len(content) else "WebP"
    if content.startswith(b"BM"):
        return None if _is_whole_bmp(content) else "BMP"
    return None


def significant_bits(content: bytes) -> int | None:
    """Bits of a PNG's samples before they were scaled up to those that it stores, by its chunk sBIT.

    Returns:
        None if there is no such chunk, or it gives channels of colour different bits.
    """
    for kind, body in _png_chunks(content):
        if kind == b"sBIT":
            bits = set(body[: 3 if len(body) >= 3 else 1])  # the last of two or four is alpha's
            return bits.pop() if len(bits) == 1 else None
        if kind == b"IDAT":
            break
    return None


def _png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    """Kind and body of the chunks before the samples, and of the first with samples."""
    chunks, start = [], len(PNG_SIGNATURE)
    while start + 12 <= len(content):
        stop = start + 8 + int.from_bytes(content[start : start + 4])
        kind = content[start + 4 : start + 8]
        chunks.append((kind, content[start + 8 : stop] if kind != b"IDAT" else b""))
        if kind == b"IDAT":
            break
        start = stop + 4
    return chunks


def _is_whole_png(content: bytes) -> bool:
    """Whether all chunks are there and match their checksums."""
    start = len(PNG_SIGNATURE)
    while start + 12 <= len(content):
        length = int.from_bytes(content[start : start + 4])
        stop = start + 8 + length
        if zlib.crc32(memoryview(content)[start + 4 : stop]) != int.from_bytes(content[stop : stop + 4]):
            return False
        if content[start + 4 : start + 8] == b"IEND":
            return True
        start = stop + 4
    return False


def _is_whole_jpeg(content: bytes) -> bool:
    """Whether the markers lead through at least one scan to the end of the image; what follows it does not count."""
    place, has_scan = 2, False
    while True:
        marker = _MARKER.search(content, place)
        if marker is None:
            return False
        if marker[1][0] == _END:
            return has_scan
        if marker[1][0] == _SCAN and not has_scan:
            has_scan = True
            if content.rstrip(b"\0").endswith(bytes([0xFF, _END])):  # as almost all do: no need to look at each byte
                return True
        place = marker.end() + int.from_bytes(content[marker.end() : marker.end() + 2])  # over thumbnails and tables


def _is_whole_bmp(content: bytes) -> bool:
    """Whether the rows of an uncompressed bitmap are all there; other bitmaps are left to the decoder."""
    if len(content) < 34:
        return False
    (offset, header_size, width, height, _, bits, compression) = struct.unpack_from("<IIiiHHI", content, 10)
    if header_size < 40 or compression != 0:
        return True
    num_bytes: int = offset + (abs(width) * bits + 31) // 32 * 4 * abs(height)
    return num_bytes <= len(content)
