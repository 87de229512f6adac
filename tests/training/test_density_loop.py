"""Density control in a loop of one's own: any optimizer, tensors of one's own, the example, and what is refused."""

import copy
import math
import re
from dataclasses import fields

import numpy as np
import pytest
import torch
from places import ROOT

import analytic_rasterizer as ar
import train_loop
from analytic_rasterizer import density, io
from analytic_rasterizer.density import GradientOptions, MonteCarloOptions
from analytic_rasterizer.optim import FusedAdam, SparseGaussianAdam, clear_moments, replace_rows
from analytic_rasterizer.training import Pictures, TrainingOptions

EXTENT = 10.0
SIGNED = GradientOptions(absolute=False, densify_from=0, densify_every=1, split_above=0.01, max_gaussians=0)


def make_gaussians(dtype=torch.float32, device="cpu") -> ar.Gaussians:
    """One that is split where its gradient is large, one that is cloned, one that is kept, and a transparent one."""
    generator = torch.Generator().manual_seed(2)
    scales = torch.tensor([[0.5], [0.05], [0.05], [0.05]]).expand(4, 3)
    opacities = torch.tensor([[0.5], [0.6], [0.7], [0.001]])
    rotations, shs = torch.randn(4, 4, generator=generator), torch.randn(4, 4, 3, generator=generator)
    gaussians = ar.Gaussians.from_activated(torch.randn(4, 3, generator=generator), scales, rotations, opacities, shs)
    return gaussians.map(lambda field: field.to(device, dtype)).leaves()


def give_gradients(tensors) -> None:
    for i, tensor in enumerate(tensors):
        generator = torch.Generator().manual_seed(10 + i)
        tensor.grad = torch.randn(tensor.shape, generator=generator).to(tensor)


def grow(control, norms=(1.0, 1.0, 0.0, 0.0), step=1, share=0.1) -> None:
    """As after a step whose gradients by the projected means had these norms."""
    leaf = control.leaf()
    if leaf is not None:
        leaf.grad = torch.zeros_like(leaf)
        leaf.grad[:, control.columns - 2] = torch.tensor(norms).to(leaf)
    control.observe(leaf, torch.ones(control.gaussians.count, dtype=torch.int32, device=control.gaussians.means.device))
    control.after_step(step, share)


OPTIMIZERS = {
    "Adam": lambda groups: torch.optim.Adam(groups, lr=1e-2),
    "AMSGrad": lambda groups: torch.optim.Adam(groups, lr=1e-2, amsgrad=True),
    "one at a time": lambda groups: torch.optim.Adam(groups, lr=1e-2, foreach=False),
    "SGD": lambda groups: torch.optim.SGD(groups, lr=1e-2, momentum=0.9),
    "FusedAdam": lambda groups: FusedAdam(groups, lr=1e-2),
}


def rows_of(state: dict, shape) -> dict:
    return {key: value for key, value in state.items() if isinstance(value, torch.Tensor) and value.shape == shape}


@pytest.mark.parametrize("stepped", [True, False])
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_any_optimizer_follows(name, stepped):
    """Rows of its state stay with their Gaussians, and start at zero for new ones; other parameters are left alone."""
    gaussians = make_gaussians()
    weights = torch.randn(4, 4, requires_grad=True)  # of a network, say, with as many rows as there are Gaussians
    groups = [{"params": [weights]}, {"params": list(gaussians[:2])}, {"params": list(gaussians[2:])}]
    optimizer = OPTIMIZERS[name](groups)
    if stepped:
        give_gradients([weights, *gaussians])
        optimizer.step()
    states = [dict(optimizer.state.get(field, {})) for field in gaussians]
    control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED)
    grow(control)
    # Kept: 1 and 2. The clone of 1 follows, then the halves of 0; 3 is pruned.
    for old, before, new in zip(gaussians, states, control.gaussians):
        assert len(new) == 5 and torch.equal(new[:3], old[[1, 2, 1]])
        assert new.is_leaf and new.requires_grad and new.grad is None
        after = optimizer.state.get(new, {})
        assert after.keys() == before.keys() and bool(after) == stepped
        for key, value in rows_of(before, old.shape).items():
            assert torch.equal(after[key][:2], value[[1, 2]]) and (after[key][2:] == 0).all()
        if "step" in before:
            assert int(after["step"]) == int(before["step"]) == 1
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    assert all(a is b for a, b in zip(parameters, [weights, *control.gaussians], strict=True))
    assert len(optimizer.state) == (6 if stepped else 0)
    before = control.gaussians.map(lambda field: field.detach().clone())
    give_gradients(control.gaussians)
    optimizer.step()
    assert all((new != old).any() for new, old in zip(control.gaussians, before))


