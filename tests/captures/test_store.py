"""Where pictures live changes no bit of a training; limits hold; what does not fit is said before it is read."""

import functools
import json
import pathlib
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle, write_nerf_synthetic
from commands import refused
from marks import needs_cuda
from train_extra import image

from analytic_rasterizer import io, training
from analytic_rasterizer.analysis import memory as system
from analytic_rasterizer.captures import photographs, pictures, store
from analytic_rasterizer.captures.store import DEVICE, FILE, GIB, HOST, Bytes, Made, Plan, Store
from analytic_rasterizer.training import PictureMemory, TrainingOptions, schedule

CPU = torch.device("cpu")
PLENTY = Bytes(100 * GIB, 100 * GIB)
SMALL = {"sh_degree": 0, "footprint": "box:samples=1", "max_gaussians": 300, "random_points": 200}
PLACES = {
    # Limits in bytes, and the places that there are with them. A picture of 32x32 px with alpha has 4096.
    "device": (Bytes(GIB, GIB), {DEVICE}),
    "host": (Bytes(0, GIB), {HOST}),
    "file": (Bytes(0, 0), {FILE}),
    "all": (Bytes(4 * 4096 + 3 * 1024, 3 * 1024 + 2 * 4096), {DEVICE, HOST, FILE}),
}


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """Six photographs with alpha to train with, two for the test."""
    folder = tmp_path_factory.mktemp("synthetic")
    views = circle(8)
    write_nerf_synthetic(folder, views[:6], views[6:])
    return folder


def masked(folder):
    """The same capture with a mask for every other photograph."""
    for split in ("train", "test"):
        path = folder / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        for k, frame in enumerate(content["frames"][::2]):
            levels = np.full((32, 32), 255, np.uint8)
            levels[4 + k : 12, 5:21] = 0
            frame["mask_path"] = f"{split}/mask_{k}.png"
            image.fromarray(levels).save(folder / frame["mask_path"])
        path.write_text(json.dumps(content))


def limit(monkeypatch, limits):
    monkeypatch.setattr(pictures, "limits_of", lambda *_: limits)


trained = functools.partial(runs.trained, iterations=30, scales=(1, 2), densify_every=10, **SMALL)


def results(run):
    """Everything that a training leaves."""
    losses = [(entry["loss"], entry["psnr"]) for entry in run.history]
    return [*run.trainer.gaussians], losses, run.evaluate()["test"]


def assert_same_bits(got, expected):
    assert all(torch.equal(a, b) for a, b in zip(got[0], expected[0]))
    assert got[1:] == expected[1:]


def alive():
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("pictures")]


# ------------------------------------------------------------------------------------ the bits

