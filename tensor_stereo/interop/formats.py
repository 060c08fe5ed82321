"""Endings and first bytes of files of matches. Imports no torch."""

from __future__ import annotations

from pathlib import Path

from tensor_stereo.interop.result_names import check_score_name
from tensor_stereo.paths import check_apart, check_ending, check_source, ending_of, has_ending, prepare_target

# Ending -> first bytes of such a file, and what it is called.
FORMATS = {
    ".npz": (b"PK", "NumPy archive"),
    ".csv": (b"", "CSV file"),
    ".parquet": (b"PAR1", "Parquet file"),
    ".h5": (b"\x89HDF\r\n\x1a\n", "HDF5 file"),
    ".db": (b"SQLite format 3\0", "SQLite database"),
}


KEYPOINTS_ENDING = ".keypoints.h5"


def keypoints_beside(out: Path) -> Path:
    """The file of keypoints beside a result whose matches have keypoints of their own.

    >>> keypoints_beside(Path("filtered.h5")).name
    'filtered.keypoints.h5'
    """
    return out.with_name(out.stem + KEYPOINTS_ENDING)


def check_files(source: Path, out: Path, keypoints: Path | None, score_name: str | None = None) -> str:
    """Look at the files of :func:`tensor_stereo.filter_file` before any work, and make the folder of ``out``.

    Returns:
        The ending of ``source`` in lower case.

    Raises:
        ValueError: for an unknown ending, another ending of ``out``, one file given for two, or contents that do not
            fit the ending.
        FileNotFoundError: if a file is missing.
        OSError: if ``out`` cannot be written.
    """
    ending = ending_of(source)
    check_ending("source", source, tuple(FORMATS))
    check_score_name(score_name)
    if score_name is not None and ending in (".h5", ".db"):
        raise ValueError(f"score_name must be None for {ending}, whose results have names of their own")
    if not has_ending(out, ending):
        raise ValueError(f"out must end in {ending} as source does, got {out.name!r}")
    if keypoints is not None and ending != ".h5":
        raise ValueError(f"keypoints must be None but for .h5, got {keypoints} for {source.name!r}")
    for name, path, kind in (("source", source, ending), ("keypoints", keypoints, ".h5")):
        if path is None:
            continue
        check_source(name, path)
        check_apart("out", out, {name: path})
        first, called = FORMATS[kind]
        with path.open("rb") as file:
            if file.read(len(first)) != first:
                raise ValueError(f"{path} is no {called}, whatever its ending says")
    if ending == ".h5" and keypoints is None:
        from tensor_stereo.interop.hdf5 import find_exported, open_file

        with open_file(source) as file:
            find_exported(source, file)
    prepare_target("out", out)
    return ending
