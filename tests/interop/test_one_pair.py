"""One pair without batch axis, and its images, in every adapter: the result is that of a batch of one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches, filter_disparity
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.evaluation.metrics import roc_auc
from tensor_stereo.interop.glue_factory import GlueFactoryFilter, two_view_filter
from tensor_stereo.interop.kornia import (
    FilteredMatcher,
    filter_matches,
    from_lafs,
    from_lightglue,
    from_loftr,
    to_lightglue,
    to_loftr,
)
from tests.interop.test_glue_factory import predictions


def one_pair() -> dict[str, Tensor]:
    """The dictionary of one pair, without batch axis."""
    return {name: values[0] for name, values in predictions(3, num_pairs=1).items()}


def lafs(keypoints: Tensor) -> Tensor:
    """(N, 2, 3) frames of scale 1 at keypoints (N, 2)."""
    return torch.cat([torch.eye(2).expand(len(keypoints), 2, 2), keypoints[..., None]], -1)


def test_glue_factory() -> None:
    data = one_pair()
    batch = GlueFactoryFilter()({name: values[None] for name, values in data.items()})
    for name, values in GlueFactoryFilter()(data).items():
        assert values.shape == data[name].shape
        assert torch.equal(values, batch[name][0]), name


def test_glue_factory_hands_its_images_to_a_filter_that_looks_at_them() -> None:
    pair, data = render_pair(0), one_pair()
    views = {f"view{v}": {"image": image.float() / 255} for v, image in enumerate((pair.image0, pair.image1))}
    blind, seeing = (GlueFactoryFilter(DelaunayFilter())(data | images) for images in ({}, views))
    assert not torch.equal(blind["matching_scores0"], seeing["matching_scores0"])
    paper = GlueFactoryFilter(DelaunayFilter(verdict="cardinality"))  # looks at none
    assert torch.equal(paper(data | views)["matches0"], paper(data)["matches0"])


def test_lightglue_with_lists_as_after_the_removal_of_its_batch_axis() -> None:
    data = one_pair()
    rows = (data["matches0"] >= 0).nonzero()[:, 0]
    output = {
        "matches0": data["matches0"].clamp(min=-1),
        "matches1": data["matches1"],
        "matching_scores0": data["matching_scores0"],
        "matching_scores1": data["matching_scores1"],
        "matches": torch.stack([rows, data["matches0"][rows]], 1),
        "scores": data["matching_scores0"][rows],
    }
    inputs = {f"image{v}": {"keypoints": data[f"keypoints{v}"]} for v in (0, 1)}
    matches, indices = from_lightglue(inputs, output)
    assert torch.equal(indices[:, 1:], output["matches"])
    inlier = two_view_filter()(matches).inlier
    assert 0 < int(inlier.sum()) < len(inlier)
    back = to_lightglue(output, indices, inlier)
    assert torch.equal(back["matches"], output["matches"][inlier])
    assert torch.equal(back["scores"], output["scores"][inlier])
    assert {name: values.shape for name, values in back.items() if "0" in name or "1" in name} == {
        name: values.shape for name, values in output.items() if "0" in name or "1" in name
    }


def test_loftr_without_batch_indexes() -> None:
    data = one_pair()
    output = {"keypoints0": data["keypoints0"][:40], "keypoints1": data["keypoints1"], "confidence": torch.rand(40)}
    matches, expected = from_loftr(output), from_loftr(output | {"batch_indexes": torch.zeros(40, dtype=torch.int64)})
    assert torch.equal(matches.ptr, expected.ptr)
    assert torch.equal(matches.keypoints1, expected.keypoints1)
    inlier = torch.arange(40) % 2 == 0
    assert to_loftr(output, inlier).keys() == output.keys()
    assert torch.equal(to_loftr(output, inlier)["confidence"], output["confidence"][::2])


def test_lafs_and_the_images_of_a_rectified_pair() -> None:
    pair, data = render_pair(0), one_pair()
    rows = (data["matches0"] >= 0).nonzero()[:, 0]
    indices = torch.stack([rows, data["matches0"][rows]], 1)
    views = lafs(data["keypoints0"]), lafs(data["keypoints1"])
    batched = tuple(view[None] for view in views)
    assert torch.equal(from_lafs(*views, indices).keypoints1, from_lafs(*batched, indices).keypoints1)
    for one, batch in zip(filter_matches(*views, indices), filter_matches(*batched, indices), strict=True):
        assert torch.equal(one, batch)
    images = {"images1": pair.image0, "images2": pair.image1}
    matches = from_lafs(*views, indices)
    for chosen, run in ((DelaunayFilter(), DelaunayFilter()), (None, DelaunayFilter(rectified="auto"))):
        distances, kept = filter_matches(*views, indices, filter=chosen, **images)
        expected = run(matches, images0=pair.image0, images1=pair.image1)
        assert torch.equal(kept, indices[expected.inlier])
        assert torch.equal(distances[:, 0], 1 - expected.score[expected.inlier])
    with pytest.raises(TypeError, match="images0 and images1 must be None where the score is 'consensus'"):
        filter_matches(*views, indices, filter=DelaunayFilter(score="consensus"), **images)


def test_a_filter_without_score_leaves_the_distances_of_the_matcher() -> None:
    data = one_pair()
    rows = (data["matches0"] >= 0).nonzero()[:, 0]
    indices = torch.stack([rows, data["matches0"][rows]], 1)
    views = lafs(data["keypoints0"]), lafs(data["keypoints1"])
    distances = torch.rand(len(indices), 1)
    run = DelaunayFilter(verdict="cardinality", score="none")
    found, kept = filter_matches(*views, indices, distances=distances, filter=run)
    inlier = run(from_lafs(*views, indices, distances)).inlier
    assert torch.equal(found, distances[inlier])
    assert torch.equal(kept, indices[inlier])
    assert not filter_matches(*views, indices, filter=run)[0].any()
    assert FilteredMatcher(lambda a, b: (distances, indices), run)(*(v[:, 0] for v in views), *(v[None] for v in views))


def test_a_disparity_map_of_two_axes_and_its_images() -> None:
    pair = render_pair(0)
    assert pair.disparity_gt is not None
    disparity = pair.disparity_gt
    mask = torch.rand(disparity.shape, generator=torch.Generator().manual_seed(0)) < 0.9
    blind = filter_disparity(disparity, 8, mask=mask)
    assert blind.inlier.shape == blind.mask.shape == blind.grid.shape[:2]
    batch = filter_disparity(disparity[None, None], 8, mask=mask[None, None])
    assert torch.equal(blind.score, batch.score[0, 0])
    images = {"images0": pair.image0, "images1": pair.image1}
    seeing = filter_disparity(disparity, 8, mask=mask, **images)
    assert torch.equal(seeing.mask, blind.mask)
    assert not torch.equal(seeing.score, blind.score)
    wrong = disparity + 9 * (torch.rand(disparity.shape, generator=torch.Generator().manual_seed(1)) < 0.2)
    found = filter_disparity(wrong, 8, **images)
    changed = (wrong != disparity)[::8, ::8][found.mask]
    assert roc_auc(found.score[found.mask], ~changed) > 0.95  # 9 px off is easy to see


def test_wrong_types_are_named_with_what_mends_them() -> None:
    data = one_pair()
    with pytest.raises(TypeError, match=r"keypoints0 must be a torch\.Tensor, got ndarray; convert with"):
        GlueFactoryFilter()(data | {"keypoints0": data["keypoints0"].numpy()})
    with pytest.raises(TypeError, match=r"lafs0 must be a torch\.Tensor, got ndarray; convert with"):
        from_lafs(lafs(data["keypoints0"]).numpy(), lafs(data["keypoints1"]), torch.zeros(1, 2).long())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"keypoints0 must be a torch\.Tensor, got list; convert with"):
        Matches([[0.0, 1.0]], torch.zeros(1, 2), torch.tensor([0, 1]))  # type: ignore[arg-type]
