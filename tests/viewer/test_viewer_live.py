"""The live viewer: its frames are the rasterizer's, and it serves browsers, whose part a websocket plays here."""

import http.client
import socket
import struct
import sys
import threading
import time
import types
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import refused
from gaussians import make_scene, make_view
from marks import needs_cuda
from processes import DEADLINE

import analytic_rasterizer as ar
from analytic_rasterizer import cli, io, render_stages, viewer
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.viewer import frames, live

pytestmark = pytest.mark.gate

REST = (1.0, 0.0, 0.0, 0.0)
FOV = 0.7


def expected_frame(scene, view, footprint, background=(0.0, 0.0, 0.0)):
    """(H, W, 3) uint8 of the library's own picture."""
    settings = view.settings(1.0, background, scene.sh_degree, footprint, device=scene.means.device)
    color = render_stages(settings, **scene.arguments()).color
    return (255 * color.clamp(0, 1)).round().to("cpu", torch.uint8).permute(1, 2, 0).numpy()


# -------------------------------------------------------------------------- without a server


@pytest.mark.parametrize("footprint", viewer.LIVE_FOOTPRINTS)
def test_frames_are_those_of_the_library(device, footprint):
    scene, background = make_scene().to(device), (0.2, 0.4, 0.6)
    view = frames.camera_view((0.1, -0.2, 0.3), (0.9, 0.1, -0.2, 0.05), FOV, 80, 60)
    frame = live.render_frame(scene, view, footprint, background)
    assert (frame.shape, frame.dtype) == ((60, 80, 3), np.uint8)
    assert np.ptp(frame) > 50  # there is something to see
    np.testing.assert_array_equal(frame, expected_frame(scene, view, footprint, background))


def test_frames_have_an_order():
    """Along rays where the footprint can be; others stay as they are, so that a browser can choose them."""
    scene, background = make_scene(), (0.2, 0.4, 0.6)
    view = frames.camera_view((0.1, -0.2, 0.3), (0.9, 0.1, -0.2, 0.05), FOV, 80, 60)
    settings = view.settings(1.0, background, scene.sh_degree, "box:samples=1", effects=ar.Effects(order="ray"))
    expected = render_stages(settings, **scene.arguments()).color.clamp(0, 1).mul(255).round().byte()
    frame = live.render_frame(scene, view, "box:samples=1", background, "ray")
    np.testing.assert_array_equal(frame, expected.permute(1, 2, 0).numpy())
    center = live.render_frame(scene, view, "cumulant", background)
    np.testing.assert_array_equal(live.render_frame(scene, view, "cumulant", background, "ray"), center)
    with pytest.raises(ValueError, match="order must be one of center, ray, ray:32, got 'last'"):
        live.LiveViewer(order="last")


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=needs_cuda)])
def test_a_snapshot_waits_for_the_stream_that_fills_it(device):
    scene = make_scene().to(device)
    view = frames.camera_view((0.0, 0.0, 0.0), REST, FOV, 64, 48)
    expected = expected_frame(scene, view, "analytic")
    means, late = scene.means, torch.zeros_like(scene.means)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(200_000_000)  # about 0.1 s
        late.copy_(means)
        snapshot = frames.take_snapshot(scene._replace(means=late), copy=True)
    snapshot.wait()
    np.testing.assert_array_equal(live.render_frame(snapshot.scene, view, "analytic"), expected)


def test_every_footprint_can_be_chosen():
    chosen = [ar.resolve_footprint(name) for name in viewer.LIVE_FOOTPRINTS]
    assert {footprint.name for footprint in chosen} == set(ar.FOOTPRINTS)
    assert {f.samples for f in chosen if f.name == "box"} == {1, 4, 16}
    assert {f.samples for f in chosen if f.name == "moment"} == {1, 4, 16}
    assert len(set(chosen)) == len(chosen)


