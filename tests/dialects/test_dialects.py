"""The dialects of diff_gaussian_rasterization: what each takes, returns and exports, beside what the library makes."""

import inspect

import pytest
import torch
from originals import CAMERA, COUNT, ORIGINALS, THEIR_FILTER, arguments_of, plain, render, scene_of, settings_of
from places import ROOT
from processes import run_python

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects
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


def test_settings_classes_state_their_dialect():
    for name in dialects.DIALECTS:
        module = dialects.dialect_module(name)
        assert module.GaussianRasterizationSettings.dialect == name
        assert issubclass(module.GaussianRasterizationSettings, _base.GaussianRasterizationSettings)
        assert module.__doc__ and "Repositories: " in module.__doc__
