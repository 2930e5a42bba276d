"""The commands, one a file: ``torchrl-osr train`` is ``train.py``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_CHECKOUT = _PACKAGE.parent

CONF = str((_PACKAGE if (_PACKAGE / "conf").is_dir() else _CHECKOUT) / "conf")
"""Folder of the configuration: in the installed package, or in the checkout."""


def import_from_here() -> None:
    """Let modules that the user has named be imported from the current folder.

    It comes last: no file in it takes the place of a package that is installed.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
