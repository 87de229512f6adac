"""Frames in browsers, for every footprint and for watching a training run.

`LiveViewer` needs viser, of the extra `view`, which is imported when a viewer is made.
"""

from __future__ import annotations

import html
import math
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch

from .. import io
from ..cameras.up import mean_up
from ..footprints import Footprint, get_default_footprint, resolve_footprint
from ..gaussians import Gaussians
from ..render.order import CENTER, check_order
from .frames import (
    LIVE_FOOTPRINTS,
    SMALLEST_MOVING_SCALE,
    Cost,
    Snapshot,
    camera_view,
    moving_pixels,
    render_frame,
    take_snapshot,
)
from .guarded import start_viser
from .packing import extent, overview, upright

REST_AFTER = 0.2
"""Seconds without motion after which a camera rests."""
DIVISORS = {"1": 1, "1/2": 2, "1/4": 4, "1/8": 8}
"""The choices of the control Resolution."""


class _Client:
    """A browser that is connected: its camera, its controls, and when its next frame is due."""

    def __init__(self, handle, viewer: LiveViewer):
        self.handle = handle
        self.view: io.View | None = None
        self.due = math.inf  # of time.monotonic(); infinity: nothing has changed
        self.moved = -math.inf
        self.drawn = -math.inf
        gui = handle.gui
        self.status = gui.add_html("")
        choices = list(LIVE_FOOTPRINTS)
        if viewer.footprint not in choices:
            choices.insert(0, viewer.footprint)
        self.footprint = gui.add_dropdown("Footprint", choices, initial_value=viewer.footprint)
        hint = "Of the picture. Below 1 its pixels are shown as squares."
        self.resolution = gui.add_dropdown("Resolution", list(DIVISORS), initial_value="1", hint=hint)
        colour = tuple(round(255 * channel) for channel in viewer.background)
        self.background = gui.add_rgb("Background", colour)
        self.view_name = gui.add_dropdown("View", [view.name for view in viewer.views])
        hint = "Show the picture as the photograph of the view is, not that of a pinhole."
        self.lens = gui.add_checkbox("Lens of the view", True, hint=hint, visible=viewer.has_lenses)
        self.steps = gui.add_button_group("Jump to", ["Previous", "Next", "Reset"])
        self.figures = gui.add_html("")


