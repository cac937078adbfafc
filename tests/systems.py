"""Marks of tests that need what Windows lacks."""

import os
import sys

import pytest

IS_WINDOWS = sys.platform == "win32"
PIPES = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no pipes in folders")
LINKS = pytest.mark.skipif(IS_WINDOWS, reason="Windows lets few users make links")
MODES = pytest.mark.skipif(IS_WINDOWS, reason="Windows has no modes of files")
SHELL = pytest.mark.skipif(IS_WINDOWS, reason="Windows has no shell of POSIX")
TERMINAL = pytest.mark.skipif(not hasattr(os, "openpty"), reason="Windows has no pseudo-terminals")
FORK = pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no fork")
