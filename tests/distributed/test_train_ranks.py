"""Training on several ranks: it goes on on any number of them, and is what one process makes of the same pictures.

One set of processes makes everything that is looked at here, through gloo, and leaves it in files.
"""

import datetime
import json
import math
import os
import shutil
import subprocess
import sys
from unittest import mock

import pytest
import runs
import torch
import torch.distributed as dist
import train_extra  # noqa: F401
from capture_files import circle, write_nerf_synthetic
from processes import DEADLINE, in_threads, python_path, run_program, start_processes
from runs import TINY, rows_shown, scatter
from torch.distributed import distributed_c10d

from analytic_rasterizer import distributed, training
from analytic_rasterizer.cli import launch
from analytic_rasterizer.distributed.ranks import ALONE, Ranks, even_counts
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.losses import l1_ssim
from analytic_rasterizer.optim import MOMENTS, FusedAdam
from analytic_rasterizer.training import TrainingOptions, files, random_points, schedule, sharded
from analytic_rasterizer.training.sharded import UNEVEN, Seen, ShardedTrainer

WORLD = 3
STEPS, BREAKS = 43, (14, 27)  # where the chain changes from 2 ranks to 1, and from 1 to 3
HALF = 24  # where the others have a break
COMMON = TINY | {"iterations": STEPS, "scales": (1, 2), "random_points": 120, "densify_until": 0.9}
COMMON |= {"densify_from": 10, "densify_every": 10, "density": "3dgs", "gradient_scales": "all"}
LARGER_STEPS = {"pictures_per_step": 2, "supersampling": 2}
VARIANTS = {
    "absgrad": {"density": "absgrad", "gradient_scales": "finest", "filter_3d": True, "reset_every": 35},
    "sparse": {"sparse_adam": True},
    "masked": {"alpha": "mask"},
    "mcmc": {"density": "mcmc", "max_gaussians": 150, "background": "random", **LARGER_STEPS},
}
CAMERAS = 2  # of the step whose gradients are compared


def make_run(scene, out, ranks, **given):
    return runs.make_run(scene, out, ranks=ranks, **COMMON | given)


def train_until(run, step):
    while run.progress.step < step:
        run.trainer.step()
    run.save()


# --- the processes ----------------------------------------------------------------------------------


def work(rank, world, folder):
    torch.set_num_threads(1)
    init = f"file://{folder}/rendezvous"
    timeout = datetime.timedelta(seconds=DEADLINE)
    dist.init_process_group("gloo", init_method=init, rank=rank, world_size=world, timeout=timeout)
    pair, late = dist.new_group([1, 2]), dist.new_group([1, 2])
    all_ranks, scene = Ranks.of_group(), folder / "scene"
    if rank > 0:
        two = Ranks.of_group(pair)
        assert (two.rank, two.world) == (rank - 1, 2)  # the rank in the group is not that in the world
        for name, more in VARIANTS.items():
            repeat(scene, folder / name, two, more)
        gradients(scene, folder, two)
        sparse_step(scene, folder, two)
        train_until(make_run(scene, folder / "chain", two), BREAKS[0])
        if two.is_first:
            shutil.copytree(folder / "chain", folder / "chain-by-2")
        if rank == 1:
            wait_in_vain(late, folder)
    dist.barrier()
    if rank == 0:
        run = make_run(scene, folder / "chain", ALONE, resume=True)
        save_again(run, folder / "chain-read-by-1")
        train_until(run, BREAKS[1])
        shutil.copytree(folder / "chain", folder / "chain-by-1")
    dist.barrier()
    run = make_run(scene, folder / "chain", all_ranks, resume=True)
    save_again(run, folder / "chain-read-by-3")
    run.train()
    metrics = run.evaluate()
    if rank == 2:
        (folder / "metrics.json").write_text(json.dumps(metrics))
    redistribute(run.trainer, folder)
    outside_of_float32(run, folder)
    not_finite(run, folder)
    dist.barrier()
    dist.destroy_process_group()


