"""What a role asks of the C library about its memory."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
KEPT_BYTES = 256 << 20
LARGE_BYTES = 32 << 20  # the most that glibc takes


def keep_freed_memory() -> None:
    """Let malloc keep the buffers of megabytes that come and go with every round, where it is glibc's.

    Else the kernel gives their pages anew each time: half of what taking in large windows costs.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
