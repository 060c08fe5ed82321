"""The operators behind repair and refinement: both back ends, all instructions, the rules of torch."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops import _window_refine, _window_search
from tensor_stereo.ops.backends import native
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs
from tensor_stereo.scores import refine, refine_matches, repair, repair_matches
from tensor_stereo.scores.alignment import estimate_alignment
from tests.oracles import installed_backends

needs_native = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
OPERATORS: dict[str, tuple[ModuleType, ModuleType]] = {
    "window_search": (_window_search, repair),
    "window_refine": (_window_refine, refine),
}


def arguments_of(monkeypatch: pytest.MonkeyPatch, name: str, *, rectified: bool) -> list[Any]:
    """What repair or refinement of FAST matches of rendered pairs gives the operator, but for the back end."""
    pairs = to_gray_pairs([(pair.image0, pair.image1) for pair in map(render_pair, (0, 3))])
    matches = match_pairs(pairs, PipelineConfig(detector="fast"), Stopwatch())
    graphs = build_match_graphs(matches)
    alignment = estimate_alignment(matches, graphs, rectified=rectified)
    views = [pair[0][0] for pair in pairs], [pair[1][0] for pair in pairs]
    error = (matches.disparity - matches.disparity.median()).abs()
    kept = error < error.quantile(0.7)
    implementation, user = OPERATORS[name]
    run, seen = getattr(implementation, name), []

    def record(*args: Any) -> Any:
        seen.append(list(args[:-1]))
        return run(*args)

    monkeypatch.setattr(user, name, record)
    if name == "window_search":
        repair_matches(matches, *views, kept, alignment)
    else:
        refine_matches(matches, *views, kept, alignment, graphs)
    return seen[0]  # type: ignore[no-any-return]


@needs_native
@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("name", OPERATORS)
def test_back_ends_agree(monkeypatch: pytest.MonkeyPatch, name: str, rectified: bool) -> None:
    arguments = arguments_of(monkeypatch, name, rectified=rectified)
    run = getattr(OPERATORS[name][0], name)
    found, expected = (run(*arguments, backend) for backend in ("native", "scipy"))
    assert len(found[0]) > 100
    for one, other in zip(found, expected, strict=True):
        if one.dtype == torch.bool:
            assert torch.equal(one, other)
            continue
        # Minima of parabolas and sums of squares that float32 rounds in another order; where two places cost nearly the
        # same, or a step hardly lowers the cost, rounding may choose the other one.
        gap = (one - other).abs() / other.abs().clamp(min=1)
        assert (gap > 1e-3).double().mean() < 0.01
        assert gap.median() < 1e-5


@needs_native
@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("name", OPERATORS)
def test_bits_depend_on_no_instructions_and_no_threads(
    monkeypatch: pytest.MonkeyPatch, name: str, rectified: bool
) -> None:
    arguments = arguments_of(monkeypatch, name, rectified=rectified)
    implementation = OPERATORS[name][0]
    kernels, seen = native("native"), []

    class Kernels:
        def __getattr__(self, other: str) -> Any:
            def run(*args: Any) -> Any:
                seen.append(args[:-1])
                return getattr(kernels, other)(*args)

            return run

    monkeypatch.setattr(implementation, "native", lambda backend: Kernels())
    first = getattr(implementation, name)(*arguments, "native")
    runs = 0
    for vectors in range(4):
        try:
            found = getattr(kernels, name)(*seen[0], 1 + vectors % 2, vectors)
        except ValueError:  # this machine lacks them
            continue
        runs += 1
        for one, other in zip(found, first, strict=True):
            np.testing.assert_array_equal(one, other)
    assert runs >= 2


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("name", OPERATORS)
def test_operator_keeps_the_rules_of_torch(monkeypatch: pytest.MonkeyPatch, name: str, backend: str) -> None:
    arguments = arguments_of(monkeypatch, name, rectified=True)
    torch.library.opcheck(getattr(torch.ops.tensor_stereo, name).default, (*arguments, backend))


@needs_native
@pytest.mark.parametrize("name", OPERATORS)
def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    arguments = arguments_of(monkeypatch, name, rectified=True)
    run = getattr(OPERATORS[name][0], name)
    for place, message in ((1, "one entry per pair"), (6, "one entry per"), (4, "one entry per pair")):
        wrong = list(arguments)
        wrong[place] = arguments[place][:-1]
        with pytest.raises(ValueError, match=message):
            run(*wrong, "native")
