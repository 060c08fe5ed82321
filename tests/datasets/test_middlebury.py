from __future__ import annotations

from pathlib import Path

import pytest

from tensor_stereo.datasets.middlebury import find_middlebury
from tensor_stereo.datasets.middlebury_scales import find_release, folder_year, integer_scale

OLD = ("2001", "2003")  # im2, im6, disp2
NEW = ("2005", "2006")  # view1, view5, disp1


@pytest.mark.parametrize(
    ("path", "width", "years", "scale"),
    [
        # the folder is named for the release
        ("2001/venus", 434, OLD, 8),
        ("2001/somewhere", 434, OLD, 8),
        ("2001/tsukuba", 384, ("2001",), 16),
        ("2001/map", 284, ("2001",), 8),
        ("2003/cones", 450, OLD, 4),
        ("2003/cones", 900, OLD, 2),
        ("2003/cones", 1800, OLD, 1),
        ("2005/Art", 463, NEW, 3),
        ("scenes2005/Art", 695, NEW, 2),
        ("middlebury-2006/Aloe", 1282, NEW, 1),
        ("Middlebury_2006_HalfSize/Aloe", 641, NEW, 2),
        ("2005/HalfSize/zip-2views/Art", 695, NEW, 2),
        # only the scene's name tells it
        ("flat/poster", 435, OLD, 8),
        ("flat/Tsukuba", 384, ("2001",), 16),
        ("flat/TEDDY", 450, OLD, 4),
        ("flat/conesH", 900, OLD, 2),
        ("flat/teddyF", 1800, OLD, 1),
        ("flat/moebius", 463, NEW, 3),
        ("flat/Moebius", 695, NEW, 2),
        ("flat/Wood2", 1306, NEW, 1),
        # neither: view1 and view5 mean 2005 or 2006, and the size decides
        ("flat/Chair", 463, NEW, 3),
        ("HalfSize/Chair", 500, NEW, 2),
        ("ThirdSize/Chair", 64, NEW, 3),
        # cut out of the smallest size
        ("2003/cones", 64, OLD, 4),
        ("2005/Art", 64, NEW, 3),
        ("2005/FullSize/Art", 512, NEW, 1),
    ],
)
def test_scale_follows_release_and_size(tmp_path, path, width, years, scale):
    assert integer_scale(tmp_path / path, width=width, years=years) == scale


@pytest.mark.parametrize(
    ("path", "width", "years"),
    [
        ("flat/chair", 450, OLD),  # 2001 or 2003?
        ("flat/chair", 64, NEW),  # no published size
        ("flat/Art", 500, NEW),  # between third and half size: cut out of which?
        ("2003/teddy", 640, OLD),
        ("2001/venus", 868, OLD),
        ("2003/venus", 434, OLD),  # the folder says 4, the scene 8
        ("2005/HalfSize/Art", 463, NEW),  # the folder says 2, the width 3
        ("2005/HalfSize/Art", 1390, NEW),
        ("2005/HalfSize/Art", 800, NEW),  # wider than half size
        ("2003/conesH", 450, OLD),
        ("2003/ThirdSize/cones", 450, OLD),  # never published
    ],
)
def test_scale_is_open_where_nothing_tells_or_sources_disagree(tmp_path, path, width, years):
    assert integer_scale(tmp_path / path, width=width, years=years) is None


@pytest.mark.parametrize("name", ["run-2005", "2005-06-01", "pytest-2003", "12005", "20055", "photos2005", "", "2007"])
def test_other_folders_with_a_year_are_no_release(name):
    assert folder_year(name, years=["2003", "2005"]) is None


def test_nearest_release_folder_wins():
    assert find_release(Path("/2005/data/2006/Chair"), years=NEW) == "2006"
    assert find_release(Path("/2003/data/2006/Chair"), years=NEW) == "2006"
    assert find_release(Path("/2003/data/Chair"), years=NEW) is None


def test_release_folder_goes_before_the_scenes_name():
    assert find_release(Path("/data/2006/Art"), years=NEW) == "2006"