def test_sparse_optimizer_follows():
    gaussians = make_gaussians()
    optimizer = SparseGaussianAdam([{"params": [field]} for field in gaussians], lr=1e-2, eps=1e-15)
    give_gradients(gaussians)
    optimizer.step(torch.tensor([True, False, True, True]), 4)
    control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED)
    grow(control)
    before = control.gaussians.map(lambda field: field.detach().clone())
    give_gradients(control.gaussians)
    optimizer.step(torch.tensor([True, True, False, False, True]), 5)
    for old, new in zip(before, control.gaussians):
        moved = (new != old).flatten(1).any(1)
        assert moved.tolist() == [True, True, False, False, True]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["gradient", "monte carlo"])
def test_tensors_of_ones_own_follow(device, kind, dtype):
    gaussians = make_gaussians(dtype, device)
    features = torch.arange(8.0, device=device).reshape(4, 2).requires_grad_()
    labels = torch.arange(4, device=device)
    optimizer = FusedAdam([{"params": [field]} for field in gaussians], lr=1e-3)
    optimizer.add_param_group({"params": [torch.nn.Parameter(features)]})
    (features,) = optimizer.param_groups[-1]["params"]
    if dtype == torch.float32:  # of one dtype
        give_gradients([*gaussians, features])
        optimizer.step()
    started = features.detach().clone()
    extra = {"features": features, "labels": labels}
    if kind == "gradient":
        control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED, extra=extra)
        expected = [1, 2, 1, 0, 0]
    else:
        options = MonteCarloOptions(densify_from=0, densify_every=1, max_gaussians=4, noise=0.0)
        control = density.MonteCarloDensity(gaussians, optimizer, options, extra=extra)
        expected = None  # 3 moves to where one of the others is
    grow(control)
    features, labels = control.extra["features"], control.extra["labels"]
    if expected is None:
        expected = [0, 1, 2, int(labels[3])]
        assert expected[3] < 3 and len(control.gaussians.means) == 4
        source = expected[3]
        assert torch.equal(control.gaussians.means[3], control.gaussians.means[source])
        if dtype == torch.float32:
            state = optimizer.state[features]["exp_avg"]
            assert (state[[3, source]] == 0).all() and (state != 0).any()
    assert labels.tolist() == expected and not labels.requires_grad
    assert torch.equal(features, started[expected]) and isinstance(features, torch.nn.Parameter)
    assert optimizer.param_groups[-1]["params"][0] is features


def test_fields_that_are_not_trained_follow():
    gaussians = make_gaussians()
    gaussians = gaussians._replace(rotations=gaussians.rotations.detach())
    optimizer = torch.optim.Adam([field for field in gaussians if field.requires_grad])
    control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED)
    grow(control)
    assert torch.equal(control.gaussians.rotations, gaussians.rotations[[1, 2, 1, 0, 0]])
    assert not control.gaussians.rotations.requires_grad


def test_noise_goes_by_the_learning_rate_of_the_means():
    """Whichever group they are in."""
    moved = []
    for rate in (1e-3, 2e-3):
        gaussians = make_gaussians()
        groups = [{"params": [gaussians.shs], "lr": 1.0}, {"params": [gaussians.means], "lr": rate}]
        optimizer = torch.optim.Adam([*groups, {"params": list(gaussians[1:4])}])
        before = gaussians.means.detach().clone()
        density.MonteCarloDensity(gaussians, optimizer).after_step(1, 0.0)
        moved.append((gaussians.means.detach() - before)[3])
    torch.testing.assert_close(moved[1], 2 * moved[0], rtol=1e-4, atol=1e-7)
    assert (moved[0] != 0).all()


