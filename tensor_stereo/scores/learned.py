"""Learned score: a small network that passes messages over the Delaunay graphs of both views.

Every match starts from its own quantities and, where there are images, from what these say about it. In each of three
rounds it hears from its neighbours in either view, through what lies between both; in the last it also looks at the
plane through the neighbours that are believed so far. Costs and images may be missing: training has left them out at
random, and without them the network adds nothing in their place. It says how likely the error stays within each of five
tolerances. One network has learnt from rectified pairs, another from any two views.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.scores.alignment.form import Alignment
from tensor_stereo.scores.image_evidence import NUM_VALUES, ImageEvidence
from tensor_stereo.scores.learned_inputs import (
    NUM_COST,
    NUM_EDGE,
    NUM_EDGE_IMAGE,
    NUM_NODE,
    NUM_ODD,
    Quantities,
    check_fit,
    measure_quantities,
)
from tensor_stereo.scores.learned_native import infer_natively, runs_natively
from tensor_stereo.scores.planes import NUM_PLANE, NUM_REFINED_PLANE, plane_columns
from tensor_stereo.scores.tolerance import NUM_TOLERANCES, probability_within, rising
from tensor_stereo.types import Adjacency, Matches

WEIGHTS = {
    rectified: Path(__file__).with_name(f"weights_{name}.safetensors")
    for rectified, name in ((True, "rectified"), (False, "views"))
}
_MATCHES_AT_ONCE = 8192  # of the torch network, whose edges stay in the cache, and are enough for two threads
_WIDTH, _EDGE_WIDTH, _ROUNDS = 24, 12, 3
_MAX_NORMALIZED = 4.0  # standard deviations


class LearnedScore(nn.Module):
    """How likely every match is correct, from the graphs, the costs and the images.

    Without images and costs it is translation invariant as :func:`measure_quantities` is; always, the order of the
    matches and the other pairs of the batch change nothing but rounding.

    Args:
        width: of the state of a match.
        edge_width: of a message.
        num_rounds: of messages.
    """

    calibration: Tensor  # (5, 2) slope and bias at each tolerance

    def __init__(self, width: int = _WIDTH, edge_width: int = _EDGE_WIDTH, num_rounds: int = _ROUNDS) -> None:
        super().__init__()
        self.enter = nn.Linear(NUM_NODE + NUM_COST + 2, width)
        self.enter_image = nn.Sequential(nn.Linear(NUM_VALUES, width), nn.ReLU(), nn.Linear(width, width, bias=False))
        self.enter_out = nn.Linear(width, width)
        self.rounds = nn.ModuleList(MessageRound(width, edge_width, plane=k > 1) for k in range(num_rounds))
        self.head = nn.Linear(width, width)
        self.last = nn.Linear(width, NUM_TOLERANCES)
        self.head_whole = nn.Linear(width, width, bias=False)
        sizes = {
            "nodes": NUM_NODE,
            "cost": NUM_COST,
            "image": NUM_VALUES,
            "edges": NUM_EDGE,
            "edge_image": NUM_EDGE_IMAGE,
        }
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("calibration", torch.tensor([1.0, 0.0]).repeat(NUM_TOLERANCES, 1))

    def forward(
        self,
        matches: Matches,
        graphs: MatchGraphs,
        evidence: ImageEvidence | None = None,
        config: FilterConfig | None = None,
        alignment: Alignment | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Logits, as trained, and calibrated probabilities of each match being correct within each tolerance.

        Args:
            matches: B pairs; ``cost`` may be missing.
            graphs: of the same matches.
            evidence: of their images, or None.
            config: ``backend`` is read; None means the defaults.
            alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.

        Returns:
            (M, 5) float32 each, for :data:`tensor_stereo.scores.tolerance.TOLERANCES_PX`. Gradients flow to the
            keypoints from all that is continuous in them, and are finite.
        """
        with torch.autocast(matches.keypoints0.device.type, enabled=False):
            backend = "auto" if config is None else config.backend
            if runs_natively(self, matches, backend, evidence):
                logit = infer_natively(self, matches, graphs, evidence, alignment)
                return logit, self.calibrate(logit)
            logit, _ = self.infer(measure_quantities(matches, graphs, evidence, config, alignment))
            return logit, self.calibrate(logit)

    def infer(self, q: Quantities) -> tuple[Tensor, list[Tensor]]:
        """(M, 5) logits, and (M,) those after the start and each round but the last, which training looks at too."""
        with_image = q.shown
        cost = self._normalize("cost", q.cost) * q.has_cost
        entered = self.enter(torch.cat([self._normalize("nodes", q.nodes), cost, q.has_cost, q.has_image], 1))
        q = q._replace(edges=self._normalize("edges", q.edges))
        if with_image:
            entered = entered + self.enter_image(self._normalize("image", q.image)) * q.has_image
            here = q.has_image.index_select(0, q.i)
            image_i, image_j = (self._normalize("edge_image", x) * here for x in (q.image_i, q.image_j))
            q = q._replace(image_i=image_i, image_j=image_j)
        state = self.enter_out(entered.relu())
        beliefs = []
        for messages in self.rounds:
            state, belief = messages(state, q, with_image)
            beliefs.append(belief)
        whole = self.head_whole(_pair_mean(state, q)).index_select(0, q.batch)
        return _cumulative(self.last((self.head(state) + whole).relu())), beliefs

    def is_plain(self) -> bool:
        """Whether it has the size that the kernel knows, and nothing of it is replaced, hooked or parametrized."""
        known = {LearnedScore, MessageRound, nn.Linear, nn.ReLU, nn.Sequential, nn.ModuleList, nn.LayerNorm}
        for module in self.modules():
            if type(module) not in known or module._forward_hooks or module._forward_pre_hooks:
                return False
        rounds = [messages.edge.out_features for messages in self.rounds]  # type: ignore[union-attr]
        return self.head.out_features == _WIDTH and rounds == [_EDGE_WIDTH] * _ROUNDS

    def calibrate(self, logit: Tensor) -> Tensor:
        """(M, 5) probability; logistic regression on the logits (Platt 1999), fitted on scenes left out of training."""
        slope, bias = self.calibration.unbind(1)
        return rising(torch.sigmoid(slope * logit + bias).unbind(1))

    def _normalize(self, name: str, values: Tensor) -> Tensor:
        mean, scale = getattr(self, f"{name}_mean"), getattr(self, f"{name}_scale")
        return torch.addcmul(-mean * scale, values, scale).clamp(-_MAX_NORMALIZED, _MAX_NORMALIZED)