def repeat(scene, out, ranks, more):
    """A training to its end, and once more with a break after about half of it, and pictures in their files."""
    whole, part = (make_run(scene, out / name, ranks, **more) for name in ("whole", "part"))
    if whole.options.sparse_adam or "alpha" in more:
        for run in (whole, part):
            scatter(run.trainer.gaussians)
    whole.train()
    train_until(part, HALF)
    part = make_run(scene, out / "part", ranks, resume=True, memory=training.PictureMemory(host=0))
    assert part.trainer.pictures.horizon and part.progress.step == HALF
    part.train()


def gradients(scene, folder, ranks):
    """The gradients of the first step, and the Gaussians after it."""
    run = make_run(scene, folder / "gradients", ranks)
    trainer = run.trainer
    trainer._set_rates()
    with torch.no_grad():
        loss, seen, _ = trainer._differentiate_together()
    made = {name: ranks.gather_rows(field.grad) for name, field in trainer.gaussians._asdict().items()}
    trainer._observe(seen)
    made["sums"] = ranks.gather_rows(trainer.density.gradient_sums)
    made["loss"] = math.fsum(ranks.exchange(loss.item()))
    trainer.optimizer.step()
    made["after"] = [ranks.gather_rows(field) for field in trainer.gaussians]
    if ranks.is_first:
        torch.save(made, folder / "gradients.pt")


def sparse_step(scene, folder, ranks):
    """Parameters and moments after a step that updates only what its pictures show."""
    trainer = make_run(scene, folder / "sparse-step", ranks, sparse_adam=True).trainer
    scatter(trainer.gaussians)
    trainer.step()
    after = [ranks.gather_rows(rows) for rows in state_rows(trainer)]
    if ranks.is_first:
        torch.save(after, folder / "sparse-step.pt")


def save_again(run, out):
    """What a training that has just been resumed would write."""
    run.out, before = out, run.out
    out.mkdir(exist_ok=True)
    run.save()
    run.out = before


def redistribute(trainer, folder):
    """All rows to one rank, some to each, none to the first, and back."""
    ranks = trainer.ranks
    counts = ranks.exchange(len(trainer.gaussians.means))
    total = sum(counts)
    before, seen = state_rows(trainer), []
    for after in ([0, total, 0], [total - 2, 1, 1], [0, 5, total - 5], counts):
        trainer._redistribute(ranks.exchange(len(trainer.gaussians.means)), after)
        seen.append((len(trainer.gaussians.means), after[ranks.rank], len(trainer.density.gradient_sums)))
    torch.save((before, state_rows(trainer), seen), folder / f"redistributed-{ranks.rank}.pt")


def state_rows(trainer):
    """Parameters and moments of this rank."""
    rows = [field.detach().clone() for field in trainer.gaussians]
    return rows + [trainer.optimizer.state[f][m].clone() for f in trainer.gaussians for m in MOMENTS]


def outside_of_float32(run, folder):
    """Gaussians of one rank that go, and then all of its that are most of what there is; what each rank says of it."""
    trainer, broken = run.trainer, run.ranks.rank == 1
    before, own, said = trainer.count, len(trainer.gaussians.means), []
    with torch.no_grad():
        trainer.gaussians.means[: 3 if broken else 0] = math.nan
    trainer.check()
    said += [before - trainer.count, own - len(trainer.gaussians.means), trainer.dropped, trainer.warnings[-1]]
    with torch.no_grad():
        trainer.gaussians.shs[: own if run.ranks.rank else 0] = math.inf
    try:
        trainer.check()
    except FloatingPointError as error:
        said.append(str(error))
    with torch.no_grad():
        trainer.gaussians.shs.clamp_(-1, 1)
    (folder / f"outside-{run.ranks.rank}.json").write_text(json.dumps(said))


def not_finite(run, folder):
    """A loss that is NaN on one rank: what each of them raises."""
    trainer, broken = run.trainer, run.ranks.rank == 1
    trainer.progress.steps = None
    differentiated = sharded._rows_picture_gradients

    def without_loss(**arguments):
        loss, *rest = differentiated(**arguments)
        return (loss * math.nan if broken else loss), *rest

    with mock.patch.object(sharded, "_rows_picture_gradients", without_loss):
        trainer.step()
    found = "nothing"
    try:
        trainer.take_losses()
    except FloatingPointError as error:
        found = str(error)
    (folder / f"not-finite-{run.ranks.rank}.txt").write_text(found)


