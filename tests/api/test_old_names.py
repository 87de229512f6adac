"""Modules that moved into folders still have their old names."""

import pathlib
import pickle

import pytest
from processes import run_python

import analytic_rasterizer as ar
from analytic_rasterizer import _old_names

TOP = pathlib.Path(ar.__file__).parent


@pytest.mark.parametrize(("old", "new"), _old_names.MOVED.items())
def test_import_by_the_old_name(old, new):
    """In a process that has imported nothing, because imports elsewhere would hide a missing name."""
    code = (
        f"import analytic_rasterizer.{old} as first\n"
        f"from analytic_rasterizer import {old} as second\n"
        f"import analytic_rasterizer.{new} as third\n"
        f"assert first is second is third\n"
        f"print(first.__name__)"
    )
    assert run_python(code).strip() == f"analytic_rasterizer.{new}"


def test_old_pickles():
    """A pickle names the module of its class. Protocol 0 writes names as lines, in which they can be made old."""
    effects = ar.Effects(depth=True, lens=ar.Lens("fisheye", (0.1, 0.0, 0.0, 0.0)))
    text = pickle.dumps(effects, protocol=0)
    for old, new in _old_names.MOVED.items():
        text = text.replace(f"canalytic_rasterizer.{new}\n".encode(), f"canalytic_rasterizer.{old}\n".encode())
    assert b"analytic_rasterizer.effects\n" in text and b"analytic_rasterizer.lens\n" in text
    assert b"analytic_rasterizer.render" not in text
    code = f"import pickle; print(pickle.loads({text!r}))"
    assert run_python(code).strip() == repr(effects)


def test_no_module_is_moved_and_there():
    assert not [old for old in _old_names.MOVED if (TOP / f"{old}.py").exists() or (TOP / old).exists()]


def test_top_of_the_package_stays_small():
    """A new module belongs into a folder: one looks for a door at the top."""
    assert len(list(TOP.glob("*.py"))) <= 16
