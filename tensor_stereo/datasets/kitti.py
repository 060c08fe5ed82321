"""KITTI's stereo benchmarks of 2012 (Geiger et al. 2012) and 2015 (Menze & Geiger 2015), https://www.cvlibs.net/datasets/kitti/."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs, parent_names

_SCALE = 256.0  # of the 16-bit maps, in both releases


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

    Only the frames ``*_10.png`` are taken, the ones that have ground truth. Where 2012 is there in colour and in grey,
    colour is taken. The frames of a folder ``testing`` get a dataset name of their own (``kitti-2015-testing``), since
    they share their numbers with those of ``training``.

    Args:
        root: a folder with releases, one release, or its folder ``training``.

    Returns:
        Pairs sorted by (dataset, frame); 16-bit disparity maps with ``gt_scale`` 256, None where withheld.

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
    ending = "-testing" if parent_names(folder)[0].casefold() == "testing" else ""
    for layout in _LAYOUTS:
        if not (folder / layout.image0).is_dir() or not (folder / layout.image1).is_dir():
            continue
        for image0 in sorted((folder / layout.image0).glob("*_10.png")):
            image1 = folder / layout.image1 / image0.name
            if not image1.is_file():
                raise ValueError(f"{image0} has no right view: {image1} is missing")
            disparity, noc = (folder / name / image0.name for name in (layout.disparity_gt, layout.disparity_noc_gt))
            has_disparity = disparity.is_file()
            pair = PairFiles(
                dataset=layout.dataset + ending,
                scene=image0.stem,
                image0=image0,
                image1=image1,
                disparity_gt=disparity if has_disparity else None,
                gt_scale=_SCALE if has_disparity else None,
                disparity_noc_gt=noc if has_disparity and noc.is_file() else None,
            )
            pairs.setdefault((pair.dataset, pair.scene), pair)
    return list(pairs.values())
