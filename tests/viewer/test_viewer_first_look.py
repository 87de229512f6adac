"""What a person sees who opens the page for the first time: what is awaited, what is drawn, and what a file does."""

import base64

import pytest
from chromium import WEBGL_FLAGS, facing, launch, open_page, settle, wait_for, wait_for_frame
from pages import random_scene, serve

from analytic_rasterizer import io, viewer

RECORD = """
  window.said = [];
  new MutationObserver(() => {
    const loading = document.getElementById('loading'), text = document.getElementById('loading-text');
    if (loading && !loading.hidden && text && said.at(-1) !== text.textContent) said.push(text.textContent);
  }).observe(document, { subtree: true, childList: true, characterData: true });"""
"""Runs before the page: keeps what it said was awaited."""
AREA = """() => {
  const covered = [...document.querySelectorAll('#panel, #figures, #status, #loading')].map(element => {
    const box = element.getBoundingClientRect();
    return box.width * box.height;
  });
  return covered.reduce((sum, area) => sum + area, 0) / (innerWidth * innerHeight);
}"""
DROP = """([name, text]) => {
  const files = new DataTransfer();
  files.items.add(new File([Uint8Array.from(atob(text), c => c.charCodeAt(0))], name));
  const over = new DragEvent('dragover', { dataTransfer: files, bubbles: true, cancelable: true });
  document.getElementById('surface').dispatchEvent(over);
  const dropped = new DragEvent('drop', { dataTransfer: files, bubbles: true, cancelable: true });
  setTimeout(() => document.getElementById('surface').dispatchEvent(dropped), 200);  // it may end this page
  return over.defaultPrevented;
}"""
"""Drops a file, of a name and content in base64, a little later. Whether the browser may be given it at all."""


@pytest.fixture(scope="module")
def browser():
    with launch(WEBGL_FLAGS) as launched:
        yield launched


@pytest.mark.gate
def test_the_page_says_what_it_waits_for_until_there_is_a_picture(browser):
    with serve(random_scene(100), [facing()]) as server, open_page(browser, server.url, init=RECORD) as page:
        wait_for_frame(page)
        settle(page)
        assert page.is_hidden("#loading")
        said = page.evaluate("() => said")
        assert said[0] == "Loading the scene" and "Loading the scene: 100%" in said
        assert said[-2:] == ["Preparing to draw", "WebGL 2 draws"]


def test_an_exported_file_says_what_it_waits_for(browser, tmp_path):
    path = tmp_path / "scene.html"
    viewer.export_page(path, viewer.pack_scene(random_scene(100), [facing()]))
    with open_page(browser, path.as_uri(), offline=True, init=RECORD) as page:
        wait_for_frame(page)
        assert "Loading the scene: 50%" in page.evaluate("() => said")
        assert page.is_hidden("#loading")


def test_a_failure_takes_the_place_of_what_is_awaited(browser):
    init = "HTMLCanvasElement.prototype.getContext = () => null"
    with serve(random_scene(10), [facing()]) as server, open_page(browser, server.url, init=init) as page:
        page.wait_for_selector("#message p")
        assert page.is_hidden("#loading")


@pytest.mark.gate
def test_the_page_says_plainly_which_footprint_is_drawn(browser):
    with (
        serve(random_scene(50), [facing()], footprint="moment:samples=4") as server,
        open_page(browser, server.url, size=(1000, 700)) as page,
    ):
        wait_for_frame(page)
        told = "Drawn: box:samples=1. WebGL 2 cannot draw moment:samples=4."
        assert page.inner_text("#drawn") == told and page.inner_text("#figures").startswith("box:samples=1, 1000 x 700")
        page.keyboard.press("1")
        wait_for(page, "() => document.getElementById('figures').textContent.startsWith('point, ')")
        assert page.is_hidden("#drawn")
        page.keyboard.press("c")
        wait_for(page, "() => document.getElementById('figures').textContent.startsWith('point | analytic, ')")
        page.select_option("#compare", "point")
        assert page.is_hidden("#drawn")