def wait_in_vain(group, folder):
    # Not new_group's own time-out: within that the ranks would have to find each other too, however busy the machine.
    distributed_c10d._set_pg_timeout(datetime.timedelta(seconds=1), group)
    try:
        Ranks.of_group(group).exchange(None)
    except RuntimeError as error:
        (folder / "late.txt").write_text(str(error))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder into which the processes have written."""
    folder = tmp_path_factory.mktemp("ranks")
    write_nerf_synthetic(folder / "scene", circle(7), circle(4))
    start_processes(work, (WORLD, folder), WORLD)
    return folder


def checkpoint_in(folder):
    return files.read_checkpoint(folder / files.CHECKPOINT)


def assert_same(one, other, but=()):
    """Nested dictionaries and lists with the same bits in them."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() - set(but) == other.keys() - set(but)
        for key in one.keys() - set(but):
            assert_same(one[key], other[key], but)
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other):
            assert_same(a, b, but)
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    else:
        assert one == other


# --- training ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VARIANTS)
def test_resumed_on_as_many_ranks_gives_the_same_bits(made, name):
    whole, part = (checkpoint_in(made / name / kind) for kind in ("whole", "part"))
    assert whole["progress"]["step"] == STEPS and len(whole["gaussians"]["means"]) != COMMON["random_points"]
    assert_same(whole, part, but=("seconds", "history", "measured"))
    assert (made / name / "whole" / files.SCENE).read_bytes() == (made / name / "part" / files.SCENE).read_bytes()


@pytest.mark.parametrize("name", VARIANTS)
def test_gaussians_are_spread_evenly_and_stay_within_the_limit(made, name):
    state = checkpoint_in(made / name / "whole")
    total = len(state["gaussians"]["means"])
    assert sum(state["shards"]) == total and max(state["shards"]) * len(state["shards"]) <= UNEVEN * total
    assert total <= (COMMON | VARIANTS[name])["max_gaussians"]


def test_what_no_picture_of_any_rank_counts_is_pruned(made):
    """A third, which `scatter` has moved to where no picture shows it, and all that masks leave out."""
    for name in VARIANTS:
        counting = checkpoint_in(made / name / "whole")["counting"]
        assert (counting is not None) == (name == "masked")
    state = checkpoint_in(made / "masked" / "whole")
    assert state["counting"]["pruned"] >= COMMON["random_points"] / 3
    assert len(state["counting"]["counted"]) == len(state["gaussians"]["means"])
    assert state["gaussians"]["means"][:, 1].max() < 40


def test_two_ranks_then_one_then_three(made):
    """Each goes on from what the one before wrote, all of it."""
    for written, read, step in (("2", "1", BREAKS[0]), ("1", "3", BREAKS[1])):
        before, after = (checkpoint_in(made / f"chain-{name}") for name in (f"by-{written}", f"read-by-{read}"))
        assert before["progress"]["step"] == step and before["density"]["gradient_sums"].sum() > 0
        assert before["density"]["first_count"] == COMMON["random_points"]  # of all ranks
        assert {of_field["step"] for of_field in before["optimizer"]["state"].values()} == {step}
        assert [len(state.get("shards", "1")) for state in (before, after)] == [int(written), int(read)]
        assert_same(before, after, but=("shards",))
    final = checkpoint_in(made / "chain")
    assert final["progress"]["step"] == STEPS and final["progress"]["share"] == 1 and len(final["shards"]) == 3


def test_gradients_are_those_of_one_process(made):
    """A sum over two cameras has one rounding, whatever its order; the rest is the same arithmetic."""
    got = torch.load(made / "gradients.pt")
    one = sharded_alone(made)
    loss, seen, _ = differentiate_alone(one)
    # A rounding for each part of the sum, and one for each part's division.
    assert loss.item() == pytest.approx(got["loss"], rel=4 * torch.finfo(torch.float32).eps)
    for name, field in one.gaussians._asdict().items():
        assert torch.equal(field.grad, got[name]), name
        assert field.grad.abs().max() > 0 or name == "rotations"  # of balls
    one._observe(seen)
    # The mean over two pictures has half the gradient of each.
    torch.testing.assert_close(2 * one.density.gradient_sums, got["sums"])
    optimizer_of_two(one).step()
    for name, field, after in zip(Gaussians._fields, one.gaussians, got["after"]):
        assert torch.equal(field, after), name


