"""The ragged batch forms that every step exchanges.

B pairs (or images) are concatenated along the first axis; ``ptr`` (B + 1,) int64 holds their offsets, so that pair
``b`` owns the rows ``ptr[b]:ptr[b + 1]``. Coordinates are (x, y) in pixels, pixel centres at integers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from torch import Tensor


class Relation(IntEnum):
    """How the neighbours of a match in view 0 relate to those in view 1, as sets of match indices."""

    UNTESTED = 0  # no evidence: duplicate, too small a group, or no neighbour
    EQUAL = 1
    SUBSET = 2  # N0 is a proper subset of N1
    SUPERSET = 3  # N1 is a proper subset of N0
    CONFLICT = 4


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of B images with one descriptor each.

    Attributes:
        keypoints: (N, 2) float32, (x, y) in px.
        ptr: (B + 1,) int64 offsets of the images.
        descriptors: (N, D) float32; image windows in grey levels 0..255, or unit-scaled vectors.
        scores: (N,) float32 detector response, higher is stronger.
    """

    keypoints: Tensor
    ptr: Tensor
    descriptors: Tensor
    scores: Tensor

    def __post_init__(self) -> None:
        check_points("keypoints", self.keypoints)
        check_ptr("ptr", self.ptr, len(self.keypoints))
        check_rows("descriptors", self.descriptors, len(self.keypoints))
        check_rows("scores", self.scores, len(self.keypoints))

    @property
    def num_images(self) -> int:
        return len(self.ptr) - 1


@dataclass(frozen=True, eq=False)
class Matches:
    """Putative matches of B pairs; row i of ``keypoints0`` and of ``keypoints1`` are the same match.

    Attributes:
        keypoints0: (M, 2) floating point, (x, y) in px of view 0 (left).
        keypoints1: (M, 2) the partners in view 1 (right), same dtype and device.
        ptr: (B + 1,) int64 offsets of the pairs.
        cost: (M,) or None; lower is better.
        group: (M,) integer or None; matches of one object (Restriction 3) share a value within their pair.

    Raises:
        ValueError: if shapes disagree or ``ptr`` is no offset vector; the message names the argument.
        TypeError: if a dtype does not fit.
    """

    keypoints0: Tensor
    keypoints1: Tensor
    ptr: Tensor
    cost: Tensor | None = None
    group: Tensor | None = None

    def __post_init__(self) -> None:
        check_points("keypoints0", self.keypoints0)
        check_points("keypoints1", self.keypoints1)
        num_matches = len(self.keypoints0)
        check_rows("keypoints1", self.keypoints1, num_matches)
        check_ptr("ptr", self.ptr, num_matches)
        if self.cost is not None:
            check_vector("cost", self.cost, num_matches)
        if self.group is not None:
            check_vector("group", self.group, num_matches)
            check_integer("group", self.group)

    @property
    def num_pairs(self) -> int:
        return len(self.ptr) - 1

    @property
    def num_matches(self) -> int:
        return len(self.keypoints0)

    @property
    def disparity(self) -> Tensor:
        """(M,) x0 - x1 in px."""
        return self.keypoints0[:, 0] - self.keypoints1[:, 0]

    def swap(self) -> Matches:
        """The same matches with the views exchanged."""
        return replace(self, keypoints0=self.keypoints1, keypoints1=self.keypoints0)


