"""testing.cuda_on_cpu: what asks for CUDA gets tensors on the CPU, and afterwards everything is as before."""

import os

import numpy as np
import pytest
import torch
from processes import python_path, run_program

import analytic_rasterizer as ar
from analytic_rasterizer import testing

pytest_plugins = ["analytic_rasterizer.testing.fixtures"]

ONES = torch.ones(2, 3)
CUDA = torch.device("cuda:0")


def module():
    return torch.nn.Linear(2, 3)


ASKS_FOR_CUDA = {
    "zeros": lambda: torch.zeros(2, device="cuda"),
    "another device": lambda: torch.ones(2, device="cuda:3"),
    "tensor": lambda: torch.tensor([1.0], device=CUDA),
    "an index": lambda: torch.arange(4, device=0),
    "like": lambda: torch.rand_like(ONES, device="cuda"),
    "new": lambda: ONES.new_zeros(3, device=CUDA),
    "as_tensor": lambda: torch.as_tensor(np.ones(2), device="cuda"),
    "pinned": lambda: torch.empty(2, pin_memory=True),
    "pin_memory": lambda: ONES.pin_memory(),
    ".cuda()": lambda: ONES.cuda(),
    ".cuda(0)": lambda: ONES.cuda(0, non_blocking=True),
    ".to": lambda: ONES.to("cuda"),
    ".to(0)": lambda: ONES.to(0),
    ".to, type and device": lambda: ONES.to(CUDA, torch.float64, non_blocking=True),
    ".to(device=)": lambda: ONES.to(device="cuda", dtype=torch.float16),
    ".type": lambda: ONES.type("torch.cuda.DoubleTensor"),
    "torch.cuda.FloatTensor": lambda: torch.cuda.FloatTensor([1.0, 2.0]),
    "Module.cuda": lambda: module().cuda().weight,
    "Module.to": lambda: module().to("cuda").weight,
    "a module made there": lambda: torch.nn.Linear(2, 3, device="cuda").weight,
    "a device as context": lambda: enter(torch.device("cuda"), lambda: torch.zeros(2)),
    "torch.cuda.device": lambda: enter(torch.cuda.device(0), lambda: torch.zeros(2, device="cuda")),
}


def enter(context, work):
    with context:
        return work()


@pytest.mark.parametrize("name", ASKS_FOR_CUDA)
def test_what_asks_for_cuda_is_on_the_cpu(cuda_on_cpu, name):
    made = ASKS_FOR_CUDA[name]()
    assert made.device == torch.device("cpu")
    assert not made.is_pinned()


def test_values_types_and_gradients_stay(cuda_on_cpu):
    assert torch.equal(torch.tensor([1.5, 2.5], device="cuda"), torch.tensor([1.5, 2.5]))
    assert ONES.to(CUDA, torch.float64).dtype == torch.float64
    assert ONES.type("torch.cuda.DoubleTensor").dtype == torch.float64
    assert ONES.cuda() is ONES  # as on CUDA, where nothing is copied that is there already
    leaf = ONES.clone().requires_grad_()
    leaf.cuda().mul(3).sum().backward()
    assert torch.equal(leaf.grad, 3 * ONES)


def test_strings_and_numbers_that_are_no_devices_stay(cuda_on_cpu):
    assert torch.einsum("ij->i", ONES).tolist() == [3, 3]
    assert ONES.to(torch.int64).sum(1).tolist() == [3, 3]
    assert torch.full((2,), 7).tolist() == [7, 7]
    assert torch.zeros(2, dtype=torch.bool).device.type == "cpu"


def test_the_default_device(cuda_on_cpu):
    try:
        torch.set_default_device("cuda")
        assert torch.zeros(2).device.type == "cpu"
    finally:
        torch.set_default_device(None)


@pytest.mark.parametrize("options", [{}, {"map_location": "cuda"}, {"map_location": CUDA}, {"map_location": "cpu"}])
def test_load(cuda_on_cpu, tmp_path, options):
    torch.save({"a": ONES}, tmp_path / "a.pth")
    made = torch.load(tmp_path / "a.pth", weights_only=True, **options)["a"]
    assert made.device.type == "cpu" and torch.equal(made, ONES)


def test_what_programs_say_to_the_device(cuda_on_cpu):
    torch.cuda.set_device(CUDA)
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    assert torch.cuda.current_device() == 0
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    with pytest.raises(RuntimeError, match="recorded"):
        start.elapsed_time(end)
    start.record()
    end.record()
    end.synchronize()
    assert end.query() and start.elapsed_time(end) >= 0


def test_it_tells_the_truth_about_the_machine():
    there = torch.cuda.is_available()
    with testing.cuda_on_cpu():
        assert torch.cuda.is_available() == there
        assert not torch.zeros(2, device="cuda").is_cuda


def test_everything_is_as_before():
    names = [(owner, name, getattr(owner, name)) for owner, name in testing._replacements()]
    with pytest.raises(KeyError), testing.cuda_on_cpu():
        assert torch.zeros(2, device="cuda").device.type == "cpu"
        with testing.cuda_on_cpu():
            pass
        assert torch.zeros(2, device="cuda").device.type == "cpu"
        raise KeyError
    assert all(getattr(owner, name) is value for owner, name, value in names)
    if not torch.cuda.is_available():
        with pytest.raises((RuntimeError, AssertionError)):
            torch.zeros(2, device="cuda")


def test_optimisers_of_a_new_process():
    """They import torch.compile, which makes a table of torch's functions: it must not have those of the context."""
    done = run_program(
        """
        import torch
        from analytic_rasterizer import testing
        true = torch.cuda.synchronize
        with testing.cuda_on_cpu():
            p = torch.nn.Parameter(torch.ones(3, device="cuda"))
            optimizer = torch.optim.Adam([p], lr=0.5)
            p.sum().backward()
            optimizer.step()
            changed = torch.cuda.synchronize
        known = torch._dynamo.trace_rules.get_torch_obj_rule_map()
        print(true in known, changed in known, p.device.type, p.max().item() < 1)
        """,
        environment=os.environ | {"PYTHONPATH": python_path()},
    )
    assert done.stdout == "True False cpu True\n", done.stderr[-2000:]


def test_pictures_and_gradients_are_those_of_the_cpu():
    """The rasterizer in a program that asks for CUDA everywhere, against the same program that does not."""

    def program(device):
        means = torch.tensor([[0.0, 0.0, 4.0], [0.5, 0.2, 5.0]], device=device, requires_grad=True)
        settings = ar.camera_settings(torch.eye(4, device=device), width=24, height=20, fx=25.0, fy=25.0)
        color, radii = ar.GaussianRasterizer(settings)(
            means3D=means,
            means2D=torch.zeros_like(means, device=device),
            opacities=torch.full((2, 1), 0.8, device=device),
            colors_precomp=torch.ones(2, 3, device=device),
            scales=torch.full((2, 3), 0.3, device=device),
            rotations=torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(2, 1),
        )
        color.square().sum().backward()
        return color.detach(), radii, means.grad

    plain = program("cpu")
    assert float(plain[0].max()) > 0.5
    with testing.cuda_on_cpu():
        moved = program("cuda")
    for one, other in zip(plain, moved):
        assert torch.equal(one, other)
