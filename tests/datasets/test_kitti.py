from __future__ import annotations

import pytest

from tensor_stereo.datasets import find_pairs, read_pair
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


def test_map_of_visible_pixels_is_the_ground_truth_where_it_is_alone(tmp_path, write_scene):
    write_benchmark(write_scene, tmp_path / "training", ["image_2", "image_3"], ["disp_noc_0"])
    for pair in find_kitti(tmp_path):
        assert pair.disparity_gt == tmp_path / "training" / "disp_noc_0" / f"{pair.scene}.png"
        assert (pair.gt_scale, pair.disparity_noc_gt) == (256, None)


def test_frames_without_occluded_pixels_are_found_and_read(data_root):
    root = data_root.parent / "training_data" / "kitti2015"
    if not root.is_dir():
        pytest.skip(f"there are no frames of KITTI 2015 in {root}")
    pairs = find_pairs(root)
    assert {pair.dataset for pair in pairs} == {"kitti-2015"}
    pair = read_pair(pairs[0])
    assert pair.occluded is None
    assert pair.disparity_gt[~pair.disparity_gt.isnan()].max() < 256


RAW = "2011_09_26/2011_09_26_drive_0001_sync"


@pytest.mark.parametrize(
    ("cameras", "chosen"),
    [
        (("image_02", "image_03"), "image_02"),
        (("image_00", "image_01"), "image_00"),
        (("image_00", "image_01", "image_02", "image_03"), "image_02"),
        (("image_00", "image_01", "image_02"), "image_00"),
    ],
)
@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("root", [".", "2011_09_26", RAW])
def test_raw_data_are_pairs_without_truth(tmp_path, write_scene, cameras, chosen, ending, root):
    for camera in cameras:
        write_scene(tmp_path / RAW / camera / "data", f"0000000000.{ending} 0000000107.{ending}")
    pairs = find_pairs(tmp_path / root)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [
        ("kitti-raw", "2011_09_26_drive_0001_sync/0000000000"),
        ("kitti-raw", "2011_09_26_drive_0001_sync/0000000107"),
    ]
    assert (
        pairs[0].image0.relative_to(tmp_path / root)
        == (tmp_path / RAW / chosen).relative_to(tmp_path / root) / "data" / f"0000000000.{ending}"
    )
    assert pairs[0].image1.parent.parent.name == chosen[:-1] + str(int(chosen[-1]) + 1)
    assert (pairs[0].disparity_gt, pairs[0].gt_scale) == (None, None)


def test_raw_data_that_are_not_rectified_are_left_out_and_said_to_be(tmp_path, write_scene):
    for camera in ("image_02", "image_03"):
        folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_extract" / camera / "data"
        write_scene(folder, "0000000000.png")
    assert find_kitti(tmp_path) == []
    with pytest.raises(ValueError, match=r"_extract is not rectified"):
        find_pairs(tmp_path)


@pytest.mark.parametrize(
    ("cameras", "chosen"), [((2, 3), "image_2"), ((0, 1), "image_0"), ((0, 1, 2, 3), "image_2"), ((0, 1, 2), "image_0")]
)
def test_odometry_is_pairs_without_truth(tmp_path, write_scene, cameras, chosen):
    for sequence in ("00", "21"):
        for camera in cameras:
            write_scene(tmp_path / "dataset" / "sequences" / sequence / f"image_{camera}", "000000.png 000001.png")
    pairs = find_pairs(tmp_path)
    assert [pair.scene for pair in pairs] == ["00/000000", "00/000001", "21/000000", "21/000001"]
    assert {pair.dataset for pair in pairs} == {"kitti-odometry"}
    assert pairs[3].image0 == tmp_path / "dataset" / "sequences" / "21" / chosen / "000001.png"
    assert pairs[3].disparity_gt is None


def test_object_detection_has_a_name_of_its_own(tmp_path, write_scene):
    for part in ("training", "testing"):
        for camera in ("image_2", "image_3"):
            write_scene(tmp_path / part / camera, "000000.png")
    assert [(pair.dataset, pair.scene) for pair in find_pairs(tmp_path)] == [
        ("kitti-object", "testing/000000"),
        ("kitti-object", "training/000000"),
    ]


@pytest.mark.parametrize("folder", [RAW, "sequences/00"])
def test_frame_of_a_sequence_without_a_right_view_is_an_error(tmp_path, write_scene, folder):
    left, right, name = (
        ("image_02/data", "image_03/data", "0000000000.png") if folder == RAW else ("image_2", "image_3", "000000.png")
    )
    write_scene(tmp_path / folder / left, name)
    (tmp_path / folder / right).mkdir(parents=True)
    with pytest.raises(ValueError, match=rf"{name} has no right view"):
        find_pairs(tmp_path)
