"""The pictures of a capture at several scales, on the device or waiting for it."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from .. import io
from ..io.errors import SceneWarning, counted_files, naming
from ..render.order import CENTER
from ..render.settings import GaussianRasterizationSettings, in_order
from .depth import DepthMap, depth_planes
from .loading import Photograph
from .photographs import UPRIGHT, Header, Stored, read_file, read_mask, read_size, unreadable_pictures
from .reduction import check_scales, reduce, reduced_depths
from .store import DEVICE, FILE, Key, Made, PictureMemory, Plan, Store, columns, free_memory, limits_of, plan_places
from .undistortion import window_of, without_lens

NAMED = 3  # files in a warning
DEPTH_BYTES = 4  # of a pixel


class Pictures(NamedTuple):
    """Views and their pictures. By scale: 2 is half the size.

    Attributes:
        views: At scale 1.
        settings: By scale, for every view.
        colors: By scale, for every view: (3, H, W) uint8, on the background; or (4, H, W) premultiplied, with alpha.
            Black where nothing counts; otherwise the mean of what counts. Any device; those of a `store` that wait are
            fetched when they are asked for.
        masks: By scale, for every view: (H, W) uint8, the share of each pixel that counts; None: all of them count,
            in all views if it stands for the dict.
        store: Where `load_pictures` has put them; None: colours and masks are lists.
        shares: For every view, the share of its finest picture that counts; empty: not known.
        depths: By scale, for every view: (2, H, W) float16, inverse depths times the reference of its `DepthMap`, and
            how much each pixel counts; None: none is known, in all views if it stands for the dict.
        depth_sums: By scale, for every view: the sum of the latter.
    """

    views: list[io.View]
    settings: dict[int, list[GaussianRasterizationSettings]]  # made once: they hold tensors
    colors: dict[int, Sequence[Tensor]]
    masks: dict[int, Sequence[Tensor | None]] | None = None
    store: Store | None = None
    shares: Sequence[float] = ()
    depths: dict[int, Sequence[Tensor | None]] | None = None
    depth_sums: dict[int, list[float]] | None = None

    @property
    def horizon(self) -> int:
        """How many places of an order `expect` looks at; 0: all pictures are on the device."""
        return 0 if self.store is None else self.store.horizon

    def expect(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Has the pictures of these `pairs`, (view, scale), fetched ahead, in the order of the steps that show them."""
        if self.horizon:
            self.store.expect((scale, view) for view, scale in pairs)

    def close(self) -> None:
        """Ends the threads that fetch pictures; the next one that is asked for starts others."""
        if self.store is not None:
            self.store.close()

    def truth(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """The picture of a `view` at a `scale`, (3, H, W) float32 in [0, 1] on the device.

        `background` (3,) is for pictures with alpha.
        """
        color = self._color(scale, view).float() / 255
        return color if background is None else color[:3] + (1 - color[3:]) * background[:, None, None]

    def target(self, scale: int, view: int, background: Tensor | None = None) -> Tensor:
        """`truth` of `scale` and `view` as `l1_ssim` takes it: without a `background`, (3, H, W) uint8 as stored."""
        return self._color(scale, view) if background is None else self.truth(scale, view, background)

    def mask(self, scale: int, view: int) -> Tensor | None:
        """(H, W) float32 on the device: the share of each pixel of a `view` at a `scale` that counts. None: all do."""
        stored = None if self.masks is None else self.masks[scale][view]
        return None if stored is None else self._on_device(stored, scale, view).float() / 255

    def depth(self, scale: int, view: int) -> Tensor | None:
        """(2, H, W) float32 on the device: `depths` of a `view` at a `scale`. None: nothing is known."""
        stored = None if self.depths is None else self.depths[scale][view]
        return None if stored is None else self._on_device(stored, scale, view).float()

    def _on_device(self, stored: Tensor, scale: int, view: int) -> Tensor:
        return stored.to(self.settings[scale][view].viewmatrix.device, non_blocking=True)

    def _color(self, scale: int, view: int) -> Tensor:
        return self._on_device(self.colors[scale][view], scale, view)

    def resolve(self, order: str = CENTER, **options) -> dict[int, list[GaussianRasterizationSettings]]:
        """The settings with an `Effects.order`, and with other options, such as `footprint` and `sh_degree`."""
        return {
            scale: [in_order(s, order)._replace(**options) for s in of_scale]
            for scale, of_scale in self.settings.items()
        }


def load_pictures(
    items: list[Photograph],
    scales: tuple[int, ...],
    background: tuple[float, float, float] | None,
    device: str | torch.device,
    downsampling: str = "box",
    memory: PictureMemory | None = None,
    maps: Sequence[DepthMap | None] | None = None,
) -> Pictures:
    """Reads photographs, and reduces them.

    A picture that is to be undistorted is resampled to that of a pinhole, see `undistortion.without_lens`. All pictures
    are cut about their centres, so that all scales show the same. Views are scaled to the sizes of their pictures.
    Every file is read once, so that broken ones are found; pictures that do not fit into the memory that they may take
    are read again when they are asked for.

    Args:
        items: What `load_capture` found.
        scales: Whole numbers, 2 for half the size.
        background: (r, g, b) in [0, 1] for pictures with alpha; None: keep alpha.
        device: Of the pictures and the settings.
        downsampling: As in `TrainingOptions`.
        memory: How much of it pictures may take; None: the shares of `PictureMemory`.
        maps: Depth maps of the photographs; None: none has any.

    Warns of pictures that EXIF says to turn, unless their sizes show that they fit their cameras as they are stored.
    They are not turned. Warns of pictures of another shape than their cameras', see `fitted`.

    Raises:
        io.SceneError: Pictures that cannot be read, of which it says how many there are; one that holds numbers that
            are not finite, or is too small for the scales; memory that does not suffice, before a picture is read.
        ValueError: Scales that are not whole numbers of at least 1; `memory` that is none.
    """
    check_scales(scales)
    device, memory = torch.device(device), memory or PictureMemory()
    memory.check(device)
    recipe = Recipe(math.lcm(*scales), background, downsampling)
    shapes = read_sizes(items)
    maps = [None] * len(items) if maps is None else maps
    sizes, pixels = _sizes(shapes, scales, recipe, maps)
    free = free_memory(device)
    plan = plan_places(sizes, pixels, limits_of(memory, free, device), free, device, memory.processes)
    found = _read_all(items, maps, scales, recipe, plan, device)
    warn_of_shapes(shapes)
    _warn_of_turned(found.to_turn)

    def read(key: Key, pinned: Callable[[Tensor], Tensor]) -> dict[int, Stored]:
        files = _read_files(items[key[1]], key[:1], maps[key[1]])
        return {scale: stored.map(pinned) for scale, stored in files.items()}

    def make(key: Key, files: dict[int, Stored], moved: Callable[[Tensor], Tensor]) -> Made:
        return _make(items[key[1]], files, key[:1], recipe, moved)[1][key[0]]

    store = Store(device, plan, found.kept, read, make)
    if plan.ahead:
        colors, masks, depths = columns(store, scales, len(items))
    else:
        colors, masks, depths = (
            {scale: [found.kept[scale, i][k] for i in range(len(items))] for scale in scales}
            for k in range(len(Made._fields))
        )
    depths = depths if any(maps) else None
    return Pictures(found.views, found.settings, colors, masks, store, found.shares, depths, found.depth_sums)


class Recipe(NamedTuple):
    """How pictures are made of photographs."""

    multiple: int  # px, of their sizes at scale 1
    background: tuple[float, float, float] | None
    downsampling: str


class _Read(NamedTuple):
    """What reading every photograph once has found."""

    views: list[io.View]  # this one and those without a comment as in `Pictures`
    settings: dict[int, list[GaussianRasterizationSettings]]
    shares: list[float]
    depth_sums: dict[int, list[float]]
    kept: dict[Key, Made]  # pictures that stay in memory
    to_turn: list[Path]  # files that EXIF says to turn


def _read_all(
    items: list[Photograph],
    maps: Sequence[DepthMap | None],
    scales: tuple[int, ...],
    recipe: Recipe,
    plan: Plan,
    device: torch.device,
) -> _Read:
    """Reads and makes all pictures. Raises io.SceneError, which says how many cannot be read."""
    found = _Read([], {scale: [] for scale in scales}, [], {scale: [] for scale in scales}, {}, [])
    background = io.BLACK if recipe.background is None else recipe.background
    errors = []
    with closing(_read_ahead(items, maps, scales, plan.threads)) as ahead:
        for number, (item, files) in enumerate(zip(items, ahead)):
            if isinstance(files, io.SceneError):
                errors.append(files)
            if errors:  # the others are read to say how many there are
                continue
            if not files[1].header.tells_orientation(item.view):
                found.to_turn.append(item.files[1])
            view, of_scales = _make(item, files, scales, recipe, lambda tensor: tensor.to(device))
            found.views.append(view)
            mask = of_scales[min(scales)].mask
            found.shares.append(1.0 if mask is None else mask.float().mean().item() / 255)
            for scale, made in of_scales.items():
                place = plan.places[scale, number]
                if place != FILE:
                    found.kept[scale, number] = made if place == DEVICE else made.map(Tensor.cpu)
                # In fractions: the cut makes both sizes multiples of the scale.
                found.settings[scale].append(view.settings(1 / scale, background, device=device))
                found.depth_sums[scale].append(0.0 if made.depth is None else made.depth[1].float().sum().item())
    if errors:
        raise unreadable_pictures(errors, len(items))
    return found


def _warn_of_turned(paths: list[Path]) -> None:
    """Warns of pictures that EXIF says to turn, for who calls `load_pictures`."""
    if paths:
        named = ", ".join(map(str, paths[:NAMED])) + (", .." if len(paths) > NAMED else "")
        warnings.warn(
            f"EXIF says to turn or mirror {len(paths)} pictures, which are used as they are stored, as COLMAP does; "
            f"cameras that were found for the turned pictures do not fit them: {named}",
            stacklevel=3,
        )


def read_sizes(items: list[Photograph]) -> list[tuple[Photograph, Header]]:
    """The photographs with the sizes of their files; orientations are not read.

    Raises io.SceneError for files that are no pictures, of which it says how many there are.
    """

    def read(item: Photograph) -> tuple[int, int] | io.SceneError:
        try:
            return read_size(item.files[1])
        except io.SceneError as error:
            return error

    with ThreadPoolExecutor() as pool:
        sizes = list(pool.map(read, items))
    errors = [size for size in sizes if isinstance(size, io.SceneError)]
    if errors:
        raise unreadable_pictures(errors, len(items))
    return [(item, Header(*size, UPRIGHT)) for item, size in zip(items, sizes)]


def _sizes(
    shapes: list[tuple[Photograph, Header]], scales: tuple[int, ...], recipe: Recipe, maps: Sequence[DepthMap | None]
) -> tuple[dict[Key, int], int]:
    """Bytes of every picture, and pixels of the largest photograph, by what the files say before they are decoded."""
    sizes, pixels = {}, 0
    channels = 4 if recipe.background is None else 3
    for number, (item, header) in enumerate(shapes):
        pixels = max(pixels, header.width * header.height)
        view = _view_of(item, header.width, header.height)
        with naming(item.files[1]):
            width, height = window_of(view)[2:4] if item.undistort else (view.width, view.height)
        planes = channels + (item.mask is not None or item.alpha_is_mask) + DEPTH_BYTES * (maps[number] is not None)
        for scale in scales:
            lengths = ((length - length % recipe.multiple) // scale for length in (width, height))
            sizes[scale, number] = planes * math.prod(lengths)
    return sizes, pixels


def warn_of_shapes(shapes: list[tuple[Photograph, Header]]) -> None:
    """Warns of pictures of another shape than their cameras', for who calls `load_pictures`."""
    wrong = [(item, header) for item, header in shapes if not header.fits(item.view)]
    cut = [pair for pair in wrong if pair[1].is_cut(pair[0].view)]
    for pairs, taken in (
        (cut, "are taken as cut about the principal point, so that their pixels stay square"),
        ([pair for pair in wrong if pair not in cut], "are taken as squeezed, so that their pixels are oblong"),
    ):
        if pairs:
            item, header = pairs[0]
            found = f"{header.width} x {header.height} px of a camera of {item.view.width} x {item.view.height}"
            counted = counted_files([item.files[1] for item, _ in pairs], len(shapes), "pictures", f"{taken}")
            text = f"{counted}, {found}: photographs and cameras have different proportions"
            warnings.warn(SceneWarning(text, "take the photographs for which the cameras were found"), stacklevel=3)


def _make(
    item: Photograph,
    files: dict[int, Stored],
    scales: tuple[int, ...],
    recipe: Recipe,
    moved: Callable[[Tensor], Tensor],
) -> tuple[io.View, dict[int, Made]]:
    """The view of a photograph, and its pictures at some scales, of what its files have.

    `moved` gives a tensor of the host on the device, on which pictures are made: another one would round otherwise.
    """
    mask = None if files[1].mask is None else moved(files[1].mask)
    view, rgba, mask = fitted(moved(files[1].rgba), item, recipe.multiple, mask)
    made = {}
    for scale in scales:
        stored = scale if scale in item.files and scale != 1 else 1
        whole, whole_mask = (rgba, mask) if stored == 1 else _stored(files[stored], item, moved)
        if whole.shape[:2] != (view.height // stored, view.width // stored):
            raise io.SceneError(f"{item.files[stored]}: expected {view.width // stored} x {view.height // stored} px")
        made[scale] = Made(*reduce(whole, scale // stored, recipe.background, recipe.downsampling, whole_mask))
    if files[1].depth is not None:
        planes = _depths_beside(moved(files[1].depth), files[1].header, view)
        made = {scale: its._replace(depth=reduced_depths(planes, scale, mask)) for scale, its in made.items()}
    return view, made


def _depths_beside(planes: Tensor, header: Header, view: io.View) -> Tensor:
    """(2, H, W) of `depth_planes`, in the pixels of a view that is cut about the centre of its photograph."""
    planes = functional.interpolate(planes[None], (header.height, header.width), mode="area")[0]
    left, top = (header.width - view.width) // 2, (header.height - view.height) // 2
    return planes[:, top : top + view.height, left : left + view.width]


def _stored(stored: Stored, item: Photograph, moved: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor | None]:
    """A picture of a coarse scale and its mask, as the file has them."""
    rgba, mask = moved(stored.rgba), None if stored.mask is None else moved(stored.mask)
    return _with_alpha_as_mask(rgba, mask) if item.alpha_is_mask else (rgba, mask)


def _read_ahead(
    items: list[Photograph], maps: Sequence[DepthMap | None], scales: tuple[int, ...], threads: int
) -> Iterator[dict[int, Stored] | io.SceneError]:
    """What is stored of each photograph at every scale that is needed, or why it cannot be read. Threads read some
    photographs ahead."""

    def read(item: Photograph, depth: DepthMap | None) -> dict[int, Stored] | io.SceneError:
        try:
            return _read_files(item, scales, depth)
        except io.SceneError as error:
            return error

    with ThreadPoolExecutor(threads, "pictures") as pool:
        ahead: deque = deque()
        try:
            for item, depth in zip(items, maps):
                ahead.append(pool.submit(read, item, depth))
                if len(ahead) > threads:  # more would only wait in memory
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def _read_files(item: Photograph, scales: tuple[int, ...], depth: DepthMap | None) -> dict[int, Stored]:
    found = {scale: read_file(item.files[scale]) for scale in {1, *scales} if scale in item.files}
    if item.mask is not None:
        found = {
            scale: stored._replace(mask=read_mask(item.mask, stored.rgba.shape[1], stored.rgba.shape[0]))
            for scale, stored in found.items()
        }
    if depth is not None:
        found[1] = found[1]._replace(depth=depth_planes(depth, item.view))
    return found


def fitted(
    rgba: Tensor, item: Photograph, multiple: int, mask: Tensor | None = None
) -> tuple[io.View, Tensor, Tensor | None]:
    """The picture (H, W, 4) of a photograph, its view and its mask (H, W), cut about the centre to multiples of px.

    They are undistorted if that is wanted. The principal point moves along. Where the picture is not of the size that
    the view states, the view is scaled; where exactly one side differs, it is cut about the principal point. Where
    alpha is a mask, the picture becomes opaque.

    Raises io.SceneError for pictures that are too small, or that were turned by a quarter after their camera was found.
    """
    path = item.files[1]
    height, width = rgba.shape[:2]
    view = _view_of(item, width, height)
    rgba, mask = _with_alpha_as_mask(rgba, mask) if item.alpha_is_mask else (rgba, mask)
    if item.undistort:
        with naming(path):
            view, rgba, mask = _undistorted(rgba, mask, view)
    left, top = view.width % multiple // 2, view.height % multiple // 2
    size = (view.width - view.width % multiple, view.height - view.height % multiple)
    if not all(size):
        raise io.SceneError(f"{path}: {width} x {height} px are too few for these scales, expected at least {multiple}")
    view = replace(view, width=size[0], height=size[1], cx=view.cx - left, cy=view.cy - top)
    rows, columns = slice(top, top + size[1]), slice(left, left + size[0])
    return view, rgba[rows, columns], None if mask is None else mask[rows, columns]


def _view_of(item: Photograph, width: int, height: int) -> io.View:
    """The view of a photograph of so many px. Raises io.SceneError if it was turned after its camera was found."""
    view, header = item.view, Header(width, height, UPRIGHT)
    if not header.fits(view) and header.fits_turned(view):
        raise io.SceneError(
            f"{item.files[1]}: expected the orientation of its camera, {view.width} x {view.height} px, got {width} x "
            f"{height}"
        )
    if header.is_cut(view):
        middle = view.middle if width == view.width else (width / 2, view.middle[1])
        cx, cy = middle if height == view.height else (middle[0], height / 2)
        return replace(view, width=width, height=height, cx=cx, cy=cy)
    x, y = width / view.width, height / view.height
    cx, cy = (factor * middle for factor, middle in zip((x, y), view.middle))
    return replace(view, width=width, height=height, fx=x * view.fx, fy=y * view.fy, cx=cx, cy=cy)


def _with_alpha_as_mask(rgba: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """An opaque picture, and the mask of what was opaque and counted."""
    alpha = rgba[..., 3]
    if bool((alpha == 255).all()):
        return rgba, mask
    opaque = torch.cat([rgba[..., :3], torch.full_like(rgba[..., 3:], 255)], 2)
    return opaque, alpha if mask is None else _product(alpha, mask)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Of two shares in uint8."""
    return (a.float() * b / 255).round().byte()


def _undistorted(rgba: Tensor, mask: Tensor | None, view: io.View) -> tuple[io.View, Tensor, Tensor | None]:
    """The picture and the mask of the pinhole. No colour of what does not count gets into pixels beside it."""
    if mask is None:
        return *without_lens(rgba, view), None
    # Colours count by their alpha, and this alpha is zero where nothing counts.
    counted = torch.cat([rgba[..., :3], _product(rgba[..., 3], mask)[..., None]], 2)
    pinhole, seen = without_lens(counted, view)
    _, masks = without_lens(
        torch.cat([mask[..., None].expand(-1, -1, 3), torch.full_like(rgba[..., 3:], 255)], 2), view
    )
    share = masks[..., 0]
    alpha = torch.where(share > 0, 255 * seen[..., 3].float() / share, 0).clamp_max(255).round().byte()
    return pinhole, torch.cat([seen[..., :3], alpha[..., None]], 2), share
