"""Random scenes with bad numbers in them: what is culled must leave no trace, and nothing may spread.

    python tests/fuzz.py --seconds 600 [--device cuda] [--seed 0]

runs until the time is over or a seed fails; test_stability.py runs a few seconds of it. A seed decides
everything, so `check(seed)` repeats a failure.

Properties, of any scene:
  - image and gradients are finite;
  - a Gaussian with a number that is not finite, where it is read, has radius 0 (where only its colour is
    not finite: or is too faint to be drawn) and gets zero gradient;
  - without the Gaussians of radius 0, image, radii and gradients of the others are the same to the bit.
"""

import argparse
import math
import sys
import time
from pathlib import Path

import torch

import analytic_rasterizer as ar

sys.path.insert(0, str(Path(__file__).parent / "makers"))

import scenes
from scenes import VARIANTS, Camera, ParallelCamera, name_of, rand

NOT_FINITE = (math.nan, math.inf, -math.inf)
# Zero, denormal and nearly so, huge; finite in float32.
EXTREME = (
    0.0,
    -0.0,
    1e-45,
    -1e-45,
    1e-40,
    1e-38,
    1e-30,
    1e-20,
    1e-10,
    1e10,
    1e18,
    1e20,
    1e30,
    3e38,
    -1e30,
    -3e38,
    -1.0,
)
COLORS = ("shs", "colors_precomp")


def random_camera(g, kind):
    """Any size up to 70 px and a few degrees to more than 90, from outside the scene or within."""
    size = torch.randint(1, 70, (2,), generator=g).tolist()
    tangent = torch.exp(rand(g, 2, low=math.log(0.05), high=math.log(1.5))).tolist()
    distance = rand(g, 1, low=0.1, high=6.0).item()
    return kind(
        image_width=size[0],
        image_height=size[1],
        tanfovx=tangent[0],
        tanfovy=tangent[1],
        bg=tuple(rand(g, 3, low=-1.0, high=2.0).tolist()),
        scale_modifier=rand(g, 1, low=0.5, high=2.0).item(),
        sh_degree=int(torch.randint(0, 5, (1,), generator=g)),
        eye=(0.3 * distance, -0.2 * distance, -distance),
    )


def random_effects(g, pick):
    """A full camera, with any of what it has; None for a plain one."""
    if pick(range(3)):
        return None

    def speed(size):
        return tuple((rand(g, 3, low=-1.0) * pick((1e-6, 1.0, 1e2)) * size).tolist())

    return ar.Effects(
        camera_gradients=True,
        off_center=pick((False, True)),
        orthographic=pick((False, True)),
        near=pick((0.2, 0.01, 1.0)),
        far=pick((math.inf, 5.0)),
        defocus=pick((None, ar.Defocus(pick((1e-6, 0.1, 1e3)), pick((0.2, 1.0, 4.0))))),
        motion=pick((None, ar.Motion(0.1, speed(1.0), speed(1.0), speed(100.0)[:2]))),
    )


def random_case(seed):
    """(camera, effects, variant, scene, rows with a number that is not finite, those where only the colour is not)."""
    g = torch.Generator().manual_seed(seed)

    def pick(choices):
        return choices[int(torch.randint(0, len(choices), (1,), generator=g))]

    effects = random_effects(g, pick)
    camera, variant = random_camera(g, ParallelCamera if effects and effects.orthographic else Camera), pick(VARIANTS)
    count = int(torch.randint(1, 40, (1,), generator=g))
    scene = scenes.random_scene(
        seed, count, degree=4, opacity=(0.0, 1.0), sigma=(pick((1e-4, 1e-2)), pick((0.5, 20.0)))
    )
    if pick((False, True)):
        scene = scenes.with_precomputed(scene, seed)
    scene = {name: value.float() for name, value in scene.items()}
    fields = [name for name in scene if name != "means2D"]
    broken, discoloured = set(), set()
    for row in range(count):
        if pick(range(3)):
            continue
        for _ in range(pick((1, 1, 3))):
            field, value = pick(fields), pick(NOT_FINITE if pick((False, True)) else EXTREME)
            entries = scene[field][row].view(-1)
            if pick(range(4)) == 0:  # of several bad numbers one may hide another
                entries[:] = pick(EXTREME)
            column = pick(range(len(entries)))
            entries[column] = value
            read = field != "shs" or column < 3 * (camera.sh_degree + 1) ** 2
            if read and not math.isfinite(value):
                (discoloured if field in COLORS else broken).add(row)
    # What was written over again may be finite by now: look.
    used = {name: value[:, : (camera.sh_degree + 1) ** 2] if name == "shs" else value for name, value in scene.items()}
    finite = {name: torch.isfinite(value.reshape(count, -1)).all(1) for name, value in used.items()}
    broken = [r for r in sorted(broken) if not all(finite[name][r] for name in fields if name not in COLORS)]
    discoloured = [r for r in sorted(discoloured) if not all(finite[name][r] for name in fields if name in COLORS)]
    return camera, effects, variant, scene, broken, discoloured