def test_a_camera_is_a_pinhole():
    quaternion = torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64)
    position = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    view = frames.camera_view(position.numpy(), (2 * quaternion).numpy(), 1.0, 200, 100)
    assert (view.fx, view.fy) == pytest.approx((50 / np.tan(0.5), 50 / np.tan(0.5)))
    rotation = view.w2c[:3, :3].T  # camera to world
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(-rotation @ view.w2c[:3, 3], position)
    # The axis of the quaternion is where its rotation leaves it.
    axis = quaternion[1:] / quaternion[1:].norm()
    torch.testing.assert_close(rotation @ axis, axis)
    angle = 2 * torch.atan2(quaternion[1:].norm(), quaternion[0])
    across = torch.linalg.cross(axis, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(rotation @ across, across * angle.cos() + torch.linalg.cross(axis, across) * angle.sin())


BAD_CAMERAS = [("position", (0, 0, np.nan)), ("width", 0), ("height", -1), ("width", frames.LARGEST_SIDE + 1)]
BAD_CAMERAS += [("wxyz", (0, 0, 0, 0)), ("wxyz", (1, 0, 0)), ("fov", 0.0), ("fov", np.pi), ("fov", np.nan)]


@pytest.mark.parametrize("name, value", BAD_CAMERAS)
def test_a_bad_camera_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        frames.camera_view(**{"position": (0, 0, 0), "wxyz": REST, "fov": FOV, "width": 8, "height": 8} | {name: value})


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r'needs viser: pip install "analytic_rasterizer\[view\]"'):
        viewer.LiveViewer()


def test_the_command_names_the_extra(monkeypatch, tmp_path, capsys):
    pytest.importorskip("gsply", reason="needs the cli extra")
    io.save_scene(tmp_path / "scene.ply", make_scene())
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["view", str(tmp_path / "scene.ply"), "--server"]) == 2
    assert 'pip install "analytic_rasterizer[view]"' in capsys.readouterr().err


