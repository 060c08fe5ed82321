"""Views may have any ending of images, in any case, in every reader."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tensor_stereo.datasets import build_manifest, find_pairs, read_manifest, read_pair, write_manifest, write_pfm
from tensor_stereo.datasets.files import IMAGE_ENDINGS, list_files, list_frames

SHAPE = (12, 16)
LAYOUTS = {  # left view, right view, map, mask
    "middlebury-2014": ("2014/Adirondack-perfect/im0", "im1", "2014/Adirondack-perfect/disp0.pfm", None),
    "middlebury-2003": ("2003/QuarterSize/cones/im2", "im6", "2003/QuarterSize/cones/disp2.png", None),
    "middlebury-2005": ("2005/ThirdSize/Art/view1", "view5", "2005/ThirdSize/Art/disp1.png", None),
    "middeval3": ("MiddEval3/trainingQ/Art/im0", "im1", "MiddEval3/trainingQ/Art/disp0GT.pfm", "mask0nocc.png"),
    "eth3d": ("two_view_training/forest_1s/im0", "im1", "two_view_training_gt/forest_1s/disp0GT.pfm", "mask0nocc.png"),
    "kitti-2015": ("training/image_2/000000_10", "../image_3/000000_10", "training/disp_occ_0/000000_10.png", None),
    "monkaa-cleanpass": (
        "Monkaa/frames_cleanpass/x/left/0001",
        "../right/0001",
        "Monkaa/disparity/x/left/0001.pfm",
        None,
    ),
    "flyingthings3d-subset-cleanpass": (
        "train/image_clean/left/0000000",
        "../right/0000000",
        "train/disparity/left/0000000.pfm",
        "../../disparity_occlusions/left/0000000.png",
    ),
    "sintel-clean": (
        "training/clean_left/alley_1/frame_0001",
        "../../clean_right/alley_1/frame_0001",
        "training/disparities/alley_1/frame_0001.png",
        "../../occlusions/alley_1/frame_0001.png",
    ),
}


def _write(path: Path, pixels: np.ndarray, capitals: bool) -> Path:
    """Write an image or map; with its ending in capitals if asked for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    target = path.with_suffix(path.suffix.upper()) if capitals else path
    if path.suffix == ".pfm":
        write_pfm(target, pixels.astype(np.float32))
    else:
        target.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return target


def _scene(root: Path, dataset: str, ending: str, capitals: bool) -> list[Path | None]:
    left, right, disparity, mask = LAYOUTS[dataset]
    rng = np.random.default_rng(0)
    grey = ending == ".pgm"
    views = [
        _write(
            (root / (left + ending)).parent / name,
            rng.integers(0, 256, SHAPE if grey else (*SHAPE, 3), np.uint8),
            capitals,
        )
        for name in (Path(left).name + ending, right + ending)
    ]
    deep = dataset.startswith("kitti")
    values = np.full(SHAPE, 512 if deep else 8, np.uint16 if deep else np.uint8)
    if dataset.startswith("sintel"):
        values = np.repeat(values[..., None], 3, axis=2)
    paths = [*views, _write(root / disparity, values, capitals)]
    folder = (root / disparity).parent
    paths.append(None if mask is None else _write(folder / mask, np.full(SHAPE, 255, np.uint8), capitals))
    return [None if path is None else path.resolve() for path in paths]


@pytest.mark.parametrize("capitals", [False, True], ids=["small", "capitals"])
@pytest.mark.parametrize("ending", IMAGE_ENDINGS)
@pytest.mark.parametrize("dataset", LAYOUTS)
def test_every_reader_takes_views_of_every_ending(tmp_path, dataset, ending, capitals):
    root = tmp_path.resolve()
    expected = _scene(root, dataset, ending, capitals)
    write_manifest(build_manifest([root]), tmp_path / "m.parquet")
    [files] = read_manifest(tmp_path / "m.parquet")
    assert files.dataset == dataset
    assert [files.image0, files.image1, files.disparity_gt, files.mask] == expected
    pair = read_pair(files)
    assert pair.image0.shape == ((1 if ending == ".pgm" else 3), *SHAPE)
    assert pair.disparity_gt is not None
    assert not pair.disparity_gt.isnan().any()


@pytest.mark.parametrize("name", ["D.PFM", "d.Pfm"])
def test_a_float_map_of_any_case_needs_no_scale_in_a_list(tmp_path, name):
    for view in ("a.JPG", "b.jpeg"):
        (tmp_path / view).write_bytes(cv2.imencode(".jpg", np.zeros((*SHAPE, 3), np.uint8))[1].tobytes())
    write_pfm(tmp_path / name, np.full(SHAPE, 2, np.float32))
    (tmp_path / "LIST.CSV").write_text(f"image0,image1,disparity_gt\na.JPG,b.jpeg,{name}\n")
    write_manifest(build_manifest([tmp_path / "LIST.CSV"]), tmp_path / "M.PARQUET")
    assert (read_pair(read_manifest(tmp_path / "M.PARQUET")[0]).disparity_gt == 2).all()


def test_a_lossless_view_is_preferred_and_small_letters_are(tmp_path):
    for name in ("im0.jpg", "im0.png", "im0.PNG", "im1.tif", "im1.webp", "notes.txt"):
        (tmp_path / name).touch()
    if len(list(tmp_path.iterdir())) < 6:
        pytest.skip("the file system does not tell small letters from capitals")
    assert list_files(tmp_path)["im0.png"] == tmp_path / "im0.png"
    assert list_frames(tmp_path) == {"im0": tmp_path / "im0.png", "im1": tmp_path / "im1.tif"}


def test_lossy_images_are_no_ground_truth(tmp_path):
    for name in ("view1.jpg", "view5.jpg", "disp1.jpg"):
        (tmp_path / name).write_bytes(cv2.imencode(".jpg", np.zeros(SHAPE, np.uint8))[1].tobytes())
    [pair] = find_pairs(tmp_path)
    assert pair.disparity_gt is None