def test_gaussians_can_be_taken_away():
    gaussians = make_gaussians()
    optimizer = torch.optim.Adam(list(gaussians))
    control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED)
    control.observe_gradients(torch.tensor([[1.0, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]]), torch.ones(4).int())
    control.keep(torch.tensor([True, False, True, False]))
    assert torch.equal(control.gaussians.means, gaussians.means[[0, 2]])
    assert control.gradient_sums.tolist() == [1, 3] and control.views.tolist() == [1, 1]


@pytest.mark.parametrize("kind", ["gradient", "monte carlo"])
def test_goes_on_from_its_state(kind):
    """Of the same bits, in a control that was made anew."""

    def make(gaussians):
        optimizer = FusedAdam([{"params": [field]} for field in gaussians], lr=1e-2)
        if kind == "gradient":
            options = GradientOptions(densify_from=0, densify_every=2, densify_until=0.9, max_gaussians=9)
            return density.GradientDensity(gaussians, optimizer, EXTENT, options, seed=3)
        times = {"densify_from": 0, "densify_every": 2, "densify_until": 0.9}
        options = MonteCarloOptions(**times, max_gaussians=9, grow_share=0.5, noise=1.0)
        return density.MonteCarloDensity(gaussians, optimizer, options, seed=3)

    def go(control, steps):
        for step in steps:
            give_gradients(control.gaussians)
            control.optimizer.step()
            grow(control, torch.linspace(0.1, 1, control.gaussians.count).tolist(), step, step / 10)

    control = make(make_gaussians())
    go(control, range(1, 4))
    resumed = make(control.gaussians.leaves())
    resumed.optimizer.load_state_dict(copy.deepcopy(control.optimizer.state_dict()))
    state = control.state_dict()
    resumed.load_state_dict(state)
    for one in (control, resumed):
        go(one, range(4, 8))
    assert control.gaussians.count > 4
    assert all(torch.equal(a, b) for a, b in zip(control.gaussians, resumed.gaussians))
    if kind == "gradient":
        with pytest.raises(ValueError, match=r"state must be of \d Gaussians, as many as there are, got"):
            make(make_gaussians()).load_state_dict(state | {"views": state["views"][:3]})


def test_defaults_are_those_of_training():
    usual = TrainingOptions()
    of_training = usual.to_dict() | usual.growth.times(usual.iterations)
    for options in (GradientOptions(), MonteCarloOptions()):
        for field in fields(options):
            if field.name not in ("absolute", "white_background"):
                assert getattr(options, field.name) == of_training[field.name], field.name
    assert GradientOptions().absolute and of_training["density"] == "absgrad"
    for absolute in (True, False):
        training = TrainingOptions(density="absgrad" if absolute else "3dgs")
        assert GradientOptions(absolute=absolute).growth_gradient == training.growth_gradient


@pytest.mark.parametrize(
    "kind, option, error, message",
    [
        (GradientOptions, {"densify_every": 0}, ValueError, "densify_every must be at least 1, got 0"),
        (GradientOptions, {"densify_from": -1}, ValueError, "densify_from must be at least 0, got -1"),
        (GradientOptions, {"densify_until": 75}, ValueError, "densify_until must be 0 to 1, got 75"),
        (GradientOptions, {"gradient": math.nan}, ValueError, "gradient must be finite and not negative, got nan"),
        (GradientOptions, {"split_above": 0}, ValueError, "split_above must be positive and finite, got 0"),
        (GradientOptions, {"max_gaussians": 1.5}, ValueError, "max_gaussians must be a whole number, got 1.5"),
        (GradientOptions, {"reset_every": "often"}, TypeError, "reset_every must be a whole number, got 'often'"),
        (GradientOptions, {"absolute": 1}, TypeError, "absolute must be a bool, got 1"),
        (GradientOptions, {"prune_opacity": 1}, ValueError, "prune_opacity must be at least 0 and below 1, got 1"),
        (MonteCarloOptions, {"max_gaussians": 0}, ValueError, "max_gaussians must be at least 1, got 0"),
        (MonteCarloOptions, {"noise": math.inf}, ValueError, "noise must be finite and not negative, got inf"),
        (MonteCarloOptions, {"grow_share": 2}, ValueError, "grow_share must be 0 to 1, got 2"),
    ],
)
def test_options_outside_their_range(kind, option, error, message):
    with pytest.raises(error, match=message):
        kind(**option)
    assert GradientOptions(densify_from=np.int64(7), split_above=np.float32(0.5)).densify_from == 7


