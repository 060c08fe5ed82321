"""HDF5 files of matches: those of hloc, of DISK, and the predictions that glue-factory exports.

hloc stores for each pair of images the partner of every keypoint of the first: ``matches0[i] = j`` says that keypoint i
of the first image and keypoint j of the second are a match; -1 is none. DISK stores (2, S) rows of both images, and
tools made after it (S, 2). The keypoints of both are in a second file. glue-factory stores a pair with its keypoints.

hloc counts pixel centres as integers, as this library does; it adds the half pixel of COLMAP only when it fills a
database. Half precision, its default, holds whole pixels beyond 1024 and every second one beyond 2048: keypoints that
fall together are duplicates, which are not tested.

Source: hloc's ``extract_features.py``, ``match_features.py`` and ``utils/io.py``; DISK's ``detect.py`` and
``match.py``; glue-factory's ``utils/export_predictions.py``.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from tensor_stereo.interop.added_keypoints import AddedKeypoints, KeptRows, place_kept
from tensor_stereo.interop.hdf5 import OF_PAIR, Copy, find_exported, has, is_exported, member, open_file, read, reading
from tensor_stereo.interop.hdf5_keypoints import append_keypoints
from tensor_stereo.interop.image_filter import ImageFilter, PairImages, filter_stream
from tensor_stereo.interop.index_arrays import Indices, index_matches
from tensor_stereo.interop.result_names import ResultNames, free_name, name_results
from tensor_stereo.interop.verdicts import Array, FilterSummary, Improved, MatchFilter, Verdicts
from tensor_stereo.scores import Origin
from tensor_stereo.types import Matches

_NOTE = "putative_results"  # attribute with the names of the results
_INDEXED = ("matches0", "matches1")
_SCORES = ("matching_scores0", "matching_scores1")


class _Pair(NamedTuple):
    form: Literal["hloc", "disk", "glue-factory"]
    path: str  # of its group, or of DISK's dataset
    image0: str = ""  # path of its dataset in the file of keypoints
    image1: str = ""


class _Found(NamedTuple):
    """What was read of a pair: the matches, where they stand, and the array that holds them."""

    pair: _Pair
    stored: Array
    indices: Indices
    keypoints0: Array  # (N0, 2) px, all of them
    num_known1: int  # keypoints of the second image
    in_rows: bool = True  # whether DISK's array is (S, 2)


class _Better(NamedTuple):
    """The matches of a pair that are kept after repair and refinement."""

    rows: KeptRows
    score: Array | None
    origin: Array


def filter_hdf5(
    source: Path, target: Path, run: MatchFilter, keypoints: Path | None, keypoints_out: Path | None = None
) -> FilterSummary:
    """Copy a file of matches without what the filter rejects.

    Of hloc the groups ``name0/name1`` are read and, as older versions wrote them, ``name0_name1``, in which ``/`` of
    the names is ``-``, with the datasets ``matches0``, at most (N0,) integers, and optionally ``matching_scores0`` of
    the same length, higher is better. Pairs may be stored in either order, and in both. Of glue-factory every group is
    read that has ``keypoints0``, ``keypoints1`` and ``matches0``, and optionally ``matches1`` and the scores of both.
    There rejected matches become -1. Beside them each group gets ``putative_matches0``, which is ``matches0`` as it
    was, and of the same length ``inlier`` bool, ``score`` float32 and ``relation`` int8, False, 0 and UNTESTED where
    there is no match.

    Of DISK the datasets ``name0/name1`` are read, (2, S) or (S, 2) rows of both images. Rejected columns or rows are
    taken out, and the attributes ``putative_matches``, ``inlier``, ``score`` and ``relation`` of the dataset hold all.

    Everything else is carried through. Links to other places or files are refused.

    A filter that looks at the images finds them by the names of hloc and DISK. If it repairs or refines, the matches
    are those that are kept then, each group or dataset has their ``improved_score`` float32 and ``origin`` int8, values
    of :class:`tensor_stereo.scores.Origin`, of one length with the matches, and partners that have moved are keypoints
    of their own, behind those of their image and for this pair alone, in ``keypoints_out``: a copy of ``keypoints`` in
    which other datasets of the image, such as descriptors, are as much longer.

    Args:
        source: file of matches.
        target: the copy.
        run: the filter.
        keypoints: file of features: for every image a group by its name with the dataset ``keypoints`` (N, 2), as hloc
            writes it, or a dataset (N, 2) by its name, as DISK does; None for files of glue-factory.
        keypoints_out: the copy of ``keypoints`` that a filter needs which repairs or refines.

    Raises:
        ValueError: if a file is damaged or a dataset is wrong; the message names file, pair and row.
        OSError: if the copy cannot be written.
        ImportError: if h5py is not installed.
    """
    summary = FilterSummary()
    with ExitStack() as files:
        matches_file = files.enter_context(open_file(source))
        features = None
        if keypoints is None:
            if isinstance(run, ImageFilter):
                raise ValueError(f"images must be None for {source}: pairs of glue-factory do not name their images")
            pairs = [_Pair("glue-factory", path) for path in find_exported(source, matches_file)]
        else:
            features = files.enter_context(open_file(keypoints))
            pairs = list(_find_pairs(source, matches_file, keypoints, _find_images(keypoints, features)))
        shutil.copyfile(source, target)
        copy = files.enter_context(Copy(target, "r+b"))
        with open_file(source, copy) as result:
            added = AddedKeypoints[str]()
            items = _read_pairs(source, matches_file, keypoints or source, features, pairs)
            for found, verdicts, improved in filter_stream(items, run):
                better = None if improved is None else _place(found, improved, added)
                with reading(source):
                    if found.pair.form == "disk":
                        _replace_dataset(result, found, verdicts, better)
                    else:
                        _write_group(result[found.pair.path], found, verdicts, better)
                copy.check(source)
                summary = summary.add(1, verdicts, improved)
        copy.check(source)
        if keypoints_out is not None and keypoints is not None:
            append_keypoints(keypoints, keypoints_out, added)
    return summary


def _find_images(keypoints: Path, features: Any) -> dict[str, list[str]]:
    """The datasets of the images that have keypoints, by the image's name as the file of matches spells it."""
    import h5py

    images: dict[str, list[str]] = {}
    pending, seen = [""], set()
    with reading(keypoints):
        while pending:
            path = pending.pop()
            group = features[f"/{path}"]
            address = h5py.h5o.get_info(group.id).addr
            if address in seen:
                raise ValueError(f"{keypoints}: group {path!r} is also known by another name")
            seen.add(address)
            if isinstance(member(keypoints, group, "keypoints"), h5py.Dataset) and path:
                images.setdefault(path.replace("/", "-"), []).append(f"{path}/keypoints")
                continue
            for name in group:
                inner = f"{path}/{name}" if path else name
                if isinstance(member(keypoints, group, name), h5py.Group):
                    pending.append(inner)
                else:
                    images.setdefault(inner.replace("/", "-"), []).append(inner)
    return images


