"""Kernel locks, which end with their process; temporary files that nobody locks are left over."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

fcntl: Any  # on POSIX a module, elsewhere None
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # file systems that cannot lock


def try_lock(file: IO[Any], *, shared: bool = False) -> bool | None:
    """Take the kernel's lock on a file; processes that inherit the file share it until the last one closes it.

    Returns whether it was free; None if the system cannot lock, so that nobody is kept out.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return None
    return True


def is_there(file: IO[Any], path: Path) -> bool:
    """Whether ``path`` is still the opened file; its owner removes it at the end."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    return False


@contextlib.contextmanager
def fresh_file(path: Path) -> Iterator[None]:
    """An empty file, locked during the block; removed at its end if still there.

    Windows cannot rename open files: there it is not locked.
    """
    try:
        while True:
            with path.open("wb") as file:
                if fcntl is None:
                    file.close()
                elif try_lock(file) is False or not is_there(file, path):
                    continue  # another process took it for left over and removes it
                yield
                return
    finally:
        path.unlink(missing_ok=True)


def remove_left_over(path: Path) -> None:
    """Remove a :func:`fresh_file` whose process has ended; on systems without locks it stays."""
    if fcntl is None or path.is_symlink() or not path.is_file():
        return
    with path.open("r+b") as file:
        if try_lock(file) and is_there(file, path):
            path.unlink()
