"""The contract with code that was written for other rasterizers, and with wrong input."""

import collections
import copy
import dataclasses
import functools
import inspect
import math
import pickle
import types

import originals
import pytest
import reference
import scenes
import torch
import torch.utils._pytree
from marks import each_path, each_precision
from op_calls import Calls
from processes import run_python
from scenes import PATHS, RENDERED, Camera, name_of
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv

import analytic_rasterizer as ar
from analytic_rasterizer import _C, rasterizer
from analytic_rasterizer.footprints import check_device

FIELDS = tuple(originals.BASE)
CAMERA = Camera(bg=(0.2, 0.5, 0.9), sh_degree=1)
Settings = ar.GaussianRasterizationSettings

FULL = ar.Effects(
    camera_gradients=True,
    defocus=ar.Defocus(0.1, 3.0),
    motion=ar.Motion(1.0, velocity=(0.1, -0.2, 0.1), screen_velocity=(3.0, 2.0)),
)
each_camera = pytest.mark.parametrize("effects", [None, FULL], ids=["plain", "full"])


@pytest.fixture(autouse=True)
def no_default_footprint(monkeypatch):
    monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT", raising=False)
    ar.set_default_footprint(None)
    yield
    ar.set_default_footprint(None)


def scene32(device="cpu", seed=1, count=20, degree=1):
    return scenes.cast(scenes.random_scene(seed, count, degree), torch.float32, device)


def render(scene, settings=None):
    settings = settings or CAMERA.settings(torch.float32, scene["means3D"].device)
    return ar.GaussianRasterizer(settings)(**scene)


def gradients(scene, settings=None):
    """(color, radii, gradients by name) of sum(color * fixed weights)."""
    leaves = scenes.leaves(scene)
    color, radii = render(leaves, settings)
    (color * scenes.probe(color)).sum().backward()
    return color.detach(), radii, {name: leaf.grad for name, leaf in leaves.items()}


# --- names and settings ------------------------------------------------------------------------


def test_public_names():
    classes = {"GaussianRasterizationSettings", "GaussianRasterizer"}
    functions = {"rasterize_gaussians", "render_stages", "footprint_weight"}
    assert classes | functions | {"FOOTPRINTS", "TILE"} <= set(ar.__all__)
    assert {"get_default_footprint", "set_default_footprint"} <= set(ar.__all__)
    assert all(hasattr(ar, name) for name in ar.__all__)


def test_import_under_the_name_existing_code_uses(nothing_chosen):
    import diff_gaussian_rasterization as drop_in

    # Classes of their own, which follow a dialect (test_dialects.py); those of the library do not.
    assert issubclass(drop_in.GaussianRasterizationSettings, ar.GaussianRasterizationSettings)
    assert issubclass(drop_in.GaussianRasterizer, ar.GaussianRasterizer)
    settings = drop_in.GaussianRasterizationSettings(**CAMERA.fields(torch.float32))
    scene = scene32()
    for made in (drop_in.GaussianRasterizer(settings)(**scene), ar.GaussianRasterizer(settings)(**scene)):
        assert all(map(torch.equal, made, render(scene)))
    # Its mere presence makes 3DGS take another code path.
    assert not hasattr(drop_in, "SparseGaussianAdam")


def test_settings_look_like_those_of_3dgs_2023():
    """Downstream code probes _fields and the signature: neither may show more."""
    assert Settings._fields == FIELDS
    assert tuple(inspect.signature(Settings).parameters) == FIELDS
    assert all(p.default is inspect.Parameter.empty for p in inspect.signature(Settings).parameters.values())


@pytest.mark.parametrize("extra", [{}, {"footprint": "box", "samples": 16}], ids=["plain", "box"])
def test_settings_are_a_tuple(extra):
    fields = CAMERA.fields()
    by_keyword = Settings(**fields, **extra)
    by_position = Settings(*fields.values(), **extra)
    for settings in (by_keyword, by_position):
        assert isinstance(settings, tuple)
        assert len(settings) == 12
        assert [*settings] == [*fields.values()]
        assert settings[1] == settings.image_width == 45
        assert settings._asdict() == fields
        height, width, *rest = settings
        assert (height, width, len(rest)) == (37, 45, 10)
    assert by_keyword.footprint == by_position.footprint


def test_settings_are_equal_where_footprint_and_effects_are_too():
    settings = Settings(**CAMERA.fields())
    variants = [
        settings,
        settings._replace(footprint="box", samples=4),
        settings._replace(footprint="box", samples=16),
        settings._replace(effects=ar.Effects(alpha=True)),
        settings._replace(effects=ar.Effects(filter_3d=torch.ones(3))),
        settings._replace(effects="auto"),
        settings._replace(image_width=46),
    ]
    for i, one in enumerate(variants):
        for j, other in enumerate(variants):
            assert (one == other, one != other) == (i == j, i != j)
    same = variants[1]._replace(samples=4, footprint="box")
    assert same is not variants[1] and same == variants[1] and hash(same) == hash(variants[1])
    assert settings == tuple(settings) and tuple(settings) == settings and settings != tuple(variants[-1])


def test_missing_and_unknown_fields():
    fields = CAMERA.fields()
    with pytest.raises(TypeError):
        Settings(**{k: v for k, v in fields.items() if k != "debug"})
    with pytest.raises(TypeError, match=r"got antialias$"):
        Settings(**fields, antialias=True)
    with pytest.raises(TypeError, match=r"got footprnt; did you mean footprint\?$"):
        Settings(**fields, footprnt="box")
    with pytest.raises(TypeError):
        Settings(*fields.values(), False)
    with pytest.raises((TypeError, ValueError), match="samples"):
        Settings(**fields, samples=4)  # an option without its footprint


BOX16 = {"footprint": "box", "samples": 16}


def assert_same_footprint(settings, expected):
    scene = scene32()
    assert torch.equal(render(scene, settings)[0], render(scene, expected)[0])


@pytest.mark.parametrize(
    "how",
    [
        lambda s: s._replace(bg=s.bg),
        copy.copy,
        copy.deepcopy,
        lambda s: pickle.loads(pickle.dumps(s)),
        lambda s: Settings(*s, footprint=s.footprint),
    ],
    ids=["_replace", "copy", "deepcopy", "pickle", "rebuilt"],
)
def test_copies_keep_the_footprint(how):
    settings = CAMERA.settings(torch.float32, **BOX16)
    duplicate = how(settings)
    assert type(duplicate) is Settings
    assert duplicate._fields == FIELDS
    assert str(duplicate.footprint) == str(settings.footprint)
    assert_same_footprint(duplicate, settings)


