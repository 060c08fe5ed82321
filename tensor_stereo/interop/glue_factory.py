"""Dictionaries of glue-factory and LightGlue: padded keypoints and, per keypoint, the index of its partner.

``matches0[b, i] = j`` says that keypoint i of view 0 and keypoint j of view 1 are a match of pair b; -1 is none and -2
is "ignore", which occurs in ground truth. glue-factory counts pixel corners, not centres, as integers: its keypoints
are half a pixel larger than those of this library. The converters leave them so, because no verdict depends on a shift.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.configs import ConsensusConfig
from tensor_stereo.modules import DelaunayFilter, FilterOutput
from tensor_stereo.types import Matches, check_mask, check_tensor, check_vector

_ENTRIES = (
    *("keypoints0", "keypoints1"),
    *("matches0", "matches1", "matching_scores0", "matching_scores1"),
)
# Entries that glue-factory itself puts into the configuration of a component.
_PIPELINE_KEYS = ("name", "freeze_batch_normalization", "timeit", "apply_loss", "visualize")


def from_glue_factory(data: Mapping[str, Any]) -> tuple[Matches, Tensor]:
    """The matches of a dictionary, without the keypoints that have none.

    Args:
        data: ``keypoints0`` (B, N0, 2) and ``keypoints1`` (B, N1, 2), (x, y) in px, ``matches0`` (B, N0) int64 with -1
            and -2 for keypoints without a match, and optionally ``matching_scores0`` (B, N0), higher is better. One
            pair may come without the batch axis, in all of them. Other entries are not read.

    Returns:
        Matches of B pairs, ordered by the row in view 0, with the cost 1 - score if there are scores, and their
        indices (M, 3) int64: pair, row in view 0, row in view 1. Gradients flow to keypoints and scores.

    Raises:
        ValueError: if an entry is missing, shapes disagree, or ``matches0`` names a row beyond N1.
        TypeError: if ``matches0`` is not int64 or keypoints are neither float32 nor float64.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]])
        >>> matches, indices = from_glue_factory(
        ...     {"keypoints0": points, "keypoints1": points - 1, "matches0": torch.tensor([[2, -1, 1]])}
        ... )
        >>> matches.keypoints1.tolist()
        [[-1.0, 3.0], [3.0, -1.0]]
        >>> indices.tolist()
        [[0, 0, 2], [0, 2, 1]]
    """
    missing = [name for name in ("keypoints0", "keypoints1", "matches0") if name not in data]
    if missing:
        raise ValueError(f"data must hold {missing[0]!r}, got the keys {sorted(data)}")
    for name in ("keypoints0", "keypoints1", "matches0"):
        check_tensor(name, data[name])
    if data["keypoints0"].ndim == 2:
        data = _with_batch_axis(data)
    keypoints0, keypoints1, matches0 = data["keypoints0"], data["keypoints1"], data["matches0"]
    if matches0.dtype != torch.int64:
        raise TypeError(f"matches0 must be int64, got {matches0.dtype}")
    for name, points in (("keypoints0", keypoints0), ("keypoints1", keypoints1)):
        if points.ndim != 3 or points.shape[2] != 2 or len(points) != len(keypoints0):
            raise ValueError(f"{name} must have shape (B, N, 2) with one B for both views, got {tuple(points.shape)}")
    scores = data.get("matching_scores0")
    for name, values in (("matches0", matches0), ("matching_scores0", scores)):
        if values is not None and values.shape != keypoints0.shape[:2]:
            raise ValueError(f"{name} must have shape {tuple(keypoints0.shape[:2])}, got {tuple(values.shape)}")
    matched = matches0 >= 0
    pair, row0 = matched.nonzero(as_tuple=True)
    row1 = matches0[pair, row0]
    if bool((row1 >= keypoints1.shape[1]).any()):
        raise ValueError(f"matches0 must name rows below {keypoints1.shape[1]} of keypoints1, got {int(row1.max())}")
    cost = None if scores is None else (1 - scores[pair, row0]).to(keypoints0.dtype)
    matches = Matches(keypoints0[pair, row0], keypoints1[pair, row1], lengths_to_ptr(matched.sum(1)), cost)
    return matches, torch.stack([pair, row0, row1], dim=1)


def to_glue_factory(
    data: Mapping[str, Any], indices: Tensor, inlier: Tensor, score: Tensor | None = None
) -> dict[str, Tensor]:
    """Write verdicts back into the form that the matches came from.

    Args:
        data: the dictionary that :func:`from_glue_factory` was given.
        indices: (M, 3) int64, the second result of :func:`from_glue_factory`.
        inlier: (M,) bool verdicts.
        score: (M,) scores of the filter, in [0, 1]; None leaves the scores of inliers as they are.

    Returns:
        New tensors for those of ``matches0``, ``matches1``, ``matching_scores0`` and ``matching_scores1`` that ``data``
        holds, in their layout. A rejected match becomes -1 with score 0, on both sides. The score of an inlier is
        multiplied by ``score``. All other places keep their value, so -2 stays -2. Gradients flow to both scores.

    Raises:
        ValueError: if ``indices``, ``inlier`` or ``score`` has another number of rows.
        TypeError: if ``inlier`` is not bool.

    Example:
        >>> data = {"matches0": torch.tensor([[1, -2, 0]]), "matching_scores0": torch.tensor([[0.5, 0.0, 0.8]])}
        >>> indices = torch.tensor([[0, 0, 1], [0, 2, 0]])
        >>> to_glue_factory(data, indices, torch.tensor([True, False]))
        {'matches0': tensor([[ 1, -2, -1]]), 'matching_scores0': tensor([[0.5000, 0.0000, 0.0000]])}
    """
    if indices.ndim != 2 or indices.shape[1] != 3:
        raise ValueError(f"indices must have shape (M, 3), got {tuple(indices.shape)}")
    check_vector("inlier", inlier, len(indices))
    check_mask("inlier", inlier)
    if score is not None:
        check_vector("score", score, len(indices))
    weight = inlier.float() if score is None else torch.where(inlier, score, 0)
    if data["matches0"].ndim == 1:
        batched = to_glue_factory(_with_batch_axis(data), indices, inlier, score)
        return {name: values[0] for name, values in batched.items()}
    pair, row0, row1 = indices.unbind(1)
    result = _write_view(data, "0", (pair, row0), inlier, weight)
    if "matches1" in data:
        # A matcher that is not mutual may match one keypoint of view 1 twice; matches1 knows one of them at most.
        mutual = data["matches1"][pair, row1] == row0
        result |= _write_view(data, "1", (pair[mutual], row1[mutual]), inlier[mutual], weight[mutual])
    return result


def _with_batch_axis(data: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that the converters read, of one pair, as a batch of one."""
    return {name: data[name][None] for name in _ENTRIES if data.get(name) is not None}


