"""The dialects of diff_gaussian_rasterization: what each takes, returns and exports, beside what the library makes."""

import copy
import dataclasses
import inspect
import math
import pickle
import shutil
import sys

import pytest
import scenes
import torch
from marks import each_precision
from originals import (
    BASE,
    CAMERA,
    COUNT,
    ORIGINALS,
    THEIR_FILTER,
    arguments_of,
    fields_of,
    plain,
    probe,
    relative_error,
    render,
    scene_of,
    settings_of,
)
from places import ROOT
from processes import in_threads, run_python

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects, installation
from analytic_rasterizer.dialects import _base

pytestmark = pytest.mark.usefixtures("nothing_chosen")


# --- the module ---------------------------------------------------------------------------------


def test_every_dialect_is_listed():
    assert set(dialects.DIALECTS) == set(ORIGINALS), (
        "ORIGINALS of tests/makers/originals.py must have a row for every dialect"
    )


@pytest.mark.parametrize("name", ORIGINALS)
def test_module_answers_as_the_original(name):
    """Downstream code probes fields, signatures and imports to find out what it runs on."""
    fields, arguments, exports = ORIGINALS[name]
    drop_in.set_dialect(name)
    assert drop_in.get_dialect() == name
    settings = drop_in.GaussianRasterizationSettings
    assert settings.dialect == name
    assert list(settings._fields) == list(inspect.signature(settings).parameters) == fields
    assert all(p.default is inspect.Parameter.empty for p in inspect.signature(settings).parameters.values())
    forward = list(inspect.signature(drop_in.GaussianRasterizer.forward).parameters)[1:]
    assert [key for key in forward if key in arguments or name != "depth_alpha"] == arguments
    for export in ("SparseGaussianAdam", "compute_relocation"):
        assert (export in dir(drop_in)) == (export in exports)
    assert hasattr(drop_in, "SparseGaussianAdam") == ("SparseGaussianAdam" in exports)
    for export in drop_in.__all__:
        assert getattr(drop_in, export) is not None


