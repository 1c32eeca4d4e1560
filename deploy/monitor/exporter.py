"""A run's newest metrics for Prometheus, over HTTP from a thread of its launcher."""

import socketserver
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from rmc.common.bus.metrics_record import is_finite
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.preflight import check_port

MOST_CLIENTS = 8  # at once: no more of the launcher's handles are theirs
REQUEST_SECONDS = 5.0  # of silence, until a client is let go


class Exported(NamedTuple):
    """A metric out of the records of the roles whose names begin so, with the label ``role``."""

    name: str
    roles: str
    field: str
    help: str


GAUGES = (
    Exported("busy_share", "", "busy_share", "Share of time spent working, 0 to 1."),
    Exported("waiting_share", "", "waiting_share", "Share of time spent waiting, 0 to 1."),
    Exported("env_steps", "replay", "env_steps", "Agent steps committed."),
    Exported("env_steps_per_second", "replay", "env_steps_per_s", "Agent steps committed a second."),
    Exported("windows", "replay", "windows", "Windows committed."),
    Exported("windows_per_second", "replay", "windows_per_s", "Windows committed a second."),
    Exported("ring_windows", "replay", "ring_windows", "Windows in the ring."),
    Exported("ring_capacity_windows", "replay", "ring_capacity", "Windows that the ring holds at most."),
    Exported("replay_ratio", "replay", "replay_ratio", "Trained steps drawn per agent step."),
    Exported("credit_steps", "replay", "credit_steps", "Agent steps that actors may take now."),
    Exported("policy_lag_updates", "replay", "policy_lag_mean", "Updates that a window's policy was behind."),
    Exported("weights_update", "actor", "weights_update", "The learner's update whose policy acts."),
    Exported("unacked_entries", "actor", "unacked_entries", "Entries sent and not yet committed."),
    Exported("episode_return", "actor", "episode_return_mean", "Mean return of newest episodes, with exploration."),
    Exported("updates", "learner", "updates", "The learner's updates."),
    Exported("updates_per_second", "learner", "updates_per_s", "The learner's updates a second."),
    Exported("sample_age_updates", "learner", "sample_age_mean", "Updates that a drawn window's policy is behind."),
    Exported("redis_away_seconds", "launcher", "redis_away_s", "Seconds since Redis has answered, 0 if it does."),
    Exported("redis_memory_bytes", "launcher", "redis_memory_bytes", "Memory that Redis has allocated."),
    Exported("host_available_bytes", "launcher", "host_available_bytes", "Free memory of the launcher's machine."),
    Exported("host_disk_free_bytes", "launcher", "host_disk_free_bytes", "Free disk where the run's folder is."),
    Exported("host_disk_bytes", "launcher", "host_disk_bytes", "Size of that disk."),
)
REFUSED = {"dead_letters": "entries", "refused_clients": "clients", "refused_values": "values",
           "refused_weights": "weights", "refused_priorities": "priorities", "damaged_windows": "windows"}  # fmt: skip
RESTARTS = "restarts_"  # and a role


class RunCollector(Collector):
    """What a run's roles said last, in Prometheus's terms."""

    def __init__(self, status: RunStatus, run: str) -> None:
        self._status, self._run = status, run

    def collect(self) -> Iterator[Metric]:
        """Every metric, as it is now."""
        status, roles = self._status, self._status.roles
        last = status.last if status.last and status.last.is_complete else None
        about = {"run": self._run, "env": status.env, "preset": status.preset, "seed": str(status.seed)}
        yield InfoMetricFamily("rmc_run", "The run.", about)
        for name, text, value in (
            ("total_steps", "Agent steps of the run's total.", status.total_steps),
            ("evaluation_return", "Mean of the last evaluation.", last.return_mean if last else None),
            ("evaluation_return_best", "Mean of the best one.", status.best.return_mean if status.best else None),
        ):
            yield GaugeMetricFamily(f"rmc_{name}", text, value)
        silent = status.silent()
        yield _gauge(
            "silent_seconds",
            "Seconds that a role, or Redis, has said nothing for too long; else 0.",
            {role: silent.get(role, 0.0) for role in [*roles, *silent]},
        )
        for one in GAUGES:
            said = {role: record.get(one.field) for role, record in roles.items() if role.startswith(one.roles)}
            yield _gauge(one.name, one.help, said)
        yield _restarts(roles.get("launcher", {}))
        yield _refusals(roles)


def _gauge(name: str, text: str, values: Mapping[str, Any]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(f"rmc_{name}", text, labels=["role"])
    for role, value in values.items():
        if is_finite(value):
            family.add_metric([role], value)
    return family


def _restarts(launcher: dict[str, Any]) -> CounterMetricFamily:
    family = CounterMetricFamily("rmc_restarts", "How often a role was started again.", labels=["role"])
    for name, count in launcher.items():
        if name.startswith(RESTARTS):
            family.add_metric([name.removeprefix(RESTARTS)], count)
    return family


def _refusals(roles: dict[str, dict[str, Any]]) -> CounterMetricFamily:
    text = "What was refused, by what it was and why; the reason is empty where there is one alone."
    family = CounterMetricFamily("rmc_refusals", text, labels=["role", "what", "reason"])
    for role, record in roles.items():
        for total, what in REFUSED.items():
            reasons = {name.removeprefix(f"{total}_"): name for name in record if name.startswith(f"{total}_")}
            for reason, name in (reasons or {"": total}).items():
                if is_finite(count := record.get(name)):
                    family.add_metric([role, what, reason], count)
    return family


class _Server(socketserver.ThreadingMixIn, WSGIServer):
    """A thread for each of a few clients, none of whom the end waits for."""

    daemon_threads = True

    def __init__(self, *where: Any) -> None:
        self._free = threading.Semaphore(MOST_CLIENTS)
        super().__init__(*where)

    def server_bind(self) -> None:
        """Without asking for its host's name, which nobody reads, and which may take as long as DNS does."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])
        self.setup_environ()

    def verify_request(self, request: Any, client_address: Any) -> bool:  # noqa: ARG002
        """Whether there is room for one more; else it is hung up on."""
        return self._free.acquire(blocking=False)

    def process_request(self, *client: Any) -> None:
        """Serve it in a thread, where one can be started."""
        try:
            super().process_request(*client)
        except RuntimeError:
            self._free.release()
            raise

    def process_request_thread(self, *client: Any) -> None:
        """Serve it."""
        try:
            super().process_request_thread(*client)
        finally:
            self._free.release()

    def handle_error(self, *client: Any) -> None:
        """One that asks for nothing, or goes away, is no news."""


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_SECONDS

    def log_message(self, *words: Any) -> None:
        """Nothing: the terminal is the run's."""


@contextmanager
def served(status: RunStatus, run: str, options: LaunchOptions) -> Iterator[None]:
    """Serve a run's metrics meanwhile.

    Raises ConfigError where the port cannot be had, OSError where it was taken since that was looked at.
    """
    assert options.metrics_port is not None
    check_port(options)
    registry = CollectorRegistry()
    registry.register(RunCollector(status, run))
    with make_server(options.metrics_host, options.metrics_port, make_wsgi_app(registry), _Server, _Handler) as server:
        thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()
