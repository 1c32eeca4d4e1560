"""A policy's file, from a path or out of a run: read and judged as a whole before anything acts on it."""

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError

from rmc.actors.policy_runner import PolicyRunner, one_thread
from rmc.analysis import hub
from rmc.common.agent import Agent
from rmc.common.bus.metrics_record import is_complete, is_finite
from rmc.common.checkpoint import POLICY, PROGRESS
from rmc.common.env.config import check_env_config, check_range
from rmc.common.errors import ConfigError, MessageError, first_line, one_line
from rmc.common.policy_header import METADATA_KEY, PolicyHeader
from rmc.common.user_path import user_path
from rmc.deploy.run.checkpoint_choice import choose_checkpoint
from rmc.deploy.run.config import from_dict
from rmc.deploy.run.folder import RunFolder, near_run
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.migrations import FORMAT, migrated
from rmc.deploy.run.validation import validate

OF_SUFFIX = {  # what a file is that is no policy's
    ".json": "no policy's file; give a run's folder or a policy.safetensors",
    ".pt": "a learner's state; give its run's folder, or the policy.safetensors beside it",
    ".onnx": "it is for onnxruntime; give its run, or what rmc export RUN --out policy.safetensors writes",
}
EVALUATED = ("return_mean", "return_std", "episodes")


@dataclass(frozen=True)
class PolicyFile:
    """A policy, and what is known of it."""

    header: PolicyHeader
    blob: bytes
    """Safetensors of its weights; a header in there may know less than ``header``."""

    def with_timeout(self, seconds: float) -> "PolicyFile":
        """The same, with another time for a call into its environment."""
        return replace(self, header=replace(self.header, env=replace(self.header.env, env_timeout=seconds)))

    def encode(self) -> bytes:
        """The file's contents, its header the one here."""
        return safetensors.torch.save(safetensors.torch.load(self.blob), self.header.metadata())


def read_policy(source: str | Path, checkpoint: str = "latest") -> PolicyFile:
    """A policy's file, that of ``hf://owner/name``, or of a run's ``latest``, ``best`` or numbered checkpoint.

    Raises ConfigError.
    """
    if str(source).startswith(hub.SCHEME):
        source = hub.pull(str(source).removeprefix(hub.SCHEME).lstrip("/"))
    path = user_path(source)
    if path.is_dir():
        return _of_run(RunFolder(path), checkpoint)
    if checkpoint != "latest":
        raise ConfigError("--checkpoint", checkpoint, f"{path} is no run's folder; leave it")
    try:
        blob = path.read_bytes()
    except OSError as error:
        fix = near_run(path, "; give a run's folder or a policy.safetensors")
        raise ConfigError("RUN", str(path), f"cannot be read ({error.strerror}){fix}") from None
    try:
        return decode(blob)
    except MessageError as error:
        raise ConfigError("policy file", str(path), OF_SUFFIX.get(path.suffix.lower(), str(error))) from None


def decode(blob: bytes) -> PolicyFile:
    """A file's contents as a policy. Raises MessageError, which says what to do about it."""
    shapes = _shapes(blob)
    facts = _facts(blob)
    if facts is None:
        raise MessageError("no policy", f"its metadata has no {METADATA_KEY}; give the folder of its run")
    header = _header(facts)
    difference = _difference(header, shapes)
    if difference:
        raise MessageError("other sizes than its header's", f"{difference}; copy it again")
    policy_runner(header, blob)  # judges the weights
    return PolicyFile(header, blob)


def _shapes(blob: bytes) -> dict[str, tuple[int, ...]]:
    try:
        return {name: tuple(value.shape) for name, value in safetensors.torch.load(blob).items()}
    except (SafetensorError, ValueError, KeyError) as error:
        raise MessageError("cut, or no safetensors file", f"{one_line(error)}; copy it again") from None


def _facts(blob: bytes) -> Any:
    """What the header of a whole safetensors file says, before any of it is believed; None where there is none."""
    length = int.from_bytes(blob[:8], "little")
    metadata = json.loads(blob[8 : 8 + length]).get("__metadata__") or {}
    text = metadata.get(METADATA_KEY)
    try:
        return None if text is None else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MessageError("damaged header", f"no JSON ({error}); copy it again") from None


def _header(facts: Any) -> PolicyHeader:
    if not isinstance(facts, dict):
        raise MessageError("damaged header", f"{facts!r} is no object; copy it again")
    number, sizes = facts.get("format"), facts.pop("sizes", None)
    wrote = " ".join(str(facts.get("rmc")).split())  # in one line, whatever it is
    if type(number) is not int or number < 1:
        raise MessageError("damaged header", f"its format is {number!r}; copy it again")
    if number > FORMAT:
        fix = f"RMC {wrote} wrote format {number}, this one reads up to {FORMAT}; install that version"
        raise MessageError("newer policy", fix)
    try:
        header = from_dict(PolicyHeader, migrated(facts) | {"format": FORMAT}, "")
        _check_facts(header)
    except ConfigError as error:
        raise MessageError("header of another version", f"RMC {wrote} wrote it; {error}") from None
    if header.sizes() != sizes:
        raise MessageError("damaged header", f"its sizes are {sizes!r}, its parts make {header.sizes()}; copy it again")
    return header


