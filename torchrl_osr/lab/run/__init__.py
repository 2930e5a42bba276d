"""An experiment: its configuration, what is built from it, and its folder."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parents[2]

CONF = str((_PACKAGE if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent) / "conf")
"""Folder of the configuration: in the installed package, or in the checkout."""