def test_the_table_of_the_documentation():
    """docs/dialects.md has a row for every dialect, with what recognises it and its filter."""
    rows = {}
    for line in (ROOT / "docs" / "dialects.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 5 and cells[0].startswith("`"):
            rows[cells[0].strip("`")] = cells
    assert set(rows) == set(dialects.DIALECTS), "the table of docs/dialects.md must have a row for every dialect"
    for name, (_, repositories, recognised, _, footprint) in rows.items():
        settings = dialects.dialect_module(name).GaussianRasterizationSettings
        expected = THEIR_FILTER[name].replace("0.25", "kernel_size").partition(":dil")[0].partition(":frame")[0]
        assert footprint == f"`{expected}`"
        stated = vars(settings)
        names = [*stated.get("inferred_from", ()), *stated.get("inferred_from_arguments", ())]
        assert not names or any(f"`{keyword}`" in recognised for keyword in names)
        assert name == "mini" or any(repository.lower() in repositories.lower() for repository in settings.repositories)


def test_every_repository_has_its_row_in_the_guide():
    """docs/migrating.md says what to set for each that a dialect names, but for second names of the same."""
    plain_name = lambda text: "".join(filter(str.isalnum, text.lower()))  # noqa: E731
    guide = plain_name((ROOT / "docs" / "migrating.md").read_text())
    for name in dialects.DIALECTS:
        for repository in dialects.dialect_module(name).GaussianRasterizationSettings.repositories:
            assert repository in ("3DGS accel", "Deformable-3D-Gaussians") or plain_name(repository) in guide


def test_names_are_unique():
    """A repository belongs to one dialect, however it is spelled, and no dialect has the name of another's."""
    owner = {}
    for name in dialects.DIALECTS:
        settings = dialects.dialect_module(name).GaussianRasterizationSettings
        for spelled in (name, *settings.repositories):
            plain_name = "".join(filter(str.isalnum, spelled.lower()))
            assert owner.setdefault(plain_name, name) == name, spelled


@pytest.mark.parametrize("name, dialect", [("SplaTAM", "luiten"), ("mip-splatting", "mip"), ("GS2024", "gs2024")])
def test_dialects_by_the_name_of_a_repository(name, dialect):
    drop_in.set_dialect(name)
    assert drop_in.get_dialect() == dialect


def test_unknown_dialect():
    for wrong in ("nonsense", "", 3):
        with pytest.raises(ValueError, match=r"dialect must be one of accel, .*gs2023.* got"):
            drop_in.set_dialect(wrong)
    assert drop_in.get_dialect() == "gs2023"


def test_environment_variable():
    code = """
        import diff_gaussian_rasterization as d
        from diff_gaussian_rasterization import SparseGaussianAdam
        print(d.get_dialect(), "antialiasing" in d.GaussianRasterizationSettings._fields)
        d.set_dialect("mip"); d.set_dialect(None); print(d.get_dialect())
    """
    assert run_python(code, ANALYTIC_RASTERIZER_DIALECT="accel").split() == ["accel", "True", "accel"]
    code = """
        try:
            import diff_gaussian_rasterization
        except ValueError as error:
            print(error)
    """
    wrong = run_python(code, ANALYTIC_RASTERIZER_DIALECT="acel")
    assert "environment variable ANALYTIC_RASTERIZER_DIALECT must be one of accel" in wrong and "'acel'" in wrong


def test_names_of_other_dialects():
    """What probing finds missing is missing as in the original; what nobody probes says where it is."""
    with pytest.raises(AttributeError, match="gs2023"):
        _ = drop_in.SparseGaussianAdam
    with pytest.raises(ImportError, match="SparseGaussianAdam"):
        from diff_gaussian_rasterization import SparseGaussianAdam  # noqa: F401
    with pytest.raises(ImportError, match="set ANALYTIC_RASTERIZER_DIALECT=mcmc"):
        from diff_gaussian_rasterization import compute_relocation  # noqa: F401
    with pytest.raises(AttributeError, match="nonsense"):
        _ = drop_in.nonsense


# --- what is returned ---------------------------------------------------------------------------


def expected_values(name, device, dtype):
    """What each rasterizer returns, from the library: a function of its own for every dialect."""
    of = lambda **effects: plain(device, dtype, THEIR_FILTER[name], **effects)  # noqa: E731
    if name in ("gs2023", "mip", "analytic", "scaffold", "lightgaussian"):
        return of()[:2]
    if name in ("gs2024", "accel"):
        color, radii, outputs = of(inverse_depth=True)
        return color, radii, outputs.inverse_depth
    if name == "depth":
        color, radii, outputs = of(depth=True)
        return color, radii, outputs.depth
    if name == "depth_alpha":
        color, radii, outputs = of(depth=True, alpha=True)
        return color, radii, outputs.depth, outputs.alpha
    if name == "luiten":
        color, radii, outputs = of(median_depth=True)
        return color, radii, torch.where(outputs.median_depth > 0, outputs.median_depth, 15.0)
    if name == "monogs":
        color, radii, outputs = of(depth=True, alpha=True, gaussian_stats=True)
        return color, radii, outputs.depth, outputs.alpha, outputs.gaussian_stats.pixels_in_front
    if name in ("langsplat", "grouping", "mcmc"):
        color, radii, _ = of()
        made = {"langsplat": (torch.zeros_like(color), radii), "mcmc": (radii, (radii > 0).int())}
        return color, *made.get(name, (radii, color.new_zeros(16, *color.shape[1:])))
    if name == "feature3dgs":
        color, radii, outputs = of(depth=True)
        features = arguments_of(name, device, dtype)["semantic_feature"].flatten(1)
        settings = CAMERA.settings(dtype, device, footprint="point")._replace(bg=features.new_zeros(5))
        scene = scene_of(device, dtype) | {"shs": None, "colors_precomp": features}
        return color, ar.GaussianRasterizer(settings)(**scene)[0], radii, outputs.depth
    if name != "mini":
        pytest.fail(f"expected_values must say what dialect {name} returns")
    color, radii, outputs = of(gaussian_stats=True, dominant_index=True)
    dominated = torch.tensor([(outputs.dominant_index == i).sum() for i in range(COUNT)], device=device).int()
    return color, radii, outputs.gaussian_stats.sum_weight, outputs.gaussian_stats.pixels, dominated


@pytest.mark.parametrize("name", ORIGINALS)
def test_returned_values(device, name):
    made, expected = render(name, device), expected_values(name, device, torch.float32)
    assert len(made) == len(expected)
    # Features are blended with the colours here, and by themselves there: a few roundings of numbers up to 1.
    tolerance = 2e-6 if name == "feature3dgs" else 0
    for ours, theirs in zip(made, expected):
        assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
        assert torch.allclose(ours, theirs, rtol=0, atol=tolerance)


def test_visible_filter_names_what_is_wrong():
    with pytest.raises(ValueError, match=r"means3D must have shape \(P, 3\), got \(\)"):
        drop_in.GaussianRasterizer(settings_of("scaffold")).visible_filter(torch.tensor(1.0))


@pytest.mark.parametrize("name", ORIGINALS)
def test_functional_form(name):
    """rasterize_gaussians has the arguments of forward in the order of the original, opacities after the colours."""
    arguments = arguments_of(name)
    order = [key for key in ORIGINALS[name][1] if key not in ("opacities", "means2D_densify")]
    at = order.index("scales")
    order = [*order[:at], "opacities", *order[at:]]
    module, settings = dialects.dialect_module(name), settings_of(name)
    made = module.rasterize_gaussians(*[arguments.get(key) for key in order], settings)
    assert all(map(torch.equal, made, module.GaussianRasterizer(settings)(**arguments)))


@pytest.mark.parametrize("name", ORIGINALS)
def test_functional_form_with_settings_of_the_library(name):
    """They render as the library does, and take nothing that belongs to a dialect."""
    arguments, plain = arguments_of(name), scene_of()
    order = list(inspect.signature(dialects.dialect_module(name).rasterize_gaussians).parameters)[:-1]
    names = {"sh": "shs", "cov3Ds_precomp": "cov3D_precomp"}
    settings = CAMERA.settings(torch.float32)

    def rendered(given):
        made = [given.get(names.get(key, key)) for key in order]
        return dialects.dialect_module(name).rasterize_gaussians(*made, settings)

    assert all(map(torch.equal, rendered(plain), ar.GaussianRasterizer(settings)(**plain)))
    if set(order) & set(arguments) - set(plain):
        with pytest.raises(TypeError, match=r"settings must be of a dialect that takes .*, got those of the library"):
            rendered(arguments)


@pytest.mark.parametrize("name", ORIGINALS)
def test_outputs_of_the_effects_come_last(name):
    made = render(name)
    effects = ar.Effects(alpha=True, median_depth=True)
    *values, outputs = render(name, scene=arguments_of(name), effects=effects)
    assert isinstance(outputs, ar.Outputs) and outputs.alpha is not None and outputs.median_depth is not None
    assert len(values) == len(made)
    assert all(map(torch.equal, values, made))


@pytest.mark.parametrize("name", ORIGINALS)
def test_no_gaussians(device, name):
    scene = {key: value[:0] for key, value in arguments_of(name, device).items()}
    made = render(name, device, scene=scene)
    background = torch.tensor(CAMERA.bg, device=device)[:, None, None].expand(3, 30, 40)
    assert any(value.shape == background.shape and torch.equal(value, background) for value in made)


# --- the filter ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ORIGINALS)
def test_the_filter_is_theirs_unless_the_user_chose_one(name, monkeypatch):
    settings = settings_of(name)
    assert str(settings.footprint_in_use()) == THEIR_FILTER[name]
    color = render(name)[0]
    monkeypatch.setenv("ANALYTIC_RASTERIZER_FOOTPRINT", "cumulant")
    assert str(settings.footprint_in_use()) == "cumulant"
    ar.set_default_footprint("box", samples=1)
    assert str(settings.footprint_in_use()) == "box:samples=1"
    assert str(settings_of(name, footprint="mip").footprint_in_use()) == "mip:variance=0.1"
    at = 2 if name == "lightgaussian_count" else 0
    assert torch.equal(render(name)[at], plain(footprint="box:samples=1")[0])
    assert not torch.equal(render(name)[at], color)
    # Settings of the library never have the filter of a dialect.
    ar.set_default_footprint(None)
    monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT")
    drop_in.set_dialect(name)
    assert CAMERA.settings(torch.float32).footprint_in_use().name == "analytic"


@pytest.mark.parametrize("name", ["gs2024", "accel"])
def test_antialiasing_changes_what_samples_points(name):
    assert torch.equal(render(name, antialiasing=True)[0], render(name)[0])
    made = render(name, antialiasing=True, footprint="point:dilation=0.2")[0]
    assert torch.equal(made, plain(footprint="mip:variance=0.2")[0])
    assert torch.equal(render(name, footprint="point:dilation=0.2")[0], plain(footprint="point:dilation=0.2")[0])


# --- what is inferred ---------------------------------------------------------------------------

INFERRED = [
    name
    for name in ORIGINALS
    if {"inferred_from", "inferred_without"} & vars(dialects.dialect_module(name).GaussianRasterizationSettings).keys()
]


def test_some_dialects_are_inferred():
    assert {"gs2024", "mip", "luiten", "monogs", "langsplat", "lightgaussian"} <= set(INFERRED)


@pytest.mark.parametrize("name", INFERRED)
def test_dialects_that_the_settings_tell(name):
    settings = drop_in.GaussianRasterizationSettings(**fields_of(name))
    assert settings.dialect == name and list(settings._fields) == ORIGINALS[name][0]
    assert isinstance(settings, drop_in.GaussianRasterizationSettings)
    made = drop_in.GaussianRasterizer(settings)(**arguments_of(name))
    assert all(map(torch.equal, made, render(name)))


@pytest.mark.parametrize("name, key", [("depth", "means2D_densify"), ("grouping", "sh_objs"), ("accel", "dc")])
def test_dialects_that_the_arguments_tell(name, key):
    settings = drop_in.GaussianRasterizationSettings(**fields_of(name))
    scene = arguments_of(name)
    scene.setdefault(key, torch.zeros(COUNT, 3) if name == "depth" else torch.rand(COUNT, 1, 16))
    made = drop_in.GaussianRasterizer(settings)(**scene)
    assert all(map(torch.equal, made, render(name, scene=scene)))


def test_settings_of_two_dialects():
    with pytest.raises(TypeError, match=r"of one dialect, got antialiasing \(gs2024\), kernel_size \(mip\)"):
        drop_in.GaussianRasterizationSettings(**CAMERA.fields(), antialiasing=True, kernel_size=0.1)


def test_ambiguous_and_missing_settings():
    values = list(CAMERA.fields().values())
    with pytest.raises(TypeError, match="have 12 fields, got 13 by position"):
        drop_in.GaussianRasterizationSettings(*values, False)
    with pytest.raises(TypeError, match="gs2023 must have campos, prefiltered, which are missing"):
        drop_in.GaussianRasterizationSettings(*values[:9], debug=False)
    with pytest.raises(TypeError, match="mip must have debug, which are missing"):
        drop_in.GaussianRasterizationSettings(*values[:4], kernel_size=0.1, **dict(zip(BASE[4:11], values[4:11])))
    with pytest.raises(TypeError, match=r"settings must be among.*nonsense"):
        drop_in.GaussianRasterizationSettings(*values, nonsense=1)
    # Of any dialect, while none is chosen.
    for misspelt, near in (("antialiasng", "antialiasing"), ("kernel_sise", "kernel_size"), ("efects", "effects")):
        with pytest.raises(TypeError, match=rf"got {misspelt}; did you mean {near}\?$"):
            drop_in.GaussianRasterizationSettings(*values, **{misspelt: 1})


def test_arguments_of_other_dialects():
    rasterizer = drop_in.GaussianRasterizer(settings_of("gs2023"))
    with pytest.raises(TypeError, match=r"gs2023 does not take theta: .*docs/dialects.md"):
        rasterizer(**scene_of(), theta=torch.zeros(3))
    with pytest.raises(TypeError, match="dc belongs to dialect accel, and the settings are those of gs2023"):
        rasterizer(**scene_of(), dc=torch.zeros(COUNT, 1, 3))
    with pytest.raises(TypeError, match="sh_objs belongs to dialect grouping, and the settings are those of mcmc"):
        drop_in.GaussianRasterizer(settings_of("mcmc"))(**scene_of(), sh_objs=torch.zeros(COUNT, 1, 16))


REFUSED_SETTINGS = {"inv_viewprojmatrix": "StopThePop", "pixel_weights": "Taming", "require_depth": "RaDe-GS"}
REFUSED_ARGUMENTS = {"view2gaussian_precomp": "Gaussian Opacity Fields", "scores": "Speedy-Splat"}


@pytest.mark.parametrize("name, owner", [*REFUSED_SETTINGS.items(), *REFUSED_ARGUMENTS.items()])
@pytest.mark.parametrize("dialect", ["gs2023", "mip", "depth"])
def test_settings_and_arguments_of_other_algorithms(dialect, name, owner):
    with pytest.raises(TypeError, match=f"^{name} is not supported: {owner}.* own rasterizer"):
        if name in REFUSED_SETTINGS:
            dialects.dialect_module(dialect).GaussianRasterizationSettings(**fields_of(dialect), **{name: None})
        else:
            drop_in.GaussianRasterizer(settings_of(dialect))(**scene_of(), **{name: None})


def test_names_of_other_algorithms():
    with pytest.raises(ImportError, match="StopThePop"):
        from diff_gaussian_rasterization import ExtendedSettings  # noqa: F401
    with pytest.raises(AttributeError, match="Gaussian Opacity Fields"):
        drop_in.GaussianRasterizer(settings_of("mip")).integrate(torch.zeros(3, 3))


# --- settings and rasterizers as objects --------------------------------------------------------


@pytest.mark.parametrize("name", ORIGINALS)
def test_settings_are_a_tuple_that_can_be_copied(name):
    fields = fields_of(name)
    settings = settings_of(name, footprint="box:samples=1")
    by_position = type(settings)(*fields.values(), footprint="box", samples=1)
    by_keyword = type(settings)(**settings._asdict(), footprint=settings.footprint)
    copies = copy.copy(settings), copy.deepcopy(settings), pickle.loads(pickle.dumps(settings))
    for same in (*copies, settings._replace(bg=settings.bg), by_keyword, by_position):
        assert type(same) is type(settings) and same._fields == settings._fields == tuple(fields)
        assert str(same.footprint) == "box:samples=1" and len(same) == len(fields)
        assert same.image_height == same[0] == 30 and same.sh_degree == 1
        assert torch.equal(same.viewmatrix, settings.viewmatrix)
    assert settings._replace(image_height=7).image_height == 7
    assert str(settings._replace(footprint=None).footprint_in_use()) == THEIR_FILTER[name]
    assert type(settings)._make(fields.values()).dialect == name
    with pytest.raises((TypeError, ValueError), match="nonsense"):
        settings._replace(nonsense=1)


@pytest.mark.parametrize("name", ORIGINALS)
def test_rasterizers_can_be_copied(name):
    rasterizer = dialects.dialect_module(name).GaussianRasterizer(settings_of(name))
    arguments = arguments_of(name)
    expected = rasterizer(**arguments)
    for same in (copy.deepcopy(rasterizer), pickle.loads(pickle.dumps(rasterizer))):
        assert all(map(torch.equal, same(**arguments), expected))


def test_classes_that_were_imported_before():
    """The classes of 3DGS 2023 follow the dialect that is chosen later; settings that exist do not change."""
    settings_class, rasterizer_class = drop_in.GaussianRasterizationSettings, drop_in.GaussianRasterizer
    before = settings_class(**CAMERA.fields(torch.float32))
    drop_in.set_dialect("depth_alpha")
    later = settings_class(**CAMERA.fields(torch.float32))
    assert len(rasterizer_class(before)(**scene_of())) == 2
    assert len(rasterizer_class(later)(**scene_of())) == 4
    drop_in.set_dialect("mip")
    with pytest.raises(TypeError, match="dialect mip must have kernel_size, which are missing"):
        settings_class(**CAMERA.fields(torch.float32))
    with pytest.raises(TypeError, match=r"settings must be among.*kernel_size.*got antialiasing$"):
        settings_class(**fields_of("mip"), antialiasing=True)  # a choice is not overruled
    # The library's own classes belong to no dialect.
    assert len(ar.GaussianRasterizer(CAMERA.settings(torch.float32))(**scene_of())) == 2


def test_rasterizers_follow_the_settings_they_are_given():
    rasterizer = drop_in.GaussianRasterizer(settings_of("gs2023"))
    assert len(rasterizer(**scene_of())) == 2
    rasterizer.raster_settings = settings_of("luiten")
    assert len(rasterizer(**scene_of())) == 3
    rasterizer.raster_settings = CAMERA.settings(torch.float32, effects=ar.Effects(alpha=True))  # the library's
    assert isinstance(rasterizer(**scene_of())[2], ar.Outputs)
    assert rasterizer.markVisible(scene_of()["means3D"]).all()


def test_subclasses():
    class MySettings(drop_in.GaussianRasterizationSettings):
        pass

    class MyRasterizer(drop_in.GaussianRasterizer):
        def forward(self, means3D, **others):
            return super().forward(means3D, **others)[0]

    made = MyRasterizer(MySettings(**CAMERA.fields(torch.float32)))(**scene_of())
    assert torch.equal(made, plain()[0])
    assert torch.equal(MyRasterizer(settings_of("mip"))(**scene_of()), render("mip")[0])


def test_luiten_takes_debug_too():
    fields = CAMERA.fields(torch.float32)
    drop_in.set_dialect("luiten")
    settings = drop_in.GaussianRasterizationSettings(**fields)
    assert not settings.debug and settings.dialect == "luiten"
    assert drop_in.GaussianRasterizationSettings(**fields | {"debug": True}).debug
    assert pickle.loads(pickle.dumps(settings._replace(debug=True))).debug
    assert not settings_of("luiten").debug
    assert all(map(torch.equal, drop_in.GaussianRasterizer(settings)(**scene_of()), render("luiten")))


def test_dialects_in_threads():
    """Settings carry their dialect: threads that render in different ones do not meet."""
    names = ["gs2023", "mip", "depth_alpha", "luiten"]
    expected = [render(name) for name in names]
    wrong = []

    def work(i):
        for _ in range(10):
            if not all(map(torch.equal, render(names[i]), expected[i])):
                wrong.append(names[i])

    in_threads(len(names), work)
    assert not wrong


# --- means2D ------------------------------------------------------------------------------------


def gradient_of_means2d(name, device, dtype, columns=3, key="means2D", **further):
    points = torch.zeros(COUNT, columns, dtype=dtype, device=device, requires_grad=True)
    scene = {**arguments_of(name, device, dtype), key: points, **further}
    color = render(name, device, dtype, scene=scene)[0]
    (color * probe(color)).sum().backward()
    return points.grad


@each_precision
def test_third_column_of_mip_is_the_sum_of_absolute_values(device, dtype):
    """|gx| + |gy| over pixels: the sum of the two columns that a (P, 4) means2D has."""
    three = gradient_of_means2d("mip", device, dtype)
    four = gradient_of_means2d("mip", device, dtype, columns=4)
    # The same numbers, added up in another order: a few roundings per pixel of the picture.
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    assert torch.allclose(three[:, 2], four[:, 2:].sum(1), rtol=tolerance, atol=0)
    assert (three[:, 2] > 0).any() and torch.equal(three[:, :2], four[:, :2])


def test_third_column_of_analytic_is_the_sum_of_norms():
    """Per pixel, by definition: the gradient of a loss of that pixel alone, its length, and the sum over pixels."""
    camera = dataclasses.replace(CAMERA, image_width=9, image_height=7)
    scene = scenes.random_scene(5, 4, 1)
    settings = dialects.dialect_module("analytic").GaussianRasterizationSettings(**camera.fields())
    points = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    color = drop_in.GaussianRasterizer(settings)(**scene | {"means2D": points})[0]
    dL_dcolor = probe(color)
    expected = torch.zeros(4, dtype=torch.float64)
    for y in range(7):
        for x in range(9):
            of_pixel = torch.zeros_like(dL_dcolor)
            of_pixel[:, y, x] = dL_dcolor[:, y, x]
            (grad,) = torch.autograd.grad(color, points, of_pixel, retain_graph=True)
            expected += grad[:, :2].norm(dim=1)
    (grad,) = torch.autograd.grad(color, points, dL_dcolor)
    assert torch.allclose(grad[:, 2], expected, rtol=1e-10, atol=0) and (expected > 0).sum() == 3


@pytest.mark.parametrize("name", ["gs2023", "gs2024", "depth_alpha", "luiten", "monogs", "scaffold", "mcmc"])
def test_third_column_of_the_others_is_zero(device, name):
    grad = gradient_of_means2d(name, device, torch.float32)
    assert (grad[:, 2] == 0).all() and (grad[:, :2] != 0).any()


def test_densify_receives_what_means2d_receives(device):
    means2D = torch.zeros(COUNT, 3, device=device, requires_grad=True)
    grad = gradient_of_means2d("depth", device, torch.float32, key="means2D_densify", means2D=means2D)
    assert torch.equal(grad, means2D.grad) and (grad[:, :2] != 0).any()
    alone = gradient_of_means2d("depth", device, torch.float32, key="means2D_densify", means2D=None)
    assert torch.equal(grad, alone)


# --- dialect by dialect -------------------------------------------------------------------------


def test_accel_has_the_gradient_of_dc(device):
    """The same rows of harmonics, in one tensor or in two."""
    scene = scenes.leaves(arguments_of("accel", device))
    whole = scenes.leaves(scene_of(device))
    for made in (render("accel", device, scene=scene)[0], plain(device, scene=whole)[0]):
        (made * probe(made)).sum().backward()
    assert torch.equal(torch.cat([scene["dc"].grad, scene["shs"].grad], 1), whole["shs"].grad)
    only = scene_of(device) | {"shs": None, "dc": scene["dc"].detach()}
    flat = dataclasses.replace(CAMERA, sh_degree=0)
    expected = plain(device, scene=scene_of(device) | {"shs": only["dc"]}, camera=flat)
    assert torch.equal(render("accel", device, scene=only, sh_degree=0)[0], expected[0])


def test_sparse_adam_against_its_definition(device):
    drop_in.set_dialect("accel")
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    parameters = [torch.nn.Parameter(draw(6, 2, 3).to(device)), torch.nn.Parameter(draw(6).to(device))]
    groups = [{"params": [parameters[0]], "lr": 0.1, "name": "a"}, {"params": [parameters[1]], "name": "b"}]
    assert drop_in.SparseGaussianAdam is ar.optim.SparseGaussianAdam
    optimizer = drop_in.SparseGaussianAdam(groups, lr=0.02, eps=1e-15)
    zeros = lambda p: torch.zeros(p.shape).double()  # noqa: E731
    states = [[p.detach().cpu().clone(), zeros(p), zeros(p)] for p in parameters]
    for visible in ([1, 0, 1, 0, 1, 1], [0, 0, 1, 1, 0, 1], [0, 0, 0, 0, 0, 0]):
        for p, lr, (value, m, v) in zip(parameters, (0.1, 0.02), states):
            p.grad = draw(*p.shape).to(device)
            for row in range(6):
                if visible[row]:
                    g = p.grad[row].cpu()
                    m[row], v[row] = 0.9 * m[row] + 0.1 * g, 0.999 * v[row] + 0.001 * g * g
                    value[row] -= lr * m[row] / (v[row].sqrt() + 1e-15)
        optimizer.step(torch.tensor(visible, dtype=torch.bool, device=device), 6)
        for p, (value, m, v) in zip(parameters, states):
            assert torch.allclose(p.detach().cpu(), value, rtol=1e-12)
            assert torch.allclose(optimizer.state[p]["exp_avg"].cpu(), m, rtol=1e-12)
            assert torch.allclose(optimizer.state[p]["exp_avg_sq"].cpu(), v, rtol=1e-12)
    with pytest.raises(ValueError, match=r"visibility must have shape \(6,\), got \(5,\)"):
        optimizer.step(torch.ones(5, dtype=torch.bool, device=device), 6)
    with pytest.raises(TypeError, match="visibility must be a tensor, got list"):
        optimizer.step([True] * 6, 6)
    with pytest.raises(ValueError, match=rf"rows must be on the device of the parameters, {device}.*, got meta"):
        optimizer.step(torch.ones(6, dtype=torch.bool, device="meta"), 6)


@pytest.mark.parametrize("shape", [(3,), (1, 3)])
def test_gradient_of_the_pose_is_that_of_a_small_motion(shape):
    """MonoGS's theta and rho against `ar.moved`, in float64: the same derivative, by another way."""
    scene = scene_of(dtype=torch.float64)
    theta, rho = (torch.zeros(shape, dtype=torch.float64, requires_grad=True) for _ in range(2))
    color, _, depth, *_ = render("monogs", dtype=torch.float64, scene=scene | {"theta": theta, "rho": rho})
    loss = (color * probe(color)).sum() + (depth * probe(depth)).sum()
    loss.backward()

    tangent = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    view = ar.moved(CAMERA.world_to_camera(), tangent)
    settings = CAMERA.settings(footprint="point", effects=ar.Effects(depth=True))._replace(
        viewmatrix=view.T, projmatrix=(CAMERA.perspective() @ view).T, campos=-view[:3, :3].T @ view[:3, 3]
    )
    color, _, outputs = ar.GaussianRasterizer(settings)(**scene)
    ((color * probe(color)).sum() + (outputs.depth * probe(outputs.depth)).sum()).backward()
    assert theta.grad.shape == rho.grad.shape == shape
    expected = torch.cat([tangent.grad[3:], tangent.grad[:3]])
    assert torch.allclose(torch.cat([theta.grad.flatten(), rho.grad.flatten()]), expected, rtol=1e-9)


def test_pose_of_monogs_in_single_precision(device):
    theta, rho = (torch.zeros(1, 3, device=device, requires_grad=True) for _ in range(2))
    made = render("monogs", device, scene=scene_of(device) | {"theta": theta, "rho": rho})
    made[0].square().sum().backward()
    assert theta.grad.shape == (1, 3) and (theta.grad != 0).all() and (rho.grad != 0).all()
    with pytest.raises(ValueError, match=r"rho must hold 3 numbers, got shape \(2,\)"):
        render("monogs", device, scene=scene_of(device) | {"theta": theta, "rho": torch.zeros(2, device=device)})


@pytest.mark.parametrize("name", ["gs2023", "scaffold"])
def test_visible_filter_is_the_radii_of_a_picture(device, name):
    scene = scene_of(device)
    scene["means3D"][::3] *= 10  # outside
    rasterizer = drop_in.GaussianRasterizer(settings_of(name, device))
    geometry = {key: scene[key] for key in ("means3D", "scales", "rotations")}
    found = rasterizer.visible_filter(**geometry, cov3D_precomp=None)
    assert found.dtype == torch.int32 and (found == 0).any() and (found > 0).any()
    assert torch.equal(found, rasterizer(**scene | {"opacities": torch.ones(COUNT, 1, device=device)})[1])
    assert rasterizer.visible_filter(*(value[:0] for value in geometry.values())).shape == (0,)


FEATURES = {
    "langsplat": ("language_feature_precomp", 3),
    "grouping": ("sh_objs", 16),
    "feature3dgs": ("semantic_feature", 7),
}


@each_precision
@pytest.mark.parametrize("name, key, channels", [(name, *feature) for name, feature in FEATURES.items()])
@pytest.mark.parametrize("colors", ["shs", "colors_precomp"])
def test_features_are_blended_like_colors(device, dtype, name, key, channels, colors):
    """In one pass what two pictures show, and the gradients of both."""
    feature = torch.rand(COUNT, channels, dtype=dtype, device=device)
    scene = scene_of(device, dtype)
    if colors == "colors_precomp":
        scene |= {"shs": None, "colors_precomp": torch.rand(COUNT, 3, dtype=dtype, device=device)}
    ours, theirs = ({k: v if v is None else v.clone().requires_grad_() for k, v in scene.items()} for _ in range(2))
    of_ours, of_theirs = (feature.clone().requires_grad_() for _ in range(2))
    shaped = of_ours if name == "langsplat" else of_ours[:, None]
    made = render(name, device, dtype, scene=ours | {key: shaped}, include_feature=True)
    # color, and the other picture: after it, or after the radii
    color, image = made[0], made[2] if name == "grouping" else made[1]
    expected = plain(device, dtype, "point", scene=theirs)[0]
    of_features = scenes.without(theirs, "shs") | {"colors_precomp": of_theirs}
    black = CAMERA.settings(dtype, device, footprint="point")._replace(bg=expected.new_zeros(channels))
    expected_image = ar.GaussianRasterizer(black)(**of_features)[0]
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    assert (color - expected).abs().max() <= tolerance and (image - expected_image).abs().max() <= tolerance
    ((color * probe(color)).sum() + (image * probe(image)).sum()).backward()
    ((expected * probe(color)).sum() + (expected_image * probe(image)).sum()).backward()
    assert relative_error(of_ours.grad, of_theirs.grad) < 10 * tolerance
    for name_of_input, leaf in ours.items():
        if leaf is not None:
            # Two passes add up rounded gradients, and the colour's direction passes through one more projection.
            assert relative_error(leaf.grad, theirs[name_of_input].grad) < 1000 * tolerance, name_of_input


def test_features_and_a_background_that_is_an_image():
    """The image lies behind the colours, nothing behind the features."""
    behind = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(3))
    objects = torch.rand(COUNT, 1, 16, generator=torch.Generator().manual_seed(4))
    scene = scene_of() | {"sh_objs": objects}
    over_black = render("grouping", scene=scene, bg=torch.zeros(3), effects=ar.Effects(alpha=True))
    made = render("grouping", scene=scene, bg=behind)
    expected = over_black[0] + (1 - over_black[3].alpha) * behind
    assert (made[0] - expected).abs().max() < 1e-6 and (made[2] - over_black[2]).abs().max() < 1e-6