def _find_pairs(source: Path, matches_file: Any, keypoints: Path, images: dict[str, list[str]]) -> Iterator[_Pair]:
    """The pairs of a file of hloc, in both of its layouts, or of DISK."""
    import h5py

    with reading(source):
        for name0 in matches_file:
            group = member(source, matches_file, name0)
            if not isinstance(group, h5py.Group):
                raise ValueError(f"{source}: {name0!r} must be a group of pairs, got a dataset")
            if is_exported(source, group):
                raise ValueError(f"{source}: {name0!r} holds its keypoints, as of glue-factory; leave keypoints out")
            if isinstance(member(source, group, "matches0"), h5py.Dataset) and "matches0" not in images:
                cuts = (k for k, letter in enumerate(name0) if letter == "_")
                known = [(name0[:k], name0[k + 1 :]) for k in cuts if name0[:k] in images and name0[k + 1 :] in images]
                if len(known) != 1:
                    raise ValueError(
                        f"{source}: {name0!r} must join two images of {keypoints}, {len(known)} ways are known"
                    )
                yield _Pair("hloc", name0, *(_only(source, keypoints, name, images) for name in known[0]))
                continue
            for name1 in group:
                inner = member(source, group, name1)
                form: Literal["hloc", "disk"] = "disk" if isinstance(inner, h5py.Dataset) else "hloc"
                if form == "disk" and (inner.ndim != 2 or inner.dtype.kind not in "iu"):
                    raise ValueError(f"{source}: '{name0}/{name1}' must be a group with the dataset 'matches0'")
                found = (_only(source, keypoints, name, images) for name in (name0, name1))
                yield _Pair(form, f"{name0}/{name1}", *found)


