"""Fixtures for pytest. A conftest.py takes them with `pytest_plugins = ["analytic_rasterizer.testing.fixtures"]`."""

from collections.abc import Iterator

import pytest

from . import cuda_on_cpu as context


@pytest.fixture
def cuda_on_cpu() -> Iterator[None]:
    """Runs the test with `testing.cuda_on_cpu`: what asks for CUDA gets tensors on the CPU."""
    with context():
        yield
