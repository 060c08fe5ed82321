from __future__ import annotations

import copy
from typing import Any

import kornia.feature as kf
import pytest
import torch
from kornia.feature.loftr.loftr import default_cfg
from torch import Tensor

from tensor_stereo import DelaunayFilter
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.interop.kornia import (
    FilteredMatcher,
    LocatedFeature,
    filter_matches,
    from_lafs,
    from_lightglue,
    from_loftr,
    to_lightglue,
    to_loftr,
)
from tests.interop.match_batches import exact_filter
from tests.interop.matchers import SmoothFilter, scene


def run_lightglue(**options: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Input and output of a small LightGlue with random weights: two pairs, 60 keypoints against 50."""
    torch.manual_seed(0)
    settings = {"input_dim": 16, "descriptor_dim": 32, "n_layers": 2, "num_heads": 2, "filter_threshold": 0.0}
    model = kf.LightGlue(None, **settings, **options).eval()
    size = torch.tensor([[320, 240], [320, 240]])
    data = {}
    for view, num in (("image0", 60), ("image1", 50)):
        keypoints = torch.rand(2, num, 2) * size[0]
        data[view] = {"keypoints": keypoints, "descriptors": torch.randn(2, num, 16), "image_size": size}
    with torch.no_grad():
        return data, model(data)


@pytest.fixture(scope="module")
def loftr_output() -> dict[str, Tensor]:
    """Output of a LoFTR with random weights that keeps every mutual match: two pairs."""
    torch.manual_seed(0)
    config = copy.deepcopy(default_cfg)
    config["match_coarse"]["thr"] = 0.0
    config["coarse"]["layer_names"] = ["self", "cross"]
    model = kf.LoFTR(None, config).eval()
    image = torch.rand(2, 1, 96, 128)
    with torch.no_grad():
        output: dict[str, Tensor] = model({"image0": image, "image1": image.roll(8, 3)})
    return output


@pytest.fixture(scope="module")
def images() -> dict[str, Tensor]:
    """Two pairs of textures, disparity 10 px."""
    torch.manual_seed(0)
    image = torch.nn.functional.avg_pool2d(torch.rand(2, 1, 140, 190), 5, 1, 2)
    image = (image - image.min()) / (image.max() - image.min())
    return {"image0": image[..., :-10], "image1": image[..., 10:]}


@pytest.mark.parametrize("width_confidence", [0.99, -1])
def test_lightglue_rows_are_its_own_list_of_matches(width_confidence: float) -> None:
    data, output = run_lightglue(width_confidence=width_confidence)
    matches, indices = from_lightglue(data, output)
    assert matches.num_pairs == 2
    assert all(len(rows) > 5 for rows in output["matches"])
    for b, (rows, scores) in enumerate(zip(output["matches"], output["scores"], strict=True)):
        here = slice(int(matches.ptr[b]), int(matches.ptr[b + 1]))
        assert torch.equal(indices[here, 1:], rows)
        assert torch.equal(matches.keypoints0[here], data["image0"]["keypoints"][b, rows[:, 0]])
        assert torch.equal(matches.keypoints1[here], data["image1"]["keypoints"][b, rows[:, 1]])
        assert matches.cost is not None
        assert torch.equal(matches.cost[here], 1 - scores)


def test_lightglue_output_comes_back_unchanged_if_all_matches_are_kept() -> None:
    data, output = run_lightglue()
    _, indices = from_lightglue(data, output)
    back = to_lightglue(output, indices, torch.ones(len(indices), dtype=torch.bool))
    assert back.keys() == output.keys()
    for name, values in output.items():
        pairs = zip(back[name], values, strict=True) if isinstance(values, list) else [(back[name], values)]
        assert all(torch.equal(torch.as_tensor(a), torch.as_tensor(b)) for a, b in pairs), name


def test_lightglue_lists_and_indices_hold_the_same_inliers() -> None:
    data, output = run_lightglue()
    matches, indices = from_lightglue(data, output)
    verdict = two_view_filter(verdict="cardinality", score="learned")(matches)  # the probability keeps none of noise
    assert 0 < int(verdict.inlier.sum()) < len(indices)
    back = to_lightglue(output, indices, verdict.inlier, verdict.score)
    again, kept = from_lightglue(data, back)
    assert torch.equal(kept, indices[verdict.inlier])
    assert torch.equal(again.keypoints1, verdict.to_matches().keypoints1)
    for b in range(2):
        assert torch.equal(back["matches"][b], kept[kept[:, 0] == b, 1:])
        assert torch.equal(back["scores"][b], back["matching_scores0"][b, back["matches"][b][:, 0]])
    assert int((back["matches1"] >= 0).sum()) == len(kept)
    weighted = output["matching_scores0"][indices[:, 0], indices[:, 1]] * verdict.score
    assert torch.equal(torch.cat(back["scores"]), weighted[verdict.inlier])


def test_lightglue_without_keypoints_has_no_matches() -> None:
    data, _ = run_lightglue()
    for name in ("keypoints", "descriptors"):
        data["image1"][name] = data["image1"][name][:, :0]
    model = kf.LightGlue(None, input_dim=16, descriptor_dim=32, n_layers=1, num_heads=2).eval()
    output = model(data)
    matches, indices = from_lightglue(data, output)
    assert matches.ptr.tolist() == [0, 0, 0]
    assert bool((to_lightglue(output, indices, two_view_filter()(matches).inlier)["matches0"] == -1).all())
    with pytest.raises(ValueError, match="image1"):
        from_lightglue({"image0": data["image0"]}, output)


def test_loftr_rows_become_ragged_pairs_and_come_back(loftr_output: dict[str, Tensor]) -> None:
    matches = from_loftr(loftr_output, num_pairs=3)
    assert matches.ptr.diff().tolist() == loftr_output["batch_indexes"].bincount(minlength=3).tolist()
    assert matches.num_matches > 50
    assert torch.equal(matches.keypoints1, loftr_output["keypoints1"])
    everything = to_loftr(loftr_output, torch.ones(matches.num_matches, dtype=torch.bool))
    assert everything.keys() == loftr_output.keys()
    assert all(torch.equal(everything[name], values) for name, values in loftr_output.items())


def test_loftr_inliers_are_those_of_each_pair_alone(loftr_output: dict[str, Tensor]) -> None:
    run = exact_filter()
    verdict = run(from_loftr(loftr_output))
    kept = to_loftr(loftr_output, verdict.inlier, verdict.score)
    assert 0 < len(kept["confidence"]) < len(loftr_output["confidence"])
    for b in range(2):
        rows = loftr_output["batch_indexes"] == b
        pair = {name: values[rows] for name, values in loftr_output.items()} | {
            "batch_indexes": torch.zeros(rows.sum())
        }
        pair["batch_indexes"] = pair["batch_indexes"].long()
        alone = run(from_loftr(pair))
        here = kept["batch_indexes"] == b
        assert torch.equal(kept["keypoints0"][here], pair["keypoints0"][alone.inlier])
        assert torch.equal(kept["confidence"][here], (pair["confidence"] * alone.score)[alone.inlier])


def lafs_at(keypoints: Tensor) -> Tensor:
    scale, orientation = torch.full((1, len(keypoints), 1, 1), 3.0), torch.full((1, len(keypoints), 1), 30.0)
    lafs: Tensor = kf.laf_from_center_scale_ori(keypoints[None], scale, orientation)
    return lafs


def matched_by_snn(seed: int, mode: str = "snn") -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """LAFs of both views, and what kornia's matcher says of descriptors that know their partner."""
    left, right = scene(seed)
    order = torch.randperm(len(right), generator=torch.Generator().manual_seed(seed))
    torch.manual_seed(seed)
    descriptors = torch.randn(len(left), 32)
    distances, indices = kf.DescriptorMatcher(mode, 0.95)(descriptors, descriptors[order] + 0.3 * torch.randn(60, 32))
    return lafs_at(left), lafs_at(right[order]), distances, indices


def test_keypoints_of_lafs_are_their_centres() -> None:
    lafs0, lafs1, distances, indices = matched_by_snn(0)
    matches = from_lafs(lafs0, lafs1, indices, distances)
    assert matches.num_pairs == 1
    assert torch.equal(matches.keypoints0, kf.get_laf_center(lafs0)[0, indices[:, 0]])
    assert torch.equal(matches.keypoints1, kf.get_laf_center(lafs1)[0, indices[:, 1]])
    assert matches.cost is not None
    assert torch.equal(matches.cost, distances[:, 0])


def test_batched_indices_of_kornia_give_the_pairs_one_by_one() -> None:
    torch.manual_seed(0)
    descriptors = torch.randn(3, 20, 8)
    distances, indices = kf.match_smnn_batched(descriptors, descriptors + 0.1 * torch.randn(3, 20, 8), 0.99)
    lafs = torch.randn(3, 20, 2, 3)
    matches = from_lafs(lafs, lafs + 1, indices, distances)
    assert matches.ptr.diff().tolist() == indices[:, 0].bincount(minlength=3).tolist()
    for b in range(3):
        alone = from_lafs(lafs[b : b + 1], lafs[b : b + 1] + 1, indices[indices[:, 0] == b, 1:])
        here = slice(int(matches.ptr[b]), int(matches.ptr[b + 1]))
        assert torch.equal(matches.keypoints1[here], alone.keypoints1)


@pytest.mark.parametrize("mode", ["nn", "snn"])
def test_filter_matches_keeps_the_rows_of_the_inliers(mode: str) -> None:
    lafs1, lafs2, distances, indices = matched_by_snn(1, mode)
    verdict = two_view_filter()(from_lafs(lafs1, lafs2, indices, distances))
    kept_distances, kept = filter_matches(lafs1, lafs2, indices, distances=distances)
    assert 0 < len(kept) < len(indices)
    assert torch.equal(kept, indices[verdict.inlier])
    assert kept_distances.shape == (len(kept), 1)
    assert torch.equal(kept_distances[:, 0], 1 - verdict.score[verdict.inlier])
    strict = filter_matches(lafs1, lafs2, indices, distances=distances, filter=DelaunayFilter(verdict="adjacency"))
    assert len(strict[1]) < len(kept)


def test_filter_follows_a_matcher_that_needs_lafs() -> None:
    torch.manual_seed(0)
    left, right = scene(2, wrong=0.1)
    descriptors = torch.randn(60, 32)
    lafs1, lafs2 = lafs_at(left), lafs_at(right)
    noisy = descriptors + 0.1 * torch.randn(60, 32)
    _, indices = kf.GeometryAwareDescriptorMatcher("fginn")(descriptors, noisy, lafs1, lafs2)
    _, kept = filter_matches(lafs1, lafs2, indices)
    rows = {tuple(row) for row in indices.tolist()}
    assert rows > {tuple(row) for row in kept.tolist()} > set()


def test_the_better_of_two_matches_of_one_keypoint_counts() -> None:
    x, y = torch.meshgrid(torch.arange(5.0), torch.arange(5.0), indexing="xy")
    lafs = lafs_at(torch.stack([x, y], -1).reshape(25, 2) * 10)
    indices = torch.cat([torch.arange(25)[:, None].expand(25, 2), torch.tensor([[12, 13]])])
    distances = torch.cat([torch.full((25, 1), 0.5), torch.tensor([[0.9]])])
    _, kept = filter_matches(lafs, lafs, indices, distances=distances)
    assert torch.equal(kept, indices[:25])
    first = torch.roll(torch.arange(26), 1)  # the wrong one in front: only its distance tells
    _, kept = filter_matches(lafs, lafs, indices[first], distances=distances[first])
    assert torch.equal(kept, indices[:25])


def test_empty_matches_of_kornia_stay_empty() -> None:
    distances, indices = kf.match_snn(torch.randn(1, 8), torch.randn(1, 8))
    lafs = lafs_at(torch.ones(1, 2))
    kept_distances, kept = filter_matches(lafs, lafs, indices, distances=distances)
    assert kept_distances.shape == (0, 1)
    assert kept.shape == (0, 2)


def test_distances_carry_the_gradient_of_the_score_to_the_lafs() -> None:
    lafs1, lafs2, _, indices = matched_by_snn(3)
    lafs2.requires_grad_()
    distances, kept = filter_matches(lafs1, lafs2, indices, filter=SmoothFilter())
    distances.sum().backward()
    assert lafs2.grad is not None
    moved = (lafs2.grad[0, :, :, 2] != 0).all(-1).nonzero()[:, 0]
    assert torch.equal(moved, kept[:, 1].sort().values)
    assert bool((lafs2.grad[..., :2] == 0).all())


def test_filtered_matcher_in_local_feature_matcher_gives_the_inliers_of_its_plain_output(images: Any) -> None:
    feature, matcher = kf.SIFTFeatureScaleSpace(150), kf.DescriptorMatcher("nn")
    with torch.no_grad():
        plain = kf.LocalFeatureMatcher(feature, matcher)(images)
        filtered = kf.LocalFeatureMatcher(LocatedFeature(feature), FilteredMatcher(matcher))(images)
    verdict = two_view_filter()(from_loftr(plain))
    expected = to_loftr(plain, verdict.inlier)
    assert filtered.keys() == expected.keys()
    for name in ("keypoints0", "keypoints1", "lafs0", "lafs1", "batch_indexes"):
        assert torch.equal(filtered[name], expected[name]), name
    torch.testing.assert_close(filtered["confidence"], verdict.score[verdict.inlier])
    assert filtered["batch_indexes"].unique().tolist() == [0, 1]

    def precision(output: dict[str, Tensor]) -> float:
        error = output["keypoints0"] - output["keypoints1"] - torch.tensor([10.0, 0.0])
        return (error.norm(dim=1) < 1).float().mean().item()

    assert precision(filtered) > precision(plain)


def test_filtered_matcher_with_lafs_equals_positions_in_the_descriptors() -> None:
    left, right = scene(4, wrong=0.1)
    descriptors = torch.randn(60, 32, generator=torch.Generator().manual_seed(0))
    matcher = FilteredMatcher(kf.DescriptorMatcher("mnn"))
    with_lafs = matcher(descriptors, descriptors, lafs_at(left), lafs_at(right))
    located = matcher(torch.cat([descriptors, left], 1), torch.cat([descriptors, right], 1))
    assert 0 < len(located[1]) < 60
    assert torch.equal(with_lafs[0], located[0])
    assert torch.equal(with_lafs[1], located[1])
    with pytest.raises(ValueError, match="lafs1 and lafs2"):
        matcher(descriptors, descriptors, lafs_at(left))


@pytest.mark.parametrize(
    ("lafs", "indices", "error", "message"),
    [
        (torch.ones(1, 4, 2, 2), torch.tensor([[0, 0]]), ValueError, "lafs0 must have shape"),
        (torch.ones(1, 4, 2, 3), torch.tensor([[0, 4]]), ValueError, "indices must be sorted"),
        (torch.ones(1, 4, 2, 3), torch.tensor([[-1, 0]]), ValueError, "indices must be sorted"),
        (torch.ones(2, 4, 2, 3), torch.tensor([[1, 0, 0], [0, 1, 1]]), ValueError, "indices must be sorted"),
        (torch.ones(2, 4, 2, 3), torch.tensor([[0, 0]]), ValueError, "indices must have shape"),
        (torch.ones(1, 4, 2, 3), torch.tensor([[0.0, 0.0]]), TypeError, "indices must be int64"),
    ],
)
def test_bad_lafs_and_indices_are_named(lafs: Tensor, indices: Tensor, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        from_lafs(lafs, lafs, indices)


def test_bad_verdicts_on_loftr_are_named(loftr_output: dict[str, Tensor]) -> None:
    with pytest.raises(ValueError, match="inlier"):
        to_loftr(loftr_output, torch.ones(3, dtype=torch.bool))
    with pytest.raises(TypeError, match="inlier must be bool"):
        to_loftr(loftr_output, torch.ones(len(loftr_output["confidence"])))
    with pytest.raises(ValueError, match="batch must name pairs"):
        from_loftr(loftr_output, num_pairs=1)
    with pytest.raises(ValueError, match="'confidence'"):
        from_loftr({name: values for name, values in loftr_output.items() if name != "confidence"})
