"""Whether this machine can do it, asked before anything starts: the ring, the device, the cores."""

import errno
import math
import os
import re
import shutil
import socket
from pathlib import Path

from rich.filesize import decimal as size_text

from rmc.common.bus.weight_store import LARGEST_BYTES
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.host import existing_parent, free_memory, memory_limit
from rmc.deploy.run.launch_options import LaunchOptions

DISK_RESERVE = 256 << 20  # bytes left for checkpoints, metrics and logs


def check_machine(config: RunConfig, options: LaunchOptions) -> None:
    """Raises ConfigError where device, disk, memory or port does not do. On Ray, device and ring are a node's."""
    if options.launcher != "ray":
        check_learner(config, options.device)
    if options.launcher in ("local", "lockstep"):
        check_ring_fits(config, options)
    check_port(options)


def check_port(options: LaunchOptions) -> None:
    """Raises ConfigError where metrics are to be served, and cannot be there now."""
    host, port = options.metrics_host, options.metrics_port
    if port is not None:
        listening(host, port, "--metrics-host", "--metrics-port", socket.AF_INET, lowest=1).close()


def listening(
    host: str, port: int, host_option: str, port_option: str, family: int = socket.AF_UNSPEC, lowest: int = 0
) -> socket.socket:
    """Raises ConfigError where there is no such address on this machine, or the port cannot be had."""
    if not lowest <= port <= 65_535:
        raise ConfigError(port_option, port, f"take a port from {lowest} to 65535")
    try:
        found, *_, address = socket.getaddrinfo(host, port, family, socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=found)
    except (OSError, UnicodeError) as error:
        if not isinstance(error, OSError) or isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            kind = "IPv4 address" if family == socket.AF_INET else "address"
            raise ConfigError(host_option, host, f"is no {kind} of this machine; take one, like 127.0.0.1") from None
        another = "another" if lowest else "another, or 0 for a free one"
        raise ConfigError(port_option, port, f"{os.strerror(error.errno or 0)} on {host}; take {another}") from None


def check_learner(config: RunConfig, device: str) -> None:
    """Raises ConfigError where the device is not there, or a CPU's memory holds no networks or no batch."""
    check_device(device)
    if device == "cpu":
        check_networks_fit(config)
        check_batch_fits(config)


