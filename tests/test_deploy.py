"""The recipes: schemas, rules of hadolint, the image's steps replayed, nothing runs as root."""

from __future__ import annotations

import ast
import json
import os
import re
import socket
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import yaml

from ppdf_dask.cluster import ENVIRONMENT

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
MANIFESTS = sorted((DEPLOY / "kubernetes").glob("*.yaml"))


@pytest.fixture(scope="session")
def schemas() -> Path:
    folder = os.environ.get("PPDF_DASK_SCHEMAS")
    if not folder:
        pytest.skip("PPDF_DASK_SCHEMAS is not set: no schemas here (sh deploy/test.sh brings them)")
    return Path(folder)


def documents(path: Path) -> list[dict]:
    return list(yaml.safe_load_all(path.read_text()))


@pytest.mark.parametrize("recipe", ["slurm/runner.sbatch", "docker/Dockerfile"])
def test_workers_of_a_recipe_have_the_environment_of_our_own(recipe):
    text = (DEPLOY / recipe).read_text().split()
    assert {f"{name}={value}" for name, value in ENVIRONMENT.items()} <= set(text)


def test_manifests_match_the_operators_own_definitions(schemas):
    jsonschema = pytest.importorskip("jsonschema")
    kinds = set()
    crds = schemas / "dask_kubernetes/operator/deployment/helm/dask-kubernetes-operator/crds"
    for path in MANIFESTS:
        for document in documents(path):
            if document["kind"].startswith("Dask"):
                crd = yaml.safe_load((crds / f"{document['kind'].lower()}.yaml").read_text())
                schema = crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
                body = {"spec": document["spec"]}
                found = [e.message for e in jsonschema.Draft202012Validator(strict(schema)).iter_errors(body)]
                assert not found, f"{path}: {found}"
                assert document["apiVersion"] == f"{crd['spec']['group']}/{crd['spec']['versions'][0]['name']}"
                kinds.add(document["kind"])
    assert kinds == {"DaskCluster", "DaskJob", "DaskAutoscaler"}


