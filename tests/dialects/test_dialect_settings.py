"""Settings and rasterizers of dialects: which is inferred, what is refused, and what can be copied."""

import copy
import pickle

import pytest
import torch
from originals import (
    BASE,
    CAMERA,
    COUNT,
    ORIGINALS,
    THEIR_FILTER,
    arguments_of,
    fields_of,
    plain,
    render,
    scene_of,
    settings_of,
)
from processes import in_threads

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects

pytestmark = pytest.mark.usefixtures("nothing_chosen")


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