def _check_facts(header: PolicyHeader) -> None:
    """Raises ConfigError for what no run of ours writes: it is shown, and played by."""
    check_env_config(header.env)
    for name in ("seed", "env_steps", "updates", "eval_episodes"):
        check_range(name, getattr(header, name), (0, 2**63 - 1), Integral)
    for name in ("eval_return_mean", "eval_return_std"):
        value = getattr(header, name)
        if not (value is None or is_finite(value)):
            raise ConfigError(name, value, "must be finite")
    if not header.preset.isprintable():
        raise ConfigError("preset", header.preset, "must be of characters that can be seen")


def _difference(header: PolicyHeader, shapes: dict[str, tuple[int, ...]]) -> str:
    """From what a header says; empty where none. Takes no memory for its sizes. Raises MessageError."""
    try:
        with torch.device("meta"):
            agent = Agent(header.obs_dim, header.action_dim, header.agent, header.layout.missing)
            expected = agent.policy_shapes()
    except (RuntimeError, ArithmeticError, TypeError, ValueError, IndexError) as error:  # torch's, for such sizes
        fault = f"no networks have its sizes ({first_line(error)}); copy it again"
        raise MessageError("damaged header", fault) from None
    for name in sorted(expected.keys() | shapes.keys()):
        if expected.get(name) != shapes.get(name):
            return f"{name} has shape {shapes.get(name)}, its header says {expected.get(name)}"
    return ""


def policy_runner(header: PolicyHeader, blob: bytes, rows: int = 1) -> PolicyRunner:
    """What acts by these weights in so many episodes. Raises MessageError for weights that nothing can act by."""
    with one_thread(), torch.inference_mode(mode=False):  # of the caller's, outside of which it may act, too
        runner = PolicyRunner(header.obs_dim, header.action_dim, header.agent, rows, header.layout.missing)
        runner.load(blob)
    return runner


def _of_run(folder: RunFolder, checkpoint: str) -> PolicyFile:
    if folder.is_baseline():
        folder.config()  # says so
    _, files = choose_checkpoint(folder, checkpoint)
    try:
        if POLICY not in files:
            raise MessageError("no policy", f"it holds no {POLICY}")
        has_header = _shapes(files[POLICY]) and _facts(files[POLICY]) is not None
        policy = decode(files[POLICY]) if has_header else _of_older_run(folder, files)
        settings = folder.settings().get("env")
        if not isinstance(settings, dict) or policy.header.env.id != settings.get("id"):
            raise MessageError("weights", f"not a policy of this run (but of {policy.header.env.id})")
    except MessageError as error:
        raise ConfigError("--checkpoint", checkpoint, f"{error}; use another") from None
    policy = replace(policy, header=_evaluated(policy.header, folder))
    seconds = settings.get("env_timeout")  # a resume may have changed it
    return policy.with_timeout(seconds) if is_finite(seconds) and seconds > 0 else policy


def _of_older_run(folder: RunFolder, files: dict[str, bytes]) -> PolicyFile:
    """Of one whose policies have no headers: its environment is made. Raises ConfigError, MessageError."""
    config = folder.config()
    validate(config)
    try:
        progress = {name: int(json.loads(files[PROGRESS])[name]) for name in ("env_steps", "updates")}
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise MessageError("damaged progress", f"{PROGRESS}: {error}") from None
    folder.check_sizes(config.env.id, config.sizes())
    header = replace(config.policy_header(), env_steps=progress["env_steps"], updates=progress["updates"])
    if _difference(header, _shapes(files[POLICY])):
        raise MessageError("weights", "not a policy of this run (its networks have other sizes)")
    policy_runner(header, files[POLICY])
    return PolicyFile(header, files[POLICY])


def _evaluated(header: PolicyHeader, folder: RunFolder) -> PolicyHeader:
    """With how this checkpoint played: when the run ended, or while it trained."""
    result = None
    with suppress(ConfigError):  # damaged: the checkpoint is none the less whole
        result = folder.result()
    records = [result] if result and result["updates"] == header.updates and is_complete(result) else []
    if not records:
        records = MetricsTail(folder.metrics).take()
        records = [one for one in records if one.get("eval_update") == header.updates and is_complete(one)]
    played: dict[str, Any] = records[-1] if records else {}
    if not all(is_finite(played.get(f"eval_{name}")) for name in EVALUATED):
        return header
    mean, deviation, episodes = (played[f"eval_{name}"] for name in EVALUATED)
    return replace(header, eval_return_mean=mean, eval_return_std=deviation, eval_episodes=episodes)
