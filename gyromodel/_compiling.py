"""How JAX compiles for commands: what it keeps for later processes, and which of XLA's code it takes."""

from __future__ import annotations

import os
import platform
import shutil
import warnings
from contextlib import suppress
from importlib.metadata import version

from gyromodel._cache import cache_folder

# Bytes of compiled code that are kept; beyond, one begins anew.
MOST_KEPT = 500_000_000
# The newest jaxlib known to have the switch below: XLA ends the process over one that it does not know.
NEWEST_KNOWN = (0, 10, 2)


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


def former_fusions() -> dict[str, bool]:
    """XLA's former code for fused loops on processors, as options of `jax.jit`; none where it may be gone.

    It compiles faster than the present one, and to faster code where arrays are joined.
    """
    newest = tuple(int(part) for part in version("jaxlib").split(".")[:3] if part.isdigit())
    return {"xla_cpu_use_fusion_emitters": False} if newest <= NEWEST_KNOWN else {}


def take_former_fusions() -> None:
    """Set them for everything that this process and those that it starts compile; call before JAX is imported."""
    os.environ.setdefault("XLA_FLAGS", " ".join(f"--{k}={str(v).lower()}" for k, v in former_fusions().items()))