def _write_view(
    data: Mapping[str, Any], view: str, places: tuple[Tensor, Tensor], inlier: Tensor, weight: Tensor
) -> dict[str, Tensor]:
    """The two entries of one view with rejected matches taken out."""
    partners = data[f"matches{view}"]
    result = {f"matches{view}": partners.index_put(places, torch.where(inlier, partners[places], -1))}
    scores = data.get(f"matching_scores{view}")
    if scores is not None:
        result[f"matching_scores{view}"] = scores.index_put(places, scores[places] * weight.to(scores.dtype))
    return result


def two_view_filter(**settings: Any) -> DelaunayFilter:
    """The default filter for matches of any two views, which need not be rectified.

    It is a :class:`~tensor_stereo.DelaunayFilter` that looks at every pair whether it is rectified.

    Args:
        **settings: Settings of :class:`~tensor_stereo.DelaunayFilter` in place of these.

    >>> two_view_filter().config.verdict, two_view_filter().config.rectified
    ('score', 'auto')
    """
    return DelaunayFilter(**{"rectified": "auto"} | settings)


def _images_of(data: Mapping[str, Any], run: Callable[..., FilterOutput]) -> dict[str, Tensor]:
    """The images of both views, where there are such and the filter looks at them."""
    if not isinstance(run, DelaunayFilter) or run.config.resolved_score != "learned":
        return {}
    images = {f"images{view}": (data.get(f"view{view}") or {}).get("image") for view in (0, 1)}
    found = {name: image for name, image in images.items() if image is not None}
    return found if len(found) == 2 else {}


class GlueFactoryFilter(nn.Module):
    """The ``filter`` of a two-view pipeline: dictionary in, the entries that change out.

    In glue-factory's configuration this module is named by its path, with the settings of
    :class:`~tensor_stereo.DelaunayFilter` beside it::

        filter:
            name: tensor_stereo.interop.glue_factory
            verdict: adjacency

    Args:
        filter: Takes Matches, returns a FilterOutput; None is :func:`two_view_filter`. A
            :class:`~tensor_stereo.DelaunayFilter` whose score looks at images gets those of ``data["view0"]["image"]``
            and ``data["view1"]["image"]``, if they are there.

    Example:
        >>> x, y = torch.meshgrid(torch.arange(0.0, 40, 10), torch.arange(0.0, 40, 10), indexing="xy")
        >>> points = torch.stack([x, y], -1).reshape(1, 16, 2)
        >>> data = {"keypoints0": points, "keypoints1": points - 1, "matches0": torch.arange(16)[None]}
        >>> bool((GlueFactoryFilter()(data)["matches0"] == data["matches0"]).all())
        True
    """

    required_data_keys = ("keypoints0", "keypoints1", "matches0")

    def __init__(self, filter: Callable[..., FilterOutput] | None = None) -> None:  # noqa: A002 - the slot's name
        super().__init__()
        self.filter = two_view_filter() if filter is None else filter

    @classmethod
    def from_conf(cls, conf: Mapping[str, Any]) -> GlueFactoryFilter:
        """The filter of a glue-factory configuration; entries that DelaunayFilter lacks raise TypeError.

        Without any setting it is :func:`two_view_filter`.
        """
        settings = {name: value for name, value in conf.items() if name not in _PIPELINE_KEYS}
        if not settings.get("trainable"):  # glue-factory writes it into every component
            settings.pop("trainable", None)
        if "consensus" in settings:
            settings["consensus"] = ConsensusConfig(**(settings["consensus"] or {}))
        return cls(two_view_filter(**settings))

    def forward(self, data: Mapping[str, Any]) -> dict[str, Tensor]:
        """Take out what the filter rejects.

        Args:
            data: a dictionary for :func:`from_glue_factory`; ``matches1`` and ``matching_scores1`` are kept consistent.

        Returns:
            The result of :func:`to_glue_factory`, with the score of an inlier multiplied by the filter's. Gradients
            flow to the matcher's scores, and to the keypoints if the filter's score is differentiable.
        """
        matches, indices = from_glue_factory(data)
        output = self.filter(matches, **_images_of(data, self.filter))
        return to_glue_factory(data, indices, output.inlier, output.score)

    def loss(self, pred: Mapping[str, Any], data: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Not implemented, which tells glue-factory to go on with the losses of the other components."""
        raise NotImplementedError


__main_model__ = GlueFactoryFilter.from_conf  # glue-factory looks for this name in a module given by its path