def test_replace():
    settings = CAMERA.settings(torch.float32, **BOX16)
    smaller = settings._replace(image_height=10)
    assert smaller.image_height == 10
    assert settings.image_height == 37
    assert render(scene32(), smaller)[0].shape == (3, 10, 45)
    assert_same_footprint(settings._replace(footprint="mip"), CAMERA.settings(torch.float32, footprint="mip"))
    with pytest.raises((TypeError, ValueError), match="nonsense"):
        settings._replace(nonsense=1)


def test_make():
    """NamedTuple's other constructor."""
    settings = Settings._make(CAMERA.fields(torch.float32).values())
    assert type(settings) is Settings
    assert_same_footprint(settings, CAMERA.settings(torch.float32))
    assert "image_height=37" in repr(settings)


def test_settings_without_footprint_follow_the_default():
    """The default is looked up when rendering, so set_default_footprint works on existing code."""
    settings = CAMERA.settings(torch.float32)
    expected = {name_of(v): render(scene32(), CAMERA.settings(torch.float32, variant=v))[0] for v in RENDERED}
    assert torch.equal(render(scene32(), settings)[0], expected["analytic-frozen"])
    ar.set_default_footprint("box", samples=1)
    assert torch.equal(render(scene32(), settings)[0], expected["box-1"])
    ar.set_default_footprint("point:dilation=0")
    assert str(ar.get_default_footprint()).startswith("point")
    assert torch.equal(render(scene32(), settings)[0], expected["point-0.0"])
    with pytest.raises(ValueError, match=r"footprint must .*'nonsense'"):
        ar.set_default_footprint("nonsense")
    assert torch.equal(render(scene32(), settings)[0], expected["point-0.0"])
    # An explicit footprint is not touched by the default.
    explicit = CAMERA.settings(torch.float32, footprint="mip")
    assert torch.equal(render(scene32(), explicit)[0], expected["mip"])
    assert not torch.equal(expected["mip"], expected["point-0.0"])


def test_environment_variable(monkeypatch):
    variable = "ANALYTIC_RASTERIZER_FOOTPRINT"
    monkeypatch.setenv(variable, "box:samples=1")
    assert str(ar.get_default_footprint()) == "box:samples=1"
    assert_same_footprint(CAMERA.settings(torch.float32), CAMERA.settings(torch.float32, footprint="box", samples=1))
    ar.set_default_footprint("mip")  # the call wins over the variable
    assert ar.get_default_footprint().name == "mip"
    ar.set_default_footprint(None)
    monkeypatch.setenv(variable, "")
    assert ar.get_default_footprint().name == "analytic"
    monkeypatch.setenv(variable, "bocks")
    with pytest.raises(ValueError, match=r"ANALYTIC_RASTERIZER_FOOTPRINT.*bocks"):
        ar.get_default_footprint()


def test_environment_variable_of_a_new_process():
    """As a user sets it: outside, for a script that only knows the old import."""
    code = "import diff_gaussian_rasterization, analytic_rasterizer as ar;print(ar.get_default_footprint())"
    assert run_python(code, ANALYTIC_RASTERIZER_FOOTPRINT="cumulant").strip() == "cumulant"


# --- what is accepted --------------------------------------------------------------------------


def test_call_forms_agree(device):
    """Keywords, positions, the function, with and without gradients."""
    scene = scene32(device)
    settings = CAMERA.settings(torch.float32, device)
    expected, radii = render(scene, settings)
    assert expected.dtype == torch.float32
    assert radii.dtype == torch.int32
    assert expected.device == radii.device == scene["means3D"].device
    rasterizer = ar.GaussianRasterizer(raster_settings=settings)
    assert isinstance(rasterizer, torch.nn.Module)
    order = "means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations"
    positional = rasterizer(*map(scene.get, order))
    order = "means3D", "means2D", "shs", "colors_precomp", "opacities", "scales", "rotations", "cov3D_precomp"
    functional = ar.rasterize_gaussians(*map(scene.get, order), settings)
    with torch.no_grad():
        inference = render(scenes.leaves(scene), settings)
    tracked = render(scenes.leaves(scene), settings)
    assert tracked[0].requires_grad
    assert not tracked[1].requires_grad
    assert not inference[0].requires_grad
    for result in (positional, functional, inference, tracked):
        assert len(result) == 2
        assert torch.equal(result[0], expected)
        assert torch.equal(result[1], radii)


def test_some_inputs_without_gradient(device):
    scene = scene32(device)
    _, _, full = gradients(scene)
    for name in scene:
        leaves = {k: v.clone().requires_grad_(k == name) for k, v in scene.items()}
        color, _ = render(leaves)
        (color * scenes.probe(color)).sum().backward()
        assert torch.equal(leaves[name].grad, full[name]), name
        assert all(leaf.grad is None for k, leaf in leaves.items() if k != name)


def test_gradients_accumulate_and_the_graph_can_be_kept(device):
    leaves = scenes.leaves(scene32(device))
    color, _ = render(leaves)
    color.sum().backward(retain_graph=True)
    once = {name: leaf.grad.clone() for name, leaf in leaves.items()}
    color.sum().backward()
    for name, leaf in leaves.items():
        assert torch.equal(leaf.grad, 2 * once[name]), name


def test_image_gradients_of_any_layout(device):
    """An expanded gradient (sum), a strided one (transpose), a lazily negated one, and a partial one (slice)."""
    scene = scene32(device)
    leaves = scenes.leaves(scene)
    color, _ = render(leaves)
    by_sum = torch.autograd.grad(color.sum(), leaves["means3D"], retain_graph=True)[0]
    ones = torch.ones(37, 3, 45, device=device).transpose(0, 1)
    assert not ones.is_contiguous()
    by_strided = torch.autograd.grad(color, leaves["means3D"], ones, retain_graph=True)[0]
    assert torch.equal(by_sum, by_strided)
    negated = torch._neg_view(torch.full_like(color, -1.0))
    assert torch.equal(by_sum, torch.autograd.grad(color, leaves["means3D"], negated, retain_graph=True)[0])
    sums = color[:, :20].sum(), color[:, 20:].sum()
    parts = [torch.autograd.grad(part, leaves["means3D"], retain_graph=True)[0] for part in sums]
    # Two float32 sums in another order: 37 * 45 terms, far from cancelling to 1e-3.
    assert (sum(parts) - by_sum).abs().max() < 1e-4 * by_sum.abs().max()