@pytest.mark.parametrize(
    ("scene", "names", "width", "dataset", "scale"),
    [
        ("2001/venus", "im2.png im6.png disp2.png disp6.png", 434, "middlebury-2001", 8),
        ("scenes2001/data/bull", "im2.ppm im6.ppm disp2.pgm disp6.pgm", 433, "middlebury-2001", 8),
        ("2001/map", "im0.pgm im1.pgm disp0.pgm disp1.pgm", 284, "middlebury-2001", 8),
        (
            "2001/tsukuba",
            "scene1.row3.col3.ppm scene1.row3.col4.ppm truedisp.row3.col3.pgm",
            384,
            "middlebury-2001",
            16,
        ),
        ("2003/cones", "im2.png im6.png disp2.png disp6.png", 450, "middlebury-2003", 4),
        ("scenes2003/teddyH", "im2.ppm im6.ppm disp2.pgm disp6.pgm", 900, "middlebury-2003", 2),
        ("2005/Art", "view1.png view5.png disp1.png disp5.png dmin.txt", 463, "middlebury-2005", 3),
        ("2006/HalfSize/Aloe", "view1.png view5.png disp1.png disp5.png", 641, "middlebury-2006", 2),
        ("Aloe", "view1.png view5.png disp1.png", 427, "middlebury-2006", 3),
        ("scenes2014/Adirondack", "im0.png im1.png disp0.pfm disp1.pfm calib.txt", 16, "middlebury-2014", 1),
        ("Adirondack-imperfect", "im0.png im1.png im1E.png disp0.pfm calib.txt", 16, "middlebury-2014", 1),
        ("2021/data/artroom1", "im0.png im1.png disp0.pfm calib.txt", 16, "middlebury-2021", 1),
        ("artroom1", "im0.png im1.png disp0.pfm calib.txt", 16, "middlebury-2021", 1),
        ("MiddEval3/trainingQ/Teddy", "im0.png im1.png disp0GT.pfm mask0nocc.png calib.txt", 16, "middeval3", 1),
        ("Vintage", "im0.png im1.png disp0GT.pfm calib.txt", 16, "middeval3", 1),
        ("chair", "im0.png im1.png disp0.pfm", 16, "middlebury", 1),
    ],
)
def test_every_release_is_read_from_its_own_layout(tmp_path, write_scene, scene, names, width, dataset, scale):
    folder = write_scene(tmp_path / scene, names, width=width)
    [pair] = find_middlebury(tmp_path)
    image0, image1, disparity = names.split()[:3] if "im1E" not in names else ("im0.png", "im1.png", "disp0.pfm")
    assert (pair.dataset, pair.scene, pair.gt_scale) == (dataset, folder.name, scale)
    assert (pair.image0, pair.image1, pair.disparity_gt) == (folder / image0, folder / image1, folder / disparity)
    assert pair.mask == (folder / "mask0nocc.png" if "mask" in names else None)
    assert pair.calibration == (folder / "calib.txt" if "calib" in names else None)


@pytest.mark.parametrize("path", ["2003/cones", "2003", "."])
def test_root_may_be_scene_release_or_above(tmp_path, write_scene, path):
    write_scene(tmp_path / "2003" / "cones", "im2.png im6.png disp2.png", width=450)
    [pair] = find_middlebury(tmp_path / path)
    assert (pair.dataset, pair.scene, pair.gt_scale) == ("middlebury-2003", "cones", 4)


def test_root_may_be_the_current_folder(tmp_path, write_scene, monkeypatch):
    monkeypatch.chdir(write_scene(tmp_path / "2003" / "cones", "im2.png im6.png disp2.png", width=450))
    [pair] = find_middlebury(".")
    assert (pair.dataset, pair.scene, pair.gt_scale) == ("middlebury-2003", "cones", 4)


