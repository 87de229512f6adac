"""The page shows one scene the same from every format, and an exported file alone, without a network, as it was."""

import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
import torch
from chromium import WEBGL_FLAGS, facing, launch, open_page, page_of, pixels, wait_for, wait_for_frame, wait_until_ready
from commands import command
from npm import MODULES, splat_transform
from pages import assert_same, gaussians_of, psnr, random_scene, rendered, turned_view

from analytic_rasterizer import io, viewer
from analytic_rasterizer.cameras.rotations import rotation_matrices
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


SPARK = """<link rel="icon" href="data:,">
<script type="importmap">{"imports": {"three": "/three/build/three.module.js",
  "three/addons/": "/three/examples/jsm/", "spark": "/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import { SplatMesh } from 'spark';
window.read = async name => {
  const mesh = new SplatMesh({ url: `/${name}` }), rows = [];
  await mesh.initialized;
  mesh.forEachSplat((i, mean, scales, q, opacity, { r, g, b }) =>
    rows.push([mean.toArray(), scales.toArray(), [q.w, q.x, q.y, q.z], [opacity], [r, g, b]].flat()));
  return rows;
};
</script>"""
"""A page that reads a file as Spark does, which draws Gaussians for three.js."""


@pytest.fixture
def spark(browser, tmp_path):
    """A function from a file's name in `tmp_path` to rows of what Spark reads: the (N, 14) numbers of `SPARK`."""
    if not (MODULES / "@sparkjsdev").exists():
        pytest.skip("needs npm's @sparkjsdev/spark and three: make npm")
    (tmp_path / "index.html").write_text(SPARK)
    for name in ("three", "@sparkjsdev"):
        (tmp_path / name).symlink_to(MODULES / name)
    handler = partial(QuietHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with open_page(browser, f"http://127.0.0.1:{server.server_port}") as page:
            wait_for(page, "() => window.read !== undefined")
            yield lambda name: torch.tensor(page.evaluate("name => read(name)", name), dtype=torch.float64)
        server.shutdown()


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def test_spark_reads_one_scene_from_every_format(spark, tmp_path):
    """Places, covariances and colours are those of the .ply. It holds scales and rotations in 8 bits."""
    scene = asymmetric_scene("a.splat")
    names = ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.splat")
    for name in names:
        io.save_scene(tmp_path / name, scene)
    rows = {name: spark(name) for name in names}
    wanted = rows["a.ply"]
    torch.testing.assert_close(wanted[:, :3], scene.means.double(), rtol=2**-10, atol=2**-10)  # half floats
    for name in names:
        found = rows[name]
        assert len(found) == len(wanted)
        index = torch.cdist(wanted[:, :3], found[:, :3]).argmin(1)
        assert len(index.unique()) == len(wanted)
        found = found[index]
        torch.testing.assert_close(found[:, :3], wanted[:, :3], rtol=2**-10, atol=2**-6)
        torch.testing.assert_close(found[:, 10:], wanted[:, 10:], rtol=0, atol=0.02)
        apart = (covariances(found) - covariances(wanted)).flatten(1).norm(dim=1)
        assert (apart / covariances(wanted).flatten(1).norm(dim=1)).max() < 0.25, name


def covariances(rows):
    rotations = rotation_matrices(rows[:, 6:10])
    return rotations @ torch.diag_embed(rows[:, 3:6] ** 2) @ rotations.mT


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
