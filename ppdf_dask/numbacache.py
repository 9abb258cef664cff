"""A place for compiled kernels where neither the package's folder nor the home can be written."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from contextlib import suppress
from pathlib import Path


def ensure_cache() -> str | None:
    """Give Numba a private folder when it would find none; it would refuse to import any cached kernel then.

    The folder is one per user and machine, open to nobody else (what lies there is executed), and passed on to child
    processes by ``NUMBA_CACHE_DIR``. To be called before the kernels are imported.

    Returns
    -------
    str or None
        The folder, or None where Numba's own choice is writable or the user has made one.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if _writable(Path(__file__).parent / "__pycache__") or _writable(home / "numba"):
        return None
    folder = os.environ["NUMBA_CACHE_DIR"] = private_folder()
    if "numba" in sys.modules:
        import numba

        numba.config.CACHE_DIR = folder
    return folder


def private_folder() -> str:
    """Return a folder below the temporary one that only this user can enter, the same for all processes of a machine.

    A folder of that name that is another's, or open to others, is not used: a new one is made instead.

    Examples
    --------
    >>> oct(os.stat(private_folder()).st_mode & 0o777)
    '0o700'
    """
    name = f"ppdf-dask-numba-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    folder = Path(tempfile.gettempdir()) / name
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    mine = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
    if stat.S_ISDIR(found.st_mode) and mine:
        return str(folder)
    return tempfile.mkdtemp(prefix=f"{name}-")


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
