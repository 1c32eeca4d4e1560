"""What a report plays and looks at: an episode of a policy as a video, and its world model's rollouts as a picture."""

import io
import tempfile
from dataclasses import dataclass
from pathlib import Path

from rmc.analysis import video, world_model_picture
from rmc.analysis.policy import load_policy
from rmc.analysis.report_figures import data_uri
from rmc.analysis.report_run import ReportRun
from rmc.common.errors import ConfigError, RmcError
from rmc.common.return_text import return_text
from rmc.deploy.run.checkpoint_choice import checkpoint_number

LONGEST_FILM = 1_000  # steps: the page holds it


@dataclass(frozen=True)
class Medium:
    """An embedded file, or why there is none."""

    run: str
    uri: str = ""
    note: str = ""


def media(run: ReportRun, with_video: bool) -> tuple[Medium | None, Medium]:
    """Film and rollouts of one checkpoint; of a run in training, unless that is dropped meanwhile."""
    checkpoint = _there(run, "latest")
    seen = rollouts(run, checkpoint)
    return film(run, _there(run, checkpoint)) if with_video else None, seen


def _there(run: ReportRun, checkpoint: str) -> str:
    """Its number, as a run goes on to others; "latest" where it is not there."""
    try:
        return str(checkpoint_number(run.folder, checkpoint))
    except ConfigError:
        return "latest"


def film(run: ReportRun, checkpoint: str) -> Medium:
    """One deterministic episode, its first 1 000 steps."""
    if run.folder.is_baseline():
        return Medium(run.name, note="Of a baseline there is no video.")
    try:
        config = run.folder.config()
        with tempfile.TemporaryDirectory() as place:
            out, policy = Path(place) / "episode.mp4", load_policy(run.folder.path, checkpoint)
            video.prepare(config.env, out)
            total = video.record(policy, config.env, config.seed, out, LONGEST_FILM)
            return Medium(
                run.name,
                data_uri(out.read_bytes(), "video/mp4"),
                f"return {return_text(total)} over its first {LONGEST_FILM:,} steps at most",
            )
    except RmcError as error:
        return Medium(run.name, note=f"No video: {_why(error)}.")


def rollouts(run: ReportRun, checkpoint: str) -> Medium:
    """The world model's predictions along an episode."""
    if run.folder.is_baseline():
        return Medium(run.name, note="A baseline has no world model.")
    picture = io.BytesIO()
    try:
        insight = world_model_picture.inspect_to(run.folder, checkpoint, picture)
    except RmcError as error:
        return Medium(run.name, note=f"No world-model rollouts: {_why(error)}.")
    ahead = ", ".join(f"{share:.0%} at {horizon}" for horizon, share in insight.open_loop.items())
    note = f"unexplained of the observation's change, by steps ahead: {ahead} (100% is a guess of no change)"
    if not ahead:
        note = world_model_picture.NOTHING_SEEN
    return Medium(run.name, data_uri(picture.getvalue(), "image/png"), note)


def _why(error: RmcError) -> str:
    return error.fix if isinstance(error, ConfigError) else str(error)
