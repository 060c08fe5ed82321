"""The learned score by its definition: loops over matches and neighbours, whole (M, M) arrays, float64 throughout."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import expit

from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.image_evidence import NUM_VALUES, ImageEvidence
from tensor_stereo.scores.learned import LearnedScore
from tensor_stereo.types import Matches
from tests.oracles import neighbor_sets

Weights = dict[str, np.ndarray]


class Seen(NamedTuple):
    """What the network sees; ``[i, j]`` is what match i is told about its neighbour j."""

    nodes: np.ndarray  # (M, 8)
    cost: np.ndarray  # (M, 2)
    has_cost: np.ndarray  # (M,) bool
    image: np.ndarray | None  # (M, NUM_VALUES)
    has_image: np.ndarray  # (M,) bool
    disparity: np.ndarray  # (M,) px
    refined: np.ndarray  # (M,) px
    pair: np.ndarray  # (M,) int
    linked: np.ndarray  # (M, M) bool, neighbours in either view
    edges: np.ndarray  # (M, M, 15)
    odd: np.ndarray  # (M, M, 2)
    edge_image: np.ndarray  # (M, M, 9)
    step: np.ndarray  # (M, M, 2)


def random_pairs(
    seed: int, lengths: tuple[int, ...] = (28, 0, 1, 17), *, whole: bool = False, dtype: torch.dtype = torch.float64
) -> Matches:
    """Matches of a sloped surface, 30 % of them wrong, with duplicates, few different costs and two groups per pair."""
    rng = np.random.default_rng(seed)
    count = sum(lengths)
    left, other = (rng.random((count, 2)) * [78, 58] for _ in range(2))
    shift = np.stack([6 + left[:, 0] / 20, rng.normal(0, 0.4, count)], 1)
    right = np.where(rng.random((count, 1)) < 0.3, other, left - shift)
    if whole:
        left, right = left.round(), (2 * right).round() / 2
    repeated = rng.random(count) < 0.05
    left[1:][repeated[1:]] = left[:-1][repeated[1:]]
    cost = rng.choice([-1.0, 0.0, 0.004, 0.5, 3.0, 20.0, 1000.0, 1e5], count)
    points = (torch.from_numpy(view).to(dtype) for view in (left, right))
    ptr = torch.tensor([0, *lengths]).cumsum(0)
    return Matches(*points, ptr, torch.from_numpy(cost).to(dtype), torch.from_numpy(rng.integers(0, 2, count)))


def random_evidence(seed: int, matches: Matches, *, seen: float = 1.0) -> ImageEvidence:
    """Made-up evidence of the right form; each pair has images with probability ``seen``."""
    rng = np.random.default_rng(seed)
    count, width = matches.num_matches, 24
    curves = (torch.from_numpy(rng.normal(0, 2, (count, 2, width))).float() for _ in range(2))
    shown = np.repeat(rng.random(matches.num_pairs) < seen, matches.ptr.diff().numpy())
    num_columns = torch.from_numpy(np.where(shown, rng.integers(1, width + 1, count), 0))
    values = torch.from_numpy(rng.normal(0, 1, (count, NUM_VALUES))).float()
    first, offset = (torch.from_numpy(x).float() for x in (rng.integers(-9, 6, count), rng.normal(0, 0.7, count)))
    return ImageEvidence(values, *curves, first, num_columns, offset)


def see(matches: Matches, evidence: ImageEvidence | None = None, graphs: MatchGraphs | None = None) -> Seen:
    """The quantities, match by match and edge by edge, over sets of neighbours."""
    graphs = build_match_graphs(matches) if graphs is None else graphs
    near0, near1 = neighbor_sets(graphs.adjacency0), neighbor_sets(graphs.adjacency1)
    left, right = (view.detach().double().numpy() for view in (matches.keypoints0, matches.keypoints1))
    disparity, row_offset = (left - right).T
    count = len(left)
    near = [a | b for a, b in zip(near0, near1, strict=True)]
    linked = np.array([[j in near[i] for j in range(count)] for i in range(count)], bool).reshape(count, count)
    refined = disparity if evidence is None else disparity + evidence.offset.double().numpy()
    edges, odd, edge_image, step = (np.zeros((count, count, k)) for k in (15, 2, 9, 2))
    length = [{j: _length(left[j] - left[i]) for j in near[i]} for i in range(count)]
    reach = [np.mean([*found.values()]) if found else 0 for found in length]  # px, to the neighbours
    for i, j in np.argwhere(linked):
        gap, row_gap = abs(disparity[j] - disparity[i]), abs(row_offset[j] - row_offset[i])
        length0, length1, same = length[i][j], _length(right[j] - right[i]), np.exp(-gap / 0.7)
        in0, in1 = j in near0[i], j in near1[i]
        edges[i, j] = [
            *(same, np.exp(-gap / 2), np.exp(-gap / 6), np.log1p(gap)),
            *(min(gap / length0, 2), np.exp(-8 * gap / length0), np.exp(-row_gap), np.log1p(row_gap)),
            *(in0, in1, np.log(length0), np.log(length1 / length0), same * (in0 and in1)),
            abs(left[j, 1] - left[i, 1]) / length0,
            np.tanh((disparity[j] - disparity[i]) / 4) * (left[j, 0] - left[i, 0]) / length0,
        ]
        odd[i, j] = [np.tanh((disparity[j] - disparity[i]) / scale_px) for scale_px in (2, 8)]
        step[i, j] = (left[j] - left[i]) / ((reach[i] + reach[j]) / 2)
        if evidence is not None:
            column = int(np.round(disparity[j] - float(evidence.first[i])))
            if 0 <= column < int(evidence.num_columns[i]):
                curves = [float(c) for curve in (evidence.curve0, evidence.curve1) for c in curve[i, :, column]]
                edge_image[i, j, :5] = [*(curves if gap >= 0.5 else np.zeros(4)), 1]
            between = abs(refined[j] - refined[i])
            closeness = np.exp(-between / 0.3), np.exp(-between), np.exp(-27 * between / max(length0, 1))
            edge_image[i, j, 5:] = [*closeness[:2], np.log1p(between), closeness[2]]
    return Seen(
        np.array([_node(*sets, abs(r)) for *sets, r in zip(near0, near1, row_offset, strict=True)]).reshape(-1, 8),
        *_relative_costs(matches),
        None if evidence is None else evidence.values.double().numpy(),
        np.zeros(count, bool) if evidence is None else evidence.num_columns.numpy() > 0,
        *(disparity, refined, np.repeat(np.arange(matches.num_pairs), matches.ptr.diff().numpy())),
        *(linked, edges, odd, edge_image, step),
    )


def _length(way: np.ndarray) -> float:
    return float(np.sqrt((way**2).sum() + 1e-6))  # 1e-3 px between coincident points


def _node(near0: set[int], near1: set[int], row_offset: float) -> list[float]:
    shared, fewer = len(near0 & near1), min(len(near0), len(near1))
    parts = [shared / max(len(near0 | near1), 1), shared / max(fewer, 1)]
    return [
        *(*parts, np.log1p(len(near0)), np.log1p(len(near1))),
        *(np.exp(-2 * row_offset), np.exp(-row_offset / 2), np.log1p(row_offset), np.log1p(shared)),
    ]


def _relative_costs(matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    """Share of the pair that is cheaper, equal ones by half; log cost less its mean over the pair; who has a cost."""
    count = matches.num_matches
    columns, known = np.zeros((count, 2)), np.zeros(count, bool)
    for start, stop in pairwise(matches.ptr.tolist()) if matches.cost is not None else ():
        own = matches.cost[start:stop].detach().double().numpy()
        if not np.isfinite(own).all() or not len(own):
            continue  # an infinite cost says nothing, and no mean can be told
        known[start:stop] = True
        logs = np.log(own - min(0, own.min()) + 1e-3)
        columns[start:stop, 0] = [((own < value).sum() + (own == value).sum() / 2) / len(own) for value in own]
        columns[start:stop, 1] = np.clip(logs - logs.mean(), -5, 5)
    return columns, known


def weights_of(network: LearnedScore) -> Weights:
    return {name: values.double().numpy() for name, values in network.state_dict().items()}


def infer(weights: Weights, seen: Seen, num_rounds: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """(M, 5) logits at the tolerances and (rounds, M) logits of the beliefs before each round."""
    cost = _normalize(weights, "cost", seen.cost) * seen.has_cost[:, None]
    flags = np.stack([seen.has_cost, seen.has_image], 1)
    state = _linear(weights, "enter", np.concatenate([_normalize(weights, "nodes", seen.nodes), cost, flags], 1))
    between = _normalize(weights, "edges", seen.edges)
    shown = np.zeros_like(seen.edge_image)
    if seen.image is not None:
        hidden = np.maximum(_linear(weights, "enter_image.0", _normalize(weights, "image", seen.image)), 0)
        state = state + _linear(weights, "enter_image.2", hidden) * seen.has_image[:, None]
        shown = _normalize(weights, "edge_image", seen.edge_image) * seen.has_image[:, None, None]
    state = _linear(weights, "enter_out", np.maximum(state, 0))
    same = seen.pair[:, None] == seen.pair
    mean_of_pair = same / same.sum(1, keepdims=True)
    beliefs = []
    for k in range(num_rounds):
        own = {name.removeprefix(f"rounds.{k}."): w for name, w in weights.items() if f"rounds.{k}." in name}
        hear, tell = np.split(_linear(own, "ends", state), 2, axis=1)
        said = _linear(own, "edge", between) + _linear(own, "odd", seen.odd) + hear[:, None] + tell
        said = said + _linear(own, "edge_image", shown)
        heard = (np.maximum(said, 0) * seen.linked[..., None]).sum(1) / np.maximum(seen.linked.sum(1, keepdims=True), 1)
        beliefs.append(_linear(own, "belief", state)[:, 0])
        trust = expit(beliefs[-1])
        known = [state, heard, *([plane_columns(trust, seen, seen.disparity)[:, 5:]] if k > 1 else [])]
        mixed = _linear(own, "mix", np.concatenate(known, 1)) + _linear(own, "whole", mean_of_pair @ state)
        if k > 1 and seen.image is not None:
            found = _linear(own, "mix_refined", plane_columns(trust, seen, seen.refined))
            mixed = mixed + found * seen.has_image[:, None]
        state = state + _linear(own, "out", np.maximum(mixed, 0))
        state = (state - state.mean(1, keepdims=True)) / np.sqrt(state.var(1, keepdims=True) + 1e-5)
        state = state * own["norm.weight"] + own["norm.bias"]
    head = _linear(weights, "head", state) + _linear(weights, "head_whole", mean_of_pair @ state)
    outputs = _linear(weights, "last", np.maximum(head, 0))
    one, steps = outputs[:, 1:2], np.log1p(np.exp(outputs))  # the logit at 1 px, and how far apart the others lie
    return np.concatenate([one - steps[:, :1], one, one + steps[:, 2:].cumsum(1)], 1), np.array(beliefs)


def calibrate(weights: Weights, logit: np.ndarray) -> np.ndarray:
    """(M, 5) probabilities: a logistic regression at each tolerance, and none below that of a smaller one."""
    slope, bias = weights["calibration"].T
    return np.maximum.accumulate(1 / (1 + np.exp(-slope * logit - bias)), 1)


def plane_columns(belief: np.ndarray, seen: Seen, disparity: np.ndarray) -> np.ndarray:
    """(M, 14) five steps, then functions of the distances from a ridge regression and from the mean of the neighbours.

    Both are weighted by the beliefs and seen from the match; 0.01 keeps the means of doubted neighbours near it.
    """
    rows = []
    for i in range(len(belief)):
        near = np.flatnonzero(seen.linked[i])
        gap = np.clip(disparity[near] - seen.disparity[i], -64, 64)
        table = np.column_stack([np.clip(seen.step[i, near], -4, 4), gap])  # x, y, disparity
        total = belief[near].sum()
        mean = belief[near] @ table / (total + 0.01)
        moments = (table.T * belief[near]) @ table - total * np.outer(mean, mean)
        slope = np.linalg.solve(moments[:2, :2] + 0.3 * np.eye(2), moments[:2, 2])
        miss, from_mean = abs(mean[2] - slope @ mean[:2]), abs(mean[2])
        columns = [expit((1 - miss / tolerance) / 0.15) for tolerance in (0.5, 1, 2, 3, 5)]
        for r in (miss, from_mean):
            columns += [np.exp(-r / 0.7), np.exp(-r / 2), np.exp(-r / 6), np.log1p(r)]
        rows.append([*columns, np.log1p(total)])
    return np.array(rows).reshape(-1, 14)


def _linear(weights: Weights, name: str, x: np.ndarray) -> np.ndarray:
    return x @ weights[f"{name}.weight"].T + weights.get(f"{name}.bias", 0)


def _normalize(weights: Weights, name: str, x: np.ndarray) -> np.ndarray:
    """In standard deviations, at most four."""
    return np.clip((x - weights[f"{name}_mean"]) * weights[f"{name}_scale"], -4, 4)
