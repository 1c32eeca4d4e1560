"""Packages that a test does as if they were not installed."""

import importlib.util

import pytest


def hide(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """None finds it for as long as the test lasts."""
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else there(name))
