"""Names of files and folders that some tool takes for something else: a pattern, a setting, a home, an address."""

from __future__ import annotations

NAMES = (
    "run [1]",
    "a*b?",
    "{x,y}",
    "seed=3",
    "~",
    "'quoted\" name'",
    "übung 数",
    "n" * 200,
    "%41#frag",
    "C:\\here",
    "[bold]rich",
)
