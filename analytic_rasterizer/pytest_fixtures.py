"""Fixtures for pytest. A conftest.py takes them with `pytest_plugins = ["analytic_rasterizer.pytest_fixtures"]`."""

from collections.abc import Iterator

import pytest

from . import testing


@pytest.fixture
def cuda_on_cpu() -> Iterator[None]:
    """Runs the test with `testing.cuda_on_cpu`: what asks for CUDA gets tensors on the CPU."""
    with testing.cuda_on_cpu():
        yield