def sharded_alone(made, **more):
    """One process that takes the pictures of two in a step."""
    run = make_run(made / "scene", made / "one", ALONE, pictures_per_step=CAMERAS, **more)
    start = run.trainer.gaussians.map(torch.Tensor.detach)
    one = ShardedTrainer(run.options, start, run.trainer.pictures, (1.0, 1.0, 1.0), "cpu", ALONE)
    one._set_rates()
    return one


def differentiate_alone(one):
    """What `_differentiate_together` returns, by autograd in one process."""
    pictures, gaussians = one._next(), one.gaussians.arguments()
    batch = distributed.rasterize([p.settings for p in pictures], **gaussians, means2d_abs=True)
    losses = []
    for shown, of_camera in zip(pictures, batch.renderings, strict=True):
        losses.append(l1_ssim(of_camera.image, one.pictures.target(*shown[:2], None), one.options.ssim_weight))
    loss = sum(of_picture / len(losses) for of_picture in losses)
    loss.backward()
    seen = []
    for splats, absolute in zip(batch.shard, batch.means2d_abs):
        gradient = absolute.grad if one.options.density == "absgrad" else splats.means2d.grad
        seen.append(Seen(splats.gaussian_ids, gradient, (splats.width, splats.height)))
    return loss.detach(), seen, one._visible(batch.shard)


def optimizer_of_two(one):
    """An optimizer of its Gaussians with the rates of two ranks."""
    rates = [2**0.5 * group["lr"] for group in one.optimizer.param_groups]
    groups = [{"params": [field], "lr": rate} for field, rate in zip(one.gaussians, rates)]
    groups[-1] |= {"head": 1, "head_lr": 2**0.5 * one.optimizer.param_groups[-1]["head_lr"]}
    return FusedAdam(groups, betas=(0.9**2, 0.999**2), eps=1e-15)


def test_a_sparse_step_updates_what_a_picture_of_any_rank_shows(made):
    one = sharded_alone(made, sparse_adam=True)
    scatter(one.gaussians)
    shown, optimizer = rows_shown(one), optimizer_of_two(one)
    _, _, rows = differentiate_alone(one)
    assert torch.equal(rows, shown[0] | shown[1]) and not torch.equal(*shown) and 0 < rows.sum() < len(rows)
    optimizer.step(rows=rows)
    expected = [*one.gaussians, *(optimizer.state[field][moment] for field in one.gaussians for moment in MOMENTS)]
    for field, after in zip(expected, torch.load(made / "sparse-step.pt"), strict=True):
        assert torch.equal(field, after)


def test_evaluation_is_that_of_one_process(made):
    """Images of several ranks have the bits of one, and so have the measures of each view."""
    metrics = json.loads((made / "metrics.json").read_text())
    assert metrics == json.loads((made / "chain" / files.METRICS).read_text())  # of rank 2, and what rank 0 wrote
    alone = make_run(made / "scene", made / "chain", ALONE, resume=True)
    pictures = training.load_pictures(alone.capture.test, (1, 2), (1.0, 1.0, 1.0), "cpu")
    expected = training.evaluate(alone.trainer.scene(), pictures, alone.options.footprint, color_corrected=True)
    assert metrics["test"] == expected and len(expected["1"]["views"]) == 4


def test_moved_rows_keep_their_order(made):
    parts = [torch.load(made / f"redistributed-{rank}.pt") for rank in range(WORLD)]
    for before, after, seen in parts:
        assert all(torch.equal(a, b) for a, b in zip(before, after))
        assert all(count == expected == sums for count, expected, sums in seen)


def test_a_loss_that_is_not_finite_on_one_rank_ends_all(made):
    found = {(made / f"not-finite-{rank}.txt").read_text() for rank in range(WORLD)}
    assert found == {f"the loss of step {STEPS + WORLD} is nan; lower learning rates may help"}


