"""Archives as matchers write them."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensor_stereo import Matches, filter_file
from tensor_stereo.configs import FileFilterConfig, FilterConfig
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.interop.npz import filter_npz
from tensor_stereo.interop.verdicts import Verdicts
from tests.interop.match_batches import batch, exact_filter, expected_exactly
from tests.interop.test_npz import filtered

Arrays = dict[str, np.ndarray]


def scattered(seed: int) -> tuple[Arrays, Matches, np.ndarray]:
    """Equally many keypoints in both views, most of them matched but not in order; the matches; and their rows."""
    rng = np.random.default_rng(seed)
    matches = batch(seed, [40])
    rows0, rows1 = np.sort(rng.permutation(50)[:40]), rng.permutation(50)[:40]
    points = {f"keypoints{view}": rng.uniform(0, 300, (50, 2)) for view in (0, 1)}
    points["keypoints0"][rows0], points["keypoints1"][rows1] = matches.keypoints0, matches.keypoints1
    plain = Matches(matches.keypoints0, matches.keypoints1, matches.ptr)
    return points, plain, np.stack([rows0, rows1], axis=1)


def superglue(seed: int) -> tuple[Arrays, Verdicts, np.ndarray]:
    """``match_pairs.py`` of SuperGlue before matches1: ``matches`` (N0,) with -1, ``match_confidence``."""
    points, plain, rows = scattered(seed)
    partner, confidence = np.full(50, -1), np.zeros(50, dtype=np.float32)
    partner[rows[:, 0]] = rows[:, 1]
    confidence[rows[:, 0]] = np.random.default_rng(seed).random(40).astype(np.float32)
    cost = torch.from_numpy(1 - confidence[rows[:, 0]].astype(np.float64))
    expected = expected_exactly(Matches(plain.keypoints0, plain.keypoints1, plain.ptr, cost))
    return {**points, "matches": partner, "match_confidence": confidence}, expected, rows[:, 0]


def lightglue(seed: int) -> tuple[Arrays, Verdicts, np.ndarray]:
    """LightGlue's ``matches`` (S, 2) and ``scores`` (S,), as ``rbd`` leaves them."""
    points, plain, rows = scattered(seed)
    scores = np.random.default_rng(seed).random(40)
    expected = expected_exactly(Matches(plain.keypoints0, plain.keypoints1, plain.ptr, torch.from_numpy(1 - scores)))
    return {**points, "matches": rows, "scores": scores, "stop": np.array(9)}, expected, np.arange(40)


def loftr(seed: int) -> tuple[Arrays, Verdicts, np.ndarray]:
    """LoFTR's ``mkpts0_f``, ``mkpts1_f`` and ``mconf`` beside the coarse ones."""
    matches = batch(seed, [40])
    confidence = np.random.default_rng(seed).random(40)
    cost = torch.from_numpy(1 - confidence)
    expected = expected_exactly(Matches(matches.keypoints0, matches.keypoints1, matches.ptr, cost))
    arrays = {"mkpts0_f": matches.keypoints0.numpy(), "mkpts1_f": matches.keypoints1.numpy(), "mconf": confidence}
    return {**arrays, "mkpts0_c": np.zeros((40, 2)), "mkpts1_c": np.zeros((40, 2))}, expected, np.arange(40)


def matched_points(seed: int) -> tuple[Arrays, Verdicts, np.ndarray]:
    """``mkpts0``, ``mkpts1`` beside all keypoints, of which both views have equally many."""
    points, plain, _ = scattered(seed)
    arrays = {"mkpts0": plain.keypoints0.numpy(), "mkpts1": plain.keypoints1.numpy(), **points}
    return arrays, expected_exactly(plain), np.arange(40)