class MessageRound(nn.Module):
    """One round: along each pair of neighbours in both directions, then at every match.

    Args:
        width: of the state of a match.
        edge_width: of a message.
        plane: whether matches look at the plane through their believed neighbours.
    """

    def __init__(self, width: int, edge_width: int, *, plane: bool) -> None:
        super().__init__()
        self.ends = nn.Linear(width, 2 * edge_width)
        self.edge = nn.Linear(NUM_EDGE, edge_width, bias=False)
        self.odd = nn.Linear(NUM_ODD, edge_width, bias=False)
        self.edge_image = nn.Linear(NUM_EDGE_IMAGE, edge_width, bias=False)
        self.belief = nn.Linear(width, 1)
        self.plane = plane
        self.mix = nn.Linear(width + edge_width + NUM_PLANE * plane, width)
        self.mix_refined = nn.Linear(NUM_REFINED_PLANE, width, bias=False) if plane else None
        self.whole = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, state: Tensor, q: Quantities, with_image: bool) -> tuple[Tensor, Tensor]:
        """(M, width) state and (M,) logit of the belief before it."""
        ends = self.ends(state)
        between, odd = self.edge(q.edges), self.odd(q.odd)
        (hear_i, tell_i), (hear_j, tell_j) = (ends.index_select(0, rows).chunk(2, 1) for rows in (q.i, q.j))
        to_i, to_j = (between + hear_i).add_(tell_j).add_(odd), (between + hear_j).add_(tell_i).sub_(odd)
        belief = self.belief(state)
        if with_image:
            to_i, to_j = to_i.add_(self.edge_image(q.image_i)), to_j.add_(self.edge_image(q.image_j))
        heard = q.receivers.sum(to_i.relu_(), to_j.relu_()) / q.degree
        known = [state, heard]
        if self.plane:
            trust = torch.sigmoid(belief)
            known.append(plane_columns(trust, q, refined=False))
        mixed = self.mix(torch.cat(known, 1)) + self.whole(_pair_mean(state, q)).index_select(0, q.batch)
        if self.mix_refined is not None and with_image:
            mixed = mixed + self.mix_refined(plane_columns(trust, q, refined=True) * q.has_image)
        return self.norm(state + self.out(mixed.relu())), belief[:, 0]


