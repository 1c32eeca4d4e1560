"""A sweep's words and file: what they mean, and that bad ones are one line that names key, value and fix."""

import os
from pathlib import Path

import pytest

from rmc.cli import main, parser, sweep_check
from rmc.cli.sweep_command import default_folder, read_sweep
from rmc.common.errors import ConfigError
from rmc.sweep.grid import grid_jobs
from rmc.sweep.job import run_name
from rmc.sweep.spec import Range, Spec, read_ranges, read_seeds, read_spec, read_values

PENDULUM = "InvertedPendulum-v5"


def spec_of(*words: str) -> Spec:
    return read_sweep(parser.parse(["sweep", *words]))


def test_words_and_file_say_the_same(tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text(
        f'env = "{PENDULUM}"\nseeds = "1-3"\n[options]\npreset = "debug"\n'
        "[grid]\nlearning-rate = [3e-4, 1e-3]\nheads = [[64, 64], [32, 32]]\ngrounding = [true, false]\n"
    )
    grid = ["learning_rate=3e-4,1e-3", "heads=[64,64],[32,32]", "grounding=true,false"]
    words = spec_of(PENDULUM, "--seeds", "1-3", "--grid", *grid, "--preset", "debug")
    ours, theirs = grid_jobs(read_spec(path, []), tmp_path), grid_jobs(words, tmp_path)
    assert len(ours) == 24
    assert [(job.name, job.seed, job.values) for job in ours] == [(job.name, job.seed, job.values) for job in theirs]
    assert [job.seed for job in ours] == [1] * 8 + [2] * 8 + [3] * 8  # what is compared goes on side by side
    configs = [sweep_check.read_job(job)[0] for job in ours]
    assert configs == [sweep_check.read_job(job)[0] for job in theirs]
    last = configs[-1]
    assert (last.update.learning_rate, last.agent.heads, last.agent.grounding) == (1e-3, (32, 32), False)
    assert (last.seed, last.preset) == (3, "debug")


def test_options_of_train_come_after_the_environment_or_the_file(tmp_path: Path) -> None:
    (tmp_path / "spec.toml").write_text(f'env = "{PENDULUM}"\n')
    for what in (PENDULUM, str(tmp_path / "spec.toml")):
        spec = spec_of(what, "--preset", "debug", "--heads", "8", "8", "--env-kwargs", "a=1", "b=2", "--jobs", "1")
        (job,) = grid_jobs(spec, tmp_path)
        config = sweep_check.read_job(job)[0]
        assert (config.agent.heads, config.env.env_kwargs, config.preset) == ((8, 8), {"a": 1, "b": 2}, "debug")


def test_environments_are_told_apart_by_commas_or_a_list(tmp_path: Path) -> None:
    path, envs = tmp_path / "spec.toml", (PENDULUM, "dm_control/walker-walk-v0")
    path.write_text(f"env = {list(envs)}\nseeds = [1, 2]\n[options]\npreset = 'debug'\n[grid]\nscheme = [1, 3]\n")
    words = spec_of(", ".join(envs), "--seeds", "1,2", "--grid", "scheme=1,3", "--preset", "debug")
    ours, theirs = grid_jobs(read_spec(path, []), tmp_path), grid_jobs(words, tmp_path)
    configs = [sweep_check.read_job(job)[0] for job in ours]
    assert configs == [sweep_check.read_job(job)[0] for job in theirs]
    runs = [(config.env.id, config.seed, config.update.scheme) for config in configs]
    assert runs == [(env, seed, scheme) for seed in (1, 2) for env in envs for scheme in (1, 3)]
    assert [job.name for job in ours] == [job.name for job in theirs]
    assert ours[0].name == f"env={PENDULUM},scheme=1,seed=1"
    assert ours[0].title == f"env {PENDULUM}, scheme 1, seed 1"
    assert default_folder(",".join(envs)) == default_folder(PENDULUM)  # to which others may be added


def test_of_several_environments_a_bad_one_is_named(tmp_path: Path) -> None:
    jobs = grid_jobs(spec_of(f"{PENDULUM},Nope-v5", "--preset", "debug"), tmp_path)
    with pytest.raises(ConfigError, match=r"^ENV='Nope-v5': no such environment"):
        sweep_check.check_jobs(jobs, on_this_machine=True)


@pytest.mark.parametrize("env", ["[]", "1", '["Ant-v5", 3]', '""', '["Ant-v5", "Ant-v5"]', "true"])
def test_what_are_no_environments(env: str, tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text(f"env = {env}\n")
    with pytest.raises(ConfigError, match=r"^env=\[.*\]: (write ENV,ENV|has a value twice)"):
        read_spec(path, [])


@pytest.mark.parametrize(
    ("raw", "seeds"), [("1-3,7", (1, 2, 3, 7)), ("4", (4,)), ([5, 2], (5, 2)), (6, (6,)), (" 1 , 2", (1, 2))]
)
def test_seeds(raw: object, seeds: tuple[int, ...]) -> None:
    assert read_seeds(raw) == seeds


@pytest.mark.parametrize("raw", ["", "a", "3-1", "1,1", "-1", [], [1, 1], ["1"], [True], 1.5, "1-99999999"])
def test_what_are_no_seeds(raw: object) -> None:
    with pytest.raises(ConfigError, match=r"^seeds=.*whole numbers"):
        read_seeds(raw)


def test_values() -> None:
    assert read_values("1,2.5,1e-3") == [1, 2.5, 1e-3]
    assert read_values("l1,l2") == ["l1", "l2"]
    assert read_values("true,l2,3") == [True, "l2", 3]
    assert read_values("False,True") == [False, True]
    assert read_values(".5,l2") == [0.5, "l2"]  # as --env-kwargs reads it
    assert read_values("[64,64],[8]") == [[64, 64], [8]]


def test_a_search_has_ranges_and_choices() -> None:
    words = ["learning_rate=1e-5..1e-2:log", "n_step=1..5", "scheme=1,3"]
    search = spec_of(PENDULUM, "--search", *words, "--trials", "7", "--no-prune").search
    assert search is not None
    ranges = {"learning_rate": Range(1e-5, 1e-2, log=True), "n_step": Range(1, 5), "scheme": [1, 3]}
    assert (search.ranges, search.trials, search.prune) == (ranges, 7, False)
    assert read_ranges(["warmup_steps=1_000..5e3", "gamma=.9...99"]) == {
        "warmup_steps": Range(1_000, 5_000.0),
        "gamma": Range(0.9, 0.99),
    }
    choices = spec_of(PENDULUM, "--search", "init_from=../a,../b").search
    assert choices is not None
    assert choices.ranges == {"init_from": ["../a", "../b"]}
    assert read_ranges(["latent_target=ema", "gamma=0.9"]) == {"latent_target": ["ema"], "gamma": [0.9]}


def test_a_tracker_is_of_every_run(tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text('env = "InvertedPendulum-v5"\n[options]\ntrack = "off"\ntrack_tags = ["a", "b"]\nvideo_every = 2\n')
    (job,) = grid_jobs(spec_of(str(path)), tmp_path)
    options = sweep_check.read_job(job)[1]
    assert (options.track, options.track_tags, options.video_every) == ("off", ("a", "b"), 2)


def test_names_of_folders_are_plain_and_tell_values_apart() -> None:
    assert run_name({"learning_rate": 3e-4, "grounding": True}, 1) == "learning_rate=0.0003,grounding=true,seed=1"
    odd = [run_name({"env_kwargs": {"map": text}}, 1) for text in ("a/b", "a:b", "x" * 300)]
    assert len(set(odd)) == 3
    assert all("/" not in name and len(name) < 200 for name in odd)
    assert default_folder("dm_control/walker-walk-v0") == Path("runs/dm_control_walker-walk-v0__sweep")
    assert default_folder("some/where/rates.toml") == Path("runs/rates")


FILES = {
    'sedes = "1-2"': "sedes='1-2': no such key; did you mean seeds?",
    'seeds = "a"': "seeds='a': write whole numbers",
    "options = 1": "options=1: write it as a table",
    "[options]\ntotal_step = 5": "options.total_step=5: no option that a sweep's runs take; did you mean total_steps?",
    "[options]\nseed = 5": "options.seed=5: every run has its own",
    '[grid]\nenv = ["Hopper-v5", "Ant-v5"]': "grid.env=['Hopper-v5', 'Ant-v5']: give ENV,ENV in place of ENV, or in a",
    '[options]\nrun_dir = "x"': "options.run_dir='x': no option that a sweep's runs take",
    '[options]\nredis_url = "redis://:pw@x"': "options.redis_url='redis://x': no option that a sweep's runs take",
    '[grid]\nactors = ["redis://:pw@x"]': "grid.actors='redis://x': Error parsing --actors: 'redis://x' is no whole",
    '[options]\nlauncher = "ray"': "options.launcher='ray': a run's is local or lockstep",
    "[options]\nactors = 1.5": "options.actors=1.5: Error parsing --actors: '1.5' is no whole number",
    "[options]\nactors = 0": "--actors=0: take a number from 1",
    "[grid]\nlearning_rate = []": "grid.learning_rate=[]: write a list of values",
    "[grid]\nlearning_rate = 3e-4": "grid.learning_rate=0.0003: write a list of values",
    "[grid]\nlearning_rate = [1e-3, 1e-3]": "grid.learning_rate=[0.001, 0.001]: has a value twice",
    '[grid]\nlearning_rate = ["high"]': "grid.learning_rate='high': Error parsing --learning-rate",
    "[grid]\nlearning_rate = [3e-4, 7.0]": "--learning-rate=7.0: take a number from",
    "[grid]\nlearning_rate = [1979-05-27]": "grid.learning_rate=datetime.date(1979, 5, 27)",
    "[grid]\nstride = [9, 20]\ntrained_steps = [10, 20]": "--stride=20: take 0 to --trained-steps=10",
    "[options]\nactors = 1\n[grid]\nactors = [1, 2]": "actors=[1, 2]: is an option of every run and varied, too",
    "[search]": "search.ranges={}: name options",
    "[search]\ntrials = 0\n[search.ranges]\nscheme = [1]": "search.trials=0: take 1 to",
    "[search]\ntrails = 2": "search.trails=2: no such key; did you mean trials?",
    '[search]\ntrials = "2"': "search.trials='2': write a whole number",
    "[search.ranges]\nscheme = 1": "search.scheme=1: write {low",
    "[search.ranges]\nscheme = []": "search.scheme=[]: write a list of choices",
    "[search.ranges]\nlearning_rat = [1]": "search.learning_rat=[1]: no option that a sweep's runs take; did you mean",
    "[search.ranges]\nlearning_rate = {low = 2, high = 1}": "search.learning_rate={'low': 2, 'high': 1",
    "[search.ranges]\nlearning_rate = {low = 0, high = 1, log = true}": "search.learning_rate=0: a logarithmic range",
    "[search.ranges]\nlearning_rate = {low = 0, high = 1, lag = 1}": "search.learning_rate.lag=1: no such key",
    "[search.ranges]\nlearning_rate = {low = 1e-4, high = 2.0}": "--learning-rate=2.0: take a number from",
    "[search.ranges]\nhide = {low = 1, high = 2}": "search.hide='nothing': only numbers have a range",
    "[search.ranges]\nscheme = [1, 9]": "search.scheme=9: invalid choice",
    "[search.ranges]\ngrounding = {low = 0, high = 1}": "search.grounding=",
    "[grid]\nscheme = [1]\n[search.ranges]\nn_step = [1]": "grid=['scheme']: a sweep has a grid or a search",
    'seeds = "1-2"\n[search.ranges]\nn_step = [1]': "seeds=[1, 2]: a search has one",
    "[options]\nenv_kwargs = {reset_noise_scale = 1979-05-27}": "--env-kwargs reset_noise_scale=",
    "seeds = [": "not TOML",
}


@pytest.mark.parametrize(("text", "message"), FILES.items())
def test_a_bad_file_is_one_line_and_nothing_is_written(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("spec.toml").write_text(f'env = "{PENDULUM}"\n{text}\n')
    assert main.run(["sweep", "spec.toml"]) == 2
    _one_line(capsys, message)
    assert os.listdir() == ["spec.toml"]


@pytest.mark.parametrize("table", ["options", "grid", "search.ranges"])
def test_an_option_that_a_table_names_twice_is_refused(table: str, tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text(f'env = "{PENDULUM}"\n[{table}]\nscheme = [3]\nn-step = [1]\nn_step = [3]\n')
    place = table.partition(".")[0]
    with pytest.raises(ConfigError, match=rf"{place}\.n_step=\['n-step', 'n_step'\]: is there twice; leave one"):
        read_spec(path, [])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "ENV|SPEC.toml"),
        (["nowhere.toml"], "SPEC='nowhere.toml': cannot be read (No such file"),
        (["Nope-v5"], "no such environment"),
        ([f"{PENDULUM},"], f"env=['{PENDULUM}', '']: write ENV,ENV"),
        ([f"{PENDULUM},Ant-v5", "--search", "n_step=1..3"], f"env=['{PENDULUM}', 'Ant-v5']: a search has one"),
        ([PENDULUM, "--sede", "1"], "options of rmc train='--sede 1': Unrecognized options: --sede"),
        ([PENDULUM, "other"], "options of rmc train='other': Unrecognized options: other"),
        ([PENDULUM, "--run-dir", "x"], "--run-dir='--run-dir x': a sweep's runs are given none"),
        (
            [PENDULUM, "--redis_url", "redis://:pw@x"],
            "--redis-url='--redis_url redis://x': a sweep's runs are given",
        ),
        ([PENDULUM, "--seed", "5"], "--seed='--seed 5': a sweep has several: give --seeds"),
        ([PENDULUM, "--grid", "learning_rate"], "--grid='learning_rate': write NAME=VALUE"),
        ([PENDULUM, "--grid", "scheme=1", "scheme=2"], "has an option twice"),
        ([PENDULUM, "--grid", "scheme=1,3", "--grid", "n_step=1,2"], "--grid='--grid --grid': is there twice"),
        ([PENDULUM, "--search", "scheme=1,3", "--search=n_step=1..2"], "is there twice; give all of NAME=VALUE"),
        (
            [PENDULUM, "--search", "learning_rate=1e-4-1e-2"],
            "search.learning_rate='1e-4-1e-2': write LOW..HIGH, LOW..HIGH:log, or choices with commas between",
        ),
        ([PENDULUM, "--search", "scheme=1,1,3"], "search.scheme=[1, 1, 3]: has a value twice"),
        (
            [PENDULUM, "--grid", "heads=64,64"],
            "grid.heads=[64, 64]: has a value twice; give each once, and lists in",
        ),
        (
            [PENDULUM, "--search", "actors=1..2", "replay_shards=1..2"],
            "--replay-shards=2: every shard needs an actor: take at most --actors=1",
        ),
        (["--preset", "debug", PENDULUM], "ENV|SPEC.toml='--preset': give it first; options of rmc train follow it"),
        (["--no-grounding", PENDULUM], "ENV|SPEC.toml='--no-grounding': give it first; options of rmc train follow it"),
        ([PENDULUM, "--grid", "launcher=local,ray"], "grid.launcher='ray': a run's is local or lockstep"),
        ([PENDULUM, "--grid", "xyzzy=1"], "no option that a sweep's runs take; rmc train --help-all lists them"),
        ([PENDULUM, "--grid", "n_step=1,1.0"], "values=[{'n_step': 1}, {'n_step': 1.0}]: are one and the same run"),
        ([PENDULUM, "--search", "n_step=1,1.0"], "values=[{'n_step': 1}, {'n_step': 1.0}]: are one and the same run"),
        ([PENDULUM, "--search", "grounding=0..1"], "search.grounding=True: only numbers have a range"),
        ([PENDULUM, "--seeds", "1-1000000000"], 'like [1, 2, 3] or "1-5", 1_000_000 at most'),
        ([PENDULUM, "--search", "n_step=1..3,5"], "search.n_step='1..3': "),
        ([PENDULUM, "--init-from", "runs/none"], "--init-from='runs/none': no such run"),
        ([PENDULUM, "--grid", "track=wandb,off"], "grid.track=['wandb', 'off']: no option that a sweep's runs take"),
        ([PENDULUM, "--device", "cuda:1", "--launcher", "ray"], "--device='cuda:1': a run on a node sees one GPU"),
        ([PENDULUM, "--grid", "lr=1"], "grid.lr=[1]: no option"),
        ([PENDULUM, "--grid", "scheme=1,2", "--scheme", "3"], "scheme=[1, 2]: is an option of every run"),
        ([PENDULUM, "--grid", "grounding=true,false", "--no-grounding"], "grounding=[True, False]: is an option"),
        ([PENDULUM, "--search", "foo=1..2:log"], "search.foo=1..2:log: no option"),
        ([PENDULUM, "--jobs", "-1"], "--jobs=-1: take 1 or more"),
        (
            [PENDULUM, "--init_from", "runs/a", "--launcher", "ray"],
            "--init-from='--init_from runs/a': the nodes do not have that file",
        ),
        (
            [PENDULUM, "--grid", "init_from=runs/a,runs/b", "--launcher", "ray"],
            "--init-from='': the nodes do not have that file",
        ),
        (
            [PENDULUM, "--preset", "debug", "--ray-address", "head:6379"],
            "--ray-address='head:6379': give --launcher ray",
        ),
        ([PENDULUM, "--config", "f.toml"], "--config='f.toml': cannot be read"),
        ([PENDULUM, "--config", "me@f.toml"], "--config='me@f.toml': cannot be read"),
        ([PENDULUM, "--trials", "3"], "--trials=3: is for a search"),
        ([PENDULUM, "--preset", "debug", "--track-tags", "x"], "--track-tags=('x',): say which tracker"),
        (["spec.toml", "--seeds", "1"], "--seeds='1': belongs into spec.toml"),
        ([PENDULUM, "--search", "scheme=9..1"], "search.scheme={'low': 9"),
        ([PENDULUM, "--preset", "debug", "--total-steps", "9"], "--total-steps=9: take more than --warmup-steps"),
    ],
)
def test_bad_words_are_one_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.run(["sweep", *words]) == 2
    _one_line(capsys, message)
    assert os.listdir() == []


@pytest.mark.parametrize(
    "line",
    [
        "metrics_port = 9000", "dry_run = true", 'if_exists = "new"', 'run_dir = "x"', 'redis_url = "unix:///a"',
        'launcher = "manual"', "seed = 7",
    ],
)  # fmt: skip
def test_what_a_sweeps_runs_are_not_given_is_refused_in_the_file_of_config_too(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("base.toml").write_text(f'preset = "debug"\n{line}\n')
    assert main.run(["sweep", PENDULUM, "--config", "base.toml"]) == 2
    _one_line(capsys, f"--config base.toml: {line.split()[0]}=")
    assert os.listdir() == ["base.toml"]


def test_the_file_of_config_is_read_once_and_what_the_sweep_says_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = 'env = "Ant-v5"\npreset = "debug"\ngamma = 0.9\nheads = [4, 4]\nn_step = 2\nenv_kwargs = {a = 1}\n'
    Path("base.toml").write_text(file)
    Path("spec.toml").write_text(f'env = "{PENDULUM}"\n[options]\ngamma = 0.95\n[grid]\nn_step = [3, 4]\n')
    typed = ["--heads", "8", "8", "--config", "base.toml", "--actors", "1", "--env_kwargs", "b=2"]
    spec = sweep_check.with_file(spec_of("spec.toml", *typed))
    Path("base.toml").unlink()
    configs = [sweep_check.read_job(job)[0] for job in grid_jobs(spec, tmp_path)]
    assert [config.update.n_step for config in configs] == [3, 4]
    for config in configs:
        assert (config.preset, config.update.gamma, config.agent.heads, config.actors) == ("debug", 0.95, (8, 8), 1)
        assert (config.env.id, config.env.env_kwargs) == (PENDULUM, {"b": 2})


def _one_line(capsys: pytest.CaptureFixture[str], message: str) -> None:
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err
