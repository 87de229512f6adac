"""gsplat's own programs on our functions: strategies, splatfacto's call, patching, covariances and relocation."""

import math

import pytest
import torch
from gsplat_calls import BOTH_LAYOUTS, HEIGHT, WIDTH, activated, cameras_of, scene_of, step_once, trained
from marks import each_precision
from processes import run_python

from analytic_rasterizer.dialects import gsplat as dialect
from analytic_rasterizer.relocation import compute_relocation


@BOTH_LAYOUTS
@pytest.mark.parametrize("absgrad", [False, True], ids=["grad", "absgrad"])
def test_default_strategy_runs_on_our_meta(device, packed, absgrad, patched):
    """Statistics, growth, pruning and reset: the numbers of Gaussians are those that the rules give."""
    params, optimizers = trained(device)
    cameras = cameras_of(torch.float32, device)
    strategy = patched.DefaultStrategy(
        refine_start_iter=1, refine_every=4, grow_grad2d=0.0, prune_opa=0.2, absgrad=absgrad, refine_scale2d_stop_iter=3
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    norms, counts = torch.zeros(60, device=device), torch.zeros(60, device=device)
    for step in range(5):

        def before(meta, step=step):
            strategy.step_pre_backward(params, optimizers, state, step, meta)

        _, _, meta = step_once(params, optimizers, cameras, before, packed=packed, absgrad=absgrad)
        scaled = meta["means2d"].absgrad if absgrad else meta["means2d"].grad
        scaled = scaled * torch.tensor([WIDTH, HEIGHT], device=device)  # half of each, and two cameras
        if packed:
            ids = meta["gaussian_ids"]
        else:
            drawn = (meta["radii"] > 0).all(-1)
            ids, scaled = drawn.nonzero()[:, 1], scaled[drawn]
        norms.index_add_(0, ids, scaled.norm(dim=-1))
        counts.index_add_(0, ids, torch.ones(len(ids), device=device))
        if step == 4:
            grown = (norms > 0).sum().item()
            faint = params["opacities"].sigmoid() < 0.2
            expected = 60 + grown - faint.sum() - (faint & (norms > 0)).sum()
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=packed)
        if step < 4:
            torch.testing.assert_close(state["grad2d"], norms)
            assert torch.equal(state["count"], counts)
    assert grown > 30 and faint.sum() > 0
    assert len(params["means"]) == expected and (params["opacities"].sigmoid() >= 0.2).all()
    assert all(len(optimizers[name].state[value]["exp_avg"]) == expected for name, value in params.items())

    patched.strategy.ops.reset_opa(params, optimizers, state, value=0.4)
    assert params["opacities"].sigmoid().max() <= 0.4 + 1e-6
    images, _, _ = step_once(params, optimizers, cameras, packed=packed, absgrad=absgrad)
    assert images.isfinite().all()


@BOTH_LAYOUTS
@pytest.mark.parametrize("column", [False, True], ids=["vector", "column"])
def test_mcmc_strategy_runs_on_our_meta(device, packed, column, patched):
    """With our relocation: dead Gaussians move to living ones, whose places they share, and 5% are added."""
    params, optimizers = trained(device)
    if column:  # as nerfstudio has them
        params["opacities"] = torch.nn.Parameter(params["opacities"].detach()[:, None])
        optimizers["opacities"] = torch.optim.Adam([params["opacities"]], lr=1e-3)
    with torch.no_grad():
        params["opacities"][:10] = -8.0  # sigmoid 3.4e-4
    cameras = cameras_of(torch.float32, device)
    strategy = patched.MCMCStrategy(cap_max=65, refine_start_iter=0, refine_every=1, noise_lr=1e3)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    torch.manual_seed(0)
    for step, expected in enumerate((60, 63, 65, 65)):

        def before(meta, step=step):
            strategy.step_pre_backward(params, optimizers, state, step, meta)

        _, _, meta = step_once(params, optimizers, cameras, before, packed=packed)
        strategy.step_post_backward(params, optimizers, state, step, meta, lr=1e-4)
        assert len(params["means"]) == expected
        assert all(value.isfinite().all() for value in params.values())
    assert (params["opacities"].sigmoid() >= 0.0049).all()


def test_splatfactos_call(patched, device):
    """The keywords that nerfstudio calls with, and what it does with the results."""
    params, _ = trained(device)
    cameras = cameras_of(torch.float32, device, 1)
    options = {"near_plane": 0.01, "far_plane": 1e10, "render_mode": "RGB+ED", "sh_degree": 0, "packed": False}
    options |= {"sparse_grad": False, "absgrad": True, "rasterize_mode": "classic", "width": WIDTH, "height": HEIGHT}
    render_, alpha, info = patched.rendering.rasterization(**activated(params), **cameras, **options)
    rgb = (render_[:, ..., :3] + (1 - alpha) * torch.ones(3, device=device)).clamp(0, 1)
    assert rgb.squeeze(0).shape == (HEIGHT, WIDTH, 3) and render_[:, ..., 3:4].squeeze(0).shape == (HEIGHT, WIDTH, 1)
    info["means2d"].retain_grad()
    rgb.sum().backward()
    assert info["means2d"].grad.shape == info["means2d"].absgrad.shape == (1, 60, 2)


