"""An experiment: its configuration, what is built from it, and its folder."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parents[2]
_CHECKOUT = _PACKAGE.parent

CONF = str((_PACKAGE if (_PACKAGE / "conf").is_dir() else _CHECKOUT) / "conf")
"""Folder of the configuration: in the installed package, or in the checkout."""
