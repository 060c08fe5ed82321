"""Alignment: what all matches of a pair share, which says nothing about one of them."""

from tensor_stereo.scores.alignment.estimate import estimate_alignment as estimate_alignment
from tensor_stereo.scores.alignment.form import Alignment as Alignment
from tensor_stereo.scores.alignment.form import align_matches as align_matches
from tensor_stereo.scores.alignment.rows import fit_alignment as fit_alignment
