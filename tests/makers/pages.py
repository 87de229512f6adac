"""What the tests of the viewer's page share, whatever the browser: scenes, a server, and how near pictures must be."""

import threading
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from analytic_rasterizer import io, render_stages, viewer
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.viewer.compressed import compress, decompress
from analytic_rasterizer.viewer.packing import PAGE_ENTRIES

PATIENCE = 600
"""Seconds to wait for the page: drawing in software on a busy machine takes its time."""
REDUCTIONS = (pytest.param(1, marks=pytest.mark.gate), 2, 4, 8)

WEBGL_FOOTPRINTS = tuple(entry["name"] for entry in PAGE_ENTRIES if entry["instead"] is None)
"""What the page draws with WebGL 2: one sample, which does not move."""

# Blended in 32-bit floats, a picture differs from the rasterizer's by splats whose alpha is 1/255 but for rounding: one
# of the two leaves them out, which is less than one level of 255 and concerns few pixels. Rounded to 8 bits that is at
# most one level.
LARGEST = 1
ROOT_MEAN_SQUARE = 0.05
# In half floats every blend rounds too, by 2^-12 of the colour.
ROOT_MEAN_SQUARE_OF_HALVES = 0.1

READ_PIXELS = """async () => {
  const bytes = new Uint8Array((await analyticPixels()).buffer);
  let text = '';
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
}"""


@contextmanager
def serve(scene, views, photographs=None, opens=None, **options):
    """A server of the scene, in a thread of its own."""
    with viewer.start_server(
        viewer.pack_scene(scene, views, **options), photographs=photographs, opens=opens
    ) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def gaussians_of(packed):
    """The scene that `pack_scene` packed, not compact."""
    geometry = torch.frombuffer(bytearray(packed.geometry), dtype=torch.float32).reshape(-1, 12)
    harmonics = torch.frombuffer(bytearray(packed.harmonics), dtype=torch.float16).reshape(len(geometry), -1).float()
    shs = harmonics[:, : 3 * (packed.meta["sh_degree"] + 1) ** 2].unflatten(1, (-1, 3))
    return Gaussians.from_activated(geometry[:, :3], geometry[:, 4:7], geometry[:, 8:], geometry[:, 3:4], shs)


def export_rounded(path, scene, view, **options):
    """Writes a file of the scene, and returns the scene that it holds."""
    packed = viewer.pack_scene(scene, [view], **options)
    viewer.export_page(path, packed)
    return gaussians_of(decompress(packed.meta, *compress(packed)))


def rendered(scene, view, footprint, background=(0.0, 0.0, 0.0)):
    settings = view.settings(1.0, background, scene.sh_degree, footprint)
    return render_stages(settings, **scene.arguments()).color.numpy()


def assert_same(ours, expected, largest=LARGEST, rms=ROOT_MEAN_SQUARE):
    error = 255 * (ours - expected)
    levels = np.abs(np.rint(255 * ours.clip(0, 1)) - np.rint(255 * expected.clip(0, 1)))
    worst = np.unravel_index(levels.argmax(), levels.shape)
    assert levels.max() <= largest, (
        f"{(levels > largest).sum()} of {levels.size} values are off, most of all that at (channel, row, column) "
        f"{tuple(map(int, worst))}: {ours[worst]} in place of {expected[worst]}"
    )
    assert np.sqrt(np.mean(error**2)) <= rms


def psnr(ours, expected):
    """Of colours from 0 to 1 [dB]."""
    return -10 * np.log10(np.mean((ours.clip(0, 1) - expected.clip(0, 1)) ** 2))


def turned_view(width=160, height=120, focal=150.0, **options):
    angle = torch.tensor(0.2, dtype=torch.float64)
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[0, 0] = w2c[2, 2] = angle.cos()
    w2c[0, 2], w2c[2, 0] = angle.sin(), -angle.sin()
    w2c[:3, 3] = torch.tensor([0.1, -0.05, 0.4])
    return io.View("turned", width, height, focal, 1.05 * focal, w2c, **options)


def random_scene(count=2000, degree=3, seed=3):
    g = torch.Generator().manual_seed(seed)
    z = 2 + 6 * torch.rand(count, generator=g)
    x, y = (torch.rand(2, count, generator=g) - 0.5) * torch.tensor([[1.3], [1.0]]) * z
    shs = 0.05 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    shs[:, 0] = 3 * (torch.rand(count, 3, generator=g) - 0.5)  # colours from 0.08 to 0.92, before the other bands
    return Gaussians.from_activated(
        torch.stack([x, y, z], 1),
        (0.03 * torch.exp(torch.randn(count, 3, generator=g))).clamp(max=0.5),
        torch.randn(count, 4, generator=g),
        torch.sigmoid(1.5 * torch.randn(count, 1, generator=g)),
        shs,
    )
