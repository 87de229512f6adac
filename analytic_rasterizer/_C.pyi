"""Types of what is public of the extension (csrc/torch/ops.cpp)."""

from typing import Any

TILE: int
"""Width of a tile of `list_tiles`, px, where blending does not ask for smaller ones."""

def instruction_set() -> str:
    """Instructions that the CPU path runs on in this process: "sse2", "avx2" or "avx512"."""

def __getattr__(name: str) -> Any: ...
