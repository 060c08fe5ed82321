"""Pairs outside of the domain of a score are marked once, and others are not."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches
from tensor_stereo.scores.domain import Domain, DomainWarning, check_images, describe_domain
from tests.interop.matchers import scene


def pair(right: Tensor, left: Tensor | None = None) -> ts.Matches:
    return ts.Matches(scene(1, 200)[0] if left is None else left, right, torch.tensor([0, len(right)]))


def wrong_rows(rows: float, wrong: float = 0.3) -> ts.Matches:
    """A pair whose right image lies ``rows`` px lower, with some wrong matches."""
    left, right = scene(1, 200, wrong)
    return pair(right + torch.tensor([0.0, rows]), left)


def turned(degrees: float) -> ts.Matches:
    left = scene(2, 200)[0]
    return pair(turned_points(left, degrees), left)


def turned_points(points: Tensor, degrees: float) -> Tensor:
    angle = math.radians(degrees)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return (points - 160) @ turn.T + 160


def marks(matches: ts.Matches, **settings: object) -> list[str]:
    return run(matches, **settings)[1]


def run(matches: ts.Matches, **settings: object) -> tuple[list[Domain] | None, list[str]]:
    """The mark of every pair, and what the warnings say. Scores are finite whatever the pair."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        output = ts.DelaunayFilter(**settings)(matches)
    assert all(issubclass(item.category, DomainWarning) for item in caught)
    assert output.score is None or bool(output.score.isfinite().all())
    texts = [str(item.message) for item in caught]
    if output.domain is None:
        return None, texts
    assert output.domain.dtype == torch.int8
    return [Domain(mark) for mark in output.domain.tolist()], texts


def shuffled(seed: int = 1, count: int = 200) -> ts.Matches:
    left, right = scene(seed, count, 0.0)
    return pair(right[torch.randperm(count, generator=torch.Generator().manual_seed(seed))], left)


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.parametrize("rows", [1.0, -1.0, 40.0])
def test_a_row_offset_is_taken_out_and_no_matter_for_a_warning(rows: float, score: str) -> None:
    assert not marks(wrong_rows(rows), score=score)


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.parametrize("degrees", [8.0, 20.0, -45.0])
def test_a_turned_view_gets_one_warning_that_says_what_to_set(degrees: float, score: str) -> None:
    found, (text,) = run(turned(degrees), score=score)
    assert found == [Domain.ROWS]
    for words in ("rectified pairs", "of pair 0", "rectified=False", "'auto'"):
        assert words in text


def test_of_a_batch_there_is_one_warning_with_the_number_of_pairs() -> None:
    good, bad = wrong_rows(0.0), turned(20.0)
    found, (text,) = run(collate_matches([good, bad, good, bad]))
    assert found == [0, Domain.ROWS, 0, Domain.ROWS]
    assert "2 of 4 pairs" in text
    (text,) = marks(collate_matches([good, bad, good]))
    assert "of pair 1 " in text


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6, 0.8])
def test_rectified_pairs_with_wrong_matches_are_not_marked(wrong: float) -> None:
    assert run(wrong_rows(0.0, wrong)) == ([Domain(0)], [])


@pytest.mark.parametrize("seed", range(4))
def test_small_groups_that_agree_by_themselves_are_no_evidence(seed: int) -> None:
    left, right = scene(seed, 240, 0.9)
    group = torch.arange(240) % 40  # six matches each
    found, _ = run(ts.Matches(left, right, torch.tensor([0, 240]), group=group))
    assert found == [Domain.AGREEMENT]  # and not ROWS


def test_noise_of_either_sign_is_no_row_offset() -> None:
    left = scene(3, 200)[0]
    noise = 1.3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    assert not marks(pair(left - torch.tensor([12.0, 0.0]) + noise, left))


@pytest.mark.parametrize(
    "settings",
    [
        {"rectified": False},
        {"rectified": "auto"},
        {"verdict": "cardinality"},
        {"score": "topology", "threshold": 0.5},
        {"verdict": "adjacency", "score": "none"},
    ],
)
def test_what_does_not_look_at_rows_does_not_mark_them(settings: dict[str, object]) -> None:
    assert not marks(wrong_rows(5.0), **settings)


def test_few_matches_say_nothing_about_their_pair() -> None:
    left = scene(4, 7)[0]
    assert not marks(pair(left / 100 + torch.tensor([0.0, 3.0]), left / 100))
    assert not marks(pair(torch.zeros(0, 2), torch.zeros(0, 2)))


