"""Gaussians that are sharded over ranks make the pictures of one rank bit for bit, and its gradients to rounding.

One set of processes runs every scenario, of as many ranks as it says, and leaves its results in files, for starting a
process takes seconds. On the CPU they talk through gloo, on CUDA through NCCL, with a device for each.
"""

import dataclasses
import datetime
from unittest import mock

import pytest
import scenes
import torch
import torch.distributed as dist
from marks import needs_cuda
from processes import DEADLINE, start_processes
from scenes import Camera
from torch.distributed import distributed_c10d

import analytic_rasterizer as ar
from analytic_rasterizer import _C, distributed
from analytic_rasterizer.cli import launch
from analytic_rasterizer.distributed import agreement
from analytic_rasterizer.distributed.exchange import Route
from analytic_rasterizer.distributed.rows import Shard, together
from analytic_rasterizer.losses import l1_ssim

WORLD = 3
COUNT, HIDDEN = 60, slice(37, 46)
CAMERAS = (
    (Camera(image_width=27, image_height=21, bg=(0.1, 0.3, 0.2)), "box:samples=4"),
    (Camera(image_width=40, image_height=17, eye=(1.5, 0.4, -3.2)), "analytic"),
    (Camera(image_width=18, image_height=33, tanfovx=0.3, bg=(0.5, 0.0, 1.0)), "box:samples=16"),
    (Camera(image_width=27, image_height=21, eye=(-1.1, 0.2, -4.5)), "cumulant"),
    # This one is projected together with the first.
    (Camera(image_width=27, image_height=21, eye=(0.9, 0.5, -3.6)), "box:samples=4"),
    (Camera(image_width=31, image_height=18, eye=(9, 0, 0), target=(18, 0, 0), bg=(0.2, 0.7, 0.4)), "moment:samples=4"),
)
UNSEEING = 5  # of these cameras: it looks away from all Gaussians


@dataclasses.dataclass(frozen=True)
class Scenario:
    """How a scene of `COUNT` Gaussians is spread over ranks; cameras by their place in `CAMERAS`."""

    shards: tuple
    cameras: tuple = (0, 1, 2, 3)
    owners: tuple | None = None
    dtype: torch.dtype = torch.float32
    frozen: tuple = ()  # ranks whose Gaussians require no gradient; with one of them cameras require none either
    means2d_abs: bool = True

    @property
    def ranks(self):
        return len(self.shards)

    @property
    def trains(self):
        """Whether any Gaussian has a gradient that is not zero."""
        return len(self.frozen) < self.ranks and self.cameras != (UNSEEING,)


SCENARIOS = {
    "one-rank": Scenario((60,)),
    "two-ranks": Scenario((41, 19)),
    "two-ranks-float64": Scenario((19, 41), dtype=torch.float64),
    "two-ranks-one-without-gradient": Scenario((30, 30), frozen=(0,), means2d_abs=False),
    "two-ranks-one-without-camera": Scenario((30, 30), cameras=(1,)),
    "two-ranks-cameras-projected-together": Scenario((23, 37), cameras=(0, 1, 4), owners=(1, 0, 1)),
    "two-ranks-one-camera-sees-nothing": Scenario((41, 19), cameras=(UNSEEING, 1)),
    "two-ranks-no-camera-sees-anything": Scenario((41, 19), cameras=(UNSEEING,), owners=(1,)),
    "two-ranks-only-backgrounds-have-gradients": Scenario((30, 30), cameras=(1,), frozen=(0, 1), means2d_abs=False),
    "three-ranks-one-unseen": Scenario((37, 9, 14)),
    "three-ranks-one-empty": Scenario((0, 45, 15), owners=(2, 0, 0, 2)),
}