def test_the_size_of_moving_frames_follows_from_what_frames_take():
    def seconds(pixels, fixed, per_pixel):
        return frames.Cost(pixels, fixed + per_pixel * pixels)

    def chosen(fixed, per_pixel):
        return frames.moving_pixels(seconds(10**6, fixed, per_pixel), seconds(10**5, fixed, per_pixel))

    target = frames.MOVING_SECONDS
    assert frames.moving_pixels(None, frames.Cost(1, 1.0)) == frames.moving_pixels(frames.Cost(1, 1.0), None)
    for fixed in (0.0, target / 2):  # within the target, it is met
        assert chosen(fixed, 1e-6) == pytest.approx((target - fixed) / 1e-6)
    for fixed in (2 * target, 10 * target):  # where it cannot be met, pixels may take a quarter more
        assert chosen(fixed, 1e-6) == pytest.approx(fixed / 4 / 1e-6)
    # A frame that took longer than a larger one, by chance, says that pixels cost nothing.
    assert frames.moving_pixels(frames.Cost(10**6, 0.01), frames.Cost(10**5, 0.02)) > 10**9
    full = frames.Cost(10**6, 0.01)
    assert frames.moving_pixels(full, full) == np.inf
    assert frames.moving_pixels(full, frames.Cost(10**6, 1.0)) == 10**6 / 2


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        ({"footprint": "nothing"}, "footprint must be one of"),
        ({"background": (0, 0, 2)}, "background must be"),
        ({"background": (0, 0)}, "background must be"),
        ({"interval": -1.0}, "interval must be"),
        ({"interval": float("nan")}, "interval must be"),
        ({"port": -1}, "port must be"),
        ({"port": 65536}, "port must be"),
    ],
)
def test_bad_arguments_are_refused_before_anything_starts(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        viewer.LiveViewer(**arguments)


# -------------------------------------------------------------------------------- with a server


class Browser:
    """What a browser does, without one: sends a camera and values of controls, and receives messages of viser."""

    def __init__(self, url, **options):
        self.msgpack = pytest.importorskip("msgspec").msgpack
        self.zstd = pytest.importorskip("zstandard").ZstdDecompressor()
        client = pytest.importorskip("websockets.sync.client")
        protocol = f"viser-v{pytest.importorskip('viser').__version__}"
        address = url.replace("http:", "ws:").rstrip("/")  # as the page does
        options |= {"subprotocols": [protocol], "compression": None, "max_size": None}
        options |= {"open_timeout": DEADLINE, "ping_interval": None}  # of the server a busy machine may hear late
        self.socket = client.connect(address, **options)
        self.controls = {}  # label: uuid
        self.texts = {}  # uuid: HTML
        self.camera = {}  # what the server has set
        self.frames = []

    def close(self):
        self.socket.close()

    def send(self, kind, **fields):
        self.socket.send(self.msgpack.encode({"type": kind} | fields))

    def move(self, position=(0.0, 0.0, 0.0), width=64, height=48, fov=FOV):
        x, y, z = position
        pose = {"wxyz": REST, "position": position, "look_at": (x, y, z + 1.0), "up_direction": (0.0, -1.0, 0.0)}
        pose |= {"fov": fov, "near": 0.1, "far": 10.0, "image_height": height, "image_width": width}
        self.send("ViewerCameraMessage", **pose)

    def choose(self, label, value):
        self.send("GuiUpdateMessage", uuid=self.controls[label], updates={"value": value})

    def receive(self, seconds):
        """Takes in one packet of messages; False where none comes."""
        try:
            packet = self.socket.recv(timeout=seconds)
        except TimeoutError:
            return False
        _, size = struct.unpack_from("<QQ", packet)
        for message in self.msgpack.decode(self.zstd.decompress(packet[16 : 16 + size]))["messages"]:
            kind = message["type"]
            if kind == "BackgroundImageMessage" and message["rgb_data"]:
                self.frames.append((message["format"], self.decode(message["rgb_data"])))
            elif kind.startswith("Gui") and "label" in message.get("props", {}):
                self.controls[message["props"]["label"]] = message["uuid"]
            elif kind == "GuiUpdateMessage" and "content" in message["updates"]:
                self.texts[message["uuid"]] = message["updates"]["content"]
            elif kind.startswith("SetCamera"):
                self.camera |= {k: v for k, v in message.items() if k != "type"}
        return True

    @staticmethod
    def decode(data):
        from io import BytesIO

        image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
        return np.asarray(image.open(BytesIO(data)).convert("RGB"))

    def wait_for(self, done):
        """Takes in messages until `done()` is true."""
        end = time.monotonic() + DEADLINE
        while not done():
            assert time.monotonic() < end, (self.controls, self.texts, [f.shape for _, f in self.frames])
            self.receive(1)

    def wait_for_picture(self, expected):
        """Takes in messages until the last frame is this picture. Frames at rest lose nothing on their way."""
        self.wait_for(lambda: self.frames and np.array_equal(self.frames[-1][1], expected))

    @property
    def text(self):
        return " ".join(self.texts.values())


@contextmanager
def connected(url, **camera):
    browser = Browser(url)
    try:
        browser.move(**camera)
        yield browser
    finally:
        browser.close()


@pytest.fixture
def live_viewer():
    pytest.importorskip("viser", reason="needs the view extra")
    with viewer.LiveViewer(views=[make_view("front"), make_view("other")], name="a <b> scene") as running:
        yield running


def seen(position=(0.0, 0.0, 0.0), width=64, height=48, fov=FOV):
    return frames.camera_view(position, REST, fov, width, height)


def front(browser_width=64, browser_height=48):
    """The pinhole of the first view in a browser: square pixels, with all of the view in the picture."""
    focal = min(70.0 * browser_width / 64, 71.0 * browser_height / 48)
    return seen(width=browser_width, height=browser_height, fov=2 * np.arctan(browser_height / (2 * focal)))


def test_a_browser_sees_the_first_view_and_moves(live_viewer, device):
    scene = make_scene().to(device)
    live_viewer.update(scene)
    with connected(live_viewer.url) as browser:
        browser.wait_for_picture(expected_frame(scene, front(), "analytic"))
        assert browser.frames[-1][0] == "png"
        assert browser.camera["fov"] == pytest.approx(2 * np.arctan(24 / 70))
        browser.move((0.3, 0.2, -0.5))
        browser.wait_for_picture(expected_frame(scene, seen((0.3, 0.2, -0.5)), "analytic"))
        browser.move((0.3, 0.2, -0.5), width=90, height=33)
        browser.wait_for_picture(expected_frame(scene, seen((0.3, 0.2, -0.5), 90, 33), "analytic"))


def test_controls_change_the_picture(live_viewer):
    scene = make_scene()
    live_viewer.update(scene)
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: browser.frames)
        browser.move()
        for footprint in ("box:samples=16", "moment:samples=4", "exact"):
            browser.choose("Footprint", footprint)
            browser.wait_for_picture(expected_frame(scene, seen(), footprint))
        browser.choose("Background", [255, 0, 51])
        browser.wait_for_picture(expected_frame(scene, seen(), "exact", (1.0, 0.0, 0.2)))
        browser.choose("Resolution", "1/4")
        small = expected_frame(scene, seen().scaled(0.25), "exact", (1.0, 0.0, 0.2))
        browser.wait_for_picture(small.repeat(4, 0).repeat(4, 1))


