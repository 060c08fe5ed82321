"""The network of the learned score by the compiled kernels, where no gradient is asked for.

The torch network of :mod:`tensor_stereo.scores.learned` is its definition; both agree to 1e-5.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter

from tensor_stereo.configs import Backend
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.ops.backends import native
from tensor_stereo.scores.alignment.form import Alignment, align_matches
from tensor_stereo.scores.image_evidence import ImageEvidence
from tensor_stereo.types import Matches

if TYPE_CHECKING:
    from tensor_stereo.scores.learned import LearnedScore

_SCALED = ("nodes", "cost", "image", "edges", "edge_image")


def runs_natively(
    network: LearnedScore, matches: Matches, backend: Backend, evidence: ImageEvidence | None = None
) -> bool:
    """Whether the kernel computes that network for these matches: not where a gradient or a tangent is asked for.

    >>> from tensor_stereo.scores.learned import load_learned
    >>> points = torch.rand(9, 2).requires_grad_()
    >>> runs_natively(load_learned(), Matches(points, points, torch.tensor([0, 9])), "auto")
    False
    """
    if torch.compiler.is_compiling() or native(backend) is None or not network.is_plain():
        return False
    given = (matches.keypoints0, matches.keypoints1, *network.parameters(), *(() if evidence is None else evidence))
    if any(type(values) not in (Tensor, Parameter) or not values.is_cpu for values in given):
        return False
    if any(forward_ad.unpack_dual(values).tangent is not None for values in given[:2]):  # type: ignore[no-untyped-call]
        return False
    return not (torch.is_grad_enabled() and any(values.requires_grad for values in given))


def infer_natively(
    network: LearnedScore,
    matches: Matches,
    graphs: MatchGraphs,
    evidence: ImageEvidence | None,
    alignment: Alignment | None,
) -> Tensor:
    """(M, 5) float32 logits, of what :func:`runs_natively`.

    Args:
        network: Of the size that the package has.
        matches: B pairs on the CPU.
        graphs: The graphs of the same matches.
        evidence: What their images say, or None.
        alignment: What the matches of every pair share, or None.
    """
    kernels = native("native")
    if kernels is None:
        raise ValueError("backend must be 'native'")
    has_rows = torch.ones(matches.num_pairs, dtype=torch.bool)
    cost = None if matches.cost is None else matches.cost.detach().double().contiguous().numpy()
    if alignment is not None:
        has_rows, matches = alignment.has_rows, align_matches(matches, alignment)
    seen: tuple[Any, ...] = (None,) * 6
    if evidence is not None:
        order = ("values", "curve0", "curve1", "first", "num_columns", "offset")
        seen = tuple(getattr(evidence, name).detach().contiguous().numpy() for name in order)
    logits = kernels.learned_network(
        pack_weights(network).numpy(),
        matches.ptr.numpy(),
        *(view.detach().double().contiguous().numpy() for view in (matches.keypoints0, matches.keypoints1)),
        has_rows.numpy(),
        cost,
        *(part.numpy() for part in graphs.patterns),
        *seen,
        torch.get_num_threads(),
    )
    return torch.from_numpy(logits)


@torch.no_grad()
def pack_weights(network: LearnedScore) -> Tensor:
    """All weights in one row, in the order in which the kernel reads them: copied in every call, as they are then."""
    return torch.cat([part.detach().float().reshape(-1) for part in _list_weights(network)])


def _list_weights(network: LearnedScore) -> list[Tensor]:
    parts: list[Any] = [getattr(network, f"{name}_{kind}") for name in _SCALED for kind in ("mean", "scale")]
    layers: list[Any] = [network.enter, network.enter_image[0], network.enter_image[2], network.enter_out]
    for messages in network.rounds:
        layers += [messages.ends, messages.edge, messages.odd, messages.edge_image, messages.belief, messages.mix]
        layers += [] if messages.mix_refined is None else [messages.mix_refined]
        layers += [messages.whole, messages.out, messages.norm]
    layers += [network.head, network.last, network.head_whole]
    for layer in layers:
        parts += [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
    return parts
