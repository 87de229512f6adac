"""Whole training programs for the repositories' rasterizers, written anew: the same calls, 700 steps, a tiny scene.

Other tests look at the parts. Here they meet: what a dialect returns goes into the loss and the statistics of its
repository; rows of parameters and of the optimizer's state are cloned, split and pruned; opacities are lowered; the
training is interrupted and goes on; and the scene is stored and read again.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from originals import BASE

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects, io
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.gaussians import SH_C0

pytestmark = pytest.mark.usefixtures("nothing_chosen")

STEPS, PERIOD = 700, 50  # steps in all, and between two changes of the number of Gaussians
START, MOST = 100, 260  # Gaussians
SIDE, VIEWS = 32, 6  # px, and cameras on an arc
EXTENT = 4.0  # radius of the scene, world units
MOMENTS = ("exp_avg", "exp_avg_sq")
RATES = {"means": 1.6e-3, "dc": 2.5e-3, "rest": 1.25e-4, "opacities": 0.05, "scales": 5e-3, "rotations": 1e-3}


@dataclass
class Repository:
    """What its training program does that the others do not."""

    dialect: str
    chosen: bool = False  # whether the user has to choose the dialect; the others follow from the settings
    settings: dict = field(default_factory=dict)
    exposure: bool = False  # a matrix (3, 4) per picture that its colours are multiplied with
    inverse_depth: bool = False  # whether the third result enters the loss
    filtered: bool = False  # whether Gaussians are widened by the sampling interval
    by_absolute: bool = False  # whether growth also goes by a quantile of the third column of means2D.grad
    by_index: bool = False  # what is seen: numbers of the Gaussians (n, 1), or else a mask


REPOSITORIES = {
    "3DGS 2023": Repository("gs2023"),
    "3DGS 2024": Repository("gs2024", settings={"antialiasing": False}, inverse_depth=True, by_index=True),
    "3DGS 2024, antialiasing": Repository("gs2024", settings={"antialiasing": True}, by_index=True),
    "3DGS 2024, exposure": Repository("gs2024", settings={"antialiasing": False}, exposure=True, by_index=True),
    "3DGS 2024, sparse Adam": Repository("accel", True, settings={"antialiasing": False}, by_index=True),
    "Mip-Splatting": Repository("mip", settings={"kernel_size": 0.1}, filtered=True, by_absolute=True),
    "Analytic-Splatting": Repository("analytic", True, filtered=True),
    "Analytic-Splatting, dense": Repository("analytic", True, filtered=True, by_absolute=True),
}


def seeded(seed):
    """A generator of the device that the test runs on."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)


class Camera:
    """Matrices as programs have them: transposed views of those that act on columns."""

    def __init__(self, angle):
        c, s = math.cos(angle), math.sin(angle)
        self.pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, EXTENT], [0, 0, 0, 1]])
        self.tangent = math.tan(0.4)
        self.focal = SIDE / (2 * self.tangent)
        projection = torch.zeros(4, 4)
        projection[0, 0] = projection[1, 1] = 1 / self.tangent
        projection[2, 2], projection[2, 3], projection[3, 2] = 1.0001, -0.010001, 1.0
        self.view = self.pose.T
        self.full = self.view @ projection.T
        self.center = self.view.inverse()[3, :3]
        self.depths: torch.Tensor | None = None

    def fields(self, sh_degree):
        size, tangents = (SIDE, SIDE), (self.tangent, self.tangent)
        values = *size, *tangents, torch.zeros(3), 1.0, self.view, self.full, sh_degree, self.center, False, False
        return dict(zip(BASE, values, strict=True))


def photographs(cameras, exposures=None):
    """Pictures of other Gaussians than those that a program starts from."""
    generator = seeded(8)
    points = torch.randn(150, 3, generator=generator).clamp(-1.5, 1.5) * 0.6
    colors = torch.rand(150, 3, generator=generator)
    truth = ar.Gaussians.from_points(points, colors, sh_degree=0, opacity=0.9, scale=0.6)
    pictures = []
    for number, camera in enumerate(cameras):
        settings = ar.GaussianRasterizationSettings(**camera.fields(0), footprint="box:samples=16")
        picture = ar.GaussianRasterizer(settings)(means2D=None, **truth.arguments())[0]
        # Those of an automatic camera are brighter or darker.
        pictures.append(picture * (1 + 0.3 * math.sin(number)) if exposures else picture)
    return pictures


