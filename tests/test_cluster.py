"""Safe by default: loopback, TLS or an explicit word; pre-flight; the dashboard's link."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import certificates
import dask
import pytest
from distributed import Client, LocalCluster, Security

from ppdf_dask import cluster, execute, preflight
from ppdf_dask.cluster import check_address, connect, dashboard
from ppdf_dask.errors import ClusterError
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.survey import scan


@pytest.mark.parametrize(
    "address",
    ["tcp://127.0.0.1:8786", "127.0.0.1:8786", "tcp://[::1]:8786", "localhost:8786", "tls://a.b:1", "inproc://1/2/3"],
)
def test_addresses_that_nobody_else_can_read(address):
    check_address(address)


@pytest.mark.parametrize(
    "address",
    [
        "tcp://10.0.0.1:8786",
        "10.0.0.1:8786",
        "tcp://127.evil.com:8786",
        "ucx://10.0.0.1:1",
        "tcp://localhost.evil.com:1",
    ],
)
def test_open_addresses_need_a_word(address):
    with pytest.raises(ClusterError, match="--insecure"):
        check_address(address)
    check_address(address, insecure=True)


def test_a_scheduler_file_hides_no_open_address(tmp_path):
    path = tmp_path / "scheduler.json"
    path.write_text('{"address": "tcp://10.0.0.1:8786"}')
    with pytest.raises(ClusterError, match="not encrypted"), connect(str(path)):
        pass
    path.write_text('{"id": 1}')
    with pytest.raises(ClusterError, match="holds no scheduler's address"), connect(str(path)):
        pass


def test_nobody_answers(monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    with pytest.raises(ClusterError, match="no scheduler answers at tcp"), connect("tcp://127.0.0.1:9"):
        pass


def test_what_we_start_listens_on_loopback_only_and_keeps_its_memory(monkeypatch):
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "1000000")  # what the user sets goes before
    with cluster.local_cluster(1) as client:
        (found,) = client.run(lambda: dict(os.environ)).values()
        (cycle,) = client.run(
            lambda dask_worker: dask_worker.periodic_callbacks["profile-cycle"].callback_time
        ).values()
        info = client.scheduler_info()
        addresses = [info["address"], *info["workers"], *(w["nanny"] for w in info["workers"].values())]
        ports = {int(a.rsplit(":", 1)[1]) for a in addresses} | set(info["services"].values())
        ports |= {w["services"]["dashboard"] for w in info["workers"].values()}
        heard = listeners()
    assert all("//127.0.0.1:" in a for a in addresses)
    assert {address for address, port in heard if port in ports} == {"0100007F"}
    assert ports <= {port for _, port in heard}
    assert cycle == 600_000
    assert {name: found[name] for name in cluster.ENVIRONMENT} == {
        **cluster.ENVIRONMENT,
        "MALLOC_TRIM_THRESHOLD_": "1000000",
    }


def listeners() -> set[tuple[str, int]]:
    """Return address (hexadecimal, as the kernel writes it) and port of all listening TCP sockets."""
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            place, state = line.split()[1], line.split()[3]
            if state == "0A":
                found.add((place.split(":")[0], int(place.split(":")[1], 16)))
    return found


@pytest.fixture(scope="module")
def tls(tmp_path_factory):
    """Give Dask's variables of two authorities and an encrypted scheduler of the first."""
    folder = tmp_path_factory.mktemp("tls")
    good, bad = certificates.make(folder / "good"), certificates.make(folder / "bad")
    place = good["DASK_DISTRIBUTED__COMM__TLS__CA_FILE"].rsplit("/", 1)[0]
    parts = {"tls_ca_file": f"{place}/ca.pem", "require_encryption": True}
    for role in ("scheduler", "worker", "client"):
        parts |= {f"tls_{role}_cert": f"{place}/node.pem", f"tls_{role}_key": f"{place}/node.key"}
    security = Security(**parts)
    with LocalCluster(
        n_workers=1, processes=False, host="tls://127.0.0.1", security=security, dashboard_address="127.0.0.1:0"
    ) as made:
        yield SimpleNamespace(address=made.scheduler_address, good=good, bad=bad)