def test_archives_of_nine_views_give_views_2_and_6(tmp_path, write_scene):
    names = " ".join(f"im{i}.ppm" for i in range(9))
    folder = write_scene(tmp_path / "cones", f"{names} disp2.pgm disp6.pgm", width=450)
    [pair] = find_middlebury(tmp_path)
    assert (pair.image0, pair.image1, pair.gt_scale) == (folder / "im2.ppm", folder / "im6.ppm", 4)


def test_nine_views_as_png_are_not_taken_for_2014(tmp_path, write_scene):
    folder = write_scene(tmp_path / "cones", "im0.png im1.png im2.png im6.png disp2.png", width=450)
    [pair] = find_middlebury(tmp_path)
    assert (pair.dataset, pair.image0) == ("middlebury-2003", folder / "im2.png")


def test_other_illuminations_are_no_scenes(tmp_path, write_scene):
    scene = write_scene(tmp_path / "Art", "view1.png view5.png disp1.png", width=463)
    write_scene(scene / "Illum1" / "Exp0", "view1.png view5.png", width=463)
    write_scene(tmp_path / "Books" / "Illum2" / "Exp1", "view1.png view5.png", width=463)
    assert [pair.scene for pair in find_middlebury(tmp_path)] == ["Art"]


def test_scenes_without_ground_truth_are_listed(tmp_path, write_scene):
    write_scene(tmp_path / "2005" / "Dwarves", "view1.png view5.png", width=463)
    write_scene(tmp_path / "MiddEval3" / "testQ" / "Crusade", "im0.png im1.png calib.txt")
    found = [(pair.dataset, pair.scene, pair.disparity_gt, pair.gt_scale) for pair in find_middlebury(tmp_path)]
    assert found == [("middeval3", "Crusade", None, None), ("middlebury-2005", "Dwarves", None, None)]


@pytest.mark.parametrize("names", ["view1.png disp1.png", "view5.png disp1.png"])
def test_half_a_scene_is_an_error(tmp_path, write_scene, names):
    write_scene(tmp_path / "Art", names, width=463)
    with pytest.raises(ValueError, match=r"Art holds disp1\.png and one view, but not the other: no view[15]\.png"):
        find_middlebury(tmp_path)


def test_a_view_without_a_readable_header_does_not_hide_the_pair_and_a_pair_without_any_is_named(tmp_path, write_scene):
    folder = write_scene(tmp_path / "Art", "view1.png view5.png disp1.png", width=463)
    (folder / "view1.png").write_bytes(b"")
    assert [pair.gt_scale for pair in find_middlebury(tmp_path)] == [3]  # told by the other files
    for name in ("view5.png", "disp1.png"):
        (folder / name).write_bytes(b"")
    with pytest.raises(ValueError, match=r"disp1\.png is empty"):
        find_middlebury(tmp_path)


def test_eth3d_scenes_are_left_to_their_reader(tmp_path, write_scene):
    write_scene(tmp_path / "eth3d" / "hall", "im0.png im1.png disp0GT.pfm")
    write_scene(tmp_path / "flat" / "forest_2s", "im0.png im1.png disp0GT.pfm")
    assert find_middlebury(tmp_path) == []


def test_releases_of_the_data_root(data_root):
    found = find_middlebury(data_root)
    scales = {"2001": 8, "2003": 4, "2005": 3, "2006": 3, "middeval3": 1}
    counts = dict.fromkeys(scales, 0)
    for pair in found:
        release = pair.dataset.removeprefix("middlebury-")
        assert pair.gt_scale == scales[release]
        counts[release] += 1
    assert counts == {"2001": 4, "2003": 2, "2005": 6, "2006": 10, "middeval3": 2}


def test_flat_copy_of_the_data_root_gives_the_same_scales(data_root, tmp_path):
    nested = find_middlebury(data_root / "middlebury")
    for pair in nested:
        (tmp_path / pair.scene).symlink_to(pair.image0.parent, target_is_directory=True)
    flat = find_middlebury(tmp_path)
    assert [(p.dataset, p.scene, p.gt_scale) for p in flat] == [(p.dataset, p.scene, p.gt_scale) for p in nested]