def test_browsers_have_cameras_and_controls_of_their_own(live_viewer):
    scene = make_scene()
    live_viewer.update(scene)
    with connected(live_viewer.url) as one, connected(live_viewer.url) as two:
        for browser in (one, two):
            browser.wait_for(lambda browser=browser: browser.frames)
        one.choose("Footprint", "point")
        one.move((0.2, 0.0, 0.0))
        two.move((0.0, 0.3, 0.0), width=40)
        one.wait_for_picture(expected_frame(scene, seen((0.2, 0.0, 0.0)), "point"))
        two.wait_for_picture(expected_frame(scene, seen((0.0, 0.3, 0.0), 40), "analytic"))


def test_an_update_is_shown_with_its_text(live_viewer):
    live_viewer.interval = 0.0
    first, second = make_scene(), make_scene(50)
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: "waiting for the first scene" in browser.text)
        assert live_viewer.update(first, step=1, text="loss <0.5>")
        browser.wait_for_picture(expected_frame(first, front(), "analytic"))
        browser.wait_for(lambda: "step 1" in browser.text and "loss &lt;0.5&gt;" in browser.text)
        assert "a &lt;b&gt; scene" in browser.text
        assert live_viewer.update(lambda: second, step=2)
        browser.wait_for_picture(expected_frame(second, front(), "analytic"))
        browser.wait_for(lambda: "step 2" in browser.text and "50 Gaussians" in browser.text)


def test_what_is_shown_is_a_copy(live_viewer, device):
    scene = make_scene().to(device)
    kept = scene.map(torch.clone)
    live_viewer.update(scene)
    scene.means.zero_()  # as an optimiser changes its parameters
    with connected(live_viewer.url) as browser:
        browser.wait_for_picture(expected_frame(kept, front(), "analytic"))


def test_a_camera_that_is_read_late_does_not_bring_back_what_was(live_viewer):
    """A browser's first message is handled beside the jump to the first view, by another thread."""

    class Camera:
        wxyz, fov, image_width, image_height = REST, FOV, 64, 48

        def __init__(self, position, meanwhile=lambda: None):
            self.at, self.meanwhile = position, meanwhile

        @property
        def position(self):
            self.meanwhile()
            return self.at

    client = types.SimpleNamespace(view=None, moved=0.0)
    newer = threading.Thread(target=live_viewer._move, args=(client, Camera((0.0, 0.0, 1.0))))

    def run_newer():
        newer.start()
        newer.join(0.5)  # as far as it gets: it waits for the older one

    live_viewer._move(client, Camera((0.0, 0.0, 2.0), run_newer))
    newer.join(DEADLINE)
    assert torch.equal(client.view.w2c, seen((0.0, 0.0, 1.0)).w2c)


