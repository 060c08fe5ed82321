"""What a reader finds on disk: the files of one pair, and the walk over folders that finds them. Imports no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

StrPath: TypeAlias = str | os.PathLike[str]
GT_ENCODINGS = ("scaled", "sintel")

MAX_DEPTH = 6  # data/middlebury/scenes2005/FullSize/zip-2views/Art, with one level to spare
_SKIPPED = re.compile(r"\..*|__MACOSX|Illum\d+", re.IGNORECASE)  # Illum: the same scene under other lights (2005, 2006)


@dataclass(frozen=True)
class PairFiles:
    """The files of one rectified pair; nothing is opened yet.

    Attributes:
        dataset: release, e.g. ``middlebury-2005``, ``middeval3``, ``kitti-2015``, ``eth3d``.
        scene: name of the scene's folder, or KITTI's frame.
        image0: view 0 (left).
        image1: view 1 (right).
        disparity_gt: disparity map of view 0 (PFM, or a grey PNG/PGM); None where the release withholds it.
        gt_scale: stored value / gt_scale = disparity in px; None while it is open.
        mask: ``mask0nocc.png`` of MiddEval3 and ETH3D.
        disparity_noc_gt: KITTI's map that holds the visible pixels only, on the scale of ``disparity_gt``.
        calibration: ``calib.txt`` in Middlebury's format.
        gt_encoding: how the maps hold their values: ``scaled`` (value / gt_scale, or PFM), or ``sintel`` (three
            channels, as its archive says).
    """

    dataset: str
    scene: str
    image0: Path
    image1: Path
    disparity_gt: Path | None = None
    gt_scale: float | None = None
    mask: Path | None = None
    disparity_noc_gt: Path | None = None
    calibration: Path | None = None
    gt_encoding: str = "scaled"


FolderReader: TypeAlias = Callable[[Path], list[PairFiles]]


def collect_pairs(root: StrPath, readers: Sequence[FolderReader]) -> list[PairFiles]:
    """Ask ``readers`` for the pairs of ``root`` and of every folder below it.

    A folder that holds pairs is not searched further; hidden folders are skipped; links are followed, each folder once.

    Args:
        root: a data root, a release, or the folder of one scene.
        readers: functions from one folder to the pairs directly in it.

    Returns:
        Pairs sorted by (dataset, scene without case, path).

    Raises:
        FileNotFoundError: if ``root`` does not exist.
        NotADirectoryError: if ``root`` is a file.
    """
    root = Path(root)
    if not root.exists():
        raise FileNotFoundError(f"root must be a folder with stereo pairs, but {root} does not exist")
    if not root.is_dir():
        raise NotADirectoryError(f"root must be a folder with stereo pairs, but {root} is a file")
    pairs: list[PairFiles] = []
    visited: set[Path] = set()
    pending = [(root, 0)]
    while pending:
        folder, depth = pending.pop()
        real = folder.resolve()
        if real in visited:
            continue
        visited.add(real)
        found = [pair for reader in readers for pair in reader(folder)]
        pairs += found
        if not found and depth < MAX_DEPTH:
            with os.scandir(folder) as entries:
                names = [entry.name for entry in entries if entry.is_dir() and not _SKIPPED.fullmatch(entry.name)]
            pending += [(folder / name, depth + 1) for name in sorted(names, reverse=True)]
    return sorted(pairs, key=lambda pair: (pair.dataset, pair.scene.casefold(), str(pair.image0)))


def find_file(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the first of ``names`` that is a file in ``folder``, or None.

    >>> find_file(Path("no/such/folder"), ["im0.png"]) is None
    True
    """
    return next((folder / name for name in names if (folder / name).is_file()), None)


class Views(NamedTuple):
    """The files of one layout in one folder."""

    image0: Path
    image1: Path
    disparity_gt: Path | None


def find_views(folder: Path, names0: Sequence[str], names1: Sequence[str], names_gt: Sequence[str]) -> Views | None:
    """Return the files of a layout, or None if ``folder`` is no scene of it.

    Raises:
        ValueError: if the disparity map and one view are there but not the other, as after a partial unpacking.

    >>> find_views(Path("no/such/folder"), ["im0.png"], ["im1.png"], ["disp0.pfm"]) is None
    True
    """
    image0, image1, disparity = (find_file(folder, names) for names in (names0, names1, names_gt))
    if image0 is not None and image1 is not None:
        return Views(image0, image1, disparity)
    if disparity is not None and (image0 is not None or image1 is not None):
        missing = names0 if image0 is None else names1
        raise ValueError(f"{folder} holds {disparity.name} and one view, but not the other: no {' or '.join(missing)}")
    return None


def parent_names(folder: Path) -> list[str]:
    """Names of ``folder`` and of the folders above it, nearest first.

    >>> parent_names(Path("/data/2005/Art"))[:2]
    ['Art', '2005']
    """
    return list(reversed(Path(os.path.abspath(folder)).parts))  # noqa: PTH100 (resolve() would follow links)


def missing_scale(files: PairFiles) -> ValueError:
    """The error for a disparity map whose scale nothing tells."""
    return ValueError(
        f"the scale of {files.disparity_gt} is open: its folders, the scene's name {files.scene!r} and the image width "
        "do not agree on one Middlebury release and size. Give gt_scale (--gt-scale), the stored value of one pixel of "
        "disparity: 8 for 2001 (tsukuba 16), 4 for 2003 in quarter size, 3 for 2005 and 2006 in third size"
    )


def check_gt_scale(gt_scale: float | None) -> None:
    """Raise unless ``gt_scale`` is None or a positive finite number.

    >>> check_gt_scale(3.0)
    """
    if gt_scale is not None and not 0 < gt_scale < float("inf"):
        raise ValueError(f"gt_scale (--gt-scale) must be positive and finite, got {gt_scale}")
