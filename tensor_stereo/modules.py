"""The classifier as a module: padded keypoints or ragged matches in, verdicts and scores out."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from tensor_stereo.batching import from_padded, lengths_to_ptr
from tensor_stereo.classification import apply_score, classify_graphs, mask_untested
from tensor_stereo.configs import COLDEST, HOTTEST, ConsensusConfig, FilterConfig
from tensor_stereo.features import list_images
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.outputs import FilterOutput as FilterOutput
from tensor_stereo.outputs import Images as Images
from tensor_stereo.scores.by_name import score_matches
from tensor_stereo.scores.image_evidence import ImageEvidence
from tensor_stereo.scores.learned import LearnedNetworks, load_learned
from tensor_stereo.types import Matches, check_mask, check_pixels, check_tensor

_RENAMED = {"restriction": "verdict", "unit": "temperature_unit"}


class DelaunayFilter(nn.Module):
    """Decides which putative matches are right, and scores them with gradients.

    By default a match is kept if its calibrated probability of being right, the score ``learned``, is at least .5. The
    set tests of the paper, :func:`tensor_stereo.classify_matches`, are the verdicts ``adjacency`` and ``cardinality``;
    their result, ``relation``, is always returned.

    Args:
        config: The settings; None means the defaults.
        straight_through: Whether the score is the verdict, with the gradient of the soft score.
        learnable_temperature: Whether the temperature of ``topology`` is a parameter; its logarithm is what is learnt.
        trainable: Whether the weights of ``learned`` have gradients. They are parameters, and frozen unless this is
            set. Those that look at images get a gradient only where there are images, and those of the first beliefs
            none.
        **settings: Fields of :class:`tensor_stereo.FilterConfig` that replace those of ``config``:

            ``verdict``: ``score``, or ``adjacency`` or ``cardinality``, the paper's Restrictions 1 and 2.
            ``score``: ``learned``, the calibrated probability of a small network
            (:func:`tensor_stereo.scores.learned.score_learned`), best with the images; ``consensus``, the calibrated
            probability that follows from how far the believed neighbours of a match predict its displacement
            (:func:`tensor_stereo.scores.consensus.consensus_score`); ``topology``, how far both neighbour sets agree:
            their soft Jaccard index, a similarity, 1 iff Restriction 1 holds; ``auto``, ``learned`` under the verdict
            ``score`` and ``topology`` under the others; ``none`` under the others only.
            ``threshold``: The least score of a match that is kept, in place of .5.
            ``min_precision``: The verdict keeps the largest set of matches of a pair whose expected precision is at
            least this value (precision is the paper's negative predictive value).
            ``target_sensitivity``: The verdict keeps the largest set of matches of a pair that is expected to leave out
            this fraction of the incorrect ones.
            ``max_error_px``: The score is the probability of an error of at most this, from .5 to 5 px of view 0.
            ``min_group_size``, ``tie_tolerance``, ``backend``: As in :func:`tensor_stereo.classify_matches`.
            ``rectified``: Whether partners lie on one row, as ``learned`` and ``consensus`` expect by default; False
            for any two views; ``auto`` decides for every pair by its matches, and ``alignment.rectified`` says what it
            took.
            ``consensus``: Settings of that score.
            ``temperature``: Of ``topology``; dual Voronoi edges much shorter than this are hardly told from ties.
            ``temperature_unit``: ``edge``, in lengths of the edge at hand, so that the score does not depend on scale;
            or ``px``.

    Raises:
        TypeError: for a setting that does not exist.
        ValueError: for a value outside of its limits, or settings that contradict each other.

    The state dictionary holds the weights and a fingerprint of the settings that define the score; the state of another
    score is refused, but not that of another tolerance, which has the same weights. ``torch.compile(fullgraph=True)``
    works, for ``learned`` with batches that have at least one pair of neighbours, and without images: to use these,
    measure the evidence outside of the compiled part. Compiled, it marks pairs outside of the domain without a warning.

    Source: the set tests are those of Bustos, Vargas & Trujillo, CIARP 2016, section 3; the scores are this library's.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> left = torch.rand(2, 300, 2, generator=generator) * 300
        >>> right = left - torch.tensor([5.0, 0.0])
        >>> right[:, :90] = torch.rand(2, 90, 2, generator=generator) * 300  # wrong matches
        >>> output = DelaunayFilter()(left, right)
        >>> output.inlier[:, :90].sum(), output.inlier[:, 90:].sum()
        (tensor(0), tensor(420))
    """

    log_temperature: Tensor

    def __init__(
        self,
        config: FilterConfig | None = None,
        *,
        straight_through: bool = False,
        learnable_temperature: bool = False,
        trainable: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__()
        config = _merge(FilterConfig() if config is None else config, settings)
        if config.score == "auto" and config.verdict != "score":
            config = replace(config, score="topology")  # its soft counterpart, whose gradient is asked for
        self.config = config
        score = config.resolved_score
        for name, given, needed in (
            ("learnable_temperature", learnable_temperature, ("topology",)),
            ("trainable", trainable, ("learned",)),
            ("straight_through", straight_through, ("topology", "consensus", "learned")),
        ):
            if given and score not in needed:
                raise ValueError(f"{name} must be False where the score is {score!r}")
        self.straight_through = straight_through
        self.network: LearnedNetworks | None = None
        with torch.inference_mode(False):  # tensors that were made in it could never take part in a gradient
            logarithm = torch.tensor(config.temperature, dtype=torch.float64).log()
            if learnable_temperature:
                self.log_temperature = nn.Parameter(logarithm)
            else:
                self.register_buffer("log_temperature", logarithm)
            if score == "learned":
                networks = (
                    copy.deepcopy(load_learned(rectified=kind)) if config.rectified in (kind, "auto") else None
                    for kind in (True, False)
                )
                self.network = LearnedNetworks(*networks).requires_grad_(trainable)
        self.register_load_state_dict_pre_hook(_refuse_other_score)  # type: ignore[no-untyped-call]

    @property
    def temperature(self) -> Tensor:
        """() float64, in ``temperature_unit``, whatever the dtype that the module is moved to."""
        return self.log_temperature.exp().clamp(COLDEST, HOTTEST)

    def extra_repr(self) -> str:
        """The settings, in one line."""
        settings = {f.name: getattr(self.config, f.name) for f in fields(FilterConfig)}
        settings["score"] = self.config.resolved_score
        if settings["consensus"] == ConsensusConfig() or settings["score"] != "consensus":
            del settings["consensus"]
        if settings["score"] != "topology":
            del settings["temperature"], settings["temperature_unit"]
        shown = [f"{name}={value!r}" for name, value in settings.items() if value is not None]
        return ", ".join([*shown, *(["straight_through=True"] if self.straight_through else [])])

    def get_extra_state(self) -> Tensor:
        """The settings that define the score, as the bytes of a JSON text, for ``state_dict``."""
        text = json.dumps(self._fingerprint(), sort_keys=True)
        return torch.tensor(list(text.encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse the state of another score.

        Raises:
            ValueError: naming the setting that differs.
        """
        mine = self._fingerprint()
        try:
            known = json.loads(bytes(state.to(torch.uint8).tolist()))
        except ValueError as error:
            raise ValueError("state_dict holds no readable fingerprint of a DelaunayFilter's settings") from error
        for name in sorted(known.keys() | mine.keys(), key=lambda name: (name != "score", name)):
            if known.get(name) != mine.get(name):
                given = f"{known.get(name)!r}, but this filter has {mine.get(name)!r}"
                raise ValueError(f"state_dict is that of a DelaunayFilter with {name}={given}")

    def _fingerprint(self) -> dict[str, Any]:
        config = self.config
        score = config.resolved_score
        settings: dict[str, Any] = {"score": score, "tie_tolerance": config.tie_tolerance}
        if score == "topology":
            settings["temperature_unit"] = config.temperature_unit
        if score == "consensus":
            settings["consensus"] = asdict(config.consensus)
        if score in ("consensus", "learned"):
            settings["rectified"] = config.rectified
        return settings

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DelaunayFilter:
        """Follow a move to another device, but not one to another dtype: each score has its own precision."""
        super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)  # type: ignore[no-untyped-call]
        return self

    def forward(
        self,
        keypoints0: Tensor | Matches,
        keypoints1: Tensor | None = None,
        mask: Tensor | None = None,
        group: Tensor | None = None,
        cost: Tensor | None = None,
        *,
        images0: Images | None = None,
        images1: Images | None = None,
        evidence: ImageEvidence | None = None,
    ) -> FilterOutput:
        """Classify and score padded pairs, one pair, or a ragged batch given as the only argument.

        Args:
            keypoints0: (B, N, 2) float32 or float64 px of view 0; (N, 2) for one pair, then without batch axis in all
                other arguments and in the result; or :class:`Matches`.
            keypoints1: (B, N, 2) px of view 1; row i of both is one match.
            mask: (B, N) bool, True for real matches; None means all. The padding may hold anything.
            group: (B, N) integer object groups.
            cost: (B, N), lower is better; decides between duplicates, and is evidence for consensus and learned.
            images0: Images of view 0, at which ``learned`` looks: (B, C, H, W), or a list of B images (C, H, W) of any
                sizes; uint8 or floating point in [0, 1], C = 1 or 3 (RGB). The keypoints are px of these images.
            images1: Images of view 1.
            evidence: What :func:`tensor_stereo.scores.measure_images` has measured before for the rows of
                ``Matches``, in place of the images.

        Returns:
            ``inlier``, ``score``, ``relation`` and ``cumulative`` in the layout of the input. The score has the dtype
            of the keypoints, under autocast that of autocast. Gradients flow from it to both keypoints (and the
            temperature, and for consensus the cost), and are zero for untested matches; topology is not differentiable
            twice.

        Raises:
            ValueError: if shapes disagree, coordinates are NaN, infinite or out of range, or costs are NaN.
            TypeError: for values that are no tensors of the right dtype; for arguments beside ``Matches``; for images
                beside a score that looks at none.

        Warns:
            DomainWarning: if the keypoints are no pixels, or matches do not agree on rows of rectified pairs, or on a
                map of other views, as ``learned`` and ``consensus`` expect.
        """
        if isinstance(keypoints0, Matches):
            rest = {"keypoints1": keypoints1, "mask": mask, "group": group, "cost": cost}
            for name in (name for name, value in rest.items() if value is not None):
                raise TypeError(f"{name} must be part of the Matches, not given beside them")
            return self._decide(keypoints0, images0, images1, evidence)
        if evidence is not None:
            raise TypeError("evidence must be that of Matches, got padded keypoints")
        if keypoints1 is None:
            raise ValueError("keypoints1 must be given with keypoints0")
        tensors = {"keypoints0": keypoints0, "keypoints1": keypoints1, "mask": mask, "group": group, "cost": cost}
        for name, value in tensors.items():
            if value is not None:
                check_tensor(name, value)
        single = keypoints0.ndim == 2
        if single:
            tensors = {name: None if value is None else value[None] for name, value in tensors.items()}
        mask = _check_padded(tensors, single=single)
        rows = {name: None if v is None else from_padded(v, mask)[0] for name, v in tensors.items() if name != "mask"}
        ptr = lengths_to_ptr(mask.sum(1))
        matches = Matches(rows["keypoints0"], rows["keypoints1"], ptr, rows["cost"], rows["group"])  # type: ignore[arg-type]
        output = self._decide(matches, images0, images1, None)
        spread: dict[str, Any] = {"mask": mask}
        for name in ("inlier", "score", "relation", "cumulative"):
            values: Tensor | None = getattr(output, name)
            spread[name] = None if values is None else _spread(values, mask)
        if single:
            spread = {name: None if values is None else values[0] for name, values in spread.items()}
        return FilterOutput(matches=matches, alignment=output.alignment, domain=output.domain, judge=self, **spread)

    def _decide(
        self, matches: Matches, images0: Images | None, images1: Images | None, evidence: ImageEvidence | None
    ) -> FilterOutput:
        """Verdict, score and relation of every match."""
        config = self.config
        images = _both_views(images0, images1, matches.num_pairs)
        if config.resolved_score == "none":
            for name, value in (("images0", images), ("evidence", evidence)):
                if value is not None:
                    raise TypeError(f"{name} must be None where there is no score")
            graphs = build_match_graphs(matches, tie_tolerance=config.tie_tolerance, backend=config.backend)
            verdict = classify_graphs(graphs, config)
            return FilterOutput(verdict.inlier, None, verdict.relation, matches, judge=self)
        found = score_matches(
            matches, config, images=images, evidence=evidence, temperature=self.temperature, network=self.network
        )
        score = found.score.to(matches.keypoints0.dtype)
        verdict, score = apply_score(classify_graphs(found.graphs, config), score, matches.ptr, config)
        device = matches.keypoints0.device.type
        if torch.is_autocast_enabled(device):  # after the verdict, which no rounding shall change
            score = score.to(torch.get_autocast_dtype(device))
        if self.straight_through:
            score = score + (verdict.inlier.to(score.dtype) - score).detach()
        cumulative = mask_untested(found.cumulative, verdict)
        return FilterOutput(
            verdict.inlier,
            score,
            verdict.relation,
            matches,
            None,
            found.alignment,
            cumulative,
            found.domain,
            judge=self,
        )


