"""A run on a Ray cluster: placement, role actors, supervision."""

import os

from rmc.common.extra import check_installed

check_installed("ray", ("ray",), "--launcher", "ray")
# read when ray is imported: else its own handler of SIGTERM ends a process that saves by SIGABRT after three seconds
os.environ.setdefault("RAY_DISABLE_FAILURE_SIGNAL_HANDLER", "1")
