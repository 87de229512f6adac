"""The viewer in a browser without WebGPU: pictures against the CPU rasterizer, and what users do with the page.

Skipped where chromium or playwright is missing; `make test-browser` installs both. The browser draws in software, so
that no graphics device is needed.
"""

import base64
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import torch
from chromium import (
    HARD,
    WEBGL_FLAGS,
    check_photographs,
    drawn,
    facing,
    launch,
    off_centre,
    open_page,
    page_of,
    pixels,
    screenshot,
    settle,
    wait_for,
    wait_for_frame,
    wait_until_ready,
)
from gaussians import of_inputs
from pages import (
    LARGEST,
    PATIENCE,
    REDUCTIONS,
    ROOT_MEAN_SQUARE_OF_HALVES,
    WEBGL_FOOTPRINTS,
    assert_same,
    export_rounded,
    random_scene,
    rendered,
    serve,
    turned_view,
)
from places import SHARED

import analytic_rasterizer as ar
import demo
from analytic_rasterizer import io, viewer

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: make test-browser")


@pytest.fixture(scope="module")
def browser():
    with launch(WEBGL_FLAGS) as launched:
        yield launched


# ----------------------------------------------------------------------------------- pictures


@pytest.fixture(scope="module")
def demo_page(browser):
    scene, view = demo.make_target()
    with page_of(browser, scene, view, "?view=0&size=16x16", background=demo.PAPER) as page:
        yield page, scene, view


@pytest.fixture(scope="module")
def random_page(browser):
    scene, view = random_scene(), turned_view()
    with page_of(browser, scene, view, "?view=0&size=16x16") as page:
        yield page, scene, view


@pytest.mark.parametrize("reduction", (1, 2, 4, 8))
@pytest.mark.parametrize("footprint", WEBGL_FOOTPRINTS)
def test_demo(demo_page, footprint, reduction):
    page, scene, view = demo_page
    view = view.scaled(1 / reduction)
    ours = drawn(page, footprint, view.width, view.height)
    assert_same(ours, rendered(scene, view, footprint, demo.PAPER))


@pytest.mark.parametrize("reduction", REDUCTIONS)
@pytest.mark.parametrize("footprint", [*WEBGL_FOOTPRINTS, "point:dilation=0.05", "mip:variance=0.3"])
def test_random_scene(random_page, footprint, reduction):
    page, scene, view = random_page
    view = view.scaled(1 / reduction)
    ours = drawn(page, footprint, view.width, view.height)
    assert_same(ours, rendered(scene, view, footprint))


@pytest.mark.parametrize("case", HARD)
def test_hard_scenes(browser, case):
    make_scene, make_view = HARD[case]
    scene, view = make_scene(), make_view()
    with page_of(browser, scene, view) as page:
        assert np.array_equal(pixels(page, view.width, view.height), drawn(page, "analytic", view.width, view.height))
        for footprint in ("point", "analytic", "box:samples=1"):
            assert_same(drawn(page, footprint, view.width, view.height), rendered(scene, view, footprint))


def test_several_views(browser):
    scene, views = random_scene(500), [facing(), turned_view()]
    with page_of(browser, scene, views, "?view=1&footprint=mip") as page:
        assert_same(pixels(page, 160, 120), rendered(scene, views[1], "mip"))
        assert_same(drawn(page, "mip", 160, 120, view=0), rendered(scene, views[0], "mip"))


@pytest.mark.parametrize("name", ["plant_sh3"])
def test_trained_scene(browser, name, request):
    if not (SHARED / "data" / f"{name}.npz").exists():
        pytest.skip("needs the optional ../shared scenes next to the project")
    inputs, cameras = request.getfixturevalue("plant")
    scene = of_inputs(inputs)
    camera = cameras[0]
    w2c = torch.tensor(camera["w2c"], dtype=torch.float64).reshape(4, 4)
    view = io.View("trained", camera["width"], camera["height"], camera["fx"], camera["fy"], w2c).scaled(0.5)
    with page_of(browser, scene, view, "?view=0&footprint=analytic") as page:
        error = np.abs(pixels(page, view.width, view.height) - rendered(scene, view, "analytic"))
        assert 255 * np.quantile(error, 0.9999) <= 2