def wrong_arguments():
    gaussians = make_gaussians()
    given = list(gaussians)
    other = torch.zeros(4, 3, requires_grad=True)
    yield {"gaussians": tuple(gaussians)}, TypeError, "gaussians must be Gaussians, got tuple"
    yield {"optimizer": given}, TypeError, "optimizer must be a torch.optim.Optimizer, got list"
    yield {"options": TrainingOptions()}, TypeError, "options must be GradientOptions, got TrainingOptions"
    yield {"extent": 0}, ValueError, "extent must be positive and finite, got 0"
    yield {"extent": "large"}, TypeError, "extent must be a number, got 'large'"
    wrong = gaussians._replace(log_scales=other)
    yield {"gaussians": wrong}, ValueError, "log_scales must be a parameter of the optimizer, or require no gradient"
    wrong = gaussians._replace(shs=2 * gaussians.shs)
    yield {"gaussians": wrong}, ValueError, r"shs must be a leaf of the graph: give shs.detach\(\).requires_grad_\(\)"
    wrong = gaussians._replace(means=gaussians.means.detach())
    yield {"gaussians": wrong}, ValueError, "means must be a parameter of the optimizer that requires a gradient"
    wrong = gaussians._replace(logit_opacities=torch.zeros(3, 1))
    yield {"gaussians": wrong}, ValueError, r"logit_opacities must have 4 rows on cpu, as the means, got shape \(3, 1\)"
    yield {"extra": {"features": other}}, ValueError, "features must be a parameter of the optimizer, or require no"
    yield {"extra": {"labels": [1, 2, 3, 4]}}, TypeError, "labels must be a tensor, got list"
    yield ({"extra": {"shs": torch.zeros(4)}}, ValueError, "extra must not have the name of a field of Gaussians")


@pytest.mark.parametrize("wrong, error, message", wrong_arguments())
def test_what_does_not_fit_is_refused(wrong, error, message):
    gaussians = wrong.get("gaussians") or make_gaussians()
    parameters = [g for g in gaussians if g.is_leaf and g.requires_grad and not (g == 0).all()]
    arguments = {"gaussians": gaussians, "optimizer": torch.optim.Adam(parameters), "extent": EXTENT, **wrong}
    with pytest.raises(error, match=message):
        density.GradientDensity(**arguments)


def test_a_picture_without_gradient_is_refused():
    gaussians = make_gaussians()
    control = density.GradientDensity(gaussians, torch.optim.Adam(list(gaussians)), EXTENT)
    radii = torch.ones(4, dtype=torch.int32)
    with pytest.raises(ValueError, match="leaf has no gradient: render with means2D=leaf, and call backward before"):
        control.observe(control.leaf(), radii)
    stale = control.leaf()
    stale.grad = torch.ones_like(stale)
    control.keep(torch.tensor([True, True, False, False]))
    with pytest.raises(ValueError, match=r"with P = 2, got \(4"):
        control.observe(stale, radii)
    for other in (density.FixedDensity, density.MonteCarloDensity):
        gaussians = make_gaussians()
        control = other(gaussians, torch.optim.Adam(list(gaussians)))
        assert control.leaf() is None and control.observe(None, radii) is None


def test_parameters_that_the_optimizer_no_longer_has():
    """Somebody has replaced one of them: nothing may be half done."""
    gaussians = make_gaussians()
    optimizer = torch.optim.Adam([{"params": [field]} for field in gaussians])
    control = density.GradientDensity(gaussians, optimizer, EXTENT, SIGNED)
    optimizer.param_groups[4]["params"] = [gaussians.shs.detach().clone().requires_grad_()]
    with pytest.raises(ValueError, match="shs must be a parameter of the optimizer"):
        grow(control)
    assert control.gaussians is gaussians
    assert all(group["params"][0] is field for group, field in zip(optimizer.param_groups[:4], gaussians))


