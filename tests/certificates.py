"""Throw-away certificates for tests of encrypted clusters: by the script that deploy/ offers."""

from __future__ import annotations

import subprocess
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "deploy" / "certificates.sh"


def make(folder: Path) -> dict[str, str]:
    """Make certificates; return Dask's variables for scheduler, workers and clients alike."""
    subprocess.run(["sh", str(SCRIPT), str(folder)], check=True)
    lines = (folder / "tls.env").read_text().splitlines()
    pairs = (line.removeprefix("export ").split("=", 1) for line in lines)
    return {name: value.strip("'") for name, value in pairs}
