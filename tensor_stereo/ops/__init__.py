"""Operators of ``torch.library`` under the namespace ``tensor_stereo``, each with a slow reference."""

from tensor_stereo.ops._agreeing_neighbors import agreeing_neighbors as agreeing_neighbors
from tensor_stereo.ops._consensus_belief import consensus_belief as consensus_belief
from tensor_stereo.ops._delaunay_graph import delaunay_graph as delaunay_graph
from tensor_stereo.ops._delaunay_graph import match_graphs as match_graphs
from tensor_stereo.ops._dual_critical_points import dual_critical_points as dual_critical_points
from tensor_stereo.ops._dual_edge_ratio import dual_edge_ratio as dual_edge_ratio
from tensor_stereo.ops._dual_edge_ratio import dual_edge_ratio_backward as dual_edge_ratio_backward
from tensor_stereo.ops._nearest_ssd import nearest_ssd as nearest_ssd
from tensor_stereo.ops._predicates import incircle as incircle
from tensor_stereo.ops._predicates import orientation as orientation
from tensor_stereo.ops._relate import relate as relate
from tensor_stereo.ops._row_overlap import row_overlap as row_overlap
from tensor_stereo.ops._soft_counts import soft_counts as soft_counts
from tensor_stereo.ops._soft_counts import soft_counts_backward as soft_counts_backward
from tensor_stereo.ops._soft_match_graphs import soft_match_graphs as soft_match_graphs
from tensor_stereo.ops._window_evidence import window_evidence as window_evidence
from tensor_stereo.ops._window_refine import window_refine as window_refine
from tensor_stereo.ops._window_search import window_search as window_search
from tensor_stereo.ops.backends import BackendInfo as BackendInfo
from tensor_stereo.ops.backends import backend as backend
from tensor_stereo.ops.backends import resolve_backend as resolve_backend
