"""What a training step costs besides rendering: the loss, the activations and the optimiser, against plain torch.

    python benchmarks/losses.py [--sizes 800x800 400x400 ...] [--gaussians 200000] [--device cuda] [--json FILE]

Every row has the time of one forward and backward pass (of one step, for the optimisers):

    plain torch     the loss of 3DGS from separable convolutions, exp, normalize and sigmoid, torch.optim.Adam
    ours            losses.l1_ssim, activations.activate, optim.FusedAdam and optim.SparseGaussianAdam

On the CPU times are those of a call. With CUDA "call" is the time per call of a queue of calls, as in a training that
does not wait: the longer of what the host and what the device need. "device" is the time per call of the same calls
replayed as a CUDA graph, which the host does not slow down. Rows are timed in turn, round after round; medians. "extra"
is the memory that a call needs beyond its inputs and results.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from functools import partial

import torch
from common import CLOCKS, add_measuring, parse, parse_size, save_json
from torch import Tensor
from torch.nn import functional

from analytic_rasterizer import losses
from analytic_rasterizer.activations import activate
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import added_memory, describe_machine, in_turn
from analytic_rasterizer.optim import FusedAdam, SparseGaussianAdam

CALLS = {"cpu": 1, "cuda": 20}  # that are timed together
WIDTHS = {"means": 3, "constant": 3, "harmonics": 45, "opacities": 1, "scales": 3, "rotations": 4}  # of SH degree 3


def main() -> None:
    args = parse_arguments()
    torch.backends.cudnn.allow_tf32 = False  # the variances of SSIM are small differences
    calls = make_calls(args)
    print(f"{args.gaussians} Gaussians, {describe_machine(args.device)}\n")
    results = measure(calls, args.device, args.rounds)
    print(format_results(results))
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", nargs="+", type=parse_size, default=[(800, 800), (400, 400), (200, 200), (100, 100)])
    parser.add_argument("--gaussians", type=int, default=200_000)
    add_measuring(parser)
    return parse(parser)


# ----------------------------------------------------------------------------------------- what is timed


def make_calls(args: argparse.Namespace) -> dict[str, Callable[[], object]]:
    """By name of the row."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator).to(args.device)

    calls = {}
    for width, height in args.sizes:
        image, truth = draw(3, height, width).requires_grad_(), draw(3, height, width)
        name = f"loss {width}x{height}"
        for kind, target in (("", truth), (", 8 bits", (truth * 255).byte())):
            calls[f"{name}{kind}: plain torch"] = partial(gradients, plain_loss, [image, target])
            calls[f"{name}{kind}: ours"] = partial(gradients, losses.l1_ssim, [image, target])
    parameters = [draw(args.gaussians, width).requires_grad_() for width in (3, 4, 1)]
    calls["activations: plain torch"] = partial(gradients, plain_activations, parameters)
    calls["activations: ours"] = partial(gradients, activate, parameters)
    capturable = {"capturable": args.device == "cuda"}
    for name, options in (("Adam, foreach", {"foreach": True}), ("Adam, fused", {"fused": True})):
        calls[f"{name}: torch"] = torch.optim.Adam(make_groups(draw, args), eps=1e-15, **options, **capturable).step
    calls["Adam: ours"] = FusedAdam(make_groups(draw, args), eps=1e-15).step
    visible = draw(args.gaussians) < 0.5
    calls["Adam, half of the rows: ours"] = partial(FusedAdam(make_groups(draw, args), eps=1e-15).step, rows=visible)
    sparse = SparseGaussianAdam(make_groups(draw, args), lr=1e-3, eps=1e-15)
    calls["SparseGaussianAdam, half visible: ours"] = partial(sparse.step, visible, args.gaussians)
    return calls


def gradients(function: Callable, arguments: list[Tensor]) -> tuple[Tensor, ...]:
    """The outputs of a call, and the gradients of their sums with respect to its arguments."""
    outputs = function(*arguments)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    leaves = [argument for argument in arguments if argument.requires_grad]
    return *outputs, *torch.autograd.grad(outputs, leaves, [torch.ones_like(output) for output in outputs])


def make_groups(draw: Callable[..., Tensor], args: argparse.Namespace) -> list[dict]:
    """A group for every parameter of the Gaussians, with gradients, as 3DGS has them."""
    groups = []
    for name, width in WIDTHS.items():
        parameter = draw(args.gaussians, width).requires_grad_()
        parameter.grad = draw(args.gaussians, width) - 0.5
        groups.append({"params": [parameter], "lr": 1e-3, "name": name})
    return groups


def plain_loss(image: Tensor, target: Tensor) -> Tensor:
    if target.dtype == torch.uint8:
        target = target / 255
    moments = torch.stack([image, target, image * image, target * target, image * target])
    x = torch.arange(-5, 6, device=image.device, dtype=image.dtype)
    line = torch.softmax(-(x**2) / (2 * 1.5**2), 0).repeat(3, 1)
    rows = functional.conv2d(moments, line[:, None, None], padding=(0, 5), groups=3)
    x, y, xx, yy, xy = functional.conv2d(rows, line[:, None, :, None], padding=(5, 0), groups=3)
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * x * y + c1) * (2 * (xy - x * y) + c2) / ((x * x + y * y + c1) * (xx - x * x + yy - y * y + c2))
    return 0.8 * (image - target).abs().mean() + 0.2 * (1 - similarity.mean())


def plain_activations(log_scales: Tensor, quats: Tensor, logit_opacities: Tensor) -> tuple[Tensor, ...]:
    return torch.exp(log_scales), functional.normalize(quats), torch.sigmoid(logit_opacities)


# ----------------------------------------------------------------------------------------- how it is timed


def measure(calls: dict[str, Callable[[], object]], device: str, rounds: int) -> dict[str, dict]:
    """Seconds per call and, with CUDA, on the device alone; bytes of memory."""
    repeated = {name: partial(repeat, call, CALLS[device]) for name, call in calls.items()}
    ways = {"call": repeated}
    if device == "cuda":
        ways["device"] = {name: capture(call).replay for name, call in repeated.items()}
    cases = {(way, name): [call] for way, of_way in ways.items() for name, call in of_way.items()}
    results = {name: {"extra_bytes": extra_bytes(call, device)} for name, call in calls.items()}
    for (way, name), (samples,) in in_turn(cases, CLOCKS[device], rounds + 1).items():
        results[name][way] = statistics.median(samples[1:]) / CALLS[device]
    return results


def repeat(call: Callable[[], object], times: int) -> None:
    for _ in range(times):
        call()


def capture(call: Callable[[], object]) -> torch.cuda.CUDAGraph:
    """What a call launches, to be replayed."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return graph


def extra_bytes(call: Callable[[], object], device: str) -> int:
    """What a call needs beyond its inputs and results; below 0 where unknown."""
    call()
    results, added = added_memory(call, torch.device(device))
    return added - sum(t.numel() * t.element_size() for t in results or ())


def format_results(results: dict[str, dict]) -> str:
    ways = [way for way in ("call", "device") if way in next(iter(results.values()))]
    rows = [
        [name, *(1e3 * result[way] for way in ways), result["extra_bytes"] / 2**20] for name, result in results.items()
    ]
    return markdown_table(["", *(f"{way} ms" for way in ways), "extra MiB"], rows)


if __name__ == "__main__":
    main()
