"""What the plain path, three colours of a fixed pinhole, calls and allocates: tests/data/plain_path.json.

    PYTHONPATH=TREE python tests/record_plain_path.py tests/data/plain_path.json [--devices cpu cuda] [--commit NAME]

records a TREE that has been built in place, wherever this program lies: it uses nothing that TREEs before the effects
lack. Devices that are not recorded keep what the file has of them. test_zero_cost.py measures the same again, of the
build under test, and compares.

The record is that of commit a52dfaa, the last before the full camera (csrc/core/camera.h): what was compiled in since
must not show in it. Should the plain path itself be changed, on purpose and by all, record the tree that changes it and
say so in its commit; a change for the sake of an effect is what the test is there to refuse.

Of every footprint and pass the file has

- `calls`: what our ops and their autograd nodes call of torch, in order; where they make a tensor with its bytes,
  "empty:2880". Ours, whatever the version of torch.
- `everything`: all ops from the call of the rasterizer to its end, in order, and `allocated`, the bytes of all
  allocations by size, "12:3" for three of 12 bytes. Torch's own are among them: of one version of torch.
- on CUDA, where those bytes are what the caching allocator rounds them to, also `kernels`: launches of ours by name;
  `others`, those of torch; `memsets`, `memcpys`; `bytes` and `allocations`: what was asked for, before rounding. Room
  for pairs is fixed (FRAME_PAIRS), or it would follow the frames before.
"""

from __future__ import annotations

import argparse
import collections
import json
import pathlib
import re
import subprocess
import tempfile

import scenes
import torch

import analytic_rasterizer as ar
from analytic_rasterizer import _C

FOOTPRINTS = ("point", "analytic", "box:samples=4", "adaptive")  # one sample, an option, several, chosen
PASSES = ("inference", "forward", "forward_backward")
CAMERA = scenes.Camera(image_height=29, image_width=37, sh_degree=1)
FRAME_PAIRS = 1 << 12
_OURS = "analytic_rasterizer::"
_FACTORIES = ("empty", "zeros")  # of torch: names begin with these


def prepare(footprint: str, pass_: str, device: str):
    """A function that renders the fixed scene, all of whose inputs are there."""
    settings = CAMERA.settings(torch.float32, device, footprint=footprint)
    scene = scenes.cast(scenes.random_scene(11, 60, degree=1), torch.float32, device)
    rasterizer = ar.GaussianRasterizer(settings)
    if pass_ == "inference":
        return torch.no_grad()(lambda: rasterizer(**scene))
    leaves = scenes.leaves(scene)
    weights = torch.ones(3, CAMERA.image_height, CAMERA.image_width, device=device)

    def forward_backward():
        color, _ = rasterizer(**leaves)
        return torch.autograd.grad(color, list(leaves.values()), weights)

    return forward_backward if pass_ == "forward_backward" else lambda: rasterizer(**leaves)


def measure(footprint: str, pass_: str, device: str) -> dict:
    """What one pass calls and allocates, as the module says."""
    if device == "cuda":
        _C.force_pair_capacity(FRAME_PAIRS)
    try:
        call = prepare(footprint, pass_, device)
        call()  # what happens once is no cost of a frame
        events = profile(call, device)
        return _of_host(events) | (_of_cuda(events, call) if device == "cuda" else {})
    finally:
        if device == "cuda":
            _C.force_pair_capacity(0)


