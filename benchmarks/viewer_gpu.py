"""What a frame of the viewer's page costs with WebGL 2, without a browser: the page's own shaders under OpenGL.

    pip install moderngl
    python benchmarks/viewer_gpu.py SCENE --views VIEWS [--sizes 512x384,1920x1080] [--footprints point analytic ...]

The sources of the shaders and their constants are taken from the modules of the page, which node runs. What is around
them is drawn as webgl.js does it, with the same textures, geometry and blending. Footprints are
those of one sample, which WebGL 2 draws. Needs a context of OpenGL 4.3, which takes shaders of GLSL ES 3.00. On Linux
it comes from EGL and needs no window.

Each picture of the first size, blended in 32-bit floats (as when the camera rests) and in half floats (as when it
moves), is compared with that of the CPU rasterizer. Frames are then timed in half floats, footprints in turn, round
after round. A frame is a projection of all Gaussians and one drawing; the order by depth, which a worker of the page
finds, is not in it. "device" is the time that the graphics device takes for projecting and drawing, with another frame
before them so that it never waits for commands; "clock" is the time from the first call until everything is drawn.
Medians over rounds, averaged over views.

For a machine without node, or without this package, prepare there where they are:

    python benchmarks/viewer_gpu.py --write-shaders FILE.json                  then --shaders FILE.json
    python benchmarks/viewer_gpu.py SCENE --views VIEWS --prepare FILE.npz     then FILE.npz in place of the scene

The second holds scene, cameras, shaders and the pictures to compare with, and needs numpy and moderngl only.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from page_job import Camera, Job, add_scene, check_scene, difference, read_job, run_node, table, to_bytes

EXTRACT = """
import { readFileSync } from 'fs';
import { CONSTANTS } from './constants.js';
import {
  FULL_SCREEN, GL_KINDS, SPLATS_PER_INSTANCE, SPLATS_PER_ROW, drawFragmentShader, drawVertexShader, projectShader,
  texelsOfHarmonics,
} from './webgl_shaders.js';

