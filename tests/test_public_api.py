"""The public face: names, their signatures and their homes change only on purpose.

A changed face is recorded by ``python tests/test_public_api.py``; the difference belongs into the changelog.
"""

from __future__ import annotations

import importlib
import inspect
import json
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

RECORD = Path(__file__).with_name("public_api.json")
PACKAGES = (
    "tensor_stereo",
    "tensor_stereo.configs",
    "tensor_stereo.datasets",
    "tensor_stereo.datasets.download",
    "tensor_stereo.datasets.synthetic",
    "tensor_stereo.dense",
    "tensor_stereo.evaluation",
    "tensor_stereo.features",
    "tensor_stereo.interop",
    "tensor_stereo.ops",
    "tensor_stereo.reports",
    "tensor_stereo.scores",
    "tensor_stereo.sweeps",
)


def describe(value: object) -> str:
    """A line about a public object: the names of its parameters or fields, without types and defaults."""
    if is_dataclass(value):
        return f"dataclass({', '.join(field.name for field in fields(value))})"
    if inspect.isclass(value):
        methods = [name for name in vars(value) if not name.startswith("_")]
        return f"class {', '.join(sorted(methods))}".strip()
    if callable(value):
        marks = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
        parts, keyword = [], False
        for parameter in inspect.signature(value).parameters.values():
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY and not keyword:
                keyword = True
                parts.append("*")
            parts.append(f"{marks.get(parameter.kind, '')}{parameter.name}")
        return f"({', '.join(parts)})"
    return type(value).__name__


def face() -> dict[str, dict[str, str]]:
    found = {}
    for package in PACKAGES:
        module = importlib.import_module(package)
        names = getattr(module, "__all__", None) or [
            name
            for name, value in vars(module).items()
            if not name.startswith("_") and getattr(value, "__module__", "").startswith("tensor_stereo")
        ]
        found[package] = {name: describe(getattr(module, name)) for name in sorted(names)}
    return found


def test_the_public_face_is_the_recorded_one() -> None:
    known, found = json.loads(RECORD.read_text()), face()
    assert found.keys() == known.keys()
    for package, names in found.items():
        assert names == known[package], package


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_of_the_face_is_listed_and_documented(package: str) -> None:
    module = importlib.import_module(package)
    for name in getattr(module, "__all__", ()):
        value = getattr(module, name)
        assert name in dir(module)
        if callable(value):
            assert inspect.getdoc(value), f"{package}.{name}"
    with pytest.raises(AttributeError, match="has no attribute 'nothing_of_the_kind'"):
        _ = module.nothing_of_the_kind


def test_no_name_of_an_operator_hides_its_module() -> None:
    import tensor_stereo.ops._relate as module
    from tensor_stereo import ops

    assert inspect.ismodule(module)
    assert ops.relate is module.relate


if __name__ == "__main__":
    RECORD.write_text(json.dumps(face(), indent=1) + "\n")
