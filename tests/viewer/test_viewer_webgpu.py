"""The viewer with WebGPU in a real browser: pictures against the CPU rasterizer, and what may go wrong with a device.

Skipped where chromium or playwright is missing (`make test-browser` installs both), or chromium has no WebGPU in
software.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from chromium import (
    HARD,
    WEBGPU_FLAGS,
    check_photographs,
    drawn,
    facing,
    launch,
    open_page,
    page_of,
    pixels,
    screenshot,
    settle,
    wait_for,
    wait_for_frame,
    wait_until_ready,
)
from pages import assert_same, export_rounded, random_scene, rendered, serve, turned_view

import demo
from analytic_rasterizer import viewer
from analytic_rasterizer.gaussians import Gaussians

ADAPTER = "async () => (await navigator.gpu?.requestAdapter())?.info.isFallbackAdapter ?? null"
DEVICES = """
  window.devices = [];
  const { requestDevice } = GPUAdapter.prototype;
  GPUAdapter.prototype.requestDevice = async function (...given) {
    window.devices.push(await requestDevice.apply(this, given));
    return window.devices.at(-1);
  };"""
"""Runs before the page: keeps the devices that it asks for, which `destroy` of one takes away from it."""


@pytest.fixture(scope="module")
def browser():
    with launch(WEBGPU_FLAGS) as launched:
        with serve(random_scene(10), [facing()]) as server, open_page(launched, server.url) as page:
            adapter = page.evaluate(ADAPTER)
        if adapter is None:
            pytest.skip("needs a chromium that has WebGPU in software")
        yield launched


def open_gpu(browser, server, query="", **options):
    """A page that draws with WebGPU although the device is only software."""
    return open_page(browser, f"{server.url}?renderer=webgpu{query}", **options)


def gpu_page_of(browser, scene, views, query="", *given, **options):
    return page_of(browser, scene, views, f"?renderer=webgpu{query}", *given, **options)


def small(view, size=96):
    return view.scaled(size / view.width)


@pytest.fixture(scope="module")
def settled(browser):
    scene, view, background = random_scene(), small(turned_view()), (0.2, 0.3, 0.4)
    with gpu_page_of(browser, scene, view, "&view=0&size=16x16", background=background) as page:
        yield page, scene, view, background


# ----------------------------------------------------------------------------------- pictures


GATE = ("analytic", "moment:samples=4")


@pytest.mark.parametrize(
    "footprint",
    [
        pytest.param(name, marks=pytest.mark.gate if name in GATE else ())
        for name in (*viewer.PAGE_FOOTPRINTS, "point:dilation=0.05", "mip:variance=0.3")
    ],
)
def test_pictures(settled, footprint):
    page, scene, view, background = settled
    ours = drawn(page, footprint, view.width, view.height)
    assert_same(ours, rendered(scene, view, footprint, background))
    # Tiles at the border of a picture of another size are cut off.
    other = view.scaled(1 / 3)
    assert_same(drawn(page, footprint, other.width, other.height), rendered(scene, other, footprint, background))


HARD_AND_DEMO = HARD | {"demo": (lambda: demo.make_target()[0], lambda: demo.make_target()[1])}


@pytest.mark.parametrize("case", HARD_AND_DEMO)
def test_hard_scenes(browser, case):
    make_scene, make_view = HARD_AND_DEMO[case]
    scene, view = make_scene(), small(make_view())
    with gpu_page_of(browser, scene, view, "&view=0&footprint=analytic") as page:
        assert_same(pixels(page, view.width, view.height), rendered(scene, view, "analytic"))
        ours = drawn(page, "moment:samples=4", view.width, view.height)
        assert_same(ours, rendered(scene, view, "moment:samples=4"))
        assert np.array_equal(ours, drawn(page, "moment:samples=4", view.width, view.height))


def wide_splats():
    """Faint Gaussians as large as the picture: more pairs of splat and tile than the page makes room for at first."""
    scene = random_scene(500).with_activated(scales=torch.full((500, 3), 4.0))
    scene.logit_opacities[:] = -4.0
    return scene


@pytest.mark.parametrize("most", [None, 4 * 70_000])
def test_pairs_beyond_the_room_lose_no_picture(browser, most):
    """The room grows; where the device has no more (`most` bytes of a binding), the picture is drawn in parts."""
    scene, view = wide_splats(), small(facing(), 120)
    init = f"""Object.defineProperty(
      GPUSupportedLimits.prototype, 'maxStorageBufferBindingSize', {{ get: () => {most} }})"""
    with serve(scene, [view]) as server, open_gpu(browser, server, "&view=0", init=init if most else None) as page:
        wait_until_ready(page)
        first = drawn(page, "box:samples=1", view.width, view.height)
        assert_same(first, rendered(scene, view, "box:samples=1"))
        assert np.array_equal(first, drawn(page, "box:samples=1", view.width, view.height))


def unpacked(scene):
    """A scene as a compact one tells it."""
    packed = viewer.pack_scene(scene, compact=True)
    geometry = np.frombuffer(packed.geometry, "<u4").reshape(-1, 6).copy()
    assert np.array_equal(geometry[:, :3].view("f4"), scene.means.numpy())
    halves, turn = geometry[:, 3:5].copy().view("f2").astype("f4"), geometry[:, 5]
    largest, rows = (turn >> 30).astype(int), np.arange(len(turn))
    others = np.stack([turn >> 10 * k & 1023 for k in range(3)], 1) / 511 - 1
    quaternions = np.zeros((len(turn), 4))
    for k in range(3):
        quaternions[rows, (largest + 1 + k) % 4] = others[:, k] * 0.5**0.5
    quaternions[rows, largest] = np.sqrt(1 - (quaternions**2).sum(1))
    bytes_ = np.frombuffer(packed.harmonics, "u1").reshape(len(turn), -1)
    first = bytes_[:, :8].copy().view("<f2").astype("f4")
    used = 3 * ((scene.sh_degree + 1) ** 2 - 1)
    rest = bytes_[:, 8 : 8 + used].view("i1") / 127 * first[:, 3:]
    shs = torch.from_numpy(np.concatenate([first[:, :3], rest], 1)).float().reshape(len(turn), -1, 3)
    return Gaussians.from_activated(
        scene.means,
        torch.from_numpy(halves[:, :3] * packed.meta["compact"]),
        torch.from_numpy(quaternions).float(),
        torch.from_numpy(halves[:, 3:]),
        shs,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compact_scenes(browser, degree):
    scene, view = random_scene(500, degree=degree), small(turned_view())
    told = unpacked(scene)
    for name, atol in {"scales": 1e-4, "opacities": 1e-3, "shs": 2e-3}.items():
        assert torch.allclose(getattr(told, name), getattr(scene, name), atol=atol, rtol=1e-3), name
    turned = (told.rotations * torch.nn.functional.normalize(scene.rotations)).sum(1).abs()
    assert turned.min() > np.cos(0.003)  # radians of half of the angle
    with gpu_page_of(browser, scene, view, "&view=0&size=16x16", compact=True) as page:
        picture = drawn(page, "moment:samples=4", view.width, view.height)
    assert_same(picture, rendered(told, view, "moment:samples=4"))


def test_compact_scenes_need_webgpu(browser):
    init = "Object.defineProperty(GPUSupportedLimits.prototype, 'maxStorageBufferBindingSize', { get: () => 560 })"
    would = "A compact scene needs WebGPU. WebGL 2 would draw: "
    with serve(random_scene(11), [facing()], compact=True) as server:
        with open_page(browser, f"{server.url}?renderer=webgl") as page:
            wait_for(page, "() => window.analyticError")
            assert page.inner_text("#message") == f"{would}the address asks for it."
        with open_gpu(browser, server, init=init) as page:
            wait_for(page, "() => window.analyticError")
            assert page.inner_text("#message") == (
                f"{would}the scene has 11 Gaussians, and WebGPU on this device can hold 10 of spherical harmonics of "
                "degree 3."
            )


def test_a_compact_scene_has_places_to_focus_on(browser):
    still = {"reduced_motion": "reduce"}
    with gpu_page_of(browser, random_scene(300), facing(), "", wait_for_frame, still, compact=True) as page:
        page.mouse.dblclick(200, 60)
        wait_for(page, "() => location.hash.includes('camera=')")


# ----------------------------------------------------------------------------- which renderer


def test_a_scene_that_is_too_large_for_webgpu_is_drawn_without(browser):
    init = "Object.defineProperty(GPUSupportedLimits.prototype, 'maxStorageBufferBindingSize', { get: () => 960 })"
    with gpu_page_of(browser, random_scene(20), facing(), wait=wait_for_frame, of_page={"init": init}) as page:
        expected = (
            "WebGL 2 draws: the scene has 20 Gaussians, and WebGPU on this device can hold 10 of spherical harmonics "
            "of degree 3, or 17 with --compact. Footprints in grey need WebGPU."
        )
        assert page.text_content("#renderer") == expected


def test_a_device_that_is_only_software_is_not_taken_unasked(browser):
    with serve(random_scene(100), [facing()], footprint="moment") as server, open_page(browser, server.url) as page:
        wait_for_frame(page)
        assert page.text_content("#renderer").startswith("WebGL 2 draws: WebGPU would have no graphics device here.")
        assert page.text_content("#drawn") == "Drawn: box:samples=1. WebGL 2 cannot draw moment:samples=4."
    with gpu_page_of(browser, random_scene(100), facing(), wait=wait_for_frame) as page:
        assert page.text_content("#renderer") == "WebGPU draws."


@pytest.mark.gate
def test_a_lost_device_comes_back_once_and_then_webgl_draws(browser):
    scene, view = random_scene(500), facing()
    lose = "() => { const lost = devices.at(-1); lost.destroy(); return lost.lost.then(() => null); }"
    with gpu_page_of(browser, scene, view, wait=wait_for_frame, of_page={"init": DEVICES}, footprint="moment") as page:
        before = drawn(page, "moment:samples=4", view.width, view.height)
        assert_same(before, rendered(scene, view, "moment:samples=4"))
        page.evaluate(lose)
        assert np.array_equal(drawn(page, "moment:samples=4", view.width, view.height), before)
        assert page.evaluate("() => devices.length") == 2
        page.evaluate(lose)
        wait_for(page, "() => document.getElementById('renderer').textContent.startsWith('WebGL 2 draws: ')")
        assert "WebGPU lost the graphics device twice." in page.text_content("#renderer")
        assert_same(drawn(page, "analytic", view.width, view.height), rendered(scene, view, "analytic"))
        assert page.is_hidden("#message")


def test_where_webgpu_fails_webgl_draws(browser):
    init = """
      GPUDevice.prototype.createComputePipelineAsync = async () => { throw new Error('A shader is refused.'); };"""
    with gpu_page_of(browser, random_scene(100), facing(), wait=wait_for_frame, of_page={"init": init}) as page:
        expected = "WebGL 2 draws: WebGPU failed here. A shader is refused. Footprints in grey need WebGPU."
        assert page.text_content("#renderer") == expected
        assert page.is_hidden("#message")


NOTHING_COMPUTED = "GPUComputePassEncoder.prototype.dispatchWorkgroups = () => {};"
NOTHING_SHOWN = "GPURenderPassEncoder.prototype.draw = () => {};"


@pytest.mark.gate
@pytest.mark.parametrize(
    "broken, why",
    [(NOTHING_COMPUTED, "Its picture was empty where the scene is."), (NOTHING_SHOWN, "The page stayed black.")],
)
def test_where_webgpu_shows_black_webgl_draws(browser, broken, why):
    """The commands are accepted, and do nothing: that is no error to the browser."""
    scene = random_scene(200).with_activated(scales=torch.full((200, 3), 0.1))
    with serve(scene, [facing()]) as server, open_gpu(browser, server, init=broken) as page:
        wait_for_frame(page)
        wait_for(page, "() => document.getElementById('renderer').textContent.startsWith('WebGL 2 draws: ')")
        assert f"WebGPU failed here. {why}" in page.text_content("#renderer")
        wait_for(page, "() => document.getElementById('loading').hidden")
        assert page.is_hidden("#message")


def test_a_compact_scene_that_stays_black_is_a_sentence(browser):
    scene = random_scene(200).with_activated(scales=torch.full((200, 3), 0.1))
    with serve(scene, [facing()], compact=True) as server, open_gpu(browser, server, init=NOTHING_SHOWN) as page:
        page.wait_for_selector("#message p")
        assert page.inner_text("#message") == (
            "A compact scene needs WebGPU. WebGL 2 would draw: WebGPU failed here. The page stayed black."
        )


@pytest.mark.parametrize("scene", ["dark", "behind", "tiny"])
def test_what_is_black_by_right_stays_with_webgpu(browser, scene):
    made = random_scene(100).with_activated(scales=torch.full((100, 3), 1e-5 if scene == "tiny" else 0.1))
    if scene == "dark":
        made.shs[:] = 0
        made.shs[:, 0] = -2.0
    if scene == "behind":
        made.means[:, 2] = -made.means[:, 2]
    with serve(made, [facing()]) as server, open_gpu(browser, server) as page:
        wait_for_frame(page)
        settle(page)
        assert page.text_content("#renderer") == "WebGPU draws."


def test_the_page_says_that_shaders_compile(browser):
    init = """
      window.said = [];
      new MutationObserver(() => {
        const text = document.getElementById('loading-text')?.textContent;
        if (text && said.at(-1) !== text) said.push(text);
      }).observe(document, { subtree: true, childList: true, characterData: true });"""
    with serve(random_scene(50), [facing()]) as server, open_gpu(browser, server, init=init) as page:
        wait_for_frame(page)
        said = page.evaluate("() => said")
        assert "WebGPU compiles its shaders: 0%" in said and "WebGPU compiles its shaders: 100%" in said
        assert page.is_hidden("#loading")


def test_a_picture_whose_device_is_lost_is_drawn_again(browser):
    scene, view = random_scene(500), turned_view()
    query = "&view=0&size=16x16"
    with serve(scene, [view]) as server, open_gpu(browser, server, query, init=DEVICES) as page:
        wait_until_ready(page)
        page.evaluate(
            """async given => {
              const drawn = analyticRender(...given);
              devices[0].destroy();  // while the device is at work
              await drawn;
            }""",
            [0, "moment:samples=4", view.width, view.height],
        )
        assert page.evaluate("() => devices.length") == 2
        assert_same(pixels(page, view.width, view.height), rendered(scene, view, "moment:samples=4"))


# ----------------------------------------------------------------------------------- the page


@pytest.mark.gate
def test_an_exported_file_draws_moment_without_network(browser, tmp_path):
    scene, view = random_scene(500), facing()
    path = tmp_path / "scene.html"
    rounded = export_rounded(path, scene, view, footprint="moment")
    with open_page(browser, f"{path.as_uri()}?view=0&renderer=webgpu", offline=True) as page:
        wait_until_ready(page)
        assert_same(pixels(page, view.width, view.height), rendered(rounded, view, "moment:samples=4"))


@pytest.fixture
def controls(browser):
    """A page for a user who prefers no motion, so that journeys end at once."""
    scene, views = random_scene(300), [facing(), turned_view()]
    still = {"reduced_motion": "reduce"}
    with gpu_page_of(browser, scene, views, "", wait_for_frame, still, name="room.ply", footprint="moment") as page:
        yield page


def test_the_divider_and_the_heat_map_compare_any_two(controls):
    def picture():
        return screenshot(controls)[50:100]  # without names and controls

    moment = picture()
    controls.keyboard.press("c")
    assert controls.text_content("#label-right") == "point"
    both = picture()
    controls.keyboard.press("c")
    difference = picture()
    controls.keyboard.press("c")
    controls.keyboard.press("1")
    point = picture()
    assert (both[:, :120] == moment[:, :120]).all() and (both[:, 200:] == point[:, 200:]).all()
    assert (moment[:, :120] != point[:, :120]).any() and (moment[:, 200:] != point[:, 200:]).any()
    darkest = difference[(point == moment).all(axis=2)]
    assert len(darkest) > 0 and darkest.max() <= 32  # the first colour of the map
    assert difference.max() > 100


def test_the_times_of_passes_are_shown_where_the_device_tells_them(controls):
    settle(controls)
    told = controls.evaluate("async () => (await navigator.gpu.requestAdapter()).features.has('timestamp-query')")
    if not told:
        assert controls.text_content("#stages") == ""
        pytest.skip("this device has no timestamps")
    text = controls.text_content("#stages")
    names = ("project", "sort", "bin", "sort tiles", "blend")
    assert re.fullmatch(", ".join(rf"{name} (\d+\.\d)" for name in names) + " ms", text)
    assert sum(float(time) for time in re.findall(r"\d+\.\d", text)) > 0


def test_photographs_are_beside_the_pictures_of_their_views(browser):
    check_photographs(browser, "?renderer=webgpu")


def test_what_the_screen_shows_is_the_picture(browser):
    image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
    view = replace(facing(), width=320, height=240, fx=300.0, fy=300.0)
    scene = random_scene(500)
    expected = rendered(scene, view, "moment:samples=4").clip(0, 1).transpose(1, 2, 0)
    with gpu_page_of(browser, scene, view, wait=wait_for_frame, footprint="moment") as page:
        shown = screenshot(page)
        assert np.abs(shown - 255 * expected)[50:100].max() <= 1.5
        with page.expect_download() as download:
            page.keyboard.press("p")
        saved = np.asarray(image.open(download.value.path()).convert("RGB"))
        assert saved.shape == shown.shape and (saved[50:100] == shown[50:100]).all()