def _refuse_other_score(module: DelaunayFilter, state_dict: dict[str, Any], prefix: str, *_: Any) -> None:
    """Look at the fingerprint before anything is loaded."""
    state = state_dict.get(f"{prefix}_extra_state")
    if state is not None:
        module.set_extra_state(state)


def _merge(config: FilterConfig, settings: dict[str, Any]) -> FilterConfig:
    """The same settings with others in their place; raises for names that are none."""
    if not isinstance(config, FilterConfig):
        raise TypeError(f"config must be a FilterConfig, got {config!r}; other settings are keyword arguments")
    names = [f.name for f in fields(FilterConfig)]
    for name in settings:
        if name in _RENAMED:
            raise TypeError(f"DelaunayFilter has no setting {name!r}; it is {_RENAMED[name]!r} now")
        if name not in names:
            raise TypeError(f"DelaunayFilter has no setting {name!r}; known are {', '.join(names)}")
    if settings.get("consensus", config) is None:
        settings = settings | {"consensus": ConsensusConfig()}
    return replace(config, **settings)


def _both_views(
    images0: Images | None, images1: Images | None, num_pairs: int
) -> tuple[list[Tensor], list[Tensor]] | None:
    if images0 is None and images1 is None:
        return None
    for name, images in (("images0", images0), ("images1", images1)):
        if images is None:
            raise ValueError(f"{name} must be given, as the other view has images")
    return list_images("images0", images0, num_pairs), list_images("images1", images1, num_pairs)  # type: ignore[arg-type]