def test_gaussians_outside_of_float32_on_one_rank_are_those_of_all(made):
    of_ranks = [json.loads((made / f"outside-{rank}.json").read_text()) for rank in range(WORLD)]
    assert [lost for lost, *_ in of_ranks] == [3] * WORLD and [own for _, own, *_ in of_ranks] == [0, 3, 0]
    assert all(said[2] == 3 and said[3:] == of_ranks[0][3:] for said in of_ranks)
    _, _, _, warning, error = of_ranks[0]
    assert warning.startswith("3 of ") and "means outside of float32" in warning
    assert "shs outside of float32" in error and error.endswith("a lower --color-rate may help")


def test_a_rank_that_does_not_answer_is_named_as_a_time_out(made):
    said = (made / "late.txt").read_text()
    assert launch._reason(said, 1) == "time-out: another rank did not answer for 1 s (--rank-timeout)"


# --- parts ------------------------------------------------------------------------------------------


def test_what_is_allowed_is_divided_by_what_is_wanted():
    def shares(limit, rows):
        ranks = [Ranks(rank, len(rows)) for rank in range(len(rows))]
        with mock.patch.object(Ranks, "exchange", lambda self, value: rows):
            return [r.allowed(limit, *row) for r, row in zip(ranks, rows)]

    assert shares(100, [(10, 5), (20, 0), (30, 7)]) == [5, 0, 7]  # there is room for all
    assert sum(shares(66, [(10, 5), (20, 0), (30, 7)])) == 6
    assert shares(60, [(10, 5), (20, 3), (30, 7)]) == [0, 0, 0]
    assert shares(10, [(10, 5), (20, 3), (30, 7)]) == [0, 0, 0]
    assert shares(100, [(0, 0), (1, 0)]) == [0, 0]
    for limit in range(60, 80):
        got = shares(limit, [(10, 5), (20, 3), (30, 7)])
        assert sum(got) == min(limit - 60, 15) and all(0 <= g <= w for g, w in zip(got, (5, 3, 7)))
    assert [ALONE.allowed(limit, 10, 5) for limit in (8, 12, 20)] == [0, 2, 5]


def test_even_counts():
    assert even_counts(10, 3) == [3, 3, 4] and even_counts(2, 3) == [0, 1, 1] and even_counts(0, 2) == [0, 0]


@pytest.mark.parametrize("stride", [1, 2, 3, 7])
def test_periods_are_passed_once_for_each_multiple(stride):
    ends = range(stride, 100 * stride, stride)
    assert [step for step in ends if schedule.passes(step, 5, stride)] == sorted(
        {math.ceil(k / stride) * stride for k in range(5, 99 * stride + 1, 5)} & set(ends)
    )
    progress = schedule.Progress(10, None)
    progress.advance(stride)
    assert (progress.step, progress.passed(5)) == (stride, stride >= 5)


# --- the command ------------------------------------------------------------------------------------


def command(scene, out, *options):
    return ["train", str(scene), "--out", str(out), "--device", "cpu", "--random-points", "60", *options]


def torchrun(scene, out, *options):
    """`train` on two processes."""
    program = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    program += ["-m", "analytic_rasterizer", *command(scene, out, *options)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": python_path()}
    return subprocess.run(program, capture_output=True, text=True, timeout=DEADLINE, env=environment, cwd=out.parent)


def as_torchrun_starts(program, *arguments):
    """What two processes make of a program, each as `run_program` says it, where torchrun would have started them."""
    store = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # as torchrun has one
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": python_path(), "WORLD_SIZE": "2"}
    environment |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port)}
    environment |= {"TORCHELASTIC_RUN_ID": "none", "TORCHELASTIC_USE_AGENT_STORE": "True"}
    done = [None, None]

    def run(rank):
        done[rank] = run_program(program, *arguments, environment=environment | {"RANK": str(rank)})

    in_threads(2, run)
    return done


COUNT_THREADS = """
        import contextlib, pathlib

        def threads_of_group():
            names = []
            for path in pathlib.Path("/proc/self/task").glob("*/comm"):
                with contextlib.suppress(OSError):  # it has ended meanwhile
                    names.append(path.read_text())
            return sum("gloo" in name for name in names)
"""


