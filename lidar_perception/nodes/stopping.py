"""Termination of a node process by a signal, even during its start or while DDS is stuck."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import threading
from collections.abc import Callable, Collection

WORK_TIMEOUT_S = 0.7  # time to finish the current work before force_exit() ends the process
POLL_PERIOD_S = 0.05  # polling period while the guard is loading


class Stop:
    """Handle signals in dedicated threads; all threads of the process must block the signals.

    An exception in the main thread, as raised by Python's signal handlers, could be lost in a
    destructor, or interrupt work that must be finished. Fast DDS can wait for a lock in shared
    memory that a dead process still holds while rclpy holds the interpreter lock, so that no Python
    thread runs. The compiled guard.py needs no interpreter. It takes a second to load, and longer to
    compile; a Python thread waits for signals until then.

    The node calls begin_closing() before it writes its results, and finish_closing() afterwards.

    Attributes:
        on_signal: function called at the first signal; by default it ends the process.
        force_exit: function called if the work continues for WORK_TIMEOUT_S seconds after the signal.
        requested: True once a signal has arrived.
    """

    def __init__(self, signals: Collection[signal.Signals]) -> None:
        self.on_signal: Callable[[], object] = lambda: os._exit(0)
        self.force_exit: Callable[[], object] | None = None
        self.requested = False
        self._closing = threading.Event()
        self._leaving = threading.Lock()
        self._awake, pipe = os.pipe()
        threading.Thread(target=self._wait, daemon=True).start()
        # Use signalfd: a thread that waits in sigwait(3) does not keep the signals blocked.
        mask = sum(1 << number - 1 for number in signals).to_bytes(128, "little")  # laid out as a sigset_t
        arrived, loaded = ctypes.CDLL(None).signalfd(-1, mask, os.O_CLOEXEC), threading.Event()
        listener = threading.Thread(target=_relay_first_signal, args=(arrived, loaded, pipe), daemon=True)
        listener.start()
        from lidar_perception.nodes import guard  # takes seconds because it imports NumPy and Numba

        loaded.set()
        listener.join()
        self._state = guard.start_guard(arrived, pipe)
        self._closing_phase, self._closed_phase = guard.CLOSING, guard.CLOSED

    def _wait(self) -> None:
        os.read(self._awake, 1)
        self.requested = True
        self.on_signal()
        if not self._closing.wait(WORK_TIMEOUT_S) and self.force_exit:
            with self._leaving:
                if not self._closing.is_set():
                    self.force_exit()

    def begin_closing(self) -> None:
        """Suspend the time limit while the results are written.

        Does not return if force_exit() is ending the process.
        """
        with self._leaving:
            self._closing.set()
        self._state[0] = self._closing_phase

    def finish_closing(self, code: int) -> None:
        """End the process with this code, at the latest after guard.TEARDOWN_S seconds."""
        self._state[:] = self._closed_phase, code
        self.on_signal = lambda: None
        os.kill(os.getpid(), signal.SIGTERM)  # wakes the guard if no signal has woken it yet


def _relay_first_signal(arrived: int, loaded: threading.Event, pipe: int) -> None:
    """Write to the pipe if a signal arrives before the guard is loaded."""
    while not loaded.is_set():
        if select.select([arrived], [], [], POLL_PERIOD_S)[0]:
            os.write(pipe, b"\0")
            return
