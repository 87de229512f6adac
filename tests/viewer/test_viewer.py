"""The viewer without a browser: packing, server, exported file, command, and what the page says of the footprints."""

import base64
import gzip
import hashlib
import http.client
import json
import re
import threading
from io import BytesIO

import commands
import numpy as np
import pytest
import torch
from capture_files import circle, write_colmap, write_pictures
from commands import refused
from gaussians import make_scene, make_view
from node import run_node
from pages import serve
from places import ROOT
from processes import DEADLINE

import analytic_rasterizer as ar
from analytic_rasterizer import _C, cli, io, viewer
from analytic_rasterizer.cli.photographs import find_photographs
from analytic_rasterizer.footprints import footprint_variants
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.viewer import pages
from analytic_rasterizer.viewer.compressed import compress

CORE = ROOT / "csrc" / "core"
JAVASCRIPT = (*pages.MODULES, pages.WORKER)


@pytest.fixture
def server():
    with viewer.start_server(viewer.pack_scene(make_scene(), [make_view()])) as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def ask(server, path, method="GET", host=None, body=None):
    """(status, headers, body) of a request to the server, sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=DEADLINE)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{server.server_port}")
    if body is not None:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    response = connection.getresponse()
    answer = response.status, dict(response.getheaders()), response.read()
    connection.close()
    return answer


# ------------------------------------------------------------------------------------ packing


@pytest.mark.parametrize("degree, numbers", [(0, 4), (1, 12), (2, 28), (3, 48)])
def test_packed_numbers(degree, numbers):
    scene = make_scene(7, degree)
    packed = viewer.pack_scene(scene, [make_view()], name="a scene", footprint="box:samples=16", background=(1, 0.5, 0))
    geometry = np.frombuffer(packed.geometry, "<f4").reshape(7, 12)
    np.testing.assert_array_equal(geometry[:, :3], scene.means)
    np.testing.assert_array_equal(geometry[:, 3:4], scene.opacities)
    np.testing.assert_array_equal(geometry[:, 4:7], scene.scales)
    np.testing.assert_allclose(
        geometry[:, 8:], torch.nn.functional.normalize(scene.rotations.double(), dim=1), rtol=0, atol=2**-24
    )
    harmonics = np.frombuffer(packed.harmonics, "<f2").reshape(7, numbers)
    used = 3 * (degree + 1) ** 2
    np.testing.assert_array_equal(harmonics[:, :used], scene.shs.reshape(7, -1).half())
    assert not harmonics[:, used:].any()
    meta = json.loads(packed.meta_json())
    assert (meta["name"], meta["count"], meta["sh_degree"]) == ("a scene", 7, degree)
    assert (meta["footprint"], meta["background"]) == ("box:samples=16", [1.0, 0.5, 0.0])


def test_packed_views():
    views = [make_view("centre"), make_view("off centre", cx=20.0, cy=25.0)]
    meta = viewer.pack_scene(make_scene(), views).meta
    assert [(v["name"], v["cx"], v["cy"]) for v in meta["views"]] == [("centre", 32, 24), ("off centre", 20.0, 25.0)]
    assert meta["views"][0]["w2c"] == torch.eye(4).flatten().tolist()
    assert meta["up"] == [0.0, -1.0, 0.0]


def test_without_views_there_is_one_that_sees_the_scene():
    scene = make_scene(400)
    (entry,) = viewer.pack_scene(scene).meta["views"]
    w2c = torch.tensor(entry["w2c"]).reshape(4, 4)
    seen = scene.means @ w2c[:3, :3].T + w2c[:3, 3]
    x = entry["fx"] * seen[:, 0] / seen[:, 2] + entry["cx"]
    y = entry["fy"] * seen[:, 1] / seen[:, 2] + entry["cy"]
    inside = (seen[:, 2] > 0.2) & (x > 0) & (x < entry["width"]) & (y > 0) & (y < entry["height"])
    assert inside.float().mean() > 0.8


def floor(across, thickness, count=400):
    """Flat Gaussians that face along axis number `across`, and as many that face anywhere, in a flat box."""
    g = torch.Generator().manual_seed(1)
    means = torch.rand(2 * count, 3, generator=g) - 0.5
    means[:, across] *= thickness
    scales = torch.full((2 * count, 3), 0.02)
    scales[:, across] = 1e-4
    rotations = torch.randn(2 * count, 4, generator=g)
    rotations[:count] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    opacities, shs = torch.full((2 * count, 1), 0.9), torch.zeros(2 * count, 1, 3)
    return Gaussians.from_activated(means, scales, rotations, opacities, shs)


def picture():
    """Flat Gaussians that all face z, in layers, as the demonstration's."""
    scene = floor(2, 0.5)
    return scene._replace(rotations=scene.rotations[:400].repeat(2, 1))


