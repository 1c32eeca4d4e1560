"""What an environment may change of its whole process, and our code relies on: each has its own, ours and theirs."""

import logging
import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from rmc.common.process.watchdog import EnvCall

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD, signal.SIGPIPE)
OURS = "rmc."  # with which our loggers' names begin
STAY_OURS = ("handlers", "streams", "logs", "random")  # which an environment does not find again as it left them
OF_TORCH = ("dtype", "gradients", "threads", "device")  # a process's state that is torch's


class ProcessState(NamedTuple):
    """As it is now; None for what cannot be known. Torch's is only asked where it is imported."""

    folder: str | None
    numpy_errors: dict[str, Any]
    dtype: Any
    gradients: bool
    threads: int | None
    device: Any
    handlers: tuple[Any, ...]
    streams: tuple[Any, Any]
    logs: tuple[Any, ...]

    @classmethod
    def read(cls) -> "ProcessState":
        """Takes some microseconds."""
        folder = None
        with suppress(OSError):  # it was deleted
            folder = os.getcwd()
        errors, handlers = dict(np.geterr()), tuple(map(signal.getsignal, SIGNALS))
        others = handlers, (sys.stdout, sys.stderr), _logs()
        torch = sys.modules.get("torch")
        if torch is None or not hasattr(torch, "get_default_device"):  # it may just be being imported
            return cls(folder, errors, None, True, None, None, *others)
        dtype, device = torch.get_default_dtype(), torch.get_default_device()
        return cls(folder, errors, dtype, torch.is_grad_enabled(), torch.get_num_threads(), device, *others)

    def install(self, now: "ProcessState") -> None:
        """Where ``now``, as it is, differs."""
        torch = sys.modules.get("torch")
        setters: dict[str, Callable[[Any], Any]] = {
            "folder": _go, "numpy_errors": lambda errors: np.seterr(**errors), "handlers": _catch,
            "streams": _write_to, "logs": _log_by,
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

    @contextmanager
    def of_torch(self) -> Iterator[None]:
        """Within it torch's defaults and threads are as they were when this was read."""
        ours = ProcessState.read()
        if self.dtype is not None:  # there was a torch
            ours._replace(**{name: getattr(self, name) for name in OF_TORCH}).install(ours)
        try:
            yield
        finally:
            now = ProcessState.read()
            now._replace(**{name: getattr(ours, name) for name in OF_TORCH}).install(now)

    def differences(self, other: "ProcessState") -> set[str]:
        """The names of what is not the same."""
        return {name for name, mine, theirs in zip(self._fields, self, other, strict=True) if mine != theirs}


_dtype_lock = threading.Lock()
_callers: list[ProcessState] = []  # of what now runs as in a fresh process; the first is the caller's program's


@contextmanager
def torch_as_imported() -> Iterator[None]:
    """Torch's defaults as a fresh process has them; afterwards those of the caller's program.

    The default dtype is one for all threads: it changes back once the last that needs this is over.
    """
    import torch  # slow

    theirs, rounding = ProcessState.read(), _rounding()
    with _dtype_lock:
        if _callers:  # what another thread plays takes one thread now and then
            theirs = theirs._replace(threads=_callers[0].threads)
        _callers.append(theirs)
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
            now, first = ProcessState.read(), _callers[0].dtype
            _callers.pop()
            if _callers or now.dtype != torch.float32:  # or the caller has chosen another meanwhile
                first = now.dtype
            kept = {name: getattr(now, name) for name in ("folder", "numpy_errors", "streams", "logs")}
            theirs._replace(dtype=first, **kept).install(now)


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


def _is_main() -> bool:
    """Elsewhere no handler can be set, by nobody; and what others change of streams and logging is the program's."""
    return threading.current_thread() is threading.main_thread()


def _catch(handlers: tuple[Any, ...]) -> None:
    if _is_main():
        for number, handler in zip(SIGNALS, handlers, strict=True):
            if handler is not None:  # not set from Python
                signal.signal(number, handler)


def _write_to(streams: tuple[Any, Any]) -> None:
    if _is_main():
        sys.stdout, sys.stderr = streams


def _logs() -> tuple[Any, ...]:
    """How the root logs, up to which level nobody does, and who of ours is off."""
    root = logging.getLogger()
    off = frozenset(logger for logger in _our_loggers(len(root.manager.loggerDict)) if logger.disabled)
    return root.level, tuple(root.handlers), root.manager.disable, off


def _log_by(logs: tuple[Any, ...]) -> None:
    if not _is_main():
        return
    root, (level, handlers, disabled, off) = logging.getLogger(), logs
    root.setLevel(level)
    root.handlers[:] = handlers
    logging.disable(disabled)
    for logger in _our_loggers(len(root.manager.loggerDict)):
        logger.disabled = logger in off


@lru_cache(maxsize=1)
def _our_loggers(known: int) -> list[logging.Logger]:
    """Among so many that are known; none ever goes."""
    every = list(logging.getLogger().manager.loggerDict.values())[:known]  # a copy: other threads may add some
    return [one for one in every if isinstance(one, logging.Logger) and one.name.startswith(OURS)]


class ApartCall(EnvCall):
    """A call in which the process is as the environment has left it; afterwards it is as it was before the call.

    A step is not looked at for changes of its own. Signals' handlers, streams and logging stay ours.
    """

    env_states: dict[str, dict[str, Any]] = {}  # noqa: RUF012 - by an environment's module: what differs from ours
    changed: dict[str, Any] = {}  # noqa: RUF012 - by any environment of this process: what, and into what
    variables: dict[str, tuple[str | None, str | None]] = {}  # noqa: RUF012 - as one is made: before, and after

    def __enter__(self) -> "ApartCall":
        super().__enter__()
        env_state = ApartCall.env_states.get(self._module())
        self._ours = ProcessState.read() if self.name != "step" or env_state is not None else None
        self._random = _random_state() if self.name == "make" else None
        self._variables = dict(os.environ) if self.name == "make" else None
        if self._ours is not None and env_state is not None:
            self._ours._replace(**env_state).install(self._ours)
        return self

    def __exit__(self, *error: object) -> None:
        if self._ours is not None:
            self._part(self._ours)
        if self._variables is not None:
            self._note_variables(self._variables)
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
        if own := {name: value for name, value in changed.items() if name not in STAY_OURS}:
            ApartCall.env_states[self._module()] = own

    def _note_variables(self, before: dict[str, str]) -> None:
        for name in before.keys() | os.environ.keys():
            was, now = before.get(name), os.environ.get(name)
            if was != now:
                first, left = ApartCall.variables.get(name, (was, was))
                ApartCall.variables[name] = (first if was == left else was), now  # or the program has set it since


def our_variables() -> dict[str, str]:
    """This process's environment variables, without what environments have made of them as they were made."""
    undone = {name: was for name, (was, now) in ApartCall.variables.items() if os.environ.get(name) == now}
    return {name: value for name, value in {**os.environ, **undone}.items() if value is not None}


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
    "streams": "sys.stdout and sys.stderr",
    "logs": "the setup of logging",
    "random": "the random generators that all share",
}


def changes() -> list[str]:
    """What environments have changed of this process so far, in words."""
    return [DESCRIPTIONS[name].format(value) for name, value in ApartCall.changed.items()]
