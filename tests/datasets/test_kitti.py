from __future__ import annotations

import pytest

from tensor_stereo.datasets.kitti import find_kitti

FRAMES = ("000000_10", "000000_11", "000001_10", "000001_11")


def write_benchmark(write_scene, folder, images, maps=()):
    for name in images:
        write_scene(folder / name, " ".join(f"{frame}.png" for frame in FRAMES))
    for name in maps:
        write_scene(folder / name, " ".join(f"{frame}.png" for frame in FRAMES if frame.endswith("_10")))


def test_kitti_2015_takes_the_frames_with_ground_truth(tmp_path, write_scene):
    training = tmp_path / "training"
    write_benchmark(write_scene, training, ["image_2", "image_3"], ["disp_occ_0", "disp_noc_0"])
    pairs = find_kitti(tmp_path)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [("kitti-2015", "000000_10"), ("kitti-2015", "000001_10")]
    assert pairs[1].image0 == training / "image_2" / "000001_10.png"
    assert pairs[1].image1 == training / "image_3" / "000001_10.png"
    assert pairs[1].disparity_gt == training / "disp_occ_0" / "000001_10.png"
    assert pairs[1].disparity_noc_gt == training / "disp_noc_0" / "000001_10.png"
    assert pairs[1].gt_scale == 256


@pytest.mark.parametrize(
    ("images", "chosen"),
    [
        (["colored_0", "colored_1"], "colored_0"),
        (["image_0", "image_1"], "image_0"),
        (["image_0", "image_1", "colored_0", "colored_1"], "colored_0"),
    ],
)
def test_kitti_2012_prefers_colour(tmp_path, write_scene, images, chosen):
    write_benchmark(write_scene, tmp_path / "training", images, ["disp_occ"])
    pairs = find_kitti(tmp_path)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [("kitti-2012", "000000_10"), ("kitti-2012", "000001_10")]
    assert pairs[0].image0 == tmp_path / "training" / chosen / "000000_10.png"
    assert pairs[0].disparity_gt == tmp_path / "training" / "disp_occ" / "000000_10.png"
    assert (pairs[0].gt_scale, pairs[0].disparity_noc_gt) == (256, None)


def test_both_releases_in_one_folder_are_told_apart(tmp_path, write_scene):
    maps = ["disp_occ", "disp_occ_0"]
    write_benchmark(write_scene, tmp_path, ["image_0", "image_1", "image_2", "image_3"], maps)
    assert [pair.dataset for pair in find_kitti(tmp_path)] == ["kitti-2012"] * 2 + ["kitti-2015"] * 2


def test_testing_frames_have_no_ground_truth_and_a_name_of_their_own(tmp_path, write_scene):
    write_benchmark(write_scene, tmp_path / "testing", ["image_2", "image_3"])
    pairs = find_kitti(tmp_path)
    assert {pair.dataset for pair in pairs} == {"kitti-2015-testing"}
    assert [(pair.disparity_gt, pair.gt_scale) for pair in pairs] == [(None, None)] * 2


def test_frame_without_a_right_view_is_an_error(tmp_path, write_scene):
    write_benchmark(write_scene, tmp_path, ["image_2", "image_3"])
    (tmp_path / "image_3" / "000001_10.png").unlink()
    with pytest.raises(ValueError, match=r"image_2/000001_10\.png has no right view"):
        find_kitti(tmp_path)


def test_left_images_alone_are_no_pairs(tmp_path, write_scene):
    write_benchmark(write_scene, tmp_path, ["image_2"])
    assert find_kitti(tmp_path) == []


@pytest.mark.parametrize("root", [".", "kitti2015", "kitti2015/training"])
def test_frame_of_the_data_root(data_root, root):
    [pair] = find_kitti(data_root / root)
    assert (pair.dataset, pair.scene, pair.gt_scale) == ("kitti-2015", "000046_10", 256)
