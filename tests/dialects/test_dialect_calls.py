"""Every dialect called in the ways in which programs call it: the same picture, or an error that helps."""

import inspect
import types

import pytest
import torch
from originals import COUNT, ORIGINALS, arguments_of, fields_of, render, scene_of, settings_of

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects

pytestmark = pytest.mark.usefixtures("nothing_chosen")

each_dialect = pytest.mark.parametrize("name", ORIGINALS)

# What is rendered further where a dialect can.
FURTHER_SETTINGS = {"langsplat": {"include_feature": True}, "lightgaussian": {"f_count": True}}


def full_arguments(name, **scene):
    """A scene with every optional input that the dialect has."""
    scene = arguments_of(name, **scene)
    if name == "langsplat":
        scene["language_feature_precomp"] = torch.linspace(0, 1, 3 * COUNT).reshape(COUNT, 3)
    if name == "grouping":
        scene["sh_objs"] = torch.linspace(0, 1, 16 * COUNT).reshape(COUNT, 1, 16)
    if name == "monogs":
        scene["theta"], scene["rho"] = torch.zeros(3), torch.zeros(3)
    return scene


def full_settings(name, **changed):
    return settings_of(name, **FURTHER_SETTINGS.get(name, {}), **changed)


def rasterizer_of(name, settings):
    return dialects.dialect_module(name).GaussianRasterizer(raster_settings=settings)


def assert_same(made, expected):
    assert len(made) == len(expected)
    for ours, theirs in zip(made, expected):
        assert ours.dtype == theirs.dtype and torch.equal(ours, theirs)


def with_strides(tensor):
    """The same numbers, every other one of a larger tensor."""
    return torch.stack([tensor, tensor], -1)[..., 0]


def gradients(name, settings, scene):
    """What is rendered, and the gradients of its sum by input; means2D is made as 3DGS makes it."""
    leaves = {key: value.detach().clone().requires_grad_() for key, value in scene.items()}
    leaves["means2D"] = torch.zeros_like(leaves["means3D"], requires_grad=True) + 0
    leaves["means2D"].retain_grad()
    made = rasterizer_of(name, settings)(**leaves)
    sum(value.sum() for value in made if value.requires_grad).backward()
    return made, {key: leaf.grad for key, leaf in leaves.items()}


# --- the ways to give the same -------------------------------------------------------------------


@each_dialect
def test_by_position(name):
    expected = render(name)
    settings_class = dialects.dialect_module(name).GaussianRasterizationSettings
    settings = settings_class(*fields_of(name).values())
    scene = arguments_of(name)
    assert_same(rasterizer_of(name, settings)(*[scene.get(key) for key in ORIGINALS[name][1]]), expected)


@each_dialect
def test_tensors_as_programs_have_them(name):
    """Views, transposed matrices, empty tensors for what is missing, opacities without a second dimension."""
    expected = render(name)
    scene = arguments_of(name)
    strided = {key: with_strides(value) for key, value in scene.items()}
    assert not any(value.is_contiguous() for value in strided.values())
    assert_same(render(name, scene=strided), expected)
    assert_same(render(name, scene=scene | {"opacities": scene["opacities"].squeeze(1)}), expected)
    empty = torch.Tensor([])
    assert_same(render(name, scene=scene | {"colors_precomp": empty, "cov3D_precomp": empty}), expected)
    more_rows = torch.cat([scene["shs"], torch.ones(COUNT, 12, 3)], 1)
    assert_same(render(name, scene=scene | {"shs": more_rows}), expected)


@each_dialect
def test_cameras_as_programs_have_them(name):
    expected = render(name)
    fields = fields_of(name)
    matrices = [key for key in fields if "matrix" in key]
    assert_same(render(name, **{key: fields[key].T.contiguous().T for key in matrices}), expected)
    assert_same(render(name, **{key: fields[key][None] for key in matrices}), expected)
    assert_same(render(name, campos=fields["campos"][None], bg=fields["bg"][None]), expected)
    numbers = {key: torch.tensor(fields[key]) for key in ("image_height", "image_width", "sh_degree")}
    numbers |= {key: torch.tensor(fields[key], dtype=torch.float64) for key in ("tanfovx", "tanfovy", "scale_modifier")}
    assert_same(render(name, **numbers), expected)


@each_dialect
def test_settings_that_were_replaced(name):
    settings = settings_of(name, scale_modifier=0.5)._replace(scale_modifier=1.0)
    assert_same(rasterizer_of(name, settings)(**arguments_of(name)), render(name))


@each_dialect
def test_debug(name):
    fields = {"debug": True} if "debug" in ORIGINALS[name][0] else {}
    assert_same(render(name, **fields), render(name))