@pytest.mark.parametrize(
    "make, up, ahead, above",
    [
        (lambda: floor(1, 0.4), [0, -1, 0], [0, 0, 1], 0.2),
        (lambda: floor(1, 1.0), [0, -1, 0], [0, 0, 1], 0.2),
        (lambda: floor(2, 0.4), [0, 0, 1], [0, 1, 0], 0.2),
        (lambda: floor(0, 0.4), [0, -1, 0], [0, 0, 1], 0.2),
        (picture, [0, -1, 0], [0, 0, 1], -1e-6),  # it hangs, and is looked at head on
    ],
)
def test_the_first_view_stands_upright_before_the_scene_and_above_its_floor(make, up, ahead, above):
    meta = viewer.pack_scene(make()).meta
    w2c = torch.tensor(meta["views"][0]["w2c"]).reshape(4, 4)
    up, ahead = torch.tensor(up).double(), torch.tensor(ahead).double()
    rotation = right, down, forward = w2c[:3, :3].double()
    torch.testing.assert_close(torch.linalg.cross(down, forward), right)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-6)
    assert down @ up < -0.9 and forward @ ahead > 0.9 and abs(right @ up) < 1e-6
    eye = -w2c[:3, :3].double().T @ w2c[:3, 3].double() - torch.tensor(meta["center"])
    assert above * eye.norm() < eye @ up < 0.4 * eye.norm()
    assert meta["up"] == up.tolist()


def test_one_gaussian_has_a_view():
    (entry,) = viewer.pack_scene(make_scene(1)).meta["views"]
    assert np.isfinite(entry["w2c"]).all()


def test_a_zero_quaternion_is_the_identity_and_tiny_ones_survive():
    scene = make_scene(2)
    scene.rotations[0] = 0
    scene.rotations[1] = torch.tensor([0, 1e-30, 0, 0])
    geometry = np.frombuffer(viewer.pack_scene(scene).geometry, "<f4").reshape(2, 12)
    np.testing.assert_array_equal(geometry[:, 8:], [[1, 0, 0, 0], [0, 1, 0, 0]])


@pytest.mark.parametrize("field", ["means", "scales", "rotations", "opacities", "shs"])
def test_numbers_that_are_not_finite_are_refused(field):
    scene = make_scene()
    stored = {"scales": "log_scales", "opacities": "logit_opacities"}.get(field, field)
    getattr(scene, stored).view(-1)[4] = float("nan")
    with pytest.raises(ValueError, match=f"{field} must be finite"):
        viewer.pack_scene(scene)


def test_an_empty_scene_is_refused():
    with pytest.raises(ValueError, match=r"garden\.ply: the scene has no Gaussians"):
        viewer.pack_scene(make_scene(0), name="garden.ply")


WHOLE_NAMES = {"analytic:frame_gradient=paper": "analytic", "box": "box:samples=4", "moment": "moment:samples=4"}
WHOLE_NAMES |= {"point:dilation=0": "point:dilation=0.0"}
WHOLE_NAMES |= {name: name for name in ("analytic", "point", "mip:variance=0.3", "cumulant", "moment:samples=16")}


