#!/bin/sh
# Really try the recipes on this machine: SLURM, several hosts, schemas. As root, on Debian:  sh deploy/test.sh
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
command -v slurmctld > /dev/null && command -v ip > /dev/null || {
  apt-get update -q
  DEBIAN_FRONTEND=noninteractive apt-get install -q -y slurm-wlm munge iproute2 openssl
}
"$python" -c "import dask_jobqueue, cryptography" || "$python" -m pip install -q 'dask-jobqueue>=0.9' 'cryptography>=42'
# Only the schemas in them are used.
PPDF_DASK_SCHEMAS=${PPDF_DASK_SCHEMAS:-$(mktemp -d)}
export PPDF_DASK_SCHEMAS
[ -d "$PPDF_DASK_SCHEMAS/compose" ] ||
  "$python" -m pip install -q --no-deps --target "$PPDF_DASK_SCHEMAS" dask-kubernetes docker-compose \
    kubernetes-validate importlib-resources
"$python" -m pytest -m "slow or not slow" --durations=10 \
  tests/test_deploy.py tests/test_deploy_slurm.py tests/test_deploy_hosts.py
