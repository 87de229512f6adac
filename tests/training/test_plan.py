"""What a capture calls for: captures that are made with an effect, and without."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import looking_at_origin, write_colmap_text
from cli_extra import image
from commands import refused
from places import SHARED
from wall import COUNT, SIZE, cameras, photograph, stored, wall_points, write_tracked, write_wall

from analytic_rasterizer import Lens, cli, io
from analytic_rasterizer.captures import colmap, evidence
from analytic_rasterizer.captures.offsets import medians_of
from analytic_rasterizer.captures.photographs import Stored
from analytic_rasterizer.training import CaptureSource, automatic, plan
from analytic_rasterizer.training.options import as_words
from analytic_rasterizer.training.plan import (
    EXPOSURE,
    NO,
    NOT_KNOWN,
    YES,
    displacement_of,
    plan_capture,
    stops_of_photographs,
)


def findings(found) -> dict:
    return {finding.effect: finding for finding in found.findings}


def plan_of(folder, **options) -> dict:
    return findings(plan_capture(folder, **options))


EVEN = {"lens", "exposure", "white balance", "scales", "blur", "masks", "alpha", "EXIF turns", "wrong sizes"}
EVEN |= {"missing pictures", "outlying cameras", "far from zero", "sampling", "depth", "vignetting"}


@pytest.mark.parametrize("tracked", [True, False])
def test_an_even_capture_calls_for_nothing(tmp_path, tracked):
    found = plan_capture(write_wall(tmp_path / "wall", tracked=tracked))
    assert {name: finding.verdict for name, finding in findings(found).items()} == dict.fromkeys(EVEN, NO)
    assert found.options == {} and "nothing special" in found.to_text()
    assert findings(found)["exposure"].number < 0.02 and findings(found)["white balance"].number < 1
    assert len(found.to_lines()) == 1 + len(EVEN)


@pytest.mark.parametrize("tracked", [True, False])
def test_exposure(tmp_path, tracked):
    found = plan_of(write_wall(tmp_path / "wall", tracked=tracked, gains=lambda i: (2 ** (0.5 - i % 2),) * 3))
    assert found["exposure"].verdict == YES and found["exposure"].option == "--exposure affine"
    assert found["exposure"].number == pytest.approx(0.5, abs=0.03)
    assert found["white balance"].verdict == NO
    assert found["blur"].verdict == NO


def test_stops_of_photographs(tmp_path, monkeypatch):
    folder = write_wall(tmp_path / "wall", gains=lambda i: (2 ** (0.5 - i % 2),) * 3)
    known = plan_capture(folder).stops
    files = sorted(known)
    assert len(files) == COUNT
    threads = torch.get_num_threads()
    stops = stops_of_photographs(folder, [*files, tmp_path / "another.png"])
    assert torch.get_num_threads() == threads
    assert stops.shape == (COUNT + 1, 3) and stops[-1].isnan().all()
    expected = 0.5 - torch.arange(COUNT).double() % 2
    assert torch.allclose(stops[:-1] - stops[:-1].mean(0), expected[:, None].expand(-1, 3), atol=0.05)
    assert torch.equal(stops[:-1], torch.stack([known[file] for file in files]))
    # A training that has looked does not look again; what cannot be looked at starts as it is.
    monkeypatch.setattr(automatic, "stops_of_photographs", lambda *_, **__: pytest.fail("looks"))
    assert torch.equal(automatic.measured_stops(CaptureSource(folder), files, known), stops[:-1])
    monkeypatch.undo()
    assert automatic.measured_stops(CaptureSource(tmp_path / "none"), files, {}).isnan().all()


def test_white_balance(tmp_path):
    found = plan_of(write_wall(tmp_path / "wall", gains=lambda i: (1.2, 1, 1 / 1.2) if i % 2 else (1, 1, 1)))
    assert found["white balance"].verdict == YES and found["white balance"].option == "--exposure affine"
    assert found["white balance"].number == pytest.approx(100 * (math.sqrt(1.2) - 1), abs=1)
    assert found["exposure"].verdict == NO


def test_blurred_photographs_are_named(tmp_path):
    found = plan_of(write_wall(tmp_path / "wall", blurred=(3, 7)))
    assert found["blur"].verdict == YES and found["blur"].number == 2
    assert set(found["blur"].photographs) == {"p_3.png", "p_7.png"}
    assert found["exposure"].verdict == NO


def test_what_masks_hide_is_not_looked_at(tmp_path):
    """Every second photograph is a stop brighter where its mask hides it."""
    folder = write_wall(tmp_path / "wall", gains=lambda i: (2 ** (0.5 - i % 2),) * 3)
    for view in cameras():
        path = folder / "images" / f"{view.name}.png"
        picture = np.array(image.open(path))
        picture[:, : SIZE[0] // 4] = photograph(view)[:, : SIZE[0] // 4]
        image.fromarray(picture).save(path)
        mask = np.zeros(SIZE[::-1], np.uint8)
        mask[:, : SIZE[0] // 4] = 255
        (folder / "masks").mkdir(exist_ok=True)
        image.fromarray(mask).save(folder / "masks" / f"{view.name}.png.png")
    found = plan_of(folder)
    assert found["exposure"].verdict == NO and found["masks"].number == COUNT
    for path in (folder / "masks").iterdir():
        path.rename(path.with_name(f"other_{path.name}"))
    found = plan_of(folder)
    assert found["exposure"].verdict == YES and found["masks"].verdict == NO
    assert f"{COUNT} files of masks belong to no convention" in found["masks"].reason


def test_sampling_intervals_and_scales(tmp_path):
    """From 2 to 3.6 away intervals differ by 1.8, from 1 to 6 by 6."""
    found = plan_of(write_wall(tmp_path / "some", cameras(lambda i: 2 + 1.6 * (i % 2))))
    assert found["sampling"].verdict == YES and found["scales"].verdict == NO
    found = plan_of(write_wall(tmp_path / "many", cameras(lambda i: 1 + 5 * (i % 2))))
    assert found["scales"].verdict == YES and found["scales"].option == "--scales 1,2,4,8"
    assert found["scales"].options == {"scales": (1, 2, 4, 8)}


def test_no_points(tmp_path):
    """What points tell is not known then, and what files tell is."""
    found = plan_of(write_wall(tmp_path / "wall", points=False))
    unknown = {name for name, finding in found.items() if finding.verdict == NOT_KNOWN}
    assert unknown == {"exposure", "white balance", "vignetting", "sampling", "scales", "blur", "depth"}
    assert all(found[name].reason.endswith("the capture has no points") for name in unknown)
    assert all(found[name].number is None for name in unknown - {"depth"}) and found["depth"].number == 0


def test_lens(tmp_path):
    lens = Lens.perspective((-0.05,))
    views = cameras(lens=lens)
    folder = write_wall(tmp_path / "wall", views, model=4, coefficients=(-0.05, 0, 0, 0))
    found = plan_of(folder)["lens"]
    assert found.verdict == YES and found.option == "--lens keep"
    corner = torch.tensor([[0.0, 0.0]], dtype=torch.float64)
    ray = views[0].rays_of(corner)[0]
    pinhole = 180 * ray[:2] / ray[2] + torch.tensor([80.0, 60.0])
    assert found.number == pytest.approx(pinhole.norm().item(), rel=1e-6) and found.number > 1


def test_displacement_of_lenses():
    view = io.View("v", 100, 80, 50.0, 50.0, torch.eye(4, dtype=torch.float64))
    assert displacement_of(view) == 0
    assert displacement_of(io.View("v", 100, 80, 50.0, 50.0, view.w2c, lens=Lens.perspective())) < 1e-6
    assert displacement_of(io.View("v", 200, 200, 50.0, 50.0, view.w2c, lens=Lens.fisheye())) == math.inf


def test_more_than_a_half_space(tmp_path):
    """A lens that no pinhole comes near to has no displacement that JSON holds."""
    view = io.View("v", 200, 200, 50.0, 50.0, torch.eye(4, dtype=torch.float64), lens=Lens.fisheye())
    found = plan._lens([plan.Photograph(view, {1: tmp_path / "v.png"})])
    assert (found.number, found.verdict, found.option) == (None, YES, "--lens keep")
    assert "1 of 1 photographs have a lens (fisheye)" in found.to_text()


def test_pictures_of_several_sizes(tmp_path):
    """As in the multi-scale Blender set, which names them in metadata.json."""
    rows = {key: [] for key in ("file_path", "cam2world", "width", "height", "focal")}
    for i, view in enumerate(cameras()[:3]):
        c2w = torch.linalg.inv(view.w2c)
        c2w[:3, 1:3] *= -1
        for scale in (1, 2, 4):
            name = f"{i}_{scale}.png"
            image.new("RGBA", (64 // scale, 64 // scale), (9, 9, 9, 255)).save(tmp_path / name)
            for key, value in zip(rows, (name, c2w.tolist(), 64 // scale, 64 // scale, 70 / scale)):
                rows[key].append(value)
    (tmp_path / "metadata.json").write_text(json.dumps({"train": rows, "test": {key: [] for key in rows}}))
    whole = plan_capture(tmp_path)
    found = findings(whole)
    assert (found["scales"].verdict, found["scales"].number) == (YES, 3)
    assert whole.options == found["scales"].options == {"scales": (1, 2, 4)}
    assert whole.to_json()["options"] == {"scales": "1,2,4"} and "calls for: --scales 1,2,4" in whole.to_text()
    assert found["scales"].option == "--scales 1,2,4"
    assert found["alpha"].verdict == NO and found["sampling"].verdict == NOT_KNOWN


def test_files(tmp_path):
    """A far camera, a mask, alpha, a turn, a missing picture, and coordinates like those of UTM."""
    views = cameras()
    far = views[4].w2c.clone()
    far[2, 3] = 4000.0
    folder = write_wall(tmp_path / "wall", views, shift=(4e5, 5e6, 0))
    views[4] = io.View("p_4", *SIZE, 180.0, 180.0, far)
    write_tracked(folder / "moved", [v.in_frame((-4e5, -5e6, 0.0)) for v in views], *shifted(wall_points()))
    (folder / "images" / "p_2.png").unlink()
    (folder / "masks").mkdir()
    image.new("L", SIZE).save(folder / "masks" / "p_1.png.png")
    picture = image.open(folder / "images" / "p_5.png").convert("RGBA")
    picture.putpixel((3, 3), (0, 0, 0, 0))
    picture.save(folder / "images" / "p_5.png")
    turned = image.open(folder / "images" / "p_6.png")
    exif = turned.getexif()
    exif[0x0112] = 6
    turned.save(folder / "images" / "p_6.png", exif=exif)
    image.open(folder / "images" / "p_7.png").resize((120, 160)).save(folder / "images" / "p_7.png")
    whole = plan_capture(folder, cameras="moved")
    found = findings(whole)
    expected = {
        "outlying cameras": (1, ("p_4.png",), ""),
        "masks": (1, (), "--masks auto"),
        "alpha": (1, (), ""),
        "EXIF turns": (1, ("p_6.png",), ""),
        "wrong sizes": (1, ("p_7.png",), ""),
        "missing pictures": (1, ("images/p_2.png",), "--missing skip"),
    }
    for effect, (number, names, option) in expected.items():
        finding = found[effect]
        assert (finding.number, finding.photographs, finding.option) == (number, names, option), effect
        assert finding.verdict == YES, effect
    assert found["far from zero"].verdict == YES and found["far from zero"].number == pytest.approx(
        math.hypot(4e5, 5e6)
    )
    assert "1 do after a quarter turn" in found["wrong sizes"].reason
    assert whole.options == {"masks": "auto", "missing": "skip"}
    assert (whole.photographs, whole.looked_at) == (9, 7)  # neither the far camera, nor what does not fit


def shifted(points) -> tuple[torch.Tensor, torch.Tensor]:
    return points[0] + torch.tensor([4e5, 5e6, 0.0], dtype=torch.float64), points[1]


def test_no_more_photographs_are_read_than_asked_for(tmp_path, monkeypatch):
    read = []
    usual = evidence.read_file
    monkeypatch.setattr(evidence, "read_file", lambda path, largest: read.append(path.name) or usual(path, largest))
    found = plan_capture(write_wall(tmp_path / "wall"), most=4)
    assert sorted(read) == ["p_0.png", "p_2.png", "p_5.png", "p_7.png"]
    assert (found.photographs, found.looked_at) == (10, 4)
    with pytest.raises(ValueError, match="most must be at least 1, got 0"):
        plan_capture(tmp_path / "wall", most=0)


def test_tracks(tmp_path):
    """Rows of points, of which those that are not finite are left out, by the names of views."""
    points, colors = wall_points(20)
    points[4, 1] = math.nan
    write_tracked(tmp_path / "sparse", cameras()[:3], points, colors)
    tracks = colmap.load_tracks(tmp_path / "sparse")
    with pytest.warns(UserWarning, match="1 of 20 points are not finite"):
        kept, _ = colmap.load_points(tmp_path / "sparse")
    for view in cameras()[:3]:
        pixels = view.pixels_of(kept @ view.w2c[:3, :3].T + view.w2c[:3, 3])
        shown = ((pixels >= 0) & (pixels < torch.tensor(SIZE))).all(1)
        assert torch.equal(tracks[view.name].sort().values, shown.nonzero()[:, 0])


def test_tracks_of_texts(tmp_path):
    views = cameras()[:2]
    write_colmap_text(tmp_path / "text", views, *wall_points(3))
    assert colmap.load_tracks(tmp_path / "text") == {}
    path = tmp_path / "text" / "images.txt"
    path.write_text(path.read_text().replace("1.0 2.0 -1", "1.0 2.0 2 3.5 4.5 -1 5 6 0 7 8 99"))
    assert {name: rows.tolist() for name, rows in colmap.load_tracks(tmp_path / "text").items()} == {"p_1": [0, 2]}
    path.write_text(path.read_text().replace("1.0 2.0 2", "1.0 2.0 x"))
    with pytest.raises(io.SceneError, match="invalid literal"):
        colmap.load_tracks(tmp_path / "text")
    assert len(colmap.load_views(tmp_path / "text")) == 2  # which do not need them


def test_medians():
    values = torch.tensor([5.0, 1.0, 2.0, 9.0, 4.0], dtype=torch.float64)
    found = medians_of(values, torch.tensor([2, 0, 2, 2, 0]), 4)
    assert found[[0, 2]].tolist() == [2.5, 5.0] and found[[1, 3]].isnan().all()


def test_options_are_those_of_train():
    source = Path(plan.__file__).read_text(encoding="utf-8")
    named = dict(re.findall(r'{"([a-z]+)": "([a-z]+)"}', source))
    corrections = {"exposure": "affine", "vignetting": "polynomial"}
    assert named == {**corrections, "lens": "keep", "masks": "auto", "missing": "skip"}
    for name, value in {**named, "scales": plan.SCALES}.items():
        words = as_words({name: value}).split(" ")
        assert getattr(cli.build_parser().parse_args(["train", "SCENE", "--out", "DIR", *words]), name) == value


def test_inspect_of_a_capture(tmp_path, capsys):
    folder = write_wall(tmp_path / "wall", gains=lambda i: (2 ** (0.5 - i % 2),) * 3)
    out = tmp_path / "plan.json"
    assert cli.main(["inspect", str(folder), "--json", str(out), "--max-views", "8"]) == 0
    text = capsys.readouterr().out
    assert "looked at 8 of 10 photographs" in text and text.endswith("calls for: --exposure affine\n")
    data = json.loads(out.read_text())
    assert data["options"] == {"exposure": "affine"} and len(data["findings"]) == len(EVEN)
    assert set(data["findings"][0]) == {"effect", "number", "unit", "verdict", "option", "reason", "photographs"}
    assert cli.main(["inspect", str(folder), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["photographs"] == 10


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--views", "views.json"], "--views is for scenes, and wall is a capture"),
        (["--scales", "2"], "--scales is for scenes, and wall is a capture"),
        (["--cameras", "sparse/7"], "sparse/7: no such file or folder of cameras"),
        (["--images", "photos"], "photos: no such folder"),
        (["--json", "."], ".: expected a file for the results, got a folder"),
    ],
)
def test_errors_of_a_capture_are_one_line(tmp_path, capsys, monkeypatch, extra, message):
    write_wall(tmp_path / "wall")
    monkeypatch.chdir(tmp_path)
    err = refused(capsys, cli.main, ["inspect", "wall", *extra])
    assert message in err


def test_a_broken_picture_is_named(tmp_path, capsys):
    folder = write_wall(tmp_path / "wall")
    path = folder / "images" / "p_1.png"
    path.write_bytes(path.read_bytes()[:200])
    assert cli.main(["inspect", str(folder)]) == 0
    found = r"missing pictures yes        1 files are not there, or cannot be read; images/p_1.png; --missing skip"
    assert found in capsys.readouterr().out.splitlines()


def real_capture(name):
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    return folder


@pytest.mark.parametrize(
    ("name", "exposure", "blurred"),
    [("mouse", {YES}, True), ("bonsai", {NO, NOT_KNOWN}, False), ("fox", {YES, NOT_KNOWN}, False)],
)
def test_real_captures(name, exposure, blurred):
    """A phone's exposure varies in mouse and fox; that of bonsai looks even. Only the files of mouse have tracks."""
    found = plan_of(real_capture(name), most=24)
    assert found["exposure"].verdict in exposure
    assert (found["blur"].number > 0) == blurred
    assert found["lens"].verdict == found["scales"].verdict == NO


