"""How a training ends early: by Ctrl-C or SIGTERM, after the step that runs."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruption() -> Iterator[threading.Event]:
    """Ctrl-C or SIGTERM sets the event, so that the step that runs is completed; a second one ends the process at once.

    A second Ctrl-C raises KeyboardInterrupt. A handler of the program for SIGTERM is left in place.
    """
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped  # only the main thread may look at signals
        return
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        del usual[signal.SIGTERM]
    before = {number: signal.getsignal(number) for number in usual}

    def stop(number: int, _) -> None:
        stopped.set()
        signal.signal(number, usual[number])

    try:
        for number in usual:
            signal.signal(number, stop)
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
