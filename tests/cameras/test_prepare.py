"""The ops `prepare_cameras` and `prepare_lens` against torch, and limits of lenses against a search in Python.

The search is in camera_reference.py.
"""

import math

import pytest
import torch
from camera_reference import fold_of, reach_of
from marks import needs_cuda

import analytic_rasterizer as ar
from analytic_rasterizer import _C

OPS = torch.ops.analytic_rasterizer
WIDTH, HEIGHT, NEAR, FAR = 64, 48, 0.2, 90.0
LENSES = {
    "perspective": ar.Lens.perspective((-0.2, 0.05, 0.0, 0.01), (1e-3, -2e-3), (1e-3,)),
    "fisheye": ar.Lens.fisheye((0.03, -0.01, 0.002), (1e-3, 2e-3)),
    "rad_tan_fisheye": ar.Lens.rad_tan_fisheye((0.02, -0.02), (1e-3, 2e-3), (0.0, 1e-3)),
    "fov": ar.Lens.fov(0.9),
}
MEMBERS = dict(_C.LENS)


def columns(name):
    first = sum(size for size in list(MEMBERS.values())[: list(MEMBERS).index(name)])
    return slice(first, first + MEMBERS[name])


def cameras(count=3, dtype=torch.float64, device="cpu"):
    """Poses that are nearly rigid, and intrinsics whose principal points are not in the middle."""
    g = torch.Generator().manual_seed(5)
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None] + 0.01 * torch.randn(count, 3, 3, generator=g).double()
    views = torch.zeros(count, 4, 4, dtype=torch.float64)
    views[:, :3, :3], views[:, :3, 3] = turn, torch.randn(count, 3, generator=g, dtype=torch.float64)
    intrinsics = torch.tensor([[50.0, 0, 30], [0, 60, 25], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    intrinsics[:, 0] += torch.arange(count)[:, None]
    return views.to(device, dtype), intrinsics.to(device, dtype)


def camera_matrices(view, scale, center, orthographic):
    """World to clip space, for column vectors, and the camera's centre."""
    near, far = 0.01, 100.0  # of clip-space z
    w = view[..., 3:, :] if orthographic else view[..., 2:3, :]
    xy = scale[..., None] * view[..., :2, :] + center[..., None] * w
    z = far / (far - near) * (view[..., 2:3, :] - near * view[..., 3:, :])
    position = -torch.linalg.solve(view[..., :3, :3], view[..., :3, 3:])[..., 0]
    return torch.cat([xy, z, w], -2), position


def center_of(view, proj):
    """Of matrices for row vectors."""
    view, proj = view[:, :3, :3], proj[:, :3, :2]
    p = view.mT @ proj / (view**2).sum(1)[:, :, None]
    return -p[:, 2] / p.diagonal(dim1=1, dim2=2)


def prepared_in_torch(views, intrinsics, coefficients, model, off_center):
    """The same in torch's operators, in float64, but for limits."""
    orthographic = model == "orthographic"
    last = torch.eye(4, dtype=views.dtype)[3].expand(len(views), 1, 4)
    views = torch.cat([views[:, :3], last], 1)
    fx, fy, cx, cy = (intrinsics[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    scale = torch.stack([2 * fx / WIDTH, 2 * fy / HEIGHT], 1)
    center = torch.stack([2 * cx / WIDTH - 1, 2 * cy / HEIGHT - 1], 1)
    projections, positions = camera_matrices(views, scale, center, orthographic)
    view, proj = views.mT, projections.mT
    lens = [torch.zeros(len(views), size, dtype=views.dtype) for size in MEMBERS.values()]
    lens = dict(zip(MEMBERS, lens))
    lens["tan_half_fov"] = 1 / scale
    if off_center or model in LENSES:
        lens["center"] = center_of(view, proj)
    lens["focus"] += 1
    lens["near"] += NEAR
    lens["far"] += FAR
    lens["model"] += _C.CAMERA_MODELS.index(model)
    if coefficients is not None:
        lens["distortion"] = coefficients
    return view, proj, positions, torch.cat(list(lens.values()), 1)


CASES = [("pinhole", True), ("pinhole", False), ("orthographic", True), *((name, True) for name in LENSES)]


def arguments_of(model, off_center, dtype=torch.float64, device="cpu"):
    views, intrinsics = cameras(dtype=dtype, device=device)
    coefficients = None
    if model in LENSES:
        coefficients = torch.tensor(LENSES[model].coefficients).to(views).repeat(len(views), 1)
    return (views, intrinsics, coefficients), (WIDTH, HEIGHT, model, NEAR, FAR, off_center)


each_case = pytest.mark.parametrize(("model", "off_center"), CASES)


@each_case
def test_cameras_are_those_of_torch(model, off_center, device):
    tensors, numbers = arguments_of(model, off_center, device=device)
    made = OPS.prepare_cameras(*tensors, *numbers)
    expected = prepared_in_torch(*(None if t is None else t.cpu() for t in tensors), model, off_center)
    limits = columns("reach").start, columns("fold").stop
    for result, wanted in zip(made, expected, strict=True):
        result = result.cpu().clone()
        if result.shape[1:] == (sum(MEMBERS.values()),):
            result[:, slice(*limits)] = 0
        assert torch.allclose(result, wanted, rtol=1e-12, atol=1e-12)
    if model not in LENSES:
        return
    measure = (lambda a: a) if model in ar.lens.WIDE else math.tan
    for row in made[3].cpu():
        tangents, middle = row[columns("tan_half_fov")].tolist(), row[columns("center")].tolist()
        fold = fold_of(model, LENSES[model].coefficients)
        reach = reach_of(model, LENSES[model].coefficients, *tangents, *middle)
        assert math.isclose(row[columns("fold")].item(), measure(fold), rel_tol=1e-9)
        assert math.isclose(row[columns("reach")].item(), measure(reach), rel_tol=1e-9)


@each_case
def test_float32_is_float64_rounded_once(model, off_center, device):
    tensors, numbers = arguments_of(model, off_center, torch.float32, device)
    made = OPS.prepare_cameras(*tensors, *numbers)
    expected = OPS.prepare_cameras(*(None if t is None else t.double() for t in tensors), *numbers)
    for result, wanted in zip(made, expected, strict=True):
        assert result.dtype == torch.float32
        assert torch.equal(result, wanted.float())


@each_case
def test_gradients_of_cameras(model, off_center):
    tensors, numbers = arguments_of(model, off_center)
    leaves = [t.clone().requires_grad_() for t in tensors if t is not None]

    def differentiable(*given):
        made = OPS.prepare_cameras(*given, *(None,) * (3 - len(given)), *numbers)
        return *made[:3], made[3][:, : columns("near").start]  # limits have no gradient

    assert torch.autograd.gradcheck(differentiable, leaves)


@each_case
def test_gradients_of_cameras_are_those_of_torch(model, off_center, device):
    tensors, numbers = arguments_of(model, off_center, torch.float32, device)
    gradients = []
    for double in (False, True):
        place = ("cpu", torch.float64) if double else (device, torch.float32)
        leaves = [t.detach().to(*place).requires_grad_() for t in tensors if t is not None]
        given = (*leaves, *(None,) * (3 - len(leaves)))
        made = prepared_in_torch(*given, model, off_center) if double else OPS.prepare_cameras(*given, *numbers)
        g = torch.Generator().manual_seed(1)
        loss = 0
        for result in made:
            weights = torch.randn(result.shape, generator=g, dtype=torch.float64)
            loss = loss + (result * weights.to(result)).sum()
        gradients.append(torch.autograd.grad(loss, leaves))
    for found, wanted in zip(*gradients, strict=True):
        # Of weights rounded to float32, and a result rounded once.
        assert torch.allclose(found.cpu().double(), wanted, rtol=1e-5, atol=1e-5 * wanted.abs().max().item())


def test_wrong_cameras():
    views, intrinsics = cameras()
    good = {"views": views, "intrinsics": intrinsics, "coefficients": None, "width": WIDTH, "height": HEIGHT}
    good |= {"model": "pinhole", "near": NEAR, "far": FAR}
    none = torch.zeros(3, 12, dtype=torch.float64)
    singular = views.clone()
    singular[1, 2] = singular[1, 1]
    for change, error, message in (
        ({"views": views[0]}, ValueError, r"views must have shape \(C, 4, 4\), got \(4, 4\)"),
        ({"views": singular}, RuntimeError, "views must be invertible, got a singular one at 1"),
        ({"intrinsics": intrinsics[:2]}, ValueError, r"intrinsics must have shape \(C, 3, 3\) with C = 3"),
        ({"intrinsics": intrinsics.float()}, TypeError, "intrinsics must have the dtype of views"),
        ({"model": "ortho"}, ValueError, "model must be one of .*got 'ortho'"),
        ({"far": 0.1}, ValueError, "far must be above near, 0.2, got 0.1"),
        ({"width": 0}, ValueError, "image_width must be in .*got 0"),
        ({"model": "fisheye", "coefficients": none / 0}, ValueError, "coefficients must be finite, got .*nan at"),
        ({"model": "fov", "coefficients": none}, ValueError, "the fov lens .* is no map at its axis"),
    ):
        with pytest.raises(error, match=message):
            OPS.prepare_cameras(**good | change)


def test_opcheck(device):
    for model, off_center in CASES:
        tensors, numbers = arguments_of(model, off_center, torch.float32, device)
        leaves = [None if t is None else t.requires_grad_() for t in tensors]
        torch.library.opcheck(OPS.prepare_cameras.default, (*leaves, *numbers))


# --- the lens of settings ------------------------------------------------------------------------

GIVEN = {"tanfovx": 1, "tanfovy": 1, "aperture": 1, "focus": 1, "shift": 3, "turn": 3, "screen": 2, "distortion": 12}


def lens_arguments(model="fisheye", dtype=torch.float64, device="cpu"):
    tensors, numbers = arguments_of(model, True, dtype, device)
    view, proj, _, lens = OPS.prepare_cameras(*tensors, *numbers)
    g = torch.Generator().manual_seed(2)
    given = {n: (0.1 + 0.1 * torch.rand(size, generator=g)).to(lens) for n, size in GIVEN.items()}
    given["distortion"] = lens[0, columns("distortion")].clone()
    values = lens[0].tolist()
    values[columns("reach")] = values[columns("fold")] = [0.0]
    matrices = {"viewmatrix": view[0].clone(), "projmatrix": proj[:1].clone()}
    return matrices | given, {"numbers": values, "centered": True, "height": HEIGHT}


@pytest.mark.parametrize("model", LENSES)
def test_the_lens_of_matrices_is_that_of_the_camera(model, device):
    tensors, numbers = lens_arguments(model, device=device)
    numbers["numbers"][columns("center")] = [0.0, 0.0]
    coefficients, without = tensors["distortion"], dict.fromkeys(GIVEN)
    one = (t[:1] for t in cameras(device=device))
    expected = OPS.prepare_cameras(*one, coefficients[None], WIDTH, HEIGHT, model, NEAR, FAR)[3][0]
    for given in (without, without | {"distortion": coefficients}):
        lens = OPS.prepare_lens(**tensors | given, **numbers)
        assert torch.allclose(lens, expected, rtol=1e-12, atol=1e-12)
    known = {"numbers": list(numbers["numbers"])}
    known["numbers"][columns("fold")] = [_C.lens_fold(model, coefficients.tolist())]
    assert torch.allclose(OPS.prepare_lens(**tensors | without, **numbers | known), expected, rtol=1e-12, atol=1e-12)


def test_gradients_of_a_lens():
    tensors, numbers = lens_arguments()
    names, leaves = zip(*((name, t.requires_grad_()) for name, t in tensors.items()))

    def differentiable(*given):
        return OPS.prepare_lens(**dict(zip(names, given)), **numbers)[: columns("near").start]

    assert torch.autograd.gradcheck(differentiable, leaves)


def test_opcheck_of_a_lens(device):
    tensors, numbers = lens_arguments(dtype=torch.float32, device=device)
    leaves = {name: t.requires_grad_() for name, t in tensors.items()}
    torch.library.opcheck(OPS.prepare_lens.default, (), leaves | numbers)
    only = dict.fromkeys(GIVEN)
    torch.library.opcheck(OPS.prepare_lens.default, (), leaves | only | numbers)


# --- limits of a lens ----------------------------------------------------------------------------

G = torch.Generator().manual_seed(3)
RANDOM = [(model, (torch.randn(12, generator=G) * 0.05).tolist()) for model in LENSES for _ in range(6)]
RANDOM = [(m, [*k[:4], 0.0, 0.0, *k[6:]] if m == "fisheye" else k) for m, k in RANDOM]
RANDOM = [(m, [abs(k[0]) * 8 + 0.1, *[0.0] * 11] if m == "fov" else k) for m, k in RANDOM]


@pytest.mark.parametrize(("model", "coefficients"), RANDOM)
def test_limits_are_those_of_a_search(model, coefficients):
    fold = _C.lens_fold(model, coefficients)
    assert math.isclose(fold, fold_of(model, tuple(coefficients)), rel_tol=1e-9)
    for picture in ((0.5, 0.4, 0.0, 0.0), (0.2, 0.1, 0.4, -0.3), (3.0, 2.0, 0.0, 0.5)):
        reach = _C.lens_reach(model, coefficients, *picture)
        assert math.isclose(reach, reach_of(model, tuple(coefficients), *picture), rel_tol=1e-9)


@needs_cuda
def test_a_lens_that_is_no_map_shows_nothing_on_cuda():
    views, intrinsics = cameras(device="cuda", dtype=torch.float32)
    for worth in (math.nan, 0.0):
        coefficients = torch.full((3, 12), worth, device="cuda")
        lens = OPS.prepare_cameras(views, intrinsics, coefficients, WIDTH, HEIGHT, "fov", NEAR, FAR)[3]
        assert (lens[:, columns("fold")] < 0).all()