def test_real_photographs_with_effects(monkeypatch):
    """Every second photograph of bonsai a stop brighter than the others, and one in ten blurred by 1 px."""
    folder, usual = real_capture("bonsai"), evidence.read_file
    items = evidence.spread_out(sorted((folder / "images").iterdir()), 20)
    blurred = {path.name for path in items[3::10]}

    def changed(path, largest):
        rgba = usual(path, largest).rgba.permute(2, 0, 1)[:, None].double() / 255
        light = evidence._linear(rgba[:3]) * 2 ** (0.5 - items.index(path) % 2)
        planes = torch.cat([torch.from_numpy(stored(light.numpy())), rgba[3:]])
        planes = evidence._blurred(planes) if path.name in blurred else planes
        return Stored((255 * planes[:, 0].permute(1, 2, 0)).round().to(torch.uint8), 1)

    monkeypatch.setattr(evidence, "read_file", changed)
    found = plan_of(folder, most=20)
    noise = max(EXPOSURE[False])  # without tracks
    assert found["exposure"].verdict == YES and found["exposure"].number == pytest.approx(0.5, abs=noise)
    assert set(found["blur"].photographs) == blurred and len(blurred) == 2


def lights(count: int, uneven: float) -> tuple:
    """Evidence of an object without points in photographs from all around, directions of the cameras, and stops."""
    generator = torch.Generator().manual_seed(1)
    axes = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    usual = -2 + axes @ torch.tensor([[0.4, 0.3, 0.5], [0.2, 0.1, 0.0], [1.0, 0.9, 0.7]], dtype=torch.float64)
    usual += 0.3 * axes[:, :1] * axes[:, 1:2]
    stops = uneven * (torch.arange(count) % 2 - 0.5)[:, None] * torch.tensor([1.0, 1.0, 0.5], dtype=torch.float64)
    none, seen = torch.zeros(0, dtype=torch.float64), torch.ones(count, dtype=torch.bool)
    rows = (none.long(), none.long(), none, none, none, none, none, none.long(), seen)
    return evidence.Evidence(count, 0, *rows, light=2 ** (usual + stops)), axes, stops


