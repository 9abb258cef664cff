"""Where compiled kernels are kept: one folder per version of this code.

numba notices when the file of a kernel changed, but not when a module it calls did, and then runs old machine code. So
the folder's name carries the state of all modules that compile. It also gives numba a place where the package and the
home are both read-only, as on clusters.
"""

from __future__ import annotations

import os
import sys
import tempfile
import zlib
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def ensure_cache() -> str | None:
    """Point numba to the folder of this code, unless the user chose one or numba is loaded already.

    Called when `ppdf_dask` is imported, before any kernel is; child processes inherit it.

    Returns
    -------
    str or None
        The folder, or None where the choice stands already.
    """
    if os.environ.get(VARIABLE) or "numba" in sys.modules:
        return None
    folder = _folder()
    if folder is not None:
        os.environ[VARIABLE] = str(folder)
    return None if folder is None else str(folder)


def state(package: Path) -> str:
    """Return eight hexadecimal digits that change with the text of any module that compiles something.

    Examples
    --------
    >>> state(Path(__file__).parent) == state(Path(__file__).parent)
    True
    """
    crc = 0
    for path in sorted(package.rglob("*.py")):
        text = path.read_bytes()
        if b"import njit" in text or b"compiled import" in text:
            crc = zlib.crc32(text, zlib.crc32(str(path.relative_to(package)).encode(), crc))
    return f"{crc:08x}"


def _folder() -> Path | None:
    name = f"numba-{state(Path(__file__).parent)}"
    for base in (_user_cache() / "ppdf_dask", Path(tempfile.gettempdir()) / f"ppdf_dask-{_user()}"):
        try:
            base.mkdir(mode=0o700, parents=True, exist_ok=True)
            # In a folder that all may write to, somebody else's would run his code as ours.
            if base.is_symlink() or (hasattr(os, "getuid") and base.stat().st_uid != os.getuid()):
                continue
            (base / name).mkdir(mode=0o700, exist_ok=True)
            with tempfile.TemporaryFile(dir=base / name):
                return base / name
        except OSError:
            continue
    return None


def _user_cache() -> Path:
    chosen = os.environ.get("XDG_CACHE_HOME")
    if chosen:
        return Path(chosen)
    home = os.environ.get("HOME") or os.environ.get("USERPROFILE")
    return Path(home) / ".cache" if home else Path(tempfile.gettempdir()) / f"ppdf_dask-{_user()}"


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
