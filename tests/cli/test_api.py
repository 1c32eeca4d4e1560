"""``rmc.train``, ``rmc.resume``, ``rmc.evaluate``: what cannot work is one line before anything starts."""

import dataclasses
import errno
import json
import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import rmc
from rmc import api
from rmc.cli.signals import signals_caught, signals_interrupt
from rmc.common.errors import STOPPED_STATUS
from rmc.deploy.run.config import checked, to_json
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import PATH_VARIABLE, LaunchOptions
from rmc.deploy.run.opening import open_run
from tests.runs import untrained

CONFIG = rmc.presets.debug("InvertedPendulum-v5")


def test_a_preset_takes_an_id_as_well() -> None:
    for preset in (rmc.presets.robust, rmc.presets.memory, rmc.presets.paper, rmc.presets.debug):
        assert preset("Ant-v5") == preset(rmc.EnvConfig("Ant-v5"))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"total_steps": 1e5}, r"total_steps=100000.0: must be int"),
        ({"seed": "1"}, r"seed='1': must be int"),
        ({"env": "Ant-v5"}, r"env='Ant-v5': must be an object, in Python of class EnvConfig"),
        ({"agent": dataclasses.replace(CONFIG.agent, head_input="all")}, r"agent.head_input='all': must be one of"),
        ({"agent": dataclasses.replace(CONFIG.agent, heads=(8, 8, 8))}, r"agent.heads=\[8, 8, 8\]: must be tuple"),
        ({"actors": np.float64(2)}, r"actors=2.0: must be int"),
        ({"seed": {1}}, r"seed=\{1\}: set is not JSON's; take numbers, text"),
        (
            {"agent": dataclasses.replace(CONFIG.agent, heads=np.ones(2))},
            r"agent.heads=array.*: ndarray is not JSON's",
        ),
    ],
)
def test_a_value_of_a_wrong_type_is_named(changes: dict[str, Any], line: str, tmp_path: Path) -> None:
    with pytest.raises(rmc.ConfigError, match=f"^{line}"):
        rmc.train(dataclasses.replace(CONFIG, **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_numbers_of_numpy_are_taken() -> None:
    kwargs = {"size": np.int64(4), "at": [np.float64(0.5)], "deep": np.bool_(True)}
    given = dataclasses.replace(
        CONFIG,
        env=rmc.EnvConfig("InvertedPendulum-v5", flicker=np.float32(0.5), env_kwargs=kwargs),  # type: ignore[arg-type]
        seed=np.int64(3),  # type: ignore[arg-type]
        actors=np.uint8(2),  # type: ignore[arg-type]
        agent=dataclasses.replace(CONFIG.agent, heads=tuple(np.array([8, 16]))),
    )
    config = checked(given)
    assert to_json(config) == to_json(checked(config))
    assert (config.seed, config.actors, config.agent.heads, config.env.flicker) == (3, 2, (8, 16), 0.5)
    assert config.env.env_kwargs == {"size": 4, "at": [0.5], "deep": True}
    assert {type(config.seed), type(config.env.env_kwargs["size"])} == {int}
    ranges = dataclasses.replace(CONFIG.env, env_kwargs={"w": (0.2, (1,))})  # as gymnasium writes them
    assert checked(dataclasses.replace(CONFIG, env=ranges)).env.env_kwargs == {"w": [0.2, [1]]}


@pytest.mark.parametrize(
    "kwargs",
    [
        {"w": {1: 2, "1": 3}},
        {"w": {1: 2}},
        {1: 2},
        {"w": float("nan")},
        {"w": np.ones(2)},
    ],
)
def test_keywords_that_json_would_change_are_refused(kwargs: dict[Any, Any], tmp_path: Path) -> None:
    env = rmc.EnvConfig("InvertedPendulum-v5", env_kwargs=kwargs)
    with pytest.raises(rmc.ConfigError, match=r"^--env-kwargs [w1]=.*: take finite numbers, .*, or dicts"):
        rmc.train(dataclasses.replace(CONFIG, env=env), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"launcher": "locla"}, "launcher='locla': must be one of 'local', 'ray', 'lockstep', 'manual'"),
        ({"if_exists": "overwrite"}, "if_exists='overwrite': must be one of 'resume', 'fail', 'new'"),
        ({"track": "neptune"}, "track='neptune': must be one of 'wandb', 'trackio', 'mlflow' or one of 'off' or None"),
        ({"init_parts": "half"}, r"init_parts='half': must be one of 'all', 'memory\+world-model', 'policy'"),
        ({"metrics_port": "9000"}, "metrics_port='9000': must be int or None"),
        ({"video_every": 1.0}, "video_every=1.0: must be int or None"),
        ({"redis_url": 5}, "redis_url=5: must be str or None"),
        ({"all_cpus": 1}, "all_cpus=1: must be bool"),
        ({"track_tags": "abc"}, "track_tags='abc': take a list of texts"),
        ({"track_tags": 5}, "track_tags=5: take a list of texts"),
        ({"track_tags": [5]}, r"track_tags\[0\]=5: must be str"),
    ],
)
def test_a_choice_that_there_is_none_of_is_refused(options: dict[str, Any], line: str, tmp_path: Path) -> None:
    with pytest.raises(rmc.ConfigError, match=f"^{line}$"):
        rmc.train(CONFIG, tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


def test_arguments_of_another_kind_are_refused() -> None:
    for episodes in (2.5, True, "3", None, 0):
        with pytest.raises(rmc.ConfigError, match=r"^--episodes=.*: take a whole number from 1 to 10_000$"):
            rmc.evaluate("runs/none", episodes)
    for flicker in (True, "x", 1.5):
        with pytest.raises(rmc.ConfigError, match=r"^--flicker=.*: take a number from 0.0 to 1.0$"):
            rmc.evaluate("runs/none", flicker=flicker)
    for call in (rmc.evaluate, rmc.load_policy, rmc.resume, lambda path: rmc.train(CONFIG, path)):
        with pytest.raises(rmc.ConfigError, match=r"^path=5: take text or a Path$"):
            call(5)
    with pytest.raises(rmc.ConfigError, match=r"^seed=-1: take a whole number from 0"):
        rmc.load_policy("runs/none", seed=-1)


def test_a_tilde_is_the_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    untrained(tmp_path / "run", CONFIG)
    with pytest.raises(rmc.ConfigError, match=rf"^--run-dir='{tmp_path}/run': is there already"):
        rmc.train(CONFIG, "~/run", if_exists="fail")
    with pytest.raises(rmc.ConfigError, match=f"^RUN='{tmp_path}/none': is not there; give the folder of a run"):
        rmc.resume("~/none")
    with pytest.raises(rmc.ConfigError, match=f"^RUN='{tmp_path}/none': cannot be read"):
        rmc.evaluate("~/none")
    with pytest.raises(rmc.ConfigError, match="--init-from='~/run': it has no checkpoint yet"):
        rmc.train(CONFIG, tmp_path / "other", init_from="~/run")


def test_a_runs_config_is_what_it_was_trained_with(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, seed=7, env=rmc.EnvConfig("InvertedPendulum-v5", env_kwargs={"frame_skip": 3}))
    untrained(tmp_path / "run", config)
    assert rmc.load_config(tmp_path / "run") == rmc.load_config(str(tmp_path / "run")) == config
    (tmp_path / "run" / "config.json").write_text("{")
    with pytest.raises(rmc.ConfigError, match=r"config\.json.*not JSON"):
        rmc.load_config(tmp_path / "run")


def test_what_is_no_config_is_refused() -> None:
    with pytest.raises(rmc.ConfigError, match=r"^config='Ant-v5': take a RunConfig"):
        rmc.train("Ant-v5")  # type: ignore[arg-type]


class Mine(gymnasium.Env):  # type: ignore[type-arg]
    """Never made."""


def test_an_environment_of_the_script_itself_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Mine, "__module__", "__main__")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(tmp_path / "script.py"), raising=False)
    monkeypatch.setenv(PATH_VARIABLE, "")
    gymnasium.register("Mine-v0", entry_point=Mine)
    try:
        for launcher in ("local", "ray"):
            with pytest.raises(
                rmc.ConfigError, match=r"^ENV='Mine-v0': is registered in this process .*module:Mine-v0"
            ):
                rmc.train(rmc.presets.debug("Mine-v0"), tmp_path / "run", launcher=launcher)  # type: ignore[arg-type]
    finally:
        del gymnasium.registry["Mine-v0"]
    assert os.environ[PATH_VARIABLE] == str(tmp_path.resolve())


