from __future__ import annotations

import os
import subprocess
import sys

import pytest

import tensor_stereo.datasets
from tensor_stereo.datasets import find_pairs
from tensor_stereo.datasets.files import MAX_DEPTH

PAPER = ("Art", "Books", "Cones", "Dolls", "Laundry", "Moebius", "Reindeer", "Teddy")
NEW, OLD, FLOAT = "view1.png view5.png disp1.png", "im2.png im6.png disp2.png", "im0.png im1.png disp0GT.pfm"


def labels(pairs):
    return [(pair.dataset, pair.scene, pair.gt_scale) for pair in pairs]


def test_data_root_holds_26_pairs_in_a_fixed_order(data_root):
    pairs = find_pairs(data_root)
    assert len(pairs) == 26
    assert len({(pair.dataset, pair.scene) for pair in pairs}) == 26
    assert labels(pairs) == sorted(labels(pairs), key=lambda label: (label[0], label[1].casefold()))
    assert all(pair.disparity_gt is not None for pair in pairs)
    assert pairs == find_pairs(str(data_root))


def test_scenes_of_the_paper_have_the_published_scales(data_root):
    pairs = find_pairs(data_root, scenes=PAPER)
    assert [pair.scene for pair in pairs] == [
        "cones",
        "teddy",
        "Art",
        "Books",
        "Dolls",
        "Laundry",
        "Moebius",
        "Reindeer",
    ]
    assert [pair.gt_scale for pair in pairs] == [4, 4, 3, 3, 3, 3, 3, 3]


def test_releases_below_one_root_are_all_found(tmp_path, write_scene):
    write_scene(tmp_path / "middlebury" / "2003" / "cones", OLD, width=450)
    write_scene(tmp_path / "middlebury" / "2005" / "Art", NEW, width=463)
    write_scene(tmp_path / "MiddEval3" / "trainingQ" / "Piano", FLOAT)
    write_scene(tmp_path / "eth3d" / "forest_1s", FLOAT)
    write_scene(tmp_path / "kitti" / "training" / "image_2", "000000_10.png")
    write_scene(tmp_path / "kitti" / "training" / "image_3", "000000_10.png")
    assert labels(find_pairs(tmp_path)) == [
        ("eth3d", "forest_1s", 1),
        ("kitti-2015", "000000_10", None),
        ("middeval3", "Piano", 1),
        ("middlebury-2003", "cones", 4),
        ("middlebury-2005", "Art", 3),
    ]


def test_one_name_in_several_releases_selects_them_all(tmp_path, write_scene):
    write_scene(tmp_path / "2003" / "teddy", OLD, width=450)
    write_scene(tmp_path / "MiddEval3" / "trainingQ" / "Teddy", FLOAT)
    both = [("middeval3", "Teddy", 1), ("middlebury-2003", "teddy", 4)]
    assert labels(find_pairs(tmp_path, scenes=["TEDDY"])) == both
    assert labels(find_pairs(tmp_path, scenes=["middlebury-2003/Teddy"])) == both[1:]


def test_one_scene_in_several_sizes_gets_datasets_of_its_own(tmp_path, write_scene):
    for size in "QH":
        write_scene(tmp_path / "MiddEval3" / f"training{size}" / "Teddy", FLOAT)
    write_scene(tmp_path / "MiddEval3" / "trainingQ" / "Piano", FLOAT)
    assert labels(find_pairs(tmp_path)) == [
        ("middeval3", "Piano", 1),
        ("middeval3:MiddEval3/trainingH", "Teddy", 1),
        ("middeval3:MiddEval3/trainingQ", "Teddy", 1),
    ]


def test_missing_scenes_are_listed_with_those_found(tmp_path, write_scene):
    write_scene(tmp_path / "2005" / "Books", NEW, width=463)
    write_scene(tmp_path / "2005" / "Art", NEW, width=463)
    with pytest.raises(ValueError, match="scenes not found: Aart, Bookz; found: Art, Books"):
        find_pairs(tmp_path, scenes=["Aart", "art", "Bookz"])


def test_selection_must_be_names(tmp_path, write_scene):
    write_scene(tmp_path / "2005" / "Art", NEW, width=463)
    with pytest.raises(TypeError, match="scenes must be a sequence of names"):
        find_pairs(tmp_path, scenes="Art")
    with pytest.raises(ValueError, match="at least one scene"):
        find_pairs(tmp_path, scenes=[])


def test_unknown_layout_lists_what_was_looked_for(tmp_path, write_scene):
    write_scene(tmp_path / "mine", "left.png right.png")
    with pytest.raises(ValueError, match="no stereo pairs in") as error:
        find_pairs(tmp_path)
    for name in (
        str(tmp_path),
        "view1, view5, disp1",
        "im2, im6, disp2",
        "disp0GT.pfm",
        "image_2, image_3, disp_occ_0",
    ):
        assert name in str(error.value)