@each_dialect
def test_settings_of_a_class_of_the_program(name):
    """The originals read attributes of whatever they are given."""
    own = types.SimpleNamespace(**fields_of(name), name_of_the_view="0001")
    drop_in.set_dialect(name)
    rasterizer = drop_in.GaussianRasterizer(own)
    scene = arguments_of(name)
    assert_same(rasterizer(**scene), render(name))
    geometry = scene["means3D"], scene["scales"], scene["rotations"]
    assert (rasterizer.visible_filter(*geometry) > 0).all() and rasterizer.markVisible(scene["means3D"]).all()
    own.bg = own.bg + 0.25  # it is read anew in every call
    assert not torch.equal(rasterizer(**scene)[0], render(name)[0])
    if name == "mini":
        expected = rasterizer_of(name, settings_of(name, bg=own.bg)).render_depth(**scene)
        assert_same(rasterizer.render_depth(**scene).values(), expected.values())


@each_dialect
def test_settings_of_a_class_of_the_program_in_the_function(name):
    own = types.SimpleNamespace(**fields_of(name))
    drop_in.set_dialect(name)
    function = inspect.signature(drop_in.rasterize_gaussians).parameters
    names = {"sh": "shs", "cov3Ds_precomp": "cov3D_precomp", "raster_settings": None}
    given = {p: own if p == "raster_settings" else arguments_of(name).get(names.get(p, p)) for p in function}
    settings = given | {"raster_settings": settings_of(name)}
    assert_same(drop_in.rasterize_gaussians(**given), drop_in.rasterize_gaussians(**settings))


def test_settings_of_a_class_of_the_program_may_have_footprint_and_effects():
    own = types.SimpleNamespace(**fields_of("gs2023"), footprint="box:samples=16", effects=ar.Effects(alpha=True))
    made = drop_in.GaussianRasterizer(own)(**arguments_of("gs2023"))
    keywords = {"footprint": own.footprint, "effects": own.effects}
    assert_same(made[:2], render("gs2023", **keywords)[:2])
    assert torch.equal(made[2].alpha, render("gs2023", **keywords)[2].alpha)
    assert not torch.equal(made[0], render("gs2023")[0])


def test_settings_of_a_class_of_the_program_are_inferred_too():
    own = types.SimpleNamespace(**fields_of("monogs"))
    assert_same(drop_in.GaussianRasterizer(own)(**arguments_of("monogs")), render("monogs"))
    del own.campos
    with pytest.raises(TypeError, match="monogs must have campos, which are missing"):
        drop_in.GaussianRasterizer(own)(**arguments_of("monogs"))


# --- modes of torch ------------------------------------------------------------------------------


@each_dialect
def test_without_gradients(name):
    expected = render(name)
    leaves = {key: value.requires_grad_() for key, value in arguments_of(name).items()}
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            made = render(name, scene=leaves)
        assert_same(made, expected)
        assert not any(value.requires_grad for value in made)


@each_dialect
def test_autocast_rounds_nothing(name):
    """Under autocast matrix products have 8 bits: depths, statistics and poses must not be made with them."""
    settings = full_settings(name, subpixel_offset=torch.full((30, 40, 2), 0.25))
    scene = full_arguments(name)
    rasterizer = rasterizer_of(name, settings)

    def results():
        made, found = gradients(name, settings, scene)
        depths = rasterizer.render_depth(**scene).values() if name == "mini" else ()
        return [*made, rasterizer.markVisible(scene["means3D"]), *depths, *found.values()]

    expected = results()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        made = results()
    assert_same(made, expected)


@each_dialect
@pytest.mark.parametrize("mode", ["device", "dtype"])
def test_defaults_of_the_program(name, mode):
    """Programs make "cuda" the default device, or another dtype the default: tensors on the host stay there."""
    settings = full_settings(name, subpixel_offset=torch.full((30, 40, 2), 0.25))
    scene = full_arguments(name)
    expected, expected_gradients = gradients(name, settings, scene)
    try:
        if mode == "device":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(torch.float64)
        made, found = gradients(name, settings, scene)
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
    assert_same([*made, *found.values()], [*expected, *expected_gradients.values()])


def test_relocation_under_another_default_device():
    arguments = torch.rand(4), torch.rand(4, 3), torch.tensor([1, 2, 3, 4])
    expected = ar.compute_relocation(*arguments, n_max=13)
    ar.relocation._coefficients.cache_clear()
    torch.set_default_device("meta")
    try:
        made = ar.compute_relocation(*arguments, n_max=13)
    finally:
        torch.set_default_device(None)
    assert_same(made, expected)


def test_the_pose_is_not_rounded_under_autocast():
    pose, tangent = torch.eye(4), torch.linspace(-0.1, 0.2, 6)
    pose[:3, 3] = torch.tensor([0.3, -1.7, 4.1])
    expected = ar.moved(pose, tangent)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(ar.moved(pose, tangent), expected)