FORMS = (superglue, lightglue, loftr, matched_points)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("has_batch_axis", [False, True])
def test_every_form_gets_the_verdicts_of_its_matches(tmp_path: Path, form: Any, has_batch_axis: bool) -> None:
    arrays, expected, places = form(3)
    if has_batch_axis:
        arrays = {name: values[None] if values.ndim else values for name, values in arrays.items()}
    result = filtered(tmp_path, arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(result[name], values)
    for name, values in expected._asdict().items():
        given = result[name][0] if has_batch_axis else result[name]
        np.testing.assert_array_equal(given[places], values)
        assert not np.delete(given, places).any()


def test_correct_matches_of_superglue_are_kept(tmp_path: Path) -> None:
    """Rows of both views are not paired because both have equally many keypoints."""
    rng = np.random.default_rng(0)
    points0 = rng.uniform(0, 400, (200, 2))
    order = rng.permutation(200)
    points1 = (points0 - [12.0, 0.0])[order]
    np.savez(tmp_path / "in.npz", keypoints0=points0, keypoints1=points1, matches=np.argsort(order))
    assert filter_file(tmp_path / "in.npz", tmp_path / "out.npz").num_kept == 200


@pytest.mark.parametrize("name", ["batch_indexes", "m_bids", "b_ids"])
def test_rows_of_several_pairs_may_be_mixed(tmp_path: Path, name: str) -> None:
    matches = batch(5, [30, 20, 25])
    pair = np.repeat([7, 3, 9], [30, 20, 25])
    order = np.random.default_rng(0).permutation(75)
    arrays = {
        "keypoints0": matches.keypoints0.numpy()[order],
        "keypoints1": matches.keypoints1.numpy()[order],
        name: pair[order],
    }
    result = filtered(tmp_path, arrays)
    expected = expected_exactly(Matches(matches.keypoints0, matches.keypoints1, matches.ptr))
    # duplicates are told by their order in the file, so the rows of each pair are compared in that order
    for number in (7, 3, 9):
        rows = np.flatnonzero(pair[order] == number)
        part = Matches(
            torch.from_numpy(arrays["keypoints0"][rows]),
            torch.from_numpy(arrays["keypoints1"][rows]),
            torch.tensor([0, len(rows)]),
        )
        for key, values in expected_exactly(part)._asdict().items():
            np.testing.assert_array_equal(result[key][rows], values)
    assert len(expected.inlier) == 75


def test_kornias_dictionary_has_its_confidence_as_cost(tmp_path: Path) -> None:
    matches = batch(6, [40])
    confidence = np.random.default_rng(1).random(40)
    arrays = {"keypoints0": matches.keypoints0.numpy(), "keypoints1": matches.keypoints1.numpy()}
    result = filtered(tmp_path, {**arrays, "confidence": confidence, "batch_indexes": np.zeros(40, dtype=np.int64)})
    cost = torch.from_numpy(1 - confidence)
    expected = expected_exactly(Matches(matches.keypoints0, matches.keypoints1, matches.ptr, cost))
    for name, values in expected._asdict().items():
        np.testing.assert_array_equal(result[name], values)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("match_indices", np.zeros((6, 2), dtype=int)),
        ("match_indices", np.zeros((6, 2))),
        ("idxs", np.zeros((4, 2), dtype=int)),
        ("pairs", np.zeros((4, 2), dtype=int)),
        ("edges", np.zeros((2, 9), dtype=int)),
        ("m01", np.zeros(6, dtype=np.int16)),
        ("nn12", np.zeros((1, 6), dtype=np.uint16)),
        ("gt_matches0", np.zeros(6, dtype=np.int16)),
        ("Matches0", np.zeros(6)),
        ("match_mask", np.ones(6, dtype=bool)),
        ("mask", np.ones(6, dtype=bool)),
        ("correspondences", np.zeros((6, 2), dtype=np.uint32)),
        ("mkpts0", np.zeros((4, 2))),
        ("partner_of_0", np.zeros(6, dtype=int)),
    ],
)
def test_an_array_that_may_pair_the_rows_is_refused_by_name(tmp_path: Path, name: str, values: np.ndarray) -> None:
    points = np.arange(12.0).reshape(6, 2)
    arrays = {"keypoints0": points, "keypoints1": points, name: values}
    with pytest.raises(ValueError, match=f"in.npz pairs the rows of its keypoints, but the array '{name}' may say"):
        filtered(tmp_path, arrays)
    # unless something says that they are matches
    np.testing.assert_array_equal(filtered(tmp_path, arrays | {"ptr": np.array([0, 6])})[name], values)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("correct", np.ones(6, dtype=bool)),
        ("frame", np.array(7)),
        ("image_size0", np.array([640, 480])),
        ("pair_idx", np.array([3])),
        ("match_confidence", np.ones(6)),
        ("descriptors0", np.zeros((6, 128), dtype=np.uint8)),
        ("meta", np.array({"a": 1}, dtype=object)),
    ],
)
def test_what_says_nothing_of_the_rows_is_carried_through(tmp_path: Path, name: str, values: np.ndarray) -> None:
    points = np.arange(12.0).reshape(6, 2)
    np.savez(tmp_path / "in.npz", keypoints0=points, keypoints1=points, **{name: values})
    filter_npz(tmp_path / "in.npz", tmp_path / "out.npz", exact_filter())
    with zipfile.ZipFile(tmp_path / "in.npz") as before, zipfile.ZipFile(tmp_path / "out.npz") as after:
        assert before.read(f"{name}.npy") == after.read(f"{name}.npy")


