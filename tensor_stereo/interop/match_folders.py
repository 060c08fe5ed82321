"""Many files of matches: one result per file; a call that ended early goes on where it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tensor_stereo.configs import FileFilterConfig, FilterConfig
from tensor_stereo.interop.formats import keypoints_beside
from tensor_stereo.interop.match_files import filter_file
from tensor_stereo.interop.match_lists import KIND, MatchFile, find_match_files
from tensor_stereo.interop.verdicts import FilterSummary
from tensor_stereo.paths import check_folder, has_ending
from tensor_stereo.result_folders import ResultFolder, Source, in_turn

_LATER = {"images": None, "repair": False, "refine": False}  # settings that earlier releases did not have


@dataclass(frozen=True)
class FolderSummary:
    """What became of many files.

    Attributes:
        num_files: All files.
        num_found: Those that an earlier call has finished.
        errors: Reason of each file that failed, by its name.
        matches: Counts over the files that are finished.
    """

    num_files: int = 0
    num_found: int = 0
    errors: dict[str, str] = field(default_factory=dict)
    matches: FilterSummary = field(default_factory=FilterSummary)


def filter_files(
    source: Path | str,
    out: Path | str,
    *,
    keypoints: Path | str | None = None,
    score_name: str | None = None,
    config: FilterConfig | None = None,
    images: Path | str | None = None,
    repair: bool = False,
    refine: bool = False,
    on_progress: Callable[[int, int, str], None] | None = None,
) -> FolderSummary:
    r"""Filter all files of matches in a folder or a list, each as :func:`~tensor_stereo.filter_file` does.

    Every result has the name of its file, below ``out``. ``filter.json`` in that folder holds the settings and
    ``filter.jsonl`` one line per file that is done. Call it again to go on after an interruption: files that are done
    and have not changed since are not done again, and those that failed are.

    Args:
        source: A folder, or a ``.csv`` or ``.parquet`` list with the column ``matches`` and optionally ``keypoints``,
            paths that are absolute or relative to the folder of the list.
        out: Folder of the results; it is made.
        keypoints: File of keypoints for the ``.h5`` files of hloc or DISK, which hold none.
        score_name: Name of the score, as in :func:`~tensor_stereo.filter_file`. Not for ``.h5`` and ``.db``.
        config: Settings of verdict and score, as in :func:`~tensor_stereo.filter_file`.
        images: Folder of the images of all files, as in :func:`~tensor_stereo.filter_file`. Whether an image has
            changed nobody asks when a call goes on.
        repair: Search rejected matches again, as there.
        refine: Move kept matches, as there.
        on_progress: Called after each file with the number of files done, their total and the name of the file.

    Returns:
        Counts, and the reason for each file that failed.

    Raises:
        ValueError: If there is no file, the list is wrong, or ``out`` holds results of other settings.
        FileNotFoundError: If ``source`` or ``keypoints`` is missing.
        OSError: If nothing can be written to ``out``.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "a.csv").write_text("x0,y0,x1,y1\n0,0,-3,0\n9,1,6,1\n1,8,-2,8\n8,9,5,9\n")
        ...     _ = Path(folder, "b.csv").write_text("x0,y0\n")
        ...     summary = filter_files(folder, Path(folder, "out"), config=FilterConfig(verdict="cardinality"))
        ...     summary.matches.num_kept, list(summary.errors), Path(folder, "out", "a.csv").exists()
        (4, ['b.csv'], True)
    """
    source, out = Path(source), Path(out)
    files = find_match_files(source, out, None if keypoints is None else Path(keypoints))
    looks = {"images": None if images is None else str(Path(images).absolute()), "repair": repair, "refine": refine}
    if images is not None:
        check_folder("images", Path(images))
    settings = {"config": asdict(config or FileFilterConfig()), "score_name": score_name, **looks}
    folder = ResultFolder(
        out, KIND, settings, defaults=_LATER, to_json=asdict, from_json=lambda values: FilterSummary(**values)
    )
    sources = [_source(file, out / file.name) for file in files]
    run = in_turn(lambda k: _filter_one(files[k], out / files[k].name, score_name, config, looks))
    worked = folder.work(sources, run, on_progress)
    total = sum(worked.summaries.values(), start=FilterSummary())
    return FolderSummary(len(files), worked.num_found, worked.errors, total)


def _source(file: MatchFile, result: Path) -> Source:
    inputs = (file.source,) if file.keypoints is None else (file.source, file.keypoints)
    return Source(file.name, inputs, (result, keypoints_beside(result)) if has_ending(result, ".h5") else (result,))


def _filter_one(
    file: MatchFile, result: Path, score_name: str | None, config: FilterConfig | None, looks: dict[str, Any]
) -> FilterSummary:
    return filter_file(
        file.source,
        result,
        keypoints=file.keypoints,
        score_name=None if has_ending(file.source, (".h5", ".db")) else score_name,
        config=config,
        **looks,
    )