def test_views_can_be_stepped_through(live_viewer):
    live_viewer.update(make_scene())
    with connected(live_viewer.url, position=(1.0, 0.0, 0.0)) as browser:
        browser.wait_for(lambda: browser.camera.get("position") == [0.0, 0.0, 0.0] and "Jump to" in browser.controls)
        for button, name in (("Next", "other"), ("Next", "front"), ("Previous", "other")):
            browser.choose("Jump to", button)
            client = next(iter(live_viewer._clients.values()))
            browser.wait_for(lambda name=name, client=client: client.view_name.value == name)


def test_the_lens_of_a_view_is_shown_and_can_be_switched_off():
    pytest.importorskip("viser", reason="needs the view extra")
    scene, lens = make_scene(), ar.Lens.fisheye((0.05,))
    with viewer.LiveViewer(views=[replace(make_view("front"), lens=lens), make_view("other")]) as running:
        running.update(scene)
        with connected(running.url) as browser:
            browser.wait_for_picture(expected_frame(scene, replace(front(), lens=lens), "analytic"))
            browser.choose("Lens of the view", False)
            browser.wait_for_picture(expected_frame(scene, front(), "analytic"))


def counted_frames(monkeypatch):
    frames = []
    original = live.render_frame
    monkeypatch.setattr(live, "render_frame", lambda *args: frames.append(1) or original(*args))
    return frames


def test_without_a_browser_nothing_is_rendered_or_copied(live_viewer, monkeypatch):
    frames, asked = counted_frames(monkeypatch), []
    scene = make_scene()

    def gaussians():
        asked.append(1)
        return scene

    live_viewer.interval = 0.0
    assert live_viewer.update(gaussians)  # the first says where the scene is
    assert not any(live_viewer.update(gaussians, step=step) for step in range(100))
    assert live_viewer.update(gaussians, force=True)
    assert len(asked) == 2
    with connected(live_viewer.url) as browser:
        browser.wait_for_picture(expected_frame(scene, front(), "analytic"))
    end = time.monotonic() + DEADLINE
    while live_viewer._clients and time.monotonic() < end:
        time.sleep(0.01)
    before = len(frames)
    assert before > 0
    assert not live_viewer.update(gaussians)
    assert live_viewer.update(gaussians, force=True)
    time.sleep(2 * live.REST_AFTER)
    assert len(frames) == before


def test_copies_keep_their_distance(live_viewer):
    live_viewer.interval = 1e6
    scene = make_scene()
    live_viewer.update(scene)
    with connected(live_viewer.url) as browser:
        browser.wait_for_picture(expected_frame(scene, front(), "analytic"))
        assert not live_viewer.update(scene)
        assert live_viewer.update(scene, force=True)


def test_an_update_does_not_wait_for_a_frame(live_viewer, monkeypatch):
    rendering, finish = threading.Event(), threading.Event()

    def slow_frame(scene, view, *_):
        rendering.set()
        finish.wait(DEADLINE)
        return np.zeros((view.height, view.width, 3), np.uint8)

    monkeypatch.setattr(live, "render_frame", slow_frame)
    live_viewer.interval = 0.0
    live_viewer.update(make_scene())
    with connected(live_viewer.url) as browser:
        assert rendering.wait(DEADLINE)
        # These come back although the frame does not end before they do.
        assert live_viewer.update(make_scene(40), step=1)
        assert live_viewer.update(make_scene(41), step=2)
        finish.set()
        browser.wait_for(lambda: "41 Gaussians" in browser.text and browser.frames)


