"""What docs/conventions.md says of pixel centres, poses, quaternions and cameras from elsewhere."""

import json
import math

import pytest
import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.dialects import gsplat

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
POINT = torch.tensor([[0.3, 0.2, 0.5]], dtype=torch.float64)


@pytest.fixture
def view():
    w2c = ar.moved(
        torch.eye(4, dtype=torch.float64), torch.tensor([0.1, -0.2, 3.0, 0.1, 0.2, 0.3], dtype=torch.float64)
    )
    return ar.View("a", 64, 48, 50.0, 52.0, w2c, cx=30.0, cy=26.0)


def seen(view):
    return view.pixels_of((view.w2c[:3, :3] @ POINT.T).T + view.w2c[:3, 3])[0]


def small_gaussian(dtype):
    return {
        "opacities": torch.full((1, 1), 0.01, dtype=dtype),  # faint: alpha is proportional to the weight
        "colors_precomp": torch.ones(1, 3, dtype=dtype),
        "scales": torch.full((1, 3), 0.1, dtype=dtype),
        "rotations": torch.tensor([[1.0, 0, 0, 0]], dtype=dtype),
    }


def test_pinhole(view):
    x, y, z = (view.w2c[:3, :3] @ POINT[0] + view.w2c[:3, 3]).tolist()
    assert seen(view).tolist() == pytest.approx([view.fx * x / z + view.cx, view.fy * y / z + view.cy], rel=1e-12)


def test_pixel_centres(view):
    """(0, 0) is a corner for View; for splats it is the centre of the first pixel."""
    settings = view.settings(sh_degree=0, footprint="box:samples=1", dtype=torch.float64)
    gaussian = small_gaussian(torch.float64)
    splats = ar.project(settings, POINT, **gaussian)
    torch.testing.assert_close(splats.means2d[0], seen(view) - 0.5, rtol=0, atol=1e-9)
    image, _ = ar.GaussianRasterizer(settings)(POINT, None, **gaussian)
    column, row = splats.means2d[0].round().long().tolist()
    offset = torch.tensor([column, row], dtype=torch.float64) - splats.means2d[0]
    expected = 0.01 * ar.footprint_weight(offset, splats.cov2d[0], "box", samples=1)
    assert image[0, row, column].item() == pytest.approx(expected.item(), rel=1e-6)


def test_gsplat_counts_from_the_corner(view):
    scene = small_gaussian(torch.float64)
    k = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], dtype=torch.float64)
    _, _, meta = gsplat.rasterization(
        POINT, scene["rotations"], scene["scales"], scene["opacities"][:, 0], scene["colors_precomp"],
        view.w2c[None], k[None], view.width, view.height, packed=False,
    )  # fmt: skip
    torch.testing.assert_close(meta["means2d"][0, 0], seen(view), rtol=0, atol=1e-6)


def test_quaternions_turn_gaussians_to_the_world(view):
    """(w, x, y, z) of a quarter turn about z: the long axis x becomes y."""
    upright = torch.eye(4, dtype=torch.float64)
    upright[2, 3] = 3
    settings = ar.View("b", 64, 48, 50.0, 50.0, upright).settings(sh_degree=0, dtype=torch.float64)
    gaussian = small_gaussian(torch.float64) | {
        "scales": torch.tensor([[0.3, 0.01, 0.01]], dtype=torch.float64),
        "rotations": torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]], dtype=torch.float64),
    }
    xx, xy, yy = ar.project(settings, torch.zeros(1, 3, dtype=torch.float64), **gaussian).cov2d[0].tolist()
    assert yy > 100 * xx and abs(xy) < 1e-6 * yy


@pytest.mark.parametrize("form", ["nerfstudio", "cameras.json", "w2c"])
def test_cameras_there_and_back(view, form, tmp_path):
    file = tmp_path / "cameras.json"
    if form == "nerfstudio":
        c2w = torch.linalg.inv(view.w2c) @ FLIP
        torch.testing.assert_close(torch.linalg.inv(c2w @ FLIP), view.w2c, rtol=0, atol=1e-12)
        size = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 52.0, "cx": 30.0, "cy": 26.0}
        file.write_text(json.dumps(size | {"frames": [{"file_path": "a.png", "transform_matrix": c2w.tolist()}]}))
    elif form == "cameras.json":
        c2w = torch.linalg.inv(view.w2c)
        pose = {"rotation": c2w[:3, :3].tolist(), "position": c2w[:3, 3].tolist()}
        size = {"width": 64, "height": 48, "fx": 50.0, "fy": 52.0, "cx": 30.0, "cy": 26.0}
        file.write_text(json.dumps([{"id": 0, "img_name": "a"} | size | pose]))
    else:
        io.save_views(file, [view])
    read = io.load_views(file)[0]
    torch.testing.assert_close(read.w2c, view.w2c, rtol=0, atol=1e-12)
    torch.testing.assert_close(seen(read), seen(view), rtol=0, atol=1e-9)
