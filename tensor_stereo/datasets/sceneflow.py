"""The Scene Flow data sets FlyingThings3D, Monkaa and Driving (Mayer et al., CVPR 2016).

Layout as published on https://lmb.informatik.uni-freiburg.de/resources/datasets/SceneFlowDatasets.en.html: a folder per
data set with ``frames_cleanpass`` and ``frames_finalpass`` (PNG) and ``disparity`` (PFM), and the same folders in each,
the innermost of which are ``left`` and ``right``.
"""

from __future__ import annotations

from pathlib import Path

from tensor_stereo.datasets.files import PairFiles, StrPath, collect_pairs, parent_names

_PASSES = ("cleanpass", "finalpass")
_NAMES = ("flyingthings3d", "monkaa", "driving")


def find_sceneflow(root: StrPath) -> list[PairFiles]:
    """Find the frames of the Scene Flow data sets in ``root`` and below; no image is opened.

    Both passes are taken, as data sets of their own (``monkaa-cleanpass``). The data set is named after the nearest
    folder whose name holds that of one of the three; else it is ``sceneflow``.

    Args:
        root: a folder with data sets, or one of them.

    Returns:
        Pairs sorted by (dataset, scene); a scene is the path of the frame, ``TRAIN/A/0000/0006``. Disparity maps are in
        px; None where there are none.

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
    pairs = []
    for kind in _PASSES:
        frames = folder / f"frames_{kind}"
        for image0 in sorted(frames.glob("**/left/*.png")):
            inner = image0.parent.parent.relative_to(frames)
            image1 = frames / inner / "right" / image0.name
            if not image1.is_file():
                raise ValueError(f"{image0} has no right view: {image1} is missing")
            disparity = folder / "disparity" / inner / "left" / f"{image0.stem}.pfm"
            pairs.append(
                PairFiles(
                    dataset=f"{_dataset(folder)}-{kind}",
                    scene=(inner / image0.stem).as_posix(),
                    image0=image0,
                    image1=image1,
                    disparity_gt=disparity if disparity.is_file() else None,
                    gt_scale=1.0 if disparity.is_file() else None,
                )
            )
    return pairs


def _dataset(folder: Path) -> str:
    above = (name.casefold() for name in parent_names(folder))
    return next((known for name in above for known in _NAMES if known in name), "sceneflow")
