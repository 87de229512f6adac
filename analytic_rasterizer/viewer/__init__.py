"""A viewer in the browser that draws scenes with the footprints of the rasterizer.

`pack_scene` brings a scene into the form that the page reads, `start_server` serves page and scene on this machine,
and `export_page` writes both into one HTML file. The page itself is in the folder `page`: HTML, CSS and JavaScript
modules that are served as they are. `LiveViewer` shows frames that the library's own kernels render, of a scene that
may change. From the command line: `python -m analytic_rasterizer view`.
"""

from .export import export_page
from .live import LIVE_FOOTPRINTS, LiveViewer
from .packing import (
    PAGE_FOOTPRINTS,
    PackedScene,
    PageFootprintError,
    nearest_page_footprint,
    pack_scene,
    page_footprint,
)
from .server import ViewerServer, start_server

__all__ = [
    "LIVE_FOOTPRINTS",
    "PAGE_FOOTPRINTS",
    "LiveViewer",
    "PackedScene",
    "PageFootprintError",
    "ViewerServer",
    "export_page",
    "nearest_page_footprint",
    "pack_scene",
    "page_footprint",
    "start_server",
]
