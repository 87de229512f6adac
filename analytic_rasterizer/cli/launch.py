"""Several processes that torchrun starts: how they meet, which device each has, and that they end with one message."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist

from ..distributed.ranks import ALONE, Ranks

TIMEOUT = 600  # s
STORE_TIMEOUT = 10  # s, to tell torchrun's store that there is a message
# What gloo and NCCL say of a rank that does not answer, and of one that is gone.
LATE, GONE = ("timed out", "timeout"), ("connection closed", "connection reset", "broken pipe", "remote process exited")


def is_launched() -> bool:
    """Whether torchrun started this process as one of several."""
    return dist.is_available() and dist.is_torchelastic_launched() and int(os.environ.get("WORLD_SIZE", 1)) > 1


def add_rank_options(parser) -> None:
    help_ = f"under torchrun: how long processes wait for each other (default: {TIMEOUT})"
    parser.add_argument("--rank-timeout", type=float, default=TIMEOUT, metavar="SECONDS", help=help_)


@contextmanager
def ranks_of(args) -> Iterator[Ranks]:
    """The processes that torchrun started, or this one alone. `args.device` becomes that of this process.

    Raises:
        ValueError: --rank-timeout is not positive, or there is no CUDA device for this process.
        RuntimeError: Another rank is gone or does not answer; the message says so.
    """
    if not args.rank_timeout > 0:
        raise ValueError(f"--rank-timeout must be positive, got {args.rank_timeout}")
    if not is_launched():
        yield ALONE
        return
    backend = "gloo"
    if args.device == "cuda":
        backend = "cpu:gloo,cuda:nccl"  # what is no splat goes through the host, whose time-outs can be named
        place = int(os.environ["LOCAL_RANK"])
        if place >= torch.cuda.device_count():
            raise ValueError(f"--device cuda: {torch.cuda.device_count()} CUDA devices, none for process {place}")
        args.device = f"cuda:{place}"
        torch.cuda.set_device(place)
    try:
        make_group(backend, timeout=timedelta(seconds=args.rank_timeout))
        yield Ranks.of_group()
    except RuntimeError as error:
        reason = _reason(str(error), args.rank_timeout)
        if reason is None:
            raise
        raise RuntimeError(f"{reason} ({str(error).partition(chr(10))[0]})") from error
    dist.destroy_process_group()  # not after an error: it may wait for ranks that are gone


def make_group(backend: str, **options) -> None:
    """init_process_group, such that nothing of the group outlives destroy_process_group."""
    # Parts of torch import this module when they are first used, and defaults of its functions hold the group of that
    # time: imported before there is one, it cannot keep the group and its threads beyond destroy_process_group. A
    # thread that still runs while Python ends may abort the process.
    importlib.import_module("torch.distributed.nn.functional")
    dist.init_process_group(backend, **options)


def _reason(message: str, timeout: float) -> str | None:
    """What happened to another rank, if that is what the message is about."""
    text = message.lower()
    if any(words in text for words in LATE):
        return f"time-out: another rank did not answer for {timeout:g} s (--rank-timeout)"
    if any(words in text for words in GONE):
        return "another rank is gone: it was killed, or had an error of its own"
    return None


def report(text: str) -> None:
    """Prints an error on stderr; of the processes of torchrun the first one that has one does, and names itself."""
    if is_launched():
        if not _is_first_report():
            return
        if not text.startswith("on rank "):
            text = f"on rank {os.environ['RANK']}: {text}"
    print(f"error: {text}", file=sys.stderr, flush=True)


def _is_first_report() -> bool:
    """Whether no other rank has reported an error. An error of one rank makes others fail, which is no news."""
    try:
        address = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(*address, is_master=False, timeout=timedelta(seconds=STORE_TIMEOUT))
        attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")  # torchrun may start all ranks anew
        return store.add(f"analytic_rasterizer/errors/{attempt}", 1) == 1
    except (KeyError, ValueError, RuntimeError):
        return True  # without torchrun's store two messages are better than none
