"""A fingerprint of this package's own code: results of different code are not mixed, whatever the version says."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

NO_RESULT = ("cli", "experiments", "synthetic")
"""Folders of the package that shape no result of a run."""


@cache
def code() -> str:
    """Return 12 hexadecimal digits of all modules that a run's results may depend on.

    Examples
    --------
    >>> len(code()), code() == code()
    (12, True)
    """
    root = Path(__file__).parent
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in NO_RESULT:
            found.update(f"{name.as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()[:12]