def without(extension):
    """Runs before the page: the device lacks an extension of WebGL."""
    return f"""
      const original = WebGL2RenderingContext.prototype.getExtension;
      WebGL2RenderingContext.prototype.getExtension = function (name) {{
        return name === '{extension}' ? null : original.call(this, name);
      }};"""


@pytest.mark.parametrize("footprint", ["point", "analytic"])
def test_half_floats_are_a_fallback(browser, footprint):
    scene, view = random_scene(), turned_view()
    init = without("EXT_float_blend")
    with page_of(browser, scene, view, of_page={"init": init}) as page:
        ours = drawn(page, footprint, view.width, view.height)
        assert np.array_equal(ours, ours.astype(np.float16))
        assert_same(ours, rendered(scene, view, footprint), rms=ROOT_MEAN_SQUARE_OF_HALVES)


def test_a_device_that_draws_no_floats_is_a_sentence(browser):
    init = without("EXT_color_buffer_float")
    with serve(random_scene(10), [facing()]) as server, open_page(browser, server.url, init=init) as page:
        page.wait_for_selector("#message p")
        assert "needs WebGPU, or WebGL 2 that draws into floats" in page.inner_text("#message")


def test_photographs_are_beside_the_pictures_of_their_views(browser):
    check_photographs(browser)


def test_what_the_screen_shows_is_the_picture(browser):
    scene, view = random_scene(500), facing()
    with page_of(browser, scene, view, "?view=0&footprint=mip") as page:
        shown = page.evaluate(
            """async () => {
              await analyticRender(0, 'mip', 160, 120);
              return canvas.toDataURL();
            }"""
        )
        image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
        png = np.asarray(image.open(BytesIO(base64.b64decode(shown.split(",")[1]))).convert("RGB"))
        expected = rendered(scene, view, "mip").clip(0, 1).transpose(1, 2, 0)
        assert np.abs(png - 255 * expected).max() <= LARGEST + 0.5


# ------------------------------------------------------------------------------ exported file


@pytest.mark.gate
def test_a_compressed_file_is_near_without_network(browser, tmp_path):
    scene, view = random_scene(500), turned_view()
    path = tmp_path / "a scene.html"
    rounded = export_rounded(path, scene, view, footprint="mip")
    with open_page(browser, f"{path.as_uri()}?view=0", offline=True) as page:
        wait_until_ready(page)
        assert_same(pixels(page, view.width, view.height), rendered(rounded, view, "mip"))


@pytest.mark.gate
def test_an_exact_file_looks_the_same_without_network(browser, tmp_path):
    scene, view = random_scene(500), turned_view()
    path = tmp_path / "a scene.html"
    viewer.export_page(path, viewer.pack_scene(scene, [view], footprint="mip"), exact=True)
    with open_page(browser, f"{path.as_uri()}?view=0", offline=True) as page:
        wait_until_ready(page)
        exported = pixels(page, view.width, view.height)
    with page_of(browser, scene, view, footprint="mip") as page:
        assert np.array_equal(exported, pixels(page, view.width, view.height))
    assert_same(exported, rendered(scene, view, "mip"))
    with open_page(browser, path.as_uri(), offline=True) as page:
        wait_for_frame(page)
        assert page.inner_text("#scene-name") == "scene"
        page.keyboard.press("1")
        wait_for(page, "() => location.hash.includes('footprint=point')")


# ------------------------------------------------------------------------------- misfortunes


@pytest.mark.gate
def test_a_lost_context_comes_back(browser):
    scene, view = random_scene(500), turned_view()
    with page_of(browser, scene, view, "", wait_for_frame) as page:
        page.evaluate(
            """() => {
              window.loser = canvas.getContext('webgl2').getExtension('WEBGL_lose_context');
              window.back = new Promise(resolve => canvas.addEventListener('webglcontextrestored', resolve));
              loser.loseContext();
            }"""
        )
        wait_for(page, "() => document.getElementById('status').textContent.includes('taken away')")
        page.evaluate("() => { loser.restoreContext(); }")
        page.evaluate("() => back.then(() => null)")
        ours = drawn(page, "analytic", view.width, view.height)
        assert_same(ours, rendered(scene, view, "analytic"))
        assert page.is_hidden("#message")


