"""The files of the page, and the Content-Security-Policy that they are served under."""

from __future__ import annotations

from importlib import resources

MODULES = (
    "constants.js",
    "formulas.js",
    "sh.js",
    "camera.js",
    "frame.wgsl.js",
    "footprint.wgsl.js",
    "sort.wgsl.js",
    "bin.wgsl.js",
    "project.wgsl.js",
    "blend.wgsl.js",
    "present.wgsl.js",
    "webgpu_passes.js",
    "webgpu.js",
    "compressed.js",
    "load.js",
    "webgl_tools.js",
    "webgl_shaders.js",
    "webgl.js",
    "renderers.js",
    "interface.js",
    "drop.js",
    "proof.js",
    "photograph.js",
    "address.js",
    "pace.js",
    "viewer.js",
    "main.js",
)
"""The JavaScript modules, each after those that it imports."""

WORKER = "sort.js"

CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}


def page_file(name: str) -> str:
    """Text of a file of the page."""
    return resources.files(__package__).joinpath("page", name).read_text(encoding="utf-8")


def served_files() -> dict[str, tuple[bytes, str]]:
    """Content and type of every file of the page, by name."""
    names = ("index.html", "style.css", WORKER, *MODULES)
    return {name: (page_file(name).encode(), CONTENT_TYPES[name[name.rindex(".") :]]) for name in names}


def content_security_policy(*, script: str, style: str, connect: str, worker: str) -> str:
    """A policy that allows these sources and nothing else; pictures may be data or blobs, for screenshots."""
    return (
        f"default-src 'none'; script-src {script}; style-src {style}; connect-src {connect}; worker-src {worker}; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
