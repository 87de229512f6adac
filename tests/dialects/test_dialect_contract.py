"""What every program that imports diff_gaussian_rasterization relies on: clause by clause, on the default dialect."""

import inspect
import pickle

import pytest
import torch
from originals import BASE

import diff_gaussian_rasterization as module
from diff_gaussian_rasterization import GaussianRasterizationSettings as Settings
from diff_gaussian_rasterization import GaussianRasterizer as Rasterizer

pytestmark = pytest.mark.usefixtures("nothing_chosen")

COUNT = 200


class Program:
    """A camera and Gaussians, and the picture that every way of asking for it has to give."""

    def __init__(self, device):
        self.device = device
        generator = torch.Generator().manual_seed(0)
        rand = lambda *shape: torch.rand(*shape, generator=generator).to(device)  # noqa: E731
        randn = lambda *shape: torch.randn(*shape, generator=generator).to(device)  # noqa: E731
        view = torch.eye(4)
        view[3, 2] = 4
        lens = torch.tensor([[2.4, 0, 0, 0], [0, 2.4, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])
        self.view, self.lens = view.to(device), lens.to(device)
        bg, campos = torch.tensor([0.1, 0.2, 0.3], device=device), torch.tensor([0.0, 0, -4], device=device)
        values = 32, 48, 0.4, 0.4, bg, 1.0, self.view, self.view @ self.lens, 1, campos, False, False
        self.camera = dict(zip(BASE, values, strict=True))
        self.scene = {"means3D": randn(COUNT, 3), "opacities": rand(COUNT, 1), "shs": 0.1 * randn(COUNT, 4, 3)}
        self.scene |= {"scales": 0.1 * rand(COUNT, 3), "rotations": randn(COUNT, 4)}
        self.picture = self.render()
        assert (self.picture[0] - self.camera["bg"][:, None, None]).abs().max() > 0.1

    def render(self, scene=(), means2D=None, **camera):
        return Rasterizer(Settings(**{**self.camera, **camera}))(means2D=means2D, **{**self.scene, **dict(scene)})

    def gives_the_picture(self, made):
        return len(made) == 2 and all(map(torch.equal, made, self.picture))

    def gradient_of(self, columns):
        points = torch.zeros(COUNT, columns, device=self.device, requires_grad=True)
        self.render(means2D=points)[0].square().sum().backward()
        return points.grad


@pytest.fixture
def program(device):
    return Program(device)


EMPTY = torch.Tensor([])  # on the CPU, whatever the device
SAME_PICTURE = {
    "settings by position": lambda p: Rasterizer(Settings(*p.camera.values()))(means2D=None, **p.scene),
    "arguments by position": lambda p: Rasterizer(Settings(**p.camera))(
        *(p.scene.get(key) for key in ("means3D", "means2D", "opacities", "shs", "colors", "scales", "rotations"))
    ),
    "empty tensors for what is missing": lambda p: p.render({"colors_precomp": EMPTY, "cov3D_precomp": EMPTY}),
    "the function": lambda p: module.rasterize_gaussians(
        p.scene["means3D"], None, p.scene["shs"], EMPTY, p.scene["opacities"], p.scene["scales"], p.scene["rotations"],
        EMPTY, Settings(**p.camera),
    ),
    "matrices (1, 4, 4), transposed in memory": lambda p: p.render(
        viewmatrix=p.view.T.contiguous().T[None], projmatrix=p.camera["projmatrix"][None]
    ),
    "tangents as tensors": lambda p: p.render(
        tanfovx=torch.tensor(0.4, dtype=torch.float64), tanfovy=torch.tensor(0.4, dtype=torch.float64)
    ),
    "opacities (P,)": lambda p: p.render({"opacities": p.scene["opacities"].squeeze(1)}),
    "16 rows of harmonics for degree 1": lambda p: p.render(
        {"shs": torch.cat([p.scene["shs"], torch.ones(COUNT, 12, 3, device=p.device)], 1)}
    ),
    "debug": lambda p: p.render(debug=True),
}  # fmt: skip


@pytest.mark.parametrize("asked", SAME_PICTURE.values(), ids=SAME_PICTURE)
def test_ways_of_asking_for_the_same(program, asked):
    assert program.gives_the_picture(asked(program))


def test_no_gaussians_show_the_background(program):
    color, radii = program.render({key: value[:0] for key, value in program.scene.items()})
    assert torch.equal(color, program.camera["bg"][:, None, None].expand(3, 32, 48)) and len(radii) == 0


def test_settings_are_a_named_tuple(program):
    settings = Settings(**program.camera)
    assert settings._replace(debug=True).debug and not settings.debug
    assert pickle.loads(pickle.dumps(settings)).image_width == 48
    assert list(inspect.signature(Settings).parameters) == list(program.camera) == list(Settings._fields)


def test_radii_and_visibility(program):
    radii = program.picture[1]
    assert radii.dtype == torch.int32 and (radii > 0).any() and (radii == 0).any()
    visible = Rasterizer(Settings(**program.camera)).markVisible(program.scene["means3D"])
    assert visible.dtype == torch.bool and visible[radii > 0].all()


def test_gradients_of_projected_means(program):
    """The third of three columns is zero in 3DGS 2023; of four, the last two add up absolute values."""
    three, four = program.gradient_of(3), program.gradient_of(4)
    assert (three[:, :2] != 0).any() and (three[:, 2] == 0).all()
    assert torch.equal(four[:, :2], three[:, :2]) and (four[:, 2:] >= four[:, :2].abs() - 1e-5).all()
    assert (four[:, 2:] > four[:, :2].abs() + 1e-5).any()


def test_colours_and_harmonics_are_an_error(program):
    with pytest.raises(Exception, match="shs and colors_precomp"):
        program.render({"colors_precomp": torch.rand(COUNT, 3, device=program.device)})


def test_names_of_the_module(program):
    from diff_gaussian_rasterization import _C

    assert all(hasattr(_C, name) for name in ("rasterize_gaussians", "rasterize_gaussians_backward", "mark_visible"))
    assert hasattr(module, "set_dialect")


def test_settings_of_other_repositories_decide_what_is_returned(program):
    """How many values there are, without a choice of the user."""
    without_debug = {key: value for key, value in program.camera.items() if key != "debug"}
    assert len(program.render(antialiasing=False)) == 3
    assert len(program.render(kernel_size=0.1, subpixel_offset=torch.zeros(32, 48, 2, device=program.device))) == 2
    assert len(program.render(projmatrix_raw=program.lens)) == 5
    assert len(Rasterizer(Settings(**without_debug))(means2D=None, **program.scene)) == 3
