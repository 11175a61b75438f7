"""How a node's process ends at a signal, also while it starts, or while DDS is stuck."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import threading
from collections.abc import Callable, Collection

PATIENCE = 0.7  # seconds for the current work, before `leave` ends the process without it
POLL = 0.05  # seconds, while the guard is loaded


class Stop:
    """Takes the given signals, which every thread must block, in threads of its own: as exceptions
    in the main thread they could be lost in a destructor, or cut short what must be finished.

    `react` is called at the first signal; until there is a node, it ends the process. Where the
    work goes on for PATIENCE seconds after that, `leave` is called. The node calls closing() before
    it writes its last, closed() after that.

    Fast DDS can wait for a lock in shared memory that a process which died still holds, and rclpy
    holds the interpreter's lock meanwhile, so no Python thread runs: guard.py needs none. It takes
    a second to load, and longer to compile, so a Python thread listens until then.
    """

    def __init__(self, signals: Collection[signal.Signals]) -> None:
        self.react: Callable[[], object] = lambda: os._exit(0)
        self.leave: Callable[[], object] | None = None
        self.asked = False  # a signal has come
        self._closing = threading.Event()
        self._leaving = threading.Lock()
        self._awake, pipe = os.pipe()
        threading.Thread(target=self._wait, daemon=True).start()
        # A descriptor to read signals from: in sigwait(3) a thread does not block them.
        mask = sum(1 << number - 1 for number in signals).to_bytes(128, "little")  # sigset_t
        arrived, loaded = ctypes.CDLL(None).signalfd(-1, mask, os.O_CLOEXEC), threading.Event()
        listener = threading.Thread(target=_listen, args=(arrived, loaded, pipe), daemon=True)
        listener.start()
        from lidar_perception.nodes import guard  # NumPy and Numba: seconds on a busy machine
        loaded.set()
        listener.join()
        self._state = guard.start_guard(arrived, pipe)
        self._closing_phase, self._closed_phase = guard.CLOSING, guard.CLOSED

    def _wait(self) -> None:
        os.read(self._awake, 1)
        self.asked = True
        self.react()
        if not self._closing.wait(PATIENCE) and self.leave:
            with self._leaving:
                if not self._closing.is_set():
                    self.leave()

    def closing(self) -> None:
        """The work is done; what follows may take its time. While leave() ends the process this
        does not return."""
        with self._leaving:
            self._closing.set()
        self._state[0] = self._closing_phase

    def closed(self, code: int) -> None:
        """All is written: the process ends with this code within guard.TEARDOWN seconds."""
        self._state[:] = self._closed_phase, code
        self.react = lambda: None
        os.kill(os.getpid(), signal.SIGTERM)  # wakes the guard, if no signal has


def _listen(arrived: int, loaded: threading.Event, pipe: int) -> None:
    """Until the guard is loaded."""
    while not loaded.is_set():
        if select.select([arrived], [], [], POLL)[0]:
            os.write(pipe, b"\0")
            return