class Program:
    """Model, optimizer and density control of a training program."""

    def __init__(self, repository):
        self.repository, self.degree, self.interval = repository, 0, None
        generator = seeded(7)
        columns = 0.8 * torch.randn(3, START, generator=generator).cpu().numpy().astype(np.float64)
        # Of a file's columns x, y and z: all x come first in memory.
        points = torch.tensor(np.vstack(list(columns)).T).float()
        assert points.stride() == (1, START)
        near = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].square().mean(1)
        harmonics = torch.zeros(START, 3, 16)
        harmonics[:, :, 0] = (torch.rand(START, 3, generator=generator) - 0.5) / SH_C0
        dc, rest = (part.transpose(1, 2).contiguous() for part in harmonics.split((1, 15), 2))
        opacities, scales = torch.full((START, 1), 0.1).logit(), near.sqrt().log()[:, None].repeat(1, 3)
        shapes = {"opacities": opacities, "scales": scales, "rotations": torch.eye(4)[:1].repeat(START, 1)}
        self.adopt({"means": points, "dc": dc, "rest": rest} | shapes)
        self.exposures = torch.nn.Parameter(torch.eye(3, 4)[None].repeat(VIEWS, 1, 1))
        self.exposure_optimizer = torch.optim.Adam([self.exposures], lr=1e-2)
        self.watch_anew()
        self.radii = torch.zeros(START)

    def adopt(self, tensors):
        """Trains these from now on, with an optimizer that has taken no step."""
        self.tensors = {name: torch.nn.Parameter(tensor.requires_grad_()) for name, tensor in tensors.items()}
        groups = [{"params": [self.tensors[name]], "lr": rate, "name": name} for name, rate in RATES.items()]
        if self.repository.dialect == "accel":
            self.optimizer = drop_in.SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
        else:
            self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)

    def watch_anew(self):
        """Begins new averages."""
        self.sums, self.absolutes, self.seen = (torch.zeros(self.count, 1) for _ in range(3))

    @property
    def count(self):
        return len(self.tensors["means"])

    def widened(self):
        """Scales and opacities, activated, with the 3D filter where the program has one."""
        scales, opacities = self.tensors["scales"].exp(), self.tensors["opacities"].sigmoid()
        if self.interval is None:
            return scales, opacities
        squares = scales.square()
        wide = squares + self.interval.square()
        return wide.sqrt(), opacities * (squares.prod(1) / wide.prod(1)).sqrt()[:, None]

    @torch.no_grad()
    def measure_intervals(self, cameras):
        """The 3D filter: 0.2 pixels^2 of the camera that is the nearest to a Gaussian, in world units."""
        depths = torch.stack([(self.tensors["means"] @ c.pose[:3, :3].T + c.pose[:3, 3])[:, 2] for c in cameras])
        self.interval = (depths.amin(0) / cameras[0].focal * math.sqrt(0.2))[:, None]

    def render(self, camera):
        """Picture, radii, the tensor that receives the gradients of projected means, and what else there is."""
        screen = torch.zeros_like(self.tensors["means"], requires_grad=True) + 0
        if screen.requires_grad:
            screen.retain_grad()
        further = dict(self.repository.settings)
        if "kernel_size" in further:
            further["subpixel_offset"] = torch.zeros(SIDE, SIDE, 2)
        settings = drop_in.GaussianRasterizationSettings(**camera.fields(self.degree), **further)
        scales, opacities = self.widened()
        dc, rest = self.tensors["dc"], self.tensors["rest"]
        colors = {"dc": dc, "shs": rest} if self.repository.dialect == "accel" else {"shs": torch.cat([dc, rest], 1)}
        arguments = {"means3D": self.tensors["means"], "means2D": screen, "opacities": opacities, "scales": scales}
        arguments |= {"rotations": torch.nn.functional.normalize(self.tensors["rotations"])}
        arguments |= colors | {"colors_precomp": None, "cov3D_precomp": None}
        picture, radii, *others = drop_in.GaussianRasterizer(raster_settings=settings)(**arguments)
        return picture, radii, screen, others

    @torch.no_grad()
    def watch(self, screen, radii):
        """Statistics of one picture."""
        seen = (radii > 0).nonzero() if self.repository.by_index else radii > 0
        self.radii[seen] = torch.max(self.radii[seen], radii[seen])
        self.sums[seen] += screen.grad[seen, :2].norm(dim=-1, keepdim=True)
        self.absolutes[seen] += screen.grad[seen, 2:].norm(dim=-1, keepdim=True)
        self.seen[seen] += 1

    def exchange(self, name, tensor, moment):
        """Another tensor in the place of a parameter; `moment` makes its moments from the old ones."""
        (group,) = [group for group in self.optimizer.param_groups if group["name"] == name]
        state = self.optimizer.state.get(group["params"][0], None)
        if state is not None:
            del self.optimizer.state[group["params"][0]]
            state.update({key: moment(state[key]) for key in MOMENTS})
        self.tensors[name] = group["params"][0] = torch.nn.Parameter(tensor.requires_grad_())
        if state is not None:
            self.optimizer.state[group["params"][0]] = state

    def append(self, rows):
        for name, new in rows.items():
            more = torch.zeros_like(new)
            self.exchange(name, torch.cat([self.tensors[name], new]), lambda old, more=more: torch.cat([old, more]))
        self.watch_anew()
        self.radii = torch.zeros(self.count)

    def select(self, kept):
        for name, old in self.tensors.items():
            self.exchange(name, old[kept], lambda moment: moment[kept])
        self.sums, self.absolutes, self.seen = self.sums[kept], self.absolutes[kept], self.seen[kept]
        self.radii = self.radii[kept]

    @torch.no_grad()
    def change_number(self, generator, by_size):
        """Clones what is small, splits what is large, and prunes."""
        signed = (self.sums / self.seen).nan_to_num(0)[:, 0]
        absolute = (self.absolutes / self.seen).nan_to_num(0)[:, 0]
        grown = signed >= 2e-4
        if self.repository.by_absolute:
            grown |= absolute >= torch.quantile(absolute, 1 - grown.float().mean())
        if self.count < MOST:
            small = self.tensors["scales"].exp().amax(1) <= 0.01 * EXTENT
            self.append({name: tensor[grown & small] for name, tensor in self.tensors.items()})
            parents = torch.zeros(self.count, dtype=torch.bool)
            parents[: len(grown)] = grown & ~small
            halves = {name: torch.cat([tensor[parents]] * 2) for name, tensor in self.tensors.items()}
            offsets = torch.normal(torch.zeros_like(halves["means"]), halves["scales"].exp(), generator=generator)
            halves["means"] += (rotation_matrices(halves["rotations"]) @ offsets[:, :, None])[:, :, 0]
            halves["scales"] -= math.log(1.6)
            self.append(halves)
            self.select(torch.cat([~parents, torch.ones(2 * int(parents.sum()), dtype=torch.bool)]))
        pruned = (self.tensors["opacities"].sigmoid() < 0.005)[:, 0]
        if by_size:
            pruned |= (self.radii > 2 * SIDE) | (self.tensors["scales"].exp().amax(1) > 0.3 * EXTENT)
        self.select(~pruned)

    @torch.no_grad()
    def lower_opacities(self):
        lowered = self.tensors["opacities"].sigmoid().clamp_max(0.01).logit()
        self.exchange("opacities", lowered, torch.zeros_like)

    def step(self, radii):
        if self.repository.dialect == "accel":
            self.optimizer.step(radii > 0, radii.shape[0])
        else:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.exposure_optimizer.step()
        self.exposure_optimizer.zero_grad(set_to_none=True)

    def captured(self):
        """What a checkpoint holds."""
        others = self.degree, self.radii, self.sums, self.absolutes, self.seen
        return self.tensors, others, self.exposures, self.optimizer.state_dict()

    def restore(self, held):
        tensors, others, self.exposures, state = held
        self.adopt({name: tensor.detach() for name, tensor in tensors.items()})
        self.degree, self.radii, self.sums, self.absolutes, self.seen = others
        self.exposure_optimizer = torch.optim.Adam([self.exposures], lr=1e-2)
        self.optimizer.load_state_dict(state)

    def columns(self):
        """What the program stores, by the names of a .ply."""
        values = {name: tensor.detach().cpu().numpy() for name, tensor in self.tensors.items()}
        means, rest = values["means"], values["rest"].transpose(0, 2, 1).reshape(self.count, -1)
        named = dict(zip("xyz", means.T)) | {f"n{axis}": np.zeros(self.count) for axis in "xyz"}
        named |= {f"f_dc_{i}": values["dc"][:, 0, i] for i in range(3)}
        named |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])} | {"opacity": values["opacities"][:, 0]}
        named |= {f"scale_{i}": values["scales"][:, i] for i in range(3)}
        return named | {f"rot_{i}": values["rotations"][:, i] for i in range(4)}


