"""``ray up`` on three machines: a run learns on them, loses processes, networks and nodes, and is taken down.

The machines are namespaces of this one (``machines.py``). Not collected by ``make test``: ``make test-cluster`` makes
five rounds with every cut.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from rmc import deploy
from tests.cluster import machines
from tests.cluster.machines import Machine, Machines
from tests.integration.running import newest_in
from tests.integration.test_learning import DATA, FAST, SMALL

pytestmark = [pytest.mark.skipif(bool(machines.missing()), reason=machines.missing()), pytest.mark.timeout(900)]
PROJECT = Path(deploy.__file__).parents[1]
PYTHON = Path(sys.executable).parent  # the environment that the machines use, too
CUTS = [int(word) for word in os.environ.get("RMC_CUTS", "5 30 90 240").split()]  # seconds without a network
BACK_SECONDS = 10.0  # after a network is back
GIVEN_UP_SECONDS = 180  # without a network, after which Ray has surely given the node up
ANEW_SECONDS = 60.0  # after such a node is back: every role on it begins anew, all on two cores
SHOWN = os.environ.get("RMC_CLUSTER_RESULTS")  # a file for the figures
RMC = f"cd {PROJECT} && {PYTHON}/python -P -m rmc.cli.main"
RAY = "RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0"
WORKER = f"{PROJECT}/deploy/cluster/worker.sh {PYTHON}/ray"  # keeps Ray there
ON_A_WORKER = 3  # actors, where the learner is not
# As Ray is told: the learner's group takes two of one worker's.
CPUS = {"head": 0, "alpha": ON_A_WORKER, "beta": ON_A_WORKER}
PACE = ("--replay-ratio", "240", "--alpha-learning-rate", "1e-3", "--total-steps", "60000")  # as on one machine
LEARNING = ("--preset", "debug", *SMALL, *FAST, *DATA, *PACE)


def note(**figures: Any) -> None:
    """Keep a figure for the closing table."""
    print(figures)
    if SHOWN:
        with Path(SHOWN).open("a") as file:
            file.write(json.dumps(figures) + "\n")


class Site:
    """A cluster of three such machines, brought up by the project's own file for machines of one's own."""

    def __init__(self, folder: Path) -> None:
        keep = [PROJECT, Path(sys.prefix), Path(sys.base_prefix)]
        environment = {"PATH": f"{PYTHON}:$PATH", "RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
        environment["PYTHONPATH"] = str(PROJECT)
        self.machines = Machines(folder, list(CPUS), keep, environment)
        self.head, self.alpha, self.beta = self.machines.machines
        self.config = folder / "cluster.yaml"
        self.config.write_text(
            yaml.safe_dump(self._edited(yaml.safe_load((PROJECT / "deploy/cluster/on-premise.yaml").read_text())))
        )

    def _edited(self, config: dict[str, Any]) -> dict[str, Any]:
        """With these addresses, and the environment that is here already in place of its setup."""
        config["provider"] |= {"head_ip": self.head.ip, "worker_ips": [self.alpha.ip, self.beta.ip]}
        config["auth"] = {"ssh_user": "root", "ssh_private_key": str(self.machines.key)}
        config["file_mounts"].pop("~/rmc")
        config["setup_commands"] = ["chmod 600 ~/.ray/auth_token"]
        for name in ("head_start_ray_commands", "worker_start_ray_commands"):
            commands = [
                command.replace("~/rmc-env/bin", str(PYTHON)).replace("~/rmc", str(PROJECT)) for command in config[name]
            ]
            cpus = CPUS["head" if name.startswith("head") else "alpha"]
            config[name] = [*commands[:-1], f"{commands[-1]} --num-cpus={cpus} --object-store-memory=100000000"]
        return config

    def join(self, machine: Machine) -> None:
        """As the cluster's file starts a worker."""
        token = self.head.run("cat ~/.ray/auth_token").stdout.strip()
        machine.run(f"umask 077; mkdir -p ~/.ray; echo {token} > ~/.ray/auth_token")
        machine.run(
            f"{RAY} {WORKER} start --address={self.head.ip}:6379 --node-ip-address={machine.ip} --num-cpus=1 "
            "--object-store-memory=100000000"
        )

    def alive(self) -> int:
        code = (
            "import ray; ray.init(address='auto', logging_level='ERROR', log_to_driver=False); "
            "print('alive', sum(n['Alive'] for n in ray.nodes()))"
        )
        output = self.head.run(f'{PYTHON}/python -c "{code}"').stdout  # Ray's autoscaler may say something, too
        return int(next(line for line in output.splitlines() if line.startswith("alive ")).split()[1])


def _replaced(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]]) -> list[str]:
    return [actor for actor in before if now[actor]["epoch"] > before[actor]["epoch"]]