@pytest.mark.gate
@pytest.mark.parametrize(
    "size, most",
    [((1280, 720), 0.3), ((800, 450), 0.28), ((480, 800), 0.1), ((320, 240), 0.25), ((320, 120), 0.2)]
    + [((120, 90), 0.35)],
)
def test_the_controls_leave_most_of_the_scene_free(browser, size, most):
    with (
        serve(random_scene(50), [facing()], footprint="moment:samples=4") as server,
        open_page(browser, server.url, size=size) as page,
    ):
        wait_for_frame(page)
        settle(page)
        assert page.evaluate(AREA) < most
        assert page.is_visible("#fold")
        assert page.is_visible("#footprint") == (size[0] > 480 and size[1] > 360)
        outside = page.evaluate(
            """() => [...document.querySelectorAll('#panel, #figures')].map(e => e.getBoundingClientRect()).filter(
                 box => box.left < 0 || box.top < 0 || box.right > innerWidth || box.bottom > innerHeight).length"""
        )
        assert outside == 0


def test_the_controls_fold_where_the_window_becomes_small(browser):
    with serve(random_scene(10), [facing()]) as server, open_page(browser, server.url, size=(800, 450)) as page:
        wait_for_frame(page)
        for size, shown in (((480, 450), False), ((800, 450), True), ((800, 360), False), ((800, 450), True)):
            page.set_viewport_size(dict(zip(("width", "height"), size)))
            wait_for(page, f"() => document.body.classList.contains('folded') === {str(not shown).lower()}")


@pytest.mark.gate
def test_the_key_of_the_help_closes_it_too(browser):
    with serve(random_scene(10), [facing()]) as server, open_page(browser, server.url) as page:
        wait_for_frame(page)
        for is_open in (True, False, True, False):
            page.keyboard.press("?")
            assert page.evaluate("() => document.getElementById('help').open") == is_open


# ------------------------------------------------------------------------------ dropped files


@pytest.fixture
def drop(browser):
    """A page, and a function that drops a file with some content."""

    def opens(path):
        return viewer.pack_scene(io.load_scene(path), [], name=path.name)

    with (
        serve(random_scene(50), [facing()], name="first.ply", opens=opens) as server,
        open_page(browser, server.url) as page,
    ):
        wait_for_frame(page)
        yield page, lambda name, data: page.evaluate(DROP, [name, base64.b64encode(data).decode()])


@pytest.mark.gate
def test_a_dropped_file_opens(drop, tmp_path):
    page, dropped = drop
    io.save_scene(tmp_path / "other.ply", random_scene(70, degree=1))
    with page.expect_event("load"):
        assert dropped("other.ply", (tmp_path / "other.ply").read_bytes())
    wait_for_frame(page)
    assert page.inner_text("#scene-name") == "other.ply"
    assert page.inner_text("#scene-facts") == "70 Gaussians, spherical harmonics of degree 1"


def test_a_dropped_file_that_is_no_scene_is_a_sentence(drop):
    page, dropped = drop
    page.complaints.clear()
    assert dropped("notes.ply", b"Dear diary")
    wait_for(page, "() => document.getElementById('status').textContent.startsWith('notes.ply: ')")
    assert page.is_hidden("#loading") and page.inner_text("#scene-name") == "first.ply"
    page.complaints.clear()  # the browser's own of an answer that is no success


def test_an_exported_file_says_who_opens_files(browser, tmp_path):
    path = tmp_path / "scene.html"
    viewer.export_page(path, viewer.pack_scene(random_scene(20), [facing()]))
    with open_page(browser, path.as_uri(), offline=True) as page:
        wait_for_frame(page)
        assert page.evaluate(DROP, ["a.ply", ""])
        wait_for(page, "() => document.getElementById('status').textContent.includes('view FILE opens another')")
