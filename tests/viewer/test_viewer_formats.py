"""The page shows one scene the same from every format, and an exported file alone, without a network, as it was."""

import json

import pytest
from chromium import WEBGL_FLAGS, facing, launch, open_page, page_of, pixels, wait_for, wait_for_frame, wait_until_ready
from commands import command
from npm import splat_transform
from pages import assert_same, gaussians_of, psnr, random_scene, rendered, turned_view

from analytic_rasterizer import io, viewer
from analytic_rasterizer.io.axes import AXES, flipped
from analytic_rasterizer.viewer.compressed import compress, decompress

FORMATS = ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a/meta.json", "a.splat", "a.glb", "a.gltf", "a.usdc")
THEIRS = {"a.ply": None, "a.compressed.ply": None, "a.spz": "rdf", "a.sog": None, "a.glb": None}
"""What splat-transform writes, with the axes that a file does not say."""
NEAR, TURNED = 34, 22  # [dB], of a picture from a file that rounds, and of one whose axes are others


@pytest.fixture(scope="module")
def browser():
    with launch(WEBGL_FLAGS) as launched:
        yield launched


def asymmetric_scene(name):
    """No axis is like another one; colours depend on the direction, where the format has them."""
    scene = random_scene(400, degree=0 if name == "a.splat" else 3)
    scene.means[:, 1] += 0.3 * scene.means[:, 0] - 0.4
    scene.shs[:, 0, 0] += 0.6 * scene.means[:, 0]
    scene.shs[:, 0, 1] -= 0.6 * scene.means[:, 1]
    return scene


def check(browser, path, scene, axes=None):
    view, found = turned_view(), io.load_scene(path, axes=axes)
    expected = rendered(scene, view, "analytic")
    with page_of(browser, found, view, "?view=0&footprint=analytic") as page:
        shown = pixels(page, view.width, view.height)
    assert_same(shown, rendered(found, view, "analytic"))
    assert psnr(shown, expected) > NEAR


def test_the_scene_looks_different_with_any_other_axes():
    scene, view = asymmetric_scene("a.ply"), turned_view()
    fields = {name: field.numpy() for name, field in scene._asdict().items()}
    for axes in sorted({*AXES} - {"rdf"}):
        turned = scene._replace(
            **{name: scene.means.new_tensor(field) for name, field in flipped(fields, axes).items()}
        )
        assert psnr(rendered(turned, view, "analytic"), rendered(scene, view, "analytic")) < TURNED, axes


@pytest.mark.parametrize("name", FORMATS)
def test_a_scene_looks_the_same_from_every_format(browser, tmp_path, name):
    if name == "a.usdc":
        pytest.importorskip("pxr", reason="needs the usd extra")
    scene = asymmetric_scene(name)
    (tmp_path / "a").mkdir()
    io.save_scene(tmp_path / name, scene)
    check(browser, tmp_path / name, scene)


@pytest.mark.parametrize("name", THEIRS)
def test_a_scene_looks_the_same_from_files_of_splat_transform(browser, tmp_path, name):
    scene = asymmetric_scene(name)
    io.save_scene(tmp_path / "scene.ply", scene)
    check(browser, splat_transform()(tmp_path / "scene.ply", tmp_path / name), scene, THEIRS[name])


@pytest.mark.gate
@pytest.mark.parametrize("options", ["", "--exact"])
def test_an_exported_file_keeps_footprint_and_views_and_asks_for_nothing(browser, tmp_path, options):
    """Opened as a person does it. What a view shows is the rasterizer's picture of the scene in the file."""
    scene, views = random_scene(400), [facing(), turned_view()]
    io.save_scene(tmp_path / "scene.ply", scene, io.SceneMetadata(footprint="mip", background=(0.2, 0.3, 0.4)))
    cameras = [
        {"width": view.width, "height": view.height, "fx": view.fx, "fy": view.fy, "w2c": view.w2c.flatten().tolist()}
        for view in views
    ]
    (tmp_path / "views.json").write_text(json.dumps(cameras))
    out, asked = tmp_path / "out" / "one file.html", []
    more = ("--export", out, *options.split())
    assert command("view", tmp_path / "scene.ply", "--views", tmp_path / "views.json", *more) == 0
    (tmp_path / "scene.ply").unlink()
    if not options:
        packed = viewer.pack_scene(scene, views)
        scene = gaussians_of(decompress(packed.meta, *compress(packed)))
    with open_page(browser, out.as_uri(), offline=True, reduced_motion="reduce") as page:
        page.on("request", lambda request: asked.append(request.url))
        page.reload()
        wait_for_frame(page)
        assert page.input_value("#footprint") == "mip"
        assert page.locator("#view option:not([value=''])").count() == 2
        page.keyboard.press(".")
        wait_for(page, "() => location.hash.includes('view=1')")
        assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
    for number, view in enumerate(views):
        with open_page(browser, f"{out.as_uri()}?view={number}", offline=True) as page:
            wait_until_ready(page)
            assert_same(pixels(page, view.width, view.height), rendered(scene, view, "mip", (0.2, 0.3, 0.4)))