@dataclass(frozen=True, eq=False)
class Adjacency:
    """Pattern of a block-diagonal, square, symmetric boolean matrix over a whole batch, without self-loops.

    Attributes:
        crow_indices: (M + 1,) int64 row offsets into ``col_indices``.
        col_indices: (nnz,) int64 global column of each entry, sorted within its row.
        ptr: (B + 1,) int64 offsets of the diagonal blocks.
    """

    crow_indices: Tensor
    col_indices: Tensor
    ptr: Tensor

    @property
    def num_nodes(self) -> int:
        return len(self.crow_indices) - 1

    @property
    def degree(self) -> Tensor:
        """(M,) int64 number of neighbours of each node."""
        return self.crow_indices.diff()

    @property
    def row_indices(self) -> Tensor:
        """(nnz,) int64 global row of each entry."""
        nodes = torch.arange(self.num_nodes, device=self.crow_indices.device)
        return torch.repeat_interleave(nodes, self.degree, output_size=len(self.col_indices))

    def neighbors(self, node: int) -> Tensor:
        """(degree,) int64 neighbours of one node, as global indices."""
        return self.col_indices[self.crow_indices[node] : self.crow_indices[node + 1]]

    def to_sparse_csr(self, dtype: torch.dtype = torch.bool) -> Tensor:
        """(M, M) sparse CSR tensor whose stored values are one."""
        values = torch.ones(len(self.col_indices), dtype=dtype, device=self.col_indices.device)
        size = (self.num_nodes, self.num_nodes)
        return torch.sparse_csr_tensor(self.crow_indices, self.col_indices, values, size, check_invariants=False)

    def to_sparse_coo(self, dtype: torch.dtype = torch.bool) -> Tensor:
        """(M, M) coalesced sparse COO tensor whose stored values are one."""
        indices = torch.stack([self.row_indices, self.col_indices])
        values = torch.ones(len(self.col_indices), dtype=dtype, device=self.col_indices.device)
        size = (self.num_nodes, self.num_nodes)
        return torch.sparse_coo_tensor(indices, values, size, is_coalesced=True, check_invariants=False)

    def to_dense(self, b: int) -> Tensor:
        """(N_b, N_b) boolean matrix of the block of pair ``b``."""
        start, stop = int(self.ptr[b]), int(self.ptr[b + 1])
        dense = torch.zeros(stop - start, stop - start, dtype=torch.bool, device=self.col_indices.device)
        entries = slice(int(self.crow_indices[start]), int(self.crow_indices[stop]))
        rows = torch.repeat_interleave(self.degree[start:stop])
        dense[rows, self.col_indices[entries] - start] = True
        return dense


@dataclass(frozen=True, eq=False)
class Classification:
    """Verdict on every match.

    Attributes:
        inlier: (M,) bool, False for untested matches.
        relation: (M,) int8 values of :class:`Relation`.
        overlap: (M,) int64 number of neighbours that both views share.
        degree0: (M,) int64 number of neighbours in view 0.
        degree1: (M,) int64 number of neighbours in view 1.
    """

    inlier: Tensor
    relation: Tensor
    overlap: Tensor
    degree0: Tensor
    degree1: Tensor

    def inlier_of(self, restriction: str) -> Tensor:
        """(M,) bool, the verdict of one of the paper's restrictions, whatever decided ``inlier``.

        Args:
            restriction: ``adjacency``: both neighbour sets are equal. ``cardinality``: one contains the other.
        """
        equal = self.relation == int(Relation.EQUAL)
        if restriction == "adjacency":
            return equal
        return equal | (self.relation == int(Relation.SUBSET)) | (self.relation == int(Relation.SUPERSET))


@dataclass(frozen=True, eq=False)
class StereoPair:
    """One rectified pair as read or rendered.

    Attributes:
        name: scene name, unique within its dataset.
        image0: (C, H, W) uint8, view 0 (left), C = 1 or 3 (RGB).
        image1: (C, H, W) uint8, view 1 (right).
        disparity_gt: (H, W) float32 disparity of view 0 in px, x0 - x1; NaN where unknown. None without ground truth.
        occluded: (H, W) bool, pixels of view 0 that view 1 does not see. None if the release has no such mask.
        dataset: release that the pair comes from, e.g. ``middlebury-2005``.
    """

    name: str
    image0: Tensor
    image1: Tensor
    disparity_gt: Tensor | None = None
    occluded: Tensor | None = None
    dataset: str = ""

    def __post_init__(self) -> None:
        if self.image0.shape != self.image1.shape:
            sizes = f"{tuple(self.image0.shape)} and {tuple(self.image1.shape)}"
            raise ValueError(f"image0 and image1 of {self.name!r} must have one shape (C, H, W), got {sizes}")
        for name, value in (("disparity_gt", self.disparity_gt), ("occluded", self.occluded)):
            if value is not None and value.shape != self.image0.shape[1:]:
                expected, given = tuple(self.image0.shape[1:]), tuple(value.shape)
                raise ValueError(f"{name} of {self.name!r} must have the images' shape {expected}, got {given}")


