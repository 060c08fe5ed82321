"""The Scene Flow data sets FlyingThings3D, Monkaa and Driving, and the subset of the first (Mayer et al., CVPR 2016).

Layout as published on https://lmb.informatik.uni-freiburg.de/resources/datasets/SceneFlowDatasets.en.html: a folder per
data set with ``frames_cleanpass`` and ``frames_finalpass`` (PNG; WebP in ``frames_cleanpass_webp`` and
``frames_finalpass_webp``) and ``disparity`` (PFM), and the same folders in each, the innermost of which are ``left``
and ``right``. The subset for DispNet and FlowNet 2.0 holds ``train`` and ``val``, each with ``image_clean``,
``image_final``, ``disparity`` and ``disparity_occlusions``, and ``left`` and ``right`` in each.

The subset stores the disparities of the left view with the sign of the optical flow to the right view: they are
negative, other than those of the full data sets. Its readers say so: aloception reads the maps as signed by the side of
the camera (alodataset/flyingthings3D_subset_dataset.py), and https://github.com/mli0603/stereo-transformer/issues/78
met negative maps of the left view only. Since https://github.com/ucbdrive/hd3/issues/27 reports positive maps, each map
is turned by its own values: see :func:`tensor_stereo.datasets.read_pair`.
"""

from __future__ import annotations

from pathlib import Path

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs, list_files, pair_frames, parent_names

_PASSES = ("cleanpass", "finalpass")
_FOLDERS = ("frames_{}", "frames_{}_webp")  # a frame that is in both is taken from the first
_NAMES = ("flyingthings3d", "monkaa", "driving")
_SUBSET = {"image_clean": "cleanpass", "image_final": "finalpass"}


def find_sceneflow(root: StrPath) -> list[PairFiles]:
    """Find the frames of the Scene Flow data sets in ``root`` and below; no image is opened.

    Both passes are taken, as data sets of their own (``monkaa-cleanpass``). The data set is named after the nearest
    folder whose name holds that of one of the three; else it is ``sceneflow``. The pairs of the subset of
    FlyingThings3D are ``flyingthings3d-subset-cleanpass`` and ``-finalpass``.

    Args:
        root: a folder with data sets, or one of them.

    Returns:
        Pairs sorted by (dataset, scene); a scene is the path of the frame, ``TRAIN/A/0000/0006``, in the subset
        ``train/0000006``. Disparity maps are in px; None where there are none. ``mask`` is the map of occluded pixels
        of the subset.

    Raises:
        FileNotFoundError, NotADirectoryError: if ``root`` is no folder.
        ValueError: if the right view of a frame is missing.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     for name in ("frames_cleanpass/a_rain/left", "frames_cleanpass/a_rain/right", "disparity/a_rain/left"):
    ...         Path(root, "Monkaa", name).mkdir(parents=True)
    ...         Path(root, "Monkaa", name, "0001.pfm" if name.startswith("disp") else "0001.png").touch()
    ...     [pair] = find_sceneflow(root)
    >>> pair.dataset, pair.scene, pair.disparity_gt.name
    ('monkaa-cleanpass', 'a_rain/0001', '0001.pfm')
    """
    return collect_pairs(root, [sceneflow_pairs])


def sceneflow_pairs(folder: Path) -> list[PairFiles]:
    """Return the pairs of the data set whose folders of frames lie directly in ``folder``.

    >>> sceneflow_pairs(Path("no/such/folder"))
    []
    """
    pairs: dict[tuple[str, str], PairFiles] = {}
    for kind in _PASSES:
        for frames in (folder / name.format(kind) for name in _FOLDERS):
            for left in sorted(frames.rglob("left")):
                inner = left.parent.relative_to(frames)
                maps = list_files(folder / "disparity" / inner / "left")
                for stem, image0, image1 in pair_frames(left, left.with_name("right")):
                    disparity = maps.get(f"{stem}.pfm".casefold())
                    pair = PairFiles(
                        dataset=f"{_dataset(folder)}-{kind}",
                        scene=(inner / stem).as_posix(),
                        image0=image0,
                        image1=image1,
                        disparity_gt=disparity,
                        gt_scale=None if disparity is None else 1.0,
                    )
                    pairs.setdefault((pair.dataset, pair.scene), pair)
    return [*pairs.values(), *_subset_pairs(folder)]


def _subset_pairs(folder: Path) -> list[PairFiles]:
    """The pairs of FlyingThings3D's subset, if ``folder`` is its ``train`` or ``val``."""
    pairs = []
    for name, kind in _SUBSET.items():
        frames = pair_frames(folder / name / "left", folder / name / "right")
        if not frames:
            continue
        maps, masks = (list_files(folder / part / "left") for part in ("disparity", "disparity_occlusions"))
        for stem, image0, image1 in frames:
            disparity = maps.get(f"{stem}.pfm".casefold())
            pairs.append(
                PairFiles(
                    dataset=f"flyingthings3d-subset-{kind}",
                    scene=f"{parent_names(folder)[0]}/{stem}",
                    image0=image0,
                    image1=image1,
                    disparity_gt=disparity,
                    gt_scale=None if disparity is None else 1.0,
                    mask=masks.get(f"{stem}.png".casefold()),
                    gt_encoding="flyingthings3d-subset",
                )
            )
    return pairs


def _dataset(folder: Path) -> str:
    above = (name.casefold() for name in parent_names(folder))
    return next((known for name in above for known in _NAMES if known in name), "sceneflow")
