"""Mip-Splatting's offsets of pixels: what they do, and when they are looked at."""

import math

import pytest
import scenes
import torch
from marks import needs_cuda
from originals import CAMERA, render, scene_of, settings_of
from processes import in_threads

import analytic_rasterizer as ar
from analytic_rasterizer.dialects import mip
from analytic_rasterizer.dialects._later import LaterFlags

pytestmark = pytest.mark.usefixtures("nothing_chosen")


def test_mip_takes_no_offset_for_zero(device):
    assert torch.equal(render("mip", device, subpixel_offset=None)[0], render("mip", device)[0])


@pytest.mark.parametrize("x, y", [(0.3, -0.2), (-0.5, 0.0), (0.0, 1.25)])
def test_mip_offset_of_all_pixels_against_its_definition(device, x, y):
    """A Gaussian's weight in a pixel whose centre is moved, and the same gradient as where the mean is moved."""
    one = {name: tensor[:1] for name, tensor in scenes.without(scene_of(device), "means2D", "shs").items()}
    one["colors_precomp"] = torch.ones(1, 3, device=device)
    settings = settings_of("mip", device, bg=torch.zeros(3, device=device))
    splat = ar.project(CAMERA.settings(torch.float32, device), **one)
    rows, columns = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    offset = torch.tensor([x, y], device=device)
    centers = torch.stack([columns, rows], -1).to(device) + offset
    weight = ar.footprint_weight(centers - splat.means2d[0], splat.cov2d[0], "mip", variance=0.25)
    alpha = (one["opacities"] * weight).clamp(max=0.99)
    moved = settings._replace(subpixel_offset=offset.expand(30, 40, 2))
    color = moved.render(**one, means2D=None)[0][0]
    # 40 px of a mean in float32, seen through a slope of at most 1 / px: 40 roundings of 2^-23, several times.
    decided = (alpha - 1 / 255).abs() > 1e-4
    assert decided.float().mean() > 0.9 and (alpha > 0.1).any()
    expected = torch.where(alpha >= 1 / 255, alpha, 0)
    assert (color - expected)[decided].abs().max() <= 5e-5
    if (x, y) != (0.0, 0.0):
        assert (color - settings.render(**one, means2D=None)[0][0]).abs().max() > 1e-2


def test_mip_refuses_jitter(device):
    """Also in a tensor that was zero, and after many that were."""
    offset = torch.zeros(30, 40, 2, device=device)
    render("mip", device, subpixel_offset=offset)
    offset[3, 4, 1] = 0.5
    with pytest.raises(ValueError, match=r"the same for all pixels, .* y from 0.0 to 0.5"):
        render("mip", device, subpixel_offset=offset, debug=True)
    with pytest.raises(ValueError, match=r"the same for all pixels"):
        render("mip", device, subpixel_offset=torch.full((30, 40, 2), math.nan, device=device), debug=True)
    with pytest.raises(ValueError, match=r"subpixel_offset must have shape \(30, 40, 2\), got \(40, 30, 2\)"):
        render("mip", device, subpixel_offset=torch.zeros(40, 30, 2, device=device))


@pytest.mark.parametrize("offset", [torch.full((30, 40, 2), 0.25).numpy(), [0.25, 0.25], 0.25], ids=type)
def test_an_offset_that_is_no_tensor_is_not_taken_for_none(offset):
    with pytest.raises(TypeError, match="subpixel_offset must be a tensor, got"):
        render("mip", "cpu", subpixel_offset=offset)


@pytest.mark.parametrize("inference", [False, True])
def test_mip_looks_at_a_tensor_once(device, monkeypatch, inference):
    """And on CUDA no longer at new ones, once 8 were zero."""
    looks = []
    monkeypatch.setattr(torch, "stack", lambda *args, of=torch.stack: looks.append(1) or of(*args))
    shape = 30, 40, 2
    with torch.inference_mode(inference):
        offset = torch.zeros(shape, device=device)
    for _ in range(3):
        assert mip._offset_of(offset, shape, debug=False) == (0, 0)
    assert len(looks) == (3 if inference else 1)
    offset = torch.zeros(shape, device=device)
    for step in range(3):
        offset += 0.25
        assert mip._offset_of(offset, shape, debug=False) == (0.25 * (step + 1),) * 2

    def looks_at(count, debug=False):
        looks.clear()
        for _ in range(count):
            mip._offset_of(torch.zeros(shape, device=device), shape, debug=debug)
        return len(looks)

    assert looks_at(20) == 20  # one was not zero: all are looked at
    mip._looks_left = mip._LOOKS
    assert looks_at(20) == (mip._LOOKS if device == "cuda" else 20)
    assert looks_at(1, debug=True) == 1


# --- offsets that are looked at later ------------------------------------------------------------


