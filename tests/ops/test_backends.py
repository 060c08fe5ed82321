from __future__ import annotations

import pytest

from tensor_stereo.ops import backend, backends


def test_missing_kernels_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TENSOR_STEREO_BACKEND", raising=False)
    monkeypatch.setattr(backends, "kernels", None)
    monkeypatch.setattr(backends, "_reason", "the compiled module is missing")
    assert backend() == ("scipy", "the compiled module is missing")
    with pytest.raises(ValueError, match="backend 'native' cannot run: the compiled module is missing"):
        backends.resolve_backend("native")


def test_environment_overrides_auto_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TENSOR_STEREO_BACKEND", "scipy")
    assert backend().name == "scipy"
    assert "TENSOR_STEREO_BACKEND" in backend().reason
    monkeypatch.setenv("TENSOR_STEREO_BACKEND", "gpu")
    with pytest.raises(ValueError, match="TENSOR_STEREO_BACKEND must be"):
        backend()
    assert backends.resolve_backend("scipy") == "scipy"
