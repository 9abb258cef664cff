"""A run on Coiled: it brings TLS and the versions; `out` lies on a file system that its machines mount."""

import coiled

import ppdf_dask
from ppdf_dask import preflight

workers = {"n_workers": 20, "worker_memory": "8 GiB", "worker_options": {"nthreads": 1}}
with coiled.Cluster(**workers) as cluster, cluster.get_client() as client:
    memory = preflight.worker_memory(client, wait=900)
    plan = ppdf_dask.plan(ppdf_dask.scan("/mnt/survey/tiles"), out="/mnt/survey/run", memory=memory)
    print(plan.run(client))
