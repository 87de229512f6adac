"""Small trainings, and which Gaussians their pictures show."""

import inspect
from dataclasses import fields

import torch

from analytic_rasterizer.captures import loading
from analytic_rasterizer.training import CaptureSource, Run, Trainer, TrainingOptions, load_capture, load_pictures
from analytic_rasterizer.training import rendering as g

TINY = {"sh_degree": 1, "random_points": 150, "densify_from": 20, "densify_every": 20, "max_gaussians": 400}
SHORT = {"images": "photographs", "iterations": 120, "scales": (1, 2), **TINY}
OF_RUN = inspect.signature(Run).parameters.keys() - {"device", "iterations", "seconds"}
OF_SOURCE = {field.name for field in fields(CaptureSource)}


def make_run(folder, out, device="cpu", *, more=None, **given) -> Run:
    """A training that saves nothing before its end. `given` are its options, what `CaptureSource` says, and arguments
    of `Run` with other names than options; `more` are further ones of `Run`."""
    of_source = {name: given.pop(name) for name in OF_SOURCE & given.keys()}
    of_run = {name: given.pop(name) for name in OF_RUN & given.keys()}
    source, options = CaptureSource(folder, **of_source), TrainingOptions(**given)
    return Run(source, out, options, device=device, **{"save_every": 0} | of_run | (more or {}))


def trained(folder, out, device="cpu", **given) -> Run:
    """A training that has ended."""
    run = make_run(folder, out, device, **given)
    assert run.train()
    return run


def cpu_test_pictures(folder):
    return load_pictures(load_capture(folder).test, (1, 2), loading.WHITE, "cpu")


@torch.no_grad()
def scatter(gaussians) -> None:
    """Puts Gaussians where no picture shows them, and others where only some pictures do."""
    gaussians.means[::3, 1] += 50
    gaussians.means[1::3] *= 4


def rows_shown(trainer) -> list[torch.Tensor]:
    """Which Gaussians each picture of the next step shows."""
    supersampling = trainer.options.supersampling
    with torch.no_grad():
        scene = trainer.scene().arguments()
        return [g.render(scene, s.settings, None, supersampling)[1] > 0 for s in trainer._next()]


def around_steps(monkeypatch, before=lambda trainer: None, after=lambda trainer: None) -> None:
    """Every step of a training is between before(trainer) and after(trainer)."""
    step = Trainer.step

    def watched(trainer):
        before(trainer)
        step(trainer)
        after(trainer)

    monkeypatch.setattr(Trainer, "step", watched)
