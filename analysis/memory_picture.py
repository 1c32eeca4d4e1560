"""What an agent remembers, as panels of a picture and as tables: influence over delay, what h tells of the hidden."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.table import Table

from rmc.analysis.episodes import Episode, HiddenPart
from rmc.analysis.influence import Influence, influence
from rmc.analysis.memory_probe import Probe, probes
from rmc.common.agent import Agent, Memory
from rmc.deploy.monitor.table import plain_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # an extra

COLOURS = {"h": "tab:purple", "Q": "tab:orange", "action": "tab:blue"}
TABLE_DELAYS = (1, 5, 10, 20, 50, 100, 300, 1_000)
LEAST_R2 = -1.0  # drawn
WIDTH = 100  # columns that the tables take


@dataclass(frozen=True)
class MemoryInsight:
    """What an agent remembers."""

    first: Influence  # of an episode's first observation
    later: Influence
    probes: list[Probe]

    @property
    def panels(self) -> int:
        """That ``draw`` needs."""
        return 1 + bool(self.probes)


def examine_memory(agent: Agent, untrained: Memory, episodes: list[Episode], parts: list[HiddenPart]) -> MemoryInsight:
    """From several episodes, and what they hide from the agent, beside a memory that never learnt."""
    return MemoryInsight(*influence(agent, episodes), probes(agent, untrained, episodes, parts))


def draw(memory: MemoryInsight, axes: "list[Axes]") -> None:
    """Influence in the first of ``panels`` axes, probes in the second."""
    for name, one, style in (("first", memory.first, "-"), ("later", memory.later, "--")):
        for quantity, values in one.changes.items():
            label = f"{quantity}, {name} observation"
            axes[0].plot(one.delays, values, style, color=COLOURS[quantity], marker=".", label=label)
    axes[0].set_xscale("log")
    axes[0].xaxis.set_major_formatter("{x:g}")
    axes[0].set_ylim(bottom=0.0)
    axes[0].set_xlabel("steps after an observation is changed")
    axes[0].set_ylabel("change / spread")
    axes[0].legend(ncols=2, fontsize="small")
    if memory.probes:
        _draw_probes(memory.probes, axes[1])


def _draw_probes(of: list[Probe], axis: "Axes") -> None:
    places = range(len(of))
    for offset, label, values, colour in (
        (-0.27, "from h", [one.from_memory for one in of], "tab:purple"),
        (0.0, "from an untrained h", [one.from_untrained for one in of], "thistle"),
        (0.27, "from the newest observation", [one.from_newest for one in of], "lightgrey"),
    ):
        lengths = [max(value, LEAST_R2) for value in values]
        axis.barh([place + offset for place in places], lengths, 0.27, color=colour, label=label)
    axis.set_yticks(list(places), [one.name for one in of], parse_math=False)
    axis.invert_yaxis()
    least = min(min(one.from_memory, one.from_untrained, one.from_newest) for one in of)
    axis.set_xlim(LEAST_R2 if least < 0.0 else 0.0, 1.0)
    axis.set_xlabel("R² of what is hidden, read linearly")
    axis.legend(fontsize="small")


def tables(memory: MemoryInsight) -> list[str | Table]:
    """For a terminal."""
    head = "one observation is changed; how much that changes later, as a share of each quantity's own spread:"
    return [head, _influence_table(memory), *([_probe_table(memory.probes)] if memory.probes else [])]


def _influence_table(memory: MemoryInsight) -> Table:
    delays = [k for k in TABLE_DELAYS if k in {*memory.first.delays, *memory.later.delays}]
    heads = [f"{k} step{'s' * (k > 1)} later" if k == delays[0] else f"{k:,}" for k in delays]
    table = plain_table(("changed observation", "changes", *heads))
    for name, one in (("first", memory.first), ("later", memory.later)):
        for quantity, values in one.changes.items():
            by_delay = dict(zip(one.delays, values, strict=True))
            table.add_row(name, quantity, *(f"{by_delay[k]:.0%}" if k in by_delay else "" for k in delays))
    return table


def _probe_table(of: list[Probe]) -> Table:
    table = plain_table(("hidden", "R² from h", "from an untrained h", "from the newest observation"))
    for one in of:
        table.add_row(one.name, *(f"{value:.2f}" for value in (one.from_memory, one.from_untrained, one.from_newest)))
    return table
