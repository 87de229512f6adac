"""Serves the page and one scene to browsers on this machine."""

from __future__ import annotations

import http.server
import json
import secrets
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Mapping
from pathlib import Path

from .packing import PackedScene
from .pages import content_security_policy, served_files

ADDRESS = "127.0.0.1"
CHUNK = 1 << 20
LONGEST_NAME = 100  # characters of a file that is dropped

Opens = Callable[[Path], PackedScene]
"""Packs the scene of a file. Raises OSError, ValueError or ImportError with a sentence."""


class ViewerServer(http.server.ThreadingHTTPServer):
    """Serves a fixed set of files and photographs, under a random path, on 127.0.0.1 only.

    Attributes:
        url: Where the page is.
        token: First part of every path that is answered. Who does not know it, such as another user of the machine or a
            page from elsewhere in the browser, is refused.
    """

    daemon_threads = True

    def __init__(
        self,
        scene: PackedScene,
        port: int = 0,
        photographs: Mapping[int, Callable[[], bytes]] | None = None,
        opens: Opens | None = None,
    ):
        """Binds to a port.

        Args:
            scene: What `pack_scene` returned.
            port: 0 takes any free port.
            photographs: By the number of their view, functions that return the PNG of a photograph.
            opens: For files that are dropped on the page; None: they are refused.

        Raises:
            OSError: The port cannot be had.
        """
        super().__init__((ADDRESS, port), _Handler)
        self.token = secrets.token_urlsafe(24)
        self.opens, self.opening = opens, threading.Lock()
        self.show(scene, photographs or {})
        self.url = f"http://{ADDRESS}:{self.server_port}/{self.token}/"

    def show(self, scene: PackedScene, photographs: Mapping[int, Callable[[], bytes]]) -> None:
        """Serves this scene from now on.

        Args:
            scene: What `pack_scene` returned.
            photographs: By the number of their view, functions that return the PNG of a photograph.
        """
        meta = scene.meta | {"photographs": sorted(photographs)}
        files: dict[str, tuple[bytes | Callable[[], bytes], str]] = served_files() | {
            "scene.json": (json.dumps(meta, allow_nan=False).encode(), "application/json"),
            "geometry.bin": (scene.geometry, "application/octet-stream"),
            "harmonics.bin": (scene.harmonics, "application/octet-stream"),
        }
        files |= {f"photographs/{k}": (read, "image/png") for k, read in photographs.items()}
        files[""] = files["index.html"]
        self.files = files


def start_server(
    scene: PackedScene,
    port: int = 0,
    photographs: Mapping[int, Callable[[], bytes]] | None = None,
    opens: Opens | None = None,
) -> ViewerServer:
    """A server that is bound, and answers as soon as its `serve_forever` runs.

    Args:
        scene: What `pack_scene` returned.
        port: 0 takes any free port.
        photographs: By the number of their view, functions that return the PNG of a photograph. They may raise OSError
            or ValueError, which the page shows.
        opens: For files that are dropped on the page: packs the scene of a file. It may raise OSError, ValueError or
            ImportError, which the page shows. None: such files are refused.

    Raises:
        ValueError: The port cannot be used.
    """
    try:
        return ViewerServer(scene, port, photographs, opens)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"port {port} cannot be used: {reason}") from None


class _Handler(http.server.BaseHTTPRequestHandler):
    """Answers GET and HEAD for the files of its server, and POST with a file that it is to show."""

    server_version = "analytic_rasterizer"
    sys_version = ""
    timeout = 60  # seconds, so that connections that say nothing end

    def do_GET(self):
        self._answer(with_body=True)

    def do_HEAD(self):
        self._answer(with_body=False)

    def do_POST(self):
        name = self._name()
        if name is None:
            return
        if name != "open" or self.server.opens is None:
            self._refuse(501, "This page opens no files.")
            return
        try:
            with self.server.opening, tempfile.TemporaryDirectory() as folder:
                # Of the name only its last part, in a folder of its own: no path reaches the file system.
                given = urllib.parse.parse_qs(self.path.partition("?")[2]).get("name", [""])[0]
                path = Path(folder) / (given.replace("\\", "/").rpartition("/")[2][-LONGEST_NAME:] or "scene")
                self._receive(path)
                try:
                    self.server.show(self.server.opens(path), {})
                except (OSError, ValueError, ImportError) as error:
                    self._refuse(400, str(error).replace(f"{folder}/", ""))
                    return
        except OSError as error:
            self._refuse(500, f"The file cannot be kept: {error.strerror or error}")
            return
        self._send(200, b"", "text/plain; charset=utf-8", True)

    def _receive(self, temporary: Path) -> None:
        """Writes what is sent into a file. Raises OSError where there is no room, or the connection ends."""
        left = int(self.headers.get("Content-Length") or 0)
        with temporary.open("wb") as file:
            while left > 0:
                part = self.rfile.read(min(left, CHUNK))
                if not part:
                    raise OSError("the connection ended before the file was complete")
                file.write(part)
                left -= len(part)

    def _name(self) -> str | None:
        """What is asked for, after the token; None where that has been refused."""
        # A page from elsewhere whose name was made to point to this machine still sends its own name.
        hosts = {f"{name}:{self.server.server_port}" for name in (ADDRESS, "localhost")}
        if self.headers.get("Host") not in hosts:
            self._refuse(403, "This viewer answers to 127.0.0.1 only.")
            return None
        token, slash, name = self.path.partition("?")[0].lstrip("/").partition("/")
        if not secrets.compare_digest(token.encode(), self.server.token.encode()):
            self._refuse(403, "Open the address that the command printed: it holds a key.")
            return None
        if not slash:  # as people copy the address
            self._send(302, b"", "text/plain; charset=utf-8", False, {"Location": f"/{token}/"})
            return None
        return name

    def _answer(self, with_body: bool) -> None:
        name = self._name()
        if name is None:
            return
        # A fixed table of names: no path ever reaches the file system.
        if name not in self.server.files:
            self._refuse(404, "There is no such file.")
            return
        content, kind = self.server.files[name]
        if callable(content):
            try:
                content = content()
            except (OSError, ValueError) as error:
                self._refuse(500, str(error))
                return
        self._send(200, content, kind, with_body)

    def _refuse(self, status: int, reason: str) -> None:
        self._send(status, f"{reason}\n".encode(), "text/plain; charset=utf-8", self.command != "HEAD")

    def _send(
        self, status: int, content: bytes, kind: str, with_body: bool, headers: dict[str, str] | None = None
    ) -> None:
        policy = content_security_policy(script="'self'", style="'self'", connect="'self'", worker="'self'")
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", f"{policy}; frame-ancestors 'none'")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.end_headers()
        if not with_body:
            return
        body = memoryview(content)
        try:
            for start in range(0, len(body), CHUNK):
                self.wfile.write(body[start : start + CHUNK])
        except ConnectionError:
            pass  # the browser closed the page

    def log_message(self, format, *args):
        """Says nothing: the terminal is the user's."""
