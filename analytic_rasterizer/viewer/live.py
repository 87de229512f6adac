"""Frames rendered by the library's own kernels, for every footprint and for watching a training run.

`LiveViewer` needs viser, of the extra `view`, which is imported when a viewer is made.
"""

from __future__ import annotations

import html
import math
import threading
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from .. import io
from ..footprints import FOOTPRINTS, OPTIONS, Footprint, get_default_footprint, option_values, resolve_footprint
from ..rasterizer import rasterize_gaussians
from .packing import extent, mean_up, overview
from .server import ADDRESS

REST_AFTER = 0.2
"""Seconds without motion after which a camera rests."""
MOVING_SECONDS = 0.06
"""What a frame should take while its camera moves; the resolution adapts to it."""
FIRST_MOVING_PIXELS = 40_000
"""Pixels of such a frame as long as nothing is known."""
SMALLEST_MOVING_SCALE = 1 / 8
LARGEST_SIDE = 8192
"""Pixels of a frame along one side, at most."""
DIVISORS = {"1": 1, "1/2": 2, "1/4": 4, "1/8": 8}
"""The choices of the control Resolution."""


def _footprint_choices() -> tuple[str, ...]:
    choices = []
    for name in FOOTPRINTS:
        by_samples = "samples" in OPTIONS.get(name, {})
        choices += [f"{name}:samples={n}" for n in option_values(name)] if by_samples else [name]
    return tuple(choices)


LIVE_FOOTPRINTS = _footprint_choices()
"""The footprints that can be chosen in a live viewer: all of them, with every number of samples."""


