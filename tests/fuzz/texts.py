"""Changes of the words of text files: CSV tables, TOML settings, headers of PFM and PGM files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from random import Random

from tests.fuzz.mutations import TEXTS, mutate_bytes

_COLUMNS = (
    "x0", "y0", "x1", "y1", "pair", "cost", "group", "inlier", "score", "relation", "probability", "inlier_score",
    "inlier_adjacency", "inlier_cardinality", "X0", " x0", '"x0"', "", "note", "ü", "a" * 2000, "x0\n", "\ufeffx0",
    "*", "^x.*$",
)  # fmt: skip
_CELLS = (
    *TEXTS,
    '"',
    '""',
    '"a""b"',
    "'",
    "a,b",
    '"a,b"',
    "a\nb",
    '"a\nb"',
    "1;2",
    "\t",
    "=1+1",
    "\ufeff",
    "é",
    "1" * 20000,
)


def mutate_csv(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change cells, columns, quotes and line ends."""
    rows = [line.split(",") for line in data.decode().splitlines()]
    comma, end, code = ",", "\n", "utf-8"
    for _ in range(rng.choice((1, 1, 2, 4))):
        row = rng.randrange(len(rows))
        at = rng.randrange(len(rows[row])) if rows[row] else 0
        what = rng.randrange(13)
        if what <= 3 and rows[row]:
            rows[row][at] = rng.choice(_CELLS)
        elif what <= 5 and rows[0]:
            rows[0][rng.randrange(len(rows[0]))] = rng.choice(_COLUMNS)
        elif what == 6:
            del rows[row][at:]
        elif what == 7:
            name = rng.choice(_COLUMNS)
            rows = [[*cells, rng.choice(_CELLS) if k else name] for k, cells in enumerate(rows)]
        elif what == 8:
            rows.insert(row, rng.choice(([], [""], [" "], rows[row] * 2, ["#"], rows[0], rows[row][:-1])))
        elif what == 9:
            comma, end = rng.choice(((",", "\r\n"), (",", "\r"), (";", "\n"), ("\t", "\n"), (", ", "\n"), (",", "\n\r"),
                                     (",", "\n\n"), (",,", "\n"), (" ,", "\n"), (",", "\r\r\n")))  # fmt: skip
        elif what == 10:
            rows = rng.choice((rows[:1], rows[:2], rows[1:], [*rows[:1], *rows[1:] * 50], rows * 2, rows[::-1]))
        elif what == 11:
            rows = [[f'"{cell}"' if rng.random() < 0.3 else cell for cell in cells] for cells in rows]
        else:
            code = rng.choice(("utf-8-sig", "utf-16", "utf-32", "utf-7", "cp037"))
        rows = rows or [[]]
    made = end.join(comma.join(cells) for cells in rows) + rng.choice((end, "", end * 3, "\x1a", "\0"))
    encoded = made.encode(code, "replace")
    return mutate_bytes(encoded, others, rng, 1) if rng.random() < 0.15 else encoded


_TOKEN = re.compile(r"\"[^\"\n]*\"|[\w.]+|[^\w\s]|\s+")
_VALUES = (
    "0", "-1", "1", "2", "3", "7", "15", "1000", "65537", "2147483647", "2147483649", "4294967295",
    "9223372036854775808",
    "0.0", "-0.0", "0.5", "1.0", "1e-300", "1e300", "1e999", "nan", "inf", "-inf", "true", "false", '"none"', '""',
    '"fast"',
    '"gftt"', '"sift"', '"surf"', '"score"', '"adjacency"', '"cardinality"', '"consensus"', '"learned"', '"topology"',
    '"none\\n"', '"\\u0000"', "1979-05-27T07:32:00Z", "07:32:00", "[]", "[[]]", "[1, 2]", '["none", 0.5]', "{}",
    "{ a = 1 }",
    "'''a\nb'''", '"""', "0x7fffffff", "0b1", "1_000", "+1", "9" * 5000, "1." + "0" * 500, "[true, 1]",
    '"' + "x" * 5000 + '"', '"sgbm"', '"3way"',
    '"opencv"', '"kornia"', '"edge"', '"px"', '"native"', '"reference"', '"ünï"', "'none'", "_", "=",
)  # fmt: skip
_SETTINGS = (
    "detector", "verdict", "score", "threshold", "target_sensitivity", "min_precision", "min_group_size",
    "tie_tolerance",
    "temperature", "temperature_unit", "backend", "constrained", "outlier_rate", "noise_px", "seed", "max_error_px",
    "restriction", "sift.backend", "sift.max_keypoints", "sift.upright", "sift.max_ratio", "fast.threshold",
    "fast.nonmax_suppression", "fast.max_keypoints", "fast.window_px", "surf.num_octaves", "surf.num_scales",
    "surf.initial_step_px", "surf.threshold", "surf.max_keypoints", "gftt.backend", "gftt.quality_level",
    "gftt.min_distance_px", "gftt.max_keypoints", "gftt.window_px", "matching.max_ratio", "matching.mutual",
    "matching.max_row_offset_px", "matching.min_disparity_px", "matching.max_disparity_px", "objects.element_px",
    "matching.method", "sgbm.window_px", "sgbm.step_penalty_levels", "sgbm.jump_penalty_levels",
    "sgbm.min_disparity_px", "sgbm.num_disparities_px", "sgbm.mode", "sgbm.left_right",
    "objects.min_area_px", "consensus.tolerance_px", "consensus.whole_tolerance_px", "consensus.row_tolerance_px",
    "consensus.whole_row_tolerance_px", "consensus.slope", "consensus.reach", "consensus.doubt",
    "consensus.cost_weight",
    "consensus.num_rounds", "consensus", "fast", "grid", "export_matches", '"fast.window_px"', "fast.fast", "a",
    "sift.",
    "__class__", "fields", "name", '""', "ü",
)  # fmt: skip
_DETECTORS = ("sift", "fast", "surf", "gftt")


