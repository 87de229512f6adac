"""Files of scenes: .ply, compressed .ply and .spz."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from ..gaussians import HIGHEST_LOGIT, Gaussians
from .common import SceneError, first_line, optional_import


def load_scene(path) -> Gaussians:
    """Reads a 3DGS `.ply`, a compressed `.ply` (PlayCanvas) or an `.spz` (Niantic) on the CPU.

    Axes are those stored in the file: tools that make
    `.spz` may have turned the scene (y and z negated), and nothing in the file says so.

    Raises SceneError for anything but a complete file with finite values, ImportError without the
    `cli` extra.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    gsply = optional_import("gsply")
    try:
        if path.suffix == ".spz":
            data = gsply.read_spz(path)
        elif path.suffix in (".ply", ".ply_compressed"):
            _check_ply_header(path)
            data = gsply.plyread(path)
        else:
            raise SceneError(f"expected a .ply or .spz file, got {path.suffix or 'no suffix'!r}")
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    except (ValueError, OSError) as error:
        raise SceneError(f"{path}: unreadable or cut short ({first_line(error)})") from None

    tensors = [
        torch.tensor(field, dtype=torch.float32, device="cpu").contiguous()  # a view of the file's rows
        for field in (data.means, data.scales, data.quats, data.opacities, data.sh0)
    ]
    means, log_scales, rotations, logits, sh0 = tensors
    count = len(means)
    shs = sh0[:, None]
    if data.shN is not None and data.shN.size:
        shs = torch.cat([shs, torch.tensor(data.shN, dtype=torch.float32, device="cpu")], dim=1)
    scene = Gaussians(means, log_scales, rotations, logits.reshape(count, 1), shs.contiguous())
    for name, field in numbers_of(scene).items():
        bad = count - int(field.flatten(1).isfinite().all(1).sum())
        if bad:
            raise SceneError(f"{path}: {name} must be finite, got {bad} of {count} rows not")
    return scene


def save_scene(path, scene: Gaussians, comments: Sequence[str] = ()) -> None:
    """Writes a scene as `.ply`, `.compressed.ply` or `.spz`, by its name.

    The two small formats round: see their own documentation. Opacities are kept off 0 and 1 by
    1e-6, where their logit is infinite. `comments` are lines for the header of a `.ply`. Raises
    SceneError, before a file is touched, for another suffix, for tensors of other shapes than those
    of `Gaussians`, for harmonics of degree 4 in anything but a `.compressed.ply`, for comments that
    cannot be written, and in the small formats for what would become other numbers: those that are
    not finite, and in an `.spz` means beyond 2^22.
    """
    path = Path(path)
    if path.suffix not in (".ply", ".spz"):
        raise SceneError(f"{path}: expected a .ply or .spz name, got {path.suffix!r}")
    if scene.sh_degree > 3 and not path.name.endswith(".compressed.ply"):
        raise SceneError(f"{path}: only a .compressed.ply holds harmonics of degree {scene.sh_degree}")
    if comments and path.suffix != ".ply":
        raise SceneError(f"{path}: only a .ply holds comments")
    if any("\n" in comment or not comment.isascii() for comment in comments):
        raise SceneError(f"{path}: comments must be single lines of ASCII, got {list(comments)}")
    cpu = scene.map(lambda field: field.detach().cpu())
    cpu = cpu._replace(logit_opacities=cpu.logit_opacities.reshape(-1, 1))
    _check_fields(path, cpu)
    gsply = optional_import("gsply")
    data = gsply.GSData.from_arrays(
        means=cpu.means.numpy(),
        scales=cpu.log_scales.numpy(),
        quats=torch.nn.functional.normalize(cpu.rotations, dim=1).numpy(),
        opacities=cpu.logit_opacities.reshape(-1).clamp(-HIGHEST_LOGIT, HIGHEST_LOGIT).numpy(),
        sh0=cpu.shs[:, 0].numpy(),
        shN=cpu.shs[:, 1:].numpy(),
        format="ply",
    )
    if path.suffix == ".spz":
        gsply.write_spz(path, data, fractional_bits=_fractional_bits(path, cpu.means))
    else:
        gsply.plywrite(path, data)
    if comments:
        content = path.read_bytes()
        start = content.index(b"\n", content.index(b"\n") + 1) + 1  # "ply", then "format ..."
        added = "".join(f"comment {comment}\n" for comment in comments).encode()
        path.write_bytes(content[:start] + added + content[start:])