def test_gaussians_whose_features_are_not_finite_are_culled(device):
    """As with colours that are not; the others are drawn as without them."""
    scene = scene_of(device)
    objects = torch.rand(COUNT, 1, 16, device=device)
    scene["sh_objs"] = objects.clone()
    scene["sh_objs"][[3, 11], 0, 15] = math.nan
    left = torch.ones(COUNT, dtype=torch.bool)
    left[[3, 11]] = False
    made = render("grouping", device, scene=scene)
    expected = render("grouping", device, scene={k: v[left] for k, v in scene.items()})
    assert (made[1][~left] == 0).all() and (render("grouping", device, scene=scene | {"sh_objs": objects})[1] > 0).all()
    assert all(map(torch.equal, (made[0], made[1][left], made[2]), expected))


def test_the_background_has_its_gradient_beside_features(device):
    bg = torch.rand(3, device=device, requires_grad=True)
    scene = arguments_of("grouping", device, sh_objs=torch.rand(COUNT, 1, 5, device=device))
    color, _, image = render("grouping", device, scene=scene, bg=bg)
    ((color * probe(color)).sum() + image.sum()).backward()
    expected = bg.detach().clone().requires_grad_()
    settings = CAMERA.settings(torch.float32, device, footprint="point")._replace(bg=expected)
    color = ar.GaussianRasterizer(settings)(**scene_of(device))[0]
    (color * probe(color)).sum().backward()
    assert torch.allclose(bg.grad, expected.grad, rtol=1e-5)