def test_a_frame_that_fails_is_said_and_the_next_one_comes(live_viewer, monkeypatch):
    original = live.render_frame

    def fail(*_):
        raise RuntimeError("out of <memory>\nand a long trace")

    monkeypatch.setattr(live, "render_frame", fail)
    scene = make_scene()
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: "waiting for the first scene" in browser.text)
        live_viewer.update(scene)
        browser.wait_for(lambda: "Rendering failed: out of &lt;memory&gt;<" in browser.text)
        monkeypatch.setattr(live, "render_frame", original)
        browser.move()
        browser.wait_for_picture(expected_frame(scene, seen(), "analytic"))


def test_a_browser_that_sends_nonsense_changes_nothing(live_viewer):
    scene = make_scene()
    live_viewer.update(scene)
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: browser.frames)
        browser.move(fov=float("nan"))
        browser.move(width=10**9)
        browser.move(position=(float("inf"), 0.0, 0.0))
        browser.move((0.1, 0.0, 0.0))
        browser.wait_for_picture(expected_frame(scene, seen((0.1, 0.0, 0.0)), "analytic"))


def test_while_the_camera_moves_frames_are_small(live_viewer):
    scene = make_scene()
    live_viewer.update(scene)
    with connected(live_viewer.url, width=640, height=480) as browser:
        expected = expected_frame(scene, front(640, 480), "analytic")
        # The jump to the first view is a motion. Its end is the whole picture.
        browser.wait_for_picture(expected)

        def small_frame_after_moving():
            browser.move((0.1, 0.0, 0.0), width=640, height=480)  # again: a frame that is late counts as one at rest
            return any(kind == "jpeg" and frame.shape[1] < 640 for kind, frame in browser.frames)

        browser.wait_for(small_frame_after_moving)
        browser.wait_for_picture(expected_frame(scene, seen((0.1, 0.0, 0.0), 640, 480), "analytic"))


@pytest.mark.parametrize(
    "scene, error",
    [
        (torch.zeros(3), TypeError),
        (lambda: None, TypeError),
        (Gaussians(*(torch.zeros(0, n) for n in (3, 3, 4, 1)), torch.zeros(0, 1, 3)), ValueError),
        (make_scene()._replace(means=torch.full((30, 3), float("nan"))), ValueError),
    ],
    ids=["tensor", "none", "empty", "nan"],
)
def test_bad_scenes_are_refused(live_viewer, scene, error):
    with pytest.raises(error, match="scene"):
        live_viewer.update(scene)
    assert live_viewer.update(make_scene())


def test_stopping_ends_thread_and_server(live_viewer):
    live_viewer.update(make_scene())
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: browser.frames)
        waiting = threading.Thread(target=live_viewer.wait)
        waiting.start()
        live_viewer.stop()
        waiting.join(DEADLINE)
        assert not waiting.is_alive()
    assert not live_viewer._thread.is_alive()
    with pytest.raises(OSError):
        Browser(live_viewer.url)
    live_viewer.stop()
    assert not live_viewer.update(make_scene())


def test_the_server_is_on_this_machine_only_and_shares_nothing(live_viewer):
    assert live_viewer._server.get_host() == "127.0.0.1"
    assert live_viewer._server.request_share_url() is None


def key_of(url):
    return url.rstrip("/").rpartition("/")[2]