def camera_view(position, wxyz, fov: float, width: int, height: int) -> io.View:
    """The pinhole of a camera of viser, whose axes are x right, y down, z forward, as those of `View`.

    Args:
        position: (3,) world units.
        wxyz: (4,) quaternion of the rotation from camera to world, of any length but zero.
        fov: Vertical field of view, radians, between 0 and pi.
        width, height: Size of the picture, px, 1 to `LARGEST_SIDE`.

    Raises:
        ValueError: Numbers that are not finite or out of their range.
    """
    pose = torch.as_tensor(np.concatenate([position, wxyz]), dtype=torch.float64)
    if not (pose.shape == (7,) and pose.isfinite().all() and pose[3:].norm() > 0):
        raise ValueError(f"position and wxyz must be 3 and 4 finite numbers, wxyz not zero, got {pose.tolist()}")
    if not 0 < fov < math.pi:
        raise ValueError(f"fov must be between 0 and pi, got {fov}")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise ValueError(f"width and height must be from 1 to {LARGEST_SIDE}, got {width} and {height}")
    w, x, y, z = pose[3:] / pose[3:].norm()
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[:3, :3] = torch.stack(  # the rows are the axes of the camera
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
    w2c[:3, 3] = -w2c[:3, :3] @ pose[:3]
    focal = height / (2 * math.tan(fov / 2))
    return io.View("live", width, height, focal, focal, w2c)


@torch.no_grad()
def render_frame(scene: io.Scene, view: io.View, footprint: str, background=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Renders a view on the device of the scene.

    Returns:
        (H, W, 3) uint8: the rasterizer's picture, clamped to [0, 1] and rounded to 8 bits.

    Raises:
        ValueError: As `resolve_footprint` and `GaussianRasterizer`.
    """
    settings = view.settings(1.0, background, scene.sh_degree, footprint, device=scene.means.device)
    color, *_ = rasterize_gaussians(
        scene.means, None, scene.shs, None, scene.opacities, scene.scales, scene.rotations, None, settings
    )
    return color.clamp(0, 1).mul(255).round().to("cpu", torch.uint8).permute(1, 2, 0).contiguous().numpy()


class Cost(NamedTuple):
    """What a frame has taken."""

    pixels: int
    seconds: float


def moving_pixels(settled: Cost | None, moving: Cost | None) -> float:
    """Pixels that a frame may have while its camera moves, given the last frames at rest and in motion.

    Two frames tell what a frame takes whatever its size, to project and sort, and what each pixel adds. Pixels get what
    is left of `MOVING_SECONDS`, or a quarter of the rest, below which a smaller frame is hardly a faster one.
    """
    if settled is None or moving is None:
        return FIRST_MOVING_PIXELS
    if moving.pixels >= settled.pixels:
        return math.inf if moving.seconds <= 2 * MOVING_SECONDS else moving.pixels / 2
    per_pixel = max((settled.seconds - moving.seconds) / (settled.pixels - moving.pixels), 1e-12)
    fixed = max(moving.seconds - per_pixel * moving.pixels, 0.0)
    return max(MOVING_SECONDS - fixed, fixed / 4) / per_pixel


class _Snapshot(NamedTuple):
    scene: io.Scene
    ready: torch.cuda.Event | None
    """Recorded on the stream of whoever made the tensors; None on the CPU."""

    def wait(self) -> None:
        """Makes the current stream wait until the tensors are filled, and keeps their memory for it."""
        if self.ready is None:
            return
        stream = torch.cuda.current_stream(self.scene.means.device)
        stream.wait_event(self.ready)
        for tensor in self.scene[:-1]:
            tensor.record_stream(stream)


@torch.no_grad()
def _take(scene: io.Scene | Callable[[], io.Scene], copy: bool) -> _Snapshot:
    """What `LiveViewer.update` is given, checked, and where asked for copied."""
    given = scene() if callable(scene) else scene
    if not isinstance(given, io.Scene):
        raise TypeError(f"scene must be an io.Scene or a function that returns one, got {type(given).__name__}")
    if len(given.means) == 0:
        raise ValueError("scene must have Gaussians, got none")
    tensors = [tensor.detach().to(torch.float32, copy=copy).contiguous() for tensor in given[:-1]]
    ready = None
    if given.means.is_cuda:
        ready = torch.cuda.Event()
        ready.record(torch.cuda.current_stream(given.means.device))
    return _Snapshot(io.Scene(*tensors, given.sh_degree), ready)


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
        self.steps = gui.add_button_group("Jump to", ["Previous", "Next", "Reset"])
        self.figures = gui.add_html("")


class LiveViewer:
    """Shows a scene, which may change, in browsers on this machine.

        viewer = LiveViewer(views=views)
        for step in range(30_000):
            ...
            viewer.update(model.scene, step=step, text=f"loss {loss:.4f}")  # model.scene() returns an io.Scene
        viewer.stop()

    Each browser has its own camera and controls. One thread renders for all of them, only while a browser is
    connected and only when something that it shows has changed: at a resolution that can keep up while its camera
    moves, and at the chosen one when the camera rests. It renders a copy of the scene, so that a training run never
    waits for it; what they share is the device.

    May be used from any thread. Is a context manager, which stops the viewer at its end.

    Attributes:
        url: Where the page is: on 127.0.0.1, which only this machine reaches.
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
    ):
        """Starts the server.

        Args:
            port: To listen on; 0 takes any free one.
            views: Cameras to jump to. Without any there is one, which sees most of the first scene.
            footprint: What browsers start with; None takes the library's default.
            background: (r, g, b) in [0, 1].
            name: What the page calls the scene.
            interval: Seconds between two copies of the scene, at least; not negative.

        Raises:
            ImportError: viser is missing; names the extra that installs it.
            ValueError: A port that cannot be used, or a bad footprint, background or interval.
        """
        chosen = get_default_footprint() if footprint is None else resolve_footprint(str(footprint))
        self.footprint = next((c for c in LIVE_FOOTPRINTS if resolve_footprint(c) == chosen), str(chosen))
        self.background = tuple(float(channel) for channel in background)
        if len(self.background) != 3 or not all(0 <= channel <= 1 for channel in self.background):
            raise ValueError(f"background must be three numbers from 0 to 1, got {background}")
        if not (math.isfinite(interval) and interval >= 0):
            raise ValueError(f"interval must be finite and not negative, got {interval}")
        if not 0 <= port <= 65535:
            raise ValueError(f"port must be from 0 to 65535, got {port}")
        viser = io.optional_import("viser", "view")

        self.name = name
        self.interval = interval
        self.views = views or [overview(torch.zeros(3, dtype=torch.float64), 1.0)]
        self._views_given = bool(views)
        self._middle = torch.zeros(3, dtype=torch.float64)  # of the first scene, which cameras turn about
        self._radius = 1.0
        self._snapshot: _Snapshot | None = None
        self._next_copy = -math.inf
        self._text = "waiting for the first scene"
        self._clients: dict[int, _Client] = {}
        self._stopped = False
        self._changed = threading.Condition()  # guards what is above, and is notified when a frame may be due
        self._settled: Cost | None = None  # these two belong to the rendering thread
        self._moving: Cost | None = None

        self._server = viser.ViserServer(host=ADDRESS, port=port, verbose=False)
        self.port = self._server.get_port()
        self.url = f"http://{ADDRESS}:{self.port}"
        if port not in (0, self.port):  # viser goes on to the next free one
            self._server.stop()
            raise ValueError(f"port {port} cannot be used: it is taken, or not allowed")
        # viser can pass the page on through a server elsewhere, for any browser that asks. Scenes stay here.
        self._server.request_share_url = lambda *_, **__: None
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("Gaussian splats")
        self._server.scene.set_up_direction(tuple(mean_up(self.views)))
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
        scene: io.Scene | Callable[[], io.Scene],
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
            TypeError: No `Scene`.
            ValueError: The scene has no Gaussians, or at the first call centres that are not finite.
        """
        with self._changed:
            first = self._snapshot is None
            due = bool(self._clients) and time.monotonic() >= self._next_copy
            if self._stopped or not (first or force or due):
                return False
        taken = _take(scene, copy)
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

    # ------------------------------------------------------------------------------- browsers

    def _begin(self, scene: io.Scene) -> None:
        """Puts cameras where the first scene is."""
        if not bool(scene.means.isfinite().all()):
            raise ValueError("means of the first scene must be finite")
        middle, self._radius = extent(scene)
        self._middle = middle.cpu()
        if not self._views_given:
            self.views = [overview(self._middle, self._radius)]

    def _connect(self, handle) -> None:
        client = _Client(handle, self)

        def ask(_) -> None:
            with self._changed:
                self._ask(client)

        for control in (client.footprint, client.resolution, client.background):
            control.on_update(ask)
        client.view_name.on_update(lambda _: self._jump(client))
        client.steps.on_click(lambda event: self._step_view(client, event.target.value))
        with self._changed:
            self._clients[handle.client_id] = client
        self._show_status(client)
        self._jump(client)
        handle.camera.on_update(lambda camera: self._move(client, camera))

    def _disconnect(self, handle) -> None:
        with self._changed:
            self._clients.pop(handle.client_id, None)

    def _ask(self, client: _Client) -> None:
        """Has a frame rendered for this browser. The lock is held."""
        client.due = time.monotonic()
        self._changed.notify_all()

    def _move(self, client: _Client, camera) -> None:
        try:
            view = camera_view(camera.position, camera.wxyz, camera.fov, camera.image_width, camera.image_height)
        except ValueError:
            return  # a window without area, or a browser that sends nonsense
        with self._changed:
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
        view = next(view for view in self.views if view.name == client.view_name.value)
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
        divisor = DIVISORS[client.resolution.value]
        scale = 1 / divisor
        if moving:
            affordable = math.sqrt(moving_pixels(self._settled, self._moving) / (view.width * view.height))
            scale = min(scale, max(affordable, SMALLEST_MOVING_SCALE))
        scaled = view.scaled(scale)
        background = [channel / 255 for channel in client.background.value]
        snapshot.wait()
        frame = render_frame(snapshot.scene, scaled, client.footprint.value, background)
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
