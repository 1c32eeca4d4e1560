"""What a baseline is trained with: as the paper sizes its networks, or as rl-baselines3-zoo tuned it.

The zoo's numbers are those of hyperparams/*.yml at its commit 00128b5, for MuJoCo's v3 environments (Reacher-v2);
CrossQ's, TD3's and DDPG's at 208b6fd, for v4.
"""

from dataclasses import dataclass, field, fields
from typing import Any, Literal

from rmc.common.env.config import EnvConfig, check_range
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import from_dict
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.option_names import option

Algorithm = Literal["sac", "crossq", "td3", "ddpg", "ppo", "recurrent-ppo"]
Settings = Literal["paper", "zoo", "default"]
Precision = Literal["auto", "fp32"]
PAPER_NET = [400, 300]
OFF_POLICY = ("sac", "crossq", "td3", "ddpg")
NAMES = {"crossq": "CrossQ", "recurrent-ppo": "RecurrentPPO"}
BEFORE = {"precision": "fp32"}  # of a run that began before there was a choice
NOISE = 0.1  # of TD3's and DDPG's actions, where the zoo explores by Gaussian noise

_LEARNING_STARTS = {"learning_starts": 10_000}
_WITH_NOISE = _LEARNING_STARTS | {"learning_rate": 1e-3, "batch_size": 256, "train_freq": 1, "gradient_steps": 1}
_WIDE = {"log_std_init": -2.0, "ortho_init": False, "net_arch": {"pi": [256, 256], "vf": [256, 256]}}
_CROSSQ_NET = {"pi": [256, 256], "qf": [2048, 2048]}
_PPO_COLUMNS = (
    "batch_size", "n_steps", "gamma", "learning_rate", "ent_coef", "clip_range", "n_epochs", "gae_lambda",
    "max_grad_norm", "vf_coef",
)  # fmt: skip
_PPO_ROWS: dict[str, tuple[float, ...]] = {
    "HalfCheetah": (64, 512, 0.98, 2.0633e-05, 0.000401762, 0.1, 20, 0.92, 0.8, 0.58096),
    "Hopper": (32, 512, 0.999, 9.80828e-05, 0.00229519, 0.2, 5, 0.99, 0.7, 0.835671),
    "Walker2d": (32, 512, 0.99, 5.05041e-05, 0.000585045, 0.1, 20, 0.95, 1.0, 0.871923),
    "Humanoid": (256, 512, 0.95, 3.56987e-05, 0.00238306, 0.3, 5, 0.9, 2.0, 0.431892),
    "HumanoidStandup": (32, 512, 0.99, 2.55673e-05, 3.62109e-06, 0.3, 20, 0.9, 0.7, 0.430793),
    "InvertedPendulum": (64, 32, 0.999, 0.000222425, 1.37976e-07, 0.4, 5, 0.9, 0.3, 0.19816),
    "Reacher": (32, 512, 0.9, 0.000104019, 7.52585e-08, 0.3, 5, 1.0, 0.9, 0.950368),
    "InvertedDoublePendulum": (512, 128, 0.98, 0.000155454, 1.05057e-06, 0.4, 10, 0.8, 0.5, 0.695929),
}
_PPO_WIDE = {"HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup"}


@dataclass(frozen=True)
class BaselineConfig:
    """A baseline's run."""

    algorithm: Algorithm
    """Which one."""
    env: EnvConfig
    """The environment."""
    settings: Settings = "paper"
    """Networks of 400 and 300 units, what rl-baselines3-zoo tuned, or stable-baselines3's own defaults."""
    seed: int = 0
    """Seed of networks, environment and sampling."""
    total_steps: int = 1_000_000
    """Agent steps of the run."""
    checkpoint_steps: int = 10_000
    """Agent steps between evaluations."""
    episodes: int = 5
    """Episodes of an evaluation."""
    threads: int = 1
    """CPU threads of the run."""
    precision: Precision = "auto"
    """Of an update's matrix products. auto: bfloat16 for off-policy agents, where the CPU has instructions for it."""

    @property
    def name(self) -> str:
        """What plots call it."""
        kind = NAMES.get(self.algorithm, self.algorithm.upper())
        return {"paper": f"{kind} 400-300", "zoo": f"{kind} zoo", "default": kind}[self.settings]


def read_config(folder: RunFolder) -> BaselineConfig:
    """A baseline's config from its folder. Raises ConfigError."""
    raw = folder.settings()
    try:
        raw = BEFORE | raw
        config = from_dict(BaselineConfig, {item.name: raw[item.name] for item in fields(BaselineConfig)}, "")
        validate(config)
    except (KeyError, ConfigError) as error:
        fix = f"its config.json is no baseline's of this version ({error}); restore it, or train another run"
        raise ConfigError("RUN", str(folder.path), fix) from None
    return config


def validate(config: BaselineConfig) -> None:
    """Raises ConfigError for the first number that makes no sense."""
    ranges = {"seed": (0, 2**32 - 1), "total_steps": (1, 2**53), "checkpoint_steps": (1, 2**53)}
    for name, limits in (ranges | {"episodes": (1, 10_000), "threads": (1, 1024)}).items():
        check_range(option(name), getattr(config, name), limits)


@dataclass(frozen=True)
class Choice:
    """Arguments of stable-baselines3's class, and what stands around it."""

    arguments: dict[str, Any] = field(default_factory=dict)
    network: dict[str, Any] = field(default_factory=dict)  # its policy_kwargs
    relu: bool = False  # on-policy ones have tanh by default
    noise: float = 0.0  # deviation of the actions' noise
    normalize: bool = False  # observations and rewards by running statistics


def choose(algorithm: Algorithm, settings: Settings, env_id: str) -> Choice:
    """For an environment; those that the zoo has not tuned have its defaults for MuJoCo."""
    noise = NOISE if algorithm in ("td3", "ddpg") else 0.0
    if settings == "default":
        return Choice(noise=noise)
    if settings == "paper":
        return Choice(network={"net_arch": PAPER_NET}, noise=noise)
    body = env_id.rpartition("/")[2].partition("-")[0]
    far = {"gamma": 0.999 if algorithm == "crossq" else 0.9999} if body == "Swimmer" else {}
    if algorithm == "sac":
        return Choice(_LEARNING_STARTS | far)
    if algorithm == "crossq":
        return Choice({"learning_starts": 5_000} | far, {"net_arch": dict(_CROSSQ_NET)})
    if algorithm in OFF_POLICY:
        return Choice(_WITH_NOISE | far, {"net_arch": PAPER_NET}, noise=noise)
    row = _PPO_ROWS.get(body)
    if row is None:
        return Choice(far, normalize=True)
    arguments = dict(zip(_PPO_COLUMNS, row, strict=True))
    wide = body in _PPO_WIDE
    return Choice(arguments, dict(_WIDE) if wide else {}, relu=wide, normalize=True)
