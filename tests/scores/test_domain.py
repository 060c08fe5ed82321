"""Pairs outside of the domain of a score are marked once, and others are not."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches
from tensor_stereo.scores.domain import DomainWarning
from tests.interop.matchers import scene


def pair(right: Tensor, left: Tensor | None = None) -> ts.Matches:
    return ts.Matches(scene(1, 200)[0] if left is None else left, right, torch.tensor([0, len(right)]))


def wrong_rows(rows: float, wrong: float = 0.3) -> ts.Matches:
    """A pair whose right image lies ``rows`` px lower, with some wrong matches."""
    left, right = scene(1, 200, wrong)
    return pair(right + torch.tensor([0.0, rows]), left)


def turned(degrees: float) -> ts.Matches:
    left = scene(2, 200)[0]
    angle = math.radians(degrees)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return pair((left - 160) @ turn.T + 160, left)


def marks(matches: ts.Matches, **settings: object) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ts.DelaunayFilter(**settings)(matches)
    assert all(issubclass(item.category, DomainWarning) for item in caught)
    return [str(item.message) for item in caught]


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.parametrize("rows", [1.0, -1.0, 40.0])
def test_a_row_offset_is_taken_out_and_no_matter_for_a_warning(rows: float, score: str) -> None:
    assert not marks(wrong_rows(rows), score=score)


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.parametrize("degrees", [8.0, 20.0, -45.0])
def test_a_turned_view_gets_one_warning_that_says_what_to_set(degrees: float, score: str) -> None:
    (text,) = marks(turned(degrees), score=score)
    for words in ("rectified pairs", "of pair 0", "consensus=UNRECTIFIED", "'cardinality'"):
        assert words in text


def test_of_a_batch_there_is_one_warning_with_the_number_of_pairs() -> None:
    good, bad = wrong_rows(0.0), turned(20.0)
    (text,) = marks(collate_matches([good, bad, good, bad]))
    assert "2 of 4 pairs" in text
    (text,) = marks(collate_matches([good, bad, good]))
    assert "of pair 1 " in text


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6, 0.8, 1.0])
def test_rectified_pairs_with_wrong_matches_are_not_marked(wrong: float) -> None:
    assert not marks(wrong_rows(0.0, wrong))


@pytest.mark.parametrize("seed", range(4))
def test_small_groups_that_agree_by_themselves_are_no_evidence(seed: int) -> None:
    left, right = scene(seed, 240, 0.9)
    group = torch.arange(240) % 40  # six matches each
    assert not marks(ts.Matches(left, right, torch.tensor([0, 240]), group=group))


def test_noise_of_either_sign_is_no_row_offset() -> None:
    left = scene(3, 200)[0]
    noise = 1.3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    assert not marks(pair(left - torch.tensor([12.0, 0.0]) + noise, left))


@pytest.mark.parametrize(
    "settings",
    [
        {"consensus": ts.UNRECTIFIED},
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
    for settings in ({}, {"score": "consensus"}, {"consensus": ts.UNRECTIFIED}):
        (text,) = marks(pair(right, left), **settings)
        assert "multiply normalised coordinates by the size of the image" in text