def test_rows_of_an_optimizer():
    weight = torch.arange(6.0).reshape(3, 2).requires_grad_()
    optimizer = torch.optim.Adam([weight])
    weight.grad = torch.ones(3, 2)
    optimizer.step()
    old = weight.detach().clone()
    kept, added = torch.tensor([2, 0]), torch.full((1, 2), 9.0)
    with pytest.raises(ValueError, match="added must have the names weight, got other"):
        replace_rows(optimizer, {"weight": weight}, kept, {"other": added})
    with pytest.raises(RuntimeError):  # torch's, of shapes that do not fit
        replace_rows(optimizer, {"weight": weight}, kept, {"weight": torch.zeros(1, 3)})
    assert optimizer.param_groups[0]["params"][0] is weight and weight in optimizer.state
    new = replace_rows(optimizer, {"weight": weight}, kept, {"weight": added})["weight"]
    assert torch.equal(new, torch.cat([old[[2, 0]], added]))
    assert optimizer.param_groups[0]["params"][0] is new and weight not in optimizer.state
    assert (optimizer.state[new]["exp_avg"][:2] != 0).all() and (optimizer.state[new]["exp_avg"][2] == 0).all()
    clear_moments(optimizer, new, torch.tensor([True, False, False]))
    assert (optimizer.state[new]["exp_avg_sq"] != 0).any(1).tolist() == [False, True, False]


# ----------------------------------------------------------------------------- from points


def test_gaussians_at_points(device):
    pytest.importorskip("scipy", reason="needs the train extra")
    axis = torch.arange(3.0)
    points = 0.2 * torch.cartesian_prod(axis, axis, axis).to(device, torch.float64)
    colors = torch.linspace(0, 1, 81, device=device, dtype=torch.float64).reshape(27, 3)
    made = ar.Gaussians.from_points(points, colors, sh_degree=2, opacity=0.3, scale=0.5, dtype=torch.float64)
    assert made.sh_degree == 2 and made.count == 27
    assert all(field.dtype == torch.float64 and field.device.type == device for field in made)
    # Every point of the grid has three neighbours at its spacing.
    torch.testing.assert_close(made.scales, torch.full_like(points, 0.1))
    torch.testing.assert_close(made.opacities, torch.full_like(points[:, :1], 0.3))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * made.shs[:, 0], colors)
    assert (made.shs[:, 1:] == 0).all() and (made.rotations[:, 0] == 1).all()
    # Gaps of coordinates that float32 does not resolve.
    far = ar.Gaussians.from_points(points + 5e6, colors.float(), scale=0.5)
    torch.testing.assert_close(far.scales, made.scales.float())
    grey = ar.Gaussians.from_points(points[:2])
    assert all(field.dtype == torch.float32 for field in grey)
    assert (grey.shs == 0).all() and grey.sh_degree == 3
    leaves = made.leaves()
    assert all(leaf.is_leaf and leaf.requires_grad and leaf.is_contiguous() for leaf in leaves)
    assert all(torch.equal(leaf, field) and leaf.data_ptr() != field.data_ptr() for leaf, field in zip(leaves, made))


@pytest.mark.parametrize(
    "wrong, error, message",
    [
        ({"points": [[0.0, 0, 0]]}, TypeError, "points must be a tensor, got list"),
        ({"points": torch.zeros(5, 3, dtype=torch.int32)}, TypeError, "points must have a floating-point dtype"),
        ({"points": torch.zeros(1, 3), "colors": torch.zeros(1, 3)}, ValueError, r"points must have shape \(N, 3\)"),
        ({"colors": torch.zeros(4, 3)}, ValueError, r"colors must have shape .* got \(4, 3\)"),
        ({"colors": torch.full((5, 3), 200, dtype=torch.uint8)}, TypeError, "colors must have a floating-point dtype"),
        ({"colors": torch.full((5, 3), 200.0)}, ValueError, r"colors must be in \[0, 1\], got 200 to 200"),
        ({"dtype": torch.float16}, ValueError, "dtype must be float32 or float64, got torch.float16"),
        ({"points": torch.full((5, 3), math.inf)}, ValueError, "points must be finite"),
        ({"sh_degree": 4}, ValueError, "sh_degree must be 0 to 3, got 4"),
        ({"opacity": 1}, ValueError, "opacity must be above 0 and below 1, got 1"),
        ({"scale": 0}, ValueError, "scale must be positive and finite, got 0"),
        ({"scale": "large"}, TypeError, "scale must be a number, got 'large'"),
    ],
)
def test_points_that_make_no_gaussians(wrong, error, message):
    arguments = {"points": torch.rand(5, 3), "colors": torch.rand(5, 3), **wrong}
    with pytest.raises(error, match=message):
        ar.Gaussians.from_points(**arguments)