def ring_bytes(config: RunConfig) -> int:
    """Of the rings of all replay servers, on disk and mapped. Makes an environment once."""
    from rmc.replay_server import ring  # imports numba

    shards = config.replay.replay_shards
    return shards * ring.file_bytes(config.window_spec(), -(-config.replay.capacity // shards))


def ring_bytes_there(config: RunConfig, options: LaunchOptions) -> int:
    """What of that a run that goes on has on the disk already."""
    if options.run_dir is None or options.if_exists == "new":
        return 0
    rings = [options.run_dir / shard.role / "ring" for shard in config.shards()]
    return sum(path.stat().st_size for path in rings if path.exists())


def check_ring_fits(config: RunConfig, options: LaunchOptions) -> None:
    """Raises ConfigError where a run's rings are larger than the free disk or the machine's memory.

    A ring is a mapped file; one larger than the memory would turn every draw into disk reads.
    """
    size, capacity, row = ring_bytes(config), config.replay.capacity, config.window_spec().dtype.itemsize

    def most(room: int) -> int:  # a run that goes on has a ring of this capacity for good
        return 0 if options.goes_on else max(0, capacity - -(-(size - room) // row))

    free_disk = shutil.disk_usage(existing_parent((options.run_dir or Path("runs")).absolute())).free
    room = ring_bytes_there(config, options) + max(0, free_disk - DISK_RESERVE)
    if size > room:
        needs = f"takes {size_text(size)} of disk beside {size_text(DISK_RESERVE)} for checkpoints and logs"
        fix = f"take at most {most(room)}" if most(room) else "make room"
        raise ConfigError("--capacity", capacity, f"{needs}, {size_text(free_disk)} are free; {fix}")
    memory = memory_limit()
    if size > memory:
        fix = f"take at most {most(memory)}" if most(memory) else "take a machine with more"
        raise ConfigError("--capacity", capacity, f"takes {size_text(size)} of {size_text(memory)} memory; {fix}")


def check_networks_fit(config: RunConfig) -> None:
    """Raises ConfigError where the networks are larger than the free memory, by the least that they can take.

    That is each weight, its gradient and Adam's two moments, of the GRU's square matrices and the heads' second layers.
    A policy is also held to what is published at once.
    """
    hidden, heads, memory = config.agent.hidden, config.agent.heads, free_memory()
    sizes = (("--hidden", hidden, 3 * hidden**2, 1), ("--heads", heads, 4 * math.prod(heads), 4))
    for name, value, weights, networks in sizes:
        if (needed := 4 * 4 * weights) > memory:
            fault = f"its weights take {size_text(needed)} of {size_text(memory)} free memory in training"
            raise ConfigError(name, value, f"{fault}; take fewer units")
        if (policy := 4 * weights // networks) > LARGEST_BYTES:
            fault = f"its weights take {size_text(policy)} of {size_text(LARGEST_BYTES)} that a policy may have"
            raise ConfigError(name, value, f"{fault}; take fewer units")


def check_batch_fits(config: RunConfig) -> None:
    """Raises ConfigError where an update's batch is larger than the free memory, by the least that it can take.

    That is its rows, and of each trained step what the way back reads: the GRU's gates and state in float32, and in
    bfloat16 the hidden layers of world model, policy, and both critics of two actions. ``--dry-run`` measures the rest.
    """
    spec, heads, size = config.window_spec(), config.agent.heads, config.learner.batch_size
    step = 4 * 5 * config.agent.hidden + 2 * 6 * sum(heads)
    window, memory = spec.dtype.itemsize + spec.train * step, free_memory()
    if (needed := size * window) <= memory:
        return
    fault = f"an update of windows of {spec.steps} steps takes {size_text(needed)} of {size_text(memory)} free memory"
    fix = f"take at most {memory // window}" if memory >= window else "take fewer steps a window"
    raise ConfigError("--batch-size", size, f"{fault}; {fix}")


def check_device(device: str) -> None:
    """Raises ConfigError where the device is not there."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise ConfigError("--device", device, "take cpu, cuda or cuda:N")
    if device.startswith("cuda"):
        import torch  # takes a second, which no other check needs

        count = torch.cuda.device_count() if torch.cuda.is_available() else 0  # the driver may be too old
        number = int(device.removeprefix("cuda").lstrip(":") or 0)
        if not count:
            raise ConfigError("--device", device, "PyTorch sees no CUDA device; use --device cpu")
        if number >= count:
            raise ConfigError("--device", device, f"PyTorch sees {count}; take cuda:0 to cuda:{count - 1}")


def two_processes(config: RunConfig, cores: int, device: str = "cpu") -> bool:
    """Whether each half of an update has a process of its own."""
    return device == "cpu" and config.update.halves_are_apart() and min(cores, config.learner.threads or cores) > 1


def thread_choices(config: RunConfig, cores: int, device: str = "cpu") -> tuple[int, ...]:
    """Threads of an update, of each half where both have a process: what ``--threads`` says, or what is to be tried."""
    halves = 2 if two_processes(config, cores, device) else 1
    if config.learner.threads:
        return (max(1, config.learner.threads // halves),)
    if device != "cpu":
        return (1,)
    return tuple(2**power for power in range(cores.bit_length()) if halves * 2**power <= cores)


def learner_threads(config: RunConfig, cores: int) -> int:
    """Threads of the learner where nothing has been tried yet: the least."""
    return thread_choices(config, cores)[0] * (2 if two_processes(config, cores) else 1)
