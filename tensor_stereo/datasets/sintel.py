"""MPI Sintel stereo (Butler et al., ECCV 2012), by the README of its training archive of 2015. Imports no torch."""

from __future__ import annotations

import re
from pathlib import Path

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs, list_files, pair_frames

_PASSES = ("clean", "final")
_FRAME = re.compile(r"frame_.*")


def find_sintel(root: StrPath) -> list[PairFiles]:
    """Find Sintel's stereo frames in ``root`` and below; no image is opened.

    Args:
        root: a folder with the archive, or its folder ``training``.

    Returns:
        Pairs of both passes (``sintel-clean``, ``sintel-final``), sorted by (dataset, scene); a scene is
        ``alley_1/frame_0001``. ``mask`` is the map of occluded pixels.

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        ValueError: if the right view of a frame is missing.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     for name in ("clean_left", "clean_right", "disparities"):
    ...         Path(root, "training", name, "alley_1").mkdir(parents=True)
    ...         Path(root, "training", name, "alley_1", "frame_0001.png").touch()
    ...     [pair] = find_sintel(root)
    >>> pair.dataset, pair.scene, pair.disparity_gt is None
    ('sintel-clean', 'alley_1/frame_0001', False)
    """
    return collect_pairs(root, [sintel_pairs])


def sintel_pairs(folder: Path) -> list[PairFiles]:
    """Return the pairs whose folders of frames lie directly in ``folder``.

    >>> sintel_pairs(Path("no/such/folder"))
    []
    """
    pairs = []
    for kind in _PASSES:
        left, right = folder / f"{kind}_left", folder / f"{kind}_right"
        for scene in sorted(left.iterdir()) if left.is_dir() and right.is_dir() else ():
            maps, masks = (list_files(folder / name / scene.name) for name in ("disparities", "occlusions"))
            for stem, image0, image1 in pair_frames(scene, right / scene.name, _FRAME):
                disparity = maps.get(f"{stem}.png".casefold())
                pairs.append(
                    PairFiles(
                        dataset=f"sintel-{kind}",
                        scene=f"{scene.name}/{stem}",
                        image0=image0,
                        image1=image1,
                        disparity_gt=disparity,
                        gt_scale=None if disparity is None else 1.0,
                        mask=masks.get(f"{stem}.png".casefold()),
                        gt_encoding="sintel",
                    )
                )
    return pairs
