"""What a reader finds on disk: the files of one pair, and the walk over folders that finds them. Imports no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, SupportsIndex, TypeAlias

from tensor_stereo.limits import LimitError, Within
from tensor_stereo.paths import has_ending

StrPath: TypeAlias = str | os.PathLike[str]
Location: TypeAlias = Path | str  # a path, or a URL of fsspec as text
GT_ENCODINGS = ("scaled", "sintel", "flyingthings3d-subset")
# Of views. The first that is there is taken; ground truth is never JPEG or WebP, which lose values.
IMAGE_ENDINGS = (".png", ".ppm", ".pgm", ".tif", ".tiff", ".bmp", ".webp", ".jpg", ".jpeg")
SAMPLE_BITS = Within(8, 16)
ESTIMATES = ("disparity_est", "disparity1_est")
PATHS = ("image0", "image1", "disparity_gt", "disparity_noc_gt", "mask", "calibration", *ESTIMATES)  # of PairFiles
READ = ("image0", "image1", "disparity_gt", "disparity_noc_gt", "mask")  # of these, what a pair is read from
SCALES = ("gt_scale", "est_scale")

MAX_DEPTH = 6  # data/middlebury/scenes2005/FullSize/zip-2views/Art, with one level to spare
_SKIPPED = re.compile(r"\..*|__MACOSX|Illum\d+", re.IGNORECASE)  # Illum: the same scene under other lights (2005, 2006)


@dataclass(frozen=True)
class PairFiles:
    """The files of one rectified pair, paths or URLs of fsspec; nothing is opened yet.

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
        gt_encoding: how the maps hold their values: ``scaled`` (value / gt_scale, or PFM), ``sintel`` (three
            channels, as its archive says), or ``flyingthings3d-subset`` (PFM with the sign of the optical flow, and
            masks that are not 0 where occluded).
        sample_bits: bits in use of views that store 16 bits per sample and do not tell; None where nothing says so.
        disparity_est: a disparity map of view 0 that some method has made, whose confidence is asked for.
        disparity1_est: likewise of view 1.
        est_scale: stored value / est_scale = disparity in px in both; integers need it.
    """

    dataset: str
    scene: str
    image0: Location
    image1: Location
    disparity_gt: Location | None = None
    gt_scale: float | None = None
    mask: Location | None = None
    disparity_noc_gt: Location | None = None
    calibration: Location | None = None
    gt_encoding: str = "scaled"
    sample_bits: int | None = None
    disparity_est: Location | None = None
    disparity1_est: Location | None = None
    est_scale: float | None = None


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


def list_files(folder: Path) -> dict[str, Path]:
    """The files directly in a folder by their names without case; none if there is no such folder.

    One look at the folder is cheaper than one at each file of a large release. Where names differ in case only, the one
    with small letters is taken.

    >>> list_files(Path("no/such/folder"))
    {}
    """
    try:
        with os.scandir(folder) as entries:
            names = sorted((entry.name for entry in entries if entry.is_file()), reverse=True)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    found: dict[str, Path] = {}
    for name in names:  # small letters come after capitals, so first here
        found.setdefault(name.casefold(), folder / name)
    return found


def find_file(files: Mapping[str, Path], names: Sequence[str]) -> Path | None:
    """Return the first of ``names`` among the files of a folder, in any case, or None.

    >>> find_file({"im0.png": Path("IM0.PNG")}, ["im0.png"]).name
    'IM0.PNG'
    """
    return next((files[name.casefold()] for name in names if name.casefold() in files), None)


def image_names(stem: str) -> list[str]:
    """The names that a view may have.

    >>> image_names("im0")[:2]
    ['im0.png', 'im0.ppm']
    """
    return [stem + ending for ending in IMAGE_ENDINGS]


def list_frames(folder: Path) -> dict[str, Path]:
    """The images directly in a folder by their names without ending, sorted; each frame once.

    >>> list_frames(Path("no/such/folder"))
    {}
    """
    found: dict[str, Path] = {}
    for path in list_files(folder).values():
        if has_ending(path, IMAGE_ENDINGS):
            other = found.setdefault(path.stem, path)
            if _rank(path) < _rank(other):
                found[path.stem] = path
    return dict(sorted(found.items()))


def _rank(path: Path) -> int:
    return IMAGE_ENDINGS.index(path.suffix.casefold())


def pair_frames(
    folder0: Path, folder1: Path, pattern: re.Pattern[str] = re.compile(".*")
) -> list[tuple[str, Path, Path]]:
    """Name, left view and right view of the frames in two folders.

    Args:
        folder0: Folder of the left views.
        folder1: Folder of the right views.
        pattern: Names without ending that are looked at.

    Raises:
        ValueError: if the right view of a frame is missing.

    >>> pair_frames(Path("no/such/left"), Path("no/such/right"))
    []
    """
    frames0 = {stem: path for stem, path in list_frames(folder0).items() if pattern.fullmatch(stem)}
    frames1 = list_frames(folder1) if frames0 else {}
    for stem, image0 in frames0.items():
        if stem not in frames1:
            raise ValueError(f"{image0} has no right view: {folder1 / image0.name} is missing")
    return [(stem, image0, frames1[stem]) for stem, image0 in frames0.items()]


class Views(NamedTuple):
    """The files of one layout in one folder."""

    image0: Path
    image1: Path
    disparity_gt: Path | None


def find_views(
    files: Mapping[str, Path], names0: Sequence[str], names1: Sequence[str], names_gt: Sequence[str]
) -> Views | None:
    """Return the files of a layout among those of a folder, or None if it is no scene of that layout.

    Raises:
        ValueError: if the disparity map and one view are there but not the other, as after a partial unpacking.

    >>> find_views({}, ["im0.png"], ["im1.png"], ["disp0.pfm"]) is None
    True
    """
    image0, image1, disparity = (find_file(files, names) for names in (names0, names1, names_gt))
    if image0 is not None and image1 is not None:
        return Views(image0, image1, disparity)
    if disparity is not None and (image0 is not None or image1 is not None):
        missing = names0 if image0 is None else names1
        folder, names = (
            disparity.parent,
            missing[0] if len(missing) == 1 else f"{missing[0]} or one with another ending",
        )
        raise ValueError(f"{folder} holds {disparity.name} and one view, but not the other: no {names}")
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
    check_scale("gt_scale (--gt-scale)", gt_scale)


def check_scale(name: str, scale: float | None) -> None:
    """Raise unless a scale is None or a positive finite number.

    >>> check_scale("est_scale", 256.0)
    """
    if scale is not None and not 0 < scale < float("inf"):
        raise ValueError(f"{name} must be positive and finite, got {scale}")


def check_sample_bits(sample_bits: int | None) -> None:
    """Raise unless ``sample_bits`` is None or an integer from 8 to 16.

    >>> check_sample_bits(12)
    """
    if sample_bits is None:
        return
    if isinstance(sample_bits, bool) or not isinstance(sample_bits, (int, SupportsIndex)):
        raise TypeError(f"sample_bits must be an integer or None, got {sample_bits!r}")
    if sample_bits not in SAMPLE_BITS:
        raise LimitError(f"sample_bits must {SAMPLE_BITS}, got {sample_bits}")
