from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops import _window_evidence as operator
from tensor_stereo.ops._window_evidence import window_evidence
from tensor_stereo.ops.backends import native
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs
from tensor_stereo.scores import image_evidence, measure_images
from tensor_stereo.scores.alignment import estimate_alignment
from tests.oracles import installed_backends

needs_native = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")


def arguments_of(monkeypatch: pytest.MonkeyPatch, seeds: tuple[int, ...], *, rectified: bool) -> list[Any]:
    """What ``measure_images`` gives the operator, for FAST matches of rendered pairs, but for the back end."""
    pairs = to_gray_pairs([(pair.image0, pair.image1) for pair in map(render_pair, seeds)])
    matches = match_pairs(pairs, PipelineConfig(detector="fast"), Stopwatch())
    graphs = build_match_graphs(matches)
    alignment = estimate_alignment(matches, graphs, rectified=rectified)
    seen: list[Any] = []

    def record(*args: Any) -> Any:
        seen.append(list(args[:-1]))
        return window_evidence(*args)

    monkeypatch.setattr(image_evidence, "window_evidence", record)
    measure_images([pair[0][0] for pair in pairs], [pair[1][0] for pair in pairs], matches, graphs, alignment)
    assert bool(alignment.rectified.all()) == rectified
    return seen[0]  # type: ignore[no-any-return]


@needs_native
@pytest.mark.parametrize("rectified", [True, False])
def test_back_ends_agree(monkeypatch: pytest.MonkeyPatch, rectified: bool) -> None:
    arguments = arguments_of(monkeypatch, (0, 3), rectified=rectified)
    found, expected = (window_evidence(*arguments, backend) for backend in ("native", "scipy"))
    assert len(found[0]) > 400
    for one, other in zip(found, expected, strict=True):
        gap = (one - other).abs()
        # of sums of squares in another order; where windows are 100 levels apart, 3e-4 (test_image_evidence.py)
        assert gap.max() < 6e-4
        assert (gap > 1e-4).double().mean() < 1e-4


@needs_native
@pytest.mark.parametrize("rectified", [True, False])
def test_bits_depend_on_no_instructions_and_no_threads(monkeypatch: pytest.MonkeyPatch, rectified: bool) -> None:
    arguments = arguments_of(monkeypatch, (0, 3), rectified=rectified)
    seen: list[Any] = []
    kernels = native("native")

    class Kernels:
        def window_evidence(self, *args: Any) -> Any:
            seen.append(args[:-1])
            return kernels.window_evidence(*args)  # type: ignore[union-attr]

    monkeypatch.setattr(operator, "native", lambda backend: Kernels())
    first = window_evidence(*arguments, "native")
    runs = []
    for vectors in range(4):
        try:
            runs.append(kernels.window_evidence(*seen[0], 1 + vectors % 2, vectors))  # type: ignore[union-attr]
        except ValueError:  # this machine lacks them
            assert vectors >= 2
    assert len(runs) >= 2
    for run in runs:
        for one, other in zip(run, first, strict=True):
            np.testing.assert_array_equal(one, other)


@needs_native
def test_a_batch_is_its_pairs_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = arguments_of(monkeypatch, (0, 3), rectified=True)
    found = window_evidence(*whole, "native")
    ptr = whole[11].tolist()
    for b in (0, 1):
        rows = slice(ptr[b], ptr[b + 1])
        own = [value[b : b + 1] for value in whole[:5]] + [value[rows] for value in whole[5:11]]
        alone = [*own, torch.tensor([0, rows.stop - rows.start]), *(value[b : b + 1] for value in whole[12:16])]
        for one, other in zip(window_evidence(*alone, whole[16], "native"), found, strict=True):
            assert torch.equal(one, other[rows])


@needs_native
def test_slopes_and_places_that_are_no_numbers_are_read_inside_of_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    for rectified in (True, False):
        arguments = arguments_of(monkeypatch, (0,), rectified=rectified)
        slope, left, along = (arguments[k].clone() for k in (10, 5, 7))
        slope[:5] = torch.tensor([[torch.nan, 0], [2, 0], [-2, 0], [torch.inf, 1], [0, -torch.inf]])
        left[5], along[6] = torch.nan, torch.nan
        arguments[10], arguments[5], arguments[7] = slope, left, along
        values = window_evidence(*arguments, "native")[0]
        assert values[7:].isfinite().all()


@pytest.mark.parametrize("backend", installed_backends())
def test_operator_keeps_the_rules_of_torch(monkeypatch: pytest.MonkeyPatch, backend: str) -> None:
    arguments = arguments_of(monkeypatch, (0,), rectified=True)
    few = [value[:9] for value in arguments[5:11]]
    small = [*arguments[:5], *few, torch.tensor([0, 9]), *arguments[12:]]
    torch.library.opcheck(torch.ops.tensor_stereo.window_evidence.default, (*small, backend))


@needs_native
@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, [torch.zeros(5, 5, dtype=torch.int16)], "images must be uint8 or float32"),
        (0, [torch.zeros(0, 5, dtype=torch.uint8)], "images must not be empty"),
        (1, [], "one entry per pair"),
        (8, torch.zeros(2), "one entry per match"),
        (11, torch.tensor([0, 3]), "ptr must rise"),
        (13, torch.tensor([257]), "count must be in 1..256"),
        (13, torch.tensor([0]), "count must be in 1..256"),
        (16, 3, "width must be at least every count"),
    ],
)
def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch, place: int, value: Any, message: str) -> None:
    arguments = arguments_of(monkeypatch, (0,), rectified=True)
    arguments[place] = value
    with pytest.raises(ValueError, match=message):
        window_evidence(*arguments, "native")
