"""What training programs of other repositories do with their rasterizer, written anew: the call, the loss, the growth.

Programs ask for CUDA by name, so that they run under `testing.cuda_on_cpu`. 3DGS, Mip-Splatting and Analytic-Splatting
are in test_whole_programs.py, at length.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import scenes
import torch
from marks import needs_cuda

import diff_gaussian_rasterization as drop_in
import diff_gaussian_rasterization_ms as mini
from analytic_rasterizer import dialects, testing

pytestmark = [
    pytest.mark.usefixtures("nothing_chosen"),
    pytest.mark.parametrize("on_gpu", [False, pytest.param(True, marks=needs_cuda)], ids=["cpu", "cuda"]),
]

WIDTH, HEIGHT, COUNT, STEPS = 40, 30, 40, 10
CAMERA = scenes.Camera(bg=(0.0, 0.0, 0.0), sh_degree=1, image_width=WIDTH, image_height=HEIGHT)
OFF_CENTRE = scenes.Camera(bg=(0.0, 0.0, 0.0), sh_degree=1, image_width=WIDTH, image_height=HEIGHT, shift=(5.0, -3.0))
SHAPES = {
    "color": (3, HEIGHT, WIDTH),
    "feature": (3, HEIGHT, WIDTH),
    "objects": (16, HEIGHT, WIDTH),
    "semantic": (8, HEIGHT, WIDTH),
    **dict.fromkeys(("depth", "median", "alpha", "opacity"), (1, HEIGHT, WIDTH)),
}
"""Of what is returned; everything else has a number for every Gaussian."""
WHOLE_NUMBERS = {"radii", "n_touched", "is_used", "counts", "pixels", "dominated"}


class Model:
    """What a program optimises: numbers before their activations, in tensors on CUDA."""

    def __init__(self, seed, further):
        made = scenes.cast(scenes.random_scene(seed, COUNT, 1, opacity=(0.3, 0.8), sigma=(0.1, 0.5)), torch.float32)
        raw = {"means3D": made["means3D"], "shs": made["shs"], "rotations": made["rotations"]}
        raw |= {"opacities": made["opacities"].logit(), "scales": made["scales"].log()}
        generator = torch.Generator().manual_seed(seed)
        raw |= {name: torch.rand(COUNT, *shape, generator=generator) for name, shape in further.items()}
        self.adopt({name: tensor.cuda() for name, tensor in raw.items()})

    def adopt(self, raw):
        self.raw = {name: tensor.detach().clone().requires_grad_() for name, tensor in raw.items()}
        self.optimizer = torch.optim.Adam(self.raw.values(), lr=0.01, eps=1e-15)

    def activated(self):
        """The arguments of a call, with the tensor that receives the gradients of projected means."""
        screen = torch.zeros_like(self.raw["means3D"], requires_grad=True, device="cuda") + 0
        if screen.requires_grad:
            screen.retain_grad()
        made = dict(self.raw, means2D=screen, scales=self.raw["scales"].exp())
        made["opacities"] = self.raw["opacities"].sigmoid()
        return made | {"rotations": torch.nn.functional.normalize(self.raw["rotations"])}

    def grow_and_prune(self, grown, kept):
        self.adopt({name: torch.cat([tensor[kept], tensor[grown]]) for name, tensor in self.raw.items()})


@dataclass
class Repository:
    """What its program does that the others do not."""

    dialect: str
    returns: str
    supervised: str = "color"
    chosen: bool = False  # whether its user has to name the dialect
    settings: dict = field(default_factory=dict)
    further: dict = field(default_factory=dict)  # shapes of further parameters of a Gaussian
    change: Callable = lambda arguments: arguments  # of the arguments, as the program makes them
    unused: str = ""  # parameters without a gradient
    densify: str = "means2D"  # whose gradients make Gaussians grow
    camera: scenes.Camera = CAMERA
    module: object = drop_in


def with_colors_of_a_network(arguments):
    """Colours from a decoder, harmonics left out; scales are one number that is repeated."""
    arguments = dict(arguments, colors_precomp=arguments.pop("colors").sigmoid(), shs=None)
    return dict(arguments, scales=arguments["scales"][:, :1].repeat(1, 3), cov3D_precomp=None)


def with_covariances(arguments):
    """Covariances that the program computed itself, six numbers of each."""
    factor = arguments.pop("scales")[:, :, None] * arguments.pop("rotations")[:, None, :3]
    full = factor.transpose(1, 2) @ factor + 0.01 * torch.eye(3, device="cuda")
    rows, columns = torch.triu_indices(3, 3)
    return dict(arguments, cov3D_precomp=full[:, rows, columns])


def with_a_pose(arguments):
    """Rotation and shift of the camera, which the program wants gradients of."""
    return arguments | {name: torch.zeros(3, device="cuda", requires_grad=True) for name in ("theta", "rho")}


def with_a_second_screen(arguments):
    """Another tensor for the gradients of projected means, by which the program densifies."""
    return arguments | {"means2D_densify": torch.zeros_like(arguments["means3D"], requires_grad=True, device="cuda")}


def with_features_of_unit_length(arguments):
    features = arguments["language_feature_precomp"]
    return dict(arguments, language_feature_precomp=features / (features.norm(dim=-1, keepdim=True) + 1e-9))


BALLS = {"further": {"colors": (3,)}, "change": with_colors_of_a_network, "unused": "shs rotations"}
POSE = {"settings": {"projmatrix_raw": CAMERA.perspective().T.float()}, "change": with_a_pose}
LANGUAGE = {"settings": {"include_feature": True}, "further": {"language_feature_precomp": (3,)}}
LANGUAGE |= {"change": with_features_of_unit_length}
KERNEL = {"kernel_size": 0.1, "subpixel_offset": torch.zeros(HEIGHT, WIDTH, 2)}
SEMANTIC = {"semantic_feature": (1, 8)}
REPOSITORIES = {
    "4DGaussians": Repository("depth", "color radii depth", chosen=True),
    "Deformable-3DGS": Repository("depth", "color radii depth", change=with_a_second_screen, densify="means2D_densify"),
    "DreamGaussian": Repository("depth_alpha", "color radii depth alpha", "color depth alpha", chosen=True),
    "SplaTAM": Repository("luiten", "color radii median", **BALLS),
    "MonoGS": Repository("monogs", "color radii depth opacity n_touched", "color depth opacity", **POSE),
    "Scaffold-GS": Repository("scaffold", "color radii", chosen=True, **BALLS),
    "LangSplat": Repository("langsplat", "color feature radii", "feature", unused="shs", **LANGUAGE),
    "Gaussian Grouping": Repository("grouping", "color radii objects", "color objects", further={"sh_objs": (1, 16)}),
    "Feature 3DGS": Repository("feature3dgs", "color semantic radii depth", "color semantic", further=SEMANTIC),
    "3dgs-mcmc": Repository("mcmc", "color radii is_used", chosen=True),
    "LightGaussian": Repository("lightgaussian", "color radii", settings={"f_count": False}),
    "LightGaussian, counting": Repository("lightgaussian", "counts scores color radii", settings={"f_count": True}),
    "Mini-Splatting": Repository("mini", "color radii weights pixels dominated", module=mini),
    "pixelSplat": Repository("gs2023", "color radii", change=with_covariances, camera=OFF_CENTRE),
    "TRELLIS": Repository("mip", "color radii", settings=KERNEL),
}
TRAINED = {name: repository for name, repository in REPOSITORIES.items() if not repository.settings.get("f_count")}
each_repository = pytest.mark.parametrize("repository", REPOSITORIES.values(), ids=REPOSITORIES)


def program_runs(on_gpu, repository):
    """The context of a program."""
    if repository.chosen:
        drop_in.set_dialect(repository.dialect)
    return contextlib.nullcontext() if on_gpu else testing.cuda_on_cpu()


def rasterizer_of(repository):
    fields = repository.camera.fields(torch.float32) | repository.settings
    if repository.dialect == "luiten":
        del fields["debug"]
        fields["viewmatrix"], fields["projmatrix"] = fields["viewmatrix"][None], fields["projmatrix"][None]
    fields = {name: value.cuda() if torch.is_tensor(value) else value for name, value in fields.items()}
    settings = repository.module.GaussianRasterizationSettings(**fields)
    return repository.module.GaussianRasterizer(raster_settings=settings)


def rendered(repository, model):
    """What a call returns, by name, and its arguments."""
    arguments = repository.change(model.activated())
    returned = rasterizer_of(repository)(**arguments)
    names = repository.returns.split()
    assert len(returned) == len(names)
    return dict(zip(names, returned)), arguments


def test_every_dialect_has_a_program(on_gpu):
    elsewhere = {"gs2024", "accel", "analytic"}  # test_whole_programs.py
    assert {repository.dialect for repository in REPOSITORIES.values()} | elsewhere == set(dialects.DIALECTS)


@each_repository
def test_what_a_call_returns(on_gpu, repository):
    with program_runs(on_gpu, repository):
        model = Model(1, repository.further)
        made, _ = rendered(repository, model)
        for name, value in made.items():
            assert value.shape == SHAPES.get(name, (COUNT,)), name
            assert value.dtype == (torch.int32 if name in WHOLE_NUMBERS else torch.float32), name
            assert (value > 0).any() and value.isfinite().all(), name


@pytest.mark.parametrize("repository", TRAINED.values(), ids=TRAINED)
def test_a_program_learns_while_its_gaussians_come_and_go(on_gpu, repository):
    """The pictures of another scene from its Gaussians with other colours, opacities and places."""
    with program_runs(on_gpu, repository):
        truth = Model(1, repository.further)
        targets = {name: value.detach() for name, value in rendered(repository, truth)[0].items()}
        generator = torch.Generator().manual_seed(2)
        model = Model(1, repository.further)
        noise = {name: 0.1 * torch.randn(raw.shape, generator=generator).cuda() for name, raw in model.raw.items()}
        model.adopt({name: raw + noise[name] for name, raw in model.raw.items()})
        losses = []
        for step in range(2 * STEPS):
            made, arguments = rendered(repository, model)
            loss = sum((made[name] - targets[name]).square().mean() for name in repository.supervised.split())
            losses.append(loss.item())
            loss.backward()
            gradient, seen = arguments[repository.densify].grad, made["radii"] > 0
            assert gradient.shape == (len(seen), 3) and (gradient[~seen] == 0).all()
            assert (gradient[seen][:, :2] != 0).any() and (gradient[:, 2] >= 0).all()
            assert (gradient[:, 2] > 0).any() == (repository.dialect == "mip")
            if "theta" in arguments:
                assert all((arguments[name].grad != 0).all() for name in ("theta", "rho"))
            received = {name: raw.grad for name, raw in model.raw.items() if raw.grad is not None}
            assert all(value.isfinite().all() for value in received.values())
            used = {name for name, value in received.items() if (value != 0).any()}
            assert set(model.raw) - used <= set(repository.unused.split())
            model.optimizer.step()
            model.optimizer.zero_grad(set_to_none=True)
            if step == STEPS:
                signed = gradient[:, :2].norm(dim=-1)
                grown = (signed >= signed.quantile(0.9)) & seen
                kept = model.raw["opacities"].sigmoid()[:, 0] > 0.2
                model.grow_and_prune(grown, kept)
                assert len(model.raw["means3D"]) == int(grown.sum() + kept.sum())
        assert losses[STEPS] < 0.8 * losses[0]
        assert losses[-1] < losses[STEPS + 1]  # goes on from its own copies


def test_scaffold_renders_what_its_filter_saw(on_gpu):
    repository = REPOSITORIES["Scaffold-GS"]
    with program_runs(on_gpu, repository), torch.no_grad():
        model = Model(1, repository.further)
        model.raw["means3D"][::3] *= 30  # outside
        arguments = repository.change(model.activated())
        rasterizer = rasterizer_of(repository)
        geometry = {key: arguments[key] for key in ("means3D", "scales", "rotations")}
        seen = rasterizer.visible_filter(**geometry, cov3D_precomp=None) > 0
        assert seen.any() and not seen[::3].all()
        rows = {name: value if value is None else value[seen] for name, value in arguments.items()}
        assert torch.equal(rasterizer(**rows)[0], rasterizer(**arguments)[0])


def test_mcmc_moves_gaussians_to_others(on_gpu):
    """As its `relocate_gs` does: dead Gaussians become copies of live ones, of which each has less of the opacity."""
    repository = REPOSITORIES["3dgs-mcmc"]
    with program_runs(on_gpu, repository), torch.no_grad():
        model = Model(1, {})
        arguments = model.activated()
        picture = rasterizer_of(repository)(**arguments)[0]
        most = 51
        table = torch.tensor([[float(math.comb(n, k)) if k <= n else 0.0 for k in range(most)] for n in range(most)])
        sources, copies = torch.tensor([0, 1, 2], device="cuda"), torch.tensor([2, 1, 3], device="cuda")
        old, sizes = arguments["opacities"][sources, 0], arguments["scales"][sources]
        opacity, scales = drop_in.compute_relocation(old, sizes, copies, table.cuda(), most)
        assert torch.allclose(opacity, 1 - (1 - old) ** (1 / copies), rtol=1e-5)
        index = torch.cat([torch.arange(COUNT, device="cuda"), torch.repeat_interleave(sources, copies - 1)])
        arguments["opacities"][sources, 0], arguments["scales"][sources] = opacity, scales
        moved = {name: value[index] for name, value in arguments.items()}
        after = rasterizer_of(repository)(**moved)[0]
        # The middle of every splat stays as bright as it was, its falloff nearly.
        assert (after - picture).abs().mean() < 0.02 * picture.mean()


def test_lightgaussian_prunes_by_its_scores(on_gpu):
    counting, plain = REPOSITORIES["LightGaussian, counting"], REPOSITORIES["LightGaussian"]
    with program_runs(on_gpu, counting), torch.no_grad():
        arguments = Model(1, {}).activated()
        counts, scores, color, radii = rasterizer_of(counting)(**arguments)
        picture = rasterizer_of(plain)(**arguments)[0]
        assert torch.equal(color, picture) and ((counts > 0) <= (radii > 0)).all()
        order = scores.argsort()
        errors = []
        for pruned in (order[:5], order[-5:]):
            kept = torch.ones(COUNT, dtype=torch.bool, device="cuda")
            kept[pruned] = False
            rows = {name: value[kept] for name, value in arguments.items()}
            errors.append((rasterizer_of(plain)(**rows)[0] - picture).abs().mean())
        assert errors[0] < 0.1 * errors[1]


def test_mini_splatting_starts_anew_from_depths(on_gpu):
    """Its points are where rays meet Gaussians: in front of the camera, and inside the scene."""
    repository = REPOSITORIES["Mini-Splatting"]
    with program_runs(on_gpu, repository), torch.no_grad():
        arguments = Model(1, {}).activated()
        made = rasterizer_of(repository).render_depth(**arguments)
        index = made["gidx"][0]
        seen = index >= 0
        assert seen.any() and made["gidx"].dtype == torch.int32
        points = made["out_pts"].permute(1, 2, 0)[seen]
        distance = (points - arguments["means3D"][index[seen].long()]).norm(dim=1)
        assert (distance < 4 * arguments["scales"][index[seen].long()].amax(1)).all()
