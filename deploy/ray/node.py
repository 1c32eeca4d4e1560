"""What an actor of Ray's does on its node before it starts processes of ours."""

import os
from pathlib import Path

RAYS_OWN = ("RAY_JOB_ID", "RAY_RAYLET_PID", "OMP_NUM_THREADS")  # variables for Ray's workers, which ours are not


def private_folder(path: Path) -> Path:
    """That folder, made where it is not there. Raises RuntimeError where others may write in it."""
    path.mkdir(mode=0o700, exist_ok=True)
    status = path.lstat()
    if status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise RuntimeError(f"{path} is not private; remove it")
    return path


def leave_rays_worker(working_folder: str) -> None:
    """What is started from here is no worker of Ray's, and begins where the user's environments may lie."""
    for name in RAYS_OWN:
        os.environ.pop(name, None)
    if os.path.isdir(working_folder):
        os.chdir(working_folder)
