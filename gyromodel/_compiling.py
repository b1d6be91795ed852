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
# The newest jaxlib known to have these switches: XLA ends the process over one that it does not know.
NEWEST_KNOWN = (0, 10, 2)
FUSIONS = "xla_cpu_use_fusion_emitters"
# Loops of up to so many bytes become one kernel: epochs of navigation cost what their arithmetic does.
LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000"


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
    jaxlib = tuple(int(part) for part in version("jaxlib").split(".")[:3] if part.isdigit())
    return {FUSIONS: False} if jaxlib <= NEWEST_KNOWN else {}


def switch_compiler() -> None:
    """Choose how XLA compiles for this process and those that it starts; call before JAX is imported."""
    if former_fusions():
        os.environ.setdefault("XLA_FLAGS", f"--{FUSIONS}=false {LOOPS}")
