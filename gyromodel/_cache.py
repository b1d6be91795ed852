"""Where things that only save time are kept between runs; what cannot be kept is made again."""

from __future__ import annotations

import os
import platform
import shutil
import warnings
from contextlib import suppress
from pathlib import Path

# Bytes of compiled code that are kept; beyond, one begins anew.
MOST_KEPT = 500_000_000


def cache_folder(name: str) -> Path:
    """A folder of the user's cache; not made."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "gyromodel" / name


def keep_compiled() -> None:
    """Have JAX keep what it compiles for later processes; call before JAX is imported.

    In a folder of this machine, as others may share the home and not its processor; JAX's own settings in the
    environment are left as they are. What was cut short there is compiled again, without JAX's warning.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    with suppress(OSError, RuntimeError):  # the second where there is no home
        folder = cache_folder("compiled") / (platform.node() or "here")
        if folder.exists() and sum(file.stat().st_size for file in folder.iterdir()) > MOST_KEPT:
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
            warnings.filterwarnings("ignore", "Error reading persistent compilation cache entry")
            os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