def test_normalised_coordinates_are_marked_by_either_score() -> None:
    left, right = (points / 320 for points in scene(5, 200))
    for settings in ({}, {"score": "consensus"}, {"rectified": False}):
        found, (text,) = run(pair(right, left), **settings)
        assert found == [Domain.SPAN]
        assert "multiply normalised coordinates by the size of the image" in text


@pytest.mark.parametrize("score", ["learned", "consensus"])
def test_shuffled_matches_agree_on_nothing(score: str) -> None:
    found, (text,) = run(shuffled(), score=score)
    assert found == [Domain.AGREEMENT]
    for words in ("agree with their neighbours", "those of pair 0 hardly do", "row i of both views"):
        assert words in text
    found, (text,) = run(collate_matches([wrong_rows(0.0), shuffled(2), shuffled(3)]), score=score)
    assert found == [0, Domain.AGREEMENT, Domain.AGREEMENT]
    assert "those of 2 of 3 pairs hardly do" in text


def test_a_drift_that_no_calibration_error_explains_is_marked() -> None:
    left, right = scene(6, 300, 0.1)
    found, (text,) = run(pair(right + torch.stack([torch.zeros(300), 0.09 * left[:, 0]], 1), left))
    assert found == [Domain.ROWS]
    assert "lie off their rows" in text


def test_few_matches_that_agree_on_nothing_are_marked_without_a_warning() -> None:
    for count in (1, 4, 12, 31):
        assert run(shuffled(3, count)) == ([Domain.AGREEMENT], [])
    for count in (32, 60):
        found, texts = run(shuffled(3, count))
        assert (found, len(texts)) == ([Domain.AGREEMENT], 1)
    assert run(pair(torch.zeros(0, 2), torch.zeros(0, 2))) == ([Domain(0)], [])


def test_untested_matches_cause_no_warning() -> None:
    left, right = scene(4, 240, 1.0)
    small = ts.Matches(left, right, torch.tensor([0, 240]), group=torch.arange(240) // 3)  # groups of three
    assert run(small) == ([Domain.AGREEMENT], [])
    _, texts = run(small, min_group_size=3)
    assert len(texts) == 1


@pytest.mark.parametrize(
    "settings", [{"score": "topology", "threshold": 0.5}, {"verdict": "adjacency", "score": "none"}]
)
def test_what_is_no_probability_has_no_domain(settings: dict[str, object]) -> None:
    assert run(shuffled(), **settings) == (None, [])


@pytest.mark.parametrize("rectified", [False, "auto"])
def test_of_any_two_views_those_are_marked_that_have_nothing_in_common(rectified: object) -> None:
    found, (text,) = run(shuffled(), rectified=rectified)
    assert found == [Domain.AGREEMENT]
    assert "hardly do" in text
    assert run(turned(20.0), rectified=rectified) == ([Domain(0)], [])


def test_a_pair_may_have_several_reasons() -> None:
    view = [torch.zeros(1, 240, 320, dtype=torch.uint8)]
    mixed = shuffled()
    mixed = ts.Matches(mixed.keypoints0 * 3, mixed.keypoints1, mixed.ptr)
    with pytest.warns(DomainWarning) as caught:
        output = ts.DelaunayFilter()(mixed, images0=view, images1=view)
    assert {str(item.message).partition(",")[0] for item in caught} == {
        "the score expects matches that agree with their neighbours",
        "the score expects keypoints in pixels of the images",
    }
    assert output.domain.tolist() == [Domain.AGREEMENT | Domain.IMAGES]
    assert describe_domain(int(output.domain)) == "agreement, images"
    assert [describe_domain(reason) for reason in (0, *Domain)] == [
        *("", "span", "agreement", "rows", "images", "epipole")
    ]


def test_images_are_checked_pair_by_pair() -> None:
    view = torch.zeros(1, 240, 320, dtype=torch.uint8)
    inside, outside = wrong_rows(0.0), pair(scene(1, 200)[1] * 2)
    with pytest.warns(DomainWarning, match="many of pair 1 lie outside"):
        found = check_images(collate_matches([inside, outside, inside]), ([view] * 3, [view] * 3))
    assert found.tolist() == [0, Domain.IMAGES, 0]


def test_marks_are_in_the_order_of_the_pairs_in_every_layout() -> None:
    good, bad = wrong_rows(0.0), shuffled(1)
    left, right = (torch.stack([getattr(p, name) for p in (good, bad)]) for name in ("keypoints0", "keypoints1"))
    module = ts.DelaunayFilter()
    with pytest.warns(DomainWarning):
        assert module(left, right).domain.tolist() == [0, Domain.AGREEMENT]
    assert module(left[0], right[0]).domain.tolist() == [0]
