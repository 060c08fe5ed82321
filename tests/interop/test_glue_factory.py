from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from tensor_stereo import ConsensusConfig, DelaunayFilter
from tensor_stereo.batching import select_matches
from tensor_stereo.interop.glue_factory import GlueFactoryFilter, from_glue_factory, to_glue_factory
from tests.interop.match_batches import exact_filter
from tests.interop.matchers import SmoothFilter, scene


def predictions(seed: int, num_pairs: int = 3, num0: int = 50, num1: int = 40) -> dict[str, Tensor]:
    """Mutual matches as a matcher of glue-factory returns them, with -1 and -2 among them."""
    generator = torch.Generator().manual_seed(seed)
    keypoints0, keypoints1 = torch.zeros(num_pairs, num0, 2), torch.zeros(num_pairs, num1, 2)
    matches0 = torch.full((num_pairs, num0), -1)
    matches1 = torch.full((num_pairs, num1), -1)
    scores0, scores1 = torch.rand(num_pairs, num0, generator=generator), torch.zeros(num_pairs, num1)
    for b in range(num_pairs):
        rows0, rows1 = (torch.randperm(n, generator=generator) for n in (num0, num1))
        keypoints0[b, rows0[:num1]], keypoints1[b, rows1] = scene(seed + b, num1)
        num_matched = num1 - 5 * b
        matches0[b, rows0[:num_matched]] = rows1[:num_matched]
        matches0[b, rows0[-2:]] = -2
        matches1[b, rows1[:num_matched]] = rows0[:num_matched]
        scores1[b, rows1[:num_matched]] = scores0[b, rows0[:num_matched]]
    return {
        "keypoints0": keypoints0,
        "keypoints1": keypoints1,
        "matches0": matches0,
        "matches1": matches1,
        "matching_scores0": scores0,
        "matching_scores1": scores1,
    }


seeds = st.integers(0, 10**6)


@given(seeds)
def test_rows_are_the_matches_that_a_loop_over_the_dictionary_finds(seed: int) -> None:
    data = predictions(seed)
    matches, indices = from_glue_factory(data)
    expected = [
        (b, i, j) for b, row in enumerate(data["matches0"].tolist()) for i, j in enumerate(row) if j not in (-1, -2)
    ]
    assert indices.tolist() == [list(row) for row in expected]
    assert matches.ptr.diff().tolist() == [40, 35, 30]
    for k, (b, i, j) in enumerate(expected):
        assert torch.equal(matches.keypoints0[k], data["keypoints0"][b, i])
        assert torch.equal(matches.keypoints1[k], data["keypoints1"][b, j])
        assert matches.cost is not None
        assert matches.cost[k] == 1 - data["matching_scores0"][b, i]


@given(seeds)
def test_accepting_all_changes_nothing_and_rejecting_all_leaves_only_the_unmatched(seed: int) -> None:
    data = predictions(seed)
    _, indices = from_glue_factory(data)
    same = to_glue_factory(data, indices, torch.ones(len(indices), dtype=torch.bool))
    assert same.keys() == {"matches0", "matches1", "matching_scores0", "matching_scores1"}
    for name, values in same.items():
        assert torch.equal(values, data[name]), name
    none = to_glue_factory(data, indices, torch.zeros(len(indices), dtype=torch.bool))
    assert torch.equal(none["matches0"], data["matches0"].clamp(max=-1))
    assert torch.equal(none["matches1"], data["matches1"].clamp(max=-1))
    assert bool((none["matching_scores1"] == 0).all())
    assert torch.equal(none["matching_scores0"], data["matching_scores0"] * (data["matches0"] < 0))


