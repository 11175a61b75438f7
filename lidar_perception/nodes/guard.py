"""Compiled thread that ends the process after a signal, even if DDS is stuck."""

from __future__ import annotations

import threading

import numpy as np
from numba import njit, types

REACTION_S = 5.0  # time to finish the current work
# Time for DDS to shut down after the results are written. An interrupted shutdown may leave a
# shared-memory port for which other processes wait. launch sends SIGTERM after 5 s.
TEARDOWN_S = 3.0
RUNNING, CLOSING, CLOSED = range(3)
TICK_S = 0.02

SIGINFO = 128  # size of struct signalfd_siginfo, in bytes

_read = types.ExternalFunction("read", types.intp(types.int32, types.uintp, types.uintp))
_write = types.ExternalFunction("write", types.intp(types.int32, types.uintp, types.uintp))
_usleep = types.ExternalFunction("usleep", types.int32(types.uint32))
_exit = types.ExternalFunction("_exit", types.void(types.int32))


def start_guard(signals: int, pipe: int) -> np.ndarray:
    """Start a thread that ends the process after the first signal.

    The thread reads the signal and writes a byte to the pipe. The process then has REACTION_S
    seconds until its state is CLOSING, unlimited time until it is CLOSED, and TEARDOWN_S seconds
    until its end.

    Args:
        signals: file descriptor from signalfd(2).
        pipe: file descriptor of the writing end of the pipe.

    Returns:
        (2,) int64 state for the caller to set: phase, and exit code when CLOSED.
    """
    state = np.array([RUNNING, 0], np.int64)
    threading.Thread(target=_run_guard, args=(state, signals, pipe), daemon=True).start()
    return state


@njit("void(i8[::1], i8, i8)", nogil=True, cache=True)
def _run_guard(state, signals, pipe):
    signal = np.zeros(SIGINFO, np.uint8)
    while _read(signals, signal.ctypes.data, SIGINFO) < 0:
        _usleep(int(TICK_S * 1e6))
    _write(pipe, signal.ctypes.data, 1)
    waited = 0.0
    while state[0] == RUNNING:
        if waited > REACTION_S:
            _exit(0)
        _usleep(int(TICK_S * 1e6))
        waited += TICK_S
    while state[0] == CLOSING:
        _usleep(int(TICK_S * 1e6))
    _usleep(int(TEARDOWN_S * 1e6))
    _exit(state[1])
