"""What an environment may change of its whole process, and our code relies on: each has its own, ours and theirs."""

import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np

from rmc.common.process.watchdog import EnvCall

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class ProcessState(NamedTuple):
    """As it is now; None for what cannot be known. Torch's is only asked where it is imported."""

    folder: str | None
    numpy_errors: dict[str, Any]
    dtype: Any
    gradients: bool
    threads: int | None
    device: Any
    handlers: tuple[Any, ...]

    @classmethod
    def read(cls) -> "ProcessState":
        """Takes some microseconds."""
        folder = None
        with suppress(OSError):  # it was deleted
            folder = os.getcwd()
        errors, handlers = dict(np.geterr()), tuple(map(signal.getsignal, SIGNALS))
        torch = sys.modules.get("torch")
        if torch is None or not hasattr(torch, "get_default_device"):  # it may just be being imported
            return cls(folder, errors, None, True, None, None, handlers)
        dtype, device = torch.get_default_dtype(), torch.get_default_device()
        return cls(folder, errors, dtype, torch.is_grad_enabled(), torch.get_num_threads(), device, handlers)

    def install(self, now: "ProcessState") -> None:
        """Where ``now``, as it is, differs."""
        torch = sys.modules.get("torch")
        setters: dict[str, Callable[[Any], Any]] = {
            "folder": _go, "numpy_errors": lambda errors: np.seterr(**errors), "handlers": _catch,
        }  # fmt: skip
        if torch is not None:
            setters |= {
                "dtype": lambda dtype: torch.set_default_dtype(dtype or torch.float32),
                "gradients": torch.set_grad_enabled,
                "threads": lambda threads: torch.set_num_threads(threads or now.threads),
                "device": lambda device: torch.set_default_device(None if str(device) == "cpu" else device),
            }
        for name in self.differences(now) & set(setters):
            setters[name](getattr(self, name))

    def differences(self, other: "ProcessState") -> set[str]:
        """The names of what is not the same."""
        return {name for name, mine, theirs in zip(self._fields, self, other, strict=True) if mine != theirs}


_dtype_lock = threading.Lock()
_callers_dtypes: list[Any] = []  # of what now runs as in a fresh process; the first is the caller's program's


@contextmanager
def torch_as_imported() -> Iterator[None]:
    """Torch's defaults as a fresh process has them; afterwards those of the caller's program.

    The default dtype is one for all threads: it changes back once the last that needs this is over.
    """
    import torch  # slow

    theirs, rounding = ProcessState.read(), _rounding()
    with _dtype_lock:
        _callers_dtypes.append(theirs.dtype)
        theirs._replace(dtype=torch.float32, gradients=True, device=torch.device("cpu")).install(theirs)
    flushes = (torch.tensor(1e-40) * 1).item() == 0.0  # a denormal: nothing can be asked
    try:
        yield
    finally:
        torch.set_flush_denormal(flushes)
        if rounding is not None and rounding != _rounding():
            torch.set_float32_matmul_precision(rounding[0])
            torch.backends.cudnn.allow_tf32 = rounding[1]
        with _dtype_lock:
            now, first = ProcessState.read(), _callers_dtypes[0]
            _callers_dtypes.pop()
            if _callers_dtypes or now.dtype != torch.float32:  # or the caller has chosen another meanwhile
                first = now.dtype
            theirs._replace(dtype=first, folder=now.folder, numpy_errors=now.numpy_errors).install(now)


def _rounding() -> tuple[str, bool] | None:
    """How a GPU rounds float32 products; None where the caller has said so by both of torch's ways."""
    import torch

    with suppress(RuntimeError):
        return torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    return None


def _go(folder: str | None) -> None:
    """Where it is still there."""
    with suppress(OSError):
        os.chdir(folder or "")


def _catch(handlers: tuple[Any, ...]) -> None:
    if threading.current_thread() is threading.main_thread():  # elsewhere none can be set, by nobody
        for number, handler in zip(SIGNALS, handlers, strict=True):
            if handler is not None:  # not set from Python
                signal.signal(number, handler)


class ApartCall(EnvCall):
    """A call in which the process is as the environment has left it; afterwards it is as it was before the call.

    A step is not looked at for changes of its own. Signals' handlers stay ours.
    """

    env_states: dict[str, ProcessState] = {}  # noqa: RUF012 - by an environment's module, where it differs from ours
    changed: dict[str, Any] = {}  # noqa: RUF012 - by any environment of this process: what, and into what

    def __enter__(self) -> "ApartCall":
        super().__enter__()
        env_state = ApartCall.env_states.get(self._module())
        self._ours = ProcessState.read() if self.name != "step" or env_state is not None else None
        self._random = _random_state() if self.name == "make" else None
        if self._ours is not None and env_state is not None:
            env_state._replace(handlers=self._ours.handlers).install(self._ours)
        return self

    def __exit__(self, *error: object) -> None:
        if self._ours is not None:
            self._part(self._ours)
        super().__exit__(*error)

    def _module(self) -> str:
        """That registers it, whose import may change the process for all that it registers; or its id."""
        return self.env_id.rpartition(":")[0] or self.env_id

    def _part(self, ours: ProcessState) -> None:
        now = ProcessState.read()
        if ours.dtype is None and now.dtype is not None:  # torch was imported meanwhile
            torch = sys.modules["torch"]
            ours = ours._replace(dtype=torch.float32, threads=now.threads, device=torch.device("cpu"))
        changed = {name: getattr(now, name) for name in sorted(ours.differences(now))}
        if self._random is not None and self._random != _random_state():
            changed["random"] = None
        ApartCall.changed |= changed
        ours.install(now)
        ApartCall.env_states.pop(self._module(), None)
        if set(changed) - {"handlers", "random"}:
            ApartCall.env_states[self._module()] = now


def _random_state() -> tuple[Any, ...]:
    """Of the generators that all share; it changes where they are seeded, and after hundreds of draws."""
    torch = sys.modules.get("torch")
    seed = torch.initial_seed() if torch is not None and hasattr(torch, "initial_seed") else None
    return str(np.random.get_state()[1]), random.getstate()[1][:-1], seed  # type: ignore[index] # noqa: NPY002


DESCRIPTIONS = {
    "folder": "the working folder ({})",
    "numpy_errors": "numpy's error state",
    "dtype": "torch's default dtype ({})",
    "gradients": "torch's grad mode ({})",
    "threads": "torch's threads ({})",
    "device": "torch's default device ({})",
    "handlers": "the handlers of signals",
    "random": "the random generators that all share",
}


def changes() -> list[str]:
    """What environments have changed of this process so far, in words."""
    return [DESCRIPTIONS[name].format(value) for name, value in ApartCall.changed.items()]