@pytest.mark.parametrize("given, name", WHOLE_NAMES.items())
def test_names_of_footprints(given, name):
    assert viewer.page_footprint(ar.resolve_footprint(given)) == name


@pytest.mark.parametrize("name", ["erf", "exact"])
def test_footprints_that_the_page_cannot_draw_are_refused(name):
    with pytest.raises(ValueError, match="viewer can draw"):
        viewer.pack_scene(make_scene(), footprint=name)


# ------------------------------------------------------------------------- tags of the files


@pytest.fixture
def files(tmp_path):
    pytest.importorskip("gsply", reason="needs the cli extra")
    io.save_scene(tmp_path / "scene.ply", make_scene())
    io.save_scene(tmp_path / "scene.spz", make_scene())
    io.save_views(tmp_path / "views.json", [make_view(), make_view("other")])
    return tmp_path


DRAWN = [ar.resolve_footprint(name) for name in viewer.PAGE_FOOTPRINTS]


@pytest.mark.parametrize("name", footprint_variants())
def test_what_the_page_cannot_draw_has_a_neighbour_that_it_can(name):
    footprint = ar.resolve_footprint(name)
    drawn = viewer.nearest_page_footprint(footprint)
    assert drawn in DRAWN and (drawn == footprint) == (footprint in DRAWN)


# ------------------------------------------------------------------------------------- server


def test_the_server_listens_on_this_machine_only(server):
    assert server.server_address[0] == "127.0.0.1"
    assert server.url == f"http://127.0.0.1:{server.server_port}/{server.token}/"
    assert len(server.token) >= 32


def test_the_server_serves_page_and_scene(server):
    for name in ("", "index.html", "style.css", "scene.json", "geometry.bin", "harmonics.bin", *JAVASCRIPT):
        status, headers, body = ask(server, f"/{server.token}/{name}")
        assert status == 200, name
        assert body == server.files[name][0]
        assert headers["Content-Length"] == str(len(body))
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
    status, headers, body = ask(server, f"/{server.token}/?view=0&footprint=point")
    assert (status, body) == (200, server.files[""][0])


def test_photographs_are_read_when_they_are_asked_for():
    def missing():
        raise OSError("gone")

    with serve(make_scene(), [make_view("a"), make_view("b")], {1: lambda: b"picture", 0: missing}) as server:
        path = f"/{server.token}"
        assert json.loads(ask(server, f"{path}/scene.json")[2])["photographs"] == [0, 1]
        status, headers, body = ask(server, f"{path}/photographs/1")
        assert (status, headers["Content-Type"], body) == (200, "image/png", b"picture")
        assert ask(server, f"{path}/photographs/0")[::2] == (500, b"gone\n")
        assert ask(server, f"{path}/photographs/2")[0] == 404


def test_head_has_no_body(server):
    status, headers, body = ask(server, f"/{server.token}/geometry.bin", method="HEAD")
    assert (status, body) == (200, b"")
    assert int(headers["Content-Length"]) == 30 * 12 * 4


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}"])
def test_a_foreign_host_is_refused(server, host):
    status, _, body = ask(server, f"/{server.token}/", host=host.format(port=server.server_port))
    assert status == 403
    assert b"<html" not in body


def test_localhost_is_not_foreign(server):
    assert ask(server, f"/{server.token}/", host=f"localhost:{server.server_port}")[0] == 200


@pytest.mark.parametrize("path", ["/", "/index.html", "//", "/x{token}/", "/{token}x/", "/{upper}/", "/%00/", "/é/"])
def test_without_the_token_nothing_is_served(server, path):
    path = path.format(token=server.token, upper=server.token.swapcase())
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=DEADLINE)
    connection._encode_request = lambda request: request.encode("latin-1")  # paths no browser would send
    connection.putrequest("GET", path.replace("é", "\xe9"), skip_host=True)
    connection.putheader("Host", f"127.0.0.1:{server.server_port}")
    connection.endheaders()
    assert connection.getresponse().status == 403
    connection.close()


NOT_LISTED = "missing.js ../server.py ../../../../../../etc/passwd %2e%2e/server.py page/index.html //etc/passwd"