def test_wrong_features(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where debug writes its dump
    with pytest.raises(ValueError, match=r"features must have shape \(P, K\) with P = 25 .*, got \(24, 3\)"):
        render("langsplat", scene=scene_of() | {"language_feature_precomp": torch.zeros(24, 3)}, include_feature=True)
    with pytest.raises(TypeError, match="features must be a tensor, got list"):
        render("langsplat", scene=scene_of() | {"language_feature_precomp": []}, include_feature=True)
    with pytest.raises(ValueError, match=r"features must come with shs or colors_precomp \(P, 3\), got \(P, 4\)"):
        given = {"shs": None, "colors_precomp": torch.zeros(COUNT, 4), "sh_objs": torch.zeros(COUNT, 1, 16)}
        render("grouping", scene=scene_of() | given, bg=torch.zeros(4))
    with pytest.raises(ValueError, match=r"features must be finite, got nan at \(2, 1\)"):
        nan = torch.zeros(COUNT, 3).index_put((torch.tensor(2), torch.tensor(1)), torch.tensor(math.nan))
        render("langsplat", scene=scene_of() | {"language_feature_precomp": nan}, include_feature=True, debug=True)
    with pytest.raises(ValueError, match="language_feature_precomp must be given"):
        render("langsplat", include_feature=True)
    with pytest.raises(ValueError, match=r"exactly one|shs"):
        both = {"colors_precomp": torch.zeros(COUNT, 3), "sh_objs": torch.zeros(COUNT, 1, 16)}
        render("grouping", scene=scene_of() | both)


@pytest.mark.parametrize(
    "name, further, error, message",
    [
        ("accel", {"dc": [1.0]}, TypeError, "dc must be a tensor, got list"),
        ("accel", {"dc": torch.zeros(5, 1, 3)}, ValueError, r"dc must have shape \(P, 1, 3\) .*, got \(5, 1, 3\) and"),
        ("accel", {"dc": torch.zeros(COUNT, 3)}, ValueError, r"dc must have shape \(P, 1, 3\) .*, got \(25, 3\) and"),
        ("accel", {"dc": torch.zeros(COUNT, 1, 3).double()}, TypeError, "dc must have the dtype of shs"),
        ("grouping", {"sh_objs": [1.0]}, TypeError, "sh_objs must be a tensor, got list"),
        ("grouping", {"sh_objs": torch.tensor(1.0)}, ValueError, r"sh_objs must have shape .*, got \(\)"),
        ("feature3dgs", {"semantic_feature": [1.0]}, TypeError, "semantic_feature must be a tensor, got list"),
        ("feature3dgs", {"semantic_feature": torch.zeros(COUNT)}, ValueError, r"semantic_feature must have shape"),
        ("depth", {"means2D_densify": [1.0]}, TypeError, "means2D_densify must be a tensor, got list"),
        ("depth", {"means2D_densify": torch.zeros(5, 3)}, ValueError, r"means2D_densify must have .*, got \(5, 3\)"),
        ("monogs", {"theta": [0.0, 0.0, 0.0]}, TypeError, "theta must be a tensor, got list"),
    ],
)
def test_wrong_further_arguments(name, further, error, message):
    with pytest.raises(error, match=message):
        render(name, scene=arguments_of(name) | further)


@pytest.mark.parametrize("missing", [None, torch.empty(0)], ids=["none", "empty"])
def test_densify_without_means2d(missing):
    """What is missing may be None or an empty tensor, here as elsewhere."""
    probe_at = torch.zeros(COUNT, 3, requires_grad=True)
    render("depth", scene=scene_of() | {"means2D": missing, "means2D_densify": probe_at})[0].sum().backward()
    expected = torch.zeros(COUNT, 3, requires_grad=True)
    render("depth", scene=scene_of() | {"means2D": expected, "means2D_densify": missing})[0].sum().backward()
    assert probe_at.grad.abs().max() > 0 and torch.equal(probe_at.grad, expected.grad)


def test_lightgaussian_counts(device):
    counts, scores, color, radii = render("lightgaussian", device, f_count=True)
    expected = plain(device, footprint="point", gaussian_stats=True)
    stats = expected[2].gaussian_stats
    assert torch.equal(counts, stats.pixels) and torch.equal(scores, stats.sum_weight)
    assert torch.equal(color, expected[0]) and torch.equal(radii, expected[1])


# --- Mini-Splatting's second module -------------------------------------------------------------


def test_module_of_mini_splatting():
    import diff_gaussian_rasterization_ms as second

    settings = second.GaussianRasterizationSettings(**CAMERA.fields(torch.float32))
    made = second.GaussianRasterizer(settings)(**scene_of())
    assert all(map(torch.equal, made, render("mini")))


def test_minis_two_modules_have_one_filter():
    """It trains through one and evaluates through the other; a footprint that the user chose is that of both."""
    program = """
        import diff_gaussian_rasterization as evaluates
        made = lambda: evaluates.GaussianRasterizationSettings(*range(12)).footprint_in_use().name
        print(made())
        import diff_gaussian_rasterization_ms as trains
        print(made(), trains.GaussianRasterizationSettings(*range(12)).footprint_in_use().name)
        import analytic_rasterizer
        analytic_rasterizer.set_default_footprint("mip")
        print(made(), trains.GaussianRasterizationSettings(*range(12)).footprint_in_use().name)
    """
    assert run_python(program).split() == ["analytic", "point", "point", "mip", "mip"]
    # The module of 3DGS 2023 stays what it is.
    settings = drop_in.GaussianRasterizationSettings(**CAMERA.fields(torch.float32))
    assert len(drop_in.GaussianRasterizer(settings)(**scene_of())) == 2


@each_precision
def test_depth_where_a_ray_passes_through_a_gaussian(device, dtype):
    """The point of highest density along each pixel's ray, found by searching along the ray."""
    scene = scenes.cast(scenes.random_scene(9, 3, 1, opacity=(0.5, 0.9), sigma=(0.2, 0.6), spread=0.5), dtype, device)
    camera = dataclasses.replace(CAMERA, shift=(3.0, -2.0))
    settings = dialects.dialect_module("mini").GaussianRasterizationSettings(**camera.fields(dtype, device))
    found = dialects.dialect_module("mini").GaussianRasterizer(settings).render_depth(**scene)
    assert found["out_pts"].shape == (3, 30, 40) and found["accum_alpha"].shape == found["depth"].shape == (1, 30, 40)
    seen = found["gidx"][0] >= 0
    assert seen.any() and not seen.all()
    assert (found["out_pts"][:, ~seen] == 0).all() and (found["depth"][0, ~seen] == 0).all()
    # The points lie on the rays of their pixels.
    points = found["out_pts"].permute(1, 2, 0)[seen].cpu().double()
    fields = camera.fields()
    clip = torch.cat([points, torch.ones(len(points), 1)], 1).double() @ fields["projmatrix"]
    pixels = ((clip[:, :2] / clip[:, 3:] + 1) * torch.tensor([40.0, 30.0]) - 1) / 2
    y, x = seen.cpu().nonzero().T
    tolerance = 1e-9 if dtype == torch.float64 else 1e-3
    assert (pixels - torch.stack([x, y], 1)).abs().max() < tolerance
    assert torch.allclose(clip[:, 3], found["depth"][0, seen].cpu().double(), rtol=tolerance)
    # Along the ray the density falls off to both sides: its derivative is zero.
    import reference

    covariance = reference.covariance_3d(scene["scales"].cpu().double(), scene["rotations"].cpu().double(), 1.0)
    index = found["gidx"][0, seen].cpu().long()
    rays = torch.nn.functional.normalize(points - fields["campos"])
    from_center = points - scene["means3D"].cpu().double()[index]
    slope = (rays * torch.linalg.solve(covariance[index], from_center)).sum(1)
    scale = torch.linalg.solve(covariance[index], rays).norm(dim=1) * from_center.norm(dim=1).clamp_min(1e-3)
    assert (slope.abs() / scale).max() < tolerance
    precomputed = scenes.without(scene, "scales", "rotations")
    rows, columns = torch.triu_indices(3, 3)
    precomputed["cov3D_precomp"] = covariance[:, rows, columns].to(scene["means3D"])
    again = dialects.dialect_module("mini").GaussianRasterizer(settings).render_depth(**precomputed)
    same = again["gidx"] == found["gidx"]
    assert same.float().mean() > 0.99
    difference = (again["out_pts"] - found["out_pts"])[:, same[0]].abs().max()
    assert difference < (1e-9 if dtype == torch.float64 else 2e-3)


# --- relocation ---------------------------------------------------------------------------------


def test_relocation_against_the_paper(device):
    """[MCMC, Eq. 9] summed term by term with exact integers, for opacities up to the largest below 1."""
    opacity = torch.tensor([0.0, 1e-6, 0.005, 0.3, 0.7, 0.97, 1 - 2.0**-20, 1.0], dtype=torch.float64)
    scales = torch.full((8, 3), 2.0, dtype=torch.float64, device=device)
    for n in (1, 2, 7, 50):
        new, scale = ar.compute_relocation(opacity.to(device), scales, torch.full((8,), n, device=device))
        for i, o in enumerate(opacity.clamp(max=1 - 2.0**-24).tolist()):
            o_new = -math.expm1(math.log1p(-o) / n)
            places = [(i, k) for i in range(1, n + 1) for k in range(i)]
            terms = [math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * o_new ** (k + 1) for i, k in places]
            factor = 1.0 if o == 0 else o / math.fsum(terms)
            # The terms cancel: up to (1 + o_new)^n of them for a sum of about o.
            tolerance = 1e-15 * n * (1 + o_new) ** n / max(o, o_new, 1e-300) if o else 0
            assert math.isclose(new[i], o_new, rel_tol=1e-13, abs_tol=1e-300)
            assert all(math.isclose(s, 2 * factor, rel_tol=1e-13 + tolerance * 10) for s in scale[i].tolist())


def test_relocation_keeps_the_centre(device):
    """N Gaussians of the new opacity let as much light through their centre as the old one."""
    opacity = torch.linspace(0.01, 0.99, 20, device=device)[:, None]
    count = torch.arange(1, 21, device=device)[:, None]
    scale = torch.rand(20, 3, device=device)
    new_opacity, new_scale = ar.compute_relocation(opacity, scale, count, torch.zeros(51, 51, device=device), 51)
    assert new_opacity.shape == (20, 1) and new_scale.shape == (20, 3) and new_scale.dtype == torch.float32
    assert torch.allclose((1 - new_opacity) ** count, 1 - opacity, atol=2e-6)
    assert torch.equal(new_scale[0], scale[0]) and torch.equal(new_opacity[0], opacity[0].clamp(max=1))
    clamped = ar.compute_relocation(opacity, scale, count * 0, None, 51)
    assert torch.equal(clamped[1], scale)


def test_relocation_of_wrong_inputs():
    opacity, scale, count = torch.rand(4), torch.rand(4, 3), torch.ones(4, dtype=torch.int64)
    for wrong, error, message in [
        ((opacity, scale[:3], count), ValueError, r"scale_old must have shape \(4, 3\), got \(3, 3\)"),
        ((opacity, scale, count[:3]), ValueError, r"N must have shape \(4,\) or \(4, 1\), got \(3,\)"),
        ((opacity, scale, count.float()), TypeError, "N must be of integers, got torch.float32"),
        ((opacity.tolist(), scale, count), TypeError, "opacity_old must be a tensor, got list"),
        ((opacity, scale, count, None, 0), ValueError, "n_max must be at least 1, got 0"),
        ((opacity, scale, count, None, 1001), ValueError, "n_max must be at most 1000, got 1001"),
        ((opacity, scale, count, None, 2.5), ValueError, "n_max must be a whole number, got 2.5"),
        ((opacity.long(), scale, count), TypeError, "opacity_old must have a floating-point dtype, got torch.int64"),
        ((opacity, scale.int(), count), TypeError, "scale_old must have a floating-point dtype, got torch.int32"),
        ((opacity, scale, count + 0j), TypeError, "N must be of integers, got torch.complex64"),
    ]:
        with pytest.raises(error, match=message):
            ar.compute_relocation(*wrong)
    assert [len(t) for t in ar.compute_relocation(opacity[:0], scale[:0], count[:0])] == [0, 0]


# --- the compiled module's functions ------------------------------------------------------------


def native_arguments(device, scene, fields):
    empty = torch.Tensor([])
    pick = lambda name: scene.get(name, empty)  # noqa: E731
    f = fields
    return (
        f["bg"], scene["means3D"], pick("colors_precomp"), scene["opacities"], pick("scales"), pick("rotations"),
        f["scale_modifier"], pick("cov3D_precomp"), f["viewmatrix"], f["projmatrix"], f["tanfovx"], f["tanfovy"],
        f["image_height"], f["image_width"], pick("shs"), f["sh_degree"], f["campos"], False, False,
    )  # fmt: skip


@pytest.mark.parametrize("inputs", ["harmonics", "precomputed"])
def test_native_functions(device, inputs):
    from diff_gaussian_rasterization import _C

    scene = scenes.random_scene(1, COUNT, 1)
    if inputs == "precomputed":
        scene = scenes.with_precomputed(scene)
    scene = scenes.cast(scene, torch.float32, device)
    fields = CAMERA.fields(torch.float32, device)
    arguments = native_arguments(device, scenes.without(scene, "means2D"), fields)
    count, color, radii, *buffers = _C.rasterize_gaussians(*arguments)
    leaves = scenes.leaves(scene)
    expected, expected_radii, _ = plain(device, scene=leaves)
    assert torch.equal(color, expected) and torch.equal(radii, expected_radii)
    assert count >= (radii > 0).sum() and isinstance(count, int) and all(torch.is_tensor(b) for b in buffers)
    weights = probe(color)
    (expected * weights).sum().backward()
    ar.set_default_footprint("point")  # the backward pass is of what was rendered
    bg, means3D, colors, _, scales, rotations, modifier, cov, view, proj, tx, ty, _, _, sh, degree, campos, *_ = (
        arguments
    )
    made = _C.rasterize_gaussians_backward(
        bg, means3D, radii, colors, scales, rotations, modifier, cov, view, proj, tx, ty, weights, sh, degree, campos,
        buffers[0], count, buffers[1], buffers[2], False,
    )  # fmt: skip
    names = ("means2D", "colors_precomp", "opacities", "means3D", "cov3D_precomp", "shs", "scales", "rotations")
    for name, gradient in zip(names, made):
        if name in leaves:
            assert torch.equal(gradient, leaves[name].grad), name
        else:
            assert len(gradient) == COUNT and (gradient == 0).all()
    assert _C.mark_visible(means3D, view, proj).all() and not _C.mark_visible(means3D * 0 - 10, view, proj).any()


def test_native_functions_without_gaussians(device):
    from diff_gaussian_rasterization import _C

    scene = {name: value[:0] for name, value in scene_of(device).items()}
    fields = CAMERA.fields(torch.float32, device)
    count, color, radii, *buffers = _C.rasterize_gaussians(*native_arguments(device, scene, fields))
    assert count == 0 and len(radii) == 0 and (color[0] == fields["bg"][0]).all()
    empty, f = torch.Tensor([]), fields
    made = _C.rasterize_gaussians_backward(
        f["bg"], scene["means3D"], radii, empty, scene["scales"], scene["rotations"], 1.0, empty, f["viewmatrix"],
        f["projmatrix"], 0.6, 0.5, probe(color), scene["shs"], 1, f["campos"], buffers[0], 0, buffers[1], buffers[2],
        False,
    )  # fmt: skip
    assert [tuple(g.shape) for g in made] == [(0, 3), (0, 3), (0, 1), (0, 3), (0, 6), (0, 4, 3), (0, 3), (0, 4)]


# --- installed beside others, and extended ------------------------------------------------------

FAKE = "GaussianRasterizer = None\n"


@pytest.mark.parametrize(
    "files, message",
    [
        ({"diff_gaussian_rasterization/__init__.py": FAKE}, "is not that of analytic_rasterizer but another at"),
        ({"diff_gaussian_rasterization/leftover.txt": ""}, "diff_gaussian_rasterization is missing"),
        ({"diff_gaussian_rasterization_ms.py": FAKE}, "diff_gaussian_rasterization_ms is not that of"),
        ({}, None),
    ],
    ids=["another", "removed", "another_ms", "ours"],
)
def test_another_distribution_of_the_same_name(tmp_path, files, message):
    """Ours is copied to a folder of its own, as in site-packages, and another's files are put over it."""
    installed(tmp_path)
    for path, text in files.items():
        folder = (tmp_path / path).parent
        if folder != tmp_path:
            shutil.rmtree(folder)
            folder.mkdir()
        elif (tmp_path / path).stem != path:
            shutil.rmtree(tmp_path / (tmp_path / path).stem)
        (tmp_path / path).write_text(text)
    code = """
        import sys, warnings
        sys.path = [sys.argv[1]] + [p for p in sys.path if "site-packages" in p or "lib" in p]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            import analytic_rasterizer
            import analytic_rasterizer.dialects
        assert analytic_rasterizer.__file__.startswith(sys.argv[1])
        print(*[w.message for w in caught], sep="\\n")
    """
    printed = run_python(code, str(tmp_path), PYTHONPATH=str(tmp_path)).strip()
    if message is None:
        assert printed == ""
    else:
        assert printed.count("\n") == 0 and message in printed and "--force-reinstall --no-deps" in printed


def test_the_distribution_to_uninstall_is_named(tmp_path, monkeypatch):
    """As pip knows it, which need not be the name of the module."""
    info = tmp_path / "their_rasterizer-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-rasterizer\nVersion: 1.0\n")
    (info / "top_level.txt").write_text("diff_gaussian_rasterization\n")
    (tmp_path / "diff_gaussian_rasterization.py").write_text(FAKE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "diff_gaussian_rasterization")
    problem = installation.problem_of("diff_gaussian_rasterization")
    assert "`pip uninstall -y their-rasterizer` and then `pip install --force-reinstall --no-deps" in problem


