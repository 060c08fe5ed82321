from __future__ import annotations

import pytest

from tensor_stereo.datasets.eth3d import find_eth3d, is_eth3d_scene

NAMES = "im0.png im1.png disp0GT.pfm mask0nocc.png calib.txt"


@pytest.mark.parametrize(
    "path", ["eth3d/two_view_training/hall", "ETH3D/hall", "two_view_training/hall", "flat/forest_2s"]
)
def test_scene_is_known_by_its_folders_or_its_name(tmp_path, write_scene, path):
    folder = write_scene(tmp_path / path, NAMES)
    [pair] = find_eth3d(tmp_path)
    assert (pair.dataset, pair.scene, pair.gt_scale) == ("eth3d", folder.name, 1)
    assert (pair.image0, pair.image1, pair.disparity_gt) == (
        folder / "im0.png",
        folder / "im1.png",
        folder / "disp0GT.pfm",
    )
    assert (pair.mask, pair.calibration) == (folder / "mask0nocc.png", folder / "calib.txt")


def test_ground_truth_may_lie_in_the_folder_of_its_archive(tmp_path, write_scene):
    write_scene(tmp_path / "two_view_training" / "forest_1s", "im0.png im1.png calib.txt")
    truth = write_scene(tmp_path / "two_view_training_gt" / "forest_1s", "disp0GT.pfm mask0nocc.png")
    [pair] = find_eth3d(tmp_path)
    assert (pair.disparity_gt, pair.mask, pair.gt_scale) == (truth / "disp0GT.pfm", truth / "mask0nocc.png", 1)


def test_test_scenes_have_no_ground_truth(tmp_path, write_scene):
    write_scene(tmp_path / "two_view_test" / "tunnel_1l", "im0.png im1.png calib.txt")
    [pair] = find_eth3d(tmp_path)
    assert (pair.disparity_gt, pair.gt_scale, pair.mask) == (None, None, None)


@pytest.mark.parametrize(
    "path", ["MiddEval3/trainingQ/Vintage", "scenes2014/Piano-perfect", "scenes2021/data/artroom1"]
)
def test_middlebury_is_not_taken_for_eth3d(tmp_path, write_scene, path):
    write_scene(tmp_path / path, NAMES)
    assert not is_eth3d_scene(tmp_path / path)
    assert find_eth3d(tmp_path) == []


def test_half_a_scene_is_an_error(tmp_path, write_scene):
    write_scene(tmp_path / "forest_1s", "im1.png disp0GT.pfm")
    with pytest.raises(ValueError, match=r"forest_1s holds disp0GT\.pfm and one view, but not the other: no im0\.png"):
        find_eth3d(tmp_path)


@pytest.mark.parametrize("root", [".", "eth3d", "eth3d/two_view_training", "eth3d/two_view_training/playground_1l"])
def test_scene_of_the_data_root(data_root, root):
    [pair] = find_eth3d(data_root / root)
    assert (pair.dataset, pair.scene, pair.gt_scale) == ("eth3d", "playground_1l", 1)
