"""Writing files so that a reader sees the old file or the new one, never half of one."""

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_write(path: Path | str) -> Iterator[BinaryIO]:
    """Write beside `path`, flush to the disk, then rename over it. On an exception `path` is as it was."""
    target = Path(path)
    name = target.parent / f".{target.name}.{secrets.token_hex(4)}.part"
    # not mkstemp: its files are private, and to read the umask is to change it for a moment, for all threads
    handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, target)
        sync_folder(target.parent)
    except BaseException:
        name.unlink(missing_ok=True)
        raise


def sync_folder(folder: Path) -> None:
    """Flush the folder itself, so that names made or replaced in it outlast a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_regular(path: Path | str) -> BufferedReader:
    """Open a file for reading; OSError for a folder, a pipe or a device, none of which is waited for."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "no regular file", str(path))
    return os.fdopen(descriptor, "rb")