def write_ply(path, columns):
    rows = np.empty(len(columns["x"]), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in columns), "end_header\n"]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


def read_ply(path):
    """All columns of a file of float properties."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    (count,) = [int(line.split()[-1]) for line in lines if line.startswith("element vertex ")]
    rows = np.frombuffer(body, [(name, "<f4") for name in names], count)
    return {name: rows[name] for name in names}


def trained(repository, tmp_path, steps=STEPS):
    """The program after its training, its cameras, the losses and the numbers of Gaussians of all steps."""
    program, cameras = Program(repository), [Camera(0.5 * number) for number in range(VIEWS)]
    pictures = photographs(cameras, repository.exposure)
    generator = seeded(1)
    losses, counts, lowered = [], [], False
    for step in range(1, steps + 1):
        if repository.filtered and step % PERIOD == 1:
            program.measure_intervals(cameras)
        program.degree = min(3, step // 100)
        program.optimizer.param_groups[0]["lr"] = RATES["means"] * 0.01 ** (step / steps)
        number = int(torch.randint(VIEWS, (1,), generator=generator))
        picture, radii, screen, others = program.render(cameras[number])
        if repository.exposure:
            matrix = program.exposures[number]
            picture = torch.einsum("chw,cd->dhw", picture, matrix[:, :3]) + matrix[:, 3, None, None]
        loss = ar.losses.l1_ssim(picture.clamp(0, 1), pictures[number])
        total = loss + 0.01 * (others[0] - 0.25).abs().mean() if repository.inverse_depth else loss
        total.backward()
        gradients = [tensor.grad for tensor in program.tensors.values()]
        assert all(gradient is not None and bool(gradient.isfinite().all()) for gradient in gradients)
        program.watch(screen, radii)
        if 100 < step < 0.8 * steps and step % PERIOD == 0:
            program.change_number(generator, by_size=step > 400)
            if repository.filtered:
                program.measure_intervals(cameras)
        if step == 300:
            program.lower_opacities()
            lowered = bool((program.tensors["opacities"].sigmoid() <= 0.0101).all())
        program.step(radii)  # which skips parameters that have just been replaced, for they have no gradient
        losses.append(loss.item())
        counts.append(program.count)
        if step == steps // 2:  # interrupted, and gone on in another process
            torch.save(program.captured(), tmp_path / "checkpoint.pth")
            before, program = program, Program(repository)
            program.restore(torch.load(tmp_path / "checkpoint.pth", weights_only=False))
            program.interval = before.interval
            assert_same_state(before, program)
    assert lowered
    return program, cameras, losses, counts


def assert_same_state(left, right):
    for name, tensor in left.tensors.items():
        state, other = left.optimizer.state[tensor], right.optimizer.state[right.tensors[name]]
        assert torch.equal(tensor, right.tensors[name]) and state.keys() == other.keys()
        assert all(torch.equal(state[key], other[key]) for key in MOMENTS)
        assert float(state["step"]) == float(other["step"]) > 0


@pytest.fixture
def by_default(device):
    """Makes new tensors on the device."""
    torch.set_default_device(device)
    yield
    torch.set_default_device(None)


@pytest.mark.usefixtures("by_default")
@pytest.mark.parametrize("name", REPOSITORIES)
def test_training_program(tmp_path, name):
    pytest.importorskip("scipy", reason="needs the train extra")
    pytest.importorskip("gsply", reason="needs the cli extra")
    repository = REPOSITORIES[name]
    if repository.chosen:
        dialects.set_dialect(repository.dialect)
    program, cameras, losses, counts = trained(repository, tmp_path)
    first, last = np.mean(losses[:30]), np.mean(losses[-30:])
    assert last < 0.5 * first
    assert START < counts[-1] < 2 * MOST and len(set(counts)) > 3
    assert (program.exposures != torch.eye(3, 4)).any() == repository.exposure

    assert (program.absolutes > 0).any() == (repository.dialect in ("mip", "analytic"))

    # What it stored, our files have too, and it reads what we store.
    stored = program.columns()
    write_ply(tmp_path / "point_cloud.ply", stored)
    scene = io.load_scene(tmp_path / "point_cloud.ply").to(torch.get_default_device())
    io.save_scene(tmp_path / "again.ply", scene)
    again = read_ply(tmp_path / "again.ply")
    assert stored.keys() <= again.keys() | {"nx", "ny", "nz"}
    for column in again.keys() & stored.keys():
        np.testing.assert_array_equal(again[column], stored[column], column)
    with torch.no_grad():
        if repository.filtered:
            scene = scene.with_activated(*program.widened())
        picture, radii, *_ = program.render(cameras[0])
        settings = drop_in.GaussianRasterizationSettings(**cameras[0].fields(3), **repository.settings)
        arguments = scene.arguments()
        if repository.dialect == "accel":
            arguments |= {"dc": arguments["shs"][:, :1], "shs": arguments["shs"][:, 1:]}
        shown, again_radii, *_ = drop_in.GaussianRasterizer(settings)(means2D=None, **arguments)
    # Activations differ in their last bits: a radius may be rounded up to the next number, and a pixel may gain or lose
    # a splat at the least alpha that is drawn, 1/255.
    assert ((radii - again_radii).abs() <= 1).all() and torch.equal(radii > 0, again_radii > 0)
    different = (shown - picture).abs() > 1e-5
    assert different.float().mean() < 1e-2
    torch.testing.assert_close(shown, picture, rtol=0, atol=2 / 255)