def test_only_who_knows_the_key_is_answered(live_viewer):
    """Websockets and pages, with the address of the server, a wrong key, or the right key under another host name."""
    live_viewer.update(make_scene())
    root, key = f"http://127.0.0.1:{live_viewer.port}", key_of(live_viewer.url)
    assert live_viewer.url == f"{root}/{key}/" and len(key) >= 32
    rejected = pytest.importorskip("websockets.exceptions").InvalidStatus
    for address in (root, f"{root}/{key[:-1]}", f"{root}/x/{key}", f"{root}/?{key}"):
        with pytest.raises(rejected, match="403"):
            Browser(address)
        with pytest.raises(urllib.error.HTTPError, match="403") as refused:
            urllib.request.urlopen(f"{address}/", timeout=DEADLINE)
        refused.value.close()
    for host, allowed in (("127.0.0.1", True), ("localhost:99", True), ("example.org", False), ("", False)):
        connection = http.client.HTTPConnection("127.0.0.1", live_viewer.port, timeout=DEADLINE)
        connection.request("GET", f"/{key}/", headers={"Host": host})
        answer = connection.getresponse()
        assert (answer.status == 200) == allowed and (b"<title>Viser</title>" in answer.read()) == allowed
        connection.close()
    # A page from elsewhere sends its own name, where it was made to point to this machine.
    there = socket.create_connection(("127.0.0.1", live_viewer.port), DEADLINE)
    with pytest.raises(rejected, match="403"):
        Browser(live_viewer.url.replace("127.0.0.1", "example.org"), sock=there)
    with pytest.raises(rejected, match="403"):  # two names
        Browser(live_viewer.url, additional_headers={"Host": "example.org"})
    with connected(live_viewer.url) as browser:
        browser.wait_for(lambda: browser.frames)


def test_every_viewer_has_its_own_key_and_viser_prints_no_address_without(live_viewer, capsys):
    with viewer.LiveViewer() as other:
        assert key_of(other.url) != key_of(live_viewer.url)
    assert "http" not in "".join(capsys.readouterr())


def test_a_viser_without_the_check_is_not_used(monkeypatch):
    """Where viser does not serve through the function that the check is added to, nothing is left running."""
    viser = pytest.importorskip("viser", reason="needs the view extra")
    stopped = []

    class Server:
        def __init__(self, **_):
            self.stop = lambda: stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Server)
    with pytest.raises(RuntimeError, match="cannot be given an access check"):
        viewer.LiveViewer()
    assert stopped == [True]


def test_a_port_in_use_is_one_sentence(live_viewer):
    with pytest.raises(ValueError, match=f"port {live_viewer.port} cannot be used"):
        viewer.LiveViewer(live_viewer.port)


# ------------------------------------------------------------------------------------ command


def test_the_command_serves_and_ends(monkeypatch, tmp_path, capsys):
    pytest.importorskip("viser", reason="needs the view extra")
    pytest.importorskip("gsply", reason="needs the cli extra")
    scene, opened, started = make_scene(), [], []
    io.save_scene(tmp_path / "scene.ply", scene)
    io.save_views(tmp_path / "views.json", [make_view("one"), make_view("two")])
    monkeypatch.setattr("webbrowser.open", opened.append)

    def interrupted(running):
        started.append((running.footprint, running.background, [view.name for view in running.views]))
        with connected(running.url) as browser:
            browser.wait_for(lambda: browser.frames)
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer.LiveViewer, "wait", interrupted)
    command = ["view", str(tmp_path / "scene.ply"), "--server", "--views", str(tmp_path / "views.json")]
    assert cli.main([*command, "--footprint", "box:samples=16", "--background", "0", "0.5", "1"]) == 0
    assert cli.main([*command, "--no-browser", "--footprint", "moment"]) == 0
    assert len(opened) == 1 and opened[0].startswith("http://127.0.0.1:")
    assert opened[0] in capsys.readouterr().out
    names = ["one", "two"]
    assert started == [("box:samples=16", (0.0, 0.5, 1.0), names), ("moment:samples=4", (0.0, 0.0, 0.0), names)]


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--server", "--export", "out.html"], "--export writes the page that needs no server"),
        (["--server", "--footprint", "nothing"], "footprint must be one of"),
        (["--device", "cuda"], "--device and --threads are for --server"),
        (["--threads", "2"], "--device and --threads are for --server"),
    ],
)
def test_mistakes_are_one_sentence(monkeypatch, tmp_path, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    assert sentence in refused(capsys, cli.main, ["view", "scene.ply", *arguments])