def strict(schema):
    """Refuse unknown fields: the API server would drop them."""
    if isinstance(schema, list):
        return [strict(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    made = {name: strict(part) for name, part in schema.items()}
    if made.get("x-kubernetes-int-or-string"):
        made.pop("anyOf", None)
        made["type"] = ["integer", "string"]
    if isinstance(made.get("properties"), dict):
        made.setdefault("additionalProperties", made.get("x-kubernetes-preserve-unknown-fields", False))
    return made


def pods(value):
    """Find all pod specs of a document."""
    if isinstance(value, dict):
        if "containers" in value:
            yield value
        for part in value.values():
            yield from pods(part)


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda p: p.stem)
def test_pods_are_locked_down_and_limited(path):
    for document in documents(path):
        for pod in pods(document):
            assert pod["securityContext"]["runAsNonRoot"] is True
            assert pod["automountServiceAccountToken"] is False
            assert not any("hostPath" in volume for volume in pod["volumes"])
            for container in pod["containers"]:
                locked = container["securityContext"]
                assert locked["readOnlyRootFilesystem"]
                assert not locked["allowPrivilegeEscalation"]
                assert locked["capabilities"] == {"drop": ["ALL"]}
                assert container["resources"]["limits"] == container["resources"]["requests"]
                limit = re.search(r"--memory-limit=([\d.]+)GiB", " ".join(container["args"]))
                if limit:
                    assert float(limit[1]) < float(container["resources"]["limits"]["memory"].removesuffix("Gi"))


def test_every_cluster_has_a_network_policy():
    found = [d for path in MANIFESTS for d in documents(path)]
    closed = {d["spec"]["podSelector"]["matchLabels"]["dask.org/cluster-name"]
              for d in found if d["kind"] == "NetworkPolicy"}  # fmt: skip
    assert closed == {d["metadata"]["name"] for d in found if d["kind"] in ("DaskCluster", "DaskJob")}


def test_network_policies_match_kubernetes_own_schema(schemas):
    pytest.importorskip("jsonschema")
    policies = str(DEPLOY / "kubernetes/network.yaml")
    subprocess.run(
        [sys.executable, "-m", "kubernetes_validate", "--strict", policies],
        env=os.environ | {"PYTHONPATH": str(schemas)},
        check=True,
        capture_output=True,
    )


def test_compose_file_matches_its_schema(schemas):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((schemas / "compose/config/compose_spec.json").read_text())
    document = yaml.safe_load((DEPLOY / "docker/compose.yaml").read_text())
    assert not list(jsonschema.Draft7Validator(schema).iter_errors(document))


def test_compose_publishes_on_loopback_only():
    services = yaml.safe_load((DEPLOY / "docker/compose.yaml").read_text())["services"]
    published = [port for s in services.values() for port in s.get("ports", [])]
    assert published == ["127.0.0.1:8787:8787", "127.0.0.1:8888:8888"]
    assert {s["user"] for s in services.values()} == {"10001:10001"}
    assert all(s["read_only"] and s["cap_drop"] == ["ALL"] for s in services.values())


def instructions() -> list[tuple[str, str]]:
    text = (DEPLOY / "docker/Dockerfile").read_text()
    lines = [line for line in text.replace("\\\n", " ").splitlines() if line.strip() and not line.startswith("#")]
    return [(name, rest.strip()) for name, rest in (line.split(" ", 1) for line in lines)]


@pytest.mark.skipif(sys.platform != "linux", reason="hadolint comes with the development extra on Linux only")
def test_hadolint_finds_nothing():
    linter = str(Path(sys.executable).parent / "hadolint")
    ran = subprocess.run([linter, str(DEPLOY / "docker/Dockerfile")], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (0, "")


def test_the_image_is_pinned_and_not_root():
    found = instructions()
    bases = [rest for name, rest in found if name == "FROM"]
    assert len(bases) == 2
    for base in bases:
        assert re.match(r"python:\d+\.\d+\.\d+-slim-\w+( AS \w+)?$", base), "a base is pinned"
    assert bases[0].split(" AS ")[0] == bases[1], "both stages have the same interpreter"
    assert [rest for name, rest in found if name == "USER"][-1] == "10001:10001"
    installs = [rest for name, rest in found if name == "RUN" and "pip install" in rest]
    assert all("--constraint constraints.txt" in rest for rest in installs), "what hadolint does not see: versions"


def test_what_the_image_copies_is_there_and_let_in():
    let_in = (DEPLOY / "docker/Dockerfile.dockerignore").read_text().splitlines()
    for name, rest in instructions():
        if name == "COPY" and "--from" not in rest:
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists()
                assert f"!{source.removeprefix('./')}" in let_in


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_images_steps_make_a_working_installation(tmp_path):
    """Replay the steps of the first stage in a clean folder and environment, with this interpreter."""
    context, target = tmp_path / "src", tmp_path / "opt"
    context.mkdir()
    for name, rest in instructions():
        if name == "COPY" and "--from" not in rest:
            *sources, place = rest.split()
            for source in sources:
                into = context / (place if len(sources) == 1 else Path(place) / source)
                subprocess.run(["cp", "-r", str(ROOT / source), str(into)], check=True)
        elif name == "RUN" and "/opt/ppdf" in rest:
            step = rest.replace("/opt/ppdf", str(target)).replace("python -m venv", f"{sys.executable} -m venv")
            subprocess.run(["sh", "-euc", step], cwd=context, check=True)
    environment = image_environment(tmp_path) | {"PATH": f"{target}/bin:/usr/bin:/bin", "HOME": "/nowhere"}
    said = subprocess.run(
        [f"{target}/bin/ppdf-dask", "doctor", "--json"], env=environment, capture_output=True, check=True, cwd=tmp_path
    )
    assert json.loads(said.stdout)["versions"]["ppdf-dask"]
    subprocess.run([f"{target}/bin/dask", "scheduler", "--help"], env=environment, check=True, capture_output=True)
    the_notebook_answers(Path(target), environment, tmp_path)


def image_environment(tmp_path: Path) -> dict[str, str]:
    """Return the image's variables with its /tmp here."""
    (variables,) = (rest for name, rest in instructions() if name == "ENV")
    pairs = (pair.split("=", 1) for pair in variables.split())
    return {name: value.replace("/tmp", str(tmp_path / "tmp")) for name, value in pairs if name != "PATH"}


def the_notebook_answers(target: Path, environment: dict[str, str], tmp_path: Path) -> None:
    """Start the notebook as compose.yaml does: it wants the token, and does not write it down."""
    notebook = yaml.safe_load((DEPLOY / "docker/compose.yaml").read_text())["services"]["notebook"]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = [o.replace("8888", str(port)).replace("0.0.0.0", "127.0.0.1") for o in notebook["command"][1:]]
    log = tmp_path / "notebook.log"
    command = [f"{target}/bin/{notebook['command'][0]}", *(o.replace("/data", "/tmp") for o in options)]
    with log.open("wb") as out:
        # Jupyter refuses to be root unless told so; in the image it is not.
        server = subprocess.Popen([*command, "--allow-root"], stdout=out, stderr=out,
                                  env=environment | {"JUPYTER_TOKEN": "word-of-ann"})  # fmt: skip
    try:
        page, end = f"http://127.0.0.1:{port}/api/contents", time.monotonic() + 120
        while (code := answer(page)) == 0:
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.5)
        assert (code, answer(f"{page}?token=word-of-ann")) == (403, 200)
    finally:
        server.terminate()
        server.wait()
    assert "word-of-ann" not in log.read_text()


def answer(page: str) -> int:
    """Return the HTTP code of a page, 0 when nobody answers."""
    try:
        with urllib.request.urlopen(page, timeout=30) as found:
            return int(found.status)
    except urllib.error.HTTPError as refused:
        return refused.code
    except OSError:
        return 0


def test_certificates_are_private(tmp_path):
    subprocess.run(["sh", str(DEPLOY / "certificates.sh"), str(tmp_path / "tls")], check=True)
    found = {p.name: stat.S_IMODE(p.stat().st_mode) for p in (tmp_path / "tls").iterdir()}
    assert "ca.key" not in found
    assert found["node.key"] == 0o600
    assert stat.S_IMODE((tmp_path / "tls").stat().st_mode) == 0o700


@pytest.mark.parametrize("path", sorted(DEPLOY.rglob("*.sh")) + sorted(DEPLOY.rglob("*.sbatch")), ids=lambda p: p.name)
def test_scripts_parse(path):
    subprocess.run(["bash", "-n", str(path)], check=True)


@pytest.mark.parametrize("name", ["gateway.py", "coiled.py"])
def test_examples_only_hand_over_a_client(name):
    """Check that the names they use from this package exist; the services themselves are not here."""
    tree = ast.parse((DEPLOY / name).read_text())
    import ppdf_dask
    from ppdf_dask import preflight

    used = {(n.value.id, n.attr) for n in ast.walk(tree)
            if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)}  # fmt: skip
    for module, attribute in used:
        if module in ("ppdf_dask", "preflight"):
            assert hasattr({"ppdf_dask": ppdf_dask, "preflight": preflight}[module], attribute)
    assert ("ppdf_dask", "plan") in used


def test_the_autoscaler_and_the_cluster_speak_of_the_same_one():
    scaler = documents(DEPLOY / "kubernetes/autoscaler.yaml")[0]["spec"]
    assert scaler["cluster"] == documents(DEPLOY / "kubernetes/cluster.yaml")[0]["metadata"]["name"]
