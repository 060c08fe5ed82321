"""Tables and figures: of one pair, of an evaluation, and the page of a sweep."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.reports.evaluation import write_evaluation as write_evaluation
    from tensor_stereo.reports.figures import draw_classification as draw_classification
    from tensor_stereo.reports.figures import write_figure as write_figure
    from tensor_stereo.reports.pair import MatchSummary as MatchSummary
    from tensor_stereo.reports.pair import classify_files as classify_files
    from tensor_stereo.reports.pair import match_table as match_table
    from tensor_stereo.reports.sweep.report import write_report as write_report
    from tensor_stereo.reports.sweep.runs import load_run as load_run
    from tensor_stereo.reports.tables import Table as Table
    from tensor_stereo.reports.tables import paper_tables as paper_tables
    from tensor_stereo.reports.tables import to_markdown as to_markdown

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "MatchSummary": "pair",
        "Table": "tables",
        "classify_files": "pair",
        "draw_classification": "figures",
        "load_run": "sweep.runs",
        "match_table": "pair",
        "paper_tables": "tables",
        "to_markdown": "tables",
        "write_evaluation": "evaluation",
        "write_figure": "figures",
        "write_report": "sweep.report",
    },
)