def configured(variables):
    return dask.config.set({k.removeprefix("DASK_").replace("__", ".").lower(): v for k, v in variables.items()})


def test_tls_with_the_right_certificates(tls):
    with configured(tls.good), connect(tls.address) as client:
        assert client.scheduler_info(n_workers=-1)["workers"]


def test_tls_with_another_authority_is_said_so(tls, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 2.0)
    with (
        configured(tls.bad),
        pytest.raises(ClusterError, match="trust each other"),
        connect(tls.address),
    ):
        pass


def test_tls_without_certificates_says_what_to_set(tls):
    with pytest.raises(ClusterError, match="DASK_DISTRIBUTED__COMM__TLS__CA_FILE"), connect(tls.address):
        pass


def test_a_plain_client_of_a_tls_scheduler_is_told(tls, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 1.0)
    with pytest.raises(ClusterError, match="wants tls://"), connect(tls.address.replace("tls", "tcp")):
        pass


def test_a_key_that_others_can_read_is_refused(tls):
    key = tls.good["DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY"]
    os.chmod(key, 0o644)
    try:
        with configured(tls.good), pytest.raises(ClusterError, match="chmod 600"), connect(tls.address):
            pass
    finally:
        os.chmod(key, 0o600)


def linked(link: str) -> SimpleNamespace:
    return SimpleNamespace(dashboard_link=link)


def test_whether_a_dashboard_answers():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        place = urlsplit(f"http://127.0.0.1:{listener.getsockname()[1]}/status")
        assert not cluster._answers(place)
        listener.listen()
        assert cluster._answers(place)


def test_a_dashboard_on_another_machines_loopback_needs_a_tunnel(monkeypatch):
    monkeypatch.setattr(cluster, "_answers", lambda place: False)
    there = linked("http://node7:8787/status")
    for environ in ({}, {"JUPYTERHUB_SERVICE_PREFIX": "/user/ann/"}):
        assert dashboard(there, environ) == [
            "dashboard on node7 only: ssh -N -L 8787:127.0.0.1:8787 node7, then http://127.0.0.1:8787/status"
        ]


def test_the_dashboard_link_as_a_browser_needs_it(monkeypatch):
    monkeypatch.setattr(cluster, "_answers", lambda place: True)
    here = linked("http://127.0.0.1:8787/status")
    assert dashboard(here, {}) == ["dashboard http://127.0.0.1:8787/status"]
    assert dashboard(here, {"JUPYTERHUB_SERVICE_PREFIX": "/user/ann/"}) == ["dashboard /user/ann/proxy/8787/status"]
    there = linked("http://10.0.0.7:8787/status")
    assert dashboard(there, {"JUPYTERHUB_SERVICE_PREFIX": "/user/ann/"}) == [
        "dashboard /user/ann/proxy/10.0.0.7:8787/status"
    ]
    lines = dashboard(there, {"SSH_CONNECTION": "1.2.3.4 5 6.7.8.9 22", "USER": "ann"})
    assert "ssh -N -L 8787:10.0.0.7:8787 ann@" in lines[1]
    assert dashboard(linked(""), {}) == []


# -- pre-flight -------------------------------------------------------------------------------------------------------


@pytest.fixture
def made(small_survey, tmp_path):
    return plan(scan([small_survey / "tiles"]), RunParams(chunks=ChunkParams(chunk_size=60.0)), out=tmp_path / "run")


def test_a_sound_cluster_passes_and_nothing_is_left(client, made):
    preflight.check(client, made)
    assert not made.out.exists()


def answer(needs: preflight.Needs, **changes):
    return preflight.probe(needs) | {"memory_limit": 4e9, "threads": 1} | changes


def faults_of(made, **changes) -> dict[str, str]:
    with preflight._meeting_place(made) as needs:
        found = preflight.find_faults({"tcp://w:1": answer(needs, **changes)}, needs)
    return {f.check: f.found for f in found}


def test_each_fault_is_named(made):
    assert faults_of(made) == {}
    other = preflight.versions() | {"numpy": "1.0"}
    assert faults_of(made, versions=other)["version"].startswith("numpy 1.0, here")
    assert "per thread" in faults_of(made, threads=16)["memory"]
    assert "is not seen here" in faults_of(made, note="elsewhere")["shared folder"]


