"""What a filter says of matches, and what can be made of it: finer and more matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from tensor_stereo.batching import select_matches
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.alignment import Alignment, estimate_alignment
from tensor_stereo.scores.refine import mark_refined, refine_matches
from tensor_stereo.scores.repair import repair_matches
from tensor_stereo.scores.tolerance import probability_within
from tensor_stereo.types import Matches

if TYPE_CHECKING:
    from tensor_stereo.modules import DelaunayFilter

Images = Tensor | Sequence[Tensor]


@dataclass(frozen=True, eq=False)
class FilterOutput:
    """Verdicts and scores in the layout of the input.

    The layout is (B, N) for padded keypoints, (N,) for one pair without batch axis, and (M,) for :class:`Matches`.

    Attributes:
        inlier: bool; False for untested matches and in the padding.
        score: in [0, 1], higher is better; 0 for untested matches and in the padding. ``consensus`` and ``learned`` are
            the calibrated probability of an error of at most ``max_error_px``, ``topology`` is a similarity. None if
            the settings ask for none.
        relation: int8 values of :class:`Relation`, UNTESTED in the padding.
        matches: the M real matches of the input, as one ragged batch.
        mask: bool, the places of ``matches`` in the layout; None for ragged input.
        alignment: What the matches of each of the B pairs share, which the score has taken out: row offset and drift of
            rectified pairs, map and epipolar lines of others, and whether enough matches agree on them; None where the
            score takes none out.
        cumulative: One axis more: probabilities of an error of at most each of
            :data:`tensor_stereo.scores.TOLERANCES_PX`, 0 where the score is; None where that is no probability. As a
            loss, one minus their mean helps keypoints that are off by a pixel most, one minus the score those that are
            nearly right (measured, see docs/training.md).
        domain: (B,) int8, values of :class:`tensor_stereo.scores.Domain`: why a pair lies outside of what the
            probability was calibrated on, 0 inside; None where there is no probability.
        rows: (M,) int64, of repaired matches: the rows of those that were given, -1 for keypoints that had no partner;
            None: they are the same.
        origin: (M,) int8, values of :class:`tensor_stereo.scores.Origin`, of refined or repaired matches; None: all are
            as given.
        judge: The filter that decided, which scores repaired matches.
    """

    inlier: Tensor
    score: Tensor | None
    relation: Tensor
    matches: Matches
    mask: Tensor | None = None
    alignment: Alignment | None = None
    cumulative: Tensor | None = None
    domain: Tensor | None = None
    rows: Tensor | None = None
    origin: Tensor | None = None
    judge: DelaunayFilter | None = field(default=None, repr=False)

    def probability(self, max_error_px: float) -> Tensor:
        """The calibrated probability of an error of at most ``max_error_px``, without another pass.

        At the tolerance of the settings it is ``score``, bit for bit, but without ``straight_through``.

        Args:
            max_error_px: From .5 to 5 px of view 0.

        Returns:
            In the layout and the dtype of ``score``, 0 where that is 0. It never falls when the tolerance grows.
            Gradients flow as from ``score``.

        Raises:
            ValueError: for another tolerance, or where the score is no probability.

        >>> import torch
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> from tensor_stereo.modules import DelaunayFilter
        >>> output = DelaunayFilter()(left, left - torch.tensor([2.0, 0.0]))
        >>> torch.equal(output.probability(1), output.score)
        True
        """
        found = probability_within(self.cumulative, max_error_px)
        return found if self.score is None else found.to(self.score.dtype)

    def to_matches(self) -> Matches:
        """The inliers, for the next filter. All pairs stay, some possibly empty; gradients flow to the keypoints."""
        return select_matches(self.matches, self.inlier if self.mask is None else self.inlier[self.mask])

    def refine(self, images0: Images, images1: Images, *, max_shift_px: float = 1.0) -> FilterOutput:
        """Move the kept matches to where the windows of both views fit best, to a fraction of a pixel.

        Verdicts and scores stay. See :func:`tensor_stereo.scores.refine_matches`.

        Args:
            images0: Images of view 0, as for :class:`tensor_stereo.DelaunayFilter`.
            images1: Images of view 1.
            max_shift_px: No keypoint moves farther, in px of view 0.

        Returns:
            The same for the moved matches, ragged whatever the layout of this one, with their ``origin``.

        Raises:
            ValueError, TypeError: as :func:`tensor_stereo.scores.refine_matches`.
        """
        flat, graphs = self._flat(), self._graphs()
        alignment = self._known_alignment(graphs)
        options: Any = {"max_shift_px": max_shift_px, "backend": self._settings.backend}
        moved = refine_matches(self.matches, images0, images1, flat.inlier, alignment, graphs, **options)
        origin = torch.zeros_like(flat.relation) if self.origin is None else self.origin
        return replace(flat, matches=moved, origin=mark_refined(self.matches, moved, origin))

    def repair(
        self, images0: Images, images1: Images, *, keypoints0: Tensor | None = None, ptr0: Tensor | None = None
    ) -> FilterOutput:
        """Search rejected matches, and keypoints without a partner, again where kept ones say, and judge all anew.

        See :func:`tensor_stereo.scores.repair_matches`.

        Args:
            images0: Images of view 0, as for :class:`tensor_stereo.DelaunayFilter`.
            images1: Images of view 1.
            keypoints0: (N, 2) px, keypoints of view 0 of which some have no match yet.
            ptr0: (B + 1,) int64 offsets of ``keypoints0``; None for one pair.

        Returns:
            What the same filter says of the repaired matches, ragged whatever the layout of this one, with ``rows`` and
            ``origin``. ``learned`` looks at the images.

        Raises:
            ValueError, TypeError: as :func:`tensor_stereo.scores.repair_matches`, or if nobody knows the filter.
        """
        if self.judge is None:
            raise ValueError("judge must be the filter that decided, got None")
        kept, alignment = self._flat().inlier, self._known_alignment()
        options: Any = {"keypoints0": keypoints0, "ptr0": ptr0, "backend": self._settings.backend}
        found = repair_matches(self.matches, images0, images1, kept, alignment, **options)
        is_shown = self.judge.config.resolved_score == "learned"
        output = self.judge(found.matches, **({"images0": images0, "images1": images1} if is_shown else {}))
        return replace(output, rows=found.rows, origin=found.origin)  # type: ignore[no-any-return]

    def _flat(self) -> FilterOutput:
        """The same in the layout (M,)."""
        if self.mask is None:
            return self
        flat: dict[str, Any] = {"mask": None}
        for name in ("inlier", "score", "relation", "cumulative"):
            values: Tensor | None = getattr(self, name)
            flat[name] = None if values is None else values[self.mask]
        return replace(self, **flat)

    @property
    def _settings(self) -> FilterConfig:
        return FilterConfig() if self.judge is None else self.judge.config

    def _graphs(self) -> MatchGraphs:
        settings = self._settings
        return build_match_graphs(self.matches, tie_tolerance=settings.tie_tolerance, backend=settings.backend)

    def _known_alignment(self, graphs: MatchGraphs | None = None) -> Alignment:
        if self.alignment is not None:
            return self.alignment
        settings, graphs = self._settings, self._graphs() if graphs is None else graphs
        return estimate_alignment(self.matches, graphs, rectified=settings.rectified, backend=settings.backend)