VARIANTS = {
    "one op": {},
    "pictures with alpha": {"background": "random", "pictures_per_step": 3},
    "cubic": {"downsampling": "bicubic", "scale_repeats": (3, 1)},
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("place", ["host", "file", "all"])
def test_bits_of_a_training_are_the_same_wherever_pictures_live(synthetic, tmp_path, monkeypatch, place, variant):
    expected = results(trained(synthetic, tmp_path / "device", **VARIANTS[variant]))
    limits, places = PLACES[place]
    limit(monkeypatch, limits)
    run = trained(synthetic, tmp_path / "out", **VARIANTS[variant])
    assert set(run.trainer.pictures.store.plan.places.values()) == places
    assert_same_bits(results(run), expected)
    assert not alive()


@pytest.mark.parametrize("alpha", ["background", "mask"])
def test_bits_with_masks(tmp_path, monkeypatch, alpha):
    views = circle(8)
    write_nerf_synthetic(tmp_path / "scene", views[:6], views[6:])
    masked(tmp_path / "scene")
    capture = training.load_capture(tmp_path / "scene", alpha=alpha)
    loaded = {}
    for place, (limits, _) in PLACES.items():
        limit(monkeypatch, limits)
        loaded[place] = training.load_pictures(capture.train, (1, 2, 4), capture.background, "cpu")
    for scale in (1, 2, 4):
        for view in range(6):
            expected = loaded["device"].target(scale, view), loaded["device"].mask(scale, view)
            assert (expected[1] is None) == (alpha == "background" and view % 2 == 1)
            for place in loaded:
                color, mask = loaded[place].target(scale, view), loaded[place].mask(scale, view)
                assert torch.equal(color, expected[0])
                assert (mask is None) == (expected[1] is None) and (mask is None or torch.equal(mask, expected[1]))
    for of_place in loaded.values():
        of_place.close()


def test_a_training_that_goes_on_has_the_same_bits(synthetic, tmp_path):
    expected = results(trained(synthetic, tmp_path / "whole", iterations=40))
    trained(synthetic, tmp_path / "out", memory=PictureMemory(host=0), iterations=20)
    run = training.Run(synthetic, tmp_path / "out", resume=True, iterations=40, memory=PictureMemory(host=0))
    other = training.Run(synthetic, tmp_path / "out", resume=True, iterations=40)
    assert run.train() and other.train()
    assert_same_bits(results(run), results(other))
    assert len(run.history) == len(other.history) and expected[0][0].shape[1] == 3


@needs_cuda
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("place", ["host", "file", "all"])
def test_bits_on_cuda(synthetic, tmp_path, monkeypatch, place, variant):
    common = {"device": "cuda", "deterministic": True, **VARIANTS[variant]}
    expected = results(trained(synthetic, tmp_path / "device", **common))
    limits, places = PLACES[place]
    limit(monkeypatch, limits)
    run = trained(synthetic, tmp_path / "out", **common)
    assert set(run.trainer.pictures.store.plan.places.values()) == places
    assert_same_bits(results(run), expected)


@needs_cuda
def test_memory_on_cuda_is_not_used_again_before_its_time():
    """Pictures that are read late, on a stream that is far behind the host, are those that were asked for."""
    device, count, side = torch.device("cuda"), 40, 1024
    made = {(1, i): Made(torch.full((3, side, side), i, dtype=torch.uint8), None) for i in range(count)}
    plan = Plan(dict.fromkeys(made, HOST), {DEVICE: 0, HOST: 0, FILE: 0}, ahead=3, threads=3)
    kept = Store(device, plan, made, None, None)
    sums = []
    for i in range(count):
        kept.expect([(1, (i + k) % count) for k in range(5)])
        color = kept.get((1, i)).color
        torch.cuda._sleep(2_000_000)  # cycles
        sums.append(color.sum(dtype=torch.int64))
        del color
    kept.close()
    assert torch.stack(sums).tolist() == [3 * side * side * i for i in range(count)]


def test_work_of_another_stream_is_waited_for(monkeypatch):
    """What is said to CUDA, without one: copies are ordered by an event, and memory is kept for the other stream."""
    told = []

    class Stream:
        def record_event(self):
            told.append("recorded")
            return "event"

        def wait_event(self, event):
            told.append(f"waits for the {event}")

    step = Stream()
    color, mask = torch.arange(12, dtype=torch.uint8).reshape(3, 2, 2), torch.ones(2, 2, dtype=torch.uint8)
    made = Made(color, mask, torch.ones(2, 2, 2, dtype=torch.float16))
    plan = Plan({(1, 0): HOST}, {DEVICE: 0, HOST: 16, FILE: 0}, ahead=2, threads=1)
    kept = Store(CPU, plan, {(1, 0): made}, None, None)
    kept._stream, empty = Stream(), torch.empty
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: step)
    monkeypatch.setattr(torch, "empty", lambda *sizes, pin_memory, **options: empty(*sizes, **options))
    monkeypatch.setattr(torch.Tensor, "record_stream", lambda tensor, stream: told.append((tensor.shape, stream)))
    got = kept.get((1, 0))
    assert all(torch.equal(a, b) and a.data_ptr() != b.data_ptr() for a, b in zip(got, made))
    assert told == ["recorded", "waits for the event", *((tensor.shape, step) for tensor in made)]
    assert kept.get((1, 0)) is got and len(told) == 5  # for its mask
    kept.close()


