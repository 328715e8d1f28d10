"""Files that are whole or not there, whatever interrupts their writing."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import secrets
import socket
import stat
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    HAS_LOCKS = False
else:
    HAS_LOCKS = True

_DAY = 86400.0  # seconds
_FAR = 1 << 40  # Windows locks bytes: one where there are none, so that all can be read


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a binary file to write that becomes ``path`` when the block ends without an error.

    Until then an old file stays as it was, and so it does for ever if the block is interrupted.
    What a killed process leaves behind is removed by the next write to the same file. A file that
    is replaced keeps its permissions, and a symbolic link stays one: its target is replaced.

    Parameters
    ----------
    overwrite : bool
        Whether an old file may be replaced. If not, one of several that write ``path`` at once
        succeeds.

    Raises
    ------
    FileExistsError
        If ``path`` exists, even as a link to nowhere, and ``overwrite`` is False.
    OSError
        If ``path`` is something else than a file, or its folder cannot be written to.
    """
    if not overwrite and os.path.lexists(path):
        raise _exists(path)
    target = Path(os.path.realpath(path))
    old = _status(target)
    _remove_leftovers(target)
    file = _open_temporary(target, 0o666 if old is None else stat.S_IMODE(old.st_mode), path)
    temporary = Path(file.name)
    try:
        with file:
            yield file
            file.flush()
            if old is not None:
                _take_over(temporary, old)
            os.fsync(file.fileno())
            if not HAS_LOCKS:  # Windows, which renames no open file
                file.close()
            # Elsewhere under the lock, so that nobody takes the file for a leftover.
            if overwrite:
                os.replace(temporary, target)
            else:
                _put_new(temporary, target, path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync_folder(target.parent)


def _exists(path: str | os.PathLike[str]) -> FileExistsError:
    return FileExistsError(f"{os.fspath(path)} exists; pass overwrite=True to replace it")


def _status(target: Path) -> os.stat_result | None:
    """Return the status of the file to be replaced, None if there is none."""
    try:
        status = target.stat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{target} is not a file and cannot be replaced by one")
    return status


def _prefix(target: Path) -> str:
    """Return how the names of the temporary files for ``target`` begin.

    They end before the 255 bytes that most file systems allow.
    """
    return f".{target.name[:50]}."


def _computer() -> str:
    return f"{zlib.crc32(os.fsencode(socket.gethostname())):08x}"


def _open_temporary(target: Path, mode: int, path: str | os.PathLike[str]) -> BinaryIO:
    """Create a file beside ``target`` and lock it; ``mode`` is subject to the umask."""
    while True:
        unique = f"{_computer()}-{secrets.token_hex(4)}"
        temporary = target.with_name(f"{_prefix(target)}{unique}.part")
        try:
            file = open(temporary, "xb", opener=functools.partial(os.open, mode=mode))
        except OSError as error:
            why = f"cannot write to the folder ({error.strerror})"
            raise OSError(error.errno, why, os.fspath(path)) from None
        if _locked(file):
            return file
        file.close()
        temporary.unlink(missing_ok=True)


def _locked(file: BinaryIO) -> bool:
    """Lock a new file, or say that someone who clears up was faster."""
    return not HAS_LOCKS or (try_lock(file) and os.path.exists(file.name))


def try_lock(file: BinaryIO) -> bool:
    """Lock an open file until it is closed or the process ends; False if somebody else has."""
    if sys.platform == "win32":
        import msvcrt

        place = file.tell()
        file.seek(_FAR)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            file.seek(place)
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: nobody gets one, and nobody clears up
        return True
    return True


def _remove_leftovers(target: Path) -> None:
    """Remove what killed processes left of ``target``, and nothing that is being written."""
    pattern = re.compile(re.escape(_prefix(target)) + r"([0-9a-f]{8})-[0-9a-f]{8}\.part")
    with contextlib.suppress(OSError):  # a folder that cannot be listed
        for name in os.listdir(target.parent):
            if match := pattern.fullmatch(name):
                with contextlib.suppress(OSError):  # in use, gone already, or someone else's
                    _remove_if_dead(target.with_name(name), match[1])


def _remove_if_dead(path: Path, computer: str) -> None:
    """Remove a temporary file if its writer, who locks it as long as it lives, is gone.

    Some network file systems keep locks for every computer alone: a file of another one must be
    a day old as well, and so must all where there are no locks.
    """
    local = HAS_LOCKS and computer == _computer()
    if not local and time.time() - path.stat().st_mtime < _DAY:
        return
    with open(path, "rb") if HAS_LOCKS else contextlib.nullcontext() as file:
        if file is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()


def _take_over(temporary: Path, old: os.stat_result) -> None:
    """Give the new file the owner and the permissions of the old one."""
    if hasattr(os, "chown"):
        with contextlib.suppress(OSError):  # only root may give files away
            os.chown(temporary, old.st_uid, old.st_gid)
    os.chmod(temporary, stat.S_IMODE(old.st_mode))


def _put_new(temporary: Path, target: Path, path: str | os.PathLike[str]) -> None:
    """Give the temporary file the name of ``target``, which nobody else may have taken."""
    try:
        os.link(temporary, target)
        return
    except FileExistsError:
        raise _exists(path) from None
    except OSError:  # a file system without hard links
        pass
    try:
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except FileExistsError:
        raise _exists(path) from None
    try:
        os.replace(temporary, target)
    except OSError:
        if target.stat().st_size == 0:  # nothing but the reserved name
            target.unlink()
        raise


def _sync_folder(folder: Path) -> None:
    """Write the new name to the disk, where folders can be opened."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