def test_a_second_derivative_is_refused(device):
    """Not implemented: it must say so, not return something."""
    leaves = scenes.leaves(scene32(device))
    color, _ = render(leaves)
    first = torch.autograd.grad((color**2).sum(), leaves["means3D"], create_graph=True)[0]
    with pytest.raises(RuntimeError):
        first.sum().backward()
    offset = torch.tensor([0.3, 0.2], device=device, requires_grad=True)
    value = ar.footprint_weight(offset, torch.tensor([1.0, 0.0, 2.0], device=device))
    first = torch.autograd.grad(value**2, offset, create_graph=True)[0]
    with pytest.raises(RuntimeError):
        first.sum().backward()


def test_a_derivative_in_forward_mode_is_refused(device):
    """Not implemented: a tangent must not be lost without a word."""
    scene = scene32(device)
    offset, cov2d = torch.tensor([0.3, 0.2], device=device), torch.tensor([1.0, 0.0, 2.0], device=device)
    rasterizer = ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))
    picture = lambda means: rasterizer(**scene | {"means3D": means})[0]  # noqa: E731
    functions = {
        "rasterize has no .* tangent of means3D": (picture, scene["means3D"]),
        "footprint_weight has no .* tangent of offset": (lambda d: ar.footprint_weight(d, cov2d), offset),
    }
    for message, (function, value) in functions.items():
        with pytest.raises(NotImplementedError, match=message):
            torch.func.jvp(function, (value,), (torch.ones_like(value),))
        with torch.autograd.forward_ad.dual_level(), pytest.raises(NotImplementedError, match=message):
            function(torch.autograd.forward_ad.make_dual(value, torch.ones_like(value)))


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vjp, torch.func.jacrev])
def test_transforms_of_torch_func_are_refused(device, transform):
    """torch refuses nodes of autograd that are made in C++, in words that do not say what to do."""
    scene = scene32(device)
    rasterizer = ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))

    def brightness(means):
        return rasterizer(**{**scene, "means3D": means})[0].sum()

    with pytest.raises(NotImplementedError, match=r"rasterize has no derivative in torch.func .* torch.autograd"):
        if transform is torch.func.vjp:
            transform(brightness, scene["means3D"])
        else:
            transform(brightness)(scene["means3D"])


def test_strided_inputs(device):
    """Columns of a larger tensor, transposed matrices: everything as if contiguous."""
    scene = scene32(device)
    expected = gradients(scene)
    strided = {name: torch.stack([value, value + 1], -1)[..., 0] for name, value in scene.items()}
    assert not any(wide.is_contiguous() for wide in strided.values())
    fields = CAMERA.fields(torch.float32, device)
    for name in ("viewmatrix", "projmatrix"):
        fields[name] = fields[name].T.contiguous().T
        assert not fields[name].is_contiguous()
    fields["bg"] = torch.stack([fields["bg"]] * 2, -1)[:, 0]
    fields["campos"] = torch.stack([fields["campos"]] * 2, -1)[:, 0]
    leaves = {name: value.detach().requires_grad_() for name, value in strided.items()}
    color, radii = render(leaves, Settings(**fields))
    (color * scenes.probe(color)).sum().backward()
    assert torch.equal(color, expected[0])
    assert torch.equal(radii, expected[1])
    for name, leaf in leaves.items():
        assert torch.equal(leaf.grad, expected[2][name]), name


@pytest.mark.parametrize(
    "change",
    [
        lambda f: {"viewmatrix": f["viewmatrix"][None], "projmatrix": f["projmatrix"][None]},
        lambda f: {"tanfovx": torch.tensor(f["tanfovx"]).double()},
        lambda f: {"tanfovx": torch.tensor(f["tanfovx"]).double(), "tanfovy": torch.tensor(0.5)},
        lambda f: {"scale_modifier": 1},
        lambda f: {"prefiltered": True},
        lambda f: {"image_height": float(f["image_height"]), "image_width": torch.tensor(f["image_width"])},
    ],
    ids=["batched matrices", "0-dim tanfov", "0-dim tanfovs", "int modifier", "prefiltered", "other whole numbers"],
)
def test_settings_in_other_forms(device, change):
    fields = CAMERA.fields(torch.float32, device)
    expected = render(scene32(device), Settings(**fields))
    actual = render(scene32(device), Settings(**(fields | change(fields))))
    assert torch.equal(actual[0], expected[0])
    assert torch.equal(actual[1], expected[1])


NO_NUMBER = TypeError, ValueError


@pytest.mark.parametrize(
    "value, error",
    [(24.5, ValueError), (math.nan, ValueError), ("24", TypeError), (True, TypeError), (torch.ones(2), NO_NUMBER)],
    ids=str,
)
@pytest.mark.parametrize("name", ["image_height", "image_width", "sh_degree"])
def test_sizes_and_degrees_are_whole_numbers(name, value, error):
    fields = CAMERA.fields(torch.float32, "cpu") | {name: value}
    with pytest.raises(error, match=f"{name} must be a whole number, got"):
        render(scene32(), Settings(**fields))
    size = {"width": 32, "height": 24} | ({name.split("_")[1]: value} if name != "sh_degree" else {})
    if name != "sh_degree":
        with pytest.raises(error, match=f"{name.split('_')[1]} must be a whole number, got"):
            ar.camera_settings(torch.eye(4), **size, fx=30.0, fy=30.0)


def test_flat_opacities(device):
    scene = scene32(device)
    column, flat = gradients(scene), gradients(dict(scene, opacities=scene["opacities"][:, 0]))
    assert torch.equal(column[0], flat[0])
    assert flat[2]["opacities"].shape == (20,)
    assert torch.equal(flat[2]["opacities"], column[2]["opacities"][:, 0])


