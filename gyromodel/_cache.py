"""Where things that only save time are kept between runs; what cannot be kept is made again."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from pathlib import Path


def cache_folder(name: str) -> Path:
    """A folder of the user's cache; not made."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "gyromodel" / name


def keep_compiled() -> None:
    """Have JAX keep what it compiles for later processes; call before JAX is imported.

    In a folder of this machine, as others may share the home and not its processor; JAX's own settings in the
    environment are left as they are.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    with suppress(OSError):
        folder = cache_folder("compiled") / (platform.node() or "here")
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
            os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