@pytest.mark.parametrize("name", [*NOT_LISTED.split(), "/index.html", "index.html/", "INDEX.HTML"])
def test_nothing_but_the_listed_files_is_served(server, name):
    assert ask(server, f"/{server.token}/{name}")[0] == 404


def test_an_address_without_its_last_slash_leads_to_the_page(server):
    status, headers, body = ask(server, f"/{server.token}")
    assert (status, headers["Location"], body) == (302, f"/{server.token}/", b"")
    assert ask(server, f"/{server.token[:-1]}")[0] == 403


def test_other_methods_are_refused(server):
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask(server, f"/{server.token}/", method=method)[0] == 501


def test_a_file_that_is_sent_is_shown_and_one_that_is_no_scene_is_refused(tmp_path):
    """Whatever its name is, it stays in a folder of its own, which is gone afterwards."""
    opened = []

    def opens(path):
        opened.append(path)
        return viewer.pack_scene(io.load_scene(path), [], name=path.name)

    io.save_scene(tmp_path / "scene.ply", make_scene())
    content = (tmp_path / "scene.ply").read_bytes()
    with viewer.start_server(viewer.pack_scene(make_scene()), opens=opens, photographs={0: lambda: b""}) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        told = ask(running, f"/{running.token}/open?name=..%2F..%2Fother%20one.ply", method="POST", body=content)
        assert told[0] == 200
        meta = json.loads(ask(running, f"/{running.token}/scene.json")[2])
        assert meta["name"] == "other one.ply" and meta["photographs"] == []
        refused = ask(running, f"/{running.token}/open?name=no.ply", method="POST", body=b"Dear diary")
        assert refused[0] == 400 and refused[2].startswith(b"no.ply: ")
        assert json.loads(ask(running, f"/{running.token}/scene.json")[2]) == meta
        for path, status in ((f"/{running.token[:-1]}/open?name=a.ply", 403), (f"/{running.token}/a.ply", 501)):
            assert ask(running, path, method="POST", body=content)[0] == status
        assert [path.name for path in opened] == ["other one.ply", "no.ply"]
        assert not any(path.parent.exists() for path in opened)
        running.shutdown()


def test_a_port_in_use_is_one_sentence(server):
    with pytest.raises(ValueError, match=rf"port {server.server_port} cannot be used: "):
        viewer.start_server(viewer.pack_scene(make_scene()), server.server_port)


# ------------------------------------------------------------------------------ exported file


@pytest.fixture(params=[True, False], ids=["exact", "compressed"])
def exported(request, tmp_path):
    """What was exported, the text of the file, and whether its numbers are exact."""
    packed = viewer.pack_scene(make_scene(), [make_view("</script><b>")], name="<script>alert(1)</script>")
    size = viewer.export_page(tmp_path / "scene.html", packed, exact=request.param)
    text = (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert size == len(text.encode())
    return packed, text, request.param


def test_the_exported_file_holds_the_scene(exported):
    packed, text, exact = exported

    def data(name):
        return re.search(rf'<script type="[^"]*" id="data-{name}">(.*?)</script>', text, re.DOTALL)[1]

    meta = json.loads(data("scene"))
    if exact:
        assert gzip.decompress(base64.b64decode(data("geometry"))) == packed.geometry
        assert gzip.decompress(base64.b64decode(data("harmonics"))) == packed.harmonics
    else:
        made, columns = compress(packed)
        assert meta.pop("compressed") == json.loads(json.dumps(made))
        assert base64.b64decode(data("columns")) == columns
    assert meta == packed.meta
    assert data("sorter") == pages.page_file("sort.js")


def test_the_exported_file_allows_its_own_script_and_style_only(exported):
    _, text, _ = exported
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)[1]
    assert text.index("Content-Security-Policy") < text.index("<style>")
    allowed = dict(part.split(maxsplit=1) for part in policy.split("; "))
    assert allowed["default-src"] == allowed["connect-src"] == "'none'"
    for directive, tag in (("script-src", '<script type="module">'), ("style-src", "<style>")):
        content = text.split(tag)[1].split(f"</{tag[1:].split()[0].rstrip('>')}>")[0]
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert allowed[directive] == f"'sha256-{digest}'"


