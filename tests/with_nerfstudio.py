"""Trains and evaluates the method `splatfacto-analytic` with nerfstudio itself, on the CPU.

    python tests/with_nerfstudio.py CAPTURE OUT [OPTION ...]

in an environment with nerfstudio. CAPTURE is a folder in the form of NeRF-synthetic, OUT is where nerfstudio writes,
and OPTIONs are those of `ns-train splatfacto-analytic`, such as `--pipeline.model.footprint`. Fails where the loss does
not fall, no Gaussian is added, or gsplat's CUDA code is loaded. The perceptual metric is left out, because its weights
are on the network.
"""

import itertools
import os
import sys
from pathlib import Path
from unittest import mock

import torch

from analytic_rasterizer.testing import cuda_on_cpu

METHOD = "splatfacto-analytic"
SHORT = {  # a training of minutes that adds Gaussians, and goes through a resolution and two degrees of harmonics
    "max-num-iterations": 150,
    "steps-per-eval-image": 0,
    "steps-per-eval-all-images": 0,
    "pipeline.model.num-random": 5000,
    "pipeline.model.random-scale": 3.0,
    "pipeline.model.num-downscales": 1,
    "pipeline.model.resolution-schedule": 125,
    "pipeline.model.sh-degree-interval": 50,
    "pipeline.model.warmup-length": 50,
    "pipeline.model.refine-every": 25,
    "pipeline.model.cull-alpha-thresh": 0.02,
    "pipeline.model.background-color": "white",
}


class NoPerceptualMetric(torch.nn.Module):
    def __init__(self, **_):
        super().__init__()

    def forward(self, *_):
        return torch.nan


def import_torchvision():
    """Wheels of PyPI load no operators beside a torch without CUDA, and stop at two that are missing."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


def train(capture, out, options):
    """Losses and numbers of Gaussians by step, and the file that nerfstudio loads the result by."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    short = [text for name, value in SHORT.items() for text in (f"--{name}", str(value))]
    always = ["--machine.device-type", "cpu", "--vis", "tensorboard", "--output-dir", str(out)]
    arguments = [METHOD, *always, *short, *options, "blender-data", "--data", str(capture)]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode="test")
    iterate, losses, counts = trainer.train_iteration, [], []

    def recorded(step):
        result = iterate(step)
        losses.append(float(result[0]))
        counts.append(trainer.pipeline.model.num_points)
        return result

    trainer.train_iteration = recorded
    trainer.train()
    return losses, counts, config.get_base_dir() / "config.yml"


def main(capture, out, *options):
    from nerfstudio.utils.eval_utils import eval_setup

    losses, counts, written = train(Path(capture), Path(out), options)
    for step in (*range(0, len(losses), max(1, len(losses) // 6)), len(losses) - 1):
        print(f"step {step}: loss {losses[step]:.4f}, {counts[step]} Gaussians")
    config, pipeline, checkpoint, _ = eval_setup(written)
    pictures = Path(out) / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    metrics = pipeline.get_average_eval_image_metrics(output_path=pictures)
    model = type(pipeline.model)
    print(f"{model.__module__}.{model.__name__}, {config.pipeline.model.footprint}, {checkpoint}: {metrics}")
    tenth = len(losses) // 10
    assert sum(losses[-tenth:]) < 0.7 * sum(losses[:tenth]), "the loss did not fall"
    assert any(after > before for before, after in itertools.pairwise(counts)), "no Gaussian was added"
    assert "gsplat.cuda._backend" not in sys.modules, "gsplat's CUDA code was loaded"


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"  # nerfstudio 1.1.5 pickles NumPy's numbers
    import_torchvision()
    perceptual = "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity"
    with cuda_on_cpu(), mock.patch(perceptual, NoPerceptualMetric):
        main(*sys.argv[1:])
