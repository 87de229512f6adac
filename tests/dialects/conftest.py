"""Fixtures of tests beside gsplat."""

import pytest

from analytic_rasterizer.dialects import gsplat as dialect


@pytest.fixture
def reference():
    """gsplat's torch implementation."""
    return pytest.importorskip("gsplat.cuda._torch_impl", reason="needs gsplat, of the extra test")


@pytest.fixture
def patched(monkeypatch):
    """gsplat with our functions in it, for one test."""
    gsplat = pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    for module, names in (
        (gsplat, ("rasterization", "quat_scale_to_covar_preci")),
        (gsplat.rendering, ("rasterization",)),
        (gsplat.relocation, ("compute_relocation",)),
        (gsplat.strategy.ops, ("compute_relocation", "quat_scale_to_covar_preci")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name))  # puts it back in the end
    dialect.patch()
    return gsplat
