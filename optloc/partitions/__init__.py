"""Fixes of large data sets: one partition at a time, in this process, on a Dask cluster or on Ray."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.partitions.clusters import dask_client as dask_client, ray_cluster as ray_cluster
    from optloc.partitions.executors import task_executor as task_executor
    from optloc.partitions.fixed_columns import fix_schema as fix_schema
    from optloc.partitions.one_partition import fix_table as fix_table

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
