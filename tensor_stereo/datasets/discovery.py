"""All pairs below one folder, whatever the release. Imports no torch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from tensor_stereo.datasets.eth3d import eth3d_pairs
from tensor_stereo.datasets.files import (
    Location,
    PairFiles,
    StrPath,
    check_gt_scale,
    check_sample_bits,
    collect_pairs,
    missing_scale,
)
from tensor_stereo.datasets.kitti import kitti_pairs
from tensor_stereo.datasets.middlebury import middlebury_pairs
from tensor_stereo.datasets.sceneflow import sceneflow_pairs
from tensor_stereo.datasets.sintel import sintel_pairs
from tensor_stereo.paths import has_ending

_EXPECTED = """\
  Middlebury 2001, 2003:     SCENE/im2, im6, disp2 (png, ppm or pgm)
  Middlebury 2005, 2006:     SCENE/view1, view5, disp1 (png)
  Middlebury 2014, 2021:     SCENE/im0.png, im1.png, disp0.pfm
  MiddEval3, ETH3D two-view: SCENE/im0.png, im1.png, disp0GT.pfm
  KITTI 2012:                training/colored_0, colored_1 (or image_0, image_1), disp_occ, disp_noc/*_10.png
  KITTI 2015:                training/image_2, image_3, disp_occ_0, disp_noc_0/*_10.png
  KITTI raw:                 *_drive_*_sync/image_02, image_03/data/*.png (*_extract is not rectified)
  KITTI odometry, object:    SEQUENCE/image_2, image_3/000000.png
  Scene Flow:                frames_cleanpass, frames_finalpass/**/left, right/*.png, disparity/**/left/*.pfm
  FlyingThings3D subset:     train, val/image_clean, image_final/left, right/*.png, disparity/left/*.pfm
  Sintel stereo:             training/clean_left, clean_right, final_left, final_right, disparities/*/frame_*.png
  Views may also be ppm, pgm, tif, tiff, bmp, webp, jpg or jpeg, and endings in capitals."""


_READERS = (middlebury_pairs, kitti_pairs, eth3d_pairs, sceneflow_pairs, sintel_pairs)


def find_pairs(
    root: StrPath,
    *,
    scenes: Iterable[str] | None = None,
    gt_scale: float | None = None,
    sample_bits: int | None = None,
) -> list[PairFiles]:
    """Find the stereo pairs of every known release in ``root`` and below.

    Pairs of one dataset and scene (a release in several sizes) are told apart by the folder that holds the scene, which
    is appended to their dataset: ``middeval3:trainingQ`` and ``middeval3:trainingH``.

    Args:
        root: a folder with several releases, one release, a folder of scenes, or one scene's folder.
        scenes: names to select, without regard to case: ``cones``, or ``middlebury-2003/cones`` where several releases
            have a scene of that name; a bare name selects all of them. None takes every pair.
        gt_scale: stored value / gt_scale = disparity in px, for the 8-bit maps of Middlebury 2001-2006. It replaces the
            scale that release and size tell; maps whose format fixes the scale (PFM, KITTI) keep theirs.
        sample_bits: bits in use of views that store 16 bits per sample and do not tell, as
            :func:`~tensor_stereo.datasets.read_image` takes them.

    Returns:
        Pairs sorted by (dataset, scene without case, path).

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        TypeError: if ``scenes`` is one string, or ``sample_bits`` no integer.
        ValueError: if no pair is found (lists what was looked for), a scene is missing (lists those found), ``scenes``
            is empty, ``gt_scale`` is not positive, ``sample_bits`` lies outside of [8, 16], a scene is incomplete, or
            the scale of a selected map is open and ``gt_scale`` is None (the message asks for ``--gt-scale``).

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     for scene in ("Art", "my_scene"):
    ...         Path(root, scene).mkdir()
    ...         for name in ("view1.ppm", "view5.ppm", "disp1.pgm"):
    ...             _ = Path(root, scene, name).write_bytes(b"P6 64 48 255 ")
    ...     [(pair.dataset, pair.scene, pair.gt_scale) for pair in find_pairs(root, scenes=["art"])]
    [('middlebury-2005', 'Art', 3.0)]
    """
    check_gt_scale(gt_scale)
    check_sample_bits(sample_bits)
    pairs = collect_pairs(root, _READERS)
    if not pairs:
        raise ValueError(f"no stereo pairs in {root} or below; looked for these layouts:\n{_EXPECTED}")
    pairs = _tell_apart(pairs, Path(root))
    if scenes is not None:
        pairs = _select(pairs, scenes)
    if sample_bits is not None:
        pairs = [replace(pair, sample_bits=int(sample_bits)) for pair in pairs]
    if gt_scale is not None:
        return [replace(pair, gt_scale=gt_scale) if _has_release_scale(pair) else pair for pair in pairs]
    for pair in pairs:
        if pair.disparity_gt is not None and pair.gt_scale is None:
            raise missing_scale(pair)
    return pairs


def find_scale(image0: Path, disparity_gt: Path) -> float | None:
    """Stored value / px of disparity of a map of a known release, by the same rule as :func:`find_pairs`.

    Args:
        image0: Image of view 0.
        disparity_gt: Map of the same pair.

    Returns:
        The scale; None if no release knows these files as one pair, or none tells its scale.

    >>> find_scale(Path("no/such/view1.png"), Path("no/such/disp1.png")) is None
    True
    """
    for folder in list(image0.absolute().parents)[:3]:
        for reader in _READERS:
            try:
                pairs = reader(folder)
            except (ValueError, OSError):  # no complete scene of this release
                continue
            for pair in pairs:
                maps = (pair.disparity_gt, pair.disparity_noc_gt)
                if _is_same(pair.image0, image0) and any(_is_same(path, disparity_gt) for path in maps):
                    return pair.gt_scale
    return None


def _is_same(path: Location | None, other: Path) -> bool:
    return isinstance(path, Path) and path.is_file() and other.is_file() and path.samefile(other)


def _tell_apart(pairs: Sequence[PairFiles], root: Path) -> list[PairFiles]:
    """Append the folder above the scene to the dataset of pairs that share dataset and scene."""
    counts = Counter((pair.dataset, pair.scene) for pair in pairs)
    told = []
    for pair in pairs:
        if counts[pair.dataset, pair.scene] > 1:
            folder = Path(pair.image0).parent.parent.relative_to(root).as_posix()
            pair = replace(pair, dataset=f"{pair.dataset}:{folder}")
        told.append(pair)
    return sorted(told, key=lambda pair: (pair.dataset, pair.scene.casefold()))


def _select(pairs: Sequence[PairFiles], scenes: Iterable[str]) -> list[PairFiles]:
    if isinstance(scenes, str):
        raise TypeError(f"scenes must be a sequence of names, got the string {scenes!r}")
    wanted = {name.casefold(): name for name in scenes}
    if not wanted:
        raise ValueError("scenes must name at least one scene, or be None for all")
    names = [{pair.scene.casefold(), f"{pair.dataset}/{pair.scene}".casefold()} for pair in pairs]
    missing = [name for key, name in wanted.items() if not any(key in own for own in names)]
    if missing:
        found = ", ".join(sorted({pair.scene for pair in pairs}, key=str.casefold))
        raise ValueError(f"scenes not found: {', '.join(missing)}; found: {found}")
    return [pair for pair, own in zip(pairs, names, strict=True) if not own.isdisjoint(wanted)]


def _has_release_scale(pair: PairFiles) -> bool:
    is_map = pair.disparity_gt is not None and not has_ending(Path(pair.disparity_gt), ".pfm")
    return is_map and pair.gt_encoding == "scaled" and not pair.dataset.startswith("kitti")