@pytest.fixture
def slow_device(monkeypatch):
    """The CPU as a device that has to be waited for: answers arrive when the test says so."""
    answers = []

    class Slow(LaterFlags):
        def send(self, flag):
            place = torch.full((), 2, dtype=torch.uint8)
            answers.append((place, flag))
            self._places.append(place)

    monkeypatch.setattr(mip, "_looking_waits", lambda offset: True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(mip, "_not_zero", Slow())

    def arrive(count):
        for place, flag in answers[:count]:
            place.copy_(flag)
        del answers[:count]

    return arrive


def zeros():
    return torch.zeros(30, 40, 2)


def one_pixel(value):
    offset = zeros()
    offset[3, 4, 1] = value
    return offset


def exhaust_looks():
    for _ in range(mip._LOOKS):
        render("mip", subpixel_offset=zeros())


@pytest.mark.parametrize("offset", [one_pixel(0.5), one_pixel(math.nan), torch.full((30, 40, 2), 0.25)])
def test_offset_that_was_not_zero_raises_once_that_is_known(slow_device, offset):
    """After many that were zero; also one that all pixels have, for the call was rendered without it."""
    exhaust_looks()
    for each in (zeros(), offset, zeros()):
        render("mip", subpixel_offset=each)  # nothing has arrived
    slow_device(1)
    render("mip", subpixel_offset=zeros())  # the first was zero
    slow_device(1)
    with pytest.raises(ValueError, match="subpixel_offset of an earlier call was not zero"):
        render("mip", subpixel_offset=None)
    slow_device(2)
    render("mip", subpixel_offset=zeros())  # it raises once
    with pytest.raises(ValueError, match="the same for all pixels"):  # and looks from then on
        render("mip", subpixel_offset=one_pixel(0.5))


def test_zeros_are_not_waited_for(slow_device):
    exhaust_looks()
    expected = render("mip", subpixel_offset=None)[0]
    for _ in range(50):
        assert torch.equal(render("mip", subpixel_offset=zeros())[0], expected)
    slow_device(50)
    for _ in range(2):
        assert torch.equal(render("mip", subpixel_offset=zeros())[0], expected)


def test_a_tensor_that_was_looked_at_is_not_asked_for_again(slow_device, monkeypatch):
    offset = zeros()
    render("mip", subpixel_offset=offset)
    exhaust_looks()
    monkeypatch.setattr(mip._not_zero, "send", lambda flag: pytest.fail("asked again"))
    render("mip", subpixel_offset=offset)


def test_what_is_known_of_a_tensor_goes_with_it():
    before = len(mip._known)
    offset = zeros()
    render("mip", subpixel_offset=offset)
    assert len(mip._known) == before + 1
    del offset
    assert len(mip._known) == before


def test_debug_looks_at_every_offset(slow_device):
    exhaust_looks()
    with pytest.raises(ValueError, match="the same for all pixels"):
        render("mip", subpixel_offset=one_pixel(0.5), debug=True)


def test_new_offsets_are_refused_while_a_graph_is_captured(slow_device, monkeypatch):
    """Reading one then would break the capture; one that is known, and none, are taken."""
    known = zeros()
    render("mip", subpixel_offset=known)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    with pytest.raises(ValueError, match="subpixel_offset must be None while a CUDA graph is captured"):
        render("mip", subpixel_offset=zeros())
    assert torch.equal(render("mip", subpixel_offset=known)[0], render("mip", subpixel_offset=None)[0])


def test_flags_that_arrive_on_their_own(device):
    """The copy itself: set or not, and looked at once."""
    flags = LaterFlags()
    assert not flags.any_set()
    for value in (False, True, False):
        flags.send(torch.tensor(value, device=device))
    if device == "cuda":
        torch.cuda.synchronize()
    assert flags.any_set() and not flags.any_set()


def test_flags_of_several_threads(device):
    """Each flag is taken by one of them, and none is lost."""
    flags, found = LaterFlags(), []

    def work(i):
        for step in range(200):
            flags.send(torch.tensor(step == 150, device=device))
            if flags.any_set():
                found.append(i)

    in_threads(4, work)
    if device == "cuda":
        torch.cuda.synchronize()
    if flags.any_set():
        found.append("left")
    assert 1 <= len(found) <= 4 and not flags._places


@needs_cuda
def test_zeros_make_no_wait_on_the_device():
    """torch reports operations that wait."""
    offsets = [torch.zeros(30, 40, 2, device="cuda") for _ in range(20)]
    for offset in offsets[: mip._LOOKS]:
        mip._offset_of(offset, (30, 40, 2), debug=False)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for offset in offsets[mip._LOOKS :]:
            mip._raise_for_an_earlier_call()
            mip._offset_of(offset, (30, 40, 2), debug=False)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.cuda.synchronize()
    mip._raise_for_an_earlier_call()
    assert not mip._not_zero._places
