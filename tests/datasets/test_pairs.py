from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch.utils.data import DataLoader

from tensor_stereo.datasets import PairDataset, PairFiles, find_pairs, read_pair, write_pfm

# width, height; from the releases
SIZES = {
    "barn1": (432, 381),
    "poster": (435, 383),
    "sawtooth": (434, 380),
    "venus": (434, 383),
    "cones": (450, 375),
    "teddy": (450, 375),
    "Art": (463, 370),
    "Books": (463, 370),
    "Dolls": (463, 370),
    "Laundry": (447, 370),
    "Moebius": (463, 370),
    "Reindeer": (447, 370),
    "Aloe": (427, 370),
    "Baby1": (413, 370),
    "Cloth1": (417, 370),
    "Flowerpots": (437, 370),
    "Lampshade1": (433, 370),
    "Midd1": (465, 370),
    "Monopoly": (443, 370),
    "Plastic": (423, 370),
    "Rocks1": (425, 370),
    "Wood1": (457, 370),
    "Recycle": (720, 486),
    "Vintage": (722, 480),
    "000046_10": (1242, 375),
    "playground_1l": (941, 490),
}
PAPER = ("Art", "Books", "cones", "Dolls", "Laundry", "Moebius", "Reindeer", "teddy")


def photo_consistency(pair, disparities):
    """Correlation of view 0 with view 1 fetched through each disparity map, over the pixels that have one.

    The grey levels are taken without their local mean, which frees the comparison from exposure.
    """
    grey = torch.stack([pair.image0, pair.image1]).float().mean(1)
    view0, view1 = grey - F.avg_pool2d(grey, 9, stride=1, padding=4)
    width = view0.shape[1]
    results = []
    for disparity in disparities:
        row, column = (~disparity.isnan()).nonzero(as_tuple=True)
        x = column - disparity[row, column]
        inside = (x >= 0) & (x <= width - 1)
        row, column, x = row[inside], column[inside], x[inside]
        left = x.long().clamp(max=width - 2)
        fetched = torch.lerp(view1[row, left], view1[row, left + 1], x - left)
        results.append(torch.corrcoef(torch.stack([fetched, view0[row, column]]))[0, 1].item())
    return results


@pytest.mark.parametrize("dataset", ["eth3d", "kitti", "middeval3", "middlebury-2001", "middlebury-2006"])
def test_ground_truth_explains_view_1_better_than_any_other_scale_shift_or_orientation(data_root, dataset):
    pairs = PairDataset([files for files in find_pairs(data_root) if files.dataset.startswith(dataset)])
    assert len(pairs) > 0
    for pair in pairs:
        truth = pair.disparity_gt
        wrong = [0.5 * truth, 0.9 * truth, 1.1 * truth, 2 * truth, truth - 1.5, truth + 1.5, truth.flip(0)]
        right, *others = photo_consistency(pair, [truth, *wrong])
        assert right > max(others) + 0.03, pair.name  # the near one is ETH3D's, whose disparities end at 20 px


def test_consistency_of_the_papers_scenes_halves_at_ten_percent_off_the_scale(data_root):
    for pair in PairDataset(find_pairs(data_root, scenes=PAPER)):
        truth = pair.disparity_gt
        right, smaller, larger = photo_consistency(pair, [truth, 0.9 * truth, 1.1 * truth])
        assert right > 1.8 * max(smaller, larger), pair.name


def test_every_pair_of_the_data_root_has_the_form_of_a_stereo_pair(data_root):
    pairs = list(PairDataset(find_pairs(data_root)))
    assert {pair.name for pair in pairs} == SIZES.keys()
    for pair in pairs:
        width, height = SIZES[pair.name]
        assert pair.image0.shape == pair.image1.shape == (3, height, width)
        assert pair.image0.dtype == pair.image1.dtype == torch.uint8
        assert pair.disparity_gt.shape == (height, width)
        assert pair.disparity_gt.dtype == torch.float32
        known = pair.disparity_gt[~pair.disparity_gt.isnan()]
        assert len(known) > 0.1 * pair.disparity_gt.numel()  # KITTI's laser scans are the sparsest
        assert ((known > 0) & (known < 0.5 * width)).all()  # also: no infinity is left


def test_occluded_pixels_come_from_the_mask_and_match_worse(data_root):
    for pair in PairDataset(find_pairs(data_root, scenes=["Vintage", "Recycle"])):
        assert pair.occluded.dtype == torch.bool
        assert not (pair.occluded & pair.disparity_gt.isnan()).any()
        truth = pair.disparity_gt
        visible, hidden = truth.masked_fill(pair.occluded, torch.nan), truth.masked_fill(~pair.occluded, torch.nan)
        consistency_visible, consistency_hidden = photo_consistency(pair, [visible, hidden])
        assert consistency_visible > consistency_hidden + 0.3