def test_an_id_that_only_this_process_knows_is_refused(tmp_path: Path) -> None:
    """Its class is a module's, but no module is named that would register it."""
    gymnasium.register("Mine-v1", entry_point="tests.memory_env:MemoryEnv")
    try:
        with pytest.raises(rmc.ConfigError, match=r"^ENV='Mine-v1': is registered in this process .*module:Mine-v1"):
            rmc.train(rmc.presets.debug("Mine-v1"), tmp_path / "run")
    finally:
        del gymnasium.registry["Mine-v1"]


@pytest.mark.parametrize("name", ["Mine-v2", "Pendulum-v1"])
def test_gymnasiums_classes_under_an_id_or_a_limit_of_ones_own_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    monkeypatch.delitem(gymnasium.registry, name, raising=False)
    pendulum = "gymnasium.envs.classic_control.pendulum:PendulumEnv"
    gymnasium.register(name, entry_point=pendulum, max_episode_steps=1000)
    with pytest.raises(rmc.ConfigError, match=rf"^ENV='{name}': is registered in this process"):
        rmc.train(rmc.presets.debug(name), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_gymnasium_registers_by_a_function_is_known_to_all() -> None:
    """Its text has an address, which is another in each process."""
    functions = [spec for spec in gymnasium.registry.values() if not isinstance(spec.entry_point, str)]
    assert api._is_known_to_all(functions[0])


def test_a_callbacks_error_is_raised_at_once_where_a_program_around_python_hears_ctrl_c(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It would reach that program, not the run."""
    callback = api._Callback(lambda record: record["none"])
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    monkeypatch.setattr(signal, "raise_signal", lambda number: pytest.fail("it was sent to the program"))
    with pytest.raises(KeyError):
        callback({})
    assert isinstance(callback.error, KeyError)


def test_a_callbacks_error_ends_a_run_whose_ctrl_c_is_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with signals_caught() as stop:
            api._Callback(lambda record: record["none"])({})
            assert stop.requested
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_error_reaches_another_process_whole() -> None:
    error = rmc.ConfigError("--seed", -1, "must be 0 or more")
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.field, copy.value, copy.fix) == (str(error), "--seed", -1, "must be 0 or more")


def test_a_signal_that_a_program_around_python_has_taken_stays_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python then knows of no handler, and could not put it back."""
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with signals_caught(), signals_interrupt():
        monkeypatch.undo()
        assert signal.getsignal(signal.SIGTERM) == before


def test_a_thread_is_refused_before_there_is_a_folder(tmp_path: Path) -> None:
    """Only the main thread hears Ctrl-C."""
    with ThreadPoolExecutor(1) as pool, pytest.raises(rmc.ConfigError, match=r"is no main thread.*; call it there"):
        pool.submit(rmc.train, CONFIG, tmp_path / "run", launcher="lockstep").result()
    assert not (tmp_path / "run").exists()


def test_a_start_that_fails_lets_the_next_one_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write_config", full)
        with pytest.raises(OSError, match="No space left"):
            rmc.train(CONFIG, tmp_path / "run", launcher="lockstep")
    RunFolder(tmp_path / "run").lock.take()


def test_a_role_finds_modules_beside_the_script_that_trains(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text(
        "import gymnasium as gym\ngym.register('Beside-v0', entry_point='gymnasium.envs.classic_control:PendulumEnv')\n"
    )
    words = [sys.executable, "-P", "-m", "rmc.cli.main", "check-env", "beside:Beside-v0", "--steps", "2"]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path, status in ((str(tmp_path), 0), ("", 2)):
        environment = os.environ | {PATH_VARIABLE: path}
        done = subprocess.run(words, cwd=elsewhere, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr


def test_without_a_folder_the_result_names_the_one_that_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = rmc.train(dataclasses.replace(CONFIG, total_steps=600), launcher="lockstep")
    assert Path(result["run_dir"]).parent == tmp_path / "runs"
    assert rmc.resume(result["run_dir"])["env_steps"] == result["env_steps"] == 600


def test_what_torch_draws_is_the_callers_also_meanwhile_in_its_dtype(tmp_path: Path) -> None:
    torch.set_flush_denormal(False)
    torch.manual_seed(123)
    drawn: list[float] = []
    config = dataclasses.replace(CONFIG, total_steps=600)
    torch.set_default_dtype(torch.float64)
    try:
        rmc.train(config, tmp_path / "run", launcher="lockstep", callback=lambda _: drawn.append(torch.rand(1).item()))
        drawn.append(torch.rand(1).item())
        torch.manual_seed(123)
        assert drawn == [torch.rand(1).item() for _ in drawn]
    finally:
        torch.set_default_dtype(torch.float32)
    assert (torch.tensor(1e-40) * 1).item() > 0  # a denormal


class Enough(Exception):
    """A caller's own."""


@pytest.mark.parametrize("launcher", ["lockstep", "local"])
def test_a_callback_hears_each_record_and_its_error_ends_a_run_that_goes_on(launcher: Any, tmp_path: Path) -> None:
    heard: list[dict[str, Any]] = []

    def until_updates(record: dict[str, Any]) -> None:
        heard.append(record)
        all_speak = {"actor-0", "replay", "launcher"} <= {one["role"] for one in heard}
        if record["role"] == "learner" and record["updates"] > 10 and all_speak:
            record.clear()  # its own copy
            raise Enough

    config = dataclasses.replace(CONFIG, total_steps=1_000_000)
    with pytest.raises(Enough):
        rmc.train(config, tmp_path / "run", launcher=launcher, callback=until_updates)
    folder = RunFolder(tmp_path / "run")
    written = [json.loads(line) for line in folder.metrics.read_text().splitlines()]
    assert heard.pop() == {}
    assert [record for record in written if record in heard] == heard
    assert folder.lock.ended() == STOPPED_STATUS
    if launcher == "lockstep":  # integration/test_end_to_end.py resumes a run of processes
        steps = written[len(heard)]["env_steps"]
        heard.clear()
        result = rmc.resume(tmp_path / "run", total_steps=steps + 300, callback=heard.append)
        assert result["env_steps"] >= steps
        assert {"learner", "actor-0", "replay", "launcher"} <= {record["role"] for record in heard}


def test_a_number_of_actors_takes_the_place_of_a_cluster_that_was_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = LaunchOptions(tmp_path / "run", launcher="ray", all_cpus=True)
    open_run(CONFIG, last).lock.release()
    said: list[Any] = []
    monkeypatch.setattr(api, "_train", lambda config, options, _: said.append((config.actors, options.all_cpus)))
    rmc.resume(last.run_dir or "")
    rmc.resume(last.run_dir or "", actors=4)
    assert said == [(CONFIG.actors, True), (4, False)]


def test_a_callback_that_is_no_function_is_refused(tmp_path: Path) -> None:
    with pytest.raises(rmc.ConfigError, match=r"^callback='print': take a function of one record"):
        rmc.train(CONFIG, tmp_path / "run", callback="print")  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()