def test_a_picture_whose_context_is_lost_is_drawn_again(browser):
    scene, view = random_scene(500), turned_view()
    with page_of(browser, scene, view, "?view=0&size=16x16") as page:
        said = page.evaluate(
            """async ([footprint, width, height]) => {
              const loser = canvas.getContext('webgl2').getExtension('WEBGL_lose_context');
              let said;
              canvas.addEventListener('webglcontextlost', () => {
                analyticPixels().catch(error => { said = error.message; });
                setTimeout(() => loser.restoreContext());
              });
              const drawn = analyticRender(0, footprint, width, height);
              loser.loseContext();  // while the order of the splats is waited for
              await drawn;
              return said;
            }""",
            ["mip", view.width, view.height],
        )
        assert said == "There is no picture: the graphics device was lost since."
        assert_same(pixels(page, view.width, view.height), rendered(scene, view, "mip"))
        assert page.is_hidden("#message")


def test_without_webgl_there_is_a_sentence(browser):
    init = "HTMLCanvasElement.prototype.getContext = () => null"
    with serve(random_scene(10), [facing()]) as server, open_page(browser, server.url, init=init) as page:
        page.wait_for_selector("#message p")
        assert "needs WebGPU or WebGL 2" in page.inner_text("#message")


def test_a_scene_too_large_for_the_device_is_a_sentence(browser):
    # The largest texture, as this device tells it, is made too small for any scene.
    init = """
      const original = WebGL2RenderingContext.prototype.getParameter;
      let asked = 0;
      WebGL2RenderingContext.prototype.getParameter = function (name) {
        return name === this.MAX_TEXTURE_SIZE && asked++ > 0 ? 12 : original.call(this, name);
      };"""
    with serve(random_scene(20), [facing()]) as server, open_page(browser, server.url, init=init) as page:
        page.wait_for_selector("#message p")
        assert page.inner_text("#message") == (
            "The scene has 20 Gaussians; this device can hold 12 of spherical harmonics of degree 3."
        )
        loaded = page.evaluate("() => performance.getEntriesByType('resource').map(({ name }) => name)")
        assert any("scene.json" in name for name in loaded) and not any("geometry.bin" in name for name in loaded)


def test_a_server_that_is_gone_is_a_sentence(browser):
    with serve(random_scene(10), [facing()]) as server:
        context = browser.new_context()
        page = context.new_page()
        page.route("**/geometry.bin", lambda route: route.abort())
        page.goto(server.url)
        page.wait_for_selector("#message p")
        assert "Is the command that serves it still running?" in page.inner_text("#message")
        context.close()


@pytest.mark.parametrize("query", ["view=2", "view=-1", "view=x", "view=0&footprint=exact", "view=0&size=0x10"])
def test_bad_requests_of_automation_are_a_sentence(browser, query):
    with serve(random_scene(10), [facing()]) as server, open_page(browser, f"{server.url}?{query}") as page:
        assert wait_for(page, "() => window.analyticError").endswith(".")
        assert page.is_visible("#message")


# ----------------------------------------------------------------------------------- controls


@pytest.fixture
def controls(browser):
    """A page for a user who prefers no motion, so that journeys end at once."""
    scene, views = random_scene(500), [facing(), turned_view(), off_centre()]
    still = {"reduced_motion": "reduce"}
    with page_of(browser, scene, views, "", wait_for_frame, still, name="room.ply") as page:
        page.keyboard.press("h")  # in windows as small as this one they are folded at first
        yield page


def address(page):
    return page.evaluate("() => Object.fromEntries(new URLSearchParams(location.hash.slice(1)))")


def pose(page):
    text = wait_for(page, "() => new URLSearchParams(location.hash.slice(1)).get('camera')")
    return np.array([float(x) for x in text.split(",")])


def changed_pose(page, act):
    """Pose after `act`, once the address shows it."""
    before = address(page).get("camera")
    act()
    # The address follows when the camera rests: where events come slowly, it has shown poses on the way.
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => setTimeout(done, 500)))")
    wait_for(
        page, f"() => new URLSearchParams(location.hash.slice(1)).get('camera') !== {before!r}".replace("None", "null")
    )
    return pose(page)


