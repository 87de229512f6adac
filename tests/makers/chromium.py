"""What the tests of the viewer's page in chromium share. Drawing is in software: no graphics device is needed."""

import base64
import math
import os
import shutil
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import torch
from pages import PATIENCE, READ_PIXELS, random_scene, rendered, serve, turned_view

from analytic_rasterizer import io

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: make test-browser")

WEBGL_FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WEBGPU_FLAGS = (
    *WEBGL_FLAGS,
    "--enable-unsafe-webgpu",
    "--enable-gpu",
    "--ignore-gpu-blocklist",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
)
"""With the first of them alone there is an adapter, but a canvas loses the device."""


def find_browser():
    """Path of a chromium, or None."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


@contextmanager
def launch(flags):
    """A chromium; skips where there is none."""
    path = find_browser()
    if path is None:
        pytest.skip("needs chromium: make test-browser")
    with playwright.sync_playwright() as runner:
        launched = runner.chromium.launch(executable_path=path, args=list(flags), timeout=1000 * PATIENCE)
        yield launched
        launched.close()


@contextmanager
def open_page(browser, url, *, offline=False, init=None, size=(320, 240), **options):
    """A page of its own context, of a size [px]. Fails for anything that the page complains of in its console."""
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, offline=offline, **options)
    context.set_default_timeout(1000 * PATIENCE)
    page = context.new_page()
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.complaints = complaints
    if init:
        page.add_init_script(init)
    page.goto(url)
    yield page
    context.close()
    assert not page.complaints


def wait_for(page, expression):
    """Waits until the expression is true. The page's policy forbids to evaluate text in it, as playwright would."""
    for _ in range(20 * PATIENCE):
        value = page.evaluate(expression)
        if value:
            return value
        page.wait_for_timeout(50)
    raise AssertionError(f"{expression} did not become true; the page says: {page.inner_text('body')}")


def wait_until_ready(page):
    wait_for(page, "() => window.analyticReady || window.analyticError")
    assert page.evaluate("() => window.analyticError ?? null") is None


def pixels(page, width, height):
    """The picture as float32 (3, height, width)."""
    data = base64.b64decode(page.evaluate(READ_PIXELS))
    return np.frombuffer(data, "<f4").reshape(3, height, width)


def drawn(page, footprint, width, height, view=0):
    page.evaluate("arguments => analyticRender(...arguments)", [view, footprint, width, height])
    return pixels(page, width, height)


def wait_for_frame(page):
    """Waits until a frame is on the screen."""
    wait_for(page, "() => document.getElementById('figures').textContent !== ''")


@contextmanager
def page_of(browser, scene, views, query="?view=0", wait=wait_until_ready, of_page=None, **options):
    """A page that shows a scene on a server of its own, after `wait(page)`. `of_page`: options of `open_page`."""
    views = views if isinstance(views, list) else [views]
    of_page = of_page or {}
    with serve(scene, views, **options) as server, open_page(browser, f"{server.url}{query}", **of_page) as page:
        wait(page)
        yield page


def settle(page):
    """Waits until the picture on the screen is what was asked for."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(null))))")
    wait_for(page, "() => document.getElementById('surface').getAttribute('aria-busy') === 'false'")


def screenshot(page):
    """The settled picture on the screen, (H, W, 3) uint8."""
    image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
    settle(page)
    return np.asarray(image.open(BytesIO(page.screenshot(type="png"))).convert("RGB"))


def check_photographs(browser, query=""):
    """A photograph is beside the picture of its view, where the view reaches, and the heat map shows the difference."""
    scene, view = random_scene(300), replace(facing(), width=320, height=240, fx=300.0, fy=300.0)
    taken = rendered(scene, view, "point")
    taken[:, 60:120, 160:] = 1.0  # a part that the scene has not
    file = BytesIO()
    io.to_image(torch.from_numpy(taken)).save(file, "PNG")

    def picture(page):
        return screenshot(page).astype(int)[50:122]  # not covered

    with (
        serve(scene, [view, turned_view()], {0: file.getvalue}, footprint="point") as server,
        open_page(browser, f"{server.url}{query}", reduced_motion="reduce", size=(480, 240)) as page,
    ):
        wait_for_frame(page)
        alone = picture(page)
        page.select_option("#compare", "photograph", force=True)
        assert page.text_content("#label-right") == "photograph of facing"
        for _ in range(100):  # until it is loaded
            both = picture(page)
            if both[12:68, 255:396].min() == 255:
                break
            page.wait_for_timeout(50)
        # The page is 80 columns wider than the view on both sides.
        for columns in (slice(0, 230), slice(404, 480)):
            assert (both[:, columns] == alone[:, columns]).all()
        assert both[12:68, 255:396].min() == 255
        page.keyboard.press("c")
        heat = picture(page)
        assert heat[12:68, 250:396].min() > 150 and heat[:, :236].max() <= 32 and heat[:, 404:].max() <= 32
        page.keyboard.press("ArrowLeft")  # elsewhere there is no photograph
        moved = picture(page)
        assert (moved[12:68, 255:396] < 255).any() and "R goes there" in page.text_content("#note")
        page.keyboard.press("r")
        assert (picture(page) == heat).all() and page.text_content("#note") == ""
        page.select_option("#view", "1", force=True)
        assert "R goes there" not in page.text_content("#note")


# ------------------------------------------------------------------------------------- scenes


def needles():
    """Lines of 1 : 10000, in all directions."""
    return random_scene(300).with_activated(scales=torch.tensor([0.5, 5e-5, 5e-5]).repeat(300, 1))


def huge_and_near():
    """Splats larger than the picture just behind the near plane, in front of a random scene."""
    scene = random_scene(300)
    near = torch.arange(8)
    scene.means[near] = torch.tensor([0.0, 0.0, -0.15]) + 0.05 * torch.randn(8, 3, generator=torch.Generator())
    scene.means[near, 2] = -0.15 + 0.02 * near  # the camera is at -0.4
    scene.log_scales[near] = math.log(2.0)
    scene.logit_opacities[near] = math.log(0.2 / 0.8)
    return scene


def equal_depths():
    """Opaque splats in four planes that face the camera of `facing`: the order of the input decides."""
    scene = random_scene(1200)
    scene.means[:, 2] = 3 + scene.means[:, 2].floor() % 4
    scene.logit_opacities[:] = math.log(0.9 / 0.1)
    return scene


def facing():
    return io.View("facing", 160, 120, 150.0, 150.0, torch.eye(4, dtype=torch.float64))


def off_centre():
    return replace(turned_view(cx=101.5, cy=43.25), name="off centre")


HARD = {
    "needles": (needles, turned_view),
    "huge": (huge_and_near, turned_view),
    "equal": (equal_depths, facing),
    "off centre": (random_scene, off_centre),
    "degree 0": (lambda: random_scene(degree=0), turned_view),
    "degree 1": (lambda: random_scene(degree=1), turned_view),
    "degree 2": (lambda: random_scene(degree=2), turned_view),
    "one": (lambda: random_scene(count=1), facing),
}
"""Scenes that are hard to draw, and views of them."""