def profile(call, device: str) -> list[dict]:
    """What torch's profiler saw of a call: events of its trace, by time."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
        torch.cuda.synchronize()
        torch.cuda.empty_cache()  # a large block that is found there may be handed out whole
    with torch.profiler.profile(activities=activities, profile_memory=True) as profiler:
        call()
        if device == "cuda":
            torch.cuda.synchronize()
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(path))
        events = json.loads(path.read_text())["traceEvents"]
    return sorted((e for e in events if e.get("ph") in ("X", "i")), key=lambda e: (e["ts"], -e.get("dur", 0)))


def _of_host(events: list[dict]) -> dict:
    """Calls and allocations. Events of a thread nest: an open span is a caller of those that begin within it."""
    calls, everything, sizes = [], [], collections.Counter()
    open_spans = collections.defaultdict(list)  # by thread: (end, name, whether it is a call of ours to torch)
    for event in events:
        spans = open_spans[event["tid"]]
        while spans and spans[-1][0] <= event["ts"]:
            spans.pop()
        if event["name"] == "[memory]":
            size = event["args"]["Bytes"]
            if size > 0:
                sizes[size] += 1
                direct = [name for _, name, is_direct in spans if is_direct]
                if direct and direct[0].startswith(_FACTORIES):
                    calls[-1] += f":{size}"
        elif event.get("cat") == "cpu_op":
            name = event["name"].removeprefix("aten::")
            is_direct = bool(spans) and is_ours(spans[-1][1]) and not is_ours(name)
            if is_direct:
                calls.append(name)
            everything.append(name.removeprefix(_OURS))
            spans.append((event["ts"] + event["dur"], name, is_direct))
    allocated = " ".join(f"{size}:{count}" for size, count in sorted(sizes.items()))
    return {"calls": _joined(calls), "everything": _joined(everything), "allocated": allocated}


def is_ours(name: str) -> bool:
    """Whether it is an op of ours, or its node in autograd's graph."""
    return name.startswith((_OURS, "torch::autograd::CppNode<ar::ops::"))


def _joined(names: list[str]) -> list[str]:
    """One string per line of the file: names without spaces, some on a line."""
    names = [re.sub(r"\s", "", name) for name in names]
    return [" ".join(names[i : i + 12]) for i in range(0, len(names), 12)]


def _of_cuda(events: list[dict], call) -> dict:
    """Launches from the trace; bytes from the allocator."""
    launched = [e["name"] for e in events if e.get("cat") == "kernel"]
    ours = collections.Counter(kernel_name(name) for name in launched if "ar::" in name)
    if not ours:
        raise RuntimeError("torch's profiler saw no kernel: CUPTI is missing, or not allowed here")
    torch.cuda.synchronize()
    before = torch.cuda.memory_stats()
    results = call()
    after = torch.cuda.memory_stats()
    del results
    counted = {"bytes": "requested_bytes.all.allocated", "allocations": "allocation.all.allocated"}
    return {
        "kernels": dict(sorted(ours.items())),
        "others": len(launched) - ours.total(),
        "memsets": sum(e.get("cat") == "gpu_memset" for e in events),
        "memcpys": sum(e.get("cat") == "gpu_memcpy" for e in events),
        **{name: after[key] - before[key] for name, key in counted.items()},
    }


def kernel_name(name: str) -> str:
    """A kernel as it was called before there were two cameras, however the demangler spells it."""
    name = re.sub(r"_GLOBAL__N__\w+?(?=::)", "(anonymous namespace)", name.removeprefix("void "))
    return re.sub(r",(ar::)?Camera<float>(?=>)", "", re.sub(r"\s", "", name))


def commit_of(tree: pathlib.Path) -> str:
    described = ["git", "-C", str(tree), "describe", "--always", "--dirty", "--exclude=*"]
    return subprocess.run(described, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    available = ["cpu", "cuda"] if _C.has_cuda and torch.cuda.is_available() else ["cpu"]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("json", type=pathlib.Path, help="file to write, or to write to where it exists")
    parser.add_argument("--devices", nargs="+", choices=available, default=available)
    parser.add_argument("--commit", help="of the tree, where git cannot tell")
    arguments = parser.parse_args()
    tree = pathlib.Path(ar.__file__).resolve().parent
    commit = arguments.commit or commit_of(tree)
    torch.set_num_threads(1)
    record = json.loads(arguments.json.read_text()) if arguments.json.exists() else {}
    for device in arguments.devices:
        passes = {f: {p: measure(f, p, device) for p in PASSES} for f in FOOTPRINTS}
        record[device] = {"commit": commit, "torch": torch.__version__, "passes": passes}
    arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    print(f"{tree.parent} at {commit}: {', '.join(arguments.devices)}")


if __name__ == "__main__":
    main()
