"""The viewer's page in Firefox: its pictures against the CPU rasterizer, and that its controls work.

Skipped where firefox or Xvfb is missing; `make test-browser` installs both. Firefox gives WebGL only to a window, which
Xvfb holds without a screen; Mesa draws in software. It is driven by Marionette, the protocol that it is built with.
"""

import base64
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from contextlib import contextmanager

import numpy as np
import pytest
from pages import (
    PATIENCE,
    READ_PIXELS,
    REDUCTIONS,
    WEBGL_FOOTPRINTS,
    assert_same,
    export_rounded,
    random_scene,
    rendered,
    serve,
    turned_view,
)

import demo

PREFERENCES = {
    "webgl.force-enabled": True,  # also on a device that is only software
    "marionette.port": 0,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.enabled": False,
}


class Firefox:
    """A window of Firefox.

    Marionette sends one JSON list per message after its length and a colon: [0, id, command, arguments] is answered by
    [1, id, error, result].
    """

    def __init__(self, path, profile, display):
        with open(os.path.join(profile, "user.js"), "w") as file:
            file.writelines(f"user_pref({json.dumps(k)}, {json.dumps(v)});\n" for k, v in PREFERENCES.items())
        command = [path, "--marionette", "--no-remote", "--profile", profile]
        environment = os.environ | {"DISPLAY": display}
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            self.connect(profile)
        except BaseException:
            self.process.kill()
            raise

    def connect(self, profile):
        port = wait_for(lambda: read(os.path.join(profile, "MarionetteActivePort")))
        self.socket = socket.create_connection(("127.0.0.1", int(port)), timeout=PATIENCE)
        self.stream = self.socket.makefile("rb")
        self.receive()
        self.count = 0
        self.ask("WebDriver:NewSession")
        self.ask("WebDriver:SetTimeouts", script=1000 * PATIENCE, pageLoad=1000 * PATIENCE)

    def receive(self):
        digits = b""
        while (byte := self.stream.read(1)) != b":":
            assert byte, "Firefox has ended"
            digits += byte
        return json.loads(self.stream.read(int(digits)))

    def send(self, command, **arguments):
        self.count += 1
        message = json.dumps([0, self.count, command, arguments]).encode()
        self.socket.sendall(b"%d:" % len(message) + message)

    def ask(self, command, **arguments):
        self.send(command, **arguments)
        _, _, error, result = self.receive()
        assert error is None, error["message"]
        return result

    def run(self, script, *arguments):
        """What the body of a function returns in the page, after its promise."""
        return self.ask("WebDriver:ExecuteScript", script=script, args=arguments, sandbox=None)["value"]

    def open(self, url):
        self.ask("WebDriver:Navigate", url=url)

    def open_settled(self, url):
        self.open(url)
        wait_for(lambda: self.run("return window.analyticReady || window.analyticError"))
        assert self.run("return window.analyticError ?? null") is None

    def pixels(self, width, height):
        return np.frombuffer(base64.b64decode(self.run(f"return ({READ_PIXELS})()")), "<f4").reshape(3, height, width)

    def drawn(self, footprint, width, height):
        self.run("return analyticRender(0, ...arguments).then(() => null)", footprint, width, height)
        return self.pixels(width, height)

    def press(self, key):
        actions = [{"type": kind, "value": key} for kind in ("keyDown", "keyUp")]
        self.ask("WebDriver:PerformActions", actions=[{"type": "key", "id": "keys", "actions": actions}])

    def end(self):
        self.send("Marionette:Quit", flags=["eForceQuit"])  # it may end before it answers
        self.socket.close()
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:  # what was to be tested has been
            self.process.kill()


def wait_for(find):
    """What `find` returns, as soon as it is true."""
    end = time.monotonic() + PATIENCE
    while not (found := find()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def read(path):
    """Text of a file; empty where there is none."""
    try:
        with open(path) as file:
            return file.read()
    except FileNotFoundError:
        return ""


@contextmanager
def screen():
    """The name of a display that nobody sees."""
    number, told = os.pipe()
    command = ["Xvfb", "-displayfd", str(told), "-screen", "0", "1024x768x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[told], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(told)
    try:
        with os.fdopen(number) as pipe:
            yield f":{pipe.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(scope="module")
def firefox():
    names = ("firefox-esr", "firefox")
    path = os.environ.get("FIREFOX") or next(filter(None, map(shutil.which, names)), None)
    if path is None or shutil.which("Xvfb") is None:
        pytest.skip("needs firefox and Xvfb: make test-browser")
    with screen() as display, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        window = Firefox(path, profile, display)
        try:
            yield window
        finally:
            window.end()


SCENES = {
    "random": lambda: (random_scene(), turned_view(), (0.0, 0.0, 0.0)),
    "demo": lambda: (*demo.make_target(), demo.PAPER),
}


@pytest.fixture(scope="module", params=SCENES)
def settled(request, firefox):
    scene, view, background = SCENES[request.param]()
    with serve(scene, [view], background=background) as server:
        firefox.open_settled(f"{server.url}?view=0&size=16x16")
        yield firefox, scene, view, background


@pytest.mark.parametrize("reduction", REDUCTIONS)
@pytest.mark.parametrize("footprint", WEBGL_FOOTPRINTS)
def test_pictures(settled, footprint, reduction):
    firefox, scene, view, background = settled
    view = view.scaled(1 / reduction)
    ours = firefox.drawn(footprint, view.width, view.height)
    assert_same(ours, rendered(scene, view, footprint, background))


def test_an_exported_file_looks_the_same(firefox, tmp_path):
    scene, view = random_scene(500), turned_view()
    rounded = export_rounded(tmp_path / "scene.html", scene, view)
    firefox.open_settled(f"{(tmp_path / 'scene.html').as_uri()}?view=0")
    assert_same(firefox.pixels(view.width, view.height), rendered(rounded, view, "analytic"))


@pytest.mark.gate
def test_keys_and_the_address(firefox):
    with serve(random_scene(200), [turned_view()], name="room.ply") as server:
        firefox.open(server.url)
        wait_for(lambda: firefox.run("return document.getElementById('figures').textContent"))
        assert firefox.run("return document.title").startswith("room.ply")
        firefox.press("1")
        wait_for(lambda: "footprint=point" in firefox.run("return location.hash"))
        firefox.press("c")
        wait_for(lambda: "compare=analytic" in firefox.run("return location.hash"))
        firefox.press("?")
        wait_for(lambda: firefox.run("return document.getElementById('help').open"))
        assert firefox.run("return document.getElementById('message').hidden")