@given(seeds)
def test_what_is_written_back_reads_as_the_selected_matches(seed: int) -> None:
    data = predictions(seed)
    matches, indices = from_glue_factory(data)
    inlier = torch.rand(len(indices), generator=torch.Generator().manual_seed(seed)) < 0.5
    again, kept = from_glue_factory({**data, **to_glue_factory(data, indices, inlier)})
    expected = select_matches(matches, inlier)
    assert torch.equal(kept, indices[inlier])
    for name in ("keypoints0", "keypoints1", "ptr", "cost"):
        assert torch.equal(getattr(again, name), getattr(expected, name)), name


@given(seeds)
def test_both_views_agree_after_the_filter(seed: int) -> None:
    data = predictions(seed)
    result = GlueFactoryFilter()(data)
    pair, row0 = (result["matches0"] >= 0).nonzero(as_tuple=True)
    row1 = result["matches0"][pair, row0]
    assert 0 < len(pair) < int((data["matches0"] >= 0).sum())
    assert torch.equal(result["matches1"][pair, row1], row0)
    assert int((result["matches1"] >= 0).sum()) == len(pair)
    assert torch.equal(result["matching_scores1"][pair, row1], result["matching_scores0"][pair, row0])


@given(seeds)
def test_batch_equals_loop(seed: int) -> None:
    data, module = predictions(seed), GlueFactoryFilter(exact_filter())
    batched = module(data)
    for b in range(3):
        for name, values in module({key: value[b : b + 1] for key, value in data.items()}).items():
            assert torch.equal(values[0], batched[name][b]), name


def test_filter_writes_the_verdicts_and_scores_of_the_delaunay_filter() -> None:
    data = predictions(7)
    matches, indices = from_glue_factory(data)
    output = DelaunayFilter(verdict="adjacency")(matches)
    result = GlueFactoryFilter(DelaunayFilter(verdict="adjacency"))(data)
    places = indices[:, 0], indices[:, 1]
    assert torch.equal(result["matches0"][places] >= 0, output.inlier)
    expected = data["matching_scores0"][places] * output.score * output.inlier
    torch.testing.assert_close(result["matching_scores0"][places], expected)
    assert torch.equal(data["matches0"], predictions(7)["matches0"])  # the input is left alone


def test_a_keypoint_of_view_1_that_two_matches_share_keeps_the_one_that_matches1_names() -> None:
    data = {
        "keypoints0": torch.rand(1, 3, 2),
        "keypoints1": torch.rand(1, 2, 2),
        "matches0": torch.tensor([[0, 0, 1]]),
        "matches1": torch.tensor([[1, 2]]),
    }
    _, indices = from_glue_factory(data)
    result = to_glue_factory(data, indices, torch.tensor([False, True, True]))
    assert result["matches0"].tolist() == [[-1, 0, 1]]
    assert result["matches1"].tolist() == [[1, 2]]


def test_gradients_reach_the_matchers_scores_and_the_keypoints() -> None:
    data: dict[str, Any] = predictions(3)
    data["keypoints1"].requires_grad_()
    data["matching_scores0"].requires_grad_()
    result = GlueFactoryFilter(SmoothFilter())(data)
    result["matching_scores0"][result["matches0"] >= 0].sum().backward()
    kept = result["matches0"] >= 0
    assert torch.equal(data["matching_scores0"].grad != 0, kept)
    assert torch.equal((data["keypoints1"].grad != 0).any(-1).sum(), kept.sum())


def test_pairs_without_matches_and_empty_batches_pass() -> None:
    data = predictions(1)
    data["matches0"][1], data["matches1"][1] = -1, -1
    result = GlueFactoryFilter()(data)
    assert bool((result["matches0"][1] == -1).all())
    assert bool((result["matches0"][0] >= 0).any())
    empty = GlueFactoryFilter()({name: values[:0] for name, values in data.items()})
    assert empty["matches0"].shape == (0, 50)


