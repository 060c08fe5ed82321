"""Which Middlebury release a folder belongs to, and the scale of its 8-bit disparity maps.

Sources: the pages of the 2001, 2003, 2005 and 2006 data sets, https://vision.middlebury.edu/stereo/data/. A stored
value divided by the scale is the disparity in px; the reduced sizes of a scene store the values of its full size.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tensor_stereo.datasets.files import parent_names

_SCENES = {
    "2001": "barn1 barn2 bull map poster sawtooth tsukuba venus",
    "2003": "cones teddy",
    "2005": "Art Books Computer Dolls Drumsticks Dwarves Laundry Moebius Reindeer",
    "2006": "Aloe Baby1 Baby2 Baby3 Bowling1 Bowling2 Cloth1 Cloth2 Cloth3 Cloth4 Flowerpots Lampshade1 Lampshade2 "
    "Midd1 Midd2 Monopoly Plastic Rocks1 Rocks2 Wood1 Wood2",
}
_YEARS = {scene.casefold(): year for year, scenes in _SCENES.items() for scene in scenes.split()}

# A folder named for a release, a size, or both: 2003, scenes2005, middlebury-2006, HalfSize, 2005_ThirdSize
_FOLDER = re.compile(
    r"(?:(?:middlebury|stereo|scenes|datasets?)[-_ ]?)*(?P<year>20\d\d)?[-_ ]?"
    r"(?:(?P<size>full|half|third|quarter)[-_ ]?size)?",
    re.IGNORECASE,
)
_SIZED_SCENE = re.compile(r"(?P<scene>cones|teddy)(?P<size>[FHQ])", re.IGNORECASE)  # archives of 2003
_LETTERS = {"f": "full", "h": "half", "q": "quarter"}


class _Size(NamedTuple):
    name: str
    scale: float
    min_width: int
    max_width: int


_SIZES_2005 = (_Size("third", 3.0, 413, 465), _Size("half", 2.0, 620, 698), _Size("full", 1.0, 1240, 1396))
_SIZES = {  # smallest first
    "2001": (_Size("", 8.0, 284, 435),),
    "2003": (_Size("quarter", 4.0, 450, 450), _Size("half", 2.0, 900, 900), _Size("full", 1.0, 1800, 1800)),
    "2005": _SIZES_2005,
    "2006": _SIZES_2005,
}
_SIZES_TSUKUBA = (_Size("", 16.0, 384, 384),)


def folder_year(name: str, *, years: Sequence[str]) -> str | None:
    """Return the one of ``years`` that a folder is named for, or None.

    >>> folder_year("scenes2005", years=["2005", "2006"]), folder_year("run-2005", years=["2005"])
    ('2005', None)
    """
    match = _FOLDER.fullmatch(name)
    return match["year"] if match and match["year"] in years else None


def find_release(folder: Path, *, years: Sequence[str]) -> str | None:
    """Return the release of a scene's folder: by the nearest folder that is named for one, else by the scene's name.

    Args:
        folder: the scene's folder.
        years: the releases that use the scene's file names.

    >>> find_release(Path("data/2006/Chair"), years=["2005", "2006"]), find_release(Path("art"), years=["2005", "2006"])
    ('2006', '2005')
    """
    return _year_of_path(folder, years) or _year_of_scene(folder, years)


def integer_scale(folder: Path, *, width: int, years: Sequence[str]) -> float | None:
    """Return stored value / disparity in px of the 8-bit maps in a scene's folder, None while that is open.

    The release comes from the path and from the scene's name, the size from the path and from ``width``. Where both
    tell and the scales differ, the answer is None. Images narrower than the smallest published size count as cut out of
    it. The names ``view1`` and ``view5`` alone mean 2005 or 2006, which share their scales, if the size is known.

    Args:
        folder: the scene's folder.
        width: of its images, in px.
        years: the releases that use the scene's file names.

    >>> integer_scale(Path("2005/Art"), width=463, years=["2005", "2006"])
    3.0
    >>> integer_scale(Path("scenes2006/HalfSize/Aloe"), width=641, years=["2005", "2006"])
    2.0
    >>> integer_scale(Path("my_scene"), width=640, years=["2001", "2003"]) is None
    True
    """
    size = _size_of_path(folder)
    known = {_year_of_path(folder, years), _year_of_scene(folder, years)} - {None}
    if not known and "2005" in years:
        return _scale_of_size(_SIZES_2005, size, width, allow_crop=False)
    tsukuba = parent_names(folder)[0].casefold() == "tsukuba"
    published = [_SIZES_TSUKUBA if tsukuba and year == "2001" else _SIZES[year] for year in known if year is not None]
    scales = {_scale_of_size(sizes, size, width, allow_crop=True) for sizes in published}
    return scales.pop() if len(scales) == 1 else None


def _scale_of_size(sizes: Sequence[_Size], name: str | None, width: int, *, allow_crop: bool) -> float | None:
    """Scale of the published size that ``name`` and ``width`` mean, None if none fits or they disagree."""
    by_width = next((size for size in sizes if size.min_width <= width <= size.max_width), None)
    if name is not None:
        by_name = next((size for size in sizes if size.name == name), None)
        if by_name is None or width > by_name.max_width or by_width not in (None, by_name):
            return None
        return by_name.scale
    if by_width is not None:
        return by_width.scale
    return sizes[0].scale if allow_crop and width < sizes[0].min_width else None


def _year_of_path(folder: Path, years: Sequence[str]) -> str | None:
    found = (folder_year(name, years=years) for name in parent_names(folder))
    return next((year for year in found if year is not None), None)


def _year_of_scene(folder: Path, years: Sequence[str]) -> str | None:
    name = parent_names(folder)[0]
    sized = _SIZED_SCENE.fullmatch(name)
    year = _YEARS.get((sized["scene"] if sized else name).casefold())
    return year if year in years else None


def _size_of_path(folder: Path) -> str | None:
    names = parent_names(folder)
    sized = _SIZED_SCENE.fullmatch(names[0])
    if sized:
        return _LETTERS[sized["size"].casefold()]
    matches = (_FOLDER.fullmatch(name) for name in names)
    return next((match["size"].casefold() for match in matches if match and match["size"]), None)