def _cumulative(outputs: Tensor) -> Tensor:
    """(M, 5) logits that grow with the tolerance: that of 1 px, and steps down and up from it."""
    half, one, two, three, five = outputs.unbind(1)
    columns = [one - functional.softplus(half), one]
    for step in (two, three, five):
        columns.append(columns[-1] + functional.softplus(step))
    return torch.stack(columns, 1)


def _pair_mean(state: Tensor, q: Quantities) -> Tensor:
    """(B, K) means over the matches of each pair."""
    return state.new_zeros(q.num_pairs, state.shape[1]).index_add(0, q.batch, state * q.share)


class LearnedNetworks(nn.Module):
    """A network for rectified pairs, another for pairs of any two views, or one of them.

    Args:
        rectified: The network of rectified pairs, or None.
        views: The network of other pairs, or None.
    """

    def __init__(self, rectified: LearnedScore | None, views: LearnedScore | None) -> None:
        super().__init__()
        self.rectified, self.views = rectified, views

    def of(self, *, rectified: bool) -> LearnedScore:
        """The network for one kind of pairs.

        Raises:
            ValueError: if there is none.

        >>> LearnedNetworks(load_learned(), None).of(rectified=True) is load_learned()
        True
        """
        found = self.rectified if rectified else self.views
        if found is None:
            raise ValueError(f"alignment must be of pairs with rectified={not rectified}, as the network is")
        return found


@cache
def load_learned(device: torch.device | None = None, *, rectified: bool = True) -> LearnedScore:
    """The network with the weights of this package, in evaluation mode and without gradients of its weights.

    Args:
        device: where it runs; None: the CPU.
        rectified: Whether it is that of rectified pairs.

    Returns:
        One network per device and process, shared by all callers.

    >>> load_learned().training
    False
    """
    from safetensors.torch import load_file

    with torch.inference_mode(False):  # weights that were made in it could never take part in a gradient
        network = LearnedScore().float()
        network.load_state_dict(load_file(WEIGHTS[rectified]))
        return network.requires_grad_(False).eval().to(device or torch.device("cpu"))


def score_learned(
    matches: Matches,
    graphs: MatchGraphs,
    evidence: ImageEvidence | None = None,
    config: FilterConfig | None = None,
    *,
    alignment: Alignment | None = None,
    network: LearnedScore | LearnedNetworks | None = None,
) -> Tensor:
    """Calibrated probability of every match being correct.

    Args:
        matches: B pairs; ``cost`` may be missing.
        graphs: The graphs of the same matches.
        evidence: What their images say, or None.
        config: ``max_error_px`` and ``backend`` are read; None means the defaults.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.
        network: The network that scores all pairs; None means those with the weights of this package, one for rectified
            pairs and one for others.

    Returns:
        (M,) float32 probability of an error of at most ``max_error_px``, of :func:`learned_probabilities`.

    Raises:
        ValueError: for graphs or evidence of another number of matches.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(300, 2, generator=torch.Generator().manual_seed(0)) * 300
        >>> right = left - torch.tensor([20.0, 0.0])
        >>> right[:30] = right[:30].flip(0)
        >>> matches = Matches(left, right, torch.tensor([0, 300]))
        >>> score = score_learned(matches, build_match_graphs(matches))
        >>> bool(score[:30].max() < score[30:].median())
        True
    """
    config = config or FilterConfig()
    cumulative = learned_probabilities(matches, graphs, evidence, config, alignment=alignment, network=network)
    return probability_within(cumulative, config.max_error_px)


