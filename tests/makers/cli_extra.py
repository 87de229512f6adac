"""The extra `cli`: tests that import this are skipped where it is missing. `image` is Pillow's."""

import pytest

image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
for name in ("gsply", "tqdm"):
    pytest.importorskip(name, reason="needs the cli extra")