def test_the_page_names_the_scene(controls):
    assert controls.title().startswith("room.ply")
    assert controls.inner_text("#scene-facts") == "500 Gaussians, spherical harmonics of degree 3"
    names = controls.eval_on_selector_all("#view option", "all => all.map(option => option.text)")
    assert names == ["facing", "turned", "off centre"]


def test_nothing_is_drawn_at_rest(controls):
    settle(controls)
    controls.evaluate(
        """() => {
          window.frames_asked = 0;
          const original = window.requestAnimationFrame;
          window.requestAnimationFrame = f => { ++window.frames_asked; return original.call(window, f); };
        }"""
    )
    controls.wait_for_timeout(500)
    assert controls.evaluate("() => frames_asked") == 0
    controls.keyboard.press("2")
    wait_for(controls, "() => frames_asked > 0")


@pytest.mark.gate
def test_keys_choose_footprints_comparison_and_resolution(controls):
    controls.keyboard.press("1")
    assert controls.input_value("#footprint") == "point"
    controls.keyboard.press("c")
    assert controls.input_value("#compare") == "analytic"
    assert controls.is_visible("#divider") and controls.is_hidden("#legend")
    controls.keyboard.press("c")
    assert controls.is_hidden("#divider") and controls.is_visible("#legend")
    controls.keyboard.press("c")
    assert controls.input_value("#compare") == ""
    for text in ("1/2", "1/4", "1/8", "1"):
        controls.keyboard.press("z")
        assert controls.inner_text("#resolution-text") == text


def test_fields_work_like_keys(controls):
    controls.select_option("#footprint", "box:samples=1")
    controls.select_option("#compare", "mip")
    controls.check("input[value=difference]")
    controls.fill("#resolution", "2")
    wait_for(controls, "() => location.hash.includes('reduce=4')")
    found = address(controls)
    assert (found["footprint"], found["compare"], found["mode"]) == ("box:samples=1", "mip", "difference")


def test_the_divider_moves_by_keys_and_mouse(controls):
    controls.keyboard.press("c")
    controls.focus("#divider")
    for key, value in (("ArrowRight", 52), ("Shift+ArrowLeft", 42), ("Home", 0), ("End", 100), ("ArrowLeft", 98)):
        controls.keyboard.press(key)
        assert controls.get_attribute("#divider", "aria-valuenow") == str(value)
    controls.mouse.move(0.98 * 320, 30)
    controls.mouse.down()
    controls.mouse.move(160, 30, steps=3)
    controls.mouse.up()
    assert controls.get_attribute("#divider", "aria-valuenow") == "50"


def test_views(controls):
    controls.keyboard.press(".")
    assert controls.input_value("#view") == "1"
    wait_for(controls, "() => location.hash.includes('view=1')")
    controls.keyboard.press(",")
    controls.keyboard.press(",")
    assert controls.input_value("#view") == "2"
    controls.click("#next")
    assert controls.input_value("#view") == "0"
    controls.select_option("#view", "1")
    wait_for(controls, "() => location.hash.includes('view=1')")


@pytest.mark.gate
def test_the_page_says_where_a_view_is_shown_without_its_lens(browser):
    views = [facing(), replace(turned_view(), lens=ar.Lens.fisheye((0.05,)))]
    with page_of(browser, random_scene(50), views, "", wait_for_frame, of_page={"reduced_motion": "reduce"}) as page:
        assert page.is_hidden("#note")
        page.keyboard.press(".")
        assert page.text_content("#note") == "This view is shown without its lens."