def test_the_exported_file_refers_to_nothing_outside(exported):
    _, text, _ = exported
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "http://" not in text and "https://" not in text
    assert not re.search(r"^\s*(import|export)\s", text, re.MULTILINE)
    assert "<script>alert" not in text


def test_a_scene_too_large_for_one_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("analytic_rasterizer.viewer.export.MAX_EMBEDDED", 100)
    with pytest.raises(ValueError, match="too large for one file"):
        viewer.export_page(tmp_path / "scene.html", viewer.pack_scene(make_scene()))
    assert not (tmp_path / "scene.html").exists()


# ------------------------------------------------------------------------------------ command


def run_view(*arguments):
    return cli.main(["view", *map(str, arguments)])


def test_export_by_the_command(files, capsys):
    out = files / "out.html"
    code = run_view(files / "scene.ply", "--views", files / "views.json", "--export", out, "--footprint", "box")
    assert code == 0
    text = out.read_text(encoding="utf-8")
    assert '"footprint": "box:samples=4"' in text and '"name": "other"' in text
    assert "30 Gaussians" in capsys.readouterr().out


def test_the_command_rounds_unless_exact(files):
    arguments, out = ("--export", files / "out.html"), files / "out.html"
    assert run_view(files / "scene.ply", *arguments) == 0
    assert 'id="data-columns"' in out.read_text(encoding="utf-8")
    assert run_view(files / "scene.ply", *arguments, "--exact") == 0
    assert 'id="data-geometry"' in out.read_text(encoding="utf-8")
    assert run_view(files / "scene.ply", *arguments, "--compact") == 0  # has a rounding of its own
    assert 'id="data-geometry"' in out.read_text(encoding="utf-8")


def test_the_command_takes_the_footprint_of_the_file(files):
    path, out = files / "scene.ply", files / "out.html"
    path.write_bytes(path.read_bytes().replace(b"\nelement", b"\ncomment antialiased 1\nelement", 1))
    assert run_view(path, "--export", out) == 0
    assert '"footprint": "mip"' in out.read_text(encoding="utf-8")
    assert run_view(path, "--export", out, "--footprint", "cumulant") == 0
    assert '"footprint": "cumulant"' in out.read_text(encoding="utf-8")


def test_the_command_shows_what_is_near_to_what_the_page_cannot_draw(files, capsys):
    io.save_scene(files / "exact.ply", make_scene(), io.SceneMetadata(footprint="exact"))
    assert run_view(files / "exact.ply", "--export", files / "out.html") == 0
    assert '"footprint": "cumulant"' in (files / "out.html").read_text(encoding="utf-8")
    expected = "footprint cumulant: the page cannot draw exact (exact.ply says so), and this is near"
    assert capsys.readouterr().err == f"{expected}; --server shows it\n"


def test_a_training_knows_the_photographs_of_its_views(tmp_path, monkeypatch):
    pytest.importorskip("scipy", reason="needs the train extra")
    image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
    data, out = tmp_path / "data", tmp_path / "out"
    cameras = circle(4)
    write_colmap(data / "sparse" / "0", cameras, torch.randn(9, 3), torch.zeros(9, 3, dtype=torch.int32))
    (data / "images").mkdir()
    write_pictures(data / "images", cameras, opaque=True)
    assert commands.train(data, out, "--iterations 1 --scales 2,4 --test-every 0") == 0

    monkeypatch.setattr("analytic_rasterizer.captures.colmap.load_points", lambda _: pytest.fail("reads the points"))
    found = io.find_scene(out)
    views = [*found.load_views(), make_view("elsewhere")]
    photographs, said = find_photographs(found, views)
    assert said == [f"4 photographs of {data} to compare with"] and sorted(photographs) == [0, 1, 2, 3]
    for k, view in enumerate(views[:4]):
        shown = np.asarray(image.open(BytesIO(photographs[k]())))
        with image.open(data / "images" / f"{view.name}.png") as stored:
            assert np.abs(shown - np.asarray(stored.convert("RGB").reduce(2), dtype=float)).max() <= 1
    assert shown.shape == (view.height, view.width, 3)

    data.rename(tmp_path / "moved")
    photographs, (said,) = find_photographs(found, views)
    assert photographs == {} and said == f"no photographs: {data}: no such folder"


