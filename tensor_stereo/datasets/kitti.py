"""KITTI's stereo benchmarks of 2012 (Geiger et al.) and 2015 (Menze & Geiger), and its sequences without truth.

Sources: https://www.cvlibs.net/datasets/kitti/ and the development kits of raw data, odometry and object detection.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs, list_files, pair_frames, parent_names

_SCALE = 256.0  # of the 16-bit maps, in both releases


_BENCHMARK = re.compile(r".*_10")  # the frame of a scene that has ground truth
_SEQUENCE = re.compile(r"\d{6}")  # a frame of odometry or of object detection
_DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync")
_CAMERAS = (("image_2", "image_3"), ("image_0", "image_1"))  # colour before grey
_RAW_CAMERAS = (("image_02", "image_03"), ("image_00", "image_01"))


class _Layout(NamedTuple):
    dataset: str
    image0: str
    image1: str
    disparity_gt: str
    disparity_noc_gt: str


_LAYOUTS = (
    _Layout("kitti-2015", "image_2", "image_3", "disp_occ_0", "disp_noc_0"),
    _Layout("kitti-2012", "colored_0", "colored_1", "disp_occ", "disp_noc"),
    _Layout("kitti-2012", "image_0", "image_1", "disp_occ", "disp_noc"),  # the same frames in grey
)


def find_kitti(root: StrPath) -> list[PairFiles]:
    """Find KITTI's stereo pairs in ``root`` and below; no image is opened.

    Of the benchmarks only the frames ``*_10`` are taken, the ones that have ground truth. Where 2012 is there in colour
    and in grey, colour is taken. The frames of a folder ``testing`` get a dataset name of their own
    (``kitti-2015-testing``), since they share their numbers with those of ``training``. Where the map of visible pixels
    ``disp_noc`` is the only one, it is the ground truth, and nothing tells the occluded pixels.

    Raw data (``kitti-raw``), odometry (``kitti-odometry``) and object detection (``kitti-object``) give pairs without
    ground truth, in colour if that is there. Of raw data only folders ``*_sync`` are taken: those named ``*_extract``
    hold images that are not rectified.

    Args:
        root: a folder with releases, one release, its folder ``training``, or one sequence.

    Returns:
        Pairs sorted by (dataset, frame); 16-bit disparity maps with ``gt_scale`` 256, None where withheld. The scene of
        a sequence is its folder and the frame, ``00/000012``.

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        ValueError: if the right view of a frame is missing.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     for name in ("image_2", "image_3", "disp_occ_0"):
    ...         Path(root, "training", name).mkdir(parents=True)
    ...         Path(root, "training", name, "000046_10.png").touch()
    ...     [pair] = find_kitti(root)
    >>> pair.dataset, pair.scene, pair.gt_scale
    ('kitti-2015', '000046_10', 256.0)
    """
    return collect_pairs(root, [kitti_pairs])


def kitti_pairs(folder: Path) -> list[PairFiles]:
    """Return the KITTI pairs whose image folders lie directly in ``folder``.

    >>> kitti_pairs(Path("no/such/folder"))
    []
    """
    pairs: dict[tuple[str, str], PairFiles] = {}
    name = parent_names(folder)[0]
    ending = "-testing" if name.casefold() == "testing" else ""
    for layout in _LAYOUTS:
        frames = _frames(folder / layout.image0, folder / layout.image1, _BENCHMARK)
        maps, maps_noc = (list_files(folder / part) if frames else {} for part in layout[3:])
        for stem, image0, image1 in frames:
            file = f"{stem}.png".casefold()
            disparity, noc = maps.get(file), maps_noc.get(file)
            has_disparity = disparity is not None or noc is not None
            pair = PairFiles(
                dataset=layout.dataset + ending,
                scene=stem,
                image0=image0,
                image1=image1,
                disparity_gt=noc if disparity is None else disparity,
                gt_scale=_SCALE if has_disparity else None,
                disparity_noc_gt=None if disparity is None else noc,
            )
            pairs.setdefault((pair.dataset, pair.scene), pair)
    return list(pairs.values()) or _sequence_pairs(folder, name)


def _sequence_pairs(folder: Path, name: str) -> list[PairFiles]:
    """The pairs of one sequence, or of one part of the benchmark of object detection."""
    if _DRIVE.fullmatch(name):
        dataset, pattern = "kitti-raw", re.compile(r"\d{10}")
        cameras = [(f"{left}/data", f"{right}/data") for left, right in _RAW_CAMERAS]
    else:
        dataset, pattern = ("kitti-object" if name in ("training", "testing") else "kitti-odometry"), _SEQUENCE
        cameras = list(_CAMERAS)
    for left, right in cameras:
        frames = _frames(folder / left, folder / right, pattern)
        if frames:
            return [PairFiles(dataset, f"{name}/{stem}", image0, image1) for stem, image0, image1 in frames]
    return []


def _frames(left: Path, right: Path, pattern: re.Pattern[str]) -> list[tuple[str, Path, Path]]:
    """The frames of both folders whose names are those of a release; none if there is only one folder."""
    return pair_frames(left, right, pattern) if left.is_dir() and right.is_dir() else []