@pytest.mark.parametrize("in_place", [True, False])
def test_pictures_are_read_with_the_bits_of_pillow(tmp_path, monkeypatch, in_place):
    taken = []
    usual = photographs._as_memory_of
    monkeypatch.setattr(
        photographs, "_as_memory_of", lambda *given: taken.append(1) or (usual(*given) if in_place else None)
    )
    rng = np.random.default_rng(3)
    rgb = image.fromarray(rng.integers(0, 256, (150, 9, 3), np.uint8))
    grey = rgb.convert("L")
    palette = rgb.quantize(16)
    made = {
        "rgb.png": (rgb, {}),
        "key.png": (rgb, {"transparency": rgb.getpixel((3, 100))}),
        "rgba.png": (image.fromarray(rng.integers(0, 256, (150, 9, 4), np.uint8)), {}),
        "grey.jpg": (grey, {}),
        "rgb.jpg": (rgb, {}),
        "progressive.jpg": (rgb, {"progressive": True, "subsampling": 0}),
        "cmyk.jpg": (rgb.convert("CMYK"), {}),
        "palette.png": (palette, {}),
        "palette_key.png": (palette, {"transparency": bytes(range(0, 160, 10))}),
        "la.png": (grey.convert("LA"), {}),
        "bits.png": (grey.convert("1"), {}),
        "flat.png": (rgb.crop((0, 0, 9, 1)), {}),
    }
    for name, (picture, options) in made.items():
        picture.save(tmp_path / name, **options)
        with image.open(tmp_path / name) as opened:
            expected = np.array(opened.convert("RGBA"))
        assert np.array_equal(photographs.read_picture(tmp_path / name).numpy(), expected), name
    assert len(taken) == 2
    (tmp_path / "rgb.jpg").write_bytes((tmp_path / "rgb.jpg").read_bytes()[:-400])
    with pytest.raises(io.SceneError, match=r"rgb.jpg: unreadable or cut short \(image file is truncated"):
        photographs.read_picture(tmp_path / "rgb.jpg")
    assert usual(SimpleNamespace(size=None), np.empty((1, 1, 4), np.uint8)) is None


# ---------------------------------------------------------------------------------- the places