def learned_probabilities(
    matches: Matches,
    graphs: MatchGraphs,
    evidence: ImageEvidence | None = None,
    config: FilterConfig | None = None,
    *,
    alignment: Alignment | None = None,
    network: LearnedScore | LearnedNetworks | None = None,
) -> Tensor:
    """Calibrated probabilities of every match being correct within each tolerance.

    Args:
        matches: B pairs; ``cost`` may be missing.
        graphs: The graphs of the same matches.
        evidence: What their images say, or None.
        config: ``backend`` is read; None means the defaults.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.
        network: The network that scores all pairs; None means those with the weights of this package, one for rectified
            pairs and one for others.

    Returns:
        (M, 5) float32, for :data:`tensor_stereo.scores.tolerance.TOLERANCES_PX`; no row falls. A match that is no
        vertex of the graphs (a duplicate) is scored from its own quantities. Gradients flow to the keypoints from all
        that is continuous in them, and are finite.

    Raises:
        ValueError: for graphs or evidence of another number of matches.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
    >>> matches = Matches(left, left - torch.tensor([5.0, 0.0]), torch.tensor([0, 50]))
    >>> learned_probabilities(matches, build_match_graphs(matches)).shape
    torch.Size([50, 5])
    """
    check_fit(matches, graphs, evidence)
    if torch.compiler.is_compiling():  # neither the lengths of the pairs nor their kinds are known yet
        return _score_compiled(matches, graphs, evidence, config, alignment, network)
    kinds = [True] * matches.num_pairs if alignment is None else alignment.rectified.tolist()
    parts = []
    networks = {kind: _of_kind(network, matches, rectified=kind) for kind in set(kinds)}
    backend = "auto" if config is None else config.backend
    is_native = all(runs_natively(one, matches, backend, evidence) for one in networks.values())
    limit = matches.num_matches if is_native else _MATCHES_AT_ONCE
    for (first, last), part, own, seen in _parts(matches, graphs, evidence, kinds, limit):
        shared = None if alignment is None else alignment.select(first, last)
        parts.append(networks[kinds[first]](part, own, seen, config, shared)[1])
    if not parts:
        return (matches.keypoints0 + matches.keypoints1).float()[:, :1].expand(-1, NUM_TOLERANCES)  # with a gradient
    return torch.cat(parts)


def _of_kind(network: LearnedScore | LearnedNetworks | None, matches: Matches, *, rectified: bool) -> LearnedScore:
    if network is None:
        return load_learned(matches.keypoints0.device, rectified=rectified)
    return network.of(rectified=rectified) if isinstance(network, LearnedNetworks) else network


def _score_compiled(
    matches: Matches,
    graphs: MatchGraphs,
    evidence: ImageEvidence | None,
    config: FilterConfig | None,
    alignment: Alignment | None,
    network: LearnedScore | LearnedNetworks | None,
) -> Tensor:
    """By every network that may be needed, all pairs at once."""
    given = matches, graphs, evidence, config, alignment
    if isinstance(network, LearnedScore):
        return network(*given)[1]  # type: ignore[no-any-return]
    if alignment is None or (network is not None and network.views is None):
        return _of_kind(network, matches, rectified=True)(*given)[1]  # type: ignore[no-any-return]
    of_views: Tensor = _of_kind(network, matches, rectified=False)(*given)[1]
    if network is not None and network.rectified is None:
        return of_views
    is_rectified = alignment.rectified.index_select(0, ptr_to_batch(matches.ptr))[:, None]
    return torch.where(is_rectified, _of_kind(network, matches, rectified=True)(*given)[1], of_views)


def _parts(
    matches: Matches, graphs: MatchGraphs, evidence: ImageEvidence | None, kinds: Sequence[bool], limit: int
) -> Iterator[tuple[tuple[int, int], Matches, MatchGraphs, ImageEvidence | None]]:
    """Runs of pairs of one kind with at most ``limit`` matches, or one pair."""
    offsets = matches.ptr.tolist()
    first = 0
    while first < matches.num_pairs:
        last = first + 1
        while last < matches.num_pairs and kinds[last] == kinds[first] and offsets[last + 1] - offsets[first] <= limit:
            last += 1
        rows = slice(offsets[first], offsets[last])
        ptr = matches.ptr[first : last + 1] - rows.start
        cost = None if matches.cost is None else matches.cost[rows]
        part = Matches(matches.keypoints0[rows], matches.keypoints1[rows], ptr, cost=cost)
        adjacency0, adjacency1 = (_cut(whole, rows, ptr) for whole in (graphs.adjacency0, graphs.adjacency1))
        seen = None if evidence is None else ImageEvidence(*(values[rows] for values in evidence))
        yield (first, last), part, MatchGraphs(adjacency0, adjacency1, graphs.group_size[rows]), seen
        first = last


def _cut(adjacency: Adjacency, rows: slice, ptr: Tensor) -> Adjacency:
    crow = adjacency.crow_indices[rows.start : rows.stop + 1]
    start, stop = int(crow[0]), int(crow[-1])
    return Adjacency(crow - start, adjacency.col_indices[start:stop] - rows.start, ptr)