def test_releases_without_a_mask_have_none(data_root):
    for pair in PairDataset(find_pairs(data_root, scenes=["cones", "Art", "000046_10", "venus"])):
        assert pair.occluded is None


@pytest.fixture
def files(tmp_path):
    """A pair of 4 x 3 px with an 8-bit map, without a scale."""
    rng = np.random.default_rng(0)
    for name in ("view1.png", "view5.png"):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 256, (3, 4, 3), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "disp1.png"), np.array([[0, 3, 6, 7]] * 3, dtype=np.uint8))
    return PairFiles("middlebury", "chair", *(tmp_path / name for name in ("view1.png", "view5.png", "disp1.png")))


def test_integer_map_becomes_pixels_with_nan_for_unknown(files):
    pair = read_pair(replace(files, gt_scale=3.0))
    expected = torch.tensor([[torch.nan, 1, 2, 7 / 3]] * 3)
    torch.testing.assert_close(pair.disparity_gt, expected, rtol=0, atol=0, equal_nan=True)
    assert (pair.name, pair.dataset, pair.occluded) == ("chair", "middlebury", None)


def test_gt_scale_replaces_that_of_the_files(files):
    for with_scale in (files, replace(files, gt_scale=3.0)):
        assert read_pair(with_scale, gt_scale=6).disparity_gt[0, 1:].tolist() == [0.5, 1.0, np.float32(7 / 6)]


def test_open_scale_asks_for_gt_scale(files):
    with pytest.raises(ValueError, match=r"disp1\.png.*--gt-scale"):
        read_pair(files)


@pytest.mark.parametrize("gt_scale", [0, -1, float("nan")])
def test_gt_scale_must_be_positive(files, gt_scale):
    with pytest.raises(ValueError, match="--gt-scale"):
        read_pair(files, gt_scale=gt_scale)
    with pytest.raises(ValueError, match="--gt-scale"):
        PairDataset([files], gt_scale=gt_scale)


def test_pair_without_ground_truth_needs_no_scale(files):
    assert read_pair(replace(files, disparity_gt=None)).disparity_gt is None


def test_float_map_is_in_pixels_with_nan_for_infinite(files, tmp_path):
    values = np.array([[1.25, np.inf, np.nan, -np.inf]] * 3, np.float32)
    write_pfm(tmp_path / "disp0.pfm", values)
    for scale, factor in ((None, 1), (1.0, 1), (2.0, 0.5)):
        truth = read_pair(replace(files, disparity_gt=tmp_path / "disp0.pfm", gt_scale=scale)).disparity_gt
        assert truth[:, 0].tolist() == [1.25 * factor] * 3
        assert truth[:, 1:].isnan().all()


def test_colour_float_map_is_refused(files, tmp_path):
    write_pfm(tmp_path / "disp0.pfm", np.ones((3, 4, 3), np.float32))
    with pytest.raises(ValueError, match=r"disp0\.pfm must have one channel"):
        read_pair(replace(files, disparity_gt=tmp_path / "disp0.pfm"))


def test_mask_gives_the_occluded_pixels(files, tmp_path):
    cv2.imwrite(str(tmp_path / "mask0nocc.png"), np.array([[0, 128, 255, 128]] * 3, dtype=np.uint8))
    pair = read_pair(replace(files, gt_scale=3.0, mask=tmp_path / "mask0nocc.png"))
    assert pair.occluded.tolist() == [[False, True, False, True]] * 3


def test_kitti_pixels_known_but_not_among_the_visible_are_occluded(files, tmp_path):
    for name, row in (("occ.png", [0, 256, 512, 700]), ("noc.png", [0, 256, 0, 700])):
        cv2.imwrite(str(tmp_path / name), np.array([row] * 3, dtype=np.uint16))
    noc = tmp_path / "noc.png"
    pair = read_pair(replace(files, disparity_gt=tmp_path / "occ.png", gt_scale=256.0, disparity_noc_gt=noc))
    assert pair.disparity_gt[0, 1:].tolist() == [1, 2, 700 / 256]
    assert pair.occluded.tolist() == [[False, False, True, False]] * 3
    cv2.imwrite(str(noc), np.zeros((3, 5), dtype=np.uint16))
    with pytest.raises(ValueError, match=r"noc\.png must have the size"):
        read_pair(replace(files, disparity_gt=tmp_path / "occ.png", gt_scale=256.0, disparity_noc_gt=noc))