const DEGREES = [0, 1, 2, 3];
const footprints = {}, projections = {};
for (const { name, kind, samples, variance } of JSON.parse(readFileSync('given.json', 'utf8'))) {
  if (samples > 1 || !(kind in GL_KINDS)) continue;
  footprints[name] = { kind, variance, vertex: drawVertexShader(kind), fragment: drawFragmentShader(kind) };
  projections[kind] = DEGREES.map(degree => projectShader(kind, degree));
}
console.log(JSON.stringify({
  near: CONSTANTS.kNear, frustum_clamp: CONSTANTS.kFrustumClamp, splats_per_row: SPLATS_PER_ROW,
  splats_per_instance: SPLATS_PER_INSTANCE, texels_of_harmonics: DEGREES.map(texelsOfHarmonics),
  full_screen: FULL_SCREEN, projections, footprints,
}));
"""
HALF, FULL = "f2", "f4"  # what is blended, as moderngl calls it
WARM_UP = 1.0  # s of drawing before frames are timed: devices raise their clocks
BITS = {HALF: "16-bit floats", FULL: "32-bit floats"}


def main() -> None:
    args = parse_arguments()
    if args.write_shaders:
        Path(args.write_shaders).write_text(json.dumps(extract_shaders()))
        return
    job = read_job(args)
    if job.page is None:
        shaders = json.loads(Path(args.shaders).read_text()) if args.shaders else extract_shaders()
        job = replace(job, page=shaders)
    names = args.footprints or list(job.page["footprints"])
    if args.prepare:
        job.save(args.prepare, names)
        return
    context = create_context()
    device = f"{context.info['GL_RENDERER']}, OpenGL {context.info['GL_VERSION']}"
    print(f"{job}, {len(job.cameras)} sizes, {device}")
    renderer = Renderer(context, job)
    differences = compare(renderer, job, names)
    print(f"\n{format_differences(differences, job)}" if differences else "\nNot compared: no pictures of these views.")
    if args.pictures:
        save_pictures(renderer, job, names, Path(args.pictures))
    results = {"device": device, "scene": str(job), "differences": differences, "rows": []}
    for size in job.cameras:
        rows = measure(renderer, job, size, names, args.rounds, args.seconds)
        print(f"\n{format_rows(rows, size)}", flush=True)
        results["rows"] += rows
        if args.json:
            Path(args.json).write_text(json.dumps(results, indent=2))


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add_scene(parser)
    add = parser.add_argument
    add("--seconds", type=float, default=60.0, help="for the rounds of a size, at most (default: %(default)s)")
    add("--pictures", help="also write pictures of the first view and size to this folder, as PNG; needs pillow")
    add("--shaders", help="file that --write-shaders wrote, instead of node")
    add("--write-shaders", metavar="FILE", help="write the shaders of the page to this file, and end")
    args = parser.parse_args()
    if not args.write_shaders:
        check_scene(parser, args)
    return args


def extract_shaders() -> dict:
    """The sources and numbers of the page, by its own modules."""
    from analytic_rasterizer.viewer import packing

    return run_node(EXTRACT, packing.PAGE_ENTRIES)


# --------------------------------------------------------------------------------------- drawing


def create_context():
    """A context of moderngl without a window; ends the program with a sentence where there is none."""
    try:
        import moderngl
    except ImportError:
        sys.exit("This benchmark needs moderngl: pip install moderngl")
    try:
        backend = {"backend": "egl"} if sys.platform == "linux" else {}
        context = moderngl.create_context(require=430, standalone=True, **backend)
    except Exception as error:  # moderngl raises Exception itself
        sys.exit(f"There is no OpenGL 4.3 here, or no EGL to reach it by: {error}")
    return context


class Renderer:
    """What webgl.js does, for one scene."""

    def __init__(self, context, job: Job):
        self.context, self.job, self.shaders = context, job, job.page
        count, width = len(job.geometry), self.shaders["splats_per_row"]
        self.rows = -(-count // width)
        texels = self.shaders["texels_of_harmonics"][job.meta["sh_degree"]]
        per_row = context.info["GL_MAX_TEXTURE_SIZE"] // texels
        self.geometry = self.filled(3 * width, 4, "f4", job.geometry)
        self.harmonics = self.filled(texels * per_row, 4, "f2", job.harmonics)
        self.order = self.texture(width, self.rows, 1, "u4")
        self.splats = [self.texture(width, self.rows, 4, "u4") for _ in range(3)]
        self.splats_target = context.framebuffer(self.splats)
        self.visible = 0
        corners = 4 * np.arange(self.shaders["splats_per_instance"])[:, None] + [0, 1, 2, 2, 1, 3]
        self.corners = context.buffer(corners.astype(np.uint16).tobytes())
        self.programs, self.targets = {}, {}
        self.queries = [context.query(time=True) for _ in range(2)]

    def texture(self, width: int, height: int, components: int, dtype: str, data=None):
        texture = self.context.texture((width, height), components, data, alignment=1, dtype=dtype)
        texture.filter = (self.context.NEAREST, self.context.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        return texture

    def filled(self, width: int, components: int, dtype: str, data: np.ndarray):
        """A texture of as many rows as the data take; the rest of the last row is zero."""
        per_row = width * components
        rows = -(-data.size // per_row)
        padded = np.zeros(rows * per_row, data.dtype)
        padded[: data.size] = data.reshape(-1)
        return self.texture(width, rows, components, dtype, padded.tobytes())

    def target(self, camera: Camera, dtype: str):
        """A framebuffer of the size of the picture."""
        key = (camera.width, camera.height, dtype)
        if key not in self.targets:
            self.targets[key] = self.context.framebuffer([self.texture(camera.width, camera.height, 4, dtype)])
        return self.targets[key]

    def program(self, vertex: str, fragment: str, indices=None):
        """A program and the empty vertex array that it draws."""
        key = (vertex, fragment)
        if key not in self.programs:
            program = self.context.program(vertex_shader=vertex, fragment_shader=fragment)
            self.programs[key] = program, self.context.vertex_array(program, [], indices, index_element_size=2)
        return self.programs[key]

    @staticmethod
    def set_uniforms(program, textures: dict, **values) -> None:
        for unit, (name, texture) in enumerate(textures.items()):
            if name in program:
                texture.use(unit)
                program[name].value = unit
        for name, value in values.items():
            program[name].value = value

    def sort(self, camera: Camera) -> None:
        """The order of sort.js: the farthest first, in depths rounded as the rasterizer rounds them."""
        x, y, z, w = np.array(camera.w2c[8:12], np.float32)
        means = self.job.geometry
        depth = x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + w
        visible = np.flatnonzero(depth > np.float32(self.shaders["near"]))
        order = visible[np.argsort(depth[visible], kind="stable")][::-1]
        padded = np.zeros(self.rows * self.shaders["splats_per_row"], np.uint32)
        padded[: len(order)] = order
        self.order.write(padded.tobytes())
        self.visible = len(order)

    def project(self, camera: Camera, name: str) -> None:
        footprint, context = self.shaders["footprints"][name], self.context
        source = self.shaders["projections"][footprint["kind"]][self.job.meta["sh_degree"]]
        program, vertices = self.program(self.shaders["full_screen"], source)
        self.splats_target.use()
        context.viewport = (0, 0, self.shaders["splats_per_row"], self.rows)
        context.disable(context.BLEND)
        view = np.array(camera.w2c).reshape(4, 4)
        clamp = self.shaders["frustum_clamp"] / 2
        values = {
            "frame.view": [tuple(row) for row in view[:3]],
            "frame.eye": tuple(-view[:3, :3].T @ view[:3, 3]),
            "frame.pinhole": (camera.fx, camera.fy, camera.cx, camera.cy),
            "frame.limit": (clamp * camera.width / camera.fx, clamp * camera.height / camera.fy),
            "frame.variance": footprint["variance"],
        }
        values = {name: value for name, value in values.items() if name in program}
        self.set_uniforms(program, {"uGeometry": self.geometry, "uHarmonics": self.harmonics}, **values)
        vertices.render(context.TRIANGLES, vertices=3)

    def draw(self, camera: Camera, name: str, dtype: str):
        """Draws the splats of the last projection; returns the framebuffer that holds the picture."""
        footprint, context = self.shaders["footprints"][name], self.context
        program, vertices = self.program(footprint["vertex"], footprint["fragment"], self.corners)
        target = self.target(camera, dtype)
        target.use()
        target.clear()
        context.viewport = (0, 0, camera.width, camera.height)
        context.enable(context.BLEND)
        context.blend_func = context.ONE, context.ONE_MINUS_SRC_ALPHA
        names = ("uMean", "uWhitening", "uColor")
        textures = dict(zip(names, self.splats)) | {"uOrder": self.order}
        self.set_uniforms(program, textures, uVisible=self.visible, uSize=(camera.width, camera.height))
        instances = -(-self.visible // self.shaders["splats_per_instance"])
        if instances > 0:
            vertices.render(context.TRIANGLES, instances=instances)
        return target

    def render(self, camera: Camera, name: str, dtype: str):
        self.project(camera, name)
        return self.draw(camera, name, dtype)

    def picture(self, camera: Camera, name: str, dtype: str) -> np.ndarray:
        """The picture over black, as uint8 (3, height, width) with row 0 at the top. Sorts."""
        self.sort(camera)
        target = self.render(camera, name, dtype)
        values = np.frombuffer(target.read(components=4, dtype="f4"), np.float32)
        return to_bytes(values.reshape(camera.height, camera.width, 4)[..., :3].transpose(2, 0, 1))


# --------------------------------------------------------------------------------------- measuring


def compare(renderer: Renderer, job: Job, names: list[str]) -> dict[str, dict]:
    """By footprint and what is blended, the difference from the expected pictures."""
    cameras = next(iter(job.cameras.values()))
    differences = {}
    for name in names:
        expected = job.expected(name)
        if expected is None:
            continue
        differences[name] = {}
        for dtype, bits in BITS.items():
            ours = np.stack([renderer.picture(camera, name, dtype) for camera in cameras])
            differences[name][bits] = difference(ours, expected)
    return differences


def save_pictures(renderer: Renderer, job: Job, names: list[str], folder: Path) -> None:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    camera = next(iter(job.cameras.values()))[0]
    for name in names:
        picture = renderer.picture(camera, name, FULL).transpose(1, 2, 0)
        Image.fromarray(np.ascontiguousarray(picture)).save(folder / f"{name.replace(':samples=', '_')}.png")


def time_frame(renderer: Renderer, camera: Camera, name: str) -> dict[str, float]:
    """Milliseconds of one frame in half floats: by the clock, and of its two parts on the device."""
    context = renderer.context
    context.finish()
    start = time.perf_counter()
    renderer.render(camera, name, HALF)
    context.finish()
    clock = 1e3 * (time.perf_counter() - start)
    renderer.render(camera, name, HALF)  # the device is at work on it while it is sent what is timed
    with renderer.queries[0]:
        renderer.project(camera, name)
    with renderer.queries[1]:
        renderer.draw(camera, name, HALF)
    project, draw = (query.elapsed / 1e6 for query in renderer.queries)
    return {"clock": clock, "device": project + draw, "project": project, "draw": draw}


def measure(renderer: Renderer, job: Job, size: str, names: list[str], rounds: int, seconds: float) -> list[dict]:
    """A row for each footprint at a size. Ends before `rounds` rounds after so many seconds."""
    cameras = job.cameras[size]

    def time_round() -> dict[str, list[dict]]:
        times = {name: [] for name in names}
        for camera in cameras:
            renderer.sort(camera)
            for name in names:
                times[name].append(time_frame(renderer, camera, name))
        return times

    start = time.perf_counter()
    while True:  # the first round compiles shaders
        time_round()
        if time.perf_counter() - start > WARM_UP:
            break
    samples = {name: [[] for _ in cameras] for name in names}
    start, taken = time.perf_counter(), 0
    while taken < rounds and (taken == 0 or time.perf_counter() - start < seconds):
        for name, of_views in time_round().items():
            for view, times in zip(samples[name], of_views):
                view.append(times)
        taken += 1
    rows = []
    for name in names:
        keys = samples[name][0][0]
        mean = {
            f"{key}_ms": statistics.mean(statistics.median(times[key] for times in view) for view in samples[name])
            for key in keys
        }
        rows.append({"size": size, "footprint": name, "rounds": taken, **mean, "ms": samples[name]})
    if "point" in names:
        for key in ("clock", "device", "draw"):
            ratios = {name: ratio_to_point(samples, name, key) for name in names}
            for row in rows:
                row[f"{key}_ratio"] = ratios[row["footprint"]]
    return rows


def ratio_to_point(samples: dict[str, list], name: str, key: str) -> float:
    """The median over rounds of the ratio to `point` in the same round, averaged over views."""
    return statistics.mean(
        statistics.median(ours[key] / point[key] for ours, point in zip(view, of_point))
        for view, of_point in zip(samples[name], samples["point"])
    )


# --------------------------------------------------------------------------------------- tables


def format_differences(differences: dict[str, dict], job: Job) -> str:
    header = [f"{next(iter(job.cameras))}, levels of 255"]
    header += [f"{bits}: {column}" for bits in BITS.values() for column in ("largest", "99.99%", "differing")]
    rows = []
    for name, of_name in differences.items():
        row = [name]
        for found in of_name.values():
            row += [found["largest"], f"{found['99.99%']:.2f}", f"{100 * found['off'] / found['values']:.3f}%"]
        rows.append(row)
    return table(header, rows)


def format_rows(rows: list[dict], size: str) -> str:
    keys = ["device_ms", "project_ms", "draw_ms", "clock_ms"]
    ratios = [key for key in ("device_ratio", "draw_ratio", "clock_ratio") if key in rows[0]]
    header = [size, *(key.replace("_", " ") for key in keys), *(key.replace("_", " ") for key in ratios)]
    lines = [[row["footprint"], *(f"{row[k]:.3f}" for k in [*keys, *ratios])] for row in rows]
    return f"{table(header, lines)}\n{rows[-1]['rounds']} rounds"


if __name__ == "__main__":
    main()
