from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tensor_stereo import Matches, StereoPair
from tensor_stereo.batching import collate_matches, split_matches
from tensor_stereo.datasets import PairDataset, PairFiles, read_pair
from tensor_stereo.interop.glue_factory import two_view_filter
from tests.interop.matchers import scene


@pytest.fixture
def pairs(tmp_path: Path) -> list[PairFiles]:
    """Five pairs of different sizes with ground truth."""
    rng = np.random.default_rng(0)
    files = []
    for k in range(5):
        shape = (20 + k, 30 + 2 * k)
        paths = [tmp_path / f"{name}{k}.png" for name in ("left", "right", "disparity")]
        for path, channels in zip(paths, [(3,), (3,), ()], strict=True):
            assert cv2.imwrite(str(path), rng.integers(0, 256, (*shape, *channels), dtype=np.uint8))
        files.append(PairFiles("middlebury-2005", f"scene{k}", *paths, gt_scale=3.0))
    return files


def collate_pairs(items: Sequence[StereoPair]) -> tuple[list[str], list[Tensor]]:
    return [pair.name for pair in items], [pair.image0 for pair in items]


def filter_items(items: Sequence[Matches]) -> Tensor:
    inlier: Tensor = two_view_filter()(collate_matches(items)).inlier
    return inlier


def test_workers_read_the_same_pairs_in_the_same_order(pairs: list[PairFiles]) -> None:
    loader = DataLoader(PairDataset(pairs), batch_size=2, num_workers=2, collate_fn=list)
    batches = list(loader)
    assert [len(batch) for batch in batches] == [2, 2, 1]
    for loaded, files in zip([pair for batch in batches for pair in batch], pairs, strict=True):
        expected = read_pair(files)
        assert loaded.name == expected.name
        assert torch.equal(loaded.image0, expected.image0)
        assert torch.equal(loaded.image1, expected.image1)
        torch.testing.assert_close(loaded.disparity_gt, expected.disparity_gt, equal_nan=True, rtol=0, atol=0)


def test_workers_apply_a_collate_function_and_a_seeded_order(pairs: list[PairFiles]) -> None:
    def epoch(num_workers: int) -> list[str]:
        generator = torch.Generator().manual_seed(1)
        loader = DataLoader(
            PairDataset(pairs),
            batch_size=2,
            shuffle=True,
            generator=generator,
            num_workers=num_workers,
            collate_fn=collate_pairs,
        )
        names = []
        for batch_names, images in loader:
            assert [image.shape[1] - 20 for image in images] == [int(name[-1]) for name in batch_names]
            names += batch_names
        return names

    assert epoch(2) == epoch(0)
    assert sorted(epoch(2)) == [f"scene{k}" for k in range(5)]


def matches_of(seed: int) -> Matches:
    left, right = scene(seed, 20 + 5 * seed)
    return Matches(left, right, torch.tensor([0, len(left)]), cost=left.sum(1), group=torch.arange(len(left)))


def test_workers_join_matches_into_ragged_batches() -> None:
    items = [matches_of(seed) for seed in range(5)]
    batches = list(DataLoader(items, batch_size=2, num_workers=2, collate_fn=collate_matches))  # type: ignore[arg-type]
    assert [batch.ptr.diff().tolist() for batch in batches] == [[20, 25], [30, 35], [40]]
    for loaded, item in zip([pair for batch in batches for pair in split_matches(batch)], items, strict=True):
        for name in ("keypoints0", "keypoints1", "ptr", "cost", "group"):
            assert torch.equal(getattr(loaded, name), getattr(item, name)), name


def test_filter_gives_the_same_verdicts_in_a_worker_as_here() -> None:
    left, right = scene(0, 80)
    items = [Matches(left, right + k, torch.tensor([0, 80])) for k in range(4)]
    here = [filter_items(items[:2]), filter_items(items[2:])]  # first, so that workers start from used threads
    loader = DataLoader(items, batch_size=2, num_workers=2, collate_fn=filter_items, timeout=60)  # type: ignore[arg-type]
    there = list(loader)
    assert 0 < int(here[0].sum()) < 160
    assert all(torch.equal(a, b) for a, b in zip(here, there, strict=True))
