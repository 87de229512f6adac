"""Values on the device that are needed but not waited for: they are copied to the host, and read in a later call."""

from __future__ import annotations

import threading
from collections import deque

import torch

_UNDER_WAY = 2  # what the place of an answer holds until it is there, neither False nor True


class LaterFlags:
    """Flags on their way from the device to the host.

    Asking costs the host what the computation of the flag and a copy of one byte cost; nothing waits for the device.
    """

    def __init__(self):
        self._places: deque[torch.Tensor] = deque()
        self._lock = threading.Lock()

    def send(self, flag: torch.Tensor) -> None:
        """Starts the copy of a flag, a tensor of one bool, on the current stream of its device."""
        # Into pinned memory, as other copies would wait; and by bytes, which a reader sees written or not.
        place = torch.full((), _UNDER_WAY, dtype=torch.uint8, device="cpu", pin_memory=flag.is_cuda)
        place.copy_(flag.view(torch.uint8), non_blocking=True)
        self._places.append(place)

    def any_set(self) -> bool:
        """Whether a flag was set among those that have arrived since the last call."""
        if not self._places:  # as a rule, and taking a lock costs time
            return False
        found = False
        with self._lock:
            while self._places:
                value = self._places[0].item()
                if value == _UNDER_WAY:
                    break
                self._places.popleft()
                found |= bool(value)
        return found
