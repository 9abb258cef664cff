"""A run on Dask Gateway, from a notebook or a terminal: the gateway brings TLS; `out` lies where all workers see it."""

from dask_gateway import Gateway

import ppdf_dask
from ppdf_dask import preflight

with Gateway().new_cluster() as cluster, cluster.get_client() as client:
    cluster.scale(20)
    memory = preflight.worker_memory(client, wait=900)
    plan = ppdf_dask.plan(ppdf_dask.scan("/shared/tiles"), out="/shared/run", memory=memory)
    print(plan.run(client))
