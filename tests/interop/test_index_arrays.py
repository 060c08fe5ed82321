from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.interop.glue_factory import from_glue_factory
from tensor_stereo.interop.index_arrays import index_matches

Arrays = dict[str, np.ndarray]


def points_of(seed: int) -> Arrays:
    rng = np.random.default_rng(seed)
    return {"keypoints0": rng.random((12, 2)), "keypoints1": rng.random((9, 2))}


def mutual(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(12,) and (9,) partners of each other, with -1 and -2 where there is none."""
    rng = np.random.default_rng(seed)
    rows0, rows1 = rng.permutation(12)[:7], rng.permutation(9)[:7]
    matches0, matches1 = rng.integers(-2, 0, 12), rng.integers(-2, 0, 9)
    matches0[rows0], matches1[rows1] = rows1, rows0
    return matches0, matches1


@given(st.integers(0, 10**6), st.booleans())
def test_partners_agree_with_the_converter_of_glue_factory(seed: int, has_scores: bool) -> None:
    rng = np.random.default_rng(seed)
    arrays = points_of(seed) | {"matches0": rng.integers(-2, 9, 12)}
    if has_scores:
        arrays["matching_scores0"] = rng.random(12)
    same, _ = from_glue_factory({name: torch.from_numpy(values)[None] for name, values in arrays.items()})
    picked, indices = index_matches("m", arrays)
    for name in ("keypoints0", "keypoints1", "ptr", "cost"):
        a, b = getattr(picked, name), getattr(same, name)
        assert (a is None and b is None) or torch.equal(a, b), name
    np.testing.assert_array_equal(indices.mask, arrays["matches0"] >= 0)


@given(st.integers(0, 10**6), st.booleans())
def test_every_form_of_the_same_matches_gives_the_same_pairs(seed: int, has_batch_axis: bool) -> None:
    matches0, matches1 = mutual(seed)
    rows0 = np.flatnonzero(matches0 >= 0)
    pairs = np.stack([rows0, matches0[rows0]], axis=1)
    expected = {(int(i), int(j)) for i, j in pairs}
    forms = {
        "matches0": matches0,
        "matches1": matches1.astype(np.int16),
        "matches01": pairs.astype(np.uint32),
        "matches": pairs.astype(np.float32),
    }
    forms_of_matches: list[Arrays] = [{name: values} for name, values in forms.items()]
    forms_of_matches += [
        {"matches": matches0},
        {"matches01": matches0},
        forms,
        {"matches": pairs, "matches1": matches1},
    ]
    for form in forms_of_matches:
        arrays = points_of(seed) | form
        if has_batch_axis:
            arrays = {name: values[None] for name, values in arrays.items()}
        matches, indices = index_matches("m", arrays)
        assert indices.pairs() == expected
        first = next(name for name in ("matches0", "matches", "matches01", "matches1") if name in form)
        of_both = arrays[first].shape[-1] == 2
        assert indices.mask.shape == (arrays[first].shape[:-1] if of_both else arrays[first].shape)
        for k, (i, j) in enumerate(zip(indices.rows0, indices.rows1, strict=True)):
            assert matches.keypoints0[k].tolist() == points_of(seed)["keypoints0"][i].tolist()
            assert matches.keypoints1[k].tolist() == points_of(seed)["keypoints1"][j].tolist()


@pytest.mark.parametrize("is_batch", [False, True])
@pytest.mark.parametrize("num0", [2, 3])
def test_one_match_is_told_from_two_keypoints(num0: int, is_batch: bool) -> None:
    """(1, 2) is one pair of rows, or the partners of the two keypoints of a batch of one."""
    points = np.arange(2.0 * num0).reshape(num0, 2)
    arrays = {"keypoints0": points, "keypoints1": points}
    if is_batch:
        arrays = {name: values[None] for name, values in arrays.items()}
    _, indices = index_matches("m", arrays | {"matches": np.array([[1, 0]])})
    assert indices.pairs() == ({(0, 1), (1, 0)} if is_batch and num0 == 2 else {(1, 0)})


@pytest.mark.parametrize(
    ("index", "confidence"),
    [
        ("matches0", "matching_scores0"),
        ("matches0", "match_confidence0"),
        ("matches", "match_confidence"),
        ("matches", "scores"),
        ("matches", "confidence"),
        ("matches01", "scores"),
        ("matches1", "matching_scores1"),
        ("matches1", "match_confidence1"),
    ],
)
def test_the_cost_is_one_less_the_confidence(index: str, confidence: str) -> None:
    points = np.arange(8.0).reshape(4, 2)
    partner, values = np.array([2, -1, 0, 3]), np.array([0.5, 0.1, 0.25, 1.0])
    if confidence in ("scores", "confidence"):
        partner, values = np.array([[0, 2], [2, 0], [3, 3]]), values[[0, 2, 3]]
    matches, _ = index_matches("m", {"keypoints0": points, "keypoints1": points, index: partner, confidence: values})
    assert matches.cost is not None
    assert matches.cost.tolist() == [0.5, 0.75, 0.0]


def test_a_matcher_that_is_not_mutual_may_leave_matches1_short() -> None:
    points = np.arange(8.0).reshape(4, 2)
    arrays = {"keypoints0": points, "keypoints1": points, "matches0": np.array([2, 2, -1, 3])}
    _, indices = index_matches("m", arrays | {"matches1": np.array([-1, -1, 1, 3])})
    assert indices.pairs() == {(0, 2), (1, 2), (3, 3)}


@pytest.mark.parametrize(
    ("other", "values"),
    [("matches1", [-1, 3, -1]), ("matches", [[0, 1]]), ("matches01", [0, 1, -1, -1])],
)
def test_index_arrays_that_disagree_are_named(other: str, values: list[int]) -> None:
    arrays = {"keypoints0": np.eye(4)[:, :2], "keypoints1": np.eye(3)[:, :2], "matches0": np.array([0, -1, -1, -1])}
    with pytest.raises(ValueError, match=f"m: matches0 and {other} must name the same matches"):
        index_matches("m", arrays | {other: np.array(values)})


def test_unmatched_keypoints_and_scores_may_hold_anything() -> None:
    points = np.array([[0.0, 1.0], [np.nan, np.inf], [2.0, 5.0]])
    arrays = {"keypoints0": points, "keypoints1": points, "matches0": np.array([2, -1])}
    with pytest.raises(ValueError, match="m: matches0 has 2 rows, but there are 3 keypoints0"):
        index_matches("m", arrays)
    scores = {"matching_scores0": np.array([0.25, np.nan])}
    picked, _ = index_matches("m", arrays | scores, may_be_short=True)
    assert picked.keypoints1.tolist() == [[2.0, 5.0]]
    assert picked.cost is not None
    assert picked.cost.tolist() == [0.75]


NAN = float("nan")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"matches0": [0, 3, -1]}, "place: matches0 must be -1, -2 or one of 3 keypoints1, got 3 in row 1"),
        ({"matches0": [0, -3, -1]}, "place: matches0 .* got -3 in row 1"),
        ({"matches0": [0, 1, 2, -1]}, "place: matches0 has 4 rows, but there are 3 keypoints0"),
        ({"matches1": [0, 1, 2, -1]}, "place: matches1 has 4 rows, but there are 3 keypoints1"),
        ({"matches1": [0, 5, 2]}, "place: matches1 must be -1, -2 or one of 3 keypoints0, got 5 in row 1"),
        ({"matches": [[0, 0], [2, 3]]}, "place: matches must be -1, -2 or one of 3 keypoints1, got 3 in row 1"),
        ({"matches": np.array([[4294967295, 0]], dtype=np.uint32)}, "one of 3 keypoints0, got 4294967295 in row 0"),
        ({"matches": np.array([[2**64 - 1, 0]], dtype=np.uint64)}, "'matches' must hold integers, got 184467440737095"),
        ({"matches": [[0.0, 0.5]]}, "'matches' must hold integers, got 0.5"),
        ({"matches": [[0.0, NAN]]}, "'matches' must hold integers, got nan"),
        ({"matches": [[True, False]]}, "'matches' must hold integers, got bool"),
        ({"matches": [[[0, 0]], [[1, 1]]]}, r"'matches' must have shape \(N, 2\), or \(1, N, 2\), got \(2, 1, 2\)"),
        ({"matches": [[0, 1, 2], [0, 1, 2]]}, r"'matches' must have shape .*, got \(2, 3\)"),
        ({"matches0": [[0, 1, 2], [0, 1, 2]]}, r"'matches0' must have shape \(N,\), or \(1, N\), got \(2, 3\)"),
        ({"matches0": [0, -1, 2], "matching_scores0": [0.5, 0.5, NAN]}, "matching_scores0 .* got NaN in row 2"),
        ({"matches0": [0, -1, 2], "matching_scores0": [0.5, 0.5]}, r"'matching_scores0' must have shape \(3,\)"),
        ({"matches0": [-1, 1, 0]}, r"place: keypoints0, row 1, must be finite, .* got \(nan, 3.0\)"),
        ({"matches0": [1, -1, 0]}, r"place: keypoints1, row 1, must be finite, .* got \(nan, 3.0\)"),
    ],
)
def test_what_is_wrong_is_named_by_place_and_row(arrays: dict[str, object], message: str) -> None:
    points = np.array([[0.0, 1.0], [np.nan, 3.0], [4.0, 5.0]])
    given_ = {name: np.asarray(values) for name, values in arrays.items()}
    with pytest.raises(ValueError, match=message):
        index_matches("place", {"keypoints0": points, "keypoints1": points} | given_)
