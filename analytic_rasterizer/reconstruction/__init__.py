"""Cameras of photographs that have none: COLMAP finds them, and a capture is made of both.

    folder, notes = reconstruct("photographs", "out/capture")  # needs pip install "analytic_rasterizer[colmap]"

`train` and `inspect` call it for a folder of photographs, or a film. pycolmap runs in a process of its own (`worker`).
"""

from .capture import Reconstructed, reconstruct

__all__ = ["Reconstructed", "reconstruct"]
