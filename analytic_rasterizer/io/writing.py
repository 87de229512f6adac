"""Writing files: every file of the project is written by `write_safely`, which never costs an earlier file.

A file has a temporary name beside its own first, and its own once it is complete and on the disk. A full disk or
Ctrl-C leaves what was there.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from .images import check_written, png, to_image

DISK_IS_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))  # Windows has no quota of this name
PROBE = bytes(1 << 16)
LONGEST_NAME = 50  # characters of a name that its temporary name repeats: four bytes each may be too long a name

_numbers = count()


def write_safely(path, write: Callable[[Path], None]) -> None:
    """Lets `write` fill a file beside `path`, and gives it that name once it is complete and on the disk.

    The permissions of an earlier file are kept. The target of a symbolic link is written, and the link stays. What is
    no file, such as /dev/stdout, is written directly.

    Args:
        path: The file to write.
        write: Is called with the path of a temporary file, which does not exist yet. Its name ends as that of `path`,
            for writers that choose a format by the suffix.

    Raises:
        OSError: The file, which is named, cannot be written: the disk is full, or the reason of the system. An earlier
            file of this name is then unchanged, and nothing half-written stays.
    """
    path = Path(path)
    earlier = None
    temporary = None
    try:
        with suppress(FileNotFoundError):
            earlier = os.stat(path)
        if earlier is not None and not stat.S_ISREG(earlier.st_mode):
            if stat.S_ISDIR(earlier.st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            write(path)
            return
        if earlier is not None and not os.access(path, os.W_OK):  # replacing it would not ask
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        target = Path(os.path.realpath(path))
        name = f".{os.getpid()}-{next(_numbers)}.partial.{target.name[-LONGEST_NAME:]}"
        temporary = target.with_name(name)
        write(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if earlier is not None:
            with suppress(OSError):  # which some file systems do not have
                os.chmod(temporary, stat.S_IMODE(earlier.st_mode))
        os.replace(temporary, target)
    # torch.save raises RuntimeError when the disk is full.
    except (OSError, RuntimeError) as error:
        raise OSError(f"{path}: {_reason(error, temporary)}; an earlier file of this name is unchanged") from error
    finally:
        with suppress(OSError):  # where files cannot be removed either, the first error is the one to report
            if temporary is not None:
                temporary.unlink(missing_ok=True)


def _reason(error: OSError | RuntimeError, temporary: Path | None) -> str:
    """Why writing failed."""
    number, text = getattr(error, "errno", None), getattr(error, "strerror", None)
    if number is None and temporary is not None:
        # PyTorch, Pillow and NumPy do not pass on why the system refused. Writing a little more finds out.
        try:
            with temporary.open("ab") as file:
                file.write(PROBE)
        except OSError as found:
            number, text = found.errno, found.strerror
    if number in DISK_IS_FULL:
        return "the disk is full"
    return f"cannot be written ({text or str(error).partition(chr(10))[0]})"


def write_text(path, text: str) -> None:
    """Writes `text` as UTF-8 to the file `path`, with the line ends that it has.

    Raises:
        OSError: As `write_safely`.
    """
    write_bytes(path, text.encode())


def write_bytes(path, content: bytes) -> None:
    """Writes the bytes `content` to the file `path`.

    Raises:
        OSError: As `write_safely`.
    """
    write_safely(path, lambda temporary: temporary.write_bytes(content))


def write_json(path, value: Any) -> None:
    """Writes `value` as JSON to the file `path`.

    Numbers that are not finite, such as the PSNR of a picture without any error, become null.

    Raises:
        OSError: As `write_safely`.
    """
    write_text(path, json.dumps(as_json(value), indent=1, allow_nan=False) + "\n")


def as_json(value: Any) -> Any:
    """What JSON has a word for: it has none for infinity and NaN, and other programs refuse files with Python's."""
    if isinstance(value, dict):
        return {key: as_json(of_key) for key, of_key in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def save_image(path, picture, **options) -> None:
    """Writes a picture in the format of the path's suffix.

    Args:
        path: The file to write.
        picture: Colours (3, H, W), which `to_image` makes an image of, or an image of Pillow's.
        options: Those of Pillow's `save`.

    Raises:
        TypeError, ValueError: As `to_image`; ValueError: a suffix of no format.
        OSError: As `write_safely`.
        ImportError: Pillow is missing, which colours in a .png do not need.
    """
    try:
        image = picture if hasattr(picture, "save") else to_image(picture)
    except ImportError:
        if Path(path).suffix.lower() != ".png":
            raise
        write_bytes(path, png(picture))
        return
    if "format" not in options:
        check_written(Path(path))
    write_safely(path, lambda temporary: image.save(temporary, **options))