def test_the_pair_of_a_row_is_not_given_twice(tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(6, 2)
    arrays = {"keypoints0": points, "keypoints1": points, "ptr": np.array([0, 6]), "b_ids": np.zeros(6, dtype=int)}
    with pytest.raises(ValueError, match="'ptr' and as 'b_ids'; leave one of them out"):
        filtered(tmp_path, arrays)


@pytest.mark.parametrize("form", FORMS)
def test_matches_of_every_form_tell_whether_their_pair_is_rectified(tmp_path: Path, form: Any) -> None:
    arrays, expected, places = form(4)
    np.savez(tmp_path / "in.npz", **arrays)
    summary = filter_file(tmp_path / "in.npz", tmp_path / "out.npz", config=FileFilterConfig(score="consensus"))
    assert (summary.num_pairs, summary.num_rectified) == (1, 1)
    with np.load(tmp_path / "out.npz") as result:
        np.testing.assert_array_equal(result["inlier"][places], expected.inlier)
        np.testing.assert_array_equal(result["score"][places], expected.score)


def own(seed: int, **more: np.ndarray) -> Arrays:
    matches = batch(seed, [40])
    return {"keypoints0": matches.keypoints0.numpy(), "keypoints1": matches.keypoints1.numpy(), **more}


def test_arrays_of_the_user_survive(tmp_path: Path) -> None:
    """Also a score that could be one of ours, through filters with and without a score."""
    users = {"score": np.linspace(0.2, 0.9, 40), "filter_score": np.linspace(-1, 1, 40), "inlier": np.arange(40) > 7}
    arrays = own(1, **users) | {"ptr": np.array([0, 40])}
    plain = filtered(tmp_path, own(1))
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    np.savez(source, **arrays)
    for score in ("consensus", "none", "consensus", "consensus"):
        verdict = "cardinality" if score == "none" else "score"
        filter_npz(source, target, two_view_filter(verdict=verdict, score=score))
        target.replace(source)
        with np.load(source) as result:
            scored = {"filter_score_2"} if score != "none" else set()
            assert set(result) == {*arrays, "filter_inlier", "relation", *scored}
            for name, values in users.items():
                np.testing.assert_array_equal(result[name], values)
            if scored:
                np.testing.assert_array_equal(result["filter_score_2"], plain["score"])
                np.testing.assert_array_equal(result["filter_inlier"], plain["inlier"])
            np.testing.assert_array_equal(result["relation"], plain["relation"])


def test_the_name_of_the_score_can_be_chosen_and_is_replaced_by_a_second_filter(tmp_path: Path) -> None:
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    users = np.linspace(2, 8, 40)
    np.savez(source, **own(2, score=users))
    for _ in range(2):
        filter_file(source, target, score_name="kept", config=FilterConfig(verdict="cardinality", score="consensus"))
        target.replace(source)
    with np.load(source) as result:
        assert set(result) == {"keypoints0", "keypoints1", "score", "inlier", "relation", "kept"}
        np.testing.assert_array_equal(result["score"], users)
    with pytest.raises(ValueError, match=r"score_name must be a new name in .*, which has 'keypoints0'"):
        filter_file(source, target, score_name="keypoints0")


def test_a_score_of_an_earlier_filter_does_not_outlive_its_verdicts(tmp_path: Path) -> None:
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    np.savez(source, **filtered(tmp_path, own(3)))
    filter_npz(source, target, two_view_filter(verdict="cardinality", score="none"))
    with np.load(target) as result:
        assert set(result) == {"keypoints0", "keypoints1", "inlier", "relation"}
