"""Options: each is declared once, the whole of a training is made of parts, and density control is told one of two."""

import copy
import json
import pickle
from dataclasses import FrozenInstanceError, dataclass, fields, replace

import pytest

from analytic_rasterizer.declared import SHARE, Options, described, option
from analytic_rasterizer.density import GradientOptions, MonteCarloOptions
from analytic_rasterizer.training import TrainingOptions
from analytic_rasterizer.training.options import CONTROLS, DECLARATIONS, PARTS, controls_of, of_other_control
from analytic_rasterizer.training.parts import DENSITIES, is_time

NAMES = [each.name for each in fields(TrainingOptions)]
# Values of all options that are not the defaults.
OTHERS = {"footprint": "box:samples=1", "scales": (2, 4), "scale_repeats": (3, 1), "downsampling": "bicubic"}
OTHERS |= {"background": "white", "effects": "none", "exposure": "affine", "gradient_scales": "all", "sh_degree": 2}
OTHERS |= {"prune_opacity": 0.25, "initial_opacity": 0.25, "densify_from": 0.25, "rates_from": 0.5}
OTHERS |= {"ssim_weight": 0.5, "grow_share": 0.5, "densify_until": 0.5, "footprint_from": 0.5}
OTHERS |= {"first_footprint": "box:samples=1", "order": "ray", "depth": "points", "depth_fit": "none"}
OTHERS |= {"vignetting": "polynomial"}


def other_value(name):
    default = getattr(TrainingOptions, name)
    if name in OTHERS:
        return OTHERS[name]
    return not default if isinstance(default, bool) else default + 2


def test_every_option_is_of_one_part_and_said_with_its_default():
    assert set(NAMES) == DECLARATIONS.keys()
    counts = [each.name for kind in PARTS.values() for each in fields(kind)]
    assert len(counts) == len(set(counts))
    for each in fields(TrainingOptions):
        declared = DECLARATIONS[each.name][1]
        assert each.default == declared.default == getattr(TrainingOptions, each.name)
        assert each.type == declared.type, each.name
        assert f"\n    {each.name}: " in TrainingOptions.__doc__


@pytest.mark.parametrize("name", [name for name in NAMES if name != "density"])
def test_an_option_is_kept_in_its_part(name):
    """By its keyword, by `replace`, in files, and in the part, with every density control that is told it."""
    part = DECLARATIONS[name][0]
    for density in controls_of(name) or DENSITIES:
        usual, value = TrainingOptions(density=density, scales=(1, 2)), other_value(name)
        for made in (replace(usual, **{name: value}), TrainingOptions.from_dict(usual.to_dict() | {name: value})):
            assert getattr(made, name) == value and made != usual
            if part != "control":
                assert getattr(getattr(made, part), name) == value
        assert made == TrainingOptions(**(usual.to_dict() | {name: value})) and hash(made) != hash(usual)
        for again in (copy.deepcopy(made), pickle.loads(pickle.dumps(made)), replace(made)):
            assert again == made and hash(again) == hash(made) and repr(again) == repr(made)
        assert TrainingOptions.from_dict(json.loads(json.dumps(made.to_dict()))) == made
        with pytest.raises(FrozenInstanceError):
            setattr(made, name, value)


def test_files_have_all_options_in_the_same_order():
    """Those of another density control too, with their defaults: other versions read them."""
    assert NAMES[0] == "footprint" and NAMES[-1] == "depth_unit" and len(NAMES) == 55
    for density in DENSITIES:
        assert list(TrainingOptions(density=density).to_dict()) == NAMES


@pytest.mark.parametrize("density, kind", [("3dgs", GradientOptions), ("absgrad", GradientOptions),
                                           ("mcmc", MonteCarloOptions), ("none", type(None))])  # fmt: skip
def test_density_control_is_told_its_own_options(density, kind):
    """Others cannot be written down: they keep their defaults, and no file has them."""
    given = {name: other_value(name) for name in NAMES if DECLARATIONS[name][0] == "control"}
    made = TrainingOptions(density=density, max_gaussians=77, iterations=600, **given)
    assert isinstance(made.control, kind)
    for name, value in given.items():
        told = density in controls_of(name)
        assert getattr(made, name) == made.to_dict()[name] == (value if told else getattr(TrainingOptions, name))
        assert hasattr(made.control, name) == told
    if made.control is not None:
        assert (made.control.max_gaussians, made.control.densify_from, made.control.densify_every) == (77, 43, 10)
    if kind is GradientOptions:
        assert made.control.absolute == (density == "absgrad") and made.control.growth_gradient == made.growth_gradient


def test_what_is_left_out_may_not_be_wrong():
    for density in DENSITIES:
        with pytest.raises(ValueError, match="grow_share must be 0 to 1, got 2"):
            TrainingOptions(density=density, grow_share=2)
        with pytest.raises(TypeError, match="gradient_scales must be a string, got 3"):
            TrainingOptions(density=density, gradient_scales=3)


def test_options_of_other_controls_are_told_apart():
    assert of_other_control("noise", "absgrad") == "it is for the density control mcmc, got absgrad"
    assert of_other_control("gradient", "none") == "it is for the density controls 3dgs and absgrad, got none"
    assert of_other_control("densify_every", "none") == "the density control none changes nothing"
    for name in ("max_gaussians", "opacity_weight", "sh_degree"):
        assert not any(of_other_control(name, density) for density in DENSITIES)
    for density in CONTROLS:
        assert of_other_control("prune_opacity", density) is None


def test_an_unknown_keyword_is_an_error():
    with pytest.raises(TypeError, match="unexpected keyword argument 'speed'"):
        TrainingOptions(speed=1)


def test_declared_options_are_settled_and_described():
    @described
    @dataclass(frozen=True)
    class Loss(Options):
        """What the loss is.

        Raises:
            ValueError: A value outside its range.
        """

        weight: float = option(0.2, "Of SSIM.", SHARE)

    assert Loss(weight=1).weight == 1.0 and type(Loss(weight=1).weight) is float
    expected = "Attributes:\n    weight: Of SSIM.\n\nRaises:\n    ValueError: A value outside its range."
    assert Loss.__doc__ == f"What the loss is.\n\n{expected}"
    with pytest.raises(ValueError, match=r"weight must be 0 to 1, got 1\.5"):
        Loss(weight=1.5)
    with pytest.raises(TypeError, match="weight must be a number, got 'x'"):
        Loss(weight="x")
    assert is_time(0.5) and is_time(2) and not is_time(1.5)
