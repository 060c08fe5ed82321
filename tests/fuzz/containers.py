"""Changes below checksums: NumPy archives, PNG and JPEG files whose outer form stays right."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np

from tests.fuzz.mutations import BYTES, FLOATS, NUMBERS, mutate_bytes

_SHAPES: tuple[Any, ...] = (
    (), (0,), (0, 2), (40,), (39,), (41,), (40, 2), (40, 3), (2, 40), (40, 2, 1), (1,), (-1, 2), (1 << 63, 2),
    (1 << 40, 2), (1 << 26, 2), (0, 1 << 62), (1 << 40, 0), (40.0, 2), (True, 2), ("40", 2), [40, 2], None, 40,
    (1 << 70, 2),
)  # fmt: skip
_DTYPES: tuple[Any, ...] = (
    "<f8", ">f8", "<f4", "<f2", "<f16", "<i8", ">i4", "<u8", "|u1", "|b1", "<c16", "|O", "<U3", "|S5", "|V8", "<M8[ns]",
    "<M8[7D]", "<m8[s]", "|S0", "<U0", "|V0", "<f9", "", "nonsense", 8, None, [("x", "<f8"), ("y", "<f8")], "<f8,<f8",
    [("x", "|O")], "(2,)<f8", ("<f8", (2,)), [("", "<f8")], [("x", "<f8"), ("x", "<f8")], "|T",
)  # fmt: skip
_NAMES = (
    "ptr", "cost", "group", "matches0", "matches1", "matches", "match_confidence", "matching_scores0", "keypoints0",
    "keypoints1", "inlier", "score", "relation", "a/b", "../x", "ü", "", "x" * 300, "scores", "image_size0",
    "descriptors0",
)  # fmt: skip


def mutate_npz(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Write an archive again with other members."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(members))
        name, member = members[at]
        what = rng.randrange(9)
        if what <= 1:
            members[at] = name, _with_header(member, rng)
        elif what <= 3:
            members[at] = name, _odd_array(rng)
        elif what == 4:
            members[at] = name, mutate_bytes(member, [other for _, other in members], rng)
        elif what == 5:
            members[at] = f"{rng.choice(_NAMES)}{rng.choice(('.npy', '.npy', '.npy', ''))}", member
        elif what == 6 and len(members) > 1:
            del members[at]
        elif what == 7:
            new = rng.choice((member, _odd_array(rng), rng.randbytes(20)))
            members.append((f"{rng.choice(_NAMES)}.npy", new))
        else:
            members[at] = name, _with_values(member, rng)
    buffer = io.BytesIO()
    kinds = [zipfile.ZIP_STORED] * 4 + [zipfile.ZIP_DEFLATED] * 3 + [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", rng.choice(kinds)) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, member in members:
            info = zipfile.ZipInfo(name, rng.choice(((1980, 1, 1, 0, 0, 0), (2107, 12, 31, 23, 59, 58))))
            info.comment, info.extra = rng.choice((b"", b"", b"c" * 70)), rng.choice((b"", b"", b"\x01\x00\x02\x00ab"))
            info.external_attr = rng.choice((0o644 << 16, 0o40755 << 16, 0o120777 << 16, 0x10))
            archive.writestr(info, member, rng.choice(kinds) if rng.random() < 0.1 else archive.compression)
        archive.comment = rng.choice((b"", b"", b"PK\x05\x06" + bytes(18)))
    made = buffer.getvalue()
    return mutate_bytes(made, others, rng, 1) if rng.random() < 0.15 else made


def npy(header: str, body: bytes, rng: Random) -> bytes:
    """An array file with any text as its header."""
    text = header.encode()
    version = rng.choice((1, 1, 1, 2, 3, 0, 9))
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    length = len(text) if rng.random() < 0.9 else rng.choice(NUMBERS)
    size = 2 if version == 1 else 4
    return b"\x93NUMPY" + bytes([version, 0]) + (length % (1 << 8 * size)).to_bytes(size, "little") + text + body


def _with_header(member: bytes, rng: Random) -> bytes:
    """The same data below another header."""
    fields: dict[Any, Any] = {"descr": "<f8", "fortran_order": False, "shape": (40, 2)}
    if rng.random() < 0.9:
        fields["shape"] = rng.choice(_SHAPES)
    if rng.random() < 0.5:
        fields["descr"] = rng.choice(_DTYPES)
    fields["fortran_order"] = rng.choice((False, False, True, 1, None))
    if rng.random() < 0.15:
        fields.pop(rng.choice(list(fields)))
    if rng.random() < 0.1:
        fields["more"] = 1
    text = repr(fields)
    if rng.random() < 0.15:
        text = rng.choice((
            "(" * 150, "(" * 5000, "-" * 4000 + "1", "{" + "'a':" * 2000, "[" * 90 + "]" * 90, "\x00",
            "1+" * 3000 + "1",
            text + "+{}", "{**{}}", "__import__('os')", "'\\ud800'", text.replace("40", "9" * 4400), "{'descr': 10L}",
            text.replace("40", "0b1"), text.replace("(", "(1j,"), "~" * 3000 + "1", text.replace("'shape'", "[1]"),
        ))  # fmt: skip
    body = member[128:] if rng.random() < 0.7 else bytes(rng.choice((0, 8, 320, 640, 1000)))
    return npy(text, body, rng)


def _odd_array(rng: Random) -> bytes:
    """An array that NumPy itself could have written."""
    shape = rng.choice(((40, 2), (40, 2), (40,), (40,), (0, 2), (0,), (4,), (), (40, 3), (1, 2), (80, 2), (1 << 14, 2)))
    kind = rng.choice(
        ("f8", ">f8", "f4", "f2", "i8", ">i8", "u8", "i1", "u4", "?", "c8", "U2", "S3", "O", "M8[s]", "c16")
    )
    if kind == "O":
        values: Any = np.full(shape, None, dtype=object)
    elif rng.random() < 0.5:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            values = np.full(shape, rng.choice((0, 1, -1, -3, 40, 1e30, -1e30, float("nan"), float("inf"), 127)))
            values = values.astype(kind)
    else:
        values = np.frombuffer(rng.randbytes(64), np.uint8).astype(np.float64)
        values = np.resize(values, shape).astype(kind) if kind not in "M8[s]" else np.zeros(shape, kind)
    buffer = io.BytesIO()
    np.save(buffer, np.asfortranarray(values) if rng.random() < 0.3 else values, allow_pickle=True)
    return buffer.getvalue()


def _with_values(member: bytes, rng: Random) -> bytes:
    """The same array with some extreme values."""
    try:
        values = np.load(io.BytesIO(member), allow_pickle=False).copy()
    except Exception:  # of a member that was changed before
        return member
    if values.size and values.dtype.kind in "fiu":
        flat = values.reshape(-1)
        for _ in range(rng.choice((1, 1, 3, 30))):
            extreme = rng.choice(FLOATS if values.dtype.kind == "f" else NUMBERS)
            if values.dtype.kind != "f":
                low, high = int(np.iinfo(values.dtype).min), int(np.iinfo(values.dtype).max)
                extreme = min(max(extreme, low), high)
            with np.errstate(all="ignore"):
                flat[rng.randrange(len(flat))] = extreme
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    return buffer.getvalue()


def mutate_png(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change chunks, with the right checksums."""
    chunks, start = [], 8
    while start + 8 <= len(data):
        length = int.from_bytes(data[start : start + 4])
        chunks.append((data[start + 4 : start + 8], data[start + 8 : start + 8 + length]))
        start += 12 + length
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(chunks))
        kind, body = chunks[at]
        what = rng.randrange(9)
        if what <= 2:
            chunks[0] = b"IHDR", _ihdr(chunks[0][1], rng)
        elif what == 3:
            chunks[at] = kind, mutate_bytes(body, [other for _, other in chunks], rng)
        elif what == 4:
            parts = [k for k, (name, _) in enumerate(chunks) if name == b"IDAT"]
            if parts:
                at = rng.choice(parts)
                chunks[at] = b"IDAT", _packed(chunks[at][1], rng)
        elif what == 5:
            chunks.insert(rng.randrange(len(chunks) + 1), _chunk(rng))
        elif what == 6 and len(chunks) > 2:
            del chunks[at]
        elif what == 7:
            chunks.insert(rng.randrange(len(chunks) + 1), chunks[at])
        else:
            chunks[at] = rng.choice((b"IDAT", b"fdAT", b"IEND", b"PLTE", b"abcd", b"ABCD", b"\0\0\0\0")), body
    made = data[:8]
    for kind, body in chunks:
        made += len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4)
    return made


