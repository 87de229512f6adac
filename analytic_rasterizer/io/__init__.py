"""Scenes, points, views and pictures in and out.

A *scene* is a set of Gaussians (`Gaussians`), read from the files that 3DGS tools write. A *view* is a pinhole
camera with an image size; its axes are OpenCV's (x right, y down, z forward). Some formats need the libraries of `pip
install "analytic_rasterizer[cli]"`; they are imported on first use.
"""

from .appearance import BLACK, WHITE, Choice, FoundScene, find_scene, is_dilated
from .errors import SceneError, optional_import
from .images import to_image
from .metadata import SceneMetadata, read_axes, read_metadata
from .points import is_scene, load_points
from .scenes import PLY_COLUMNS, load_scene, save_scene, written_format
from .video import save_video
from .views import View, load_views, save_views
from .writing import save_image, write_bytes, write_json, write_safely, write_text

__all__ = [
    "BLACK",
    "PLY_COLUMNS",
    "WHITE",
    "Choice",
    "FoundScene",
    "SceneError",
    "SceneMetadata",
    "View",
    "find_scene",
    "is_dilated",
    "is_scene",
    "load_points",
    "load_scene",
    "load_views",
    "optional_import",
    "read_axes",
    "read_metadata",
    "save_image",
    "save_scene",
    "save_video",
    "save_views",
    "to_image",
    "write_bytes",
    "write_json",
    "write_safely",
    "write_text",
    "written_format",
]