@pytest.mark.parametrize(
    "empty",
    [None, torch.Tensor([]), torch.zeros(0, dtype=torch.float64), torch.zeros(0, device="meta")],
    ids=["None", "Tensor([])", "other dtype", "other device"],
)
def test_missing_inputs(device, empty):
    """3DGS passes torch.Tensor([]), on the CPU and in float32 whatever the rest is."""
    scene = scene32(device)
    expected, _ = render(scene)
    assert torch.equal(render(dict(scene, colors_precomp=empty, cov3D_precomp=empty))[0], expected)
    precomputed = scenes.cast(scenes.with_precomputed(scenes.random_scene(1, 20)), torch.float32, device)
    expected, _ = render(precomputed)
    missing = {"shs": empty, "scales": empty, "rotations": empty, "means2D": empty}
    assert torch.equal(render(precomputed | missing)[0], expected)


def test_mark_visible(device):
    """In front of the near plane z > 0.2, wherever in the image."""
    settings = CAMERA.settings(torch.float32, device)
    g = torch.Generator().manual_seed(5)
    positions = scenes.rand(g, 500, 3, low=-8.0, high=8.0).float().to(device)
    visible = ar.GaussianRasterizer(settings).markVisible(positions)
    assert visible.dtype == torch.bool
    assert visible.shape == (500,)
    assert visible.device == positions.device
    z = torch.cat([positions.double().cpu(), torch.ones(500, 1).double()], -1) @ CAMERA.fields()["viewmatrix"]
    z = z[:, 2]
    clear = (z - reference.NEAR).abs() > 1e-4
    assert torch.equal(visible.cpu()[clear], (z > reference.NEAR)[clear])
    assert 0 < visible.sum() < 500
    assert not visible.requires_grad
    tracked = ar.GaussianRasterizer(settings).markVisible(positions.requires_grad_())
    assert torch.equal(tracked, visible)
    batched = settings._replace(viewmatrix=settings.viewmatrix[None])
    assert torch.equal(ar.GaussianRasterizer(batched).markVisible(positions), visible)
    assert ar.GaussianRasterizer(settings).markVisible(positions[:0]).shape == (0,)


def test_inputs_are_left_alone(device):
    scene = scene32(device)
    before = {name: value.clone() for name, value in scene.items()}
    gradients(scene)
    for name, value in scene.items():
        assert torch.equal(value, before[name])


# --- Gaussians that are no Gaussians -----------------------------------------------------------

NUMBERS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


@each_path
@each_precision
@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("precomputed", [False, True], ids=["scales-sh", "precomputed"])
@each_camera
def test_non_finite_gaussians_are_culled(variant, device, dtype, number, precomputed, effects):
    """Radius 0, zero gradient, and every other Gaussian as if they were not there, to the bit."""
    settings = CAMERA.settings(dtype, device, variant, effects=effects)
    scene = scenes.random_scene(1, 40, degree=1)
    if precomputed:
        scene = scenes.with_precomputed(scene)
    scene = scenes.cast(scene, dtype)
    broken = {name: value.clone() for name, value in scene.items()}
    bad = []
    for name, value in broken.items():
        if name == "means2D":  # its values are ignored
            continue
        for column in range(value[0].numel()):
            if len(bad) < 30:
                value[len(bad)].view(-1)[column] = NUMBERS[number]
                bad.append(len(bad))
    good = torch.tensor([i for i in range(40) if i not in bad])
    expected = gradients({name: value[good].to(device) for name, value in scene.items()}, settings)
    actual = gradients(scenes.to(broken, device), settings)
    good = good.to(device)
    assert torch.equal(actual[0], expected[0])
    assert (actual[1][bad] == 0).all()
    assert torch.equal(actual[1][good], expected[1])
    for name in scene:
        assert torch.equal(actual[2][name][good], expected[2][name]), name
        assert (actual[2][name][bad] == 0).all(), name


@each_path
@each_precision
@each_camera
def test_degenerate_gaussians_are_harmless(variant, device, dtype, effects):
    """Zero, negative and huge scales, indefinite covariances, absurd opacities: finite, always.

    Nothing but finiteness (and a sane image) is asked: what such a Gaussian looks like is
    undefined.
    """
    settings = CAMERA.settings(dtype, device, variant, effects=effects)
    scene = scenes.random_scene(1, 30, degree=1)
    values = [0.0, 1e-30, 1e-12, 1e-6, 1e6, 1e12, 1e30, -0.3]
    for i, value in enumerate(values):
        scene["scales"][i] = value
        scene["scales"][8 + i, 0] = value
    scene["opacities"][16:22, 0] = torch.tensor([-1.0, 0.0, 1.0, 1.5, 1e30, -1e30])
    scene["means3D"][22] = torch.tensor([1e30, 0.0, 0.0])
    scene["means3D"][23] = torch.tensor(CAMERA.eye)  # z = 0 in camera space
    scene["means3D"][24] = torch.tensor([1e-30, 1e-38, -1e-30])
    for case in (scene, scenes.with_precomputed(scene)):
        if "cov3D_precomp" in case:
            case["cov3D_precomp"] = torch.nan_to_num(case["cov3D_precomp"].to(dtype)).double()
            case["cov3D_precomp"][25] = torch.tensor([1.0, 2, 0, 1, 0, 1])  # indefinite
            case["cov3D_precomp"][26] = torch.tensor([-1.0, 0, 0, -1, 0, -1])
            case["cov3D_precomp"][27] = 0.0
        color, _, grads = gradients(scenes.cast(case, dtype, device), settings)
        assert torch.isfinite(color).all()
        for name, gradient in grads.items():
            assert torch.isfinite(gradient).all(), (name, torch.nonzero(~torch.isfinite(gradient)))


# --- errors ------------------------------------------------------------------------------------


def t(*shape, **kwargs):
    return torch.ones(*shape, **kwargs)


DOUBLE, HALF, LONG = (f"got ({name})" for name in ("Double|torch.float64", "Half|torch.float16", "Long|torch.int64"))
META = torch.device("meta")
NAN_4X4 = t(4, 4) * math.nan

