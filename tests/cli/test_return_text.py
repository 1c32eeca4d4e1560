"""Returns as text."""

import io
import math
from pathlib import Path

import pytest
from rich.console import Console

from rmc.analysis.run_list import RunSummary
from rmc.analysis.run_list import table as list_table
from rmc.cli.ending import format_evaluation
from rmc.cli.policy_commands import _result_line
from rmc.common.return_text import return_text
from rmc.deploy.monitor.plain_line import line
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.monitor.table import table


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (9671.3, "9,671"), (1000.0, "1,000"), (999.96, "1,000"), (-1204.3, "-1,204"), (27.2, "27.2"), (20, "20"),
        (0.46, "0.46"), (-0.009222, "-0.009222"), (1.5e-7, "1.5e-07"), (-0.0, "0"),
        (math.inf, "inf"), (math.nan, "nan"),
    ],
)  # fmt: skip
def test_a_return_has_four_digits_however_small_it_is(value: float, text: str) -> None:
    assert return_text(value) == text


@pytest.mark.parametrize(
    ("mean", "deviation", "text"),
    [
        (9671.3, 112.4, "9,671 ± 112"), (999.96, 0.2, "1,000 ± 0"), (999.94, 0.2, "999.9 ± 0.2"),
        (20, 0, "20.00 ± 0.00"),
        (0.46, 0.0321, "0.4600 ± 0.0321"), (-0.009222, 0.0012, "-0.009222 ± 0.001200"),
        (-0.00001, 100.0, "0.0 ± 100.0"), (0.0, 0.0, "0 ± 0"), (1e-6, 2e-7, "1e-06 ± 2e-07"),
        (math.inf, math.nan, "inf ± nan"),
    ],
)  # fmt: skip
def test_a_mean_and_its_deviation_have_the_same_decimals(mean: float, deviation: float, text: str) -> None:
    assert return_text(mean, deviation) == text


def test_a_small_return_can_be_read_wherever_it_is_printed() -> None:
    judged = {"eval_return_mean": -0.009222, "eval_return_std": 0.0012, "eval_episodes": 10}
    status = RunStatus("Hopper-v5", "robust", 1, 1000, 32.0)
    status.take({"role": "evaluator", "time": 1.0, "eval_update": 3, **judged})
    status.take({"role": "actor-0", "time": 1.0, "episode_return_mean": 0.0123})
    file = io.StringIO()
    console = Console(file=file, width=80)
    console.print(table(status, 80))
    listed = RunSummary("/runs/a", "finished", eval_return=-0.009222, best_return=0.0123)
    console.print(list_table([listed], Path("/runs"), 80))
    played = {"env": "Hopper-v5", "eval_flicker": 0.0, "eval_drop_sensors": 0.0, "env_steps": 1, **judged}
    words = (format_evaluation(judged), _result_line(played, stopped=False), line(status))
    texts = [*file.getvalue().splitlines(), *words]
    assert sum("-0.009222 ± 0.001200" in text for text in texts) == 4  # evaluation, best, at the end, rmc evaluate
    for part in ("return 0.0123, with", "-0.009222  0.0123", "eval -0.009222 (best -0.009222)"):
        assert any(part in text for text in texts), part
