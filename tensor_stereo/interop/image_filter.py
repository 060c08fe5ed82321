"""Matches from files through the filter together with the images that they were found in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from tensor_stereo.batching import split_matches
from tensor_stereo.interop.image_folder import ImageFolder
from tensor_stereo.interop.verdicts import (
    Float,
    Improved,
    Key,
    MatchFilter,
    Verdicts,
    concatenate,
    filter_each,
    filter_matches,
    to_improved,
    to_verdicts,
)
from tensor_stereo.modules import DelaunayFilter, FilterOutput
from tensor_stereo.types import Matches


class PairImages(NamedTuple):
    """What a file says of a pair beside its matches.

    Attributes:
        name0: Name of the image of view 0.
        name1: Name of the image of view 1.
        keypoints0: (N0, 2) px, all keypoints of view 0; None where the file only has those with a partner.
    """

    name0: str
    name1: str
    keypoints0: Float | None = None


class ImageFilter:
    """A filter of matches that looks at their images and, if asked, repairs and refines them.

    Args:
        run: The filter.
        images: The folder of the images.
        repair: Whether rejected matches and keypoints without a partner are searched again.
        refine: Whether kept matches move to a fraction of a pixel, after repair.
    """

    def __init__(self, run: DelaunayFilter, images: ImageFolder, *, repair: bool, refine: bool) -> None:
        self.images = images
        self._run, self._repair, self._refine = run, repair, refine
        self.improves = repair or refine
        self.num_rectified = 0

    def __call__(self, matches: Matches) -> FilterOutput:
        """The verdict without images."""
        return self._run(matches)  # type: ignore[no-any-return]

    def look(self, matches: Matches, pair: PairImages) -> tuple[Verdicts, Improved | None]:
        """The verdicts on the matches of one pair as they are, and the matches after repair and refinement.

        Raises:
            ValueError: If an image is missing or damaged, or keypoints do not lie in it; the message names the images.
        """
        try:
            views = [[self.images.read(name)] for name in pair[:2]]
            is_shown = self._run.config.resolved_score == "learned"
            output = self._run(matches, **(dict(zip(("images0", "images1"), views, strict=True)) if is_shown else {}))
            if output.alignment is not None:
                self.num_rectified += int(output.alignment.rectified.sum())
            better = output
            if self._repair:
                keypoints0 = None if pair.keypoints0 is None else torch.from_numpy(pair.keypoints0.astype(np.float64))
                better = better.repair(*views, keypoints0=keypoints0)
            if self._refine:
                better = better.refine(*views)
        except (ValueError, FileNotFoundError) as error:
            raise ValueError(f"images {pair.name0!r} and {pair.name1!r}: {error}") from error
        return to_verdicts(output), to_improved(better) if self.improves else None


def filter_stream(
    items: Iterable[tuple[Key, Matches, PairImages]], run: MatchFilter
) -> Iterator[tuple[Key, Verdicts, Improved | None]]:
    """Run a filter over a stream of pairs, with their images if it looks at them.

    Args:
        items: a key for each pair, its matches, and what the file says of its images.
        run: an :class:`ImageFilter`, or a filter for :func:`tensor_stereo.interop.verdicts.filter_matches`.

    Yields:
        Every key with its verdicts and its improved matches, in order.
    """
    if isinstance(run, ImageFilter):
        for key, matches, pair in items:
            yield key, *run.look(matches, pair)
        return
    for key, verdicts in filter_each(((key, matches) for key, matches, _ in items), run):
        yield key, verdicts, None


def filter_pairs(matches: Matches, pairs: Sequence[PairImages], run: MatchFilter) -> tuple[Verdicts, Improved | None]:
    """Run a filter over a batch, with the images of its pairs if it looks at them.

    Args:
        matches: B pairs on the CPU.
        pairs: Their images; empty if the filter does not look at them.
        run: as for :func:`filter_stream`.

    Returns:
        The verdicts, and the improved matches, pair by pair, whose rows are those of the batch.
    """
    if not pairs:
        whole = filter_matches(matches, run)
        improves = isinstance(run, ImageFilter) and run.improves
        return whole, _no_improved(whole) if improves else None
    items = zip(matches.ptr[:-1].tolist(), split_matches(matches), pairs, strict=True)
    verdicts, improved = [], []
    for start, verdict, better in filter_stream(items, run):
        verdicts.append(verdict)
        if better is not None:
            improved.append(better._replace(rows=np.where(better.rows < 0, -1, better.rows + start)))
    return concatenate(Verdicts, verdicts), concatenate(Improved, improved) if improved else None


def _no_improved(verdicts: Verdicts) -> Improved:
    """Of no matches, so that the columns of a result do not depend on its rows."""
    none = np.zeros((0, 2))
    inlier, score, relation = verdicts
    return Improved(none, none, np.zeros(0, np.int64), np.zeros(0, np.int8), inlier, score, relation)
