"""What a process may rely on: memory that does not grow, interrupts, exceptions, threads and forks."""

import gc
import os
import pathlib
import threading

import pytest
import scenes
import torch
from marks import each_path, needs_cuda
from processes import DEADLINE, in_threads, run_python
from scenes import KINDS, Camera
from threads import assert_identical

import analytic_rasterizer as ar

CAMERA = Camera(image_width=203, image_height=151, bg=(0.1, 0.5, 0.3), sh_degree=2)
SMALL = Camera(image_width=20, image_height=17, sh_degree=1)


def scene32(seed=1, count=400, degree=2):
    return scenes.cast(scenes.random_scene(seed, count, degree=degree, sigma=(0.01, 0.4)), torch.float32)


def rasterizer_for(variant, camera=CAMERA, device="cpu"):
    return ar.GaussianRasterizer(camera.settings(torch.float32, device, variant))


def render(rasterizer, scene, device="cpu"):
    """Image, radii and gradients of one call, on the CPU."""
    leaves = scenes.leaves(scenes.to(scene, device))
    color, radii = rasterizer(**leaves)
    color.backward(scenes.probe(color, seed=1))
    return [result.cpu() for result in (color.detach(), radii, *(leaf.grad for leaf in leaves.values()))]


# --- memory ------------------------------------------------------------------------------------


def resident_bytes():
    status = pathlib.Path("/proc/self/status")
    if not status.exists():
        pytest.skip("needs /proc to read the memory in use")
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


# The smallest block that malloc hands out takes 32 bytes; lost once per call it would make 320,000. The bound is half
# of that. What comes without a leak are pages of the heap that were never touched before: after the warm-up every
# size of block has been asked for, so that only few do (20 of 4096 bytes were measured). Linux may also put a huge
# page of 2 MiB in the place of small ones, some of which were never touched. A leak grows in every round; these do not.
CALLS, WARM_UP, ROUNDS = 10_000, 300, 3
GROWTH = 160_000


def test_memory_does_not_grow(device):
    """10,000 forward and backward passes, the footprints in turn; again where memory grew."""
    scene = scenes.to(scene32(count=12, degree=1), device)
    leaves = scenes.leaves(scene)
    rasterizers = [rasterizer_for(variant, SMALL, device) for variant in KINDS]
    weights = torch.ones(3, SMALL.image_height, SMALL.image_width, device=device)

    def frames(count):
        for i in range(count):
            color, _ = rasterizers[i % len(rasterizers)](**leaves)
            color.backward(weights)
            for leaf in leaves.values():
                leaf.grad = None

    def memory():
        gc.collect()
        if device == "cuda":
            torch.cuda.synchronize()
            return resident_bytes(), torch.cuda.memory_allocated(), torch.cuda.memory_reserved()
        return (resident_bytes(),)

    frames(WARM_UP)
    for _ in range(ROUNDS):
        before = memory()
        frames(CALLS)
        after = memory()
        growth = after[0] - before[0]
        print(f"{growth} bytes in {CALLS} calls")
        assert after[1:] == before[1:]
        if growth < GROWTH:
            break
    assert growth < GROWTH


# --- interrupts and exceptions -----------------------------------------------------------------


INTERRUPTED = """
import signal, sys, threading, time
import torch
import scenes, test_process as process

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored
device = sys.argv[1]
torch.set_num_threads(2)
variant = ("box", {"samples": 16})
scene, rasterizer = process.scene32(count=2000), process.rasterizer_for(variant, device=device)
expected = process.render(rasterizer, scene, device)
start = time.perf_counter()
process.render(rasterizer, scene, device)
seconds = time.perf_counter() - start
interrupts = 0
for turn in range(8):
    # At another point of the work each time: in the forward or the backward pass or in between.
    timer = threading.Timer(seconds * (turn + 0.5) / 8, signal.raise_signal, (signal.SIGINT,))
    try:
        timer.start()  # in here: the signal may come before this thread has its turn again
        for _ in range(1000):
            process.render(rasterizer, scene, device)
    except KeyboardInterrupt:
        interrupts += 1
    timer.join()
    process.assert_identical(process.render(rasterizer, scene, device), expected)
print(interrupts)
"""


def test_keyboard_interrupts(device):
    """Control-C stops a loop of renderings; the next one gives the same bits."""
    assert run_python(INTERRUPTED, device) == "8\n"


class StopError(Exception):
    """Raised in the middle of a pass."""


@each_path
def test_exceptions_leave_no_trace(device, variant):
    """Bad arguments, bad gradients and hooks that raise: afterwards the same call gives the same bits."""
    scene = scene32(count=50)
    rasterizer = rasterizer_for(variant, device=device)
    expected = render(rasterizer, scene, device)

    bad = scenes.to(dict(scene, opacities=scene["opacities"][:-1]), device)
    with pytest.raises(ValueError, match="opacities must"):
        rasterizer(**bad)
    assert_identical(render(rasterizer, scene, device), expected)

    with pytest.raises(TypeError, match="scales must"):
        rasterizer(**dict(scenes.to(scene, device), scales=scene["scales"].double().to(device)))
    assert_identical(render(rasterizer, scene, device), expected)

    def stop(_):
        raise StopError

    # Before the rasterizer's backward pass, and after it: what it saved is freed on the way out.
    for place in ("image", "means3D", "opacities"):
        leaves = scenes.leaves(scenes.to(scene, device))
        color, _ = rasterizer(**leaves)
        (color if place == "image" else leaves[place]).register_hook(stop)
        with pytest.raises(StopError):
            color.sum().backward()
        assert_identical(render(rasterizer, scene, device), expected)

    # A graph that was freed says so, and does not read what is gone.
    leaves = scenes.leaves(scenes.to(scene, device))
    color, _ = rasterizer(**leaves)
    color.sum().backward()
    with pytest.raises(RuntimeError, match="second time"):
        color.sum().backward()
    assert_identical(render(rasterizer, scene, device), expected)