def test_root_must_be_a_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        find_pairs(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file is a file"):
        find_pairs(tmp_path / "file")


def test_open_scale_asks_for_gt_scale(tmp_path, write_scene):
    folder = write_scene(tmp_path / "chair", OLD, width=640)
    with pytest.raises(ValueError, match="--gt-scale") as error:
        find_pairs(tmp_path)
    assert str(folder / "disp2.png") in str(error.value)
    assert labels(find_pairs(tmp_path, gt_scale=5)) == [("middlebury", "chair", 5)]


def test_open_scale_of_a_scene_not_selected_does_not_matter(tmp_path, write_scene):
    write_scene(tmp_path / "chair", OLD, width=640)
    write_scene(tmp_path / "teddy", OLD, width=450)
    assert labels(find_pairs(tmp_path, scenes=["teddy"])) == [("middlebury-2003", "teddy", 4)]


def test_gt_scale_replaces_only_scales_that_a_release_chose(tmp_path, write_scene):
    write_scene(tmp_path / "teddy", OLD, width=450)
    write_scene(tmp_path / "forest_1s", FLOAT)
    for name in ("image_2", "image_3", "disp_occ_0"):
        write_scene(tmp_path / "training" / name, "000000_10.png")
    assert labels(find_pairs(tmp_path, gt_scale=2.5)) == [
        ("eth3d", "forest_1s", 1),
        ("kitti-2015", "000000_10", 256),
        ("middlebury-2003", "teddy", 2.5),
    ]


@pytest.mark.parametrize("gt_scale", [0, -1, float("nan"), float("inf")])
def test_gt_scale_must_be_positive(tmp_path, gt_scale):
    with pytest.raises(ValueError, match="--gt-scale"):
        find_pairs(tmp_path, gt_scale=gt_scale)


def test_links_that_form_a_loop_end_the_walk(tmp_path, write_scene):
    write_scene(tmp_path / "data" / "teddy", OLD, width=450)
    (tmp_path / "data" / "again").symlink_to(tmp_path, target_is_directory=True)
    assert labels(find_pairs(tmp_path)) == [("middlebury-2003", "teddy", 4)]


def test_hidden_and_too_deep_folders_are_not_searched(tmp_path, write_scene):
    write_scene(tmp_path / "teddy", OLD, width=450)
    write_scene(tmp_path / ".cache" / "cones", OLD, width=450)
    write_scene(tmp_path / "__MACOSX" / "cones", OLD, width=450)
    deep = tmp_path.joinpath(*"abcdef"[:MAX_DEPTH])
    write_scene(deep / "cones", OLD, width=450)
    assert [pair.scene for pair in find_pairs(tmp_path)] == ["teddy"]
    assert [pair.scene for pair in find_pairs(tmp_path / "a")] == ["cones"]


def test_scene_folders_are_not_searched_further(tmp_path, write_scene):
    scene = write_scene(tmp_path / "teddy", OLD, width=450)
    write_scene(scene / "results" / "cones", OLD, width=450)
    assert [pair.scene for pair in find_pairs(tmp_path)] == ["teddy"]


def test_order_does_not_depend_on_the_file_system(tmp_path, write_scene, monkeypatch):
    for scene in ("Books", "art", "Dolls"):
        write_scene(tmp_path / scene, NEW, width=463)
    forwards = find_pairs(tmp_path)
    scandir = os.scandir

    class Reversed(list):
        def __enter__(self):
            return self

        def __exit__(self, *error):
            return None

    monkeypatch.setattr(os, "scandir", lambda path: Reversed(reversed(list(scandir(path)))))
    assert find_pairs(tmp_path) == forwards
    assert [pair.scene for pair in forwards] == ["art", "Books", "Dolls"]


def test_finding_pairs_imports_no_heavy_library(tmp_path, write_scene):
    write_scene(tmp_path / "teddy", OLD, width=450)
    code = (
        "import sys; from tensor_stereo.datasets import find_pairs; find_pairs(sys.argv[1]);"
        "print(sorted({'torch', 'cv2', 'numpy', 'polars'} & sys.modules.keys()))"
    )
    path = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-c", code, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path})
    assert result.stdout.strip() == "[]"


def test_every_public_name_of_the_package_resolves():
    names = [
        name for name in dir(tensor_stereo.datasets) if name.startswith(("find_", "read_", "write_", "Pair", "Cal"))
    ]
    assert len(names) >= 14
    for name in names:
        assert getattr(tensor_stereo.datasets, name).__name__ == name
    with pytest.raises(AttributeError, match="nonsense"):
        _ = tensor_stereo.datasets.nonsense
