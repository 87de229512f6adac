"""Films: pictures of one size, one after the other, as .mp4."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch

from .errors import optional_import
from .writing import write_safely

QUALITY = 18  # constant rate factor of H.264: hardly a difference can be seen


def save_video(path, pictures: Iterable[torch.Tensor], size: tuple[int, int], fps: float = 30) -> None:
    """Writes pictures as a film in H.264, which every browser plays.

    Args:
        path: The file, which ends in .mp4.
        pictures: Colours (3, H, W), on any device. They are taken one by one.
        size: Their (width, height), px. H.264 wants even numbers: an odd last column or row is left out.
        fps: Pictures per second.

    Raises:
        ImportError: Without the extra `video`.
        OSError: As `write_safely`.
        ValueError: The pictures are smaller than 2 x 2 px.
    """
    ffmpeg = optional_import("imageio_ffmpeg", "video")
    width, height = (length - length % 2 for length in size)
    if not (width and height):
        raise ValueError(f"pictures of a film must have at least 2 x 2 px, got {size[0]} x {size[1]}")

    failure: list[Exception] = []  # of the pictures, which is not one of writing

    def frames() -> Iterator[bytes]:
        try:
            for picture in pictures:
                pixels = picture[:, :height, :width].detach().clamp(0, 1).mul(255).round().to("cpu", torch.uint8)
                yield pixels.permute(1, 2, 0).contiguous().numpy().tobytes()
        except (OSError, RuntimeError) as error:
            failure.append(error)
            raise

    def write(temporary: Path) -> None:
        options = ["-crf", str(QUALITY), "-movflags", "+faststart"]
        writer = ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=fps,
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="quiet",
            output_params=options,
        )
        writer.send(None)  # starts the program
        sent = 0
        try:
            for frame in frames():
                writer.send(frame)
                sent += 1
        finally:
            writer.close()
        # The program ends without a word to us where the disk is full at the end, and leaves a film that does not play.
        complete, _ = ffmpeg.count_frames_and_secs(str(temporary))
        if complete != sent:
            raise RuntimeError(f"{complete} of {sent} pictures are in the film")

    try:
        write_safely(path, write)
    except OSError:
        if failure:
            raise failure[0] from None
        raise
