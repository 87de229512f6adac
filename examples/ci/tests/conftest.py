"""The only lines that know of the CPU: the code of the repository stays as it is."""

import pytest

pytest_plugins = ["analytic_rasterizer.testing.fixtures"]


@pytest.fixture(autouse=True)
def without_a_gpu(cuda_on_cpu):
    """Every test: what asks for CUDA gets tensors on the CPU."""