@each_path
def test_an_exception_with_another_call_in_flight(device, variant):
    """A thread whose calls fail does not disturb one whose calls succeed."""
    scene, rasterizer = scene32(count=100), rasterizer_for(variant, device=device)
    expected = render(rasterizer, scene, device)
    bad = scenes.to(dict(scene, scales=scene["scales"][:, :2]), device)
    failed, done = threading.Event(), threading.Event()

    def fail():
        while not done.is_set():
            try:
                rasterizer(**bad)
            except ValueError:
                failed.set()

    thread = threading.Thread(target=fail)
    thread.start()
    try:
        assert failed.wait(DEADLINE)
        results = [render(rasterizer, scene, device) for _ in range(5)]
    finally:
        done.set()
        thread.join()
    for result in results:
        assert_identical(result, expected)


# --- threads -----------------------------------------------------------------------------------


@pytest.mark.parametrize("openmp_threads", [1, 3])
def test_python_threads(device, openmp_threads):
    """Every footprint at once, in threads that start together, twice each: the bits of one after the other."""
    torch.set_num_threads(openmp_threads)
    scene = scene32(count=150)
    rasterizers = [rasterizer_for(variant, device=device) for variant in KINDS]
    expected = [render(rasterizer, scene, device) for rasterizer in rasterizers]
    results = [[] for _ in KINDS]
    barrier = threading.Barrier(len(KINDS))

    def work(i):
        torch.set_num_threads(openmp_threads)  # a new thread has torch's default
        barrier.wait()
        for _ in range(2):
            results[i].append(render(rasterizers[i], scene, device))

    in_threads(len(KINDS), work)
    for several, one in zip(results, expected, strict=True):
        assert len(several) == 2
        for result in several:
            assert_identical(result, one)


def test_one_scene_shared_by_threads():
    """Inputs and settings are only read: eight threads render the same tensors."""
    leaves = scenes.leaves(scene32())
    rasterizer = rasterizer_for(("analytic", {}))
    weights = torch.ones(3, CAMERA.image_height, CAMERA.image_width)

    def gradients():
        color, radii = rasterizer(**leaves)
        return [color.detach(), radii, *torch.autograd.grad(color, list(leaves.values()), weights)]

    expected = gradients()
    results = [None] * 8

    def work(i):
        results[i] = gradients()

    in_threads(len(results), work)
    for result in results:
        assert_identical(result, expected)


@needs_cuda
@each_path
def test_both_devices_at_once(variant):
    """Two threads per device, those of CUDA on streams of their own."""
    scene = scene32()
    devices = ["cpu", "cuda", "cpu", "cuda"]
    rasterizers = {device: rasterizer_for(variant, device=device) for device in set(devices)}
    expected = {device: render(rasterizer, scene, device) for device, rasterizer in rasterizers.items()}
    results = [[] for _ in devices]
    torch.cuda.synchronize()

    def work(i):
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(4):
                results[i].append(render(rasterizers[devices[i]], scene, devices[i]))

    in_threads(len(devices), work)
    for device, several in zip(devices, results, strict=True):
        assert len(several) == 4
        for result in several:
            assert_identical(result, expected[device])


# --- forks -------------------------------------------------------------------------------------

FORKED = """
import os, signal, sys, time
import torch
import scenes, test_process as process

torch.set_num_threads(3)
scene, rasterizer = process.scene32(), process.rasterizer_for(("box", {"samples": 4}))
weights = torch.ones(3, process.CAMERA.image_height, process.CAMERA.image_width)


def everything():
    # Nothing of torch's own is large enough here to run on several threads, which would wait forever too.
    leaves = scenes.leaves(scene)
    color, radii = rasterizer(**leaves)
    color.backward(weights)
    return b"".join(t.detach().numpy().tobytes() for t in (color, radii, *(leaf.grad for leaf in leaves.values())))


expected = everything()
child = os.fork()
if child == 0:
    os._exit(0 if everything() == expected else 2)
deadline = time.monotonic() + process.DEADLINE / 2
while True:
    done, status = os.waitpid(child, os.WNOHANG)
    if done:
        break
    if time.monotonic() > deadline:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        sys.exit("the child hangs")
    time.sleep(0.02)
assert os.waitstatus_to_exitcode(status) == 0
assert everything() == expected
print("same")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_renders():
    """The parent has rendered on several threads, which the child does not have: no hang, the same bits."""
    assert run_python(FORKED) == "same\n"