# P = 20 Gaussians with 4 SH rows; what is changed, and the message that is due.
WRONG_SHAPES = [
    ({"means3D": t(20, 2)}, r"means3D must have shape \(P, 3\), got \(20, 2\)"),
    ({"means3D": t(3)}, r"means3D must .*got \(3,?\)"),
    ({"means2D": t(20, 2)}, r"means2D must .*got \(20, 2\)"),
    ({"means2D": t(19, 3)}, r"means2D must .*got \(19, 3\)"),
    ({"opacities": t(19, 1)}, r"opacities must .*got \(19, 1\)"),
    ({"opacities": t(20, 2)}, r"opacities must .*got \(20, 2\)"),
    ({"shs": t(20, 4, 2)}, r"shs must .*got \(20, 4, 2\)"),
    ({"shs": t(20, 12)}, r"shs must .*got \(20, 12\)"),
    ({"shs": t(20, 3, 3)}, r"shs must .*got .*3"),
    ({"scales": t(20, 2)}, r"scales must .*got \(20, 2\)"),
    ({"scales": t(21, 3)}, r"scales must .*got \(21, 3\)"),
    ({"rotations": t(20, 3)}, r"rotations must .*got \(20, 3\)"),
    ({"shs": None, "colors_precomp": t(20, 513)}, r"colors_precomp must .*got \(20, 513\)"),
    ({"scales": None, "rotations": None, "cov3D_precomp": t(20, 3, 3)}, r"cov3D_precomp must .*got \(20, 3, 3\)"),
    ({"shs": None}, r"shs.*colors_precomp|colors_precomp.*shs"),
    ({"colors_precomp": t(20, 3)}, r"shs.*colors_precomp|colors_precomp.*shs"),
    ({"scales": None, "rotations": None}, r"scales.*cov3D_precomp|cov3D_precomp.*scales"),
    ({"rotations": None}, r"rotations"),
    ({"cov3D_precomp": t(20, 6)}, r"cov3D_precomp"),
    ({"scales": t(20, 3, device=META)}, r"scales must .*got .*meta"),
    ({"means3D": t(20, 3, device=META)}, r"must .*got .*"),
    ({"bg": t(3, device=META)}, r"bg must .*got .*meta"),
    ({"bg": t(4)}, r"bg must .*got \(4,?\)"),
    ({"viewmatrix": t(3, 4)}, r"viewmatrix must .*got \(3, 4\)"),
    ({"viewmatrix": t(2, 4, 4)}, r"viewmatrix must .*got \(2, 4, 4\)"),
    ({"viewmatrix": NAN_4X4}, r"viewmatrix must .*finite.*got"),
    ({"projmatrix": t(16)}, r"projmatrix must .*got \(16,?\)"),
    ({"projmatrix": t(4, 4) * math.inf}, r"projmatrix must .*finite.*got"),
    ({"campos": t(2)}, r"campos must .*got \(2,?\)"),
    ({"campos": t(3) * math.nan}, r"campos must .*finite.*got"),
    ({"image_height": -1}, r"image_height must .*got -1"),
    ({"image_width": 0}, r"image_width must .*got 0"),
    ({"tanfovx": 0.0}, r"tanfovx must .*got 0"),
    ({"tanfovy": math.nan}, r"tanfovy must .*got nan"),
    ({"scale_modifier": math.nan}, r"scale_modifier must .*got nan"),
    ({"tanfovx": 10**400}, r"tanfovx must be a number that a float can hold"),
    ({"sh_degree": 5}, r"sh_degree must .*got 5"),
    ({"sh_degree": -1}, r"sh_degree must .*got -1"),
]
WRONG_TYPES = [
    ({"means3D": [[0, 0, 0]]}, r"means3D must .*got list"),
    ({"means3D": None}, r"means3D must .*got NoneType"),
    ({"opacities": None}, r"opacities must .*got NoneType"),
    ({"scales": "big"}, r"scales must .*got str"),
    ({"bg": [0, 0, 0]}, r"bg must .*got list"),
    ({"viewmatrix": None}, r"viewmatrix must .*got NoneType"),
    ({"means3D": t(20, 3).half()}, rf"means3D must .*{HALF}"),
    ({"means3D": t(20, 3).long()}, rf"means3D must .*{LONG}"),
    ({"opacities": t(20, 1).double()}, rf"opacities must .*{DOUBLE}"),
    ({"shs": t(20, 4, 3).double()}, rf"shs must .*{DOUBLE}"),
    ({"bg": t(3).double()}, rf"bg must .*{DOUBLE}"),
    ({"viewmatrix": t(4, 4).double()}, rf"viewmatrix must .*{DOUBLE}"),
    ({"tanfovx": None}, r"tanfovx must be a number, got None"),
    ({"tanfovy": "wide"}, r"tanfovy must be a number, got 'wide'"),
    ({"tanfovy": t(2)}, r"tanfovy must be a number, got tensor"),
    ({"tanfovx": None, "sh_degree": 4}, r"tanfovx must be a number, got None"),  # of a full camera
    ({"scale_modifier": None}, r"scale_modifier must be a number, got None"),
]
WRONG = [
    pytest.param(error, changes, pattern, id=f"{next(iter(changes))} {i}")
    for error, table in ((ValueError, WRONG_SHAPES), (TypeError, WRONG_TYPES))
    for i, (changes, pattern) in enumerate(table)
]


@pytest.mark.parametrize("stages", [False, True], ids=["rasterizer", "stages"])
@pytest.mark.parametrize("error, changes, pattern", WRONG)
def test_errors(device, error, changes, pattern, stages, tmp_path, monkeypatch):
    """NAME must EXPECTATION, got ACTUAL: before anything is computed.

    On CUDA the numbers in a camera are looked at with debug only: that waits for the device.
    """
    if stages and "means2D" in changes:
        pytest.skip("render_stages takes no means2D")
    changes = {k: v.to(device) if torch.is_tensor(v) and v.device != META else v for k, v in changes.items()}
    if device == "cuda" and "finite" in pattern:
        if stages:
            pytest.skip("render_stages has no debug")
        monkeypatch.chdir(tmp_path)  # where the snapshot goes
        changes["debug"] = True
    fields = CAMERA.fields(torch.float32, device)
    settings = Settings(**fields | {k: v for k, v in changes.items() if k in FIELDS})
    scene = scene32(device) | {k: v for k, v in changes.items() if k not in FIELDS}
    with pytest.raises(error, match=pattern):
        if stages:
            del scene["means2D"]
            ar.render_stages(settings, **scene)
        else:
            render(scene, settings)


def test_a_scale_modifier_that_requires_a_gradient_is_refused(device):
    """It would get none. Where no gradients are made it is a number like others."""
    settings = CAMERA.settings(torch.float32, device)._replace(scale_modifier=t(()).requires_grad_())
    with pytest.raises(ValueError, match="scale_modifier must not require a gradient"):
        render(scene32(device), settings)
    with torch.no_grad():
        assert torch.equal(render(scene32(device), settings)[0], render(scene32(device))[0])