def test_the_background_is_that_of_the_file(files):
    path, out = files / "paper.ply", files / "out.html"
    io.save_scene(path, make_scene(), io.SceneMetadata(footprint="moment", background=(1, 0.5, 0.25)))
    assert run_view(path, "--export", out) == 0
    assert '"background": [1.0, 0.5, 0.25]' in out.read_text(encoding="utf-8")
    assert run_view(path, "--export", out, "--background", "white") == 0
    assert '"background": [1.0, 1.0, 1.0]' in out.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        ("missing.ply", "no such file"),
        ("scene.ply --footprint exact", "viewer can draw"),
        ("scene.ply --footprint box:samples=3", "samples must be one of"),
        ("scene.ply --views missing.json", "missing.json"),
        ("scene.ply --export out.txt", "--export must end in .html"),
        ("scene.ply --export out.html --port 8000", "--port is for serving"),
        ("scene.ply --exact", "--exact is for --export"),
        ("scene.ply --server --exact", "leave out --server"),
        ("scene.ply --export out.html --device cpu", "--device and --threads are for --server"),
        ("scene.ply --export scene.ply/out.html", "scene.ply: expected a folder for the results, got a file"),
        ("broken.ply", "broken.ply"),
        ("empty.ply", "no Gaussians"),
        ("broken.spz", "broken.spz"),
    ],
)
def test_mistakes_are_one_sentence(files, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(files)
    ply = (files / "scene.ply").read_bytes()
    (files / "broken.ply").write_bytes(ply[: len(ply) // 2])
    (files / "broken.spz").write_bytes(b"not an spz")
    header, _ = ply.split(b"end_header\n")
    (files / "empty.ply").write_bytes(header.replace(b"element vertex 30", b"element vertex 0") + b"end_header\n")
    assert sentence in refused(capsys, commands.command, "view", arguments)


@pytest.mark.parametrize("port", ["-1", "65536", "http"])
def test_a_port_is_a_number(files, capsys, port):
    with pytest.raises(SystemExit) as stop:
        run_view(files / "scene.ply", "--port", port)
    assert stop.value.code == 2
    assert "a port from 0 to 65535" in capsys.readouterr().err


def test_the_command_serves_and_ends(files, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)

    def interrupted(server):
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer.ViewerServer, "serve_forever", interrupted)
    assert run_view(files / "scene.ply") == 0
    assert run_view(files / "scene.ply", "--no-browser") == 0
    assert len(opened) == 1
    assert opened[0] in capsys.readouterr().out


# --------------------------------------------------------------------- sources of the page


def number(text):
    return eval(text, {"__builtins__": {}})  # of our own sources: digits and arithmetic


def header(name):
    return (CORE / name).read_text(encoding="utf-8")


def test_constants_are_those_of_the_headers():
    text = pages.page_file("constants.js")
    block = re.search(r"CONSTANTS = \{(.*?)\};", text, re.DOTALL)[1]
    constants = {name: number(value) for name, value in re.findall(r"(\w+): ([^,]+),", block)}
    names = ("constants.h", "footprint/gaussian.h", "footprint/analytic.h", "footprint/cumulant.h")
    headers = "".join(header(name) for name in names)
    for name, value in constants.items():
        found = re.search(rf"constexpr double {name} = ([^;,]+)[;,]", headers)
        assert found, name
        assert value == number(found[1]), name
    assert (constants["kNear"], constants["kFrustumClamp"]) == (_C.NEAR, _C.FRUSTUM_CLAMP)


def test_nodes_are_those_of_the_headers():
    text = pages.page_file("constants.js")
    block = re.search(r"HALF_NODES = (\{.*?\});", text, re.DOTALL)[1]
    ours = json.loads(re.sub(r",(\s*[\]}])", r"\1", re.sub(r"(\d+):", r'"\1":', block)))
    source = header("footprint/gaussian.h")
    assert set(ours) == {"4", "16"}
    for samples, nodes in ours.items():
        listed = re.search(rf"kNodes{samples}\[\] = \{{(.*?)\}};", source, re.DOTALL)[1]
        theirs = [[float(x), float(y)] for x, y in re.findall(r"\{(-?[\d.]+), (-?[\d.]+)\}", listed)]
        assert nodes == theirs
        assert len(nodes) == int(samples) // 2


def test_polynomials_are_those_of_the_headers():
    minimax = re.search(r"kMinimax\[\] = \{(.*?)\}", header("lanes.h"), re.DOTALL)[1]
    ours = re.search(r"MINIMAX = \[(.*?)\]", pages.page_file("constants.js"), re.DOTALL)[1]
    assert [float(x) for x in ours.split(",") if x.strip()] == [float(x) for x in minimax.split(",")]
    harmonics = header("sh.h")
    values = re.findall(r"\d\.\d{6,}", pages.page_file("sh.js"))
    assert len(values) == 16
    for value in values:
        assert value in harmonics, value
    cumulant = header("footprint/cumulant.h")
    theirs = {float(v) for v in re.findall(r"x \* T\((?:\d \* )?(\d\.\d+)\)", cumulant)}
    ours = re.findall(r"x \* (\d\.\d+)\)", pages.page_file("footprint.wgsl.js"))
    assert len(ours) == 3 and {float(value) for value in ours} <= theirs


def test_shaders_have_no_numbers_of_their_own():
    """Whatever is not in constants.js or sh.js is a small number of a formula."""
    for name in JAVASCRIPT:
        if name.startswith(("webgl_shaders", "formulas")) or name.endswith(".wgsl.js"):
            found = set(re.findall(r"(?<![\w.])\d+\.\d{3,}", pages.page_file(name)))
            assert found <= {"0.4366", "0.6240", "0.6975"}, (name, found)


PARSE = """
import { readFileSync } from 'fs';
import { parseFootprint } from './constants.js';
const { known, names } = JSON.parse(readFileSync('names.json', 'utf8'));
const parsed = name => { try { return parseFootprint(name, known); } catch (error) { return error.message; } };
console.log(JSON.stringify(names.map(parsed)));
"""


def test_the_page_finds_footprints_by_name(tmp_path):
    """As the library does, among those that it is handed."""
    known = viewer.pack_scene(make_scene()).meta["footprints"]
    right = [*viewer.PAGE_FOOTPRINTS, "box", "point:dilation=0.5", "mip:variance=0"]
    wrong = ["box:samples=8", "mip:dilation=1", "mip:variance=-1", "mip:variance=", "analytic:=1", "exact", "", "x:y=1"]
    (tmp_path / "names.json").write_text(json.dumps({"known": known, "names": right + wrong}))
    parsed = run_node(tmp_path, ["constants.js"], PARSE)
    for name, found in zip(right, parsed):
        footprint = ar.resolve_footprint(name)
        assert viewer.page_footprint(footprint).split("=")[0] == found["name"].split("=")[0]
        assert found["samples"] == footprint.samples
        if found["option"] is not None:
            assert found["variance"] == footprint.option
    assert parsed[len(right) :] == [f"There is no footprint '{name}'." for name in wrong]


PACE = """
import { Pace } from './pace.js';
const follow = (milliseconds, frames, settled = 0) => {
  const pace = new Pace(settled), divisors = [pace.divisor];
  for (let k = 0; k < frames; ++k) {
    pace.note(milliseconds(pace.divisor, k));
    divisors.push(pace.divisor);
  }
  return divisors;
};
console.log(JSON.stringify({
  quick: follow(() => 5, 6),
  slow: follow(divisor => 10 + 200 / (divisor * divisor), 8),  // 60 ms at 1/2, 22 ms at 1/4
  stubborn: follow(() => 90, 8),                               // nothing is gained
  recovers: follow((divisor, k) => (k < 3 ? 100 / divisor : 4), 12),
  warned: follow(divisor => 400 / (divisor * divisor), 4, 3000),  // 25 ms at 1/4
}));
"""


def test_pictures_in_motion_are_as_small_as_they_must_be(tmp_path):
    followed = run_node(tmp_path, ["pace.js"], PACE)
    assert followed["quick"] == [1] * 7
    assert followed["warned"] == [4] * 5
    assert followed["slow"][-4:] == [4] * 4
    assert followed["stubborn"][-4:] == [1] * 4
    assert 2 in followed["recovers"] and followed["recovers"][-1] == 1


CELLS = """
import { cellsOf } from './constants.js';
console.log(JSON.stringify([1, 4, 16].map(cellsOf)));
"""


def test_cells_tile_the_pixel_in_the_order_of_the_header(tmp_path):
    """node() of moment.h: rows of cells, from half cells (2 k + 1 - side) / (2 side)."""
    for side, cells in zip((1, 2, 4), run_node(tmp_path, ["constants.js"], CELLS)):
        centres = [(2 * k + 1) / (2 * side) - 0.5 for k in range(side)]
        assert cells == [[x, y] for y in centres for x in centres]


def kinds_in(module, table):
    block = pages.page_file(module).split(f"export const {table} = {{")[1].split("\n}};")[0].split("\n};")[0]
    return set(re.findall(r"^  (\w+): ", block, re.MULTILINE))


def test_the_page_has_the_formulas_that_headers_name():
    """A formula is a key of KINDS in footprint.wgsl.js; pages offer every footprint whose header names one."""
    entries = viewer.pack_scene(make_scene()).meta["footprints"]
    kinds = kinds_in("footprint.wgsl.js", "KINDS")
    assert kinds == {entry["kind"] for entry in entries}
    stated = {variant["name"] for variant in _C.footprints() if variant["page"] is not None}
    assert {entry["family"] for entry in entries} == stated
    assert {entry["samples"] for entry in entries} - {1} == {4, 16}  # those of HALF_NODES


def test_without_webgpu_there_is_a_footprint_in_place_of_every_other():
    kinds = kinds_in("webgl_shaders.js", "GL_KINDS")
    entries = {entry["name"]: entry for entry in viewer.pack_scene(make_scene()).meta["footprints"]}
    drawn = {name for name, entry in entries.items() if entry["samples"] == 1 and entry["kind"] in kinds}
    assert drawn == {"point", "mip", "analytic", "box:samples=1"}
    for name, entry in entries.items():
        assert name in drawn or entry["instead"] in drawn


@pytest.mark.parametrize("name", JAVASCRIPT)
def test_numbers_have_full_precision_in_the_shaders(name):
    assert not re.search(r"\b(mediump|lowp)\b", pages.page_file(name))


def test_the_page_fetches_nothing_from_elsewhere():
    for name in ("index.html", "style.css", *JAVASCRIPT):
        assert not re.search(r"https?://|@import|url\(", pages.page_file(name)), name


def test_modules_share_no_names_and_come_after_what_they_import():
    names = []
    for place, module in enumerate(pages.MODULES):
        text = pages.page_file(module)
        names += re.findall(r"^(?:export )?(?:async )?(?:const|let|class|function) (\w+)", text, re.MULTILINE)
        for imported in re.findall(r"from '\./([\w.]+)';", text):
            assert imported in pages.MODULES[:place], (module, imported)
    assert len(names) == len(set(names)), sorted(name for name in names if names.count(name) > 1)


def test_every_file_of_the_page_is_served():
    folder = ROOT / "analytic_rasterizer" / "viewer" / "page"
    assert {path.name for path in folder.iterdir()} == set(pages.served_files())
