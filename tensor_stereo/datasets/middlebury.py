"""Middlebury's two-view releases: 2001, 2003, 2005, 2006, 2014, 2021 and the third evaluation (MiddEval3).

Sources: Scharstein & Szeliski 2002 (2001), Scharstein & Szeliski 2003, Scharstein & Pal 2007 (2005), Hirschmueller &
Scharstein 2007 (2006), Scharstein et al. 2014, and the pages of the releases, https://vision.middlebury.edu/stereo/data/.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tensor_stereo.datasets.eth3d import is_eth3d_scene
from tensor_stereo.datasets.files import (
    PairFiles,
    StrPath,
    Views,
    collect_pairs,
    find_file,
    find_views,
    image_names,
    list_files,
    parent_names,
)
from tensor_stereo.datasets.image_size import image_size
from tensor_stereo.datasets.middlebury_scales import find_release, folder_year, integer_scale

_MIDDEVAL3 = re.compile(r"middeval3|(?:training|test)[FHQ]", re.IGNORECASE)
_SCENES_2014 = re.compile(r".+-(?:im)?perfect", re.IGNORECASE)
_SCENES_2021 = re.compile(
    r"(?:artroom|bandsaw|chess|curule|ladder|octogons|pendulum|podium|skates|skiboots|traproom)\d", re.IGNORECASE
)


class _Layout(NamedTuple):
    image0: Sequence[str]
    image1: Sequence[str]
    disparity_gt: Sequence[str]
    years: Sequence[str]  # releases that used these names for integer maps, none for float maps


def _integer_layout(image0: str, image1: str, disparity_gt: str, years: Sequence[str]) -> _Layout:
    names_gt = [disparity_gt + ending for ending in (".png", ".ppm", ".pgm")]
    return _Layout(image_names(image0), image_names(image1), names_gt, years)


_LAYOUTS = (
    _Layout(image_names("im0"), image_names("im1"), ["disp0GT.pfm", "disp0.pfm"], ()),
    _integer_layout("view1", "view5", "disp1", ("2005", "2006")),
    _integer_layout("im2", "im6", "disp2", ("2001", "2003")),  # before im0, im1: archives of nine views hold im0 to im8
    _integer_layout("scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3", ("2001",)),  # tsukuba
    _integer_layout("im0", "im1", "disp0", ("2001",)),  # map
)


def find_middlebury(root: StrPath) -> list[PairFiles]:
    """Find Middlebury's pairs in ``root`` and below; no image is decoded.

    ======================  ==================================  ===============================================
    release                 files of a scene                    disparity map
    ======================  ==================================  ===============================================
    2001                    im2, im6, disp2 (map: im0, im1,     8 bits, scale 8, tsukuba 16
                            disp0; tsukuba: scene1.row3.col3,
                            col4, truedisp.row3.col3)
    2003                    im2, im6, disp2                     8 bits, scale 4, 2 or 1 in quarter, half or full size
    2005, 2006              view1, view5, disp1                 8 bits, scale 3, 2 or 1 in third, half or full size
    2014, 2021              im0, im1, disp0.pfm, calib.txt      PFM in px
    MiddEval3               im0, im1, disp0GT.pfm, calib.txt,   PFM in px
                            mask0nocc.png
    ======================  ==================================  ===============================================

    Images may have any ending of images (PNG, PPM, PGM, TIFF, BMP, WebP, JPEG), 8-bit maps may be PNG, PPM or PGM.
    For 2001-2006 ``gt_scale`` is settled by the release (a folder above the scene named for it, as ``2003``,
    ``scenes2005`` or ``middlebury-2006``, else the scene's name) and the size (a folder as ``HalfSize``, a name as
    ``conesH``, else the width of view 0); it is None where these leave it open or disagree. Scenes without a
    disparity map are listed with ``disparity_gt=None``.

    Args:
        root: a folder with releases, one release, or one scene's folder.

    Returns:
        Pairs sorted by (dataset, scene, path); empty if there is none.

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        ValueError: if a scene lacks one view beside its disparity map, or a view has no readable header.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     scene = Path(root, "2003", "cones")
    ...     scene.mkdir(parents=True)
    ...     for name in ("im2.ppm", "im6.ppm", "disp2.pgm"):
    ...         _ = (scene / name).write_bytes(b"P6 450 375 255 ")
    ...     [pair] = find_middlebury(root)
    >>> pair.dataset, pair.scene, pair.gt_scale
    ('middlebury-2003', 'cones', 4.0)
    """
    return collect_pairs(root, [middlebury_pairs])


def middlebury_pairs(folder: Path) -> list[PairFiles]:
    """Return the Middlebury pair directly in ``folder``, as a list of none or one.

    >>> middlebury_pairs(Path("no/such/folder"))
    []
    """
    files = list_files(folder)
    present = [(layout, views) for layout in _LAYOUTS if (views := find_views(files, *layout[:3])) is not None]
    if not present:
        return []
    layout, views = next(((layout, views) for layout, views in present if views.disparity_gt is not None), present[0])
    scene = parent_names(folder)[0]
    if layout.years:
        release = find_release(folder, years=layout.years)
        dataset = "middlebury" if release is None else f"middlebury-{release}"
        scale = None
        if views.disparity_gt is not None:
            scale = integer_scale(folder, width=_width(views), years=layout.years)
        return [PairFiles(dataset, scene, *views, gt_scale=scale)]
    if is_eth3d_scene(folder):  # same file names
        return []
    return [
        PairFiles(
            _float_release(folder, scene, views.disparity_gt),
            scene,
            *views,
            gt_scale=None if views.disparity_gt is None else 1.0,
            mask=find_file(files, ["mask0nocc.png"]),
            calibration=find_file(files, ["calib.txt"]),
        )
    ]


def _float_release(folder: Path, scene: str, disparity: Path | None) -> str:
    """Label of a scene with im0.png and im1.png: by the nearest folder that tells, else by its files and its name."""
    for name in parent_names(folder):
        if _MIDDEVAL3.fullmatch(name):
            return "middeval3"
        year = folder_year(name, years=("2014", "2021"))
        if year is not None:
            return f"middlebury-{year}"
    if disparity is not None and disparity.name.casefold() == "disp0gt.pfm":
        return "middeval3"
    if _SCENES_2014.fullmatch(scene):
        return "middlebury-2014"
    return "middlebury-2021" if _SCENES_2021.fullmatch(scene) else "middlebury"


def _width(views: Views) -> int:
    """Width in px of the first file of a pair that can be read; one damaged file must not hide the other pairs."""
    paths = [path for path in views if path is not None]
    for path in paths[:-1]:
        with suppress(ValueError):
            return image_size(path)[0]
    return image_size(paths[-1])[0]