def test_settings_of_another_class_are_named(device):
    """They belong to the dialects. Also where they are a tuple, whose fields could be taken for the settings of several
    cameras."""
    settings, scene = CAMERA.settings(torch.float32, device), scene32(device)
    with pytest.raises(TypeError, match="settings must be a GaussianRasterizationSettings, got SimpleNamespace"):
        render(scene, types.SimpleNamespace(**settings._asdict()))
    del scene["means2D"]
    other = collections.namedtuple("Settings", settings._fields)(*settings)
    for call in (ar.project, ar.render_stages):
        for wrong, name in ((other, "Settings"), (None, "NoneType")):
            with pytest.raises(TypeError, match=f"settings must be a GaussianRasterizationSettings, got {name}"):
                call(wrong, **scene)
    with pytest.raises(TypeError, match="settings must be a GaussianRasterizationSettings, got Settings"):
        ar.project([settings, other], **scene)


def test_footprints_are_taken_where_their_names_are():
    """So that a program can put the default back that it found."""
    box = ar.resolve_footprint("box:samples=16")
    assert ar.resolve_footprint(box) == box and ar.resolve_footprint(box, samples=1).samples == 1
    found = ar.get_default_footprint()
    try:
        ar.set_default_footprint(box)
        assert ar.get_default_footprint() == box
        ar.set_default_footprint(found)
        assert ar.get_default_footprint() == found
    finally:
        ar.set_default_footprint(None)
    offset, cov2d = torch.zeros(2), torch.tensor([0.5, 0.1, 0.4])
    assert torch.equal(ar.footprint_weight(offset, cov2d, box), ar.footprint_weight(offset, cov2d, "box:samples=16"))
    with pytest.raises(ValueError, match="name must be a footprint where options are given, got None with samples"):
        ar.set_default_footprint(None, samples=4)


@pytest.mark.parametrize(
    "keywords, pattern",
    [
        ({"footprint": "gauss"}, r"footprint must .*got 'gauss'"),
        ({"footprint": ""}, r"footprint must .*got ''"),
        ({"footprint": "adaptive"}, r"footprint must .*got 'adaptive'; take box with 16 samples or moment with 4$"),
        ({"footprint": "momment"}, r"footprint must .*got 'momment'; did you mean moment\?$"),
        (
            {"footprint": "box,samples=4"},
            r"footprint must .*got 'box,samples=4'; options follow a colon, as in moment:samp",
        ),
        ({"footprint": "trapezium"}, r"footprint must .*got 'trapezium'$"),
        ({"footprint": "box", "samples": 3}, r"samples must be one of 1, 4, 16, got 3; nearest: samples=1 or 4$"),
        ({"footprint": "box:samples=8"}, r"samples must be one of 1, 4, 16, got '8'; nearest: samples=4 or 16$"),
        ({"footprint": "moment:samples=9"}, r"samples must be one of 1, 4, 16, got '9'; nearest: samples=4 or 16$"),
        ({"footprint": "moment:samples=99"}, r"got '99'; nearest: samples=16$"),
        ({"footprint": "moment:samples=four"}, r"got 'four'$"),
        ({"footprint": "moment:samples=nan"}, r"got 'nan'$"),
        ({"footprint": "box:samples=0"}, r"samples must .*got '?0"),
        ({"footprint": "box:sample=4"}, r"'sample'"),
        ({"footprint": "box:4"}, r"'4'"),
        ({"footprint": "mip", "samples": 4}, r"'samples'"),
        ({"footprint": "mip", "variance": -0.1}, r"variance must .*got -0.1"),
        ({"footprint": "mip", "variance": "wide"}, r"variance must .*got 'wide'"),
        ({"footprint": "point", "dilation": math.inf}, r"dilation must .*got inf"),
        ({"footprint": "point", "dilation": 1e300}, r"dilation must be finite in float32 .*got 1e\+300"),
        ({"footprint": "analytic", "frame_gradient": "thawed"}, r"frame_gradient must .*'thawed'"),
    ],
    ids=str,
)
def test_wrong_footprints(keywords, pattern):
    """Refused when the settings are made, not when they are used."""
    with pytest.raises(ValueError, match=pattern):
        CAMERA.settings(torch.float32, **keywords)


def test_mark_visible_errors(device):
    rasterizer = ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))
    for positions, error, message in (
        (t(5, 2, device=device), ValueError, r"positions must .*got \(5, 2\)"),
        (t(5, 3, device=device).long(), TypeError, "positions must .*got"),
        ([[0.0, 0.0, 0.0]], TypeError, "positions must .*got"),
        (t(5, 3, device=META), ValueError, "positions must be on the device of viewmatrix, .*got meta"),
    ):
        with pytest.raises(error, match=message):
            rasterizer.markVisible(positions)
    for view, error in ((t(3, 3, device=device), ValueError), (None, TypeError)):
        with pytest.raises(error, match=r"viewmatrix must .*got"):
            settings = rasterizer.raster_settings._replace(viewmatrix=view)
            ar.GaussianRasterizer(settings).markVisible(t(5, 3, device=device))


def test_debug_writes_a_snapshot_on_failure(device, tmp_path, monkeypatch):
    """A failing forward pass leaves its arguments behind and raises what it raised."""
    monkeypatch.chdir(tmp_path)
    settings = CAMERA.settings(torch.float32, device)._replace(debug=True)
    render(scene32(device), settings)
    gradients(scene32(device), settings)
    assert not [*tmp_path.iterdir()]
    with pytest.raises(ValueError, match="scales must"):
        render(dict(scene32(device), scales=t(20, 2, device=device)), settings)
    saved = torch.load(tmp_path / "snapshot_fw.dump", weights_only=False)
    assert saved["scales"].shape == (20, 2) and saved["footprint"] == "analytic" and saved["shs"] is not None
    with pytest.raises(ValueError, match="scales must"):
        render(dict(scene32(device), scales=t(20, 2, device=device)))  # without debug: no file
    assert [path.name for path in tmp_path.iterdir()] == ["snapshot_fw.dump"]


