"""What the viewer's page draws with WebGPU and how long a frame takes, without a browser: its own passes in wgpu.

    pip install wgpu
    python benchmarks/viewer_webgpu.py SCENE --views VIEWS [--sizes 512x384,1920x1080] [--footprints mip ...]

Node runs the renderer of the page with a device that only takes notes (record_webgpu.js). What it asked of WebGPU, its
shaders, buffers and dispatches, is then done with wgpu-native, whose compiler is that of Firefox.

First, frames of the footprints of --timed are timed at every size. A frame is everything from the projection of all
Gaussians to the blended picture. "device" is the time from the begin of the first pass to the end of the last one, by
timestamps of the device, of the last of several frames that are submitted together, so that it never waits for
commands; "clock" is the time of all of them divided by their number. Where a CUDA device is found and the package is
built for it, the rasterizer's forward pass without gradient is timed too, and "ratio" is device (or clock) to that. It
is the time between two events, without that of the host. Medians over rounds, averaged over views.

Then pictures of the first size are compared with those of the CPU rasterizer, and with themselves when drawn again.

For a machine without node, or without this package, prepare where they are:

    python benchmarks/viewer_webgpu.py SCENE --views VIEWS --write-plan FILE.json   then the same with --plan FILE.json
    python benchmarks/viewer_webgpu.py SCENE --views VIEWS --prepare FILE.npz       then FILE.npz in place of the scene

The first holds what node recorded, for this number of Gaussians and these views, sizes and footprints. The second also
has the scene and the pictures to compare with, and needs numpy and wgpu only.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from base64 import b64decode
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from page_job import Camera, Job, add_scene, check_scene, difference, read_job, resized, run_node, table, to_bytes

TIMED = ["box:samples=1", "moment:samples=4", "analytic"]
PAIRS = 26_000_000  # of splats and tiles, that there is room for: bindings of 128 MiB, which every device has
FRAMES = 4  # submitted together
WARM_UP = 1.0  # s of drawing before frames are timed: devices raise their clocks


def main() -> None:
    args = parse_arguments()
    job = read_job(args)
    names = args.footprints or [entry["name"] for entry in job.meta["footprints"]]
    if job.page is None:
        page = json.loads(Path(args.plan).read_text()) if args.plan else record(job, [*names, *args.timed])
        job = replace(job, page=page)
    check_plan(job, {*names, *args.timed})
    if args.write_plan:
        Path(args.write_plan).write_text(json.dumps(job.page))
        return
    if args.prepare:
        job.save(args.prepare, names)
        return
    device = open_device(job.page)
    print(f"{job}, {device.adapter.summary}", flush=True)
    player = Player(device, job)
    results = {"device": device.adapter.summary, "scene": str(job), "rows": [], "differences": {}}

    def save():
        if args.json:
            Path(args.json).write_text(json.dumps(results, indent=2))

    time_cuda = cuda_clock(job)
    for size in job.cameras:
        rows = []
        for name in args.timed:
            rows.append(measure(player, size, name, args.rounds, time_cuda))
        print(f"\n{format_rows(rows, player.stages)}", flush=True)
        results["rows"] += rows
        save()
    print(f"\n{next(iter(job.cameras))}, levels of 255:")
    for name in names:
        found = compare(player, job, name, args.repeat)
        print(format_difference(name, found, args.repeat), flush=True)
        results["differences"][name] = found
        save()


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add_scene(parser)
    add = parser.add_argument
    add("--timed", nargs="*", metavar="NAME", default=TIMED, help="(default: %(default)s)")
    add("--repeat", type=int, default=20, help="times that a picture is drawn again (default: %(default)s)")
    add("--plan", metavar="FILE", help="file that --write-plan wrote, instead of node")
    add("--write-plan", metavar="FILE", help="write what node records to this file, and end")
    args = parser.parse_args()
    check_scene(parser, args)
    return args


def record(job: Job, footprints: list[str]) -> dict:
    """What the page asks of WebGPU for these footprints, every view and size; record_webgpu.js describes it."""
    cameras = {size: [vars(camera) for camera in of_size] for size, of_size in job.cameras.items()}
    given = {"meta": job.meta, "cameras": cameras, "footprints": footprints, "pairs": PAIRS}
    return run_node(Path(__file__).with_name("record_webgpu.js").read_text(), given) | {"drawn": what_is_drawn(job)}


def what_is_drawn(job: Job) -> list:
    """What a plan is made for, beside footprints."""

    def numbers(camera: Camera) -> list[float]:  # machines may differ in the last digits
        return [round(x, 6) for x in (camera.fx, camera.fy, camera.cx, camera.cy, *camera.w2c)]

    cameras = [[size, *map(numbers, of_size)] for size, of_size in job.cameras.items()]
    return [job.meta["count"], job.meta["sh_degree"], cameras]


def check_plan(job: Job, footprints: set[str]) -> None:
    """Ends the program where the plan is for something else."""
    if job.page["drawn"] != what_is_drawn(job):
        sys.exit("The plan was made for another number of Gaussians, other views or other sizes.")
    for size, known in job.page["frames"].items():
        if missing := footprints - set(known):
            sys.exit(f"The plan has no {', '.join(sorted(missing))} at {size}.")


# --------------------------------------------------------------------------------------- the device


def open_device(plan: dict):
    """A device of wgpu that can hold the buffers of the plan; ends the program with a sentence where there is none."""
    try:
        import wgpu
    except ImportError:
        sys.exit("This benchmark needs wgpu: pip install wgpu")
    largest = max(size for size, _ in plan["buffers"])
    limits = {"max-storage-buffer-binding-size": max(largest, 1 << 27), "max-buffer-size": max(largest, 1 << 28)}
    try:
        adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
        features = {"timestamp-query"} & set(adapter.features)
        return adapter.request_device_sync(required_features=list(features), required_limits=limits)
    except Exception as error:  # RuntimeError, and what wgpu's own code makes of a driver that is missing
        sys.exit(f"wgpu finds no device for this scene: {error}")


def ticks(device) -> float:
    """Nanoseconds of a unit of timestamps, which wgpu-native leaves as the device has it."""
    from wgpu.backends.wgpu_native import lib

    return lib.wgpuQueueGetTimestampPeriod(device.queue._internal)


class Player:
    """Does what the page asked for.

    Attributes:
        stages: Names of the stages of a frame.
        has_stamps: Whether the device tells when they begin and end.
    """

    def __init__(self, device, job: Job):
        self.device, self.plan = device, job.page
        self.stages = self.plan["stages"]
        self.has_stamps = "timestamp-query" in device.features
        self.queries = device.create_query_set(type="timestamp", count=64) if self.has_stamps else None
        self.tick = 1e-6 * ticks(device)
        self.buffers, self.pipelines, self.groups = {}, {}, {}
        self.scene = {"geometry": job.geometry, "harmonics": job.harmonics}
        used = {number for frames in self.frames() for number in self.touched(frames)}
        self.write([write for write in self.plan["setup"] if write[0] in used])

    def frames(self) -> list[dict]:
        return [frame for of_size in self.plan["frames"].values() for of_name in of_size.values() for frame in of_name]

    @staticmethod
    def touched(frame: dict) -> set[int]:
        """Buffers that a frame binds."""
        runs = [command for command in frame["commands"] if command[0] == "run"]
        return {number for *_, steps in runs for _, group, _, _ in steps for number in group}

    def buffer(self, number: int):
        if number not in self.buffers:
            size, usage = self.plan["buffers"][number]
            self.buffers[number] = self.device.create_buffer(size=size, usage=usage)
        return self.buffers[number]

    def write(self, writes: list) -> None:
        for number, at, given in writes:
            data = self.scene[given] if given in self.scene else b64decode(given)
            self.device.queue.write_buffer(self.buffer(number), at, data)

    def pipeline(self, number: int):
        if number not in self.pipelines:
            module = self.device.create_shader_module(code=self.plan["pipelines"][number])
            compute = {"module": module, "entry_point": "main"}
            self.pipelines[number] = self.device.create_compute_pipeline(layout="auto", compute=compute)
        return self.pipelines[number]

    def group(self, pipeline: int, buffers: list[int]):
        key = (pipeline, *buffers)
        if key not in self.groups:
            entries = [{"binding": k, "resource": {"buffer": self.buffer(b)}} for k, b in enumerate(buffers)]
            layout = self.pipeline(pipeline).get_bind_group_layout(0)
            self.groups[key] = self.device.create_bind_group(layout=layout, entries=entries)
        return self.groups[key]

    def encode(self, frame: dict):
        """A command buffer of a frame."""
        encoder = self.device.create_command_encoder()
        for command, *given in frame["commands"]:
            if command == "clear":
                encoder.clear_buffer(self.buffer(given[0]))
            elif command == "copy":
                source, at, target, start, size = given
                encoder.copy_buffer_to_buffer(self.buffer(source), at, self.buffer(target), start, size)
            elif command == "run":
                self.encode_pass(encoder, *given)
            elif self.has_stamps:
                first, count, target, at = given
                encoder.resolve_query_set(self.queries, first, count, self.buffer(target), at)
        return encoder.finish()

    def encode_pass(self, encoder, begin: int, end: int, steps: list) -> None:
        stamps = {"beginning_of_pass_write_index": begin, "end_of_pass_write_index": end, "query_set": self.queries}
        made = encoder.begin_compute_pass(**({"timestamp_writes": stamps} if self.has_stamps else {}))
        for pipeline, buffers, size, indirect in steps:
            made.set_pipeline(self.pipeline(pipeline))
            made.set_bind_group(0, self.group(pipeline, buffers))
            if indirect:
                made.dispatch_workgroups_indirect(self.buffer(size[0]), size[1])
            else:
                made.dispatch_workgroups(*size)
        made.end()

    def draw(self, frame: dict, times: int = 1) -> dict[str, float]:
        """Draws a frame so many times. Milliseconds by the clock for one, on the device for the last and its stages."""
        self.write(frame["writes"])
        commands = [self.encode(frame) for _ in range(times)]
        start = time.perf_counter()
        self.device.queue.submit(commands)
        numbers = self.read(frame["numbers"])
        result = {"clock": 1e3 * (time.perf_counter() - start) / times}
        *_, room, wanted = numbers[:4]
        if wanted > room:
            sys.exit(
                f"A picture has {wanted} pairs of splat and tile, and PAIRS of this program gives room for {room}."
            )
        result["pairs"] = int(wanted)
        if self.has_stamps:
            stamps = numbers[4:].view("<u8").astype(np.float64) * self.tick
            begin, end = stamps[0::2], stamps[1::2]
            result |= {"device": end[-1] - begin[0], **dict(zip(self.stages, end - begin))}
        return result

    def read(self, number: int) -> np.ndarray:
        """The words of a buffer that the page maps; waits for the device."""
        buffer = self.buffer(number)
        buffer.map_sync("READ")
        words = np.frombuffer(bytes(buffer.read_mapped()), "<u4")
        buffer.unmap()
        return words

    def picture(self, size: str, name: str, view: int) -> np.ndarray:
        """Over black, float32 (3, height, width)."""
        frame = self.plan["frames"][size][name][view]
        self.draw(frame)
        values = np.frombuffer(self.device.queue.read_buffer(self.buffer(frame["picture"])), "<f4")
        width, height = map(int, size.split("x"))
        return values.reshape(height, width, 4)[..., :3].transpose(2, 0, 1)


# --------------------------------------------------------------------------------------- measuring


def compare(player: Player, job: Job, name: str, repeat: int) -> dict:
    """How pictures of all views differ from the expected ones, where there are any, and how many of the first view are
    not the same when drawn again."""
    size, cameras = next(iter(job.cameras.items()))
    pictures = [player.picture(size, name, view) for view in range(len(cameras))]
    changed = sum(not np.array_equal(pictures[0], player.picture(size, name, 0)) for _ in range(repeat))
    expected = job.expected(name)
    ours = np.stack([to_bytes(picture) for picture in pictures])
    return {"changed": changed} | (difference(ours, expected) if expected is not None else {})


def format_difference(name: str, found: dict, repeat: int) -> str:
    again = f"{repeat - found['changed']} of {repeat} the same bits"
    if "largest" not in found:
        return f"  {name}: {again}; not compared"
    off = f"largest difference {found['largest']}, {found['off']} of {found['values']} values off"
    return f"  {name}: {off}; {again}"


def cuda_clock(job: Job) -> Callable[[str, str, int], list[list[float]]] | None:
    """A function of size, footprint and rounds: milliseconds of the rasterizer's forward pass with CUDA, by view; None
    where that is not here, or the job is a prepared file."""
    if job.source is None:
        return None
    from common import WARM_UP as PASSES
    from common import has_cuda

    from analytic_rasterizer.analysis.timing import Case, event_seconds, in_turn, warm_up_cuda

    if not has_cuda():
        return None
    scene, views = job.source[0].to("cuda"), job.source[1]

    def times(size: str, name: str, rounds: int) -> list[list[float]]:
        cases = [Case(scene, resized(view, size), name) for view in views]
        warm_up_cuda([case.forward for case in cases], PASSES)
        taken = in_turn({name: cases}, lambda case: 1e3 * event_seconds(case.forward, queued=True), rounds)
        return taken[name]

    return times


def measure(player: Player, size: str, name: str, rounds: int, time_cuda: Callable | None) -> dict:
    """Medians of a footprint at a size, averaged over views."""
    frames = player.plan["frames"][size][name]
    start = time.perf_counter()
    while True:  # the first frame compiles shaders
        for frame in frames:
            player.draw(frame)
        if time.perf_counter() - start > WARM_UP:
            break
    taken = [[] for _ in frames]
    for _ in range(rounds):
        for frame, of_view in zip(frames, taken):
            of_view.append(player.draw(frame, FRAMES))
    keys = taken[0][0]
    mean = {key: statistics.mean(statistics.median(r[key] for r in of_view) for of_view in taken) for key in keys}
    row = {"size": size, "footprint": name, "rounds": rounds, **mean, "views": taken}
    if time_cuda:
        row["cuda"] = statistics.mean(map(statistics.median, time_cuda(size, name, rounds)))
        row["ratio"] = mean.get("device", mean["clock"]) / row["cuda"]
    return row


def format_rows(rows: list[dict], stages: list[str]) -> str:
    keys = [key for key in ("device", "clock", "cuda", "ratio", *stages) if key in rows[0]]
    header = [rows[0]["size"], *(key if key == "ratio" else f"{key} ms" for key in keys), "pairs"]
    lines = [[row["footprint"], *(f"{row[key]:.3f}" for key in keys), round(row["pairs"])] for row in rows]
    return f"{table(header, lines)}\n{rows[-1]['rounds']} rounds of {FRAMES} frames"


if __name__ == "__main__":
    main()
