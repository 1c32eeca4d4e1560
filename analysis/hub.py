"""Files to and from a repository of the Hugging Face hub; HF_ENDPOINT names another hub."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from rmc.analysis import model_card
from rmc.common.checkpoint import POLICY
from rmc.common.errors import ConfigError, first_line, one_line
from rmc.common.extra import check_installed

SCHEME = "hf:/"  # before a repository's name, where a path is asked for; a Path keeps but one of its slashes
CARD = "README.md"
UNREACHED = (ConnectionError, TimeoutError, RuntimeError)  # of hf-xet, through which large files go


def check_hub(repo: str) -> None:
    """Raises ConfigError where the hub's library is missing, or the repository has no owner."""
    check_installed("hub", ("huggingface_hub",), "REPO", repo)
    if "/" not in repo:  # the hub would make it, and find nothing under that name afterwards
        raise ConfigError("REPO", repo, "no repository's name; give owner/name")


def push(repo: str, files: Mapping[str, bytes], private: bool) -> str:
    """One commit of these files; a repository that is not there is made. Its address. Raises ConfigError.

    Of a card that is there only RMC's part is replaced.
    """
    from huggingface_hub import CommitOperationAdd, HfApi, get_token

    if get_token() is None:
        raise ConfigError("HF_TOKEN", None, "no token; set it to one that may write, or run hf auth login")
    api = HfApi(library_name="rmc")
    with _in_one_line(repo):
        api.create_repo(repo, private=private or None, exist_ok=True)
        if (there := _card(repo)) is not None:
            files = {**files, CARD: model_card.renewed(there, files[CARD].decode()).encode()}
        added = [CommitOperationAdd(name, content) for name, content in files.items()]
        return str(api.create_commit(repo, added, commit_message="Upload a policy with RMC").repo_url)


def _card(repo: str) -> str | None:
    """The repository's card as it is now, if it has one."""
    from huggingface_hub import errors, hf_hub_download

    try:
        return Path(hf_hub_download(repo, CARD, library_name="rmc", force_download=True)).read_text()
    except errors.RemoteEntryNotFoundError:  # an outage raises another, and replaces no card
        return None


def pull(repo: str, revision: str | None = None) -> Path:
    """A repository's policy, in the hub's own cache. Raises ConfigError."""
    check_hub(repo)
    from huggingface_hub import hf_hub_download

    with _in_one_line(repo, revision):
        return Path(hf_hub_download(repo, POLICY, revision=revision, library_name="rmc"))


@contextmanager
def _silent() -> Iterator[None]:
    """The hub's library; afterwards it is as loud as the caller's program had it."""
    from huggingface_hub.utils.logging import get_verbosity, set_verbosity
    from huggingface_hub.utils.tqdm import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    verbosity, without_bars = get_verbosity(), are_progress_bars_disabled()
    disable_progress_bars()
    set_verbosity(logging.ERROR)
    try:
        yield
    finally:
        set_verbosity(verbosity)
        if not without_bars:
            enable_progress_bars()


@contextmanager
def _in_one_line(repo: str, revision: str | None = None) -> Iterator[None]:
    """What the hub refuses, as a ConfigError; its library says nothing beside that."""
    from huggingface_hub import constants, errors

    try:
        with _silent():
            yield
    except errors.HFValidationError:
        raise ConfigError("REPO", repo, "no repository's name; give owner/name") from None
    except errors.GatedRepoError:
        raise ConfigError("REPO", repo, f"it wants to be asked; do so at {constants.ENDPOINT}/{repo}") from None
    except errors.RepositoryNotFoundError:
        fix = "no such repository, or a private one; check its name, or run hf auth login"
        raise ConfigError("REPO", repo, fix) from None
    except errors.RevisionNotFoundError:
        raise ConfigError("--revision", revision, f"{repo} has no such revision; leave it") from None
    except errors.RemoteEntryNotFoundError:
        raise ConfigError("REPO", repo, f"it holds no {POLICY}; rmc hub push puts one there") from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        fix = "use a token that may" if status in (401, 403) else "try again"
        raise ConfigError("REPO", repo, f"the hub refuses it (HTTP {status}); {fix}") from None
    except ValueError as error:  # its library's word for a model card that the hub refuses
        raise ConfigError("REPO", repo, f"the hub refuses it ({one_line(error)}); correct that") from None
    except (*UNREACHED, errors.OfflineModeIsEnabled, errors.LocalEntryNotFoundError, errors.HTTPError) as error:  # type: ignore[attr-defined]
        cause = error.__cause__ if isinstance(error, errors.LocalEntryNotFoundError) and error.__cause__ else error
        fix = f"cannot be reached ({first_line(cause)}); try again with a network"
        raise ConfigError("HF_ENDPOINT", constants.ENDPOINT, fix) from None