def test_debug_writes_a_snapshot_when_the_backward_pass_fails(device, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    function, named = call_of("rasterize_vjp", ("box", {"samples": 4}), device)
    named |= {"debug": True, "dL_doutputs": [torch.ones(3, 5, 5, device=device)]}
    with pytest.raises(ValueError, match=r"dL_dcolor must have shape \(3, 37, 45\), got \(3, 5, 5\)"):
        function(**named)
    saved = torch.load(tmp_path / "snapshot_bw.dump", weights_only=False)
    assert torch.equal(saved["dL_doutputs"][0], torch.ones(3, 5, 5))
    assert torch.equal(saved["means3D"], named["means3D"].cpu()) and saved["shs"].shape == named["shs"].shape
    assert [path.name for path in tmp_path.iterdir()] == ["snapshot_bw.dump"]


def test_saved_counts_that_are_none(device):
    """The CPU refuses them; CUDA, which would have to wait for the answer, leaves their rows out."""
    function, named = call_of("project_vjp", ("box", {"samples": 1}), device)
    expected = function(**named)[0]
    ends, splits = named["saved"]
    for wrong in (2**30 + torch.arange(ends.shape[1], device=device), torch.tensor(-3, device=device)):
        counts = ends.clone()
        counts[0] = wrong
        named["saved"] = [counts, splits]
        if device == "cpu":
            with pytest.raises(ValueError, match="saved must be what project saved"):
                function(**named)
            continue
        found = function(**named)[0]
    if device != "cpu":  # of the second camera, whose rows are right, the gradients remain
        assert torch.allclose(2 * found, expected)


def test_saved_splits_that_do_not_rise(device):
    function, named = call_of("project_vjp", ("box", {"samples": 1}), device)
    *kept, splits = named["saved"]
    last = splits[-1].item()
    for wrong in ([0, -(2**63), last], [0, last + 1, last], [1, last, last], [0, last], [[0, last, last]]):
        with pytest.raises(ValueError, match="saved must be what project saved"):
            function(**named | {"saved": [*kept, torch.tensor(wrong)]})


@pytest.mark.parametrize("full", [False, True], ids=["plain", "full"])
def test_what_was_saved_for_other_arguments_is_refused(device, full):
    """For other images, of which the channels would be read where there are none, and for other Gaussians."""
    function, named = call_of("rasterize_vjp", ("analytic", {}), device, full)
    zeros = torch.zeros_like(named["means3D"][:, 0])
    image = torch.zeros(named["image_height"], named["image_width"], device=device)
    with pytest.raises(ValueError, match="saved must end with the channels of the forward pass"):
        function(**named | {"inverse_depth": True, "dL_doutputs": [*named["dL_doutputs"], image]})
    if full:
        for wrong in (zeros[:0], named["saved"][-1][:-1], named["saved"][-1].double(), named["saved"][-1].t()):
            with pytest.raises(ValueError, match="saved must end with the channels of the forward pass"):
                function(**named | {"saved": [*named["saved"][:-1], wrong]})
    rows = {name for name in named if torch.is_tensor(named[name]) and len(named[name]) == len(zeros)}
    fewer = {name: named[name][:3] for name in rows} | {"saved": [*named["saved"][:-1], named["saved"][-1][:3]]}
    with pytest.raises(ValueError, match="saved must be what the forward pass saved for the same 3 Gaussians"):
        function(**named | fewer)


@pytest.mark.skipif(_C.has_cuda, reason="needs an extension that was built without CUDA")
def test_cuda_tensors_without_cuda_say_what_to_do():
    with pytest.raises(RuntimeError, match="built without CUDA"):
        check_device(torch.device("cuda:0"))
    check_device(torch.device("cpu"))


def test_debug_changes_no_bit(device):
    color, _, plain = gradients(scene32(device))
    debugged, _, grads = gradients(scene32(device), CAMERA.settings(torch.float32, device)._replace(debug=True))
    assert torch.equal(color, debugged) and all(torch.equal(gradient, grads[name]) for name, gradient in plain.items())


# --- torch.library -----------------------------------------------------------------------------


def calls(variant, device, full):
    """Arguments of every op, of all that the package does with them; `full`: a full camera, and outputs."""
    return _calls(variant[0], tuple(variant[1].items()), device, full)


def call_of(op, variant, device, full=False):
    """The function of an op, and its arguments by name."""
    function, arguments = calls(variant, device, full)[op]
    return function, dict(zip((argument.name for argument in function._schema.arguments), arguments))


@functools.cache
def _calls(footprint, options, device, full):
    effects = ar.Effects(gaussian_stats=True)
    if full:
        effects = ar.Effects(alpha=True, depth=True, median_depth=True, off_center=True, defocus=ar.Defocus(0.1, 2.0))
    settings = CAMERA.settings(torch.float32, device, footprint=footprint, effects=effects, **dict(options))
    scene = scene32(device)
    leaves = scenes.leaves(scene)
    if full:
        settings = settings._replace(viewmatrix=settings.viewmatrix.clone().requires_grad_())
    features = torch.ones(len(scene["means3D"]), 4, device=device, requires_grad=True) if full else None
    with Calls() as mode:
        absent = {"colors_precomp": None, "cov3D_precomp": None}
        rasterizer.render(settings, rasterizer.NOTHING, **leaves, **absent, features=features)[0].sum().backward()
        del scene["means2D"], leaves["means2D"]
        ar.render_stages(settings, **scene)
        splats = ar.project([settings, settings], **leaves)
        image, alpha = ar.blend(splats, ar.list_tiles(splats), torch.ones(len(splats.means2d), 5, device=device))
        one = splats.split()[0]
        lists, looks = list(ar.list_tiles(one).tensors), dict.fromkeys(_C.SUMMARIES, True)
        torch.ops.analytic_rasterizer.inspect(lists, one.depths.detach(), **one.size, **looks)
        (image.sum() + alpha.sum()).backward()
        of_rows = [t.detach().requires_grad_() for t in (splats.means2d, splats.cov2d, splats.opacities)]
        table = torch.ones(len(splats.means2d), 4 if full else 3, device=device, requires_grad=True)
        others = {"dets": splats.dets, "depths": splats.depths.detach(), "row_splits": splats.row_splits}
        composited = torch.ops.analytic_rasterizer.composite(
            *of_rows, table, torch.zeros(2, 3, device=device), None, **others, **splats.size, expected=full
        )
        (composited[0].sum() + composited[1].sum()).backward()
        bent = ar.Effects(lens=ar.Lens("perspective", torch.zeros(12, device=device).requires_grad_()))
        bent_settings = CAMERA.settings(torch.float32, device, footprint="point", effects=bent)
        ar.GaussianRasterizer(bent_settings)(means2D=None, **leaves)[0].sum().backward()
        around = ar.Effects(lens=ar.Lens.equirectangular())
        around_settings = CAMERA.settings(torch.float32, device, footprint=footprint, effects=around, **dict(options))
        ar.GaussianRasterizer(around_settings)(means2D=None, **leaves)[0].sum().backward()
        pose = torch.eye(4, device=device).requires_grad_()
        ar.camera_settings(pose, 8, 6, 9.0, 9.0).projmatrix.sum().backward()
        offset, cov2d = torch.ones(7, 2, device=device), torch.tensor([2.0, 0.3, 1.0], device=device)
        ar.footprint_weight(offset.requires_grad_(), cov2d, footprint, **dict(options)).sum().backward()
    return mode.first


OPS = {
    *("rasterize", "rasterize_timed", "rasterize_vjp", "project", "project_vjp", "bin", "blend", "blend_vjp"),
    *(f"prepare_{what}{suffix}" for what in ("cameras", "lens") for suffix in ("", "_vjp")),
    *(f"{op}{suffix}" for op in ("repeat_at_seam", "composite", "footprint_weight") for suffix in ("", "_vjp")),
    "inspect",
}
OPS_WITH_TESTS_OF_THEIR_OWN = {  # test_losses.py, test_activations.py, test_optim.py, ..., test_distributed.py
    *("ssim_map", "l1_ssim", "activate", "apply_3d_filter", "correct_colors"),
    *("ssim_map_vjp", "l1_ssim_vjp", "activate_vjp", "apply_3d_filter_vjp", "correct_colors_vjp"),
    *("adam_", "observe_", "add_noise_", "picture_gradients", "rows_picture_gradients"),
    *("count_rows", "pack_rows_", "pack_rows_vjp", "blend_rows", "blend_rows_vjp_"),
}


def test_every_op_is_checked():
    named = (name.partition("::") for name in torch._C._dispatch_get_all_op_names())
    registered = {name.split(".")[0] for namespace, _, name in named if namespace == "analytic_rasterizer"}
    assert registered == OPS | OPS_WITH_TESTS_OF_THEIR_OWN


# What an operator takes and returns depends on the path and on the camera, and on neither by the other.
TRACED = {name_of(variant): (variant, False) for variant in PATHS if variant[0] != "cumulant"}
TRACED["full"] = ("analytic", {}), True
# What tracing makes of an op depends on no path that its fake kernel does not see.
DISPATCHED = ("full", name_of(("moment", {"samples": 4})))


@pytest.mark.parametrize("name", TRACED)
@pytest.mark.parametrize("op", sorted(OPS))
def test_opcheck(op, device, name):
    """Schema, fake kernel, autograd registration, and dispatch under tracing.

    rasterize_timed returns how long it took, so two runs of it are never equal, which is what the tracing test asks.
    Nor are two runs on CUDA that keep what the backward pass reads: there is room for more pairs than there are, how
    much depends on earlier frames, and it is not cleared.
    """
    variant, full = TRACED[name]
    function, arguments = calls(variant, device, full)[op]
    differentiable = hasattr(torch.ops.analytic_rasterizer, f"{op}_vjp")

    def copied(value):
        if not torch.is_tensor(value):
            return value
        return value.detach().clone().requires_grad_(differentiable and value.is_floating_point())

    arguments = torch.utils._pytree.tree_map(copied, arguments)
    if not full:  # the camera has no gradient without a lens
        names = [argument.name for argument in function._schema.arguments]
        for name in {"viewmatrix", "projmatrix", "campos"} & set(names):
            arguments[names.index(name)].requires_grad_(False)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    repeats = op != "rasterize_timed" and not (device == "cuda" and op in ("rasterize", "bin", "blend", "composite"))
    if repeats and name in DISPATCHED:
        checks = (*checks, "test_aot_dispatch_dynamic")
    torch.library.opcheck(function, arguments, test_utils=checks)


def traced(op):
    """(dtype, number of dimensions) of the tensors in the last result of an op's fake kernel, and the tensors."""
    function, arguments = calls(("box", {"samples": 4}), "cpu", False)[op]
    with FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True) as mode:
        fake = torch.utils._pytree.tree_map(lambda v: mode.from_tensor(v) if torch.is_tensor(v) else v, arguments)
        results = function(*fake)
    tensors = results[-1] if isinstance(results, tuple) else results
    return [(t.dtype, t.dim()) for t in tensors], tensors