def test_nothing_of_a_process_group_outlives_it():
    """A thread of it that is left may abort the process when Python ends."""
    program = f"""{COUNT_THREADS}
        import argparse, importlib
        from analytic_rasterizer.cli.launch import ranks_of

        with ranks_of(argparse.Namespace(rank_timeout=60.0, device="cpu")) as ranks:
            assert ranks.exchange(ranks.rank) == [0, 1]
            importlib.import_module("torch.distributed.nn.functional")  # which longer programs do at some time
            print(threads_of_group() > 0)
        assert threads_of_group() == 0
    """
    done = as_torchrun_starts(program)
    assert [of_rank.returncode for of_rank in done] == [0, 0], done
    if any("False" in of_rank.stdout for of_rank in done):
        pytest.skip("this version of torch gives the threads of a group other names")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_nothing_of_a_process_group_outlives_an_interrupted_training(made, tmp_path, name):
    program = f"""{COUNT_THREADS}
        import signal, sys
        from analytic_rasterizer import cli
        from analytic_rasterizer.training import sharded

        step = sharded.ShardedTrainer.step

        def interrupted(trainer):
            step(trainer)
            if trainer.progress.step >= 6 and trainer.ranks.rank == 1:
                signal.raise_signal(signal.{name})

        sharded.ShardedTrainer.step = interrupted
        code = cli.main(sys.argv[1:])
        assert threads_of_group() == 0
        sys.exit(code)
    """
    done = as_torchrun_starts(program, *command(made / "scene", tmp_path / "out", "--iterations", "30"))
    assert [of_rank.returncode for of_rank in done] == [130, 130], done
    assert 0 < checkpoint_in(tmp_path / "out")["progress"]["step"] < 30


def test_torchrun_trains_and_writes_once(made, tmp_path):
    """And what it trains is nearer to the pictures than what it starts from."""
    done = torchrun(made / "scene", tmp_path / "out", "--iterations", "121", "--sh-degree", "0", "--export", "mip")
    assert done.returncode == 0, done.stderr[-4000:]
    lines = done.stdout.splitlines()
    assert lines[0] == f"{tmp_path / 'out' / files.SCENE}: 60 Gaussians"
    starts = [line.split(",")[0].split(":")[0] for line in lines]
    assert starts.count("test") == 2 and starts[-1].startswith("the number after the best affine colour")
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {files.SCENE, files.MIP_SCENE, files.CAMERAS, files.METRICS, files.LOG, files.OPTIONS} < written
    state = checkpoint_in(tmp_path / "out")
    assert state["progress"]["step"] == 121 and state["shards"] == [30, 30]
    test = training.load_pictures(training.load_capture(made / "scene").test, (1,), (1.0, 1.0, 1.0), "cpu")
    start = Gaussians.from_points(*random_points(60, 0), 0)
    before = training.evaluate(start, test, TrainingOptions().footprint)["mean"]["psnr"]
    after = json.loads((tmp_path / "out" / files.METRICS).read_text())["test"]["mean"]["psnr"]
    assert after > before + 2


@pytest.mark.parametrize("end", ["raise RuntimeError('CUDA is out of memory')", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_a_rank_that_dies_ends_all_with_one_message(made, tmp_path, end):
    """Without torchrun, which would end the others itself: they find out."""
    program = f"""
        import os, signal, sys
        from analytic_rasterizer import cli
        from analytic_rasterizer.cli import launch
        from analytic_rasterizer.training import sharded

        launch.STORE_TIMEOUT = 600  # s: on a busy machine too the message is counted
        step = sharded.ShardedTrainer.step

        def broken(trainer):
            if trainer.progress.step >= 6 and trainer.ranks.rank == 1:
                {end}
            step(trainer)

        sharded.ShardedTrainer.step = broken
        sys.exit(cli.main(sys.argv[1:]))
    """
    arguments = command(made / "scene", tmp_path / "out", "--iterations", "30")
    done = as_torchrun_starts(program, *arguments)
    assert all(of_rank.returncode != 0 for of_rank in done)
    messages = [line for of_rank in done for line in of_rank.stderr.splitlines() if line.startswith("error: ")]
    assert len(messages) == 1
    if "KILL" in end:
        assert messages[0].startswith("error: on rank 0: another rank is gone")
    else:
        assert messages[0] == "error: on rank 1: CUDA is out of memory"
    assert not any("Traceback" in of_rank.stderr for of_rank in done)
    assert not (tmp_path / "out" / files.CHECKPOINT).exists()