class LiveViewer:
    """Shows a scene, which may change, in browsers on this machine.

        viewer = LiveViewer(views=views)
        for step in range(30_000):
            ...
            viewer.update(model.scene, step=step, text=f"loss {loss:.4f}")  # model.scene() returns Gaussians
        viewer.stop()

    Each browser has its own camera and controls. One thread renders for all of them, only while a browser is
    connected and only when something that it shows has changed: at a resolution that can keep up while its camera
    moves, and at the chosen one when the camera rests. It renders a copy of the scene, so that a training run never
    waits for it; what they share is the device.

    May be used from any thread. Is a context manager, which stops the viewer at its end.

    Attributes:
        url: Where the page is: on 127.0.0.1, which only this machine reaches, under a random path. Who does not know
            it, such as another user of the machine or a page from elsewhere in the browser, is refused.
        port: Its port.
        footprint, background, views: What a browser starts with.
    """

    def __init__(
        self,
        port: int = 0,
        *,
        views: list[io.View] | None = None,
        footprint: str | Footprint | None = None,
        background=(0.0, 0.0, 0.0),
        name: str = "scene",
        interval: float = 1.0,
        order: str = CENTER,
    ):
        """Starts the server.

        Args:
            port: To listen on; 0 takes any free one.
            views: Cameras to jump to. Without any there is one, which sees most of the first scene.
            footprint: What browsers start with; None takes the library's default.
            background: (r, g, b) in [0, 1].
            name: What the page calls the scene.
            interval: Seconds between two copies of the scene, at least; not negative.
            order: An `Effects.order`, for the footprints that can have it.

        Raises:
            ImportError: viser is missing; names the extra that installs it.
            TypeError: An order that is not a string.
            ValueError: A port that cannot be used, or a bad footprint, background, interval or order.
            RuntimeError: A version of viser that cannot be given an access check.
        """
        chosen = get_default_footprint() if footprint is None else resolve_footprint(str(footprint))
        self.footprint = next((c for c in LIVE_FOOTPRINTS if resolve_footprint(c) == chosen), str(chosen))
        check_order(order)
        self.order = order
        self.background = tuple(float(channel) for channel in background)
        if len(self.background) != 3 or not all(0 <= channel <= 1 for channel in self.background):
            raise ValueError(f"background must be three numbers from 0 to 1, got {background}")
        if not (math.isfinite(interval) and interval >= 0):
            raise ValueError(f"interval must be finite and not negative, got {interval}")
        if not 0 <= port <= 65535:
            raise ValueError(f"port must be from 0 to 65535, got {port}")

        self.name = name
        self.interval = interval
        _, down, ahead = torch.eye(3, dtype=torch.float64, device="cpu")
        self.views = views or [overview(0 * down, 1.0, -down, ahead, 0.0)]  # until there is a scene
        self._views_given = bool(views)
        self._middle = torch.zeros(3, dtype=torch.float64, device="cpu")  # of the first scene, which cameras turn about
        self._radius = 1.0
        self._snapshot: Snapshot | None = None
        self._next_copy = -math.inf
        self._text = "waiting for the first scene"
        self._clients: dict[int, _Client] = {}
        self._stopped = False
        self._changed = threading.Condition()  # guards what is above, and is notified when a frame may be due
        self._settled: Cost | None = None  # these two belong to the rendering thread
        self._moving: Cost | None = None

        self._server, self.url = start_viser(port)
        self.port = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("Gaussian splats")
        self._server.scene.set_up_direction(tuple(mean_up(self.views).tolist()))
        self._thread = threading.Thread(target=self._render_loop, name="LiveViewer", daemon=True)
        self._thread.start()
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)
        # A browser may leave while its frame is rendered.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def update(
        self,
        scene: Gaussians | Callable[[], Gaussians],
        *,
        step: int | None = None,
        text: str = "",
        copy: bool = True,
        force: bool = False,
    ) -> bool:
        """Shows this scene from now on.

        Meant to be called at every step of a training run. Nearly always it does nothing: the scene is copied when a
        browser is connected and `interval` has passed since the last copy, and at the first call. It never waits for a
        frame. The device holds up to two copies while browsers look.

        Args:
            scene: Gaussians, or a function that returns them, which is called without gradients and only when the
                scene is copied, so that it may compute what the parameters stand for.
            step: Number of the step, shown below the name of the scene.
            text: Shown below that, as it is.
            copy: False keeps the tensors themselves, which must not change afterwards.
            force: Take the scene in any case: for the last step.

        Returns:
            Whether the scene was taken.

        Raises:
            TypeError: No `Gaussians`.
            ValueError: The scene has no Gaussians, or at the first call centres that are not finite.
        """
        with self._changed:
            first = self._snapshot is None
            due = bool(self._clients) and time.monotonic() >= self._next_copy
            if self._stopped or not (first or force or due):
                return False
        taken = take_snapshot(scene, copy)
        if first:
            self._begin(taken.scene)
        with self._changed:
            if self._stopped:
                return False
            self._snapshot = taken
            self._next_copy = time.monotonic() + self.interval
            self._text = "\n".join(filter(None, ["" if step is None else f"step {step}", text]))
            clients = list(self._clients.values())
            for client in clients if not first else ():
                self._ask(client)
        for client in clients:
            self._show_status(client)
            if first:
                self._jump(client)  # and then there is something to render
        return True

    def stop(self) -> None:
        """Ends the server and the thread that renders. Further calls, and updates, do nothing."""
        with self._changed:
            if self._stopped:
                return
            self._stopped = True
            self._snapshot = None
            self._changed.notify_all()
        self._thread.join()
        self._server.stop()

    def wait(self) -> None:
        """Returns when the viewer is stopped, from elsewhere or by an interrupt, which is raised again."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped)

    @property
    def has_lenses(self) -> bool:
        """Whether a view has a lens, which browsers can switch off."""
        return any(view.lens is not None for view in self.views)

    # ------------------------------------------------------------------------------- browsers

    def _begin(self, scene: Gaussians) -> None:
        """Puts cameras where the first scene is."""
        if not bool(scene.means.isfinite().all()):
            raise ValueError("means of the first scene must be finite")
        middle, self._radius = extent(scene)
        self._middle = middle.cpu()
        if not self._views_given:
            self.views = [overview(self._middle, self._radius, *upright(scene.to("cpu"), self._middle, self._radius))]
            self._server.scene.set_up_direction(tuple(mean_up(self.views).tolist()))

    def _connect(self, handle) -> None:
        client = _Client(handle, self)

        def ask(_) -> None:
            with self._changed:
                self._ask(client)

        for control in (client.footprint, client.resolution, client.background, client.lens):
            control.on_update(ask)
        client.view_name.on_update(lambda _: self._jump(client))
        client.steps.on_click(lambda event: self._step_view(client, event.target.value))
        # Before the browser is sent anything that its user could answer by moving.
        handle.camera.on_update(lambda camera: self._move(client, camera))
        with self._changed:
            self._clients[handle.client_id] = client
        self._show_status(client)
        self._jump(client)

    def _disconnect(self, handle) -> None:
        with self._changed:
            self._clients.pop(handle.client_id, None)

    def _ask(self, client: _Client) -> None:
        """Has a frame rendered for this browser. The lock is held."""
        client.due = time.monotonic()
        self._changed.notify_all()

    def _move(self, client: _Client, camera) -> None:
        """Shows what this camera sees, as it is now: threads of the server and of `_jump` call this at any time."""
        with self._changed:
            # What is read before the lock is held may be older than what another thread stores meanwhile.
            try:
                view = camera_view(camera.position, camera.wxyz, camera.fov, camera.image_width, camera.image_height)
            except ValueError:
                return  # a window without area, or a browser that sends nonsense
            if client.view is not None:
                client.moved = time.monotonic()
            client.view = view
            if self._snapshot is not None:
                self._ask(client)

    def _step_view(self, client: _Client, button: str) -> None:
        names = [view.name for view in self.views]
        at = names.index(client.view_name.value)
        chosen = names[(at + {"Previous": -1, "Next": 1, "Reset": 0}[button]) % len(names)]
        if chosen == client.view_name.value:
            self._jump(client)
        else:
            client.view_name.value = chosen  # which jumps

    def _jump(self, client: _Client) -> None:
        """Moves the camera of a browser to the view that is chosen there, as soon as there is a scene."""
        with self._changed:
            if self._snapshot is None:
                return
        view = self._chosen_view(client)
        _, down, forward = view.w2c[:3, :3]
        position = -view.w2c[:3, :3].T @ view.w2c[:3, 3]
        ahead = max(((self._middle - position) @ forward).item(), 0.1 * self._radius)
        camera = client.handle.camera
        width, height = camera.image_width, camera.image_height
        focal = min(view.fx * width / view.width, view.fy * height / view.height)  # all of the view is in the picture
        with client.handle.atomic():
            camera.up_direction = (-down).numpy()
            camera.position = position.numpy()
            camera.look_at = (position + ahead * forward).numpy()
            camera.fov = 2 * math.atan(height / (2 * focal))
        self._move(client, camera)

    def _chosen_view(self, client: _Client) -> io.View:
        return next(view for view in self.views if view.name == client.view_name.value)

    def _show_status(self, client: _Client) -> None:
        with self._changed:
            snapshot, text = self._snapshot, self._text
        lines = [f"<b>{html.escape(self.name)}</b>"]
        if snapshot is not None:
            lines.append(f"{len(snapshot.scene.means):,} Gaussians on {snapshot.scene.means.device}")
        lines += [html.escape(line) for line in text.splitlines()]
        client.status.content = _paragraph(lines)

    # -------------------------------------------------------------------------------- frames

    def _render_loop(self) -> None:
        while (client := self._next_client()) is not None:
            try:
                self._draw(client)
            except Exception as error:  # such as a device out of memory: later frames may succeed
                reason = str(error).partition("\n")[0]
                client.figures.content = _paragraph([f"Rendering failed: {html.escape(reason)}"])

    def _next_client(self) -> _Client | None:
        """Waits until a frame is due, and returns its browser: the one that has waited longest. None at the end."""
        with self._changed:
            while not self._stopped:
                now = time.monotonic()
                waiting = [c for c in self._clients.values() if self._snapshot is not None and c.view is not None]
                due = [c for c in waiting if c.due <= now]
                if due:
                    return min(due, key=lambda c: c.drawn)
                soonest = min((c.due for c in waiting), default=math.inf)
                self._changed.wait(None if soonest == math.inf else soonest - now)
        return None

    def _draw(self, client: _Client) -> None:
        """Renders one frame for a browser and sends it."""
        start = time.monotonic()
        with self._changed:
            snapshot, view = self._snapshot, client.view
            client.due, client.drawn = math.inf, start
            moving = start - client.moved < REST_AFTER
            if moving:
                client.due = client.moved + REST_AFTER  # the camera may rest then
        if snapshot is None:
            return  # the viewer has been stopped meanwhile
        if client.lens.value:
            view = replace(view, lens=self._chosen_view(client).lens)
        divisor = DIVISORS[client.resolution.value]
        scale = 1 / divisor
        if moving:
            affordable = math.sqrt(moving_pixels(self._settled, self._moving) / (view.width * view.height))
            scale = min(scale, max(affordable, SMALLEST_MOVING_SCALE))
        scaled = view.scaled(scale)
        background = [channel / 255 for channel in client.background.value]
        snapshot.wait()
        frame = render_frame(snapshot.scene, scaled, client.footprint.value, background, self.order)
        seconds = time.monotonic() - start
        with self._changed:
            if client.handle.client_id not in self._clients:
                return
        cost = Cost(scaled.width * scaled.height, seconds)
        if moving:
            self._moving = cost
            client.handle.scene.set_background_image(frame, format="jpeg", jpeg_quality=85)
        else:
            self._settled = cost
            # The browser would smooth a small picture.
            squares = frame.repeat(divisor, 0).repeat(divisor, 1)
            client.handle.scene.set_background_image(squares, format="png")
        client.figures.content = _paragraph([f"{scaled.width} x {scaled.height}, {1000 * seconds:.0f} ms per frame"])


def _paragraph(lines: list[str]) -> str:
    """Lines of HTML in the place that the panel gives to text."""
    return f'<div style="padding: 0 0.85em 0.4em; font-size: 0.875em; line-height: 1.5">{"<br>".join(lines)}</div>'
