"""Files of putative matches: one function reads them, filters them and writes the same format with the verdicts."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from tensor_stereo.atomic import whole_file
from tensor_stereo.configs import FileFilterConfig, FilterConfig
from tensor_stereo.interop.colmap import filter_colmap
from tensor_stereo.interop.formats import check_files, keypoints_beside
from tensor_stereo.interop.hdf5_matches import filter_hdf5
from tensor_stereo.interop.image_filter import ImageFilter
from tensor_stereo.interop.image_folder import ImageFolder
from tensor_stereo.interop.match_tables import filter_table
from tensor_stereo.interop.npz import filter_npz
from tensor_stereo.interop.verdicts import FilterSummary, MatchFilter, RectifiedCount
from tensor_stereo.modules import DelaunayFilter
from tensor_stereo.paths import check_apart, prepare_target


def filter_file(
    source: Path | str,
    out: Path | str,
    *,
    keypoints: Path | str | None = None,
    score_name: str | None = None,
    config: FilterConfig | None = None,
    images: Path | str | None = None,
    repair: bool = False,
    refine: bool = False,
) -> FilterSummary:
    r"""Decide which matches of a file are right, and write the file again with verdict and score.

    The format is that of the ending, and the same for both files:

    ============  ==================================================================================================
    ``.npz``      arrays of rows or indices, of this library and others: :func:`~tensor_stereo.interop.npz.filter_npz`
    ``.csv``      a row per match: :func:`~tensor_stereo.interop.match_tables.filter_table`
    ``.parquet``  the same
    ``.h5``       hloc, DISK, glue-factory: :func:`~tensor_stereo.interop.hdf5_matches.filter_hdf5`
    ``.db``       database of COLMAP: :func:`~tensor_stereo.interop.colmap.filter_colmap`
    ============  ==================================================================================================

    Verdict and score are those of :class:`~tensor_stereo.DelaunayFilter` on all pairs as one batch, in blocks of
    bounded size, with coordinates in float64: a match is kept if its probability is at least .5. Whether a pair is
    rectified its matches tell, unless the settings do. Pairs with few or no matches are UNTESTED. Files are data only:
    nothing in them is run or unpickled, no size in them is believed before it is checked, and nothing is taken for a
    path but names of images, which must lie below ``images``.

    With ``images`` the score looks at the images of each pair, pair by pair. ``repair`` and ``refine`` then make more
    and finer matches of those that are kept (:func:`tensor_stereo.scores.repair_matches`,
    :func:`tensor_stereo.scores.refine_matches`), which stand beside those of the file, or in databases and in files of
    hloc and DISK take their place with keypoints of their own.

    Args:
        source: file of putative matches. It is not changed.
        out: file to write, with the ending of ``source``. It appears whole or not at all; one that exists is replaced,
            and its folder is made.
        keypoints: The file of keypoints that belongs to an ``.h5`` file of hloc or DISK; None for all others.
        score_name: Name of the column or array of the score; None: ``score``, or ``filter_score`` beside a ``score`` of
            the user's. For ``.npz``, ``.csv`` and ``.parquet`` only.
        config: Settings of verdict and score; None means :class:`~tensor_stereo.configs.FileFilterConfig`.
        images: Folder of the images, which the file names: hloc, DISK and COLMAP do, tables in the columns ``image0``
            and ``image1``, archives in arrays of these names.
        repair: Search rejected matches, and keypoints without a partner, again where kept ones say.
        refine: Move kept matches to where the images fit best, to a fraction of a pixel. For hloc and DISK, both write
            a second file beside ``out``, whose name ends in ``.keypoints.h5``: their keypoints.

    Returns:
        Counts of pairs and matches.

    Raises:
        ValueError: if a file is damaged or a value in it is wrong (naming file, pair and row or column), the ending is
            none of these, ``out`` is the same file as ``source`` or ``keypoints``, an image is missing, or ``repair``
            or ``refine`` is asked for without images.
        FileNotFoundError: if a file is missing.
        OSError: if ``out`` cannot be written.
        ImportError: if h5py (``.h5``) or pycolmap (``.db``) is needed and not installed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     source, out = Path(folder, "matches.csv"), Path(folder, "filtered.csv")
        ...     _ = source.write_text("x0,y0,x1,y1\n0,0,-3,0\n9,1,6,1\n1,8,-2,8\n8,9,5,9\n")
        ...     config = FilterConfig(verdict="cardinality")
        ...     filter_file(source, out, config=config).num_kept, out.read_text().splitlines()[:2]
        (4, ['x0,y0,x1,y1,inlier,relation', '0,0,-3,0,true,equal'])
    """
    source, out = Path(source), Path(out)
    keypoints = None if keypoints is None else Path(keypoints)
    ending = check_files(source, out, keypoints, score_name)
    config = FileFilterConfig() if config is None else config
    if config.resolved_score == "none":
        config = replace(config, score="none")  # nobody asks for a gradient here
    run: RectifiedCount | ImageFilter = RectifiedCount(DelaunayFilter(config))
    if images is not None:
        run = ImageFilter(DelaunayFilter(config), ImageFolder(Path(images)), repair=repair, refine=refine)
    elif repair or refine:
        raise ValueError(f"images must be the folder of the images for {'repair' if repair else 'refine'}, got None")
    needs_keypoints = ending == ".h5" and keypoints is not None and (repair or refine)
    if needs_keypoints:
        check_apart(
            "out, whose keypoints go into a file beside it,",
            keypoints_beside(out),
            {"source": source, "keypoints": keypoints},
        )
        prepare_target("out", keypoints_beside(out))
    # the last to be opened is the first to be in place: the keypoints that the matches name
    with whole_file(out) as target, whole_file(keypoints_beside(out)) if needs_keypoints else nullcontext() as more:
        summary = _filter(ending, source, target, run, keypoints, score_name, more)
    return replace(summary, num_rectified=run.num_rectified)


def _filter(
    ending: str,
    source: Path,
    target: Path,
    run: MatchFilter,
    keypoints: Path | None,
    score_name: str | None,
    keypoints_out: Path | None,
) -> FilterSummary:
    if ending == ".npz":
        return filter_npz(source, target, run, score_name=score_name)
    if ending == ".db":
        return filter_colmap(source, target, run)
    if ending == ".h5":
        return filter_hdf5(source, target, run, keypoints, keypoints_out)
    return filter_table(source, target, run, score_name=score_name)
