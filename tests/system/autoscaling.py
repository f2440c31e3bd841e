"""A Ray cluster with an autoscaler, which starts nodes for actors without a place and ends idle nodes.

It is Ray's own `AutoscalingCluster`, whose nodes are processes of one host. It ends every Ray process that it sees, so
the host has process ids of its own. Ray's wheel lacks the example config that it begins with, so the host sees a copy
of the provider's folder that has one.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import yaml

from tests.system.cluster import PORT, RAY_SETTINGS, Machines

EXAMPLE = {
    "cluster_name": "autoscaled",
    "max_workers": 8,
    "provider": {
        "type": "fake_multinode",
        "use_node_id_as_ip": True,
        "disable_node_updaters": True,
        "disable_launch_config_check": True,
    },
    "available_node_types": {},
    "head_node_type": "ray.head.default",
    "upscaling_speed": 1.0,
    "idle_timeout_minutes": 0.1,
    **{key: {} for key in ("auth", "docker", "file_mounts")},
    **{key: [] for key in ("initialization_commands", "setup_commands", "cluster_synced_files")},
    **{f"{node}_{when}_commands": [] for node in ("head", "worker") for when in ("setup", "start_ray")},
}
START = """
import json, sys
from ray.cluster_utils import AutoscalingCluster
AutoscalingCluster({"CPU": 0, "object_store_memory": 10**8}, json.loads(sys.argv[1]), autoscaler_v2=True).start()
"""
NODES = """
import json, ray
ray.init("auto", logging_level="error", log_to_driver=False)
print(json.dumps([node["NodeID"] for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]))
"""


class Autoscaled(Machines):
    """A host called `head` with the cluster, which begins without any node for workers. Use as a context manager."""

    def __init__(self, log_folder: Path, *, cpus: int, most: int) -> None:
        """Make a cluster that can get `most` nodes with `cpus` CPUs each. An idle node ends after six seconds."""
        super().__init__(log_folder)
        resources = {"CPU": cpus, "object_store_memory": 10**8}
        self._types = {"worker": {"resources": resources, "node_config": {}, "min_workers": 0, "max_workers": most}}

    @property
    def address(self) -> str:
        """Where a driver joins, and which is the same for all nodes, since they are on this host."""
        return f"127.0.0.1:{PORT}"

    def begin(self) -> None:
        """Make the host and start the cluster."""
        import ray

        provider = Path(ray.__file__).parent / "autoscaler" / "_private" / "fake_multi_node"
        copy = self.log_folder / "provider"
        shutil.copytree(provider, copy)
        (copy / "example.yaml").write_text(yaml.safe_dump(EXAMPLE))
        self.boot("head", setup=f"mount --bind {copy} {provider}")
        self._python(START, json.dumps(self._types))

    def workers(self) -> set[str]:
        """Ids of the nodes for workers that are alive."""
        return set(json.loads(self._python(NODES).splitlines()[-1]))

    def preempt(self, node: str, seconds: int) -> None:
        """Tell a node that it will be taken away, as a cloud does."""
        reason = ("--reason=DRAIN_NODE_REASON_PREEMPTION", "--reason-message=preempted")
        deadline = f"--deadline-remaining-seconds={seconds}"
        code, printed = self.run(
            "head", "ray", "drain-node", f"--address={self.address}", f"--node-id={node}", *reason, deadline
        )
        assert code == 0, printed

    def _python(self, script: str, *arguments: str) -> str:
        code, printed = self.run("head", sys.executable, "-c", script, *arguments, timeout=120)
        assert code == 0, printed
        return printed

    def _environment(self, node: str) -> dict[str, str]:
        return super()._environment(node) | RAY_SETTINGS
