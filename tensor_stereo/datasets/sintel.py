"""MPI Sintel stereo (Butler et al., ECCV 2012), by the README of its training archive of 2015. Imports no torch."""

from __future__ import annotations

from pathlib import Path

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs

_PASSES = ("clean", "final")


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
        for image0 in sorted(left.glob("*/frame_*.png")) if right.is_dir() else ():
            inner = image0.relative_to(left)
            if not (right / inner).is_file():
                raise ValueError(f"{image0} has no right view: {right / inner} is missing")
            disparity, mask = (folder / name / inner for name in ("disparities", "occlusions"))
            pairs.append(
                PairFiles(
                    dataset=f"sintel-{kind}",
                    scene=inner.with_suffix("").as_posix(),
                    image0=image0,
                    image1=right / inner,
                    disparity_gt=disparity if disparity.is_file() else None,
                    gt_scale=1.0 if disparity.is_file() else None,
                    mask=mask if mask.is_file() else None,
                    gt_encoding="sintel",
                )
            )
    return pairs