def _check_fields(path: Path, scene: Gaussians) -> None:
    """What gsply would write without a word, into a file that cannot be read or holds other numbers."""
    count, small = scene.count, path.suffix == ".spz" or path.name.endswith(".compressed.ply")
    shapes = {
        "means": (3,),
        "log_scales": (3,),
        "rotations": (4,),
        "logit_opacities": (1,),
        "shs": ((scene.sh_degree + 1) ** 2, 3),
    }
    for name, row in shapes.items():
        field = getattr(scene, name)
        if field.shape != (count, *row):
            raise SceneError(f"{path}: {name} must have shape {(count, *row)}, got {tuple(field.shape)}")
    for name, field in numbers_of(scene).items():
        good = field.flatten(1).isfinite().all(1)
        if small and not good.all():
            raise SceneError(f"{path}: {name} must be finite, got {count - int(good.sum())} of {count} rows not")


def numbers_of(scene: Gaussians) -> dict[str, torch.Tensor]:
    """What must be finite: scales and opacities rather than their parameters, which may be infinite."""
    return {
        "means": scene.means,
        "scales": scene.scales,
        "rotations": scene.rotations,
        "opacities": scene.opacities,
        "shs": scene.shs,
    }


def _fractional_bits(path: Path, means: torch.Tensor) -> int:
    """How many of the 24 bits of a coordinate in an .spz are fractional: the usual 12, or what the largest leaves.

    gsply would move what lies further away than the bits before the point reach.
    """
    largest = means.abs().max().item() if len(means) else 0.0
    bits = 23 - math.frexp(largest)[1]
    if bits < 1:
        raise SceneError(f"{path}: an .spz holds means up to 2^22, got {largest:g}")
    return min(bits, 12)


PLY_COLUMNS = (
    ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    + [f"scale_{i}" for i in range(3)]
    + [f"rot_{i}" for i in range(4)]
)


def _check_ply_header(path: Path) -> None:
    """Says what is wrong with a .ply that gsply would refuse without a reason, or misread: it
    takes every vertex property for a float, whatever the header says."""
    lines, size = ply_header(path), path.stat().st_size
    if any(line.startswith("element chunk") for line in lines):
        # Compressed: gsply checks the layout, but allocates memory for whatever numbers there are.
        numbers = [line.split()[-1] for line in lines if line.startswith("element ")]
        unfit = [number for number in numbers if not number.isdecimal() or int(number) > size]
        if unfit:
            raise SceneError(f"expected numbers of elements that fit {size} bytes, got {unfit[0]}")
        return
    layout = ply_layout(lines)
    if layout != "binary_little_endian":
        raise SceneError(f"expected format binary_little_endian, got {layout}")
    number, properties = ply_vertices(lines)
    kinds = {words[-1]: words[0] for words in properties}
    missing = [name for name in PLY_COLUMNS if name not in kinds]
    if missing:
        raise SceneError(f"missing vertex properties {', '.join(missing)}; is it a 3DGS scene?")
    for name, kind in kinds.items():
        if kind != "float":
            raise SceneError(f"vertex property {name} must be float, got {kind}")
    rest = sum(name.startswith("f_rest_") for name in kinds)
    if rest not in (0, 9, 24, 45):
        raise SceneError(f"expected 0, 9, 24 or 45 f_rest properties (SH degree 0 to 3), got {rest}")
    if not number.isdecimal() or 4 * int(number) * len(kinds) > size:
        raise SceneError(f"expected a number of vertices that fits {size} bytes, got {number}")


def ply_layout(header: list[str]) -> str:
    """The format of a .ply: binary_little_endian, ascii or another; "none" where the header names none."""
    return next((line.split()[1] for line in header if line.startswith("format ")), "none")


def ply_vertices(header: list[str]) -> tuple[str, list[list[str]]]:
    """What a .ply's header says of its vertices: how many there are, as it is written, and the type and the name of
    each property. Raises SceneError where they are not its first element."""
    elements = [i for i, line in enumerate(header) if line.startswith("element")]
    if not elements or not header[elements[0]].startswith("element vertex "):
        raise SceneError("expected the vertices as the first element of the .ply")
    end = elements[1] if len(elements) > 1 else len(header)
    properties = [line.split()[1:] for line in header[elements[0] + 1 : end] if line.startswith("property ")]
    return " ".join(header[elements[0]].split()[2:]), properties


def ply_header(path: Path) -> list[str]:
    """The lines of a .ply's header, comments among them. Raises SceneError where it has none."""
    lines = []
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise SceneError("not a PLY file: it does not begin with 'ply'")
        for _ in range(1000):  # a .ply that never ends its header is not read whole
            line = file.readline(1000).decode("latin-1").strip()
            if line == "end_header":
                return lines
            lines.append(line)
    raise SceneError("the PLY header has no end_header")