def mutate_toml(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change tokens, or name further settings with values that may be extreme but allowed."""
    if rng.random() < 0.35:
        return _settings(rng).encode()
    text = data.decode()
    for _ in range(rng.choice((1, 1, 2, 3))):
        lines, tokens = text.splitlines(keepends=True), _TOKEN.findall(text)
        at = rng.randrange(len(tokens) or 1)
        what = rng.randrange(11)
        if what <= 3 and tokens:
            words = [k for k, token in enumerate(tokens) if token[0].isalnum() or token[0] == '"']
            at = rng.choice(words) if words else at
            is_value = "".join(tokens[:at]).rstrip(" [,").endswith("=") or rng.random() < 0.3
            tokens[at] = rng.choice(_VALUES if is_value else _SETTINGS)
            text = "".join(tokens)
        elif what == 4 and tokens:
            del tokens[at]
            text = "".join(tokens)
        elif what == 5:
            tokens.insert(at, rng.choice((*'[]{}="#,.\n', "[[", "]]", "'''", "\x00", "\r", "\ufeff", "\u2028")))
            text = "".join(tokens)
        elif what == 6 and lines:
            text += rng.choice(lines)
        elif what == 7 and lines:
            del lines[rng.randrange(len(lines))]
            text = "".join(lines)
        elif what == 8:
            text += f"{rng.choice(_SETTINGS)} = {rng.choice(_VALUES)}\n"
        elif what == 9:
            text = text.replace(
                "[grid]", rng.choice(("[grid.fast]", "[[grid]]", "[grid.a.b]", "[grid", "[GRID]", "[[grid.x]]", ""))
            )
        else:
            deep = rng.choice((50, 500, 5000))
            text += rng.choice((
                f"a = {'[' * deep}{']' * deep}\n", f"seed = {'[' * deep}\n", f"a = {'{a=' * deep}1{'}' * deep}\n",
                f"[{'.'.join('a' * deep)}]\n", f"{'.'.join('a' * deep)} = 1\n", f"[grid.{'.'.join(['fast'] * deep)}]\n",
                f"[grid]\nseed = {list(range(deep))}\noutlier_rate = 0.5\n" if deep < 500 else "# deep\n",
            ))  # fmt: skip
    encoded = text.encode("utf-8", "replace")
    return mutate_bytes(encoded, others, rng, 1) if rng.random() < 0.15 else encoded


def _settings(rng: Random) -> str:
    """A grid of settings that are mostly in their limits, and few enough to be run."""
    detector = rng.choice(_DETECTORS)
    lines = [f'detector = "{detector}"']
    own = [name for name in _SETTINGS if name.startswith(f"{detector}.") or name.split(".")[0] not in _DETECTORS]
    for name in dict.fromkeys(rng.choices(own, k=rng.choice((1, 1, 2, 3, 4)))):
        if name not in ("detector", "grid", "export_matches"):
            values = rng.choices(_VALUES[:31], k=rng.choice((1, 1, 1, 2)))
            lines.append(f"{name} = {values[0] if len(values) == 1 else '[' + ', '.join(values) + ']'}")
    if rng.random() < 0.7 and not any(line.startswith("verdict") for line in lines):
        lines.append('verdict = "cardinality"')
    if rng.random() < 0.02:  # a product that nobody can run
        lines += [f"{name} = [{', '.join(f'0.{k + 1:02}' for k in range(60))}]" for name in _RATES]
    return "[grid]\n" + "\n".join(lines) + "\n"


_RATES = ("outlier_rate", "noise_px", "max_error_px", "temperature", "consensus.slope", "consensus.reach")


def mutate_header(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change the words of the header of a PFM, PGM or PPM file, and maybe its data."""
    lines = data.split(b"\n", 4)
    head, rest = b"\n".join(lines[:-1]), lines[-1]
    words = re.split(rb"(\s+)", head[:200])
    for _ in range(rng.choice((1, 1, 2))):
        at = rng.randrange(len(words))
        what = rng.randrange(6)
        if what <= 2:
            sizes = (
                "20000",
                "32767",
                "65536",
                "1048576",
                "99999",
                "999999999",
                "72",
                "96",
                "73",
                "6912",
                "-1.0",
                "1e-40",
                "-1e400",
            )
            words[at] = rng.choice(rng.choice((TEXTS, sizes))).encode()
        elif what == 3:
            words[at] = rng.choice((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"P7", b"P8", b"Pf", b"PF", b"PF4",
            b"pf", b"\n",
                                    b"\r\n", b" ", b"#", b"# " + b"c" * 3000 + b"\n", b"\t", b"\v", b"\0",
                                    b"\n\n\n"))  # fmt: skip
        elif what == 4:
            words.insert(at, rng.choice((b" ", b"\n", b"# c\n", b"#", b"0 ", b"00000000000000000096 ")))
        else:
            rest = mutate_bytes(rest, others, rng, 1)
    return b"".join(words) + head[200:] + b"\n" + rest