class Run:
    """A run on the head of such a site."""

    def __init__(self, site: Site, name: str, *options: str) -> None:
        self.site, self.folder = site, f"/root/{name}"
        words = f"train InvertedPendulum-v5 --run-dir {self.folder} --launcher ray {' '.join(options)}"
        self.process = site.head.background(f"{RMC} {words}")

    def records(self, role: str) -> list[dict[str, Any]]:
        text = self.site.head.run(f"cat {self.folder}/metrics.jsonl", check=False).stdout
        records = [json.loads(line) for line in text.splitlines() if line.endswith("}")]
        return [record for record in records if record["role"] == role]

    def newest(self, role: str, name: str, default: Any = 0) -> Any:
        return newest_in(self.records(role), name, default)

    def heard(self, actors: int) -> float:
        """When the actor spoke last that has been silent for longest."""
        text = self.site.head.run(f"tail -n 200 {self.folder}/metrics.jsonl").stdout
        records = [json.loads(line) for line in text.splitlines()[1:] if line.endswith("}")]
        times = {record["role"]: float(record["time"]) for record in records}
        return min(times.get(f"actor-{k}", 0.0) for k in range(actors))

    def epochs(self) -> dict[str, dict[str, Any]]:
        """Of every actor, and whether Redis refuses an older one's entries (``epochs.py``)."""
        words = f"{PYTHON}/python -P -m tests.cluster.epochs {self.folder} {self.site.head.ip}"
        epochs: dict[str, dict[str, Any]] = json.loads(self.site.head.run(words).stdout)
        return epochs

    def all_have_sent(self) -> bool:
        """Whether of every actor something is acknowledged."""
        epochs = self.epochs()
        return len(epochs) == self.actors() and all(at["acked"] for at in epochs.values())

    def check_replaced_are_fenced(self, before: dict[str, dict[str, Any]], least: int = 0) -> list[str]:
        """Actors replaced since: all that is acknowledged is their newest life's, and an older one is refused.

        Waits until there are ``least`` of them: a process that is there has no new life yet while it imports.
        """
        now: dict[str, dict[str, Any]] = {}

        def all_went_on() -> bool:
            now.update(self.epochs())
            went_on = all(at["acked"] == at["epoch"] for at in now.values())
            return went_on and len(_replaced(before, now)) >= least

        self.wait_for(all_went_on)
        replaced = _replaced(before, now)
        assert all(now[actor]["refused"] for actor in replaced), now
        return replaced

    def actors(self) -> int:
        return int(json.loads(self.site.head.run(f"cat {self.folder}/config.json").stdout)["actors"])

    def wait_for(self, condition: Callable[[], Any], seconds: float = 120.0) -> float:
        """Until it holds, while the run goes on; how long it took."""
        began = time.monotonic()
        while not condition():
            assert self.process.poll() is None, self.text()
            assert time.monotonic() - began < seconds, f"in vain for {seconds} s\n{self.logs()}"
            time.sleep(0.2)
        return time.monotonic() - began

    def text(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.read() + self.logs()

    def logs(self) -> str:
        return self.site.head.run(f"tail -n 15 {self.folder}/logs/*.log", check=False).stdout

    def wait_for_updates(self, more: int) -> float:
        goal = self.newest("learner", "updates") + more
        return self.wait_for(lambda: self.newest("learner", "updates") >= goal)

    def check_counters(self) -> None:
        """Nothing went back, and no acknowledged window was lost or asked for twice."""
        steps = [record["env_steps"] for record in self.records("replay")]
        assert steps == sorted(steps)
        assert [self.newest("replay", name, None) for name in ("entry_gaps", "dead_letters")] == [0, 0]

    def stop(self, words: str = "", machine: Machine | None = None) -> str:
        output = (machine or self.site.head).run(f"{RMC} stop {words or self.folder}").stdout
        self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return output


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share a cluster: the last one looks."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site_of_module = Site(tmp_path_factory.mktemp("site"))
    try:
        began = time.monotonic()
        environment = f"{RAY} HOME=/root"
        up = site_of_module.head.run(f"{environment} {RMC} cluster up {site_of_module.config}", seconds=400)
        note(test="up", seconds=time.monotonic() - began)
        assert "3 nodes are up" in up.stdout
        yield site_of_module
    finally:
        site_of_module.machines.close()


@pytest.fixture(scope="module")
def endless(site: Site) -> Run:
    run = Run(site, "endless", "--preset", "debug", "--total-steps", "10000000", "--replay-ratio", "8", "--all-cpus")
    run.wait_for(lambda: not run.newest("launcher", "not_running", "x"))
    run.wait_for_updates(100)
    run.wait_for(run.all_have_sent)  # an actor that is still on its way could not be missed by a test that kills it
    return run


def where(run: Run, role: str) -> Machine:
    """The machine whose processes a role's is one of."""
    hosts = [machine for machine in run.site.machines.machines if machine.processes(f"rmc.cli.main role {role}")]
    assert len(hosts) == 1, (role, [machine.name for machine in hosts])
    return hosts[0]


def test_every_node_is_there(site: Site) -> None:
    assert site.alive() == 3
    assert site.head.run("stat -c %a /root/.ray/auth_token").stdout.strip() == "600"


def test_a_sweeps_runs_are_spread_over_the_machines_and_come_to_the_head(site: Site) -> None:
    words = (
        "sweep InvertedPendulum-v5 --preset debug --total-steps 1200 --seeds 1-2 --launcher ray --sweep-dir /root/sweep"
    )
    began = time.monotonic()
    output = site.head.run(f"{RMC} {words}", seconds=400.0).stdout
    note(test="sweep", seconds=time.monotonic() - began)
    assert "2 of 2: seed " in output
    index = [json.loads(line) for line in site.head.run("cat /root/sweep/sweep.jsonl").stdout.splitlines()]
    assert [(line["run"], line["state"], line["env_steps"]) for line in index] == [
        ("seed=1", "finished", 1200),
        ("seed=2", "finished", 1200),
    ]
    kept = site.head.run("find /root/sweep -name policy.safetensors -o -name result.json -o -name ring").stdout
    assert kept.count("result.json") == 2
    assert "policy.safetensors" in kept
    assert "/ring" not in kept
    events = site.head.run("find /root/sweep -name 'events.out*'").stdout
    assert all(f".{machine.name}." in events for machine in (site.alpha, site.beta))  # TensorBoard's names say where
    for machine in site.machines.machines:
        assert not machine.processes("rmc.cli.main"), machine.name
        assert not machine.run("ls /tmp/rmc-sweep-0", check=False).stdout


def test_a_run_learns_is_stopped_and_goes_on(site: Site) -> None:
    began = time.monotonic()
    run = Run(site, "learning", *LEARNING, "--actors", "2")
    run.wait_for(lambda: run.newest("evaluator", "eval_return_mean") >= 1000.0, seconds=600)
    workers = [machine for machine in (site.alpha, site.beta) if machine.processes("rmc.cli.main role actor")]
    assert len(workers) == 2
    note(test="reached 1000", seconds=time.monotonic() - began, updates=run.newest("evaluator", "eval_update"))
    steps = run.newest("replay", "env_steps")
    assert "to go on:\n  rmc resume " in run.stop()
    for machine in site.machines.machines:
        assert not machine.processes("rmc.cli.main"), machine.name
    stopped = time.time()
    again = Run(site, "learning", *LEARNING, "--actors", "2")
    again.wait_for(
        lambda: again.newest("learner", "time") > stopped + 1.0 and again.newest("replay", "env_steps") > steps
    )
    again.check_counters()
    again.stop()
    assert "is lost" not in site.head.run(f"cat {again.folder}/logs/replay.log").stdout


def test_a_run_that_is_over_leaves_nothing_also_where_its_roles_have_been_before(site: Site) -> None:
    run, machines = Run(site, "over", "--preset", "debug", "--total-steps", "3000"), site.machines.machines
    run.wait_for(lambda: run.newest("learner", "updates"))
    identity = site.head.run(f"cat {run.folder}/scratch").stdout.split()[-1]
    found = f"/tmp/rmc-ray-0-{identity}"
    assert any(machine.run(f"ls {found}", check=False).stdout for machine in machines)
    for machine in machines:
        machine.run(f"mkdir -p -m 700 {found}")
    output, _ = run.process.communicate(timeout=180)
    assert run.process.returncode == 0, output
    assert [machine.run(f"ls -d {found}", check=False).stdout for machine in machines] == [""] * len(machines)


def test_a_killed_raylet_costs_no_acknowledged_window(endless: Run) -> None:
    learner, site = where(endless, "learner"), endless.site
    worker = site.beta if learner is site.alpha else site.alpha
    before, epochs = endless.newest("replay", "env_steps"), endless.epochs()
    worker.kill("raylet/raylet")
    ended = endless.wait_for(lambda: not worker.processes("rmc.cli.main role actor"))
    back = endless.wait_for(lambda: len(worker.processes("rmc.cli.main role actor")) >= ON_A_WORKER)
    endless.wait_for(lambda: endless.newest("replay", "env_steps") > before + 500)
    endless.check_counters()
    replaced = endless.check_replaced_are_fenced(epochs, least=ON_A_WORKER)
    note(test="raylet killed", roles_ended_s=ended, back_s=back, replaced=len(replaced))


@pytest.mark.parametrize("seconds", CUTS)
def test_a_cut_network_heals(endless: Run, seconds: int) -> None:
    worker = endless.site.beta if where(endless, "learner") is endless.site.alpha else endless.site.alpha
    epochs, actors = endless.epochs(), endless.actors()
    worker.cut()
    time.sleep(seconds)
    worker.heal()
    given_up = seconds >= GIVEN_UP_SECONDS  # by Ray, which worker.sh starts again there
    healed = time.monotonic()
    if given_up:  # those there find out, and end
        endless.wait_for(lambda: not worker.processes("rmc.cli.main role actor"))
    heard = time.time()

    def all_there() -> bool:
        return endless.heard(actors) > heard

    endless.wait_for(all_there)
    back = time.monotonic() - healed
    endless.check_counters()
    replaced = endless.check_replaced_are_fenced(epochs, least=ON_A_WORKER if given_up else 0)
    assert endless.actors() == actors
    note(test=f"network cut for {seconds} s", back_s=back, replaced=len(replaced))
    assert back < (ANEW_SECONDS if given_up else BACK_SECONDS)


@pytest.mark.parametrize("role", ["learner", "replay"])
def test_a_killed_process_resumes(endless: Run, role: str) -> None:
    machine = where(endless, role)
    before = machine.processes(f"rmc.cli.main role {role}")
    machine.kill(f"rmc.cli.main role {role}")
    back = endless.wait_for(lambda: (now := machine.processes(f"rmc.cli.main role {role}")) and now != before)
    endless.wait_for_updates(50)
    endless.check_counters()
    note(test=f"{role} killed", back_s=back)


def test_a_node_that_joins_gets_actors(endless: Run) -> None:
    site = endless.site
    new = site.machines.add("gamma")
    began = time.monotonic()
    site.join(new)
    endless.wait_for(lambda: len(new.processes("rmc.cli.main role actor")) >= 1)
    joined = time.monotonic() - began
    assert joined < 30.0
    endless.wait_for(lambda: endless.newest("launcher", "not_running", "x") == "")
    endless.wait_for_updates(50)
    endless.check_counters()
    note(test="node joined", actors_after_s=joined)


def test_the_learners_node_is_lost(endless: Run) -> None:
    site, lost = endless.site, where(endless, "learner")
    steps, updates = endless.newest("replay", "env_steps"), endless.newest("learner", "updates")
    checkpoint = int(site.head.run(f"ls {endless.folder}/checkpoints | grep -E '^[0-9]+$' | tail -n 1").stdout)
    lost.run(f"{RAY} {WORKER} stop --force")
    away = endless.wait_for(lambda: not lost.processes("rmc.cli.main role learner"))
    back = endless.wait_for(
        lambda: any(m.processes("rmc.cli.main role learner") for m in site.machines.machines if m is not lost),
        seconds=180,
    )
    endless.wait_for_updates(50)
    assert where(endless, "learner") is not lost
    assert endless.newest("replay", "env_steps") >= steps
    assert checkpoint <= endless.newest("learner", "updates")
    assert "is lost; begins empty at agent step" in site.head.run(f"cat {endless.folder}/logs/replay.log").stdout
    endless.check_counters()
    note(test="learner's node lost", away_s=away, back_s=back, updates_before=updates, checkpoint=checkpoint)


def test_the_run_is_stopped_from_a_worker_and_nothing_is_left(endless: Run) -> None:
    site = endless.site
    worker = next(machine for machine in (site.alpha, site.beta) if machine.processes("raylet/raylet"))
    (listed,) = json.loads(worker.run(f"{RMC} list --ray-address auto --json").stdout)
    assert (listed["folder"], listed["learner"]) == (endless.folder, where(endless, "learner").ip)
    assert f"its folder is {endless.folder} on head" in endless.stop("endless --ray-address auto", worker)
    newest = site.head.run(f"cat $(ls -d {endless.folder}/checkpoints/[0-9]* | tail -n 1)/progress.json").stdout
    assert json.loads(newest)["env_steps"] >= listed["env_steps"]  # saved in the end
    for machine in site.machines.machines:
        assert not machine.processes("rmc.cli.main"), machine.name
    began = time.monotonic()
    site.head.run(f"{RMC} cluster down {site.config}", seconds=180)
    note(test="down", seconds=time.monotonic() - began)
    for machine in (site.head, site.alpha, site.beta):
        assert not machine.processes("raylet/raylet|gcs_server|ray::|dashboard"), machine.name
        machine.wait_until_gone("ray", 20.0)  # the ssh connection that ray down's commands shared outlives it by 10 s