def test_exposure_of_an_object_without_points():
    found, axes, stops = lights(60, 0.6)
    assert (evidence.object_stops(found, axes) - stops).abs().median() < 0.1
    assert evidence.object_stops(lights(60, 0.0)[0], axes).abs().max() < 1e-9
    opaque = found._replace(transparent=torch.arange(60) > 0)
    for unknown, directions in ((opaque, axes), (lights(20, 0.6)[0], axes[:20])):
        assert evidence.object_stops(unknown, directions).isnan().all()


@pytest.mark.parametrize("gain, verdict", [(1.0, NO), (2.0, YES)])
def test_a_cut_out_object_with_uneven_exposure(tmp_path, gain, verdict):
    """Which has no points, as NeRF-synthetic's."""
    (tmp_path / "train").mkdir()
    disk = 255.0 * (np.hypot(*np.mgrid[-12:12, -12:12]) < 9)[..., None]
    frames = []
    for i in range(42):
        light = 0.15 * (gain if i % 2 else 1.0) * (1 + 0.3 * math.sin(0.15 * i)) * np.ones((24, 24, 3))
        pixels = np.concatenate([255 * stored(light), disk], 2).round().astype(np.uint8)
        image.fromarray(pixels).save(tmp_path / "train" / f"r_{i}.png")
        pose = torch.linalg.inv(looking_at_origin(0.15 * i))
        pose[:3, 1:3] *= -1
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": 2 * math.atan(0.5), "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    found = plan_of(tmp_path)
    assert (found["exposure"].verdict, found["white balance"].verdict) == (verdict, NO)
    assert found["exposure"].number == pytest.approx(math.log2(gain) / 2, abs=0.05)