def test_a_worker_that_cannot_answer_is_a_fault(made):
    with preflight._meeting_place(made) as needs:
        found = preflight.find_faults({"tcp://w:1": ModuleNotFoundError("No module named 'ppdf_dask'")}, needs)
    assert found[0].check == "answer"
    assert "No module named" in found[0].found


def test_another_folder_of_the_same_name_is_seen(made, tmp_path):
    with preflight._meeting_place(made) as needs:
        (Path(needs.out) / needs.token / "client").write_text("another disk")
        assert [f[0] for f in preflight.probe(needs)["faults"]] == ["shared folder"]
        (Path(needs.out) / needs.token / "client").unlink()
        assert [f[0] for f in preflight.probe(needs)["faults"]] == ["shared folder"]


def test_a_folder_that_cannot_be_written_is_seen(made, monkeypatch):
    with preflight._meeting_place(made) as needs:
        monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(30, "Read-only file system")))
        found = preflight.probe(needs)
    assert found["faults"][0][:2] == ("write", f"{needs.out} cannot be written (Read-only file system)")
    assert not found["wrote"]


def test_a_source_file_that_is_another_there_is_seen(made):
    with preflight._meeting_place(made) as needs:
        tile = made.survey.tiles[0]
        other = tile.from_dict(tile.as_dict() | {"size": tile.size + 1})
        found = preflight.probe(preflight.Needs(needs.out, needs.token, (other,), 1.0))
    assert found["faults"][0][0] == "source file"


def test_a_cluster_without_workers_is_said_so(made):
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        Client(empty) as client,
    ):
        with pytest.raises(ClusterError, match="has no worker"):
            preflight.check(client, made, wait=0.2)
        with pytest.raises(ClusterError, match="has no worker"):
            preflight.worker_memory(client, wait=0.2)


def test_a_cluster_that_lost_all_its_workers_is_said_so_and_waited_for(monkeypatch):
    monkeypatch.setattr(execute, "PATIENCE", 0.2)
    heard = []
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        Client(empty) as client,
    ):

        def hear(event):
            heard.append(event.record.get("warning", ""))
            if event.state == "noted":
                empty.scale(1)

        stage = execute.Stage("tile", lambda url, job, fingerprint: {"job": job}, "", "t")
        work = execute.Work("s_000000", 1, 7, "")
        assert list(execute.execute(client, stage, [work], hear)) == [(work, {"job": 7})]
    (said,) = [text for text in heard if text]
    assert re.fullmatch(r"the scheduler at \S+ has had no worker for 0.2 s; the run goes on as soon .*", said)


def test_closing_the_cluster_under_a_run_is_named(made):
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as short,
        Client(short) as client,
    ):

        def end(event):
            if event.state == "done":
                short.close()

        with pytest.raises(ClusterError, match=r"the scheduler at \S+:\S+ was lost .* it goes on where it stopped"):
            made.run(client, on_event=end)


SECRETS = {
    "AWS_SECRET_ACCESS_KEY": "wJalrXUtnFEMI",
    "DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY": "/keys/private-of-ann.pem",
    "JUPYTERHUB_API_TOKEN": "hub-token-4711",
}


def test_credentials_reach_neither_records_nor_logs(small_survey, tmp_path):
    out, log = tmp_path / "run", tmp_path / "events.jsonl"
    command = [sys.executable, "-m", "ppdf_dask", "run", str(small_survey / "tiles"), "--out", str(out)]
    environment = os.environ | SECRETS
    ran = subprocess.run(
        [*command, "--workers", "1", "--json-log", str(log)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    doctor = subprocess.run(
        [sys.executable, "-m", "ppdf_dask", "doctor", "--json"], env=environment, capture_output=True, check=True
    )
    texts = [ran.stdout.encode(), ran.stderr.encode(), doctor.stdout, log.read_bytes()]
    texts += [p.read_bytes() for p in out.rglob("*") if p.is_file()]
    assert len(texts) > 20
    assert not [secret for secret in SECRETS.values() for text in texts if secret.encode() in text]
    assert json.loads(doctor.stdout)["versions"] == preflight.versions()