def _only(source: Path, keypoints: Path, name: str, images: dict[str, list[str]]) -> str:
    """The one image that a name of the file of matches can mean."""
    found = images.get(name.replace("/", "-"), [])
    if len(found) != 1:
        known = [path.removesuffix("/keypoints") for path in found]
        raise ValueError(f"{source}: {name!r} must name one image of {keypoints}, got {known or 'none'}")
    return found[0]


def _read_pairs(
    source: Path, matches_file: Any, keypoints: Path, features: Any, pairs: list[_Pair]
) -> Iterator[tuple[_Found, Matches, PairImages]]:
    in_rows = _is_in_rows(source, matches_file, [pair for pair in pairs if pair.form == "disk"])
    for pair in pairs:
        place = f"{source}, pair '{pair.path}'"
        if pair.form == "glue-factory":
            yield *_read_exported(place, matches_file, pair), PairImages("", "")
            continue
        points0, points1 = (_read_keypoints(keypoints, features, image) for image in (pair.image0, pair.image1))
        name0, name1 = (image.removesuffix("/keypoints") for image in (pair.image0, pair.image1))
        images = PairImages(name0, name1, points0)
        if pair.form == "hloc":
            yield *_read_hloc(place, matches_file, pair, {"keypoints0": points0, "keypoints1": points1}), images
            continue
        folder, name = pair.path.rsplit("/", 1)
        with reading(place):
            stored = read(place, matches_file[folder], name, "iu", 2)
        rows = stored if in_rows else stored.T
        if rows.shape[1] != 2:
            form = "(S, 2)" if in_rows else "(2, S)"
            raise ValueError(f"{place}: the matches must have shape {form} as in other pairs, got {stored.shape}")
        matches, indices = index_matches(place, {"keypoints0": points0, "keypoints1": points1, "matches": rows})
        yield _Found(pair, stored, indices, points0, len(points1), in_rows), matches, images


def _is_in_rows(source: Path, matches_file: Any, pairs: list[_Pair]) -> bool:
    """Whether datasets are (S, 2); DISK's own are (2, S). A shape of (2, 2) tells nothing, so all are looked at."""
    for pair in pairs:
        with reading(source):
            shape = matches_file[pair.path].shape
        if shape != (2, 2):
            return bool(shape[1] == 2)
    return False


def _read_hloc(place: str, matches_file: Any, pair: _Pair, arrays: dict[str, Array]) -> tuple[_Found, Matches]:
    with reading(place):
        group = matches_file[pair.path]
        arrays["matches0"] = read(place, group, "matches0", "iu", 1)
        if has(place, group, "matching_scores0"):
            arrays["matching_scores0"] = read(place, group, "matching_scores0", "f", 1)
    matches, indices = index_matches(place, arrays, may_be_short=True)
    return _Found(pair, arrays["matches0"], indices, arrays["keypoints0"], len(arrays["keypoints1"])), matches


def _read_exported(place: str, matches_file: Any, pair: _Pair) -> tuple[_Found, Matches]:
    with reading(place):
        group = matches_file[pair.path]
        arrays = {name: read(place, group, name, "fiu", 2) for name in OF_PAIR}
        arrays["matches0"] = read(place, group, "matches0", "iu", 1)
        for names, kinds in ((_INDEXED, "iu"), (_SCORES, "fiu")):
            arrays |= {name: read(place, group, name, kinds, 1) for name in names if has(place, group, name)}
    matches, indices = index_matches(place, arrays)
    return _Found(pair, arrays["matches0"], indices, arrays["keypoints0"], len(arrays["keypoints1"])), matches


def _read_keypoints(keypoints: Path, features: Any, image: str) -> Array:
    folder, _, name = f"/{image}".rpartition("/")
    place = f"{keypoints}, image {image.removesuffix('/keypoints')!r}"
    with reading(place):
        points = read(place, features[folder or "/"], name, "fiu", 2)
    if points.shape[1] != 2:
        raise ValueError(f"{place}: {name!r} must have shape (N, 2), got {points.shape}")
    return points


def _place(found: _Found, improved: Improved, added: AddedKeypoints[str]) -> _Better:
    given, images = (found.indices.rows0, found.indices.rows1), (found.pair.image0, found.pair.image1)
    rows = place_kept(improved, given, found.keypoints0.astype(np.float64), found.num_known1, images, added)
    score = None if improved.score is None else improved.score[rows.kept].astype(np.float32)
    return _Better(rows, score, improved.origin[rows.kept])


