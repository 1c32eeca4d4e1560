"""What is said about an extra that is missing works where it is said."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import rmc
from rmc.common.extra import how_to_install
from rmc.deploy.run.tracking import TrackerName
from tests.package import FOLDERS, PYPROJECT, ROOT


def test_from_a_checkout() -> None:
    assert how_to_install("onnx") == f"pip install -e '.[onnx]' in {ROOT}"


def test_from_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmc.__spec__, "origin", str(tmp_path / "rmc" / "__init__.py"))
    assert how_to_install("onnx") == "pip install 'rmc-rl[onnx]'"


def test_from_a_wheels_files(tmp_path: Path) -> None:
    """As they lie in site-packages."""
    shutil.copytree(ROOT / "rmc", tmp_path / "rmc", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "common", tmp_path / "rmc" / "common", ignore=shutil.ignore_patterns("__pycache__"))
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); sys.meta_path = [f for f in sys.meta_path if "
        "'editable' not in f.__module__]; from rmc.common.extra import how_to_install as how; print(how('ray'))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout == "pip install 'rmc-rl[ray]'\n", done.stderr


def test_every_hint_asks_for_it_and_names_an_extra() -> None:
    extras = PYPROJECT["project"]["optional-dependencies"]
    paths = [ROOT / "Makefile", *(path for name in FOLDERS for path in (ROOT / name).rglob("*.py"))]
    texts = {path: path.read_text() for path in paths}
    assert not [str(path) for path, text in texts.items() if re.search(r"""install ['"]?rmc\\?\[""", text)]
    asks = re.compile(r"""(?:how_to_install|check_installed)\(['"]([^'"]*)['"]""")
    asked = {name for text in texts.values() for name in asks.findall(text)}
    assert asked | {*get_args(TrackerName)} == extras.keys() - {"dev"}
