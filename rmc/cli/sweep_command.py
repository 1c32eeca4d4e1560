"""``rmc sweep``: from its checks to its table."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from rmc.cli import sweep_check
from rmc.cli.ending import STOPPED
from rmc.cli.signals import signals_caught
from rmc.cli.sweep_check import Checked
from rmc.cli.sweep_options import Sweep
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.view import terminal
from rmc.sweep import room
from rmc.sweep.grid import Grid, grid_jobs, is_finished, make_job
from rmc.sweep.index import NAME, Index
from rmc.sweep.job import Job
from rmc.sweep.local_runs import LocalRuns
from rmc.sweep.pool import Ending, Place, Plan, conduct, drop_replay
from rmc.sweep.spec import Range, Search, Spec, read_grid, read_ranges, read_seeds, read_spec
from rmc.sweep.table import result_table, run_line
