"""Throw-away certificates for tests of encrypted clusters, by the openssl command."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def make(folder: Path, hosts: tuple[str, ...] = ("127.0.0.1",)) -> dict[str, str]:
    """Make a CA and one certificate; return Dask's variables for scheduler, workers and clients alike."""
    folder.mkdir(parents=True)
    run = lambda *a: subprocess.run(["openssl", *a], cwd=folder, check=True, capture_output=True)  # noqa: E731
    run("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", "-days", "2",
        "-subj", "/CN=test ca")  # fmt: skip
    run("req", "-newkey", "rsa:2048", "-nodes", "-keyout", "node.key", "-out", "node.csr", "-subj", "/CN=node")
    names = ",".join(f"IP:{host}" for host in hosts)
    (folder / "names").write_text(f"subjectAltName={names}\n")
    run("x509", "-req", "-in", "node.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2",
        "-extfile", "names", "-out", "node.pem")  # fmt: skip
    os.chmod(folder / "node.key", 0o600)
    variables = {"CA_FILE": "ca.pem"}
    for role in ("SCHEDULER", "WORKER", "CLIENT"):
        variables |= {f"{role}__CERT": "node.pem", f"{role}__KEY": "node.key"}
    return {f"DASK_DISTRIBUTED__COMM__TLS__{name}": str(folder / value) for name, value in variables.items()}
