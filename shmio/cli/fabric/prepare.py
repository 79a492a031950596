"""``shmio fabric prepare``: creates the registry, which the cells themselves may not do."""

from __future__ import annotations

import argparse

from shmio.cli.common import dumps
from shmio.cli.fabric import access
from shmio.fabric.registry import BUCKETS, Registry


def execute(options: argparse.Namespace) -> int:
    """Create what is missing. What exists is left as it is."""
    access.with_client(options, lambda client: Registry.open(client, replicas=options.replicas))
    print(dumps({"buckets": list(BUCKETS)}) if options.json else "the servers have a registry: the cells can join now")
    return 0
