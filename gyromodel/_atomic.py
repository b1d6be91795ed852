"""Writes that leave either the old file or the new one, never half."""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path


@contextmanager
def sibling(target: Path) -> Iterator[Path]:
    """A hidden name beside a target, for what is to take its place; what still has it at the end is removed.

    What killed runs have left there is removed first, and a folder that they put aside is put back where nothing
    stands in its place: a run that writes holds a lock on the folder, which the system takes back however the run ends.
    """
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    with ExitStack() as held:
        with suppress(ImportError, OSError):  # where locks are unknown, nothing is removed
            import fcntl

            folder = os.open(target.parent, os.O_RDONLY)
            held.callback(os.close, folder)
            with suppress(BlockingIOError):
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                for left in target.parent.glob(f".{glob.escape(target.name)}.{'?' * 8}.old"):
                    _remove(left) if target.exists() else os.replace(left, target)
                for left in target.parent.glob(f".{glob.escape(target.name)}.{'?' * 8}.tmp"):
                    _remove(left)
            fcntl.flock(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
        held.callback(_remove, temporary)
        try:
            yield temporary
        except OSError as error:
            if error.errno:
                error.filename = str(target)  # a full disk names nothing
            raise


def replace_folder(temporary: Path, target: Path) -> None:
    """Put one folder in the place of another, which then has its name.

    In one step, so that who reads always finds one; in three where the system or a network drive lacks that step.
    """
    try:
        _exchange(temporary, target)
    except (AttributeError, OSError):
        aside = temporary.with_suffix(".old")
        os.replace(target, aside)
        try:
            os.replace(temporary, target)
        except OSError:
            os.replace(aside, target)
            raise
        os.replace(aside, temporary)


def _exchange(one: Path, other: Path) -> None:
    """Linux's renameat2 with RENAME_EXCHANGE; absolute paths."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(0, os.fsencode(one), 0, os.fsencode(other), 2):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(other))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif os.path.lexists(path):  # on a read-only disk not even what is absent can be removed
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text beside the target, or what a link there leads to, and move it into place."""
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    with sibling(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
