"""`evaluate`: how good a trained scene is, with one footprint or several."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from .. import io
from ..analysis.plots import check_plot, evaluation_plots, save_plots
from ..analysis.tables import format_table
from ..captures.extent import seen_distance
from ..captures.loading import IMAGES, Capture
from ..captures.reduction import check_scales
from ..captures.source import READING
from ..captures.store import processes_here
from ..distributed.ranks import Ranks, even_counts
from ..gaussians import Gaussians
from ..io.models import DIVISORS, CfgArgs
from ..training import (
    CaptureSource,
    PictureMemory,
    TrainingOptions,
    evaluate,
    load_lpips,
    load_pictures,
    save_pictures,
)
from ..training.evaluation import COLOR_CORRECTED, LPIPS_WEIGHTS, MEASURES, about_correction, measured_in_words
from ..training.falloff import read_falloffs
from ..training.files import EVALUATION, OPTIONS, SCENE, VIGNETTING, write_json
from ..training.start import background_shown
from .arguments import (
    add_machine_options,
    add_order,
    add_reading,
    add_scales,
    check_writable_file,
    color,
    count,
    use_expandable_segments,
    use_machine,
    whole_numbers,
    writable_folder,
)
from .launch import add_rank_options, ranks_of
from .scenes import color_in_words, order_in_words, say

HEADINGS = {"psnr": ("PSNR", "{:.2f}"), "ssim": ("SSIM", "{:.4f}"), "lpips": ("LPIPS", "{:.4f}")}
HEADINGS[COLOR_CORRECTED] = ("PSNR, best affine colour", "{:.2f}")  # of each picture
SAME_POSE = 1e-3  # difference of rotations, and of positions over the size of the cameras' region: files are rounded
SIMILAR = 0.01  # share by which widths of pictures may differ unmentioned


def add_parser(subcommands) -> None:
    parser = subcommands.add_parser(
        "evaluate",
        help="measure a trained scene: PSNR, SSIM and LPIPS per scale",
        description="Compare SCENE with the test pictures of a capture, at one or more scales and with one or more "
        "footprints. SCENE is the folder that `train` wrote, a file of Gaussians, or the folder of a model of 3DGS. "
        "Writes evaluation.json, and to the folder evaluation pictures of truth, rendering and four times their "
        "difference, and prints a table.",
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", help="folder that `train` wrote, file of a scene, or folder of a model of 3DGS")
    add("--data", metavar="FOLDER", help="the capture (default: that of the training, where options.json names it)")
    add_reading(parser, "FOLDER", "as the training, or ")
    out = "folder for the results (default: SCENE where it is a folder, otherwise NAME_evaluation beside it)"
    add("--out", metavar="DIR", help=out)
    add("--footprint", nargs="+", dest="footprints", metavar="NAME[:k=v]", help="(default: that of the training)")
    add_order(parser)
    add_scales(parser, whole_numbers, "reductions to test at: 2 is half the size (default: those trained at, or 1)")
    background = "behind pictures with alpha: black, white or R,G,B (default: that of the training, or of the capture)"
    add("--background", type=color, metavar="COLOR", help=background)
    supersampling = "render pictures so many times larger and average them (default: as in the training)"
    add("--supersampling", type=count, metavar="N", help=supersampling)
    add("--lpips", choices=(*LPIPS_WEIGHTS, "none"), default="vgg", help="network of LPIPS (default: vgg)")
    add("--pictures", type=int, default=2, metavar="N", help="views to draw per footprint and scale (default: 2)")
    add("--plot", metavar="FILE", help="draw PSNR by scale and the worst views, as .png, .svg or .pdf")
    add_machine_options(parser)
    add_rank_options(parser)
    parser.set_defaults(run=run)


def run(args) -> None:
    """Measures, writes the results, and prints the table."""
    use_expandable_segments()
    if args.plot is not None:  # raises before anything is measured
        check_plot(args.plot)
        check_writable_file(args.plot)
    use_machine(args)
    with ranks_of(args) as ranks:
        run_on(ranks, args)


class Protocol(NamedTuple):
    """What a scene is compared with, and how."""

    source: CaptureSource  # settled
    scales: tuple[int, ...]
    options: TrainingOptions | None  # of the training, where it was one of this package


def protocol_of(found: io.FoundScene, args) -> Protocol:
    """As the scene was trained, where that is known, but for what is given.

    Raises:
        io.SceneError: options.json is not what `train` writes.
        ValueError: Nothing names the capture.
    """
    if found.training is not None:
        try:
            source = CaptureSource.from_dict(found.training.source)
            options = TrainingOptions.from_dict(found.training.options)
            scales = options.scales
        except (ValueError, KeyError, TypeError) as error:
            raise io.SceneError(f"{found.path.parent / OPTIONS}: not what `train` writes ({error})") from None
    else:
        cfg_args = found.cfg_args or CfgArgs()
        if args.data is None:
            model = found.model or found.path.parent
            trained = f"; {model} was trained on {cfg_args.source_path}" if cfg_args.source_path else ""
            nothing = "" if cfg_args.source_path else f", nor does an {OPTIONS} of `train` beside it"
            raise ValueError(f"{found.path} does not name its capture{nothing}: give --data FOLDER{trained}")
        named = Path(cfg_args.images or IMAGES)  # a folder of the capture, and no path that leaves it
        images = str(named) if named.name == str(named) and (Path(args.data) / named).is_dir() else IMAGES
        source, options, scales = CaptureSource(args.data, images), None, scales_of(cfg_args, args.images or images)
    given = {"folder": args.data} | {name: getattr(args, name) for name in READING}
    source = replace(source, **{name: value for name, value in given.items() if value is not None})
    return Protocol(source.settled(), tuple(dict.fromkeys(args.scales or scales)), options)


def scales_of(cfg_args: CfgArgs, images: str) -> tuple[int, ...]:
    """The reduction of the photographs in the folder `images` that a training of 3DGS had; (1,) if it is not whole."""
    total = cfg_args.images_reduction * (int(cfg_args.resolution) if cfg_args.resolution in DIVISORS else 1)
    own = CfgArgs(images=images).images_reduction
    return (total // own,) if total % own == 0 else (1,)


def run_on(ranks: Ranks, args) -> None:
    """`run`, on every rank."""
    tell = say if ranks.is_first else lambda *lines: None
    found = io.find_scene(args.scene)
    protocol = protocol_of(found, args)
    options = protocol.options or TrainingOptions()
    check_scales(protocol.scales)  # raises before the capture is read
    falloffs = [] if options.vignetting == "none" else read_falloffs(found.path.parent / VIGNETTING)
    choices = [found.choose_footprint(name) for name in args.footprints or [None]]
    orders = {str(c.footprint): found.choose_order(c.footprint, args.order) for c in choices}
    offset = found.metadata.offset or (0.0, 0.0, 0.0)  # the scene's frame, also where the capture would choose another
    capture = protocol.source.load(offset=offset)
    if not capture.test:
        raise io.SceneError(f"{protocol.source.folder}: there are no test pictures")
    background = background_for(found, protocol, capture, args.background)
    scene = part_of(io.load_scene(found.path), ranks).to(args.device)
    if not seen_distance([item.view for item in capture.test], scene.means.cpu()):
        tell(
            f"warning: no test picture shows any Gaussian of {found.path}: was it trained on {protocol.source.folder}?"
        )
    memory = PictureMemory(processes=processes_here(ranks))
    pictures = load_pictures(capture.test, protocol.scales, background, args.device, options.downsampling, memory)
    said = [] if protocol.options else differences(found, protocol, capture, background)
    if protocol.options is not None and args.data is not None:
        said += elsewhere(found, capture)
    chosen = (f"footprint {choice.footprint}: {choice.reason}" for choice in choices)
    tell(*capture.notes, *said, *chosen, *dict.fromkeys(line for of in orders.values() for line in order_in_words(of)))
    lpips = None
    if args.lpips != "none":
        try:
            lpips = load_lpips(args.lpips, args.device)
        except (ImportError, io.SceneError) as error:
            tell(f"LPIPS is left out: {error}")
    out = writable_folder(args.out or default_out(args.scene, found))
    pictures_folder = writable_folder(out / EVALUATION)
    results = {}
    common = {"supersampling": args.supersampling or options.supersampling, "ranks": ranks}
    measured = {"color_corrected": True, "falloffs": falloffs}
    for footprint, order in orders.items():
        settings = common | {"order": order.order}
        results[footprint] = evaluate(scene, pictures, footprint, lpips, **settings, **measured)
        if args.pictures > 0:
            save_pictures(pictures_folder, scene, pictures, footprint, args.pictures, **settings)
    if ranks.is_first:
        views = [view.name for view in pictures.views]
        written = {"scene": str(found.path), "data": str(protocol.source.folder), "views": views}
        written["resampled"] = sum(item.undistort for item in capture.test)
        written |= {"supersampling": common["supersampling"], "results": results}
        written["order"] = {footprint: order.order for footprint, order in orders.items()}
        write_json(out / f"{EVALUATION}.json", written)
        if args.plot is not None:
            save_plots(args.plot, evaluation_plots(results, views))
        print(format_results(results, protocol.scales, options.exposure != "none", options.vignetting != "none"))


def background_for(found: io.FoundScene, protocol: Protocol, capture: Capture, given) -> tuple[float, float, float]:
    """The colour behind pictures with alpha: `given`, that of the training, or that of the capture by convention."""
    if given is not None:
        return given
    if protocol.options is not None:
        return background_shown(protocol.options, capture.background)
    return capture.background if found.background is None else found.background[0]


def differences(found: io.FoundScene, protocol: Protocol, capture: Capture, background) -> list[str]:
    """How a scene that was trained elsewhere is tested, and where that may differ from its training, in lines."""
    said = [
        f"{found.path}: {len(capture.test)} test pictures of {protocol.source.folder}, reduced by "
        f"{', '.join(map(str, protocol.scales))}; background {color_in_words(background)}"
    ]
    if found.cfg_args is None:
        return said
    if found.cfg_args.eval is False:
        said.append("cfg_args: eval=False: the training saw these test pictures")
    view = capture.test[0].view
    trained, _ = found.cfg_args.trained_size(view.width, view.height)
    tested = view.width / CfgArgs(images=protocol.source.images).images_reduction / min(protocol.scales)
    if abs(tested - trained) > SIMILAR * trained:
        said.append(f"cfg_args: the training's pictures were {trained} px wide, these are {tested:.0f} (--scales)")
    return said


def elsewhere(found: io.FoundScene, capture: Capture) -> list[str]:
    """That no camera of the capture has the pose of one of the training, in lines: of another one, or moved."""
    try:
        trained = [] if found.cameras is None else io.load_views(found.cameras)
    except io.SceneError:  # nothing else needs the file
        trained = []
    if not trained:
        return []
    ours = poses_of([item.view for item in (*capture.train, *capture.test)], capture.offset)
    theirs = poses_of(trained, capture.offset)
    places = theirs[:, 9:]
    size = (places - places.mean(0)).norm(dim=1).max().item() or 1.0  # of one camera there is none
    units = theirs.new_tensor([1.0] * 9 + [size] * 3)
    if torch.cdist(ours / units, theirs / units, p=math.inf).min() <= SAME_POSE:
        return []
    return [
        f"note: no camera of this capture has the pose of one in {found.cameras}, which are those of the training: is "
        "it the same capture, in the same coordinates?"
    ]


def poses_of(views: list[io.View], offset: tuple[float, float, float] | None) -> torch.Tensor:
    """(V, 12) float64, camera to world: the rotation by rows, then the position relative to the offset, world units."""
    c2w = torch.linalg.inv(torch.stack([view.in_frame(offset).w2c.double() for view in views]))
    return torch.cat([c2w[:, :3, :3].flatten(1), c2w[:, :3, 3]], 1)


def default_out(given: str, found: io.FoundScene) -> Path:
    """Where results go: to the folder that was given or trained in, or else beside the file."""
    if Path(given).is_dir():
        return Path(given)
    own = found.path.name == SCENE and found.training is not None
    return found.path.parent if own else found.path.with_name(f"{found.path.stem}_evaluation")


def part_of(scene: Gaussians, ranks: Ranks) -> Gaussians:
    """The Gaussians of this rank."""
    return scene.rows(ranks.part_of(even_counts(scene.count, ranks.world)))


def format_results(
    results: dict[str, dict], scales: tuple[int, ...], exposures_vary: bool = False, vignetted: bool = False
) -> str:
    """A row per footprint and measure, with a column per scale and one for the mean; over how many pictures the means
    are, and why there are two PSNR, of which the corrected one is first where the training corrected photographs."""
    rows = []
    measures = (COLOR_CORRECTED, *MEASURES) if exposures_vary or vignetted else (*MEASURES, COLOR_CORRECTED)
    for footprint, measured in results.items():
        for measure in (m for m in measures if m in measured["mean"]):
            heading, layout = HEADINGS[measure]
            values = [measured[key][measure] for key in (*map(str, scales), "mean")]
            rows.append([footprint, heading, *("-" if math.isnan(value) else layout.format(value) for value in values)])
    table = format_table(["footprint", "", *(f"1/{scale}" for scale in scales), "mean"], rows)
    first = next(iter(results.values()))  # masks are the same for all
    said = {f"1/{scale}": measured_in_words(first[str(scale)]) for scale in scales}
    if len(set(said.values())) == 1:
        said = {"means": next(iter(said.values()))}
    over = "; ".join(f"{name} over {words}" for name, words in said.items())
    return "\n".join([table, over, about_correction(exposures_vary, vignetted)])