def scene_of(dtype, device):
    """Gaussians of which every one has a twin of equal depth far away in the input, and some that no camera sees."""
    scene = scenes.random_scene(7, COUNT, degree=1, opacity=(0.2, 0.95))
    del scene["means2D"]
    scene["means3D"][COUNT // 2 :] = scene["means3D"][: COUNT // 2].flip(0)
    scene["means3D"][HIDDEN, 2] = -50
    return scenes.cast(scene, dtype, device)


def shard_of_rank(scenario, rank, scene):
    """The rows of a rank."""
    first = sum(scenario.shards[:rank])
    return {name: value[first : first + scenario.shards[rank]] for name, value in scene.items()}


def settings_of(scenario, device):
    cameras = [CAMERAS[k] for k in scenario.cameras]
    return [
        dataclasses.replace(camera, sh_degree=1).settings(scenario.dtype, device, footprint=footprint)
        for camera, footprint in cameras
    ]


def with_camera_gradients(settings, requires_grad=True):
    """The same with leaves for backgrounds, and for view matrices that may require gradients; and these."""
    views = [s.viewmatrix.clone().requires_grad_(requires_grad) for s in settings]
    bgs = [s.bg.clone().requires_grad_() for s in settings]
    return [s._replace(viewmatrix=v, bg=b) for s, v, b in zip(settings, views, bgs)], views, bgs


def weighted(image, alpha):
    """A loss in which every pixel counts differently."""
    generator = torch.Generator().manual_seed(5)
    return sum((t * torch.rand(t.shape, generator=generator).to(t)).sum() for t in (image, alpha))


def or_zero(gradient, like):
    return torch.zeros_like(like) if gradient is None else gradient


def make(scenario, scene, settings, group=None, requires_grad=True):
    """What a rank makes of its shard, by name."""
    settings, views, bgs = with_camera_gradients(settings, not scenario.frozen)
    leaves = {name: value.detach().clone().requires_grad_(requires_grad) for name, value in scene.items()}
    batch = distributed.rasterize(
        settings, **leaves, owners=scenario.owners, means2d_abs=scenario.means2d_abs, group=group
    )
    (batch.anchor + sum(weighted(view.image, view.alpha) for view in batch.renderings)).backward()
    return {
        "cameras": [view.camera for view in batch.renderings],
        "images": [view.image.detach() for view in batch.renderings],
        "alphas": [view.alpha.detach() for view in batch.renderings],
        "gaussian_ids": [view.splats.gaussian_ids for view in batch.renderings],
        "bg": [bgs[view.camera].grad for view in batch.renderings],
        "views": [or_zero(v.grad, v) for v in views],
        "gradients": {name: or_zero(leaf.grad, leaf) for name, leaf in leaves.items()},
        "ids": [s.gaussian_ids + batch.first_id for s in batch.shard],
        "radii": [s.radii for s in batch.shard],
        "means2d": [or_zero(s.means2d.grad, s.means2d) for s in batch.shard],
        "absolute": [t.grad for t in batch.means2d_abs],
        "count": batch.count,
    }


def plain(scenario, scene, settings):
    """The same of all Gaussians by `project`, `list_tiles` and `blend`; and the gradients of each camera alone."""
    settings, views, bgs = with_camera_gradients(settings, not scenario.frozen)
    leaves = scenes.leaves(scene)
    made = {name: [] for name in ("images", "alphas", "losses", "absolute", "ids", "radii")}
    shard = [ar.project(s, **leaves) for s in settings]
    for s, splats in zip(settings, shard):
        splats.means2d.retain_grad()
        absolute = torch.zeros_like(splats.means2d, requires_grad=True)
        lists = ar.list_tiles(splats)
        image, alpha = ar.blend(splats, lists, background=s.bg, means2d_abs=absolute)
        row = image[0].detach(), alpha[0].detach(), weighted(image[0], alpha[0]), absolute
        for name, value in zip(made, (*row, splats.gaussian_ids, splats.radii)):
            made[name].append(value)
    losses = made.pop("losses")
    of_cameras = [torch.autograd.grad(loss, list(leaves.values()), retain_graph=True) for loss in losses]
    for leaf in (*leaves.values(), *made["absolute"], *(s.means2d for s in shard), *views, *bgs):
        leaf.grad = None
    sum(losses).backward()
    return made | {
        "gradients": {name: leaf.grad for name, leaf in leaves.items()},
        "magnitudes": {name: sum(g[k].abs() for g in of_cameras) for k, name in enumerate(leaves)},
        "means2d": [s.means2d.grad for s in shard],
        "absolute": [t.grad for t in made["absolute"]],
        "views": [or_zero(v.grad, v) for v in views],
        "bg": [b.grad for b in bgs],
    }


# --- the processes ----------------------------------------------------------------------------------


def error_of(call):
    try:
        call()
    except Exception as error:
        return type(error).__name__, str(error)
    return None


def mistakes(rank, device):
    """What a rank of two raises where rank 1, or each, is given something wrong."""
    scenario = SCENARIOS["two-ranks"]
    scene = {name: value[rank::2] for name, value in scene_of(scenario.dtype, device).items()}
    settings = settings_of(scenario, device)

    def call(change=None, cameras=settings, **more):
        arguments = scene | more
        if rank == 1:
            arguments |= change or {}
        cameras = arguments.pop("settings", cameras)
        return lambda: distributed.rasterize(cameras, **arguments, group=GROUPS[2])

    moving = settings[3]._replace(viewmatrix=settings[3].viewmatrix.clone().requires_grad_())
    first, last = (s._replace(viewmatrix=o.viewmatrix) for s, o in zip(settings[::3], settings[::-3]))
    other_view = settings[3]._replace(viewmatrix=settings[3].viewmatrix + 1e-6)
    found = {
        "shape": error_of(call({"means3D": torch.zeros(5, 2, device=device)})),
        "tensor": error_of(call({"opacities": None})),
        "no cameras": error_of(call({"settings": []})),
        "cameras": error_of(call({"settings": settings[:3]})),
        "matrix": error_of(call({"settings": [*settings[:3], other_view]})),
        "camera gradients": error_of(call({"settings": [*settings[:3], moving]})),
        "owners": error_of(call(owners=(0, 1, 2, 0))),
        "other owners": error_of(call({"owners": (0, 0, 0, 0)})),
        "colors": error_of(call({"shs": None})),
        "bg": error_of(call({"settings": [s._replace(bg=torch.zeros(4, device=device)) for s in settings]})),
        "auto": error_of(call(cameras=[s._replace(effects="auto") for s in settings])),
        "swapped": error_of(call({"settings": [first, *settings[1:3], last]})),
        "effects": error_of(call({"settings": with_nears(settings, reversed(NEARS))}, with_nears(settings, NEARS))),
    }
    if device == "cpu":
        double = dataclasses.replace(scenario, dtype=torch.float64)
        found["dtype"] = error_of(
            call({"settings": settings_of(double, device)} | {name: value.double() for name, value in scene.items()})
        )
    with torch.set_grad_enabled(rank == 0):
        found["grad"] = error_of(call())
    return found


NEARS = (0.2, 0.4, 0.2, 0.6)


def with_nears(settings, nears):
    """Cameras that cull up to such depths; those of one depth share their effects."""
    effects = {near: ar.Effects(near=near) for near in NEARS}
    return [s._replace(effects=effects[near]) for s, near in zip(settings, nears)]


class Guess(dict):
    """In the place of `Shard._guesses`: the same guess for whatever is rendered."""

    def __init__(self, *guess):
        super().__init__()
        self.guess = guess

    def get(self, *_):
        return self.guess


def guessed(guess, arguments):
    """What a rank makes that guesses so much room and such a first id, and how often it writes rows."""
    write = mock.patch.object(Shard, "_write", autospec=True, side_effect=Shard._write)
    with mock.patch.object(Shard, "_guesses", guess), write as writes:
        made = make(*arguments)
    return made, writes.call_count


class Full:
    """In the place of `Shard._write` of a rank that has no memory, the first `times` it is asked to write rows."""

    def __init__(self, times):
        self.left, self.write = times, Shard._write

    def __call__(self, shard, *arguments):
        self.left -= 1
        if self.left >= 0:
            raise RuntimeError("rows do not fit")
        return self.write(shard, *arguments)


def without_memory(rank, device, late):
    """What each rank of two makes, or raises, where rank 1 fails while the message is on its way."""
    scenario = SCENARIOS["two-ranks"]
    first, scene = sum(scenario.shards[:rank]), shard_of_rank(scenario, rank, scene_of(scenario.dtype, device))
    settings = settings_of(scenario, device)

    def call(times, group=GROUPS[2], change=None):
        full = Full(times if rank == 1 else 0)
        write = mock.patch.object(Shard, "_write", lambda *arguments: full(*arguments))
        with mock.patch.object(Shard, "_guesses", Guess(COUNT, first)), write:
            return make(scenario, scene | (change or {}), settings, group)

    found = {"while guessing": call(1)}
    wrong = {"means3D": torch.zeros(5, 2, device=device)} if rank == 0 else {}
    found["another rank has raised"] = error_of(lambda: call(1, change=wrong))
    if device == "cpu":  # NCCL ends the process that waits in vain
        send = Route.send

        def send_in_vain(*arguments):
            # Not new_group's own time-out: within that the ranks would have to agree too, however busy the machine.
            distributed_c10d._set_pg_timeout(datetime.timedelta(seconds=1), late)
            return send(*arguments)

        with mock.patch.object(Route, "send", send_in_vain):
            found["for good"] = error_of(lambda: call(2, late))
    return found


SHARING = dataclasses.replace(SCENARIOS["two-ranks"], cameras=(0, 1, 4, 3))


def equal_effects(rank, device):
    """Settings that are the same on both ranks, where cameras share their effects on one of them only.

    There the first and the third are projected together.
    """
    scenario, scene = SHARING, shard_of_rank(SHARING, rank, scene_of(SHARING.dtype, device))
    settings = with_nears(settings_of(scenario, device), NEARS)
    if rank == 1:
        settings = [s._replace(effects=dataclasses.replace(s.effects)) for s in settings]
    return make(scenario, scene, settings, GROUPS[2])


GROUPS = {}  # of this process, by number of ranks


def work(rank, world, folder, kind):
    """What a process does: every scenario in which it takes part."""
    torch.set_num_threads(1)
    device = kind
    if kind == "cuda":
        device = f"cuda:{rank}"
        torch.cuda.set_device(device)
    dist.init_process_group(
        "gloo" if kind == "cpu" else "nccl",
        init_method=f"file://{folder}/rendezvous",
        rank=rank,
        world_size=world,
        timeout=datetime.timedelta(seconds=DEADLINE / 2),
    )
    # The last processes, so that a rank in the group is not that in the world.
    GROUPS.update({ranks: dist.new_group(list(range(world - ranks, world))) for ranks in range(1, world)})
    GROUPS[world] = None
    late = dist.new_group([world - 2, world - 1])
    for name, scenario in scenarios_of(kind, world).items():
        place = rank - (world - scenario.ranks)
        if place < 0:
            continue
        scene = shard_of_rank(scenario, place, scene_of(scenario.dtype, device))
        arguments = scenario, scene, settings_of(scenario, device), GROUPS[scenario.ranks], place not in scenario.frozen
        with mock.patch.object(dist, "all_to_all_single", wraps=dist.all_to_all_single) as calls:
            made = make(*arguments)
        made["sent"] = [call.args[1].nbytes for call in calls.call_args_list]
        with mock.patch.object(agreement, "_ROOM", 9):  # the counts of two cameras; those of others follow
            again = make(*arguments)
        guesses = {name: Guess(*guess) for name, guess in guesses_of(sum(scenario.shards[:place])).items()}
        by_guess = {name: guessed(guess, arguments) for name, guess in guesses.items()}
        torch.save((made, again, by_guess), f"{folder}/{name}-{place}.pt")
    if rank >= world - 2:
        place = rank - (world - 2)
        for make_it in (mistakes, not_finite, equal_effects, twice):
            torch.save(make_it(place, device), f"{folder}/{make_it.__name__}-{place}.pt")
        torch.save(without_memory(place, device, late), f"{folder}/without_memory-{place}.pt")
    if rank == world - 1:
        torch.save(without_sending(device), f"{folder}/silent.pt")
    else:
        torch.save(error_of(lambda: distributed.rasterize([], None, None, group=GROUPS[1])), f"{folder}/outside.pt")
    dist.barrier()
    dist.destroy_process_group()


def guesses_of(first_id):
    """Room for rows and the id of the first Gaussian, as a rank with this first id may guess them."""
    return {
        "right": (len(CAMERAS) * COUNT, first_id),
        "too little room": (3, first_id),
        "another id": (len(CAMERAS) * COUNT, first_id + 5),
    }


def scene_not_finite(scenario, device):
    """The scene, of which some Gaussians that are seen have colours that are not."""
    scene = scene_of(scenario.dtype, device)
    scene["shs"][5, 1] = float("nan")
    scene["shs"][50, 0] = float("inf")
    return scene


def not_finite(rank, device):
    scenario = SCENARIOS["two-ranks"]
    scene = shard_of_rank(scenario, rank, scene_not_finite(scenario, device))
    return make(scenario, scene, settings_of(scenario, device), GROUPS[2])


def twice(rank, device):
    """The error of a second way back."""
    scenario = SCENARIOS["two-ranks"]
    scene = scenes.leaves({name: value[rank::2] for name, value in scene_of(scenario.dtype, device).items()})
    batch = distributed.rasterize(settings_of(scenario, device), **scene, group=GROUPS[2])
    loss = batch.anchor + sum(view.image.sum() for view in batch.renderings)
    loss.backward(retain_graph=True)
    return error_of(loss.backward)


def without_sending(device):
    """Whether a group of one rank sends something."""
    scenario = SCENARIOS["one-rank"]
    calls = ("all_gather", "all_gather_object", "all_to_all_single")
    with mock.patch.multiple(dist, **{name: mock.Mock(side_effect=AssertionError(name)) for name in calls}):
        arguments = scenario, scene_of(scenario.dtype, device), settings_of(scenario, device), GROUPS[1]
        return error_of(lambda: make(*arguments))


def scenarios_of(kind, world):
    """Those that a kind of device can run with so many processes."""
    return {
        name: s for name, s in SCENARIOS.items() if s.ranks <= world and (kind == "cpu" or s.dtype == torch.float32)
    }


@dataclasses.dataclass
class Runs:
    kind: str
    world: int
    folder: object

    def load(self, name):
        return torch.load(self.folder / f"{name}.pt", map_location=self.kind)


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda", marks=needs_cuda)])
def runs(request, tmp_path_factory):
    """The folder into which the processes have written."""
    kind = request.param
    world = WORLD if kind == "cpu" else min(WORLD, torch.cuda.device_count())
    if world < 2:
        pytest.skip("needs two CUDA devices: NCCL does not put two ranks on one")
    folder = tmp_path_factory.mktemp("ranks")
    start_processes(work, (world, str(folder), kind), world)
    return Runs(kind, world, folder)


@pytest.fixture(params=SCENARIOS)
def ran(request, runs):
    """A scenario, what its ranks made, what they made again, and what one process makes without them."""
    scenario = scenarios_of(runs.kind, runs.world).get(request.param)
    if scenario is None:
        pytest.skip(f"not of {runs.kind} with {runs.world} devices")
    made, again, _ = zip(*(runs.load(f"{request.param}-{rank}") for rank in range(scenario.ranks)))
    arguments = scenario, scene_of(scenario.dtype, runs.kind), settings_of(scenario, runs.kind)
    return scenario, made, again, plain(*arguments)


# --- images and gradients ---------------------------------------------------------------------------


def test_images_are_those_of_one_rank(ran):
    """Bit for bit: Gaussians of equal depth keep the order of their global ids wherever they live."""
    scenario, made, _, expected = ran
    owners = scenario.owners or [c % scenario.ranks for c in range(len(scenario.cameras))]
    assert [rank["cameras"] for rank in made] == [
        [c for c, owner in enumerate(owners) if owner == rank] for rank in range(scenario.ranks)
    ]
    for rank in made:
        assert rank["count"] == COUNT
        for k, camera in enumerate(rank["cameras"]):
            assert torch.equal(rank["images"][k], expected["images"][camera])
            assert torch.equal(rank["alphas"][k], expected["alphas"][camera])
            assert torch.equal(rank["gaussian_ids"][k], expected["ids"][camera])
            assert torch.equal(rank["bg"][k], expected["bg"][camera])


def trained(scenario, ids):
    """Whether the ranks of Gaussians let them require a gradient."""
    ends = torch.tensor(scenario.shards).cumsum(0).to(ids.device)
    rank = torch.searchsorted(ends, ids.long(), right=True)
    return ~torch.isin(rank, torch.tensor(scenario.frozen, dtype=rank.dtype, device=ids.device))


def test_gradients_are_those_of_one_rank(ran):
    """A gradient of each camera is the same; their sum over C cameras has C - 1 roundings, in either order."""
    scenario, made, _, expected = ran
    eps = torch.finfo(scenario.dtype).eps
    for name, whole in expected["gradients"].items():
        parts = [rank["gradients"][name] for rank in made]
        given = trained(scenario, torch.arange(COUNT, device=whole.device))
        assert all((parts[rank] == 0).all() for rank in scenario.frozen)
        error = (torch.cat(parts) - whole).abs()[given]
        bound = (len(scenario.cameras) - 1) * eps * expected["magnitudes"][name][given]
        assert (error <= bound).all(), (name, (error > bound).nonzero().tolist(), (error - bound).max())
        assert whole[given].any() == scenario.trains
        if scenario.ranks == 1:
            assert torch.equal(parts[0], whole)


def camera_terms(settings, scene):
    """(P, 4, 4) the part of each Gaussian in the gradient of `weighted` with respect to viewmatrix."""
    (settings,), (view,), _ = with_camera_gradients([settings])
    splats = ar.project(settings, **scene)
    image, alpha = ar.blend(splats, ar.list_tiles(splats), background=settings.bg)
    rows = [splats.means2d, splats.cov2d, splats.opacities, splats.depths, splats.colors]
    loss = weighted(image[0], alpha[0])
    grads = torch.autograd.grad(loss, rows, retain_graph=True, materialize_grads=True)
    terms = []
    for k in range(len(splats.means2d)):
        of_row = [torch.zeros_like(grad) for grad in grads]
        for part, grad in zip(of_row, grads):
            part[k] = grad[k]
        terms.append(torch.autograd.grad(rows, view, of_row, retain_graph=True)[0])
    return torch.stack(terms)


def test_gradients_of_cameras_are_the_sum_over_ranks(ran, runs):
    """Each rank has the sum over its Gaussians: of n terms either sum has n - 1 roundings, in another order."""
    scenario, made, _, expected = ran
    if scenario.frozen:
        pytest.skip("its cameras require no gradient")
    scene, settings = scene_of(scenario.dtype, runs.kind), settings_of(scenario, runs.kind)
    for camera, whole in enumerate(expected["views"]):
        if scenario.cameras[camera] == UNSEEING:
            assert len(expected["ids"][camera]) == 0 and not any(rank["views"][camera].any() for rank in made)
            continue
        terms = camera_terms(settings[camera], scene)
        error = (sum(rank["views"][camera] for rank in made) - whole).abs()
        bound = 2 * (len(terms) - 1) * torch.finfo(scenario.dtype).eps / 2 * terms.abs().sum(0)
        assert whole.abs().max() > 0 and (error <= bound).all(), (camera, error, bound)


def test_radii_and_gradients_of_means2d_are_where_the_gaussians_are(ran):
    """What density control reads, of every camera, on the rank of the Gaussian."""
    scenario, made, _, expected = ran
    for camera in range(len(scenario.cameras)):
        given = trained(scenario, expected["ids"][camera])[:, None]
        names = ("ids", "radii", "means2d", *["absolute"] * scenario.means2d_abs)
        wanted = {name: expected[name][camera] for name in names}
        wanted["means2d"] = wanted["means2d"] * given
        for name, value in wanted.items():
            got = torch.cat([rank[name][camera] for rank in made])
            assert torch.equal(got, value), (name, camera, (got != value).nonzero().tolist(), (got - value).abs().max())
        assert expected["means2d"][camera].any() == (scenario.cameras[camera] != UNSEEING)
    if HIDDEN.start in (sum(scenario.shards[:k]) for k in range(scenario.ranks)):
        assert [len(rank["ids"][0]) for rank in made][1] == 0  # the scenario holds a rank that sends nothing


def test_a_second_run_makes_the_same_bits(ran):
    """In it the counts of most cameras do not fit the first message."""
    _, made, again, _ = ran
    for first, second in zip(made, again):
        for name, value in second.items():
            torch.testing.assert_close(first[name], value, rtol=0, atol=0)


@pytest.mark.parametrize("name", SCENARIOS)
def test_what_is_guessed_of_rows_changes_no_bit(runs, name):
    """Rows for which too little room was guessed, or another first id, are written again."""
    scenario = scenarios_of(runs.kind, runs.world).get(name)
    if scenario is None or scenario.ranks == 1:
        pytest.skip(f"not of {runs.kind} with {runs.world} devices" if scenario is None else "writes no rows")
    written_again = 0
    for rank in range(scenario.ranks):
        made, _, by_guess = runs.load(f"{name}-{rank}")
        rows_of_rank = sum(len(ids) for ids in made["ids"])
        for guess, (again, writes) in by_guess.items():
            wrong = guess == "another id" or (guess == "too little room" and rows_of_rank > 3)
            assert writes == 1 + wrong
            written_again += wrong
            for part, value in again.items():
                torch.testing.assert_close(value, made[part], rtol=0, atol=0)
    assert written_again >= scenario.ranks


def test_as_many_bytes_are_sent_as_the_documentation_says(ran):
    """docs/internals/distributed.md, "What is sent": 12 numbers forth, 9 back, 2 for absolute gradients."""
    scenario, made, _, _ = ran
    for place, rank in enumerate(made):
        forth, back = sum(len(ids) for ids in rank["ids"]), sum(len(ids) for ids in rank["gaussian_ids"])
        if place in (0, scenario.ranks - 1):  # what stays there is not sent
            stays = sum(len(rank["ids"][camera]) for camera in rank["cameras"])
            forth, back = forth - stays, back - stays
        size = 8 if scenario.dtype == torch.float64 else 4
        bytes_sent = [12 * size * forth, (11 if scenario.means2d_abs else 9) * size * back]
        assert rank["sent"] == ([] if scenario.ranks == 1 else bytes_sent)


def test_colors_that_are_not_finite(runs):
    """Such Gaussians are in no picture and have no gradient; their rows are sent."""
    scenario = SCENARIOS["two-ranks"]
    scene = scene_not_finite(scenario, runs.kind)
    made = [runs.load(f"not_finite-{rank}") for rank in range(2)]
    expected = plain(scenario, scene, settings_of(scenario, runs.kind))
    for rank in made:
        for k, camera in enumerate(rank["cameras"]):
            assert torch.equal(rank["images"][k], expected["images"][camera])
    for name, whole in expected["gradients"].items():
        found = torch.cat([rank["gradients"][name] for rank in made])
        assert found[[5, 50]].eq(0).all() and found.isfinite().all() and whole[[5, 50]].eq(0).all()
    for camera, radii in enumerate(expected["radii"]):
        found = torch.cat([rank["radii"][camera] for rank in made])
        assert len(found) == len(radii) + 2 and torch.equal(found[found > 0], radii)


def test_effects_may_be_shared_by_cameras_on_one_rank_only(runs):
    """They are compared by what they say, camera by camera."""
    scenario = SHARING
    settings = with_nears(settings_of(scenario, runs.kind), NEARS)
    expected = plain(scenario, scene_of(scenario.dtype, runs.kind), settings)
    for rank in range(2):
        made = runs.load(f"equal_effects-{rank}")
        for k, camera in enumerate(made["cameras"]):
            assert torch.equal(made["images"][k], expected["images"][camera])


def test_what_fails_while_the_message_is_on_its_way_is_done_again(runs):
    """So the ranks agree about errors, whatever one of them could not begin."""
    made = [runs.load(f"two-ranks-{rank}")[0] for rank in range(2)]
    for rank in range(2):
        found = runs.load(f"without_memory-{rank}")
        for name, value in found["while guessing"].items():
            torch.testing.assert_close(value, made[rank][name], rtol=0, atol=0)
        assert found["another rank has raised"] == ("ValueError", MISTAKES["shape"][1].replace("rank 1", "rank 0"))


def test_a_rank_that_cannot_write_its_rows_ends_the_others_by_time_out(runs):
    if runs.kind == "cuda":
        pytest.skip("NCCL ends the process that waits in vain")
    waited, raised = (runs.load(f"without_memory-{rank}")["for good"] for rank in range(2))
    assert raised == ("RuntimeError", "rows do not fit")
    assert launch._reason(waited[1], 1) == "time-out: another rank did not answer for 1 s (--rank-timeout)"


def test_the_way_back_is_taken_once(runs):
    for rank in range(2):
        kind, message = runs.load(f"twice-{rank}")
        assert kind == "RuntimeError" and "runs once" in message


OPS = ("count_rows", "pack_rows_", "pack_rows_vjp", "blend_rows", "blend_rows_vjp_", "rows_picture_gradients")


def calls_of(device, camera=0):
    """Arguments of the ops for twice such a camera of `CAMERAS`, and the rows and gradients that they make."""
    ops, scenario = torch.ops.analytic_rasterizer, dataclasses.replace(SCENARIOS["one-rank"], cameras=(camera,))
    settings = settings_of(scenario, device) * 2
    gaussians = dict.fromkeys(("colors_precomp", "cov3D_precomp")) | scene_of(scenario.dtype, device)
    own, batch = ar.stages.project_arguments(settings, **gaussians)
    arguments = own | batch
    ends = ops.count_rows(**arguments)
    n = int(ends[0, -1])
    rows = torch.zeros(2 * n, _C.ROW_WIDTH, device=device)
    radii, ids = (torch.zeros(2 * n, dtype=torch.int32, device=device) for _ in range(2))
    packed = arguments | {"rows": rows, "radii": radii, "ids": ids, "ends": ends, "first_id": 7}
    packed["firsts"] = torch.tensor([n, 0], device=device)
    ops.pack_rows_(**packed)
    places = {"firsts": [n, 0], "counts": [n, n]}
    image = {name: batch[name] for name in ("image_height", "image_width", "footprint", "option")}
    background = settings[0].bg
    blended = {"rows": rows[:n], "background": background, **image, "keep": True}
    color, alpha, saved = ops.blend_rows(**blended)
    width = _C.ROW_GRAD_WIDTHS[1]
    back = {"dL_drows": torch.zeros(n, width, device=device), "saved": saved, "needs_background": True, **image}
    back |= {"dL_dimage": torch.ones_like(color), "dL_dalpha": torch.ones_like(alpha), "background": background}
    ops.blend_rows_vjp_(**back)
    dL_drows = torch.cat([back["dL_drows"]] * 2)
    needs = [name in ("means3D", "opacities", "shs", "scales", "rotations") for name in arguments][:11]
    adjoint = arguments | {"dL_drows": dL_drows, "ids": ids, "needs": needs} | places
    target = torch.rand(color.shape, generator=torch.Generator().manual_seed(0), dtype=color.dtype).to(device)
    loss = {"target": target, "dL_dloss": target.new_tensor(0.5), "ssim_weight": 0.2, "supersampling": 1}
    picture = {"rows": rows[:n], "bg": background, "absolute": True} | loss | image
    picture |= {"exposure": None, "vignetting": None, "center": [], "mask": None}
    return dict(zip(OPS, (arguments, packed, adjoint, blended, back, picture)))


@pytest.fixture
def calls(device):
    return calls_of(device)


@pytest.mark.parametrize("camera", [camera for camera in range(len(CAMERAS)) if camera != UNSEEING])
def test_gradients_of_rows_are_those_of_blend(camera, device):
    """To the bit, though `blend` takes other kernels on CUDA: for channels in rows of their own."""
    scenario = dataclasses.replace(SCENARIOS["one-rank"], cameras=(camera,))
    (settings,) = settings_of(scenario, device)
    splats = ar.project(settings, **scene_of(scenario.dtype, device))
    names = ("means2d", "cov2d", "opacities", "colors")
    leaves = {name: getattr(splats, name).detach().clone().requires_grad_() for name in names}
    splats = dataclasses.replace(splats, **leaves)
    absolute = torch.zeros_like(splats.means2d, requires_grad=True)
    image, alpha = ar.blend(splats, ar.list_tiles(splats), background=settings.bg, means2d_abs=absolute)
    (image.sum() + alpha.sum()).backward()
    rows = calls_of(device, camera)["blend_rows_vjp_"]["dL_drows"]
    made = [leaf.grad.view(len(rows), -1) for leaf in (*leaves.values(), absolute)]
    different = (rows != torch.cat(made, 1)).nonzero().tolist()
    assert not different, (different, (rows - torch.cat(made, 1)).abs().max())
    assert all(leaf.grad.any() for leaf in leaves.values())


def test_a_picture_of_rows_has_the_gradients_of_autograd(calls):
    given, back = calls["rows_picture_gradients"], calls["blend_rows_vjp_"]
    image, _, saved = torch.ops.analytic_rasterizer.blend_rows(**calls["blend_rows"])
    image.requires_grad_()
    expected = l1_ssim(image, given["target"], given["ssim_weight"])
    (dL_dimage,) = torch.autograd.grad(expected, image, given["dL_dloss"])
    rows = torch.zeros_like(back["dL_drows"])
    torch.ops.analytic_rasterizer.blend_rows_vjp_(
        **back | {"dL_drows": rows, "dL_dimage": dL_dimage, "dL_dalpha": None, "saved": saved}
    )
    loss, shown, dL_drows = torch.ops.analytic_rasterizer.rows_picture_gradients(**given)
    assert torch.equal(loss, expected.detach()) and torch.equal(shown, image.detach())
    assert rows.any() and torch.equal(dL_drows, rows)


def test_rows_hold_what_project_returns(calls, device):
    scenario = SCENARIOS["one-rank"]
    splats = ar.project(settings_of(scenario, device)[0], **scene_of(scenario.dtype, device))
    rows, first_id = (calls["pack_rows_"][name] for name in ("rows", "first_id"))
    rows = rows[: len(splats.means2d)]
    columns = {name: rows[:, place] for name, place in _C.ROW_COLUMNS.items()}
    columns["gaussian_ids"] = columns["gaussian_ids"].view(torch.int32) - first_id
    for name, values in columns.items():
        assert torch.equal(values, getattr(splats, name)), name
    assert sum(values[:1].numel() for values in columns.values()) == _C.ROW_WIDTH


@pytest.mark.parametrize("op", OPS)
def test_opcheck(op, calls, device):
    """Schema, fake kernel, and dispatch under tracing."""
    checks = ["test_schema", "test_autograd_registration", "test_faketensor"]
    if not (device == "cuda" and op == "blend_rows"):  # there what it saves has room that nothing is written to
        checks.append("test_aot_dispatch_dynamic")
    torch.library.opcheck(getattr(torch.ops.analytic_rasterizer, op).default, (), calls[op], test_utils=checks)


@pytest.mark.parametrize(
    "op, change, message",
    [
        ("pack_rows_", {"rows": torch.zeros(3, 5)}, "rows must be a contiguous matrix of 12 columns"),
        ("pack_rows_", {"firsts": torch.zeros(2)}, r"firsts must be contiguous int64 of shape \(2,\)"),
        ("pack_rows_vjp", {"firsts": [0, 10**6]}, "firsts and counts must be places of 2 cameras among"),
        ("pack_rows_vjp", {"firsts": [0, 2**63 - 1]}, "firsts and counts must be places of 2 cameras among"),
        ("blend_rows", {"rows": torch.zeros(25)[1:].view(2, 12)}, "rows must begin at a multiple of 16 bytes"),
        ("pack_rows_", {"radii": torch.zeros(1, dtype=torch.int32)}, "radii must be contiguous int32 of shape"),
        ("pack_rows_", {"shs": None}, "shs or colors_precomp must be given, got neither"),
        ("pack_rows_", {"rows": torch.zeros(())}, "rows must be a contiguous matrix of 12 columns"),
        ("pack_rows_", {"firsts": torch.zeros(1, 2).long()}, r"firsts must be .* of shape \(2,\)"),
        ("pack_rows_vjp", {"dL_drows": torch.zeros(4, 10)}, "dL_drows must be a contiguous matrix of 9 columns"),
        ("pack_rows_vjp", {"ids": torch.zeros(4, dtype=torch.int32)}, "ids must be contiguous int32 of shape"),
        ("blend_rows", {"rows": torch.zeros(4, 12).double()}, "rows must be a contiguous matrix of 12 columns"),
        ("blend_rows", {"background": torch.zeros(4)}, r"background must have shape \(3,\)"),
        ("blend_rows_vjp_", {"saved": []}, "saved must be what blend_rows saved with keep=True, got 0 tensors"),
        ("blend_rows_vjp_", {"dL_drows": torch.zeros(4, 9)}, "dL_drows must have a row for each of"),
    ],
)
@pytest.mark.parametrize("device", ["cpu"])
def test_the_ops_say_what_is_wrong(op, change, message, calls):
    with pytest.raises(ValueError, match=message):
        getattr(torch.ops.analytic_rasterizer, op)(**calls[op] | change)


WRITTEN = {"pack_rows_": ("rows", "radii", "ids"), "blend_rows_vjp_": ("dL_drows",)}


@pytest.mark.parametrize("op", WRITTEN)
def test_autograd_notices_what_the_ops_write_to(op, calls):
    versions = [calls[op][name]._version for name in WRITTEN[op]]
    getattr(torch.ops.analytic_rasterizer, op)(**calls[op])
    assert all(calls[op][name]._version > version for name, version in zip(WRITTEN[op], versions))


def test_nothing_is_packed_where_one_camera_is_wrong(calls):
    arguments = calls["pack_rows_"]
    for name in WRITTEN["pack_rows_"]:
        arguments[name].zero_()
    tangents = [*arguments["tanfovx"][:-1], -1.0]
    with pytest.raises(ValueError, match="tanfovx must be positive and finite, got -1"):
        torch.ops.analytic_rasterizer.pack_rows_(**arguments | {"tanfovx": tangents})
    assert not any(arguments[name].any() for name in WRITTEN["pack_rows_"])


@pytest.mark.parametrize("change", [{"firsts": torch.tensor([-1000, 0])}, {"ends": None}], ids=["firsts", "ends"])
@pytest.mark.parametrize("device", ["cpu"])
def test_places_before_the_first_row_are_not_written(change, calls):
    arguments = calls["pack_rows_"] | change
    if arguments["ends"] is None:  # as if nothing had been counted
        arguments["ends"] = torch.zeros_like(calls["pack_rows_"]["ends"])
        arguments["firsts"] = torch.zeros(2, dtype=torch.int64)
    margin, around = 4096, {}
    for name in ("rows", "radii", "ids"):
        rows = arguments[name]
        around[name] = torch.full((len(rows) + 2 * margin, *rows.shape[1:]), 7, dtype=rows.dtype)
        arguments[name] = around[name][margin:-margin]
    torch.ops.analytic_rasterizer.pack_rows_(**arguments)
    for whole in around.values():
        assert whole[:margin].eq(7).all() and whole[-margin:].eq(7).all()


def shard_of(scene):
    """The rows of a scene in two cameras, and how many there are."""
    settings = settings_of(dataclasses.replace(SCENARIOS["one-rank"], cameras=(0, 1)), "cpu")
    optional = dict.fromkeys(("shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"))
    shard = Shard(together(settings, **optional | scene), [1, 0])
    return shard, int(shard.counts.sum())


def test_a_guess_of_rows_is_for_as_many_gaussians():
    """What was guessed for another scene would cost time and memory. Few guesses are kept, the last ones."""
    scene = scene_of(torch.float32, "cpu")
    scenes_of = [{name: value[:count] for name, value in scene.items()} for count in range(COUNT // 2, COUNT)]
    with mock.patch.object(Shard, "_guesses", {}):
        for of_count in scenes_of:
            shard, total = shard_of(of_count)
            shard.begin()
            assert shard._made is None
            rows, _, ids = shard.finish(total, 0)
            assert rows.shape == (total, _C.ROW_WIDTH) and len(ids) == total > 0
        assert len(Shard._guesses) < len(scenes_of)
        for of_count, known in ((scenes_of[-1], True), (scenes_of[0], False)):
            shard, total = shard_of(of_count)
            shard.begin()
            assert (shard._made is not None) == known
            if known:
                made = shard._made[0]
                assert torch.equal(shard.finish(total, 0)[0], made[:total])


def test_depths_are_equal_in_pairs():
    """The scene does ask for an order among equal depths: another order makes another picture."""
    scenario = SCENARIOS["two-ranks"]
    scene, settings = scene_of(torch.float32, "cpu"), settings_of(scenario, "cpu")[0]
    splats = ar.project(settings, **scene)
    assert len(splats.depths.unique()) < len(splats.depths)
    swapped = {name: value.roll(COUNT // 2, 0) for name, value in scene.items()}
    images = [ar.blend(s, ar.list_tiles(s))[0] for s in (splats, ar.project(settings, **swapped))]
    assert (images[0] - images[1]).abs().max() > 1e-3


# --- one rank ---------------------------------------------------------------------------------------


def one_rank(device):
    scenario = SCENARIOS["one-rank"]
    return scenario, scene_of(scenario.dtype, device), settings_of(scenario, device)


def test_one_rank_sends_nothing(runs):
    assert runs.load("silent") is None


def test_without_torch_distributed_it_is_the_plain_path(device):
    """Where no process group was made: the same bits, forward and backward."""
    scenario, scene, settings = one_rank(device)
    made, expected = make(scenario, scene, settings), plain(scenario, scene, settings)
    for name in ("images", "alphas", "ids", "radii", "means2d", "absolute", "gradients", "views", "bg"):
        torch.testing.assert_close(made[name], expected[name], rtol=0, atol=0)


def test_without_gradient(device):
    scenario, scene, settings = one_rank(device)
    with torch.no_grad():
        batch = distributed.rasterize(settings, **scene)
    assert [view.image.requires_grad for view in batch.renderings] == [False] * 4 and batch.means2d_abs == ()
    assert torch.equal(batch.renderings[1].image, plain(scenario, scene, settings)["images"][1])


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"settings": None}, TypeError, "settings must be a sequence with the settings of each camera"),
        ({"settings": []}, ValueError, "settings must hold at least one camera, got none"),
        ({"settings": [3]}, TypeError, "settings must hold GaussianRasterizationSettings, got int at 0"),
        ({"means3D": torch.zeros(5, 2)}, ValueError, r"means3D must have shape \(P, 3\), got \(5, 2\)"),
        ({"owners": [0, 0, 0, 1]}, ValueError, "owners must be ranks from 0 to 0, got 1 for camera 3"),
        ({"owners": [0]}, ValueError, "owners must hold a rank for each of 4 cameras, got 1"),
        ({"shs": None}, ValueError, "shs or colors_precomp must be given, got neither"),
        ({"shs": torch.empty(0)}, ValueError, "shs or colors_precomp must be given, got neither"),
        ({"bg": torch.zeros(3).double()}, TypeError, "bg must have dtype torch.float32, got torch.float64 of camera 0"),
        ({"bg": (0, 0, 0)}, TypeError, "bg must be a tensor, got tuple"),
        ({"viewmatrix": None}, TypeError, "viewmatrix must be a tensor, got NoneType"),
    ],
    ids=["one-camera", "none", "number", "shape", "owner", "owners", "colours", "empty", "bg", "no-bg", "no-matrix"],
)
def test_one_rank_says_what_is_wrong(change, error, message):
    scenario = SCENARIOS["one-rank"]
    settings = settings_of(scenario, "cpu")
    of_camera = {name: value for name, value in change.items() if name in settings[0]._fields}
    of_call = {name: value for name, value in change.items() if name not in of_camera}
    settings = [s._replace(**of_camera) for s in settings]
    arguments = {"settings": settings} | scene_of(scenario.dtype, "cpu") | of_call
    if arguments["settings"] is None:
        arguments["settings"] = settings[0]
    with pytest.raises(error, match=message):
        distributed.rasterize(**arguments)


# --- errors -----------------------------------------------------------------------------------------

DIFFERENCE = "got a difference between ranks 0 and 1"
OTHER_CAMERAS = ("ValueError", f"settings, owners and means2d_abs must be the same on every rank, {DIFFERENCE}")
MISTAKES = {
    "shape": ("ValueError", "on rank 1: means3D must have shape (P, 3), got (5, 2)"),
    "tensor": ("TypeError", "on rank 1: opacities must be a tensor, got NoneType"),
    "no cameras": ("ValueError", "on rank 1: settings must hold at least one camera, got none"),
    "cameras": ("ValueError", f"settings must hold as many cameras on every rank, {DIFFERENCE}: 4 and 3"),
    "matrix": OTHER_CAMERAS,
    "camera gradients": OTHER_CAMERAS,
    "owners": ("ValueError", "on rank 0: owners must be ranks from 0 to 1, got 2 for camera 2"),
    "other owners": OTHER_CAMERAS,
    "colors": ("ValueError", "on rank 1: shs or colors_precomp must be given, got neither"),
    "bg": ("ValueError", "on rank 1: bg must have shape (3,), got (4,) of camera 0"),
    "auto": ("ValueError", 'on rank 0: effects must not be "auto", which looks at all Gaussians, got it of camera 0'),
    "swapped": OTHER_CAMERAS,
    "effects": OTHER_CAMERAS,
    "dtype": (
        "ValueError",
        f"means3D must have one dtype and one kind of device on every rank, {DIFFERENCE}: "
        "torch.float32 on cpu and torch.float64 on cpu",
    ),
    "grad": ("ValueError", f"gradients must be enabled on every rank or on none, {DIFFERENCE}: 1 and 0"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_of_one_rank_raises_on_all(runs, mistake):
    """The same error, and nothing hangs."""
    if mistake == "dtype" and runs.kind == "cuda":
        pytest.skip("there is one dtype on CUDA")
    for rank in range(2):
        assert runs.load(f"mistakes-{rank}")[mistake] == MISTAKES[mistake]


def test_a_rank_outside_the_group_raises(runs):
    kind, message = runs.load("outside")
    assert kind == "ValueError" and message.startswith("group must hold this process, got one without rank ")


def test_another_default_device_changes_nothing():
    """ "meta" stands for any other device."""
    settings = [scenes.Camera(sh_degree=1).settings(torch.float32, "cpu")] * 2
    scene = scene_of(torch.float32, "cpu")
    expected = distributed.rasterize(settings, **scene).renderings
    with torch.device("meta"):
        made = distributed.rasterize(settings, **scene).renderings
    assert len(made) == len(expected) == 2
    assert all(torch.equal(a.image, b.image) for a, b in zip(made, expected))
