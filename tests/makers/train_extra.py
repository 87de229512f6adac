"""The extra `train`: tests that import this are skipped where it is missing. `image` is Pillow's."""

import pytest
from cli_extra import image

pytest.importorskip("scipy", reason="needs the train extra")
__all__ = ["image"]
