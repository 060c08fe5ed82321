"""Endings and first bytes of files of matches. Imports no torch."""

from __future__ import annotations

from pathlib import Path

from tensor_stereo.paths import check_apart, check_source, prepare_target

# Ending -> first bytes of such a file, and what it is called.
FORMATS = {
    ".npz": (b"PK", "NumPy archive"),
    ".csv": (b"", "CSV file"),
    ".parquet": (b"PAR1", "Parquet file"),
    ".h5": (b"\x89HDF\r\n\x1a\n", "HDF5 file"),
    ".db": (b"SQLite format 3\0", "SQLite database"),
}


def check_files(source: Path, out: Path, keypoints: Path | None) -> str:
    """Look at the files of :func:`tensor_stereo.filter_file` before any work, and make the folder of ``out``.

    Returns:
        The ending of ``source`` in lower case.

    Raises:
        ValueError: for an unknown ending, another ending of ``out``, one file given for two, or contents that do not
            fit the ending.
        FileNotFoundError: if a file is missing.
        OSError: if ``out`` cannot be written.
    """
    ending = source.suffix.casefold()
    if ending not in FORMATS:
        raise ValueError(f"source must end in {', '.join(FORMATS)}, got {source.name!r}")
    if out.suffix.casefold() != ending:
        raise ValueError(f"out must end in {ending} as source does, got {out.name!r}")
    if (keypoints is not None) != (ending == ".h5"):
        raise ValueError(f"keypoints must be given for .h5, and only for it, got {keypoints} for {source.name!r}")
    for name, path, kind in (("source", source, ending), ("keypoints", keypoints, ".h5")):
        if path is None:
            continue
        check_source(name, path)
        check_apart("out", out, {name: path})
        first, called = FORMATS[kind]
        with path.open("rb") as file:
            if file.read(len(first)) != first:
                raise ValueError(f"{path} is no {called}, whatever its ending says")
    prepare_target("out", out)
    return ending
