"""Outputs of kornia's matchers: the dictionaries of LightGlue, LoFTR and LocalFeatureMatcher, and LAFs with indices.

Functions that stand in for one of kornia's keep its suffixes 1 and 2 for the two views; all others say 0 and 1.
LoFTR's pretrained weights count pixel corners as integers: subtract 0.5 from its keypoints before looking up ground
truth at them. No verdict depends on that shift.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from tensor_stereo.batching import batch_to_ptr
from tensor_stereo.interop.glue_factory import from_glue_factory, to_glue_factory, two_view_filter
from tensor_stereo.modules import FilterOutput, Images
from tensor_stereo.types import Matches, check_integer, check_mask, check_tensor, check_vector

_ROWS = ("keypoints0", "keypoints1", "confidence", "batch_indexes")  # what LoFTR returns, one row per match


def from_lightglue(data: Mapping[str, Any], output: Mapping[str, Any]) -> tuple[Matches, Tensor]:
    """The matches that LightGlue found.

    Args:
        data: its input, of which ``data["image0"]["keypoints"]`` (B, N0, 2) and ``data["image1"]["keypoints"]``
            (B, N1, 2) are read, (x, y) in px.
        output: its output, of which ``matches0`` and ``matching_scores0`` (B, N0) are read. One pair may come without
            the batch axis, in all entries of both.

    Returns:
        Matches of B pairs with the cost 1 - score, and indices (M, 3) int64: pair, row in view 0, row in view 1.
        Gradients flow to keypoints and scores.

    Raises:
        ValueError: if an entry is missing or shapes disagree.
        TypeError: if ``matches0`` is not int64 or keypoints are neither float32 nor float64.

    Example:
        >>> points = {"keypoints": torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])}
        >>> output = {"matches0": torch.tensor([[-1, 0]]), "matching_scores0": torch.tensor([[0.0, 0.75]])}
        >>> matches, indices = from_lightglue({"image0": points, "image1": points}, output)
        >>> indices, matches.cost
        (tensor([[0, 1, 0]]), tensor([0.2500]))
    """
    keypoints = {}
    for view in ("0", "1"):
        image = data.get(f"image{view}")
        if image is None or "keypoints" not in image:
            raise ValueError(f"data must hold 'image{view}' with 'keypoints', got the keys {sorted(data)}")
        keypoints[f"keypoints{view}"] = image["keypoints"]
    return from_glue_factory({**output, **keypoints})


def to_lightglue(
    output: Mapping[str, Any], indices: Tensor, inlier: Tensor, score: Tensor | None = None
) -> dict[str, Any]:
    """LightGlue's output without the rejected matches.

    Args:
        output: the output that :func:`from_lightglue` was given.
        indices: (M, 3) int64, the second result of :func:`from_lightglue`.
        inlier: (M,) bool.
        score: (M,) scores of the filter, in [0, 1]; None leaves the scores of inliers as they are.

    Returns:
        A dictionary of the same keys. A rejected match is -1 with score 0 in ``matches0`` and ``matches1`` and missing
        from the lists ``matches`` and ``scores``; scores of inliers are multiplied by ``score``. Gradients flow to both
        scores. Diagnostics and ``log_assignment`` are those of the network.

    Raises:
        ValueError: if ``indices``, ``inlier`` or ``score`` has another number of rows.
        TypeError: if ``inlier`` is not bool.

    Example:
        >>> output = {"matches0": torch.tensor([[1, 0]]), "matching_scores0": torch.tensor([[0.5, 0.75]])}
        >>> to_lightglue(output, torch.tensor([[0, 0, 1], [0, 1, 0]]), torch.tensor([False, True]))["matches0"]
        tensor([[-1,  0]])
    """
    result: dict[str, Any] = {**output, **to_glue_factory(output, indices, inlier, score)}
    if result["matches0"].ndim == 1:  # one pair without batch axis
        row0 = (result["matches0"] >= 0).nonzero()[:, 0]
        lists = {
            "matches": torch.stack([row0, result["matches0"][row0]], dim=-1),
            "scores": result["matching_scores0"][row0],
        }
        return result | {name: values for name, values in lists.items() if name in output}
    kept = [row.nonzero()[:, 0] for row in result["matches0"] >= 0]
    if "matches" in output:
        rows = zip(kept, result["matches0"], strict=True)
        result["matches"] = [torch.stack([row0, partners[row0]], dim=-1) for row0, partners in rows]
    if "scores" in output:
        result["scores"] = [values[row0] for row0, values in zip(kept, result["matching_scores0"], strict=True)]
    return result


def from_loftr(output: Mapping[str, Any], *, num_pairs: int | None = None) -> Matches:
    """The matches of LoFTR or LocalFeatureMatcher, row by row.

    Args:
        output: ``keypoints0`` and ``keypoints1`` (M, 2), (x, y) in px, ``batch_indexes`` (M,) int64, sorted, and
            ``confidence`` (M,), higher is better. Without ``batch_indexes`` it is one pair.
        num_pairs: B; the default ends with the last pair that has matches.

    Returns:
        Matches of B pairs with the cost 1 - confidence. Gradients flow.

    Raises:
        ValueError: if an entry is missing, shapes disagree, or ``batch_indexes`` are not sorted or not below
            ``num_pairs``.

    Example:
        >>> output = {"keypoints0": torch.ones(2, 2), "keypoints1": torch.zeros(2, 2),
        ...           "confidence": torch.tensor([0.5, 0.75]), "batch_indexes": torch.tensor([0, 2])}
        >>> from_loftr(output, num_pairs=4).ptr
        tensor([0, 1, 1, 2, 2])
    """
    missing = [name for name in _ROWS if name not in output and name != "batch_indexes"]
    if missing:
        raise ValueError(f"output must hold {missing[0]!r}, got the keys {sorted(output)}")
    keypoints0 = output["keypoints0"]
    cost = (1 - output["confidence"]).to(keypoints0.dtype)
    if "batch_indexes" not in output:
        return Matches(keypoints0, output["keypoints1"], torch.tensor([0, len(keypoints0)]), cost)
    check_vector("batch_indexes", output["batch_indexes"], len(keypoints0))
    check_integer("batch_indexes", output["batch_indexes"])
    ptr = batch_to_ptr(output["batch_indexes"], num_pairs)
    return Matches(keypoints0, output["keypoints1"], ptr, cost)


def to_loftr(output: Mapping[str, Any], inlier: Tensor, score: Tensor | None = None) -> dict[str, Any]:
    """The output of LoFTR or LocalFeatureMatcher without the rejected rows.

    Args:
        output: the output that :func:`from_loftr` was given; LocalFeatureMatcher's ``lafs0`` and ``lafs1``
            (1, M, 2, 3) are cut too.
        inlier: (M,) bool.
        score: (M,) scores of the filter, by which ``confidence`` is multiplied; None leaves it.

    Returns:
        A dictionary of the same keys. Gradients flow.

    Raises:
        ValueError: if ``inlier`` or ``score`` has another number of rows.
        TypeError: if ``inlier`` is not bool.

    Example:
        >>> output = {"keypoints0": torch.ones(2, 2), "keypoints1": torch.zeros(2, 2),
        ...           "confidence": torch.tensor([0.5, 0.75]), "batch_indexes": torch.tensor([0, 2])}
        >>> to_loftr(output, torch.tensor([False, True]))["confidence"]
        tensor([0.7500])
    """
    num_matches = len(output["keypoints0"])
    check_vector("inlier", inlier, num_matches)
    check_mask("inlier", inlier)
    result = dict(output)
    for name in (name for name in _ROWS if name in output):
        result[name] = output[name][inlier]
    for name in ("lafs0", "lafs1"):
        if name in output:
            result[name] = output[name][:, inlier]
    if score is not None:
        check_vector("score", score, num_matches)
        result["confidence"] = result["confidence"] * score[inlier].to(result["confidence"].dtype)
    return result


def from_lafs(lafs0: Tensor, lafs1: Tensor, indices: Tensor, distances: Tensor | None = None) -> Matches:
    """The matches of kornia's descriptor matchers.

    Args:
        lafs0: (B, N0, 2, 3), or (N0, 2, 3) for one pair: local affine frames of view 0; the keypoint is the last
            column, (x, y) in px.
        lafs1: (B, N1, 2, 3) or (N1, 2, 3).
        indices: (K, 2) int64 rows in view 0 and view 1 as from ``match_snn``, for B = 1; or (K, 3) with the pair in
            front, sorted by it, as from ``match_smnn_batched``.
        distances: (K, 1) or (K,), lower is better; becomes the cost. Do not pass LightGlueMatcher's first result,
            which is a score.

    Returns:
        Matches of B pairs, row by row those of ``indices``. Gradients flow to LAFs and distances.

    Raises:
        ValueError: if shapes disagree or an index is out of range.
        TypeError: if ``indices`` is not int64.

    Example:
        >>> lafs = torch.tensor([[[[1.0, 0.0, 7.0], [0.0, 1.0, 8.0]]]])
        >>> from_lafs(lafs, lafs - 1, torch.tensor([[0, 0]])).keypoints1
        tensor([[6., 7.]])
    """
    for name, value in (("lafs0", lafs0), ("lafs1", lafs1), ("indices", indices)):
        check_tensor(name, value)
    lafs0, lafs1 = (lafs[None] if lafs.ndim == 3 else lafs for lafs in (lafs0, lafs1))
    for name, lafs in (("lafs0", lafs0), ("lafs1", lafs1)):
        if lafs.ndim != 4 or lafs.shape[2:] != (2, 3) or len(lafs) != len(lafs0):
            raise ValueError(f"{name} must have shape (B, N, 2, 3) with one B for both views, got {tuple(lafs.shape)}")
    if indices.dtype != torch.int64:
        raise TypeError(f"indices must be int64, got {indices.dtype}")
    if indices.ndim != 2 or indices.shape[1] not in (2, 3) or (indices.shape[1] == 2 and len(lafs0) != 1):
        expected = "(K, 2) for one pair or (K, 3) with the pair in front"
        raise ValueError(f"indices must have shape {expected}, got {tuple(indices.shape)} for {len(lafs0)} pairs")
    if indices.shape[1] == 2:
        indices = torch.nn.functional.pad(indices, (1, 0))
    limits = indices.new_tensor([len(lafs0), lafs0.shape[1], lafs1.shape[1]])
    if bool(((indices < 0) | (indices >= limits)).any()) or bool((indices[:, 0].diff() < 0).any()):
        raise ValueError(f"indices must be sorted by pair, at least 0 and below {limits.tolist()} (pair, row 0, row 1)")
    pair, row0, row1 = indices.unbind(1)
    cost = None if distances is None else distances.reshape(-1)
    return Matches(lafs0[pair, row0, :, 2], lafs1[pair, row1, :, 2], batch_to_ptr(pair, len(lafs0)), cost)


def filter_matches(
    lafs1: Tensor,
    lafs2: Tensor,
    indices: Tensor,
    *,
    distances: Tensor | None = None,
    filter: Callable[..., FilterOutput] | None = None,  # noqa: A002
    images1: Images | None = None,
    images2: Images | None = None,
) -> tuple[Tensor, Tensor]:
    """Keep the matches whose neighbours agree; in the form of kornia's matchers, but without descriptors.

    Args:
        lafs1: (B, N1, 2, 3), or (N1, 2, 3) for one pair: local affine frames of the first view, px.
        lafs2: (B, N2, 2, 3) or (N2, 2, 3), of the second view.
        indices: (K, 2) or (K, 3) int64 rows; see :func:`from_lafs`.
        distances: (K, 1) or (K,) of the matcher, lower is better. They only decide which of several matches of one
            keypoint counts; without them it is the first.
        filter: Takes Matches, returns a FilterOutput; None is
            :func:`~tensor_stereo.interop.glue_factory.two_view_filter`, as kornia's pairs need not be rectified. For
            rectified pairs ``DelaunayFilter()`` is best.
        images1: Images of the first view, (B, C, H, W), a list of (C, H, W), or (C, H, W) for one pair; handed to the
            filter, whose score ``learned`` looks at them.
        images2: Images of the second view.

    Returns:
        distances (K', 1), which are 1 - score of the filter, so that kornia's confidence, 1 - distance, is that score
        (those of the matcher, or 0, where the filter has no score); and the K' rows of ``indices`` that are inliers, in
        their order. Gradients flow to the LAFs if the score is differentiable.

    Raises:
        ValueError, TypeError: for what :func:`from_lafs` refuses.

    Example:
        >>> x, y = torch.meshgrid(torch.arange(0.0, 40, 10), torch.arange(0.0, 40, 10), indexing="xy")
        >>> centres = torch.stack([x, y], -1).reshape(1, 16, 2, 1)
        >>> lafs = torch.cat([torch.eye(2).expand(1, 16, 2, 2), centres], -1)
        >>> distances, indices = filter_matches(lafs, lafs + 1, torch.arange(16)[:, None].expand(16, 2))
        >>> distances.shape, indices.shape
        (torch.Size([16, 1]), torch.Size([16, 2]))
    """
    matches = from_lafs(lafs1, lafs2, indices, distances)
    images = {} if images1 is None and images2 is None else {"images0": images1, "images1": images2}
    output = (two_view_filter() if filter is None else filter)(matches, **images)
    if output.score is not None:
        distance = 1 - output.score
    else:
        distance = matches.keypoints0.new_zeros(matches.num_matches) if matches.cost is None else matches.cost
    return distance[output.inlier][:, None], indices[output.inlier]


class LocatedFeature(nn.Module):
    """A local feature whose descriptors end in the keypoint, for :class:`FilteredMatcher` in LocalFeatureMatcher.

    LocalFeatureMatcher hands descriptors, and nothing else, to its matcher, so the positions have to travel in them.

    Args:
        local_feature: called as ``local_feature(image, mask)``; returns LAFs (B, N, 2, 3), responses (B, N) and
            descriptors (B, N, D), as ``kornia.feature.SIFTFeature``.

    Example:
        >>> detect = lambda image, mask: (torch.ones(1, 5, 2, 3), torch.ones(1, 5), torch.ones(1, 5, 8))
        >>> LocatedFeature(detect)(torch.zeros(1, 1, 4, 4))[2].shape
        torch.Size([1, 5, 10])
    """

    def __init__(self, local_feature: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor, Tensor]]) -> None:
        super().__init__()
        self.local_feature = local_feature

    def forward(self, image: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """LAFs, responses and descriptors (B, N, D + 2), in the wider of the dtypes of descriptors and LAFs."""
        lafs, responses, descriptors = self.local_feature(image, mask)
        return lafs, responses, torch.cat([descriptors, lafs[..., 2]], dim=-1)


class FilteredMatcher(nn.Module):
    """A descriptor matcher followed by the filter, in the place of ``kornia.feature.DescriptorMatcher``.

    Args:
        matcher: called as ``matcher(desc1, desc2)``; returns distances (K, 1) and indices (K, 2).
        filter: Takes Matches, returns a FilterOutput; None is
            :func:`~tensor_stereo.interop.glue_factory.two_view_filter`.

    Example:
        >>> nearest = lambda desc1, desc2: torch.cdist(desc1, desc2).min(1, keepdim=True)
        >>> def match(desc1, desc2):
        ...     distances, partner = nearest(desc1, desc2)
        ...     return distances, torch.cat([torch.arange(len(desc1))[:, None], partner], 1)
        >>> x, y = torch.meshgrid(torch.arange(0.0, 40, 10), torch.arange(0.0, 40, 10), indexing="xy")
        >>> located = torch.stack([torch.arange(16.0), x.flatten(), y.flatten()], 1)  # descriptor, x, y
        >>> FilteredMatcher(match)(located, located + torch.tensor([0.0, 5.0, 0.0]))[1].shape
        torch.Size([16, 2])
    """

    def __init__(
        self,
        matcher: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
        filter: Callable[[Matches], FilterOutput] | None = None,  # noqa: A002
    ) -> None:
        super().__init__()
        self.matcher = matcher
        self.filter = two_view_filter() if filter is None else filter

    def forward(
        self, desc1: Tensor, desc2: Tensor, lafs1: Tensor | None = None, lafs2: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Match, then keep the inliers.

        Args:
            desc1: (N1, D) descriptors; (N1, D + 2) without LAFs, the last columns being (x, y) in px, as
                :class:`LocatedFeature` makes them.
            desc2: (N2, D) or (N2, D + 2).
            lafs1: (1, N1, 2, 3) or None; both or none.
            lafs2: (1, N2, 2, 3) or None.

        Returns:
            distances (K', 1), which are 1 - score of the filter, and indices (K', 2) int64. Gradients flow to
            the LAFs if the score is differentiable.

        Raises:
            ValueError: if only one view has LAFs.
        """
        if (lafs1 is None) != (lafs2 is None):
            raise ValueError("lafs1 and lafs2 must be given both or not at all, got one")
        if lafs1 is None or lafs2 is None:
            lafs1, lafs2 = (_upright_lafs(values[:, -2:]) for values in (desc1, desc2))
            desc1, desc2 = desc1[:, :-2], desc2[:, :-2]
        distances, indices = self.matcher(desc1, desc2)
        return filter_matches(lafs1, lafs2, indices, distances=distances, filter=self.filter)


def _upright_lafs(keypoints: Tensor) -> Tensor:
    """(1, N, 2, 3) frames of scale 1 at keypoints (N, 2)."""
    axes = torch.eye(2, dtype=keypoints.dtype, device=keypoints.device)
    return torch.cat([axes.expand(len(keypoints), 2, 2), keypoints[:, :, None]], dim=-1)[None]
