"""The one warning where nobody chose a footprint: to programs that only render, once, and to no others."""

import warnings

import originals
import pytest
import torch
from originals import ORIGINALS, scene_of, settings_of
from processes import run_python

import analytic_rasterizer as ar
from analytic_rasterizer import _C, advice, dialects
from analytic_rasterizer.dialects.gsplat import rasterization

pytestmark = pytest.mark.usefixtures("nothing_chosen")

TAKE_THE_DEFAULT = ("gs2023", "gs2024", "accel")
SCENE = {name: value for name, value in scene_of().items() if name != "means2D"} | {"means2D": None}
SETTINGS = originals.CAMERA.settings(torch.float32)


@pytest.fixture
def fresh(monkeypatch):
    """As in a process that has rendered nothing yet."""
    monkeypatch.setattr(advice, "is_due", True)
    monkeypatch.setattr(_C, "gradient_was_required", lambda: False)


def told(call):
    """The warnings of a call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return caught


def library(**options):
    return lambda: ar.GaussianRasterizer(SETTINGS._replace(**options))(**SCENE)


def function():
    names = "means3D", "means2D", "shs", "colors_precomp", "opacities", "scales", "rotations", "cov3D_precomp"
    ar.rasterize_gaussians(*(SCENE.get(name) for name in names), SETTINGS)


@pytest.mark.parametrize(
    "call", [library(), library(effects=ar.Effects(alpha=True)), function], ids=["library", "effects", "function"]
)
def test_a_program_that_only_renders_is_told_once(fresh, call):
    (warning,) = told(call)
    assert warning.category is UserWarning
    for part in ("analytic", "parity with the paper", "3DGS's own rasterizer", "ANALYTIC_RASTERIZER_FOOTPRINT=point"):
        assert part in str(warning.message)
    assert warning.filename == __file__
    assert told(call) == [] and not advice.is_due


@pytest.mark.parametrize("name", ORIGINALS)
def test_dialects(fresh, name):
    """Those that have a filter of their own decide by it."""
    caught = told(lambda: originals.render(name))
    assert len(caught) == (name in TAKE_THE_DEFAULT)
    assert all(warning.filename == originals.__file__ for warning in caught)
    assert settings_of(name).takes_default() == (name in TAKE_THE_DEFAULT)
    assert not settings_of(name, footprint="analytic").takes_default()


def test_a_dialect_that_decides_leaves_the_warning_to_others(fresh):
    assert told(lambda: originals.render("mip")) == []
    assert len(told(library())) == 1


def test_what_the_user_chose(fresh, monkeypatch):
    assert told(library(footprint="analytic")) == []
    assert len(told(library())) == 1
    for choose in (
        lambda: ar.set_default_footprint("analytic"),
        lambda: monkeypatch.setenv("ANALYTIC_RASTERIZER_FOOTPRINT", "point"),
    ):
        advice.is_due = True
        choose()
        assert told(library()) == [] and not advice.is_due
        ar.set_default_footprint(None)


def test_the_companion_of_mini_splatting(fresh, monkeypatch):
    monkeypatch.setattr(dialects._base, "_companion_filter", "point")
    assert told(lambda: originals.render("gs2023")) == []


def test_other_calls_say_nothing(fresh):
    """Stages have settings too, and gsplat's call has filters of its own."""
    stages = {name: value for name, value in SCENE.items() if name != "means2D"}

    def calls():
        ar.blend(splats := ar.project(SETTINGS, **stages), ar.list_tiles(splats))
        ar.render_stages(SETTINGS, **stages)
        ar.GaussianRasterizer(SETTINGS).markVisible(SCENE["means3D"])
        means, quats, scales, opacities = (SCENE[n] for n in ("means3D", "rotations", "scales", "opacities"))
        view, intrinsics = torch.eye(4)[None], torch.diag(torch.tensor([9.0, 9.0, 1.0]))[None]
        rasterization(means, quats, scales, opacities[:, 0], means, view, intrinsics, 16, 16)

    assert told(calls) == [] and advice.is_due


def test_a_warning_that_is_an_error_is_raised_once(fresh):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="no footprint was chosen"):
            library()()
        library()()


def test_torch_compile_sees_nothing_of_it(fresh):
    compiled = torch.compile(lambda scene: 2 * library()()[0], backend="eager", fullgraph=True)
    assert told(lambda: compiled(SCENE)) == []
    advice.is_due = False
    torch._dynamo.config.error_on_recompile = True
    try:
        compiled(SCENE)
    finally:
        torch._dynamo.config.error_on_recompile = False


PROGRAM = """
import sys, warnings
import torch
from originals import CAMERA, scene_of
import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in

def picture(scene, **options):
    settings = drop_in.GaussianRasterizationSettings(**CAMERA.fields(torch.float32), **options)
    return drop_in.GaussianRasterizer(settings)(means2D=None, **scene)[0]

scene = {name: t for name, t in scene_of().items() if name != "means2D"}
leaves = {name: t.clone().requires_grad_() for name, t in scene.items()}
warnings.simplefilter("always")
with warnings.catch_warnings(record=True) as caught:
    exec(sys.argv[1])
print(len(caught), *(warning.lineno for warning in caught))
"""
RENDERS = PROGRAM[: PROGRAM.index("    return drop_in")].count("\n") + 1


@pytest.mark.parametrize(
    "program, count",
    [
        ("with torch.no_grad(): [picture(leaves) for _ in range(3)]", 1),  # an evaluation of a model
        ("for _ in range(2): picture(leaves).sum().backward()\nwith torch.no_grad(): picture(leaves)", 0),
        ("picture(leaves, footprint='box').sum().backward(); picture(scene)", 0),  # a training that chose for itself
        ("ar.activations.activate(leaves['scales'], leaves['rotations'], leaves['opacities']); picture(scene)", 0),
        ("picture(scene, footprint='box'); picture(scene); picture(leaves); picture(scene)", 1),
    ],
)
def test_whole_processes(program, count):
    environment = {"ANALYTIC_RASTERIZER_FOOTPRINT": "", "ANALYTIC_RASTERIZER_DIALECT": ""}
    found, *lines = run_python(PROGRAM, program, **environment).split()
    assert int(found) == count and lines == [str(RENDERS)] * count
