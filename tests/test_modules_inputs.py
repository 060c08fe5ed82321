"""What DelaunayFilter takes: one pair without batch axis, images, and wrong types, which the messages help to mend."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches, to_padded
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.pipeline import run_pipeline
from tensor_stereo.scores.domain import DomainWarning
from tensor_stereo.scores.image_evidence import measure_images
from tests.interop.matchers import scene

SET_TEST = ts.PipelineConfig(verdict="cardinality")


def rendered(seed: int, crop: int = 0) -> tuple[ts.Matches, Tensor, Tensor]:
    """FAST matches of a rendered pair, and its images (C, H, W)."""
    pair = render_pair(seed)
    images = [image[:, crop:] for image in (pair.image0, pair.image1)]
    return run_pipeline([(images[0], images[1])], SET_TEST).matches, images[0], images[1]


def measured(matches: ts.Matches, images0: list[Tensor], images1: list[Tensor]) -> ts.FilterOutput:
    evidence = measure_images(images0, images1, matches, build_match_graphs(matches))
    return ts.DelaunayFilter()(matches, evidence=evidence)


def test_one_pair_needs_no_batch_axis() -> None:
    matches, image0, image1 = rendered(0)
    k0, k1, cost = matches.keypoints0, matches.keypoints1, matches.cost
    assert cost is not None
    mask = torch.arange(len(k0)) % 5 > 0
    module = ts.DelaunayFilter()
    for images, single in (({}, {}), ({"images0": image0[None], "images1": image1[None]}, {"images0": image0})):
        one = module(k0, k1, mask, cost=cost, **single, **({"images1": image1} if single else {}))
        batch = module(k0[None], k1[None], mask[None], cost=cost[None], **images)
        assert one.inlier.shape == one.score.shape == one.relation.shape == (len(k0),)
        for name in ("inlier", "score", "relation"):
            assert torch.equal(getattr(one, name), getattr(batch, name)[0]), name
        kept = one.to_matches()
        assert torch.equal(kept.keypoints0, k0[one.inlier])
        assert kept.num_pairs == 1


def test_images_at_the_door_are_the_evidence_measured_before() -> None:
    (first, a0, a1), (second, b0, b1) = rendered(0), rendered(1, crop=40)
    assert a0.shape != b0.shape
    matches = collate_matches([first, second])
    assert matches.cost is not None
    expected = measured(matches, [a0, b0], [a1, b1])
    given = {"images0": [a0, b0], "images1": [a1, b1]}  # lists of any sizes
    assert torch.equal(ts.DelaunayFilter()(matches, **given).score, expected.score)
    (k0, mask), (k1, _), (cost, _) = (
        to_padded(values, matches.ptr, fill=float("nan"))
        for values in (matches.keypoints0, matches.keypoints1, matches.cost)
    )
    padded = ts.DelaunayFilter()(k0, k1, mask, cost=cost, **given)
    assert torch.equal(padded.score[mask], expected.score)
    blind = ts.DelaunayFilter()(matches)
    assert not torch.equal(blind.score, expected.score)


def test_a_batch_of_images_may_be_floating_point_or_colour() -> None:
    matches, image0, image1 = rendered(2)
    two = collate_matches([matches, matches])
    images = [torch.stack([image, image]) for image in (image0, image1)]  # (B, C, H, W)
    expected = ts.DelaunayFilter()(two, images0=images[0], images1=images[1]).score
    floating = [image.double() / 255 for image in images]
    assert torch.equal(ts.DelaunayFilter()(two, images0=floating[0], images1=floating[1]).score, expected)
    assert torch.equal(expected[: matches.num_matches], expected[matches.num_matches :])


def test_images_that_do_not_fit_are_named() -> None:
    matches, image0, image1 = rendered(0)
    module = ts.DelaunayFilter()
    with pytest.raises(ValueError, match="images1 must be given, as the other view has images"):
        module(matches, images0=image0)
    with pytest.raises(ValueError, match=r"images0 must hold one image per pair \(1\), got 2"):
        module(matches, images0=[image0, image0], images1=[image1, image1])
    with pytest.raises(ValueError, match=r"images0 must be images \(C, H, W\) with C = 1 or 3"):
        module(matches, images0=image0[0], images1=image1[0])
    with pytest.raises(
        TypeError, match=r"images0 must be a torch\.Tensor, got ndarray; convert with torch\.from_numpy"
    ):
        module(matches, images0=image0.numpy(), images1=image1)
    with pytest.raises(ValueError, match=r"floating-point images must lie in \[0, 1\]"):
        module(matches, images0=image0.float(), images1=image1.float())
    for other in (ts.DelaunayFilter(score="consensus"), ts.DelaunayFilter(verdict="adjacency")):
        with pytest.raises(TypeError, match="images0 and images1 must be None where the score is"):
            other(matches, images0=image0, images1=image1)
    with pytest.raises(TypeError, match="images0 must be None where there is no score"):
        ts.DelaunayFilter(verdict="adjacency", score="none")(matches, images0=image0, images1=image1)
    evidence = measure_images([image0], [image1], matches, build_match_graphs(matches))
    with pytest.raises(TypeError, match="evidence must be None beside images"):
        module(matches, images0=image0, images1=image1, evidence=evidence)
    with pytest.raises(TypeError, match="evidence must be that of Matches"):
        module(matches.keypoints0, matches.keypoints1, evidence=evidence)


LEFT = scene(0)[0]
RIGHT = LEFT - torch.tensor([15.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LEFT.numpy(), RIGHT), r"keypoints0 must be a torch\.Tensor, got ndarray; convert with torch\.from_numpy"),
        ((LEFT, RIGHT.tolist()), r"keypoints1 must be a torch\.Tensor, got list; convert with torch\.as_tensor"),
        (
            (LEFT.long(), RIGHT.long()),
            r"keypoints0 must be float32 or float64 pixels, got torch\.int64; convert with \.float",
        ),
        (
            (LEFT, RIGHT.half()),
            r"keypoints1 must be float32 or float64 pixels, got torch\.float16; convert with \.float",
        ),
        ((LEFT.bfloat16(), RIGHT), r"keypoints0 must be float32 or float64 pixels, got torch\.bfloat16; convert"),
        ((LEFT, RIGHT, np.ones(60, bool)), r"mask must be a torch\.Tensor, got ndarray"),
        ((LEFT, RIGHT, torch.ones(60)), r"mask must be bool, got torch\.float32; convert with \.bool\(\)"),
        (
            (LEFT, RIGHT, torch.ones(60, dtype=torch.uint8)),
            r"mask must be bool, got torch\.uint8; convert with \.bool\(\)",
        ),
        ((LEFT, RIGHT, None, [0] * 60), r"group must be a torch\.Tensor, got list"),
        ((LEFT, RIGHT, None, torch.zeros(60)), r"group must hold integers, got torch\.float32"),
        ((LEFT, RIGHT, None, None, np.zeros(60)), r"cost must be a torch\.Tensor, got ndarray"),
    ],
)
def test_a_wrong_type_is_named_with_what_mends_it(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        ts.DelaunayFilter()(*arguments)
    fields = ("keypoints0", "keypoints1", "mask", "group", "cost")
    given = {
        name: value for name, value in zip(fields, arguments, strict=False) if name != "mask" and value is not None
    }
    if len(arguments) != 3:  # Matches have no mask
        with pytest.raises(TypeError, match=message):
            ts.Matches(ptr=torch.tensor([0, 60]), **given)  # type: ignore[arg-type]


def test_shapes_of_one_pair_are_named_as_they_were_given() -> None:
    module = ts.DelaunayFilter()
    for name, arguments in {
        "keypoints0": (LEFT[:, :1], RIGHT),
        "keypoints1": (LEFT, RIGHT[:9]),
        "mask": (LEFT, RIGHT, torch.ones(9, dtype=torch.bool)),
        "cost": (LEFT, RIGHT, None, None, torch.ones(9)),
    }.items():
        with pytest.raises(ValueError, match=rf"{name} must have shape .*\((60, |60,\)|B, N)"):
            module(*arguments)


def test_nothing_is_warned_of_for_pixels_of_a_rectified_pair() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ts.DelaunayFilter()(LEFT, RIGHT).inlier.all()


def test_state_of_another_score_is_refused_by_name() -> None:
    learned, consensus = ts.DelaunayFilter(), ts.DelaunayFilter(score="consensus")
    with pytest.raises(
        ValueError, match="state_dict is that of a DelaunayFilter with score='consensus', but this filter has 'learned'"
    ):
        learned.load_state_dict(consensus.state_dict(), strict=False)
    with pytest.raises(ValueError, match="with score='learned', but this filter has 'consensus'"):
        consensus.load_state_dict(learned.state_dict(), strict=False)
    other = ts.DelaunayFilter(score="consensus", consensus=ts.ConsensusConfig(slope=0.3))
    with pytest.raises(ValueError, match="with consensus="):
        other.load_state_dict(consensus.state_dict())
    with pytest.raises(ValueError, match="with temperature_unit='px', but this filter has 'edge'"):
        ts.DelaunayFilter(verdict="adjacency").load_state_dict(
            ts.DelaunayFilter(verdict="adjacency", temperature_unit="px").state_dict()
        )
    # what decides beside the score is no part of it
    ts.DelaunayFilter(min_precision=0.9).load_state_dict(learned.state_dict())


def test_weights_of_learned_are_parameters_that_survive_and_can_be_trained() -> None:
    frozen, module = ts.DelaunayFilter(), ts.DelaunayFilter(trainable=True)
    assert not any(parameter.requires_grad for parameter in frozen.parameters())
    assert all(parameter.requires_grad for parameter in module.parameters())
    before = module(LEFT, RIGHT).score
    optimizer = torch.optim.SGD(module.parameters(), lr=1e-3)
    before.mean().backward()
    optimizer.step()
    after = module(LEFT, RIGHT).score
    assert after.mean() < before.mean()
    assert torch.allclose(frozen(LEFT, RIGHT).score, before, atol=1e-6)  # every filter has weights of its own
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    frozen.load_state_dict(torch.load(file, weights_only=True))
    assert torch.allclose(frozen(LEFT, RIGHT).score, after, atol=1e-6)  # a kernel computes it without gradients
    from safetensors.torch import load, save

    frozen.load_state_dict(load(save(module.state_dict())))


def test_repr_shows_the_settings() -> None:
    text = repr(ts.DelaunayFilter(min_precision=0.9))
    assert "verdict='score', score='learned', min_precision=0.9, max_error_px=1.0, rectified=True" in text
    text = repr(ts.DelaunayFilter(verdict="adjacency", temperature=0.5))
    assert "verdict='adjacency', score='topology'" in text
    assert "temperature=0.5" in text
    assert "slope=0.3" in repr(ts.DelaunayFilter(score="consensus", consensus=ts.ConsensusConfig(slope=0.3)))


def test_options_of_another_score_are_refused() -> None:
    for settings in ({"learnable_temperature": True}, {"trainable": True, "score": "consensus"}):
        with pytest.raises(ValueError, match=f"{next(iter(settings))} must be False where the score is"):
            ts.DelaunayFilter(**settings)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="straight_through must be False where the score is 'none'"):
        ts.DelaunayFilter(verdict="adjacency", score="none", straight_through=True)


def test_settings_replace_those_of_the_config() -> None:
    config = ts.FilterConfig(min_precision=0.9, min_group_size=7)
    assert ts.DelaunayFilter(config).config == config
    module = ts.DelaunayFilter(config, min_precision=None, threshold=0.3)
    assert module.config == replace(config, min_precision=None, threshold=0.3)


@pytest.mark.parametrize("score", ["learned", "consensus"])
def test_coordinates_that_are_no_pixels_are_marked(score: str) -> None:
    module = ts.DelaunayFilter(score=score)
    size = torch.tensor([320.0, 240.0])
    with pytest.warns(DomainWarning, match="expects keypoints in pixels, but those of pair 0 span less than 4 px"):
        module(LEFT / size, RIGHT / size)
    for scale in (1e18, 1e30):
        with pytest.raises(
            ValueError, match=r"keypoints0 must be pixels, at most 16777216 in magnitude, got .* of pair 0"
        ):
            module(LEFT * scale, RIGHT * scale)
    far = module(LEFT + 2.0**20, RIGHT + 2.0**20)  # far, but pixels
    assert bool(far.score.isfinite().all())
    verdict = ts.DelaunayFilter(verdict="cardinality")((LEFT * 1e18).double(), (RIGHT * 1e18).double())
    assert bool(verdict.inlier.all())  # the set test has no unit
    assert bool(verdict.score.isfinite().all())


def test_images_of_another_size_than_the_keypoints_are_marked() -> None:
    matches, image0, image1 = rendered(0)
    assert matches.cost is not None
    arguments = (matches.keypoints0, matches.keypoints1)
    with pytest.warns(DomainWarning, match="many of pair 0 lie outside"):
        ts.DelaunayFilter()(
            *arguments,
            cost=matches.cost,
            images0=image0[:, ::2, ::2].contiguous(),
            images1=image1[:, ::2, ::2].contiguous(),
        )


@pytest.mark.parametrize("score", ["learned", "consensus"])
def test_autocast_changes_no_verdict(score: str) -> None:
    """The cuts below are scores of the matches, so that one that was rounded before it is compared falls below."""
    left, right = scene(3, 100)
    right = torch.where(torch.arange(100)[:, None] % 3 == 0, right + 2 * left.flip(1) / 100, right)
    for cut in ts.DelaunayFilter(score=score)(left, right).score.sort().values[::10].tolist():
        module = ts.DelaunayFilter(score=score, threshold=cut)
        full = module(left, right)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            low = module(left, right)
        assert low.score.dtype == torch.bfloat16
        assert torch.equal(low.inlier, full.inlier)


def test_a_filter_made_in_inference_mode_can_be_trained() -> None:
    with torch.inference_mode():
        module = ts.DelaunayFilter(trainable=True)
    module(LEFT, RIGHT).score.sum().backward()
    assert any(parameter.grad is not None for parameter in module.parameters())


def test_a_refused_state_changes_nothing() -> None:
    module = ts.DelaunayFilter(verdict="adjacency", temperature=3.0)
    before = module.temperature.clone()
    other = ts.DelaunayFilter(verdict="adjacency", temperature=0.5, temperature_unit="px").state_dict()
    with pytest.raises(ValueError, match="temperature_unit"):
        module.load_state_dict(other)
    assert torch.equal(module.temperature, before)
    state = module.state_dict()
    module.load_state_dict({name: value.float() for name, value in state.items()})  # as a cast of a checkpoint does
    state["_extra_state"] = torch.zeros_like(state["_extra_state"])
    with pytest.raises(ValueError, match="no readable fingerprint"):
        module.load_state_dict(state)


@pytest.mark.filterwarnings("ignore:the score expects matches that agree")  # colours that match badly
def test_a_grey_view_may_stand_beside_one_in_colour() -> None:
    """As if its channel had been repeated, in the pipeline and in the module."""
    matches, image0, image1 = rendered(2)
    colour = torch.cat([image0, image0 // 2, image0 // 3])
    repeated = image1.expand(3, -1, -1)
    expected = ts.DelaunayFilter()(matches, images0=colour, images1=repeated).score
    assert torch.equal(ts.DelaunayFilter()(matches, images0=colour, images1=image1).score, expected)
    mixed, alike = (run_pipeline([(colour, view)]) for view in (image1, repeated))
    assert mixed.matches.num_matches > 0
    assert torch.equal(mixed.matches.keypoints1, alike.matches.keypoints1)
    assert torch.equal(mixed.score, alike.score)
