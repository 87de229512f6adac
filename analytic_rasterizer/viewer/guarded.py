"""A server of viser that answers only those who know its address.

viser asks for no key and does not look at who asks: any page in a browser on this machine may open a websocket to it,
and so may any other user of the machine. It has no setting for that either. So a check is put where websockets, the
library that viser serves with, lets a server decide about a request: `process_request` of `serve`.
"""

from __future__ import annotations

import dataclasses
import http
import secrets
import threading
from collections.abc import Callable

from .. import io
from .server import ADDRESS

_starting = threading.Lock()  # held while what viser uses is replaced


def start_viser(port: int):
    """Starts a server of viser on 127.0.0.1, under a random path.

    Requests for another path, and requests under another host name than 127.0.0.1 or localhost, are refused with status
    403, websockets as well as pages.

    Args:
        port: To listen on; 0 takes any free one.

    Returns:
        (server, url): a `viser.ViserServer`, and the address of its page.

    Raises:
        ImportError: viser is missing; names the extra that installs it.
        ValueError: The port cannot be used.
        RuntimeError: This version of viser serves in a way that the check cannot be added to.
    """
    viser = io.optional_import("viser", "view")
    websockets = io.optional_import("websockets.asyncio.server", "view")
    console = io.optional_import("rich", "view").get_console()  # where viser prints an address without the key
    key, original, checked = secrets.token_urlsafe(24), websockets.serve, []

    def serve(*args, process_request=None, **options):
        checked.append(True)
        return original(*args, process_request=_with_check(process_request, key), **options)

    with _starting:
        websockets.serve, quiet, console.quiet = serve, console.quiet, True
        try:
            server = viser.ViserServer(host=ADDRESS, port=port, verbose=False)  # returns when it is listening
        finally:
            websockets.serve, console.quiet = original, quiet
    # viser can pass the page on through a server elsewhere, for any browser that asks. Scenes stay here.
    server.request_share_url = lambda *_, **__: None
    if not checked:
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} cannot be given an access check: install another version")
    if port not in (0, server.get_port()):  # viser goes on to the next free one
        server.stop()
        raise ValueError(f"port {port} cannot be used: it is taken, or not allowed")
    return server, f"http://{ADDRESS}:{server.get_port()}/{key}/"


def _with_check(process_request: Callable | None, key: str) -> Callable:
    """`process_request` for requests that may be answered, whose path it sees without the key."""

    def checked(connection, request):
        # A page from elsewhere whose name was made to point to this machine still sends its own name.
        hosts = [host.partition(":")[0] for host in request.headers.get_all("Host")]
        first, _, rest = request.path.partition("?")[0].lstrip("/").partition("/")
        known = hosts in ([ADDRESS], ["localhost"])
        if not known or not secrets.compare_digest(first.encode(), key.encode()):
            reason = "Open the address that the viewer printed: it holds a key.\n"
            return connection.respond(http.HTTPStatus.FORBIDDEN, reason)
        return process_request and process_request(connection, dataclasses.replace(request, path=f"/{rest}"))

    return checked