# --- scenes that change --------------------------------------------------------------------------


@each_dialect
def test_gaussians_that_come_and_go(name):
    """As density control leaves them: some, fewer, none, more; each with a gradient of its own shape."""
    settings = full_settings(name)
    whole = full_arguments(name)
    for count in (COUNT, 3, 0, 11):
        scene = {key: value[:count] if len(value) == COUNT else value for key, value in whole.items()}
        made, found = gradients(name, settings, scene)
        assert any(len(value) == count and value.dtype == torch.int32 for value in made)  # radii
        for key, gradient in found.items():
            assert gradient.shape == scene[key].shape and gradient.isfinite().all(), key
        assert count == 0 or (found["means2D"][:, :2] != 0).any()


@each_dialect
def test_nothing_to_see(name):
    """All Gaussians behind the camera: the background, radii of zero, and gradients of zero."""
    settings = full_settings(name)
    scene = full_arguments(name)
    scene["means3D"] = scene["means3D"] - 1000 * torch.tensor([0.0, 0.0, 1.0])
    made, found = gradients(name, settings, scene)
    assert any(value.shape == (COUNT,) and value.dtype == torch.int32 and (value == 0).all() for value in made)
    background = settings.bg[:, None, None].expand(3, 30, 40)
    assert any(value.shape == background.shape and torch.equal(value, background) for value in made)
    for key, gradient in found.items():
        assert gradient.shape == scene[key].shape and (gradient == 0).all(), key


# --- what cannot be rendered ---------------------------------------------------------------------


@each_dialect
def test_wrong_dtypes_are_named(name):
    """Where the originals say "expected scalar type Float but found Double"."""
    scene = arguments_of(name)
    with pytest.raises(TypeError, match="scales must have the dtype of means3D, Float, got Double"):
        render(name, scene=scene | {"scales": scene["scales"].double()})
    with pytest.raises(TypeError, match="viewmatrix must have the dtype of means3D, Float, got Double"):
        render(name, viewmatrix=fields_of(name)["viewmatrix"].double())
    with pytest.raises(TypeError, match=r"means3D must .*Half"):
        render(name, scene={key: value.half() for key, value in scene.items()})


def test_names_of_stopthepop_in_any_order():
    for name in ("ExtendedSettings", "SortMode", "GlobalSortOrder"):
        with pytest.raises(ImportError, match=f"{name} is not supported: StopThePop"):
            exec(f"from diff_gaussian_rasterization import {name}")


# --- more ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [509, 512, 1024])
def test_more_features_than_one_pass_takes(channels):
    """Feature 3DGS has the 512 numbers of CLIP: picture and gradients of all, and of the geometry through all."""
    generator = torch.Generator().manual_seed(3)
    features = torch.rand(COUNT, 1, channels, generator=generator)
    weights = torch.rand(channels, 30, 40, generator=generator) - 0.5

    def made_of(parts):
        """Image and gradients, from renderings of parts of the channels."""
        leaves = {key: value.clone().requires_grad_() for key, value in scene_of().items()}
        of_features = features.clone().requires_grad_()
        loss, images, at = 0, [], 0
        for part in of_features.split(parts, -1):
            image = render("feature3dgs", scene=leaves | {"semantic_feature": part})[1]
            loss, at = loss + (image * weights[at : at + parts]).sum(), at + parts
            images.append(image)
        loss.backward()
        return torch.cat(images), of_features.grad, leaves["means3D"].grad, leaves["opacities"].grad

    made, expected = made_of(channels), made_of(128)
    assert made[0].shape == (channels, 30, 40)
    for ours, theirs in zip(made, expected):
        # Sums of 512 products in another order: some tens of roundings of 6e-8.
        assert (ours - theirs).norm() <= 1e-5 * theirs.norm()


def test_fusedssim_of_the_compiled_module():
    """Map and gradient of `ar.losses.ssim`, by the names under which 3DGS 2024 imports them."""
    from diff_gaussian_rasterization._C import fusedssim, fusedssim_backward

    image, target = (torch.rand(3, 20, 24, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    image.requires_grad_()
    expected = ar.losses.ssim(image, target, "none")
    made = fusedssim(0.01**2, 0.03**2, image, target)
    assert torch.equal(made, expected) and not made.requires_grad
    upstream = torch.rand(expected.shape, generator=torch.Generator().manual_seed(3))
    expected.backward(upstream)
    assert torch.equal(fusedssim_backward(0.01**2, 0.03**2, image, target, upstream), image.grad)
    with pytest.raises(ValueError, match=r"C1 and C2 must be 0.01\^2 and 0.03\^2, got 0.01 and 0.03"):
        fusedssim(0.01, 0.03, image, target)
