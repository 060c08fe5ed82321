from __future__ import annotations

import pytest
import torch

from tensor_stereo.types import Features, Matches, StereoPair

POINTS, PTR = torch.rand(3, 2), torch.tensor([0, 3])


@pytest.mark.parametrize(
    ("name", "error", "arguments"),
    [
        ("keypoints0", ValueError, {"keypoints0": torch.rand(3, 3)}),
        ("keypoints0", TypeError, {"keypoints0": torch.zeros(3, 2, dtype=torch.int64)}),
        ("keypoints1", TypeError, {"keypoints1": POINTS.half()}),
        ("keypoints1", ValueError, {"keypoints1": POINTS[:2]}),
        ("ptr", ValueError, {"ptr": torch.tensor([0, 2])}),
        ("ptr", ValueError, {"ptr": torch.tensor([0, 2, 1, 3])}),
        ("ptr", ValueError, {"ptr": torch.tensor([1, 3])}),
        ("ptr", TypeError, {"ptr": PTR.int()}),
        ("cost", ValueError, {"cost": torch.rand(2)}),
        ("group", ValueError, {"group": torch.zeros(4, dtype=torch.int64)}),
        ("group", TypeError, {"group": torch.zeros(3)}),
    ],
)
def test_matches_name_a_bad_argument(name: str, error: type[Exception], arguments: dict) -> None:
    with pytest.raises(error, match=name):
        Matches(**{"keypoints0": POINTS, "keypoints1": POINTS, "ptr": PTR, **arguments})


def test_features_name_a_bad_argument() -> None:
    with pytest.raises(ValueError, match="descriptors"):
        Features(POINTS, PTR, torch.rand(2, 8), torch.rand(3))
    with pytest.raises(ValueError, match="scores"):
        Features(POINTS, PTR, torch.rand(3, 8), torch.rand(2))


def test_pair_names_a_bad_argument() -> None:
    image = torch.zeros(1, 4, 5, dtype=torch.uint8)
    with pytest.raises(ValueError, match="image0 and image1 of 'a'"):
        StereoPair("a", image, image[:, :3])
    with pytest.raises(ValueError, match="disparity_gt of 'a'"):
        StereoPair("a", image, image, disparity_gt=torch.zeros(5, 4))


def test_disparity_is_positive_to_the_left() -> None:
    assert Matches(POINTS, POINTS - torch.tensor([2.0, 0.0]), PTR).disparity.tolist() == pytest.approx([2.0] * 3)