def _ihdr(body: bytes, rng: Random) -> bytes:
    fields = list(struct.unpack(">IIBBBBB", body[:13])) if len(body) >= 13 else [96, 72, 8, 0, 0, 0, 0]
    k = rng.randrange(7)
    sizes = (0, 1, 2, 71, 73, 95, 97, 4096, 30000, 65535, 1 << 20, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)
    fields[k] = rng.choice(sizes) if k < 2 else rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 32, 255))
    if rng.random() < 0.3:  # a large image of little data
        fields[:2] = rng.choice((20000, 32767, 1 << 15)), rng.choice((20000, 32767, 1 << 15))
    return struct.pack(">IIBBBBB", *fields)


def _packed(body: bytes, rng: Random) -> bytes:
    """Other image data, deflated anew."""
    try:
        raw = zlib.decompress(body)
    except zlib.error:
        return body
    raw = rng.choice((mutate_bytes(raw, [], rng), raw[: len(raw) // 2], raw * 3, bytes([5]) + raw[1:], b""))
    return zlib.compress(raw, rng.choice((0, 1, 9)))


def _chunk(rng: Random) -> tuple[bytes, bytes]:
    """A further chunk, of those that decoders look into."""
    packed = zlib.compress(bytes(rng.choice((10, 1 << 20))))
    number = struct.pack(">I", rng.choice(NUMBERS) % (1 << 32))
    frame = struct.pack(">IIIIIHHBB", rng.choice((0, 1, 9)), rng.choice((96, 1, 1 << 31)), rng.choice((72, 0, 1 << 30)),
                        rng.choice((0, 9, 1 << 31)), rng.choice((0, 9)), 1, 0, rng.choice((0, 2, 9)), rng.choice((0,
                        1, 9)))  # fmt: skip
    return rng.choice((
        (b"tRNS", rng.randbytes(rng.choice((1, 2, 6, 256, 300)))), (b"PLTE", rng.randbytes(rng.choice((0, 3, 4, 768,
        771)))),
        (b"gAMA", number), (b"sRGB", b"\x09"), (b"iCCP", b"name\0\0" + packed), (b"iCCP", rng.randbytes(40)),
        (b"zTXt", b"key\0\0" + packed), (b"iTXt", b"key\0\1\0\0\0" + packed), (b"tEXt", b"k" * 100 + b"\0v"),
        (b"eXIf", b"MM\0*" + number + rng.randbytes(30)), (b"acTL", number + number), (b"fcTL", frame),
        (b"fdAT", number + packed), (b"sBIT", rng.randbytes(5)), (b"bKGD", rng.randbytes(7)), (b"hIST",
        rng.randbytes(3)),
        (b"pHYs", number * 2 + b"\5"), (b"cHRM", number * 8), (b"tIME", rng.randbytes(7)), (b"IDAT", packed),
        (b"IEND", b""),
        (b"cICP", rng.randbytes(4)), (b"mDCV", rng.randbytes(24)),
    ))  # fmt: skip


def mutate_jpg(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change one segment of a JPEG file, or put one in."""
    segments, start = [], 2
    while start + 4 <= len(data) and data[start] == 0xFF and data[start + 1] != 0xDA:
        length = int.from_bytes(data[start + 2 : start + 4])
        segments.append((data[start + 1], data[start + 4 : start + 2 + length]))
        start += 2 + length
    rest = data[start:]
    for _ in range(rng.choice((1, 1, 2))):
        at = rng.randrange(len(segments))
        kind, body = segments[at]
        frames = [k for k, (marker, _) in enumerate(segments) if 0xC0 <= marker <= 0xC2]
        what = rng.randrange(6)
        if what <= 1 and frames:
            marker, frame = segments[frames[0]]
            size = rng.choice((b"\0\0", b"\0\1", b"\xff\xff", b"\x7f\xff", b"\0\x47", b"\0\x60", b"\x4e\x20"))
            other = rng.choice((frame[3:5], b"\xff\xff", b"\x4e\x20"))
            body = rng.choice(
                (frame[:1] + size + other, frame[:1] + other + size, bytes([rng.choice(BYTES)]) + frame[1:5])
            )
            tail = frame[5:] if rng.random() < 0.7 else mutate_bytes(frame[5:], [], rng, 1)
            segments[frames[0]] = rng.choice((marker, marker, 0xC0, 0xC1, 0xC2, 0xC3, 0xC9, 0xCB)), body + tail
        elif what == 2:
            segments[at] = kind, mutate_bytes(body, others, rng, 1)[:60000]
        elif what == 3:
            del segments[at]
            segments = segments or [(kind, body)]
        elif what == 4:
            exif = b"Exif\0\0II*\0\x08\0\0\0" + rng.randbytes(2) + b"\x12\1\3\0" + rng.randbytes(20)
            new = rng.choice(((0xE1, exif), (0xEE, b"Adobe\0\x64\0\0\0\0" + rng.randbytes(1)), (0xDD, rng.randbytes(2)),
                              (0xFE, b"c" * 60000), (0xE2, b"ICC_PROFILE\0" + rng.randbytes(50)), (0xDC,
                              b"\xff\xff")))  # fmt: skip
            segments.insert(rng.randrange(len(segments) + 1), new)
        else:
            rest = mutate_bytes(rest, others, rng, 1)
    made = b"".join(bytes([0xFF, kind]) + (len(body) + 2).to_bytes(2) + body for kind, body in segments)
    return data[:2] + made + rest