def _check_padded(tensors: dict[str, Tensor | None], *, single: bool) -> Tensor:
    """The mask (B, N); raises unless all shapes fit, of which those of one pair have no batch axis yet."""
    keypoints0, mask = tensors["keypoints0"], tensors["mask"]
    if keypoints0 is None or keypoints0.ndim != 3 or keypoints0.shape[2] != 2:
        given = None if keypoints0 is None else tuple(keypoints0.shape[int(single) :])
        raise ValueError(f"keypoints0 must have shape (B, N, 2), or (N, 2) for one pair, got {given}")
    for name, value in tensors.items():
        shape = keypoints0.shape if name.startswith("keypoints") else keypoints0.shape[:2]
        if value is not None and value.shape != shape:
            expected, given = (tuple(size[1:] if single else size) for size in (shape, value.shape))
            raise ValueError(f"{name} must have shape {expected}, got {given}")
        if value is not None and name.startswith("keypoints"):
            check_pixels(name, value)
    if mask is None:
        return torch.ones(keypoints0.shape[:2], dtype=torch.bool, device=keypoints0.device)
    check_mask("mask", mask)
    return mask


def _spread(rows: Tensor, mask: Tensor) -> Tensor:
    """(M, ...) rows -> (B, N, ...), zero in the padding."""
    mask = mask.reshape(mask.shape + (1,) * (rows.ndim - 1)).expand(mask.shape + rows.shape[1:])
    return torch.zeros_like(mask, dtype=rows.dtype).masked_scatter(mask, rows)