@pytest.mark.parametrize("shape", [(3, 5, 3), (4, 4, 3), (3, 5)])
def test_views_of_different_shape_are_named(files, shape):
    cv2.imwrite(str(files.image1), np.zeros(shape, dtype=np.uint8))
    with pytest.raises(ValueError, match=r"view1\.png has \(3, 3, 4\), .*view5\.png has"):
        read_pair(files, gt_scale=3)


@pytest.mark.parametrize(("field", "name"), [("disparity_gt", "disp1.png"), ("mask", "mask0nocc.png")])
def test_map_of_another_size_is_named(files, tmp_path, field, name):
    cv2.imwrite(str(tmp_path / name), np.zeros((3, 5), dtype=np.uint8))
    with pytest.raises(
        ValueError, match=rf"{name} must have the size \(H, W\) = \(3, 4\) of .*view1\.png, got \(3, 5\)"
    ):
        read_pair(replace(files, **{field: tmp_path / name}), gt_scale=3)


def test_dataset_reads_by_index_and_ends(files):
    dataset = PairDataset([files, replace(files, scene="table")], gt_scale=3)
    assert len(dataset) == 2
    assert [pair.name for pair in dataset] == ["chair", "table"]
    assert dataset[-1].name == dataset[np.int64(1)].name == "table"
    with pytest.raises(IndexError):
        dataset[2]
    with pytest.raises(TypeError):
        dataset[0:1]


def test_scenes_of_one_name_are_named_with_their_release(files):
    dataset = PairDataset([files, replace(files, dataset="middlebury-2005"), replace(files, scene="table")], gt_scale=3)
    assert [pair.name for pair in dataset] == ["middlebury/chair", "middlebury-2005/chair", "table"]


def test_dataset_feeds_a_data_loader(files):
    scenes = ["chair", "table", "lamp"]
    dataset = pickle.loads(pickle.dumps(PairDataset([replace(files, scene=name) for name in scenes], gt_scale=3)))
    batches = [[pair.name for pair in batch] for batch in DataLoader(dataset, batch_size=2, collate_fn=list)]
    assert batches == [["chair", "table"], ["lamp"]]


@pytest.mark.parametrize("view", [0, 1])
def test_grey_view_beside_a_colour_one_is_repeated(files, view):
    path = (files.image0, files.image1)[view]
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    cv2.imwrite(str(path), grey)
    pair = read_pair(replace(files, disparity_gt=None))
    repeated, coloured = (pair.image0, pair.image1)[:: 1 if view == 0 else -1]
    assert repeated.tolist() == [grey.tolist()] * 3
    assert repeated.is_contiguous()
    assert coloured.shape == (3, 3, 4)
    assert len(coloured.unique(dim=0)) == 3  # in colour still


def test_two_grey_views_stay_grey(files):
    for path in (files.image0, files.image1):
        cv2.imwrite(str(path), np.zeros((3, 4), np.uint8))
    assert read_pair(replace(files, disparity_gt=None)).image0.shape == (1, 3, 4)


def test_bits_of_a_pair_reach_both_views(files):
    for path in (files.image0, files.image1):
        cv2.imwrite(str(path), np.full((3, 4), 4095, np.uint16))
    pair = read_pair(replace(files, disparity_gt=None, sample_bits=12))
    assert (pair.image0 == 255).all()
    assert (pair.image1 == 255).all()


@pytest.mark.parametrize("sign", [-1, 1])
def test_maps_of_the_flyingthings3d_subset_are_read_with_either_sign(files, tmp_path, sign):
    write_pfm(tmp_path / "0000000.pfm", np.full((3, 4), sign * 2.5, np.float32))
    cv2.imwrite(str(tmp_path / "0000000.png"), np.array([[0, 255, 1, 0]] * 3, dtype=np.uint8))
    changes = {"disparity_gt": tmp_path / "0000000.pfm", "mask": tmp_path / "0000000.png", "gt_scale": 1.0}
    pair = read_pair(replace(files, gt_encoding="flyingthings3d-subset", **changes))
    assert (pair.disparity_gt == 2.5).all()
    assert pair.occluded.tolist() == [[False, True, True, False]] * 3


def test_negative_maps_of_other_data_sets_stay_negative(files, tmp_path):
    write_pfm(tmp_path / "d.pfm", np.full((3, 4), -2.5, np.float32))
    assert (read_pair(replace(files, disparity_gt=tmp_path / "d.pfm")).disparity_gt == -2.5).all()
