"""A real Prometheus watches a short run, an actor of which stands still and is killed."""

import json
import re
import shutil
import subprocess
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any, Self

import pytest

from tests.integration.running import Training, free_port
from tests.waiting import wait_until

MONITOR = Path(__file__).parents[2] / "deploy" / "monitor"
HERE = "127.0.0.1"
SILENT = 'ALERTS{alertname="RmcRoleSilent", alertstate="firing", role="actor-0"}'


class Prometheus:
    """One of its own folder, that looks at a port every second."""

    def __init__(self, folder: Path, target: str, alerts: str) -> None:
        folder.mkdir()
        (folder / "alerts.yaml").write_text(alerts)
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["alerts.yaml"],
            "scrape_configs": [{"job_name": "rmc", "static_configs": [{"targets": [target]}]}],
        }
        (folder / "prometheus.yml").write_text(json.dumps(config))
        self._at, self._log = f"{HERE}:{free_port()}", folder / "log"
        words = [f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}"]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                ["prometheus", *words, f"--web.listen-address={self._at}"], stdout=log, stderr=log
            )

    def ask(self, path: str, **words: str) -> Any:
        """What its API answers; nothing until it is there."""
        assert self._process.poll() is None, self._log.read_text()
        try:
            with urllib.request.urlopen(f"http://{self._at}/api/v1/{path}?{urllib.parse.urlencode(words)}") as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            if error.code == 503:  # it still starts
                return {"result": []}
            raise AssertionError(f"{words}: {error.read().decode()}") from None
        except urllib.error.URLError:
            return {"result": []}

    def values(self, expr: str) -> list[float]:
        """What an expression gives now."""
        return [float(one["value"][1]) for one in self.ask("query", query=expr)["result"]]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.wait()


def queries() -> list[str]:
    """The dashboard's."""
    dashboard = json.loads((MONITOR / "dashboard.json").read_text())
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="no Prometheus here: apt-get install prometheus")
def test_a_run_is_scraped_its_alerts_fire_and_the_dashboard_has_data(tmp_path: Path) -> None:
    port, alerts = free_port(), (MONITOR / "alerts.yaml").read_text()
    sooner = alerts.replace("rmc_silent_seconds > 60", "rmc_silent_seconds > 5")
    assert sooner != alerts
    options = ("--total-steps", "1000000", "--checkpoint-steps", "200", "--metrics-port", str(port))
    with (
        Prometheus(tmp_path / "prometheus", f"{HERE}:{port}", sooner) as prometheus,
        Training(tmp_path / "run", *options, env="tests.slow_env:Slow-v0") as training,
    ):
        training.wait_for(lambda: prometheus.values("rmc_evaluation_return"))
        actor = training.role("actor")
        assert actor is not None
        actor.suspend()
        training.wait_for(lambda: prometheus.values(SILENT) == [1.0])
        actor.kill()
        training.wait_for(lambda: prometheus.values('rmc_restarts_total{role="actor-0"}') == [1.0])
        training.wait_for(lambda: not prometheus.values(SILENT))
        training.wait_for(lambda: prometheus.values("rmc_redis_memory_bytes > 0"))
        for expr in queries():
            assert prometheus.values(expr.replace("$instance", f"{HERE}:{port}")), expr
        (group,) = prometheus.ask("rules")["groups"]
        assert {(rule["name"], rule["health"], rule.get("lastError", "")) for rule in group["rules"]} == {
            (name, "ok", "") for name in re.findall(r"alert: (\w+)", alerts)
        }
        training.interrupt()
        wait_until(lambda: prometheus.values("up") == [0.0], 30.0)
