"""Who follows a run, a tracker or films alone: chosen on the command line, kept in the run's folder."""

import dataclasses
import json
import logging
import re
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rmc.common.errors import ConfigError
from rmc.common.extra import check_installed
from rmc.common.whole_file import write_whole
from rmc.deploy.run.config import from_dict
from rmc.deploy.run.folder import RunFolder, read_object
from rmc.deploy.run.launch_options import LaunchOptions, TrackerName
from rmc.deploy.run.option_names import option

PROJECT = "rmc"
VIDEOS: Literal["videos"] = "videos"  # in a tracker's place: films alone
LONGEST_TAG = 64  # characters that wandb takes
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tracking:
    """A run as its tracker knows it; the ``id`` stays over all starts."""

    tracker: TrackerName | Literal["videos"]
    project: str
    tags: tuple[str, ...]
    id: str
    video_every: int = 0  # evaluations; 0 films the final policy alone
    name: str = ""  # of the run's folder when the tracker first had it


def choose_tracking(options: LaunchOptions) -> Tracking | None:
    """What the options ask for; where they say nothing, what the run's folder has. Raises ConfigError."""
    resumes = options.run_dir is not None and options.if_exists == "resume"
    before = kept_tracking(options.run_dir) if options.run_dir is not None and resumes else None
    before = before if options.track != "off" else None
    tracker: TrackerName | Literal["videos"] = before.tracker if before else VIDEOS
    if options.track is not None and options.track != "off":
        tracker = options.track
    if tracker == VIDEOS and options.track != "off":
        _refuse_without_tracker(options)
    project = options.track_project or (before.project if before else PROJECT)
    tags = options.track_tags or (before.tags if before else ())
    every = options.video_every if options.video_every is not None else before.video_every if before else 0
    if tracker == VIDEOS and not every:
        return None
    _check(tracker, project, tags, every)
    if before is None or (before.tracker, before.project) != (tracker, project):
        return Tracking(tracker, project, tags, secrets.token_hex(4), every)
    return Tracking(tracker, project, tags, before.id, every, before.name)


def _refuse_without_tracker(options: LaunchOptions) -> None:
    for name in ("track_project", "track_tags"):
        if value := getattr(options, name):
            raise ConfigError(option(name), value, "say which tracker: --track wandb, trackio or mlflow")


def _check(tracker: str, project: str, tags: tuple[str, ...], video_every: int) -> None:
    if tracker == VIDEOS:
        check_installed("video", ("imageio_ffmpeg",), "--video-every", video_every)
    else:
        check_installed(tracker, (tracker,), "--track", tracker)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", project):
        fix = "take up to 100 letters, digits, and _ . - after the first"
        raise ConfigError("--track-project", project, fix)
    for tag in tags:
        if not (tag.isprintable() and 1 <= len(tag) <= LONGEST_TAG):
            raise ConfigError("--track-tags", tag, f"take tags of 1 to {LONGEST_TAG} characters")
    if video_every < 0:
        raise ConfigError("--video-every", video_every, "take 1 or more evaluations, or 0 for the final one alone")


def keep_tracking(folder: RunFolder, tracking: Tracking | None) -> None:
    """Write it into the run's folder, whose name it takes where it has none, or that there is none."""
    if tracking is None:
        _file(folder.path).unlink(missing_ok=True)
    else:
        named = dataclasses.asdict(tracking) | {"name": tracking.name or folder.path.name}
        write_whole(_file(folder.path), f"{json.dumps(named)}\n".encode())


def kept_tracking(path: Path) -> Tracking | None:
    """That of a run's folder, None where it has none. Raises ConfigError where the file is damaged."""
    names, kept = {item.name for item in dataclasses.fields(Tracking)}, None
    try:
        settings = {"video_every": 0, "name": ""} | read_object(_file(path))  # older versions had neither
        kept = from_dict(Tracking, {name: value for name, value in settings.items() if name in names}, "")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except ConfigError:
        pass
    if kept is None or kept.video_every < 0:
        raise ConfigError("tracking.json", str(_file(path)), "is damaged; remove it, and give --track again")
    return kept


def _file(path: Path) -> Path:
    return path / "tracking.json"