@pytest.mark.parametrize("op, names", [("bin", "LISTS"), ("blend", "STATE"), ("inspect", "SUMMARY")])
def test_tracing_has_the_order_of_tensors_from_the_extension(op, names, monkeypatch):
    """In C++ alone: what a struct there gains, loses or moves is no change in Python."""
    before, count = traced(op)[0], len(getattr(_C, names))
    monkeypatch.setattr(_C, names, getattr(_C, names)[::-1])
    reversed_ = [member for first in range(0, len(before), count) for member in before[first : first + count][::-1]]
    assert traced(op)[0] == reversed_ != before


def test_tracing_has_widths_of_rows_from_the_extension(monkeypatch):
    monkeypatch.setitem(_C.WIDTHS, "splats", 17)
    assert traced("bin")[1][_C.LISTS.index("splats")].shape[1] == 17
    monkeypatch.setitem(_C.WIDTHS, "partials", 5)
    image = torch.rand(3, 9, 8)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        _, saved = torch.ops.analytic_rasterizer.ssim_map(mode.from_tensor(image), mode.from_tensor(image), True)
    assert saved[0].shape == (5, 3, 9, 8)


def test_opcheck_of_bin_in_a_large_image(device):
    """Where the tiles of `moment` with one cell are larger on CUDA than in small images."""
    camera = dataclasses.replace(CAMERA, image_width=512, image_height=512)
    settings = camera.settings(torch.float32, device, footprint="moment", samples=1)
    scene = scenes.without(scene32(device), "means2D")
    with Calls() as mode:
        ar.list_tiles(ar.project(settings, **scene))
    function, arguments = mode.first["bin"]
    torch.library.opcheck(function, arguments, test_utils=("test_schema", "test_faketensor"))
