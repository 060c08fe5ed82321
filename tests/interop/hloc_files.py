"""Files as hloc writes and reads them, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tensor_stereo import Matches
from tests.interop.matchers import scene

h5py = pytest.importorskip("h5py", reason="h5py is not installed")

IMAGES = ("db/1.jpg", "db/2.jpg", "query/night_1.jpg")


def features(seed: int, num_keypoints: int = 50) -> dict[str, np.ndarray]:
    """Keypoints as hloc stores them: in half precision, more than are matched."""
    left, right = scene(seed, num_keypoints)
    third = left - torch.tensor([0.0, 7.0])
    return {name: points.numpy().astype(np.float16) for name, points in zip(IMAGES, (left, right, third), strict=True)}


def write_features(path: Path, keypoints: dict[str, np.ndarray]) -> None:
    """What extract_features of hloc writes: one group per image, its descriptors and size beside the keypoints."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, points in keypoints.items():
            group = file.create_group(name)
            group.create_dataset("keypoints", data=points)
            group["keypoints"].attrs["uncertainty"] = 1.0
            group.create_dataset("descriptors", data=np.zeros((16, len(points)), dtype=np.float16))
            group.create_dataset("image_size", data=np.array([320, 240]))


def write_matches(path: Path, pairs: dict[tuple[str, str], dict[str, np.ndarray]], separator: str = "/") -> None:
    """What match_features of hloc writes: "/" of names is "-", int16 partners, half-precision scores."""
    with h5py.File(path, "w", libver="latest") as file:
        for names, arrays in pairs.items():
            group = file.create_group(separator.join(name.replace("/", "-") for name in names))
            for name, values in arrays.items():
                group.create_dataset(name, data=values)


def partners(seed: int, num_keypoints: int = 50, num_rows: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    matches0 = np.arange(num_rows, dtype=np.int16) % num_keypoints
    matches0[rng.random(num_rows) < 0.2] = -1
    return {"matches0": matches0, "matching_scores0": rng.random(num_rows).astype(np.float16)}


def some_pairs(seed: int) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Pairs in both orders, one without scores, one shorter than its keypoints, one without matches."""
    one, two, three = IMAGES
    return {
        (one, two): partners(seed),
        (two, one): partners(seed + 1),
        (one, three): {"matches0": partners(seed)["matches0"].astype(np.int32)},
        (three, two): partners(seed + 2, num_rows=30),
        (three, one): {"matches0": np.full(50, -1, dtype=np.int16)},
        (three, three): {"matches0": np.zeros(0, dtype=np.int64), "matching_scores0": np.zeros(0, dtype=np.float16)},
    }


def to_matches(
    names: tuple[str, str], arrays: dict[str, np.ndarray], keypoints: dict[str, np.ndarray]
) -> tuple[Matches, np.ndarray]:
    """The matches of a pair in a loop over its rows, and those rows."""
    points0, points1 = (keypoints[name].astype(np.float64) for name in names)
    rows = np.array([i for i, j in enumerate(arrays["matches0"]) if j >= 0], dtype=np.int64)
    left = torch.tensor(np.array([points0[i] for i in rows]).reshape(-1, 2))
    right = torch.tensor(np.array([points1[arrays["matches0"][i]] for i in rows]).reshape(-1, 2))
    scores = arrays.get("matching_scores0")
    cost = None if scores is None else torch.from_numpy(1 - scores.astype(np.float64)[rows])
    return Matches(left, right, torch.tensor([0, len(rows)]), cost), rows


def read_as_hloc(path: Path, name0: str, name1: str) -> np.ndarray:
    """(K, 2) rows of both images, found as hloc's utils/io.py finds them."""
    with h5py.File(path, "r", libver="latest") as file:
        flat0, flat1 = name0.replace("/", "-"), name1.replace("/", "-")
        for pair, is_reversed in (
            (f"{flat0}/{flat1}", False),
            (f"{flat1}/{flat0}", True),
            (f"{flat0}_{flat1}", False),
            (f"{flat1}_{flat0}", True),
        ):
            if pair in file:
                matches0 = file[pair]["matches0"][()]
                kept = np.flatnonzero(matches0 != -1)
                found = np.stack([kept, matches0[kept]], axis=1)
                return found[:, ::-1] if is_reversed else found
    raise AssertionError(f"no pair {name0}, {name1}")


def paths(folder: Path) -> tuple[Path, Path, Path]:
    return folder / "matches.h5", folder / "out.h5", folder / "features.h5"
