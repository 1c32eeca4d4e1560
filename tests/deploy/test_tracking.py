"""Which tracker follows a run is chosen once, and stays with the run's folder."""

import dataclasses
from typing import Any

import pytest

from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.tracking import PROJECT, Tracking, choose_tracking, keep_tracking, kept_tracking
from tests.hiding import hide

NEGATIVE = '{"tracker": "wandb", "project": "x", "tags": [], "id": "y", "video_every": -1}'


def chosen(folder: RunFolder, **options: Any) -> Tracking | None:
    return choose_tracking(dataclasses.replace(LaunchOptions(folder.path), **options))


def test_a_new_run_is_in_no_tracker_unless_asked(folder: RunFolder) -> None:
    assert chosen(folder) is None
    tracking = chosen(folder, track="wandb", track_tags=("a", "b"))
    assert tracking is not None
    assert (tracking.tracker, tracking.project, tracking.tags) == ("wandb", PROJECT, ("a", "b"))


def test_how_often_it_is_filmed_goes_on_with_the_run(folder: RunFolder) -> None:
    keep_tracking(folder, chosen(folder, track="wandb", video_every=3))
    for words, every in (({}, 3), ({"video_every": 0}, 0), ({"track": "trackio"}, 3)):
        tracking = chosen(folder, **words)
        assert tracking is not None
        assert tracking.video_every == every
    with pytest.raises(ConfigError, match=r"^--video-every=-1: take 1 or more evaluations, or 0"):
        chosen(folder, video_every=-1)
    assert chosen(folder, track="off", track_project="x") is None
    keep_tracking(folder, None)
    alone = chosen(folder, video_every=2)
    assert alone is not None
    assert (alone.tracker, alone.video_every) == ("videos", 2)
    keep_tracking(folder, alone)
    alone = dataclasses.replace(alone, name="run")
    assert kept_tracking(folder.path) == chosen(folder) == alone  # a run that goes on is filmed further
    assert chosen(folder, video_every=0) is None
    with pytest.raises(ConfigError, match=r"^--track-tags=.*: say which tracker: --track wandb"):
        chosen(folder, track_tags=("a",))


def test_what_a_version_before_has_kept_is_read(folder: RunFolder) -> None:
    (folder.path / "tracking.json").write_text('{"tracker": "wandb", "project": "x", "tags": [], "id": "y"}')
    assert kept_tracking(folder.path) == Tracking("wandb", "x", (), "y", 0)


def test_a_run_that_goes_on_stays_the_same_in_its_tracker(folder: RunFolder) -> None:
    given = chosen(folder, track="trackio", track_project="mine", track_tags=("a",))
    assert given is not None
    keep_tracking(folder, given)
    first = dataclasses.replace(given, name="run")
    assert kept_tracking(folder.path) == chosen(folder) == chosen(folder, track="trackio") == first
    tagged = chosen(folder, track_tags=("c",))
    assert tagged == dataclasses.replace(first, tags=("c",))
    for elsewhere in ({"track": "wandb"}, {"track_project": "other"}):
        other = chosen(folder, **elsewhere)
        assert other is not None
        assert other.id != first.id
    assert chosen(folder, if_exists="new") is None


def test_its_name_there_is_that_of_the_folder_at_its_first_start(folder: RunFolder) -> None:
    """As today's is for one of a version before, which kept none; elsewhere it is another run."""
    (folder.path / "tracking.json").write_text('{"tracker": "trackio", "project": "x", "tags": [], "id": "y"}')
    keep_tracking(folder, chosen(folder))
    renamed = RunFolder(folder.path.rename(folder.path.with_name("renamed")))
    for words, name in (({}, "run"), ({"track_project": "other"}, "renamed")):
        keep_tracking(renamed, chosen(renamed, **words))
        kept = kept_tracking(renamed.path)
        assert kept is not None
        assert kept.name == name


def test_it_can_be_left(folder: RunFolder) -> None:
    keep_tracking(folder, chosen(folder, track="wandb"))
    keep_tracking(folder, chosen(folder, track="off"))
    assert chosen(folder) is None
    keep_tracking(folder, None)  # once more


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"tracker": "neptune", "project": "x", "tags": [], "id": "y"}', NEGATIVE]
)
def test_a_damaged_note_is_named(folder: RunFolder, text: str) -> None:
    (folder.path / "tracking.json").write_text(text)
    with pytest.raises(ConfigError, match=r"^tracking\.json='.*': is damaged; remove it, and give --track again$"):
        chosen(folder)


@pytest.mark.parametrize("tracker", ["wandb", "trackio"])
def test_a_missing_extra_is_said(folder: RunFolder, tracker: str, monkeypatch: pytest.MonkeyPatch) -> None:
    hide(tracker, monkeypatch)
    with pytest.raises(ConfigError, match=rf"--track='{tracker}': {tracker} is missing; pip install .*{tracker}"):
        chosen(folder, track=tracker)