def test_the_mouse_turns_moves_and_zooms(controls):
    def drag(button="left"):
        controls.mouse.move(300, 40)
        controls.mouse.down(button=button)
        controls.mouse.move(270, 60, steps=4)
        controls.mouse.up(button=button)

    forward = np.array([0, 0, 1.0])
    turned = changed_pose(controls, drag)
    distance = turned[7]
    # An orbit keeps the target, which was straight ahead.
    w, x, y, z = turned[3:7]
    looks = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(turned[:3] + distance * looks, distance * forward, atol=1e-4 * distance)
    assert np.abs(turned[:3]).max() > 0.05 * distance
    moved = changed_pose(controls, lambda: drag("right"))
    np.testing.assert_allclose(moved[3:], turned[3:], atol=1e-6)
    assert np.abs(moved[:3] - turned[:3]).max() > 0.01 * distance
    near = changed_pose(controls, lambda: controls.mouse.wheel(0, -200))
    assert near[7] < distance
    np.testing.assert_allclose(near[3:7], moved[3:7], atol=1e-6)


def test_dragging_turns_the_scene_the_way_of_the_mouse(controls):
    controls.mouse.move(250, 40)
    controls.mouse.down()
    after = changed_pose(controls, lambda: controls.mouse.move(280, 40, steps=2))
    controls.mouse.up()
    # The camera starts at the origin and looks along z: what turns to the right is seen from further left.
    assert after[0] < 0
    assert abs(after[1]) < 1e-6


def test_keys_fly_and_reset(controls):
    def fly():
        controls.keyboard.down("w")
        controls.wait_for_timeout(300)
        controls.keyboard.up("w")

    ahead = changed_pose(controls, fly)
    assert ahead[2] > 0 and np.abs(ahead[:2]).max() < 1e-6
    controls.keyboard.press("r")
    wait_for(controls, "() => !location.hash.includes('camera=')")
    turned = changed_pose(controls, lambda: controls.keyboard.press("ArrowLeft"))
    assert np.abs(turned[3:7] - [1, 0, 0, 0]).max() > 0.01
    closer = changed_pose(controls, lambda: controls.keyboard.press("+"))
    assert closer[7] == pytest.approx(0.9 * turned[7], rel=1e-5)


def test_a_double_click_focuses_what_is_there(controls):
    after = changed_pose(controls, lambda: controls.mouse.dblclick(250, 60))
    np.testing.assert_allclose(after[:3], 0, atol=1e-6)  # the camera turns where it is
    w, x, y, z = after[3:7]
    looks = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    # The view has 160 x 120 pixels of focal length 150; the page is twice as large.
    ray = np.array([(250 - 160) / 300, (60 - 120) / 300, 1])
    np.testing.assert_allclose(looks, ray / np.linalg.norm(ray), atol=1e-4)
    assert 2 < after[7] < 12


def test_the_camera_travels_between_views(browser):
    views = [facing(), turned_view()]
    with page_of(browser, random_scene(100), views, "", wait_for_frame) as page:
        page.keyboard.press(".")
        # At the end it is at the view exactly: the address needs no pose.
        wait_for(page, "() => location.hash.includes('view=1') && !location.hash.includes('camera=')")