def test_the_smallest_pictures_stay_nearest():
    sizes = {(scale, view): 3072 // scale**2 for scale in (1, 2, 4) for view in range(10)}
    total = sum(sizes.values())
    plan = store.plan_places(sizes, 1024, Bytes(total, 0), PLENTY, CPU)
    assert set(plan.places.values()) == {DEVICE} and plan.ahead == 0 and plan.taken[DEVICE] == total

    limits = Bytes(total - 1, 5 * 3072)
    plan = store.plan_places(sizes, 1024, limits, PLENTY, CPU)
    assert plan.ahead >= store.LEAST_AHEAD
    buffers = (plan.ahead + store.IN_USE) * 3072
    for place, of_place in plan.taken.items():
        held = sum(size for key, size in sizes.items() if plan.places[key] == place)
        assert of_place == held + (buffers if place == DEVICE else 0)
    assert plan.taken[DEVICE] <= limits.device and plan.taken[HOST] <= limits.host
    nearest = [DEVICE, HOST, FILE]
    by_size = [nearest.index(plan.places[key]) for key in sorted(sizes, key=lambda key: (sizes[key], key))]
    assert by_size == sorted(by_size) and set(by_size) == {0, 1, 2}

    plan = store.plan_places(sizes, 1024, Bytes(0, 0), PLENTY, CPU)
    assert set(plan.places.values()) == {FILE} and plan.ahead == store.LEAST_AHEAD


def test_threads_are_as_many_as_memory_allows(monkeypatch):
    pixels = 12_000_000
    each = store.DECODING * pixels
    monkeypatch.setattr(store.os, "sched_getaffinity", lambda _: range(64), raising=False)
    for free, processes, expected in ((1e12, 1, 16), (1e12, 16, 4), (8 * 5.5 * each, 1, 5), (1.2e9, 1, 1)):
        plan = store.plan_places({(1, 0): 36_000_000}, pixels, PLENTY, Bytes(free, free), CPU, processes)
        assert plan.threads == expected


def test_limits(monkeypatch):
    cuda, free = torch.device("cuda"), Bytes(80 * GIB, 128 * GIB)
    assert store.limits_of(PictureMemory(), free, cuda) == (20 * GIB, 64 * GIB)
    assert store.limits_of(PictureMemory(processes=4), free, cuda) == (5 * GIB, 16 * GIB)
    assert store.limits_of(PictureMemory(2, 0.5), free, cuda) == (2 * GIB, GIB // 2)
    assert store.limits_of(PictureMemory(), Bytes(7, 128 * GIB), CPU) == (64 * GIB, 0)
    assert store.limits_of(PictureMemory(host=3), Bytes(7, 128 * GIB), CPU) == (3 * GIB, 0)
    taken = Plan({}, {DEVICE: GIB, HOST: 2 * GIB, FILE: 0}, 0, 1)
    assert PictureMemory(1.5, 1).less(taken, cuda) == PictureMemory(0.5, 0)
    assert PictureMemory(None, 4).less(taken, cuda) == PictureMemory(None, 2)
    assert PictureMemory(None, 4).less(taken, CPU) == PictureMemory(None, 3)
    for memory, message in (
        (PictureMemory(host=-1), "picture_memory_host must be finite and not negative, got -1"),
        (PictureMemory(gpu=float("nan")), "picture_memory_gpu must be finite and not negative, got nan"),
        (PictureMemory(gpu=1), "picture_memory_gpu must be None on a CPU, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            memory.check(CPU)
    found = store.free_memory(CPU)
    assert 0 < found.host == found.device
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    numbers = {"mem_get_info": (100, 1000), "memory_reserved": 70, "memory_allocated": 50}
    for name, value in numbers.items():
        monkeypatch.setattr(torch.cuda, name, lambda device, value=value: value)
    assert store.free_memory(cuda).device == 120


@pytest.mark.parametrize(
    ("folder", "limit", "used"),
    [
        ("/sys/fs/cgroup", "memory.max", "memory.current"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ],
    ids=["version 2", "version 1"],
)
def test_a_container_limits_what_is_free(monkeypatch, folder, limit, used):
    """Files that were read count as used, and give way. Trainings and pictures of commands go by the same number."""
    files = {
        "/proc/meminfo": "MemTotal: 90 kB\nMemAvailable: 80 kB\n",
        f"{folder}/{limit}": "50000",
        f"{folder}/{used}": "20000",
        f"{folder}/memory.stat": "anon 3\ninactive_file 5000\n",
    }

    def read(path):
        if str(path) not in files:
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(pathlib.Path, "read_text", read)

    def free():
        assert store.free_memory(CPU) == (system.free_memory("cpu"),) * 2
        return system.free_memory("cpu")

    assert free() == 35000
    files[f"{folder}/{used}"] = "60000"  # files that give way are not all of it
    assert free() == 0
    del files[f"{folder}/memory.stat"]
    files[f"{folder}/{used}"] = "20000"
    assert free() == 30000
    files[f"{folder}/{limit}"] = "max"
    assert free() == 80 * 1024


def test_where_the_system_does_not_tell_half_of_all_memory_is_free(monkeypatch):
    def missing(path):
        raise FileNotFoundError(path)

    monkeypatch.setattr(pathlib.Path, "read_text", missing)
    monkeypatch.setattr(system.os, "sysconf", {"SC_PHYS_PAGES": 6, "SC_PAGE_SIZE": 1000}.get)
    assert system.free_memory("cpu") == 3000 and store.free_memory(CPU) == (3000, 3000)
    monkeypatch.delattr(system.os, "sysconf")
    assert system.free_memory("cpu") is None and store.free_memory(CPU) == (store.UNKNOWN, store.UNKNOWN)


# -------------------------------------------------------------------- what is said, and when


@pytest.fixture
def unread(monkeypatch):
    """Fails where pixels are read."""
    monkeypatch.setattr(pictures, "read_file", lambda *_: pytest.fail("a photograph was decoded"))


def test_what_does_not_fit_is_said_before_anything_is_decoded(synthetic, monkeypatch, unread):
    capture = training.load_capture(synthetic)
    helps = r"larger --scales or smaller photographs \(--images\) may help; a lower --picture-memory"
    monkeypatch.setattr(pictures, "free_memory", lambda _: Bytes(GIB, 1024))
    expected = rf"the 12 pictures of .* need [\d.e-]+ GiB of memory, where 9.54e-07 GiB are free; {helps}-host may help"
    with pytest.raises(io.SceneError, match=expected):
        training.load_pictures(capture.train, (1, 2), capture.background, "cpu")
    sizes = {(1, i): 12_000_000 * 3 for i in range(1000)}
    for free, limits, where, option in (
        (Bytes(10 * GIB, 100 * GIB), Bytes(40 * GIB, 0), "the GPU, where 10 GiB", "gpu"),
        (Bytes(GIB // 2, 100 * GIB), Bytes(0, 40 * GIB), "the GPU, where 0.5 GiB", "gpu"),
        (Bytes(80 * GIB, 20 * GIB), Bytes(0, 40 * GIB), "memory, where 20 GiB", "host"),
    ):
        with pytest.raises(io.SceneError, match=rf"need .* GiB of {where} are free; {helps}-{option} may help"):
            store.plan_places(sizes, 12_000_000, limits, free, torch.device("cuda"))


@pytest.mark.parametrize(
    "options, message",
    [
        ("--picture-memory-gpu 1", "picture_memory_gpu must be None on a CPU, got 1.0"),
        ("--picture-memory-host -1", "picture_memory_host must be finite and not negative, got -1.0"),
    ],
)
def test_bad_options(synthetic, tmp_path, unread, capsys, options, message):
    assert message in refused(capsys, commands.train, synthetic, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_the_command_says_where_pictures_are(synthetic, tmp_path, capsys):
    for out, options in (("file", ["--picture-memory-host", "0"]), ("device", [])):
        assert commands.train(synthetic, tmp_path / out, "--iterations 3 --no-evaluate", *options) == 0
        said = "in memory (--picture-memory-host), and 1.72e-05 GiB are decoded ahead" in capsys.readouterr().err
        assert said == (out == "file")
    scenes = [io.load_scene(tmp_path / out / "scene.ply") for out in ("file", "device")]
    assert all(torch.equal(a, b) for a, b in zip(*scenes))


# ---------------------------------------------------------------------------- ahead, in order


class Slow:
    """Reads when it may; the store that asks it has pictures of one pixel in files."""

    def __init__(self, views: int, ahead: int):
        self.asked, self.may, self.fails = [], threading.Event(), set()
        places = {(1, view): FILE for view in range(views)}
        places[1, views - 1] = DEVICE
        plan = Plan(places, {DEVICE: 0, HOST: 0, FILE: 0}, ahead, threads=1)
        kept = {(1, views - 1): Made(torch.full((3, 1, 1), views - 1, dtype=torch.uint8), None)}
        self.store = Store(CPU, plan, kept, self.read, self.make)

    def read(self, key, pinned):
        self.may.wait()
        self.asked.append(key[1])
        if key[1] in self.fails:
            raise io.SceneError(f"{key[1]}.jpg: unreadable")
        return key[1]

    def make(self, key, source, moved):
        return Made(moved(torch.full((3, 1, 1), source, dtype=torch.uint8)), None)

    def get(self, view):
        return self.store.get((1, view)).color[0, 0, 0].item()

    def expect(self, *views):
        self.store.expect((1, view) for view in views)


def test_pictures_are_fetched_in_the_order_in_which_they_are_expected():
    slow = Slow(6, ahead=3)
    slow.expect(3, 5, 1, 4, 0)
    assert [key[1] for key in slow.store._fetched] == [3, 1, 4]  # no more; 5 is on the device
    slow.may.set()
    assert [slow.get(view) for view in (3, 5, 1, 4, 0, 0, 2, 3)] == [3, 5, 1, 4, 0, 0, 2, 3]
    assert slow.asked == [3, 1, 4, 0, 2, 3]  # each once, 2 and the second 3 though nobody had expected them
    slow.store.close()


def test_a_picture_that_comes_twice_is_fetched_twice_only_where_another_is_between():
    slow = Slow(4, ahead=2)
    slow.may.set()
    order = [0, 0, 1, 0, 2]
    for first, view in enumerate(order):
        slow.expect(*order[first:])
        assert slow.get(view) == view
    slow.store.close()
    assert slow.asked == [0, 1, 0, 2]


def test_what_is_no_longer_expected_is_dropped():
    slow = Slow(6, ahead=2)
    slow.expect(0, 1, 2)
    slow.expect(3, 4)
    assert [key[1] for key in slow.store._fetched] == [3, 4]
    slow.may.set()
    assert slow.get(3) == 3 and slow.get(4) == 4
    slow.store.close()
    assert slow.asked in ([0, 3, 4], [3, 4])  # 0 where its thread had begun


def test_an_error_in_a_thread_is_raised_when_its_picture_is_asked_for():
    slow = Slow(4, ahead=2)
    slow.fails = {1}
    slow.may.set()
    slow.expect(0, 1, 2)
    assert slow.get(0) == 0
    with pytest.raises(io.SceneError, match=r"^1.jpg: unreadable$"):
        slow.get(1)
    assert slow.get(2) == 2
    slow.store.close()
    assert not alive()


def test_closed_threads_are_gone_and_start_again():
    slow = Slow(5, ahead=3)
    slow.expect(0, 1, 2)
    assert alive()
    slow.may.set()
    slow.store.close()
    assert not alive() and set(slow.asked) <= {0, 1, 2}
    assert slow.get(2) == 2
    slow.store.close()
    assert not alive()


def test_the_order_of_a_training_is_known_ahead(synthetic, tmp_path):
    """Each step of a process asks for the pictures of its own that come next, across passes."""
    run = runs.make_run(synthetic, tmp_path / "out", memory=PictureMemory(host=0), scales=(1, 2), **SMALL)
    trainer = run.trainer
    assert trainer.pictures.horizon == trainer.pictures.store.plan.ahead
    told = []
    trainer.pictures.store.expect = lambda keys: told.append([*keys])
    order = schedule.PictureOrder(6, trainer.options)
    for step in (0, 16, 17):  # 18 pictures make a pass
        trainer.progress.step = step
        trainer._next()
        wanted = [order(n) for n in range(step, step + 1 + trainer.pictures.horizon)]
        assert told.pop() == [(scale, view) for view, scale in wanted]
    trainer.ranks = SimpleNamespace(rank=1, world=3)
    trainer._expect(30)
    wanted = [order(n) for n in range(31, 31 + 3 * trainer.pictures.horizon, 3)]
    assert told.pop()[: len(wanted)] == [(scale, view) for view, scale in wanted]
    run.trainer.pictures.close()


def test_passes_are_those_of_any_order_of_questions():
    options = TrainingOptions(scales=(1, 2), seed=4)
    expected = [schedule.PictureOrder(5, options)(n) for n in range(300)]
    order = schedule.PictureOrder(5, options)
    assert [order(n) for step in range(200) for n in (step, step + 99)] == [
        expected[n] for step in range(200) for n in (step, step + 99)
    ]
    assert [order(n) for n in (0, 299, 7, 150)] == [expected[n] for n in (0, 299, 7, 150)]
    assert len(order.drawn) <= schedule.PASSES


# --------------------------------------------------------------------------------- how it ends


def test_a_picture_that_breaks_during_a_training_ends_it_with_its_name(tmp_path):
    views = circle(5)
    write_nerf_synthetic(tmp_path / "scene", views[:4], views[4:])
    run = runs.make_run(tmp_path / "scene", tmp_path / "out", memory=PictureMemory(host=0), **SMALL)
    (tmp_path / "scene" / "train" / "r_2.png").write_bytes(b"no picture")
    with pytest.raises(io.SceneError, match=r"r_2\.png: unreadable or cut short"):
        run.train()
    assert not alive()


def test_interruption_ends_the_threads(synthetic, tmp_path, monkeypatch):
    run = runs.make_run(synthetic, tmp_path / "out", memory=PictureMemory(host=0), **SMALL)
    seen = []

    def interrupted(trainer):
        seen.append(alive())
        if len(seen) == 3:
            raise KeyboardInterrupt

    runs.around_steps(monkeypatch, after=interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.train()
    assert all(seen) and not alive()


def test_a_broken_picture_ends_the_threads_that_read_others(tmp_path):
    write_nerf_synthetic(tmp_path, circle(6), circle(2))
    (tmp_path / "train" / "r_1.png").write_bytes((tmp_path / "train" / "r_1.png").read_bytes()[:-40])
    capture = training.load_capture(tmp_path)
    with pytest.raises(io.SceneError, match=r"r_1\.png: unreadable or cut short"):
        training.load_pictures(capture.train, (1,), capture.background, "cpu")
    assert not alive()
