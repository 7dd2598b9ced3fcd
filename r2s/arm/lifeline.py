"""Detect the death of another process without delay.

When the owner of a robust mutex dies, the kernel marks the mutex (robust_list of futex(2)) before it unmaps the
owner's memory. A check of the parent's id would be slower: the id changes only after the kernel has unmapped the
parent's memory, tens of ms later if PyTorch is loaded.
"""

import ctypes
import sys
import threading
from multiprocessing.sharedctypes import RawArray

OWNER_DIED, OWNER = 0x40000000, 0x3FFFFFFF  # FUTEX_OWNER_DIED and FUTEX_TID_MASK of linux/futex.h
SHARED = ROBUST = 1  # PTHREAD_PROCESS_SHARED, PTHREAD_MUTEX_ROBUST
_kept: list[RawArray] = []  # type: ignore[valid-type]  # locked mutexes, to which the C library may still refer


class Lifeline:
    """A mutex in shared memory that shows whether the process that locked the mutex has died.

    If the C library has no robust mutex of the expected layout, `lost` always returns None.
    """

    def __init__(self):
        self._raw = RawArray("i", 32)  # a mutex has 40 bytes, its first word is the futex

    def hold(self) -> None:
        """Lock the mutex until this thread ends or `release` is called."""
        if not sys.platform.startswith("linux"):
            return
        libc, settings = ctypes.CDLL(None), (ctypes.c_long * 8)()
        _kept.append(self._raw)
        libc.pthread_mutexattr_init(settings)
        libc.pthread_mutexattr_setpshared(settings, SHARED)
        libc.pthread_mutexattr_setrobust(settings, ROBUST)
        libc.pthread_mutex_init(self._raw, settings)
        libc.pthread_mutex_lock(self._raw)
        if self._raw[0] & OWNER != threading.get_native_id():  # this C library has another layout
            self.release()

    def release(self) -> None:
        """Unlock the mutex before this thread ends normally, so that `lost` does not report a death."""
        if sys.platform.startswith("linux"):
            ctypes.CDLL(None).pthread_mutex_unlock(self._raw)

    def lost(self) -> str | None:
        """Return a message for `watched` if the thread that locked the mutex has died, else None."""
        return "the process of the policy has ended" if self._raw[0] & OWNER_DIED else None
