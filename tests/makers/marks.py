"""Marks of tests: what they need, and on which devices and in which dtypes they run."""

import pytest
import torch
from scenes import KINDS, PATHS, RENDERED, name_of

from analytic_rasterizer import _C

needs_cuda = pytest.mark.skipif(
    not (_C.has_cuda and torch.cuda.is_available()),
    reason="needs a CUDA device and an extension that was built for CUDA",
)

# The compiler of torch 2.4 knows no types of the members of settings, and no ops that change lists of tensors.
needs_newer_compiler = pytest.mark.skipif(
    torch.__version__.startswith("2.4."), reason="torch 2.4 cannot compile or export these calls (docs/install.md)"
)

# Tests of a footprint with its options: each that renders, one of each footprint, one of each path (see scenes.py).
every_footprint = pytest.mark.parametrize("variant", RENDERED, ids=name_of)
each_kind = pytest.mark.parametrize("variant", KINDS, ids=name_of)
each_path = pytest.mark.parametrize("variant", PATHS, ids=name_of)

# For tests of both dtypes, in place of the fixture `device`: the rasterizer has no float64 on CUDA.
each_precision = pytest.mark.parametrize(
    "device, dtype",
    [
        pytest.param("cpu", torch.float32, id="torch.float32"),
        pytest.param("cpu", torch.float64, id="torch.float64"),
        pytest.param("cuda", torch.float32, id="cuda-torch.float32", marks=needs_cuda),
    ],
)
