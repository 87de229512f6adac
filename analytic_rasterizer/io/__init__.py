"""Scenes and views in and out.

A *scene* is a set of Gaussians (`Gaussians`), read from the files that 3DGS tools write. A *view* is a pinhole
camera with an image size; its axes are OpenCV's (x right, y down, z forward). Reading and writing
scenes needs the libraries of `pip install analytic_rasterizer[cli]`; they are imported on first
use.
"""

from .common import SceneError, optional_import, to_image
from .scenes import PLY_COLUMNS, load_scene, ply_header, save_scene
from .views import View, load_views, save_views

__all__ = [
    "PLY_COLUMNS",
    "SceneError",
    "View",
    "load_scene",
    "load_views",
    "optional_import",
    "ply_header",
    "save_scene",
    "save_views",
    "to_image",
]
