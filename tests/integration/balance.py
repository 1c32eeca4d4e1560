"""It learns to balance a pendulum to the time limit: some minutes, by ``make test-learning``."""

from pathlib import Path

import pytest

from tests.integration.test_learning import SECONDS, best_return

pytestmark = pytest.mark.timeout(SECONDS + 30)


def test_one_actor_and_one_learner_balance_the_pendulum(tmp_path: Path) -> None:
    pace = ["--total-steps", "8000", "--replay-ratio", "240", "--alpha-learning-rate", "1e-3"]
    assert best_return(tmp_path / "run", "InvertedPendulum-v5", pace, 1000.0) == 1000.0