def test_two_fingers_zoom(browser):
    with page_of(browser, random_scene(100), facing(), "", wait_for_frame, of_page={"has_touch": True}) as page:
        touch = page.context.new_cdp_session(page)

        def fingers(kind, *places):
            points = [{"x": x, "y": 40, "id": i} for i, x in enumerate(places)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        def pinch():
            fingers("touchStart", 140)
            fingers("touchStart", 140, 180)
            for spread in (30, 40):
                fingers("touchMove", 160 - spread, 160 + spread)
            fingers("touchEnd")

        near = changed_pose(page, pinch)
        # The fingers end twice as far apart as they began, about the same middle.
        assert near[2] > 0
        np.testing.assert_allclose(near[3:7], [1, 0, 0, 0], atol=1e-6)
        np.testing.assert_allclose(near[7] + near[2], 2 * near[7], rtol=1e-5)


def test_the_wheel_never_loses_the_scene(controls):
    near = changed_pose(controls, lambda: [controls.mouse.wheel(0, -1000) for _ in range(15)])
    assert near[7] == pytest.approx(0.3)  # beyond the near plane
    far = changed_pose(controls, lambda: [controls.mouse.wheel(0, 1000) for _ in range(15)])
    radius = viewer.pack_scene(random_scene(500)).meta["radius"]
    assert far[7] == pytest.approx(30 * radius, rel=1e-5)


def test_the_background_can_be_chosen(controls):
    controls.fill("#background", "#3060c0")
    wait_for(controls, "() => location.hash.includes('background=3060c0')")
    controls.keyboard.press("h")
    shown = screenshot(controls)
    assert (shown == [0x30, 0x60, 0xC0]).all(axis=2).any()


def test_the_address_brings_back_pose_and_state(browser):
    with serve(random_scene(200), [facing()]) as server:
        state = "#view=0&camera=0.1,0.2,-0.3,0.9950042,0,0.0998334,0,4&footprint=mip&compare=point&mode=split&reduce=2"
        with open_page(browser, server.url + state) as page:
            wait_for_frame(page)
            assert page.input_value("#footprint") == "mip"
            assert page.input_value("#compare") == "point"
            assert page.inner_text("#resolution-text") == "1/2"
            page.keyboard.press("3")
            wait_for(page, "() => location.hash.includes('footprint=analytic')")
            np.testing.assert_allclose(pose(page), [0.1, 0.2, -0.3, 0.9950042, 0, 0.0998334, 0, 4], atol=1e-6)
        with open_page(browser, f"{server.url}#camera=1,2&footprint=nothing&view=9&reduce=3") as page:
            wait_for_frame(page)
            assert page.input_value("#footprint") == "analytic"


@pytest.mark.gate
def test_help_opens_and_closes_by_keys(controls):
    controls.keyboard.press("?")
    assert controls.evaluate("() => document.getElementById('help').open")
    controls.keyboard.press("Escape")
    assert not controls.evaluate("() => document.getElementById('help').open")


@pytest.mark.gate
def test_a_key_folds_and_unfolds_the_controls(controls):
    def unfolded():
        assert (controls.get_attribute("#fold", "aria-expanded") == "true") == controls.is_visible("#footprint")
        return controls.is_visible("#footprint")

    assert unfolded()
    controls.keyboard.press("h")
    assert not unfolded()
    # Until the next frame a closed dialog may still have the focus: it keeps no keys.
    controls.evaluate(
        "() => document.querySelector('#help button')"
        ".dispatchEvent(new KeyboardEvent('keydown', { key: 'h', bubbles: true }))"
    )
    assert unfolded()


def test_on_a_phone_the_controls_leave_the_scene_free(browser):
    phone = {"has_touch": True, "is_mobile": True}
    with page_of(browser, random_scene(100), facing(), "", wait_for_frame, of_page=phone) as page:
        assert page.is_hidden("#footprint")
        page.tap("#fold")
        assert page.is_visible("#footprint")
        left, right = page.evaluate(
            """() => {
              const panel = document.getElementById('panel').getBoundingClientRect();
              return [panel.left, innerWidth - panel.right];
            }"""
        )
        assert left == right >= 0


@pytest.mark.parametrize("width, height", [(360, 640), (320, 240), (641, 360), (844, 390), (1280, 720)])
def test_nothing_covers_the_handle_of_the_divider(controls, width, height):
    controls.set_viewport_size({"width": width, "height": height})
    if controls.is_hidden("#footprint"):
        controls.keyboard.press("h")
    controls.keyboard.press("c")
    assert controls.is_visible("#compare-options")  # the panel is as high as it gets
    corners = controls.evaluate(
        """() => {
          const divider = document.getElementById('divider'), box = divider.getBoundingClientRect();
          const handle = getComputedStyle(divider, '::after');
          const [left, top, width, height] = ['left', 'top', 'width', 'height'].map(k => parseFloat(handle[k]));
          const x = box.left + left, y = box.top + top + parseFloat(handle.marginTop);
          const at = [[1, 1], [width - 1, 1], [1, height - 1], [width - 1, height - 1]];
          return at.map(([dx, dy]) => [x + dx, y + dy, document.elementFromPoint(x + dx, y + dy).id]);
        }"""
    )
    (x, y, _), (x_end, _, _), (_, y_end, _), _ = corners
    assert x < width / 2 < x_end and 0 < y < y_end < height
    assert [name for *_, name in corners] == ["divider"] * 4


def test_a_screenshot_is_saved(controls):
    with controls.expect_download() as download:
        controls.keyboard.press("p")
    assert download.value.suggested_filename == "room_analytic.png"
    with open(download.value.path(), "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"


def test_side_by_side_shows_both(controls):
    def picture():
        return screenshot(controls)[50:100]  # without names and controls

    controls.keyboard.press("h")
    controls.keyboard.press("1")
    point = picture()
    controls.keyboard.press("3")
    analytic = picture()
    assert (point[:, 200:] != analytic[:, 200:]).any() and (point[:, :120] != analytic[:, :120]).any()
    controls.keyboard.press("1")
    controls.keyboard.press("c")
    both = picture()
    # Away from the divider in the middle.
    assert (both[:, :120] == point[:, :120]).all()
    assert (both[:, 200:] == analytic[:, 200:]).all()
    controls.keyboard.press("c")
    difference = picture()
    darkest = difference[(point == analytic).all(axis=2)]
    assert len(darkest) > 0 and darkest.max() <= 32  # the first colour of the map


def test_every_control_has_a_name(controls):
    nameless = controls.evaluate(
        """() => [...document.querySelectorAll('button, select, input, [tabindex], [role=slider]')].filter(e =>
             !(e.labels?.length || e.getAttribute('aria-label') || e.textContent.trim())).map(e => e.outerHTML)"""
    )
    assert nameless == []


@pytest.mark.gate
@pytest.mark.parametrize("state", ["plain", "comparing", "help"])
def test_axe_finds_nothing(controls, state):
    axe = pytest.importorskip("axe_core_python.sync_playwright", reason="needs axe-core-python: make test-browser")
    controls.keyboard.press({"plain": "2", "comparing": "c", "help": "?"}[state])
    found = axe.Axe().run(controls)["violations"]
    assert [(v["id"], [node["html"] for node in v["nodes"]]) for v in found] == []


def test_the_order_is_that_of_a_stable_sort(browser):
    depths = np.random.default_rng(0).choice(np.linspace(0.1, 50, 997), 20000).astype(np.float32)
    means = np.zeros((20000, 12), np.float32)
    means[:, 2] = depths
    with page_of(browser, random_scene(10), facing(), "", wait_for_frame) as page:
        script = """async text => {
          const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
          const worker = new Worker('sort.js');
          worker.postMessage({ geometry: new Float32Array(bytes.buffer), count: 20000 });
          const answer = await new Promise(resolve => {
            worker.onmessage = ({ data }) => resolve(data);
            worker.postMessage({ row: Float32Array.of(0, 0, 1, 0), near: 0.2 });
          });
          worker.terminate();
          return [...answer.order];
        }"""
        text = base64.b64encode(means.tobytes()).decode()
        order = np.array(page.evaluate(script, text))
    expected = np.argsort(depths, kind="stable")
    expected = expected[depths[expected] > np.float32(0.2)][::-1]
    np.testing.assert_array_equal(order, expected)


# ---------------------------------------------------------------------------------- live viewer


@pytest.mark.gate
def test_a_frame_of_the_live_viewer_arrives(browser):
    pytest.importorskip("viser", reason="needs the view extra: make test-browser")
    image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
    scene, view = random_scene(500), replace(facing(), width=640, height=360, fx=500.0, fy=500.0)
    expected = 255 * rendered(scene, view, "moment:samples=4").clip(0, 1).transpose(1, 2, 0)
    with viewer.LiveViewer(views=[view], footprint="moment:samples=4") as live:
        live.update(scene)
        context = browser.new_context(viewport={"width": view.width, "height": view.height})
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        addresses = []
        page.on("request", lambda request: addresses.append(request.url))
        page.goto(live.url)

        def error():
            """Away from the controls of viser, on the right, and from its messages, above."""
            shown = np.asarray(image.open(BytesIO(page.screenshot(type="png"))).convert("RGB"))
            return np.abs(shown - expected)[250:, :300]

        for _ in range(PATIENCE):
            page.wait_for_timeout(1000)
            if error().max() <= LARGEST + 0.5:
                break
        assert error().max() <= LARGEST + 0.5
        assert all(address.startswith((live.url, "data:", "blob:")) for address in addresses), addresses
        context.close()