def render(settings, scene, device):
    """(image, radii, gradients, those of the camera) on the CPU, with pixel gradients between -1 and 1."""
    leaves, camera = scenes.leaves(scenes.to(scene, device)), {}
    if settings.effects:
        camera = scenes.leaves({name: getattr(settings, name) for name in ("viewmatrix", "projmatrix", "campos")})
    color, radii = ar.GaussianRasterizer(settings._replace(**camera))(**leaves)
    g = torch.Generator().manual_seed(5)
    (color * rand(g, *color.shape, low=-1.0).to(color)).sum().backward()
    return (
        color.detach().cpu(),
        radii.cpu(),
        *({name: leaf.grad.cpu() for name, leaf in some.items()} for some in (leaves, camera)),
    )


def check(seed, device="cpu", dtype=torch.float32):
    """Raises AssertionError, which names the seed, where a property does not hold."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)  # on CUDA gradients are else the same to the bit only from frame to frame
    try:
        check_properties(seed, device, dtype)
    finally:
        torch.use_deterministic_algorithms(before)


def check_properties(seed, device, dtype):
    camera, effects, variant, scene, broken, discoloured = random_case(seed)
    footprint, options = variant
    where = f"seed {seed}, {name_of(variant)}, {device}, {dtype}, {effects}"
    settings = camera.settings(dtype, device, footprint=footprint, effects=effects, **options)
    scene = scenes.cast(scene, dtype)
    color, radii, grads, by_camera = render(settings, scene, device)
    assert torch.isfinite(color).all(), f"{where}: the image is not finite"
    for name, grad in grads.items():
        rows = torch.nonzero(~torch.isfinite(grad.reshape(len(grad), -1)).all(1)).flatten().tolist()
        assert not rows, f"{where}: gradient of {name} is not finite at {rows}"
    for name, grad in by_camera.items():
        assert torch.isfinite(grad).all(), f"{where}: gradient of {name} is not finite"
    assert (radii[broken] == 0).all(), f"{where}: not culled: {[r for r in broken if radii[r] != 0]}"
    for name, grad in grads.items():
        for rows in (broken, discoloured, radii == 0):
            assert (grad[rows] == 0).all(), f"{where}: what is culled has a gradient of {name}"
    kept = radii > 0
    kept[discoloured] = False
    clean = render(settings, {name: value[kept] for name, value in scene.items()}, device)
    assert torch.equal(clean[0], color), f"{where}: the image depends on what is culled"
    assert torch.equal(clean[1], radii[kept]), f"{where}: radii depend on what is culled"
    for name, grad in grads.items():
        assert torch.equal(clean[2][name], grad[kept]), f"{where}: the gradient of {name} depends on what is culled"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--seed", type=int, help="the first; by default the time of day")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    first = int(time.time()) * 1000 if arguments.seed is None else arguments.seed
    print(f"seeds from {first}", flush=True)
    end, seed = time.monotonic() + arguments.seconds, first
    dtypes = (torch.float32, torch.float64) if arguments.device == "cpu" else (torch.float32,)
    failures = 0
    while time.monotonic() < end and failures < 10:
        for dtype in dtypes:
            try:
                check(seed, arguments.device, dtype)
            except AssertionError as error:
                print(error, flush=True)
                failures += 1
        seed += 1
    print(f"{seed - first} scenes, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
