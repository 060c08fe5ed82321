"""ETH3D's low-resolution two-view benchmark (Schoeps et al. 2017), https://www.eth3d.net/datasets."""

from __future__ import annotations

import re
from pathlib import Path

from tensor_stereo.datasets.files import (
    PairFiles,
    StrPath,
    collect_pairs,
    find_file,
    find_views,
    image_names,
    list_files,
    parent_names,
)

_FOLDER = re.compile(
    r"eth3d(?:[-_ ]?(?:stereo|low[-_]?res|two[-_]?view))*|two_view_(?:training|test|testing)", re.IGNORECASE
)
_SCENE = re.compile(r"[a-z]\w*_\d[ls]", re.IGNORECASE)  # playground_1l, sand_box_1s: long or short baseline


def find_eth3d(root: StrPath) -> list[PairFiles]:
    """Find ETH3D's two-view pairs in ``root`` and below; no image is opened.

    A scene holds im0.png and im1.png, or images with other endings; its ground truth disp0GT.pfm (px) and mask0nocc.png
    lie beside them, or in the folder of the same name under ``two_view_training_gt``, as the archives unpack.
    Middlebury uses the same file names: a scene counts as ETH3D's if a folder above it is named ``eth3d`` or
    ``two_view_training``, or by its own name, as ``playground_1l``.

    Args:
        root: a folder with releases, the release, or one scene's folder.

    Returns:
        Pairs sorted by scene; ``disparity_gt`` is None for the test scenes.

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        ValueError: if a scene lacks one view beside its disparity map.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     scene = Path(root, "playground_1l")
    ...     scene.mkdir()
    ...     for name in ("im0.png", "im1.png", "disp0GT.pfm"):
    ...         (scene / name).touch()
    ...     [pair] = find_eth3d(root)
    >>> pair.dataset, pair.scene, pair.gt_scale
    ('eth3d', 'playground_1l', 1.0)
    """
    return collect_pairs(root, [eth3d_pairs])


def is_eth3d_scene(folder: Path) -> bool:
    """Tell by the names in its path whether a folder with im0.png and im1.png belongs to ETH3D.

    >>> is_eth3d_scene(Path("flat/forest_2s")), is_eth3d_scene(Path("MiddEval3/trainingQ/Vintage"))
    (True, False)
    """
    names = parent_names(folder)
    return _SCENE.fullmatch(names[0]) is not None or any(map(_FOLDER.fullmatch, names))


def eth3d_pairs(folder: Path) -> list[PairFiles]:
    """Return the ETH3D pair directly in ``folder``, as a list of none or one.

    >>> eth3d_pairs(Path("no/such/folder"))
    []
    """
    if not is_eth3d_scene(folder):
        return []
    files = list_files(folder)
    views = find_views(files, image_names("im0"), image_names("im1"), ["disp0GT.pfm"])
    if views is None:
        return []
    scene, release, *_ = parent_names(folder)
    truth = files if views.disparity_gt is not None else list_files(folder.parent.with_name(f"{release}_gt") / scene)
    disparity = find_file(truth, ["disp0GT.pfm"])
    return [
        PairFiles(
            dataset="eth3d",
            scene=scene,
            image0=views.image0,
            image1=views.image1,
            disparity_gt=disparity,
            gt_scale=None if disparity is None else 1.0,
            mask=find_file(truth, ["mask0nocc.png"]),
            calibration=find_file(files, ["calib.txt"]),
        )
    ]