def test_patching_puts_ours_in_the_place_of_gsplats():
    """Before 1.5 a splat had one radius, which the strategies of that time read."""
    pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    code = """
        import sys, torch
        import gsplat as theirs
        from analytic_rasterizer.dialects import gsplat
        theirs.__version__ = sys.argv[1]
        gsplat.patch()
        from gsplat import rasterization
        from gsplat.rendering import rasterization as again
        from gsplat.strategy import ops
        assert rasterization is again and ops.compute_relocation is gsplat.compute_relocation
        assert theirs.relocation.compute_relocation is gsplat.compute_relocation
        assert ops.quat_scale_to_covar_preci is gsplat.quat_scale_to_covar_preci
        K = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]])[None]
        scene = torch.tensor([[0, 0, 3.0]]), torch.eye(4)[:1], torch.tensor([[1.0, 0.1, 0.1]])
        _, _, meta = rasterization(*scene, torch.ones(1), torch.ones(1, 3), torch.eye(4)[None], K, 8, 8, packed=False)
        print(meta["radii"].tolist())
    """
    # 3.33 sqrt(9 + 0.3) and 3.33 sqrt(0.09 + 0.3) px
    assert run_python(code, "1.5.3").strip() == "[[[11, 3]]]"
    assert run_python(code, "1.4.0").strip() == "[[11]]"


def test_gsplat_need_not_be_installed():
    code = """
        import sys
        sys.modules["gsplat"] = None
        from analytic_rasterizer.dialects import gsplat
        try:
            gsplat.patch()
        except ImportError:
            print("missing")
    """
    assert run_python(code).strip() == "missing"


@each_precision
def test_covariances_and_their_inverses(device, dtype, reference):
    scene = scene_of(torch.float64, "cpu")
    quats, scales = scene["quats"].reshape(2, 20, 4), scene["scales"].reshape(2, 20, 3)
    for triu in (False, True):
        expected = reference._quat_scale_to_covar_preci(quats, scales, triu=triu)
        actual = dialect.quat_scale_to_covar_preci(quats.to(device, dtype), scales.to(device, dtype), triu=triu)
        for a, e in zip(actual, expected):
            rounding = 20 * torch.finfo(dtype).eps * e.abs().amax(-1, keepdim=True).amax()
            assert a.shape == e.shape and (a.cpu() - e).abs().max() <= rounding
    assert dialect.quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None
    assert dialect.quat_scale_to_covar_preci(quats, scales, compute_covar=False)[0] is None
    identity, _ = dialect.quat_scale_to_covar_preci(torch.zeros(4), torch.tensor([1.0, 2.0, 3.0]))
    assert torch.equal(identity, torch.diag(torch.tensor([1.0, 4.0, 9.0])))
    with pytest.raises(ValueError, match=r"quats must have shape \(\.\.\., 4\) and scales \(\.\.\., 3\)"):
        dialect.quat_scale_to_covar_preci(torch.zeros(3), torch.zeros(3))


def test_autocast_does_not_round_covariances():
    scene = scene_of(torch.float32, "cpu")
    expected = dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(map(torch.equal, dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"]), expected))


BINOMS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float64)


def relocated(opacity, scale, copies):
    """The formula of the paper, term by term, in exact integers and float64."""
    new = 1 - (1 - opacity) ** (1 / copies)
    terms = (
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    return new, opacity / math.fsum(terms) * scale


@each_precision
@pytest.mark.parametrize("column", [False, True], ids=["vector", "column"])
def test_relocation_is_the_papers_formula(device, dtype, column):
    opacities, copies = torch.meshgrid(
        *(torch.tensor(v, dtype=torch.float64) for v in ([0.005, 0.1, 0.5, 0.9, 0.999], [1, 2, 5, 51])), indexing="ij"
    )
    opacities, copies = opacities.flatten().to(dtype), copies.flatten().long()
    scales = torch.rand(20, 3, dtype=torch.float64).to(dtype)
    given = opacities[:, None] if column else opacities
    on_device = (t.to(device) for t in (given, scales, copies, BINOMS.to(dtype)))
    new, new_scales = compute_relocation(*on_device, 51)
    assert new.shape == given.shape and new.dtype == dtype
    rtol = 1e-6 if dtype == torch.float32 else 1e-11
    for i in range(20):
        opacity, factor = relocated(opacities[i].item(), 1.0, copies[i].item())
        assert new.reshape(-1)[i].item() == pytest.approx(opacity, rel=rtol)
        # For an opacity of 0.999 alternating terms of up to e^7 / sqrt(7) leave a sum of 0.3.
        torch.testing.assert_close(new_scales[i].cpu(), factor * scales[i], rtol=rtol, atol=0)


def test_relocation_checks_shapes():
    copies = torch.ones(4, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"scale_old must have shape \(4, 3\), got \(3, 3\)"):
        compute_relocation(torch.ones(4), torch.ones(3, 3), copies, BINOMS, 51)
    with pytest.raises(TypeError, match="N must be a tensor, got int"):
        compute_relocation(torch.ones(4), torch.ones(4, 3), 2, BINOMS, 51)
