"""Where the published stereo releases lie, file by file. Imports no torch.

Addresses are the publishers' own, as their pages and the scripts of public projects give them. Of Middlebury's sizes,
the quarter is taken of 2003 and the third of 2005 and 2006, the sizes most often evaluated, and of all years the scenes
with public ground truth alone. No publisher's page that was at hand gives checksums.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import urlsplit

_MIDDLEBURY = "https://vision.middlebury.edu/stereo"
_KITTI = "https://s3.eu-central-1.amazonaws.com/avg-kitti"
_ETH3D = "https://www.eth3d.net"
_SCENEFLOW = "https://lmb.informatik.uni-freiburg.de"
_SINTEL = "https://files.is.tue.mpg.de/jwulff/sintel"

# The ninth scene of 2001, map, is left out: no page that lists its files was at hand.
_SCENES_2001 = ("barn1", "barn2", "bull", "poster", "sawtooth", "venus")
_TSUKUBA = ("scene1.row3.col3.ppm", "scene1.row3.col4.ppm", "truedisp.row3.col3.pgm")
_SCENES_2003 = ("cones", "teddy")
_SCENES_2005 = ("Art", "Books", "Dolls", "Laundry", "Moebius", "Reindeer")
_SCENES_2006 = (
    *("Aloe", "Baby1", "Baby2", "Baby3", "Bowling1", "Bowling2", "Cloth1", "Cloth2", "Cloth3", "Cloth4", "Flowerpots"),
    *("Lampshade1", "Lampshade2", "Midd1", "Midd2", "Monopoly", "Plastic", "Rocks1", "Rocks2", "Wood1", "Wood2"),
)
_SCENES_2014 = (
    *("Adirondack", "Backpack", "Bicycle1", "Cable", "Classroom1", "Couch", "Flowers", "Jadeplant", "Mask"),
    *("Motorcycle", "Piano", "Pipes", "Playroom", "Playtable", "Recycle", "Shelves", "Shopvac", "Sticks", "Storage"),
    *("Sword1", "Sword2", "Umbrella", "Vintage"),
)


@dataclass(frozen=True)
class RemoteFile:
    """One file of a release.

    Attributes:
        url: where its publisher serves it.
        folder: below the folder of the release; the file is put there, and unpacked there if it is an archive.

    Example:
        >>> RemoteFile("https://example.org/data/Art-2views.zip").name
        'Art-2views.zip'
    """

    url: str
    folder: str = ""

    @property
    def name(self) -> str:
        return PurePosixPath(urlsplit(self.url).path).name


@dataclass(frozen=True)
class Release:
    """One published release.

    Attributes:
        name: what users type, and the folder that it is put in.
        page: its publisher's page, with the terms of use and what to cite.
        files: all that is fetched.
    """

    name: str
    page: str
    files: tuple[RemoteFile, ...]


def _archives(base: str, names: Iterable[str]) -> tuple[RemoteFile, ...]:
    return tuple(RemoteFile(f"{base}/{name}") for name in names)


def _middlebury_2001() -> Release:
    scenes = dict.fromkeys(_SCENES_2001, ("im2.ppm", "im6.ppm", "disp2.pgm")) | {"tsukuba": _TSUKUBA}
    page = f"{_MIDDLEBURY}/data/scenes2001/"
    files = (RemoteFile(f"{page}data/{scene}/{name}", scene) for scene, names in scenes.items() for name in names)
    return Release("middlebury-2001", page, tuple(files))


def _middlebury_archives(year: str, names: Iterable[str]) -> Release:
    page = f"{_MIDDLEBURY}/data/scenes{year}/"
    return Release(f"middlebury-{year}", page, _archives(page.rstrip("/"), names))


def _middeval3(size: str) -> Release:
    names = (f"MiddEval3-{part}-{size}.zip" for part in ("data", "GT0"))
    return Release(
        f"middeval3-{size.casefold()}", f"{_MIDDLEBURY}/submit3/", _archives(f"{_MIDDLEBURY}/submit3/zip", names)
    )


def _kitti(year: str, benchmark: str) -> Release:
    page = f"https://www.cvlibs.net/datasets/kitti/eval_{benchmark}.php?benchmark=stereo"
    return Release(f"kitti-{year}", page, _archives(_KITTI, [f"data_{benchmark}.zip"]))


def _sceneflow(name: str) -> Release:
    prefix = name.casefold()
    base = f"{_SCENEFLOW}/data/SceneFlowDatasets_CVPR16/Release_april16/data/{name}"
    frames = [f"raw_data/{prefix}__frames_{kind}.tar" for kind in ("cleanpass", "finalpass")]
    files = _archives(base, [*frames, f"derived_data/{prefix}__disparity.tar.bz2"])
    return Release(prefix, f"{_SCENEFLOW}/resources/datasets/SceneFlowDatasets.en.html", files)


RELEASES: Mapping[str, Release] = {
    release.name: release
    for release in (
        _middlebury_2001(),
        _middlebury_archives("2003", (f"newdata/{scene}/{scene}-png-2.zip" for scene in _SCENES_2003)),
        _middlebury_archives("2005", (f"ThirdSize/zip-2views/{scene}-2views.zip" for scene in _SCENES_2005)),
        _middlebury_archives("2006", (f"ThirdSize/zip-2views/{scene}-2views.zip" for scene in _SCENES_2006)),
        _middlebury_archives("2014", (f"zip/{scene}-perfect.zip" for scene in _SCENES_2014)),
        _middlebury_archives("2021", ["zip/all.zip"]),
        *map(_middeval3, "QHF"),
        _kitti("2012", "stereo_flow"),
        _kitti("2015", "scene_flow"),
        Release(
            "eth3d-two-view",
            f"{_ETH3D}/datasets",
            _archives(f"{_ETH3D}/data", ["two_view_training.7z", "two_view_training_gt.7z"]),
        ),
        *map(_sceneflow, ("FlyingThings3D", "Driving", "Monkaa")),
        Release(
            "sintel-stereo",
            "http://sintel.is.tue.mpg.de/stereo",
            _archives(_SINTEL, ["MPI-Sintel-stereo-training-20150305.zip"]),
        ),
    )
}