def test_configuration_names_the_filter_by_its_module_path() -> None:
    # The look-up that glue-factory's get_model does, with the dictionary of the component as argument.
    conf = {"name": "tensor_stereo.interop.glue_factory", "verdict": "adjacency", "trainable": False}
    model = importlib.import_module(conf["name"]).__main_model__(conf)  # type: ignore[arg-type]
    assert isinstance(model, nn.Module)
    assert isinstance(model.filter, DelaunayFilter)
    data = predictions(5)
    expected = GlueFactoryFilter(DelaunayFilter(verdict="adjacency"))(data)
    pred = {**data, **model({**data, "view0": {"image": None}})}
    assert torch.equal(pred["matches0"], expected["matches0"])
    assert not torch.equal(pred["matches0"], GlueFactoryFilter()(data)["matches0"])
    with pytest.raises(NotImplementedError):
        model.loss(pred, data)
    with pytest.raises(TypeError, match="verdicts"):
        GlueFactoryFilter.from_conf({"verdicts": "adjacency"})


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"matches0": torch.full((3, 50), 40)}, ValueError, "matches0 must name rows below 40"),
        ({"matches0": torch.zeros(3, 50)}, TypeError, "matches0 must be int64"),
        ({"matches0": torch.zeros(3, 49, dtype=torch.int64)}, ValueError, "matches0 must have shape"),
        ({"matching_scores0": torch.zeros(3, 49)}, ValueError, "matching_scores0 must have shape"),
        ({"keypoints1": torch.zeros(2, 40, 2)}, ValueError, "keypoints1 must have shape"),
    ],
)
def test_bad_entries_are_named(change: dict[str, Tensor], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        from_glue_factory({**predictions(0), **change})


def test_missing_entries_and_bad_verdicts_are_named() -> None:
    data = predictions(0)
    with pytest.raises(ValueError, match="'matches0'"):
        from_glue_factory({"keypoints0": data["keypoints0"], "keypoints1": data["keypoints1"]})
    _, indices = from_glue_factory(data)
    with pytest.raises(ValueError, match="inlier"):
        to_glue_factory(data, indices, torch.ones(3, dtype=torch.bool))
    with pytest.raises(TypeError, match="inlier must be bool"):
        to_glue_factory(data, indices, torch.ones(len(indices)))
    with pytest.raises(ValueError, match="indices"):
        to_glue_factory(data, indices[:, :2], torch.ones(len(indices), dtype=torch.bool))


@pytest.mark.parametrize("consensus", [{"slope": 0.3}, {}, None, {"row_tolerance_px": 2.0}])
def test_a_consensus_in_the_configuration_is_one_of_any_two_views(consensus: dict[str, Any] | None) -> None:
    module = GlueFactoryFilter.from_conf({"score": "consensus", "consensus": consensus}).filter
    assert isinstance(module, DelaunayFilter)
    assert module.config.consensus == ConsensusConfig(**(consensus or {}))
    assert module.config.rectified == "auto"


@pytest.mark.parametrize("settings", [{}, {"rectified": "auto"}, {"rectified": True}, {"rectified": False}])
def test_the_configuration_says_whether_pairs_are_rectified(settings: dict[str, Any]) -> None:
    data = predictions(5)
    matches, indices = from_glue_factory(data)
    run = DelaunayFilter(**({"rectified": "auto"} | settings))
    output = run(matches)
    expected = to_glue_factory(data, indices, output.inlier, output.score)
    result = GlueFactoryFilter.from_conf(settings)(data)
    assert result.keys() == expected.keys()
    for name, values in result.items():
        assert torch.equal(values, expected[name]), name


def test_other_values_of_rectified_are_refused() -> None:
    for value in (1, "yes", None):
        with pytest.raises(ValueError, match="rectified must be one of True, False, auto, got"):
            GlueFactoryFilter.from_conf({"rectified": value})


def test_weights_can_be_trained_by_the_configuration() -> None:
    module = GlueFactoryFilter.from_conf({"score": "learned", "verdict": "score", "trainable": True})
    assert any(parameter.requires_grad for parameter in module.parameters())
    assert not any(p.requires_grad for p in GlueFactoryFilter.from_conf({"trainable": False}).parameters())