def test_harmonics_of_another_degree():
    made = ar.Gaussians.from_points(torch.rand(5, 3), sh_degree=1)
    made = made._replace(shs=torch.rand(5, 4, 3))
    assert made.with_sh_degree(0).shs.equal(made.shs[:, :1]) and made.with_sh_degree(1).shs.equal(made.shs)
    most = made.with_sh_degree(4).shs
    assert most.shape == (5, 25, 3) and most[:, :4].equal(made.shs) and not most[:, 4:].any()
    for wrong, error, message in ((5, ValueError, "must be 0 to 4, got 5"), ("3", TypeError, "must be a whole number")):
        with pytest.raises(error, match=f"degree {message}"):
            made.with_sh_degree(wrong)


# ----------------------------------------------------------------------- the example, the page


@pytest.mark.parametrize("absolute", [True, False])
def test_example_learns_and_grows(device, absolute):
    pytest.importorskip("scipy", reason="needs the train extra")
    pictures, points = train_loop.own_pictures(device)
    options = GradientOptions(absolute=absolute, densify_from=10, densify_every=10, max_gaussians=200)
    gaussians, losses = train_loop.train(pictures, points, 80, options)
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])
    assert len(points[0]) < gaussians.count <= 200
    assert all(field.isfinite().all() and not field.requires_grad for field in gaussians)


@pytest.fixture
def capture(tmp_path):
    for name in ("scipy", "gsply", "PIL"):
        pytest.importorskip(name, reason="needs the train extra")
    from capture_files import circle, write_nerf_synthetic

    write_nerf_synthetic(tmp_path / "lego", circle(4), circle(2))
    return tmp_path / "lego"


def test_example_writes_a_scene(capture, tmp_path, monkeypatch, capsys):
    train, given = train_loop.train, []

    def shorter(pictures, points, steps, options):
        given.append((steps, len(points[0])))
        return train(Pictures(*pictures), [points[0][:200], points[1][:200]], 2, options)

    monkeypatch.setattr(train_loop, "train", shorter)
    train_loop.main(tmp_path / "out", capture)
    assert given == [(7000, 100_000)]
    assert io.load_scene(tmp_path / "out" / "scene.ply").count == 200
    found = io.find_scene(tmp_path / "out")  # as `render` and `view` do
    assert len(found.load_views()) == 4
    choice = found.choose_footprint()
    assert str(choice.footprint) == train_loop.FOOTPRINT and choice.reason == "scene.ply says so"
    assert capsys.readouterr().out.startswith("200 Gaussians, loss ")


def test_code_of_the_page(capture, monkeypatch):
    page = (ROOT / "docs" / "density.md").read_text()
    loop, more, trainer = re.findall(r"```python\n(.*?)```", page, flags=re.S)
    made, (points, _) = train_loop.own_pictures("cpu")
    given = {"views": made.views, "points": points, "colors": None, "device": "cpu", "steps": 8}
    given |= {"settings": made.settings[1], "pictures": [made.target(1, i) for i in range(8)] * 2}
    exec(loop.replace("max_gaussians=300_000", "max_gaussians=300, densify_from=2, densify_every=2"), given)
    assert len(points) < given["control"].gaussians.count <= 300
    given["gaussians"] = ar.Gaussians.from_points(points).leaves()
    exec(more, given)
    assert given["features"].shape == (len(points), 16)
    monkeypatch.chdir(capture.parent)
    exec(trainer.replace("iterations=7000", "iterations=3, random_points=60"), given)
    assert io.load_scene("scene.ply").count == 60 and given["trainer"].progress.step == 3