def _write_group(group: Any, found: _Found, verdicts: Verdicts, better: _Better | None) -> None:
    """Write -1 for what is rejected, and the verdicts beside it."""
    indices = found.indices
    taken = set(group)
    for name in _earlier(group, "putative_matches0"):
        del group[name]
        taken.remove(name)
    results = _results(found, verdicts, taken)
    if better is not None:
        results |= _improved_results(better, len(found.keypoints0), {*taken, *results})
        partner = np.full(len(found.keypoints0), -1, np.int32)
        partner[better.rows.rows0] = better.rows.rows1
        attributes = dict(group["matches0"].attrs)
        del group["matches0"]
        group.create_dataset("matches0", data=partner).attrs.update(attributes)
        if "matching_scores0" in group:
            _spread_scores(group, better, len(partner))
    for name, values in {"putative_matches0": found.stored, **results}.items():
        group.create_dataset(name, data=values)
    group["putative_matches0"].attrs[_NOTE] = list(results)
    if better is not None:
        return
    group["matches0"][...] = np.where(~indices.mask | verdicts.spread(indices.mask).inlier, found.stored, -1)
    if found.pair.form == "glue-factory" and "matches1" in group:
        partner = group["matches1"][()]
        rejected = ~verdicts.inlier
        rows0, rows1 = indices.rows0[rejected], indices.rows1[rejected]
        partner[rows1[partner[rows1] == rows0]] = -1
        group["matches1"][...] = partner


def _spread_scores(group: Any, better: _Better, size: int) -> None:
    """Give repaired matches the score of the filter in the place of the matcher's, and every keypoint a value."""
    old = group["matching_scores0"]
    scores = np.zeros(size, old.dtype)
    scores[: len(old)] = old[()]
    again = better.origin == int(Origin.REPAIRED)
    if better.score is not None:
        scores[better.rows.rows0[again]] = better.score[again]
    attributes = dict(old.attrs)
    if "putative_matching_scores0" not in group:
        group.create_dataset("putative_matching_scores0", data=old[()])
    del group["matching_scores0"]
    group.create_dataset("matching_scores0", data=scores).attrs.update(attributes)


def _improved_results(better: _Better, size: int | None, taken: set[str]) -> dict[str, Any]:
    """Scores and origins of the kept matches, by row of view 0 if there is a ``size``, else in their order."""
    results = {}
    for name, values in {"improved_score": better.score, "origin": better.origin}.items():
        if values is not None and size is not None:
            wide = np.zeros(size, values.dtype)
            wide[better.rows.rows0] = values
            values = wide
        if values is not None:
            results[free_name(name, taken)] = values
    return results


def _results(found: _Found, verdicts: Verdicts, taken: set[str]) -> dict[str, Any]:
    """Results by their names."""
    wide = verdicts.spread(found.indices.mask)
    score = None if wide.score is None else wide.score.astype(np.float32)
    names = name_results(found.pair.path, taken)
    results = {names.inlier: wide.inlier, names.score: score, names.relation: wide.relation}
    return {name: values for name, values in results.items() if values is not None}


def _earlier(stored: Any, mark: str) -> list[str]:
    """What an earlier filter wrote into a group, or into the attributes of a dataset."""
    if not (has("", stored, mark) if hasattr(stored, "create_group") else mark in stored):
        return []
    notes = getattr(stored[mark], "attrs", stored)  # beside the results, whose names they tell
    return [name for name in (mark, _NOTE, *notes.get(_NOTE, ResultNames())) if name in stored]


def _replace_dataset(file: Any, found: _Found, verdicts: Verdicts, better: _Better | None) -> None:
    """Write the inliers alone, with all matches as attributes, where no reader of DISK's files looks."""
    stored = found.stored
    keep = verdicts.spread(found.indices.mask).inlier
    old = file[found.pair.path].attrs
    earlier = _earlier(old, "putative_matches")
    attributes = {name: value for name, value in old.items() if name not in earlier}
    results = _results(found, verdicts, set(attributes))
    left = stored[keep] if found.in_rows else stored[:, keep]
    if better is not None:
        results |= _improved_results(better, None, {*attributes, *results})
        rows = np.stack([better.rows.rows0, better.rows.rows1], axis=1 if found.in_rows else 0)
        fits = rows.max(initial=0) <= np.iinfo(stored.dtype).max
        left = rows.astype(stored.dtype if fits else np.int64)
    attributes |= {"putative_matches": stored, **results, _NOTE: list(results)}
    del file[found.pair.path]
    dataset = file.create_dataset(found.pair.path, data=left)
    for name, values in attributes.items():
        dataset.attrs[name] = values