def installed(folder):
    """The packages in another folder, as an installation has them."""
    for package in ("analytic_rasterizer", "diff_gaussian_rasterization", "diff_gaussian_rasterization_ms"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    library = next(path for path in (ROOT / "analytic_rasterizer").glob("_C*"))
    assert (folder / "analytic_rasterizer" / library.name).exists()


def test_compiled_module_of_another_that_was_left_behind(tmp_path):
    """A `_C` that the other rasterizer left beside our __init__.py is not imported."""
    installed(tmp_path)
    (tmp_path / "diff_gaussian_rasterization" / "_C.py").write_text("raise RuntimeError('the wrong one')")
    code = """
        import diff_gaussian_rasterization._C
        from diff_gaussian_rasterization import _C
        print(_C.rasterize_gaussians.__module__, diff_gaussian_rasterization._C.mark_visible.__module__)
    """
    names = run_python(code, PYTHONPATH=str(tmp_path)).split()
    assert names == ["analytic_rasterizer.dialects._native"] * 2


def test_a_new_dialect_is_one_file(tmp_path):
    """The file of its page, put into the package, is a dialect: by choice and by inference."""
    text = (ROOT / "docs" / "internals" / "adding-a-dialect.md").read_text()
    source = text.split("```python\n# analytic_rasterizer/dialects/confident.py\n")[1].split("```")[0]
    installed(tmp_path)
    (tmp_path / "analytic_rasterizer" / "dialects" / "confident.py").write_text(source)
    code = """
        import sys, torch
        import diff_gaussian_rasterization as d
        import analytic_rasterizer
        assert analytic_rasterizer.__file__.startswith(sys.argv[1])
        view = torch.eye(4); view[3, 2] = 4
        camera = [8, 8, 0.4, 0.4, torch.zeros(3), 1.0, view, view @ torch.diag(torch.tensor([2.5, 2.5, 1, 0])), 0]
        projection = torch.zeros(4, 4); projection[0, 0] = projection[1, 1] = 2.5; projection[2, 3] = 1
        camera[7] = view @ projection
        settings = d.GaussianRasterizationSettings(*camera, torch.zeros(3), False, False, confidence=torch.ones(1, 1))
        made = d.GaussianRasterizer(settings)(
            torch.zeros(1, 3), None, torch.ones(1, 1), colors_precomp=torch.ones(1, 3), scales=torch.ones(1, 3),
            rotations=torch.ones(1, 4),
        )
        print(settings.dialect, len(made), settings.footprint_in_use())
        d.set_dialect("confident"); print(d.GaussianRasterizationSettings._fields[-1])
    """
    printed = run_python(code, str(tmp_path), PYTHONPATH=str(tmp_path)).split()
    assert printed == ["confident", "4", "point:dilation=0.3", "confidence"]
    assert "confident" not in dialects.DIALECTS


def test_settings_classes_state_their_dialect():
    for name in dialects.DIALECTS:
        module = dialects.dialect_module(name)
        assert module.GaussianRasterizationSettings.dialect == name
        assert issubclass(module.GaussianRasterizationSettings, _base.GaussianRasterizationSettings)
        assert module.__doc__ and "Repositories: " in module.__doc__
