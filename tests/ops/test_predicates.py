from __future__ import annotations

import numpy as np
import pytest
import torch

from tensor_stereo.ops import incircle, orientation
from tests.oracles import installed_backends
from tests.point_sets import GENERATORS

needs_kernels = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")


@needs_kernels
@pytest.mark.parametrize("kind", GENERATORS)
def test_expansions_equal_integer_arithmetic(kind: str) -> None:
    rng = np.random.default_rng(5)
    pool = GENERATORS[kind](rng, 60)
    rows = torch.from_numpy(pool[rng.integers(0, len(pool), (4, 2000))])
    assert torch.equal(orientation(*rows[:3], "native"), orientation(*rows[:3], "scipy"))
    assert torch.equal(incircle(*rows, "native"), incircle(*rows, "scipy"))


@pytest.mark.parametrize("backend", installed_backends())
def test_operators_keep_the_rules_of_torch_and_compile(backend: str) -> None:
    rows = torch.rand(4, 7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).unbind()
    torch.library.opcheck(torch.ops.tensor_stereo.orientation.default, (*rows[:3], backend))
    torch.library.opcheck(torch.ops.tensor_stereo.incircle.default, (*rows, backend))
    compiled = torch.compile(lambda: incircle(*rows, backend) * 2, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(), incircle(*rows, backend) * 2)


def test_bad_input_is_named() -> None:
    good = torch.zeros(3, 2, dtype=torch.float64)
    with pytest.raises(TypeError, match="b must be float64"):
        orientation(good, good.float(), good, "auto")
    with pytest.raises(ValueError, match="d must have"):
        incircle(good, good, good, good[:2], "auto")
