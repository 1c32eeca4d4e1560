"""Updates a second on a GPU: one CUDA graph with batches copied ahead, beside kernels launched one by one.

    python -m benchmarks.cuda [--env ENV] [--batches 64 256] [--rounds N] [--seconds S]

Batches lie ready in pinned memory; both take priorities back to the host. Ends at once where there is no GPU.
"""

from itertools import count, product

import torch

from benchmarks.harness import Row, argument_parser, compare, random_rows, save
from benchmarks.peers.turns import speed
from rmc.common.agent import Agent
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.presets import robust
from rmc.learner.batch import view_batch
from rmc.learner.config import Precision
from rmc.learner.device_update import DeviceUpdate, HostCopy
from rmc.learner.precision import set_precision
from rmc.learner.update import JointUpdate
from rmc.learner.update_order import make_update

PRECISIONS: tuple[Precision, ...] = ("auto", "bf16", "fp32")
CHUNK = 10  # updates between looks at the clock


def _update(run: RunConfig, precision: Precision) -> JointUpdate:
    spec, device = run.window_spec(), torch.device("cuda")
    agent = Agent(spec.obs_dim, spec.action_dim, run.agent).to(device)
    return make_update(agent, run.update, 0, set_precision(precision, device))


def measure(run: RunConfig, batch_size: int, precision: Precision, seconds: float, rounds: int) -> list[Row]:
    """One batch size in one precision."""
    spec = run.window_spec()
    raw = torch.from_numpy(random_rows(spec, batch_size).view("u1").reshape(batch_size, -1)).pin_memory()
    importance = torch.ones(batch_size).pin_memory()
    plain, graphed = (_update(run, precision) for _ in range(2))
    at_once = DeviceUpdate(graphed, spec, batch_size)
    beta, numbers = torch.zeros((), device="cuda"), count(1)

    def one_by_one() -> int:
        for _ in range(CHUNK):
            there = raw.to("cuda", non_blocking=True), importance.to("cuda", non_blocking=True)
            plain(view_batch(*there, spec, plain.plan(raw, spec, next(numbers))), beta).priorities.cpu()
        return CHUNK

    def as_graph() -> int:
        before = None
        for _ in range(CHUNK):
            (updated,) = at_once(raw, importance, 0.0, next(numbers))
            if before is not None:
                before.wait()
            before = HostCopy(updated.priorities)
        torch.cuda.synchronize()
        return CHUNK

    name = f"update on a GPU, {run.env.id}, batch {batch_size}, {'tf32' if precision == 'auto' else precision}"
    peers = {"launched kernel by kernel": lambda: speed(one_by_one, seconds)}
    for work in (one_by_one, as_graph):
        speed(work, 1.0)
    return compare(name, "updates/s", lambda: speed(as_graph, seconds), peers, rounds=rounds)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--batches", type=int, nargs="+", default=[64, 256])
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("PyTorch sees no CUDA device: nothing was measured")
        return
    run = robust(EnvConfig(options.env))
    rows: list[Row] = []
    for size, precision in product(options.batches, PRECISIONS):
        rows += measure(run, size, precision, options.seconds, options.rounds)
    save(rows)


if __name__ == "__main__":
    main()