def check_tensor(name: str, value: object) -> None:
    """Raise unless ``value`` is a tensor; the message says how to make one."""
    if isinstance(value, Tensor):
        return
    module, kind = type(value).__module__, type(value).__name__
    convert = "torch.from_numpy" if module == "numpy" else "torch.as_tensor"
    raise TypeError(f"{name} must be a torch.Tensor, got {kind}; convert with {convert}(...)")


def check_points(name: str, points: Tensor) -> None:
    """Raise unless ``points`` is (N, 2) floating point."""
    check_tensor(name, points)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name} must have shape (N, 2), got {tuple(points.shape)}")
    check_pixels(name, points)


def check_pixels(name: str, points: Tensor) -> None:
    """Raise unless ``points`` are float32 or float64; half precision cannot tell pixels apart beyond 256 or 2048."""
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64 pixels, got {points.dtype}; convert with .float()")


def check_mask(name: str, mask: Tensor) -> None:
    """Raise unless ``mask`` is a tensor of bool."""
    check_tensor(name, mask)
    if mask.dtype != torch.bool:
        raise TypeError(f"{name} must be bool, got {mask.dtype}; convert with .bool()")


def check_ptr(name: str, ptr: Tensor, num_rows: int) -> None:
    """Raise unless ``ptr`` is a vector of non-decreasing offsets from 0 to ``num_rows``."""
    check_tensor(name, ptr)
    if ptr.ndim != 1 or len(ptr) < 1:
        raise ValueError(f"{name} must have shape (B + 1,), got {tuple(ptr.shape)}")
    if ptr.dtype != torch.int64:
        raise TypeError(f"{name} must be int64, got {ptr.dtype}; convert with .long()")
    if torch.compiler.is_compiling():
        return  # values are not known yet; the operators look at them
    offsets = ptr.numpy(force=True)
    if offsets[0] != 0 or offsets[-1] != num_rows or (offsets[1:] < offsets[:-1]).any():
        raise ValueError(f"{name} must rise from 0 to the number of rows {num_rows}, got {ptr.tolist()[:10]}")


def check_rows(name: str, values: Tensor, num_rows: int) -> None:
    """Raise unless ``values`` has ``num_rows`` rows."""
    if len(values) != num_rows:
        raise ValueError(f"{name} must have one row per keypoint ({num_rows}), got {len(values)}")


def check_vector(name: str, values: Tensor, num_rows: int) -> None:
    """Raise unless ``values`` is a vector of ``num_rows`` elements."""
    check_tensor(name, values)
    if values.shape != (num_rows,):
        raise ValueError(f"{name} must have shape ({num_rows},), got {tuple(values.shape)}")


def check_integer(name: str, values: Tensor) -> None:
    """Raise unless ``values`` holds integers."""
    if values.is_floating_point() or values.is_complex() or values.dtype == torch.bool:
        raise TypeError(f"{name} must hold integers, got {values.dtype}")


def check_links(name: str, pairs: Tensor, num_rows: int) -> None:
    """Raise unless ``pairs`` is (E, 2) int64 and names rows below ``num_rows``."""
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype != torch.int64:
        raise ValueError(f"{name} must be (E, 2) int64, got {tuple(pairs.shape)} {pairs.dtype}")
    if not torch.compiler.is_compiling() and len(pairs) and not (pairs.min() >= 0 and pairs.max() < num_rows):
        raise ValueError(f"{name} must name rows 0..{num_rows - 1}, got {int(pairs.min())}..{int(pairs.max())}")


def check_tie_tolerance(tie_tolerance: float) -> None:
    """Raise unless 0 <= ``tie_tolerance`` < 1."""
    if not 0 <= tie_tolerance < 1:
        raise ValueError(f"tie_tolerance must lie in [0, 1), got {tie_tolerance}")


def check_unit(unit: str, name: str = "unit") -> None:
    """Raise unless ``unit`` is one that a temperature can have; ``name`` is that of the argument."""
    if unit not in ("edge", "px"):
        raise ValueError(f"{name} must be 'edge' or 'px', got {unit!r}")
