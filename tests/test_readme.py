"""What the README shows is what it prints."""

from __future__ import annotations

import doctest
from pathlib import Path

import cv2
import pytest
import torch

from tensor_stereo import DelaunayFilter
from tensor_stereo.datasets.synthetic.rendering import render_pair

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not README.is_file(), reason="the README is not installed with the tests")
def test_examples_print_what_they_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = render_pair(1)
    for name, image in (("left", pair.image0), ("right", pair.image1)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[0].numpy())
    monkeypatch.chdir(tmp_path)
    torch.set_printoptions(profile="default")
    failed, tried = doctest.testfile(str(README), module_relative=False)
    assert tried > 10
    assert failed == 0
    assert (tmp_path / "matches.png").stat().st_size > 10_000


@pytest.mark.parametrize("seed", range(5))
def test_the_first_example_is_good_whatever_the_points(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    left = torch.rand(1000, 2, generator=generator) * torch.tensor([640.0, 480.0])
    right = left - torch.tensor([25.0, 0.0])
    right[:300] = right[:300].flip(0)
    for points in (torch.float32, torch.float64):
        inlier = DelaunayFilter()(left.to(points), right.to(points)).inlier
        assert int(inlier[:300].sum()) <= 5
        assert int(inlier[300:].sum()) >= 690
